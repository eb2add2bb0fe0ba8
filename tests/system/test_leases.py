"""Leases between hosts: what a host holds that is away for longer is released, and its programs hear of it before."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Literal

import pytest

import rr_actors as rr
from support import TEST_PATHS, hang, kill, pid_of
from support_cli import run_cli
from support_hosts import Cameras, Proxy, endpoint, until

LIMIT_S = 150.0
LEASE_S = 1.0
ENVIRONMENT = os.environ | {"PYTHONPATH": TEST_PATHS}

pytestmark = pytest.mark.timeout(300)

Hosts = tuple[rr.System, rr.System, Proxy]


class Heard:
    """The statuses that a query heard."""

    def __init__(self) -> None:
        self.states: list[tuple[rr.State, str]] = []
        self.any = threading.Event()

    def __call__(self, status: rr.Status) -> None:
        self.states.append((status.state, status.message))
        self.any.set()


def cameras_at(state_dir: Path, listen: str, on_lost: Literal["keep", "release"] = "release") -> rr.System:
    exports = {"cameras": rr.Export(on_lost=on_lost)}
    hosts = rr.Hosts("hostb", listen=[listen], exports=exports, lease_s=LEASE_S)
    return rr.System([rr.ChildSpec(Cameras, id="cameras")], state_dir=state_dir, hosts=hosts)


def consumer_at(state_dir: Path, at: str) -> rr.System:
    return rr.System([], state_dir=state_dir, hosts=rr.Hosts("hosta", connect=[at]))


@pytest.fixture(params=["release"])
def hosts(tmp_path: Path, request: pytest.FixtureRequest) -> Iterator[Hosts]:
    """The consumer's host, the provider's, and the network between them."""
    listen = endpoint()
    with (
        cameras_at(tmp_path / "b", listen, request.param) as b,
        Proxy(listen) as proxy,
        consumer_at(tmp_path / "a", proxy.endpoint) as a,
    ):
        yield a, b, proxy


def holders(system: rr.System) -> list[str]:
    """Return who holds what the cameras of a system serve."""
    return sorted(holder for one in system.registrar("cameras").resources() for holder in one.holders)


def is_lost(heard: Heard) -> bool:
    return [state for state, _ in heard.states] == [rr.State.FATAL] and "lease at host 'hostb'" in heard.states[0][1]


def test_what_is_held_by_a_host_that_is_away_is_released_and_its_programs_hear_of_it_before(hosts: Hosts) -> None:
    a, b, proxy = hosts
    heard, app = Heard(), a.open_registrar("app")
    query = app.load("hostb/cameras/camera", "front", on_status=heard, timeout_s=LIMIT_S)
    own = b.open_registrar("own").load("cameras/camera", "front")
    assert holders(b) == ["hosta/app", "own"]

    proxy.hold()
    until(lambda: holders(b) == ["own"], "it is released for hosta", LIMIT_S)
    assert is_lost(heard)  # and that was so before
    until(lambda: app.queries() == [], "it is not held any more")
    waiting = app.load("hostb/cameras/camera", "front", block=False, timeout_s=LIMIT_S)

    proxy.go()
    again = waiting.get(timeout=LIMIT_S)
    assert (again.resource_id, again.id != query.id) == (query.resource_id, True)
    assert holders(b) == ["hosta/app", "own"]
    assert len(heard.states) == 1
    again.unload()
    own.unload()
    assert holders(b) == []


@pytest.mark.parametrize("hosts", ["keep"], indirect=True)
def test_what_is_exported_to_be_kept_is_held_however_long_its_host_is_away(hosts: Hosts) -> None:
    a, b, proxy = hosts
    heard, app = Heard(), a.open_registrar("app")
    query = app.load("hostb/cameras/camera", "front", on_status=heard, timeout_s=LIMIT_S)
    proxy.hold()
    until(lambda: a.hosts()[0].state == "unreachable", "the lease is over", LIMIT_S)
    assert "has not answered for the time of the lease" in a.hosts()[0].why
    proxy.go()
    again = app.load("hostb/cameras/camera", "front", timeout_s=LIMIT_S)
    assert again.resource_id == query.resource_id
    assert holders(b) == ["hosta/app", "hosta/app"]
    assert heard.states == []
    app.unload_all(timeout_s=LIMIT_S)
    assert holders(b) == []


@pytest.mark.parametrize("frozen", ["a", "b"])
def test_a_gateway_that_is_frozen_hides_no_end_of_a_lease(hosts: Hosts, frozen: str) -> None:
    """The programs at its host look for themselves."""
    a, b, _ = hosts
    heard, app = Heard(), a.open_registrar("app")
    app.load("hostb/cameras/camera", "front", on_status=heard, timeout_s=LIMIT_S)
    pid = pid_of(a if frozen == "a" else b, "hosts")
    hang(pid)
    try:
        assert heard.any.wait(LIMIT_S)
        assert is_lost(heard)
        if frozen == "a":
            until(lambda: holders(b) == [], "it is released", LIMIT_S)
    finally:
        os.kill(pid, signal.SIGCONT)
    with app.load("hostb/cameras/camera", "front", timeout_s=LIMIT_S):
        until(lambda: holders(b) == ["hosta/app"], "only the new one is held", LIMIT_S)
    assert holders(b) == []
    assert len(heard.states) == 1


@pytest.mark.parametrize("killed", ["hosts", "cameras"])
def test_a_process_of_the_provider_that_is_killed_meanwhile_forgets_no_end_of_a_lease(
    hosts: Hosts, killed: str
) -> None:
    a, b, proxy = hosts
    heard, app = Heard(), a.open_registrar("app")
    app.load("hostb/cameras/camera", "front", on_status=heard, timeout_s=LIMIT_S)
    proxy.hold()
    kill(b, killed)
    until(lambda: holders(b) == [], "it is released", LIMIT_S)
    assert is_lost(heard)
    proxy.go()
    app.load("hostb/cameras/camera", "front", timeout_s=LIMIT_S).unload()
    assert holders(b) == []


CONSUMER = """
import sys, support_hosts, rr_actors as rr
if __name__ == "__main__":
    hosts = rr.Hosts("hosta", connect=[sys.argv[2]])
    with rr.System([], state_dir=sys.argv[1], hosts=hosts) as system:
        system.open_registrar("app").load("hostb/cameras/scope", "one", timeout_s=150)
        print("loaded", flush=True)
        sys.stdin.read()
