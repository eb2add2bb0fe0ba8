"""Direct unloads: of queries of which nothing is on disk yet, and of those that are."""

from __future__ import annotations

import contextlib
import functools
import os
import signal
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

import rr_actors as rr
from rr_actors.base.errors import CatalogError
from rr_actors.base.values.failure import Failure
from rr_actors.registrar.engine.commit_log import CommitLog
from rr_actors.registrar.links.consumer_links import Routes
from rr_actors.registrar.links.local_line import LocalLine
from rr_actors.registrar.links.provider_link import THREADS
from rr_actors.registrar.model import commands as c
from rr_actors.registrar.model.messages import Load, Loaded, LoadRefused, Noticed, Unload, Unloaded, UnloadRefused
from rr_actors.registrar.model.rows import Held, Hold, Notice, State
from rr_actors.runtime.time_limits import deadline_of, left_until
from rr_actors.storage.opening import read_rows
from rr_actors.wire.thread_connections import BlockingLink, ThreadConnections
from rr_actors.wire.transport import Hello
from support import (
    Calls,
    Gate,
    Workshop,
    break_exchanges,
    catalog_path,
    connect_threads,
    eventually,
    hang,
    kill,
    pid_of,
    serve,
    wait_respawned,
)
from support_inside import actor_of
from support_managers import Order, Shop

# -- brief holds of real registrars ----------------------------------------------------------------------------------


@pytest.fixture
def brief(monkeypatch: pytest.MonkeyPatch) -> None:
    """What may be written a moment later is written with something else, or when the test says so."""
    monkeypatch.setattr(CommitLog, "save_soon", lambda _ledger: None)


@pytest.fixture
def shop(start: Callable[..., rr.System], workshop: Workshop, brief: None) -> rr.System:
    """A system with a provider in another process."""
    return start(rr.ChildSpec(Shop, id="shop", args=(str(workshop.root),)))


@pytest.fixture
def buyer(shop: rr.System) -> rr.Registrar:
    """A consumer whose threads have connections to it."""
    app = shop.open_registrar("app")
    connect_threads(app, "shop/thing", Order("first"))
    return app


def held_on_disk(state_dir: Path) -> list[Held]:
    return [row for row in read_rows(catalog_path(state_dir, "app")) if isinstance(row, Held)]


def is_new(registrar: rr.Registrar, query: rr.Query) -> bool:
    """Whether nothing of it is on disk."""
    return query.id in actor_of(registrar).commits.unsaved.new


def held_directly(registrar: rr.Registrar, name: str) -> rr.Query:
    query = registrar.load("shop/thing", Order(name))
    assert is_new(registrar, query)
    return query


def held_and_saved(registrar: rr.Registrar, name: str) -> rr.Query:
    query = held_directly(registrar, name)
    registrar.save_catalog()
    assert not is_new(registrar, query)
    return query


Holding = Callable[[rr.Registrar, str], rr.Query]


@pytest.fixture(params=[held_directly, held_and_saved], ids=["new", "saved"])
def hold(request: pytest.FixtureRequest) -> Holding:
    """Whether what is held is on disk."""
    return request.param


def test_what_is_held_briefly_is_loaded_and_unloaded_and_never_on_disk(
    shop: rr.System, buyer: rr.Registrar, workshop: Workshop, state_dir: Path
) -> None:
    buyer.save_catalog()
    before = held_on_disk(state_dir)
    for number in range(20):
        with held_directly(buyer, f"n{number}") as query:
            assert query.response.name == f"n{number}"
    assert len(workshop.lines("unload")) == 20
    assert [query.request.name for query in buyer.queries()] == ["first"]
    assert [resource.request.name for resource in shop.registrar("shop").resources()] == ["first"]
    assert buyer.stats()["unloading"] == 0
    buyer.save_catalog()
    assert held_on_disk(state_dir) == before


