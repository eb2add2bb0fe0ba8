"""Serial managers, and servers with `at_once`: so many callbacks run at a time, and one that waits lets another in."""

from __future__ import annotations

import asyncio
import faulthandler
import random
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal

import pytest

import rr_actors as rr
from rr_actors.managers import Actions, Budgets, Choices, Components, Keeper, Pipes, Programs, Robots
from rr_actors.runtime.workers import Gate
from support import eventually, kill, wait_respawned

Start = Callable[..., rr.System]
LIMIT_S = 30.0
Placement = Literal["process", "thread"]
PLACEMENTS: tuple[Placement, ...] = ("process", "thread")


class Inside:
    """Counts how many are inside at once, and takes its time for it."""

    def __init__(self) -> None:
        self.now = self.most = self.count = 0

    def __enter__(self) -> None:
        before = self.count
        self.now += 1
        self.most = max(self.most, self.now)
        time.sleep(0.0005)
        self.count = before + 1

    def __exit__(self, *_error: object) -> None:
        self.now -= 1

    async def in_task(self) -> None:
        before = self.count
        self.now += 1
        self.most = max(self.most, self.now)
        await asyncio.sleep(0.0005)
        self.count = before + 1
        self.now -= 1


class Lines(rr.Manager, serial=True):
    """Counts in a way that only one at a time can use."""

    def __init__(self) -> None:
        self.inside = Inside()

    @rr.server("line")
    def load(self, port: int) -> int:
        with self.inside:
            if port < 0:
                raise ValueError("no such port")
            return port

    @load.unload
    def close(self, port: int, response: int) -> None:
        with self.inside:
            pass

    @load.usage
    def used(self, port: int, response: int) -> dict[str, float]:
        with self.inside:
            return {"lines": 1}

    @load.status
    def heard(self, port: int, status: rr.Status) -> None:
        with self.inside:
            pass

    @rr.server("awaited")
    async def load_awaited(self, port: int) -> int:
        await self.inside.in_task()
        return port

    def on_receive(self, message: Any) -> tuple[int, int]:
        with self.inside:
            pass
        return self.inside.count, self.inside.most

    def of_class(self) -> bool:
        return self.serial


@pytest.mark.parametrize("placement", PLACEMENTS)
def test_of_all_callbacks_and_messages_one_is_inside_at_a_time(start: Start, placement: Placement) -> None:
    system = start(rr.ChildSpec(Lines, id="lines", placement=placement))
    app, lines = system.open_registrar("app"), system.ref("lines")
    wanted: list[tuple[str, int]] = [
        (name, number) for number in range(100) for name in ("lines/line", "lines/awaited")
    ]
    asked = [lines.ask("how many?", block=False) for _ in range(20)]
    with app.load_all(wanted, timeout_s=LIMIT_S):
        asked += [lines.ask("how many?", block=False) for _ in range(20)]
        system.registrar("lines").usage()
    for reply in asked:
        reply.get(timeout=LIMIT_S)
    count, most = lines.ask("how many?", timeout=LIMIT_S)
    assert most == 1
    assert count == 200 + 100 + 100 + 40 + 1  # loads, unloads, usages, messages


class Open(rr.Manager, serial=True):
    """Counts what it has open, as any actor counts."""

    def __init__(self) -> None:
        self.open = 0

    def _add(self, change: int) -> None:
        before = self.open
        time.sleep(0.001)  # a read of a device, say
        self.open = before + change

    @rr.server("line")
    def load(self, port: int) -> int:
        self._add(1)
        return port

    @load.unload
    def close(self, port: int, response: int) -> None:
        self._add(-1)

    def on_receive(self, message: Any) -> int:
        return self.open


@pytest.mark.parametrize("placement", PLACEMENTS)
def test_a_serial_manager_counts_what_it_has_open(start: Start, placement: Placement) -> None:
    system = start(rr.ChildSpec(Open, id="lines", placement=placement))
    app, lines = system.open_registrar("app"), system.ref("lines")
    app.load_all([("lines/line", port) for port in range(200)], timeout_s=LIMIT_S)
    assert lines.ask("how many?", timeout=LIMIT_S) == 200
    app.unload_all(timeout_s=LIMIT_S)
    assert lines.ask("how many?", timeout=LIMIT_S) == 0


