"""The pages for everybody: axe-core finds nothing to complain of, dark or light, narrow or wide; keys are enough."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from importlib import resources
from typing import Any

import pytest

import rr_actors as rr
from support import serve
from support_browser import LAB, Chromium, Tab, needs_chromium, web

pytestmark = [needs_chromium, pytest.mark.timeout(180)]

Start = Callable[..., rr.System]
PAGES = ("", "tree", "timeline", "resources", "loads", "figures", "sequence")
WIDTHS = (420, pytest.param(1400, marks=pytest.mark.slow), pytest.param(2560, marks=pytest.mark.slow))
AXE = (resources.files("axe_playwright_python") / "axe.min.js").read_text()
RUN = """async () => {
    const wanted = { runOnly: ["wcag2a", "wcag2aa", "wcag21a", "wcag21aa"] };
    const { violations } = await axe.run(document, wanted);
    return violations.flatMap((rule) => rule.nodes.map((node) => `${rule.id}: ${node.html.slice(0, 150)} (${
        [...node.any, ...node.all].map((one) => one.message).join("; ").slice(0, 200)})`));
}"""


@pytest.fixture
def system(start: Start) -> rr.System:
    """A small system with something on each page."""
    inner = rr.Supervisor([rr.ChildSpec(rr.Actor, id="somewhat-long-name")], id="inner")
    system = start(rr.ChildSpec(rr.Actor, id="a"), inner)
    provider, app = system.open_registrar("provider"), system.open_registrar("app")
    serve(provider, "camera", lambda request: "made")
    query = app.load("provider/camera", "front")
    provider.send_status(query.resource_id, rr.Status("WARNING", "dirty"))
    return system


def violations(tab: Tab) -> list[str]:
    """What axe-core complains of, once the page stands still."""
    tab.do(asyncio.sleep(0.6))  # colours that change take 0.3 s
    tab.do(tab.page.evaluate(f"() => {{ {AXE} }}"))
    found: Any = tab.do(tab.page.evaluate(RUN))
    return list(found)


@pytest.mark.parametrize("scheme", ["light", pytest.param("dark", marks=pytest.mark.slow)])
def test_axe_finds_no_violation_on_any_page_of_a_system(system: rr.System, tab: Tab, scheme: Any) -> None:
    with system.serve_web() as page:
        tab.do(tab.page.emulate_media(color_scheme=scheme))
        tab.goes_to(page.url)
        found: dict[str, list[str]] = {}
        for path in PAGES:
            tab.do(tab.page.goto(page.url.partition("?")[0] + path))
            tab.sees(".rr-main", "started")
            if path == "tree":
                tab.do(tab.locate('[data-path="root/a"]').click())
                tab.sees(".rr-drawer", "started")
            found[path] = violations(tab)
        assert [one for path in found for one in found[path]] == []


@pytest.mark.slow
@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_axe_finds_no_violation_in_the_lab(tab: Tab, scheme: Any) -> None:
    with web("--lab", LAB) as url:
        tab.do(tab.page.emulate_media(color_scheme=scheme))
        tab.goes_to(url)
        tab.sees("body", "Escalation")
        found = violations(tab)
        tab.clicks("A tree of your own")
        tab.sees("body", "What will the supervisor team do?")
        found += violations(tab)
        tab.clicks("run it")
        tab.sees('button[data-path="root/team/c"]', "running")
        found += violations(tab)
        tab.clicks("Ten questions", role="link")
        tab.sees("body", "10. A manager is killed")
        found += violations(tab)
        assert found == []


# -- keys alone ------------------------------------------------------------------------------------------------------

FOCUSED = """(() => {
    const one = document.activeElement;
    return one.dataset.path || one.getAttribute("aria-label") || one.innerText || one.labels?.[0]?.innerText || "";
})()"""


def goes_by_tab_to(tab: Tab, name: str, most: int = 80) -> None:
    """Press Tab until what is named has the focus."""
    passed: list[str] = []
    for _ in range(most):
        tab.presses("Tab")
        passed.append(str(tab.do(tab.page.evaluate(FOCUSED))))
        if passed[-1].strip() == name:
            return
    pytest.fail(f"no way by Tab to {name!r}: {passed}")


@pytest.mark.slow
def test_an_experiment_is_chosen_answered_run_and_paused_with_keys_alone(tab: Tab) -> None:
    with web("--lab", LAB) as url:
        tab.goes_to(url)
        tab.sees("body", "Escalation")
        goes_by_tab_to(tab, "A tree of your own")
        tab.presses("Enter")
        tab.sees("body", "What will the supervisor team do?")
        goes_by_tab_to(tab, "restart b")
        tab.presses("Space")
        goes_by_tab_to(tab, "run it")
        tab.presses("Enter")
        tab.sees('button[data-path="root/team/c"]', "running")
        goes_by_tab_to(tab, "pause")
        tab.presses("Enter")
        tab.sees("[role=toolbar]", "go on")
        goes_by_tab_to(tab, "program")  # and out of it again: Tab is not the program's
        tab.do(tab.page.keyboard.press("Shift+Tab"))
        assert tab.do(tab.page.evaluate(FOCUSED)) != "program"


# -- widths ----------------------------------------------------------------------------------------------------------

FAULTS = """(width) => {
    const shown = (e) => e.checkVisibility({ checkOpacity: true, checkVisibilityCSS: true });
    const foreign = "svg, .ag-root-wrapper, .ag-aria-description-container";
    const says = (e) => [...e.childNodes].some((node) => node.nodeType === 3 && node.textContent.trim());
    const texts = [...document.querySelectorAll("body *")].filter((e) => says(e) && shown(e) && !e.closest(foreign));
    const name = (e) => `${e.className}: ${e.textContent.trim().slice(0, 40)}`;
    const cut = texts.filter((e) => e.scrollWidth > e.clientWidth + 1 && getComputedStyle(e).overflowX === "hidden"
        && e.clientWidth);
    const seen = (e) => { // what of its box is not scrolled away
        const box = e.getBoundingClientRect();
        let [left, top, right, bottom] = [box.left, box.top, box.right, box.bottom];
        for (let above = e.parentElement; above; above = above.parentElement) {
            if (getComputedStyle(above).overflow === "visible") continue;
            const pane = above.getBoundingClientRect();
            [left, top] = [Math.max(left, pane.left), Math.max(top, pane.top)];
            [right, bottom] = [Math.min(right, pane.right), Math.min(bottom, pane.bottom)];
        }
        return { left, top, right, bottom, width: right - left, height: bottom - top };
    };
    const boxes = texts.filter((e) => !e.closest("[inert]")).map((e) => [e, seen(e)])
        .filter(([, b]) => b.width > 0 && b.height > 0);
    const lies = ([one, a], [other, b]) => !one.contains(other) && !other.contains(one)
        && Math.min(a.right, b.right) - Math.max(a.left, b.left) > 2
        && Math.min(a.bottom, b.bottom) - Math.max(a.top, b.top) > 4;
    const overlaps = boxes.flatMap((one, at) => boxes.slice(at + 1).filter((other) => lies(one, other))
        .map((other) => `${name(one[0])} over ${name(other[0])}`));
    const panels = [...document.querySelectorAll(".rr-panel")];
    const empty = panels.filter((e) => shown(e) && e.clientHeight > 40
        && !e.innerText.trim() && !e.querySelector("canvas, svg, input"));
    const wide = document.documentElement.scrollWidth > width ? [`wider than ${width}`] : [];
    const sideways = panels.filter((e) => shown(e) && e.scrollWidth > e.clientWidth + 1);
    const said = [...sideways.map((e) => `wider than its panel: ${e.textContent.slice(0, 40)}`),
        ...cut.map((e) => `cut ${name(e)}`), ...empty.map((e) => `empty ${e.innerHTML.slice(0, 150)}`)];
    return [...wide, ...said, ...overlaps];
}"""


def faults(tab: Tab, width: int) -> list[str]:
    """What is cut off, lies over something else, or is empty without a word, once the page stands still."""
    tab.do(asyncio.sleep(0.6))
    found: Any = tab.do(tab.page.evaluate(FAULTS, width))
    return list(found)


CUT_NODES = """(() => {
    const cut = (element) => {
        const mine = element.getBoundingClientRect(), panel = element.closest('.rr-panel').getBoundingClientRect();
        return mine.left < panel.left || mine.right > panel.right || element.scrollWidth > element.clientWidth;
    };
    return [...document.querySelectorAll('.rr-node')].filter(cut).map(element => element.innerText);
})()"""
WIDER = "width => document.documentElement.scrollWidth > width"


def fits(tab: Tab, width: int) -> None:
    """Give the page this width, and see that it takes no more of it, and that no child is cut off."""
    tab.do(tab.page.set_viewport_size({"width": width, "height": 900}))
    tab.waits(lambda: not tab.do(tab.page.evaluate(WIDER, width)), f"a page as wide as {width}")
    tab.waits(lambda: tab.do(tab.page.evaluate(CUT_NODES)) == [], f"whole children at {width}")


@pytest.mark.parametrize("width", WIDTHS)
def test_nothing_is_cut_off_or_covered_or_empty(system: rr.System, chromium: Chromium, width: int) -> None:
    with system.serve_web() as page, chromium.tab(width, 900) as tab:
        tab.goes_to(page.url)
        found: list[str] = []
        for path in PAGES:
            tab.do(tab.page.goto(page.url.partition("?")[0] + path))
            tab.sees(".rr-main", "started")
            if path == "sequence":
                tab.clicks("record")
                tab.sees(".rr-note", "recording")
                (camera,) = system.registrar("provider").resources()
                system.registrar("provider").send_status(
                    camera.id, rr.Status("WARNING", "dirty, and rather blurred too")
                )
                tab.sees(".rr-rows", "provider/camera")
            if path == "tree":
                tab.sees('[data-path="root/inner/somewhat-long-name"]', "running")
            found += [f"{path}: {fault}" for fault in faults(tab, width)]
            for each in (1400, 2560, width):
                fits(tab, each)
        assert found == []


NAMES = """(() => {
    const element = document.querySelector(".nicegui-echart");
    const chart = element && getElement(element.id.slice(1)).chart;
    if (!chart) return [0, []];
    const box = (e) => {
        const one = e.getBoundingRect().clone();
        if (e.transform) one.applyTransform(e.transform);
        return { says: e.style.text, left: one.x, right: one.x + one.width, top: one.y, bottom: one.y + one.height };
    };
    const drawn = chart.getZr().storage.getDisplayList().filter((e) => e.type === "tspan" && !e.ignore && e.style.text);
    const all = drawn.map(box);
    const cut = all.filter((one) => one.left < -1 || one.right > chart.getWidth() + 1 || one.top < -1
        || one.bottom > chart.getHeight() + 1).map((one) => `cut ${one.says}`);
    const lies = (one, other) => Math.min(one.right, other.right) - Math.max(one.left, other.left) > 2
        && Math.min(one.bottom, other.bottom) - Math.max(one.top, other.top) > 3;
    const over = all.flatMap((one, at) => all.slice(at + 1).filter((other) => lies(one, other))
        .map((other) => `${one.says} over ${other.says}`));
    return [all.length, [...cut, ...over]];
})()"""
BROKEN = """[...document.querySelectorAll(".rr-line > :not(button)")].filter((e) => {
    const words = e.textContent.trim().split(/\\s+/);
    return words.length === 1 && words[0].length < 12 && e.getClientRects()[0]?.height > 30;
}).map((e) => e.textContent)"""


@pytest.mark.parametrize("width", WIDTHS)
def test_no_name_in_the_graph_is_cut_off_or_covered_and_no_word_is_broken(
    system: rr.System, chromium: Chromium, width: int
) -> None:
    provider, app = system.open_registrar("provider-with-a-long-name"), system.registrar("app")
    lens, camera = "provider-with-a-long-name/lens", "provider-with-a-long-name/stereo-camera-in-front"
    serve(provider, "lens", lambda request: "glass")
    serve(provider, "stereo-camera-in-front", lambda request: provider.load(lens, request).response)
    for number in range(20):
        app.load(camera, f"/dev/by-path/platform-usb-{number:03}-with-a-long-name")
    with system.serve_web() as page, chromium.tab(width, 900) as tab:
        tab.goes_to(page.url)
        tab.do(tab.page.goto(page.url.partition("?")[0] + "resources"))
        tab.waits(lambda: tab.do(tab.page.evaluate(NAMES))[0] > 25, "the names of the graph")
        tab.do(tab.locate('.ag-cell:has-text("usb-000")').first.click())
        tab.sees(".rr-drawer", "depends on 1", "lens")
        assert faults(tab, width) == []
        assert tab.do(tab.page.evaluate(NAMES))[1] == []
        assert tab.do(tab.page.evaluate(BROKEN)) == []


@pytest.mark.parametrize("width", WIDTHS)
@pytest.mark.slow
def test_nothing_is_cut_off_or_covered_or_empty_in_the_lab(chromium: Chromium, width: int) -> None:
    with web("--lab", LAB) as url, chromium.tab(width, 900) as tab:
        tab.goes_to(url)
        tab.sees("body", "Escalation")
        found = faults(tab, width)
        tab.do(tab.page.goto(url.partition("?")[0] + "?experiment=sharing_and_parts"))
        tab.clicks("run it")
        tab.sees("[role=log]", "the mapper loads the front camera")
        tab.do(tab.locate(".rr-graph canvas").first.wait_for())
        found += faults(tab, width)
        tab.do(tab.page.goto(url.partition("?")[0] + "/questions"))
        tab.sees("body", "10. A manager is killed")
        found += faults(tab, width)
        assert found == []
