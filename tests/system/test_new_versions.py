"""A new version of the user's program on an old state directory: what fits is kept, the rest is lost by name."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Callable
from dataclasses import make_dataclass
from enum import Enum
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st

import rr_actors as rr
from rr_actors.base.errors import InvalidRequest
from rr_actors.base.values.canonical import Codec, encode
from rr_actors.base.values.type_shapes import digest_of
from rr_actors.system.console.console_connection import ConsoleConnection, find_console
from rr_actors.tools.explanations import explain
from support import TEST_PATHS, eventually

_PROGRAM = """
import os, pathlib, signal, sys
from dataclasses import dataclass
import rr_actors as rr
from support import eventually

@dataclass(frozen=True)
class Open:
    {request}

@dataclass(frozen=True)
class Feed:
    {response}

class Cameras(rr.Manager):
    @rr.server("{server}")
    def load_camera(self, request: Open) -> Feed:
        return Feed({made})

    @load_camera.unload
    def close_camera(self, request: Open, response: Feed) -> None:
        with open("unloads", "a") as file:
            print(request, response, file=file)
    {more}

if __name__ == "__main__":
    system = rr.System([rr.ChildSpec(Cameras, id="cameras")], state_dir="state")
    system.start()
    app = system.open_registrar("app")
    {main}
"""
_DIE = "os.kill(os.getpid(), signal.SIGKILL)"
_LOAD = 'app.load("cameras/camera", {"dev": "front"}); app.save_catalog(); ' + _DIE
_V1 = {"request": "dev: str", "response": "topic: str", "made": "request.dev", "server": "camera", "more": ""}


@pytest.fixture
def run(tmp_path: Path) -> Callable[..., str]:
    return runner(tmp_path)


def runner(place: Path) -> Callable[..., str]:
    """Return a function that runs a version of the program on one state directory; it returns what that says."""

    def run_version(main: str, **changes: str) -> str:
        (place / "program.py").write_text(_PROGRAM.format(**{**_V1, **changes, "main": main}))
        environment = dict(os.environ, PYTHONPATH=TEST_PATHS, PYTHONUNBUFFERED="1")  # a SIGKILL loses nothing printed
        command = [sys.executable, "program.py"]
        done = subprocess.run(
            command, env=environment, capture_output=True, text=True, timeout=60, check=False, cwd=place
        )
        assert done.returncode in (0, -signal.SIGKILL), done.stderr
        return done.stdout + done.stderr

    return run_version


_REPORT = """
    (query,) = app.queries()
    if {wants_fatal}: eventually(lambda: query.state is rr.State.FATAL)
    (resource,) = system.registrar("cameras").resources()
    print("STATE", query.state, resource.message)
    print("ASKED", query.request, resource.request)
    again = app.load("cameras/{server}", {request!r})
    print("AGAIN", again.resource_id == query.resource_id, again.response)
    again.unload()
    query.unload()
    print("LEFT", len(system.registrar("cameras").resources()))
    system.stop()
    print("STOPPED")
"""


def report(request: dict[str, Any], *, fatal: bool, server: str = "camera") -> str:
    return _REPORT.format(request=request, wants_fatal=fatal, server=server)


@pytest.mark.parametrize(
    ("changes", "request_", "why"),
    [
        ({"request": "dev: int", "made": "str(request.dev)"}, {"dev": 1}, "request.dev: expected int, got str"),
        (
            {"request": "device: str", "made": "request.device"},
            {"device": "front"},
            "request: expected fields device, got the unknown field 'dev'",
        ),
        (
            {"request": "device: str = 'none'", "made": "request.device"},
            {"device": "front"},
            "request: expected fields device, got the unknown field 'dev'",
        ),
        ({"response": "topic: int", "made": "7"}, {"dev": "front"}, "response.topic: expected int, got str"),
    ],
)
def test_what_does_not_fit_todays_types_is_lost_by_name_and_released_without_its_callback(
    run: Callable[..., str], tmp_path: Path, changes: dict[str, str], request_: dict[str, Any], why: str
) -> None:
    run(_LOAD)
    said = run(report(request_, fatal=True), **changes)
    assert f"STATE FATAL lost: {why}" in said
    stored = {"dev": "front"} if "request" in changes else "Open(dev='front')"
    assert f"ASKED {stored} {stored}" in said, "what was asked for, and no other request"
    assert "stored by an earlier version; its unload callback does not run" in said
    assert "AGAIN False Feed(" in said
    assert "LEFT 0" in said
    assert "STOPPED" in said
    assert len((tmp_path / "unloads").read_text().splitlines()) == 1, "that of the new resource"


def test_what_fits_todays_types_is_kept_and_an_equal_request_finds_it(run: Callable[..., str], tmp_path: Path) -> None:
    run(_LOAD)
    said = run(
        report({"dev": "front"}, fatal=False), request="dev: str; fps: int = 30", response="topic: str; n: int=0"
    )
    assert "STATE OK" in said
    assert "ASKED Open(dev='front', fps=30) Open(dev='front', fps=30)" in said
    assert "AGAIN True Feed(topic='front', n=0)" in said
    assert (tmp_path / "unloads").read_text() == "Open(dev='front', fps=30) Feed(topic='front', n=0)\n"


_UPGRADE = """
    @load_camera.upgrade
    def upgrade_camera(self, request, response):
        return Open(device=request["dev"]), Feed(len(response["topic"]))
