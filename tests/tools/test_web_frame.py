"""The frame of the web pages in a browser: addresses, links, the drawer, the overview, the palette and the keys."""

from __future__ import annotations

import os
import signal
import urllib.parse
from collections.abc import Callable

import pytest
from hypothesis import given
from hypothesis import strategies as st

import rr_actors as rr
from rr_actors.system.console.attention.attention_items import AttentionItem
from rr_actors.system.console.console_messages import ChildRow
from rr_actors.system.recording.timeline_lanes import Bar, Lane, Mark
from rr_actors.system.recording.timelines import Timeline
from rr_actors.tools.web.frame.overview import head_card, lanes_html, restarts_of, troubles_html
from rr_actors.tools.web.frame.page_addresses import KINDS, Address, link_to
from support import pid_of, serve
from support_browser import Chromium, Tab, needs_chromium

Start = Callable[..., rr.System]
NOW = 1_800_000_000.0
TEXTS = st.text(st.characters(blacklist_categories=["Cs"]), max_size=40)


# -- pure parts ------------------------------------------------------------------------------------------------------


@given(
    kind=st.sampled_from(KINDS),
    name=TEXTS.filter(bool),
    match=TEXTS,
    sort=TEXTS,
    events=TEXTS,
    at=st.none() | st.floats(1.0, 9e9).map(lambda at: round(at, 1)),
)
def test_an_address_is_read_as_it_was_written(
    kind: str, name: str, match: str, sort: str, events: str, at: float | None
) -> None:
    address = Address(match=match, sort=sort, events=events, at=at).chosen(kind, name)  # type: ignore[arg-type]
    written = urllib.parse.urlencode(address.query())
    read = Address.read(dict(urllib.parse.parse_qsl(written, keep_blank_values=True)))
    assert read == address
    assert Address.read(dict(urllib.parse.parse_qsl(link_to(address.kind, name)[1:]))) == Address(address.kind, name)


@pytest.mark.parametrize("at", ["", "x", "nan", "inf", "-5", "0", "1e400", "1e300"])
def test_an_address_with_a_time_that_is_none_shows_now(at: str) -> None:
    assert Address.read({"at": at, "nonsense": "1"}) == Address()


ITEMS = [
    AttentionItem("resource:1", "ERROR", "resource", 'camera "hall" is ERROR', "", NOW, ("app",), 3, "why 1", "1"),
    AttentionItem("child:root/b", "WARNING", "stopped", "root/b is stopped", "root/b"),
    AttentionItem("pool:watts", "WARNING", "pool", "<b>watts</b> is full", "watts", command="budgets watts"),
]


def test_what_needs_attention_has_a_way_on_and_the_head_counts_it() -> None:
    assert "3 things need attention" in head_card(ITEMS, "")
    assert "1 thing needs attention" in head_card(ITEMS[:1], "")
    assert "All is well" in head_card([], "")
    assert "All is well" not in head_card([], "no system runs")
    html = troubles_html(ITEMS, "")
    assert 'href="?resource=1"' in html
    assert "touches app and 2 more" in html
    assert 'href="?child=root%2Fb"' in html
    assert "<code>rr-actors budgets watts</code>" in html


def test_names_of_a_system_are_texts_and_no_html() -> None:
    died = [Mark(NOW - ago, "killed", "SIGKILL") for ago in (400.0, 30.0, 700.0)]
    child = ChildRow('root/<img src=x onerror="1">', 1, "worker", "stopped")
    lane = Lane(child.path, "worker", [Bar(NOW - 900)], died)
    assert restarts_of(lane, NOW - 600, NOW) == 2
    timeline = Timeline([lane], NOW - 900, NOW)
    html = head_card(ITEMS[2:], "<i>") + troubles_html(ITEMS, "") + lanes_html(timeline, [child], {})
    assert "<img" not in html
    assert "<b>watts" not in html
    assert "<i>" not in html
    assert html.count("rr-mark") == 2


# -- in a browser ----------------------------------------------------------------------------------------------------


@pytest.fixture
def system(start: Start) -> rr.System:
    """Two actors, and a camera in ERROR that stands on a lens."""
    system = start(rr.ChildSpec(rr.Actor, id="a"), rr.ChildSpec(rr.Actor, id="b"))
    provider, app = system.open_registrar("provider"), system.open_registrar("app")
    serve(provider, "lens", lambda request: "glass")
    serve(provider, "camera", lambda request: provider.load("provider/lens", "50 mm").response)
    app.load("provider/camera", "front")
    return system


def address(tab: Tab) -> tuple[str, dict[str, str]]:
    parts = urllib.parse.urlsplit(tab.page.url)
    return parts.path, dict(urllib.parse.parse_qsl(parts.query))


def lens_of(system: rr.System) -> str:
    return next(row.id for row in system.registrar("provider").resources() if row.request == "50 mm")


