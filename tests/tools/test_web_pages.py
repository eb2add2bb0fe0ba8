"""The live web page in a real browser: what it shows of a running system, and what its buttons do."""

from __future__ import annotations

import asyncio
import importlib.machinery
import itertools
import json
import logging
import os
import re
import shutil
import signal
import socket
import subprocess
import sys
import threading
import time
import urllib.error
import urllib.parse
import urllib.request
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy
import psutil
import pytest
from playwright.async_api import Page, Route

import rr_actors as rr
from rr_actors.managers import Actions, RunGraph
from rr_actors.system import web_process
from support import LIMIT_S, Workshop, child, hang, kill, lives, pid_of, quickly, serve, wait_gone
from support_browser import LAB, Chromium, Tab, needs_chromium, web
from support_managers import Order, Shop

pytestmark = [needs_chromium, pytest.mark.timeout(120)]

Start = Callable[..., rr.System]

_STANDS_S = 4.0
"""How long a browser stands in a test: a page that queued all its looks would have 20 of them to show then."""


@pytest.fixture
def shop(start: Start, workshop: Workshop) -> rr.System:
    """A system with a manager, `shop`, in a process of its own."""
    return start(rr.ChildSpec(Shop, id="shop", args=(str(workshop.root),)))


def node(path: str) -> str:
    return f'[data-path="{path}"]'


# -- the tree --------------------------------------------------------------------------------------------------------


def test_the_tree_shows_the_children_and_the_chosen_ones_history(shop: rr.System, tab: Tab) -> None:
    with shop.serve_web() as page:
        tab.goes_to(page.url, "tree")
        tab.sees(node("root"), "root", "one_for_one, 3 in 5 s", "0/3")
        tab.sees(node("root/shop"), "●", "running", str(pid_of(shop, "shop")))
        tab.do(tab.locate(node("root/shop")).click())
        tab.sees(".rr-drawer", "running", "pid", "started")
        assert page.url.partition("token=")[2] not in tab.page.url


def test_a_button_that_takes_something_away_has_the_colour_of_what_is_bad(shop: rr.System, tab: Tab) -> None:
    with shop.serve_web() as page:
        tab.goes_to(page.url, "tree")
        tab.do(tab.locate(node("root/shop")).click())
        tab.sees(".rr-drawer", "kill -9", "stop", "restart")
        seen = "[...document.querySelectorAll('.rr-drawer .rr-act')].filter((one) => one.offsetParent)"
        script = f"{seen}.map((one) => getComputedStyle(one).color)"
        kill_9, stop, restart = tab.do(tab.page.evaluate(script))
        assert kill_9 == stop != restart


def test_a_child_is_killed_stopped_and_started_again_by_a_button_each(shop: rr.System, tab: Tab) -> None:
    pid = pid_of(shop, "shop")
    with shop.serve_web() as page:
        tab.goes_to(page.url, "tree")
        tab.do(tab.locate(node("root/shop")).click())
        tab.clicks("kill -9")
        tab.sees(".q-dialog", "Kill root/shop?")
        tab.clicks("cancel")
        tab.waits(lambda: not tab.do(tab.locate(".q-dialog").count()), "the end of the question")
        assert pid_of(shop, "shop") == pid
        tab.clicks("kill -9")
        tab.clicks("kill it")
        tab.sees("body", f"sent SIGKILL to root/shop (pid {pid})")
        tab.sees(node("root"), "1/3")  # first: the window empties by itself
        tab.sees(node("root/shop"), "↻1", "running")
        tab.sees(".rr-rows", "SIGKILL", "restarted")
        tab.sees(node("root"), "0/3")
        tab.clicks("stop")
        tab.sees(".q-dialog", "Stop root/shop?", "until it is started")
        tab.clicks("stop it")
        tab.sees(node("root/shop"), "■", "stopped")
        assert child(shop, "shop").state == "stopped"
        tab.clicks("start")
        tab.sees(node("root/shop"), "●", "running")
    assert pid_of(shop, "shop") != pid


@pytest.mark.slow
def test_a_child_that_fails_shows_its_traceback_and_what_it_logged(start: Start, tab: Tab) -> None:
    system = start(rr.ChildSpec(Fragile, id="fragile"))
    with system.serve_web() as page:
        tab.goes_to(page.url, "tree")
        tab.do(tab.locate(node("root/fragile")).click())
        system.ref("fragile").tell("break")
        tab.sees(node("root/fragile"), "↻1")
        tab.sees(".rr-rows", "ValueError: broken on purpose", "Traceback", "on_receive")
        tab.sees(".rr-rows", "ERROR    fragile: <img src=x onerror=alert(1)> told to break")


class Fragile(rr.Actor):
    def on_receive(self, message: object) -> None:
        logging.getLogger("fragile").error("<img src=x onerror=alert(1)> told to %s", message)
        raise ValueError("broken on purpose")


@pytest.mark.slow
def test_all_is_done_with_keys_alone(shop: rr.System, tab: Tab) -> None:
    pid = pid_of(shop, "shop")
    with shop.serve_web() as page:
        tab.goes_to(page.url, "tree")
        tab.sees(node("root/shop"), "running")
        focused = "document.activeElement.dataset.path || document.activeElement.innerText"
        while tab.do(tab.page.evaluate(focused)) != "root":
            tab.presses("Tab")
        tab.presses("ArrowDown", "Enter")
        tab.sees(".rr-drawer", "running", "pid")
        while tab.do(tab.page.evaluate(focused)) != "kill -9":
            tab.presses("Tab")
        tab.presses("Enter")
        tab.sees(".q-dialog", "Kill root/shop?")
        while tab.do(tab.page.evaluate(focused)) != "kill it":
            tab.presses("Tab")
        tab.presses("Enter")
        tab.sees("body", f"sent SIGKILL to root/shop (pid {pid})")
        tab.sees(node("root/shop"), "↻1", "running")


