"""What the web page draws: where nodes are, what lights up, how a status travels, and what it was minutes ago."""

from __future__ import annotations

import os
import signal
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

import rr_actors as rr
from rr_actors.registrar.model.recorded import Entry
from rr_actors.registrar.pages import HolderRow, ResourceRow, ServerRow
from rr_actors.system.console.console_connection import ConsoleConnection
from rr_actors.system.console.console_messages import Entries, RegistrarRow
from rr_actors.system.console.console_questions import ListServers
from rr_actors.tools.terminal.console_link import ConsoleLink
from rr_actors.tools.web import sequence_page
from rr_actors.tools.web.graph_picture import Chart, around, chart, edges_in, neighbours_of, rows_of_server, travels
from rr_actors.tools.web.sequence_page import Recorder
from rr_actors.tools.web.watch import Moment, Moments, Watch
from support import LIMIT_S, Gate, child, eventually, hang, kill, pid_of, serve, wait_respawned
from support_inside import node_of

Start = Callable[..., rr.System]


def resource(id: str, server: str, *holders: tuple[str, str], state: str = "OK") -> ResourceRow:
    """A resource, and who holds it for which of its own."""
    held = [HolderRow(f"{id}-{origin}-{parent}", origin, parent) for origin, parent in holders]
    return ResourceRow(id, server, f'"{id}"', "", "loaded", state, "", 1, held, len(held), [], 0)


LENS = resource("lens", "lenses/lens", ("cameras", "front"), ("cameras", "back"))
FRONT = resource("front", "cameras/camera", ("app", ""))
BACK = resource("back", "cameras/camera", ("guard", ""))
ROBOT = Moment(1.0, resources=(LENS, FRONT, BACK), total=3)


def x_of(moment: Moment) -> dict[str, float]:
    return {node["name"]: node["value"][0] for node in chart(moment)["series"][1]["data"]}


def test_what_holds_is_left_of_what_is_held() -> None:
    x = x_of(ROBOT)

    assert x["@app"] < x["front"] < x["lens"]
    assert x["front"] == x["back"]


def test_registrars_that_hold_of_each_other_have_places_all_the_same() -> None:
    first = resource("a", "one/x", ("two", "b"))
    second = resource("b", "two/x", ("one", "a"))

    assert set(x_of(Moment(1.0, resources=(first, second), total=2))) == {"a", "b"}


def test_a_choice_lights_up_its_holders_and_parts_and_not_its_siblings() -> None:
    assert around("front", edges_in(ROBOT)) == {"front", "@app", "lens"}
    assert around("lens", edges_in(ROBOT)) == {"lens", "front", "back", "@app", "@guard"}
    assert around("", edges_in(ROBOT)) == set()


def test_a_status_travels_step_by_step_to_those_who_hold() -> None:
    told = [("lens", 100.0), ("back", 100.001), ("front", 100.002)]

    assert travels(told, ROBOT, 0.5) == {"lens": 100.0, "back": 100.5, "front": 100.5, "@app": 101.0, "@guard": 101.0}


def test_a_state_is_shown_by_its_sign_and_its_shape_too() -> None:
    moment = Moment(1.0, resources=(resource("bad", "a/b", state="FATAL"), resource("good", "a/b")), total=2)
    bad, good = chart(moment)["series"][1]["data"]

    assert bad["label"]["formatter"] != good["label"]["formatter"].replace("good", "bad")
    assert bad["symbol"] != good["symbol"]


def test_a_request_is_no_markup_in_a_tooltip() -> None:
    (node,) = chart(Moment(1.0, resources=(resource("<img onerror=x>", "a/b"),), total=1))["series"][1]["data"]

    assert "<img" not in node["tooltip"]["formatter"]


MANY = Moment(
    1.0,
    registrars=(RegistrarRow("app", "up"), RegistrarRow("radar", "dormant")),
    total=19_999,
    servers=(
        ServerRow("app", {}, {"cameras/camera": 2}),
        ServerRow("guard", {}, {"cameras/camera": 1}),
        ServerRow("cameras/camera", {"OK": 12_000, "ERROR": 3, "WARNING": 7_000}, {"lenses/lens": 19_000}),
        ServerRow("lenses/lens", {"OK": 996}),
    ),
)


def nodes_of(options: Chart) -> dict[str, Any]:
    return {node["name"]: node for node in options["series"][1]["data"]}


def links_of(options: Chart) -> set[tuple[str, str]]:
    return {(link["source"], link["target"]) for link in options["series"][1]["links"]}


