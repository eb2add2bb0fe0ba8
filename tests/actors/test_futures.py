"""Futures of rr_actors where Python's own are expected: by concurrent.futures and asyncio."""

from __future__ import annotations

import asyncio
import concurrent.futures
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pykka
import pytest

import rr_actors as rr
from rr_actors.actors.messaging.futures import Reply, StopReply
from support import Calls, Gate, eventually, serve
from support_pykka import Worker, boom

Start = Callable[..., rr.System]

LIMIT_S = 10


@pytest.fixture(params=["here", "elsewhere"])
def ref(request: pytest.FixtureRequest, start: Start) -> Iterator[rr.ActorRef[Any]]:
    """An actor of this process that nobody supervises, and one in a child process."""
    if request.param == "here":
        ref: Any = Worker.start()
        yield ref
        ref.stop()
    else:
        yield start(rr.ChildSpec(Worker, "worker")).ref("worker")


def test_result_and_exception_wait_as_executors_futures_do(ref: rr.ActorRef[Any]) -> None:
    good, bad = ref.ask("good", block=False), ref.ask(boom, block=False)
    assert isinstance(good, concurrent.futures.Future)
    assert isinstance(good, pykka.Future)
    assert good.result(timeout=LIMIT_S) == "good"
    assert good.exception() is None
    assert isinstance(bad.exception(timeout=LIMIT_S), KeyError)
    with pytest.raises(KeyError, match="boom"):
        bad.result()
    assert good.done()
    assert not good.cancelled()
    assert not good.running()
    assert good.get() == "good"


def test_result_and_exception_time_out_with_timeout_error(ref: rr.ActorRef[Any], tmp_path: Path) -> None:
    works = ref.proxy().work_until(str(tmp_path / "go"))
    for wait in (works.result, works.exception):
        with pytest.raises(TimeoutError, match=r"no reply after 0\.01 seconds"):
            wait(timeout=0.01)
    with pytest.raises(pykka.Timeout):
        works.get(timeout=0.01)
    (tmp_path / "go").touch()
    assert works.result(timeout=LIMIT_S) is None


def test_wait_and_as_completed_take_them(ref: rr.ActorRef[Any], tmp_path: Path) -> None:
    quick = ref.ask("quick", block=False)
    works = ref.proxy().work_until(str(tmp_path / "go"))
    late = [ref.ask(number, block=False) for number in range(3)]
    done, waiting = concurrent.futures.wait([quick, works, *late], LIMIT_S, return_when="FIRST_COMPLETED")
    assert done == {quick}
    assert len(waiting) == 4
    (tmp_path / "go").touch()
    found = [future.result() for future in concurrent.futures.as_completed([quick, works, *late], LIMIT_S)]
    assert set(found) == {"quick", None, 0, 1, 2}
    assert concurrent.futures.wait([quick, works, *late], LIMIT_S).not_done == set()


def test_wait_returns_at_the_first_exception(ref: rr.ActorRef[Any], tmp_path: Path) -> None:
    good, bad = ref.ask("good", block=False), ref.ask(boom, block=False)
    works = ref.proxy().work_until(str(tmp_path / "go"))
    done, waiting = concurrent.futures.wait([good, bad, works], LIMIT_S, return_when="FIRST_EXCEPTION")
    assert bad in done
    assert waiting == {works}
    (tmp_path / "go").touch()
    works.get(timeout=LIMIT_S)


def test_wrap_future_and_gather_take_them(ref: rr.ActorRef[Any]) -> None:
    async def ask() -> list[Any]:
        futures = [asyncio.wrap_future(ref.ask(number, block=False)) for number in range(3)]
        with pytest.raises(KeyError):
            await asyncio.wrap_future(ref.ask(boom, block=False))
        return await asyncio.gather(*futures)

    assert asyncio.run(ask()) == [0, 1, 2]


