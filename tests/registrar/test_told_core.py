"""What a callback's own thread may tell, and what a direct line may ask before notes are taken up, as tables."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rr_actors.registrar.core import loading, unloading
from rr_actors.registrar.core.callback_runs import only_waiter
from rr_actors.registrar.core.decide import decide, obey, told_directly
from rr_actors.registrar.model import commands as c
from rr_actors.registrar.model import effects as e
from rr_actors.registrar.model.catalog import Catalog, Server
from rr_actors.registrar.model.messages import Failure, Fetch, Load, Loaded, Unload, Unloaded
from rr_actors.registrar.model.rows import (
    TABLE_OF,
    Change,
    Drop,
    Held,
    Hold,
    Notice,
    Phase,
    Put,
    Query,
    Resource,
    State,
)
from rr_actors.registrar.model.transaction import Batch

FAILURE = Failure("UnloadFailed", "busy")
LOADED = c.LoadDone("q", 1, b"feed", told=True)
GONE = c.UnloadDone("q", 1, told=True)
_replace = msgspec.structs.replace


def says(catalog: Catalog, *items: Any) -> Batch:
    """The batch of these messages and commands."""
    batch = Batch(catalog)
    for item in items:
        if isinstance(item, (Load, Unload, Fetch)):
            decide(batch, item, "app")
        else:
            obey(batch, item, "event")
    return batch


def ask(id: str = "q", request: bytes = b"front", **more: Any) -> Load:
    return _replace(Load(id, "cam", request, "app", "", 0, 1), **more)


def loading_one(**server: Any) -> Catalog:
    """Query "q" of app waits for resource "q"."""
    catalog = Catalog("p")
    says(catalog, c.Register(Server("cam", **server)), Fetch("app", True), ask())
    return catalog


def loaded_one() -> Catalog:
    catalog = loading_one()
    says(catalog, c.LoadDone("q", 1, b"feed"))
    return catalog


def unloading_one() -> Catalog:
    """App has let go of "q", and waits."""
    catalog = loaded_one()
    says(catalog, Unload("q", "app"))
    return catalog


def picture(catalog: Catalog) -> dict[str, Any]:
    """Everything a catalog knows, as it is now."""
    return {
        name: {key: dict(v) if isinstance(v, dict) else v for key, v in value.items()}
        if isinstance(value, dict)
        else value
        for name, value in vars(catalog).items()
        if name != "_index"
    }


# -- a load that is done ---------------------------------------------------------------------------------------------


def test_of_a_load_that_one_query_waits_for_the_thread_writes_the_row_and_answers() -> None:
    catalog = loading_one()
    before = picture(catalog)
    told = loading.loaded_directly(catalog, LOADED)
    assert told is not None
    (change,) = told.changes
    assert isinstance(change, Put)
    assert change.row == _replace(catalog.resources["q"], phase=Phase.LOADED, response=b"feed")
    assert told.answer == Loaded("q", "q", b"feed")
    assert told_directly(catalog, LOADED) == told
    assert picture(catalog) == before


def another_holder(catalog: Catalog) -> None:
    catalog.set("queries", "other", Query("other", "q", "b", "", 0, 2))
    catalog.waiting["other"] = "q"


def no_holder(catalog: Catalog) -> None:
    catalog.set("queries", "q", None)


def parts(catalog: Catalog) -> None:
    catalog.set("held", "part", Held("part", "other", "thing", b"", b"", "part", "q", 1, 1, Hold.HELD, State.OK))


def an_owner(catalog: Catalog) -> None:
    catalog.owners["q"] = ("ticket",)


def being_recovered(catalog: Catalog) -> None:
    catalog.recovering["q"] = ()


def noticed(catalog: Catalog) -> None:
    catalog.set("notices", "n", Notice("n", "q", "app", "q", "e", State.WARNING, "hot", "q"))


def nobody_asked_in_this_incarnation(catalog: Catalog) -> None:
    catalog.waiting.clear()
    catalog.letting.clear()


def unknown(catalog: Catalog) -> None:
    catalog.set("queries", "q", None)
    catalog.set("resources", "q", None)


def the_same_again(catalog: Catalog) -> None:
    for number in ("attempt", "tries"):
        row = catalog.resources["q"]
        catalog.set("resources", "q", _replace(row, **{number: getattr(row, number) + 1}))


def in_another_phase(phase: Phase) -> Callable[[Catalog], None]:
    def change(catalog: Catalog) -> None:
        catalog.set("resources", "q", _replace(catalog.resources["q"], phase=phase))

    change.__name__ = phase.value
    return change


MORE_FOLLOWS = [
    *(another_holder, no_holder, parts, an_owner, being_recovered, noticed, nobody_asked_in_this_incarnation),
    *(unknown, the_same_again),
]


@pytest.mark.parametrize(
    "also", [*MORE_FOLLOWS, *map(in_another_phase, (Phase.QUEUED, Phase.LOADED, Phase.UNLOADING, Phase.UNLOAD_FAILED))]
)
def test_a_load_from_whose_end_more_follows_is_not_told_by_its_thread(also: Callable[[Catalog], None]) -> None:
    catalog = loading_one()
    also(catalog)
    assert loading.loaded_directly(catalog, LOADED) is None


@pytest.mark.parametrize(
    ("also", "waiting", "waiter"),
    [
        (lambda catalog: None, {"q"}, "q"),
        (lambda catalog: None, {"other"}, None),
        (another_holder, {"q"}, None),
        (no_holder, {"q"}, None),
        (parts, {"q"}, None),
        (an_owner, {"q"}, None),
        (being_recovered, {"q"}, None),
        (noticed, {"q"}, None),
    ],
)
def test_the_only_one_who_waits(also: Callable[[Catalog], None], waiting: set[str], waiter: str | None) -> None:
    catalog = loading_one()
    also(catalog)
    assert only_waiter(catalog, catalog.resources["q"], waiting) == waiter


def test_a_load_that_was_told_is_taken_up_as_any_but_for_the_write_and_the_answer() -> None:
    """And watchers hear nothing: there were none when it happened."""
    plain, told = (loading_one(load_timeout_s=5.0) for _ in range(2))
    ordinary = says(plain, _replace(LOADED, told=False))
    after = says(told, LOADED)
    assert picture(told) == picture(plain)
    assert after.changes == []
    assert after.later == {}
    assert [effect for effect in ordinary.effects if not isinstance(effect, (e.Reply, e.Happened))] == after.effects
    assert e.Reply("app", Loaded("q", "q", b"feed")) in ordinary.effects
    assert [effect.key for effect in after.effects if isinstance(effect, e.SetTimer)] == ["load:q"]


def test_who_joined_after_it_was_told_is_answered_when_it_is_taken_up() -> None:
    catalog = loading_one()
    says(catalog, ask("other", origin="b"))
    batch = says(catalog, LOADED)
    assert [effect for effect in batch.effects if isinstance(effect, e.Reply)] == [
        e.Reply("b", Loaded("other", "q", b"feed"))
    ]
    assert catalog.waiting == {}
    assert batch.changes == []


@pytest.mark.parametrize("also", [unknown, the_same_again, in_another_phase(Phase.LOADED)])
def test_the_note_of_what_is_over_changes_nothing(also: Callable[[Catalog], None]) -> None:
    catalog = loading_one()
    also(catalog)
    before = picture(catalog)
    batch = says(catalog, LOADED)
    assert picture(catalog) == before
    assert (batch.changes, batch.effects) == ([], [])


# -- an unload that is done ------------------------------------------------------------------------------------------


def test_of_an_unload_that_one_query_waits_for_the_thread_drops_the_rows_and_answers() -> None:
    catalog = unloading_one()
    before = picture(catalog)
    told = unloading.unloaded_directly(catalog, GONE)
    assert told is not None
    assert told.changes == [Drop("queries", "q"), Drop("resources", "q")]
    assert told.answer == Unloaded("q")
    assert told_directly(catalog, GONE) == told
    assert picture(catalog) == before


def queued_behind_it(catalog: Catalog) -> None:
    says(catalog, ask("next"))
    assert catalog.resources["next"].phase is Phase.QUEUED


def its_server_leaves(catalog: Catalog) -> None:
    catalog.leaving["cam"] = "ticket"


@pytest.mark.parametrize(
    "also",
    [
        *(*MORE_FOLLOWS, queued_behind_it, its_server_leaves),
        *map(in_another_phase, (Phase.QUEUED, Phase.LOADED, Phase.LOADING, Phase.UNLOAD_FAILED)),
    ],
)
def test_an_unload_from_whose_end_more_follows_is_not_told_by_its_thread(also: Callable[[Catalog], None]) -> None:
    catalog = unloading_one()
    also(catalog)
    assert unloading.unloaded_directly(catalog, GONE) is None


def test_an_unload_that_another_is_queued_behind_of_another_request_is_told() -> None:
    catalog = unloading_one()
    says(catalog, ask("next", b"back"))
    assert unloading.unloaded_directly(catalog, GONE) is not None


def test_an_unload_that_was_told_is_taken_up_as_any_but_for_the_write_and_the_answer() -> None:
    plain, told = unloading_one(), unloading_one()
    ordinary = says(plain, _replace(GONE, told=False))
    after = says(told, GONE)
    assert picture(told) == picture(plain)
    assert (after.changes, after.later) == ([], {})
    assert e.Reply("app", Unloaded("q")) in ordinary.effects
    assert [effect for effect in ordinary.effects if not isinstance(effect, (e.Reply, e.Happened))] == after.effects


def test_what_was_queued_after_it_was_told_begins_when_it_is_taken_up() -> None:
    catalog = unloading_one()
    queued_behind_it(catalog)
    batch = says(catalog, GONE)
    assert [effect.resource.id for effect in batch.effects if isinstance(effect, e.StartLoad)] == ["next"]
    assert list(catalog.resources) == ["next"]


@pytest.mark.parametrize(("make", "note"), [(loading_one, LOADED), (unloading_one, GONE)])
def test_what_was_told_and_could_not_be_taken_up_is_as_before(make: Callable[[], Catalog], note: Any) -> None:
    catalog = make()
    before = picture(catalog)
    says(catalog, note).undo()
    assert picture(catalog) == before


# -- what a direct line may ask before notes are taken up ------------------------------------------------------------


@pytest.mark.parametrize(
    ("catalog", "message", "is_first"),
    [
        (loaded_one, ask("new", b"back"), True),
        (loaded_one, ask("new"), False),
        (loading_one, ask("new"), False),
        (unloading_one, ask("new"), False),
        (loaded_one, ask("q", b"back"), False),
        (loaded_one, ask("new", b"back", parent="part"), False),
        (loaded_one, ask("new", b"back", server="other"), False),
    ],
    ids=["first", "loaded", "loading", "being unloaded", "known already", "for a resource", "unknown server"],
)
def test_which_load_is_the_first(catalog: Callable[[], Catalog], message: Load, is_first: bool) -> None:
    assert loading.is_first(catalog(), message) is is_first


def test_what_is_queued_was_asked_for_already() -> None:
    catalog = unloading_one()
    queued_behind_it(catalog)
    says(catalog, c.UnloadDone("q", 1))
    assert not loading.is_first(catalog, ask("new"))


def test_a_load_that_was_refused_or_withdrawn_before_is_not_the_first() -> None:
    catalog = loaded_one()
    says(catalog, Unload("new", "app"))
    assert not loading.is_first(catalog, ask("new", b"back"))


def test_who_asks_for_what_is_fatal_is_the_first_of_another() -> None:
    catalog = loaded_one()
    says(catalog, c.SetStatus("q", "e", State.FATAL, "", None))
    assert loading.is_first(catalog, ask("new"))


@pytest.mark.parametrize(
    ("also", "message", "is_held"),
    [
        (lambda catalog: None, Unload("q", "app"), True),
        (lambda catalog: None, Unload("other", "app"), False),
        (lambda catalog: None, Unload("q", "b"), False),
        (being_recovered, Unload("q", "app"), False),
        *((in_another_phase(phase), Unload("q", "app"), False) for phase in Phase if phase is not Phase.LOADED),
    ],
)
def test_which_unload_is_of_what_is_held(also: Callable[[Catalog], None], message: Unload, is_held: bool) -> None:
    catalog = loaded_one()
    also(catalog)
    assert unloading.is_held(catalog, message) is is_held


def test_while_a_join_is_not_taken_up_nobody_is_the_last() -> None:
    catalog = loaded_one()
    query = loading.joined_directly(catalog, ask("new"))
    assert query is not None
    note = loading.note_joined(catalog, query)
    assert note == c.Joined(query)
    assert catalog.joining == {"new": "q"}
    assert not unloading.is_held(catalog, Unload("q", "app"))

    batch = says(catalog, note)
    assert catalog.joining == {}
    assert unloading.is_held(catalog, Unload("q", "app"))
    batch.undo()
    assert catalog.joining == {"new": "q"}
    assert not unloading.is_held(catalog, Unload("q", "app"))

    says(catalog, note, note)
    assert catalog.joining == {}
    assert [one.id for one in catalog.queries_of("q")] == ["q", "new"]


# -- whichever way, it comes to the same -----------------------------------------------------------------------------


class World:
    """A provider's catalog and its disk; with `told`, threads tell what they may."""

    def __init__(self, *, told: bool) -> None:
        self.told = told
        self.catalog = Catalog("p")
        self.disk: dict[tuple[str, str], Any] = {}
        self.answers: list[Any] = []
        self.others: list[Any] = []
        self.tellings = 0
        self.take(c.Register(Server("cam")))
        self.take(Fetch("app", True))

    def take(self, item: Any) -> None:
        if self.told and isinstance(item, (c.LoadDone, c.UnloadDone)):
            told = told_directly(self.catalog, item)
            if told is not None:
                self.tellings += 1
                self.write(told.changes)
                self.answers.append(told.answer)
                item = _replace(item, told=True)
        batch = says(self.catalog, item)
        self.write(batch.changes)
        for effect in batch.effects:
            if isinstance(effect, e.Reply):
                self.answers.append(effect.message)
            elif not isinstance(effect, e.Happened):  # nobody watches
                self.others.append(effect)

    def write(self, changes: list[Change]) -> None:
        for change in changes:
            if isinstance(change, Put):
                self.disk[TABLE_OF[type(change.row)], change.row.id] = change.row
            else:
                self.disk.pop((change.table, change.id), None)

    def running(self, phase: Phase) -> list[Resource]:
        return [row for row in self.catalog.resources.values() if row.phase is phase]


