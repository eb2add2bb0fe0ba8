"""What a warm load may cost, counted and not timed: the same on every machine, so that a slow one proves nothing."""

from __future__ import annotations

import gc
import itertools
import statistics
import sys
import tracemalloc
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from types import FrameType
from typing import Any, TypeVar

import pytest

import rr_actors as rr
from benchmarks.stages import (
    FramingLink,
    actor_of,
    answered_at_once,
    both_here,
    decided_alone,
    framing_only,
    warm_loads,
)
from benchmarks.workload import SERVER, Ask
from rr_actors.base.folder import Folder
from rr_actors.base.values.canonical import encode
from rr_actors.registrar.engine.effect_runner import EffectRunner
from rr_actors.registrar.engine.registrar_actor import RegistrarActor
from rr_actors.registrar.model.messages import Load
from rr_actors.registrar.model.rows import Held, Hold, Put, State
from rr_actors.runtime import thread_rules
from rr_actors.storage.journaled_store import End, Segment
from rr_actors.storage.sql_tables import Meta
from rr_actors.wire.transport import Hello
from support import Calls

LOADS = 100
T = TypeVar("T")


@pytest.fixture
def registrars() -> Iterator[tuple[rr.Registrar, rr.Registrar]]:
    with both_here() as both:
        yield both


def on_loop(actor: RegistrarActor, work: Callable[[], T]) -> T:
    async def run() -> T:
        return work()

    return actor.node.dispatcher.run(run(), timeout_s=30.0)


def is_check(frame: FrameType) -> bool:
    """Whether a call is of the checks of thread_rules.py, which only the tests make."""
    caller = frame.f_back
    return frame.f_code.co_filename == thread_rules.__file__ or (
        caller is not None
        and caller.f_code.co_filename == thread_rules.__file__
        and caller.f_code.co_name != "checked"  # this one calls what it has checked
    )


def calls_of(work: Callable[[], object], *, c_calls: bool = False) -> int:
    """How many calls of Python functions `work` makes in this thread; with `c_calls`, of those in C, too.

    Meanwhile no garbage is collected: what earlier tests have left could call finalizers here.
    """
    calls = 0
    counted = ("call", "c_call") if c_calls else ("call",)

    def count(frame: FrameType, event: str, _argument: Any) -> None:
        nonlocal calls
        calls += event in counted and not is_check(frame)

    gc.disable()
    sys.setprofile(count)
    try:
        work()
    finally:
        sys.setprofile(None)
        gc.enable()
    return calls - 1  # work itself


def test_the_caller_of_a_warm_load_makes_few_calls(registrars: tuple[rr.Registrar, rr.Registrar]) -> None:
    _, consumer = registrars
    # Not in the main thread: that looks at the handlers of all signals every 50 ms, which a slow machine does often.
    with answered_at_once(consumer), ThreadPoolExecutor(1) as thread:
        thread.submit(consumer.load, SERVER, Ask(0)).result()
        calls = thread.submit(calls_of, lambda: [consumer.load(SERVER, Ask(0)) for _ in range(LOADS)]).result()
    assert calls / LOADS <= CALLER


def test_the_provider_of_a_warm_load_makes_few_calls(registrars: tuple[rr.Registrar, rr.Registrar]) -> None:
    """On a direct line: it joins what is held, at once."""
    actor, consumer = actor_of(registrars[0]), actor_of(registrars[1])
    loads = list(itertools.islice(warm_loads(), LOADS))
    line = AnsweredLine(consumer)

    def handle() -> None:
        for load in loads:
            actor.consumers.received_directly(line, load)

    calls = on_loop(actor, lambda: calls_of(handle))
    assert line.flushed == LOADS
    assert calls / LOADS <= PROVIDER


class AnsweredLine(FramingLink):
    """A direct line that threads answer."""

    def __init__(self, consumer: RegistrarActor) -> None:
        super().__init__()
        self.hello = Hello("direct", "provider", consumer.name, consumer.epoch)
        self.answers = Calls()

    def open_outlet(self) -> None:
        pass

    def answering(self, message: Any) -> Callable[[], None]:
        return lambda: self.answers(message)

    def send_now(self, message: Any) -> None:  # the loop's answer
        super().send_now(message)
        self.answers(message)


def test_the_loop_of_a_first_load_makes_few_calls(registrars: tuple[rr.Registrar, rr.Registrar]) -> None:
    """On a direct line: it decides, commits and wakes a thread, which does the rest."""
    actor, consumer = actor_of(registrars[0]), actor_of(registrars[1])
    line = AnsweredLine(consumer)
    calls: list[int] = []
    for number in range(1, LOADS + 1):
        load = Load(f"{number:032x}", "echo", encode(Ask(number)), consumer.name, "", 0, 1)

        def handle(load: Load = load) -> None:
            actor.consumers.received_directly(line, load)

        calls.append(on_loop(actor, lambda handle=handle: calls_of(handle)))
        line.answers.wait(number)
    assert statistics.median(calls) <= FIRST
    assert line.flushed < LOADS / 2  # the loop answers those that come while it acts on others