def test_callbacks_get_the_future(ref: rr.ActorRef[Any]) -> None:
    seen = Calls()
    future = ref.ask("value", block=False)
    future.add_done_callback(seen)
    assert seen.wait() == [future]
    future.add_done_callback(seen)
    assert seen.wait(2) == [future, future]


def test_a_cancelled_future_says_so_everywhere(ref: rr.ActorRef[Any], tmp_path: Path) -> None:
    works = ref.proxy().work_until(str(tmp_path / "go"))
    seen = Calls()
    future = ref.ask("late", block=False)
    future.add_done_callback(seen)
    assert future.cancel()
    assert future.cancel()
    assert seen.wait() == [future]
    assert future.cancelled()
    assert future.done()
    for wait in (future.result, future.exception, future.get):
        with pytest.raises(concurrent.futures.CancelledError):
            wait()
    assert concurrent.futures.wait([future], LIMIT_S).done == {future}
    (tmp_path / "go").touch()
    works.get(timeout=LIMIT_S)
    assert not works.cancel()
    assert ref.ask("alive") == "alive"


def test_a_message_that_was_cancelled_is_not_handled_and_one_that_is_cannot_be_cancelled() -> None:
    handled: list[Any] = []
    gate = Gate()

    class Counts(rr.Actor):
        def on_receive(self, message: Any) -> Any:
            handled.append(message)
            if message == "first":
                gate()

    ref = Counts.start()
    first, second, third = (ref.ask(each, block=False) for each in ("first", "second", "third"))
    eventually(lambda: first.running())
    assert not first.cancel()
    assert second.cancel()
    gate.open()
    third.get(timeout=LIMIT_S)
    assert handled == ["first", "third"]
    assert not ref.stop(block=False).cancel()


def test_what_map_and_join_return_can_be_waited_for_and_calls_back(ref: rr.ActorRef[Any]) -> None:
    seen = Calls()
    doubled = ref.ask(21, block=False).map(lambda value: 2 * value)
    doubled.add_done_callback(seen)  # type: ignore[attr-defined]
    assert seen.wait() == [doubled]
    joined = ref.ask(1, block=False).join(ref.ask(2, block=False))
    failing = ref.ask("text", block=False).map(lambda value: 1 / value)
    everything: Any = [doubled, joined, failing]
    assert concurrent.futures.wait(everything, LIMIT_S).not_done == set()
    assert [everything[0].result(), everything[1].result()] == [42, [1, 2]]
    assert isinstance(everything[2].exception(), TypeError)
    fresh: Any = ref.ask(3, block=False).map(lambda value: value + 1)
    assert fresh.result(timeout=LIMIT_S) == 4
    assert fresh.exception() is None


@pytest.mark.parametrize(
    "error",
    [rr.UsageError("set"), TimeoutError("set"), pykka.Timeout("set"), concurrent.futures.CancelledError("set")],
    ids=repr,
)
def test_an_exception_that_was_set_is_returned_through_map(error: Exception) -> None:
    source: Reply[int] = Reply()
    mapped: Any = source.map(lambda value: value + 1)
    source.set_exception(error)
    assert mapped.exception() is error


def test_exception_of_what_map_returns_raises_what_hinders_the_wait() -> None:
    mapped: Any = Reply[int]().map(lambda value: value + 1)
    with pytest.raises(rr.UsageError, match="expected seconds"):
        mapped.exception(timeout=-1)
    with pytest.raises(TimeoutError, match="no reply after"):
        mapped.exception(timeout=0.01)


def test_ctrl_c_while_exception_waits_is_raised(monkeypatch: pytest.MonkeyPatch) -> None:
    source: Reply[int] = Reply()
    mapped: Any = source.map(str)

    def interrupted(_timeout: float | None) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(source, "_wait", interrupted)
    with pytest.raises(KeyboardInterrupt):
        mapped.exception()


