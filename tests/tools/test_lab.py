"""The lab: each experiment runs by its button, shows what it promises, ends by itself and leaves nothing."""

from __future__ import annotations

import asyncio
import json
import re
import shutil
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from rr_actors.base.errors import UsageError
from rr_actors.testing.experiments import Seen, Trial, check_levers, check_trials
from rr_actors.tools.web.lab.lab_folder import read_lab
from rr_actors.tools.web.lab.lab_runs import Place, Run
from support import eventually
from support_browser import LAB, Tab, needs_chromium, web

pytestmark = pytest.mark.timeout(180)

EXPERIMENTS = read_lab([LAB]).experiments
LONG_S = 60.0
SHARING = LAB / "sharing_and_parts.py"
AT_ONCE = 10  # experiments side by side: more of them make each too slow to show what it should


@pytest.fixture(autouse=True)
def temporary_place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A directory for temporary files that no other test uses, here and in the processes that are started."""
    place = tmp_path / "temporary"
    place.mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(place))
    monkeypatch.setenv("TMPDIR", str(place))


def left_behind() -> list[Path]:
    return list(Path(tempfile.gettempdir()).glob("rr-lab-*"))


def test_each_experiment_says_what_it_is_and_what_to_look_for() -> None:
    assert len({one.title for one in EXPERIMENTS.values()}) == len(EXPERIMENTS) == 21
    for one in EXPERIMENTS.values():
        assert one.about
        assert one.look_for
        assert "def main(" in one.code
        assert '"""' not in one.code


def test_a_run_that_is_stopped_leaves_nothing() -> None:
    before = left_behind()
    run = Run(SHARING)
    try:
        eventually(lambda: run.watch is not None and run.watch.now.children, LONG_S)
        assert len(left_behind()) == len(before) + 1
    finally:
        run.stop()
    assert not run.is_running
    assert left_behind() == before
    run.stop()


def test_a_place_has_one_run_however_fast_buttons_are_pressed_and_none_when_its_page_has_gone() -> None:
    before, runs = left_behind(), set[Run]()

    async def press() -> None:
        place = Place(runs)
        assert await place.start(SHARING)
        assert await asyncio.gather(place.start(SHARING), place.start(LAB / "restart_storm.py")) == [True, True]
        assert place.run is not None
        assert [run.name for run in runs if run.is_running] == [place.run.name] == ["restart_storm"]
        await asyncio.gather(place.start(SHARING), place.leave())

    asyncio.run(press())
    assert runs == set()
    assert left_behind() == before


def test_a_run_that_ends_by_itself_leaves_nothing_and_shows_its_error() -> None:
    before = left_behind()
    run = Run(LAB / "no_such_experiment.py")
    eventually(lambda: not run.is_running, LONG_S)
    assert "No module named" in "\n".join(run.lines)
    assert left_behind() == before


def test_an_experiment_imports_what_is_beside_it_also_when_its_code_was_changed(tmp_path: Path) -> None:
    (tmp_path / "_words.py").write_text('WORD = "beside"')
    program = tmp_path / "mine.py"
    program.write_text("from _words import WORD\ndef main(state_dir):\n    print(WORD, flush=True)")
    runs = [Run(program), Run(program, code=program.read_text())]
    for run in runs:
        eventually(lambda run=run: not run.is_running, LONG_S)
        assert run.lines == ["beside"]


@needs_chromium
def test_the_page_names_a_file_that_is_broken_and_serves_the_others_also_one_that_is_mended(
    tab: Tab, tmp_path: Path
) -> None:
    mine = tmp_path / "mine"
    mine.mkdir()
    shutil.copy(SHARING, mine)
    broken = mine / "broken.py"
    broken.write_text("def main(:")
    with web("--lab", LAB, "--lab", mine) as url:
        tab.goes_to(url)
        tab.sees(
            "nav", "Sharing and dependencies", f"{broken}: expected a Python program", "expected a name that no other"
        )
        broken.write_text('"""Mended: now."""\ndef main(state_dir): ...')
        tab.do(tab.page.reload())
        tab.clicks("Mended")
        tab.sees("[role=status]", "broken waits for you")


