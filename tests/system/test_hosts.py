"""Systems on several hosts, here on loopback: what is loaded, shared, told, lost and refused between them."""

from __future__ import annotations

import asyncio
import functools
import importlib.machinery
import json
import os
import re
import subprocess
import sys
import threading
from collections.abc import Iterator, Sequence
from pathlib import Path

import pytest

import rr_actors as rr
from rr_actors.registrar.model.messages import Describe, Load, Message
from rr_actors.system.hosts.host_messages import Beat, Beaten, Exported, Exports, GatewayMessage
from rr_actors.system.recording.recordings import Recording
from rr_actors.wire.hosts import zenoh_link
from rr_actors.wire.hosts.zenoh_link import ZenohTransport
from rr_actors.wire.transport import Attach, Hello, Link, Receiver, Welcome
from support import TEST_PATHS, kill
from support_cli import run_cli
from support_hosts import Cameras, Loops, Maps, Warmed, cameras_at, endpoint, until
from support_transports import Inbox

LIMIT_S = 150.0

pytestmark = pytest.mark.timeout(300)  # to start a host takes a second alone, and 20 s on a machine that is very busy

Pair = tuple[rr.System, rr.System]


def is_up(system: rr.System, host: str) -> bool:
    return any(info.name == host and info.state == "up" for info in system.hosts())


def says(system: rr.System, pattern: str) -> bool:
    """Return whether the reason of one of the hosts that a system knows matches."""
    return any(re.search(pattern, info.why) for info in system.hosts())


def wait_up(system: rr.System, registrar: str) -> None:
    host, _, name = registrar.partition("/")

    def up() -> bool:
        return any(info.name == host and info.exports.get(name) == "up" for info in system.hosts())

    until(up, f"{registrar} is up", LIMIT_S)


@pytest.fixture
def pair(tmp_path: Path) -> Iterator[Pair]:
    listen = endpoint()
    hosts = rr.Hosts("hosta", connect=[listen], routes={"routed": "hostb/cameras"})
    with (
        cameras_at(tmp_path / "b", listen) as b,
        rr.System([rr.ChildSpec(Cameras, id="own")], state_dir=tmp_path / "a", hosts=hosts) as a,
    ):
        wait_up(a, "hostb/cameras")
        yield a, b


def origins(system: rr.System) -> list[str]:
    """Return who holds what the cameras of a system serve."""
    return sorted(holder for resource in resources(system) for holder in resource.holders)


def resources(system: rr.System) -> list[rr.ResourceInfo]:
    return system.registrar("cameras").resources()


class Heard:
    """The statuses that a query heard."""

    def __init__(self) -> None:
        self.states: list[tuple[rr.State, str]] = []
        self.any = threading.Event()

    def __call__(self, status: rr.Status) -> None:
        self.states.append((status.state, status.source))
        self.any.set()

    def wait(self) -> list[tuple[rr.State, str]]:
        assert self.any.wait(LIMIT_S)
        return self.states


def test_a_load_of_another_host_is_shared_told_of_statuses_and_released(pair: Pair) -> None:
    a, b = pair
    heard = Heard()
    app, other = a.open_registrar("app"), a.open_registrar("other")
    first = app.load("hostb/cameras/camera", "front", on_status=heard, timeout_s=LIMIT_S)
    second = other.load("hostb/cameras/camera", "front", timeout_s=LIMIT_S)
    assert first.response == second.response == {"device": "front"}
    assert first.resource_id == second.resource_id
    assert first.server_id == "hostb/cameras/camera"
    assert len(resources(b)) == 1
    assert origins(b) == ["hosta/app", "hosta/other"]

    b.registrar("cameras").send_status(first.resource_id, rr.Status(rr.State.ERROR, "dark"))
    assert heard.wait() == [(rr.State.ERROR, "hostb/cameras/camera")]

    first.unload()
    assert origins(b) == ["hosta/other"]
    second.unload()
    assert resources(b) == []