def test_exception_of_what_map_returns_raises_a_ring_of_asks() -> None:
    ref = Worker.start()
    asked: Any = ref.ask(lambda me: me.actor_ref.ask(1, block=False).map(str).exception(), block=False)
    with pytest.raises(rr.UsageError, match="asks itself"):
        asked.get(timeout=LIMIT_S)
    ref.stop()


def test_a_cancel_that_is_interrupted_wakes_all_that_wait() -> None:
    def interrupted() -> None:
        raise KeyboardInterrupt

    reply: Reply[int] = Reply()
    reply.withdraw = interrupted
    seen = Calls()
    reply.add_done_callback(seen)
    with pytest.raises(KeyboardInterrupt):
        reply.cancel()
    assert reply.cancelled()
    assert seen.items == [reply]


def test_a_signal_handler_may_cancel_a_future_that_its_thread_is_about_to_wait_for() -> None:
    reply: Reply[int] = Reply()
    reply.withdraw = Calls()

    class Interrupted(str):
        """concurrent.futures.wait() compares this while it holds the locks of the futures."""

        __slots__ = ()
        __hash__ = str.__hash__

        def __eq__(self, other: object) -> bool:
            assert reply.cancel()
            return super().__eq__(other)

    concurrent.futures.wait([reply], 0, Interrupted(concurrent.futures.ALL_COMPLETED))
    assert reply.cancelled()


def test_what_map_returns_is_computed_later_if_there_was_no_thread_for_it(monkeypatch: pytest.MonkeyPatch) -> None:
    def no_thread(_thread: threading.Thread) -> None:
        raise RuntimeError("can't start new thread")

    source: Reply[int] = Reply()
    mapped: Any = source.map(str)
    source.set(1)
    seen = Calls()
    with monkeypatch.context() as scarce:
        scarce.setattr(threading.Thread, "start", no_thread)
        with pytest.raises(RuntimeError, match="can't start new thread"):
            mapped.add_done_callback(seen)
    assert concurrent.futures.wait([mapped], LIMIT_S).done == {mapped}
    assert seen.wait() == [mapped]


def test_a_future_shows_its_actor_and_its_state(ref: rr.ActorRef[Any]) -> None:
    asked = ref.ask("good", block=False)
    assert asked.get() == "good"
    assert repr(asked) == f"<Reply: the reply of {ref}, finished>"
    assert repr(Reply()) == "<Reply: a future, pending>"


def test_a_cancelled_load_is_withdrawn(app: rr.Registrar, provider: rr.Registrar, gate: Gate) -> None:
    served = serve(provider, "slow", load=gate)
    future: Any = app.load("provider/slow", "x", block=False)
    gate.wait_arrived()
    assert future.cancel()
    gate.open()
    with pytest.raises(concurrent.futures.CancelledError):
        future.get()
    served.unloads.wait()
    eventually(lambda: not provider.resources())
    assert app.queries() == []


def test_many_threads_wait_set_and_cancel_at_once() -> None:
    for _ in range(200):
        reply: Reply[int] = Reply()
        reply.withdraw = lambda: None
        seen = Calls()
        reply.add_done_callback(seen)
        actions = [lambda reply=reply: reply.set(1), reply.cancel, lambda reply=reply: concurrent.futures.wait([reply])]
        threads = [threading.Thread(target=action) for action in actions]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        assert seen.wait() == [reply]
        assert reply.cancelled() or reply.get() == 1


@pytest.mark.parametrize("report", ["set", "set_unopened"])
def test_who_waits_for_a_stop_returns_when_the_end_has_been_noted(report: str) -> None:
    reply = StopReply()
    noted: list[bool] = []
    reply.ended = lambda: noted.append(reply.done())

    getattr(reply, report)(None)

    assert noted == [False]
    assert reply.get() is True


def test_an_end_that_did_not_come_is_not_noted() -> None:
    reply = StopReply()
    noted: list[bool] = []
    reply.ended = lambda: noted.append(True)

    reply.set_exception(rr.ActorUnavailable("away", id="away"))

    assert reply.get() is False
    assert noted == []
