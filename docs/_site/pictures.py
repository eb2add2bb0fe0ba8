"""Take the pictures of the web page and of the lab, with Chromium: `python docs/_site/pictures.py [PART OF A NAME]`.

They go to docs/images. Look at each before you commit it.
"""

from __future__ import annotations

import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

ROOT = Path(__file__).parents[2]
IMAGES = ROOT / "docs" / "images"
OVERVIEW_S = 120
"""How many seconds the first page's bars and curves show."""
sys.path[:0] = [str(ROOT), str(ROOT / "tests")]

import rr_actors as rr  # noqa: E402
from support_browser import LAB, Chromium, Tab, web  # noqa: E402


class Cameras(rr.Manager):
    """A manager with a server."""

    @rr.server("camera")
    def load_camera(self, request: str) -> str:
        return f"/camera/{request}"


class Lenses(rr.Manager):
    """What cameras depend on."""

    @rr.server("lens")
    def load_lens(self, request: str) -> str:
        return f"/lens/{request}"


class RobotCameras(rr.Manager):
    """Cameras that depend on a lens."""

    @rr.server("camera")
    def load_camera(self, request: str) -> str:
        self.registrar.load("lenses/lens", "wide")
        return f"/camera/{request}"


class Maps(rr.Manager):
    """Maps that depend on cameras."""

    @rr.server("map")
    def load_map(self, request: str) -> str:
        self.registrar.load("cameras/camera", request)
        return f"/map/{request}"


@contextmanager
def robot() -> Iterator[tuple[rr.System, rr.Registrar]]:
    """The system of three pictures, with what its application holds."""
    wheels = [rr.ChildSpec(rr.Actor, id="left"), rr.ChildSpec(rr.Actor, id="right")]
    children = [
        rr.ChildSpec(Lenses, id="lenses"),
        rr.ChildSpec(RobotCameras, id="cameras"),
        rr.ChildSpec(Maps, id="maps"),
        rr.Supervisor(wheels, id="drive", strategy="one_for_all", max_seconds=60),
    ]
    with (
        tempfile.TemporaryDirectory(prefix="robot-") as state,
        rr.System(children, name="robot", state_dir=state) as system,
    ):
        app, guard = system.open_registrar("app"), system.open_registrar("guard")
        for room in ("kitchen", "hall"):
            app.load("maps/map", room)
        for room in ("kitchen", "door"):
            guard.load("cameras/camera", room)
        yield system, app


def warn(system: rr.System) -> None:
    """Say that the lens is dirty: all that depends on it hears of it."""
    (lens,) = system.registrar("lenses").resources()
    system.registrar("lenses").send_status(lens.id, rr.Status("WARNING", "dirty"))


def kill_left(system: rr.System) -> None:
    """Kill one of the two wheels, which are started again together."""
    (left,) = [one for one in system.supervisor("root/drive").which_children() if one.id == "left"]
    left.kill()


def take_overview(tab: Tab) -> None:
    """Take the picture of the first page after a kill, while a lens is in ERROR. It takes two minutes."""
    with robot() as (system, app), system.serve_web() as page:
        tab.goes_to(page.url)
        tab.sees("h1", "All is well")
        for number in range(OVERVIEW_S):
            if number == OVERVIEW_S // 2:
                kill_left(system)
            for _ in range(number % 7):
                app.load("maps/map", "hall").unload()
            tab.do(tab.page.wait_for_timeout(1000))
        (lens,) = system.registrar("lenses").resources()
        system.registrar("lenses").send_status(lens.id, rr.Status("ERROR", "no light"))
        tab.sees("h1", "1 thing needs attention")
        tab.sees(".rr-trouble", "no light", "touches")
        tab.sees(".rr-five", "Deaths, last hour", "1 of left")
        tab.do(tab.page.wait_for_timeout(2000))  # the numbers stand still
        take(tab, "web-overview.png")


def take_tree(tab: Tab) -> None:
    """Take the picture of the tree after a kill."""
    with robot() as (system, _), system.serve_web() as page:
        tab.goes_to(page.url, "tree")
        tab.do(tab.locate('[data-path="root/drive/left"]').click())
        tab.sees(".rr-drawer", "running", "pid", "kill -9")
        kill_left(system)
        tab.sees('[data-path="root/drive/left"]', "↻1", "running")
        tab.sees('[data-path="root/drive"]', "1/3")
        tab.sees(".rr-rows", "SIGKILL", "restarted")
        tab.do(tab.page.wait_for_timeout(2000))  # the numbers stand still
        take(tab, "web-tree.png")


