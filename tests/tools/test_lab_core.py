"""What the lab decides without a page: levers, questions and their answers, playback, notebooks."""

from __future__ import annotations

import ast
import inspect
import json
import re
import runpy
import subprocess
import sys
from pathlib import Path

import nbformat
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rr_actors.base.errors import ConfigError
from rr_actors.system.recording.event_memory import Event
from rr_actors.system.recording.timeline_lanes import Bar, Lane, Mark
from rr_actors.system.recording.timelines import Timeline
from rr_actors.tools.web.lab.lab_declarations import LabDeclaration, LabExperiment, Lever, Question, Seen, Sign
from rr_actors.tools.web.lab.lab_folder import read_experiment, read_lab
from rr_actors.tools.web.lab.lab_notebook import notebook_of
from rr_actors.tools.web.lab.lab_questions import QUESTIONS
from rr_actors.tools.web.lab.playback import PACES, Playback
from support import REPOSITORY
from support_cli import run_cli

DOCS = Path(__file__).parents[2] / "docs"
ROOT = DOCS.parent
LAB = ROOT / "examples" / "lab"
EXPERIMENTS = read_lab([LAB]).experiments
ANSWERS = {"a": Sign(event="restarted", path="root/a"), "said": Sign(prints="hello"), "neither": Sign()}
QUESTION = Question("Which?", ANSWERS)
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
    assert (
        Question("Which?", {"a": Sign(prints="a")}).verdict({"a"}, Seen()) == "This run has shown none of the answers."
    )


def test_levers_have_their_first_value_unless_another_is_chosen() -> None:
    levers = (Lever("kills", "kills", (1, 2)), Lever("child", "child", ("a", "b")))
    experiment = LabExperiment(Path("room/name.py"), "", "", "", "", "", LabDeclaration(levers=levers))
    assert experiment.name == "name"
    assert experiment.values({}) == {"kills": 1, "child": "a"}
    assert experiment.values({"kills": "2"}) == {"kills": 2, "child": "a"}
    assert experiment.values({"kills": "3"}) is None
    assert experiment.values({"no such lever": "1"}) is None


@pytest.mark.parametrize("name", EXPERIMENTS)
def test_the_levers_of_an_experiment_are_the_parameters_of_its_program(name: str) -> None:
    experiment = EXPERIMENTS[name]
    program = runpy.run_path(str(experiment.program))
    parameters = list(inspect.signature(program["main"]).parameters.values())[1:]
    assert {one.name: one.default for one in parameters} == {one.name: one.choices[0] for one in experiment.levers}
    assert experiment.question is not None
    assert experiment.code.startswith("from __future__ import annotations\n")


def test_the_page_names_each_experiment_by_its_title() -> None:
    rows = re.findall(r"^\| ([^|]+) \|", (REPOSITORY / "docs" / "console.md").read_text(), re.MULTILINE)
    assert {experiment.title.partition(":")[0] for experiment in EXPERIMENTS.values()} - set(rows) == set()


@pytest.mark.parametrize("name", EXPERIMENTS)
def test_what_is_read_before_a_question_does_not_answer_it(name: str) -> None:
    experiment = EXPERIMENTS[name]
    assert experiment.question is not None
    told = " ".join((experiment.title, experiment.about, experiment.question.text)).lower()
    answers = [words for answer in experiment.question.answers if len(words := answer.lower().split()) > 2]
    for words in answers:
        assert " ".join(words[:4]) not in told
    assert experiment.why


def test_every_program_of_the_examples_is_an_experiment() -> None:
    assert read_lab([LAB]).broken == []


# -- a folder of one's own -------------------------------------------------------------------------------------------

MINE = '''"""Mine: what it shows.

More of `it`.

Look for: the child.

Why: it is
supervised.
"""

# /// lab
# place = 2
# question = "What becomes of it?"
# levers = [{name = "kills", label = "how often", choices = [1, 2.5, "never"]}]
# [answers]
# "it runs again" = {event = "restarted", path = "root/a"}
# neither = {}
# ///

import time


def main(state_dir, kills=1):
    time.sleep(kills)
'''


def written(folder: Path, text: str, name: str = "mine.py") -> Path:
    file = folder / name
    file.write_text(text)
    return file


def test_a_file_says_its_title_its_texts_its_levers_and_its_question(tmp_path: Path) -> None:
    mine = read_experiment(written(tmp_path, MINE))

    assert (mine.title, mine.about) == ("Mine: what it shows", "More of it.")
    assert (mine.look_for, mine.why) == ("the child.", "it is supervised.")
    assert mine.code == "import time\n\n\ndef main(state_dir, kills=1):\n    time.sleep(kills)\n"
    assert mine.levers == (Lever("kills", "how often", (1, 2.5, "never")),)
    assert mine.question == Question(
        "What becomes of it?", {"it runs again": Sign(event="restarted", path="root/a"), "neither": Sign()}
    )