def test_a_route_and_the_own_hosts_name(pair: Pair) -> None:
    a, b = pair
    app = a.open_registrar("app")
    assert app.load("routed/camera", "x", timeout_s=LIMIT_S).server_id == "hostb/cameras/camera"
    assert app.load("hosta/own/camera", "y", timeout_s=LIMIT_S).server_id == "own/camera"
    assert origins(b) == ["hosta/app"]
    app.unload_all()
    assert resources(b) == []


def test_what_a_registrar_held_elsewhere_is_released_when_its_system_stops(tmp_path: Path) -> None:
    listen = endpoint()
    with cameras_at(tmp_path / "b", listen) as b:
        with rr.System([], state_dir=tmp_path / "a", hosts=rr.Hosts("hosta", connect=[listen])) as a:
            wait_up(a, "hostb/cameras")
            a.open_registrar("app").load("hostb/cameras/camera", "x", timeout_s=LIMIT_S)
            assert origins(b) == ["hosta/app"]
        until(lambda: resources(b) == [], "the camera is released")
        until(lambda: not is_up(b, "hosta"), "hosta is seen to be away")
        assert [info.state for info in b.hosts()] == ["unreachable"]


def test_three_hosts_in_a_chain(tmp_path: Path) -> None:
    """app@a has a map of b, which has a camera of c: a status of the camera comes up, and an unload goes down."""
    at_c, at_b = endpoint(), endpoint()
    maps = rr.Hosts(
        "hostb", listen=[at_b], connect=[at_c], exports={"maps": rr.Export()}, routes={"cameras": "hostc/cameras"}
    )
    with (
        cameras_at(tmp_path / "c", at_c, "hostc") as c,
        rr.System([rr.ChildSpec(Maps, id="maps")], state_dir=tmp_path / "b", hosts=maps) as b,
        rr.System([], state_dir=tmp_path / "a", hosts=rr.Hosts("hosta", connect=[at_b])) as a,
    ):
        wait_up(b, "hostc/cameras")
        wait_up(a, "hostb/maps")
        heard = Heard()
        query = a.open_registrar("app").load("hostb/maps/map", "front", on_status=heard, timeout_s=LIMIT_S)
        assert query.response == {"map": "front"}
        assert origins(c) == ["hostb/maps"]
        camera = resources(c)[0]
        c.registrar("cameras").send_status(camera.id, rr.Status(rr.State.WARNING, "dim"))
        assert heard.wait() == [(rr.State.WARNING, "hostc/cameras/camera")]
        query.unload()
        assert resources(c) == []
        with pytest.raises(rr.LoadFailed) as raised:
            a.open_registrar("again").load("hostb/maps/map", "broken", timeout_s=LIMIT_S)
        assert [frame.origin for frame in raised.value.trace] == ["hostc/cameras/camera", "hostb/maps/map"]


@pytest.mark.parametrize(("where", "child"), [("a", "hosts"), ("b", "hosts"), ("b", "cameras")])
def test_after_sigkill_what_was_held_is_held_and_loads_go_on(pair: Pair, where: str, child: str) -> None:
    a, b = pair
    app = a.open_registrar("app")
    heard = Heard()
    query = app.load("hostb/cameras/camera", "front", on_status=heard, timeout_s=LIMIT_S)
    kill(a if where == "a" else b, child)

    assert app.load("hostb/cameras/camera", "back", timeout_s=LIMIT_S).response == {"device": "back"}
    assert sorted(camera.response["device"] for camera in resources(b)) == ["back", "front"]
    assert origins(b) == ["hosta/app", "hosta/app"]
    b.registrar("cameras").send_status(query.resource_id, rr.Status(rr.State.ERROR, "dark"))
    until(lambda: (rr.State.ERROR, "hostb/cameras/camera") in heard.states, "the status is heard")
    app.unload_all(timeout_s=LIMIT_S)
    assert resources(b) == []


