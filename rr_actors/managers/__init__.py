"""Ready-made managers: for programs, for components made of programs, and for robots made of components."""

from __future__ import annotations

from rr_actors.managers.components import Component, Components, LoadComponent
from rr_actors.managers.programs import Program, Programs, Ready, RunProgram
from rr_actors.managers.robots import LoadRobot, Robot, Robots

__all__ = [
    "Component",
    "Components",
    "LoadComponent",
    "LoadRobot",
    "Program",
    "Programs",
    "Ready",
    "Robot",
    "Robots",
    "RunProgram",
]