def test_a_docstring_and_a_main_are_enough(tmp_path: Path) -> None:
    mine = read_experiment(written(tmp_path, '"""Mine."""\ndef main(state_dir): ...'))

    assert (mine.title, mine.levers, mine.question) == ("Mine", (), None)


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("def main(:", r"mine\.py: expected a Python program, got: .* \(line 1\)"),
        ("def main(state_dir): ...", r"mine\.py: expected a docstring, got none"),
        ('"""Mine."""', r"mine\.py: expected a function main\(state_dir, \.\.\.\), got none"),
        ('"""Mine."""\ndef main(): ...', r"mine\.py: expected a function main\(state_dir, \.\.\.\), got none"),
        (MINE.replace("place = 2", "place = first"), r"mine\.py: lab: not valid TOML"),
        (MINE.replace("question =", "asks ="), r"mine\.py: lab: asks: expected one of .*, got an unknown key"),
        (MINE.replace('1, 2.5, "never"', ""), r"mine\.py: lab: levers\[0\]\.choices"),
        (
            MINE.replace('name = "kills"', 'name = "kill"'),
            r"mine\.py: lab: levers\[0\]\.name: expected a parameter of main\(\): kills, got 'kill' \(str\)",
        ),
        (MINE.replace("prints", "print").replace("event", "evnt"), r"lab: answers\.it runs again\.evnt"),
    ],
)
def test_a_file_that_is_no_experiment_is_named_with_what_is_wrong(text: str, says: str, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=says):
        read_experiment(written(tmp_path, text))


def test_a_folder_has_its_experiments_in_the_order_of_their_places_and_names_what_is_broken(tmp_path: Path) -> None:
    written(tmp_path, MINE, "b_last.py")
    written(tmp_path, MINE.replace("place = 2", "place = 1").replace("Mine:", "First:"), "c_first.py")
    written(tmp_path, '"""No place."""\ndef main(state_dir): ...', "a_without_a_place.py")
    written(tmp_path, "not Python", "broken.py")
    written(tmp_path, MINE, "no-module.py")
    written(tmp_path, "not Python", "_helper.py")
    (tmp_path / "bytes.py").write_bytes(b"\xff\xfe")

    lab = read_lab([tmp_path])

    assert list(lab.experiments) == ["c_first", "b_last", "a_without_a_place"]
    assert [Path(text.partition(":")[0]).name for text in lab.broken] == ["broken.py", "bytes.py", "no-module.py"]


WRONG = {
    "a line that is no comment": (
        MINE.replace("# place = 2", "place = 2"),
        'expected lines from "# /// lab" to "# ///" that begin with "# ", got another form at line 11',
    ),
    "no end": (MINE.replace("# ///\n\nimport", "import"), "got another form at line 11"),
    "a second block": (MINE + "# /// lab\n# place = 3\n# ///\n", "expected one block, got another at line 25"),
    "TOML that is none": (MINE.replace("place = 2", "place ="), "not valid TOML: Invalid value (at line 12"),
    "a truth value as a choice": (MINE.replace('2.5, "never"', "true"), "levers[0].choices[1]: expected"),
    "no choices": (MINE.replace('1, 2.5, "never"', ""), "levers[0].choices: expected"),
    "two levers of one name": (
        MINE.replace("levers = [", 'levers = [{name = "kills", label = "", choices = [1]}, '),
        "levers[1].name: expected a name that no other lever has, got 'kills' (str)",
    ),
    "two choices that look alike": (
        MINE.replace('"never"', '"1"'),
        "levers[0].choices[2]: expected a value that no other choice has, got '1' (str)",
    ),
    "a choice that the parameter cannot have": (
        MINE.replace("kills=1", "kills: float = 1"),
        "levers[0].choices[2]: expected `float`, as main() has it, got 'never' (str)",
    ),
    "another default": (
        MINE.replace("kills=1", "kills=2"),
        "levers[0].choices[0]: expected the default of main(), 2, got 1 (int)",
    ),
    "a parameter that nobody gives": (
        MINE.replace("kills=1", "kills=1, *, child"),
        "levers: expected a lever for child, a parameter without a default, got none",
    ),
    "answers without a question": (
        MINE.replace('# question = "What becomes of it?"\n', ""),
        "question: expected a text, as there are answers, got none",
    ),
    "a question without answers": (
        "\n".join(line for line in MINE.splitlines() if not line.startswith(("# [answers", '# "it', "# neither"))),
        "answers: expected a table, as there is a question, got none",
    ),
    "an event that is none": (MINE.replace('"restarted"', '"restart"'), "got 'restart'; did you mean 'restarted'?"),
    "an event of nobody": (
        MINE.replace(', path = "root/a"', ""),
        "answers.it runs again.path: expected event and path together, got none",
    ),
    "two signs in one": (
        MINE.replace("{event", '{prints = "a", event'),
        "answers.it runs again: expected either prints, or event and path, got both",
    ),
}


