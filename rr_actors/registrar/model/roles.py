"""Roles: the kinds of callbacks that a server has."""

from __future__ import annotations

import msgspec

from rr_actors.registrar.model.rows import LOADED, LOADING, PAUSING, RESUMING, UNLOADING, Phase


class Role(msgspec.Struct, frozen=True, eq=False):
    """One kind of callback of a server; ROLES has all of them.

    Attributes:
        name: its field in ServerSpec.
        arguments: what the callback is called with.
        phase: the phase of the resource until the callback returns; None: nothing waits for it.
        reports: whether it may report progress.
        patient: whether it waits for a free thread however many do so; else it is refused then.
        in_order: whether the callbacks of one resource run one after another.
        counted: the name under which core/callback_runs.py counts the processes that died in its runs; "" for a load or
            unload, whose rows count their runs themselves.
    """

    name: str
    arguments: tuple[str, ...]
    phase: Phase | None = None
    reports: bool = False
    patient: bool = False
    in_order: bool = False
    counted: str = ""


LOAD = Role("load", ("request",), LOADING, reports=True)
UNLOAD = Role("unload", ("request", "response"), UNLOADING, patient=True)
STATUS = Role("status", ("request", "status"), in_order=True, counted="status")
RECOVER = Role("recover", ("request", "response"), LOADED, reports=True, patient=True, counted="recover")
UPGRADE = Role("upgrade", ("request", "response"))
USAGE = Role("usage", ("request", "response"), patient=True, counted="usage")
PROBE = Role("probe", ("request", "response"), patient=True, counted="health")
PAUSE = Role("pause", ("request", "response"), PAUSING, patient=True, counted="pause")
RESUME = Role("resume", ("request", "response"), RESUMING, patient=True, counted="resume")
ROLES = {role.name: role for role in (LOAD, UNLOAD, STATUS, RECOVER, UPGRADE, USAGE, PROBE, PAUSE, RESUME)}