def take_resources(tab: Tab) -> None:
    """Take the picture of a warning that has reached what depends on a lens."""
    with robot() as (system, _), system.serve_web() as page:
        tab.goes_to(page.url)
        tab.clicks("Resources", role="link")
        tab.do(tab.locate('.ag-row:has-text("cameras/camera"):has-text("hall") .ag-cell').first.click())
        warn(system)
        tab.sees(".rr-drawer", "dirty", "Who is touched", "began here")
        tab.sees(".ag-root", 'map "hall"', "WARNING")
        tab.do(tab.page.wait_for_timeout(4000))  # the status has passed
        take(tab, "web-resources.png")


def take_sequence(tab: Tab) -> None:
    """Take the picture of the messages of a warning."""
    with robot() as (system, _), system.serve_web() as page:
        tab.goes_to(page.url)
        tab.clicks("Sequence", role="link")
        tab.clicks("record")
        tab.sees(".rr-note", "recording")
        warn(system)
        tab.sees(".rr-rows", "lenses/lens WARNING", "maps/map WARNING")
        tab.do(tab.locate('.rr-rows .q-btn:has-text("lenses/lens")').first.click())
        tab.do(tab.locate(".rr-sequence svg").first.wait_for())
        tab.do(tab.page.wait_for_timeout(500))  # it is drawn at its width
        take(tab, "web-sequence.png")


def take_loads(tab: Tab) -> None:
    """Take the picture of the loads of the same system."""
    with robot() as (system, app), system.serve_web() as page:
        for _ in range(3):
            app.load("maps/map", "hall")
        tab.goes_to(page.url)
        tab.clicks("Loads", role="link")
        tab.sees("table", "Loads of each server", "maps/map")
        take(tab, "web-loads.png")


def take(tab: Tab, name: str) -> None:
    """Write what a tab shows."""
    tab.do(tab.page.evaluate("scrollTo(0, 0)"))
    tab.do(tab.page.screenshot(path=str(IMAGES / name)))


def take_lab(tab: Tab) -> None:
    """Take the picture of an experiment that is played again."""
    with web("--lab", LAB) as url:
        tab.goes_to(url)
        tab.clicks("A tree of your own")
        tab.do(tab.page.get_by_label("strategy").click())
        tab.do(tab.page.get_by_role("option", name="rest_for_one").click())
        tab.do(tab.page.get_by_role("checkbox", name="restart b").click())
        tab.clicks("run it")
        tab.sees(".rr-verdict", "Not quite", limit_s=60)
        tab.clicks("again")
        for _ in range(9):
            tab.clicks("step")
        tab.sees("[role=log]", "SIGKILL to b", "restarted     root/team/c")
        tab.do(tab.page.wait_for_timeout(1000))  # the ripple of the click has passed
        take(tab, "web-lab.png")


def take_figures(tab: Tab) -> None:
    """Take the picture of the figures of two managers, one of which works."""
    children = [rr.ChildSpec(Cameras, id="cameras"), rr.ChildSpec(Cameras, id="more-cameras")]
    with tempfile.TemporaryDirectory() as state, rr.System(children, state_dir=state) as system:
        app = system.open_registrar("app")
        with system.serve_web() as page:
            tab.goes_to(page.url, "figures")
            for number in range(60):
                app.load("cameras/camera", f"camera {number}")
                tab.do(tab.page.wait_for_timeout(15 * number))
            tab.sees('[data-child="root/cameras"]', "resources", "60")
            take(tab, "web-figures.png")


TAKEN = (
    (take_overview, 880),
    (take_tree, 640),
    (take_resources, 940),
    (take_sequence, 800),
    (take_loads, 610),
    (take_figures, 720),
    (take_lab, 1140),
)


def main() -> None:
    """Take all pictures, or those that the first argument names."""
    wanted = sys.argv[1] if len(sys.argv) > 1 else ""
    chromium = Chromium()
    chromium.open()
    try:
        for taking, height in TAKEN:
            if wanted in taking.__name__:
                with chromium.tab(1280, height) as tab:
                    taking(tab)
    finally:
        chromium.close()


if __name__ == "__main__":
    main()
