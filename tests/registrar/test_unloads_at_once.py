"""Unloads of one query by two at once, each in its own way: both are told how theirs ended."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from typing import Any

import pytest

import rr_actors as rr
from rr_actors.registrar.loads import Unloads
from support import Calls, Gate, break_exchanges, eventually, serve
from support_inside import actor_of


class Pause:
    """A place where one thread waits until the test lets it go on."""

    def __init__(self) -> None:
        self.there = threading.Event()
        self.go_on = threading.Event()

    def __call__(self) -> None:
        self.there.set()
        assert self.go_on.wait(10)


class Lock:
    """The lock of who decides; a thread that waits at `pause` goes on when the loop begins to wait for the lock."""

    def __init__(self, registrar: rr.Registrar, pause: Pause) -> None:
        self._lock = actor_of(registrar).lock
        self._dispatcher = actor_of(registrar).node.dispatcher
        self._pause = pause

    def __enter__(self) -> None:
        if self._dispatcher.is_loop_thread() and self._pause.there.is_set():
            self._pause.go_on.set()
        self._lock.__enter__()

    def __exit__(self, *exc: Any) -> None:
        self._lock.__exit__(*exc)


@pytest.fixture
def query(app: rr.Registrar, provider: rr.Registrar) -> rr.Query:
    """One that its registrar's loop knows of, and nothing waits to be written."""
    serve(provider, "thing")
    app.load("provider/thing", "keeps the link")
    app.load("provider/thing", "not the first of its kind")
    query = app.load("provider/thing", "x")
    app.save_catalog()
    assert query.id in actor_of(app).catalog.held
    eventually(lambda: actor_of(app).commits.saving is False)
    return query


@pytest.fixture
def writing(app: rr.Registrar, query: rr.Query, monkeypatch: pytest.MonkeyPatch) -> Pause:
    """Threads that are about to write that it is owed wait until the loop wants to decide something."""
    pause = Pause()
    ledger = actor_of(app).commits
    commit_row = ledger.commit_row

    def slowly(row: Any) -> bool:
        pause()
        return commit_row(row)

    monkeypatch.setattr(ledger, "commit_row", slowly)
    lock = Lock(app, pause)
    monkeypatch.setattr(actor_of(app), "lock", lock)
    return pause


@pytest.fixture
def answered(monkeypatch: pytest.MonkeyPatch) -> Pause:
    """Threads whose line has not brought that it is unloaded wait before they turn to the loop."""
    pause = Pause()
    go_on = Unloads.go_on

    def later(*args: Any) -> None:
        pause()
        go_on(*args)

    monkeypatch.setattr(Unloads, "go_on", later)
    return pause


def let_go(query: rr.Query, outcomes: Calls) -> None:
    try:
        query.unload()
        outcomes("unloaded")
    except rr.RrError as error:
        outcomes(type(error).__name__)


def letting_go(query: rr.Query) -> tuple[threading.Thread, Calls]:
    outcomes = Calls()
    thread = threading.Thread(target=let_go, args=(query, outcomes))
    thread.start()
    return thread, outcomes


def test_who_comes_while_a_thread_writes_that_it_is_owed_hears_that_it_is_gone(
    app: rr.Registrar, query: rr.Query, writing: Pause
) -> None:
    thread, outcomes = letting_go(query)
    assert writing.there.wait(10)
    with pytest.raises(rr.UnknownQuery, match=query.id):
        app.unload(query, block=False, timeout_s=None).get(timeout=10)
    thread.join()
    assert list(outcomes) == ["unloaded"]


def test_a_registrar_is_closed_while_a_thread_writes_that_a_query_is_owed(
    app: rr.Registrar, query: rr.Query, writing: Pause
) -> None:
    thread, outcomes = letting_go(query)
    assert writing.there.wait(10)
    began = time.monotonic()
    app.close(timeout_s=20)
    assert time.monotonic() - began < 10
    thread.join()
    assert set(outcomes) <= {"unloaded", "RegistrarDown"}