@pytest.mark.parametrize("placement", PLACEMENTS)
def test_a_callback_that_raises_makes_room_for_the_next(start: Start, placement: Placement) -> None:
    app = start(rr.ChildSpec(Lines, id="lines", placement=placement)).open_registrar("app")
    for _ in range(3):
        with pytest.raises(rr.LoadFailed, match="no such port"):
            app.load("lines/line", -1, timeout_s=LIMIT_S)
    assert app.load("lines/line", 1, timeout_s=LIMIT_S).response == 1


class Left(rr.Manager, serial=True):
    other = "right"

    @rr.server("part")
    def load(self, depth: int) -> int:
        return self.registrar.load(f"{self.other}/part", depth - 1, timeout_s=LIMIT_S).response + 1 if depth else 0

    @rr.server("awaited")
    async def load_awaited(self, depth: int) -> int:
        if not depth:
            return 0
        return (await self.registrar.load_async(f"{self.other}/awaited", depth - 1, timeout_s=LIMIT_S)).response + 1

    @rr.server("asked")
    def load_asked(self, depth: int) -> int:
        if not depth:
            return 0
        return self.ref(self.other).ask(depth - 1, timeout=LIMIT_S) + 1

    def on_receive(self, message: int) -> int:
        return self.registrar.load(f"{self.other}/asked", message, timeout_s=LIMIT_S).response


class Right(Left):
    other = "left"


@pytest.mark.parametrize("placement", PLACEMENTS)
@pytest.mark.parametrize(("server", "depth"), [("part", 6), ("awaited", 6), ("asked", 1)])
def test_serial_managers_that_wait_for_each_other_in_a_ring_go_on(
    start: Start, placement: Placement, server: str, depth: int
) -> None:
    specs = [rr.ChildSpec(kind, id=id, placement=placement) for kind, id in ((Left, "left"), (Right, "right"))]
    app = start(*specs).open_registrar("app")
    loads = [app.load(f"{id}/{server}", depth, timeout_s=LIMIT_S, block=False) for id in ("left", "right")]
    assert [load.get(timeout=2 * LIMIT_S).response for load in loads] == [depth, depth]
    app.unload_all(timeout_s=LIMIT_S)


class Shop(rr.Manager, serial=True):
    """Waits for a part of a slow manager while others pass by, and goes on alone."""

    def __init__(self) -> None:
        self.inside = 0
        self.alone = True
        self.passed = 0

    @rr.server("order")
    def order(self, what: str) -> int:
        before = self.passed
        self.registrar.load("slow/part", what, timeout_s=LIMIT_S)
        self.inside += 1
        time.sleep(0.002)
        self.alone = self.alone and self.inside == 1
        self.inside -= 1
        return self.passed - before

    def on_receive(self, message: str) -> bool:
        self.passed += 1
        return self.alone


class Slow(rr.Manager):
    def __init__(self) -> None:
        self.go = threading.Event()

    @rr.server("part")
    def part(self, what: str) -> str:
        self.go.wait(LIMIT_S)
        return what

    def on_receive(self, message: str) -> int:
        if message == "go":
            self.go.set()
        return len(self.registrar.resources())


def test_while_one_waits_for_a_load_others_pass_and_it_goes_on_alone(start: Start) -> None:
    system = start(rr.ChildSpec(Slow, id="slow"), rr.ChildSpec(Shop, id="shop"))
    app, shop, slow = system.open_registrar("app"), system.ref("shop"), system.ref("slow")
    orders = [app.load("shop/order", f"part {number}", timeout_s=LIMIT_S, block=False) for number in range(20)]
    assert eventually(lambda: slow.ask("how many?") == 20)
    for _ in range(5):
        shop.ask("passing by", timeout=LIMIT_S)
    slow.tell("go")
    assert [order.get(timeout=LIMIT_S).response for order in orders] == [5] * 20
    assert shop.ask("was each alone?", timeout=LIMIT_S)


class Printers(rr.Manager):
    """Two of three servers have a driver that few may use at a time."""

    def __init__(self) -> None:
        self.two, self.one, self.free = Inside(), Inside(), Inside()
        self.together = threading.Barrier(8)

    @rr.server("two", at_once=2)
    def load_two(self, page: int) -> int:
        with self.two:
            return page

    @rr.server("one", at_once=1)
    def load_one(self, page: int) -> int:
        with self.one:
            return page

    @rr.server("free")
    def load_free(self, page: int) -> int:
        self.together.wait(LIMIT_S)
        return page

    def on_receive(self, message: Any) -> tuple[int, int]:
        return self.one.most, self.two.most


