"""The exercises of `rr-actors learn`: as given each fails with a picture, and its solution passes."""

from __future__ import annotations

import ast
import re
import subprocess
import sys
from dataclasses import dataclass, field
from pathlib import Path

import pytest

from rr_actors.tools.learn.check_process import check_file
from rr_actors.tools.learn.learn_exercises import Exercise, all_exercises
from rr_actors.tools.learn.scenes import Outcome
from rr_actors.tools.web.lab.lab_declarations import Seen
from support import REPOSITORY

EXERCISES = {one.name: one for one in all_exercises()}
LIMIT_S = 90.0  # a busy machine


@dataclass(frozen=True)
class Expected:
    """What a check says: of the file as given, and of two wrong mends, each a list of replaced texts.

    A mend begins with the file as it was given; one whose first text is "" begins with the solution.
    """

    answer: str
    given: str
    wrong: dict[str, list[tuple[str, str]]] = field(default_factory=dict)


EXPECTED = {
    "let_it_crash": Expected(
        "10, a mean of three",
        "the scale went on after an error that nobody expected",
        {
            "the scale ended, and hid the error": [('print("cannot weigh", message)', "self.stop()")],
            "the scale does not weigh": [("self.grams += message", "self.grams = message")],
        },
    ),
    "strategies": Expected(
        "the driver alone",
        "driver died, and map still has a connection to a dead process",
        {
            "driver died, and logger was started again without need": [("one_for_one", "one_for_all")],
            "logger died, and driver was started again without need": [
                ("one_for_one", "rest_for_one"),
                ("        [\n", '        [\n            rr.ChildSpec(Logger, id="logger"),\n'),
                ('"viewer"),\n            rr.ChildSpec(Logger, id="logger"),', '"viewer"),'),
            ],
        },
    ),
    "intensity": Expected(
        "it gives up within ten minutes",
        "the supervisor gave up, although the lidar only crashes now and then",
        {
            "the lidar is unplugged, and the supervisor never gives up": [("max_restarts=1", "max_restarts=10000")],
            "the tree has other children than before": [('rr.ChildSpec(Lidar, id="lidar"), ', "")],
        },
    ),
    "order_of_starts": Expected(
        "the start fails at once",
        "the system does not start",
        {
            "the viewer runs, and has no camera": [
                ('self.registrar.load("cameras/camera", "front").response', '"picture of front"')
            ],
            "the tree has other children than before": [('id="viewer"', 'id="zviewer"')],
        },
    ),
    "poison": Expected(
        "one is parsed, then the supervisor gives up",
        "the supervisor gave up: the same text has killed each new parser",
        {
            "a text was lost, and nobody hears of it": [
                ("parser.wait_running(timeout_s=5)", "parser.wait_running(5)\n                break")
            ],
            "the text two is right, and was not parsed": [
                ("", ""),
                ("            parser.wait_running(timeout_s=5)\n", ""),
            ],
        },
    ),
    "state_that_survives": Expected(
        "1",
        "the coins from before the kill are forgotten",
        {
            "the sum is written only at a clean stop": [
                ("", ""),
                ("        return self.sum\n", "        return self.sum\n\n    def on_stop(self) -> None:\n"),
                ('        new = self.file.with_name("sum.new")\n        new.write_text(str(self.sum))\n', ""),
                ("        new.replace(self.file)  # whole, or not at all\n", ""),
                ("on_stop(self) -> None:\n", "on_stop(self) -> None:\n        self.file.write_text(str(self.sum))\n"),
            ],
            "two tills share one sum": [("", ""), ('Path(folder, "sum")', 'Path(folder).with_name("sum")')],
        },
    ),
    "sharing": Expected(
        "twice",
        "the camera front is opened twice",
        {
            "the cameras front and rear are the same one": [
                ("OpenCamera(device, wanted_by=registrar.name)", 'OpenCamera("front", wanted_by="all")')
            ],
            "guard looks through the camera, and does not hold it": [
                ("def look", "HELD: dict[str, rr.Query] = {}\n\n\ndef look"),
                ("    return registrar", "    HELD[device] = HELD.get(device) or registrar"),
                ("wanted_by=registrar.name)", "wanted_by=registrar.name)"),
                ("registrar.name))", "registrar.name))\n    return HELD[device]"),
            ],
        },
    ),
    "dependencies": Expected(
        "no",
        "the lens broke, and the holder of the camera did not hear it",
        {
            "the camera uses a lens that nobody holds": [
                ("", ""),
                ("        lens = self.registrar", "        with self.registrar"),
                ('"wide")\n', '"wide") as lens:\n'),
                ('        return f"{device}', '            return f"{device}'),
            ],
            "the last camera is closed, and a lens stays loaded": [
                ('return f"{device}', 'self.registrar.load("lenses/lens", "wide")\n        return f"{device}')
            ],
        },
    ),
    "statuses": Expected(
        "nothing",
        "the lens is FATAL, and the application does not hear it",
        {
            "the application hears of dust on the lens": [("status.handled()", "pass")],
            "the lens is in ERROR, and the application does not hear it": [
                ("status.handled()", "if status.state is not rr.State.FATAL:\n            status.handled()")
            ],
        },
    ),
    "recovery": Expected(
        "the turn fails, although the motor is OK",
        "after the crash the motor does not turn, although it is there",
        {
            "the left motor is still there, and its holder heard FATAL": [('recovery="keep"', 'recovery="lost"')],
            "the right motor was unplugged, and its holder believes that it works": [
                ('return f"{self', 'self.connections.get(message) or self.connect(message)\n        return f"{self')
            ],
        },
    ),
    "time_outs": Expected(
        "for ever",
        "the cable is loose, and the robot still waits",
        {
            "the cable is loose, and reading() raised an error": [("timeout=None", "timeout=0.9")],
            "the sensor works, needs 0.33 s, and was given up": [("", ""), ("timeout=0.9", "timeout=0.01")],
            "the cable is loose, and reading() made a reading up": [("", ""), ("return None", "return 0.0")],
        },
    ),
    "back_pressure": Expected(
        "nearly all of them",
        "too many readings wait in the mailbox of the filter",
        {
            "the mailbox was full, and the lidar stopped at an error": [
                ("    def __init__", "    mailbox_limit = 20\n\n    def __init__")
            ],
            "readings were lost, and nobody heard of it": [
                ("    def __init__", "    mailbox_limit = 20\n\n    def __init__"),
                ("to.tell(reading)", "try:\n            to.tell(reading)\n        except Exception:\n            pass"),
            ],
        },
    ),
    "budgets": Expected(
        "nothing: both are on",
        "heater and pump are both on, and the budget knows nothing of them",
        {
            "the heater costs 70 W, and the budget has another figure": [
                ('@rr.server("device")', '@rr.server("device", cost={"watts": 20})')
            ],
            "the battery is another one": [('Pool("watts", 100)', 'Pool("watts", 1000)')],
            "the urgent pump was refused": [("", ""), ("WATTS[name]}", "70.0 if name == 'heater' else 101.0}")],
        },
    ),
    "action_graph": Expected(
        "nobody",
        "the camera arm is broken, and nobody has taken a picture",
        {
            "no camera is broken, and a camera works without need": [
                ('"conditions": []', '"conditions": ["on_error -> run"]')
            ],
            "the camera arm is broken, and has taken the picture": [("if given.camera in BROKEN", "if False")],
        },
    ),
}