@pytest.mark.parametrize(("line", "outcome"), [("refused", "UnloadFailed"), ("broken", "unloaded")])
def test_who_tries_again_before_another_has_taken_in_the_refusal_is_told_as_well(
    app: rr.Registrar,
    provider: rr.Registrar,
    answered: Pause,
    gate: Gate,
    monkeypatch: pytest.MonkeyPatch,
    line: str,
    outcome: str,
) -> None:
    failures = [OSError("busy")]

    def unload(_request: Any, _response: Any) -> None:
        if failures:
            raise failures.pop()
        gate()

    serve(provider, "thing", unload=unload)
    app.load("provider/thing", "keeps the link")
    query = app.load("provider/thing", "x")
    assert len(app.queries()) == 2
    if line == "broken":
        break_exchanges(monkeypatch, ConnectionResetError("lost"), sends=True)
    thread, outcomes = letting_go(query)
    assert answered.there.wait(10)
    eventually(lambda: query.id in actor_of(app).catalog.kept)
    again = app.unload(query, block=False, timeout_s=None)
    gate.wait_arrived()
    alone = actor_of(app).unloads[query.id]
    answered.go_on.set()
    if line == "refused":
        outcomes.wait()
    else:
        eventually(lambda: actor_of(app).unloads[query.id] is not alone)
    gate.open()
    again.get(timeout=10)
    thread.join()
    assert list(outcomes) == [outcome]
    assert not actor_of(app).busy()


def noted(calls: Calls, fn: Callable[..., None]) -> Callable[..., None]:
    """The same function, which notes when it has been called."""

    def call(*args: Any) -> None:
        fn(*args)
        calls(args)

    return call


def test_what_a_thread_has_not_let_go_in_time_is_unknown_to_who_comes_later(
    app: rr.Registrar, provider: rr.Registrar, answered: Pause, monkeypatch: pytest.MonkeyPatch
) -> None:
    served = serve(provider, "thing")
    app.load("provider/thing", "keeps the link")
    query = app.load("provider/thing", "x")
    break_exchanges(monkeypatch, ConnectionResetError("lost"), sends=False)
    thread, outcomes = letting_go(query)
    assert answered.there.wait(10)

    dispatcher = actor_of(app).node.dispatcher
    turn = Pause()
    dispatcher.call(turn)
    assert turn.there.wait(10)
    wanted = Calls()
    for way in ("call", "hand_over"):
        monkeypatch.setattr(dispatcher, way, noted(wanted, getattr(dispatcher, way)))
    late = app.unload(query, block=False, timeout_s=None)
    answered.go_on.set()
    wanted.wait(2)  # what both want is done in one turn of the loop
    turn.go_on.set()
    with pytest.raises(rr.UnknownQuery, match=query.id):
        late.get(timeout=10)
    thread.join()
    assert list(outcomes) == ["unloaded"]
    assert [request for request, _ in served.unloads] == ["x"]


def test_a_thread_lets_nothing_go_between_the_look_at_what_is_under_way_and_the_reading_of_the_catalog(
    app: rr.Registrar, query: rr.Query, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What it had written would be read, and its note be about another catalog."""
    actor = actor_of(app)
    lets_go = threading.Event()
    found: list[Any] = []
    busy = actor.busy
    let_it_go = actor.owe

    def looked() -> bool:
        seen = busy()
        thread.start()
        assert lets_go.wait(10)
        thread.join(0.2)  # it waits
        found.extend(actor.unloads)
        return seen

    def noticed(query_id: str) -> bool:
        lets_go.set()
        return let_it_go(query_id)

    monkeypatch.setattr(actor, "busy", looked)
    monkeypatch.setattr(actor, "owe", noticed)
    outcomes = Calls()
    thread = threading.Thread(target=let_go, args=(query, outcomes))
    app.load_catalog()
    thread.join()
    assert found == []
    assert list(outcomes) == ["unloaded"]


def test_releases_that_come_together_are_decided_and_written_together(app: rr.Registrar, query: rr.Query) -> None:
    queries = [app.load("provider/thing", "x") for _ in range(40)]
    app.save_catalog()  # now each release is written
    pause = Pause()
    actor_of(app).node.dispatcher.call(pause)  # the loop
    assert pause.there.wait(10)
    before = actor_of(app).commit_counts()["commits"]

    replies = [app.unload(query, block=False) for query in queries]
    pause.go_on.set()

    for reply in replies:
        reply.get(timeout=10)
    assert actor_of(app).commit_counts()["commits"] - before <= 3  # the releases, and what is forgotten a moment later
