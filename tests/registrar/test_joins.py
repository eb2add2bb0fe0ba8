"""Joins: a thread that loads what a registrar of its own process has, and somebody holds, joins it itself.

Leaving: a thread that releases what others hold, too, decides that itself.
"""

from __future__ import annotations

import contextlib
import os
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import rr_actors as rr
from rr_actors.base.errors import CatalogError
from rr_actors.base.values.failure import Failure
from rr_actors.registrar.core import unloading
from rr_actors.registrar.core.decide import decide
from rr_actors.registrar.core.loads import loading
from rr_actors.registrar.engine import registrar_state
from rr_actors.registrar.model import commands as c
from rr_actors.registrar.model.catalog import Catalog, Decision, Server
from rr_actors.registrar.model.effects import SendReply
from rr_actors.registrar.model.messages import Fetch, Load, Loaded, Unload, Unloaded
from rr_actors.registrar.model.rows import Drop, Phase, Put, ServedQuery
from rr_actors.runtime.event_loop import Dispatcher
from rr_actors.storage.opening import read_rows
from support import Calls, Gate, Served, catalog_path, eventually, serve, wait_respawned
from support_inside import actor_of

# -- what may be joined ----------------------------------------------------------------------------------------------


def ask(id: str = "new", parent: str = "") -> Load:
    return Load(id, "cam", b"front", "app", parent, 0, 7)


def catalog(*servers: Server) -> Catalog:
    """Query "q" of app on resource "q", loaded."""
    catalog = Catalog("p")
    for server in servers or (Server("cam"),):
        decide(catalog, [(c.Register(server, "event"), None)])
    decide(catalog, [(ask("q"), "app")])
    decide(catalog, [(c.CallbackEnded("load", "q", 1, response=b"feed"), None)])
    return catalog


def everything(catalog: Catalog) -> dict[str, Any]:
    """All that a catalog knows; without numbers, and what is undone."""
    return {name: value for name, value in vars(catalog).items() if name not in ("_index", "unfinished", "servers")}


STEPS = st.lists(
    st.one_of(
        st.builds(
            Load,
            st.sampled_from("abcd"),
            st.sampled_from(("cam", "mic")),
            st.sampled_from((b"front", b"back")),
            st.sampled_from(("app", "bpp")),
            st.sampled_from(("", "parent")),
            st.just(0),
            st.just(1),
        ),
        st.builds(Unload, st.sampled_from("abcd"), st.sampled_from(("app", "bpp"))),
        st.builds(c.CallbackEnded, st.just("load"), st.sampled_from("abcd"), st.just(1), response=st.just(b"feed")),
        st.builds(c.CallbackEnded, st.just("unload"), st.sampled_from("abcd"), st.sampled_from((1, 2))),
        st.builds(
            c.SetStatus, st.sampled_from("abcd"), st.just("e"), st.sampled_from(rr.State), st.just(""), st.just("t")
        ),
        st.builds(c.Unregister, st.sampled_from(("cam", "mic")), st.just("event"), st.just("t")),
    ),
    max_size=30,
)


@given(STEPS, st.booleans())
@settings(max_examples=400, deadline=None)
def test_the_fast_path_gives_the_catalog_and_the_answer_of_decide(steps: list[Any], lingers: bool) -> None:
    servers = (Server("cam", linger_s=60.0 if lingers else 0.0), Server("mic"))
    fast, general = Catalog("p"), Catalog("p")
    for one in (fast, general):
        for server in servers:
            decide(one, [(c.Register(server, "event"), None)])
    for step in steps:
        if not isinstance(step, (Load, Unload)):
            decide(general, [(step, None)])
            decide(fast, [(step, None)])
            continue
        leaves = isinstance(step, Unload) and unloading.leave(general, step)
        decision = decide(general, [(step, step.origin)])
        if leaves:  # the thread answers, and the row is all that changes
            assert decision.effects == [SendReply(step.origin, Unloaded(step.query_id))]
            assert (decision.changes, decision.later) == ([Drop("queries", step.query_id)], {})
        query = loading.join(fast, step) if isinstance(step, Load) else None
        if query is None:
            decide(fast, [(step, step.origin)])
        else:
            fast.set("queries", query.id, query)
            resource = fast.resources[query.resource_id]
            fast.joined[resource.server] = fast.joined.get(resource.server, 0) + 1  # as RegistrarState counts
            answer = Loaded(query.id, resource.id, resource.response or b"", state=resource.state)
            assert decision.effects == [SendReply(step.origin, answer)]
            assert (decision.changes, decision.later) == ([Put(query)], {})
        assert everything(fast) == everything(general)