def test_too_many_resources_are_shown_as_their_servers_with_counts_in_the_colour_of_the_worst() -> None:
    options = chart(MANY)
    nodes = nodes_of(options)

    assert nodes["#cameras/camera"]["label"]["formatter"] == "✖ camera\n19,003\n3 ERROR\n7,000 WARNING"
    assert nodes["#lenses/lens"]["label"]["formatter"] == "lens\n996"
    assert nodes["@radar"]["label"]["formatter"].endswith("@radar: dormant")
    bad = nodes_of(chart(Moment(1.0, resources=(resource("bad", "a/b", state="ERROR"),), total=1)))["bad"]
    assert nodes["#cameras/camera"]["itemStyle"]["color"] == bad["itemStyle"]["color"]
    assert nodes["#lenses/lens"]["itemStyle"]["color"] != bad["itemStyle"]["color"]
    assert links_of(options) == {
        ("@app", "#cameras/camera"),
        ("@guard", "#cameras/camera"),
        ("#cameras/camera", "#lenses/lens"),
    }


def test_an_opened_server_has_its_rows_and_a_node_for_those_that_are_left() -> None:
    broken = resource("broken", "cameras/camera", ("app", ""), state="ERROR")
    options = chart(MANY, opened={"cameras/camera": [broken], "lenses/lens": [LENS]})

    assert nodes_of(options)["#cameras/camera"]["label"]["formatter"] == (
        "✖ camera\n19,002 more\n2 ERROR\n7,000 WARNING"
    )
    assert nodes_of(options)["broken"]["label"]["formatter"] == '✖ camera "broken"'
    assert ("@app", "broken") in links_of(options)
    assert ("@guard", "broken") not in links_of(options)  # it holds another camera
    assert ("#cameras/camera", "lens") in links_of(options)


def test_the_servers_of_a_system_are_counted_and_opened_the_worst_first_and_a_resource_has_its_neighbours(
    start: Start, state_dir: Path
) -> None:
    system = start()
    app, maps, cameras = map(system.open_registrar, ("app", "maps", "cameras"))
    serve(cameras, "camera")
    serve(cameras, "spare")
    serve(maps, "map", load=lambda request: maps.load("cameras/camera", request).id)
    top = app.load("maps/map", "hall")
    app.load_all([("cameras/camera", f"unused {number}") for number in range(50)])
    (hall,) = [row for row in cameras.resources() if row.request == "hall"]
    cameras.send_status(hall.id, rr.Status("ERROR", "dark"))
    link = ConsoleLink(state_dir)
    try:
        eventually(lambda: app.queries()[0].state == "ERROR")
        servers = {row.server: row for row in link.ask(ListServers()).rows}
        opened = rows_of_server(link.ask, "cameras/camera", servers["cameras/camera"].states)
        near = neighbours_of(link.ask, hall.id)
    finally:
        link.close()

    assert servers["cameras/camera"].states == {"OK": 50, "ERROR": 1}
    assert servers["cameras/spare"] == ServerRow("cameras/spare")
    assert servers["maps/map"].holds == {"cameras/camera": 1}
    assert servers["app"] == ServerRow("app", {}, {"maps/map": 1, "cameras/camera": 50})
    assert opened[0].id == hall.id
    assert len(opened) == 40
    assert [row.id for row in near] == [hall.id, top.resource_id]


def test_a_watch_keeps_what_was_and_shares_what_has_not_changed(start: Start, state_dir: Path) -> None:
    system = start(rr.ChildSpec(rr.Actor, id="a"), rr.ChildSpec(rr.Actor, id="b"))
    serve(system.open_registrar("app"), "thing")
    watch = Watch(state_dir)
    watch.start()
    try:
        eventually(lambda: watch.now.stale == "" and not watch.now.problem)
        before = watch.now
        kill(system, "a")
        eventually(lambda: any(row.restarts and row.state == "running" for row in watch.now.children))
        assert watch.moment_at(before.at) is before
        assert watch.moment_at(0.0) is watch.moments[0]
        assert watch.moment_at(time.time()) is watch.now
        assert {id(row) for row in before.children} & {id(row) for row in watch.now.children}
        assert watch.now.registrars is before.registrars
        assert child(system, "a").state == "running"
    finally:
        watch.stop()


def test_a_watch_that_comes_late_has_the_events_before_it_and_a_timeline_until_now(
    start: Start, state_dir: Path
) -> None:
    system = start(rr.ChildSpec(rr.Actor, id="early"))
    wait_respawned(system, "early", kill(system, "early"))
    watch = Watch(state_dir)
    watch.start()
    try:
        eventually(lambda: watch.now.stale == "" and watch.heard)
        assert watch.moments[0].stale is not None  # the slider begins with a whole picture
        told = [str(line) for line in watch.lines.lines()]
        assert any("exited" in line and "root/early" in line and "SIGKILL" in line for line in told)
        before = watch.timeline().until
        eventually(lambda: watch.timeline().until > before)
        assert time.time() - watch.timeline().until < LIMIT_S
    finally:
        watch.stop()