@pytest.mark.parametrize("case", WRONG)
def test_a_declaration_that_cannot_be_right_is_named_with_file_place_expected_and_got(
    case: str, tmp_path: Path
) -> None:
    text, says = WRONG[case]
    file = written(tmp_path, text)

    with pytest.raises(ConfigError) as error:
        read_experiment(file)

    assert str(error.value).startswith(f"{file}: lab: ")
    assert says in str(error.value)


def test_all_that_is_wrong_in_a_file_is_named_at_once(tmp_path: Path) -> None:
    text = MINE.replace("kills=1", "kills=2").replace('"restarted"', '"restart"')

    with pytest.raises(ConfigError, match=r"2 faults:\n.*choices\[0\].*\n.*answers\.it runs again\.event"):
        read_experiment(written(tmp_path, text))


def test_a_file_that_would_hide_a_module_of_python_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"queue\.py: expected a name that Python can import, and no module"):
        read_experiment(written(tmp_path, MINE, "queue.py"))


def test_folders_are_read_one_after_another_and_a_second_experiment_of_a_name_or_title_is_named(tmp_path: Path) -> None:
    ours, mine = tmp_path / "ours", tmp_path / "mine"
    for folder in (ours, mine):
        folder.mkdir()
    written(ours, MINE, "first.py")
    written(mine, MINE.replace("Mine:", "Another:"), "first.py")
    written(mine, MINE, "second.py")
    written(mine, MINE.replace("Mine:", "A third:").replace("place = 2", "place = 1"), "third.py")
    written(mine, MINE, "test_second.py")

    lab = read_lab([ours, tmp_path / "nowhere", mine])

    assert list(lab.experiments) == ["first", "third"]
    assert lab.broken == [
        f"--lab: {tmp_path}/nowhere: expected a folder with experiments, as examples/lab of the repository, "
        "got: No such file or directory",
        f"{mine}/first.py: name: expected a name that no other experiment has, got 'first', as {ours}/first.py",
        f"{mine}/second.py: title: expected a title that no other experiment has, got 'Mine', as {ours}/first.py",
    ]


def test_a_folder_that_is_not_there_or_has_none_is_refused_with_what_to_give(tmp_path: Path) -> None:
    for folder in (tmp_path, tmp_path / "nowhere"):
        ran = run_cli("web", "--lab", LAB, "--lab", folder)
        assert ran.returncode == 2
        assert f"--lab: {folder}: expected a folder with experiments, as examples/lab of the repository" in ran.stderr


def test_without_a_folder_the_command_says_what_to_give() -> None:
    ran = run_cli("web", "--lab")

    assert (ran.returncode, ran.stdout) == (2, "")
    assert ran.stderr == (
        "rr-actors: Option '--lab' requires an argument: A folder with experiments to serve in place of a system; or "
        "several of them.\n"
    )


@pytest.mark.parametrize("name", EXPERIMENTS)
def test_a_notebook_has_the_same_code_and_the_chosen_levers(name: str) -> None:
    experiment = EXPERIMENTS[name]
    levers = {lever.name: lever.choices[-1] for lever in experiment.levers}
    notebook = nbformat.reads(notebook_of(experiment, levers), as_version=4)
    nbformat.validate(notebook)
    asked, code, call, happened, picture, why = [cell.source for cell in notebook.cells]
    assert experiment.question is not None
    assert f"**{experiment.question.text}**\n\n- " in asked
    assert experiment.why not in asked
    assert why == f"Why: {experiment.why}"
    for source in (code, picture):
        compile(source, "cell", "exec")
    called = ast.parse(call).body[-1]
    assert isinstance(called, ast.Expr)
    assert isinstance(called.value, ast.Call)
    assert {one.arg: ast.literal_eval(one.value) for one in called.value.keywords} == levers
    words = re.findall(r"\b(?:box(?:es)?|buttons?|pages?|squares?|tabs?|clicks?)\b", f"{asked} {happened} {why}")
    assert words == []


def test_a_notebook_shows_what_has_happened(tmp_path: Path) -> None:
    code = """
import rr_actors as rr
def main(state_dir, *, id="mine"):
    with rr.System([rr.ChildSpec(rr.Actor, id=id)], state_dir=state_dir): ...
"""
    experiment = LabExperiment(tmp_path / "mine.py", "Mine", "", "", "", code, LabDeclaration())
    cells = json.loads(notebook_of(experiment, {"id": "lidar"}))["cells"]
    source = "\n".join(cell["source"] for cell in cells if cell["cell_type"] == "code")
    program = written(tmp_path, f"{source}._repr_svg_()".replace("read_timeline(f", "print(read_timeline(f") + ")")

    ran = subprocess.run([sys.executable, program], capture_output=True, text=True, timeout=50)

    assert ran.stdout.startswith("<svg"), ran.stderr
    assert "lidar" in ran.stdout


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
        assert not asked.experiment or asked.experiment in EXPERIMENTS
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
