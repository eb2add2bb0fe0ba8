"""Whether cost grows in step with the work: what each of a hundred, a thousand, ten thousand of something costs.

The exponent says how the whole cost grows from the second size to the third: 1 is in step, 2 is quadratic. With ten
times as many, 1.1 is 1.26 times as much for each. What a start costs, however few there are, hides in the first size.
"""

from __future__ import annotations

import itertools
import math
import resource
import subprocess
import sys
import tempfile
import time
import uuid
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Literal

import pykka

import rr_actors as rr
from benchmarks import placement as placement_of
from benchmarks.measure import time_each
from benchmarks.table import Row
from benchmarks.workload import PAYLOAD, Empty
from benchmarks.yardsticks import pipe_echo, thread_echo

Seconds = dict[str, float]
"""What each step took, by its name."""

_AIM = 1.1
_LIMIT_S = 600.0
_IN_TURN = 5
_SESSIONS = 1_000
"""Sessions in a second, one after another: open a registrar, load, unload, close."""


def in_step(scale: int, times: int) -> list[Row]:
    """Measure everything at three sizes: 10, 100 and 1,000 times `scale`, or less of what is dear.

    Args:
        times: how often each size is measured; the least counts.
    """
    few, some, many = (10 * scale, 100 * scale, 1_000 * scale)
    dear = (scale, 3 * scale, 10 * scale)
    registrars = (scale, 10 * scale, 100 * scale)
    managers = (scale, 10 * scale, 30 * scale)
    return [
        *_rows("children in threads", (few, some, many), times, lambda count: _children(count, "thread")),
        *_rows("children in processes", dear, times, lambda count: _children(count, "process")),
        *_rows("managers in threads", managers, times, _managers),
        *_rows("managers that are added as threads", managers, times, _added),
        *_rows("actors", (few, some, many), times, _actors),
        *_rows("registrars", registrars, times, _registrars),
        *_sessions(10 * scale, times),
        *_rows("registrars in a chain", managers, times, _on_one_core(_chain)),
        *_beside_one("thread", 10 * scale, times),
        *_beside_one("process", 4 * scale, times),
        *_rows("parts of a resource", (few, some, many), times, _on_one_core(_parts)),
        *_rows("connections", dear, times, _connections),
        *_rows("resources", (some, many, 3 * many), times, _inspected),
    ]


def _rows(what: str, sizes: Sequence[int], times: int, measure: Callable[[int], Seconds]) -> list[Row]:
    least: dict[str, list[float]] = {}
    for size in sizes:
        taken = [measure(size) for _ in range(times)]
        for step in taken[0]:
            least.setdefault(step, []).append(min(seconds[step] for seconds in taken))
    rows: list[Row] = []
    for step, seconds in least.items():
        rows += [
            Row(f"{step}, for each of {size:,} {what}", 1e3 * whole / size, "ms")
            for size, whole in zip(sizes, seconds, strict=True)
        ]
        exponent = math.log(seconds[2] / seconds[1]) / math.log(sizes[2] / sizes[1])
        rows.append(Row(f"growth of {step}, {sizes[1]:,} to {sizes[2]:,} {what}", exponent, "exponent", at_most=_AIM))
    return rows


def _on_one_core(measure: Callable[[int], Seconds]) -> Callable[[int], Seconds]:
    """Return `measure` on one core, as the threads of one process take turns, and to wake another core takes longer."""

    def measured(count: int) -> Seconds:
        with placement_of.here(placement_of.ONE_CORE):
            return measure(count)

    return measured


class _Clock:
    """Takes the time of one step after another; with another `clock`, the time of that, as this process's."""

    def __init__(self, clock: Callable[[], float] = time.perf_counter) -> None:
        self.taken: Seconds = {}
        self._clock = clock
        self._last = clock()

    def step(self, name: str) -> None:
        now = self._clock()
        self.taken[name], self._last = now - self._last, now


@contextmanager
def _system(*children: rr.ChildSpec) -> Iterator[tuple[rr.System, _Clock]]:
    with tempfile.TemporaryDirectory(prefix="rr-bench-") as state_dir:
        root = rr.Supervisor(children, max_restarts=1_000_000)
        clock = _Clock()
        system = rr.System(root, state_dir=state_dir, config=rr.SystemConfig(connections_limit=1_000))
        with system:
            yield system, clock


