"""An injector: a signal at every place of a call where Python delivers one, and what must hold afterwards.

Its handler raises KeyboardInterrupt, as Python's own does, or with ``--raising Exception`` an exception such as a time
limit's, which `except Exception` would catch. What is interrupted within asyncio is asyncio's: it may lose a callback.

Python runs signal handlers in the main thread only, and there only at certain instructions: at the beginning of a
function, after a call, and at the end of each round of a loop. A signal that arrives between two of them is delivered
at the second. So these are all the points there are. A call that blocks counts twice: once for a signal that arrives
just before it, and once for a signal that ends it.

The tracing function stops tracing at the chosen point, and makes a capsule whose destructor, in C, calls
PyErr_SetInterrupt. The capsule dies as the function returns. The traced instruction then meets a pending SIGINT, as if
the signal had come in just before: nothing is simulated but its time.

``python tests/support_interrupts.py --help`` runs all scenes, each in a process of its own.
"""

from __future__ import annotations

import argparse
import ast
import asyncio
import ctypes
import dis
import faulthandler
import functools
import gc
import json
import linecache
import os
import random
import signal
import subprocess
import sys
import tempfile
import threading
import time
import traceback
from collections import Counter, deque
from collections.abc import Callable, Coroutine, Iterator
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from types import CodeType, FrameType
from typing import Any, NoReturn, cast

import rr_actors as rr
from rr_actors.runtime.event_loop import Dispatcher
from support import eventually

LIMIT_S = 20.0
"""A step that takes longer is wedged: its process is ended, with the stack of each thread."""

MORE_DESCRIPTORS = 32
"""So many more than at the beginning are idle lines and bells of threads."""

_CHECKING = ("RESUME", "CALL", "JUMP_BACKWARD", "POP_JUMP_BACKWARD", "CALL_FUNCTION_EX", "CALL_KW")
_BLOCKING = frozenset(("acquire", "wait", "_readable", "poll", "recv", "select", "connect", "sched_yield", "waitpid"))
_UNTRACED = (
    "importlib",
    "/asyncio/",
    "/logging/",
    "linecache",
    "tokenize",
    "support_interrupts",
    "/inspect.py",
    "/ast.py",
)

_capsule = ctypes.pythonapi.PyCapsule_New
_capsule.restype = ctypes.py_object
_capsule.argtypes = [ctypes.c_void_p, ctypes.c_char_p, ctypes.c_void_p]
_set_interrupt = ctypes.cast(ctypes.pythonapi.PyErr_SetInterrupt, ctypes.c_void_p).value


class Alarm(Exception):
    """What a handler raises that ends a call after some time."""


_rung: list[bool] = []
"""Something, if an Alarm was raised. A handler may set no threading.Event that its own thread waits for."""


def _ring(_number: int, _frame: object) -> None:
    _rung.append(True)
    raise Alarm


HANDLERS: dict[str, tuple[type[BaseException], Callable[..., Any]]] = {
    "KeyboardInterrupt": (KeyboardInterrupt, signal.default_int_handler),
    "Exception": (Alarm, _ring),
}
"""What a signal's handler raises, and the handler."""


class Points:
    """The points of each code object: the offset of an instruction, and whether what it calls may block."""

    def __init__(self) -> None:
        self._known: dict[CodeType, dict[int, bool]] = {}

    def of(self, code: CodeType) -> dict[int, bool]:
        """Those of one code object."""
        known = self._known.get(code)
        if known is None:
            known = {}
            ours = not any(part in code.co_filename for part in _UNTRACED)
            if ours or code.co_name.startswith("planted"):
                for instruction in dis.get_instructions(code):
                    name = instruction.opname
                    if name.startswith(_CHECKING) and "NO_INTERRUPT" not in name:
                        known[instruction.offset] = name.startswith("CALL") and _called(code, instruction) in _BLOCKING
            self._known[code] = known
        return known