def test_the_first_call_over_a_link_goes_by_the_link_and_the_second_opens_a_connection(shop: rr.System) -> None:
    app = shop.open_registrar("app")
    app.load("shop/thing", Order("first"))
    query = app.load("shop/thing", Order("second"))
    connections = actor_of(app).clients["shop"].connections
    assert connections.idle == []
    query.unload()
    assert len(connections.idle) == 1


class Brief(rr.Manager):
    """Holds something, and releases something else while the provider hangs, whose pid is the message."""

    def on_receive(self, message: Any) -> Any:
        if message == "queries":
            return [query.request.name for query in self.registrar.queries()]
        threading.Thread(target=self.hold_briefly, args=(message,), daemon=True).start()
        return None

    def hold_briefly(self, provider: int) -> None:
        connect_threads(self.registrar, "shop/thing", Order("first"))
        query = self.registrar.load("shop/thing", Order("wheel"))
        hang(provider)
        with contextlib.suppress(rr.RegistrarDown):
            query.unload()


@pytest.mark.parametrize("end", ["kill", "stop"])
def test_a_release_of_a_brief_hold_that_its_provider_has_not_read_is_owed_on_disk_a_moment_later(
    start: Callable[..., rr.System], workshop: Workshop, state_dir: Path, end: str
) -> None:
    system = start(rr.ChildSpec(Shop, id="shop", args=(str(workshop.root),)), rr.ChildSpec(Brief, id="brief"))
    system.ref("brief").tell(pid_of(system, "shop"))
    path = catalog_path(state_dir, "brief")

    def is_owed() -> bool:
        held = [row for row in read_rows(path) if isinstance(row, Held) and b"wheel" in row.request]
        return [row.hold for row in held] == [Hold.OWED]

    eventually(is_owed)
    if end == "kill":
        wait_respawned(system, "brief", kill(system, "brief"))
    else:
        system.supervisor().terminate_child("brief")
        system.supervisor().restart_child("brief")
    kill(system, "shop")
    workshop.wait("unload wheel")
    eventually(lambda: [resource.request.name for resource in system.registrar("shop").resources()] == ["first"])
    assert system.ref("brief").ask("queries") == ["first"]


def test_while_others_hold_it_a_brief_hold_ends_without_a_callback(buyer: rr.Registrar, workshop: Workshop) -> None:
    held_directly(buyer, "first").unload()
    assert workshop.lines("unload") == []


def test_unloading_twice_is_a_clear_error(buyer: rr.Registrar, hold: Holding) -> None:
    query = hold(buyer, "wheel")
    query.unload()
    for again in (query.unload, lambda: buyer.unload(query.id)):
        with pytest.raises(rr.UnknownQuery, match=query.id):
            again()


def let_go(query: rr.Query, barrier: threading.Barrier, outcomes: Calls) -> None:
    barrier.wait()
    try:
        query.unload()
        outcomes("unloaded")
    except rr.UnknownQuery as error:
        outcomes(type(error).__name__)


