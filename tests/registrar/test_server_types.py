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
from rr_actors.registrar.links.provider_link import ServerTypes
from rr_actors.registrar.model.rows import Put, ServerType
from support import LIMIT_S, Calls, eventually
from support_inside import actor_of


class _Disk:
    """A registrar whose disk may be full, and the calls that its loop makes later."""

    def __init__(self) -> None:
        self.later: list[tuple[Callable[..., None], tuple[Any, ...]]] = []
        self.room = False
        self.rows: dict[str, ServerType] = {}
        loop = SimpleNamespace(call_later=lambda _seconds, fn, *args: self.later.append((fn, args)))
        self.registrar: Any = SimpleNamespace(
            name="app",
            closed=False,
            catalog=SimpleNamespace(server_types=self.rows),
            node=SimpleNamespace(dispatcher=SimpleNamespace(loop=loop)),
            commit_rows=self._commit_rows,
        )
        clients: Any = {"provider": SimpleNamespace(deliver=lambda _wish: None)}
        self.types = ServerTypes(self.registrar, clients)

    def _commit_rows(self, changes: list[Put]) -> None:
        if not self.room:
            raise CatalogError("disk full")
        for change in changes:
            assert isinstance(change.row, ServerType)
            self.rows[change.row.id] = change.row

    def call_later(self) -> None:
        later, self.later = self.later, []
        for fn, args in later:
            fn(*args)


@pytest.mark.parametrize("closed", [False, True])
def test_types_that_a_full_disk_does_not_take_are_written_when_there_is_room(closed: bool) -> None:
    disk = _Disk()
    told: list[float] = []
    disk.types.tell(ServerId("provider", "thing"), lambda: told.append(time.monotonic()))

    disk.types.described("provider/thing", b"types")
    assert (told, len(disk.later)) == ([], 1)
    disk.room, disk.registrar.closed = True, closed
    disk.call_later()

    assert len(told) == (0 if closed else 1)
    assert disk.rows == ({} if closed else {"provider/thing": ServerType("provider/thing", b"types")})
    assert disk.later == []


def test_types_that_are_written_later_do_not_replace_newer_ones() -> None:
    disk = _Disk()
    disk.types.described("provider/thing", b"old")
    disk.room = True
    disk.types.described("provider/thing", b"new")
    disk.call_later()
    assert disk.rows == {"provider/thing": ServerType("provider/thing", b"new")}


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
    types = actor_of(app).catalog.server_types
    known = eventually(lambda: dict(types))
    types.clear()  # as a crash may do
    asked: list[ServerId] = []
    monkeypatch.setattr(actor_of(app).types, "tell", lambda server, told: asked.append(server))
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


@dataclass
class Track:
    topic: str


def test_a_thread_that_knows_no_types_does_not_read_its_response_with_older_ones(
    app: rr.Registrar, provider: rr.Registrar, monkeypatch: pytest.MonkeyPatch
) -> None:
    provider.register_server("linked", lambda _: None)
    app.load("provider/linked", "")
    actor = actor_of(app)
    client, on_way = actor.clients["provider"], Calls()
    receive = client.received
    monkeypatch.setattr(client, "received", on_way)  # what the link brings from now on is on its way
    for response_type in (Feed, Track):
        provider.register_server("camera", lambda _: {"topic": "front"}, request_type=str, response_type=response_type)
        if response_type is Feed:
            provider.unregister_server("camera")
    on_way.wait(2)
    read: list[object] = []
    reader = threading.Thread(target=lambda: read.append(app.load("provider/camera", "front").response))
    reader.start()
    eventually(lambda: "camera" in client.undescribed)

    def arrive() -> None:
        monkeypatch.undo()
        for link, message in on_way.items[1:]:
            receive(link, message)

    actor.node.dispatcher.call(receive, *on_way.items[0])
    reader.join(0.2)
    assert read == []
    actor.node.dispatcher.call(arrive)
    reader.join(LIMIT_S)
    assert read == [Track("front")]
