"""What becomes of messages and commands whose changes could not be written, as a table; and as a caller sees it."""

from __future__ import annotations

import time
from typing import Any, get_args

import pytest

import rr_actors as rr
from rr_actors.base.errors import CatalogError
from rr_actors.base.values.failure import Failure
from rr_actors.registrar import loads
from rr_actors.registrar.core.decide import refuse_uncommitted
from rr_actors.registrar.model import commands as c
from rr_actors.registrar.model import effects as e
from rr_actors.registrar.model.catalog import Catalog, Decision, Server
from rr_actors.registrar.model.messages import (
    Describe,
    Described,
    Fetch,
    Fetched,
    Gone,
    Leased,
    Load,
    Loaded,
    LoadRefused,
    Message,
    Noticed,
    NoticesHandled,
    Probe,
    Progressed,
    Released,
    Reprioritise,
    Reprioritised,
    Unload,
    Unloaded,
    UnloadRefused,
    WaitedFor,
)
from rr_actors.registrar.model.rows import Held, Hold, Notice, Phase, Resource, ServedQuery, State, content_of
from support import Calls, Gate, eventually, serve
from support_inside import actor_of

FULL = Failure("CatalogError", "disk full")
LATE = Failure("Unavailable", "not within 1 s")
WHY = Failure("LoadFailed", "no such device")
NOTICE = Notice("n", "mine", "me", "r", "event", State.ERROR, "", "p/cam")


def held(id: str, hold: Hold) -> Held:
    return Held(id, "p", "cam", b"front", b"feed", "r", "", 0, 1, hold, State.OK)


RESOURCE = Resource("r", "cam", b"front", b"feed", Phase.LOADED, State.OK, "", 1)

ROWS = (
    RESOURCE,
    ServedQuery("served", "r", "app", "", 0, 1),
    held("mine", Hold.HELD),
    held("owed", Hold.OWED),
    held("asked", Hold.PENDING),
)


def load(id: str) -> Load:
    return Load(id, "cam", b"front", "app", "", 0, 1)


def ask() -> c.AskProvider:
    return c.AskProvider("new", "p", "cam", b"front", "", 1)


def refused(*items: Any) -> tuple[list[Any], list[Any], Decision]:
    """What is caused, and what is to be done again. Messages come from "app"."""
    catalog = Catalog("me", content_of(ROWS))
    senders = ["app" if isinstance(item, get_args(Message)) else None for item in items]
    decision, again = refuse_uncommitted(catalog, list(zip(items, senders, strict=True)), FULL)
    assert (decision.changes, decision.later) == ([], {}), "it would need the disk that has just failed"
    return decision.effects, again, decision


TOLD: list[tuple[Any, Any]] = [
    (load("new"), e.SendReply("app", LoadRefused("new", FULL))),
    (c.Release("mine"), e.UnloadResolved("mine", FULL)),
    (c.ReleaseOverdue("owed", LATE), e.UnloadResolved("owed", LATE)),  # it is owed on disk, and stays so
    (c.SetStatus("r", "event", State.OK, "", "ticket"), e.AnswerCall("ticket", FULL)),
    (c.SetResponse("r", "event", b"", "", "ticket"), e.AnswerCall("ticket", FULL)),
    (c.Swap("r", "part", "spare", (), "event", b"", "", "ticket"), e.AnswerCall("ticket", FULL)),
    (c.SetPriority("mine", 5, "ticket"), e.AnswerCall("ticket", FULL)),
    (c.ForceUnload("r", "event", "ticket"), e.AnswerCall("ticket", FULL)),
    (c.Reload("r", "ticket"), e.AnswerCall("ticket", FULL)),
    (c.Revoke("r", "event", "why", 5000, "ticket"), e.AnswerCall("ticket", FULL)),
    (c.Unregister("cam", "event", "ticket"), e.AnswerCall("ticket", FULL)),
]

