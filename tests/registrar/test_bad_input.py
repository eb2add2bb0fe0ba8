"""Bad input: each raises its named error, says what to do next, and changes nothing; nothing hangs."""

from __future__ import annotations

import asyncio
import functools
import os
import pickle
import subprocess
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import pykka
import pytest

import rr_actors as rr
from support import REPOSITORY, Calls, Gate, Workshop, child, eventually, kill, messages, serve
from support_inside import actor_of
from support_managers import Order, Shop

Start = Callable[..., rr.System]


@pytest.fixture(autouse=True)
def _at_once() -> Iterator[None]:
    """None of the errors here needs time; a hang would show."""
    begun = time.monotonic()
    yield
    assert time.monotonic() - begun < 15.0


# -- names, servers, registrars ------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["my registrar", "k\u00e4se", "\u0663"])
def test_a_wrong_name_is_told_with_what_is_expected(system: rr.System, name: str) -> None:
    with pytest.raises(rr.InvalidName, match="ASCII letters, digits") as caught:
        system.open_registrar(name)
    assert isinstance(caught.value, rr.UsageError)
    assert caught.value.name == name


def test_a_server_id_without_slash_is_told_with_what_is_expected(app: rr.Registrar) -> None:
    with pytest.raises(rr.InvalidName, match="registrar/server"):
        app.load("camera", None)


def test_a_misspelt_server_is_told_with_those_there_are(app: rr.Registrar, provider: rr.Registrar) -> None:
    serve(provider, "camera")
    serve(provider, "lidar")
    with pytest.raises(rr.UnknownServer, match=r"provider/camara.*did you mean 'camera'\? it has .*camera") as caught:
        app.load("provider/camara", None)
    assert sorted(name.rpartition("/")[2] for name in caught.value.known) == ["camera", "lidar"]


def test_a_misspelt_registrar_is_told_with_those_there_are(
    system: rr.System, app: rr.Registrar, provider: rr.Registrar
) -> None:
    for call in (
        lambda: app.load("provder/camera", None),
        lambda: app.fetch_queries("provder"),
        lambda: system.registrar("provder"),
    ):
        with pytest.raises(rr.UnknownRegistrar, match=r"provder.*did you mean 'provider'.*app, provider") as caught:
            call()
        assert list(caught.value.known) == ["app", "provider"]


def test_unregistering_a_server_that_is_not_there_is_an_error(provider: rr.Registrar) -> None:
    serve(provider, "camera")
    with pytest.raises(rr.UnknownServer, match="camara"):
        provider.unregister_server("camara")
    assert list(provider.servers()) == ["provider/camera"]


@pytest.mark.parametrize("name", [None, 5, b"camera", [], {}])
def test_unregistering_by_something_else_than_a_name_is_an_error(provider: rr.Registrar, name: Any) -> None:
    serve(provider, "camera")
    with pytest.raises(rr.UsageError, match=r"unregister_server: expected a server's name, got"):
        provider.unregister_server(name)
    assert provider.load("provider/camera", 1).response == {"of": 1, "number": 1}


def test_a_ref_or_supervisor_that_is_not_there_is_an_error(system: rr.System) -> None:
    with pytest.raises(rr.RrError, match="nobody"):
        system.ref("nobody").ask("hello", timeout=1.0)
    with pytest.raises(rr.NotFound, match="nobody"):
        system.supervisor("root/nobody").which_children()


def test_a_ref_or_supervisor_by_something_else_than_text_is_an_error(system: rr.System) -> None:
    wrong: Any = 3
    with pytest.raises(rr.UsageError, match=r"ref: expected a child's id or path, got 3 \(int\)"):
        system.ref(wrong)
    for wrong in (3, 0, []):
        with pytest.raises(rr.UsageError, match=r"supervisor: expected a path of ids, got .* \((int|list)\)"):
            system.supervisor(wrong)


def test_a_child_further_down_is_found_by_its_id_or_told_its_path(start: Start) -> None:
    def tree(*children: rr.Supervisor | str, id: str) -> rr.Supervisor:
        specs = [rr.ChildSpec(Idle, id=c, placement="thread") if isinstance(c, str) else c for c in children]
        return rr.Supervisor(specs, id=id)

    middle = tree(tree("a", "b", "c", id="inner"), "c", id="middle")
    system = start(middle, rr.ChildSpec(Idle, id="a", placement="thread"))
    assert system.ref("b") == system.ref("root/middle/inner/b")
    assert system.ref("a") == system.ref("root/a")
    for wrong, meant in (("c", "'root/middle/c' or 'root/middle/inner/c'"), ("inner/b", "'root/middle/inner/b'")):
        with pytest.raises(rr.NotFound, match=rf"did you mean {meant}\?$") as caught:
            system.ref(wrong)
        assert caught.value.id == wrong
    with pytest.raises(rr.NotFound, match=r"no child 'd' \(it has: middle, a\)$"):
        system.ref("d")
    system.supervisor().terminate_child("middle")
    with pytest.raises(rr.NotFound, match=r"no child 'b'"):
        system.ref("b")


def test_a_call_on_a_supervisor_that_stops_does_not_say_that_it_comes_back(start: Start) -> None:
    stopping, done = threading.Event(), threading.Event()

    class Slow(rr.Actor):
        def on_stop(self) -> None:
            stopping.set()
            assert done.wait(10)

    system = start(rr.ChildSpec(Slow, placement="thread"))
    stopper = threading.Thread(target=system.stop)
    stopper.start()
    try:
        assert stopping.wait(10)
        with pytest.raises(rr.ActorUnavailable, match=r"^root is being started again, or is stopping; "):
            system.ref("Slow")
    finally:
        done.set()
        stopper.join(10)


