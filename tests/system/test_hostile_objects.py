"""Objects whose own methods raise or wait for ever, given to every public call: a clear error, and the system lives."""

from __future__ import annotations

import asyncio
import gc
import os
import threading
import weakref
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NoReturn, cast

import pykka
import pytest

import rr_actors as rr
from rr_actors.runtime import callback_errors
from support import Calls, eventually, serve
from support_inside import actor_of


class Hostile(Exception):
    """What the methods of the objects here raise."""


def _raise(*_: object, **__: object) -> NoReturn:
    raise Hostile("no")


_in_test: list[None] = []


def _raise_in_its_test(_: object) -> None:
    """Raise as a finalizer does, but not in a later test: a thread may have kept the object until then."""
    if _in_test:
        raise Hostile("no")


@pytest.fixture
def finalizers_raise() -> Iterator[None]:
    _in_test.append(None)
    yield
    _in_test.clear()


_METHODS: dict[str, Callable[..., Any]] = {"del": _raise_in_its_test}


def _zoo() -> dict[str, Callable[[], Any]]:
    """Makers of hostile objects, by name."""
    names = ("hash", "eq", "str", "repr", "getattr", "bool", "iter", "len", "reduce", "reduce_ex", "del", "call")
    zoo: dict[str, Callable[[], Any]] = {}
    for base in (object, str, int, float, list, dict, tuple):
        for name in names:
            if name == "call" and base is not object:
                continue
            method = f"__{name}__"
            zoo[f"{base.__name__} {method}"] = type(
                f"Bad_{base.__name__}_{name}", (base,), {method: _METHODS.get(name, _raise)}
            )
        lies = {"__class__": property(_raise)}
        zoo[f"{base.__name__} __class__"] = type(f"Bad_{base.__name__}_class", (base,), lies)
    both = {"__getattr__": _raise, "__call__": lambda *_: None}
    zoo["callable __getattr__"] = type("BadCallable", (), both)
    zoo["callable __class__"] = type("LyingCallable", (), {"__class__": property(_raise), "__call__": lambda *_: None})
    zoo["all"] = type(
        "Worst", (), {f"__{name}__": _METHODS.get(name, _raise) for name in names} | {"__class__": property(_raise)}
    )
    zoo["dead proxy"] = _dead_proxy
    zoo["deep list"] = deep
    zoo["bytes path"] = BytesPath
    return zoo


def _dead_proxy() -> Any:
    def gone() -> None: ...

    return weakref.proxy(gone)


def deep() -> list[Any]:
    """A list in a list, 100,000 times."""
    found: list[Any] = []
    gc.disable()  # each collection would go through all that there are by then
    try:
        for _ in range(100_000):
            found = [found]
    finally:
        gc.enable()
    return found


class BytesPath:
    """A path that is none of text."""

    def __fspath__(self) -> bytes:
        return b"state"


ZOO = _zoo()
OTHER_BASES = ("float ", "int ", "list ", "tuple ")  # than object, str and dict: among the slow tests, as the deep list
AT_ONCE = [name for name in ZOO if name != "deep list" and not name.startswith(OTHER_BASES)]
NAMED = (rr.RrError, pykka.ActorDeadError, pykka.Timeout)


Call = Callable[[Any], Any]


