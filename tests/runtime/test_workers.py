"""Workers: a thread for each running callback, reused; coroutines on the user loop; one at a time per key if wanted."""

from __future__ import annotations

import asyncio
import contextvars
import errno
import functools
import gc
import inspect
import logging
import os
import threading
import weakref
from collections.abc import Callable
from typing import Any

import pytest

from rr_actors.base.errors import MailboxFull, Unavailable
from rr_actors.runtime import thread_pool
from rr_actors.runtime.callback_errors import described
from rr_actors.runtime.event_loop import Dispatcher
from rr_actors.runtime.thread_pool import EventBell
from rr_actors.runtime.user_loop import is_coroutine, start_task
from rr_actors.runtime.workers import Workers, is_async
from support import Calls, Gate, eventually


@pytest.fixture
def workers(dispatcher: Dispatcher) -> Workers:
    return dispatcher.workers


def limited(threads: int) -> Dispatcher:
    """Return a dispatcher with at most that many worker threads."""
    dispatcher = Dispatcher()
    dispatcher.workers.threads.limit = threads
    return dispatcher


def no_thread(_thread: threading.Thread) -> None:
    """Stand for Thread.start() where the system gives no more threads."""
    raise RuntimeError("can't start new thread")


def deliver(done: Callable[..., object], *outcome: Any) -> None:
    """Call `done` in the worker's own thread."""
    done(*outcome)


class Outcomes(Calls):
    """A `done` that notes (result, error), and on which thread it was called."""

    def __init__(self) -> None:
        super().__init__()
        self.threads: list[str] = []

    def __call__(self, *args: Any) -> None:
        self.threads.append(threading.current_thread().name)
        super().__call__(*args)


def test_a_callback_runs_in_a_worker_and_its_result_comes_to_the_loop(workers: Workers) -> None:
    done = Outcomes()
    workers.submit(lambda left, right: (left + right, threading.current_thread().name), 1, 2, done=done)
    ((total, thread), error) = done.wait()[0]
    assert (total, error) == (3, None)
    assert thread.startswith("rr-worker-")
    assert done.threads == ["rr-loop"]


def test_what_a_callback_raises_comes_to_the_loop(workers: Workers) -> None:
    done = Outcomes()

    def fail(error: BaseException) -> None:
        raise error

    for error in (ValueError("wrong"), SystemExit(2), KeyboardInterrupt()):
        workers.submit(fail, error, done=done)
    errors = {type(error) for _, error in done.wait(3)}
    assert errors == {ValueError, SystemExit, KeyboardInterrupt}


def test_without_done_what_a_callback_raises_is_logged(workers: Workers, caplog: pytest.LogCaptureFixture) -> None:
    def fail() -> None:
        raise ValueError("nobody asked")

    with caplog.at_level(logging.ERROR, "rr_actors"):
        workers.submit(fail)
        eventually(lambda: "nobody asked" in caplog.text)


def test_an_idle_thread_is_used_again(workers: Workers) -> None:
    done = Outcomes()
    for count in range(20):
        workers.submit(threading.get_ident, done=done)
        done.wait(count + 1)
    assert len({ident for ident, _ in done}) == 1
    assert len(workers.threads) == 1


def test_callbacks_that_wait_for_one_another_to_any_depth_each_have_a_thread(workers: Workers) -> None:
    depth = 200

    def nested(level: int) -> int:
        if level == depth:
            return level
        inner: list[int] = []
        ready = threading.Event()
        workers.submit(lambda: (inner.append(nested(level + 1)), ready.set()))
        assert ready.wait(40)
        return inner[0]

    done = Outcomes()
    workers.submit(nested, 0, done=done)
    assert done.wait(timeout=40) == [(depth, None)]


def test_what_is_submitted_together_is_done_by_few_threads_if_none_blocks(dispatcher: Dispatcher) -> None:
    done = Outcomes()

    def submit_many() -> None:
        for _ in range(200):
            dispatcher.workers.submit(threading.get_ident, done=done)

    dispatcher.call(submit_many)
    threads = {ident for ident, _ in done.wait(200)}
    assert len(threads) < 20
    assert len(dispatcher.workers.threads) < 20


