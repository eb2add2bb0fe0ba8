"""The registrar's decisions as tables: what a message does in each state of what it is about."""

from __future__ import annotations

import itertools
from typing import Any

import msgspec
import pytest

from rr_actors.base.values.failure import Failure
from rr_actors.registrar.core import holding, recovery
from rr_actors.registrar.core.decide import Item, decide
from rr_actors.registrar.core.releasing import forgetting, owing
from rr_actors.registrar.model import commands as c
from rr_actors.registrar.model import effects as e
from rr_actors.registrar.model.catalog import Catalog, Server, Unsaved
from rr_actors.registrar.model.messages import (
    Fetch,
    Fetched,
    FetchedQuery,
    Gone,
    Load,
    Loaded,
    LoadRefused,
    Noticed,
    NoticesHandled,
    Probe,
    Unload,
    Unloaded,
    UnloadRefused,
)
from rr_actors.registrar.model.rows import (
    Drop,
    Held,
    Hold,
    Notice,
    Peer,
    Phase,
    Put,
    State,
    StoredServer,
    apply,
    content_of,
)

FAILURE = Failure("LoadFailed", "no such device")
PHASES = ("queued", "loading", "loaded", "unloading", "unload_failed", "fatal", "recovering")


class Registrar:
    """A catalog that is told things; keeps what the last of them caused."""

    def __init__(self, name: str = "p", *servers: Server, rows: Any = (), epoch: int = 1) -> None:
        self.catalog = Catalog(name, content_of(rows), epoch)
        self.effects: list[Any] = []
        self.changes: list[Any] = []
        self.numbers = itertools.count(self.catalog.since + 1)
        for server in servers:
            self.obey(c.Register(server, "event"))

    def decide(self, message: Any, sender: str = "app") -> list[Any]:
        return self.together((message, sender))

    def obey(self, command: Any) -> list[Any]:
        return self.together((command, None))

    def ask(self, id: str, provider: str, server: str, request: bytes, parent: str) -> list[Any]:
        return self.obey(c.AskProvider(id, provider, server, request, parent, next(self.numbers)))

    def begin_again(self) -> list[Any]:
        return self.together((c.BeginAgain(), None))

    def again(self, *servers: Server) -> Registrar:
        """As after a crash in which everything had been written."""
        rows = [row for table in self.catalog.tables.values() for row in table.values()]
        registrar = Registrar(self.catalog.name, rows=rows, epoch=self.catalog.epoch + 1)
        registrar.begin_again()
        registrar.together(
            *((c.Register(server, "event"), None) for server in servers), (c.BeginServing("event"), None)
        )
        return registrar

    def together(self, *items: Item) -> list[Any]:
        """As what one read brings."""
        decision = decide(self.catalog, items)
        self.effects, self.changes = decision.effects, decision.changes
        return decision.effects

    @property
    def replies(self) -> list[Any]:
        return [effect.message for effect in self.effects if isinstance(effect, e.SendReply)]

    def starts(self, role: str) -> list[Any]:
        return [effect for effect in self.effects if isinstance(effect, e.StartCallback) and effect.role == role]

    def started(self, role: str) -> list[str]:
        return [start.resource.id for start in self.starts(role)]

    def phase(self, id: str = "q") -> Phase | None:
        resource = self.catalog.resources.get(id)
        return resource.phase if resource else None


def load(id: str = "q", origin: str = "app", parent: str = "", seq: int = 1) -> Load:
    return Load(id, "cam", b"front", origin, parent, 0, seq)


def provider(phase: str, **server: Any) -> Registrar:
    """Query "q" of app on resource "q" in that phase."""
    cam = Server("cam", **server)
    registrar = Registrar("p", cam)
    registrar.decide(Fetch("app", True))
    if phase == "queued":
        registrar.decide(load("old", "other"))
        registrar.obey(c.CallbackEnded("load", "old", 1, response=b"1"))
        registrar.decide(Unload("old", "other"))
    registrar.decide(load())
    if phase in ("queued", "loading"):
        return registrar
    registrar.obey(c.CallbackEnded("load", "q", 1, response=b"feed"))
    match phase:
        case "unloading":
            registrar.decide(Unload("q", "app"))
        case "unload_failed":
            registrar.decide(Unload("q", "app"))
            registrar.obey(c.CallbackEnded("unload", "q", 1, FAILURE))
        case "fatal":
            registrar.obey(c.SetStatus("q", "e", State.FATAL, "", None))
            registrar.decide(NoticesHandled(["e:q"]))
        case "recovering":
            registrar = registrar.again(msgspec.structs.replace(cam, has_recover=True))
            registrar.decide(Fetch("app", True))
        case _:
            pass
    return registrar


# -- provider: each message in each phase ----------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("phase", "answer"),
    [
        ("queued", None),
        ("loading", None),
        ("loaded", Loaded("q", "q", b"feed")),
        ("unload_failed", Loaded("q", "q", b"feed")),
        ("fatal", Loaded("q", "q", b"feed", state=State.FATAL)),
        ("recovering", None),
    ],
)
def test_a_load_sent_again_is_the_same_query(phase: str, answer: Any) -> None:
    registrar = provider(phase)
    before = dict(registrar.catalog.queries)

    registrar.decide(load())

    assert registrar.replies == ([answer] if answer else [])
    assert registrar.catalog.queries == before
    assert registrar.started("load") == []


@pytest.mark.parametrize(
    ("phase", "resource", "begins"),
    [
        ("queued", "q", False),
        ("loading", "q", False),
        ("loaded", "q", False),
        ("unloading", "r", False),  # queued
        ("unload_failed", "r", True),
        ("fatal", "r", True),
        ("recovering", None, False),  # parked
    ],
)
def test_an_identical_request_of_another_joins_or_begins(phase: str, resource: str | None, begins: bool) -> None:
    registrar = provider(phase)

    registrar.decide(load("r", "other"), "other")

    query = registrar.catalog.queries.get("r")
    assert (query.resource_id if query else None) == resource
    assert bool(registrar.started("load")) is begins


@pytest.mark.parametrize(
    ("phase", "answered", "after"),
    [
        ("queued", True, None),
        ("loading", True, Phase.LOADING),
        ("loaded", False, Phase.UNLOADING),
        ("unloading", False, Phase.UNLOADING),
        ("unload_failed", False, Phase.UNLOADING),
        ("fatal", False, Phase.UNLOADING),
        ("recovering", False, Phase.LOADED),
    ],
)
def test_the_last_unload_in_each_phase(phase: str, answered: bool, after: Phase | None) -> None:
    registrar = provider(phase)

    registrar.decide(Unload("q", "app"))

    assert registrar.replies == ([Unloaded("q")] if answered else [])
    assert registrar.phase() == after


@pytest.mark.parametrize("phase", PHASES)
def test_an_unload_of_another_consumer_is_refused_and_changes_nothing(phase: str) -> None:
    registrar = provider(phase)

    registrar.decide(Unload("q", "thief"), "thief")

    (refusal,) = registrar.replies
    assert isinstance(refusal, UnloadRefused)
    assert refusal.failure.kind == "NotHolder"
    assert registrar.changes == []


@pytest.mark.parametrize(
    ("phase", "answer", "noticed", "after"),
    [
        ("queued", LoadRefused, False, None),
        ("loading", LoadRefused, False, Phase.LOADING),
        ("loaded", None, True, Phase.UNLOADING),
        ("unloading", Unloaded, False, Phase.UNLOADING),
        ("unload_failed", None, True, Phase.UNLOADING),
        ("fatal", None, True, Phase.UNLOADING),
        ("recovering", None, True, Phase.LOADED),  # unloaded when it is known whether it lives
    ],
)
def test_a_forced_unload_in_each_phase(phase: str, answer: Any, noticed: bool, after: Phase | None) -> None:
    registrar = provider(phase)

    registrar.obey(c.ForceUnload("q", "f", "ticket"))

    others = [reply for reply in registrar.replies if not isinstance(reply, Noticed)]
    assert [type(reply) for reply in others] == ([answer] if answer else [])
    assert [r.notice.released for r in registrar.replies if isinstance(r, Noticed)] == ([True] if noticed else [])
    assert "q" not in registrar.catalog.queries
    assert registrar.phase() == after


@pytest.mark.parametrize("phase", PHASES)
def test_unregistering_ends_every_phase_and_answers_once(phase: str) -> None:
    registrar = provider(phase)
    registrar.obey(c.Unregister("cam", "event", "ticket"))
    answers = [effect for effect in registrar.effects if isinstance(effect, e.AnswerCall)]

    for _ in range(4):  # what runs comes to its end
        for resource in list(registrar.catalog.resources.values()):
            match resource.phase:
                case Phase.LOADING:
                    registrar.obey(c.CallbackEnded("load", resource.id, resource.attempt, response=b"x"))
                case Phase.UNLOADING:
                    registrar.obey(c.CallbackEnded("unload", resource.id, resource.tries))
                case _:
                    registrar.obey(c.CallbackEnded("recover", resource.id, resource.attempt, event="r"))
            answers += [effect for effect in registrar.effects if isinstance(effect, e.AnswerCall)]

    assert answers == [e.AnswerCall("ticket", None)]
    assert (registrar.catalog.resources, registrar.catalog.queries) == ({}, {})
    assert registrar.catalog.servers == {}


def test_a_stored_server_goes_with_the_decision_that_answers_its_unregistration() -> None:
    registrar = provider("loaded")
    registrar.obey(c.SetRows([Put(StoredServer("cam", b"spec"))]))

    registrar.obey(c.Unregister("cam", "event", "ticket"))
    assert "cam" in registrar.catalog.stored_servers
    (resource,) = registrar.catalog.resources.values()
    registrar.obey(c.CallbackEnded("unload", resource.id, resource.tries))

    assert [effect for effect in registrar.effects if isinstance(effect, e.AnswerCall)] == [
        e.AnswerCall("ticket", None)
    ]
    assert Drop("stored_servers", "cam") in registrar.changes
    assert registrar.catalog.stored_servers == {}


@pytest.mark.parametrize("phase", PHASES)
def test_what_a_dead_consumer_held_is_released_in_each_phase(phase: str) -> None:
    registrar = provider(phase)

    registrar.decide(Gone("app"))

    assert "app" not in registrar.catalog.by_origin
    assert registrar.phase() in (None, Phase.LOADING, Phase.UNLOADING, Phase.LOADED)
    assert registrar.phase() is not Phase.LOADED or "q" in registrar.catalog.recovering


@pytest.mark.parametrize("phase", PHASES)
def test_a_status_is_on_disk_and_on_its_way_in_each_phase(phase: str) -> None:
    registrar = provider(phase)

    registrar.obey(c.SetStatus("q", "s", State.WARNING, "hot", "ticket"))

    assert [r.notice.id for r in registrar.replies if isinstance(r, Noticed)] == ["s:q"]
    assert "s:q" in registrar.catalog.notices
    assert e.AnswerCall("ticket", None) in registrar.effects