def test_a_server_runs_as_many_callbacks_at_once_as_it_says(start: Start) -> None:
    system = start(rr.ChildSpec(Printers, id="printers"))
    app = system.open_registrar("app")
    wanted = [(f"printers/{name}", page) for page in range(60) for name in ("one", "two")]
    wanted += [("printers/free", page) for page in range(8)]
    app.load_all(wanted, timeout_s=LIMIT_S)
    one, two = system.ref("printers").ask("most?")
    assert one == 1
    assert two <= 2


def test_the_time_limit_of_a_callback_begins_when_it_has_room(start: Start) -> None:
    system = start()
    app = system.open_registrar("app")

    def load(page: int) -> int:
        time.sleep(0.5)  # the time is what is limited: six take longer than one may
        return page

    app.register_server("printer", load, load_timeout_s=2.0, at_once=1)
    queries = app.load_all([("app/printer", page) for page in range(6)], timeout_s=LIMIT_S)
    assert [query.response for query in queries] == list(range(6))


def test_a_load_that_waits_for_room_can_be_withdrawn(start: Start) -> None:
    app = start().open_registrar("app")
    go, begun = threading.Event(), list[str]()

    def load(name: str) -> str:
        begun.append(name)
        go.wait(LIMIT_S)
        return name

    app.register_server("printer", load, at_once=1)
    first = app.load("app/printer", "first", block=False)
    assert eventually(lambda: begun == ["first"])
    with pytest.raises(rr.LoadTimeout):
        app.load("app/printer", "second", timeout_s=0.2)
    go.set()
    assert first.get(timeout=LIMIT_S).response == "first"
    assert app.load("app/printer", "third", timeout_s=LIMIT_S).response == "third"


def test_a_load_that_is_cancelled_in_an_async_callback_makes_room(start: Start) -> None:
    app = start().open_registrar("app")
    never, begun = asyncio.Event(), list[str]()

    async def load(name: str) -> str:
        begun.append(name)
        if name == "first":
            await never.wait()
        return name

    app.register_server("printer", load, at_once=1)
    with pytest.raises(rr.LoadTimeout):
        app.load("app/printer", "first", timeout_s=0.3)
    assert app.load("app/printer", "second", timeout_s=LIMIT_S).response == "second"
    assert begun == ["first", "second"]


class Hears(rr.Manager, serial=True):
    """What it holds tells it statuses, and each is heard alone."""

    def __init__(self) -> None:
        self.inside = Inside()

    def on_start(self) -> None:
        for number in range(10):
            self.registrar.load("slow/part", f"part {number}", on_status=self.heard, timeout_s=LIMIT_S)

    def heard(self, status: rr.Status) -> None:
        with self.inside:
            pass

    def on_receive(self, message: Any) -> tuple[int, int]:
        return self.inside.count, self.inside.most


def test_statuses_of_what_a_serial_manager_holds_are_heard_one_at_a_time(start: Start) -> None:
    system = start(rr.ChildSpec(Slow, id="slow"))
    system.ref("slow").tell("go")
    system.start_child(rr.ChildSpec(Hears, id="hears"))
    parts = system.registrar("slow")
    for info in parts.resources():
        parts.send_status(info, rr.Status(rr.State.WARNING, "hot"))
    hears = system.ref("hears")
    assert eventually(lambda: hears.ask("how many?", timeout=LIMIT_S) == (10, 1))


class Devices(rr.Manager, serial=True):
    """Its recover callbacks use one bus."""

    def __init__(self, directory: str) -> None:
        self.directory = Path(directory)

    @rr.server("device")
    def load(self, name: str) -> str:
        return name

    @load.recover
    def found(self, name: str, response: str) -> str:
        (self.directory / "bus").mkdir()  # raises if another one uses it
        time.sleep(0.01)
        (self.directory / "bus").rmdir()
        return response


