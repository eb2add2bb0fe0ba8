"""Told: a thread that ran a callback writes how it has ended, and answers who waits; the loop hears of it later."""

from __future__ import annotations

import os
import signal
import threading
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import msgspec
import pytest

import rr_actors as rr
from rr_actors.actors import inbox
from rr_actors.actors.direct import LocalLine
from rr_actors.actors.ledger import Ledger
from rr_actors.actors.short_cuts import ShortCuts
from rr_actors.core import commands as c
from rr_actors.errors import CatalogError
from rr_actors.records import Change, Phase, Query, Resource
from rr_actors.stores.opening import read_rows
from support import Calls, Gate, Served, Workshop, catalog_path, eventually, loaded_with_parts, pid_of, serve

Start = Callable[..., rr.System]


class Order(msgspec.Struct):
    """A request that can be written in two ways."""

    name: str
    number: int = 3


@pytest.fixture
def shy(monkeypatch: pytest.MonkeyPatch) -> None:
    """The loop does not look at what is noted until something else wakes it."""
    monkeypatch.setattr(inbox, "_LOOK_SOON_S", 3600.0)


def behind(gate: Gate) -> Callable[[str], str]:
    """A load callback that stands at the gate when it is asked for "x"."""

    def load(request: str) -> str:
        if request == "x":
            gate()
        return request

    return load


@pytest.fixture
def distant(monkeypatch: pytest.MonkeyPatch) -> None:
    """Lines of this process are taken for those of another: what they ask for overtakes notes."""
    monkeypatch.setattr(LocalLine, "local", False)


@pytest.fixture
def told(monkeypatch: pytest.MonkeyPatch) -> Calls:
    """Whether the threads that ran callbacks told it themselves, one after another."""
    calls = Calls()
    tell: Callable[[ShortCuts, Any], bool] = ShortCuts.tell

    def noted(short_cuts: ShortCuts, done: Any) -> bool:
        outcome = tell(short_cuts, done)
        calls(outcome)
        return outcome

    monkeypatch.setattr(ShortCuts, "tell", noted)
    return calls


def on_disk(state_dir: Path, request: str) -> list[Phase]:
    """The phases of what the provider has loaded, or is loading, for this request; none if no query is on it."""
    rows = list(read_rows(catalog_path(state_dir, "provider")))
    queries = {row.resource_id for row in rows if isinstance(row, Query)}
    wanted = msgspec.msgpack.encode(request)
    return [row.phase for row in rows if isinstance(row, Resource) and row.request == wanted and row.id in queries]


def nothing_is_left_open(provider: rr.Registrar) -> bool:
    routes = provider._actor.consumers.routes
    return not routes.lines_wait and routes.open_by_link == 0


def in_thread(fn: Callable[[], object], outcome: Calls) -> threading.Thread:
    """Call it in a thread; `outcome` hears what it returned, or raised."""

    def run() -> None:
        try:
            outcome(fn())
        except rr.RrError as error:
            outcome(error)

    thread = threading.Thread(target=run)
    thread.start()
    return thread


# -- the loop is not needed ------------------------------------------------------------------------------------------


def test_a_first_load_and_the_last_unload_are_on_disk_and_answered_while_the_loop_does_something_else(
    app: rr.Registrar, provider: rr.Registrar, told: Calls, state_dir: Path
) -> None:
    dispatcher = provider._actor.node.dispatcher
    busy: list[Gate] = []

    def load(request: str) -> str:
        if request == "x":
            busy.append(Gate())
            dispatcher.call(busy[-1])
            busy[-1].wait_arrived()
        return request

    def unload(request: str, _response: str) -> None:
        load(request)

    serve(provider, "thing", load=load, unload=unload)
    app.load("provider/thing", "before")
    eventually(lambda: provider._actor.inbox.is_quiet)
    try:
        query = app.load("provider/thing", "x")
        assert told.wait(2)[1] is True
        assert on_disk(state_dir, "x") == [Phase.LOADED]
        busy[0].open()
        query.unload()
        assert told.wait(3)[2] is True
        assert on_disk(state_dir, "x") == []
    finally:
        for gate in busy:
            gate.open()
    assert [resource.request for resource in provider.resources()] == ["before"]
    assert nothing_is_left_open(provider)


