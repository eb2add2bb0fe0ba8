"""The process's loop: calls in order, nothing kills it, it is there while somebody holds it."""

from __future__ import annotations

import asyncio
import gc
import importlib.util
import logging
import os
import sys
import threading
import weakref
from collections.abc import Callable, Iterator

import pytest

from rr_actors.base.errors import Unavailable, UsageError
from rr_actors.runtime import event_loop as module
from rr_actors.runtime import interpreter
from rr_actors.runtime.event_loop import Dispatcher, acquire, current, release
from rr_actors.runtime.shielding import Flag
from support import Calls, Gate, eventually


@pytest.fixture
def dispatcher() -> Iterator[Dispatcher]:
    yield acquire()
    release()


def test_calls_run_on_the_loop_thread_in_the_order_they_were_made(dispatcher: Dispatcher) -> None:
    seen = Calls()
    for number in range(1000):
        dispatcher.call(lambda number=number: seen((number, threading.current_thread().name)))
    assert seen.wait(1000) == [(number, "rr-loop") for number in range(1000)]


def _see_each_in_order(put: Callable[[int], Callable[..., None]]) -> None:
    """Have four threads call put(number)(seen, name, number) 500 times; see that each thread's calls run in order."""
    seen = Calls()

    def work(name: int) -> None:
        for number in range(500):
            put(number)(seen, name, number)

    threads = [threading.Thread(target=work, args=(name,)) for name in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    calls = seen.wait(2000)
    for name in range(4):
        assert [number for who, number in calls if who == name] == list(range(500))


def test_calls_of_many_threads_all_run_each_threads_in_order(dispatcher: Dispatcher) -> None:
    _see_each_in_order(lambda _number: dispatcher.call)


def test_many_pending_calls_cost_one_wake_up_of_the_loop(dispatcher: Dispatcher) -> None:
    wake_ups: list[object] = []
    entered, go_on = threading.Event(), threading.Event()

    def hold() -> None:
        entered.set()
        go_on.wait(10)

    dispatcher.call(hold)
    entered.wait(10)
    dispatcher.loop = _Counting(dispatcher.loop, wake_ups)  # type: ignore[assignment]
    seen = Calls()
    for number in range(100):
        dispatcher.call(seen, number)
    go_on.set()
    assert seen.wait(100) == list(range(100))
    assert len(wake_ups) == 1


def test_what_is_handed_over_runs_in_order_with_what_is_called(dispatcher: Dispatcher) -> None:
    _see_each_in_order(lambda number: dispatcher.call if number % 3 else dispatcher.hand_over)


def test_a_loop_that_sleeps_wakes_for_what_is_handed_over(dispatcher: Dispatcher) -> None:
    for number in range(200):
        seen = Calls()
        dispatcher.hand_over(seen, number)
        assert seen.wait() == [number]


def test_what_the_loop_hands_over_to_itself_runs_after_what_hands_it_over(dispatcher: Dispatcher) -> None:
    seen = Calls()
    dispatcher.call(lambda: (dispatcher.hand_over(seen, "inner"), seen("outer")))
    assert seen.wait(2) == ["outer", "inner"]


def test_nothing_is_handed_over_to_a_loop_that_has_ended() -> None:
    dispatcher = Dispatcher()
    dispatcher.close()
    with pytest.raises(Unavailable):
        dispatcher.hand_over(print)


class _Counting:
    def __init__(self, loop: asyncio.AbstractEventLoop, wake_ups: list[object]) -> None:
        self._loop = loop
        self._wake_ups = wake_ups

    def call_soon_threadsafe(self, *args: object) -> None:
        self._wake_ups.append(args)
        self._loop.call_soon_threadsafe(*args)  # type: ignore[arg-type]

    def __getattr__(self, name: str) -> object:
        return getattr(self._loop, name)


def test_a_call_made_on_the_loop_runs_after_the_one_that_made_it(dispatcher: Dispatcher) -> None:
    seen = Calls()

    def outer() -> None:
        dispatcher.call(seen, "inner")
        seen("outer")

    dispatcher.call(outer)
    assert seen.wait(2) == ["outer", "inner"]


def test_an_exception_in_a_callback_is_logged_and_the_loop_goes_on(
    dispatcher: Dispatcher, caplog: pytest.LogCaptureFixture
) -> None:
    def fail() -> None:
        raise ValueError("a fault of the test")

    def leave() -> None:
        raise SystemExit(3)

    with caplog.at_level(logging.ERROR, "rr_actors"):
        dispatcher.call(fail)
        dispatcher.call(leave)
        seen = Calls()
        dispatcher.call(seen, "still there")
        assert seen.wait() == ["still there"]
    assert "a fault of the test" in caplog.text
    assert "SystemExit" in caplog.text


def test_an_exception_in_a_callback_of_the_loop_itself_is_logged(
    dispatcher: Dispatcher, caplog: pytest.LogCaptureFixture
) -> None:
    def fail() -> None:
        raise ValueError("scheduled with call_soon")

    with caplog.at_level(logging.ERROR, "rr_actors"):
        dispatcher.call(dispatcher.loop.call_soon, fail)
        eventually(lambda: "scheduled with call_soon" in caplog.text)


def test_run_returns_what_the_coroutine_returns_and_raises_what_it_raises(dispatcher: Dispatcher) -> None:
    async def answer(value: int) -> int:
        await asyncio.sleep(0)
        if value < 0:
            raise ValueError("negative")
        return value + 1

    assert dispatcher.run(answer(41)) == 42
    with pytest.raises(ValueError, match="negative"):
        dispatcher.run(answer(-1))


def test_run_starts_no_thread_and_keeps_no_error(dispatcher: Dispatcher, monkeypatch: pytest.MonkeyPatch) -> None:
    started: list[object] = []
    monkeypatch.setattr(threading.Thread, "start", started.append)

    class Gone(Exception):
        pass

    async def fail() -> None:
        raise Gone

    gc.disable()
    try:
        with pytest.raises(Gone) as raised:
            dispatcher.run(fail())
        error = weakref.ref(raised.value)
        del raised
        dispatcher.run(asyncio.sleep(0))  # the loop has let the task go
        assert error() is None
    finally:
        gc.enable()
    assert started == []


def test_run_gives_up_after_its_time_limit_and_cancels_the_coroutine(dispatcher: Dispatcher) -> None:
    cancelled = Calls()

    async def wait_for_ever() -> None:
        try:
            await asyncio.Event().wait()
        except asyncio.CancelledError:
            cancelled("cancelled")
            raise

    with pytest.raises(TimeoutError):
        dispatcher.run(wait_for_ever(), 0.02)
    assert cancelled.wait() == ["cancelled"]


def test_a_coroutine_whose_thread_is_interrupted_before_the_loop_has_time_for_it_never_begins(
    dispatcher: Dispatcher, gate: Gate, monkeypatch: pytest.MonkeyPatch
) -> None:
    begun = Calls()
    me = threading.get_ident()

    async def work() -> None:
        begun("work")

    interrupts = Calls()

    def interrupted(*_: object) -> None:
        monkeypatch.undo()
        interrupts("once")
        raise KeyboardInterrupt

    def waits() -> bool:  # until it has ended; or it has not begun
        return sys._current_frames()[me].f_code.co_name in ("wait", "join", "_wait_for_tstate_lock")

    def open_gate() -> None:
        interrupts.wait()
        eventually(waits)
        gate.open()

    dispatcher.call(gate)
    gate.wait_arrived()
    monkeypatch.setattr(Flag, "wait", interrupted)
    opening = threading.Thread(target=open_gate)
    opening.start()
    with pytest.raises(KeyboardInterrupt):
        dispatcher.run(work())
    opening.join()
    dispatcher.run(asyncio.sleep(0))
    assert list(begun) == []


def test_run_is_refused_on_the_loops_own_thread(dispatcher: Dispatcher) -> None:
    outcome = Calls()

    async def nothing() -> None: ...

    def block() -> None:
        assert dispatcher.is_loop_thread()
        try:
            dispatcher.run(nothing())
        except UsageError as error:
            outcome(str(error))

    dispatcher.call(block)
    assert "would hang the process" in outcome.wait()[0]
    assert not dispatcher.is_loop_thread()


def test_run_is_refused_in_an_async_callback_of_the_user(dispatcher: Dispatcher) -> None:
    outcome = Calls()

    async def nothing() -> None: ...

    async def block() -> None:
        dispatcher.run(nothing())

    dispatcher.workers.submit(block, done=lambda _result, error: outcome(error))
    error = outcome.wait()[0]
    assert isinstance(error, UsageError)
    assert "async def" in str(error)


def test_the_loop_is_uvloops_where_that_is_installed_and_no_policy_is_set(dispatcher: Dispatcher) -> None:
    expected = "uvloop" if importlib.util.find_spec("uvloop") else "asyncio"
    assert type(dispatcher.loop).__module__.startswith(expected)
    assert type(asyncio.get_event_loop_policy()).__module__.startswith("asyncio")


def test_the_loop_lives_while_somebody_holds_it_and_its_threads_end_with_the_last() -> None:
    before = set(threading.enumerate())
    first, second = acquire(), acquire()
    assert first is second is current()
    done = Calls()
    first.workers.submit(lambda: None, done=done)
    done.wait()
    release()
    assert current() is first
    assert first.run(_name_of_thread()) == "rr-loop"
    release()
    assert current() is None
    assert set(threading.enumerate()) <= before


async def _name_of_thread() -> str:
    return threading.current_thread().name


def test_after_the_last_release_the_next_acquire_starts_a_new_loop() -> None:
    first = acquire()
    release()
    second = acquire()
    try:
        assert second is not first
        assert second.run(_name_of_thread()) == "rr-loop"
        with pytest.raises(Unavailable):
            first.call(print)
    finally:
        release()


def test_the_last_release_on_the_loop_itself_ends_it_without_waiting_for_itself() -> None:
    dispatcher = acquire()
    dispatcher.call(release)
    eventually(lambda: not dispatcher.thread.is_alive())
    assert current() is None


def test_the_last_release_in_a_worker_ends_the_loop() -> None:
    dispatcher = acquire()
    dispatcher.workers.submit(release)
    eventually(lambda: not dispatcher.thread.is_alive())
    assert current() is None


def test_what_was_called_before_close_still_runs() -> None:
    dispatcher = Dispatcher()
    seen: list[int] = []
    for number in range(100):
        dispatcher.call(seen.append, number)
    dispatcher.close()
    assert seen == list(range(100))


def test_close_does_not_wait_for_a_callback_that_is_stuck() -> None:
    dispatcher = Dispatcher()
    go_on = threading.Event()
    started = threading.Event()

    def stuck() -> None:
        started.set()
        go_on.wait(10)

    dispatcher.workers.submit(stuck)
    started.wait(10)
    dispatcher.close(timeout_s=0.02)
    assert not dispatcher.thread.is_alive()
    go_on.set()


def test_release_without_acquire_is_an_error_that_says_so() -> None:
    assert current() is None
    with pytest.raises(UsageError, match=r"without acquire\(\)"):
        release()


def test_a_forked_child_does_not_use_its_parents_loop(dispatcher: Dispatcher) -> None:
    reader, writer = os.pipe()
    pid = os.fork()
    if pid == 0:
        try:
            refused = False
            try:
                dispatcher.call(print)
            except Unavailable:
                refused = True
            own = acquire()
            works = own.run(_name_of_thread(), 5) == "rr-loop"
            release()
            os.write(writer, b"ok" if refused and works and own is not dispatcher else b"no")
        finally:
            os._exit(0)
    os.close(writer)
    with os.fdopen(reader, "rb") as pipe:
        assert pipe.read() == b"ok"
    os.waitpid(pid, 0)


def test_at_exit_the_loop_ends_and_its_holders_may_still_release_it() -> None:
    dispatcher = acquire()
    (close,) = (each for each in interpreter.of_each_process if each.__module__ == module.__name__)
    close()
    assert not dispatcher.thread.is_alive()
    release()
    assert current() is None


def test_a_coroutine_is_refused_if_the_loop_ends_before_it_begins(monkeypatch: pytest.MonkeyPatch) -> None:
    async def nothing() -> None:
        """Never begun: else Python warns."""

    dispatcher = Dispatcher()
    monkeypatch.setattr(dispatcher, "hand_over", lambda _begin: dispatcher.close())  # the loop's last look was before
    with pytest.raises(Unavailable, match="has ended"):
        dispatcher.run(nothing())