def test_after_a_crash_the_resources_are_recovered_one_at_a_time(start: Start, tmp_path: Path) -> None:
    system = start(rr.ChildSpec(Devices, id="devices", args=(str(tmp_path),)))
    app = system.open_registrar("app")
    queries = app.load_all([("devices/device", f"device {number}") for number in range(20)])
    wait_respawned(system, "devices", kill(system, "devices"))
    devices = system.registrar("devices")
    assert eventually(lambda: [info.phase for info in devices.resources()] == ["loaded"] * 20)
    assert {query.state for query in queries} == {rr.State.OK}


def test_a_class_is_serial_as_its_base_class_is_unless_it_says_otherwise() -> None:
    class Inherits(Lines):
        pass

    class Parallel(Lines, serial=False):
        pass

    assert (Lines.serial, Inherits.serial, Parallel.serial, rr.Manager.serial) == (True, True, False, False)


@pytest.mark.parametrize("wrong", [1, "yes", None.__class__])
def test_serial_is_true_or_false(wrong: Any) -> None:
    with pytest.raises(rr.UsageError, match="serial: expected True or False, got"):
        type("Cameras", (rr.Manager,), {}, serial=wrong)


@pytest.mark.parametrize("kind", [Actions, Budgets, Choices, Components, Keeper, Pipes, Programs, Robots])
def test_a_ready_made_manager_is_not_serial(kind: type[rr.Manager]) -> None:
    with pytest.raises(rr.UsageError, match=r"class One: serial: expected False, as it is a .*: a ready-made manager"):
        type("One", (kind,), {}, serial=True)
    with pytest.raises(rr.UsageError, match="class Two: serial: expected False"):
        type("Two", (Lines, kind), {})


@pytest.mark.parametrize("wrong", [0, -1, True, 1.0, "1"])
def test_at_once_is_a_whole_number_of_at_least_one(start: Start, wrong: Any) -> None:
    with pytest.raises(rr.InvalidSpec, match="at_once: expected a whole number of at least 1, or None"):
        rr.server("printer", at_once=wrong)
    with pytest.raises(rr.InvalidSpec, match="at_once: expected a whole number of at least 1, or None"):
        start().open_registrar("app").register_server("printer", lambda page: page, at_once=wrong)


# -- rings, and many of everything -------------------------------------------------------------------------------------


class Ring(rr.Manager, serial=True):
    """Loads of the next manager in a ring what that loads of its next one: another thing at each step."""

    def __init__(self, following: str) -> None:
        self.following, self.inside, self.most = following, 0, 0

    @rr.server("thing")
    def load(self, steps: int) -> list[str]:
        self._pass()
        rest = self.registrar.load(f"{self.following}/thing", steps - 1, timeout_s=LIMIT_S).response if steps else []
        self._pass()
        return [self.registrar.name, *rest]

    def _pass(self) -> None:
        self.inside += 1
        self.most = max(self.most, self.inside)
        time.sleep(0)
        self.inside -= 1

    def on_receive(self, message: str) -> int:
        self._pass()
        return self.most


@pytest.mark.parametrize("placement", PLACEMENTS)
def test_three_serial_managers_that_load_from_each_other_in_a_ring_go_on(start: Start, placement: Placement) -> None:
    ring = {"a": "b", "b": "c", "c": "a"}
    specs = [rr.ChildSpec(Ring, id=id, args=(following,), placement=placement) for id, following in ring.items()]
    system = start(*specs)
    app = system.open_registrar("app")
    loads = [app.load(f"{id}/thing", 7, timeout_s=LIMIT_S, block=False) for id in ring]
    assert ["".join(load.get(timeout=2 * LIMIT_S).response) for load in loads] == ["abcabcab", "bcabcabc", "cabcabca"]
    app.unload_all(timeout_s=LIMIT_S)
    assert [system.ref(id).ask("how many?", timeout=LIMIT_S) for id in ring] == [1, 1, 1]