@needs_chromium
@pytest.mark.slow
def test_an_experiment_is_started_and_stopped_by_a_button_and_ends_with_its_page(tab: Tab) -> None:
    before = left_behind()
    with web("--lab", LAB) as url:
        tab.goes_to(url)
        tab.clicks("Sharing and dependencies")
        assert "Look for:" not in tab.text("body")
        tab.clicks("what to look for")
        tab.sees("body", "Look for: how many cameras and lenses there are")
        tab.clicks("run it")
        code = tab.do(tab.locate("textarea").input_value())
        assert "def main(state_dir: str)" in code
        tab.sees('button[data-path="root/lenses"]', "running", limit_s=LONG_S)
        tab.sees("[role=log]", "the mapper loads the front camera")
        tab.clicks("stop it")
        eventually(lambda: left_behind() == before, what="nothing left of it")
        tab.sees("[role=status]", "sharing_and_parts has ended")
        tab.clicks("Escalation")
        tab.clicks("run it")
        tab.sees('button[data-path="root/base/wheel/motor"]', "running", limit_s=LONG_S)
        tab.do(tab.page.goto("about:blank"))
        eventually(lambda: left_behind() == before, what="nothing left of a page that was left")


@needs_chromium
@pytest.mark.slow
def test_an_experiment_ends_with_the_lab(tab: Tab) -> None:
    before = left_behind()
    with web("--lab", LAB) as url:
        tab.goes_to(url)
        tab.clicks("A poisoned message")
        tab.clicks("run it")
        tab.sees('button[data-path="root/parser"]', "running", limit_s=LONG_S)
    assert left_behind() == before


CHANGED = """
import rr_actors as rr
class Mine(rr.Actor):
    def on_receive(self, message):
        return f"my own answer to {message}"
def main(state_dir, number):
    with rr.System([rr.ChildSpec(Mine, id="mine")], state_dir=state_dir) as system:
        print(system.ref("mine").ask(number, timeout=20), flush=True)
"""


SLEEPS = """
import signal
def main(state_dir):
    signal.pause()
"""


def test_changed_code_runs_in_the_place_of_an_experiment_with_its_levers() -> None:
    before = left_behind()
    run = Run(SHARING, {"number": 7}, CHANGED)
    eventually(lambda: not run.is_running, LONG_S)
    assert run.lines == ["my own answer to 7"]
    assert run.has_finished
    assert left_behind() == before


def test_a_run_that_fails_or_is_stopped_has_not_finished() -> None:
    failed, stopped = Run(SHARING, {}, "1 / 0"), Run(SHARING, {}, SLEEPS)
    eventually(lambda: not failed.is_running, LONG_S)
    stopped.stop()
    assert not failed.has_finished
    assert not stopped.has_finished
    assert "ZeroDivisionError" in failed.lines[-1]


def watts_on(seen: Seen, step: str) -> int:
    on = next(line for line in seen.lines[list(seen.lines).index(step) :] if line.startswith("on:"))
    return sum(40 if device == "pump" else 20 for device in on.split()[1:])


def waits(seen: Seen, modem: str) -> list[str]:
    return [line.rpartition("(")[2] for line in seen.lines if line.startswith(f"root/{modem}, wait")]


def restarts(count: int, path: str) -> Callable[[Seen], bool]:
    return lambda seen: seen.count("restarted", path) == count


def prints(*texts: str) -> Callable[[Seen], bool]:
    return lambda seen: all(map(seen.prints, texts))


def trial(name: str, levers: dict[str, Any], right: set[str], shows: Callable[[Seen], bool] | None = None) -> Trial:
    return Trial(LAB / f"{name}.py", levers, right, shows)