"""


def test_an_exclusive_resource_of_a_host_that_is_killed_goes_to_the_next_in_line(tmp_path: Path) -> None:
    listen = endpoint()
    with cameras_at(tmp_path / "b", listen) as b:
        command = [sys.executable, "-c", CONSUMER, tmp_path / "a", listen]
        with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, env=ENVIRONMENT) as other:
            try:
                assert other.stdout is not None
                assert other.stdout.readline() == b"loaded\n"
                waiting = b.open_registrar("own").load("cameras/scope", "one", block=False, timeout_s=LIMIT_S)
                assert holders(b).count("hosta/app") == 1
            finally:
                other.kill()
        assert waiting.get(timeout=LIMIT_S).response == "one"
        assert holders(b) == ["own"]
        with consumer_at(tmp_path / "a", listen) as a:
            app = a.open_registrar("app")
            with pytest.raises(rr.ResourceBusy, match="own has it"):
                app.load("hostb/cameras/scope", "one", wait_s=0, timeout_s=LIMIT_S)
            until(lambda: app.queries() == [], "what the killed system held is lost", LIMIT_S)


def test_a_system_that_is_back_within_its_lease_holds_what_it_held(tmp_path: Path) -> None:
    listen = endpoint()
    exports = {"cameras": rr.Export(on_lost="release")}
    hosts = rr.Hosts("hostb", listen=[listen], exports=exports, lease_s=60)
    with rr.System([rr.ChildSpec(Cameras, id="cameras")], state_dir=tmp_path / "b", hosts=hosts) as b:
        command = [sys.executable, "-c", CONSUMER, tmp_path / "a", listen]
        with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, env=ENVIRONMENT) as other:
            try:
                assert other.stdout is not None
                assert other.stdout.readline() == b"loaded\n"
                held = b.registrar("cameras").resources()[0].id
            finally:
                other.kill()
        with consumer_at(tmp_path / "a", listen) as a:
            app = a.open_registrar("app")
            app.load("hostb/cameras/camera", "front", timeout_s=LIMIT_S)
            assert held in [query.resource_id for query in app.queries()]
            app.unload_all(timeout_s=LIMIT_S)
        assert holders(b) == []


def test_a_host_that_is_back_with_an_empty_state_directory_leaves_nothing_held(tmp_path: Path) -> None:
    listen = endpoint()
    with cameras_at(tmp_path / "b", listen) as b:
        command = [sys.executable, "-c", CONSUMER, tmp_path / "a", listen]
        with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, env=ENVIRONMENT) as other:
            try:
                assert other.stdout is not None
                assert other.stdout.readline() == b"loaded\n"
            finally:
                other.kill()
        shutil.rmtree(tmp_path / "a")
        with consumer_at(tmp_path / "a", listen) as a:
            app = a.open_registrar("another")
            with app.load("hostb/cameras/camera", "front", timeout_s=LIMIT_S):
                assert holders(b) == ["hosta/another"]


CLIENT = CONSUMER.replace("system.open_registrar", "rr.connect(sys.argv[1]).open_registrar")


def test_a_connected_program_killed_while_the_other_host_is_away_owes_what_it_held_there(tmp_path: Path) -> None:
    """Its catalog keeps that, as the other host cannot see that the program is gone."""
    listen = endpoint()
    with cameras_at(tmp_path / "b", listen, "keep") as b:
        command = [sys.executable, "-c", CLIENT, tmp_path / "a", listen]
        with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, env=ENVIRONMENT) as other:
            assert other.stdout is not None
            assert other.stdout.readline() == b"loaded\n"
            other.kill()
        assert holders(b) == ["hosta/connection.app"]
        with consumer_at(tmp_path / "a", endpoint()):
            pass  # hostb is not reached
        found = run_cli("check", tmp_path / "a")
        assert found.returncode == 0, found.stdout + found.stderr
        assert holders(b) == ["hosta/connection.app"]
        with consumer_at(tmp_path / "a", listen) as a:
            until(lambda: a.hosts()[0].state == "up", "hostb is there", LIMIT_S)
            until(lambda: holders(b) == [], "it is released", LIMIT_S)