AGAIN: list[Any] = [
    load("served"),  # it is held: this was to send its answer again
    Loaded("mine", "r", b"feed"),
    LoadRefused("mine", WHY),
    Unload("served", "app"),
    Unloaded("owed"),
    UnloadRefused("owed", WHY),
    Fetch("app", True),
    Describe("cam"),
    Noticed(NOTICE),
    NoticesHandled(["n"]),
    Probe("served", "r", "served", []),
    WaitedFor("mine", "r", "served", []),
    Gone("app"),
    Leased(["hostb"], 1),
    Reprioritise("served", "app", 5),
    Reprioritised("mine", 5),
    c.Got("mine", "r", b"feed"),
    c.SendAgain("mine"),
    c.GiveUp("mine", LATE),
    c.BeginAgain(),
    c.BeginServing("event"),
    c.SetRows([]),
    c.AddInFlight(),
    c.RefuseLoad("app", "new", WHY),
    c.Register(Server("cam"), "event"),
    c.CallbackEnded("load", "r", 1, response=b"feed"),
    c.CallbackEnded("load", "r", 1, WHY),
    c.CallbackOverdue("load", "r", 1, LATE),
    c.CallbackEnded("unload", "r", 1),
    c.CallbackEnded("unload", "r", 1, WHY),
    c.CallbackEnded("recover", "r", 1, event="event"),
    c.CallbackEnded("recover", "r", 1, WHY, event="event"),
    c.CallbackOverdue("recover", "r", 1, LATE),
    c.CallbackEnded("pause", "r", 1),
    c.CallbackEnded("pause", "r", 1, WHY),
    c.CallbackEnded("resume", "r", 1, event="event"),
    c.CallbackEnded("resume", "r", 1, WHY, event="event"),
    c.BeginRun("health", RESOURCE),
    c.CallbackEnded("health", "r"),
    c.BeginTrial("recover:r"),
    c.TrialOver("recover:r"),
    c.RefusalOver("request:cam:0"),
    c.WaitOver("served"),
    c.LingerOver("r"),
    c.GraceOver("r", "event"),
    c.Heard("mine", "event"),
    c.CallbackEnded("status", "r", notice=NOTICE, handled=False),
    c.Reconcile("p", [], "event"),
    c.ConsumerLost("app"),
    c.LinkLost("p"),
    c.PeerGone("p", LATE, True, "event"),
    c.LeaseOver("p", 1, "over", "event"),
    c.BeginClosing(LATE),
    c.EndClosing(),
    c.EndProcess(),
]


@pytest.mark.parametrize(("item", "effect"), TOLD, ids=lambda value: type(value).__name__)
def test_who_waits_for_it_is_told(item: Any, effect: Any) -> None:
    effects, again, _ = refused(item)
    assert (effects, again) == ([effect], [])


def test_who_waits_for_a_load_of_ones_own_is_told() -> None:
    (effect,), again, decision = refused(ask())
    assert (effect.held.id, effect.held.hold, effect.failure, again) == ("new", Hold.PENDING, FULL, [])
    assert "new" not in decision.catalog.held


@pytest.mark.parametrize(("id", "unheard"), [("asked", False), ("asked", True), ("mine", True), ("unknown", False)])
def test_who_tires_of_a_load_hears_so_at_once_and_the_load_is_withdrawn_again_even_if_it_is_held_by_then(
    id: str, unheard: bool
) -> None:
    (effect,), again, _ = refused(c.GiveUp(id, LATE, unheard))
    assert (effect.held.id, effect.failure) == (id, LATE)
    assert again == [(c.GiveUp(id, LATE, unheard=True), None)]


@pytest.mark.parametrize("item", AGAIN, ids=lambda item: type(item).__name__)
def test_what_nobody_can_be_refused_is_done_again(item: Any) -> None:
    effects, again, _ = refused(item)
    assert (effects, [what for what, _ in again]) == ([], [item])


def test_every_message_and_command_is_in_one_of_these_tables() -> None:
    known = {type(item) for item in (*(item for item, _ in TOLD), *AGAIN, ask())}
    for_clients = {Fetched, Described, Progressed, Released}  # they come to no registrar's inbox
    assert known == {*get_args(Message), *c.Command.__subclasses__()} - for_clients


def test_the_rest_is_done_again_in_its_order_by_whom_it_came_from() -> None:
    got = c.Got("mine", "r", b"feed")
    _, again, _ = refused(Unload("served", "app"), ask(), c.LinkLost("p"), load("new"), load("served"), got)
    items = [Unload("served", "app"), c.LinkLost("p"), load("served"), got]
    assert again == list(zip(items, ["app", None, "app", None], strict=True))


def test_a_load_that_was_refused_gets_the_same_answer_when_it_is_sent_again() -> None:
    _, _, decision = refused(load("new"))
    assert decision.catalog.refused == {"new": FULL}


@pytest.mark.parametrize("id", ["mine", "unknown"])
def test_of_a_release_that_is_not_owed_nobody_is_told_that_it_is_overdue(id: str) -> None:
    effects, again, _ = refused(c.Release(id), c.ReleaseOverdue(id, LATE))
    assert (effects, again) == ([e.UnloadResolved(id, FULL)], [])