TRIALS = (
    trial("four_strategies", {}, {"b", "c"}),
    trial("four_strategies", {"child": "a"}, {"a", "b", "c"}),
    trial("four_strategies", {"child": "c"}, {"c"}, restarts(1, "root/one_for_one/c")),
    trial("your_own_tree", {}, {"restart b"}, restarts(1, "root/team/b")),
    trial("your_own_tree", {"strategy": "one_for_all", "child": "a"}, {"restart a", "restart b", "restart c"}),
    trial("your_own_tree", {"strategy": "rest_for_one", "kills": 2}, {"restart b", "restart c"}),
    trial("your_own_tree", {"max_restarts": 0}, {"give up"}),
    trial("your_own_tree", {"max_restarts": 1, "kills": 2, "child": "c"}, {"restart c", "give up"}),
    trial("your_own_tree", {"kills": 3}, {"restart b", "give up"}, restarts(2, "root/team/b")),
    trial("your_own_tree", {"max_restarts": 3, "kills": 3}, {"restart b"}, restarts(3, "root/team/b")),
    trial("your_own_tree", {"max_restarts": 3, "kills": 4}, {"restart b", "give up"}, restarts(3, "root/team/b")),
    trial("restart_storm", {}, {"branch", "root, too"}, restarts(6, "root/branch/broken")),
    trial("restart_storm", {"max_restarts": 1}, {"branch", "root, too"}, restarts(2, "root/branch/broken")),
    trial("restart_storm", {"max_restarts": 2}, {"branch", "root, too"}, restarts(4, "root/branch/broken")),
    trial("escalation_levels", {}, {"wheel", "base"}, prints("kill 4")),
    trial("escalation_levels", {"kills": 1}, {"none: the motor alone"}, restarts(1, "root/base/wheel/motor")),
    trial("escalation_levels", {"kills": 2}, {"wheel"}, restarts(1, "root/base/wheel/motor")),
    trial("escalation_levels", {"kills": 3}, {"wheel"}, restarts(2, "root/base/wheel/motor")),
    trial("back_off", {}, {"over 3 s"}, lambda seen: waits(seen, "left") == waits(seen, "right")),
    trial("back_off", {"factor": 1.0}, {"under 1.5 s"}, prints("wait 2: under 1.5 s (1.00 s)")),
    trial(
        "back_off",
        {"factor": 1.0, "jitter": 0.5},
        {"under 1.5 s"},
        lambda seen: waits(seen, "left") != waits(seen, "right"),
    ),
    trial("poisoned_actor", {}, {"never see it"}),
    trial("frozen_child", {}, {"another process takes its place"}, prints("is no longer there")),
    trial("frozen_child", {"heartbeat_s": 3.0}, {"another process takes its place"}, prints("is no longer there")),
    trial("frozen_child", {"heartbeat_s": 0.0}, {"it goes on after that"}),
    trial("sharing_and_parts", {}, {"one"}),
    trial("kill_in_a_load", {}, {"the map, a little later"}),
    trial("handled_status", {}, {"the cameras' manager"}),
    trial("handled_status", {"handled": "no"}, {"the cameras' manager", "the consumer"}),
    trial("refused_ring", {}, {"an error that names the ring"}),
    trial("crash_in_unload", {}, {"its unload runs again"}),
    trial("brownout", {}, {"radio", "lamp"}, lambda seen: watts_on(seen, "for 60 W") == 60),
    trial("brownout", {"capacity": 80}, {"radio", "lamp"}, lambda seen: watts_on(seen, "for 80 W") == 80),
    trial("brownout", {"capacity": 40}, {"radio", "lamp"}, lambda seen: watts_on(seen, "for 40 W") == 40),
    trial("brownout", {"priority": 2}, {"nobody: the pump waits"}),
    trial("generator", {}, {"the generator starts, and nobody is switched off"}),
    trial("generator", {"fuel": "no"}, {"the radio and the lamp are switched off"}),
    trial("tour_guide", {}, {"it is paused"}),
    trial("tour_guide", {"idle": "unload"}, {"it has been ended"}),
    trial("tour_guide", {"linger_s": 30.0}, {"it runs on"}),
    trial("rebinding", {}, {"the lidar, and later the camera again"}),
    trial("rebinding", {"settle_s": 30.0}, {"the lidar, to the end"}),
    trial("rebinding", {"at_least_hz": 50}, {"nothing: it ends with an error"}),
    trial("keep", {}, {"radio 0, radio 1 and radio 2"}, prints("radio 0 is killed", "1 wanted: radio 0")),
    trial(
        "keep",
        {"fault": "silent", "then_wanted": 5},
        {"radio 0, radio 1 and radio 2"},
        prints("radio 0 is silent", "5 wanted: radio 0, radio 1, radio 2, radio 3, radio 4"),
    ),
    trial("keep", {"delay_s": 20.0}, {"radio 1 and radio 2"}),
    trial("umrf", {}, {"the spare camera takes it"}),
    trial("umrf", {"broken": "none"}, {"the arm's camera takes it"}),
    trial("umrf", {"broken": "spare"}, {"the arm's camera takes it"}),
    trial("umrf", {"killed": "actions"}, {"the spare camera takes it", "the spare camera begins again, as attempt 2"}),
    trial("full_mailbox", {}, {"nothing: readings become dead letters"}),
    trial("full_mailbox", {"way": "ask"}, {"each answer, as slow as the filter"}),
    trial("full_mailbox", {"where": "its own process"}, {"MailboxFull"}),
    trial("full_mailbox", {"limit": 1000}, {"nothing: all of them wait"}),
    trial("philosophers", {}, {"one is refused at once, the others eat"}),
    trial("philosophers", {"where": "processes of their own"}, {"all wait, until a time limit ends one"}),
    trial("philosophers", {"first": "the fork with the lower number"}, {"all eat, one after another"}),
    trial("philosophers", {"way": "tell"}, {"all wait for ever"}),
    trial("lost_token", {}, {"it is gone, and the ring stands still"}),
    trial("lost_token", {"watch": "the program, with a monitor"}, {"the one that watches makes a new one"}),
)


