"""Ready-made managers: for programs, components made of programs, robots made of components, and budgets."""

from __future__ import annotations

from rr_actors.base.errors import OverCapacity
from rr_actors.managers.budgets.budget_manager import Budgets, PoolInfo, Share, Supply
from rr_actors.managers.budgets.pools import Pool, Reserve
from rr_actors.managers.components import Component, Components, LoadComponent
from rr_actors.managers.programs import Program, Programs, Ready, RunProgram
from rr_actors.managers.robots import LoadRobot, Robot, Robots

__all__ = [
    "Budgets",
    "Component",
    "Components",
    "LoadComponent",
    "LoadRobot",
    "OverCapacity",
    "Pool",
    "PoolInfo",
    "Program",
    "Programs",
    "Ready",
    "Reserve",
    "Robot",
    "Robots",
    "RunProgram",
    "Share",
    "Supply",
]
