"""Decisions as a recording has them: what is decided again from their texts is the same, in worlds of every kind."""

from __future__ import annotations

import base64
import zlib
from collections.abc import Callable, Iterable, Sequence
from typing import Any

import msgspec
import pytest

import simulation.sim_registrar
from rr_actors.registrar.core.decide import Item, decide
from rr_actors.registrar.decisions.decided import Began, Decided, all_of, catalog_of, memory_of
from rr_actors.registrar.decisions.deciding_again import Again, DecidedAgain
from rr_actors.registrar.decisions.decision_notes import PART, DecisionNotes
from rr_actors.registrar.decisions.typed_values import CLASSES, Opaque, UnknownValue, plain, text_from, value_from
from rr_actors.registrar.model import commands as c
from rr_actors.registrar.model.catalog import Catalog, Decision, Server
from rr_actors.registrar.model.messages import Load, Unload
from rr_actors.registrar.model.rows import Phase, State, content_of
from simulation import run

WORLDS = 12
OF_THEM = 3  # every so many decisions of a world are decided again


class Notes:
    """The notes of a registrar that has nowhere to send them."""

    def __init__(self) -> None:
        self.texts: list[str] = []
        self.has_room = True
        self.notes = DecisionNotes("cameras", self._send)

    def _send(self, _registrar: str, number: int, parts: Sequence[str]) -> bool:
        if self.has_room:
            assert all(len(part) <= PART for part in parts)
            self.texts.append("".join(parts))
        return self.has_room

    def decide(self, catalog: Catalog, items: Iterable[Item], recording: int = 1) -> Decision:
        items = self.notes.begin(catalog, items, recording)
        decision = decide(catalog, items)
        self.notes.committed(decision)
        decision.close()
        catalog.deserted.clear()
        return decision

    @property
    def values(self) -> list[Any]:
        return [value_from(text) for text in self.texts]

    def again(self) -> list[Any]:
        """What comes of each note: the differences from what was known, or the decision again."""
        registrar = DecidedAgain()
        return [registrar.begin(one) if isinstance(one, Began) else registrar.decide(one) for one in self.values]


def serving() -> Catalog:
    catalog = Catalog("cameras", content_of(()))
    for command in (c.BeginAgain(), c.Register(Server("camera"), "registered"), c.BeginServing("served")):
        decide(catalog, [(command, None)]).close()
    return catalog


def load(id: str, request: bytes = b"\xa5front") -> Load:
    return Load(id, "camera", request, "app", "", 0, 1)