def test_each_lever_is_played_with_each_of_its_values() -> None:
    assert {Path(one.file).stem for one in TRIALS} == set(EXPERIMENTS)
    check_levers(TRIALS)


@pytest.mark.slow
@pytest.mark.parametrize("first", range(0, len(TRIALS), AT_ONCE))
def test_each_run_does_what_its_levers_say_and_shows_which_answers_are_right(first: int) -> None:
    before = left_behind()
    for seen in check_trials(TRIALS[first : first + AT_ONCE], at_once=AT_ONCE):
        assert not any(one.event == "dead_letter" and "Question" in str(one.facts) for one in seen.events)
    assert left_behind() == before


# -- trials of one's own ---------------------------------------------------------------------------------------------

PRINTS = '''"""It prints: what its lever says."""

# /// lab
# question = "What will it print?"
# levers = [{name = "times", label = "how many lines", choices = [1, 2, 3]}]
# [answers]
# "one line" = {}
# "two lines" = {prints = "line 1"}
# "three lines" = {prints = "line 2"}
# ///

def main(state_dir, times=1):
    for number in range(times):
        print("line", number)
'''


@pytest.fixture
def printing(tmp_path: Path) -> Path:
    file = tmp_path / "it_prints.py"
    file.write_text(PRINTS)
    return file


def test_trials_that_are_right_return_what_each_has_shown(printing: Path) -> None:
    before = left_behind()
    trials = [
        Trial(printing, {}, {"one line"}),
        Trial(printing, {"times": 2}, {"two lines"}, lambda seen: seen.prints("1")),
    ]

    seen = check_trials(trials, at_once=1)

    assert [one.lines for one in seen] == [["line 0"], ["line 0", "line 1"]]
    assert left_behind() == before


def test_trials_that_are_wrong_are_named_with_what_they_have_printed(printing: Path, tmp_path: Path) -> None:
    raises = tmp_path / "raises.py"
    raises.write_text('"""It raises."""\ndef main(state_dir):\n    raise ValueError("no such device")')
    trials = [
        Trial(printing, {"times": 2}, {"one line"}),
        Trial(printing, {}, {"one line"}, lambda _: False),
        Trial(raises),
    ]

    with pytest.raises(AssertionError) as error:
        check_trials(trials)

    text = str(error.value)
    assert "it_prints(times=2): right: expected 'one line', got 'two lines'\n    line 0\n    line 1\n" in text
    assert "it_prints(): shows: expected True of what the run has shown, got False\n    line 0\n" in text
    assert "raises(): expected a run that comes to its end, got an error or the time limit\n" in text
    assert text.endswith("ValueError: no such device")


def test_values_of_levers_that_no_trial_has_are_named_by_their_labels(printing: Path) -> None:
    check_levers([Trial(printing), Trial(printing, {"times": 2}), Trial(printing, {"times": 3})])
    with pytest.raises(AssertionError) as error:
        check_levers([Trial(printing, {"times": 2})])
    assert str(error.value) == "\n".join(
        f"{printing}: times (how many lines): expected a trial with {value}, got none" for value in (1, 3)
    )


@pytest.mark.parametrize(
    ("levers", "right", "says"),
    [
        ({"time": 1}, [], "levers: expected one of times, got 'time'; did you mean 'times'?"),
        ({"times": 4}, [], "levers.times: expected one of 1, 2, 3, got 4"),
        ({}, ["one lines"], "right: expected one of one line, two lines, three lines, got 'one lines'; did you mean"),
    ],
)
def test_a_trial_of_what_an_experiment_does_not_have_is_refused_before_anything_runs(
    printing: Path, levers: dict[str, Any], right: list[str], says: str
) -> None:
    for check in (check_levers, check_trials):
        with pytest.raises(UsageError, match=re.escape(says)):
            check([Trial(printing, levers, right)])


