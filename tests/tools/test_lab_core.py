"""What the lab decides without a page: levers, questions and their answers, playback, notebooks."""

from __future__ import annotations

import ast
import importlib
import inspect
import re
from pathlib import Path

import nbformat
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rr_actors.system.console.console_messages import Event
from rr_actors.system.recording.timeline_lanes import Bar, Lane, Mark
from rr_actors.system.recording.timelines import Timeline
from rr_actors.tools.web.lab.lab_catalog import EXPERIMENTS, experiment_called
from rr_actors.tools.web.lab.lab_declarations import Happens, LabExperiment, Lever, NothingElse, Prints, Question, Seen
from rr_actors.tools.web.lab.lab_questions import QUESTIONS
from rr_actors.tools.web.lab.lab_texts import PACKAGE, notebook_of
from rr_actors.tools.web.lab.playback import PACES, Playback

DOCS = Path(__file__).parents[2] / "docs"
QUESTION = Question("Which?", {"a": Happens("restarted", "root/a"), "said": Prints("hello"), "neither": NothingElse()})
A = Event(1, 1.0, "restarted", {"path": "root/a"})


@pytest.mark.parametrize(
    ("seen", "right"),
    [
        (Seen(), {"neither"}),
        (Seen([A]), {"a"}),
        (
            Seen([Event(1, 1.0, "exited", {"path": "root/a"}), Event(2, 1.0, "restarted", {"path": "root/ab"})]),
            {"neither"},
        ),
        (Seen([A], ["oh, hello there"]), {"a", "said"}),
    ],
)
def test_a_run_says_which_answers_are_right(seen: Seen, right: set[str]) -> None:
    assert QUESTION.right(seen) == right


@pytest.mark.parametrize(
    ("given_answers", "said"),
    [
        (set(), "You gave no answer. It was: a."),
        ({"a"}, "Right: a."),
        ({"neither", "a"}, "Not quite. You said: a, neither. It was: a."),
    ],
)
def test_the_given_answers_are_compared_with_the_run(given_answers: set[str], said: str) -> None:
    assert QUESTION.verdict(given_answers, Seen([A])) == said


def test_a_question_of_which_a_run_shows_nothing_says_so() -> None:
    assert Question("Which?", {"a": Prints("a")}).verdict({"a"}, Seen()) == "This run has shown none of the answers."


def test_levers_have_their_first_value_unless_another_is_chosen() -> None:
    declared = LabExperiment("room.name", (Lever("kills", "kills", (1, 2)), Lever("child", "child", ("a", "b"))))
    assert declared.name == "name"
    assert declared.values({}) == {"kills": 1, "child": "a"}
    assert declared.values({"kills": "2"}) == {"kills": 2, "child": "a"}
    assert declared.values({"kills": "3"}) is None
    assert declared.values({"no such lever": "1"}) is None


@pytest.mark.parametrize("declared", EXPERIMENTS, ids=lambda one: one.name)
def test_the_levers_of_an_experiment_are_the_parameters_of_its_program(declared: LabExperiment) -> None:
    program = importlib.import_module(f"{PACKAGE}.{declared.program}")
    parameters = list(inspect.signature(program.main).parameters.values())[1:]
    assert {one.name: one.default for one in parameters} == {one.name: one.choices[0] for one in declared.levers}
    assert declared.question is not None
    assert experiment_called(declared.name) is declared


def test_every_program_beside_the_others_is_declared() -> None:
    root = Path(str(importlib.import_module(PACKAGE).__file__)).parent
    found = {".".join(path.relative_to(root).with_suffix("").parts) for path in root.rglob("*.py")}
    assert {one.program for one in EXPERIMENTS} == {name for name in found if "__" not in name}


@pytest.mark.parametrize("declared", EXPERIMENTS, ids=lambda one: one.name)
def test_a_notebook_has_the_same_code_and_the_chosen_levers(declared: LabExperiment) -> None:
    levers = {lever.name: lever.choices[-1] for lever in declared.levers}
    notebook = nbformat.reads(notebook_of(declared, levers), as_version=4)
    nbformat.validate(notebook)
    _, code, call = [cell.source for cell in notebook.cells]
    compile(code, "cell", "exec")
    arguments = ast.parse(call, mode="eval").body
    assert isinstance(arguments, ast.Call)
    assert {one.arg: ast.literal_eval(one.value) for one in arguments.keywords} == levers