@given(st.lists(st.tuples(st.sampled_from(["load", "unload", "done", "gone", "fails", "hot"]), st.integers(0, 5))))
def test_told_and_noted_it_comes_to_what_the_loop_would_have_done(steps: list[tuple[str, int]]) -> None:
    plain, told = World(told=False), World(told=True)
    for number, (step, which) in enumerate(steps):
        item: Any = None
        queries, loads, unloads = list(plain.catalog.queries), *map(plain.running, (Phase.LOADING, Phase.UNLOADING))
        match step:
            case "load":
                item = ask(f"q{number}", (b"front", b"back")[which % 2])
            case "unload" if queries:
                item = Unload(queries[which % len(queries)], "app")
            case "done" if loads:
                item = c.LoadDone(loads[which % len(loads)].id, loads[which % len(loads)].attempt, b"%d" % number)
            case "gone" if unloads:
                item = c.UnloadDone(unloads[which % len(unloads)].id, unloads[which % len(unloads)].tries)
            case "fails" if unloads:
                item = c.UnloadErred(unloads[which % len(unloads)].id, unloads[which % len(unloads)].tries, FAILURE)
            case "hot" if plain.catalog.resources:
                item = c.SetStatus(next(iter(plain.catalog.resources)), f"e{number}", State.WARNING, "hot", None)
            case _:
                continue
        plain.take(item)
        told.take(item)
        assert picture(told.catalog) == picture(plain.catalog)
        assert told.disk == plain.disk
        assert told.answers == plain.answers
        assert told.others == plain.others


def test_of_what_one_loads_and_lets_go_again_the_threads_tell_both() -> None:
    world = World(told=True)
    for item in (ask(), c.LoadDone("q", 1, b"feed"), Unload("q", "app"), c.UnloadDone("q", 1)):
        world.take(item)
    assert world.tellings == 2
    assert world.answers[1:] == [Loaded("q", "q", b"feed"), Unloaded("q")]  # behind the answer to Fetch
    assert world.disk == {}
