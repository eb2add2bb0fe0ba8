"""The lab: each experiment runs by its button, shows what it promises, ends by itself and leaves nothing."""

from __future__ import annotations

import asyncio
import tempfile
from pathlib import Path

import pytest

from rr_actors.tools.web.lab_runs import Place, Run, experiments
from support import eventually
from support_browser import Tab, needs_chromium, web

pytestmark = pytest.mark.timeout(180)

LONG_S = 60.0


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
    assert len({one.title for one in experiments()}) == 6
    for one in experiments():
        assert one.about
        assert one.look_for
        assert "def main(state_dir: str)" in one.code
        assert '"""' not in one.code


def test_a_run_that_is_stopped_leaves_nothing() -> None:
    before = left_behind()
    run = Run("sharing_and_parts")
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
        assert await place.start("sharing_and_parts")
        assert await asyncio.gather(place.start("sharing_and_parts"), place.start("restart_storm")) == [True, True]
        assert place.run is not None
        assert [run.name for run in runs if run.is_running] == [place.run.name] == ["restart_storm"]
        await asyncio.gather(place.start("sharing_and_parts"), place.leave())

    asyncio.run(press())
    assert runs == set()
    assert left_behind() == before


def test_a_run_that_ends_by_itself_leaves_nothing_and_shows_its_error() -> None:
    before = left_behind()
    run = Run("no_such_experiment")
    eventually(lambda: not run.is_running, LONG_S)
    assert "No module named" in "\n".join(run.lines)
    assert left_behind() == before


@needs_chromium
@pytest.mark.slow
def test_an_experiment_is_started_and_stopped_by_a_button_and_ends_with_its_page(tab: Tab) -> None:
    before = left_behind()
    with web("--lab") as url:
        tab.goes_to(url)
        tab.clicks("Sharing and dependencies")
        tab.sees("body", "Look for:", "def main(state_dir: str)", "two consumers share it")
        tab.sees('[data-path="root/lenses"]', "running", limit_s=LONG_S)
        tab.sees("[role=log]", "the mapper loads the front camera")
        tab.clicks("stop it")
        eventually(lambda: left_behind() == before, what="nothing left of it")
        tab.sees("[role=status]", "sharing_and_parts has ended")
        tab.clicks("Escalation")
        tab.sees('[data-path="root/base/wheel/motor"]', "running", limit_s=LONG_S)
        tab.do(tab.page.goto("about:blank"))
        eventually(lambda: left_behind() == before, what="nothing left of a page that was left")


@needs_chromium
@pytest.mark.slow
def test_an_experiment_ends_with_the_lab(tab: Tab) -> None:
    before = left_behind()
    with web("--lab") as url:
        tab.goes_to(url)
        tab.clicks("A poisoned message")
        tab.sees('[data-path="root/parser"]', "running", limit_s=LONG_S)
    assert left_behind() == before


RESULTS = {
    "The four strategies side by side": (['[data-path="root/rest_for_one/c"]', "↻1"], "SIGKILL to template"),
    "A restart storm against the intensity window": (['[data-path="root"]', "stopped"], "the tree has ended: shutdown"),
    "Escalation": (['[data-path="root/base"]', "↻1"], "kill 4: SIGKILL"),
    "A poisoned message": (['[data-path="root/parser"]', "stopped"], "four: nobody is there"),
    "Sharing and dependencies": (['[data-path="root/cameras"]', "running"], "the guard releases it"),
    "kill -9 in the middle of a load": (
        ['[data-path="root/maps"]', "↻1"],
        "loaded: the map of kitchen, from attempt 2",
    ),
}


@needs_chromium
@pytest.mark.slow
@pytest.mark.parametrize("button", RESULTS)
def test_each_button_shows_what_its_experiment_promises(button: str, tab: Tab) -> None:
    (selector, *shown), printed = RESULTS[button]
    before = left_behind()
    with web("--lab") as url:
        tab.goes_to(url)
        tab.clicks(button)
        tab.sees("[role=log]", printed, limit_s=LONG_S)
        tab.sees(selector, *shown, limit_s=LONG_S)
        tab.sees(".rr-status", "has ended", limit_s=LONG_S)
        eventually(lambda: left_behind() == before)
