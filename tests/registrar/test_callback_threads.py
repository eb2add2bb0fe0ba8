"""The thread that ran a callback decides what follows from its end, and answers if one direct line waits for that."""

from __future__ import annotations

import os
import signal
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgspec
import pytest

import rr_actors as rr
from rr_actors.base.errors import CatalogError
from rr_actors.registrar.engine.commit_log import CommitLog
from rr_actors.registrar.engine.registrar_base import RegistrarBase
from rr_actors.registrar.links.consumer_links import Consumers
from rr_actors.registrar.model import commands as c
from rr_actors.registrar.model.catalog import Decision
from rr_actors.registrar.model.effects import AnswerCall
from rr_actors.registrar.model.messages import Message, Noticed
from rr_actors.registrar.model.rows import Phase, Resource, ServedQuery
from rr_actors.storage.opening import read_rows
from support import LIMIT_S, Calls, Gate, Served, Workshop, catalog_path, eventually, loaded_with_parts, pid_of, serve
from support_asks import in_threads
from support_inside import actor_of, on_loop

Start = Callable[..., rr.System]


class Order(msgspec.Struct):
    """A request that can be written in two ways."""

    name: str
    number: int = 3


def behind(gate: Gate) -> Callable[[str], str]:
    """A load callback that stands at the gate when it is asked for "x"."""

    def load(request: str) -> str:
        if request == "x":
            gate()
        return request

    return load


@pytest.fixture
def told(monkeypatch: pytest.MonkeyPatch) -> Calls:
    """Whether the threads that ran callbacks decided that themselves, one after another."""
    calls = Calls()
    decide_here: Callable[[RegistrarBase, Any], bool] = RegistrarBase.decide_here

    def noted(monitor: RegistrarBase, done: Any) -> bool:
        outcome = decide_here(monitor, done)
        calls(outcome)
        return outcome

    monkeypatch.setattr(RegistrarBase, "decide_here", noted)
    return calls


def on_disk(state_dir: Path, request: str) -> list[Phase]:
    """The phases of what the provider has loaded, or is loading, for this request; none if no query is on it."""
    rows = list(read_rows(catalog_path(state_dir, "provider")))
    queries = {row.resource_id for row in rows if isinstance(row, ServedQuery)}
    wanted = msgspec.msgpack.encode(request)
    return [row.phase for row in rows if isinstance(row, Resource) and row.request == wanted and row.id in queries]


def nothing_is_left_open(provider: rr.Registrar) -> bool:
    routes = actor_of(provider).consumers.routes
    return on_loop(provider, lambda: not routes.lines() and not routes.links())


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
    dispatcher = actor_of(provider).node.dispatcher
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


def test_who_asks_the_same_in_other_words_gets_the_same(app: rr.Registrar, provider: rr.Registrar) -> None:
    loads = Calls()

    def load(request: Order) -> str:
        loads(request.name)
        return threading.current_thread().name

    provider.register_server("thing", load)
    app.load("provider/thing", Order("before"))

    first = app.load("provider/thing", {"name": "x", "number": 3})
    outcome = Calls()
    thread = in_thread(lambda: app.load("provider/thing", {"name": "x"}, timeout_s=10.0), outcome)
    thread.join()

    (query,) = outcome
    assert (query.resource_id, query.response) == (first.resource_id, first.response)
    assert loads.items == ["before", "x"]
    assert sorted(len(resource.queries) for resource in provider.resources()) == [1, 2]


# -- what goes by the loop -------------------------------------------------------------------------------------------


def test_while_somebody_watches_they_hear_that_it_is_loaded(
    system: rr.System, app: rr.Registrar, provider: rr.Registrar, served: Served, told: Calls
) -> None:
    events = Calls()
    leave = system.subscribe(events)
    query = app.load("provider/thing", "y")
    eventually(lambda: "loaded" in [event["event"] for event in events])
    query.unload()
    leave()
    app.load("provider/thing", "y").unload()
    assert told.wait(4) == [True] * 4


@pytest.mark.parametrize("options", [{"save_on_modify": False}, {"durability": "power"}])
def test_where_many_share_a_commit_the_loop_decides(
    system: rr.System, app: rr.Registrar, told: Calls, options: dict[str, Any]
) -> None:
    other = system.open_registrar("other", config=rr.RegistrarConfig(**options))
    served = serve(other, "thing")
    for request in ("x", "y"):
        app.load("other/thing", request).unload()
    assert told.wait(4) == [False] * 4
    assert len(served.unloads) == 2
    assert nothing_is_left_open(other)