def test_what_is_submitted_together_does_not_wait_for_one_that_blocks(dispatcher: Dispatcher) -> None:
    together = threading.Barrier(40)

    def submit_many(done: Outcomes) -> None:
        for number in range(80):
            dispatcher.workers.submit(together.wait if number % 2 else int, done=done)

    for _ in range(3):  # with new threads, then with idle ones
        done = Outcomes()
        dispatcher.call(submit_many, done)
        assert {error for _, error in done.wait(80)} == {None}
    assert len(dispatcher.workers.threads) >= 40


def test_while_a_thread_waits_for_its_turn_after_starting_another_that_one_starts_none(
    dispatcher: Dispatcher, monkeypatch: pytest.MonkeyPatch
) -> None:
    done, its_turn = Outcomes(), threading.Event()
    start = threading.Thread.start

    def start_on_a_busy_machine(thread: threading.Thread) -> None:
        start(thread)
        if threading.current_thread().name.startswith("rr-worker"):
            assert its_turn.wait(20.0)

    def submit_many() -> None:
        for _ in range(200):
            dispatcher.workers.submit(threading.get_ident, done=done, patient=True)

    monkeypatch.setattr(threading.Thread, "start", start_on_a_busy_machine)
    try:
        dispatcher.call(submit_many)
        threads = {ident for ident, _ in done.wait(200)}
    finally:
        its_turn.set()
    assert len(threads) < 20


def test_what_is_gathered_wakes_nobody_before_all_is_submitted_and_none_waits_for_one_that_blocks(
    dispatcher: Dispatcher, monkeypatch: pytest.MonkeyPatch
) -> None:
    workers, ring = dispatcher.workers, EventBell.ring
    rung: list[EventBell] = []
    before_going: list[EventBell] = []
    gate, done = Gate(), Outcomes()

    def ring_and_note(bell: EventBell) -> None:
        rung.append(bell)
        ring(bell)

    def submit_many() -> None:
        workers.threads.gather()
        for number in range(40):
            workers.submit(gate if number % 2 else int, done=done)
        before_going.extend(rung)
        workers.threads.go()

    workers.submit(int, done=done)
    done.wait()  # there is an idle thread
    monkeypatch.setattr(EventBell, "ring", ring_and_note)
    dispatcher.call(submit_many)
    gate.wait_arrived(20)
    done.wait(21)
    gate.open()
    assert {error for _, error in done.wait(41)} == {None}
    assert before_going == []
    assert rung


def test_what_is_gathered_and_no_thread_can_come_for_is_refused(
    dispatcher: Dispatcher, monkeypatch: pytest.MonkeyPatch
) -> None:
    done = Outcomes()

    def submit_two() -> None:
        dispatcher.workers.threads.gather()
        dispatcher.workers.submit(print, done=done)
        dispatcher.workers.submit(print, done=done, patient=True)
        dispatcher.workers.threads.go()

    monkeypatch.setattr(threading.Thread, "start", no_thread)
    dispatcher.call(submit_two)
    assert [type(error) for _, error in done.wait(2)] == [MailboxFull, MailboxFull]
    monkeypatch.undo()
    dispatcher.workers.submit(lambda: "later", done=done)
    assert done.wait(3)[2] == ("later", None)


@pytest.mark.parametrize("together", [1, 5, 30])
def test_idle_threads_are_woken_each_time_there_is_something_to_do(dispatcher: Dispatcher, together: int) -> None:
    for _ in range(100):
        done = Outcomes()
        for number in range(together):
            dispatcher.workers.submit(lambda number=number: number, done=done)
        assert sorted(result for result, _ in done.wait(together)) == list(range(together))