class Idle(rr.Actor):
    pass


class Listener(pykka.ThreadingActor):
    def __init__(self) -> None:
        super().__init__()
        self.heard: list[object] = []

    def on_receive(self, message: object) -> None:
        self.heard.append(message)


@pytest.mark.parametrize("placement", ["thread", "process"])
def test_a_supervisor_that_is_an_actor_is_an_error_that_names_the_supervisors(start: Start, placement: Any) -> None:
    actors = (Idle, Shelf, Listener)
    children = [rr.ChildSpec(actor, id=actor.__name__.lower(), placement=placement) for actor in actors]
    system = start(rr.Supervisor([rr.Supervisor([], id="low")], id="middle"), rr.Supervisor([], id="other"), *children)
    there = ("root", "root/middle", "root/middle/low", "root/other")
    for name, what in (
        ("idle", "it is no supervisor, but a child of class Idle"),
        ("shelf", "it is no supervisor, but a child of class Shelf"),
        ("listener", "it is no supervisor, but a child of class Listener"),
    ):
        supervisor = system.supervisor(name)
        for call in (
            supervisor.which_children,
            lambda supervisor=supervisor: supervisor.start_child(rr.ChildSpec(Idle, id="new")),
            lambda supervisor=supervisor: supervisor.update(rr.Supervisor([], id="new")),
        ):
            expected = f"^supervisor 'root/{name}': .*{what}; there are: {', '.join(there)}$"
            with pytest.raises(rr.NotFound, match=expected) as caught:
                call()
            assert caught.value.known == there
    with pytest.raises(
        rr.NotFound, match=r"^supervisor 'root/low': there is none.*did you mean 'root/middle/low'"
    ) as low:
        system.supervisor("low")
    assert low.value.known == there
    assert system.ref("listener").proxy().heard.get() == []


# -- requests ------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Lens:
    width: int


@dataclass(frozen=True)
class Camera:
    device: str
    fps: int = 30
    lenses: tuple[Lens, ...] = ()


def test_a_type_that_cannot_be_read_is_logged_since_nothing_is_checked_then(
    app: rr.Registrar, provider: rr.Registrar, caplog: pytest.LogCaptureFixture
) -> None:
    def unread(request: NoSuchType) -> None:  # type: ignore[name-defined]  # noqa: F821
        assert isinstance(request, dict)

    def read(request: int) -> None: ...

    provider.register_server("read", read)
    provider.register_server("builtin", print)
    provider.register_server("given", unread, request_type=dict)
    assert not caplog.records
    provider.register_server("unread", unread)
    (record,) = caplog.records
    assert record.levelname == "WARNING"
    said = "provider/unread: the annotations of its load callback cannot be read (name 'NoSuchType' is not defined): "
    assert record.getMessage().startswith(said)
    app.load("provider/unread", {"device": "front"})


@pytest.mark.parametrize(
    ("request_", "path", "expected"),
    [
        ({"fps": 30}, "device", "device"),
        ({"device": 7}, "device", "str"),
        ({"device": "front", "fps": "30"}, "fps", "int"),
        ({"device": "front", "fps": 1.5}, "fps", "int"),
        ({"device": "front", "lenses": [{"width": 1}, {"width": "wide"}]}, "lenses[1].width", "int"),
        ("front", "", "Camera"),
        (None, "", "Camera"),
        ([], "", "Camera"),
    ],
)
def test_a_request_of_the_wrong_type_is_told_with_field_and_expected_type(
    app: rr.Registrar, provider: rr.Registrar, request_: Any, path: str, expected: str
) -> None:
    served = serve(provider, "camera", request_type=Camera)
    with pytest.raises(rr.InvalidRequest) as caught:
        app.load("provider/camera", request_)
    assert caught.value.server == "provider/camera"
    assert "provider/camera" in str(caught.value)
    assert path in str(caught.value)
    assert expected in str(caught.value)
    assert len(served.loads) == 0


class Odd:
    pass


@pytest.mark.parametrize(
    ("request_", "path"),
    [
        (lambda: 0, "request"),
        ({"options": [1, {"callback": lambda: 0}]}, "request.options[1].callback"),
        ([threading.Lock()], "request[0]"),
        ({"a": {"b": Odd()}}, "request.a.b"),
        ({"big": 2**70}, "request.big"),
    ],
)
def test_a_request_that_cannot_travel_is_told_at_the_sender_with_its_path(
    app: rr.Registrar, provider: rr.Registrar, request_: Any, path: str
) -> None:
    served = serve(provider, "camera")
    with pytest.raises(rr.NotSerializable) as caught:
        app.load("provider/camera", request_)
    assert caught.value.path == path
    assert path in str(caught.value)
    assert len(served.loads) == 0
    assert list(app.queries()) == []


def test_a_request_that_contains_itself_is_told_at_the_sender(app: rr.Registrar, provider: rr.Registrar) -> None:
    serve(provider, "camera")
    endless: list[Any] = []
    endless.append(endless)
    with pytest.raises(rr.UsageError):
        app.load("provider/camera", endless)
    assert app.load("provider/camera", "fine").response["of"] == "fine"


def test_a_response_that_cannot_travel_fails_the_load_with_its_path(app: rr.Registrar, provider: rr.Registrar) -> None:
    serve(provider, "camera", load=lambda request: {"stream": {"lock": threading.Lock()}})
    with pytest.raises(rr.LoadFailed, match=r"response\.stream\.lock"):
        app.load("provider/camera", None)
    eventually(lambda: not provider.resources())