@pytest.mark.slow
def test_only_what_can_be_done_has_a_button_and_what_cannot_be_done_is_said(shop: rr.System, tab: Tab) -> None:
    def buttons() -> list[str]:
        seen = "[...document.querySelectorAll('.rr-drawer .rr-act')].filter((one) => one.offsetParent)"
        return tab.do(tab.page.evaluate(f"{seen}.map((one) => one.innerText)"))

    with shop.serve_web() as page:
        tab.goes_to(page.url, "tree")
        tab.do(tab.locate(node("root/shop")).click())
        tab.sees(".rr-drawer", "running", "pid")
        assert buttons() == ["kill -9", "stop", "restart"]
        tab.clicks("kill -9")
        tab.sees(".q-dialog", "It cannot finish what it does.")
        shop.supervisor().terminate_child("shop")
        tab.sees(node("root/shop"), "stopped")
        tab.clicks("kill it")
        tab.sees(".q-notification", "kill -9:", "root/shop")
        tab.waits(lambda: buttons() == ["start"], "the button that starts it")


@pytest.mark.slow
def test_the_root_has_no_buttons_as_none_of_them_would_work(shop: rr.System, tab: Tab) -> None:
    with shop.serve_web() as page:
        tab.goes_to(page.url, "tree")
        tab.do(tab.locate(node("root/shop")).click())
        tab.sees(".rr-drawer", "running", "pid")
        assert tab.do(tab.page.get_by_role("button", name="stop", exact=True).count()) == 1
        tab.do(tab.locate(node("root")).click())
        tab.waits(
            lambda: not tab.do(tab.page.get_by_role("button", name="stop", exact=True).count()),
            "the end of the buttons",
        )


@pytest.mark.slow
def test_two_browsers_see_the_same_and_what_the_other_does(shop: rr.System, tab: Tab, chromium: Chromium) -> None:
    with shop.serve_web() as page, chromium.tab() as other:
        for one in (tab, other):
            one.goes_to(page.url, "tree")
            one.sees(node("root/shop"), "running")
        tab.do(tab.locate(node("root/shop")).click())
        tab.clicks("stop")
        tab.clicks("stop it")
        for one in (tab, other):
            one.sees(node("root/shop"), "■", "stopped")


def test_a_page_without_the_token_shows_nothing(shop: rr.System, tab: Tab) -> None:
    tab.expected += ("403",)
    with shop.serve_web() as page:
        tab.goes_to(page.url.partition("?")[0])
        tab.sees("body", "open the address that rr-actors web has printed")


# -- resources -------------------------------------------------------------------------------------------------------


LOOKS = """(chart) => {
    if (!chart || !chart.getOption()) return "";
    const graph = chart.getOption().series[1];
    const looks = (n) => [n.label.formatter, n.itemStyle.opacity, n.itemStyle.borderWidth || 0];
    return JSON.stringify([graph.data.map(looks), graph.links.length]);
}"""
CHART = """(() => {
    const element = document.querySelector('.nicegui-echart');
    return element && getElement(element.id.slice(1)).chart;
})()"""


def titles(tab: Tab) -> str:
    """What the graph draws, as ECharts has it: names, labels, sizes."""
    return tab.do(tab.page.evaluate(f"({LOOKS})({CHART})")).replace("\\n", " ")


def keep_pictures(tab: Tab) -> None:
    """Have the page keep what the graph draws from now on: some of it is soon gone."""
    script = f"""() => {{
        const chart = {CHART}, draw = chart.setOption;
        window.pictures = [];
        chart.setOption = (...options) => {{
            draw.apply(chart, options);
            window.pictures.push(({LOOKS})(chart));
        }};
    }}"""
    tab.do(tab.page.evaluate(script))


def sees_drawn(tab: Tab, *words: str) -> None:
    tab.waits(lambda: all(word in titles(tab) for word in words), f"{words} in the graph")


def clicks_node(tab: Tab, name: str, *words: str) -> None:
    """Click a node of the graph with the mouse, until the graph has these words."""
    place = f"""(() => {{
        const chart = {CHART}, box = chart.getDom().getBoundingClientRect();
        const node = chart.getOption().series[1].data.find((one) => one.name === {json.dumps(name)});
        const [x, y] = node ? chart.convertToPixel({{xAxisIndex: 0, yAxisIndex: 0}}, node.value) : [0, 0];
        return [box.left + x, box.top + y];
    }})()"""

    def clicked() -> bool:
        if all(word in titles(tab) for word in words):
            return True
        tab.do(tab.page.mouse.click(*tab.do(tab.page.evaluate(place))))
        return False

    tab.waits(clicked, f"{words} in the graph after a click at {name}")


@pytest.fixture
def camera(start: Start) -> rr.System:
    """A camera that stands on a lens, held by an app."""
    system = start()
    provider, app = system.open_registrar("provider"), system.open_registrar("app")
    serve(provider, "lens", lambda request: "glass")
    serve(provider, "camera", lambda request: provider.load("provider/lens", "50 mm").response)
    app.load("provider/camera", "front")
    serve(provider, "other")
    app.load("provider/other", "table")
    return system


def test_a_chosen_resource_lights_up_with_its_holders_and_parts(camera: rr.System, tab: Tab) -> None:
    with camera.serve_web() as page:
        tab.goes_to(page.url)
        tab.clicks("Resources", role="link")
        sees_drawn(tab, 'camera \\"front\\"', 'lens \\"50 mm\\"', "@app")
        tab.do(tab.locate('.ag-cell:has-text("front")').first.click())
        tab.sees(".rr-drawer", 'provider/camera "front"', "held by 1", "depends on 1", 'provider/lens "50 mm"')
        sees_drawn(
            tab,
            '["camera \\"front\\"",1,0]',
            '["lens \\"50 mm\\"",1,0]',
            '["other \\"table\\"",0.15,0]',
            '["@app",1,0]',
        )
        (lens,) = [row for row in camera.registrar("provider").resources() if row.request == "50 mm"]
        camera.registrar("provider").send_status(lens.id, rr.Status("ERROR", "scratched"))
        tab.sees(".rr-drawer", "ERROR", "scratched", "held, ERROR", "began here")  # so it comes from below