@pytest.mark.parametrize(
    ("phase", "begins", "attempt", "tries"),
    [("loading", "load", 2, 0), ("loaded", None, 1, 0), ("unloading", "unload", 1, 2), ("unload_failed", None, 1, 1)],
)
def test_what_a_crash_interrupted_runs_again_under_the_next_number(
    phase: str, begins: Any, attempt: int, tries: int
) -> None:
    registrar = provider(phase).again(Server("cam"))

    resource = registrar.catalog.resources["q"]
    assert [effect.role for effect in registrar.effects if hasattr(effect, "resource")] == ([begins] if begins else [])
    assert (resource.attempt, resource.tries) == (attempt, tries)


@pytest.mark.parametrize("recovery", ["keep", "reload"])
def test_a_health_callback_in_whose_runs_three_processes_have_died_loses_its_resource(recovery: Any) -> None:
    server = Server("cam", recovery=recovery)
    registrar = provider("loaded", recovery=recovery)
    for deaths in (1, 2, 3):
        registrar.obey(c.BeginRun("health", registrar.catalog.resources["q"]))
        if deaths > 1:  # it waits, as it may be innocent
            (timer,) = registrar.effects
            registrar.obey(timer.command)
        assert registrar.started("health") == ["q"]
        registrar = registrar.again(server)
        assert registrar.catalog.callback_runs["health:q"].deaths == deaths

    assert registrar.catalog.resources["q"].state is State.FATAL


def test_a_health_callback_that_has_returned_is_not_blamed_for_the_death_of_its_process() -> None:
    registrar = provider("loaded")
    for _ in range(5):
        registrar.obey(c.BeginRun("health", registrar.catalog.resources["q"]))
        registrar.obey(c.CallbackEnded("health", "q"))
        registrar = registrar.again(Server("cam"))

    assert registrar.catalog.callback_runs == {}
    assert registrar.catalog.resources["q"].state is State.OK


def test_a_health_callback_is_innocent_if_the_process_dies_without_it() -> None:
    registrar = provider("loaded")
    registrar.obey(c.BeginRun("health", registrar.catalog.resources["q"]))
    registrar = registrar.again(Server("cam"))
    assert registrar.catalog.callback_runs["health:q"].deaths == 1
    (timer,) = registrar.obey(c.BeginRun("health", registrar.catalog.resources["q"]))
    assert isinstance(timer, e.SetTimer)
    registrar = registrar.again(Server("cam"))  # it dies while the callback waits
    assert registrar.catalog.callback_runs == {}


def test_a_death_counts_when_all_callbacks_that_ran_have_ended_in_the_next_process() -> None:
    registrar = provider("loaded")
    registrar.decide(Load("r", "cam", b"rear", "app", "", 0, 2))
    registrar.obey(c.BeginRun("usage", registrar.catalog.resources["q"]))
    registrar = registrar.again(Server("cam"))
    assert e.Acquitted() not in registrar.obey(c.CallbackEnded("load", "r", 2, response=b"feed"))
    registrar.obey(c.BeginRun("usage", registrar.catalog.resources["q"]))
    assert e.Acquitted() in registrar.obey(c.CallbackEnded("usage", "q"))


def both_probed(registrar: Registrar) -> list[Item]:
    resources = registrar.catalog.resources.values()
    return [(c.BeginRun("health", resource, waited=True), None) for resource in resources]


def test_after_two_deaths_health_callbacks_run_one_after_another_until_the_one_that_kills_is_found() -> None:
    registrar = provider("loaded")
    registrar.decide(Load("r", "cam", b"rear", "app", "", 0, 2))
    registrar.obey(c.CallbackEnded("load", "r", 1, response=b"feed"))
    for _ in range(2):
        registrar.together(*both_probed(registrar))
        assert registrar.started("health") == ["q", "r"]
        registrar = registrar.again(Server("cam"))

    registrar.together(*both_probed(registrar))
    assert registrar.started("health") == ["q"]
    registrar.obey(c.CallbackEnded("health", "q"))
    registrar.obey(c.BeginTrial("health:r"))
    assert registrar.started("health") == ["r"]
    registrar = registrar.again(Server("cam"))

    states = {id: resource.state for id, resource in registrar.catalog.resources.items()}
    assert states == {"q": State.OK, "r": State.FATAL}


def test_what_an_interrupted_reload_had_loaded_goes_with_a_resource_that_is_fatal_since() -> None:
    server = Server("cam", recovery="reload")
    registrar = provider("loaded", recovery="reload").again(server)
    registrar.obey(c.Reconcile("lens", [], "r"))
    registrar.ask("part", "lens", "zoom", b"", "q")
    registrar.decide(Loaded("part", "res", b"x"), "lens")
    registrar.obey(c.SetStatus("q", "s", State.FATAL, "", None))

    registrar = registrar.again(server)

    assert registrar.started("recover") == []
    assert registrar.catalog.parts_of("q") == ["part"]
    registrar.decide(Unload("q", "app"))
    registrar.obey(c.CallbackEnded("unload", "q", 1))
    assert registrar.catalog.held["part"].hold is Hold.OWED


def test_the_end_of_an_interrupted_run_is_not_taken_for_the_present_ones() -> None:
    registrar = provider("loading").again(Server("cam"))

    assert registrar.obey(c.CallbackEnded("load", "q", 1, response=b"stale")) == []
    assert registrar.phase() is Phase.LOADING


def test_a_refused_load_is_refused_again_and_does_not_run_again() -> None:
    registrar = provider("loading")
    registrar.obey(c.CallbackEnded("load", "q", 1, FAILURE))

    registrar.decide(load())

    assert registrar.replies == [LoadRefused("q", FAILURE)]
    assert registrar.started("load") == []


def test_a_load_that_comes_behind_its_own_withdrawal_is_refused() -> None:
    registrar = Registrar("p", Server("cam"))
    registrar.decide(Unload("q", "app"))
    assert registrar.replies == [Unloaded("q")]

    registrar.decide(load())

    assert [type(reply) for reply in registrar.replies] == [LoadRefused]
    assert registrar.catalog.queries == {}


def test_a_queued_load_that_became_fatal_still_begins_when_its_turn_comes() -> None:
    registrar = provider("queued")
    registrar.obey(c.SetStatus("q", "s", State.FATAL, "", None))

    registrar.obey(c.CallbackEnded("unload", "old", 1))

    assert registrar.started("load") == ["q"]


def test_a_resource_that_takes_an_id_in_use_gets_one_of_its_own() -> None:
    registrar = provider("unload_failed")
    registrar.obey(c.ForceUnload("q", "f", None))
    registrar.catalog.refused.clear()  # as after a crash

    registrar.decide(load())

    assert registrar.catalog.queries["q"].resource_id == "q+2"
    assert registrar.catalog.resources["q+2"].phase is Phase.QUEUED


def test_lingering_is_given_to_the_next_and_nobody_keeps_a_fatal_one_warm() -> None:
    registrar = provider("loaded", linger_s=5.0)
    registrar.decide(Unload("q", "app"))
    assert registrar.phase() is Phase.LOADED
    assert e.SetTimer("linger:q", 5.0, c.LingerOver("q")) in registrar.effects

    registrar.decide(load("r"))
    assert registrar.replies == [Loaded("r", "q", b"feed")]
    assert registrar.obey(c.LingerOver("q")) == []

    registrar.decide(Unload("r", "app"))
    registrar.obey(c.SetStatus("q", "s", State.FATAL, "", None))
    assert registrar.phase() is Phase.UNLOADING


def test_a_fetch_lists_the_queries_and_then_sends_what_was_not_dealt_with() -> None:
    registrar = provider("loaded")
    registrar.obey(c.ConsumerLost("app"))
    registrar.obey(c.SetStatus("q", "s", State.ERROR, "", None))
    assert registrar.replies == []

    registrar.decide(Fetch("app", True, 7))

    listed, noticed = registrar.replies
    rows = [FetchedQuery("q", "cam", "q", b"front", b"feed", "", 0, 1, "ERROR")]
    assert listed == Fetched(rows, False, 7, notices=True)
    assert (noticed.notice.id, noticed.repeated) == ("s:q", False)


# -- consumer --------------------------------------------------------------------------------------------------------


def consumer(hold: str) -> Registrar:
    """Query "q" at registrar p, pending, held or owed, over a link that is reconciled."""
    registrar = Registrar("app")
    registrar.obey(c.Reconcile("p", [], "r0"))
    registrar.ask("q", "p", "cam", b"front", "")
    if hold != "pending":
        registrar.decide(Loaded("q", "res", b"feed"), "p")
    if hold == "owed":
        registrar.obey(c.Release("q"))
    return registrar


def requests(registrar: Registrar) -> list[Any]:
    return [effect.message for effect in registrar.effects if isinstance(effect, e.SendRequest)]


def hold_of(registrar: Registrar) -> Hold | None:
    held = registrar.catalog.held.get("q")
    return held.hold if held else None


@pytest.mark.parametrize(
    ("hold", "message", "after", "says"),
    [
        ("pending", Loaded("q", "res", b"feed"), Hold.HELD, []),
        ("held", Loaded("q", "res", b"feed"), Hold.HELD, []),
        ("owed", Loaded("q", "res", b"feed"), Hold.OWED, []),
        ("pending", LoadRefused("q", FAILURE), None, []),
        ("held", LoadRefused("q", FAILURE), Hold.HELD, []),  # taken away since: a notice says so
        ("owed", LoadRefused("q", FAILURE), None, []),
        ("pending", Unloaded("q"), Hold.PENDING, []),
        ("owed", Unloaded("q"), None, []),
        ("pending", UnloadRefused("q", FAILURE), Hold.PENDING, []),
        ("held", UnloadRefused("q", FAILURE), Hold.HELD, []),
        ("owed", UnloadRefused("q", FAILURE), Hold.HELD, []),
    ],
)
def test_each_answer_to_each_view_of_a_query(hold: str, message: Any, after: Hold | None, says: list[Any]) -> None:
    registrar = consumer(hold)

    registrar.decide(message, "p")

    assert hold_of(registrar) == after
    assert requests(registrar) == says


@pytest.mark.parametrize("listed", [True, False])
def test_a_provider_is_looked_for_after_a_crash_once_a_link_to_it_has_been_up(listed: bool) -> None:
    """It may have something of ours; or a thread loads by its own line there, before a decision knows of it."""
    registrar = Registrar("app")

    registrar.obey(c.Reconcile("p", [their()] if listed else [], "r0"))

    assert registrar.changes[:1] == [Put(Peer("p"))]