def _children(count: int, placement: Literal["process", "thread"]) -> Seconds:
    specs = [rr.ChildSpec(Empty, id=f"child{number}", placement=placement) for number in range(count)]
    with _system(*specs) as (_, clock):
        clock.step("start")
    clock.step("stop")
    return clock.taken


class _Shop(rr.Manager):
    @rr.server("thing")
    def load_thing(self, request: object) -> object:
        return request


def _managers(count: int) -> Seconds:
    specs = [rr.ChildSpec(_Shop, id=f"shop{number}", placement="thread") for number in range(count)]
    with _system(*specs) as (system, clock):
        clock.step("start")
        system.snapshot()
        clock.step("snapshot")
    return clock.taken


def _added(count: int) -> Seconds:
    with _system() as (system, clock):
        clock.step("")
        for number in range(count):
            system.start_child(rr.ChildSpec(_Shop, id=f"shop{number}", placement="thread"))
        clock.step("opening")
    del clock.taken[""]
    return clock.taken


def _sessions(count: int, times: int) -> list[Row]:
    """Sessions with a manager in a process, one after another, in one thread."""
    with _system(rr.ChildSpec(_Shop, id="shop")) as (system, _):
        taken = [time_each(lambda: _session(system), count) for _ in range(times)]
    a_second = count / min(map(sum, taken))
    return [Row("sessions of an application in a second", a_second, "a second", at_least=_SESSIONS)]


def _session(system: rr.System) -> None:
    registrar = system.open_registrar(f"session-{uuid.uuid4().hex}")
    registrar.load("shop/thing", 1).unload()
    registrar.close()


class _Link(rr.Manager):
    """Its callback loads from the next manager, the last one's from none."""

    def __init__(self, below: str) -> None:
        self._below = below

    @rr.server("link")
    def load_link(self, request: int) -> None:
        if self._below:
            self.registrar.load(self._below, request)


def _beside_one(placement: Literal["process", "thread"], count: int, times: int) -> list[Row]:
    """A load through so many managers that depend on one another, for each of them, beside a chain of one.

    Beside it, in turns, a bare message takes the same way, and managers that do not depend on one another are asked one
    after another. To wake what has not run for a while takes longer, whatever it does then.
    """
    echo, kind = (pipe_echo, "processes") if placement == "process" else (thread_echo, "threads")
    belows = [*(f"link{number}/link" for number in range(1, count)), ""]
    with (
        echo(PAYLOAD) as bare_one,
        echo(PAYLOAD, count) as bare_many,
        _loads([""], 1, placement) as one,
        _loads([""] * count, count, placement) as apart,
        _loads(belows, 1, placement) as chain,
    ):
        bare = (lambda: time_each(bare_one, 1)[0]), (lambda: time_each(bare_many, 1)[0])
        least = _least_in_turns((*bare, one, apart, chain), 4 * times)
    rows = [
        _each(f"a bare message through {count:,} {kind}", count, least[1], least[0]),
        _each(f"a load from {count:,} managers in {kind}, one after another", count, least[3], least[2]),
        _each(f"a load through {count:,} managers in {kind}", count, least[4], least[2]),
    ]
    loss, bare_loss = least[4] / count / least[2], least[1] / count / least[0]
    name = f"what a load through {count:,} {kind} takes, of one"
    return [*rows, Row(name, loss, "times", ratio=loss / bare_loss, against="a bare message", at_most=_AIM)]


def _least_in_turns(calls: Sequence[Callable[[], float]], rounds: int) -> list[float]:
    taken = [[call() for _ in range(_IN_TURN)] for _ in range(rounds) for call in calls]
    return [min(itertools.chain(*taken[number :: len(calls)])) for number in range(len(calls))]


def _each(name: str, count: int, many_s: float, one_s: float) -> Row:
    return Row(f"{name}, for each", 1e3 * many_s / count, "ms", ratio=many_s / count / one_s, against="one")