def _called(code: CodeType, instruction: dis.Instruction) -> str:
    place = instruction.positions
    if place is None or place.lineno is None or place.lineno != place.end_lineno:
        return ""
    line = linecache.getline(code.co_filename, place.lineno).encode()
    try:
        call = ast.parse(line[place.col_offset : place.end_col_offset].decode(), mode="eval").body
    except (SyntaxError, UnicodeDecodeError):
        return ""
    if not isinstance(call, ast.Call):
        return ""
    return call.func.attr if isinstance(call.func, ast.Attribute) else getattr(call.func, "id", "")


_points = Points()


@dataclass
class Interrupted:
    """How a call ended that was to be interrupted at a point.

    Attributes:
        points: how many points the call passed.
        where: where the interrupt was injected; "" if the call ended before that.
        error: what the call raised.
        is_late: whether the call had returned by then: a handler that came in a turn is called behind it.
    """

    points: int = 0
    where: str = ""
    error: BaseException | None = None
    is_late: bool = False

    @property
    def was_raised(self) -> bool:
        """Whether the caller had what the handler raised; from asyncio.run() it may come as what cancels its task.

        An Alarm may also be the cause of what the caller had: what a user's value raises while it is encoded, say, is
        told as an error of that value.
        """
        error = self.error
        if isinstance(error, (KeyboardInterrupt, asyncio.CancelledError)):
            return True
        while error is not None and not isinstance(error, Alarm):
            error = error.__cause__ or error.__context__
        return error is not None


def interrupted(
    call: Callable[[], object], point: int, raising: type[BaseException] = KeyboardInterrupt
) -> Interrupted:
    """Make the call, in the main thread, and have it interrupted at its n-th point; the first is 1.

    Args:
        raising: what the handler of SIGINT raises.
    """
    told = Interrupted()
    _rung.clear()

    def reached(frame: FrameType, blocks: bool) -> bool:
        """Whether this is the point. Then a SIGINT is pending as soon as the capsule is gone, as this returns."""
        told.points += 1 + blocks
        if told.points < point or told.where:
            return False
        _watch(None)
        told.where = f"{Path(frame.f_code.co_filename).name}:{frame.f_lineno} {frame.f_code.co_name}"
        if told.points - blocks != point:  # the second of the two points of a call that blocks
            told.where += " (blocked)"
            _rung.append(True)
            raise raising
        capsule = _capsule(1, None, _set_interrupt)  # noqa: F841 - dies as this returns
        return True

    before = gc.isenabled()
    gc.disable()  # a collection would run finalizers at some other point each time
    _watch(reached)
    try:
        call()
        _watch(None)
        if told.where and raising is Alarm and not _rung:
            told.is_late = True
            eventually(lambda: _rung, 5.0, "a handler that came in a turn is called behind it")
    except BaseException as error:
        _watch(None)
        told.error = error
    finally:
        if before:
            gc.enable()
    return told


Reached = Callable[[FrameType, bool], bool]
"""Told at each point: the frame, and whether what it calls may block; True: there are no more."""


def _watch_by_tracing(reached: Reached | None) -> None:
    def trace(frame: FrameType, event: str, _arg: object) -> Any:
        points = _points.of(frame.f_code)
        if event == "call":
            frame.f_trace_lines, frame.f_trace_opcodes = False, bool(points)
            return trace if points else None
        if event == "opcode":
            blocks = points.get(frame.f_lasti)
            if blocks is not None and reached is not None and reached(frame, blocks):
                return None
        return trace

    sys.settrace(None if reached is None else trace)


def _watch_by_monitoring(reached: Reached | None) -> None:
    """From Python 3.12 on a trace function is not told of each instruction, and from 3.13 on of few."""
    monitoring: Any = getattr(sys, "monitoring")  # noqa: B009 - not in 3.11
    tool, event, me = monitoring.DEBUGGER_ID, monitoring.events.INSTRUCTION, threading.get_ident()

    def at(code: CodeType, offset: int) -> Any:
        blocks = _points.of(code).get(offset)
        if blocks is None:
            return monitoring.DISABLE
        if reached is not None and threading.get_ident() == me:
            reached(sys._getframe(1), blocks)  # pyright: ignore[reportPrivateUsage]
        return None

    if monitoring.get_tool(tool) is None:
        monitoring.use_tool_id(tool, "interrupts")
    monitoring.register_callback(tool, event, at if reached is not None else None)
    monitoring.set_events(tool, event if reached is not None else 0)