@pytest.mark.parametrize("notices", [True, False])
def test_a_provider_that_goes_for_good_before_its_notices_arrived_is_looked_for_when_it_is_back(notices: bool) -> None:
    """A query that nobody knows was lost there while this registrar was down; its notice went with the link."""
    lost = Notice("e:lost", "lost", "app", "res", "e", State.FATAL, "lost", "p/cam", True)
    provider = Registrar("p", rows=[lost] if notices else ())
    provider.decide(Fetch("app", resume=True))
    (fetched,) = [reply for reply in provider.replies if isinstance(reply, Fetched)]
    assert fetched.notices is notices

    registrar = Registrar("app")
    registrar.obey(c.Reconcile("p", [], "r0", notices=fetched.notices))
    registrar.obey(c.LinkLost("p"))
    registrar.obey(c.PeerGone("p", FAILURE, final=True, event="r1", empty=False))

    assert registrar.again().catalog.needs("p") is notices


def test_a_load_that_was_sent_again_and_that_its_line_refused_is_owed_on_disk_before_anybody_hears_so() -> None:
    """The refusal is of an incarnation that has died: the present one may load it."""
    registrar = Registrar("app")
    ask_directly(registrar)
    registrar.obey(c.Reconcile("p", [], "r1"))
    assert [type(message) for message in requests(registrar)] == [Load]

    registrar.obey(c.GiveUp("q", FAILURE, unheard=True))

    assert Put(registrar.catalog.held["q"]) in registrar.changes
    assert hold_of(registrar) is Hold.OWED
    assert requests(registrar) == [Unload("q", "app")]
    (told,) = [effect.failure for effect in registrar.effects if isinstance(effect, e.LoadResolved)]
    assert told == FAILURE


def test_a_load_that_its_callers_own_line_refused_is_let_go_where_it_was_held_by_another_way() -> None:
    registrar = Registrar("app")
    registrar.obey(c.Reconcile("p", [], "r0"))
    ask_directly(registrar)
    registrar.obey(c.Reconcile("p", [their()], "r1"))
    assert hold_of(registrar) is Hold.HELD

    registrar.obey(c.GiveUp("q", FAILURE, unheard=True))

    assert hold_of(registrar) is Hold.OWED
    assert requests(registrar) == [Unload("q", "app")]


def test_a_refusal_by_the_link_says_nothing_while_the_callers_own_line_may_say_that_it_is_loaded() -> None:
    """It was loaded for the line, taken away, and refused when the link asked again: of the loss a notice tells."""
    registrar = Registrar("app")
    registrar.obey(c.Reconcile("p", [], "r0"))
    ask_directly(registrar)

    registrar.decide(LoadRefused("q", FAILURE), "p")
    registrar.obey(c.Got("q", "res", b"feed"))
    assert hold_of(registrar) is Hold.HELD
    notice = Notice("e:q", "q", "app", "res", "e", State.FATAL, "gone", "p/cam", True)
    registrar.decide(Noticed(notice), "p")

    assert [effect.notice for effect in registrar.effects if isinstance(effect, e.Hear)] == [notice]


def test_a_refusal_by_the_link_is_the_end_of_a_load_whose_line_has_broken() -> None:
    registrar = Registrar("app")
    registrar.obey(c.Reconcile("p", [], "r0"))
    ask_directly(registrar)
    registrar.decide(LoadRefused("q", FAILURE), "p")

    registrar.obey(c.SendAgain("q"))
    assert [type(message) for message in requests(registrar)] == [Load]
    registrar.decide(LoadRefused("q", FAILURE), "p")

    assert hold_of(registrar) is None
    assert [effect.failure for effect in registrar.effects if isinstance(effect, e.LoadResolved)] == [FAILURE]


def in_flight() -> Registrar:
    """A load of the query "q" by its caller's own line, which nobody else has heard of."""
    registrar = Registrar("app")
    registrar.obey(c.Reconcile("p", [], "r0"))
    registrar.ask("first", "p", "cam", b"front", "")
    registrar.catalog.in_flight["q"] = ASKED
    return registrar


ASKED = holding.pending(c.AskProvider("q", "p", "cam", b"front", "", (1 << 32) + 7))
GOT = c.Got("q", "res", b"feed")


def ask_directly(registrar: Registrar) -> None:
    """A load by its caller's own connection, of which something is about to be decided."""
    registrar.catalog.in_flight["q"] = ASKED
    registrar.obey(c.AddInFlight())


@pytest.mark.parametrize(("run", "lost"), [(3, 0), (4, 1)])
def test_what_a_line_has_brought_without_a_link_is_lost_if_a_later_run_of_its_provider_does_not_list_it(
    run: int, lost: int
) -> None:
    """The list of the same run may be older than the answer of the line."""
    registrar = in_flight()
    registrar.obey(c.LinkLost("p"))
    registrar.obey(c.Got("q", "res", b"feed", run=3))

    registrar.obey(c.Reconcile("p", [], "r1", run=run))

    assert len([effect for effect in registrar.effects if isinstance(effect, e.Receive)]) == lost


def test_a_load_in_flight_is_owed_when_its_registrar_is_closed() -> None:
    registrar = Registrar("app")
    registrar.obey(c.Reconcile("p", [], "r0"))
    registrar.catalog.in_flight["q"] = ASKED

    registrar.obey(c.EndClosing())

    assert hold_of(registrar) is Hold.OWED
    assert list(registrar.catalog.peers) == ["p"]


def everything(registrar: Registrar) -> dict[str, Any]:
    """All that is known; not what is undone."""
    return {name: value for name, value in vars(registrar.catalog).items() if name not in ("_index", "unfinished")}


def test_what_a_thread_takes_up_of_its_load_is_what_is_decided_of_it() -> None:
    fast, general = in_flight(), in_flight()
    unsaved = Unsaved()
    assert holding.hold(fast.catalog, unsaved, GOT)
    (resolved,) = general.obey(GOT)
    assert isinstance(resolved, e.LoadResolved)  # which its thread knows
    assert everything(fast) == everything(general)
    assert unsaved.changes() == [Put(general.catalog.held["q"])]
    assert "q" in unsaved.new


def lost_link(registrar: Registrar) -> None:
    registrar.obey(c.LinkLost("p"))


def noticed(registrar: Registrar) -> None:
    registrar.decide(Noticed(Notice("e:q", "q", "app", "res", "e", State.ERROR, "hot", "p/cam"), False), "p")


def listed(registrar: Registrar) -> None:
    registrar.obey(c.Reconcile("p", [], "r1"))


@pytest.mark.parametrize("meanwhile", [lost_link, noticed, listed])
def test_a_load_of_which_something_was_heard_meanwhile_is_decided(meanwhile: Any) -> None:
    registrar = in_flight()
    meanwhile(registrar)
    assert not holding.hold(registrar.catalog, Unsaved(), GOT)
    registrar.obey(GOT)
    assert hold_of(registrar) is Hold.HELD
    assert registrar.catalog.in_flight == {}


def owes(registrar: Registrar, id: str = "q") -> bool:
    """Whether a query may be let go by the fast path."""
    return holding.owe(registrar.catalog, Unsaved(), id, lambda row: True)


@pytest.mark.parametrize("saved", [True, False])
def test_what_a_thread_lets_go_by_its_line_is_gone_as_what_is_decided_of_it(saved: bool) -> None:
    fast, general = in_flight(), in_flight()
    unsaved = Unsaved()
    assert holding.hold(fast.catalog, unsaved, GOT)
    if saved:
        unsaved.clear()
    owed = msgspec.structs.replace(fast.catalog.held["q"], hold=Hold.OWED)
    written: list[Any] = []
    assert holding.owe(fast.catalog, unsaved, "q", lambda row: not written.append(row))
    general.obey(GOT)
    general.obey(c.Release("q"))
    assert everything(fast) == everything(general)
    assert written == ([owed] if saved else [])  # what was never written is written as owed a moment later
    assert unsaved.changes() == ([] if saved else [Put(owed)])
    assert not owes(fast)

    assert holding.forget_released(fast.catalog, unsaved, "q")
    general.decide(Unloaded("q"), "p")
    assert everything(fast) == everything(general)
    assert unsaved.changes() == ([Drop("held", "q")] if saved else [])
    assert "q" not in unsaved.new


def test_what_cannot_be_written_as_owed_is_held() -> None:
    registrar = in_flight()
    unsaved = Unsaved()
    assert holding.hold(registrar.catalog, unsaved, GOT)
    unsaved.clear()
    assert not holding.owe(registrar.catalog, unsaved, "q", lambda row: False)
    assert hold_of(registrar) is Hold.HELD
    assert registrar.catalog.unfinished is None


def test_a_release_that_is_late_or_goes_on_by_the_link_is_owed_on_disk() -> None:
    for command in (c.SendAgain("q"), c.ReleaseOverdue("q", FAILURE)):
        registrar = in_flight()
        unsaved = Unsaved()
        assert holding.hold(registrar.catalog, unsaved, GOT)
        assert holding.owe(registrar.catalog, unsaved, "q", lambda row: False)
        registrar.obey(command)
        assert registrar.changes == [Put(registrar.catalog.held["q"])]


@pytest.mark.parametrize("hold", ["pending", "owed"])
def test_what_is_not_held_is_not_let_go_by_a_line(hold: str) -> None:
    registrar = consumer(hold)
    assert not owes(registrar)


def test_what_is_about_to_change_is_not_let_go_by_a_line() -> None:
    held = consumer("held")
    assert not owes(held, "other")

    before_a_crash = held.again()
    assert not owes(before_a_crash)

    refused = consumer("owed")
    refused.decide(UnloadRefused("q", FAILURE), "p")
    assert hold_of(refused) is Hold.HELD
    assert not owes(refused)

    taken = consumer("held")
    taken.decide(Noticed(Notice("e:q", "q", "app", "res", "e", State.FATAL, "", "p/cam", True), False), "p")
    assert hold_of(taken) is Hold.HELD
    assert not owes(taken)


def test_who_lets_go_of_what_was_taken_from_him_is_not_told_that_any_more() -> None:
    registrar = provider("loaded")
    registrar.obey(c.ForceUnload("q", "e", "ticket"))
    assert [notice.query_id for notice in registrar.catalog.notices.values()] == ["q"]

    registrar.decide(Unload("q", "app"))

    assert registrar.replies == [Unloaded("q")]
    assert registrar.catalog.notices == {}


@pytest.mark.parametrize("listed", ["loaded", "loading", "gone"])
def test_what_was_heard_of_a_resource_before_the_link_broke_is_not_said_of_the_one_its_load_gets(listed: str) -> None:
    """The old one was given a new response and taken away; of the latter the broken link brought nothing."""
    registrar = consumer("pending")
    update = Notice("e:q", "q", "app", "old", "e", State.UPDATE, "", "p/cam", False, b"late")
    registrar.decide(Noticed(update, False), "p")
    registrar.obey(c.LinkLost("p"))

    place = ("q", "cam", "new", b"front")
    row = FetchedQuery(*place, b"feed" if listed == "loaded" else None, "", 0, registrar.catalog.held["q"].seq, "OK")
    registrar.obey(c.Reconcile("p", [] if listed == "gone" else [row], "r1"))
    if listed != "loaded":
        assert [message.query_id for message in requests(registrar)] == ["q"]
        registrar.decide(Loaded("q", "new", b"feed"), "p")

    held = registrar.catalog.held["q"]
    assert (held.hold, held.resource_id, held.response, held.state) == (Hold.HELD, "new", b"feed", State.OK)


