"""What an application tests itself with: the plugin of pytest, and the crash-test of a manager."""

from __future__ import annotations

from rr_actors.testing.callback_notes import closed, opened
from rr_actors.testing.manager_checks import ManagerCheck, ManagerFault, check_manager, play_steps
from rr_actors.testing.scenario_steps import (
    AskUsage,
    Fatal,
    Kill,
    Load,
    LoadTogether,
    Pause,
    Reload,
    Resume,
    SendStatus,
    Step,
    Unload,
    UnloadTogether,
    Update,
    Wrong,
)

__all__ = [
    "AskUsage",
    "Fatal",
    "Kill",
    "Load",
    "LoadTogether",
    "ManagerCheck",
    "ManagerFault",
    "Pause",
    "Reload",
    "Resume",
    "SendStatus",
    "Step",
    "Unload",
    "UnloadTogether",
    "Update",
    "Wrong",
    "check_manager",
    "closed",
    "opened",
    "play_steps",
]