_watch = _watch_by_monitoring if sys.version_info >= (3, 12) else _watch_by_tracing


# -- what is interrupted ---------------------------------------------------------------------------------------------


class Echo(rr.Actor):
    """Answers."""

    def on_receive(self, message: Any) -> Any:
        """Give back what came."""
        return message

    def twice(self, number: int) -> int:
        """For proxies."""
        return 2 * number


class Stock(rr.Manager):
    """A manager in a process of its own."""

    @rr.server("thing")
    def load_thing(self, request: int) -> int:
        """Give back what is asked for."""
        return request

    @load_thing.unload
    def unload_thing(self, request: int, response: int) -> None:
        """Do nothing."""


class World:
    """A running system, and what the scenes use of it."""

    def __init__(self, state_dir: Path) -> None:
        root = [
            rr.ChildSpec(Stock, id="stock"),
            rr.ChildSpec(Echo, id="far"),
            rr.ChildSpec(Echo, id="near", placement="thread"),
        ]
        self.system = rr.System(root, state_dir=state_dir).start()
        self.provider = self.system.open_registrar("provider")
        self.provider.register_server("thing", _same, _nothing)
        self.app = self.system.open_registrar("app")
        self.other = self.system.open_registrar("other")
        self.shared = self.other.load("provider/thing", -1)
        self.remote = self.other.load("stock/thing", -1)
        self.far, self.near = self.system.ref("far"), self.system.ref("near")
        self.stock = self.system.registrar("stock")
        self.query: Any = None
        self.number = 0
        for server in ("provider/thing", "stock/thing"):  # from now on lines go directly
            for _ in range(3):
                self.app.load(server, self.fresh()).unload()
        self.far.ask(1)

    def fresh(self) -> int:
        """A request that nobody has made yet."""
        self.number += 1
        return self.number

    def works(self) -> None:
        """See that everything works, and that nothing is held by nobody."""
        app = self.app
        for server in ("provider/thing", "stock/thing"):
            request = self.fresh()
            with app.load(server, request, timeout_s=5.0) as query:
                assert query.response == request
        assert self.near.ask(3, timeout=5.0) == 3
        assert self.far.ask(4, timeout=5.0) == 4
        eventually(self._agree, 5.0, "what the providers hold is what the consumer knows of")

    def _agree(self) -> bool:
        app = self.app
        stats = app.stats()
        if stats["loading"] or stats["unloading"] or app.owed():
            return False
        theirs = {query.id for name in ("provider", "stock") for query in app.fetch_queries(name, timeout_s=5.0)}
        return theirs == {query.id for query in app.queries()}

    def empty(self) -> None:
        """See that nothing is left once all is let go."""
        self.app.unload_all(timeout_s=5.0)
        assert self.app.queries() == []
        for registrar, kept in ((self.provider, self.shared), (self.stock, self.remote)):
            eventually(
                lambda registrar=registrar, kept=kept: [r.id for r in registrar.resources()] == [kept.resource_id],
                5.0,
                f"{registrar.name} serves what is held, and nothing else",
            )


def _kinds_of_descriptors() -> Iterator[str]:
    for descriptor in os.listdir("/proc/self/fd"):
        with suppress(OSError):  # the one by which the directory is read
            yield os.readlink(f"/proc/self/fd/{descriptor}").partition(":[")[0]


def _same(request: int) -> int:
    return request


def _nothing(request: int, response: int) -> None:
    return None


@dataclass
class Scene:
    """A call, what is done before it, and what must hold when it was interrupted."""

    name: str
    act: Callable[[World], object]
    before: Callable[[World], object] = lambda _world: None
    after: Callable[[World], object] = lambda _world: None
    holds_nothing: bool = False


def _held(server: str) -> Callable[[World], None]:
    def load(world: World) -> None:
        world.query = world.app.load(server, world.fresh())

    return load


def _known(server: str) -> Callable[[World], None]:
    def load(world: World) -> None:
        _held(server)(world)
        world.app.queries()  # which takes up what was loaded directly

    return load