def test_of_two_threads_that_let_go_of_one_hold_one_is_told_that_it_is_gone(
    buyer: rr.Registrar, hold: Holding, workshop: Workshop
) -> None:
    for number in range(20):
        query = hold(buyer, f"n{number}")
        outcomes = Calls()
        barrier = threading.Barrier(2)
        threads = [threading.Thread(target=let_go, args=(query, barrier, outcomes)) for _ in range(2)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        assert sorted(outcomes) == ["UnknownQuery", "unloaded"]
    assert len(workshop.lines("unload")) == 20


def test_a_failing_unload_callback_leaves_it_held_and_it_can_be_unloaded_again(
    app: rr.Registrar, provider: rr.Registrar, brief: None
) -> None:
    failures = ["busy", "still busy"]

    def unload(_request: Any, _response: Any) -> None:
        if failures:
            raise OSError(failures.pop(0))

    served = serve(provider, "thing", unload=unload)
    app.load("provider/thing", "keeps the link")
    query = app.load("provider/thing", "x")
    assert is_new(app, query)
    with pytest.raises(rr.UnloadFailed, match="busy") as caught:
        query.unload()
    assert [frame.origin for frame in caught.value.trace] == ["provider/thing"]
    assert query.id in [held.id for held in app.queries()]
    with pytest.raises(rr.UnloadFailed, match="still busy"):
        query.unload()
    query.unload()
    assert [request for request, _ in served.unloads] == ["x", "x", "x"]
    assert query.id not in [held.id for held in app.queries()]


def test_closing_a_registrar_lets_go_of_brief_holds_first(
    app: rr.Registrar, provider: rr.Registrar, brief: None
) -> None:
    served = serve(provider, "thing")
    app.load("provider/thing", "x")
    app.load("provider/thing", "y")
    app.close()
    assert sorted(request for request, _ in served.unloads) == ["x", "y"]


# -- what goes wrong meanwhile ---------------------------------------------------------------------------------------


def test_a_provider_killed_while_it_unloads_a_brief_hold_does_it_when_it_is_back(
    shop: rr.System, buyer: rr.Registrar, hold: Holding, workshop: Workshop
) -> None:
    query = hold(buyer, "wheel")
    workshop.shut("unload wheel")
    thread = threading.Thread(target=query.unload)
    thread.start()
    workshop.wait("unload wheel")
    old = kill(shop, "shop")
    workshop.open("unload wheel")
    thread.join()
    wait_respawned(shop, "shop", old)
    assert workshop.lines("unload")[-1] == "unload wheel"
    assert [query.request.name for query in buyer.queries()] == ["first"]
    assert buyer.owed() == []
    assert [resource.request.name for resource in shop.registrar("shop").resources()] == ["first"]


def test_a_provider_that_hangs_is_waited_for_in_time_and_the_release_stays_owed(
    shop: rr.System, buyer: rr.Registrar, hold: Holding, workshop: Workshop, state_dir: Path
) -> None:
    query = hold(buyer, "wheel")
    pid = query.response.pid
    hang(pid)
    try:
        with pytest.raises(rr.Unavailable, match=r"'shop' did not answer within 0\.2 s; the release is owed"):
            query.unload(timeout_s=0.2)
        assert buyer.owed() == [query.id]
        assert [row.id for row in held_on_disk(state_dir) if row.hold is Hold.OWED] == [query.id]
    finally:
        os.kill(pid, signal.SIGCONT)
    eventually(lambda: buyer.owed() == [])
    assert workshop.lines("unload") == ["unload wheel"]


class Giving:
    """A line that, while it is being closed, sees another thread give back one."""

    def __init__(self, connections: ThreadConnections[Any], epoch: int, others: list[Giving]) -> None:
        self.connections, self.epoch, self.others, self.closed = connections, epoch, others, False

    def exchange(self, message: Any, deadline: float) -> Any:
        raise AssertionError("not used")

    def close(self) -> None:
        self.closed = True
        for other in self.others:
            self.connections.give_back(other)

    def cut(self) -> None:
        """It is not waited for."""


def test_lines_that_threads_give_back_while_their_registrar_closes_are_closed_with_the_others(
    app: rr.Registrar, provider: rr.Registrar, monkeypatch: pytest.MonkeyPatch
) -> None:
    serve(provider, "thing")
    app.load("provider/thing", "x").unload()
    client = actor_of(app).clients["provider"]
    link, connections = client.link, client.connections
    assert link is not None
    assert connections is not None
    late, last = (Giving(connections, link.welcome.epoch, []) for _ in range(2))
    first = Giving(connections, link.welcome.epoch, [late])
    dialled = iter((first, late, last))
    monkeypatch.setattr(actor_of(provider), "line", lambda _hello: next(dialled))
    taken = [connections.take(None) for _ in range(len(connections.idle) + 3)]
    assert taken[-3:] == [first, late, last]
    connections.give_back(first)
    app.close()
    connections.give_back(last)
    assert late.closed
    assert last.closed


@pytest.fixture
def break_lines(monkeypatch: pytest.MonkeyPatch) -> Callable[..., None]:
    """Connections of threads are lost when they are to send an Unload, or, with `sends`, when it has been answered."""
    return functools.partial(break_exchanges, monkeypatch)


@pytest.mark.parametrize("sends", [False, True], ids=["question lost", "answer lost"])
def test_a_line_that_breaks_hands_over_to_the_link(
    buyer: rr.Registrar, hold: Holding, workshop: Workshop, break_lines: Callable[..., None], sends: bool
) -> None:
    query = hold(buyer, "wheel")
    break_lines(ConnectionResetError("lost"), sends=sends)
    query.unload()
    assert workshop.lines("unload") == ["unload wheel"]
    assert query.id not in [held.id for held in buyer.queries()]
    assert buyer.owed() == []
    assert not actor_of(buyer).busy()


@pytest.mark.parametrize("sends", [False, True], ids=["question lost", "answer lost"])
def test_who_is_interrupted_has_let_it_go_all_the_same(
    buyer: rr.Registrar, hold: Holding, workshop: Workshop, break_lines: Callable[..., None], sends: bool
) -> None:
    query = hold(buyer, "wheel")
    break_lines(KeyboardInterrupt(), sends=sends)
    with pytest.raises(KeyboardInterrupt):
        query.unload()
    eventually(lambda: workshop.lines("unload") == ["unload wheel"])
    eventually(lambda: buyer.stats()["owed"] == 0)
    assert query.id not in [held.id for held in buyer.queries()]


@pytest.fixture
def interrupt_answered(monkeypatch: pytest.MonkeyPatch) -> Callable[[], None]:
    """Threads are interrupted when a line of theirs has been answered."""

    def interrupted(*_: Any) -> None:
        raise KeyboardInterrupt

    return lambda: monkeypatch.setattr(ThreadConnections, "give_back", interrupted)


def test_who_is_interrupted_when_the_unload_was_answered_leaves_nothing_under_way(
    buyer: rr.Registrar, hold: Holding, workshop: Workshop, interrupt_answered: Callable[[], None]
) -> None:
    query = hold(buyer, "wheel")
    interrupt_answered()
    with pytest.raises(KeyboardInterrupt):
        query.unload()
    assert query.id not in [held.id for held in buyer.queries()]
    eventually(lambda: not actor_of(buyer).busy())
    assert workshop.lines("unload") == ["unload wheel"]


def test_who_is_interrupted_when_the_load_was_answered_holds_nothing(
    buyer: rr.Registrar, workshop: Workshop, interrupt_answered: Callable[[], None]
) -> None:
    interrupt_answered()
    with pytest.raises(KeyboardInterrupt):
        buyer.load("shop/thing", Order("wheel"))
    eventually(lambda: workshop.lines("unload") == ["unload wheel"])
    eventually(lambda: not actor_of(buyer).busy())
    assert [held.request.name for held in buyer.queries()] == ["first"]


@pytest.mark.parametrize("sends", [False, True], ids=["question lost", "answer lost"])
def test_a_full_disk_when_the_line_breaks_delays_the_release(
    buyer: rr.Registrar,
    workshop: Workshop,
    break_lines: Callable[..., None],
    monkeypatch: pytest.MonkeyPatch,
    sends: bool,
) -> None:
    query = held_directly(buyer, "wheel")
    break_lines(ConnectionResetError("lost"), sends=sends)
    store = actor_of(buyer).commits.store
    refusals = [CatalogError("disk full"), CatalogError("disk full")]
    commit = store.commit

    def commit_if_there_is_room(changes: Any) -> None:
        if refusals:
            raise refusals.pop()
        commit(changes)

    monkeypatch.setattr(store, "commit", commit_if_there_is_room)
    query.unload()
    assert not refusals
    assert workshop.lines("unload") == ["unload wheel"]
    assert buyer.owed() == []


def test_a_status_that_comes_while_it_is_let_go_finds_it_known(
    system: rr.System, app: rr.Registrar, provider: rr.Registrar, brief: None, gate: Gate
) -> None:
    """The unload callback fails, and who holds it again hears how it is."""

    def unload(_request: Any, _response: Any) -> None:
        gate()
        raise OSError("stuck")

    serve(provider, "thing", unload=unload)
    app.load("provider/thing", "keeps the link")
    query = app.load("provider/thing", "x")
    errors: list[BaseException] = []

    def let_go() -> None:
        try:
            query.unload()
        except rr.UnloadFailed as error:
            errors.append(error)

    thread = threading.Thread(target=let_go)
    thread.start()
    gate.wait_arrived()
    assert app.stats()["unloading"] == 1
    provider.send_status(query.resource_id, rr.Status(rr.State.WARNING, "hot"))
    gate.open()
    thread.join()
    assert len(errors) == 1
    assert query.wait_status(timeout_s=10).message == "hot"
    assert query.id in [held.id for held in app.queries()]


def test_lines_of_both_kinds_say_nothing_that_is_not_answered() -> None:
    """An Unload on a line is answered there: a withdrawal must not go by one."""
    for kind in (LocalLine, BlockingLink):
        assert not hasattr(kind, "say")


# -- lines within one process ----------------------------------------------------------------------------------------


def test_many_threads_that_load_at_once_take_few_file_descriptors(app: rr.Registrar, provider: rr.Registrar) -> None:
    serve(provider, "thing")
    app.load("provider/thing", "x")
    before = len(os.listdir("/proc/self/fd"))
    barrier = threading.Barrier(40)
    outcomes = Calls()

    def hold_briefly() -> None:
        barrier.wait()
        with app.load("provider/thing", "x"):
            outcomes("held")

    threads = [threading.Thread(target=hold_briefly) for _ in range(40)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(outcomes) == 40
    assert len(os.listdir("/proc/self/fd")) <= before + 8  # some for workers


def test_many_registrars_of_one_process_take_few_file_descriptors_for_their_lines(
    system: rr.System, app: rr.Registrar, provider: rr.Registrar
) -> None:
    serve(provider, "thing")
    others = [system.open_registrar(f"other{number}") for number in range(20)]
    for other in others:
        other.load("provider/thing", "keeps the link")
    before = len(os.listdir("/proc/self/fd"))
    for other in others:
        other.load("provider/thing", "x")
    assert len(os.listdir("/proc/self/fd")) <= before + 8  # some for workers


def test_lines_that_are_closed_give_their_file_descriptors_back(
    system: rr.System, app: rr.Registrar, provider: rr.Registrar
) -> None:
    serve(provider, "thing")
    app.load("provider/thing", "x")
    before = len(os.listdir("/proc/self/fd"))
    for number in range(30):
        other = system.open_registrar(f"other{number}")
        for _ in range(3):
            other.load("provider/thing", "x")
        other.close()
    eventually(lambda: len(os.listdir("/proc/self/fd")) <= before + 8)


def test_a_line_whose_registrar_answers_and_closes_is_lost_after_the_answer(
    app: rr.Registrar, provider: rr.Registrar
) -> None:
    line = LocalLine(actor_of(app).node, actor_of(provider), Hello(THREADS, "provider", "app", 1))
    line.send(Unloaded("q"))
    line.close()
    line.close()
    assert line.exchange(Unload("q", "app"), deadline_of(10)) == Unloaded("q")
    line.send(Unloaded("late"))


def test_opening_a_connection_and_the_exchange_have_one_time_limit(
    buyer: rr.Registrar, monkeypatch: pytest.MonkeyPatch
) -> None:
    take, exchange, limits = ThreadConnections.take, BlockingLink.exchange, Calls()

    def take_slowly(connections: Any, limit_s: float | None) -> Any:
        time.sleep(0.2)
        return take(connections, limit_s)

    def note(line: BlockingLink, message: Any, deadline: float) -> Any:
        limits(left_until(deadline))
        return exchange(line, message, deadline)

    monkeypatch.setattr(ThreadConnections, "take", take_slowly)
    monkeypatch.setattr(BlockingLink, "exchange", note)
    query = buyer.load("shop/thing", Order("second"), timeout_s=10)
    query.unload(timeout_s=10)
    assert len(limits) == 2
    assert max(limits) <= 9.8


# -- what is in the catalog ------------------------------------------------------------------------------------------


class Watched:
    """A server whose unload callback says what it finds on its consumer's disk, about the query in `id`."""

    def __init__(self, provider: rr.Registrar, state_dir: Path) -> None:
        self.id = ""
        self.found: list[Hold | None] = []
        self.failures: list[BaseException] = []
        self._state_dir = state_dir
        serve(provider, "thing", unload=self._unload)

    def _unload(self, _request: Any, _response: Any) -> None:
        self.found.append(self.on_disk())
        if self.failures:
            raise self.failures.pop()

    def on_disk(self) -> Hold | None:
        return next((row.hold for row in held_on_disk(self._state_dir) if row.id == self.id), None)


@pytest.fixture
def watched(app: rr.Registrar, provider: rr.Registrar, brief: None, state_dir: Path) -> Watched:
    """With a consumer that has a link, and looks at what is noted when something else wakes it."""
    watched = Watched(provider, state_dir)
    app.load("provider/thing", "keeps the link")
    return watched


def taken_up(app: rr.Registrar, watched: Watched, *, saved: bool) -> rr.Query:
    query = app.load("provider/thing", "x")
    watched.id = query.id
    assert len(app.queries()) == 2
    if saved:
        app.save_catalog()
        assert watched.on_disk() is Hold.HELD
    return query


def test_that_it_is_owed_is_on_disk_before_its_provider_hears_of_it(app: rr.Registrar, watched: Watched) -> None:
    query = taken_up(app, watched, saved=True)
    query.unload()
    assert watched.found == [Hold.OWED]
    app.save_catalog()
    assert watched.on_disk() is None
    assert not actor_of(app).busy()


def test_what_was_never_written_need_not_be_owed_on_disk(app: rr.Registrar, watched: Watched) -> None:
    query = taken_up(app, watched, saved=False)
    query.unload()
    assert watched.found == [None]
    app.save_catalog()
    assert watched.on_disk() is None
    assert not actor_of(app).busy()


def test_an_update_that_waits_to_be_written_is_not_the_first_that_is_written_of_it(
    app: rr.Registrar, provider: rr.Registrar, watched: Watched
) -> None:
    query = taken_up(app, watched, saved=True)
    provider.send_status(query.resource_id, rr.Status(rr.State.WARNING, "hot"))
    query.wait_status(timeout_s=10)
    query.unload()
    assert watched.found == [Hold.OWED]
    app.save_catalog()
    assert watched.on_disk() is None


def test_the_loop_is_not_woken_for_it(app: rr.Registrar, watched: Watched, monkeypatch: pytest.MonkeyPatch) -> None:
    query = taken_up(app, watched, saved=True)
    with monkeypatch.context() as patch:
        patch.setattr(type(actor_of(app)), "release", None)
        query.unload()
    assert watched.found == [Hold.OWED]


def test_while_something_waits_to_be_decided_the_loop_lets_it_go(app: rr.Registrar, watched: Watched) -> None:
    """It may be about the query."""
    query = taken_up(app, watched, saved=True)
    actor_of(app).waiting.append((c.LinkLost("nobody"), None))
    assert not actor_of(app).owe(query.id)
    query.unload()
    assert watched.found == [Hold.OWED]
    assert not actor_of(app).waiting


def test_a_failing_unload_callback_leaves_it_held_and_on_disk(app: rr.Registrar, watched: Watched) -> None:
    query = taken_up(app, watched, saved=True)
    watched.failures.append(OSError("busy"))
    with pytest.raises(rr.UnloadFailed, match="busy"):
        query.unload()
    assert query.id in [held.id for held in app.queries()]
    assert watched.on_disk() is Hold.HELD
    query.unload()
    assert watched.found == [Hold.OWED, Hold.OWED]
    assert query.id not in [held.id for held in app.queries()]


def test_who_is_interrupted_while_it_is_written_has_let_it_go_or_holds_it(
    app: rr.Registrar, watched: Watched, monkeypatch: pytest.MonkeyPatch
) -> None:
    query = taken_up(app, watched, saved=True)
    ledger = actor_of(app).commits
    written = ledger.commit_row

    def interrupted(row: Any) -> bool:
        written(row)
        raise KeyboardInterrupt

    monkeypatch.setattr(ledger, "commit_row", interrupted)
    with pytest.raises(KeyboardInterrupt):
        query.unload()
    eventually(lambda: watched.found == [Hold.OWED])
    eventually(lambda: not actor_of(app).busy())
    assert query.id not in [held.id for held in app.queries()]


def test_of_two_futures_of_one_unload_one_is_told_that_it_is_gone(
    app: rr.Registrar, provider: rr.Registrar, gate: Gate
) -> None:
    serve(provider, "thing", unload=lambda _request, _response: gate())
    query = app.load("provider/thing", "x")
    first = app.unload(query, block=False)
    gate.wait_arrived()
    second = app.unload(query, block=False)
    with pytest.raises(rr.UnknownQuery, match=query.id):
        second.get(timeout=10)
    gate.open()
    first.get(timeout=10)


def test_unload_all_beside_threads_that_let_go_for_themselves_never_fails(
    app: rr.Registrar, provider: rr.Registrar
) -> None:
    served = serve(provider, "thing")
    for turn in range(15):
        queries = [app.load("provider/thing", f"{turn}.{number}") for number in range(12)]
        outcomes = Calls()
        barrier = threading.Barrier(4)
        threads = [threading.Thread(target=let_go_of, args=(queries[part::3], barrier, outcomes)) for part in range(3)]
        for thread in threads:
            thread.start()
        barrier.wait()
        app.unload_all()
        for thread in threads:
            thread.join()
        assert set(outcomes) <= {"unloaded", "UnknownQuery"}
        assert app.queries() == []
    assert len(served.unloads) == 15 * 12


def let_go_of(queries: list[rr.Query], barrier: threading.Barrier, outcomes: Calls) -> None:
    barrier.wait()
    for query in queries:
        try:
            query.unload()
            outcomes("unloaded")
        except rr.UnknownQuery as error:
            outcomes(type(error).__name__)


def test_a_consumer_killed_while_its_provider_unloads_owes_it_no_more_when_both_are_back(
    start: Callable[..., rr.System], workshop: Workshop
) -> None:
    """It was on disk as owed: it is neither held again nor said to be lost."""
    system = start(
        rr.ChildSpec(Shop, id="shop", args=(str(workshop.root),)),
        rr.ChildSpec(Shop, id="trader", args=(str(workshop.root),)),
    )
    trader = system.registrar("trader")
    held = trader.load("shop/thing", Order("wheel"))
    assert [query.id for query in trader.queries()] == [held.id]
    workshop.shut("unload wheel")
    future = trader.unload(held.id, block=False)
    workshop.wait("unload wheel")
    old = kill(system, "trader")
    workshop.open("unload wheel")
    with pytest.raises(rr.RrError):
        future.get(timeout=20)
    wait_respawned(system, "trader", old)
    eventually(lambda: system.registrar("trader").owed() == [])
    assert system.registrar("trader").queries() == []
    assert workshop.lines("unload") == ["unload wheel"]
    assert system.registrar("shop").resources() == []


# -- by which way a provider answers ---------------------------------------------------------------------------------


NOTICE = Notice("e:q", "q", "app", "r", "e", State.OK, "", "provider/thing")


def test_each_answer_goes_by_the_line_that_its_question_came_by_once() -> None:
    routes = Routes()
    routes.asked_by_line("line", Load("q", "thing", b"", "app", "", 0, 1))
    assert routes.way_of(Noticed(NOTICE, False)) == (None, True)
    assert routes.way_of(Loaded("other", "r", b"")) == (None, True)
    assert routes.way_of(Loaded("q", "r", b"")) == ("line", False)
    assert routes.way_of(Loaded("q", "r", b"")) == (None, True)


def test_the_answer_to_a_load_that_comes_late_is_not_that_to_an_unload() -> None:
    routes = Routes()
    routes.asked_by_line("line", Unload("q", "app"))
    routes.asked_by_link("app", Load("q", "thing", b"", "app", "", 0, 1))
    assert routes.way_of(LoadRefused("q", Failure("LoadError", "no"))) == (None, True)
    assert routes.way_of(Unloaded("q")) == ("line", False)


def test_what_the_link_has_asked_too_is_answered_by_both() -> None:
    routes = Routes()
    routes.asked_by_line("line", Unload("q", "app"))
    routes.asked_by_link("app", Unload("q", "app"))
    assert routes.way_of(Unloaded("q")) == ("line", True)
    assert routes.way_of(Unloaded("q")) == (None, True)


def test_what_comes_by_a_line_after_the_link_has_asked_is_answered_by_both() -> None:
    """The thread may have left the line, and the provider not read that yet."""
    routes = Routes()
    routes.asked_by_link("app", Unload("q", "app"))
    routes.asked_by_line("line", Unload("q", "app"))
    assert routes.way_of(Unloaded("q")) == ("line", True)


def test_an_unload_by_a_line_that_the_link_has_asked_for_and_that_was_refused_is_answered_by_both() -> None:
    """The first answer has the query held again, so the second must not go to a line alone that its thread has left."""
    routes = Routes()
    routes.asked_by_link("app", Unload("q", "app"))
    assert routes.way_of(UnloadRefused("q", Failure("UnloadFailed", "busy"))) == (None, True)
    routes.asked_by_line("line", Unload("q", "app"), released={"q"})
    assert routes.way_of(Unloaded("q")) == ("line", True)


def test_what_a_link_has_asked_is_asked_no_more_when_it_is_answered_withdrawn_or_lost() -> None:
    routes = Routes()
    for query_id in ("answered", "withdrawn", "lost"):
        routes.asked_by_link("app", Load(query_id, "thing", b"", "app", "", 0, 1))
    routes.asked_by_link("app", Unload("withdrawn", "app"))
    routes.asked_by_link("other", Unload("others", "other"))
    assert len(routes.links()) == 5
    assert routes.way_of(Loaded("answered", "r", b"")) == (None, True)
    assert routes.way_of(Unloaded("withdrawn")) == (None, True)
    assert len(routes.links()) == 2
    routes.link_lost("app")
    assert len(routes.links()) == 1


def test_a_refused_unload_goes_by_the_link_as_well() -> None:
    routes = Routes()
    routes.asked_by_line("line", Unload("q", "app"))
    assert routes.way_of(UnloadRefused("q", Failure("UnloadFailed", "busy"))) == ("line", True)


def test_what_a_lost_line_waits_for_is_answered_by_the_link() -> None:
    routes = Routes()
    routes.asked_by_line("line", Unload("q", "app"))
    routes.asked_by_line("other", Unload("o", "app"))
    routes.line_lost("line")
    assert routes.way_of(Unloaded("q")) == (None, True)
    assert routes.clear() == ["other"]
    assert routes.way_of(Unloaded("o")) == (None, True)


def test_a_question_may_be_answered_while_its_line_or_link_is_lost() -> None:
    """A worker answers, and the loop notes the loss."""
    routes = Routes()

    class Answering(str):
        """A line, or a consumer; the worker answers while it is looked for."""

        __slots__ = ()
        __hash__ = str.__hash__

        def __eq__(self, other: object) -> bool:
            routes.answered(Unloaded("q"))
            return super().__eq__(other)

    routes.asked_by_link(Answering("app"), Load("q", "thing", b"", "app", "", 0, 1))
    routes.asked_by_line(Answering("line"), Unload("q", "app"))
    routes.line_lost("line")
    assert routes.lines() == []
    routes.asked_by_link(Answering("app"), Load("q", "thing", b"", "app", "", 0, 1))
    routes.link_lost("app")
    assert len(routes.links()) == 0