def test_tree_and_counts_are_shown_before_the_libraries_of_graph_and_table_have_come(
    camera: rr.System, tab: Tab
) -> None:
    held: list[str] = []
    released = asyncio.Event()

    async def hold(route: Route) -> None:
        held.append(route.request.url)
        await released.wait()
        await route.continue_()

    async def release() -> None:
        released.set()

    with camera.serve_web() as page:
        tab.goes_to(page.url)
        tab.do(tab.page.route("**/esm/**", hold))
        tab.do(tab.page.goto(page.url.partition("?")[0] + "resources"))
        tab.sees(".rr-main", "3 resources")
        tab.waits(lambda: len(held) > 1, "both libraries are asked for")
        assert tab.do(tab.locate(".ag-row, canvas").count()) == 0
        tab.do(tab.page.get_by_label("search in id").fill("glass-less"))  # before there is a table
        tab.do(tab.page.get_by_label("search in id").fill("front"))
        tab.do(release())
        sees_drawn(tab, 'camera \\"front\\"')
        tab.sees(".ag-center-cols-container", "front")
        assert tab.do(tab.locate(".ag-row").count()) == 1


class Cameras(rr.Manager):
    """A camera with pictures that change, and with notes that are none."""

    @rr.server("camera")
    def open_camera(self, device: str) -> None:
        images, notes = (rr.current().open_stream(name) for name in ("images", "notes"))
        self.ended = threading.Event()

        def grab() -> None:
            for number in itertools.count():
                if self.ended.wait(0.02):
                    return
                images.publish(numpy.full((480, 640, 3), number % 256, "u1"))
                notes.publish("<img src=x onerror=alert(1)>")

        threading.Thread(target=grab, daemon=True).start()

    @open_camera.unload
    def close_camera(self, device: str, response: object) -> None:
        self.ended.set()


class Steps(rr.Action):
    go = threading.Event()

    def run(self, given: object) -> None:
        self.go.wait(60)
        raise OSError("<b>blocked</b>")


class Report(rr.Action):
    def run(self, given: object) -> None:
        return


def test_a_running_graph_of_actions_is_drawn_with_its_states(start: Start, tab: Tab) -> None:
    graph: dict[str, Any] = {
        "actions": [
            {"name": "Steps", "children": [{"name": "Report"}]},
            {"name": "Report", "parents": [{"name": "Steps", "conditions": ["on_error -> run"]}]},
        ]
    }
    Steps.go.clear()
    kwargs = {"actions": [Steps, Report]}
    system = start(rr.ChildSpec(Actions, id="actions", kwargs=kwargs, placement="thread"))
    picture = ".rr-actions"
    with system.open_registrar("app").load("actions/graph", RunGraph(graph)), system.serve_web() as page:
        tab.goes_to(page.url)
        tab.clicks("Resources", role="link")
        tab.do(tab.locate('.ag-cell:has-text("actions/graph")').first.click())
        tab.sees(".rr-rows", "graph RUNNING:", "Steps_0", "RUNNING", "Report_0", "UNINITIALIZED")
        tab.sees(picture, "Steps_0", "RUNNING", "Report_0", "UNINITIALIZED")
        Steps.go.set()
        tab.sees(".rr-rows", "graph FINISHED:", "ERROR, actions/action: OSError: <b>blocked</b>")
        tab.sees(picture, "Steps_0", "ERROR", "Report_0", "FINISHED")


def test_the_pictures_of_a_chosen_resource_are_shown_live_and_small(start: Start, tab: Tab) -> None:
    system = start(rr.ChildSpec(Cameras, id="cameras"))
    camera = system.open_registrar("app").load(Cameras.open_camera, "front")
    image = tab.locate('.rr-pictures img[alt="stream images"]')
    with system.serve_web() as page:
        tab.goes_to(page.url)
        tab.clicks("Resources", role="link")
        tab.do(tab.locate('.ag-cell:has-text("front")').first.click())
        tab.sees(".rr-rows", "stream images", "/s", "stream notes")
        first = tab.do(image.get_attribute("src"))
        assert first is not None
        assert first.startswith("data:image/png;base64,")
        tab.waits(lambda: tab.do(image.get_attribute("src")) != first, "another picture")
        tab.waits(lambda: tab.do(image.evaluate("one => one.naturalWidth")) == 214, "a picture of 214 by 160")
        assert tab.do(tab.locate(".rr-pictures img").count()) == 1
        assert tab.do(tab.locate("img[src=x]").count()) == 0
        camera.unload()
        tab.waits(lambda: tab.do(image.count()) == 0, "no picture")


@pytest.mark.slow
def test_a_status_is_seen_travelling_up(camera: rr.System, tab: Tab) -> None:
    provider = camera.registrar("provider")
    (lens,) = [row for row in provider.resources() if row.request == "50 mm"]
    with camera.serve_web() as page:
        tab.goes_to(page.url, "resources")
        sees_drawn(tab, "lens")
        keep_pictures(tab)

        def travelled() -> bool:
            """Send a status. A page that hears of it a second late shows nothing of its way."""
            provider.send_status(lens.id, rr.Status("WARNING", "dirty"))
            tab.do(asyncio.sleep(ON_ITS_WAY_S))
            pictures = tab.do(tab.page.evaluate("window.pictures.join()"))
            return all(f'["{name}",1,6]' in pictures for name in WAY)

        tab.waits(travelled, f"a status that travels over {WAY}")
        sees_drawn(tab, '["! lens \\"50 mm\\"",1,0]')  # it has passed


@pytest.mark.slow
def test_a_query_and_a_resource_are_unloaded_by_a_button_each(camera: rr.System, tab: Tab) -> None:
    app = camera.registrar("app")
    with camera.serve_web() as page:
        tab.goes_to(page.url, "resources")
        tab.do(tab.locate('.ag-cell:has-text("table")').first.click())
        tab.clicks("unload")
        tab.sees("body", "released query")
        tab.waits(lambda: [query.request for query in app.queries()] == ["front"], "unloaded")
        tab.do(tab.locate('.ag-cell:has-text("front")').first.click())
        tab.sees(".rr-rows", "held by 1")
        tab.clicks("unload from all")
        tab.clicks("unload it")
        tab.sees("body", "away from 1 holder")
        tab.waits(lambda: not app.queries(), "taken away")
        app.load("provider/other", "stool")
        sees_drawn(tab, '["other \\"stool\\"",1,0]')  # not dim, though what was chosen has gone