# -- ten questions ---------------------------------------------------------------------------------------------------


def test_the_docs_have_the_ten_questions_with_the_same_answers() -> None:
    page = (DOCS / "let-it-crash.md").read_text().partition("## Ten questions")[2]
    asked, answers = (re.split(r"^\d+\. ", part, flags=re.MULTILINE)[1:] for part in page.split("### Answers"))
    assert [" ".join(one.split()) for one in asked] == [one.text for one in QUESTIONS]
    assert [" ".join(one.split()) for one in answers] == [one.why for one in QUESTIONS]
    assert len(QUESTIONS) == 10


def test_a_choice_is_answered_with_the_docs_answer_and_its_place_does_not_betray_it() -> None:
    for asked in QUESTIONS:
        assert asked.verdict(asked.choices[0]) == f"Right. {asked.why}"
        assert asked.verdict(asked.choices[1]) == f"Not quite. {asked.why}"
        assert not asked.experiment or experiment_called(asked.experiment)
    assert {asked.shown.index(asked.choices[0]) for asked in QUESTIONS} == {0, 1, 2}


# -- playback --------------------------------------------------------------------------------------------------------


def test_what_is_live_stays_live_and_can_be_paused() -> None:
    live = Playback()
    assert live.advanced(1.0, 10.0) == live
    paused = live.toggled(10.0)
    assert paused == Playback(10.0, is_paused=True)
    assert paused.advanced(5.0, 20.0) == paused
    assert paused.toggled(20.0).advanced(5.0, 20.0) == Playback(15.0)
    assert paused.toggled(20.0).advanced(15.0, 20.0) == live


def test_steps_go_to_what_happens_next_and_at_last_to_the_newest_time() -> None:
    here, seen = Playback().again(0.0), list[float | None]()
    for _ in range(4):
        here = here.stepped([2.0, 1.0, 3.0], 4.0)
        seen.append(here.at)
    assert seen == [1.0, 2.0, 3.0, 4.0]
    assert here.is_paused


def test_slower_halves_the_pace_and_after_the_slowest_one_it_is_the_first_again() -> None:
    slow = Playback(2.0).slower(10.0)
    assert slow.advanced(2.0, 10.0) == Playback(3.0, 0.5)
    assert slow.slower(10.0).advanced(2.0, 10.0) == Playback(2.5, 0.25)
    assert slow.slower(10.0).slower(10.0) == Playback(2.0)
    assert slow.again(0.0) == Playback(0.0, 0.5)


def pressed(playback: Playback, button: str, times: list[float], newest: float) -> Playback:
    buttons = {
        "toggled": lambda: playback.toggled(newest),
        "stepped": lambda: playback.stepped(times, newest),
        "slower": lambda: playback.slower(newest),
        "again": lambda: playback.again(0.0),
        "advanced": lambda: playback.advanced(1.0, newest),
    }
    return buttons[button]()


@given(
    st.lists(st.sampled_from(("toggled", "stepped", "slower", "again", "advanced")), max_size=30),
    st.lists(st.floats(0, 100), max_size=5),
)
def test_playback_stays_between_the_first_and_the_newest_time(presses: list[str], times: list[float]) -> None:
    playback, newest = Playback(), 0.0
    for press in presses:
        newest += 1.0
        playback = pressed(playback, press, [time for time in times if time <= newest], newest)
        assert playback.at is None or 0.0 <= playback.at <= newest
        assert playback.pace in PACES


# -- a timeline as it was --------------------------------------------------------------------------------------------


def test_a_timeline_as_it_was_ends_there() -> None:
    bars = [Bar(0.0, 4.0, how="killed"), Bar(5.0)]
    marks = [Mark(4.0, "killed", "killed"), Mark(5.0, "restarted", "restarted")]
    whole = Timeline([Lane("root/a", "actor", bars, marks)], 0.0, 9.0, "a system")
    (lane,) = whole.as_of(3.0).lanes
    assert lane.bars == [Bar(0.0)]
    assert lane.marks == []
    (lane,) = whole.as_of(4.5).lanes
    assert (lane.bars, lane.marks) == (bars[:1], marks[:1])
    assert whole.as_of(99.0).lanes == whole.lanes
    assert (whole.as_of(3.0).until, whole.as_of(99.0).until) == (3.0, 9.0)
