"""The curves of the children's figures: what is kept of each, and what is drawn of it."""

from __future__ import annotations

import os
from collections.abc import Callable
from xml.etree import ElementTree

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rr_actors.system.console.console_messages import ChildRow, RegistrarRow
from rr_actors.tools.process_usage import RateWatch
from rr_actors.tools.terminal import figure_curves
from rr_actors.tools.terminal.figure_curves import STEP_S, STEPS, FigureCurves

Pass = Callable[[float], None]
NEAR, FAR = ChildRow("root/near", 1, "worker", "running", os.getpid()), ChildRow("root/far", 1, "worker", "running")


def registrar(name: str, **counts: int) -> RegistrarRow:
    return RegistrarRow(name, "up", [], counts)


def values(curves: FigureCurves, path: str) -> dict[str, list[float | None]]:
    """The values of a child's curves from the first known one on, by the names of the figures."""
    found = {curve.kind.name: list(curve.values) for curve in curves.curves()[path]}
    return {
        name: known[next(at for at, value in enumerate(known) if value is not None) :] for name, known in found.items()
    }


@pytest.fixture
def pass_s(monkeypatch: pytest.MonkeyPatch) -> Pass:
    """Let time pass for the curves."""
    now = [1000.0]

    def later(seconds: float) -> None:
        now[0] += seconds

    monkeypatch.setattr(figure_curves.time, "monotonic", lambda: now[0])  # the clock of all modules
    return later


def test_a_child_has_the_figures_of_its_process_and_of_its_registrar() -> None:
    curves = FigureCurves()
    again = ChildRow("root/again", 1, "worker", "running", os.getpid())
    curves.take([NEAR, again, FAR], [registrar("near", mailbox=3, resources=7), registrar("far", mailbox=1)])
    kinds = {path: [curve.kind.name for curve in found] for path, found in curves.curves().items()}
    assert kinds == {
        "root/near": ["CPU", "memory", "mailbox", "resources"],
        "root/again": [],  # it is in the process of the first one
        "root/far": ["mailbox"],
    }
    near = {curve.kind.name: curve.now for curve in curves.curves("near")["root/near"]}
    assert (near["mailbox"], near["resources"]) == ("3", "7")
    assert near["memory"].endswith(" MiB")


def test_loads_are_counted_by_the_second_and_gaps_stay_gaps(pass_s: Pass) -> None:
    curves = FigureCurves()
    curves.take([FAR], [registrar("far", mailbox=0, loads=100)])
    curves.take([FAR], [registrar("far", mailbox=9, loads=110)])  # too early to count
    pass_s(1.0)
    curves.take([FAR], [registrar("far", mailbox=4, loads=112)])
    pass_s(STEP_S)
    curves.take([FAR], [registrar("far", mailbox=2, loads=112)])
    pass_s(2 * STEP_S)
    curves.take([FAR], [registrar("far", mailbox=0, loads=132)])
    assert values(curves, "root/far") == {"mailbox": [4, 2, None, 0], "loads": [12, 0, None, 2]}
    pass_s(STEP_S * (STEPS - 1))
    curves.take([FAR], [registrar("far", mailbox=9)])
    assert values(curves, "root/far")["mailbox"] == [0, *[None] * (STEPS - 2), 9]
    pass_s(1.0)
    curves.take([], [])
    assert curves.curves() == {}


@given(st.lists(st.one_of(st.none(), st.integers(0, 2**60)), max_size=20), st.text(max_size=10))
def test_a_picture_stays_within_its_frame_and_shows_any_path_as_text(counts: list[int | None], path: str) -> None:
    path = "".join(char for char in path if char.isprintable())
    row = ChildRow(f"root/<img onerror='x'>{path}", 1, "worker", "running")
    curves = FigureCurves()
    with pytest.MonkeyPatch.context() as patched:
        for step, count in enumerate(counts):
            patched.setattr(figure_curves.time, "monotonic", lambda at=step: 1000.0 + at * STEP_S)
            curves.take([row], [] if count is None else [registrar(row.id, mailbox=count)])
    for curve in curves.curves().get(row.path, []):
        picture = ElementTree.fromstring(curve.svg(row.path))
        assert row.path in picture.attrib["aria-label"]
        assert [element.tag for element in picture.iter()] == ["svg", "path"]
        strokes = picture[0].attrib["d"].replace("M", " ").replace("L", " ").replace("h1", "").split()
        assert all(0 <= int(x) < STEPS for x in strokes[::2])
        assert all(0 <= int(y) < 32 for y in strokes[1::2])


def test_a_count_that_begins_anew_has_no_rate_at_first(pass_s: Pass) -> None:
    rates = RateWatch()
    assert rates.look("far", 7) is None
    pass_s(2.0)
    assert rates.look("far", 27) == 10
    pass_s(2.0)
    assert rates.look("far", 3) is None
    pass_s(0.1)
    assert rates.look("far", 9) is None  # too early to count
    pass_s(2.9)
    assert rates.look("far", 9) == 2