@pytest.mark.slow
def test_a_resource_is_revoked_by_a_button_after_a_question(camera: rr.System, tab: Tab) -> None:
    app = camera.registrar("app")
    with camera.serve_web() as page:
        tab.goes_to(page.url, "resources")
        tab.do(tab.locate('.ag-cell:has-text("table")').first.click())
        tab.sees(".rr-rows", "held by 1")
        tab.clicks("revoke")
        tab.sees(".q-dialog", "Revoke provider/other", "5 s to release it")
        tab.clicks("cancel")
        tab.waits(lambda: not tab.do(tab.locate(".q-dialog").count()), "the end of the question")
        assert len(app.queries()) == 2
        tab.clicks("revoke")
        tab.clicks("revoke it")
        tab.sees("body", "revoked provider/other")
        tab.waits(lambda: [query.request for query in app.queries()] == ["front"], "revoked")


@pytest.mark.slow
def test_a_priority_is_given_by_a_button_after_a_question_and_a_limit_is_named(start: Start, tab: Tab) -> None:
    system = start(config=rr.SystemConfig(registrars={"guests": rr.RegistrarConfig(max_priority=2)}))
    provider, guests = system.open_registrar("provider"), system.open_registrar("guests")
    serve(provider, "thing")
    query = guests.load("provider/thing", "lamp")
    with system.serve_web() as page:
        tab.goes_to(page.url.partition("?")[0] + "resources?" + page.url.partition("?")[2])
        tab.do(tab.locate('.ag-cell:has-text("lamp")').first.click())
        tab.sees(".rr-rows", "held by 1")

        def gives(typed: str, answer: str) -> None:
            tab.clicks("priority")
            tab.sees(".q-dialog", "The priority of guests, for itself")
            tab.do(tab.locate(".q-dialog input").fill(typed))
            tab.clicks(answer)
            tab.waits(lambda: not tab.do(tab.locate(".q-dialog").count()), "the end of the question")

        gives("1", "cancel")
        gives("9", "give it")
        tab.sees("body", "expected 2 at most, as the max_priority of registrar 'guests' says, got 9")
        gives("high", "give it")
        tab.sees("body", "priority: expected a whole number from -1000 to 1000, or standby, got 'high'")
        assert query.priority == 0
        gives("2", "give it")
        tab.sees("body", f"gave priority 2 to query {query.id[-8:]} of guests")
        tab.sees(".rr-rows", "guests, for itself, priority 2")
    assert query.priority == 2


@pytest.mark.slow
def test_what_a_button_did_is_said_although_another_row_was_chosen_meanwhile(camera: rr.System, tab: Tab) -> None:
    begun, may_end = threading.Event(), threading.Event()

    def unload(request: str, response: str) -> None:
        begun.set()
        may_end.wait(LIMIT_S)

    camera.registrar("provider").register_server("slow", lambda request: "made", unload, request_type=str)
    camera.registrar("app").load("provider/slow", "oven")
    with camera.serve_web() as page:
        tab.goes_to(page.url, "resources")
        tab.do(tab.locate('.ag-cell:has-text("oven")').first.click())
        tab.clicks("unload")
        tab.waits(begun.is_set, "its unload has begun")
        tab.do(tab.locate('.ag-cell:has-text("front")').first.click())
        tab.sees(".rr-drawer", 'provider/camera "front"')  # the button that was clicked is gone
        may_end.set()
        tab.sees("body", "released query", "oven")


@pytest.mark.slow
def test_the_table_is_searched_by_the_system_and_used_with_keys(camera: rr.System, tab: Tab) -> None:
    with camera.serve_web() as page:
        tab.goes_to(page.url, "resources")
        tab.sees(".ag-center-cols-container", "front", "table", "50 mm")
        tab.do(tab.locate("input[aria-label^=search]").click())
        tab.do(tab.page.keyboard.type("table"))
        cells = ".ag-center-cols-container"
        tab.waits(lambda: "table" in (text := tab.text(cells)) and "front" not in text, "the rows that match, alone")
        while tab.do(tab.page.evaluate("!document.activeElement.closest('.ag-center-cols-container')")):
            tab.presses("Tab", "ArrowDown")
        tab.presses("Space")
        tab.sees(".rr-drawer", 'provider/other "table"')


@pytest.mark.slow
def test_the_slider_shows_the_graph_as_it_was_whatever_happens_meanwhile(camera: rr.System, tab: Tab) -> None:
    app, provider = camera.registrar("app"), camera.registrar("provider")
    front, table, lens = (next(row for row in provider.resources() if row.request == what) for what in PARTS)
    with camera.serve_web() as page:
        tab.goes_to(page.url, "resources")
        sees_drawn(tab, '"camera \\"front\\"",1,0', '"other \\"table\\"",1,0', '"lens \\"50 mm\\"",1,0')
        before = titles(tab)
        app.unload(next(query for query in app.queries() if query.resource_id == table.id))
        app.load("provider/other", "chair")
        provider.send_status(front.id, rr.Status("ERROR", "dark"))
        sees_drawn(tab, '"✖ camera \\"front\\"",1,0', '"other \\"chair\\"",1,0', '"@app",1,0')
        assert "table" not in titles(tab)

        tab.do(tab.locate(".q-slider__track-container").focus())
        tab.presses(*["PageDown"] * 30)  # to the beginning
        tab.waits(lambda: titles(tab) == before, "the graph as it was")
        provider.send_status(lens.id, rr.Status("WARNING", "dirty"))
        tab.waits(lambda: "dirty" in tab.text("[role=log]"), "the event, while the past is shown")
        for _ in range(10):  # it is on its way up for a while
            assert titles(tab) == before
            tab.do(asyncio.sleep(0.1))
        tab.clicks("now")
        sees_drawn(tab, '"! camera', '"! lens', "chair")  # the warning has reached the camera, too


PARTS = ("front", "table", "50 mm")
WAY = ('! lens \\"50 mm\\"', '! camera \\"front\\"', "@app")
ON_ITS_WAY_S = 2.0
"""How long a status travels in the picture: two steps of 0.5 s, and the last that it reaches stands out for 1 s."""
MANY = 100_000


def program_of_page() -> psutil.Process:
    """The process of the page that a system of this process serves."""
    (found,) = (each for each in psutil.Process().children() if "web" in each.cmdline())
    return found