def _calls(
    system: rr.System, app: rr.Registrar, held: rr.Query, ref: rr.ActorRef[Any]
) -> dict[str, Callable[[Any], Any]]:
    """A call of each public method for each parameter of a user's."""
    top = system.supervisor()
    spec: Any = rr.ChildSpec
    calls: dict[str, Call] = {
        "load server": lambda it: app.load(it, 1),
        "load request": lambda it: app.load("app/thing", it).unload(),
        "load on_status": lambda it: app.load("app/thing", 1, on_status=it).unload(),
        "load timeout_s": lambda it: app.load("app/thing", 1, timeout_s=it).unload(),
        "load progress": lambda it: app.load("app/thing", 1, progress=it).unload(),
        "load parent": lambda it: app.load("app/thing", 1, parent=it),
        "unload": lambda it: app.unload(it),
        "unload force": lambda it: app.unload(it, force=True),
        "unload timeout_s": lambda it: app.unload("none", timeout_s=it),
        "unload_client": lambda it: app.unload_client(it),
        "unload_all timeout_s": lambda it: app.unload_all(timeout_s=it),
        "register name": lambda it: app.register_server(it, _same),
        "register load": lambda it: app.register_server("bad", it),
        "register unload": lambda it: app.register_server("bad", _same, it),
        "register status": lambda it: app.register_server("bad", _same, status=it),
        "register recover": lambda it: app.register_server("bad", _same, recover=it),
        "register request_type": lambda it: app.register_server("bad", _same, request_type=it),
        "register linger_s": lambda it: app.register_server("bad", _same, linger_s=it),
        "register load_timeout_s": lambda it: app.register_server("bad", _same, load_timeout_s=it),
        "register recovery": lambda it: app.register_server("bad", _same, recovery=it),
        "unregister": lambda it: app.unregister_server(it),
        "status state": lambda it: app.send_status(held, rr.Status(it)),
        "status message": lambda it: app.send_status(held, rr.Status("OK", it)),
        "status": lambda it: app.send_status(held, it),
        "status target": lambda it: app.send_status(it, rr.Status("OK")),
        "update target": lambda it: app.update_response(it, 1),
        "update response": lambda it: app.update_response(held, it),
        "update message": lambda it: app.update_response(held, 1, it),
        "fetch_queries": lambda it: app.fetch_queries(it),
        "children": lambda it: app.children(it),
        "on_status server": lambda it: app.on_status(it, _same),
        "on_status callback": lambda it: app.on_status("app/thing", it),
        "close timeout_s": lambda it: app.close(timeout_s=cast("Any", [it])),
        "wait_status": lambda it: held.wait_status(it, 0.01),
        "open_registrar": lambda it: system.open_registrar(it),
        "open_registrar config": lambda it: system.open_registrar("bad", it),
        "registrar": lambda it: system.registrar(it),
        "release": lambda it: system.release(it),
        "ref": lambda it: system.ref(it),
        "supervisor": lambda it: system.supervisor(it).which_children(),
        "subscribe": lambda it: system.subscribe(it)(),
        "stop timeout_s": lambda it: system.stop(cast("Any", [it])),
        "tree": lambda it: system.tree(it),
        "System root": lambda it: rr.System(it),
        "System name": lambda it: rr.System(name=it),
        "System state_dir": lambda it: rr.System(state_dir=it),
        "System config": lambda it: rr.System(config=it),
        "ChildSpec class": lambda it: spec(it),
        "ChildSpec id": lambda it: spec(Listener, id=it),
        "ChildSpec args": lambda it: spec(Listener, args=it),
        "ChildSpec kwargs": lambda it: spec(Listener, kwargs=it),
        "ChildSpec restart": lambda it: spec(Listener, restart=it),
        "ChildSpec shutdown_s": lambda it: spec(Listener, shutdown_s=it),
        "ChildSpec backoff": lambda it: spec(Listener, backoff=it),
        "ChildSpec heartbeat_s": lambda it: spec(Listener, heartbeat_s=it),
        "Supervisor children": lambda it: rr.Supervisor(it),
        "Supervisor strategy": lambda it: rr.Supervisor(strategy=it),
        "Supervisor max_restarts": lambda it: rr.Supervisor(max_restarts=it),
        "start_child": lambda it: top.start_child(it),
        "terminate_child": lambda it: top.terminate_child(it),
        "restart_child": lambda it: top.restart_child(it),
        "delete_child": lambda it: top.delete_child(it),
        "get_childspec": lambda it: top.get_childspec(it),
        "update": lambda it: top.update(it),
        "monitor ref": lambda it: rr.monitor(it, _same).demonitor(),
        "monitor callback": lambda it: rr.monitor(ref, it).demonitor(),
        "ask timeout": lambda it: ref.ask("hello", timeout=it),
        "server name": lambda it: rr.server(it),
        "server load": lambda it: rr.server("x")(it),
        "current": lambda it: rr.Status("OK", resource_id=it),
    }
    return calls


def _same(request: Any, *_: Any) -> Any:
    return request