def loading_still(provider: Catalog) -> None:
    decide(provider, [(Load("other", "cam", b"back", "app", "", 0, 1), "app")])


def let_go(provider: Catalog) -> None:
    decide(provider, [(Unload("q", "app"), "app")])


def fatal(provider: Catalog) -> None:
    decide(provider, [(c.SetStatus("q", "e", rr.State.FATAL, "", "ticket"), None)])


def leaving(provider: Catalog) -> None:
    decide(provider, [(c.Unregister("cam", "event", "ticket"), None)])


def not_to_be_unloaded(provider: Catalog) -> None:
    let_go(provider)
    decide(provider, [(c.CallbackEnded("unload", "q", 1, Failure("UnloadFailed", "busy")), None)])


@pytest.mark.parametrize("meanwhile", [let_go, fatal, leaving, not_to_be_unloaded])
def test_what_is_not_simply_there_is_not_joined(meanwhile: Callable[[Catalog], None]) -> None:
    provider = catalog()
    meanwhile(provider)
    assert loading.join(provider, ask()) is None


@pytest.mark.parametrize(
    "message",
    [ask("q"), Load("new", "cam", b"back", "app", "", 0, 1), Load("new", "other", b"front", "app", "", 0, 1)],
    ids=["asked again", "another request", "another server"],
)
def test_what_is_to_be_decided_as_any_load_is_not_joined(message: Load) -> None:
    assert loading.join(catalog(), message) is None


def test_what_is_loading_is_not_joined() -> None:
    provider = catalog()
    loading_still(provider)
    assert provider.resources["other"].phase is Phase.LOADING
    assert loading.join(provider, Load("new", "cam", b"back", "app", "", 0, 1)) is None


def test_what_lingers_with_no_holder_is_not_joined() -> None:
    provider = catalog(Server("cam", linger_s=60.0))
    let_go(provider)
    assert provider.resources["q"].phase is Phase.LOADED
    assert loading.join(provider, ask()) is None


def test_what_was_refused_before_is_not_joined() -> None:
    provider = catalog()
    decide(provider, [(Unload("new", "app"), "app")])  # withdrawn before it came
    assert loading.join(provider, ask()) is None


@pytest.mark.parametrize(
    "meanwhile", [let_go, not_to_be_unloaded, lambda provider: None], ids=["gone", "not unloaded", "the last"]
)
def test_what_nobody_else_holds_is_not_left(meanwhile: Callable[[Catalog], None]) -> None:
    provider = catalog()
    meanwhile(provider)
    assert not unloading.leave(provider, Unload("q", "app"))


def test_what_another_holds_is_left_by_its_holder_alone() -> None:
    provider = catalog()
    decide(provider, [(ask("more"), "app")])
    assert unloading.leave(provider, Unload("more", "app"))
    assert not unloading.leave(provider, Unload("more", "bpp"))
    assert not unloading.leave(provider, Unload("never", "app"))


def test_what_has_a_status_on_its_way_or_a_priority_is_not_left() -> None:
    provider = catalog()
    decide(provider, [(ask("more"), "app")])
    decide(provider, [(Load("first", "cam", b"front", "app", "", 0, 9, 5), "app")])
    assert not unloading.leave(provider, Unload("more", "app"))
    decide(provider, [(Unload("first", "app"), "app")])
    assert unloading.leave(provider, Unload("more", "app"))
    decide(provider, [(Fetch("app", True), "app")])
    decide(provider, [(c.SetStatus("q", "e", rr.State.WARNING, "", "ticket"), None)])
    assert not unloading.leave(provider, Unload("more", "app"))


# -- of real registrars ----------------------------------------------------------------------------------------------


