"""Timelines and sequence diagrams as text: the words and marks, and that no line is wider than a terminal."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

import rr_actors as rr
from rr_actors.registrar.model.recorded import Entry
from rr_actors.system.recording.sequence_diagrams import sequence_of
from rr_actors.system.recording.timelines import timeline_of
from rr_actors.tools.learn.text_pictures import WIDTH, sequence_text, timeline_text

NAMES = st.text(st.characters(codec="ascii", categories=["L", "N"]), min_size=1, max_size=40)


def entry(at: float, event: str, me: str, peer: str, what: str) -> Entry:
    return Entry(at, event, process="root", pid=1, registrar=me, peer=peer, name=what)


def tree(ids: list[str]) -> rr.Supervisor:
    return rr.Supervisor([rr.ChildSpec(rr.Actor, id=id) for id in ids], id="robot")


def test_a_killed_child_has_a_cross_where_its_life_ends_and_another_bar() -> None:
    run = rr.simulate(tree(["camera", "map"]), [("camera", 30.0)], until_s=60.0)
    robot, camera, chart, axis, legend = timeline_text(run.timeline).splitlines()

    assert (robot[:10], camera[:10], chart[:10]) == ("robot     ", "  camera  ", "  map     ")
    assert camera.count("✗") == 1
    assert abs(camera.index("✗") - (10 + 68 // 2)) <= 2  # in the middle
    assert set(camera[camera.index("✗") + 3 :]) == {"━"}
    assert "✗" not in chart
    assert axis.split() == ["0", "s", "29.9", "s", "59.9", "s"]  # from the first start on
    assert legend.strip().startswith("━ runs")


def test_a_supervisor_that_gives_up_has_an_arrow_and_nothing_after_it() -> None:
    run = rr.simulate(tree(["camera"]), {"camera": rr.Child.fails(every_s=0.01)}, until_s=10.0)
    robot, camera, *_ = timeline_text(run.timeline).splitlines()

    assert robot.endswith("▲")
    assert camera.endswith("✗")


def test_a_timeline_of_nothing_says_so() -> None:
    assert timeline_text(timeline_of([])) == "nothing has happened to a child"
    assert sequence_text(sequence_of([])) == "nothing was sent"


@given(st.lists(NAMES, min_size=1, max_size=5, unique=True), st.floats(1.0, 9.0))
def test_no_line_of_a_timeline_is_wider_than_a_terminal(ids: list[str], at: float) -> None:
    run = rr.simulate(tree(ids), [(ids[0], at)], until_s=10.0)
    lines = timeline_text(run.timeline).splitlines()

    assert len(lines) == len(ids) + 3
    assert max(map(len, lines[:-1])) <= WIDTH


@given(st.lists(st.tuples(NAMES, NAMES, st.text(max_size=100)), min_size=1, max_size=60))
def test_no_line_of_a_sequence_is_wider_than_a_terminal_and_long_ones_are_counted(
    sent: list[tuple[str, str, str]],
) -> None:
    entries = [entry(number / 10, "sent", *one) for number, one in enumerate(sent)]
    lines = sequence_text(sequence_of(entries)).splitlines()

    assert max(map(len, lines)) <= WIDTH
    assert len(lines) <= 31
    assert (" more lines" in "\n".join(lines)) == (len(sent) + 1 > 31)


def test_an_arrow_points_to_its_receiver_and_a_lost_message_has_a_cross() -> None:
    lines = sequence_text(
        "sequenceDiagram\n    participant p0 as root/app\n    participant p1 as root/camera\n"
        "    p0->>p1: 0.0 ms: Ask #quot;shoot#quot;\n    p1-->>p0: 1.5 ms: Answer 1\n"
        "    p0-xp1: 2.0 ms: Tell 2 (no record of its arrival)\n    Note over p1: 3.0 ms: exited SIGKILL\n"
        "    p0->>p0: 4.0 ms: Stop"
    ).splitlines()

    assert lines == [
        "             app    camera",
        '    0.0 ms     │──────>│     Ask "shoot"',
        "    1.5 ms     │<┄┄┄┄┄┄│     Answer 1",
        "    2.0 ms     │──────✗│     Tell 2 (no record of its arrival)",
        "    3.0 ms     │       ■     exited SIGKILL",
        "    4.0 ms     ↻       │     Stop",
    ]