"""
_V2 = {"request": "device: str", "response": "size: int", "made": "0"}


def test_an_upgrade_callback_migrates_what_does_not_fit(run: Callable[..., str], tmp_path: Path) -> None:
    run(_LOAD)
    said = run(report({"device": "front"}, fatal=False), more=_UPGRADE, **_V2)
    assert "STATE OK" in said or "STATE UPDATE" in said
    assert "AGAIN True Feed(size=5)" in said
    assert (tmp_path / "unloads").read_text() == "Open(device='front') Feed(size=5)\n"


def test_an_upgrade_callback_that_raises_loses_the_resource_by_name(run: Callable[..., str]) -> None:
    run(_LOAD)
    said = run(report({"device": "front"}, fatal=True), more=_UPGRADE.replace('request["dev"]', "1 / 0"), **_V2)
    assert "STATE FATAL lost: request" in said
    assert "the upgrade callback raised ZeroDivisionError" in said
    assert "STOPPED" in said


# -- servers that are gone ---------------------------------------------------------------------------------------------


_GONE = """
    import time
    (query,) = app.queries()
    try:
        query.unload(timeout_s=20)
    except rr.Unavailable as error:
        print("ERROR", error)
    began = time.monotonic()
    system.stop()
    print("STOPPED", time.monotonic() - began < 5)