def judged(exercise: Exercise, text: str, tmp_path: Path) -> Outcome:
    file = tmp_path / exercise.file_name
    file.write_text(text)
    found = check_file(exercise, file, LIMIT_S)
    assert list(tmp_path.iterdir()) == [file]  # nothing is left beside it
    return found


def mended(exercise: Exercise, changes: list[tuple[str, str]]) -> str:
    text = exercise.text
    for old, new in changes:
        if not old:
            text = exercise.solution
            continue
        assert old in text, f"{exercise.name}: no {old!r}"
        text = text.replace(old, new)
    return text


@pytest.mark.timeout(200)
@pytest.mark.parametrize("name", EXERCISES)
def test_the_file_as_given_fails_with_a_picture_and_answers_the_question(name: str, tmp_path: Path) -> None:
    exercise = EXERCISES[name]
    found = judged(exercise, exercise.text, tmp_path)

    assert (found.passed, found.what) == (False, EXPECTED[name].given), found
    assert re.search(f"{exercise.file_name}, line \\d+$", found.where), found.where
    assert found.expected
    assert found.got
    assert re.search("[━│├─]", found.picture), found.picture
    assert exercise.question.right(Seen(lines=found.lines)) == {EXPECTED[name].answer}


@pytest.mark.timeout(200)
@pytest.mark.parametrize("name", EXERCISES)
def test_the_solution_passes_with_a_picture(name: str, tmp_path: Path) -> None:
    found = judged(EXERCISES[name], EXERCISES[name].solution, tmp_path)

    assert found.passed, found
    assert re.search("[━│├─]", found.picture), found.picture


WRONG = [
    pytest.param(name, what, id=f"{name}-{what}", marks=pytest.mark.slow if number else ())
    for name in EXPECTED
    for number, what in enumerate(EXPECTED[name].wrong)
]


@pytest.mark.timeout(200)
@pytest.mark.parametrize(("name", "what"), WRONG)
def test_a_typical_wrong_mend_fails_with_a_message_of_its_own(name: str, what: str, tmp_path: Path) -> None:
    exercise = EXERCISES[name]
    found = judged(exercise, mended(exercise, EXPECTED[name].wrong[what]), tmp_path)

    assert (found.passed, found.what) == (False, what), found
    assert what != EXPECTED[name].given


def test_each_exercise_has_its_expectations_and_two_wrong_mends() -> None:
    assert list(EXPECTED) == list(EXERCISES)
    assert [name for name, one in EXPECTED.items() if len(one.wrong) < 2] == []


def test_an_exercise_has_a_question_three_hints_and_a_reason() -> None:
    for one in EXERCISES.values():
        assert one.declared.question.endswith("?"), one.name
        assert len(one.declared.answers) >= 3
        assert len(set(one.declared.hints)) == 3
        assert one.declared.tried
        assert one.title
        assert one.about
        assert one.why
        assert one.text != one.solution


def test_the_programs_of_the_exercises_are_clean(tmp_path: Path) -> None:
    """They are no modules of the package, so the linters of the package do not see them."""
    for one in EXERCISES.values():
        for kind, text in (("given", one.text), ("solution", one.solution), ("check", one.check)):
            (tmp_path / f"{one.name}_{kind}.py").write_text(text)
            ast.parse(text)
    rules = ["--config", str(REPOSITORY / "pyproject.toml"), "--no-cache", "--ignore", "D,T20,INP"]
    ruff = Path(sys.executable).with_name("ruff")
    done = subprocess.run([ruff, "check", *rules, tmp_path], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
