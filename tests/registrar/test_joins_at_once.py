"""Joins at once: what a direct line asks for, and somebody holds, the loop answers as it comes in."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

import rr_actors as rr
from rr_actors.base.errors import CatalogError
from rr_actors.base.values.canonical import encode
from rr_actors.registrar.engine.registrar_actor import RegistrarActor
from rr_actors.registrar.model.messages import Load, Loaded, LoadRefused, Message, Unload
from rr_actors.registrar.model.rows import ServedQuery
from rr_actors.storage.opening import read_rows
from rr_actors.wire.transport import Hello
from support import Served, catalog_path, eventually, serve
from support_inside import actor_of


class Line:
    """A direct line's end at the provider, which keeps what is sent."""

    def __init__(self, epoch: int) -> None:
        self.hello = Hello("direct", "provider", "app", epoch)
        self.sent: list[Message] = []
        self.flushed = 0
        self.closed = False

    def send(self, message: Message) -> None:
        self.sent.append(message)

    def flush(self) -> None:
        self.flushed = len(self.sent)

    def send_now(self, message: Message) -> None:
        self.send(message)
        self.flush()

    def open_outlet(self) -> None:
        """It has none: the loop answers."""

    def answering(self, message: Message) -> None:
        return

    def close(self) -> None:
        self.closed = True


class Lines:
    """Direct lines of "app" to a registrar of this process, by which its loop is asked several things in one turn."""

    def __init__(self, provider: RegistrarActor, epoch: int) -> None:
        self.provider = provider
        self.epoch = epoch

    def ask(self, *messages: Message) -> list[Line]:
        """Each by a line of its own; returns when the loop has read them all, and taken up none that it put aside."""
        lines = [Line(self.epoch) for _ in messages]

        async def read() -> None:
            for line, message in zip(lines, messages, strict=True):
                self.provider.consumers.received_directly(line, message)

        self.provider.node.dispatcher.run(read(), timeout_s=10.0)
        return lines


def load(id: str, request: str = "x") -> Load:
    return Load(id, "thing", encode(request), "app", "", 0, 1)


@pytest.fixture
def lines(app: rr.Registrar, provider: rr.Registrar, served: Served) -> Lines:
    return Lines(actor_of(provider), actor_of(app).epoch)


def on_disk(state_dir: Path) -> list[str]:
    return [row.id for row in read_rows(catalog_path(state_dir, "provider")) if isinstance(row, ServedQuery)]