def _three(world: World) -> None:
    for server in ("provider/thing", "stock/thing", "provider/thing"):
        world.app.load(server, world.fresh())


def _unregister(world: World) -> None:
    with suppress(rr.UnknownServer):
        world.provider.unregister_server("extra")


def _close(name: str) -> Callable[[World], None]:
    def close(world: World) -> None:
        try:
            registrar = world.system.open_registrar(name)
        except rr.NameTaken:
            registrar = cast("rr.Registrar", world.system.registrar(name))
        registrar.close()

    return close


def _remove(id: str) -> Callable[[World], None]:
    def remove(world: World) -> None:
        top = world.system.supervisor()
        with suppress(rr.NotFound):
            top.terminate_child(id)
            top.delete_child(id)
        assert id not in [child.id for child in top.which_children()]

    return remove


def _start(id: str, placement: Any) -> Callable[[World], object]:
    return lambda world: world.system.start_child(rr.ChildSpec(Echo, id=id, placement=placement))


def _terminated(world: World) -> None:
    _start("extra", "thread")(world)
    world.system.supervisor().terminate_child("extra")


def _monitor(ref: str) -> Callable[[World], None]:
    def monitor(world: World) -> None:
        found: rr.ActorRef[Any] = getattr(world, ref)
        rr.monitor(found, _nothing_of).demonitor()

    return monitor


def _nothing_of(_: object) -> None:
    return None


def _run(coroutine: Coroutine[Any, Any, None]) -> None:
    """As asyncio.run(), but it waits a second at most for what is left.

    An interrupt within asyncio may lose the wake-up of a task, which then never ends, and asyncio.run() with it. Or it
    may lose the task itself, which then runs but is in no list: it ends when the garbage collector runs. The task's
    coroutine ends here all the same, as it would with the loop of an application that gives up.
    """
    runner = asyncio.Runner()
    try:
        runner.run(coroutine)
    finally:
        loop = runner.get_loop()
        left = asyncio.all_tasks(loop)
        for task in left:
            task.cancel()
        if left:
            loop.run_until_complete(asyncio.wait(left, timeout=1.0))
            for task in left:
                if not task.done():
                    task.get_coro().close()
        loop.run_until_complete(loop.shutdown_asyncgens())
        loop.run_until_complete(loop.shutdown_default_executor())
        asyncio.set_event_loop(None)
        loop.close()
        coroutine.close()


async def _load_async(world: World) -> None:
    query = await world.app.load_async("provider/thing", world.fresh())
    world.app.unload(query)


async def _load_async_elsewhere(world: World) -> None:
    query = await world.app.load_async("stock/thing", world.fresh())
    await query.unload_async()


def _load_two(world: World) -> None:
    world.app.load_all([("provider/thing", world.fresh()), ("stock/thing", world.fresh())])


def _load_two_and_fail(world: World) -> None:
    two = [("provider/thing", world.fresh()), ("stock/thing", world.fresh())]
    with suppress(rr.UnknownServer):
        world.app.load_all([*two, ("provider/nothing", 0)])