@contextmanager
def _loads(belows: Sequence[str], asked: int, placement: Literal["process", "thread"]) -> Iterator[Callable[[], float]]:
    """A call that loads from so many of these managers, one after another, and returns the seconds; then it unloads."""
    specs = [
        rr.ChildSpec(_Link, id=f"link{number}", args=(below,), placement=placement)
        for number, below in enumerate(belows)
    ]
    with _system(*specs) as (system, _):
        app = system.open_registrar("app")
        requests = itertools.count()

        def load() -> float:
            request, start = next(requests), time.perf_counter()
            queries = [app.load(f"link{number}/link", request, timeout_s=_LIMIT_S) for number in range(asked)]
            seconds = time.perf_counter() - start
            for query in queries:
                query.unload(timeout_s=_LIMIT_S)
            return seconds

        load()  # connects
        yield load


def _actors(count: int) -> Seconds:
    clock = _Clock()
    refs = [Empty.start() for _ in range(count)]
    clock.step("start")
    pykka.ActorRegistry.broadcast(None)
    for ref in refs:
        ref.ask(None)
    clock.step("broadcast, and an ask")
    pykka.ActorRegistry.stop_all()
    clock.step("stop_all")
    return clock.taken


def _registrars(count: int) -> Seconds:
    with _system() as (system, clock):
        clock.step("")
        registrars = [system.open_registrar(f"session{number}") for number in range(count)]
        clock.step("opening")
        for registrar in registrars:
            registrar.close()
        clock.step("closing")
    del clock.taken[""]
    return clock.taken


def _chain(count: int) -> Seconds:
    """Each registrar's callback loads from the next one."""
    with _system() as (system, _):
        registrars = [system.open_registrar(f"link{number}") for number in range(count)]

        def serve(number: int) -> None:
            def load(request: object) -> None:
                if number + 1 < count:
                    registrars[number].load(f"link{number + 1}/link", request)

            registrars[number].register_server("link", load, _nothing)

        for number in range(count):
            serve(number)
        clock = _Clock(time.process_time)
        query = system.open_registrar("consumer").load("link0/link", 1, timeout_s=_LIMIT_S)
        clock.step("load, processor time")
        query.unload(timeout_s=_LIMIT_S)
        clock.step("unload, processor time")
    return clock.taken


def _nothing(request: object, response: object) -> None:
    pass


def _parts(count: int) -> Seconds:
    with _system() as (system, _):
        makers = {name: system.open_registrar(name) for name in ("whole", "part")}

        def load(request: object) -> None:
            for number in range(count):
                makers["whole"].load("part/part", number)

        makers["whole"].register_server("whole", load, _nothing)
        makers["part"].register_server("part", lambda request: request, _nothing)
        clock = _Clock(time.process_time)
        query = system.open_registrar("consumer").load("whole/whole", 1, timeout_s=_LIMIT_S)
        clock.step("load, processor time")
        query.unload(timeout_s=_LIMIT_S)
        clock.step("unload, processor time")
    return clock.taken


def _connections(count: int) -> Seconds:
    with _system() as (system, _), ExitStack() as stack:
        provider = system.open_registrar("provider")
        provider.register_server("thing", lambda request: request, _nothing)
        clock = _Clock()
        for number in range(count):
            connection = stack.enter_context(rr.connect(system.state_dir))
            connection.open_registrar(f"worker{number}").load("provider/thing", "one for all")
        clock.step("connection and a load")
    return clock.taken


def _inspected(count: int) -> Seconds:
    """The processor time that `rr-actors inspect` and `tree` take more than a command that does nothing."""
    with _system() as (system, _):
        provider, consumer = system.open_registrar("provider"), system.open_registrar("consumer")
        provider.register_server("thing", lambda request: request, _nothing)
        consumer.load_all([("provider/thing", number) for number in range(count)])
        taken = {command: _worked(command, system.state_dir) for command in ("version", "inspect", "tree")}
    start = taken.pop("version")
    return {command: max(seconds - start, 0.001) for command, seconds in taken.items()}


def _worked(command: str, state_dir: Path) -> float:
    wanted = [command] if command == "version" else [command, "--state", str(state_dir)]
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    subprocess.run([sys.executable, "-m", "rr_actors", *wanted], check=True, stdout=subprocess.DEVNULL)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
