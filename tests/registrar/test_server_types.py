"""The types of providers' servers, as a consumer keeps them."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any

import pytest

import rr_actors as rr
from rr_actors.base.errors import CatalogError
from rr_actors.base.names import ServerId
from rr_actors.registrar import queries
from rr_actors.registrar.engine.registrar_actor import ServerTypes
from rr_actors.registrar.model.rows import Put, ServerType
from support import LIMIT_S, eventually


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


@dataclass
class Feed:
    topic: str

    def __post_init__(self) -> None:
        if threading.current_thread().name == "reader":
            reading.set()
            assert read_on.wait(LIMIT_S)


reading, read_on = threading.Event(), threading.Event()


def _serve_feeds(provider: rr.Registrar) -> None:
    provider.register_server("camera", lambda topic: {"topic": topic}, request_type=str, response_type=Feed)


def test_a_response_that_was_read_before_its_type_was_known_has_that_type_later(
    app: rr.Registrar, provider: rr.Registrar, monkeypatch: pytest.MonkeyPatch
) -> None:
    _serve_feeds(provider)
    query = app.load("provider/camera", "front")
    types = app._actor.catalog.server_types  # pyright: ignore[reportPrivateUsage]
    known = eventually(lambda: dict(types))
    types.clear()  # as a crash may do
    asked: list[ServerId] = []
    monkeypatch.setattr(app._actor.types, "tell", lambda server, told: asked.append(server))  # pyright: ignore[reportPrivateUsage]
    monkeypatch.setattr(queries, "_TYPES_S", 0.05)

    assert [query.response for _ in range(3)] == [{"topic": "front"}] * 3
    assert asked == [("provider", "camera")]  # no read waits again

    types.update(known)
    assert query.response == Feed("front")
    assert query.response is query.response


def test_a_response_that_arrives_while_the_one_before_is_read_is_not_lost(
    app: rr.Registrar, provider: rr.Registrar
) -> None:
    _serve_feeds(provider)
    query = app.load("provider/camera", "front")
    reading.clear()
    read_on.clear()
    read: list[Feed] = []
    reader = threading.Thread(target=lambda: read.append(query.response), name="reader")
    reader.start()
    assert reading.wait(LIMIT_S)
    provider.update_response(query, {"topic": "rear"})
    query.wait_status("UPDATE", LIMIT_S)
    read_on.set()
    reader.join()
    assert read == [Feed("front")]
    assert query.response == Feed("rear")