def scenes() -> Iterator[Scene]:
    """All that need a running system."""
    for where, server in (("here", "provider/thing"), ("elsewhere", "stock/thing")):

        def load(world: World, server: str = server, **options: Any) -> Any:
            return world.app.load(server, world.fresh(), **options)

        def join(world: World, server: str = server) -> Any:
            return world.app.load(server, -1)

        def future(world: World, server: str = server) -> Any:
            return world.app.load(server, world.fresh(), block=False)

        def listened(world: World, server: str = server) -> Any:
            return world.app.load(server, world.fresh(), on_status=_nothing_of)

        def through(world: World, server: str = server) -> None:
            with world.app.load(server, world.fresh()) as query:
                assert query.response

        def client(world: World, server: str = server) -> None:
            world.app.unload_client(server)

        yield Scene(f"load {where}", load, holds_nothing=True)
        yield Scene(f"join {where}", join, holds_nothing=True)
        yield Scene(f"load {where}, listening", listened, holds_nothing=True)
        yield Scene(f"load {where} as a future", future)
        yield Scene(f"load {where} as a future, and get it", lambda world, future=future: future(world).get(timeout=5))
        yield Scene(f"load and unload {where}", through)
        yield Scene(f"unload {where}", lambda world: world.app.unload(world.query), _held(server))
        yield Scene(f"unload {where} what is known", lambda world: world.app.unload(world.query), _known(server))
        yield Scene(
            f"unload {where} as a future",
            lambda world: world.app.unload(world.query, block=False).get(timeout=5),
            _known(server),
        )
        yield Scene(f"unload_client {where}", client, _three)
        yield Scene(f"children {where}", lambda world: world.app.children(world.query), _known(server))
        name = server.partition("/")[0]
        yield Scene(f"fetch_queries {where}", lambda world, name=name: world.app.fetch_queries(name), _known(server))
        yield Scene(
            f"send_status {where}",
            lambda world, server=server: _owner(world, server).send_status(world.query, rr.Status("WARNING", "hm")),
            _known(server),
        )
        yield Scene(
            f"update_response {where}",
            lambda world, server=server: _owner(world, server).update_response(world.query, 5),
            _known(server),
        )
        yield Scene(
            f"forced unload {where}",
            lambda world, server=server: _owner(world, server).unload(world.query, force=True),
            _known(server),
        )
        yield Scene(
            f"resources {where}", lambda world, server=server: _owner(world, server).resources(), _known(server)
        )
        yield Scene(f"queries of {where}", lambda world, server=server: _owner(world, server).queries())
    yield Scene("load_all", _load_two, holds_nothing=True)
    yield Scene("load_all, of which one fails", _load_two_and_fail, holds_nothing=True)
    yield Scene("unload_all", lambda world: world.app.unload_all(), _three)
    yield Scene("unload_all as a future", lambda world: world.app.unload_all(block=False).get(timeout=5), _three)
    yield Scene("load_async", lambda world: _run(_load_async(world)))
    yield Scene("load_async elsewhere", lambda world: _run(_load_async_elsewhere(world)))
    yield Scene("queries", lambda world: [query.request for query in world.app.queries()], _three)
    yield Scene("listings", lambda world: (world.app.clients(), world.app.servers(), world.app.owed()))
    yield Scene("save_catalog", lambda world: world.app.save_catalog(), _three)
    yield Scene("load_catalog", lambda world: world.app.load_catalog())
    yield Scene("on_status", lambda world: world.app.on_status("provider/thing", _nothing_of))
    yield Scene("register_server", lambda world: world.provider.register_server("extra", _same), after=_unregister)
    yield Scene(
        "unregister_server",
        lambda world: world.provider.unregister_server("extra"),
        lambda world: world.provider.register_server("extra", _same),
        _unregister,
    )
    yield Scene("open_registrar", lambda world: world.system.open_registrar("extra"), after=_close("extra"))
    yield Scene("close", lambda world: world.query.close(), _open_extra, _close("extra"))
    for name in ("near", "far"):
        yield Scene(f"ask {name}", lambda world, name=name: getattr(world, name).ask(5))
        yield Scene(f"ask {name} as a future", lambda world, name=name: getattr(world, name).ask(5, block=False).get())
        yield Scene(f"tell {name}", lambda world, name=name: getattr(world, name).tell(5))
        yield Scene(f"proxy of {name}", lambda world, name=name: getattr(world, name).proxy().twice(4).get(timeout=5))
        yield Scene(f"is_alive {name}", lambda world, name=name: getattr(world, name).is_alive())
        yield Scene(f"monitor {name}", _monitor(name))
    yield Scene("ref", lambda world: world.system.ref("far"))
    yield Scene("snapshot", lambda world: world.system.snapshot(), _three)
    yield Scene("tree", lambda world: str(world.system.tree()))
    yield Scene("subscribe", lambda world: world.system.subscribe(_nothing_of)())
    yield Scene("which_children", lambda world: world.system.supervisor().which_children())
    yield Scene("start_child in a thread", _start("extra", "thread"), after=_remove("extra"))
    yield Scene("start_child in a process", _start("extra", "process"), after=_remove("extra"))
    yield Scene(
        "terminate_child",
        lambda world: world.system.supervisor().terminate_child("extra"),
        _start("extra", "thread"),
        _remove("extra"),
    )
    yield Scene(
        "restart_child", lambda world: world.system.supervisor().restart_child("extra"), _terminated, _remove("extra")
    )