@pytest.mark.parametrize(("withdrawn", "after"), [(True, Hold.OWED), (False, None)])
def test_what_was_withdrawn_is_owed_until_it_is_unloaded_whatever_was_taken_away(
    withdrawn: bool, after: Hold | None
) -> None:
    """Its Load may be under way again, and what the notice is about be what it got the time before."""
    registrar = consumer("pending" if withdrawn else "held")
    registrar.obey(c.GiveUp("q", FAILURE) if withdrawn else c.Release("q"))

    registrar.decide(Noticed(Notice("e:q", "q", "app", "res", "e", State.FATAL, "gone", "p/cam", True), False), "p")

    assert hold_of(registrar) is after
    asked_again = [Unload("q", "app")] if withdrawn else []  # it may have been refused before
    assert requests(registrar) == [*asked_again, NoticesHandled(["e:q"])]
    registrar.decide(Unloaded("q"), "p")
    assert hold_of(registrar) is None


@pytest.mark.parametrize("command", [c.SendAgain("q"), c.GiveUp("q", FAILURE, unheard=True)])
def test_who_still_waits_for_what_was_taken_from_him_hears_that_it_is_over(command: Any) -> None:
    registrar = Registrar("app")
    (resolved,) = registrar.obey(command)
    assert isinstance(resolved, e.LoadResolved)
    assert resolved.held.id == "q"
    assert resolved.failure is not None


def test_of_what_is_let_go_while_its_provider_says_that_it_is_gone_nobody_hears() -> None:
    registrar = Registrar("app")
    registrar.obey(c.Reconcile("p", [], "r0"))
    registrar.catalog.in_flight["q"] = ASKED
    registrar.obey(GOT)
    registrar.obey(c.Release("q"))

    registrar.obey(c.Reconcile("p", [], "r1"))  # restarted, and does not have it

    assert not [effect for effect in registrar.effects if isinstance(effect, (e.Hear, e.Receive))]
    assert requests(registrar) == [Unload("q", "app")]


def test_an_answer_to_a_query_that_nobody_knows_lets_it_go() -> None:
    registrar = consumer("held")

    registrar.decide(Loaded("unknown", "res", b"feed"), "p")

    assert requests(registrar) == [Unload("unknown", "app")]


@pytest.mark.parametrize(("unheard", "after"), [(True, Hold.OWED), (False, Hold.HELD)])
def test_a_load_given_up_when_it_is_held_is_withdrawn_if_nobody_heard_so(unheard: bool, after: Hold) -> None:
    registrar = consumer("held")

    registrar.obey(c.GiveUp("q", FAILURE, unheard))

    assert hold_of(registrar) is after
    resolved = [effect.failure for effect in registrar.effects if isinstance(effect, e.LoadResolved)]
    assert resolved == ([FAILURE] if unheard else [])  # said when the release is on disk
    assert len(registrar.changes) == len(requests(registrar)) == (1 if unheard else 0)
    registrar.decide(UnloadRefused("q", FAILURE), "p")
    assert hold_of(registrar) is after


def test_a_withdrawn_load_whose_unload_fails_is_not_held_again() -> None:
    registrar = consumer("pending")
    registrar.obey(c.GiveUp("q", FAILURE))

    registrar.decide(UnloadRefused("q", FAILURE), "p")

    assert hold_of(registrar) is Hold.OWED


def their(response: bytes | None = b"feed", parent: str = "", attempt: int = 0, seq: int = 1) -> FetchedQuery:
    return FetchedQuery("q", "cam", "res", b"front", response, parent, attempt, seq, "OK")


@pytest.mark.parametrize(
    ("hold", "theirs", "after", "says"),
    [
        ("pending", None, Hold.PENDING, [Load]),
        ("pending", their(None), Hold.PENDING, [Load]),
        ("pending", their(), Hold.HELD, []),
        ("held", their(), Hold.HELD, []),
        ("owed", None, Hold.OWED, [Unload]),
        ("owed", their(), Hold.OWED, [Unload]),
        ("unknown", their(), Hold.HELD, []),
        ("unknown", their(None), Hold.OWED, [Unload]),
        ("unknown", their(parent="gone", attempt=1), Hold.OWED, [Unload]),
        ("unknown", their(seq=(1 << 32) + 5), Hold.OWED, [Unload]),  # of this incarnation: it was let go
    ],
)
def test_what_both_know_is_reconciled(hold: str, theirs: FetchedQuery | None, after: Hold, says: list[type]) -> None:
    registrar = Registrar("app") if hold == "unknown" else consumer(hold)

    registrar.obey(c.Reconcile("p", [] if theirs is None else [theirs], "r"))

    assert hold_of(registrar) is after
    assert [type(message) for message in requests(registrar)] == says


def test_what_the_provider_does_not_have_any_more_is_lost_once_it_may_be_heard() -> None:
    registrar = consumer("held")
    registrar.obey(c.Reconcile("p", [], "r"))
    (received,) = [effect for effect in registrar.effects if isinstance(effect, e.Receive)]
    assert hold_of(registrar) is Hold.HELD

    registrar.decide(received.message, received.sender)
    assert [effect.notice.state for effect in registrar.effects if isinstance(effect, e.Hear)] == [State.FATAL]

    registrar.obey(c.Heard("q", "r"))
    assert hold_of(registrar) is None
    assert registrar.changes == [Drop("held", "q")]


def received(registrar: Registrar) -> list[Noticed]:
    messages = [effect.message for effect in registrar.effects if isinstance(effect, e.Receive)]
    return [message for message in messages if isinstance(message, Noticed)]


def test_what_was_decided_over_a_link_that_is_lost_by_now_is_not_sent_over_the_next() -> None:
    registrar = consumer("pending")

    registrar.together(
        (c.LinkLost("p"), None),
        (c.Reconcile("p", [their(None)], "r2"), None),  # is still being loaded there: sent again
        (LoadRefused("q", FAILURE), "p"),
        (c.LinkLost("p"), None),
        (c.Reconcile("p", [], "r3"), None),
    )

    assert (hold_of(registrar), requests(registrar)) == (None, [])


@pytest.mark.parametrize("hold", ["pending", "held", "owed"])
def test_what_is_known_only_since_a_link_was_lost_has_it_made_anew(hold: str) -> None:
    """When it was lost nothing was known that would need it."""
    registrar = Registrar("app")
    registrar.obey(c.Reconcile("p", [], "r0"))
    ask_directly(registrar)
    known: dict[str, tuple[c.Command, ...]] = {"pending": (), "held": (GOT,), "owed": (GOT, c.Release("q"))}

    for command in known[hold]:
        registrar.obey(command)
    registrar.obey(c.LinkLost("p"))

    assert e.Connect("p") in registrar.effects


def test_who_waits_for_a_load_that_was_sent_waits_on_when_the_link_is_lost() -> None:
    """Whoever connects for a new request hears at once that the provider is stopped, and may be between two starts."""
    registrar = consumer("pending")
    registrar.obey(c.LinkLost("p"))
    assert registrar.effects == []


def losses(registrar: Registrar) -> list[tuple[str, bool]]:
    return [(message.notice.message, message.repeated) for message in received(registrar)]


def test_a_link_is_kept_for_the_notice_of_what_is_lost() -> None:
    registrar = consumer("held")
    registrar.obey(c.Reconcile("p", [], "r", notices=True))
    (lost,) = received(registrar)
    registrar.decide(lost, "")
    registrar.obey(c.Heard("q", "r"))

    assert hold_of(registrar) is None
    assert registrar.catalog.needs("p")  # its provider has the notice until it is acknowledged


def test_an_unload_tried_twice_whose_second_answer_was_lost_is_told_as_when_it_arrives() -> None:
    registrar = consumer("owed")
    registrar.decide(UnloadRefused("q", FAILURE), "p")
    registrar.decide(Unloaded("q"), "p")
    told = losses(registrar)

    registrar = consumer("owed")
    registrar.decide(UnloadRefused("q", FAILURE), "p")
    registrar.obey(c.LinkLost("p"))
    registrar.obey(c.Reconcile("p", [], "r"))

    assert losses(registrar) == told == [("unloaded after all", False)]


def test_what_was_still_there_when_a_new_link_came_was_not_unloaded_after_all() -> None:
    registrar = consumer("owed")
    registrar.decide(UnloadRefused("q", FAILURE), "p")
    registrar.obey(c.Reconcile("p", [their()], "r1"))

    registrar.obey(c.Reconcile("p", [], "r2"))

    assert losses(registrar) == [("'p' does not have it any more", False)]


@pytest.mark.parametrize("end", ["heard", "released", "given up"])
def test_that_an_unload_failed_is_forgotten_with_the_query(end: str) -> None:
    registrar = consumer("owed")
    registrar.decide(UnloadRefused("q", FAILURE), "p")
    assert registrar.catalog.kept == {"q": True}

    match end:
        case "heard":
            registrar.decide(Unloaded("q"), "p")
            (lost,) = received(registrar)
            registrar.decide(lost, "")
            registrar.obey(c.Heard("q", lost.notice.event))
        case "released":
            registrar.obey(c.Release("q"))
            registrar.decide(Unloaded("q"), "p")
        case _:
            registrar.obey(c.GiveUp("q", FAILURE, unheard=True))
            registrar.decide(Unloaded("q"), "p")

    assert (hold_of(registrar), registrar.catalog.kept) == (None, {})


def test_what_the_last_attempt_of_a_given_up_load_had_loaded_is_owed() -> None:
    registrar = Registrar("p", Server("cam"))
    registrar.decide(load())
    for _ in range(recovery.ATTEMPTS - 1):
        registrar = registrar.again(Server("cam"))
    registrar.obey(c.Reconcile("lens", [], "r"))
    registrar.ask("part", "lens", "zoom", b"", "q")
    (asked,) = requests(registrar)
    rows = [*registrar.catalog.resources.values(), *registrar.catalog.queries.values()]
    rows += [*registrar.catalog.peers.values()]  # the part's own row had not been written

    registrar = Registrar("p", rows=rows, epoch=registrar.catalog.epoch + 1)
    registrar.begin_again()
    refusals = registrar.replies
    registrar.together((c.Register(Server("cam"), "event"), None), (c.BeginServing("event"), None))
    assert registrar.started("unload") == ["q"]
    part = FetchedQuery("part", "zoom", "res", b"", b"x", "q", asked.attempt, asked.seq, "OK")
    registrar.obey(c.Reconcile("lens", [part], "r"))

    assert [type(refusal) for refusal in refusals] == [LoadRefused]
    assert requests(registrar) == [Unload("part", "p")]
    assert registrar.catalog.parts_of("q") == []


