"""The types of providers' servers, as a consumer keeps them."""

from __future__ import annotations

import time
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import pytest

from rr_actors.base.errors import CatalogError
from rr_actors.base.names import ServerId
from rr_actors.registrar.engine.registrar_actor import ServerTypes
from rr_actors.registrar.model.rows import Put, ServerType


@pytest.mark.parametrize("closed", [False, True])
def test_types_that_a_full_disk_does_not_take_are_written_when_there_is_room(closed: bool) -> None:
    later: list[tuple[Callable[..., None], tuple[Any, ...]]] = []
    room = False
    registrar = SimpleNamespace(
        name="app",
        closed=False,
        catalog=SimpleNamespace(server_types={}),
        node=SimpleNamespace(
            dispatcher=SimpleNamespace(
                loop=SimpleNamespace(call_later=lambda _seconds, fn, *args: later.append((fn, args)))
            )
        ),
        client=lambda _provider: SimpleNamespace(describe=lambda _server, *, at_once: None),
    )

    def commit_rows(changes: list[Put]) -> None:
        if not room:
            raise CatalogError("disk full")
        for change in changes:
            registrar.catalog.server_types[change.row.id] = change.row

    registrar.commit_rows = commit_rows
    types = ServerTypes(registrar)
    told: list[float] = []
    types.tell(ServerId("provider", "thing"), lambda: told.append(time.monotonic()))

    types.described("provider/thing", b"types")
    assert (told, len(later)) == ([], 1)
    room, registrar.closed = True, closed
    fn, args = later.pop()
    fn(*args)

    assert len(told) == (0 if closed else 1)
    assert registrar.catalog.server_types == (
        {} if closed else {"provider/thing": ServerType("provider/thing", b"types")}
    )
    assert later == []