def _owner(world: World, server: str) -> Any:
    return world.provider if server.startswith("provider") else world.stock


def _open_extra(world: World) -> None:
    world.query = world.system.open_registrar("extra")
    world.query.load("provider/thing", world.fresh())


# -- a run -------------------------------------------------------------------------------------------------------------


class Broken(Exception):
    """After an interrupt something did not work any more: go on in another process."""


Tell = Callable[..., None]


class Run:
    """Interrupts scenes at a number of points each, and tells what comes of it.

    Args:
        most: how many points of a scene are tried, evenly over all it has; 0: each once.
        raising: what the handler of SIGINT raises.
        together: so many calls of a running system are interrupted, each at a point, before it is looked at.
        tell: called with facts as keywords.
        directory: for the state of systems.
        skip: the scene to begin with and how many of its points not to try: to go on where a process was wedged.
    """

    def __init__(
        self,
        most: int,
        seed: int,
        raising: type[BaseException],
        together: int,
        tell: Tell,
        directory: Path,
        skip: tuple[str, int] = ("", 0),
    ) -> None:
        self._most = most
        self._seed = seed
        self._raising = raising
        self._together = together
        self._tell = tell
        self._directory = directory
        self._skip = skip

    def scenes(self, wanted: list[Scene]) -> None:
        """Try scenes of a running system."""
        if not wanted:
            return
        world = World(self._directory / "world")
        files: Counter[str] = Counter()
        for scene in wanted:
            faulthandler.dump_traceback_later(3 * LIMIT_S, exit=True)
            passed: list[int] = []
            for _ in range(4):  # the first time caches are filled, and any time it may have to wait for long
                scene.before(world)
                passed.append(interrupted(lambda scene=scene: scene.act(world), sys.maxsize).points)
                self._settle(scene, world)
            files = files or Counter(_kinds_of_descriptors())
            for points in self._chosen(scene.name, min(passed), self._together):
                self._try(scene, world, points)
        faulthandler.dump_traceback_later(LIMIT_S, exit=True)
        gc.collect()
        if Counter(_kinds_of_descriptors()).total() - files.total() > MORE_DESCRIPTORS:
            kinds = Counter(_kinds_of_descriptors()) - files
            self._tell(scene="all", found=f"more descriptors are open than at the beginning: {kinds}")
        world.system.stop(5.0)
        faulthandler.cancel_dump_traceback_later()

    def _try(self, scene: Scene, world: World, points: list[int]) -> None:
        """Interrupt the scene at each of some points, then see whether all is well."""
        all_raised = True
        try:
            for left, point in zip(reversed(range(len(points))), points, strict=True):
                scene.before(world)
                told = interrupted(lambda: scene.act(world), point, self._raising)
                self._note(scene.name, point, told)
                all_raised &= told.was_raised and not told.is_late
                if left:  # after the last one, _settle() does it
                    scene.after(world)
            if scene.holds_nothing and all_raised:
                eventually(lambda: not world.app.queries(), 5.0, "what was interrupted is held by nobody")
            self._settle(scene, world)
        except (Exception, KeyboardInterrupt) as error:
            self._broken(scene.name, points, error)

    def systems(self, wanted: list[SystemScene]) -> None:
        """Try the start and the stop of systems."""
        for scene in wanted:
            faulthandler.dump_traceback_later(3 * LIMIT_S, exit=True)
            points = 0
            for _ in range(2):
                system = scene.system(self._directory / "system")
                points = interrupted(getattr(system, scene.what), sys.maxsize).points
                system.stop(5.0)
            for [point] in self._chosen(scene.name, points, 1):
                before = set(threading.enumerate())
                system = scene.system(self._directory / "system")
                told = interrupted(getattr(system, scene.what), point, self._raising)
                self._note(scene.name, point, told)
                try:
                    self._again(scene, system, before)
                except (Exception, KeyboardInterrupt) as error:
                    self._broken(scene.name, [point], error)
        faulthandler.cancel_dump_traceback_later()

    def _chosen(self, name: str, points: int, together: int) -> Iterator[list[int]]:
        chance = random.Random(f"{self._seed} {name}")
        chosen: list[int] = []
        while len(chosen) < (self._most or points):
            left = min(points, (self._most or points) - len(chosen))
            chosen += sorted(chance.sample(range(1, points + 1), left))
        skipped = self._skip[1] if self._skip[0] == name else 0
        self._tell(scene=name, points=points)
        for place in range(skipped, len(chosen), together):
            some = chosen[place : place + together]
            self._tell(scene=name, place=place, some=some)
            faulthandler.dump_traceback_later(LIMIT_S, exit=True)
            yield some

    def _note(self, name: str, point: int, told: Interrupted) -> None:
        self._tell(scene=name, where=told.where, raised=told.was_raised)
        if told.error is not None and not told.was_raised:
            self._tell(scene=name, found=f"{name}, point {point}, {told.where}: raised {told.error!r}")

    def _broken(self, name: str, points: list[int], error: BaseException) -> NoReturn:
        here = f"{name}, point {', '.join(map(str, points))}"
        self._tell(scene=name, found=f"{here}: afterwards {error!r}", trace=traceback.format_exc())
        raise Broken(here) from error

    def _settle(self, scene: Scene, world: World) -> None:
        scene.after(world)
        world.works()
        world.empty()

    def _again(self, scene: SystemScene, system: rr.System, before: set[threading.Thread]) -> None:
        system.stop(5.0)
        with scene.system(self._directory / "system", start=False) as again:
            assert again.open_registrar("app").queries() == []
        eventually(lambda: not set(threading.enumerate()) - before, 5.0, "no thread is left")