@needs_chromium
@pytest.mark.slow
def test_the_lab_asks_runs_what_was_chosen_compares_and_plays_it_again(tab: Tab) -> None:
    with web("--lab", LAB) as url:
        tab.goes_to(url)
        tab.clicks("A tree of your own")
        tab.sees("body", "What will the supervisor team do?", "strategy")
        tab.do(tab.page.get_by_label("strategy").click())
        tab.do(tab.page.get_by_role("option", name="rest_for_one").click())
        tab.do(tab.page.get_by_role("checkbox", name="restart b").click())
        href = tab.do(tab.page.get_by_role("link", name="the same as a notebook").get_attribute("href"))
        answer = tab.do(tab.page.request.get(url.partition("/lab")[0] + str(href)))
        notebook = json.loads(tab.do(answer.text()))
        assert "strategy='rest_for_one', max_restarts=2" in notebook["cells"][2]["source"]
        assert tab.do(tab.page.request.get(url.partition("/lab")[0] + "/lab/no.ipynb")).status == 404
        assert "Look for:" not in tab.text("body")
        tab.clicks("run it")
        tab.sees("body", "Look for: the children that start again")
        tab.sees("[role=log]", "SIGKILL to b", "restarted     root/team/c", limit_s=LONG_S)
        assert "Why:" not in tab.text("body")
        tab.clicks("pause")
        tab.sees("[role=toolbar]", "go on", "at ")
        tab.clicks("go on")
        tab.sees(".rr-verdict", "Not quite. You said: restart b. It was: restart b, restart c.", limit_s=LONG_S)
        tab.sees("body", "Why: the strategy says which children start again")
        tab.sees(".rr-status", "has ended")
        for child in ("b", "c"):
            tab.sees(f'button[data-path="root/team/{child}"]', "running", "↻1")
        tab.clicks("again")
        tab.clicks("step")
        tab.waits(lambda: "SIGKILL" not in tab.text("[role=log]"), "the log as it was")
        for _ in range(30):
            tab.clicks("step")
        tab.sees("[role=log]", "SIGKILL to b", "restarted     root/team/c")


@needs_chromium
@pytest.mark.slow
def test_code_cannot_be_changed_where_other_machines_reach_the_lab(tab: Tab) -> None:
    with web("--lab", LAB, "--host", "0.0.0.0") as url:
        tab.goes_to(url.replace("0.0.0.0", "127.0.0.1"))
        tab.clicks("Sharing and dependencies")
        tab.sees("body", "It can be changed where the lab listens at this machine alone.")
        assert tab.do(tab.page.get_by_label("program").is_disabled())


@needs_chromium
@pytest.mark.slow
def test_a_child_is_killed_by_hand(tab: Tab) -> None:
    with web("--lab", LAB) as url:
        tab.goes_to(url)
        tab.do(tab.page.goto(url.partition("?")[0] + "?experiment=sharing_and_parts"))
        tab.clicks("run it")
        tab.sees('button[data-path="root/lenses"]', "running", limit_s=LONG_S)
        tab.do(tab.locate('button[data-path="root/lenses"]').click())
        tab.clicks("kill -9 the chosen child")
        tab.sees('button[data-path="root/lenses"]', "↻1")
        tab.clicks("stop it")
        tab.sees(".rr-verdict", "It did not come to its end.")


@needs_chromium
@pytest.mark.slow
def test_ten_questions_are_answered_with_what_the_docs_say(tab: Tab) -> None:
    with web("--lab", LAB) as url:
        tab.goes_to(url)
        tab.clicks("Ten questions", role="link")
        tab.do(tab.page.get_by_role("radio", name="one_for_all").click())
        tab.sees("body", "Not quite. rest_for_one, with the driver first.", "0 of 10 right")
        tab.do(tab.page.get_by_role("radio", name="the cameras, but not the count").click())
        tab.sees("body", "Right. The three cameras", "1 of 10 right")


RESULTS = {
    "The four strategies side by side": (['button[data-path="root/rest_for_one/c"]', "↻1"], "SIGKILL to template"),
    "A restart storm against the intensity window": (
        ['button[data-path="root"]', "stopped"],
        "the tree has ended: shutdown",
    ),
    "Escalation": (['button[data-path="root/base"]', "↻1"], "kill 4: SIGKILL"),
    "A poisoned message": (['button[data-path="root/parser"]', "stopped"], "four: nobody is there"),
    "Sharing and dependencies": (['button[data-path="root/cameras"]', "running"], "the guard releases it"),
    "kill -9 in the middle of a load": (
        ['button[data-path="root/maps"]', "↻1"],
        "loaded: the map of kitchen, from attempt 2",
    ),
}


@needs_chromium
@pytest.mark.slow
@pytest.mark.parametrize("button", RESULTS)
def test_each_button_shows_what_its_experiment_promises(button: str, tab: Tab) -> None:
    (selector, *shown), printed = RESULTS[button]
    before = left_behind()
    with web("--lab", LAB) as url:
        tab.goes_to(url)
        tab.clicks(button)
        tab.clicks("run it")
        tab.sees("[role=log]", printed, limit_s=LONG_S)
        tab.sees(selector, *shown, limit_s=LONG_S)
        tab.sees(".rr-status", "has ended", limit_s=LONG_S)
        eventually(lambda: left_behind() == before)