def test_a_notice_is_acknowledged_when_its_listeners_have_dealt_with_it_and_heard_once() -> None:
    noticed = Noticed(Notice("s:q", "q", "app", "res", "s", State.WARNING, "hot", "p/cam"))
    registrar = consumer("held")

    registrar.decide(noticed, "p")
    assert [type(effect) for effect in registrar.effects] == [e.Hear]

    registrar.decide(Noticed(noticed.notice, repeated=True), "p")
    assert registrar.effects == []

    registrar.obey(c.Heard("q", "s"))
    assert requests(registrar) == [NoticesHandled(["s:q"])]

    registrar.decide(Noticed(noticed.notice, repeated=True), "p")
    assert requests(registrar) == [NoticesHandled(["s:q"])]


def test_a_window_of_notices_is_on_its_way_and_others_follow_in_order_when_half_of_it_is_handled() -> None:
    registrar = provider("loaded")
    registrar.catalog.window = 4
    sent: list[str] = []
    behind: list[Any] = []
    for number in range(8):
        registrar.obey(c.SetStatus("q", f"s{number}", State.WARNING, "hot", number))
        sent += [noticed.notice.event for noticed in received_by_holders(registrar)]
        behind += [effect for effect in registrar.effects if isinstance(effect, e.FellBehind)]
    assert sent == ["s0", "s1", "s2", "s3"]
    assert behind == [e.FellBehind("app", "q", "q", 4)]

    registrar.decide(NoticesHandled(["s1:q"]))
    assert received_by_holders(registrar) == []
    registrar.decide(NoticesHandled(["s0:q"]))
    assert [noticed.notice.event for noticed in received_by_holders(registrar)] == ["s4", "s5"]

    registrar.obey(c.ConsumerLost("app"))
    registrar.decide(NoticesHandled(["s2:q"]))
    registrar.decide(Fetch("app", True))
    again = [(noticed.notice.event, noticed.repeated) for noticed in received_by_holders(registrar)]
    assert again == [("s3", True), ("s4", True), ("s5", True), ("s6", False)]
    registrar.decide(NoticesHandled(["s3:q", "s4:q", "s5:q"]))
    assert [noticed.notice.event for noticed in received_by_holders(registrar)] == ["s7"]
    assert registrar.catalog.behind == {}


def test_a_status_that_is_sent_again_has_the_newest_response() -> None:
    """Its holder may have had that already, and takes what comes."""
    registrar = provider("loaded")
    registrar.decide(Fetch("app", True))
    for number in range(2):
        registrar.obey(c.SetResponse("q", f"s{number}", b"%d" % number, "", None))
    assert [noticed.notice.response for noticed in received_by_holders(registrar)] == [b"1"]

    registrar.obey(c.ConsumerLost("app"))
    registrar.decide(Fetch("app", True))

    again = [(noticed.notice.response, noticed.repeated) for noticed in received_by_holders(registrar)]
    assert again == [(b"1", True), (b"1", True)]


def said_to(registrar: Any, states: str) -> list[Any]:
    """Say these one after another of resource q; return the effects that say what was dropped."""
    behind: list[Any] = []
    for number, letter in enumerate(states):
        if letter == "R":
            registrar.obey(c.SetResponse("q", f"s{number}", b"%d" % number, "", number))
        else:
            state = State.FATAL if letter == "F" else State.WARNING
            registrar.obey(c.SetStatus("q", f"s{number}", state, "hot", number))
        behind += [effect for effect in registrar.effects if isinstance(effect, e.FellBehind) and effect.dropped]
    return behind


@pytest.mark.parametrize(("linked", "left", "dropped"), [(True, "s0 s1 s3 s4 s5 s6", 1), (False, "s3 s4 s5 s6", 3)])
def test_of_a_query_with_too_many_notices_the_oldest_that_wait_go_but_no_fatal_and_not_the_last_response(
    linked: bool, left: str, dropped: int
) -> None:
    registrar = provider("loaded")
    registrar.catalog.window, registrar.catalog.backlog = 2, 6
    if not linked:
        registrar.obey(c.ConsumerLost("app"))
    behind = said_to(registrar, "WWRRFWW")
    assert " ".join(notice.event for notice in registrar.catalog.notices.values()) == left
    assert behind == [e.FellBehind("app", "q", "q", 0, dropped)]


def test_own_statuses_wait_for_a_status_callback_up_to_a_bound_also_while_the_resource_is_recovered() -> None:
    registrar = provider("loaded", has_status=True, has_recover=True)
    registrar = registrar.again(Server("cam", has_status=True, has_recover=True))
    registrar.catalog.window, registrar.catalog.backlog = 2, 4
    behind = said_to(registrar, "WWWFWWWWW")
    assert [start.notice.event for start in registrar.catalog.deferred["q"]] == ["s0", "s1"]
    assert [effect.dropped for effect in behind] == [1, 1, 1]
    registrar.obey(c.CallbackEnded("recover", "q", 1, event="r"))
    runs = [start.notice for start in registrar.starts("status")]
    for notice in runs:  # it grows
        registrar.obey(c.CallbackEnded("status", "q", notice=notice, handled=False))
        runs += [start.notice for start in registrar.starts("status")]
    assert [notice.event for notice in runs] == ["s0", "s1", "s3", "s6", "s7", "s8"]
    assert registrar.catalog.late == registrar.catalog.deferred == registrar.catalog.own_notices == {}


@pytest.mark.parametrize("again", [False, True])
def test_a_response_that_came_before_a_load_was_answered_is_of_the_resource_that_the_answer_names(again: bool) -> None:
    """The query was on another before. Its provider took that away, and was asked again before it could say so."""
    registrar = consumer("pending")
    registrar.decide(Noticed(Notice("s:q", "q", "app", "before", "s", State.UPDATE, "", "p/cam", False, b"late")), "p")
    if again:  # the new one says something, too
        registrar.decide(Noticed(Notice("t:q", "q", "app", "res", "t", State.WARNING, "hot", "p/cam")), "p")

    registrar.decide(Loaded("q", "res", b"feed"), "p")

    held = registrar.catalog.held["q"]
    assert (held.response, held.state) == (b"feed", State.WARNING if again else State.OK)


def test_a_status_that_a_part_brings_again_takes_no_second_place_in_the_window() -> None:
    registrar = Registrar("p", Server("cam"))
    registrar.catalog.window = 1
    registrar.obey(c.Reconcile("lens", [], "r"))
    registrar.decide(Fetch("app", True))
    registrar.decide(load())
    registrar.ask("part", "lens", "zoom", b"", "q")
    registrar.decide(Loaded("part", "res", b"x"), "lens")
    registrar.obey(c.CallbackEnded("load", "q", 1, response=b"feed"))
    registrar.obey(c.SetStatus("q", "s", State.WARNING, "hot", None))
    registrar.obey(c.SetStatus("q", "t", State.ERROR, "hotter", None))

    registrar.decide(
        Noticed(Notice("s:part", "part", "p", "res", "s", State.WARNING, "hot", "lens/zoom"), True), "lens"
    )
    registrar.decide(NoticesHandled(["s:q"]))

    assert [noticed.notice.event for noticed in received_by_holders(registrar)] == ["t"]


def received_by_holders(registrar: Registrar) -> list[Noticed]:
    return [reply for reply in registrar.replies if isinstance(reply, Noticed)]


def test_a_notice_for_a_query_that_is_not_held_again_whatever_happens_is_acknowledged() -> None:
    registrar = consumer("pending")
    registrar.obey(c.GiveUp("q", FAILURE))

    registrar.decide(Noticed(Notice("s:q", "q", "app", "res", "s", State.WARNING, "hot", "p/cam")), "p")
    assert requests(registrar) == [NoticesHandled(["s:q"])]


@pytest.mark.parametrize("listened", ["part", "lens/zoom", None])
@pytest.mark.parametrize("handled", [True, False])
def test_a_status_waits_for_who_listens_to_the_part_and_goes_up_if_they_have_not_dealt_with_it(
    listened: str | None, handled: bool
) -> None:
    registrar = Registrar("p", Server("cam"))
    registrar.obey(c.Reconcile("lens", [], "r"))
    registrar.decide(Fetch("app", True))
    registrar.decide(load())
    registrar.ask("part", "lens", "zoom", b"", "q")
    registrar.decide(Loaded("part", "res", b"x"), "lens")
    registrar.obey(c.CallbackEnded("load", "q", 1, response=b"feed"))
    if listened:
        registrar.catalog.listened.add(listened)
    notice = Notice("s:part", "part", "p", "res", "s", State.WARNING, "hot", "lens/zoom")

    registrar.decide(Noticed(notice), "lens")
    if listened is None:
        assert [reply.notice.query_id for reply in registrar.replies] == ["q"]
        assert registrar.started("status") == []
        return
    assert [type(effect) for effect in registrar.effects] == [e.Hear]

    registrar.obey(c.Heard("part", "s", handled))
    if handled:
        assert registrar.started("status") == []
    else:
        assert requests(registrar) == []
        assert registrar.started("status") == ["q"]
        registrar.obey(c.CallbackEnded("status", "q", notice=notice, handled=False))
    assert [reply.notice.query_id for reply in registrar.replies] == ([] if handled else ["q"])
    assert requests(registrar) == [NoticesHandled(["s:part"])]


# -- what the owner says: its server's status callback first ----------------------------------------------------------


def own(event: str = "s", state: State = State.WARNING, message: str = "hot", response: bytes | None = None) -> Notice:
    """The notice for the server of resource "q" itself."""
    return Notice(f"{event}:", "", "", "q", event, state, message, "p/cam", False, response)


def told(registrar: Registrar) -> list[tuple[str, State]]:
    """To whom what the registrar last did was told, and what."""
    replies = [reply for reply in registrar.replies if isinstance(reply, Noticed)]
    return [(reply.notice.query_id, reply.notice.state) for reply in replies]


@pytest.mark.parametrize("handled", [True, False])
def test_a_status_goes_to_the_status_callback_of_its_own_server_first_and_then_to_the_holders(handled: bool) -> None:
    registrar = provider("loaded", has_status=True)

    registrar.obey(c.SetStatus("q", "s", State.WARNING, "hot", "ticket"))
    assert registrar.effects[-2:] == [
        e.StartCallback("status", registrar.catalog.resources["q"], own()),
        e.AnswerCall("ticket", None),
    ]
    assert Put(own()) in registrar.changes
    assert told(registrar) == []
    assert registrar.catalog.resources["q"].state is State.WARNING

    registrar.obey(c.CallbackEnded("status", "q", notice=own(), handled=handled))
    assert told(registrar) == ([] if handled else [("q", State.WARNING)])
    assert Drop("notices", "s:") in registrar.changes
    assert registrar.catalog.own_notices == {}

    registrar.obey(c.CallbackEnded("status", "q", notice=own(), handled=False))
    assert registrar.effects == []