"""


def test_a_server_that_is_gone_is_named_and_the_system_stops_in_order(run: Callable[..., str], tmp_path: Path) -> None:
    run(_LOAD)
    said = run(_GONE, server="lens")
    waits = "waits for its server 'cameras/camera', which is not registered"
    assert waits in said.split("ERROR ")[1].split("\n")[0]
    assert "STOPPED True" in said
    assert [line for line in said.splitlines() if waits in line and "ERROR cameras" not in line]
    assert "killed" not in said
    run("system.stop()")
    assert (tmp_path / "unloads").read_text() == "Open(dev='front') Feed(topic='front')\n", "the server is back"


def test_what_waits_for_a_server_is_explained_and_cleared_with_the_server(
    app: rr.Registrar, provider: rr.Registrar, system: rr.System
) -> None:
    stuck = [True]

    def unload(_request: Any, _response: Any) -> None:
        if stuck:
            raise ValueError("stuck")

    provider.register_server("thing", lambda request: request, unload)
    query = app.load("provider/thing", "x")
    with pytest.raises(rr.UnloadFailed):
        provider.unregister_server("thing")
    with pytest.raises(rr.Unavailable):
        provider.unload(query.resource_id, force=True, timeout_s=0.1)
    with ConsoleConnection(find_console(system.state_dir)) as console:
        said = "\n".join(explain(console, query.resource_id))
        assert "It waits for its server 'provider/thing', which is not registered" in said
        assert "rr-actors unload --force provider/thing" in said
    provider.unregister_server("thing")
    eventually(lambda: not provider.resources())
    with pytest.raises(rr.UnknownServer):
        provider.unregister_server("thing")


# -- pairs of versions -------------------------------------------------------------------------------------------------

_TYPES: dict[str, tuple[type, Any]] = {"int": (int, 3), "str": (str, "x"), "bool": (bool, True), "float": (float, 0.5)}
versions = st.dictionaries(
    st.sampled_from("abcd"), st.tuples(st.sampled_from(sorted(_TYPES)), st.booleans()), max_size=4
)
Version = dict[str, tuple[str, bool]]


def class_of(version: Version) -> type:
    required = [(name, _TYPES[kind][0]) for name, (kind, has_default) in version.items() if not has_default]
    defaulted = [(name, *_TYPES[kind]) for name, (kind, has_default) in version.items() if has_default]
    return make_dataclass("Open", [*required, *defaulted], frozen=True)


@settings(deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(old=versions, new=versions)
def test_of_a_pair_of_versions_a_request_is_read_as_todays_or_refused_by_its_field(old: Version, new: Version) -> None:
    stored = encode(class_of(old)(**{name: _TYPES[kind][1] for name, (kind, _) in old.items()}))
    codec = Codec(class_of(new))
    removed, added = old.keys() - new.keys(), new.keys() - old.keys()
    kept = old.keys() & new.keys()
    fits = all(old[name][0] == new[name][0] or (old[name][0], new[name][0]) == ("int", "float") for name in kept)
    if fits and all(new[name][1] for name in added) and not (added and removed):
        today = codec.today(stored)
        values = codec.decode(today)
        assert all(getattr(values, name) == _TYPES[old[name][0]][1] for name in kept)
        assert codec.today(today) == codec.canonical(today) == today
    else:
        with pytest.raises(InvalidRequest) as caught:
            codec.today(stored)
        assert str(caught.value).startswith("request")


_FITS = {  # the fields of a version: a request of it, and the versions whose requests fit it
    "dev: str": ({"dev": "a"}, {"dev: str", "dev: str; fps: int = 1"}),
    "dev: str; fps: int = 1": ({"dev": "a"}, {"dev: str", "dev: str; fps: int = 1"}),
    "dev: int": ({"dev": 1}, {"dev: int"}),
    "device: str = 'x'": ({"device": "a"}, {"device: str = 'x'"}),
}
_RELEASE = """
    for query in app.queries():
        if query.server == "{server}" and {lost}:
            eventually(lambda: query.state is rr.State.FATAL)
        try:
            query.unload(timeout_s=20)
            print("RELEASED", query.server, query.state)
        except rr.Unavailable as error:
            print("WAITS", error)
    {rest}
"""


def test_the_digest_of_a_type_changes_with_its_fields_its_defaults_and_the_members_of_its_enums() -> None:
    def digest(fields: list[Any]) -> bytes:
        return digest_of((Codec(make_dataclass("Open", fields, frozen=True)).shape,))

    one, two = Enum("Side", {"LEFT": "left"}), Enum("Side", {"LEFT": "left", "RIGHT": "right"})
    versions: list[list[Any]] = [[("a", int)], [("a", str)], [("b", int)], [("a", int, 3)], [("a", one)], [("a", two)]]
    digests = [digest(fields) for fields in versions]
    assert len(set(digests)) == len(versions)
    assert digests == [digest(fields) for fields in versions]
    assert b"" not in digests


_BACK = [("dev: str", "camera"), ("dev: int", "camera"), ("dev: str", "camera")]


@pytest.mark.slow
@example(_BACK)
@settings(max_examples=2, deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(st.lists(st.tuples(st.sampled_from(sorted(_FITS)), st.sampled_from(["camera", "lens"])), min_size=3, max_size=3))
def test_versions_that_alternate_over_sigkill_end_in_order_and_lose_by_name(
    tmp_path_factory: pytest.TempPathFactory, rounds: list[tuple[str, str]]
) -> None:
    run = runner(tmp_path_factory.mktemp("versions"))
    left: tuple[str, str] | None = None
    for fields, server in rounds:
        request, fitting = _FITS[fields]
        load = f'app.load("cameras/{server}", {request!r}); app.save_catalog(); {_DIE}'
        lost = left is not None and left[1] == server and left[0] not in fitting
        main = _RELEASE.format(server=server, lost=lost, rest=load)
        said = run(main, request=fields, server=server, made="''")
        if left is not None and left[1] != server:
            assert f"WAITS cameras/{left[1]}: resource " in said
        elif left is not None:
            assert f"RELEASED {server} {'FATAL' if lost else 'OK'}" in said
        assert "unload_failed" not in said
        left = fields, server
    fields, server = rounds[-1]
    main = _RELEASE.format(server=server, lost=False, rest="system.stop(); print('STOPPED')")
    assert "STOPPED" in run(main, request=fields, server=server, made="''")
