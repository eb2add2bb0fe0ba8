"""The timeline in a real browser: on the live page and in a file, with mouse and keys."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

import rr_actors as rr
from rr_actors.registrar.model.recorded import Entry
from rr_actors.system.recording.event_memory import Event
from rr_actors.system.recording.recordings import Recording, add, entry_of
from rr_actors.system.recording.timelines import timeline_of
from rr_actors.tools.web.timeline_file import html
from support import Workshop, kill, pid_of
from support_browser import Chromium, Tab, needs_chromium, web
from support_cli import run_cli
from support_managers import Order, Shop

pytestmark = [needs_chromium, pytest.mark.timeout(120)]

Start = Callable[..., rr.System]
MARK = ".rr-tl-mark"
WHY = ".rr-tl-why"
BEGAN = 1_790_000_000.0
HOUR = 3600.0


def child(after_s: float, event: str, path: str = "root/a", pid: int = 7, **facts: object) -> Entry:
    told = {"event": event, "at": BEGAN + after_s, "path": path, "kind": "actor", "run": 1, "pid": pid}
    return entry_of(Event.of(told | facts))


def killed(after_s: float, path: str = "root/a", pid: int = 7) -> Entry:
    return child(after_s, "exited", path, pid, reason="killed", detail="SIGKILL", up_s=1.0)


HOUR_OF_ONE = [
    child(0.0, "started"),
    killed(1800.0),
    child(1800.1, "restarted", pid=8),
    child(1.0, "started", "root/b"),
    child(HOUR, "stopped", "root/b", reason="shutdown"),
]


@pytest.fixture
def shown(tab: Tab, tmp_path: Path) -> Callable[[list[Entry]], Tab]:
    """A function that shows the timeline of entries as a file."""

    def show(entries: list[Entry]) -> Tab:
        file = tmp_path / "timeline.html"
        file.write_text(html(timeline_of(sorted(entries, key=lambda entry: entry.at), "robot")))
        tab.do(tab.page.goto(file.as_uri()))
        return tab

    return show


def span(tab: Tab) -> tuple[float, float]:
    """The times at the left and right end of what is visible, in seconds after the first."""
    data = tab.do(tab.page.evaluate("({...document.querySelector('.rr-tl-host').dataset})"))
    return float(data["since"]) - BEGAN, float(data["until"]) - BEGAN


def marks(tab: Tab, path: str) -> list[str]:
    """The kinds of the marks of a lane that are visible."""
    return tab.do(
        tab.page.evaluate(f"[...document.querySelectorAll('{MARK}[data-path=\"{path}\"]')].map(m => m.dataset.kind)")
    )


def box(tab: Tab, selector: str) -> dict[str, float]:
    found: Any = tab.do(tab.locate(selector).first.bounding_box())
    return found


def drags(tab: Tab, by: float) -> None:
    plot = box(tab, ".rr-tl-plot")
    x, y = plot["x"] + plot["width"] * 0.6, plot["y"] + 40

    async def drag() -> None:
        await tab.page.mouse.move(x, y)
        await tab.page.mouse.down()
        await tab.page.mouse.move(x + by, y, steps=5)
        await tab.page.mouse.up()

    tab.do(drag())


def turns_wheel(tab: Tab, at: float, by: float) -> None:
    plot = box(tab, ".rr-tl-lanes")

    async def turn() -> None:
        await tab.page.mouse.move(plot["x"] + plot["width"] * at, plot["y"] + 20)
        await tab.page.mouse.wheel(0, by)

    tab.do(turn())


def test_a_click_on_a_mark_says_why(shown: Callable[[list[Entry]], Tab]) -> None:
    tab = shown(HOUR_OF_ONE)
    tab.sees(WHY, "Click a mark")
    tab.do(tab.locate(f"{MARK}[data-kind=killed]").click())
    tab.sees(WHY, "root/a: 1 × killed, 1 × restarted", "killed: SIGKILL, after 1 s", "pid 8")
    assert tab.do(tab.locate(".ring").count()) == 1
    tab.do(tab.locate(".bar").nth(1).click(position={"x": 40, "y": 4}))
    tab.sees(WHY, "root/a, pid 7", "killed")


def test_the_wheel_zooms_where_the_mouse_is_and_what_was_one_mark_are_two(shown: Callable[[list[Entry]], Tab]) -> None:
    tab = shown(HOUR_OF_ONE)
    assert span(tab) == (0, HOUR)
    assert marks(tab, "root/a") == ["started", "killed"]
    kill_x = box(tab, f"{MARK}[data-kind=killed] .touch")["x"] + 7
    lanes = box(tab, ".rr-tl-lanes")
    for _ in range(8):
        turns_wheel(tab, (kill_x - lanes["x"]) / lanes["width"], -400)
    tab.waits(lambda: marks(tab, "root/a") == ["killed", "restarted"], "two marks")
    since, until = span(tab)
    assert since < 1800 < until
    assert until - since < 2
    assert abs(box(tab, f"{MARK}[data-kind=killed] .touch")["x"] + 7 - kill_x) < 60
    for _ in range(8):
        turns_wheel(tab, 0.5, 400_000)
    tab.waits(lambda: span(tab) == (0, HOUR), "all")


def test_it_is_moved_with_the_mouse_and_never_beyond_its_ends(shown: Callable[[list[Entry]], Tab]) -> None:
    tab = shown(HOUR_OF_ONE)
    tab.clicks("zoom in")
    tab.clicks("beginning")
    assert span(tab) == (0, HOUR / 2)
    drags(tab, -200)
    since, until = span(tab)
    assert 100 < since < 1000
    assert until - since == pytest.approx(HOUR / 2)
    assert tab.text(WHY).startswith("Drag")  # a drag is no click
    drags(tab, 600)
    assert span(tab)[0] == 0
    tab.clicks("now")
    assert span(tab) == (HOUR / 2, HOUR)
    tab.clicks("all")
    assert span(tab) == (0, HOUR)


def test_all_of_it_is_done_with_keys(shown: Callable[[list[Entry]], Tab]) -> None:
    tab = shown(HOUR_OF_ONE)
    tab.do(tab.locate(".rr-tl-plot").focus())
    tab.presses("+", "+", "Home")
    assert span(tab) == (0, HOUR / 4)
    tab.presses("ArrowRight", "ArrowRight")
    assert span(tab)[0] == pytest.approx(HOUR / 16)
    tab.presses("ArrowLeft", "End")
    assert span(tab) == (HOUR * 3 / 4, HOUR)
    tab.presses("0", "n", "n", "n")
    tab.sees(WHY, "SIGKILL")
    tab.presses("p")
    tab.sees(WHY, "root/b", "started")
    tab.presses("-")
    assert span(tab) == (0, HOUR)


def test_whatever_a_reason_contains_is_text(shown: Callable[[list[Entry]], Tab]) -> None:
    hostile = "</script><img src=x onerror=alert(1)> \x1b[2J \u202e"
    tab = shown([*HOUR_OF_ONE, child(900.0, "exited", "root/b", reason="abnormal", detail=hostile)])
    tab.do(tab.locate(f"{MARK}[data-kind=crashed]").click())
    tab.sees(WHY, "<img src=x onerror=alert(1)>")
    assert tab.do(tab.locate("img").count()) == 0


COLOURS = """(() => {
    const style = getComputedStyle(document.querySelector('.rr-tl-host'));
    return [style.color, style.backgroundColor];
})()"""


def test_it_is_dark_where_the_system_is(shown: Callable[[list[Entry]], Tab]) -> None:
    tab = shown(HOUR_OF_ONE)
    light = tab.do(tab.page.evaluate(COLOURS))
    tab.do(tab.page.emulate_media(color_scheme="dark"))
    dark = tab.do(tab.page.evaluate(COLOURS))
    assert light[1] == "rgb(255, 255, 255)"
    assert sum(map(int, dark[1][4:-1].split(","))) < 120 < sum(map(int, dark[0][4:-1].split(",")))


CUT = """[...document.querySelectorAll('svg text, button, .rr-tl-subject, .rr-tl-legend span')].filter(e => {
    const r = e.getBoundingClientRect();
    return r.width && (r.left < -0.5 || r.right > innerWidth + 0.5);
}).map(e => e.textContent)"""
OVERLAPS = """(() => {
    const boxOf = (e) => {
        const one = e.getBoundingClientRect(), trimmed = e.tagName === "text" ? 1.5 : 0;
        const [top, bottom] = [one.top + trimmed, one.bottom - trimmed];
        return { left: one.left, right: one.right, top, bottom, of: e.parentNode };
    };
    const all = [...document.querySelectorAll("g > .mark, g > .count")].map(boxOf);
    const lie = (one, other) => one.of !== other.of && one.left < other.right && other.left < one.right
        && one.top < other.bottom && other.top < one.bottom;
    const edge = Math.max(...[...document.querySelectorAll("svg")].map((e) => e.getBoundingClientRect().right));
    const cut = all.filter((one) => one.right > edge).length;
    return [all.length, all.filter((one, i) => all.some((other, j) => j < i && lie(one, other))).length, cut];
})()"""


def resource(after_s: float, event: str, registrar: str) -> Entry:
    facts = {"registrar": registrar, "server": f"{registrar}/lamp", "resource_id": "x", "request": '"front"'}
    return entry_of(Event.of({"event": event, "at": BEGAN + after_s, "detail": ""} | facts))


MANY = sorted(
    (
        entry
        for number in range(40)
        for turn in range(60)
        for at, name in [(turn * 60.0 + number, f"a-long-name-{number}")]
        for entry in (
            child(at, "restarted", f"root/supervisor-{number % 4}/{name}", turn + 1),
            killed(at + 5 * (turn % 9), f"root/supervisor-{number % 4}/{name}", turn + 1),
            *(resource(at + step, "loaded", name) for step in range(0, 30, 3 + number)),
        )
    ),
    key=lambda entry: entry.at,
)


@pytest.mark.parametrize("width", [420, 1400, 2560])
def test_nothing_is_cut_off_and_no_mark_lies_on_another(chromium: Chromium, tmp_path: Path, width: int) -> None:
    file = tmp_path / "timeline.html"
    file.write_text(html(timeline_of(MANY, "robot")))
    with chromium.tab(width, 800) as tab:
        tab.do(tab.page.goto(file.as_uri()))
        assert tab.do(tab.page.evaluate("document.documentElement.scrollWidth")) <= width
        assert tab.do(tab.page.evaluate(CUT)) == []
        for _ in range(6):
            drawn, overlaps, cut = tab.do(tab.page.evaluate(OVERLAPS))
            assert drawn > 20
            assert (overlaps, cut) == (0, 0)
            tab.clicks("zoom in")


def test_in_an_svg_no_mark_lies_on_another(tab: Tab) -> None:
    tab.do(tab.page.set_content(timeline_of(MANY, "robot").svg()))
    drawn, overlaps, cut = tab.do(tab.page.evaluate(OVERLAPS))
    assert drawn > 1000
    assert (overlaps, cut) == (0, 0)


def test_a_click_on_a_mark_of_many_lists_them(shown: Callable[[list[Entry]], Tab]) -> None:
    tab = shown([killed(number / 10, pid=number) for number in range(30)] + [killed(HOUR)])
    assert tab.do(tab.locate(f"{MARK} .count").first.text_content()) == "30"
    tab.do(tab.locate(MARK).first.click())
    assert tab.text(WHY).count("SIGKILL") == 30
    assert tab.text(WHY).startswith("root/a: 30 × killed")


@pytest.mark.slow
def test_of_a_long_recording_of_many_children_what_is_in_sight_is_drawn(shown: Callable[[list[Entry]], Tab]) -> None:
    entries = [
        one
        for number in range(400)
        for turn in range(100)
        for one in (
            child(turn * 864.0 + number, "restarted", f"root/c{number}", turn + 1),
            killed(turn * 864.0 + number + 600.0, f"root/c{number}", turn + 1),
        )
    ]
    tab = shown(entries)
    drawn = tab.do(tab.page.evaluate("document.querySelectorAll('.rr-tl-plot .bar').length"))
    assert 0 < drawn < 10_000  # of 40,000: what is out of sight is not drawn
    tab.sees(".rr-tl-subject", ", left out: 1 lane with less trouble")


# -- on the page -----------------------------------------------------------------------------------------------------


def test_the_page_shows_a_kill_as_it_happens_and_goes_back_to_the_beginning(
    start: Start, workshop: Workshop, tab: Tab
) -> None:
    system = start(rr.ChildSpec(Shop, id="shop", args=(str(workshop.root),)))
    app = system.open_registrar("app")
    kill(system, "shop")  # before the page is open
    app.load("shop/thing", Order("chair"))
    with system.serve_web() as page:
        tab.goes_to(page.url)
        tab.clicks("Timeline", role="link")
        tab.waits(lambda: "killed" in marks(tab, "root/shop"), "what was before the page")
        before = len(marks(tab, "root/shop"))
        app.load("shop/thing", Order("table"))
        tab.waits(lambda: "loaded" in marks(tab, "root/shop"), "the load")
        pid = pid_of(system, "shop")
        kill(system, "shop")
        tab.waits(lambda: len(marks(tab, "root/shop")) > before, "the second kill")
        tab.clicks("zoom in")
        tab.clicks("zoom in")
        tab.clicks("beginning")
        since, until = span(tab)
        app.load("shop/thing", Order("lamp"))
        tab.sees("[role=log]", "lamp")
        assert span(tab) == (since, until)  # it stays where its reader has moved it
        tab.clicks("all")
        tab.do(tab.locate(f'{MARK}[data-kind="killed"]').last.click())
        tab.sees(WHY, "SIGKILL")
        assert pid


@pytest.mark.slow
def test_the_page_has_the_lives_of_the_system_before_and_of_the_one_that_starts_again(
    start: Start, workshop: Workshop, state_dir: Path, tab: Tab
) -> None:
    children = [rr.ChildSpec(Shop, id="shop", args=(str(workshop.root),))]
    system = start(*children)
    with web("--state", state_dir) as url:
        tab.goes_to(url)
        tab.clicks("Timeline", role="link")
        tab.waits(lambda: "started" in marks(tab, "root/shop"), "its start")
        system.stop()
        tab.sees(".rr-banner", "No answer since")
        with rr.System(children, state_dir=state_dir):
            tab.waits(lambda: tab.do(tab.locate("g[data-item] > .bar").count()) >= 3, "two lives, and the root's")


def test_the_command_draws_one_file_that_asks_for_nothing(tab: Tab, tmp_path: Path) -> None:
    recording = Recording("robot")
    add(recording, HOUR_OF_ONE)
    recording.save(tmp_path / "run.jsonl")
    ran = run_cli("timeline", tmp_path / "run.jsonl", "--format", "html")
    file = tmp_path / "run.html"
    file.write_text(ran.stdout)
    tab.do(tab.page.goto(file.as_uri()))
    tab.sees(".rr-tl-subject", "robot", "3 lanes")
    assert [url for url in tab.asked if not url.startswith("file:")] == []