def test_what_a_status_callback_says_of_its_own_resource_goes_to_the_holders_at_once() -> None:
    registrar = provider("loaded", has_status=True)
    registrar.obey(c.SetStatus("q", "s", State.OK, "again", None, callback_of="q"))
    assert told(registrar) == [("q", State.OK)]
    assert registrar.started("status") == []
    registrar.obey(c.SetResponse("q", "r", b"new", "", None, callback_of="q"))
    assert told(registrar) == [("q", State.UPDATE)]
    registrar.obey(c.SetStatus("q", "t", State.OK, "", None, callback_of="another"))
    assert registrar.started("status") == ["q"]


def test_a_new_response_reaches_the_holders_whatever_the_status_callback_says_of_it() -> None:
    registrar = provider("loaded", has_status=True)
    registrar.obey(c.SetResponse("q", "r", b"new", "", None))
    registrar.obey(c.SetResponse("q", "later", b"newest", "", None, callback_of="q"))
    registrar.obey(c.CallbackEnded("status", "q", notice=own("r", State.UPDATE, "", b"new"), handled=True))
    (noticed,) = registrar.replies
    assert noticed.notice.response == b"newest"
    assert registrar.catalog.resources["q"].response == b"newest"


@pytest.mark.parametrize("phase", ["queued", "loading", "given up"])
def test_what_never_had_a_response_is_not_given_one_by_its_owner(phase: str) -> None:
    registrar = provider("loading" if phase == "given up" else phase)
    if phase == "given up":
        for _ in range(recovery.ATTEMPTS - 1):
            registrar = registrar.again(Server("cam"))
        registrar = registrar.again()
        assert registrar.phase() is Phase.UNLOADING

    (answer,) = registrar.obey(c.SetResponse("q", "r", b"new", "", "ticket"))

    assert answer.failure.kind == "UsageError"
    assert "has not returned a response" in answer.failure.message
    registrar.obey(c.Register(Server("cam"), "event"))
    assert registrar.catalog.resources["q"].response is None  # its unload callback knows by this that it cleans up


@pytest.mark.parametrize("phase", ["loaded", "loading", "queued"])
def test_after_a_crash_a_status_callback_that_had_not_run_to_its_end_runs_again(phase: str) -> None:
    registrar = provider(phase, has_status=True)
    registrar.obey(c.SetStatus("q", "s", State.WARNING, "hot", None))
    assert registrar.started("status") == (["q"] if phase == "loaded" else [])

    again = registrar.again(Server("cam", has_status=True))

    if phase == "loaded":
        (start,) = again.starts("status")
        assert (start.notice, start.repeated) == (own(), True)
    else:
        assert again.started("status") == []
        assert list(again.catalog.deferred) == ["q"]


@pytest.mark.parametrize("crash", [False, True])
def test_a_window_of_own_statuses_is_given_to_the_status_callback_and_the_next_follow_in_order(
    crash: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Catalog, "window", 4)
    registrar = provider("loaded", has_status=True)

    def started() -> list[Notice]:
        return [start.notice for start in registrar.starts("status")]

    runs: list[Notice] = []
    for number in range(9):
        registrar.obey(c.SetStatus("q", f"s{number}", State.WARNING, "hot", None))
        runs += started()
    assert [notice.event for notice in runs] == ["s0", "s1", "s2", "s3"]
    if crash:
        registrar = registrar.again(Server("cam", has_status=True))
        runs = started()
        assert [notice.event for notice in runs] == ["s0", "s1", "s2", "s3"]
    for done in range(9):
        assert len(runs) - done <= 4
        registrar.obey(c.CallbackEnded("status", "q", notice=runs[done], handled=False))
        runs += started()
    assert [notice.event for notice in runs] == [f"s{number}" for number in range(9)]
    assert registrar.catalog.late == registrar.catalog.statuses == registrar.catalog.own_notices == {}


@pytest.mark.parametrize("crash", [False, True])
def test_a_status_callback_that_runs_while_its_server_is_registered_anew_is_not_run_once_more(crash: bool) -> None:
    registrar = provider("loaded", has_status=True)
    registrar.obey(c.SetStatus("q", "s", State.WARNING, "hot", None))
    if crash:
        registrar = registrar.again(Server("cam", has_status=True))
    assert registrar.started("status") == ["q"]
    registrar.obey(c.Unregister("cam", "event", None))
    registrar.obey(c.CallbackEnded("unload", "q", registrar.catalog.resources["q"].tries, FAILURE))
    assert "cam" not in registrar.catalog.servers

    registrar.obey(c.Register(Server("cam", has_status=True), "event"))
    assert registrar.started("status") == []
    assert list(registrar.catalog.own_notices) == ["q"]
    registrar.obey(c.CallbackEnded("status", "q", notice=own(), handled=False))
    assert registrar.catalog.own_notices == {}


@pytest.mark.parametrize("fails", [False, True])
def test_who_releases_a_resource_whose_server_is_missing_hears_how_the_unload_ends_later(fails: bool) -> None:
    registrar = provider("loaded").again()
    registrar.decide(Fetch("app", True))
    registrar.decide(Unload("q", "app"))
    assert [(type(reply), reply.failure.kind) for reply in registrar.replies] == [(UnloadRefused, "Unavailable")]

    registrar.obey(c.Register(Server("cam"), "event"))
    tries = registrar.catalog.resources["q"].tries
    registrar.obey(c.CallbackEnded("unload", "q", tries, FAILURE) if fails else c.CallbackEnded("unload", "q", tries))
    assert registrar.replies == [UnloadRefused("q", FAILURE) if fails else Unloaded("q")]
    assert registrar.catalog.unanswered == {}


def test_what_a_holder_passed_over_does_not_wait_before_the_word_that_its_query_was_taken_away() -> None:
    registrar = provider("loaded").again()
    registrar.decide(Fetch("app", True))
    registrar.decide(Unload("q", "app"))  # there is no server: the release stays owed, and its holder passes over
    registrar.obey(c.SetStatus("q", "lost", State.FATAL, "", None))
    assert [notice.event for notice in registrar.catalog.notices.values()] == ["lost"]

    registrar.obey(c.Unregister("cam", "cleared", None))
    assert [(notice.event, notice.released) for notice in registrar.catalog.notices.values()] == [("cleared", True)]
    assert registrar.phase() is None


@pytest.mark.parametrize("phase", ["queued", "loading", "loaded", "unloading", "unload_failed", "fatal", "recovering"])
def test_what_a_server_has_not_heard_goes_with_its_resource(phase: str) -> None:
    registrar = provider(phase, has_status=True)
    if phase == "fatal":
        registrar.obey(c.CallbackEnded("status", "q", notice=own("e", State.FATAL, ""), handled=False))
    registrar.obey(c.SetStatus("q", "s", State.WARNING, "hot", None))
    assert list(registrar.catalog.own_notices) == ["q"]
    registrar.obey(c.ForceUnload("q", "f", None))
    for _ in range(3):  # what runs comes to its end
        resource = registrar.catalog.resources.get("q")
        if resource is not None:
            registrar.obey(c.CallbackEnded("recover", "q", resource.attempt, event="r"))
            registrar.obey(c.CallbackEnded("load", "q", resource.attempt, response=b"feed"))
            registrar.obey(c.CallbackEnded("unload", "q", registrar.catalog.resources["q"].tries))
    assert registrar.phase() is None
    assert registrar.catalog.own_notices == {}
    assert registrar.catalog.deferred == {}


# -- what is said to a resource whose load has not returned ----------------------------------------------------------


def whole(*, has_status: bool = True, phase: str = "loading") -> Registrar:
    """Resource "q", which has loaded "part" of lens/zoom, and is loading still, or is asked after."""
    registrar = provider(phase, has_status=has_status)
    registrar.obey(c.Reconcile("lens", [], "r"))
    registrar.ask("part", "lens", "zoom", b"", "q")
    registrar.decide(Loaded("part", "res", b"x"), "lens")
    return registrar


def of_part(event: str = "s", state: State = State.WARNING) -> Noticed:
    return Noticed(Notice(f"{event}:part", "part", "p", "res", event, state, "hot", "lens/zoom"))


@pytest.mark.parametrize("has_status", [True, False])
@pytest.mark.parametrize("phase", ["loading", "recovering"])
def test_what_a_part_says_waits_until_the_load_or_recover_callback_has_returned(phase: str, has_status: bool) -> None:
    registrar = whole(has_status=has_status, phase=phase)
    registrar.decide(of_part(), "lens")
    registrar.decide(of_part("later"), "lens")
    assert [type(effect) for effect in registrar.effects] == [e.Hear]
    registrar.obey(c.Heard("part", "s"))
    registrar.obey(c.Heard("part", "later"))
    assert (requests(registrar), told(registrar)) == ([], [])

    attempt = registrar.catalog.resources["q"].attempt
    registrar.obey(
        c.CallbackEnded("load", "q", attempt, response=b"feed")
        if phase == "loading"
        else c.CallbackEnded("recover", "q", attempt, event="r")
    )

    started = [start.notice.event for start in registrar.starts("status")]
    assert started == ["s", "later"]
    registrar.obey(c.CallbackEnded("status", "q", notice=of_part().notice, handled=False))
    assert told(registrar) == [("q", State.WARNING)]
    assert requests(registrar) == [NoticesHandled(["s:part"])]


def test_who_listens_to_a_part_hears_at_once_and_may_deal_with_it_for_the_resource_that_is_loading() -> None:
    registrar = whole()
    registrar.catalog.listened.add("part")
    registrar.decide(of_part(), "lens")
    assert [type(effect) for effect in registrar.effects] == [e.Hear]
    registrar.obey(c.Heard("part", "s", handled=True))
    assert requests(registrar) == [NoticesHandled(["s:part"])]
    registrar.obey(c.CallbackEnded("load", "q", 1, response=b"feed"))
    assert registrar.started("status") == []


def test_what_a_part_has_said_to_a_load_that_fails_is_acknowledged() -> None:
    registrar = whole()
    registrar.decide(of_part(), "lens")
    registrar.obey(c.Heard("part", "s"))
    registrar.obey(c.SetStatus("q", "own", State.WARNING, "hot", None))
    registrar.obey(c.CallbackEnded("load", "q", 1, FAILURE))
    assert NoticesHandled(["s:part"]) in requests(registrar)
    assert registrar.catalog.hearing == registrar.catalog.deferred == registrar.catalog.own_notices == {}