def commits(provider: rr.Registrar, monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """How many changes each commit has from now on."""
    store = actor_of(provider).commits.store
    commit, sizes = store.commit, []

    def counted(changes: Any) -> None:
        sizes.append(len(changes))
        commit(changes)

    monkeypatch.setattr(store, "commit", counted)
    return sizes


def test_it_is_in_memory_and_on_disk_when_it_is_answered_and_the_inbox_has_seen_nothing(
    provider: rr.Registrar, lines: Lines, state_dir: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with monkeypatch.context() as patch:
        patch.setattr(actor_of(provider), "deliver", None)
        (line,) = lines.ask(load("new"))
    (resource,) = provider.resources()
    server = actor_of(provider).catalog.servers[resource.server]
    assert line.sent == [Loaded("new", resource.id, encode(resource.response), server.types_checksum)]
    assert line.flushed == 1
    assert "new" in on_disk(state_dir)
    assert [len(resource.queries) for resource in provider.resources()] == [2]


def test_it_is_one_holder_more(app: rr.Registrar, provider: rr.Registrar, served: Served, lines: Lines) -> None:
    lines.ask(load("new"))
    (first,) = app.queries()
    first.unload()
    assert list(served.unloads) == []
    (line,) = lines.ask(Unload("new", "app"))
    eventually(lambda: len(served.unloads) == 1)
    eventually(lambda: line.flushed == 1)


def test_asked_again_it_is_answered_again(lines: Lines, provider: rr.Registrar) -> None:
    (line,) = lines.ask(load("new"))
    (again,) = lines.ask(load("new"))
    eventually(lambda: again.flushed == 1)
    assert again.sent == line.sent
    assert [len(resource.queries) for resource in provider.resources()] == [2]


def test_what_came_before_it_is_decided_before_it(app: rr.Registrar, served: Served, lines: Lines) -> None:
    """The last holder's Unload is in the inbox: the load behind it runs the callback anew."""
    (held,) = app.queries()
    _, line = lines.ask(Unload(held.id, "app"), load("new"))
    eventually(lambda: line.flushed == 1)
    assert [type(message) for message in line.sent] == [Loaded]
    assert (len(served.loads), len(served.unloads)) == (2, 1)


def test_what_nobody_holds_is_loaded(served: Served, lines: Lines) -> None:
    (line,) = lines.ask(load("new", "y"))
    eventually(lambda: line.flushed == 1)
    assert [type(message) for message in line.sent] == [Loaded]
    assert [call[0] for call in served.loads] == ["x", "y"]


def test_a_dead_incarnations_line_joins_nothing(provider: rr.Registrar, lines: Lines) -> None:
    lines.epoch += 1
    (line,) = lines.ask(load("new"))
    assert (line.sent, line.closed) == ([], True)
    assert [len(resource.queries) for resource in provider.resources()] == [1]


def test_a_full_disk_refuses_it_and_leaves_nothing(
    provider: rr.Registrar, lines: Lines, state_dir: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    before = on_disk(state_dir)
    with monkeypatch.context() as patch:

        def full(_changes: Any) -> None:
            raise CatalogError("disk full")

        patch.setattr(actor_of(provider).commits.store, "commit", full)
        (line,) = lines.ask(load("new"))
        eventually(lambda: line.flushed == 1)
    (refused,) = line.sent
    assert isinstance(refused, LoadRefused)
    assert (refused.query_id, refused.failure.kind) == ("new", "CatalogError")
    assert on_disk(state_dir) == before
    assert [len(resource.queries) for resource in provider.resources()] == [1]


def test_a_defect_ends_the_registrar_so_that_nobody_waits_at_the_line_for_ever(
    system: rr.System, provider: rr.Registrar, lines: Lines, monkeypatch: pytest.MonkeyPatch
) -> None:
    with monkeypatch.context() as patch:

        def defect(_changes: Any) -> None:
            raise OverflowError("too large")

        patch.setattr(actor_of(provider).commits.store, "commit", defect)
        (line,) = lines.ask(load("new"))
        eventually(lambda: line.closed)
    assert line.sent == []
    assert actor_of(provider).closed
    serve(system.open_registrar("provider"), "thing")  # the system has to unload what is left


def test_it_gets_into_the_tables_when_it_is_quiet(provider: rr.Registrar, lines: Lines) -> None:
    provider.save_catalog()
    store = actor_of(provider).commits.store
    eventually(lambda: not store.wants_tidying())
    lines.ask(load("new"))
    assert store.wants_tidying()
    eventually(lambda: not store.wants_tidying())


@pytest.mark.parametrize(
    ("options", "written"),
    [({}, [1, 1]), ({"durability": "none"}, [1, 1]), ({"durability": "power"}, [2]), ({"save_on_modify": False}, [])],
    ids=["process", "none", "power", "saved later"],
)
def test_only_where_a_commit_waits_for_the_disk_do_several_share_it(
    system: rr.System, app: rr.Registrar, monkeypatch: pytest.MonkeyPatch, options: dict[str, Any], written: list[int]
) -> None:
    other = system.open_registrar("other", config=rr.RegistrarConfig(**options))
    serve(other, "thing")
    app.load("other/thing", "x")
    sizes = commits(other, monkeypatch)
    both = Lines(actor_of(other), actor_of(app).epoch).ask(load("one"), load("two"))
    eventually(lambda: [line.flushed for line in both] == [1, 1])
    assert sizes == written
    assert [len(resource.queries) for resource in other.resources()] == [3]