def on_disk(state_dir: Path) -> list[str]:
    return [row.id for row in read_rows(catalog_path(state_dir, "provider")) if isinstance(row, ServedQuery)]


def test_it_is_on_disk_when_the_load_returns_and_no_loop_was_woken(
    app: rr.Registrar, served: Served, state_dir: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    app.stats()
    with monkeypatch.context() as patch:
        patch.setattr(Dispatcher, "hand_over", None)
        query = app.load("provider/thing", "x")
    assert query.id in on_disk(state_dir)
    assert query.response == {"of": "x", "number": 1}
    assert len(served.loads) == 1
    assert query.id in [held.id for held in app.queries()]


def test_a_holder_less_is_on_disk_when_the_unload_returns_and_no_loop_was_woken(
    app: rr.Registrar, provider: rr.Registrar, served: Served, state_dir: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    query = app.load("provider/thing", "x")
    app.stats()
    with monkeypatch.context() as patch:
        patch.setattr(Dispatcher, "hand_over", None)
        query.unload()
    assert query.id not in on_disk(state_dir)
    assert query.id not in [held.id for held in app.queries()]
    assert [resource.holders for resource in provider.resources()] == [("app",)]
    assert list(served.unloads) == []
    with pytest.raises(rr.RrError):
        query.unload()


def test_a_release_waits_behind_what_the_loop_has_to_do(
    app: rr.Registrar, provider: rr.Registrar, served: Served, gate: Gate
) -> None:
    query = app.load("provider/thing", "x")
    dispatcher = actor_of(app).node.dispatcher
    dispatcher.call(gate)
    gate.wait_arrived()
    unloading = threading.Thread(target=query.unload)
    unloading.start()
    unloading.join(0.2)
    assert unloading.is_alive()
    gate.open()
    unloading.join(10)
    assert [resource.holders for resource in provider.resources()] == [("app",)]


def test_a_release_that_cannot_be_written_is_not_done_and_is_owed(
    app: rr.Registrar, provider: rr.Registrar, served: Served, monkeypatch: pytest.MonkeyPatch
) -> None:
    query = app.load("provider/thing", "x")
    store = actor_of(provider).commits.store

    def full(_changes: Any) -> None:
        raise CatalogError("disk full", path="provider.db")

    with monkeypatch.context() as patch:
        patch.setattr(store, "commit", full)
        with contextlib.suppress(rr.RrError):
            query.unload(timeout_s=0.3)
        assert [len(resource.queries) for resource in provider.resources()] == [2]
    eventually(lambda: [len(resource.queries) for resource in provider.resources()] == [1])
    assert list(served.unloads) == []


def test_it_is_one_holder_more_whatever_comes_in_next(
    app: rr.Registrar, provider: rr.Registrar, served: Served
) -> None:
    (first,) = app.queries()
    second = app.load("provider/thing", "x")
    first.unload()
    assert list(served.unloads) == []
    provider.send_status(second.resource_id, rr.Status(rr.State.WARNING, "hot"))
    assert second.wait_status(timeout_s=10).message == "hot"
    assert [resource.holders for resource in provider.resources()] == [("app",)]
    second.unload()
    assert len(served.unloads) == 1


def test_it_gets_into_the_tables_when_it_is_quiet(app: rr.Registrar, provider: rr.Registrar, served: Served) -> None:
    provider.save_catalog()
    app.load("provider/thing", "x")
    store = actor_of(provider).commits.store
    assert store.wants_tidying()
    eventually(lambda: not store.wants_tidying())


def test_no_thread_sees_what_was_decided_and_could_not_be_written(
    app: rr.Registrar, provider: rr.Registrar, served: Served, monkeypatch: pytest.MonkeyPatch
) -> None:
    actor = actor_of(provider)
    seen: list[bool] = []
    undo = Decision.undo

    def look() -> None:
        seen.append(actor.lock.acquire(blocking=False))
        if seen[-1]:
            actor.lock.release()

    def undone(decision: Decision) -> None:
        looking = threading.Thread(target=look)
        looking.start()
        looking.join()
        undo(decision)

    def full(_changes: Any) -> None:
        raise CatalogError("disk full")

    with monkeypatch.context() as patch:
        patch.setattr(Decision, "undo", undone)
        patch.setattr(actor.commits.store, "commit", full)
        with pytest.raises(CatalogError, match="disk full"):
            app.load("provider/thing", "y")
    assert seen == [False]
    assert [resource.request for resource in provider.resources()] == ["x"]


@pytest.mark.parametrize("written", [True, False])
def test_who_is_interrupted_meanwhile_holds_nothing(
    app: rr.Registrar,
    provider: rr.Registrar,
    served: Served,
    state_dir: Path,
    monkeypatch: pytest.MonkeyPatch,
    written: bool,
) -> None:
    ledger = actor_of(provider).commits
    commit_row = ledger.commit_row

    def interrupted(row: Any) -> bool:
        if written:
            commit_row(row)
        raise KeyboardInterrupt

    before = on_disk(state_dir)
    with monkeypatch.context() as patch:
        patch.setattr(ledger, "commit_row", interrupted)
        with pytest.raises(KeyboardInterrupt):
            app.load("provider/thing", "x")
    eventually(lambda: not actor_of(app).busy())
    eventually(lambda: on_disk(state_dir) == before)
    assert len(app.queries()) == 1
    assert [len(resource.queries) for resource in provider.resources()] == [1]


def test_what_waits_to_be_taken_up_is_decided_before(app: rr.Registrar, provider: rr.Registrar, gate: Gate) -> None:
    """The last holder's Unload has come in: the load that comes after it runs the callback anew."""
    served = serve(provider, "thing")
    query = app.load("provider/thing", "x")
    dispatcher = actor_of(provider).node.dispatcher
    arrived = threading.Event()

    def occupy() -> None:
        actor_of(provider).receive(Unload(query.id, "app"), "app")
        arrived.set()
        gate()

    dispatcher.call(occupy)
    assert arrived.wait(10)
    loaded = Calls()
    thread = threading.Thread(target=lambda: loaded(app.load("provider/thing", "x")))
    thread.start()
    gate.open()
    thread.join()
    assert len(served.loads) == 2
    assert len(served.unloads) == 1
    assert len(loaded) == 1


def test_threads_that_only_load_leave_nothing_to_be_decided(
    app: rr.Registrar, provider: rr.Registrar, served: Served
) -> None:
    for _ in range(5000):
        app.load("provider/thing", "x")
        assert not actor_of(provider).waiting
        assert not actor_of(app).waiting
    assert len(app.queries()) == 5001
    app.unload_all()
    assert len(served.unloads) == 1


def test_threads_that_load_and_let_go_at_once_leave_nothing(
    app: rr.Registrar, provider: rr.Registrar, served: Served, state_dir: Path
) -> None:
    barrier = threading.Barrier(6)

    def trade(number: int) -> None:
        barrier.wait()
        kept: list[rr.Query] = []
        for turn in range(100):
            kept.append(app.load("provider/thing", "x"))
            if (turn + number) % 3:
                kept.pop(0).unload()
        for query in kept:
            query.unload()

    threads = [threading.Thread(target=trade, args=(number,)) for number in range(6)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert (len(served.loads), len(served.unloads)) == (1, 0)
    (left,) = app.queries()
    assert [resource.queries for resource in provider.resources()] == [(left.id,)]
    provider.save_catalog()
    assert on_disk(state_dir) == [left.id]


def test_it_is_held_when_the_process_was_killed_and_is_back(start: Callable[..., rr.System], state_dir: Path) -> None:
    """A manager that loads from itself, and is killed before its loop has looked at anything."""
    system = start(rr.ChildSpec(SelfTrader, id="trader"))
    app = system.open_registrar("app")
    keeper = app.load("trader/thing", "x")
    pid = app.load("trader/both", 2).response
    assert pid != os.getpid()
    os.kill(pid, 9)
    wait_respawned(system, "trader", pid)
    trader = system.registrar("trader")
    eventually(lambda: len(trader.queries()) == 2)
    (resource,) = (found for found in trader.resources() if found.request == "x")
    assert sorted(resource.holders) == ["app", "trader", "trader"]
    assert keeper.id in resource.queries


@pytest.mark.parametrize("handled", [False, True], ids=["no handler", "a handler that may wait for the loop"])
def test_a_load_that_is_refused_leaves_nothing_whether_its_thread_or_the_loop_ends_it(
    app: rr.Registrar, provider: rr.Registrar, monkeypatch: pytest.MonkeyPatch, handled: bool
) -> None:
    def fail(_request: Any) -> None:
        raise OSError("busy")

    serve(provider, "thing", load=fail)
    serve(provider, "other")
    app.load("provider/other", 0)  # the next goes by a connection of this thread's own
    monkeypatch.setattr(registrar_state, "may_be_interrupted", lambda: handled)
    ended: list[str] = []
    post = actor_of(app).post
    monkeypatch.setattr(
        actor_of(app), "post", lambda command, **more: (ended.append(type(command).__name__), post(command, **more))
    )
    with pytest.raises(rr.LoadFailed, match="busy"):
        app.load("provider/thing", "x")
    assert ended.count("GiveUp") == handled
    eventually(lambda: app.owed() == [])
    stats = app.stats()
    assert (stats["loading"], stats["queries"]) == (0, 1)
    assert actor_of(app).loads == {}


def test_what_is_held_is_listed_and_let_go_in_the_order_of_its_loads_whichever_way_they_went(
    app: rr.Registrar, provider: rr.Registrar
) -> None:
    serve(provider, "thing")
    for number in range(3):
        app.load("provider/thing", number, block=False).get(timeout=10)
    for number in range(3, 6):
        app.load("provider/thing", number)
    app.load("provider/thing", 6, block=False).get(timeout=10)
    held = app.queries()
    assert [query.request for query in held] == list(range(7))
    assert actor_of(app).newest_first() == [query.id for query in reversed(held)]


@pytest.mark.filterwarnings("ignore:.*fork.*:DeprecationWarning")
@pytest.mark.parametrize("provider", ["trader", "other"], ids=["its own", "another's"])
def test_a_forked_child_of_a_manager_takes_no_short_cuts(start: Callable[..., rr.System], provider: str) -> None:
    """It would write to its parent's journal, and to its parent's lines."""
    system = start(rr.ChildSpec(SelfTrader, id="other"), rr.ChildSpec(SelfTrader, id="trader"))
    app = system.open_registrar("app")
    assert app.load("trader/forked", f"{provider}/thing").response == "Unavailable Unavailable, 2"
    assert len(system.registrar("trader").queries()) == 2


def outcome_of(call: Callable[[], object], outcome: list[str]) -> None:
    try:
        call()
        outcome.append("done")
    except rr.RrError as error:
        outcome.append(type(error).__name__)


class SelfTrader(rr.Manager):
    """Loads what it serves."""

    @rr.server("thing")
    def thing(self, request: str) -> str:
        return request

    @rr.server("forked")
    def forked(self, request: str) -> str:
        """What a forked child of a manager is told that loads, and unloads, as though it were its parent."""
        held: list[rr.Query] = []

        def hold() -> None:
            held.extend(self.registrar.load(request, "x") for _ in range(2))
            self.registrar.queries()

        thread = threading.Thread(target=hold)
        thread.start()
        thread.join()
        read, write = os.pipe()
        child = os.fork()
        if child == 0:
            told: list[str] = []
            for call in (lambda: self.registrar.load(request, "x"), held[0].unload):
                outcome: list[str] = []
                thread = threading.Thread(target=outcome_of, args=(call, outcome))
                thread.start()
                thread.join()
                told += outcome
            os.write(write, " ".join(told).encode())
            os._exit(0)
        os.close(write)
        with os.fdopen(read) as pipe:
            told_child = pipe.read()
        os.waitpid(child, 0)
        return f"{told_child}, {len(self.registrar.queries())}"

    @rr.server("both")
    def both(self, request: int) -> int:
        held: list[rr.Query] = []

        def hold() -> None:
            held.extend(self.registrar.load("trader/thing", "x") for _ in range(request))

        thread = threading.Thread(target=hold)
        thread.start()
        thread.join()
        return os.getpid()