@needs_chromium
@pytest.mark.timeout(180)
def test_the_overview_says_what_is_wrong_and_one_click_says_why_also_after_a_reload(
    system: rr.System, tab: Tab
) -> None:
    lens = lens_of(system)
    with system.serve_web() as page:
        tab.goes_to(page.url)
        tab.sees("h1", "All is well")
        tab.sees(".rr-five", "Children running", "3", "of 3")
        tab.sees(".rr-lanes", "root", "a", "b")
        system.registrar("provider").send_status(lens, rr.Status("ERROR", "scratched"))
        tab.sees("h1", "1 thing needs attention")
        tab.sees(".rr-trouble", 'provider/lens "50 mm"', "ERROR", "scratched", "touches", "app")
        tab.do(tab.locate('.rr-trouble a:has-text("Why")').click())
        tab.sees(".rr-drawer", "ERROR", "Who is touched", "began here", "app")
        assert address(tab) == ("/", {"resource": lens})
        tab.do(tab.page.reload())
        tab.sees(".rr-drawer h2", 'provider/lens "50 mm"')
        tab.do(tab.locate('.rr-chain a:has-text("camera")').click())
        tab.sees(".rr-drawer h2", 'provider/camera "front"')
        tab.do(tab.page.go_back())
        tab.sees(".rr-drawer h2", 'provider/lens "50 mm"')
        tab.do(tab.page.go_forward())
        tab.sees(".rr-drawer h2", 'provider/camera "front"')
        tab.clicks("Tree", role="link")  # the choice goes on to the other pages
        tab.sees(".rr-drawer h2", 'provider/camera "front"')
        tab.presses("Escape")
        tab.waits(lambda: not tab.do(tab.locate(".rr-drawer").is_visible()), "the drawer is closed")
        assert address(tab) == ("/tree", {})


@needs_chromium
@pytest.mark.timeout(180)
def test_a_search_and_an_order_are_in_the_address(system: rr.System, tab: Tab) -> None:
    with system.serve_web() as page:
        tab.goes_to(page.url, "resources?match=lens&sort=holders")
        tab.sees(".ag-center-cols-container", "50 mm")
        assert tab.do(tab.locate(".ag-row").count()) == 1
        assert tab.do(tab.page.get_by_label("search in id").input_value()) == "lens"
        sorted_by = '.ag-header-cell[aria-sort="descending"]'
        tab.sees(sorted_by, "holders")
        tab.do(tab.locate('.ag-header-cell[col-id="resource"]').click())
        tab.waits(lambda: address(tab)[1].get("sort") == "resource", "the order in the address")
        tab.do(tab.page.get_by_label("search in id").fill("camera"))
        tab.waits(lambda: address(tab)[1].get("match") == "camera", "the search in the address")
        tab.do(tab.page.reload())
        tab.sees(".ag-center-cols-container", "front")
        tab.sees(sorted_by, "resource")


@needs_chromium
@pytest.mark.timeout(180)
def test_the_palette_finds_a_name_and_the_keys_lead_on(system: rr.System, tab: Tab) -> None:
    with system.serve_web() as page:
        tab.goes_to(page.url)
        tab.sees(".rr-lanes", "b")
        tab.presses("?")
        tab.sees("dialog", "Keys", "search a name or a page")
        tab.presses("Escape", "/")
        tab.sees("dialog [role=listbox]", "Tree", "page")
        tab.do(tab.page.keyboard.type("50 mm"))
        tab.waits(lambda: "Tree" not in tab.text("dialog"), "what matches, alone")
        tab.presses("Enter")
        tab.sees(".rr-drawer h2", 'provider/lens "50 mm"')
        assert address(tab) == ("/", {"resource": lens_of(system)})
        tab.presses("Escape", "j", "j", "Enter")
        tab.sees(".rr-drawer h2", "root/a")
        assert address(tab) == ("/", {"child": "root/a"})


@needs_chromium
@pytest.mark.timeout(180)
def test_a_narrow_page_has_its_pages_below_and_a_drawer_that_covers_the_work(
    system: rr.System, chromium: Chromium
) -> None:
    with system.serve_web() as page, chromium.tab(420, 900) as tab:
        tab.goes_to(page.url, "tree?child=root/a")
        tab.sees(".rr-drawer", "kill -9")
        assert tab.do(tab.page.evaluate("document.querySelector('.rr-main').inert"))
        place = "document.querySelector('.rr-nav').getBoundingClientRect()"
        assert tab.do(tab.page.evaluate(f"{place}.top > 700 && {place}.width === 420"))
        tab.presses("Escape")
        tab.waits(lambda: not tab.do(tab.locate(".rr-drawer").is_visible()), "the drawer is closed")
        assert not tab.do(tab.page.evaluate("document.querySelector('.rr-main').inert"))


@needs_chromium
@pytest.mark.timeout(180)
def test_a_child_that_dies_twice_stands_in_the_overview_with_a_mark_for_each_death(system: rr.System, tab: Tab) -> None:
    with system.serve_web() as page:
        tab.goes_to(page.url)
        tab.sees(".rr-lanes", "a")
        for _ in range(2):
            before = pid_of(system, "a")
            os.kill(before, signal.SIGKILL)
            tab.waits(lambda before=before: pid_of(system, "a") != before, "a new process")
        tab.sees(".rr-trouble", "root/a", "2 times")
        tab.waits(lambda: tab.do(tab.locate(".rr-lanes .rr-mark").count()) == 2, "two marks")
