"""How often and how long loads wait: the same by the command line, in the terminal, on the page and in /metrics."""

from __future__ import annotations

import asyncio
import json
import re
import threading
import time
import urllib.request
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

import rr_actors as rr
from rr_actors.tools.terminal.console_link import ConsoleLink
from rr_actors.tools.terminal.terminal_app import Terminal
from support import LIMIT_S, Workshop, eventually
from support_browser import Chromium, Tab, needs_chromium
from support_cli import run_cli
from support_managers import Order, Shop

pytestmark = [pytest.mark.usefixtures("runtime_dir"), pytest.mark.timeout(120)]

Start = Callable[..., rr.System]


@pytest.fixture
def shop(start: Start, workshop: Workshop) -> rr.System:
    """A system with a manager, `shop`, in a process of its own."""
    return start(rr.ChildSpec(Shop, id="shop", args=(str(workshop.root),)))


@pytest.fixture
def app(shop: rr.System) -> rr.Registrar:
    """A consumer in this process."""
    return shop.open_registrar("app")


@contextmanager
def chair_waits(app: rr.Registrar, workshop: Workshop) -> Iterator[None]:
    """One load that has ended, two that shared its lamp, and one of a chair that waits in this block."""
    for _ in range(3):
        app.load("shop/thing", Order("lamp"))
    workshop.shut("made chair")
    chair = app.load("shop/thing", Order("chair"), block=False)
    workshop.wait("load chair")
    yield
    workshop.open("made chair")
    chair.get(timeout=LIMIT_S)


@pytest.fixture
def waiting(app: rr.Registrar, workshop: Workshop) -> Iterator[rr.Registrar]:
    """A consumer in this process, one of whose loads waits."""
    with chair_waits(app, workshop):
        yield app


def loads(*arguments: str) -> dict[str, Any]:
    ran = run_cli("loads", "--json", *arguments)
    assert ran.returncode == 0, ran.stderr
    return json.loads(ran.stdout)


def server(name: str = "shop/thing") -> dict[str, Any]:
    (row,) = [row for row in loads()["servers"] if row["server"] == name]
    return row


def counts(row: dict[str, Any]) -> tuple[int, ...]:
    return tuple(row[name] for name in ("loads", "shared", "waited", "failed", "loading"))


def test_loads_that_share_a_resource_are_counted_and_those_that_wait_are_named(waiting: rr.Registrar) -> None:
    assert counts(server()) == (4, 2, 2, 0, 1)
    (row,) = loads()["waiting"]
    assert (row["origin"], row["server"], row["hold"]) == ("app", "shop/thing", "pending")
    ran = run_cli("loads", "--sort-by", "p95").stdout
    assert re.search(r'^app +shop/thing \{"name":"chair".*itself +[\d.]+ m?s$', ran, re.MULTILINE), ran
    assert re.search(r"^shop/thing +4 +2 +2 +0 +1( +[\d.]+ m?s){5}$", ran, re.MULTILINE), ran
    assert loads("lamp") == {"waiting": [], "servers": []}


def test_a_load_that_joins_one_in_progress_has_waited_and_has_shared(waiting: rr.Registrar, workshop: Workshop) -> None:
    second = waiting.load("shop/thing", Order("chair"), block=False)
    eventually(lambda: counts(server()) == (5, 3, 3, 0, 2))
    assert len(loads()["waiting"]) == 2
    workshop.open("made chair")
    second.get(timeout=LIMIT_S)
    eventually(lambda: counts(server()) == (5, 3, 3, 0, 0))
    assert "No load waits now." in run_cli("loads").stdout


