"""Labelled: the alternatives that servers name themselves, by the `provides=` that they are registered with."""

from __future__ import annotations

import time

import msgspec

from rr_actors.managers.choices.alternatives import Alternative
from rr_actors.managers.templates import Parameter
from rr_actors.wire.name_service import Directory

_COARSE_NS = 50_000_000  # the clock of a directory's changes: two within one step have the same time

_Provided = dict[str, dict[str, Parameter]]


class Labelled:
    """The alternatives of all servers of the system with labels. With a lock of its user's.

    The directory of the system is read when something in it has changed. To ask whether it has is one system call.
    """

    def __init__(self, directory: Directory) -> None:
        self._directory = directory
        self._read_at = -1  # the time of the change that was read last; -1: read again
        self._found: tuple[Alternative, ...] = ()

    def has_changed(self) -> bool:
        """Return whether a server may have come or gone since alternatives() was called last."""
        return self._directory.changed_at() != self._read_at

    def alternatives(self) -> tuple[Alternative, ...]:
        """Return one for each kind that a server provides, by server id. Each field of its request has its default."""
        changed_at = self._directory.changed_at()
        if changed_at != self._read_at:
            self._found = tuple(
                Alternative(kind, server, provides=provides)
                for server, labels in self._directory.labels().items()
                for kind, provides in msgspec.json.decode(labels, type=_Provided).items()
            )
            self._read_at = changed_at if time.time_ns() - changed_at > _COARSE_NS else -1
        return self._found