def test_without_a_thread_for_it_a_callback_is_refused_and_those_behind_a_free_one_are_done(
    dispatcher: Dispatcher, monkeypatch: pytest.MonkeyPatch
) -> None:
    go_on, entered = threading.Event(), threading.Event()
    done = Outcomes()

    monkeypatch.setattr(threading.Thread, "start", no_thread)
    with pytest.raises(MailboxFull, match="can't start new thread"):
        dispatcher.workers.submit(print)
    monkeypatch.undo()
    assert len(dispatcher.workers.threads) == 0
    dispatcher.workers.submit(lambda: (entered.set(), go_on.wait(10)), done=done)
    entered.wait(10)
    monkeypatch.setattr(threading.Thread, "start", no_thread)
    with pytest.raises(MailboxFull):
        dispatcher.workers.submit(print)
    go_on.set()
    done.wait()
    dispatcher.workers.submit(lambda: "by the thread that is free", done=done)
    assert done.wait(2)[1] == ("by the thread that is free", None)


def test_threads_are_woken_without_file_descriptors_too(workers: Workers, monkeypatch: pytest.MonkeyPatch) -> None:
    def none_left(_value: int) -> int:
        raise OSError(errno.EMFILE, os.strerror(errno.EMFILE))

    monkeypatch.setattr(os, "eventfd", none_left)
    for _ in range(50):
        done = Outcomes()
        for number in range(3):
            workers.submit(lambda number=number: number, done=done)
        assert sorted(result for result, _ in done.wait(3)) == [0, 1, 2]


def test_a_thread_that_cannot_bring_another_tells_those_who_wait(
    workers: Workers, monkeypatch: pytest.MonkeyPatch
) -> None:
    go_on = threading.Event()
    first, second = Outcomes(), Outcomes()
    rung: list[EventBell] = []

    workers.submit(int, done=first)
    first.wait()
    monkeypatch.setattr(threading.Thread, "start", no_thread)
    with monkeypatch.context() as late:
        late.setattr(EventBell, "ring", lambda bell: rung.append(bell))  # as if it took long
        workers.submit(go_on.wait, 10, done=first)
        workers.submit(print, done=second)
    for bell in rung:
        bell.ring()
    assert isinstance(second.wait()[0][1], MailboxFull)
    go_on.set()
    assert first.wait(2)[1] == (True, None)


def test_over_the_limit_a_callback_is_refused_with_the_limit_and_what_to_do() -> None:
    dispatcher = limited(2)
    go_on, entered = threading.Event(), Calls()
    try:
        done = Outcomes()
        for _ in range(2):
            dispatcher.workers.submit(lambda: (entered("a thread"), go_on.wait(10))[1], done=done)
        entered.wait(2)
        with pytest.raises(MailboxFull, match="workers_limit") as refused:
            dispatcher.workers.submit(print)
        assert refused.value.details == {"name": "workers", "limit": 2}
        go_on.set()
        assert done.wait(2) == [(True, None)] * 2
        dispatcher.workers.submit(lambda: "again", done=done)
        assert done.wait(3)[2] == ("again", None)
    finally:
        go_on.set()
        dispatcher.close()