@dataclass(frozen=True)
class SystemScene:
    """The start or the stop of a system."""

    name: str
    what: str
    root: list[Any]

    def system(self, directory: Path, *, start: bool | None = None) -> rr.System:
        """One that is ready for that."""
        system = rr.System(self.root, state_dir=directory)
        if (self.what == "stop") if start is None else start:
            system.start()
            system.open_registrar("app")
        return system


def system_scenes() -> Iterator[SystemScene]:
    """Those there are."""
    kinds = {
        "nothing": [],
        "a thread": [rr.ChildSpec(Echo, id="near", placement="thread")],
        "a process": [rr.ChildSpec(Stock, id="stock")],
    }
    for kind, root in kinds.items():
        for what in ("start", "stop"):
            yield SystemScene(f"{what} a system of {kind}", what, root)


def _child(options: argparse.Namespace) -> int:
    raising, handler = HANDLERS[options.raising]
    signal.signal(signal.SIGINT, handler)
    out = sys.stdout

    def tell(**facts: Any) -> None:
        print(json.dumps(facts), file=out, flush=True)

    if options.plant:
        PLANTS[options.plant]()
    names = options.only
    first = names.index(options.begin_scene) if options.begin_scene else 0
    names = names[first:]
    with tempfile.TemporaryDirectory() as directory:
        skip = (options.begin_scene, options.begin)
        run = Run(options.most, options.seed, raising, options.together, tell, Path(directory), skip)
        try:
            run.scenes([scene for scene in scenes() if scene.name in names])
            run.systems([scene for scene in system_scenes() if scene.name in names])
        except Broken:
            os._exit(3)  # what is left of it may hang
    return 0


# -- defects that it must find ---------------------------------------------------------------------------------------


def _flag_before_the_act() -> None:
    waiting: dict[Dispatcher, deque[Callable[[], object]]] = {}
    planned: set[Dispatcher] = set()

    def planted_call(self: Dispatcher, fn: Callable[..., object], *args: Any) -> None:
        waiting.setdefault(self, deque()).append(functools.partial(fn, *args))
        if self in planned:
            return
        planned.add(self)
        if self.is_loop_thread():
            self.loop.call_soon(drain, self)
        else:
            self.loop.call_soon_threadsafe(drain, self)

    def drain(self: Dispatcher) -> None:
        planned.discard(self)
        while calls := waiting[self]:
            calls.popleft()()

    planted: Any = Dispatcher
    planted.call = planted.hand_over = planted_call