def test_the_times_are_those_of_load_callbacks_also_of_those_that_raise(
    start: Start, monkeypatch: pytest.MonkeyPatch
) -> None:
    system = start()
    provider, app = system.open_registrar("provider"), system.open_registrar("app")

    def take(seconds: float) -> float:
        if seconds > 0.15:
            raise OSError("too slow")
        time.sleep(seconds)  # a load callback takes its time
        return seconds

    provider.register_server("thing", take)
    for _ in range(20):
        app.load("provider/thing", 0.0).unload()
    app.load("provider/thing", 0.1)
    with pytest.raises(rr.LoadFailed, match="too slow"):
        app.load("provider/thing", 0.2)
    eventually(lambda: counts(server("provider/thing")) == (22, 0, 22, 1, 0))
    row = server("provider/thing")
    assert row["longest_s"] >= 0.1 > row["p95_s"] >= 0.0
    assert row["mean_s"] * 22 == pytest.approx(row["seconds"])
    stats = provider.stats()
    assert (stats["loads"], stats["shared"]) == (22, 0)


def test_a_server_that_is_registered_again_counts_anew_and_the_metrics_have_the_same_numbers(
    waiting: rr.Registrar, shop: rr.System
) -> None:
    found = {one.name: one.value for one in shop.figures() if one.labels == {"server": "shop/thing"}}
    assert found["rr_server_loads_total"] == 4
    assert found["rr_server_shared_loads_total"] == 2
    assert found["rr_server_waited_loads_total"] == 2
    assert found["rr_server_waiting_loads"] == 1
    assert found["rr_server_load_callback_seconds_total"] >= found["rr_server_load_callback_p95_seconds"] > 0


def test_the_terminal_lists_the_loads_that_wait_and_how_long_the_others_took(
    waiting: rr.Registrar, state_dir: Path
) -> None:
    async def play() -> None:
        terminal = Terminal(ConsoleLink(state_dir))
        async with terminal.run_test(size=(160, 30)) as pilot:
            await pilot.press("5", "z")
            deadline = time.monotonic() + LIMIT_S
            pane = terminal.left
            while True:
                lines = [pane.render_line(y).text for y in range(pane.size.height)]
                if (
                    re.search(r'app waits for shop/thing \{"name":"chair".*itself', lines[1])
                    and "shop/thing" in lines[2]
                ):
                    break
                assert time.monotonic() < deadline, lines
                await pilot.pause(0.02)
            assert lines[0].split() == [
                *("mean", "p95", "loads", "shared", "waited", "failed", "longest"),
                *("own", "mean", "own", "p95"),
            ]
            assert re.search(r"shop/thing .* 4 +2 +2 +0 ", lines[2])

    asyncio.run(play())


@needs_chromium
@pytest.mark.parametrize("width", [420, 1400])
def test_the_page_lists_the_loads_that_wait_and_how_long_the_others_took(
    app: rr.Registrar, shop: rr.System, chromium: Chromium, workshop: Workshop, width: int
) -> None:
    with shop.serve_web() as page, chromium.tab(width) as tab:
        tab.goes_to(page.url)
        tab.clicks("Loads", role="link")
        tab.sees("table", "No load waits now.")
        with chair_waits(app, workshop):
            tab.sees("table", "1 load in progress", "chair", "app", "itself", "Loads of each server", "shop/thing")
            assert re.fullmatch(r"[\d.]+ m?s", tab.text('td[data-head="p95"]'))
            assert tab.do(tab.page.evaluate("document.documentElement.scrollWidth")) <= width
            cut = "[...document.querySelectorAll('td')].filter((one) => one.scrollWidth > one.clientWidth + 1).length"
            assert tab.do(tab.page.evaluate(cut)) == 0
        tab.sees("table", "No load waits now.")
        address, _, token = page.url.partition("?token=")
        request = urllib.request.Request(f"{address}metrics", headers={"Authorization": f"Bearer {token}"})
        with urllib.request.urlopen(request) as answer:
            assert 'rr_server_loads_total{server="shop/thing"} 4' in answer.read().decode()