def test_who_holds_something_hears_that_its_host_stops_orderly(tmp_path: Path) -> None:
    listen = endpoint()
    with rr.System([], state_dir=tmp_path / "a", hosts=rr.Hosts("hosta", connect=[listen])) as a:
        app, heard = a.open_registrar("app"), Heard()
        with cameras_at(tmp_path / "b", listen):
            wait_up(a, "hostb/cameras")
            app.load("hostb/cameras/camera", "front", on_status=heard, timeout_s=LIMIT_S)
        assert heard.wait() == [(rr.State.FATAL, "hostb/cameras/camera")]
        assert app.queries() == []


def test_what_is_held_on_a_host_that_is_killed_is_held_when_it_is_back(tmp_path: Path) -> None:
    listen = endpoint()
    program = (
        "import sys, support_hosts; from pathlib import Path\n"
        "if __name__ == '__main__': support_hosts.cameras_at(Path(sys.argv[1]), sys.argv[2]).run()\n"
    )

    def start() -> subprocess.Popen[bytes]:
        command = [sys.executable, "-c", program, tmp_path / "b", listen]
        return subprocess.Popen(command, env=os.environ | {"PYTHONPATH": TEST_PATHS})

    with rr.System([], state_dir=tmp_path / "a", hosts=rr.Hosts("hosta", connect=[listen])) as a:
        app = a.open_registrar("app")
        other = start()
        try:
            wait_up(a, "hostb/cameras")
            query = app.load("hostb/cameras/camera", "front", timeout_s=LIMIT_S)
            other.kill()
            other.wait()
            until(lambda: not is_up(a, "hostb"), "hostb is seen to be away")
            assert [held.id for held in app.queries()] == [query.id]
            other = start()
            again = app.load("hostb/cameras/camera", "front", timeout_s=LIMIT_S)
            assert again.resource_id == query.resource_id
            app.unload_all(timeout_s=LIMIT_S)
        finally:
            other.terminate()
            other.wait()


def test_one_that_waits_for_an_exclusive_resource_of_another_host_hears_who_has_it(pair: Pair) -> None:
    a, _ = pair
    app, other = a.open_registrar("app"), a.open_registrar("other")
    with app.load("hostb/cameras/scope", "one", timeout_s=LIMIT_S):
        with pytest.raises(rr.ResourceBusy, match="hosta/app has it"):
            other.load("hostb/cameras/scope", "one", wait_s=0, timeout_s=LIMIT_S)
        waiting = other.load("hostb/cameras/scope", "one", block=False, timeout_s=LIMIT_S)
    waiting.get(timeout=LIMIT_S).unload()


def test_a_host_that_goes_and_comes(tmp_path: Path) -> None:
    listen = endpoint()
    nobody = f"; nobody answers at {listen}"
    hosts = rr.Hosts("hosta", connect=[listen], routes={"cameras": "hostb/cameras"})
    with rr.System([], state_dir=tmp_path / "a", hosts=hosts) as a:
        app = a.open_registrar("app")
        assert [(info.name, info.state) for info in a.hosts()] == [("hostb", "unreachable")]
        until(functools.partial(says, a, f"not seen .*{nobody}"), "it says what was tried", LIMIT_S)
        with pytest.raises(rr.HostUnreachable, match=f"hostb: unreachable since .*{nobody}") as raised:
            app.load("cameras/camera", "x", timeout_s=0.2)
        assert raised.value.host == "hostb"
        assert raised.value.since_s > 0
        with pytest.raises(rr.HostUnreachable, match="hostb: unreachable since"):
            app.load("hostb/other/camera", "x", timeout_s=0.2)

        waiting = app.load("cameras/camera", "x", block=False, timeout_s=LIMIT_S)
        with cameras_at(tmp_path / "b", listen) as b:
            assert waiting.get(timeout=LIMIT_S).response == {"device": "x"}
            assert origins(b) == ["hosta/app"]
            with pytest.raises(rr.NotExported, match="does not export 'other' to 'hosta'; it exports: cameras"):
                app.load("hostb/other/camera", "x")
            waiting.get().unload()
        until(lambda: not is_up(a, "hostb"), "hostb is seen to be away")
        until(functools.partial(says, a, nobody), "it is looked for again", LIMIT_S)
        with cameras_at(tmp_path / "c", listen, "hostc"):
            other = f"another host answers at {listen}$"
            until(functools.partial(says, a, other), "hostb is not there, and hostc is", LIMIT_S)
            assert is_up(a, "hostc")