@pytest.mark.slow
@pytest.mark.timeout(400)
@pytest.mark.cold
def test_the_table_stays_usable_with_100_000_resources(start: Start, tab: Tab) -> None:
    system = start()
    provider, app = system.open_registrar("provider"), system.open_registrar("app")
    provider.register_server("thing", lambda name: name)
    for first in range(0, MANY, 5000):
        app.load_all([("provider/thing", f"lamp {number}") for number in range(first, first + 5000)], timeout_s=120)
    cells = ".ag-center-cols-container"
    with system.serve_web() as page:
        address, _, token = page.url.partition("?token=")
        worker = program_of_page()

        def rows(**wanted: object) -> tuple[dict[str, Any], float]:
            """A page of the table, and how many seconds it took."""
            url = f"{address}rows/resources?{urllib.parse.urlencode(wanted)}"
            request = urllib.request.Request(url, headers={"Authorization": f"Bearer {token}"})
            began = time.monotonic()
            with urllib.request.urlopen(request) as answer:
                return json.loads(answer.read()), time.monotonic() - began

        tab.goes_to(page.url, "resources")
        sees_drawn(tab, f"thing {MANY:,}")
        tab.sees(cells, "provider/thing")

        quickly(lambda: rows(offset=MANY - 100, limit=100)[1], PAGE_S)
        quickly(lambda: rows(match="lamp 99999", offset=0, limit=100)[1], SEARCH_S)
        assert [row["resource"] for row in rows(match="lamp 99999")[0]["rows"]] == ['provider/thing "lamp 99999"']
        last = rows(offset=MANY - 1, limit=MANY)[0]
        assert (last["total"], len(last["rows"])) == (MANY, 1)
        assert len(rows(offset=0, limit=MANY)[0]["rows"]) == 500
        before = worker.memory_info().rss
        for offset in range(0, MANY, 2000):
            rows(offset=offset, limit=500)
        grown = worker.memory_info().rss - before
        assert grown < 50 * 2**20, grown

        grid = "getElement(document.querySelector('.nicegui-aggrid').id.slice(1)).api"
        began = time.monotonic()
        tab.do(tab.page.evaluate(f"{grid}.ensureIndexVisible({MANY - 1})"))
        at_end = rows(offset=MANY - 3, limit=3)[0]["rows"]
        tab.sees(cells, *(row["resource"] for row in at_end))
        print(f"scrolled to the end in {time.monotonic() - began:.2f} s, {grown / 2**20:.0f} MiB more")
        shown = tab.do(tab.page.evaluate(f"document.querySelectorAll('{cells} .ag-row').length"))
        assert 0 < shown < 100
        tab.do(tab.locate("input[aria-label^=search]").click())
        tab.do(tab.page.keyboard.type("lamp 98765"))
        tab.waits(lambda: tab.do(tab.page.evaluate(f"{grid}.getDisplayedRowCount()")) == 1, "the row that matches")
        tab.sees(cells, "lamp 98765")


PAGE_S, SEARCH_S = 1.0, 3.0
"""How long a page of 100,000 rows may take, and a search in all of them."""


@pytest.mark.slow
def test_from_300_resources_on_the_graph_shows_servers_opens_them_and_shows_one_with_its_neighbours(
    start: Start, tab: Tab
) -> None:
    system = start()
    lenses, cameras, app = map(system.open_registrar, ("lenses", "cameras", "app"))
    serve(lenses, "lens")
    serve(cameras, "camera", load=lambda request: cameras.load("lenses/lens", request).id)
    app.load_all([("cameras/camera", number) for number in range(151)])
    (lens,) = [row for row in lenses.resources() if row.request == 77]
    lenses.send_status(lens.id, rr.Status("ERROR", "dark"))
    with system.serve_web() as page:
        tab.goes_to(page.url, "resources")
        sees_drawn(tab, "lens 151 1 ERROR", "camera 151 1 ERROR", "@app")
        tab.sees(".rr-note", "302 resources")
        tab.sees(".ag-center-cols-container", "cameras/camera")

        clicks_node(tab, "#lenses/lens", "lens 111 more", "lens 77", "camera 151 1 ERROR")
        clicks_node(tab, lens.id, "lens 77", "camera 77", "@app")
        assert "camera 151" not in titles(tab)
        tab.sees(".rr-note", "those above and below it")
        tab.sees(".rr-drawer", "ERROR", "dark")
        lenses.send_status(lens.id, rr.Status("WARNING", "dim"))
        sees_drawn(tab, "! lens 77", "! camera 77")
        tab.clicks("all")
        sees_drawn(tab, "lens 151 1 WARNING", "camera 151 1 WARNING")
    asked = [url for url in tab.asked if "/rows/" in url]
    assert asked
    assert all("limit=100" in url for url in asked)


# -- sequences and figures -------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_a_load_and_a_crash_are_drawn_as_sequences_to_copy_and_to_save(
    start: Start, workshop: Workshop, tab: Tab
) -> None:
    system = start(rr.ChildSpec(Shop, id="shop", args=(str(workshop.root),)))
    app = system.open_registrar("app")
    with system.serve_web() as page:
        tab.goes_to(page.url)
        tab.clicks("Sequence", role="link")
        tab.sees("body", "Press record, and choose what has happened")
        assert not tab.do(tab.locate(".rr-sequence svg").count())
        tab.clicks("record")
        tab.sees(".rr-note", "recording")
        app.load("shop/thing", Order("chair"))
        tab.clicks("Tree", role="link")
        tab.sees(node("root/shop"), "running")
        tab.clicks("Sequence", role="link")  # the recording has gone on meanwhile
        tab.sees(".rr-note", ", recording")
        tab.do(tab.page.get_by_role("button", name="Load shop/thing").first.click())
        tab.waits(lambda: "participant" in tab.do(tab.page.get_by_label("Mermaid text").input_value()), "the text")
        tab.sees(".rr-sequence", "Load shop/thing", "load shop/thing returned")
        kill(system, "shop")
        tab.do(tab.page.get_by_role("button", name="restarted root/shop").first.click())
        tab.sees(".rr-sequence", "restarted", "SIGKILL")
        tab.do(tab.context.grant_permissions(["clipboard-read", "clipboard-write"]))
        tab.clicks("copy text")
        copied = "navigator.clipboard.readText()"
        tab.waits(lambda: tab.do(tab.page.evaluate(copied)).startswith("sequenceDiagram"), "the text in the clipboard")
        assert "<svg" in tab.do(saved_svg(tab.page)).read_text()
        tab.clicks("stop recording")
        tab.waits(lambda: "recording" not in tab.text(".rr-note"), "the end of the recording")