PLANTS: dict[str, Callable[[], None]] = {"flag before the act": _flag_before_the_act}


# -- the command -----------------------------------------------------------------------------------------------------


@dataclass
class Result:
    """What came of a scene: how many points it has, how many were tried, how many raised, and what was found."""

    points: int = 0
    tried: int = 0
    raised: int = 0
    found: list[str] = field(default_factory=list)


def _every() -> list[str]:
    return [*(scene.name for scene in scenes()), *(scene.name for scene in system_scenes())]


def run_all(
    names: list[str],
    most: int,
    seed: int,
    plant: str = "",
    verbose: bool = False,
    *,
    raising: str = "KeyboardInterrupt",
    together: int = 1,
) -> dict[str, Result]:
    """Try the scenes in processes of their own, one after another: another when one is wedged."""
    names = sorted(names, key=_every().index)  # as they are tried: to go on behind the one that failed
    results: dict[str, Result] = {}
    scene, place, some, command = "", 0, [0], [sys.executable, str(Path(__file__)), "--child"]
    while True:
        options = ["--most", str(most), "--seed", str(seed), "--plant", plant, "--raising", raising]
        options += ["--together", str(together), "--only", *names]
        where = ["--begin-scene", scene, "--begin", str(place)]
        with tempfile.TemporaryFile("w+") as errors:
            with subprocess.Popen([*command, *where, *options], stdout=subprocess.PIPE, stderr=errors) as child:
                assert child.stdout is not None
                for line in child.stdout:
                    facts = json.loads(line)
                    result = results.setdefault(facts["scene"], Result())
                    scene = facts["scene"]
                    place, some = facts.get("place", place), facts.get("some", some)
                    result.points = facts.get("points", result.points)
                    result.tried += "raised" in facts
                    result.raised += facts.get("raised", False)
                    if "found" in facts:
                        result.found.append(facts["found"])
                        print(facts["found"], facts.get("trace", "") if verbose else "", flush=True)
            if child.returncode == 0:
                return results
            errors.seek(0)
            trace = errors.read()
        if child.returncode != 3:
            if scene == "" or scene not in results:
                raise RuntimeError(f"it ended with {child.returncode}: {trace}")
            found = f"{scene}, point {', '.join(map(str, some))}: wedged"
            results[scene].found.append(found)
            print(found, trace[-6000:] if verbose else "", flush=True)
        place += len(some)


def main() -> int:
    """Run it."""
    every = _every()
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--most", type=int, default=0, help="points tried of each scene; 0: each once")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--raising", choices=HANDLERS, default="KeyboardInterrupt", help="what the handler raises")
    parser.add_argument("--together", type=int, default=1, help="calls interrupted before the system is looked at")
    parser.add_argument("--only", nargs="+", default=every, help="names of scenes")
    parser.add_argument("--plant", default="", help=f"a defect to find: {', '.join(PLANTS)}")
    parser.add_argument("--list", action="store_true", help="say which scenes there are")
    parser.add_argument("--verbose", action="store_true", help="show traces")
    parser.add_argument("--child", action="store_true", help=argparse.SUPPRESS)
    parser.add_argument("--begin-scene", default="", help=argparse.SUPPRESS)
    parser.add_argument("--begin", type=int, default=0, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.child:
        return _child(options)
    if options.list:
        print("\n".join(every))
        return 0
    began = time.monotonic()
    results = run_all(
        options.only,
        options.most,
        options.seed,
        options.plant,
        options.verbose,
        raising=options.raising,
        together=options.together,
    )
    for name, result in results.items():
        print(f"{name:50} {result.points:6} points {result.tried:7} tried {result.raised:7} raised {len(result.found)}")
    tried = sum(result.tried for result in results.values())
    found = sum(len(result.found) for result in results.values())
    print(f"{tried} interrupts in {time.monotonic() - began:.0f} s, {found} findings")
    return 1 if found else 0


if __name__ == "__main__":
    sys.exit(main())