def test_who_may_load_what(tmp_path: Path) -> None:
    listen = endpoint()
    with (
        cameras_at(tmp_path / "b", listen, to=("hostc",)),
        rr.System([], state_dir=tmp_path / "a", hosts=rr.Hosts("hosta", connect=[listen])) as a,
    ):
        until(lambda: is_up(a, "hostb"), "hostb is up")
        app = a.open_registrar("app")
        with pytest.raises(rr.NotExported, match="'cameras' to 'hosta'; it exports: none") as not_exported:
            app.load("hostb/cameras/camera", "x")
        assert (not_exported.value.host, not_exported.value.registrar) == ("hostb", "cameras")
        with pytest.raises(rr.UnknownHost, match="did you mean 'hostb'") as unknown:
            app.load("hostv/cameras/camera", "x")
        assert unknown.value.host == "hostv"
        with pytest.raises(rr.InvalidName):
            app.load("too/many/parts/here", "x")


@pytest.mark.usefixtures("runtime_dir")
def test_the_command_line_shows_the_other_hosts(pair: Pair, tmp_path: Path) -> None:
    ran = run_cli("hosts", "--state", tmp_path / "a")
    assert ran.returncode == 0, ran.stderr
    assert re.fullmatch(r"hostb  up for \d+ s; exports cameras \(up\)\n", ran.stdout), ran.stdout
    shown = json.loads(run_cli("hosts", "--state", tmp_path / "a", "--json").stdout)
    assert shown["host"] == "hosta"
    assert [(row["name"], row["exports"]) for row in shown["hosts"]] == [("hostb", {"cameras": "up"})]
    with rr.System([], state_dir=tmp_path / "alone"):
        assert "it ends at this host" in run_cli("hosts", "--state", tmp_path / "alone").stderr


def test_a_system_without_hosts_knows_none(tmp_path: Path) -> None:
    with rr.System([], state_dir=tmp_path) as system:
        with pytest.raises(rr.UsageError, match=r"System\(hosts=\.\.\.\)"):
            system.hosts()
        with pytest.raises(rr.UnknownRegistrar):
            system.open_registrar("app").load("hostb/cameras/camera", "x")


def test_a_port_that_is_taken_is_an_error_at_the_start(tmp_path: Path) -> None:
    listen = endpoint()
    with (
        cameras_at(tmp_path / "b", listen),
        pytest.raises(rr.StartFailed, match=f"cannot listen at {listen}"),
        cameras_at(tmp_path / "c", listen, "hostc"),
    ):
        pass


MESSAGES = {"registrar": Message, "hosts": GatewayMessage}


def test_a_host_of_another_version_is_refused_by_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(zenoh_link, "PROTOCOL", 99)
    listen = endpoint()

    seen = threading.Event()

    async def be_old() -> None:
        network = ZenohTransport("rr", "hostb", MESSAGES, connect=[listen])
        try:
            await network.listen(lambda hello: (_ for _ in ()).throw(AssertionError(hello)))
            await asyncio.get_running_loop().run_in_executor(None, seen.wait, LIMIT_S)
        finally:
            await network.close()

    with rr.System([], state_dir=tmp_path / "a", hosts=rr.Hosts("hosta", listen=[listen])) as a:
        app = a.open_registrar("app")
        versions = threading.Thread(target=lambda: asyncio.run(be_old()))
        versions.start()
        try:
            refused = "hosta speaks protocol 2, hostb speaks 99"
            until(lambda: any(i.state == "refused" and refused in i.why for i in a.hosts()), "hostb is refused")
            with pytest.raises(rr.ProtocolMismatch, match="install the same version"):
                app.load("hostb/cameras/camera", "x")
        finally:
            seen.set()
            versions.join(LIMIT_S)
        assert not versions.is_alive()