def test_the_provider_of_a_warm_load_by_its_link_makes_few_calls(registrars: tuple[rr.Registrar, rr.Registrar]) -> None:
    actor = actor_of(registrars[0])
    runner = EffectRunner(actor, actor.consumers, actor.servers, actor.clients)
    loads = list(itertools.islice(warm_loads(), LOADS))

    def handle() -> None:
        for load in loads:
            decision = decided_alone(actor, load)
            with actor.lock:
                actor.commits.commit(decision)
            decision.close()
            runner.do(decision.effects)

    def counted() -> int:
        with framing_only(actor):
            return calls_of(handle)

    assert on_loop(actor, counted) / LOADS <= BY_LINK


@pytest.fixture
def committed(registrars: tuple[rr.Registrar, rr.Registrar], monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """How many changes each commit of the provider has, from now on."""
    actor = actor_of(registrars[0])
    sizes: list[int] = []
    commit = actor.commits.store.commit

    def counted(changes: Any) -> None:
        sizes.append(len(changes))
        commit(changes)

    async def begin() -> None:
        for noted in range(5):  # what the fixture has begun comes to an end
            await actor.next_change(0.01 * noted)
        monkeypatch.setattr(actor.commits.store, "commit", counted)

    actor.node.dispatcher.run(begin(), timeout_s=30.0)
    return sizes


def arrive(actor: RegistrarActor, loads: int) -> int:
    """Have that many loads arrive together; returns in how many writes they were answered."""

    async def run() -> int:
        with framing_only(actor) as link:
            for number, load in enumerate(itertools.islice(warm_loads(), loads)):
                actor.receive(load, load.origin, more=number < loads - 1)
            while actor.waiting:
                await actor.next_change(1.0)
            return link.flushed

    return actor.node.dispatcher.run(run(), timeout_s=30.0)


def test_the_loads_of_one_read_are_committed_and_answered_together(
    registrars: tuple[rr.Registrar, rr.Registrar], committed: list[int]
) -> None:
    flushed = arrive(actor_of(registrars[0]), LOADS)
    assert sum(committed) == LOADS
    assert len(committed) == 1
    assert flushed == 1


def test_of_very_many_the_first_do_not_wait_for_the_last(
    registrars: tuple[rr.Registrar, rr.Registrar], committed: list[int]
) -> None:
    flushed = arrive(actor_of(registrars[0]), 10 * LOADS)
    assert sum(committed) == 10 * LOADS
    assert 5 <= len(committed) <= 10
    assert flushed == len(committed)


def test_a_held_query_takes_less_than_a_kilobyte_of_its_provider(registrars: tuple[rr.Registrar, rr.Registrar]) -> None:
    actor = actor_of(registrars[0])
    source = warm_loads()
    many = 10 * LOADS

    def handle() -> None:
        for load in itertools.islice(source, many):
            decision = decided_alone(actor, load)
            with actor.lock:
                actor.commits.commit(decision)
            decision.close()

    def grown() -> int:
        handle()
        gc.collect()
        tracemalloc.start()
        try:
            handle()
            gc.collect()
            return tracemalloc.get_traced_memory()[0]
        finally:
            tracemalloc.stop()

    assert on_loop(actor, grown) / many <= 1_000


def test_a_load_that_does_not_wait_leaves_few_objects_to_the_garbage_collector(
    registrars: tuple[rr.Registrar, rr.Registrar],
) -> None:
    """They slow a thread with many loads in flight down most; its Query and the reply are among them."""
    _, consumer = registrars

    def loads(count: int) -> list[Any]:
        replies = [consumer.load(SERVER, Ask(0), block=False) for _ in range(count)]
        return [*replies, *(reply.get() for reply in replies)]

    kept = loads(LOADS)
    gc.collect()
    gc.disable()
    try:
        before = len(gc.get_objects())
        kept += loads(10 * LOADS)
        assert (len(gc.get_objects()) - before) / (10 * LOADS) <= LEFT
    finally:
        gc.enable()


def test_rows_that_might_have_too_large_a_number_are_looked_at_quickly(tmp_path: Path) -> None:
    """The length of bytes, and how they begin, look like one: many answers do, 207 bytes that are a map, say."""
    response = b"\x81" + bytes(0xCF - 1)
    rows = [Put(Held(str(n), "p", "s", b"", response, "r", "", 0, n, Hold.HELD, State.OK)) for n in range(LOADS)]
    folder = Folder.at(tmp_path)
    segment = Segment(folder, tmp_path / "catalog.db", Meta("0" * 16, 1, 0), 1, End())
    try:
        segment.append(rows[:1])
        calls = calls_of(lambda: segment.append(rows), c_calls=True)
    finally:
        segment.close()
        folder.close()
    assert calls / LOADS <= A_ROW


# Half as many again as they were when this was written: Python's versions differ a little, a new layer by much more.
CALLER = 33
PROVIDER = 38
BY_LINK = 42
FIRST = 94
LEFT = 11
A_ROW = 9