def test_a_part_that_is_taken_away_while_the_whole_loads_is_dropped_when_the_whole_has_heard_it() -> None:
    registrar = whole()
    gone = of_part(state=State.FATAL)
    gone = Noticed(msgspec.structs.replace(gone.notice, released=True))
    registrar.decide(gone, "lens")
    registrar.obey(c.Heard("part", "s"))
    assert "part" in registrar.catalog.held
    registrar.obey(c.CallbackEnded("load", "q", 1, response=b"feed"))
    registrar.obey(c.CallbackEnded("status", "q", notice=gone.notice, handled=True))
    assert "part" not in registrar.catalog.held
    assert requests(registrar) == [NoticesHandled(["s:part"])]


# -- an interrupted load that nobody wants any more --------------------------------------------------------------------


@pytest.mark.parametrize("when", ["before the crash", "before its server is there"])
def test_an_interrupted_load_that_was_withdrawn_is_cleaned_up_and_not_run_again(when: str) -> None:
    registrar = provider("loading")
    if when == "before the crash":
        registrar.decide(Unload("q", "app"))
        registrar = registrar.again()
    else:
        registrar = registrar.again()
        registrar.decide(Unload("q", "app"))

    registrar.obey(c.Register(Server("cam"), "event"))

    (start,) = [effect for effect in registrar.effects if isinstance(effect, e.StartCallback)]
    assert start.role == "unload"
    assert (start.resource.response, start.resource.attempt, start.resource.tries) == (None, 2, 1)
    registrar.decide(load("new", "other"), "other")
    assert registrar.phase("new.2") is Phase.QUEUED
    registrar.obey(c.CallbackEnded("unload", "q", 1))
    assert registrar.started("load") == ["new.2"]


def test_an_interrupted_load_that_somebody_holds_is_run_again_once() -> None:
    registrar = provider("loading").again(Server("cam"))
    assert registrar.started("load") == ["q"]
    assert registrar.catalog.resources["q"].attempt == 2

    registrar.decide(load(), "app")
    registrar.decide(load("s", "other"), "other")
    assert registrar.started("load") == []


def test_a_crash_before_an_interrupted_load_has_begun_again_is_not_an_attempt() -> None:
    registrar = provider("loading")
    for _ in range(4):
        registrar = registrar.again()
    assert (registrar.phase(), registrar.catalog.resources["q"].attempt) == (Phase.LOADING, 2)
    registrar = registrar.again(Server("cam"))
    assert registrar.catalog.resources["q"].attempt == 2
    registrar = registrar.again(Server("cam"))
    assert registrar.catalog.resources["q"].attempt == 3
    assert registrar.again().phase() is Phase.UNLOADING


@pytest.mark.parametrize("how", ["withdrawn", "gone", "forced"])
def test_an_interrupted_load_whose_last_holder_goes_before_its_server_is_there_is_cleaned_up(how: str) -> None:
    registrar = provider("loading").again()
    match how:
        case "withdrawn":
            registrar.decide(Unload("q", "app"))
        case "gone":
            registrar.decide(Gone("app"))
        case _:
            registrar.obey(c.ForceUnload("q", "f", "ticket"))
    registrar.obey(c.Register(Server("cam"), "event"))
    assert registrar.started("unload") == ["q"]
    assert registrar.catalog.resources["q"].response is None
    registrar.obey(c.CallbackEnded("unload", "q", 1))
    assert registrar.catalog.resources == {}
    answers = [effect for effect in registrar.effects if isinstance(effect, e.AnswerCall)]
    assert len(answers) == (1 if how == "forced" else 0)


def test_what_was_heard_of_what_is_gone_and_refused_is_remembered_within_bounds() -> None:
    registrar = Registrar("app", Server("cam"))
    registrar.obey(c.Reconcile("p", [], "r0"))
    for number in range(5000):
        id = f"q{number}"
        registrar.ask(id, "p", "cam", b"front", "")
        registrar.decide(Loaded(id, "res", b"feed"), "p")
        notice = Notice(f"s:{id}", id, "app", "res", f"s{number}", State.WARNING, "hot", "p/cam")
        registrar.decide(Noticed(notice), "p")
        registrar.obey(c.Heard(id, f"s{number}"))
        registrar.obey(c.Release(id))
        registrar.decide(Unloaded(id), "p")
        registrar.decide(Unload(f"{id}'s", "other"), "other")  # its Load may still come

    assert len(registrar.catalog.heard) <= 1024
    assert len(registrar.catalog.refused) <= 4096


def test_a_deleted_provider_keeps_what_it_has_said_of_a_query_that_is_still_held() -> None:
    """Its holder may not find it gone, as it is started again soon; and its unload callback may fail then."""
    owner = provider("loaded")
    owner.obey(c.SetStatus("q", "f", State.FATAL, "", None))
    content = owner.catalog.tables
    apply(content, owing(content, 2))

    apply(content, forgetting(content, "p", ()))

    (notice,) = content["notices"].values()
    assert (notice.query_id, notice.state) == ("q", State.FATAL)


def test_a_notice_of_what_a_list_has_shown_to_be_lost_stays_at_its_provider_until_the_row_is_gone() -> None:
    owner = provider("loaded")
    owner.obey(c.ForceUnload("q", "f", None))
    (noticed,) = owner.replies
    registrar = consumer("held")
    registrar.obey(c.Reconcile("p", [], "r1"))
    (received,) = [effect for effect in registrar.effects if isinstance(effect, e.Receive)]
    registrar.decide(received.message, received.sender)
    noticed = msgspec.structs.replace(noticed, notice=msgspec.structs.replace(noticed.notice, resource_id="res"))

    assert registrar.decide(noticed, "p") == []
    (unload,) = [effect.message for effect in registrar.obey(c.Heard("q", "r1")) if isinstance(effect, e.SendRequest)]

    assert registrar.changes == [Drop("held", "q")]
    owner.decide(unload)
    assert not owner.catalog.notices


@pytest.mark.parametrize("hold", ["held", "owed"])
@pytest.mark.parametrize("released", [False, True])
def test_a_notice_of_what_the_same_load_got_before_is_not_about_what_is_held(hold: str, released: bool) -> None:
    registrar = consumer(hold)
    before = registrar.catalog.held["q"]
    notice = Notice("s:q", "q", "app", "another", "s", State.FATAL, "gone", "p/cam", released)

    registrar.decide(Noticed(notice), "p")

    assert registrar.catalog.held["q"] == before
    assert registrar.effects == [e.SendRequest("p", NoticesHandled(["s:q"]))]


def test_who_waits_for_a_load_that_was_taken_away_unanswered_is_told_when_its_line_has_broken() -> None:
    owner = provider("loaded")
    owner.obey(c.ForceUnload("q", "f", None))
    (noticed,) = owner.replies
    registrar = Registrar("app")
    registrar.obey(c.Reconcile("p", [], "r0"))
    ask_directly(registrar)
    registrar.decide(noticed, "p")
    registrar.obey(c.SendAgain("q"))

    registrar.obey(c.Heard("q", "f"))

    (told,) = [effect.failure for effect in registrar.effects if isinstance(effect, e.LoadResolved)]
    assert told is not None
    assert "taken away" in told.message
    assert hold_of(registrar) is None
    assert registrar.decide(LoadRefused("q", FAILURE), "p") == []


@pytest.mark.parametrize("ended", ["let go", "taken away"])
def test_the_late_answer_of_a_callers_own_line_brings_nothing_back(ended: str) -> None:
    owner = provider("loaded")
    owner.obey(c.ForceUnload("q", "f", None))
    (noticed,) = owner.replies
    registrar = Registrar("app")
    registrar.obey(c.Reconcile("p", [], "r0"))
    ask_directly(registrar)
    resource_id = noticed.notice.resource_id
    registrar.decide(Loaded("q", resource_id, b"feed"), "p")  # asked for by the link, too
    assert hold_of(registrar) is Hold.HELD
    if ended == "let go":
        registrar.obey(c.Release("q"))
        registrar.decide(Unloaded("q"), "p")
    else:
        registrar.decide(noticed, "p")
        registrar.obey(c.Heard("q", "f"))
    assert hold_of(registrar) is None

    registrar.obey(c.Got("q", resource_id, b"feed"))

    assert hold_of(registrar) is None
    assert registrar.catalog.direct == {}


def test_what_a_load_gets_that_was_sent_again_after_its_line_had_answered_is_let_go_with_what_it_had_got() -> None:
    """The provider fell behind its answer, took the first away, and its list did not have it any more."""
    registrar = Registrar("app")
    ask_directly(registrar)
    registrar.obey(c.Reconcile("p", [], "r1"))
    assert [type(message) for message in requests(registrar)] == [Load]
    registrar.obey(c.Got("q", "first", b"feed"))
    registrar.decide(Noticed(Notice("f:q", "q", "app", "first", "f", State.FATAL, "gone", "p/cam", True), True), "p")
    assert hold_of(registrar) is Hold.HELD  # its holder is being told

    registrar.decide(Loaded("q", "first", b"feed"), "p")
    assert registrar.effects == []
    registrar.decide(Loaded("q", "second", b"feed"), "p")
    assert requests(registrar) == [Unload("q", "app")]
    registrar.decide(Unloaded("q"), "p")
    assert registrar.effects == []
    registrar.obey(c.Heard("q", "f"))
    assert hold_of(registrar) is None


def test_a_load_that_waits_for_itself_is_found_by_a_probe() -> None:
    registrar = Registrar("p", Server("cam"))
    registrar.obey(c.Reconcile("p", [], "r"))
    registrar.decide(load("q"))
    registrar.ask("part", "p", "cam", b"front", "q")
    (asked,) = requests(registrar)

    registrar.decide(asked, "p")

    (ended,) = [effect for effect in registrar.effects if isinstance(effect, e.LoadResolved)]
    assert ended.failure is not None
    assert (ended.failure.kind, ended.failure.details["ring"]) == ("CircularDependency", ["p/cam"])
    assert registrar.decide(Probe("unknown", "q", "part", []), "p") == []


def test_an_unknown_message_is_loud() -> None:
    registrar = Registrar()
    with pytest.raises(TypeError, match="not a message for a registrar"):
        registrar.decide(Fetched([]))
    with pytest.raises(TypeError, match="not a command for a registrar"):
        registrar.obey("what?")


# -- a spare in the place of a part --------------------------------------------------------------------------------


SWAP = c.Swap("q", "part", "spare", ("older",), "e", b"new", "why", "ticket")


def with_spares() -> Registrar:
    """Resource "q" of app, which holds "part", and "older" and "spare" in its place."""
    registrar = provider("loaded", has_status=True)
    registrar.obey(c.Reconcile("lens", [], "r"))
    for id in ("part", "older", "spare"):
        registrar.ask(id, "lens", "zoom", b"", "q")
        registrar.decide(Loaded(id, "res " + id, b"x"), "lens")
    return registrar


