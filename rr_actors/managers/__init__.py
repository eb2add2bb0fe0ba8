"""Ready-made managers: programs, components, pipes and robots of these, budgets, choices, what is kept, actions."""

from __future__ import annotations

from rr_actors.base.errors import GraphError, MissingDependency, NotAllowed, OverCapacity
from rr_actors.managers.actions.action import Action
from rr_actors.managers.actions.action_manager import ActionEnd, Actions, RunAction, RunGraph
from rr_actors.managers.actions.graph_pictures import draw_graph
from rr_actors.managers.actions.graph_results import GraphResult, run_graph
from rr_actors.managers.budgets.budget_manager import Budgets
from rr_actors.managers.budgets.measures import Measure
from rr_actors.managers.budgets.pools import Pool, Reserve, Sink
from rr_actors.managers.budgets.requests import PoolInfo, Share, Supply
from rr_actors.managers.choices.alternatives import Alternative
from rr_actors.managers.choices.by_hand import ChoiceInfo
from rr_actors.managers.choices.choice_manager import Choices
from rr_actors.managers.choices.chosen import Choose, Chosen
from rr_actors.managers.components import Component, Components, LoadComponent
from rr_actors.managers.keeper.keep_manager import Keeper, Kept
from rr_actors.managers.pipes.pipe_manager import BuiltPipe, Pipe, Pipes
from rr_actors.managers.program_conditions import ProgramHealth
from rr_actors.managers.programs import Program, Programs, Ready, RunProgram
from rr_actors.managers.replays import Replays
from rr_actors.managers.robots import LoadRobot, Robot, Robots

__all__ = [
    "Action",
    "ActionEnd",
    "Actions",
    "Alternative",
    "Budgets",
    "BuiltPipe",
    "ChoiceInfo",
    "Choices",
    "Choose",
    "Chosen",
    "Component",
    "Components",
    "GraphError",
    "GraphResult",
    "Keeper",
    "Kept",
    "LoadComponent",
    "LoadRobot",
    "Measure",
    "MissingDependency",
    "NotAllowed",
    "OverCapacity",
    "Pipe",
    "Pipes",
    "Pool",
    "PoolInfo",
    "Program",
    "ProgramHealth",
    "Programs",
    "Ready",
    "Replays",
    "Reserve",
    "Robot",
    "Robots",
    "RunAction",
    "RunGraph",
    "RunProgram",
    "Share",
    "Sink",
    "Supply",
    "draw_graph",
    "run_graph",
]