def test_an_updated_response_that_cannot_travel_is_told_at_the_sender(
    app: rr.Registrar, provider: rr.Registrar
) -> None:
    serve(provider, "camera")
    query = app.load("provider/camera", "x")
    with pytest.raises(rr.NotSerializable, match="lock"):
        provider.update_response(query.resource_id, {"lock": threading.Lock()})
    assert provider.resources()[0].response == {"of": "x", "number": 1}


def test_a_message_that_is_no_text_is_told_as_text(app: rr.Registrar, provider: rr.Registrar) -> None:
    serve(provider, "camera")
    heard, wrong = Calls(), cast("Any", 5)
    query = app.load("provider/camera", "x", on_status=heard)
    provider.update_response(query.resource_id, {"of": "x", "number": 2}, wrong)
    heard.wait(1)
    assert messages(heard) == ["5"]


def test_half_a_character_in_a_text_for_people_is_told_by_its_code_and_stops_nobody(
    app: rr.Registrar, provider: rr.Registrar
) -> None:
    """Names of files have some, and so have the errors about them."""

    def fail(*_: Any) -> None:
        raise FileNotFoundError(2, "nothing there", "caf\udce9")

    provider.register_server("none", fail)
    with pytest.raises(rr.LoadFailed, match=r"caf\\udce9"):
        app.load("provider/none", 1, timeout_s=5.0)
    provider.register_server("stuck", lambda request: request, unload=fail)
    heard = Calls()
    query = app.load("provider/stuck", 1, timeout_s=5.0, on_status=heard)
    provider.send_status(query.id, rr.Status("ERROR", "no caf\udce9"))
    provider.update_response(query.id, 2, "another caf\udce9")
    assert [status.message for status in heard.wait(2)] == [r"no caf\udce9", r"another caf\udce9"]
    with pytest.raises(rr.UnloadFailed, match=r"caf\\udce9"):
        app.unload(query, timeout_s=5.0)
    (left,) = provider.resources()
    assert "caf\\udce9" in left.message