def test_a_swap_is_one_commit_and_the_holders_hear_the_new_response_from_it() -> None:
    registrar = with_spares()

    registrar.obey(SWAP)

    rows: list[Any] = [change.row for change in registrar.changes if isinstance(change, Put)]
    holds = [("spare", Hold.HELD), ("part", Hold.OWED), ("older", Hold.OWED)]
    assert [(row.id, row.hold) for row in rows if isinstance(row, Held)] == holds
    assert [row.response for row in rows if row.id == "q"] == [b"new"]
    assert registrar.catalog.parts_of("q") == ["spare"]
    assert requests(registrar) == [Unload("part", "p"), Unload("older", "p")]
    assert told(registrar) == [("q", State.UPDATE)]
    assert registrar.started("status") == []  # it is the callback that says so
    assert registrar.effects[-1] == e.AnswerCall("ticket", None)


def called_lost() -> Registrar:
    registrar = with_spares()
    registrar.obey(c.SetStatus("q", "lost", State.FATAL, "silent", None))
    return registrar


def own_fatal(registrar: Registrar) -> Notice:
    (notice,) = [start.notice for start in registrar.starts("status")]
    return notice


def test_a_resource_whose_part_is_swapped_while_its_callback_hears_its_fatal_is_given_to_others_again() -> None:
    registrar = called_lost()
    notice = own_fatal(registrar)
    assert registrar.catalog.joinable("cam", b"front") is None
    registrar.obey(SWAP)
    registrar.obey(c.CallbackEnded("status", "q", notice=notice, handled=True))
    assert registrar.catalog.resources["q"].state is State.UPDATE
    assert registrar.catalog.joinable("cam", b"front") == "q"
    assert told(registrar) == []


def test_a_fatal_that_its_callback_does_not_handle_after_a_swap_is_final() -> None:
    registrar = called_lost()
    notice = own_fatal(registrar)
    registrar.obey(SWAP)
    registrar.obey(c.CallbackEnded("status", "q", notice=notice, handled=False))
    assert registrar.catalog.resources["q"].state is State.FATAL
    assert told(registrar) == [("q", State.FATAL)]


def test_a_resource_whose_holders_have_heard_fatal_stays_fatal_when_its_part_is_swapped() -> None:
    registrar = called_lost()
    registrar.obey(c.CallbackEnded("status", "q", notice=own_fatal(registrar), handled=False))
    registrar.obey(SWAP)
    assert registrar.catalog.resources["q"].state is State.FATAL


def test_a_swap_without_a_response_is_heard_by_nobody() -> None:
    registrar = with_spares()
    registrar.obey(msgspec.structs.replace(SWAP, response=None))
    assert told(registrar) == []
    assert registrar.catalog.resources["q"].response == b"feed"
    assert registrar.catalog.parts_of("q") == ["spare"]


def test_a_part_that_was_swapped_does_not_come_back_when_its_unload_callback_raises() -> None:
    registrar = with_spares()
    registrar.obey(SWAP)
    registrar.decide(UnloadRefused("part", FAILURE), "lens")
    assert registrar.catalog.held["part"].hold is Hold.OWED
    assert registrar.catalog.parts_of("q") == ["spare"]


def test_what_is_said_of_a_part_that_was_swapped_concerns_nobody() -> None:
    registrar = with_spares()
    registrar.obey(SWAP)
    registrar.decide(Noticed(Notice("n", "part", "p", "res part", "f", State.FATAL, "", "lens/zoom"), True), "lens")
    assert [effect for effect in registrar.effects if isinstance(effect, (e.Hear, e.StartCallback))] == []


@pytest.mark.parametrize("gone", ["part", "spare", "q"])
def test_a_swap_of_what_is_there_no_more_leaves_no_spare(gone: str) -> None:
    registrar = with_spares()
    registrar.decide(Unload("q", "app")) if gone == "q" else registrar.obey(c.Release(gone))

    registrar.obey(SWAP)

    (answer,) = [effect for effect in registrar.effects if isinstance(effect, e.AnswerCall)]
    assert answer.failure is not None
    assert answer.failure.kind == "UnknownQuery"
    assert registrar.catalog.held["spare"].hold is Hold.OWED
    assert told(registrar) == []


@pytest.mark.parametrize(("now", "fails"), [("held", False), ("owed", True)])
def test_a_part_that_is_asked_for_again_is_the_same_query(now: str, fails: bool) -> None:
    registrar = with_spares()
    if now == "owed":
        registrar.obey(c.Release("spare"))
    before = registrar.catalog.held["spare"]

    registrar.ask("spare", "lens", "zoom", b"", "q")

    (resolved,) = [effect for effect in registrar.effects if isinstance(effect, e.LoadResolved)]
    assert (resolved.failure is not None) == fails
    assert registrar.catalog.held["spare"] == before


def test_after_a_crash_the_provider_answers_a_spare_that_is_asked_for_again_with_the_one_it_has() -> None:
    lens = Registrar("lens", Server("zoom"))
    ask = Load("spare", "zoom", b"", "p", "q", 1, 1)
    lens.decide(ask, "p")
    lens.obey(c.CallbackEnded("load", "spare", 1, response=b"x"))
    lens.decide(msgspec.structs.replace(ask, seq=99), "p")
    assert lens.replies == [Loaded("spare", "spare", b"x")]
    assert list(lens.catalog.queries) == ["spare"]


# -- parts that a callback's thread has asked for ------------------------------------------------------------------


def building() -> Registrar:
    """The callback of resource "r" runs, and its thread has asked for the part "q" by a connection of its own."""
    registrar = Registrar("app", Server("robot"), rows=[Peer("p")])
    registrar.obey(c.Reconcile("p", [], "r0"))
    registrar.decide(Load("r", "robot", b"", "other", "", 0, 1))
    registrar.catalog.in_flight["q"] = holding.pending(c.AskProvider("q", "p", "cam", b"front", "r", (1 << 32) + 7), 1)
    return registrar


def test_a_part_that_a_thread_holds_by_the_fast_path_is_the_part_that_is_decided() -> None:
    fast, general = building(), building()
    unsaved = Unsaved()
    assert holding.hold(fast.catalog, unsaved, GOT)
    general.obey(GOT)
    assert everything(fast) == everything(general)
    assert fast.catalog.parts_of("r") == ["q"]
    assert unsaved.changes() == [Put(general.catalog.held["q"])]


def test_a_callback_that_raises_withdraws_what_is_in_flight_and_its_late_answer_brings_nothing_back() -> None:
    registrar = building()
    registrar.obey(c.CallbackEnded("load", "r", 1, FAILURE))
    assert registrar.catalog.in_flight == {}
    assert hold_of(registrar) is Hold.OWED
    assert Put(registrar.catalog.held["q"]) in registrar.changes
    (told,) = [effect.failure for effect in registrar.effects if isinstance(effect, e.LoadResolved)]
    assert told is not None
    assert requests(registrar) == [Unload("q", "app")]
    assert registrar.catalog.direct == {}

    assert not holding.hold(registrar.catalog, Unsaved(), GOT)
    registrar.obey(GOT)
    assert hold_of(registrar) is Hold.OWED
    registrar.decide(Unloaded("q"), "p")
    assert hold_of(registrar) is None
    assert registrar.catalog.direct == {}


def test_a_probe_goes_on_along_what_is_in_flight() -> None:
    registrar = building()
    registrar.decide(Probe("r", "theirs", "q newer", ["p/cam"]), "p")
    assert requests(registrar) == [Probe("q", "theirs", "q newer", ["p/cam", "app/robot"])]
    assert hold_of(registrar) is Hold.PENDING


def test_a_probe_goes_on_for_a_newer_load_so_that_all_probes_of_a_ring_end_the_same_one() -> None:
    registrar = building()
    registrar.decide(Probe("r", "theirs", "older", ["p/cam"]), "p")
    assert requests(registrar) == [Probe("q", "r", "q", [])]
    assert hold_of(registrar) is Hold.PENDING


def test_a_probe_that_comes_back_ends_the_load_in_flight_that_closes_the_ring() -> None:
    registrar = building()
    registrar.decide(Probe("r", "r", "q", ["p/cam"]), "p")
    (told,) = [effect.failure for effect in registrar.effects if isinstance(effect, e.LoadResolved)]
    assert told is not None
    assert told.kind == "CircularDependency"
    assert hold_of(registrar) is Hold.OWED
    assert registrar.catalog.direct == {}


# -- what simulated worlds found once in tens of thousands -----------------------------------------------------------


def test_a_refusal_of_a_query_that_is_being_released_has_a_lost_link_opened_again() -> None:
    registrar = consumer("owed")
    registrar.decide(LoadRefused("q", FAILURE), "p")
    assert hold_of(registrar) is None

    registrar.obey(c.LinkLost("p"))
    assert registrar.catalog.needs("p")  # its notice may have been behind the refusal


def test_an_answer_of_a_run_whose_catalog_was_deleted_does_not_end_a_load_that_the_link_asks_for_again() -> None:
    registrar = Registrar("app")
    registrar.obey(c.Reconcile("p", [], "r0", run=1))
    ask_directly(registrar)
    registrar.obey(c.LinkLost("p"))
    registrar.obey(c.Reconcile("p", [], "r1", link=2, run=2))
    assert [type(message) for message in requests(registrar)] == [Load]

    assert registrar.obey(c.Got("q", "old", b"old", run=1)) == []
    registrar.decide(Loaded("q", "new", b"new"), "p")
    assert registrar.catalog.held["q"].resource_id == "new"
    assert [effect.failure for effect in registrar.effects if isinstance(effect, e.LoadResolved)] == [None]


def test_a_priority_that_is_set_after_its_provider_has_ended_for_good_is_forgotten_with_the_query() -> None:
    registrar = consumer("held")
    registrar.obey(c.LinkLost("p"))
    lost = registrar.together((c.PeerGone("p", FAILURE, True, "gone", True), None), (c.SetPriority("q", 9, 1), None))
    (notice,) = [effect.message for effect in lost if isinstance(effect, e.Receive)]
    registrar.decide(notice, "")
    registrar.obey(c.Heard("q", "gone", handled=False))
    assert hold_of(registrar) is None
    assert registrar.catalog.unsent == {}


def test_a_resource_that_could_not_be_unloaded_wants_the_same_of_its_parts_without_its_server_and_with_it() -> None:
    cam = Server("cam", pauses=True)
    registrar = provider("loaded", pauses=True)
    registrar.obey(c.Unregister("cam", "event", 1))
    registrar.obey(c.CallbackEnded("unload", "q", 1, FAILURE))
    assert registrar.phase() is Phase.UNLOAD_FAILED
    without = registrar.catalog.inherited("q")
    registrar.obey(c.Register(cam, "event"))
    assert registrar.catalog.inherited("q") == without