def test_a_watch_has_all_resources_also_if_their_statuses_are_together_too_long_for_an_answer(
    app: rr.Registrar, provider: rr.Registrar, state_dir: Path
) -> None:
    serve(provider, "thing")
    for query in app.load_all([("provider/thing", number) for number in range(130)]):
        provider.send_status(query, rr.Status("WARNING", "\N{BELL}" * 9_000))
    watch = Watch(state_dir)
    watch.start()
    try:
        eventually(lambda: watch.now.total)
        assert len({row.id for row in watch.now.resources}) == 130
    finally:
        watch.stop()


def test_a_watch_knows_the_children_while_a_registrar_does_not_answer(
    start: Start, state_dir: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    system = start(rr.ChildSpec(rr.Manager, id="still"), rr.ChildSpec(rr.Actor, id="actor"))
    monkeypatch.setattr("rr_actors.tools.web.watch._LOOK_S", 0.5)
    watch = Watch(state_dir)
    watch.start()
    try:
        eventually(lambda: watch.now.stale == "" and not watch.now.problem)
        still = pid_of(system, "still")
        hang(still)
        eventually(lambda: watch.now.stale, what="no answer of the registrar")
        kill(system, "actor")
        eventually(lambda: any(row.restarts and row.state == "running" for row in watch.now.children))
        assert watch.now.problem == ""
        assert [row.name for row in watch.now.registrars] == ["still"]
        os.kill(still, signal.SIGCONT)
        eventually(lambda: watch.now.stale == "", what="the registrar's answer")
    finally:
        watch.stop()


def test_a_watch_keeps_ten_minutes_and_a_bounded_number_of_moments() -> None:
    moments = Moments([Moment(0.0)])
    for number in range(5000):
        assert moments.add(Moment(1000.0 + number / 100, total=number, stale=""))
    assert len(moments) == 3000
    assert moments.add(Moment(2000.0, total=1, stale=""))
    assert [moment.at for moment in moments] == [2000.0]
    assert not moments.add(Moment(2001.0, total=1, stale=""))  # nothing has changed
    assert len(moments) == 1


# -- a page's recording ----------------------------------------------------------------------------------------------


@pytest.fixture
def recorder(system: rr.System, state_dir: Path) -> Iterator[Recorder]:
    """The recorder of a page that shows the system."""
    watch = Watch(state_dir)
    recorder = Recorder(watch)
    yield recorder
    recorder.close()
    watch.stop()


@pytest.fixture
def reached(monkeypatch: pytest.MonkeyPatch) -> Gate:
    """Where the recorder waits when it has reached the system."""
    gate = Gate()

    class Slow(ConsoleConnection):
        def record(self, *, decisions: bool = False) -> Iterator[Entries]:
            gate()
            return super().record(decisions=decisions)

    monkeypatch.setattr(sequence_page, "ConsoleConnection", Slow)
    return gate


def is_recorded(system: rr.System) -> bool:
    return node_of(system).watched.level[0] > 1


def test_two_clicks_on_record_leave_one_recording_and_stop_ends_it(
    system: rr.System, recorder: Recorder, reached: Gate
) -> None:
    clicks = [threading.Thread(target=recorder.start) for _ in range(2)]
    for click in clicks:
        click.start()
        clicks[0].join(0.2)
    reached.open()
    for click in clicks:
        click.join()
    assert recorder.is_recording
    assert is_recorded(system)

    recorder.stop()
    assert not recorder.is_recording
    eventually(lambda: not is_recorded(system))


def test_a_page_that_is_left_while_its_recording_starts_records_nothing(
    system: rr.System, recorder: Recorder, reached: Gate
) -> None:
    click, leaving = threading.Thread(target=recorder.start), threading.Thread(target=recorder.close)
    click.start()
    reached.wait_arrived()
    leaving.start()
    leaving.join(0.2)
    reached.open()
    click.join()
    leaving.join()
    eventually(lambda: not is_recorded(system))

    recorder.start()
    assert not recorder.is_recording


def test_a_page_sees_that_its_recording_goes_on_when_it_is_full_and_what_it_has_missed(
    recorder: Recorder, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Told(ConsoleConnection):
        def record(self, *, decisions: bool = False) -> Iterator[Entries]:
            entries = [Entry(float(number), "loaded") for number in range(3)]
            return iter([Entries(entries), Entries([], 5), Entries(entries[:1], 7)])

    monkeypatch.setattr(sequence_page, "ConsoleConnection", Told)
    monkeypatch.setattr(sequence_page, "_LIMIT", 2)
    recorder.start()

    eventually(lambda: recorder.extent == (2, 1 + 5 + 7 + 1, False))