def test_what_was_taken_before_all_threads_were_busy_waits_for_a_free_one_and_what_comes_later_is_refused(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    dispatcher = limited(2)
    workers, go_on, entered = dispatcher.workers, threading.Event(), Calls()
    first, done, beyond = Outcomes(), Outcomes(), Calls()
    rung: list[EventBell] = []

    def block() -> bool:
        entered("a thread")
        return go_on.wait(10)

    try:
        both = threading.Barrier(2)
        for _ in range(2):
            workers.submit(both.wait, 10, done=first)
        first.wait(2)
        with monkeypatch.context() as late:
            late.setattr(EventBell, "ring", lambda bell: rung.append(bell))  # as if it took long
            for _ in range(5):
                workers.submit(block, done=done)
            workers.in_thread(beyond, "done all the same", beyond_limit=True)
        rung.pop().ring()
        assert beyond.wait() == ["done all the same"]
        entered.wait(2)
        with pytest.raises(MailboxFull, match="workers_limit"):
            workers.submit(print)
        assert done.items == []
        go_on.set()
        assert done.wait(5) == [(True, None)] * 5
    finally:
        go_on.set()
        dispatcher.close()


def test_callbacks_that_return_may_be_many_more_than_threads() -> None:
    dispatcher = limited(50)
    try:
        done = Outcomes()
        dispatcher.call(lambda: [dispatcher.workers.submit(int, done=done) for _ in range(5000)])
        assert set(done.wait(5000)) == {(0, None)}
    finally:
        dispatcher.close()


def test_idle_threads_end_after_a_while(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(thread_pool, "_IDLE_S", 0.02)
    workers = Workers(deliver, deliver)
    done = Outcomes()
    workers.submit(lambda: "ran", done=done)
    assert done.wait() == [("ran", None)]
    eventually(lambda: len(workers.threads) == 0)
    workers.submit(lambda: "again", done=done)
    assert done.wait(2)[1] == ("again", None)
    workers.close()


def test_an_idle_thread_keeps_nothing_of_what_it_ran(workers: Workers) -> None:
    class Big:
        def __call__(self) -> None: ...

    big = Big()
    watched = weakref.ref(big)
    done = Outcomes()
    workers.submit(big, done=done)
    done.wait()
    del big
    eventually(lambda: (gc.collect(), watched() is None)[1])


def test_close_ends_idle_threads_at_once_and_waits_no_longer_than_told_for_others() -> None:
    workers = Workers(deliver, deliver)
    go_on, started = threading.Event(), threading.Event()
    done = Outcomes()
    workers.submit(lambda: None, done=done)
    done.wait()
    workers.submit(lambda: (started.set(), go_on.wait(10)))
    started.wait(10)
    workers.close(timeout_s=0.02)
    assert len(workers.threads) == 1
    with pytest.raises(Unavailable):
        workers.submit(print)
    go_on.set()
    eventually(lambda: len(workers.threads) == 0)


# -- what a thread does at once --------------------------------------------------------------------------------------


def test_what_the_thread_has_told_at_once_the_loop_is_not_told(workers: Workers) -> None:
    at_once, done = Calls(), Outcomes()

    def tell(result: Any) -> bool:
        at_once(result, threading.current_thread().name)
        return True

    workers.submit(lambda: threading.current_thread().name, done=done, at_once=tell)
    ((result, thread),) = at_once.wait()
    assert result == thread
    workers.submit(lambda: "next", done=done)
    assert done.wait() == [("next", None)]


def test_what_the_thread_could_not_tell_at_once_the_loop_is_told(workers: Workers) -> None:
    at_once, done = Calls(), Outcomes()
    workers.submit(lambda: "result", done=done, at_once=lambda result: bool(at_once(result)))
    assert done.wait() == [("result", None)]
    assert at_once.items == ["result"]
    assert done.threads == ["rr-loop"]


def test_a_thread_that_has_more_to_run_leaves_it_to_the_loop(dispatcher: Dispatcher) -> None:
    workers = Workers(dispatcher.call, dispatcher.call)
    workers.threads.limit = 1
    at_once, done = Calls(), Outcomes()
    begun, go_on = threading.Event(), threading.Event()

    def told(result: Any) -> bool:
        at_once(result)
        return True

    def first() -> str:
        begun.set()
        assert go_on.wait(10)
        return "first"

    workers.submit(first, done=done, at_once=told)
    assert begun.wait(10)
    workers.submit(lambda: "last", done=done, at_once=told, patient=True)
    go_on.set()
    assert at_once.wait() == ["last"]
    assert done.wait() == [("first", None)]
    workers.close()


def test_what_fails_while_the_thread_tells_is_logged_and_the_loop_is_told(
    workers: Workers, caplog: pytest.LogCaptureFixture
) -> None:
    done = Outcomes()

    def defect(_result: Any) -> bool:
        raise ValueError("a defect")

    with caplog.at_level(logging.ERROR, "rr_actors"):
        workers.submit(lambda: "result", done=done, at_once=defect)
        assert done.wait() == [("result", None)]
    assert "could not say so" in caplog.text
    assert "a defect" in caplog.text
    workers.submit(lambda: "next", done=done)
    assert done.wait(2)[1] == ("next", None)


async def _in_a_task() -> str:
    return "from a task"


@pytest.mark.parametrize("fn", [_in_a_task, lambda: _in_a_task()], ids=["async", "gives a coroutine"])
def test_of_a_coroutine_the_loop_is_told(workers: Workers, fn: Callable[[], Any]) -> None:
    at_once, done = Calls(), Outcomes()
    workers.submit(fn, done=done, at_once=lambda result: bool(at_once(result)) or True)
    assert done.wait() == [("from a task", None)]
    assert at_once.items == []


def test_of_an_error_the_loop_is_told(workers: Workers) -> None:
    at_once, done = Calls(), Outcomes()

    def fail() -> None:
        raise ValueError("wrong")

    workers.submit(fail, done=done, at_once=lambda result: bool(at_once(result)) or True)
    ((_, error),) = done.wait()
    assert isinstance(error, ValueError)
    assert at_once.items == []


def test_of_what_no_thread_can_run_the_loop_is_told(dispatcher: Dispatcher, monkeypatch: pytest.MonkeyPatch) -> None:
    at_once, done = Calls(), Outcomes()

    def submit() -> None:
        dispatcher.workers.threads.gather()
        dispatcher.workers.submit(int, done=done, at_once=lambda result: bool(at_once(result)) or True)
        dispatcher.workers.threads.go()

    monkeypatch.setattr(threading.Thread, "start", no_thread)
    dispatcher.call(submit)
    ((_, error),) = done.wait()
    assert isinstance(error, MailboxFull)
    assert at_once.items == []


# -- contexts ----------------------------------------------------------------------------------------------------------

word = contextvars.ContextVar("word", default="none")


async def _read_word() -> str:
    await asyncio.sleep(0)
    return word.get()


@pytest.mark.parametrize("read", [word.get, _read_word], ids=["thread", "task"])
def test_a_callback_sees_the_context_it_was_given_and_no_other(workers: Workers, read: Callable[[], Any]) -> None:
    done = Outcomes()
    context = contextvars.Context()
    context.run(word.set, "given")
    word.set("of the test")
    workers.serial("key", read, done=done, context=context)
    done.wait()
    workers.serial("key", read, done=done)
    assert done.wait(2) == [("given", None), ("none", None)]


# -- coroutines --------------------------------------------------------------------------------------------------------


async def _thread_name(prefix: str = "") -> str:
    await asyncio.sleep(0)
    return prefix + threading.current_thread().name


class AsyncMethods:
    async def method(self) -> str:
        return await _thread_name()

    async def __call__(self) -> str:
        return await _thread_name()


def _wrapped() -> Any:
    return _thread_name()


@pytest.mark.parametrize(
    "fn",
    [
        _thread_name,
        functools.partial(_thread_name),
        functools.partial(functools.partial(_thread_name)),
        AsyncMethods().method,
        AsyncMethods(),
        lambda: _thread_name(),
        _wrapped,
    ],
    ids=["function", "partial", "partial of partial", "method", "object", "lambda", "wrapper"],
)
def test_whatever_gives_a_coroutine_is_awaited_on_the_user_loop(workers: Workers, fn: Callable[[], Any]) -> None:
    done = Outcomes()
    workers.submit(fn, done=done)
    assert done.wait() == [("rr-user-loop", None)]
    assert done.threads == ["rr-loop"]


def test_plain_callables_are_not_taken_for_coroutine_functions() -> None:
    assert not is_async(print)
    assert not is_async(functools.partial(print))
    assert not is_async(object)
    assert not is_coroutine("text")


def test_what_a_coroutine_raises_comes_to_the_loop_and_the_user_loop_goes_on(workers: Workers) -> None:
    async def fail(error: BaseException) -> None:
        await asyncio.sleep(0)
        raise error

    done = Outcomes()
    for error in (ValueError("wrong"), SystemExit(2), asyncio.CancelledError()):
        workers.submit(fail, error, done=done)
    assert {type(error) for _, error in done.wait(3)} == {ValueError, SystemExit, asyncio.CancelledError}
    workers.submit(_thread_name, done=done)
    assert done.wait(4)[3] == ("rr-user-loop", None)


def test_a_coroutine_function_called_wrongly_is_an_error_like_any_other(workers: Workers) -> None:
    done = Outcomes()
    workers.submit(_thread_name, 1, 2, 3, done=done)
    assert isinstance(done.wait()[0][1], TypeError)


def test_a_coroutine_that_is_running_at_close_is_cancelled() -> None:
    dispatcher = Dispatcher()
    started = threading.Event()
    ended = Calls()

    async def wait() -> None:
        started.set()
        try:
            await asyncio.Event().wait()
        except asyncio.CancelledError:
            ended("cancelled")
            raise

    dispatcher.workers.submit(wait)
    started.wait(10)
    dispatcher.close()
    assert ended.items == ["cancelled"]


def test_run_gives_the_loop_a_callbacks_result_to_await(dispatcher: Dispatcher) -> None:
    def fail(error: BaseException) -> None:
        raise error

    assert dispatcher.run(dispatcher.workers.run(lambda: 7)) == 7
    with pytest.raises(ValueError, match="wrong"):
        dispatcher.run(dispatcher.workers.run(fail, ValueError("wrong")))
    with pytest.raises(RuntimeError, match="SystemExit"):
        dispatcher.run(dispatcher.workers.run(fail, SystemExit(1)))


# -- queues ------------------------------------------------------------------------------------------------------------


def test_calls_of_one_key_run_one_at_a_time_and_in_order(workers: Workers) -> None:
    done = Outcomes()
    inside: list[int] = []
    order: list[int] = []

    def step(number: int) -> None:
        inside.append(number)
        assert len(inside) == 1
        order.append(number)
        inside.remove(number)

    async def async_step(number: int) -> None:
        inside.append(number)
        await asyncio.sleep(0)
        assert len(inside) == 1
        order.append(number)
        inside.remove(number)

    for number in range(60):
        workers.serial("key", (step, async_step, lambda n: async_step(n))[number % 3], number, done=done)
    assert {error for _, error in done.wait(60)} == {None}
    assert order == list(range(60))


def test_calls_of_different_keys_do_not_wait_for_each_other(workers: Workers) -> None:
    go_on = threading.Event()
    done = Outcomes()
    workers.serial("slow", go_on.wait, 10, done=done)
    workers.serial("quick", lambda: "quick", done=done)
    assert done.wait() == [("quick", None)]
    go_on.set()
    done.wait(2)


def test_a_call_that_fails_does_not_stop_those_behind_it(workers: Workers) -> None:
    done = Outcomes()
    workers.serial("key", lambda: 1 / 0, done=done)
    workers.serial("key", _thread_name, 1, 2, 3, done=done)
    workers.serial("key", lambda: "third", done=done)
    first, second, third = done.wait(3)
    assert isinstance(first[1], ZeroDivisionError)
    assert isinstance(second[1], TypeError)
    assert third == ("third", None)


def test_keys_are_forgotten_when_their_calls_are_done(workers: Workers) -> None:
    class Key:
        """One that says when it is gone."""

    done, kept = Outcomes(), weakref.WeakSet[Key]()

    def call() -> None:
        kept.add(key := Key())
        workers.serial(key, lambda: None, done=done)

    for _ in range(100):
        call()
    done.wait(100)
    eventually(lambda: gc.collect() >= 0 and not kept)


def test_a_serial_call_over_the_limit_is_refused_and_its_key_is_free_again() -> None:
    dispatcher = limited(1)
    go_on, entered = threading.Event(), threading.Event()
    try:
        done = Outcomes()
        dispatcher.workers.submit(lambda: (entered.set(), go_on.wait(10)), done=done)
        entered.wait(10)
        with pytest.raises(MailboxFull):
            dispatcher.workers.serial("key", print)
        go_on.set()
        done.wait()
        dispatcher.workers.serial("key", lambda: "now", done=done)
        assert done.wait(2)[1] == ("now", None)
    finally:
        go_on.set()
        dispatcher.close()


def test_calls_of_a_key_that_no_thread_can_run_end_with_an_error_and_the_key_is_free_again(
    workers: Workers, monkeypatch: pytest.MonkeyPatch
) -> None:
    done, go_on = Outcomes(), threading.Event()

    async def first() -> bool:
        return go_on.wait(10)

    workers.serial("key", first, done=done)
    for _ in range(2):
        workers.serial("key", int, done=done)
    with monkeypatch.context() as late:
        late.setattr(threading.Thread, "start", no_thread)
        go_on.set()
        outcomes = done.wait(3)
    assert outcomes[0] == (True, None)
    assert [type(error) for _, error in outcomes[1:]] == [MailboxFull, MailboxFull]
    workers.serial("key", lambda: "now", done=done)
    assert done.wait(4)[3] == ("now", None)


def test_a_call_of_a_key_that_comes_while_the_first_is_refused_ends_too(
    workers: Workers, monkeypatch: pytest.MonkeyPatch
) -> None:
    done, asked = Outcomes(), Calls()

    def no_thread(thread: threading.Thread) -> None:
        asked(thread)
        if len(asked.items) == 1:
            workers.serial("key", int, done=done)
            workers.serial("key", int, done=done)
        raise RuntimeError("can't start new thread")

    monkeypatch.setattr(threading.Thread, "start", no_thread)
    with pytest.raises(MailboxFull):
        workers.serial("key", print)
    assert [type(error) for _, error in done.wait(2)] == [MailboxFull, MailboxFull]


def test_closing_does_not_wait_for_a_thread_that_is_being_started(monkeypatch: pytest.MonkeyPatch) -> None:
    workers = Workers(deliver, deliver)
    being_started, go_on = threading.Event(), threading.Event()
    start = threading.Thread.start

    def start_slowly(thread: threading.Thread) -> None:
        if thread.name.startswith("rr-worker"):
            being_started.set()
            assert go_on.wait(10.0)
        start(thread)

    monkeypatch.setattr(threading.Thread, "start", start_slowly)
    ran = threading.Event()
    submitter = threading.Thread(target=workers.submit, args=(ran.set,))
    submitter.start()
    assert being_started.wait(10.0)
    workers.close(1.0)
    go_on.set()
    submitter.join(10.0)
    assert ran.wait(10.0)
    eventually(lambda: len(workers.threads) == 0)


@pytest.mark.parametrize("wrap", [lambda fn: fn, lambda fn: described(fn, "the callback")], ids=["plain", "described"])
def test_a_coroutine_that_comes_after_the_end_is_closed_and_ends_its_thread_in_order(
    dispatcher: Dispatcher, wrap: Callable[[Any], Any], recwarn: pytest.WarningsRecorder
) -> None:
    gate, workers = Gate(), dispatcher.workers

    async def too_late() -> None: ...

    def wrapper() -> Any:
        gate()
        return too_late()

    workers.submit(wrap(wrapper))
    gate.wait_arrived()
    workers.close(timeout_s=0.0)
    gate.open()

    eventually(lambda: len(workers.threads) == 0)
    gc.collect()
    assert [str(warning.message) for warning in recwarn] == []


def test_a_coroutine_whose_task_is_cancelled_before_it_begins_is_closed() -> None:
    done = Calls()

    async def never_begun() -> None: ...

    coroutine = never_begun()

    async def cancel_at_once() -> None:
        start_task(asyncio.get_running_loop(), coroutine, done, contextvars.Context()).cancel()
        await asyncio.sleep(0.01)

    asyncio.run(cancel_at_once())
    ((result, error),) = done.wait()
    assert (result, type(error)) == (None, asyncio.CancelledError)
    assert inspect.getcoroutinestate(coroutine) == inspect.CORO_CLOSED