def test_who_tires_of_an_unload_while_the_disk_is_full_hears_that_it_is_owed(
    app: rr.Registrar, provider: rr.Registrar, gate: Gate, monkeypatch: pytest.MonkeyPatch
) -> None:
    served = serve(provider, "thing", unload=lambda *_: gate())
    query = app.load("provider/thing", "x")
    ledger = actor_of(app).commits
    commit, failed = ledger.commit, list[Decision]()

    def full(decision: Decision) -> None:
        if not failed and any(isinstance(effect, e.UnloadResolved) for effect in decision.effects):
            failed.append(decision)
            raise CatalogError("disk full", path="")
        commit(decision)

    monkeypatch.setattr(ledger, "commit", full)
    with pytest.raises(rr.Unavailable, match="the release is owed"):
        app.unload(query, timeout_s=0.2)
    assert (len(failed), list(app.queries())) == (1, [])
    gate.open()
    served.unloads.wait()


@pytest.mark.parametrize("directly", [True, False])
def test_who_tires_of_a_load_while_the_disk_is_full_hears_so_in_his_time_and_in_his_own_terms(
    app: rr.Registrar, provider: rr.Registrar, gate: Gate, monkeypatch: pytest.MonkeyPatch, directly: bool
) -> None:
    served = serve(provider, "thing", load=lambda request: request and gate())
    app.load("provider/thing", None)  # from now on there are lines
    commit, withdrawn, is_full = actor_of(app).commits.commit, Calls(), [True]

    def full(decision: Decision) -> None:
        gives_up = any(isinstance(effect, e.LoadResolved) and effect.failure for effect in decision.effects)
        if gives_up and is_full:
            raise CatalogError("disk full", path="")
        commit(decision)
        if gives_up:
            withdrawn(len(decision.changes))

    monkeypatch.setattr(actor_of(app).commits, "commit", full)
    monkeypatch.setattr(loads, "GRACE_S", 60)

    def load() -> object:
        if directly:
            return app.load("provider/thing", "x", timeout_s=0.3)
        return app.load("provider/thing", "x", timeout_s=0.3, block=False).get(timeout=60)

    began = time.monotonic()
    with pytest.raises(rr.LoadTimeout, match=r"not loaded within 0\.3 s") as caught:
        load()
    assert time.monotonic() - began < 20
    assert (caught.value.timeout_s, len(withdrawn)) == (0.3, 0)
    is_full.clear()
    withdrawn.wait()
    gate.open()
    served.unloads.wait()


def test_what_is_held_after_an_unload_that_could_not_be_written_still_hears_of_statuses(
    app: rr.Registrar, provider: rr.Registrar, monkeypatch: pytest.MonkeyPatch
) -> None:
    serve(provider, "thing")
    app.load("provider/thing", "keeps the link")
    heard = Calls()
    query = app.load("provider/thing", "x", on_status=lambda status: heard(status.message))
    commit, errors = actor_of(app).commits.commit, [CatalogError("disk full", path="")]

    def full(decision: Decision) -> None:
        if errors and decision.changes:
            raise errors.pop()
        commit(decision)

    monkeypatch.setattr(actor_of(app).commits, "commit", full)
    with pytest.raises(CatalogError, match="disk full"):
        app.unload(query, block=False).get(timeout=10)
    assert query.id in [held.id for held in app.queries()]
    provider.send_status(query.resource_id, rr.Status(rr.State.WARNING, "hot"))
    heard.wait()
    assert list(heard) == ["hot"]


def test_what_cannot_be_committed_is_logged_once_however_often_it_is_tried(
    app: rr.Registrar, provider: rr.Registrar, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    tried = Calls()

    def full(_changes: Any) -> None:
        tried()
        raise CatalogError("disk full", path="")

    serve(provider, "thing")
    query = app.load("provider/thing", "x")
    app.save_catalog()
    with monkeypatch.context() as patch:
        patch.setattr(actor_of(app).commits.store, "commit", full)
        actor_of(app).node.dispatcher.call(actor_of(app).post, c.GiveUp(query.id, WHY, unheard=True))
        tried.wait(3)
    eventually(lambda: app.stats()["queries"] == 0)
    assert [record.getMessage() for record in caplog.records if "not committed" in record.getMessage()] == [
        "app: not committed, nothing was done: disk full"
    ]