def test_neither_asks_the_inbox_to_wake_the_loop(
    app: rr.Registrar,
    provider: rr.Registrar,
    served: Served,
    distant: None,
    shy: None,
    told: Calls,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    with monkeypatch.context() as patch:
        patch.setattr(provider._actor.inbox, "put", None)
        query = app.load("provider/thing", "y")
        (resource,) = (one for one in provider.resources() if one.request == "y")
        assert (resource.id, resource.queries) == (query.resource_id, (query.id,))
        query.unload()
    assert told.wait(2) == [True, True]
    assert served.unloads.items == [("y", query.response)]
    assert [resource.request for resource in provider.resources()] == ["x"]


def test_unloads_overtake_what_is_noted_and_is_not_about_the_same(
    app: rr.Registrar, provider: rr.Registrar, served: Served, distant: None, shy: None, told: Calls
) -> None:
    queries = [app.load("provider/thing", number) for number in range(5)]
    provider.resources()
    for query in queries:
        query.unload()
    assert told.wait(10) == [True] * 10
    assert len(provider._actor.inbox) == 5
    assert len(served.unloads) == 5


def test_who_asks_the_same_in_other_words_meanwhile_is_answered_too(
    app: rr.Registrar, provider: rr.Registrar, distant: None, shy: None, told: Calls
) -> None:
    loads = Calls()

    def load(request: Order) -> str:
        loads(request.name)
        return threading.current_thread().name

    provider.register_server("thing", load)
    app.load("provider/thing", Order("before"))
    eventually(lambda: provider._actor.inbox.is_quiet)

    first = app.load("provider/thing", {"name": "x", "number": 3})
    assert told.wait(2) == [False, True]
    outcome = Calls()
    thread = in_thread(lambda: app.load("provider/thing", {"name": "x"}, timeout_s=10.0), outcome)
    eventually(lambda: len(provider._actor.catalog.holders.get(first.resource_id, ())) == 2)
    provider.resources()  # which takes up what is noted
    thread.join()

    (query,) = outcome
    assert (query.resource_id, query.response) == (first.resource_id, first.response)
    assert loads.items == ["before", "x"]
    assert sorted(len(resource.queries) for resource in provider.resources()) == [1, 2]


# -- what goes by the loop -------------------------------------------------------------------------------------------


def test_while_somebody_watches_the_loop_tells_that_it_is_loaded_and_answers_after_that(
    system: rr.System, app: rr.Registrar, provider: rr.Registrar, served: Served, told: Calls
) -> None:
    events = Calls()
    leave = system.subscribe(events)
    query = app.load("provider/thing", "y")
    eventually(lambda: "loaded" in [event["event"] for event in events])
    query.unload()
    assert told.wait(2) == [False, False]
    leave()
    app.load("provider/thing", "y").unload()
    assert told.wait(4) == [False, False, True, True]


@pytest.mark.parametrize("options", [{"save_on_modify": False}, {"durability": "power"}])
def test_with_other_configs_the_loop_tells(
    system: rr.System, app: rr.Registrar, told: Calls, options: dict[str, Any]
) -> None:
    other = system.open_registrar("other", config=rr.RegistrarConfig(**options))
    served = serve(other, "thing")
    for request in ("x", "y"):
        app.load("other/thing", request).unload()
    assert told.wait(4) == [False] * 4
    assert len(served.unloads) == 2
    assert nothing_is_left_open(other)


def test_of_what_two_wait_for_the_loop_tells_both(
    app: rr.Registrar, provider: rr.Registrar, gate: Gate, told: Calls
) -> None:
    served = serve(provider, "thing", load=behind(gate))
    app.load("provider/thing", "before")
    outcome = Calls()
    threads = [in_thread(lambda: app.load("provider/thing", "x"), outcome) for _ in range(2)]
    eventually(lambda: len(provider._actor.catalog.waiting) == 2)
    gate.open()
    for thread in threads:
        thread.join()
    assert told.wait(2) == [False, False]
    first, second = outcome
    assert first.resource_id == second.resource_id
    assert len(served.loads) == 2
    assert nothing_is_left_open(provider)


def test_of_what_has_parts_the_loop_tells_that_it_is_loaded_and_gone(
    app: rr.Registrar, provider: rr.Registrar, parts: rr.Registrar, told: Calls
) -> None:
    serve(parts, "part")
    whole = serve(provider, "whole", load=loaded_with_parts(provider, ("parts/part", "p")))
    app.load("provider/whole", "x").unload()
    app.load("provider/whole", "x").unload()
    assert True not in told.items
    assert len(whole.unloads) == 2
    eventually(lambda: parts.resources() == [])


def test_of_a_closed_registrar_nothing_is_written_and_nobody_answered(
    app: rr.Registrar, provider: rr.Registrar, gate: Gate, told: Calls, monkeypatch: pytest.MonkeyPatch
) -> None:
    serve(provider, "thing", load=behind(gate))
    app.load("provider/thing", "before")
    outcome = Calls()
    thread = in_thread(lambda: app.load("provider/thing", "x", timeout_s=0.5), outcome)
    gate.wait_arrived()
    writes = Calls()
    monkeypatch.setattr(provider._actor._ledger._store, "commit", writes)
    provider._actor.node.dispatcher.call(provider._actor.close)
    eventually(lambda: provider._actor.closed)
    writes_before = len(writes)
    gate.open()
    assert told.wait(2)[1] is False
    thread.join()
    assert len(writes) == writes_before
    assert isinstance(outcome.items[0], rr.RrError)


# -- a write that fails ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("error", [CatalogError("disk full"), OSError("no such device"), ValueError("a defect")])
def test_what_the_thread_cannot_write_the_loop_does(
    app: rr.Registrar,
    provider: rr.Registrar,
    served: Served,
    told: Calls,
    state_dir: Path,
    monkeypatch: pytest.MonkeyPatch,
    error: Exception,
) -> None:
    store = provider._actor._ledger._store
    commit, failures = store.commit, Calls()

    def fails_in_threads(changes: Any) -> None:
        if threading.current_thread().name.startswith("rr-worker"):
            failures(error)
            raise error
        commit(changes)

    monkeypatch.setattr(store, "commit", fails_in_threads)
    query = app.load("provider/thing", "y")
    assert on_disk(state_dir, "y") == [Phase.LOADED]
    query.unload()
    assert on_disk(state_dir, "y") == []
    assert told.wait(2) == [False, False]
    assert len(failures) == 2
    assert nothing_is_left_open(provider)


def test_while_the_disk_is_full_who_waits_waits_and_is_answered_when_there_is_room(
    app: rr.Registrar, provider: rr.Registrar, gate: Gate, told: Calls, monkeypatch: pytest.MonkeyPatch
) -> None:
    served = serve(provider, "thing", load=behind(gate))
    app.load("provider/thing", "before")
    store = provider._actor._ledger._store
    outcome, failures = Calls(), Calls()
    thread = in_thread(lambda: app.load("provider/thing", "x"), outcome)
    gate.wait_arrived()

    def full(changes: Any) -> None:
        failures(changes)
        raise CatalogError("disk full")

    with monkeypatch.context() as patch:
        patch.setattr(store, "commit", full)
        gate.open()
        failures.wait(2)
        assert len(outcome) == 0
    thread.join()
    assert outcome.items[0].response == "x"
    assert told.wait(2) == [False, False]
    assert len(served.loads) == 2
    assert nothing_is_left_open(provider)


def test_a_first_load_that_cannot_be_written_is_refused_at_once(
    app: rr.Registrar, provider: rr.Registrar, served: Served, shy: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(_changes: Any) -> None:
        raise CatalogError("disk full")

    with monkeypatch.context() as patch:
        patch.setattr(provider._actor._ledger._store, "commit", full)
        with pytest.raises(CatalogError, match="disk full"):
            app.load("provider/thing", "y")
    assert nothing_is_left_open(provider)
    assert [resource.request for resource in provider.resources()] == ["x"]
    app.load("provider/thing", "y").unload()
    assert len(served.unloads) == 1


# -- a catalog that is loaded again, a process that dies, one that is forked -----------------------------------------


def test_a_catalog_that_is_read_again_has_what_was_told(
    app: rr.Registrar, provider: rr.Registrar, served: Served, shy: None, told: Calls
) -> None:
    query = app.load("provider/thing", "y")
    provider.load_catalog()
    assert told.wait(1) == [True]
    assert sorted(resource.request for resource in provider.resources()) == ["x", "y"]
    eventually(lambda: app.load("provider/thing", "y").resource_id == query.resource_id)
    assert len(served.loads) == 2
    app.unload_all()
    assert len(served.unloads) == 2


class Mortal(rr.Manager):
    """Dies as its thread has written, or is about to write, how a callback has ended: the first time for a request."""

    def __init__(self, root: str, at: str, when: str) -> None:
        self.work = Workshop(root)
        self.at, self.when = at, when

    @rr.server("thing")
    def thing(self, request: str) -> str:
        self.ends("load", request)
        return request

    @thing.unload
    def unload_thing(self, request: str, response: str) -> None:
        self.ends("unload", request)

    def ends(self, callback: str, request: str) -> None:
        self.work.note(callback, request)
        if request != "x" or callback != self.at or len(self.work.lines(f"{callback} x")) > 1:
            return
        commit_now = Ledger.commit_now
        when = self.when

        def die(self: Ledger, changes: Sequence[Change]) -> bool:
            if when == "after":
                commit_now(self, changes)
            os.kill(os.getpid(), signal.SIGKILL)
            return True

        Ledger.commit_now = die  # of this process, which is about to end


@pytest.mark.parametrize("at", ["load", "unload"])
@pytest.mark.parametrize(("when", "runs"), [("before", 2), ("after", 1)])
def test_a_process_that_dies_at_its_threads_write_has_done_it_or_does_it_again(
    start: Start, workshop: Workshop, at: str, when: str, runs: int
) -> None:
    system = start(rr.ChildSpec(Mortal, id="mortal", args=(str(workshop.root), at, when)))
    app = system.open_registrar("app")
    app.load("mortal/thing", "before")
    pid = pid_of(system, "mortal")
    query = app.load("mortal/thing", "x", timeout_s=20.0)
    assert query.response == "x"
    app.unload(query, timeout_s=20.0)
    assert workshop.lines(f"{at} x") == [f"{at} x"] * runs
    assert pid_of(system, "mortal") != pid
    assert [resource.request for resource in system.registrar("mortal").resources()] == ["before"]


@pytest.mark.filterwarnings("ignore:.*fork.*:DeprecationWarning")
def test_the_thread_that_forked_tells_nothing_in_the_child_and_waits_for_nobody(
    app: rr.Registrar, provider: rr.Registrar, gate: Gate
) -> None:
    """Whoever was deciding at the fork decides for ever there."""
    outcome, actor = Calls(), provider._actor

    serve(provider, "thing", load=behind(gate))
    app.load("provider/thing", "before")
    thread = in_thread(lambda: app.load("provider/thing", "x"), outcome)
    gate.wait_arrived()
    (id,) = actor.catalog.waiting.values()
    deciding, forked = threading.Event(), threading.Event()

    def decide() -> None:
        with actor.lock:
            deciding.set()
            assert forked.wait(20)

    holder = threading.Thread(target=decide)
    holder.start()
    assert deciding.wait(10)
    child = os.fork()
    if child == 0:
        signal.signal(signal.SIGALRM, signal.SIG_DFL)
        signal.alarm(10)  # it would wait for ever
        os._exit(actor.short_cuts.tell(c.LoadDone(id, 1, b"", told=True)))
    forked.set()
    holder.join()
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 0
    gate.open()
    thread.join()
    assert outcome.items[0].response == "x"


def test_who_begins_to_watch_hears_nothing_of_what_a_thread_told_before(
    system: rr.System, app: rr.Registrar, provider: rr.Registrar, shy: None, told: Calls
) -> None:
    """The note of it is taken up later."""
    serve(provider, "thing")
    eventually(lambda: provider._actor.inbox.is_quiet)
    app.load("provider/thing", "connects")
    app.load("provider/thing", "before")
    assert told.wait(2)[-1] is True
    heard = Calls()
    system.subscribe(heard)
    provider.resources()  # which takes up what is noted
    after = app.load("provider/thing", "after")
    eventually(lambda: any(event["resource_id"] == after.resource_id for event in heard if event["event"] == "loaded"))
    loaded = [event["resource_id"] for event in heard if event["event"] == "loaded"]
    assert loaded == [after.resource_id]