def test_a_registrar_that_cannot_say_why_it_cannot_commit_is_down_and_does_not_hang(
    start: Start, monkeypatch: pytest.MonkeyPatch
) -> None:
    system = start(config=rr.SystemConfig(stop_timeout_s=0.2))  # its stop would wait for the one that is down
    app, provider = system.open_registrar("app"), system.open_registrar("provider")
    served = serve(provider, "camera")
    app.load("provider/camera", "first")
    monkeypatch.setattr(actor_of(provider).commits, "commit", lambda _decision: 1 // 0)
    with pytest.raises(rr.LoadTimeout):
        app.load("provider/camera", "second", timeout_s=0.5)
    assert served.loads.items == ["first"]
    with pytest.raises(rr.RegistrarDown, match="closed"):
        provider.load("app/none", "x", timeout_s=5.0)
    serve(system.open_registrar("provider"), "camera")
    app.unload_all()


def test_a_response_over_the_frame_limit_with_its_request_is_refused_and_the_connection_lives(
    start: Start, workshop: Workshop
) -> None:
    shop = rr.ChildSpec(Shop, id="shop", args=(str(workshop.root),))
    system = start(shop, config=rr.SystemConfig(frame_limit_bytes=100_000))
    app, manager = system.open_registrar("app"), system.registrar("shop")
    manager.register_server("echo", lambda request: request * 3)
    for many in (30_000, 200_000):  # either fits a frame alone; the response does not
        with pytest.raises(rr.RrError, match="frame_limit_bytes"):
            app.load("shop/echo", "x" * many)
    assert app.queries() == []
    query = app.load("shop/echo", "x" * 20_000)
    with pytest.raises(rr.NotSerializable, match="frame_limit_bytes"):
        manager.update_response(query, "y" * 90_000)
    assert [held.response for held in app.fetch_queries("shop")] == ["x" * 60_000]


def test_a_text_over_the_frame_limit_is_cut_and_the_connection_lives(start: Start, workshop: Workshop) -> None:
    shop = rr.ChildSpec(Shop, id="shop", args=(str(workshop.root),))
    system = start(shop, config=rr.SystemConfig(frame_limit_bytes=100_000))
    app, manager = system.open_registrar("app"), system.registrar("shop")

    def fail(size: int) -> None:
        raise ValueError("x" * size)

    manager.register_server("fail", fail)
    with pytest.raises(rr.LoadFailed, match=r"shop/fail: ValueError: x+ \.\.\. \(\d+ characters more\)"):
        app.load("shop/fail", 200_000)
    with app.load("shop/thing", Order("one")) as query:
        manager.send_status(query, rr.Status(rr.State.WARNING, "y" * 50_000))
        assert query.wait_status(rr.State.WARNING, 10).message.endswith("characters more)")


def test_more_is_held_than_fits_a_frame_and_both_sides_agree_again(start: Start, workshop: Workshop) -> None:
    shop = rr.ChildSpec(Shop, id="shop", args=(str(workshop.root),))
    system = start(shop, config=rr.SystemConfig(frame_limit_bytes=100_000))
    app = system.open_registrar("app")
    system.registrar("shop").register_server("echo", lambda request: request)
    held = [app.load("shop/echo", str(number) * 20_000).id for number in range(10)]
    assert [query.id for query in app.fetch_queries("shop")] == held
    kill(system, "shop")
    assert app.load("shop/echo", "more").response == "more"
    assert [query.id for query in app.fetch_queries("shop")][:-1] == held
    app.unload_all()
    assert system.registrar("shop").resources() == []


def test_a_request_over_the_frame_limit_is_refused_and_the_connection_lives(start: Start, workshop: Workshop) -> None:
    config = rr.SystemConfig(frame_limit_bytes=64 * 1024)
    system = start(rr.ChildSpec(Shop, id="shop", args=(str(workshop.root),)), config=config)
    app = system.open_registrar("app")
    kept = app.load("shop/thing", Order("wheel"))
    with pytest.raises(rr.RrError):
        app.load("shop/thing", Order("x" * 100_000), timeout_s=5.0)
    assert app.load("shop/thing", Order("wheel")).resource_id == kept.resource_id


def test_a_load_that_takes_too_long_says_what_its_provider_was_doing(start: Start, workshop: Workshop) -> None:
    system = start(rr.ChildSpec(Shop, id="shop", args=(str(workshop.root),)))
    app = system.open_registrar("app")
    workshop.shut("load wheel")
    with pytest.raises(rr.LoadTimeout, match=r"shop/thing: .* 1 s; shop is up, its load callback, or ") as caught:
        app.load("shop/thing", Order("wheel"), timeout_s=1.0)
    assert caught.value.status == "up"
    workshop.open("load wheel")
    workshop.shut("start shop")
    kill(system, "shop")
    loading = app.load("shop/thing", Order("fence"), timeout_s=1.0, block=False)
    for wait in (loading.get, lambda: app.load("shop/thing", Order("fence"), timeout_s=1.0)):
        with pytest.raises(rr.LoadTimeout, match="shop is starting, or being started again") as caught:
            wait()
        assert caught.value.status == "starting"
    workshop.open("start shop")


# -- callbacks and children ----------------------------------------------------------------------------------------


def test_a_callback_that_cannot_travel_is_told_at_the_sender_with_what_in_it_cannot(
    start: Start, workshop: Workshop
) -> None:
    system = start(rr.ChildSpec(Shop, id="shop", args=(str(workshop.root),)))
    lock = threading.Lock()

    def load(request: Any) -> Any:
        with lock:
            return request

    handle = system.registrar("shop")
    with pytest.raises(rr.NotSerializable, match="lock"):
        handle.register_server("late", load)
    assert list(handle.servers()) == ["shop/thing"]


def test_what_belongs_to_its_process_is_said_to_when_it_is_sent_to_another(
    system: rr.System, app: rr.Registrar, start: Start, workshop: Workshop
) -> None:
    system.start_child(rr.ChildSpec(Shop, id="shop", args=(str(workshop.root),)))
    system.start_child(rr.ChildSpec(Idle, id="idle"))
    for thing, told in (
        (app, "registrar 'app' belongs to its process: send its name instead"),
        (system.registrar("shop"), "registrar 'shop' belongs to its process: send its name instead"),
        (system, "system 'system' belongs to its process: send references to its actors instead"),
    ):
        with pytest.raises(rr.NotSerializable, match=rf"^message to root/idle: item 1: {told}; it has to travel"):
            system.ref("idle").ask(("use", thing))
    with pytest.raises(rr.NotSerializable, match=r"closure variable 'app': registrar 'app' belongs to its process"):
        system.registrar("shop").register_server("late", lambda request: app.load("shop/thing", request).response)


def test_a_system_is_made_and_stopped_with_the_right_kinds_only(state_dir: Path) -> None:
    wrong: Any = {"durability": "power"}
    with pytest.raises(rr.ConfigError, match=r"System: config: expected a SystemConfig or None, got .*\(dict\)"):
        rr.System(state_dir=state_dir, config=wrong)
    for path in (None, 3, b"state", ""):
        with pytest.raises(rr.ConfigError, match="System: state_dir: expected a directory's path, got") as caught:
            rr.System(state_dir=path)  # type: ignore[arg-type]
        assert caught.value.key == "state_dir"
    with rr.System([rr.ChildSpec(Idle, id="a", placement="thread")], state_dir=state_dir) as system:
        for limit in ("soon", -1, float("nan"), True):
            with pytest.raises(rr.UsageError, match="stop: timeout_s: expected seconds, 0 or more, or None, got"):
                system.stop(limit)  # type: ignore[arg-type]
        assert system.ref("a").is_alive()
        system.stop(10**400)  # longer than any clock counts


def test_a_callback_of_a_load_that_takes_other_arguments_is_refused_before_anything_is_sent(
    app: rr.Registrar, provider: rr.Registrar
) -> None:
    served = serve(provider, "camera")
    nothing: Any = lambda: None  # noqa: E731
    two: Any = functools.partial(lambda status, more, extra: None, 1)
    for call, told in (
        (lambda: app.load("provider/camera", 1, on_status=nothing), r"load: on_status: .*takes \(status\), got"),
        (lambda: app.load("provider/camera", 1, on_status=two, block=False), r"load: on_status: .*extra"),
        (lambda: asyncio.run(app.load_async("provider/camera", 1, on_status=nothing)), "load: on_status: "),
        (lambda: app.load_all([("provider/camera", 1)], on_status=nothing), "load_all: on_status: "),
        (lambda: app.on_status("provider/camera", nothing), r"on_status: callback: .*takes \(status\)"),
        (lambda: app.load("provider/camera", 1, progress=nothing), r"load: progress: .*takes \(progress\), got"),
    ):
        with pytest.raises(rr.InvalidSpec, match=told):
            call()
    assert (len(served.loads), list(app.queries())) == (0, [])
    heard: deque[rr.Status] = deque(maxlen=3)
    unreadable: Any = heard.append  # a builtin
    query = app.load("provider/camera", 1, on_status=unreadable)
    provider.send_status(query.id, rr.Status("WARNING", "dirty"))
    eventually(lambda: heard)


def test_a_tilde_in_a_state_directory_is_the_users_home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.chdir(tmp_path)
    with rr.System([rr.ChildSpec(Idle, id="a", placement="thread")], state_dir="~/state") as system:
        assert system.state_dir == tmp_path / "state"
        assert rr.System.running("~/state") is system
        with rr.connect("~/state") as connection:
            assert connection.pid == os.getpid()
        ran = subprocess.run(
            [sys.executable, "-m", "rr_actors", "ps", "--state=~/state"], capture_output=True, text=True, timeout=30
        )
        assert (ran.returncode, ran.stderr) == (0, "")
    ran = subprocess.run(
        [sys.executable, "-m", "rr_actors", "inspect", "~/state"], capture_output=True, text=True, timeout=30
    )
    assert ran.stderr.startswith(f"rr-actors: {tmp_path}/state: expected the state directory")  # it has no catalog
    assert [path.name for path in tmp_path.iterdir()] == ["state"]
    with pytest.raises(rr.ConfigError, match="state_dir: expected a directory's path, got '~nobody-of-that-name'"):
        rr.System(state_dir="~nobody-of-that-name")


@pytest.mark.parametrize("callback", [None, "load", 7])
def test_a_callback_that_cannot_be_called_is_an_error(provider: rr.Registrar, callback: Any) -> None:
    with pytest.raises((rr.UsageError, TypeError)):
        provider.register_server("camera", callback)
    assert list(provider.servers()) == []


@pytest.mark.parametrize(
    "options",
    [
        {"recovery": "hope"},
        {"linger_s": -1.0},
        pytest.param({"linger_s": 10**400}, id="linger_s-huge"),
        {"load_timeout_s": -1.0},
        pytest.param({"load_timeout_s": 10**400}, id="load_timeout_s-huge"),
    ],
)
def test_a_server_option_out_of_range_is_an_error(provider: rr.Registrar, options: dict[str, Any]) -> None:
    with pytest.raises(rr.InvalidSpec) as caught:
        provider.register_server("camera", lambda request: request, **options)
    assert next(iter(options)) in str(caught.value)
    assert list(provider.servers()) == []


def test_arguments_of_a_child_that_cannot_travel_are_told_at_the_sender(start: Start) -> None:
    system = start()
    spec = rr.ChildSpec(Shop, id="shop", kwargs={"root": threading.Lock()})
    with pytest.raises(rr.RrError, match="lock") as caught:
        system.start_child(spec)
    assert isinstance(caught.value, (rr.NotSerializable, rr.StartFailed))
    assert list(system.supervisor().which_children()) == []


@pytest.mark.parametrize(
    ("field", "wrong"),
    [
        ("restart", "sometimes"),
        ("shutdown_s", -1.0),
        ("shutdown_s", "soon"),
        ("placement", "moon"),
        ("args", 7),
        ("kwargs", [1]),
        ("id", "a/b"),
        ("id", 0),
        ("id", []),
        pytest.param("shutdown_s", 10**400, id="shutdown_s-huge"),
        pytest.param("heartbeat_s", 10**400, id="heartbeat_s-huge"),
    ],
)
def test_a_wrong_child_spec_is_told_by_field(field: str, wrong: Any) -> None:
    with pytest.raises(rr.UsageError) as caught:
        rr.System([rr.ChildSpec(Shop, **{"id": "shop", field: wrong})])
    assert field in str(caught.value)
    assert isinstance(caught.value, (rr.InvalidSpec, rr.InvalidName))


@pytest.mark.parametrize(
    ("field", "wrong"),
    [
        ("strategy", "one_for_some"),
        ("max_restarts", -1),
        pytest.param("max_restarts", 10**400, id="max_restarts-huge"),
        ("max_seconds", 0),
        pytest.param("max_seconds", 10**400, id="max_seconds-huge"),
        ("auto_shutdown", "perhaps"),
    ],
)
def test_a_wrong_supervisor_is_told_by_field(field: str, wrong: Any) -> None:
    with pytest.raises(rr.InvalidSpec, match=field) as caught:
        rr.System(rr.Supervisor([], **{field: wrong}))
    assert caught.value.field == field


def test_a_root_that_is_none_is_shown(state_dir: Path) -> None:
    with pytest.raises(rr.InvalidSpec, match=r"a Supervisor or a list of ChildSpecs, got <class '.*Shop'>"):
        rr.System(cast("Any", Shop), state_dir=state_dir)


def test_a_child_that_is_no_actor_is_told(state_dir: Path) -> None:
    with pytest.raises(rr.UsageError, match="int"):
        rr.System([rr.ChildSpec(int, id="number")], state_dir=state_dir)


# -- state directories ---------------------------------------------------------------------------------------------


def test_a_state_directory_that_cannot_be_made_is_told_by_path(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("not a directory")
    for state_dir in (tmp_path / "file", tmp_path / "file" / "state"):
        with pytest.raises(rr.ConfigError) as caught:
            rr.System(state_dir=state_dir).start()
        assert str(tmp_path / "file") in str(caught.value)
    assert (tmp_path / "file").read_text() == "not a directory"


@pytest.mark.parametrize("state_dir", ["/proc/state"])
def test_a_state_directory_that_is_not_writable_is_told_by_path(state_dir: str) -> None:
    with pytest.raises(rr.ConfigError, match=state_dir):
        rr.System(state_dir=state_dir).start()


def test_a_current_directory_that_is_gone_is_told(tmp_path: Path) -> None:
    program = """
import os, sys
import rr_actors as rr
os.chdir(sys.argv[1])
os.rmdir(sys.argv[1])
with rr.System([rr.ChildSpec(rr.Actor, id="one")], state_dir=sys.argv[2]) as system:  # an absolute one will do
    print(system.ref("one").is_alive())
for call in (rr.System(state_dir="state").start, lambda: rr.System.running("state")):
    try:
        call()
    except rr.ConfigError as error:
        print(error)
"""
    (tmp_path / "gone").mkdir()
    ran = subprocess.run(
        [sys.executable, "-c", program, tmp_path / "gone", tmp_path / "state"],
        env={**os.environ, "PYTHONPATH": str(REPOSITORY)},
        capture_output=True,
        text=True,
        timeout=30,
        check=True,
    )
    alive, *errors = ran.stdout.splitlines()
    assert alive == "True"
    assert len(errors) == 2
    for error in errors:
        assert "'state' is relative to the current directory, which has been removed" in error
        assert "absolute state_dir" in error


def _long(directory: Path, length: int) -> Path:
    """A directory below that one whose path has that many bytes."""
    while (left := length - len(str(directory)) - 1) > 200:
        directory /= "x" * 200
    return directory / ("x" * left)


def test_a_state_directory_whose_path_is_too_long_for_sqlite_is_told_at_once(tmp_path: Path) -> None:
    with pytest.raises(
        rr.ConfigError, match=r"483 bytes, expected at most 482, as SQLite.*shorter state_dir"
    ) as caught:
        rr.System(state_dir=_long(tmp_path, 483)).start()
    assert (caught.value.key, caught.value.expected, caught.value.got) == ("state_dir", 482, 483)
    with rr.System(state_dir=_long(tmp_path, 482)) as system:
        app = system.open_registrar("a")
        serve(app, "own")
        assert app.load("a/own", 1).response["of"] == 1
        with pytest.raises(rr.CatalogError, match=r"501 bytes, expected at most 500.*shorter state_dir") as refused:
            system.open_registrar("bb")
        assert refused.value.path.endswith("/bb/catalog.sqlite3")


def test_a_supervisor_that_is_not_there_is_told_at_once_with_those_there_are(start: Start) -> None:
    inner = rr.Supervisor([rr.ChildSpec(rr.Actor, id="one", placement="thread")], id="inner")
    system = start(inner, rr.ChildSpec(rr.Actor, id="two", placement="thread"))
    for path, near in (
        ("iner", True),
        ("root/iner", True),
        ("inner/deeper", True),
        ("my inner", True),
        ("zzzz", False),
        ("", None),
    ):
        if near is None:
            assert system.supervisor(path).path == "root"
            continue
        with pytest.raises(rr.NotFound, match=r"there is none of this path.*there are: root, root/inner") as caught:
            system.supervisor(path)
        assert caught.value.known == ("root", "root/inner")
        assert ("did you mean 'root/inner'?" in str(caught.value)) is near
    assert system.supervisor("inner").path == "root/inner"
    system.supervisor().terminate_child("inner")
    assert system.supervisor("inner").path == "root/inner"  # it may be started again
    system.supervisor().delete_child("inner")
    with pytest.raises(rr.NotFound, match=r"it is gone.*; there are: root"):
        system.supervisor("inner")


def test_a_manager_cannot_be_started_outside_a_system_and_that_says_where_it_can() -> None:
    made = Calls()

    class Recorded(Shop):
        def __init__(self) -> None:
            made("it")

    with pytest.raises(
        rr.UsageError, match=r"Recorded\.start\(\).*rr\.System\(\[rr\.ChildSpec\(Recorded, id=.*start_child"
    ):
        Recorded.start()
    assert len(made) == 0


@pytest.mark.parametrize("state", ["fatal", "FATAL", "Fatal", rr.State.FATAL])
def test_a_state_may_be_named_in_any_case(app: rr.Registrar, provider: rr.Registrar, state: str) -> None:
    serve(provider, "thing")
    query = app.load("provider/thing", 1)
    provider.send_status(query.id, rr.Status(state, "gone"))
    assert query.wait_status(state, timeout_s=10).state is rr.State.FATAL


@pytest.mark.parametrize("state", ["fatale", "", 5, None, [], rr.Status("OK")])
def test_what_is_no_state_is_told_with_those_there_are(app: rr.Registrar, provider: rr.Registrar, state: Any) -> None:
    with pytest.raises(rr.UsageError, match="status: expected a state of OK, UPDATE, WARNING, ERROR, FATAL, got"):
        rr.Status(state)
    serve(provider, "thing")
    if state is not None:
        with pytest.raises(rr.UsageError, match="wait_status: expected a state of OK"):
            app.load("provider/thing", 1).wait_status(state, timeout_s=0)


def test_the_state_of_a_resource_is_text_in_each_of_its_phases(
    app: rr.Registrar, provider: rr.Registrar, gate: Gate
) -> None:
    def failing(_request: Any, _response: Any) -> None:
        raise ValueError("busy")

    provider.register_server("slow", gate)
    serve(provider, "thing", unload=failing)
    query = app.load("provider/thing", 1)
    loading = app.load("provider/slow", 1, block=False)
    gate.wait_arrived()
    found = {info.server: info for info in provider.resources()}
    assert [(type(info.state), info.state) for info in (found["slow"], found["thing"])] == [
        (str, "loading"),
        (str, "OK"),
    ]
    provider.send_status(query.id, rr.Status("warning"))
    with pytest.raises(rr.UnloadFailed):
        query.unload()
    gate.open()
    loading.get(timeout=10)
    found = {info.server: info for info in provider.resources()}
    assert [(type(info.state), info.state) for info in (found["slow"], found["thing"])] == [
        (str, "OK"),
        (str, "unload_failed"),
    ]
    assert found["thing"].status is rr.State.WARNING


def test_a_state_directory_of_another_live_system_is_told_with_its_process(system: rr.System, state_dir: Path) -> None:
    program = "import sys, rr_actors as rr\ntry:\n    rr.System(state_dir=sys.argv[1]).start()\n"
    program += "except rr.CatalogLocked as error:\n    print(error.pid, error)\n"
    done = subprocess.run(
        [sys.executable, "-c", program, str(state_dir)],
        env=dict(os.environ, PYTHONPATH=str(REPOSITORY)),
        capture_output=True,
        text=True,
        timeout=20,
        check=False,
    )
    assert done.stdout.startswith(f"{os.getpid()} "), (done.stdout, done.stderr)
    assert str(state_dir) in done.stdout


# -- configuration -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("text", "key", "expected"),
    [
        ("save_interval = 5", "save_interval", "save_interval_s"),
        ("save_interval_s = 'often'", "save_interval_s", "number"),
        ("save_interval_s = -1", "save_interval_s", "0"),
        ("save_on_modify = 'yes'", "save_on_modify", "true or false"),
        ("durability = 'eternal'", "durability", "power"),
        ("on_damage = 'cry'", "on_damage", "refuse"),
        ("name = 7", "name", "letters"),
    ],
)
def test_a_wrong_registrar_config_file_is_told_with_file_key_and_expectation(
    tmp_path: Path, text: str, key: str, expected: str
) -> None:
    file = tmp_path / "registrar.toml"
    file.write_text(f"{text}\n")
    with pytest.raises(rr.ConfigError) as caught:
        rr.RegistrarConfig.from_toml(file)
    assert str(caught.value.file) == str(file)
    assert caught.value.key == key
    for word in (str(file), key, expected):
        assert word in str(caught.value), word


@pytest.mark.parametrize(
    ("text", "key"), [("frame_limit = 5", "frame_limit"), ("mailbox_limit = 'big'", "mailbox_limit")]
)
def test_a_wrong_system_config_file_is_told_with_file_and_key(tmp_path: Path, text: str, key: str) -> None:
    file = tmp_path / "system.toml"
    file.write_text(f"{text}\n")
    with pytest.raises(rr.ConfigError) as caught:
        rr.SystemConfig.from_toml(file)
    assert (str(caught.value.file), caught.value.key) == (str(file), key)


def test_a_file_that_is_no_toml_is_told_with_its_line(tmp_path: Path) -> None:
    file = tmp_path / "registrar.toml"
    file.write_text('name = "cameras"\nsave_on_modify = = true\n')
    with pytest.raises(rr.ConfigError, match="line 2") as caught:
        rr.RegistrarConfig.from_toml(file)
    assert str(file) in str(caught.value)


def test_a_config_file_that_is_not_there_is_told_by_path(tmp_path: Path) -> None:
    with pytest.raises(rr.ConfigError, match=r"missing\.toml"):
        rr.RegistrarConfig.from_toml(tmp_path / "missing.toml")


def test_a_wrong_config_in_code_is_told_with_key_expected_and_got() -> None:
    with pytest.raises(rr.ConfigError, match="durability") as caught:
        rr.RegistrarConfig(durability="eternal")  # type: ignore[arg-type]  # that is what is tested
    assert (caught.value.key, caught.value.got) == ("durability", "eternal")
    with pytest.raises(rr.ConfigError, match="stop_timeout_s: expected a number of seconds greater than 0"):
        rr.SystemConfig(stop_timeout_s=10**400)  # no clock counts so far


# -- misuse --------------------------------------------------------------------------------------------------------


def test_a_closed_registrar_says_so(app: rr.Registrar, provider: rr.Registrar) -> None:
    serve(provider, "camera")
    app.close()
    with pytest.raises(rr.RrError, match="app"):
        app.load("provider/camera", None, timeout_s=2.0)
    app.close()  # twice does no harm


def test_a_stopped_system_says_so(start: Start) -> None:
    system = start(rr.ChildSpec(Idle, id="a"))
    app = system.open_registrar("app")
    actor, root = system.ref("a"), system.supervisor()
    system.stop()
    system.stop()  # twice does no harm
    with pytest.raises(rr.RrError):
        app.load("provider/camera", None, timeout_s=2.0)
    with pytest.raises(rr.RrError):
        system.open_registrar("late")
    with pytest.raises(rr.ActorDeadError, match="its system has stopped"):
        actor.ask("anything")
    with pytest.raises(rr.NotFound, match="its system has stopped"):
        root.which_children()
    assert not actor.is_alive()
    system.start()
    assert actor.is_alive()


def test_a_system_with_a_stuck_callback_still_stops(system: rr.System, gate: Gate) -> None:
    serve(system.open_registrar("provider"), "stuck", load=gate)
    system.open_registrar("app").load("provider/stuck", None, block=False)
    gate.wait_arrived()
    begun = time.monotonic()
    system.stop(timeout_s=0.5)
    assert time.monotonic() - begun < 8.0


def test_a_system_cannot_be_started_twice(system: rr.System) -> None:
    with pytest.raises(rr.AlreadyStarted):
        system.start()
    system.open_registrar("app")


def test_a_system_cannot_be_started_where_nothing_may_wait_and_takes_nothing_then(
    provider: rr.Registrar, app: rr.Registrar, tmp_path: Path
) -> None:
    other = rr.System([], name="other", state_dir=tmp_path / "other")

    async def start(request: Any) -> Any:
        with pytest.raises(rr.UsageError, match=r"System\.start\(\): refused in an `async def` callback"):
            other.start()
        return request

    provider.register_server("thing", start)
    app.load("provider/thing", None)
    with other:  # the state directory is free, and the process's loop ends with the last system
        other.open_registrar("app")


def test_a_child_cannot_be_started_twice(start: Start, workshop: Workshop) -> None:
    spec = rr.ChildSpec(Shop, id="shop", args=(str(workshop.root),), placement="thread")
    system = start(spec)
    with pytest.raises(rr.AlreadyStarted, match="shop"):
        system.start_child(spec)
    system.supervisor().terminate_child("shop")
    with pytest.raises(rr.AlreadyPresent, match="shop"):
        system.start_child(spec)
    with pytest.raises(rr.NotFound, match="nobody"):
        system.supervisor().terminate_child("nobody")
    assert child(system, "shop").state == "stopped"


class Picky(rr.Manager):
    def __init__(self, quality: str) -> None:
        self.quality = quality


def test_arguments_that_nobody_takes_are_an_error(start: Start, state_dir: Path) -> None:
    for spec, field in (
        (rr.ChildSpec(Idle, id="a", args=("front",)), "args"),
        (rr.ChildSpec(Idle, id="a", kwargs={"devise": "front"}), "kwargs"),
    ):
        with pytest.raises(rr.InvalidSpec, match=rf"root/a: {field}: expected none, as Idle has no __init__") as caught:
            rr.System([spec], state_dir=state_dir)
        assert caught.value.field == field
    for cls in (rr.Actor, rr.Manager, pykka.ThreadingActor):
        with pytest.raises(rr.InvalidSpec, match=f"as {cls.__name__} has no __init__"):
            rr.System([rr.ChildSpec(cls, id="a", args=(1,))], state_dir=state_dir)
    system = start(rr.ChildSpec(Idle, id="a", placement="thread"))
    with pytest.raises(rr.InvalidSpec, match=r"root/b: kwargs: expected none, as Idle"):
        system.start_child(rr.ChildSpec(Idle, id="b", kwargs={"devise": "front"}))
    with pytest.raises(rr.StartFailed, match=r"root/c.*unexpected keyword argument 'devise'"):
        system.start_child(rr.ChildSpec(Picky, id="c", kwargs={"devise": "front"}))
    assert [child.id for child in system.supervisor().which_children()] == ["a"]


def test_a_tree_that_has_ended_is_said_to_be_gone_not_to_be_coming_back(state_dir: Path) -> None:
    tree = rr.Supervisor([rr.ChildSpec(Idle, id="a"), rr.ChildSpec(Shelf, id="shelf")], max_restarts=0)
    with rr.System(tree, state_dir=state_dir) as system:
        app = system.open_registrar("app")
        actor = system.ref("a")
        kill(system, "a")
        assert system.wait(10.0)
        for call in (
            lambda: system.ref("a"),
            lambda: system.supervisor().which_children(),
            lambda: system.start_child(rr.ChildSpec(Idle, id="b")),
        ):
            with pytest.raises(rr.NotFound, match="root not found: it is gone"):
                call()
        with pytest.raises(rr.ActorDeadError):
            actor.ask("anything")
        with pytest.raises(rr.RegistrarDown, match="shelf"):
            app.load("shelf/book", "x")
        system.stop()


class Shelf(rr.Manager):
    pass


def test_every_error_is_an_rr_error_with_its_place_in_the_tree() -> None:
    tree = {
        rr.UsageError: (
            "InvalidName NameTaken UnknownServer UnknownRegistrar UnknownQuery NotHolder InvalidRequest "
            "InvalidResponse InvalidSpec ConfigError NotSerializable AlreadyStarted AlreadyPresent NotFound"
        ),
        rr.LoadError: "LoadFailed CircularDependency LoadTimeout",
        rr.RrError: "UnloadFailed",
        rr.Unavailable: "RegistrarDown ActorUnavailable MailboxFull",
        rr.CatalogError: "CatalogLocked CatalogDamaged CatalogVersion",
        rr.SupervisionError: "StartFailed RestartIntensityExceeded",
    }
    for base, names in tree.items():
        for name in names.split():
            error = getattr(rr, name)
            assert issubclass(error, base)
            assert issubclass(error, rr.RrError)
            again = pickle.loads(pickle.dumps(error("text", path="p")))
            assert (type(again), str(again), again.path) == (error, "text", "p")


# -- the command line ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("arguments", [["nonsense"], ["--nonsense"], ["tree", "/nowhere/at/all"]])
def test_the_command_line_shows_no_traceback(arguments: list[str], tmp_path: Path) -> None:
    done = subprocess.run(
        [sys.executable, "-m", "rr_actors", *arguments],
        env=dict(os.environ, PYTHONPATH=str(REPOSITORY)),
        cwd=tmp_path,
        capture_output=True,
        text=True,
        timeout=20,
        check=False,
    )
    assert done.returncode != 0
    assert "Traceback" not in done.stdout + done.stderr
    assert (done.stdout + done.stderr).strip()


def test_a_listing_over_the_frame_limit_comes_in_parts(start: Start, workshop: Workshop) -> None:
    shop = rr.ChildSpec(Shop, id="shop", args=(str(workshop.root),))
    system = start(shop, config=rr.SystemConfig(frame_limit_bytes=20_000))
    app, manager = system.open_registrar("app"), system.registrar("shop")
    manager.register_server("echo", lambda request: request)
    names = [f"{number} {'x' * 1000}" for number in range(100)]
    for name in names:
        app.load("shop/echo", name)
    assert sorted(resource.response for resource in manager.resources()) == sorted(names)
    assert manager.servers() == ["shop/echo", "shop/thing"]