def test_each_decision_of_simulated_worlds_is_the_same_when_it_is_decided_again_from_its_text(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Whatever the catalog knows then, whatever is decided: both come back from the text as they were."""
    tried, different = [0], list[Any]()

    def noted(catalog: Catalog, items: Iterable[Item]) -> Decision:
        tried[0] += 1
        if tried[0] % OF_THEM:
            return decide(catalog, items)
        notes = Notes()
        items = notes.notes.begin(catalog, items, 1)
        decision = decide(catalog, items)
        notes.notes.committed(decision)
        (_, result) = notes.again()
        different.extend(result.differences)
        return decision

    monkeypatch.setattr(simulation.sim_registrar, "decide", noted)
    for seed in range(WORLDS):
        assert run(seed).violation is None
    assert different == []
    assert tried[0] > 1000


def test_a_course_of_decisions_leads_to_what_the_registrar_knows_then() -> None:
    catalog, notes = serving(), Notes()
    notes.decide(catalog, [(load("q1"), "app")])
    notes.decide(catalog, [(load("q2"), "app"), (load("q3", b"\xa4back"), "app")])
    ended = c.CallbackEnded("load", "q1", 1, response=b"\xa6images")
    notes.decide(catalog, [(ended, None)])
    notes.decide(catalog, [(Unload("q2", "app"), "app")])
    catalog.listened.add("q1")
    catalog.servers["lens"] = Server("lens")
    notes.decide(catalog, [(c.SetStatus("q1", "event", State.ERROR, "dust", notes.decide), None)])
    notes.decide(catalog, [(Unload("q1", "app"), "app")], recording=2)

    again, values = DecidedAgain(), notes.values
    again.begin(values[0])
    for one in values[1:6]:
        again.decide(one)
    assert values == notes.values, "what was noted stays as it was"
    assert [type(one) for one in notes.values] == [Began, *[Decided] * 5, Began, Decided]
    assert notes.values[5].outside == {"listened": ({"q1": True}, []), "servers": ({"lens": Server("lens")}, [])}
    assert notes.again()[0] == notes.again()[6] == ()
    assert [one for one in notes.again() if isinstance(one, Again) and (one.differences or not one.is_decided)] == []


def test_what_is_changed_by_neither_a_decision_nor_known_code_is_seen_when_the_next_recording_begins() -> None:
    catalog, notes = serving(), Notes()
    notes.decide(catalog, [(load("q1"), "app")])
    catalog.set("resources", "q1", msgspec.structs.replace(catalog.resources["q1"], message="who did that?"))
    notes.decide(catalog, [(Unload("q1", "app"), "app")], recording=2)

    (difference,) = notes.again()[2]
    assert (difference.of, difference.name) == ("known", "resources q1")
    assert (difference.recorded.message, difference.today.message) == ("who did that?", "")


def break_the_lines(notes: Notes, catalog: Catalog) -> None:
    notes.notes.begin(catalog, [(load("q2"), "app")], 1)  # and Ctrl-C comes


def find_no_room(notes: Notes, catalog: Catalog) -> None:
    notes.has_room = False
    notes.decide(catalog, [(load("q2"), "app")])
    notes.has_room = True


def raise_an_error(notes: Notes, catalog: Catalog) -> None:
    items = notes.notes.begin(catalog, [(load("q2"), None)], 1)
    with pytest.raises(TypeError) as error:
        decide(catalog, items)
    notes.notes.raised(error.value)
    catalog.roll_back()
    catalog.unfinished = None


@pytest.mark.parametrize("happens", [break_the_lines, find_no_room, raise_an_error])
def test_after_what_no_note_has_the_next_note_has_all_that_the_registrar_knows(
    happens: Callable[[Notes, Catalog], None],
) -> None:
    catalog, notes = serving(), Notes()
    notes.decide(catalog, [(load("q1"), "app")])
    happens(notes, catalog)
    notes.decide(catalog, [(load("q3"), "app")])

    assert isinstance(notes.values[-2], Began)
    assert not notes.values[-2].again
    assert [one for one in notes.again() if isinstance(one, Again) and (one.differences or not one.is_decided)] == []


def test_an_error_of_a_decision_is_the_same_error_or_a_difference() -> None:
    catalog, notes = serving(), Notes()
    notes.decide(catalog, [(load("q1"), "app")])
    raise_an_error(notes, catalog)
    began, first, raised = notes.values
    assert (raised.end, raised.why.partition(":")[0]) == ("raised", "TypeError")
    for error, differences in ((raised.why, 0), ("ValueError: as it was then", 1)):
        registrar = DecidedAgain()
        registrar.begin(began)
        registrar.decide(first)
        result = registrar.decide(msgspec.structs.replace(raised, why=error))
        assert len(result.differences) == differences
        assert not registrar.is_known


def test_what_is_different_is_named_and_nothing_is_decided_after_it() -> None:
    catalog, notes = serving(), Notes()
    notes.decide(catalog, [(load("q1"), "app")])
    notes.decide(catalog, [(Unload("q1", "app"), "app")])
    began, first, last = notes.values
    (queries,) = [one for one in first.changes if type(one.row).__name__ == "ServedQuery"]
    other = msgspec.structs.replace(queries, row=msgspec.structs.replace(queries.row, seq=7))
    registrar = DecidedAgain()
    registrar.begin(began)
    changed = [other if one == queries else one for one in first.changes]

    result = registrar.decide(msgspec.structs.replace(first, changes=changed, effects=first.effects[:-1]))

    assert [(one.of, one.recorded, one.today) for one in result.differences] == [
        ("change", other, queries),
        ("effect", None, first.effects[-1]),
    ]
    assert registrar.decide(last) == Again(registrar.decide(last).rows, (), is_decided=False)
    registrar.begin(began)
    swapped = msgspec.structs.replace(first, changes=first.changes[::-1])
    assert [one.name for one in registrar.decide(swapped).differences] == ["at place 1"]


def test_a_decision_that_is_undone_leaves_nothing_and_what_is_refused_then_is_decided_again_as_well() -> None:
    catalog, notes = serving(), Notes()
    items: list[Item] = [(load("q1"), "app")]
    notes.notes.begin(catalog, items, 1)
    decision = decide(catalog, items)
    notes.notes.undone(decision, OSError("disk full"))
    decision.undo()
    notes.decide(catalog, [(load("q2"), "app")])
    notes.decide(catalog, [(Unload("q2", "app"), "app")], recording=2)

    assert [getattr(one, "end", "") for one in notes.values] == ["", "undone", "committed", "", "committed"]
    assert notes.again()[3] == ()
    assert [one for one in notes.again() if isinstance(one, Again) and (one.differences or not one.is_decided)] == []


# -- texts -------------------------------------------------------------------------------------------------------------


def test_every_message_command_row_and_effect_has_a_class_of_its_own_name() -> None:
    assert [name for name, cls in CLASSES.items() if cls.__name__ != name] == []
    assert {"Load", "Reconcile", "Resource", "StartCallback", "Closing", "Failure", "Decided"} <= set(CLASSES)


def test_a_caller_that_waits_becomes_something_that_stands_for_it() -> None:
    def answer() -> None: ...

    first, second, other = value_from(text_from([answer, answer, len]))
    assert first == second != other
    assert isinstance(first, Opaque)
    assert first.kind == "function"


def test_a_catalog_comes_back_with_the_order_of_all_its_indexes() -> None:
    catalog = serving()
    for id in ("q3", "q1", "q2"):
        decide(catalog, [(load(id, id.encode()), "app")]).close()
    decide(catalog, [(c.CallbackEnded("load", "q1", 1, response=b"\xa1x"), None)]).close()
    decide(catalog, [(c.Reload("q1", None), None)]).close()

    made = catalog_of(value_from(text_from(all_of(catalog))))

    assert list(made.moving) == list(catalog.moving)
    assert plain(memory_of(made)) == plain(memory_of(catalog))
    assert made.tables == catalog.tables
    assert made.resources["q2"].phase is Phase.LOADING


def compressed(value: Any) -> str:
    return base64.b64encode(zlib.compress(msgspec.msgpack.encode(value))).decode()


@pytest.mark.parametrize(
    ("text", "why"),
    [
        (text_from(load("q"))[:-9], "damaged"),
        ("AAAA" + text_from(load("q"))[4:], "damaged"),
        ("no base64!", "damaged"),
        ("", "damaged: it is cut"),
        (base64.b64encode(zlib.compress(b"\xc1")).decode(), "damaged"),
        (compressed(["Robbery", "who", "me"]), "no class 'Robbery' is known here"),
        (compressed(["Load", "colour", "red"]), "Load: .*colour"),
        (compressed(["Load", "query_id"]), "Load: "),
        (compressed(["State", "TIRED"]), "State: .*TIRED"),
        (compressed([]), "no class '' is known here"),
        (compressed([["Load"]]), "unhashable"),
        (compressed(["dict", ["list"], 1]), "dict: unhashable"),
    ],
)
def test_a_text_that_is_damaged_or_of_another_version_is_refused_by_name(text: str, why: str) -> None:
    with pytest.raises(UnknownValue, match=why):
        value_from(text)


def test_a_later_version_reads_a_class_that_has_got_a_field() -> None:
    text = compressed(["Load", "query_id", "q", "server", "s", "request", b"r", "origin", "o", "parent", "",
                       "attempt", 0, "seq", 1])  # fmt: skip
    assert value_from(text) == Load("q", "s", b"r", "o", "", 0, 1)