class Listener(rr.Actor):
    def on_receive(self, message: Any) -> Any:
        return message


@pytest.mark.usefixtures("finalizers_raise")
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")  # of what __del__ raises
@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=[pytest.mark.slow] * (name not in AT_ONCE)) for name in sorted(ZOO)]
)
def test_a_hostile_object_is_refused_by_name_or_works_and_the_system_lives_on(
    start: Callable[..., rr.System], name: str
) -> None:
    system = start(rr.ChildSpec(Listener, id="listener", placement="thread"))
    app = system.open_registrar("app")
    app.register_server("thing", _same, _same)
    held = app.load("app/thing", "kept")
    ref = system.ref("listener")
    wrong: list[str] = []
    for what, call in _calls(system, app, held, ref).items():
        it = ZOO[name]()
        try:
            call(it)
        except NAMED:
            pass
        except Exception as error:
            wrong.append(f"{what}: {type(error).__name__}: {error!r:.200}")
        for server in app.servers():
            if server != "app/thing":
                app.unregister_server(server.removeprefix("app/"))
        assert app.load("app/thing", 5, timeout_s=5.0).response == 5, what
        assert ref.ask("still there", timeout=5.0) == "still there", what
        for query in app.queries():
            if query != held:
                app.unload(query)
        del it
    gc.collect()
    assert wrong == []


# -- what hangs, and what once killed a registrar ----------------------------------------------------------------------


class Stuck(Exception):
    """Its text is not to be had before the gate is open."""

    gate = threading.Event()

    def __str__(self) -> str:
        self.gate.wait(20)
        return "at last"


@pytest.fixture
def stuck() -> Any:
    Stuck.gate.clear()
    yield Stuck
    Stuck.gate.set()


def test_an_error_whose_text_hangs_holds_up_its_own_callback_alone(app: rr.Registrar, stuck: type[Stuck]) -> None:
    def fail(*_: Any) -> Any:
        raise stuck

    app.register_server("load", fail)
    app.register_server("unload", _same, fail)
    app.register_server("status", _same, status=fail)
    served = serve(app, "thing")
    failing: Any = app.load("app/load", 1, block=False)
    app.unload(app.load("app/unload", 1), block=False)
    listened = app.load("app/thing", 1, on_status=fail)
    app.send_status(listened, rr.Status("WARNING", "hm"))
    assert app.load("app/thing", 2, timeout_s=5.0).response == {"of": 2, "number": 2}
    assert not failing.done()
    stuck.gate.set()
    with pytest.raises(rr.LoadFailed, match="Stuck: at last"):
        failing.get(timeout=5)
    assert len(served.loads) == 2


class AsyncListener(rr.Actor):
    """Handles each message in a coroutine; told to, it raises there, or in a task that nobody awaits."""

    async def on_receive(self, message: Any) -> Any:
        if message == "raise":
            raise Stuck
        if message == "leave a task":
            task = asyncio.ensure_future(_raise_stuck())
            await asyncio.sleep(0.01)
            del task
            gc.collect()  # its exception was never retrieved
        return message


async def _raise_stuck(*_: Any) -> Any:
    raise Stuck