def test_two_who_wait_for_one_load_are_both_answered(
    app: rr.Registrar, provider: rr.Registrar, gate: Gate, told: Calls
) -> None:
    served = serve(provider, "thing", load=behind(gate))
    app.load("provider/thing", "before")
    outcome = Calls()
    threads = [in_thread(lambda: app.load("provider/thing", "x"), outcome) for _ in range(2)]
    eventually(lambda: len(actor_of(provider).catalog.waiting) == 2)
    gate.open()
    for thread in threads:
        thread.join()
    first, second = outcome
    assert first.resource_id == second.resource_id
    assert len(served.loads) == 2
    assert nothing_is_left_open(provider)


def test_what_has_parts_is_loaded_and_gone_with_them(
    app: rr.Registrar, provider: rr.Registrar, parts: rr.Registrar, told: Calls
) -> None:
    serve(parts, "part")
    whole = serve(provider, "whole", load=loaded_with_parts(provider, ("parts/part", "p")))
    app.load("provider/whole", "x").unload()
    app.load("provider/whole", "x").unload()
    assert len(whole.unloads) == 2
    eventually(lambda: parts.resources() == [])


def test_of_a_closed_registrar_nothing_is_written_and_nobody_answered(
    system: rr.System,
    app: rr.Registrar,
    provider: rr.Registrar,
    gate: Gate,
    told: Calls,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    serve(provider, "thing", load=behind(gate))
    app.load("provider/thing", "before")
    outcome = Calls()
    thread = in_thread(lambda: app.load("provider/thing", "x", timeout_s=0.5), outcome)
    gate.wait_arrived()
    writes = Calls()
    monkeypatch.setattr(actor_of(provider).commits.store, "commit", writes)
    actor_of(provider).node.dispatcher.call(actor_of(provider).close)
    eventually(lambda: actor_of(provider).closed)
    writes_before = len(writes)
    gate.open()
    assert told.wait(2)[1] is False
    thread.join()
    assert len(writes) == writes_before
    assert isinstance(outcome.items[0], rr.RrError)
    system.stop(timeout_s=0)  # nobody answers the release of what it served


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
    store = actor_of(provider).commits.store
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
    store = actor_of(provider).commits.store
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
    assert told.wait(2)[1] is False
    assert len(served.loads) == 2
    assert nothing_is_left_open(provider)


# -- a catalog that is loaded again, a process that dies, one that is forked -----------------------------------------


def test_a_catalog_that_is_read_again_has_what_a_thread_decided(
    app: rr.Registrar, provider: rr.Registrar, served: Served, told: Calls
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
        commit = CommitLog.commit
        when = self.when

        def die(self: CommitLog, decision: Decision) -> None:
            if when == "after":
                commit(self, decision)
            os.kill(os.getpid(), signal.SIGKILL)

        CommitLog.commit = die  # of this process, which is about to end


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
def test_the_thread_that_forked_decides_nothing_in_the_child_and_waits_for_nobody(
    app: rr.Registrar, provider: rr.Registrar, gate: Gate
) -> None:
    """Whoever was deciding at the fork decides for ever there."""
    outcome, actor = Calls(), actor_of(provider)

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
        os._exit(actor.decide_here(c.CallbackEnded("load", id, 1, response=b"")))
    forked.set()
    holder.join()
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 0
    gate.open()
    thread.join()
    assert outcome.items[0].response == "x"


def test_who_begins_to_watch_hears_nothing_of_what_a_thread_decided_before(
    system: rr.System, app: rr.Registrar, provider: rr.Registrar, told: Calls
) -> None:
    serve(provider, "thing")
    app.load("provider/thing", "connects")
    app.load("provider/thing", "before")
    assert told.wait(2)[-1] is True
    heard = Calls()
    system.subscribe(heard)
    after = app.load("provider/thing", "after")
    eventually(lambda: any(event["resource_id"] == after.resource_id for event in heard if event["event"] == "loaded"))
    loaded = [event["resource_id"] for event in heard if event["event"] == "loaded"]
    assert loaded == [after.resource_id]


# -- calls of the owner ------------------------------------------------------------------------------------------------


@pytest.fixture
def answered(monkeypatch: pytest.MonkeyPatch) -> Calls:
    """Whether the threads that called for the owner decided that themselves, one after another."""
    calls = Calls()
    answer_here = RegistrarBase.answer_here

    def noted(
        monitor: RegistrarBase, command: Callable[[object], c.Command], done: Callable[[], object]
    ) -> AnswerCall | None:
        answer = answer_here(monitor, command, done)
        calls(answer is not None)
        return answer

    monkeypatch.setattr(RegistrarBase, "answer_here", noted)
    return calls


def test_the_thread_that_sends_a_status_decides_it(
    app: rr.Registrar, provider: rr.Registrar, state_dir: Path, answered: Calls
) -> None:
    serve(provider, "thing")
    heard = Calls()
    query = app.load("provider/thing", "x", on_status=heard)

    def send(target: str, status: rr.Status) -> None:
        in_threads(lambda: provider.send_status(target, status))

    send(query.resource_id, rr.Status(rr.State.WARNING, "first"))
    (row,) = [row for row in read_rows(catalog_path(state_dir, "provider")) if isinstance(row, Resource)]
    assert row.message == "first"  # on disk, when the call returns
    heard.wait(1)
    eventually(lambda: not actor_of(provider).node.dispatcher.is_behind())
    send(query.resource_id, rr.Status(rr.State.WARNING, "second"))
    assert answered.items == [True, True]
    eventually(lambda: [status.message for status in heard.items] == ["first", "second"])
    eventually(lambda: not actor_of(provider).node.dispatcher.is_behind())
    with pytest.raises(rr.UnknownQuery):
        send("nothing", rr.Status(rr.State.WARNING, "third"))
    assert answered.items == [True, True, True]


def test_a_status_is_on_its_way_to_the_holders_when_the_call_returns(
    app: rr.Registrar, provider: rr.Registrar, answered: Calls, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Else what its sender says next, to an actor for instance, would overtake it."""
    provider.register_server("thing", lambda request: request)  # a status callback of its own would come first
    query = app.load("provider/thing", "x")
    sent = Calls()
    send = Consumers.send

    def send_slowly(consumers: Consumers, origin: str, message: Message) -> None:
        time.sleep(0.1)
        send(consumers, origin, message)
        sent(type(message))

    monkeypatch.setattr(Consumers, "send", send_slowly)
    eventually(lambda: not actor_of(provider).node.dispatcher.is_behind())
    in_threads(lambda: provider.send_status(query, rr.Status(rr.State.WARNING, "hot")))
    assert answered.items == [True]
    assert Noticed in sent.items


def test_the_main_thread_leaves_a_status_to_the_loop(
    app: rr.Registrar, provider: rr.Registrar, answered: Calls
) -> None:
    """A Ctrl-C between the commit and what follows from it would leave the holders without the status."""
    serve(provider, "thing")
    query = app.load("provider/thing", "x")
    eventually(lambda: not actor_of(provider).node.dispatcher.is_behind())
    provider.send_status(query, rr.Status(rr.State.WARNING, "hot"))
    assert query.wait_status(timeout_s=LIMIT_S).message == "hot"
    assert True not in answered.items


def test_a_status_is_decided_behind_what_the_loop_has_still_to_do(
    app: rr.Registrar, provider: rr.Registrar, answered: Calls, monkeypatch: pytest.MonkeyPatch
) -> None:
    serve(provider, "thing")
    query = app.load("provider/thing", "x")
    gate, posted, dispatcher = Gate(), Calls(), actor_of(provider).node.dispatcher
    dispatcher.call(gate)
    gate.wait_arrived()
    call = dispatcher.call

    def noted(fn: Callable[..., object], *args: Any) -> None:
        call(fn, *args)
        posted(fn)

    monkeypatch.setattr(dispatcher, "call", noted)
    sending = threading.Thread(target=provider.send_status, args=(query, rr.Status(rr.State.WARNING, "late")))
    sending.start()
    posted.wait(1)
    gate.open()
    sending.join(LIMIT_S)
    assert not sending.is_alive()
    assert answered.items == []
    assert provider.resources()[0].message == "late"