@pytest.mark.parametrize(
    ("origin", "message", "why"),
    [
        ("hostx/app", Describe("camera"), "no pickle crosses between hosts"),
        ("hostx/app", Load("1" * 32, "camera", b"\xa1x", "hosty/app", "", 0, 1), "None"),  # the provider closes it
        ("hosty/app", None, "host 'hostx' speaks for 'hosty/app'"),
        ("app", None, "speaks for 'app'"),
    ],
)
def test_what_another_host_may_not_say_is_refused(
    tmp_path: Path, origin: str, message: Message | None, why: str
) -> None:
    """A stranger of the same version, which has no registrars: what it sends breaks its own link alone."""
    listen = endpoint()

    async def be_strange() -> str:
        network = ZenohTransport("rr", "hostx", MESSAGES, connect=[listen])
        inbox, exports = Inbox(), Inbox()
        try:
            await network.connect("hostb", Hello("hosts", "hostb", "hostx", 0), exports.attach)
            await exports.until(lambda: any(one.status == "up" for said in exports.messages for one in said.exported))
            link = await network.connect("hostb", Hello("registrar", "cameras", origin, 1), inbox.attach)
            if message is not None:
                link.send_now(message)
            await inbox.until(lambda: bool(inbox.lost_reasons))
            return str(inbox.lost_reasons[0])
        except rr.RrError as error:
            return str(error)
        finally:
            await network.close()

    with cameras_at(tmp_path / "b", listen) as b:
        said = asyncio.run(be_strange())
        assert resources(b) == []
    assert why in said


@pytest.mark.parametrize(
    ("exported", "why"),
    [
        ([Exported("../x", "up", 1, "")], r"a registrar that none can be: name '\.\./x'"),
        ([Exported("x", "there", 1, "")], "a registrar that none can be: 'there'"),
        ([Exported(f"x{number}", "up", 1, "") for number in range(1001)], "1001 registrars: expected 1000 at most"),
        ([Exported("x", "up", 1, "")], ""),
    ],
    ids=["name", "status", "many", "refuses"],
)
def test_a_host_that_says_what_cannot_be_or_refuses_all_links_is_not_asked_without_a_pause(
    tmp_path: Path, exported: list[Exported], why: str
) -> None:
    listen, asked = endpoint(), [0]
    ended = threading.Event()

    def accept(hello: Hello) -> tuple[Welcome, Attach]:
        asked[0] += 1
        if hello.kind != "hosts":
            raise rr.Unavailable("it does not want to")

        def attach(link: Link) -> Receiver:
            asyncio.get_running_loop().call_soon(link.send_now, Exports(exported, 10.0))
            return _Ignored()

        return Welcome(1), attach

    async def be_strange() -> None:
        network = ZenohTransport("rr", "hostx", MESSAGES, connect=[listen])
        try:
            await network.listen(accept)
            await asyncio.get_running_loop().run_in_executor(None, ended.wait, LIMIT_S)
        finally:
            await network.close()

    with rr.System([], state_dir=tmp_path / "a", hosts=rr.Hosts("hosta", listen=[listen])) as a:
        strange = threading.Thread(target=lambda: asyncio.run(be_strange()))
        strange.start()
        try:
            until(functools.partial(says, a, why) if why else functools.partial(is_up, a, "hostx"), why, LIMIT_S)
            with pytest.raises(rr.LoadTimeout):
                a.open_registrar("app").load("hostx/x/y", 1, timeout_s=1)
            assert asked[0] < 20 if why else asked[0] < 40
        finally:
            ended.set()
            strange.join(LIMIT_S)
        assert not strange.is_alive()