class Simulated:
    """Serial managers in a ring, with the real gates and threads that are made up: chance says which goes on.

    A load at a manager enters its gate. If it has steps left, it goes out, loads from the next manager, and comes back.

    Args:
        lets_in: whether a callback that waits lets another in.
    """

    def __init__(self, seed: int, *, lets_in: bool = True) -> None:
        self.chance, self.lets_in = random.Random(seed), lets_in
        self.gates = [Gate(1) for _ in range(self.chance.randint(2, 4))]
        self.inside = [0] * len(self.gates)
        self.ready: list[Callable[[], None]] = []
        self.left = 0
        for _ in range(self.chance.randint(2, 6)):
            self._load(self.chance.randrange(len(self.gates)), self.chance.randint(0, 5), lambda: None)

    def run(self) -> bool:
        """Go on until nothing can; return whether all loads have ended."""
        while self.ready:
            self.ready.pop(self.chance.randrange(len(self.ready)))()
        return not self.left

    def _load(self, manager: int, steps: int, then: Callable[[], None]) -> None:
        self.left += 1
        gate = self.gates[manager]

        def ended() -> None:
            self._go(manager, -1)
            self.left -= 1
            self.ready.append(then)
            gate.leave()

        def come_back() -> None:
            self._enter(gate.come_back, manager, ended) if self.lets_in else ended()

        def began() -> None:
            if not steps:
                ended()
                return
            if self.lets_in:
                self._go(manager, -1)
            self.ready.append(lambda: self._load((manager + 1) % len(self.gates), steps - 1, come_back))
            if self.lets_in:
                gate.leave()

        if self.chance.random() < 0.1:  # withdrawn while it waited: it does not begin
            self.ready.append(lambda: gate.enter(lambda: False))
        self.ready.append(lambda: self._enter(gate.enter, manager, began))

    def _enter(self, enter: Callable[[Callable[[], bool]], None], manager: int, then: Callable[[], None]) -> None:
        def begin() -> bool:
            self._go(manager, 1)
            self.ready.append(then)
            return True

        enter(begin)

    def _go(self, manager: int, step: int) -> None:
        self.inside[manager] += step
        assert 0 <= self.inside[manager] <= 1


def test_rings_of_serial_managers_end_in_whatever_order_their_threads_go_on() -> None:
    assert all(Simulated(seed).run() for seed in range(1000))
    assert not all(Simulated(seed, lets_in=False).run() for seed in range(50))  # else the simulation would find nothing


class Counter(rr.Manager, serial=True):
    """Counts all that comes in, in a way that only one at a time can use."""

    def __init__(self) -> None:
        self.inside = self.most = 0
        self.counts: dict[str, int] = {}

    def _count(self, what: str) -> None:
        self.inside += 1
        self.most = max(self.most, self.inside)
        before = self.counts.get(what, 0)
        if before % 16 == 0:
            time.sleep(0)  # another thread may go on here
        self.counts[what] = before + 1
        self.inside -= 1

    @rr.server("thing")
    def load(self, number: int) -> int:
        self._count("load")
        return number

    @load.unload
    def unload(self, number: int, response: int) -> None:
        self._count("unload")

    @rr.server("awaited")
    async def load_awaited(self, number: int) -> int:
        self._count("awaited")
        return number

    def on_receive(self, message: Any) -> Any:
        match message:
            case "how many?":
                return self.counts, self.most
            case ("timers", int(count)):
                for number in range(count):
                    rr.send_after(0.0005 * (number % 100), self.actor_ref, "timer")
            case _:
                self._count(message)
        return None


@pytest.mark.parametrize("placement", PLACEMENTS)
@pytest.mark.parametrize("count", [100, pytest.param(100_000, marks=(pytest.mark.slow, pytest.mark.timeout(3_000)))])
def test_of_many_loads_unloads_messages_and_timers_one_is_inside_at_a_time(
    start: Start, count: int, placement: Placement
) -> None:
    faulthandler.cancel_dump_traceback_later()  # pytest's, which is for shorter tests: it may crash a busy process
    system = start(rr.ChildSpec(Counter, id="counter", placement=placement))
    app, counter = system.open_registrar("app"), system.ref("counter")
    limit_s = 20 * LIMIT_S
    done = 0
    while done < count:
        some = range(done, min(done + 250, count))
        counter.tell(("timers", len(some)))  # in portions: all at once would be more than the mailbox takes
        for _ in some:
            counter.tell("message")
        with app.load_all(
            [(f"counter/{it}", number) for number in some for it in ("thing", "awaited")], timeout_s=limit_s
        ):
            done += len(some)
    expected = dict.fromkeys(("load", "unload", "awaited", "message", "timer"), count)
    assert eventually(lambda: counter.ask("how many?", timeout=limit_s)[0] == expected, limit_s)
    assert counter.ask("how many?", timeout=limit_s) == (expected, 1)