async def saved_svg(page: Page) -> Path:
    async with page.expect_download() as download:
        await page.get_by_role("button", name="save SVG").click()
    return Path(await (await download.value).path())


def test_a_browser_that_leaves_while_its_page_loads_makes_the_server_say_nothing(
    start: Start, capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("PYTEST_CURRENT_TEST")  # with it NiceGUI leaves out a middleware
    with start().serve_web() as page:
        address, _, token = page.url.partition("?token=")
        headers = {"Authorization": f"Bearer {token}"}

        def read(path: str) -> str:
            wanted = urllib.request.Request(urllib.parse.urljoin(address, path), headers=headers)
            with urllib.request.urlopen(wanted, timeout=LIMIT_S) as answer:
                return answer.read().decode()

        files = set(re.findall(r"/_nicegui/[\w./-]+\.js", read("/resources")))
        assert files
        place = urllib.parse.urlsplit(address)
        for file in files:
            lines = f"GET {file} HTTP/1.1", f"Host: {place.netloc}", f"Authorization: Bearer {token}", "", ""
            with socket.create_connection((place.hostname, place.port), LIMIT_S) as leaving:
                leaving.sendall("\r\n".join(lines).encode())
        for file in files:  # when these are answered, the others are done with
            assert read(file)
    assert "Traceback" not in capfd.readouterr().err


def test_prometheus_reads_figures_with_the_token_in_a_header(shop: rr.System) -> None:
    with shop.serve_web() as page:
        address, _, token = page.url.partition("?token=")
        request = urllib.request.Request(f"{address}metrics", headers={"Authorization": f"Bearer {token}"})
        with urllib.request.urlopen(request) as answer:
            assert answer.headers["content-type"].startswith("text/plain; version=0.0.4")
            assert "rr_" in answer.read().decode()
        with pytest.raises(urllib.error.HTTPError, match="403"):
            urllib.request.urlopen(f"{address}metrics")


# -- its life --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("prints", "said"),
    [
        ("echo hello", "hello"),
        ("exec >&-", "prints nothing"),
        ("printf http://127", "no address: 'http://127'"),
        ("printf http://127; exec >&-", "no address: 'http://127'"),
    ],
)
def test_a_program_that_prints_no_address_is_ended(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, prints: str, said: str
) -> None:
    program = tmp_path / "python"
    program.write_text(f"#!/bin/sh\n{prints}\nexec sleep 60\n")
    program.chmod(0o700)
    monkeypatch.setattr(sys, "executable", str(program))
    monkeypatch.setattr(web_process, "_START_S", 5.0)
    monkeypatch.setattr(web_process, "_END_S", 0.2)
    began = time.monotonic()
    with pytest.raises(rr.Unavailable, match=said):
        web_process.WebPage(str(tmp_path), "127.0.0.1", 0)
    assert time.monotonic() - began < 30


@pytest.mark.cold
def test_the_page_ends_with_its_system(start: Start, workshop: Workshop) -> None:
    system = start(rr.ChildSpec(Shop, id="shop", args=(str(workshop.root),)))
    page = system.serve_web()
    pid = program_of_page().pid
    assert lives(pid)
    system.stop()
    assert not lives(pid)
    page.stop()


@pytest.mark.cold
def test_a_forked_child_that_leaves_the_block_of_a_page_closes_no_file_of_its_own(start: Start) -> None:
    with start().serve_web() as page:
        program = program_of_page()
        forked = os.fork()
        if forked == 0:
            try:
                mine = [descriptor for _ in range(4) for descriptor in os.pipe()]  # numbers that the page's pipes had
                page.stop()
                for descriptor in mine:
                    os.fstat(descriptor)
                os._exit(0)
            finally:
                os._exit(1)
        assert os.waitpid(forked, 0)[1] == 0
        assert lives(program.pid)


@pytest.mark.slow
def test_the_page_ends_with_a_program_that_is_killed(tmp_path: Path) -> None:
    script = (
        "import psutil, sys, time, rr_actors as rr\n"
        "system = rr.System(state_dir=sys.argv[1]).start()\n"
        "page = system.serve_web()\n"
        "print(*(each.pid for each in psutil.Process().children() if 'web' in each.cmdline()), flush=True)\n"
        "time.sleep(60)\n"
    )
    program = subprocess.Popen([sys.executable, "-c", script, str(tmp_path / "s")], stdout=subprocess.PIPE, text=True)
    assert program.stdout is not None
    with program.stdout:
        pid = int(program.stdout.readline())
        assert lives(pid)
        program.kill()
        wait_gone(pid)
        program.wait()
    shutil.rmtree(tmp_path)  # what a killed system leaves, until it starts again


@pytest.mark.slow
def test_a_page_that_stays_open_shows_the_system_that_starts_again(
    start: Start, workshop: Workshop, state_dir: Path, tab: Tab
) -> None:
    children = [rr.ChildSpec(Shop, id="shop", args=(str(workshop.root),))]
    system = start(*children)
    with web("--state", state_dir) as url:
        tab.goes_to(url, "tree")
        tab.sees(node("root/shop"), "running", str(pid_of(system, "shop")))
        system.stop()
        tab.sees(".rr-status", "waiting for it")
        tab.sees(".rr-banner", "No answer since")
        tab.sees(node("root/shop"), "?", "unknown since")
        assert "●" not in tab.text(node("root/shop"))
        with rr.System(children, state_dir=state_dir) as again:
            tab.sees(node("root/shop"), "running", str(pid_of(again, "shop")))
            tab.sees(".rr-status", f"pid {os.getpid()}")
            tab.waits(lambda: "waiting" not in tab.text(".rr-status"), "all is well")
            tab.do(tab.locate(node("root/shop")).click())
            tab.clicks("stop")
            tab.clicks("stop it")
            tab.sees(node("root/shop"), "stopped")