class _Ignored:
    """A receiver that answers heartbeats alone."""

    def received(self, link: Link, message: object) -> None:
        if isinstance(message, Beat):
            link.send_now(Beaten(message.number))

    def lost(self, link: Link, reason: Exception | None) -> None:
        """Ignore it."""


def test_of_two_systems_with_one_name_the_second_is_refused_until_the_first_has_gone(tmp_path: Path) -> None:
    """Each says which processes they are: at the host that both have reached, and at the second one."""
    listen = endpoint()

    def named_a(place: str) -> rr.System:
        return rr.System([], state_dir=tmp_path / place, hosts=rr.Hosts("hosta", connect=[listen]))

    with cameras_at(tmp_path / "b", listen) as b, named_a("first") as first:
        wait_up(first, "hostb/cameras")
        first.open_registrar("app").load("hostb/cameras/camera", "front", timeout_s=LIMIT_S)
        with named_a("second") as second:
            app = second.open_registrar("app")
            until(lambda: bool(second.hosts()), "the second knows hostb", LIMIT_S)
            waiting = app.load("hostb/cameras/camera", "rear", timeout_s=8.0, block=False)
            until(lambda: any(info.state == "refused" for info in second.hosts()), "the second is refused", LIMIT_S)
            refused = r"a system in process \d+ of \S+ is host 'hosta' of group 'rr' already, so 'hostb' refuses"
            with pytest.raises(rr.NameTaken, match=refused) as raised:
                app.load("hostb/cameras/camera", "front")
            assert raised.value.name == "hosta"
            with pytest.raises(rr.LoadTimeout, match=refused):
                waiting.get()
            seen = r"a system in process \d+ of \S+ has its name, too, and is refused"
            until(functools.partial(says, b, seen), "hostb says so", LIMIT_S)
            assert is_up(b, "hosta")
            assert origins(b) == ["hosta/app"]
            first.stop()
            wait_up(second, "hostb/cameras")
            assert app.load("hostb/cameras/camera", "front", timeout_s=LIMIT_S).response == {"device": "front"}


def test_two_systems_with_one_name_that_reach_each_other_say_so(tmp_path: Path) -> None:
    listen = endpoint()
    with (
        rr.System([], state_dir=tmp_path / "1", hosts=rr.Hosts("hosta", listen=[listen])) as one,
        rr.System([], state_dir=tmp_path / "2", hosts=rr.Hosts("hosta", connect=[listen])) as two,
    ):
        said = r"a system in process \d+ of \S+ of group 'rr' has this host's name, too: give each one of its own"
        for system in (one, two):
            until(functools.partial(says, system, said), "it says so", LIMIT_S)
            assert [(info.name, info.state) for info in system.hosts()] == [("hosta", "refused")]
        two.stop()
        until(lambda: one.hosts() == [], "only one has the name", LIMIT_S)


def test_a_ring_over_two_hosts_is_refused_with_the_names_around_it(tmp_path: Path) -> None:
    listen = endpoint()

    def host(name: str, other: str, listens: Sequence[str], connects: Sequence[str]) -> rr.System:
        routes, exports = {"other": f"{other}/loops"}, {"loops": rr.Export(to=[other])}
        hosts = rr.Hosts(name, listen=listens, connect=connects, routes=routes, exports=exports)
        return rr.System([rr.ChildSpec(Loops, id="loops")], state_dir=tmp_path / name, hosts=hosts)

    with host("hosta", "hostb", [], [listen]) as a, host("hostb", "hosta", [listen], []) as b:
        wait_up(a, "hostb/loops")
        wait_up(b, "hosta/loops")
        with pytest.raises(rr.CircularDependency) as raised:
            a.open_registrar("app").load("loops/loop", "x", timeout_s=LIMIT_S)
        assert {*raised.value.ring} == {"loops/loop", "hostb/loops/loop"}
        assert "hostb/loops/loop -> " in str(raised.value)
        assert "hosta" not in str(raised.value)
        assert [*a.registrar("loops").resources(), *b.registrar("loops").resources()] == []


