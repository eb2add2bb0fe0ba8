"""The lines of events for people, and the filter that chooses among them."""

from __future__ import annotations

import time

import pytest

from rr_actors.system.recording.event_memory import Event
from rr_actors.system.recording.event_texts import clock
from rr_actors.tools.terminal.event_lines import EventFilter, EventLine, EventLines

THIRTEEN = time.mktime((2026, 11, 28, 13, 13, 13, 0, 0, -1))
"""13:13:13 of the local day: each pair of digits of the clock is 13."""


def loaded(lamp: str, at: float = THIRTEEN) -> Event:
    return Event(0, at, "loaded", {"server": "shop/thing", "request": f'"lamp {lamp}"'})


def chosen(wanted: EventFilter, *events: Event) -> list[str]:
    lines = EventLines()
    for event in events:
        lines.take(event)
    return [line.subject for line in lines.lines(wanted)]


@pytest.mark.parametrize("wanted", [EventFilter.parse("lamp 13"), EventFilter.of(text="13")], ids=["typed", "option"])
def test_a_filter_does_not_search_the_clock(wanted: EventFilter) -> None:
    assert chosen(wanted, *map(loaded, ("12", "13", "14"))) == ['shop/thing "lamp 13"']


def test_a_filter_does_not_search_how_often_an_event_came() -> None:
    line = EventLine.of(loaded("4"))
    line.times = 13

    assert "(13 times)" in str(line)
    assert not EventFilter.parse("13").accepts(line)
    assert not EventFilter.parse("times").accepts(line)


def test_a_filter_does_not_search_the_reach_of_a_status() -> None:
    facts = {"server": "shop/thing", "request": '"lamp"', "detail": "ERROR: dim", "heard_by": "app"}
    line = EventLine.of(Event(0, THIRTEEN, "status", facts))
    line.names.update(dict.fromkeys(f'shop/set "{number}"' for number in "abcdefghijklm"))

    assert "13 resources" in str(line)
    assert not EventFilter.parse("13").accepts(line)
    assert EventFilter.parse("dim").accepts(line)
    assert EventFilter.parse("set").accepts(line)  # a resource that the status has reached


@pytest.mark.parametrize("text", ["loaded", "lamp", "shop/thing"])
def test_a_filter_searches_the_kind_the_subject_and_how(text: str) -> None:
    assert chosen(EventFilter.parse(text), loaded("4")) == ['shop/thing "lamp 4"']


# -- what is one line --------------------------------------------------------------------------------------------------


def lines_of(*events: Event) -> list[str]:
    lines = EventLines()
    for event in events:
        lines.take(event)
    return [str(line) for line in lines.lines()]


def sonar(event: str, after_s: float, **facts: object) -> Event:
    return Event(0, THIRTEEN + after_s, event, {"path": "root/sonar", **facts})


def test_each_life_of_a_child_has_lines_of_its_own_in_the_order_in_which_they_happened() -> None:
    said = lines_of(
        sonar("started", 0, pid=12, ready_s=0.03),
        sonar("stopped", 60, pid=12, reason="shutdown", detail="stopped", up_s=60.0),
        sonar("started", 61, pid=14, ready_s=0.03),
        sonar("stopped", 200, pid=14, reason="shutdown", detail="stopped", up_s=139.0),
    )

    assert [line.split("  ")[1].strip() for line in said] == ["started", "stopped", "started", "stopped"]
    assert not any("times" in line for line in said)


def test_events_that_say_the_same_are_one_line_unless_time_has_passed_between_them() -> None:
    earlier, later = (loaded("4", THIRTEEN + second) for second in (0, 60))

    first, other, last = lines_of(earlier, loaded("4", THIRTEEN + 1), loaded("5", THIRTEEN + 30), later)

    assert first == f'{clock(THIRTEEN + 1)}  loaded        shop/thing "lamp 4"  (2 times)'
    assert "lamp 5" in other
    assert last == f'{clock(THIRTEEN + 60)}  loaded        shop/thing "lamp 4"'


def test_what_goes_on_and_on_is_one_line_that_says_since_when() -> None:
    (line,) = lines_of(*(loaded("4", THIRTEEN + 5 * number) for number in range(74)))

    assert line.endswith(f"(74 times since {clock(THIRTEEN)})")