@pytest.mark.slow
def test_the_slider_shows_the_tree_as_it_was_and_now_again(start: Start, workshop: Workshop, tab: Tab) -> None:
    system = start(rr.ChildSpec(Shop, id="shop", args=(str(workshop.root),)))
    before = pid_of(system, "shop")
    with system.serve_web() as page:
        tab.goes_to(page.url, "tree")
        tab.sees(node("root/shop"), str(before))
        kill(system, "shop")
        tab.sees(node("root/shop"), "↻1", "running")
        after = str(pid_of(system, "shop"))
        tab.sees(node("root/shop"), after)
        tab.do(tab.locate(".q-slider__track-container").focus())
        tab.presses(*["PageDown"] * 30)  # to the beginning
        tab.sees(node("root/shop"), str(before))
        tab.sees(".rr-clock", "ago")
        system.supervisor().terminate_child("shop")
        tab.waits(lambda: "stopped" in tab.text("[role=log]"), "the event, while the past is shown")
        assert str(before) in tab.text(node("root/shop"))
        tab.do(tab.locate(node("root/shop")).click())
        tab.sees(".rr-rows", "SIGKILL")
        assert str(before) in tab.text(node("root/shop"))
        tab.clicks("now")
        tab.sees(node("root/shop"), "stopped")


@pytest.mark.slow
def test_a_mouse_moves_the_slider_and_the_page_says_that_it_shows_the_past(
    start: Start, workshop: Workshop, tab: Tab
) -> None:
    system = start(rr.ChildSpec(Shop, id="shop", args=(str(workshop.root),)))
    before = pid_of(system, "shop")
    with system.serve_web() as page:
        tab.goes_to(page.url, "tree")
        tab.do(tab.locate(node("root/shop")).click())
        tab.sees(node("root/shop"), str(before))
        kill(system, "shop")
        tab.sees(node("root/shop"), "↻1", "running")
        slider = tab.locate(".q-slider__track-container")
        tab.do(slider.click(position={"x": 2, "y": 5}))
        tab.sees(node("root/shop"), str(before))
        tab.sees(".rr-banner", "This is the picture of", "buttons are off")
        tab.waits(lambda: tab.do(tab.page.get_by_role("button", name="stop", exact=True).is_disabled()), "off")
        box = tab.do(slider.bounding_box())
        assert box is not None
        tab.do(tab.page.mouse.move(box["x"] + 2, box["y"] + 5))
        tab.do(tab.page.mouse.down())
        tab.do(tab.page.mouse.move(box["x"] + box["width"], box["y"] + 5, steps=5))
        tab.do(tab.page.mouse.up())
        tab.sees(node("root/shop"), "↻1")
        tab.waits(lambda: not tab.do(tab.locate(".rr-banner").is_visible()), "now, without a word about the past")
        tab.waits(lambda: tab.do(tab.page.get_by_role("button", name="stop", exact=True).is_enabled()), "on")