def test_priorities_and_progress_reach_the_other_host(tmp_path: Path) -> None:
    listen = endpoint()
    hosts = rr.Hosts("hostb", listen=[listen], exports={"lamps": rr.Export()})
    with (
        rr.System([rr.ChildSpec(Warmed, id="lamps")], state_dir=tmp_path / "b", hosts=hosts) as b,
        rr.System([], state_dir=tmp_path / "a", hosts=rr.Hosts("hosta", connect=[listen])) as a,
    ):
        wait_up(a, "hostb/lamps")
        heard: list[tuple[float, str]] = []
        query = a.open_registrar("app").load(
            "hostb/lamps/lamp",
            "left",
            priority=7,
            progress=lambda progress: heard.append((progress.fraction, progress.text)),
            timeout_s=LIMIT_S,
        )
        assert heard == [(0.5, "warm")]
        assert [lamp.priority for lamp in b.registrar("lamps").resources()] == [7]
        query.priority = 2
        until(lambda: [lamp.priority for lamp in b.registrar("lamps").resources()] == [2], "it is less urgent")


def traced(recording: Recording, query: rr.Query) -> set[str]:
    """Return what the entries of a trace say: "app>cameras Load", "cameras load began"."""
    try:
        entries = recording.trace(query.id).entries
    except rr.NotFound:
        return set()
    sent = {f"{entry.registrar}>{entry.peer} {entry.name}" for entry in entries if entry.event == "sent"}
    return sent | {f"{one.registrar} {one.name} {one.event}" for one in entries if one.event in ("began", "ended")}


def test_the_traces_of_both_hosts_have_the_same_query(pair: Pair) -> None:
    a, b = pair
    with a.record() as here, b.record() as there:
        query = a.open_registrar("app").load("hostb/cameras/camera", "front", timeout_s=LIMIT_S)
        until(lambda: {"cameras>hosta/app Loaded"} <= traced(there, query), "it is recorded there", 30)
        until(lambda: {"app>hostb/cameras Load"} <= traced(here, query), "it is recorded here", 30)
    assert traced(here, query) == {"app>hostb/cameras Load"}
    assert traced(there, query) == {"cameras load began", "cameras load ended", "cameras>hosta/app Loaded"}


def test_a_connection_loads_from_another_host_by_its_name_and_by_a_route(pair: Pair, tmp_path: Path) -> None:
    _, b = pair
    with rr.connect(tmp_path / "a") as connection:
        app, heard = connection.open_registrar("app"), Heard()
        routed = app.load("routed/camera", "front", on_status=heard, timeout_s=LIMIT_S)
        named = app.load("hostb/cameras/camera", "front", timeout_s=LIMIT_S)
        assert (routed.server_id, named.server_id) == ("hostb/cameras/camera", "hostb/cameras/camera")
        assert routed.resource_id == named.resource_id
        assert origins(b) == ["hosta/connection.app", "hosta/connection.app"]
        b.registrar("cameras").send_status(routed.resource_id, rr.Status(rr.State.ERROR, "dark"))
        assert heard.wait() == [(rr.State.ERROR, "hostb/cameras/camera")]
        with pytest.raises(rr.UnknownHost):
            app.load("hostv/cameras/camera", "front", timeout_s=LIMIT_S)
        app.unload_all(timeout_s=LIMIT_S)
        assert resources(b) == []


def test_without_zenoh_the_error_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    found = importlib.machinery.PathFinder.find_spec
    gone = functools.partial(lambda name, *more: None if name == "zenoh" else found(name, *more))
    monkeypatch.setattr(importlib.machinery.PathFinder, "find_spec", gone)
    needed = r"System\(hosts=\.\.\.\) needs the library zenoh.*pip install 'eclipse-zenoh"
    with pytest.raises(rr.UsageError, match=needed):
        rr.System([], hosts=rr.Hosts("hosta", listen=["tcp/127.0.0.1:7447"]))