def test_an_error_of_a_coroutine_whose_text_hangs_holds_up_no_other_coroutine(
    start: Callable[..., rr.System], stuck: type[Stuck], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(callback_errors, "TEXT_LIMIT_S", 0.5)
    system = start(rr.ChildSpec(AsyncListener, id="listener", placement="thread"))
    app = system.open_registrar("app")

    async def well(request: Any) -> Any:
        await asyncio.sleep(0.001)
        return request

    app.register_server("load", _raise_stuck)
    app.register_server("unload", _same, _raise_stuck)
    app.register_server("status", _same, status=_raise_stuck)
    app.register_server("well", well)
    failing: Any = app.load("app/load", 1, block=False)
    app.unload(app.load("app/unload", 1), block=False)
    for server in ("app/well", "app/status"):
        app.send_status(app.load(server, 0, on_status=_raise_stuck), rr.Status("WARNING", "hm"))
    rr.monitor(system.ref("listener"), _raise_stuck)
    system.subscribe(_raise_stuck)
    system.ref("listener").tell("raise")  # which ends it, and it is started again
    eventually(lambda: _answers(system.ref("listener")), what="the listener is back")
    assert system.ref("listener").ask("leave a task", timeout=5.0) == "leave a task"
    for number in range(1, 10):
        assert app.load("app/well", number, timeout_s=20.0).response == number
        assert system.ref("listener").ask(number, timeout=20.0) == number
    with pytest.raises(rr.LoadFailed, match=r"Stuck was raised; its str\(\) had not returned after 0.5 s"):
        failing.get(timeout=5)
    assert not stuck.gate.is_set()


def _answers(ref: rr.ActorRef[Any]) -> bool:
    try:
        return ref.ask("there", timeout=5.0) == "there"
    except rr.RrError:
        return False


def test_a_listener_that_is_gone_is_an_error_at_the_call_and_not_on_the_loop(app: rr.Registrar) -> None:
    serve(app, "thing")
    with pytest.raises(rr.UsageError, match="on_status"):
        app.load("app/thing", 1, on_status=_dead_proxy())
    assert app.queries() == []


def test_a_listener_that_goes_later_is_logged_and_harms_nobody(app: rr.Registrar, caplog: Any) -> None:
    serve(app, "thing")

    def hear(_status: rr.Status) -> None: ...

    listeners = [hear]
    query = app.load("app/thing", 1, on_status=cast("Any", weakref.proxy(listeners[0])))
    del hear
    listeners.clear()
    app.send_status(query, rr.Status("WARNING", "hm"))
    eventually(lambda: app.stats()["callback_failures"] == 1)
    eventually(lambda: "ReferenceError" in caplog.text)
    assert app.load("app/thing", 2).response == {"of": 2, "number": 2}


def test_a_registrar_that_a_defect_has_closed_is_dormant_and_can_be_opened_again(
    system: rr.System, app: rr.Registrar, provider: rr.Registrar, monkeypatch: pytest.MonkeyPatch
) -> None:
    serve(provider, "camera")
    kept = app.load("provider/camera", "kept")
    app.queries()
    monkeypatch.setattr(actor_of(app).commits, "commit", lambda _batch: 1 // 0)
    with pytest.raises(rr.RegistrarDown):
        app.load("provider/camera", "lost", block=False).get(timeout=5)
    with pytest.raises(rr.RegistrarDown, match="open it again"):
        app.load("provider/camera", "lost", timeout_s=1.0)
    eventually(lambda: system.dormant() == ["app"])
    again = system.open_registrar("app")
    assert [query.id for query in again.queries()] == [kept.id]
    again.unload_all()
    eventually(lambda: not provider.resources())
    assert system.dormant() == []


def test_names_and_messages_of_a_users_text_class_are_kept_as_plain_text(app: rr.Registrar, tmp_path: Path) -> None:
    class Text(str):
        def __hash__(self) -> int:
            raise Hostile("no")

    app.register_server(Text("thing"), _same)
    heard = Calls()
    query = app.load(Text("app/thing"), 1, on_status=heard)
    app.send_status(Text(query.id), rr.Status("ERROR", Text("broken")))
    heard.wait(1)
    assert type(heard.items[0].message) is str
    app.unload(Text(query.id))
    assert os.fspath(rr.System(state_dir=Text(tmp_path / "other")).state_dir) == str(tmp_path / "other")


# -- errors without a name -------------------------------------------------------------------------------------------


def test_what_is_no_method_is_refused_where_a_server_is_declared() -> None:
    with pytest.raises(rr.InvalidSpec, match=r"@rr.server\('x'\): expected a method to decorate, got 5"):
        rr.server("x")(cast("Any", 5))


def test_a_path_of_bytes_is_no_state_directory() -> None:
    with pytest.raises(rr.ConfigError, match="expected a directory's path, got"):
        rr.System(state_dir=cast("Any", BytesPath()))


def test_a_thousand_million_numbers_are_no_tree() -> None:
    with pytest.raises(rr.InvalidSpec, match="ChildSpecs"):
        rr.System(cast("Any", range(10**9)))
