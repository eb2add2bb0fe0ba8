"""Roles: the kinds of callbacks that a server has. This table says how each begins, runs and ends."""

from __future__ import annotations

from typing import Literal

import msgspec

from rr_actors.registrar.model.rows import LOADED, LOADING, PAUSING, RESUMING, UNLOADING, Phase


class Role(msgspec.Struct, frozen=True, eq=False):
    """One kind of callback of a server; ROLES has all of them.

    Attributes:
        name: its name in commands, effects and rows, and for people.
        arguments: what the callback is called with.
        phase: the phase of the resource until the callback returns; None: nothing waits for it.
        answer: what the callback returns: the response; a new response, or None; something else.
        reports: whether it may report progress.
        patient: whether it waits for a free thread however many do so; else it is refused then.
        in_order: whether the callbacks of one resource run one after another.
        alone: whether it waits until no health callback of the resource runs.
        counted: whether a row of its own counts the processes that died in its runs. The row of a resource counts the
            runs of its load and unload itself.
        on_demand: whether its runs are begun by BeginRun, and have a part of the server of their own.
        field: its field in ServerSpec, if that is not its name.
    """

    name: str
    arguments: tuple[str, ...]
    phase: Phase | None = None
    answer: Literal["response", "new response", ""] = ""
    reports: bool = False
    patient: bool = False
    in_order: bool = False
    alone: bool = False
    counted: bool = False
    on_demand: bool = False
    field: str = ""

    @property
    def option(self) -> str:
        """Its field in ServerSpec."""
        return self.field or self.name


_BOTH = ("request", "response")
LOAD = Role("load", ("request",), LOADING, "response", reports=True)
UNLOAD = Role("unload", _BOTH, UNLOADING, patient=True, alone=True)
STATUS = Role("status", ("request", "status"), in_order=True, counted=True)
RECOVER = Role("recover", _BOTH, LOADED, "response", reports=True, patient=True, counted=True)
UPGRADE = Role("upgrade", _BOTH)
USAGE = Role("usage", _BOTH, patient=True, counted=True, on_demand=True)
HEALTH = Role("health", _BOTH, patient=True, counted=True, on_demand=True, field="probe")
PAUSE = Role("pause", _BOTH, PAUSING, patient=True, alone=True, counted=True)
RELOAD = Role("reload", _BOTH, LOADED, patient=True, alone=True, counted=True, field="unload")
RESUME = Role("resume", _BOTH, RESUMING, "new response", patient=True, counted=True)

ROLES = {role.option: role for role in (LOAD, UNLOAD, STATUS, RECOVER, UPGRADE, USAGE, HEALTH, PAUSE, RESUME)}
"""All roles that have a callback of their own, by its field in ServerSpec. RELOAD runs that of UNLOAD."""

BEGUN = {role.name: role for role in (LOAD, RECOVER, STATUS, UNLOAD, PAUSE, RESUME, HEALTH, USAGE, RELOAD)}
"""The roles whose callbacks decisions begin, by name: all but the upgrade, which runs before any."""