@needs_chromium
def test_what_a_load_callback_has_reported_stands_beside_the_load_that_waits(
    app: rr.Registrar, shop: rr.System, tab: Tab, state_dir: Path
) -> None:
    ends = threading.Event()

    def load(request: Any) -> Any:
        rr.current().progress(0.0, "<b>behind</b> the pump")
        ends.wait(timeout=100)  # it waits while each of the three is looked at
        return request

    shop.open_registrar("provider").register_server("oven", load)
    loading = app.load("provider/oven", "big", block=False)
    joining = app.load("provider/oven", "big", block=False)
    said = "<b>behind</b> the pump"
    assert eventually(lambda: said in run_cli("loads", "--registrar", "app", "--state", state_dir).stdout)

    async def play() -> None:
        terminal = Terminal(ConsoleLink(state_dir))
        async with terminal.run_test(size=(160, 30)) as pilot:
            await pilot.press("5", "z")
            deadline = time.monotonic() + LIMIT_S
            while f'app waits for provider/oven "big", for itself: {said}' not in terminal.left.render_line(1).text:
                assert time.monotonic() < deadline, terminal.left.render_line(1).text
                await pilot.pause(0.02)
            await pilot.press("z")
            for key in ("down", "up"):  # who joins a load does not know the resource's id
                await pilot.press(key)
                while f"loading: {said}" not in terminal.right.render_line(1).text:
                    assert time.monotonic() < deadline, terminal.right.render_line(1).text
                    await pilot.pause(0.02)

    asyncio.run(play())
    with shop.serve_web() as page:
        tab.goes_to(page.url)
        tab.clicks("Loads", role="link")
        tab.sees("table", "provider/oven", said)
    ends.set()
    joining.get(timeout=LIMIT_S)
    loading.get(timeout=LIMIT_S)


@needs_chromium
def test_the_page_lists_the_busiest_servers_first(app: rr.Registrar, shop: rr.System, tab: Tab) -> None:
    app.register_server("idle", lambda request: request, lambda request, response: None)
    app.load("shop/thing", Order("lamp"))
    assert [row["server"] for row in loads()["servers"]] == ["app/idle", "shop/thing"]
    with shop.serve_web() as page:
        tab.goes_to(page.url)
        tab.clicks("Loads", role="link")
        tab.sees("table", "app/idle")
        assert tab.do(tab.locate('td[data-head="server"]').all_inner_texts()) == ["shop/thing", "app/idle"]


@needs_chromium
def test_a_request_that_is_html_is_shown_as_text_among_the_loads(
    app: rr.Registrar, shop: rr.System, tab: Tab, workshop: Workshop
) -> None:
    name = "<img src=x onerror=alert(1)>"
    with shop.serve_web() as page:
        tab.goes_to(page.url)
        tab.clicks("Loads", role="link")
        tab.sees("table", "No load waits now.")
        workshop.shut(f"load {name}")
        load = app.load("shop/thing", Order(name), block=False)
        tab.sees("table", "<img src=x")
        assert not tab.do(tab.locate("table img").count())
        workshop.open(f"load {name}")
        load.get(timeout=LIMIT_S)


def test_a_servers_own_time_is_without_that_of_its_parts_which_count_once_if_they_load_at_once(start: Start) -> None:
    system = start()
    parts, wholes, app = (system.open_registrar(name) for name in ("parts", "wholes", "app"))

    def load_whole(request: str) -> str:
        two = [wholes.load("parts/part", f"{request} {side}", block=False) for side in ("left", "right")]
        for one in two:
            one.get(timeout=LIMIT_S)
        wholes.load("parts/part", f"{request} middle")
        time.sleep(0.2)
        return request

    def load_part(request: str) -> str:
        time.sleep(0.3)
        return request

    parts.register_server("part", load_part)
    wholes.register_server("whole", load_whole)
    app.load("wholes/whole", "table")
    row, part = server("wholes/whole"), server("parts/part")
    for whole_s, own_s in ((row["mean_s"], row["own_mean_s"]), (row["p95_s"], row["own_p95_s"])):
        assert own_s >= 0.2
        assert whole_s - own_s >= 0.6
    assert part["own_mean_s"] == part["mean_s"]
    ran = run_cli("loads", "--sort-by", "own p95", "--wide")
    assert "own p95" in ran.stdout
    assert ran.returncode == 0