@pytest.mark.slow
def test_a_server_says_its_address_alone_and_ends_in_order(start: Start, state_dir: Path) -> None:
    start()
    program = subprocess.Popen(
        [sys.executable, "-m", "rr_actors", "web", "--state", str(state_dir)],
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip
    assert program.stdout is not None
    assert program.stdout.readline().startswith("http://127.0.0.1:")
    program.terminate()
    assert program.communicate(timeout=LIMIT_S) == ("", "")
    assert program.returncode == 0


@pytest.mark.parametrize("library", ["nicegui", "uvicorn", "fastapi"])
def test_without_a_library_of_the_extra_the_command_says_what_to_install(library: str, tmp_path: Path) -> None:
    (tmp_path / f"{library}.py").write_text(f"raise ModuleNotFoundError('No module named {library}', name='{library}')")
    environment = os.environ | {"PYTHONPATH": str(tmp_path)}
    command = [sys.executable, "-m", "rr_actors", "web", "--lab", str(LAB)]

    ran = subprocess.run(command, env=environment, capture_output=True, text=True)

    assert ran.returncode == 2
    assert f"web needs the library {library}" in ran.stderr
    assert "pip install '.[web]'" in ran.stderr
    assert len(ran.stderr.splitlines()) == 1


@pytest.mark.parametrize("library", ["nicegui", "typer"])
def test_without_a_library_of_the_extra_the_method_says_what_to_install(
    library: str, start: Start, monkeypatch: pytest.MonkeyPatch
) -> None:
    system = start()
    find = importlib.machinery.PathFinder.find_spec
    monkeypatch.setattr(
        importlib.machinery.PathFinder, "find_spec", lambda name: None if name == library else find(name)
    )
    with pytest.raises(rr.UsageError, match=rf"serve_web needs the library {library}.*pip install '\.\[web\]'"):
        system.serve_web()


def test_a_system_that_does_not_run_or_has_no_console_serves_no_page(state_dir: Path) -> None:
    with pytest.raises(rr.UsageError, match="not running"):
        rr.System(state_dir=state_dir).serve_web()
    with (
        rr.System(state_dir=state_dir, config=rr.SystemConfig(console=False)) as system,
        pytest.raises(rr.UsageError, match="needs the console"),
    ):
        system.serve_web()


def test_without_a_system_the_command_says_so_and_ends(tmp_path: Path) -> None:
    ran = subprocess.run(
        [sys.executable, "-m", "rr_actors", "web", "--state", str(tmp_path)], capture_output=True, text=True
    )

    assert ran.returncode == 3
    assert "no system with a console runs in this state directory" in ran.stderr
    assert len(ran.stderr.splitlines()) == 1


def test_a_host_that_is_not_this_machines_is_named() -> None:
    ran = subprocess.run(
        [sys.executable, "-m", "rr_actors", "web", "--lab", str(LAB), "--host", "192.0.2.1"],
        capture_output=True,
        text=True,
    )
    assert ran.returncode == 2
    assert ran.stderr.startswith("rr-actors: 192.0.2.1:0: cannot be listened at (")
    assert ran.stderr.endswith("; choose another --host\n")


@pytest.mark.slow
def test_a_port_that_is_taken_is_named(start: Start) -> None:
    system = start()
    with system.serve_web() as page:
        port = int(page.url.rpartition(":")[2].partition("/")[0])
        with pytest.raises(rr.Unavailable, match="exit code 2"):
            system.serve_web(port=port)


@pytest.mark.slow
@pytest.mark.timeout(150)
def test_a_page_is_never_a_second_behind_a_minute_of_a_thousand_events_a_second(start: Start, tab: Tab) -> None:
    system = start()
    provider, app = system.open_registrar("provider"), system.open_registrar("app")
    serve(provider, "thing")
    thing = app.load("provider/thing", "one")
    sent, stood_s, stopped = 0, 0.0, threading.Event()

    def storm() -> None:
        nonlocal sent, stood_s
        began = last = time.monotonic()
        while not stopped.is_set():
            stood_s, last = max(stood_s, time.monotonic() - last), time.monotonic()
            while sent < (time.monotonic() - began) * 1000:
                provider.send_status(thing.resource_id, rr.Status("UPDATE", f"{sent} {time.time():.3f}"))
                sent += 1
            stopped.wait(0.005)

    # The newest event's own time, and the browser's clock, which is this machine's: read every 100 ms in the page.
    behind = """() => { window.late = []; setInterval(() => {
        const times = document.querySelector('[role=log]').innerText.match(/\\d{10}\\.\\d{3}/g);
        if (times) window.late.push(Date.now() / 1000 - Number(times[times.length - 1]));
    }, 100); }"""
    with system.serve_web() as page:
        tab.goes_to(page.url)
        tab.sees(".rr-status", "pid")
        tab.do(tab.page.evaluate(behind))
        thread = threading.Thread(target=storm)
        thread.start()
        stopped.wait(60)
        stopped.set()
        thread.join()
        late = sorted(tab.do(tab.page.evaluate("window.late"))[:-20])
    assert sent > 55_000
    assert len(late) > 300
    print(f"{sent} events; behind: median {late[len(late) // 2]:.2f} s, most {late[-1]:.2f} s")
    assert late[-1] < 1.0 + stood_s, late[-10:]  # while the storm itself stands, there is nothing newer to show


def test_a_kill_is_shown_while_a_manager_answers_nothing(start: Start, tab: Tab) -> None:
    system = start(rr.ChildSpec(rr.Manager, id="still"), rr.ChildSpec(rr.Actor, id="actor"))
    with system.serve_web() as page:
        tab.goes_to(page.url, "tree")
        tab.sees(node("root/actor"), "running")
        still = pid_of(system, "still")
        hang(still)
        kill(system, "actor")
        tab.sees(node("root/actor"), "↻1", "running")
        os.kill(still, signal.SIGCONT)


def test_a_browser_that_stood_shows_the_newest_state_and_not_all_that_it_missed(start: Start, tab: Tab) -> None:
    system = start()
    provider, app = system.open_registrar("provider"), system.open_registrar("app")
    serve(provider, "thing")
    thing = app.load("provider/thing", "one")
    note = """() => { window.shown = [];
        const log = document.querySelector('[role=log]');
        new MutationObserver(() => window.shown.push(log.dataset.seq)).observe(log, { attributeFilter: ['data-seq'] });
    }"""
    stand = "until => { while (Date.now() / 1000 < until); window.shown.length = 0; }"
    with system.serve_web() as page:
        tab.goes_to(page.url)
        tab.sees(".rr-status", "pid")
        provider.send_status(thing.resource_id, rr.Status("UPDATE", "the first one"))
        tab.sees("[role=log]", "the first one")
        tab.do(tab.page.evaluate(note))
        until = time.time() + _STANDS_S
        standing = threading.Thread(target=lambda: tab.do(tab.page.evaluate(stand, until)))
        standing.start()
        for number in itertools.count():  # 10 a second: the page looks five times a second
            if time.time() > until - 0.5:
                break
            provider.send_status(thing.resource_id, rr.Status("UPDATE", f"number {number}"))
            time.sleep(0.1)
        provider.send_status(thing.resource_id, rr.Status("UPDATE", "the last one"))
        standing.join()
        tab.sees("[role=log]", "the last one")
        shown = tab.do(tab.page.evaluate("window.shown"))
    assert len(shown) <= 3, shown  # what was on its way, the newest state, and what came while that was drawn


@pytest.mark.parametrize(
    ("where", "told"),
    [
        ({"port": 99_999}, "port: expected a whole number from 0 to 65535, got 99999"),
        ({"port": -1}, "port: expected a whole number from 0 to 65535, got -1"),
        ({"port": "x"}, "port: expected a whole number from 0 to 65535, got 'x'"),
        ({"port": True}, "port: expected a whole number from 0 to 65535, got True"),
        ({"host": ""}, "host: expected an address to listen at, got ''"),
        ({"host": 5}, "host: expected an address to listen at, got 5"),
    ],
)
def test_where_a_page_cannot_be_served_is_refused_before_anything_starts(
    system: rr.System, where: dict[str, Any], told: str
) -> None:
    with pytest.raises(rr.UsageError, match=f"serve_web: {told}"):
        system.serve_web(**where)


# -- how it looks ----------------------------------------------------------------------------------------------------


def test_the_figures_of_each_child_are_drawn_as_curves(shop: rr.System, tab: Tab) -> None:
    app = shop.open_registrar("app")
    with shop.serve_web() as page:
        tab.goes_to(page.url)
        tab.do(tab.page.goto(page.url.partition("?")[0] + "figures"))
        tab.sees("body", "The last ten minutes of 2 children.")
        for number in range(3):
            app.load("shop/thing", Order(f"lamp {number}"))
        tab.sees('[data-child="root/shop"]', "CPU", " %", "MiB", "mailbox", "resources", "loads", "/s")
        tab.sees('[data-child="root/shop"] div:nth-of-type(4)', "resources", "3")
        drawn = tab.do(tab.page.get_attribute('[data-child="root/shop"] svg', "aria-label"))
        assert str(drawn).startswith("CPU of root/shop: now ")
        tab.do(tab.page.get_by_label("only children with this text").fill("sho"))
        tab.sees("body", "The last ten minutes of 1 child.")


def test_the_page_is_dark_where_the_system_is(shop: rr.System, tab: Tab) -> None:
    looks = """['.rr-node', 'body'].map((selector) => {
        const colour = getComputedStyle(document.querySelector(selector)).backgroundColor;
        return Math.max(...colour.match(/[0-9]+/g).slice(0, 3));
    })"""
    with shop.serve_web() as page:
        tab.do(tab.page.emulate_media(color_scheme="dark"))
        tab.goes_to(page.url, "tree")
        tab.sees(node("root/shop"), "running")
        assert max(tab.do(tab.page.evaluate(looks))) < 80
