"""What our actors promise beyond Pykka's: start waits, async handlers, rings are errors, exits are reported."""

from __future__ import annotations

import asyncio
import contextvars
import logging
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from typing import Any

import pykka
import pytest

from rr_actors.actors.actor import BATCH, IGNORE, Actor, ExitReport, LoopActor
from rr_actors.actors.drivers import Driver
from rr_actors.actors.refs import ActorRef
from rr_actors.base.errors import MailboxFull, StartFailed, UsageError
from rr_actors.registrar.manager import Manager
from rr_actors.runtime.event_loop import Dispatcher, acquire, current, release
from rr_actors.runtime.workers import Workers
from support import REPOSITORY, Calls, Gate, eventually


@pytest.fixture(autouse=True)
def _stop_all() -> Iterator[None]:
    yield
    pykka.ActorRegistry.stop_all(timeout=10)


@pytest.fixture
def dispatcher() -> Iterator[Dispatcher]:
    yield acquire()
    release()


class Echo(Actor):
    """Returns messages; calls those that can be called."""

    def on_receive(self, message: Any) -> Any:
        return message(self) if callable(message) else message


class AsyncEcho(Actor):
    async def on_receive(self, message: Any) -> Any:
        await asyncio.sleep(0)
        if callable(message):
            result = message(self)
            return await result if asyncio.iscoroutine(result) else result
        return message


class LoopEcho(LoopActor):
    def on_receive(self, message: Any) -> Any:
        return message(self) if callable(message) else message


# -- threads -----------------------------------------------------------------------------------------------------------


def test_idle_actors_hold_no_thread() -> None:
    refs = [Echo.start() for _ in range(300)]
    assert [ref.ask(7) for ref in refs] == [7] * 300
    workers = current().workers  # type: ignore[union-attr]
    assert len(workers.threads) < 10


def test_an_actor_that_cannot_begin_answers_what_it_was_asked_meanwhile(monkeypatch: pytest.MonkeyPatch) -> None:
    replies: list[Any] = []

    def refuse(_driver: Driver) -> None:
        [ref] = pykka.ActorRegistry.get_by_class(Echo)
        replies.append(ref.ask("early", block=False))
        raise MailboxFull("no thread is free")

    monkeypatch.setattr(Driver, "start", refuse)
    with pytest.raises(MailboxFull):
        Echo.start()
    [reply] = replies
    with pytest.raises(pykka.ActorDeadError, match="stopped before handling"):
        reply.get(timeout=5)


def test_with_the_last_actor_the_loop_and_its_threads_are_gone() -> None:
    before = set(threading.enumerate())
    first, second = Echo.start(), AsyncEcho.start()
    assert (first.ask(1), second.ask(2)) == (1, 2)
    names = {thread.name for thread in set(threading.enumerate()) - before}
    assert "rr-loop" in names
    assert "rr-user-loop" in names
    first.stop()
    assert second.ask(3) == 3
    second.stop()
    eventually(lambda: set(threading.enumerate()) <= before)
    assert current() is None


def test_an_actor_that_nobody_refers_to_any_more_after_its_end_is_freed() -> None:
    import gc
    import weakref

    class Held(Echo):
        def myself(self) -> Any:
            return weakref.ref(self)

    ref = Held.start()
    watched = ref.proxy().myself().get()
    assert watched() is not None
    ref.stop()
    eventually(lambda: (gc.collect(), watched() is None)[1])


def test_a_program_ends_while_its_actors_run() -> None:
    program = """
import rr_actors.actors.actor as actors
class Echo(actors.Actor):
    def on_receive(self, message):
        return message
class Waits(actors.Actor):
    async def on_receive(self, message):
        import asyncio
        await asyncio.sleep(3600)
ref = Echo.start()
assert ref.ask(1) == 1
Waits.start().tell("for ever")
ref.stop(block=False)
Echo.start().tell("just started")
print("end of the program")
"""
    for _ in range(3):
        done = subprocess.run(
            [sys.executable, "-c", program], cwd=REPOSITORY, capture_output=True, text=True, timeout=30, check=False
        )
        assert (done.returncode, done.stdout, done.stderr) == (0, "end of the program\n", "")


def test_the_contextvars_of_an_actor_stay_its_own_from_message_to_message() -> None:
    word = contextvars.ContextVar("word", default="none")
    word.set("of the test")
    first, second = Echo.start(), AsyncEcho.start()
    assert first.ask(lambda _: word.get()) == "none"
    first.ask(lambda _: word.set("first") and None)
    second.ask(lambda _: word.set("second") and None)
    assert first.ask(lambda _: word.get()) == "first"
    assert second.ask(lambda _: word.get()) == "second"
    assert word.get() == "of the test"


# -- start -------------------------------------------------------------------------------------------------------------


def test_start_returns_when_on_start_has_succeeded() -> None:
    done: list[str] = []

    class Slow(Actor):
        async def on_start(self) -> None:
            await asyncio.sleep(0.02)
            done.append("started")

    Slow.start()
    assert done == ["started"]


def test_start_raises_what_on_start_raised_and_nothing_is_left(caplog: pytest.LogCaptureFixture) -> None:
    made: list[ActorRef[Any]] = []

    class Broken(Actor):
        def on_start(self) -> None:
            made.append(self.actor_ref)  # type: ignore[arg-type]
            raise ValueError("no such device")

    with pytest.raises(ValueError, match="no such device") as raised:
        Broken.start()
    assert raised.traceback[-1].name == "on_start"
    assert pykka.ActorRegistry.get_all() == []
    assert not made[0].is_alive()
    with pytest.raises(pykka.ActorDeadError):
        made[0].ask("anybody")
    eventually(lambda: current() is None)
    assert caplog.text == ""


def test_system_exit_in_on_start_fails_the_start_and_not_the_program() -> None:
    class Leaves(Actor):
        def on_start(self) -> None:
            sys.exit(3)

    with pytest.raises(StartFailed, match="SystemExit: 3"):
        Leaves.start()


def test_messages_sent_before_a_failed_start_fail_with_actor_dead_error() -> None:
    futures: list[Any] = []

    class Broken(Actor):
        def on_start(self) -> None:
            futures.append(self.actor_ref.ask("early", block=False))
            raise ValueError("no")

    with pytest.raises(ValueError, match="no"):
        Broken.start()
    with pytest.raises(pykka.ActorDeadError):
        futures[0].get(timeout=10)


def test_on_start_may_return_ignore() -> None:
    class Declines(Actor):
        def on_start(self) -> Any:
            return IGNORE

    assert not Declines.start().is_alive()
    assert pykka.ActorRegistry.get_all() == []


def test_init_need_not_call_its_base_and_on_start_may_start_other_actors() -> None:
    class Parent(Actor):
        def __init__(self, name: str, *, size: int) -> None:
            self.name = name
            self.size = size

        def on_start(self) -> None:
            self.child = Echo.start()

        def ask_child(self) -> Any:
            return self.child.ask((self.name, self.size))

    assert Parent.start("p", size=3).proxy().ask_child().get() == ("p", 3)


def test_start_is_refused_on_the_loop_and_in_async_handlers(dispatcher: Dispatcher) -> None:
    outcome = Calls()

    def start() -> None:
        try:
            Echo.start()
        except UsageError as error:
            outcome(str(error))

    dispatcher.call(start)
    assert "Echo.start()" in outcome.wait()[0]
    with pytest.raises(UsageError, match="async def"):
        AsyncEcho.start().ask(lambda _: Echo.start())


def test_an_actor_can_be_started_in_another_ones_handler() -> None:
    child = Echo.start().ask(lambda _: Echo.start())
    assert child.ask("child") == "child"


def test_private_names_are_left_to_the_users_class() -> None:
    """A class that keeps its target, its handle or its user in such a name must not break its actor."""

    class Bare(Actor):
        def on_receive(self, message: Any) -> set[str]:
            return {*dir(self)}

    names = {name for name in Bare.start().ask("names") | {*dir(Manager)} if name[0] == "_" and name[-2:] != "__"}
    pykkas = {*dir(pykka.ThreadingActor), "_actor_ref", "_abc_impl"}
    assert {name for name in names - pykkas if not name.startswith("_rr_")} == set()


@pytest.mark.parametrize("name", ["_target", "_handle", "_started", "_mailbox", "_monitors", "_user", "_end", "_hook"])
def test_an_actor_with_private_names_of_its_own_lives_and_ends_as_any_other(name: str) -> None:
    class Arm(Actor):
        def __init__(self) -> None:
            setattr(self, name, "mine")

        def on_receive(self, message: Any) -> Any:
            setattr(self, name, message)
            return getattr(self, name)

    arm = Arm.start()
    assert [arm.ask(one, timeout=20) for one in (1, 2)] == [1, 2]
    assert arm.stop(timeout=20)
    assert not arm.is_alive()


def test_launch_starts_an_actor_from_the_loop_and_reports_its_exit(dispatcher: Dispatcher) -> None:
    class Placed(Actor):
        def __init__(self, word: str) -> None:
            self.word = word

        async def _rr_before_start(self, place: Any) -> None:
            steps((f"before {place}", threading.current_thread().name))

        def on_start(self) -> None:
            steps(("on_start", threading.current_thread().name.rstrip("0123456789")))

        async def _rr_after_start(self) -> None:
            steps(("after", threading.current_thread().name))

        def on_stop(self) -> None:
            steps(("on_stop", threading.current_thread().name.rstrip("0123456789")))

        async def _rr_after_stop(self, final: bool) -> None:
            steps((f"after stop, final {final}", threading.current_thread().name))

    steps, exits = Calls(), Calls()
    launched = dispatcher.run(Placed.launch(("word",), path="root/placed", place="here", on_exit=exits))
    assert isinstance(launched, ActorRef)
    assert launched.actor_urn == "urn:rr-actor:root/placed"
    assert launched.proxy().word.get() == "word"
    assert launched.stop(reason="shutdown", final=True)
    assert exits.wait()[0].reason == "shutdown"
    assert steps.items == [
        ("before here", "rr-loop"),
        ("on_start", "rr-worker-"),
        ("after", "rr-loop"),
        ("on_stop", "rr-worker-"),
        ("after stop, final True", "rr-loop"),
    ]


def test_launch_raises_what_init_or_on_start_raised_and_passes_ignore_on(dispatcher: Dispatcher) -> None:
    class Moody(Actor):
        def __init__(self, mood: str) -> None:
            self.mood = mood
            if mood == "unmade":
                raise ValueError("not made")

        def on_start(self) -> Any:
            if self.mood == "unwilling":
                raise ValueError("not started")
            return IGNORE

        async def _rr_before_start(self, place: Any) -> None:
            steps("before")

        async def _rr_after_start(self) -> None:
            steps("after")

        async def _rr_after_stop(self, final: bool) -> None:
            steps("after stop")

    exits, steps = Calls(), Calls()
    with pytest.raises(ValueError, match="not made"):
        dispatcher.run(Moody.launch(("unmade",), on_exit=exits))
    assert steps.items == []
    with pytest.raises(ValueError, match="not started"):
        dispatcher.run(Moody.launch(("unwilling",), on_exit=exits))
    assert steps.items == ["before", "after stop"]
    assert dispatcher.run(Moody.launch(("elsewhere",), on_exit=exits)) is IGNORE
    assert exits.items == []


def test_a_cancelled_launch_stops_the_actor_as_soon_as_it_has_started(dispatcher: Dispatcher) -> None:
    gate = Gate()
    cancelled, stopped, exits = Calls(), Calls(), Calls()

    class Slow(Actor):
        def on_start(self) -> None:
            gate()

        def on_stop(self) -> None:
            stopped("stopped")

    launches: list[asyncio.Task[Any]] = []
    dispatcher.call(lambda: launches.append(dispatcher.loop.create_task(Slow.launch(on_exit=exits))))
    gate.wait_arrived()
    dispatcher.call(lambda: cancelled(launches[0].cancel()))
    assert cancelled.wait() == [True]
    gate.open()
    assert stopped.wait() == ["stopped"]
    eventually(lambda: pykka.ActorRegistry.get_all() == [])
    assert exits.items == []


# -- handlers ----------------------------------------------------------------------------------------------------------


def test_async_handlers_run_on_the_user_loop_one_message_at_a_time() -> None:
    class Careful(Actor):
        def __init__(self) -> None:
            self.inside = 0
            self.seen: list[int] = []

        async def on_receive(self, message: Any) -> Any:
            assert threading.current_thread().name == "rr-user-loop"
            self.inside += 1
            assert self.inside == 1
            await asyncio.sleep(0)
            self.seen.append(message)
            self.inside -= 1

        async def method(self, value: int) -> int:
            assert self.inside == 0
            await asyncio.sleep(0)
            return value + 1

    ref = Careful.start()
    for number in range(100):
        ref.tell(number)
    assert ref.proxy().method(1).get(timeout=10) == 2
    assert ref.proxy().seen.get() == list(range(100))


def test_an_async_handler_goes_on_although_for_a_moment_there_was_no_thread(monkeypatch: pytest.MonkeyPatch) -> None:
    ref = AsyncEcho.start()
    in_thread = Workers.in_thread
    refused: list[Any] = []

    def refuse_once(workers: Workers, fn: Any, *args: Any, beyond_limit: bool = False) -> None:
        if args and fn.__name__ == "drive" and not refused:
            refused.append(fn)
            raise MailboxFull("no thread") from RuntimeError("can't start new thread")
        in_thread(workers, fn, *args, beyond_limit=beyond_limit)

    monkeypatch.setattr(Workers, "in_thread", refuse_once)
    assert ref.ask("through", timeout=10) == "through"
    assert refused


def test_all_hooks_may_be_async_and_errors_in_them_are_like_any_other() -> None:
    heard = Calls()

    class Hooked(Actor):
        async def on_start(self) -> None:
            heard("on_start")

        async def on_stop(self) -> None:
            heard("on_stop")

        async def on_failure(self, exception_type: Any, exception_value: Any, traceback: Any) -> None:
            heard(str(exception_value))

        async def on_receive(self, message: Any) -> Any:
            raise message

    ref = Hooked.start()
    with pytest.raises(ValueError, match="asked"):
        ref.ask(ValueError("asked"))
    ref.tell(ValueError("told"))
    assert heard.wait(2) == ["on_start", "told"]
    other = Hooked.start()
    other.stop()
    assert heard.wait(4)[2:] == ["on_start", "on_stop"]


def test_an_async_handler_awaits_other_actors_while_they_run_on_the_same_loop() -> None:
    inner = AsyncEcho.start()

    async def relay() -> Any:
        return await inner.ask("through", block=False)

    assert AsyncEcho.start().ask(lambda _: relay()) == "through"


def test_a_full_mailbox_refuses_messages_but_not_the_stop() -> None:
    class Small(Echo):
        mailbox_limit = 3

    gate = Gate()
    ref = Small.start()
    ref.tell(lambda _: gate())
    gate.wait_arrived()
    for number in range(3):
        ref.tell(number)
    with pytest.raises(MailboxFull, match="holds 3 messages") as refused:
        ref.tell("one more")
    assert refused.value.details["limit"] == 3
    with pytest.raises(MailboxFull):
        ref.ask("one more")
    stopped = ref.stop(block=False)
    gate.open()
    assert stopped.get(timeout=10) is True


def test_a_shutdown_overtakes_what_waits_a_normal_stop_does_not() -> None:
    for reason, handled in (("normal", ["waiting"]), ("shutdown", [])):
        seen: list[str] = []
        gate = Gate()
        ref = Echo.start()
        ref.tell(lambda _, gate=gate: gate())
        gate.wait_arrived()
        ref.tell(lambda _, seen=seen: seen.append("waiting"))
        stopped = ref.stop(block=False, reason=reason)  # type: ignore[call-overload]
        gate.open()
        assert stopped.get(timeout=10) is True
        assert seen == handled


def test_ten_thousand_messages_are_handled_within_a_few_worker_runs() -> None:
    threads: set[int] = set()
    ref = Echo.start()
    for _ in range(10_000):
        ref.tell(lambda _: threads.add(threading.get_ident()))
    ref.ask("done")
    assert len(threads) <= 5


# -- exits -------------------------------------------------------------------------------------------------------------


def _exit_of(dispatcher: Dispatcher, cls: type[Actor], act: Callable[[Any], Any]) -> ExitReport:
    exits = Calls()
    act(dispatcher.run(cls.launch(on_exit=exits)))
    report = exits.wait()[0]
    assert len(exits) == 1
    return report


def test_an_exit_is_reported_as_normal_when_the_actor_stops_itself(dispatcher: Dispatcher) -> None:
    report = _exit_of(dispatcher, Echo, lambda ref: ref.tell(lambda actor: actor.stop()))
    assert (report.reason, report.exception) == ("normal", None)


def test_an_exit_is_reported_as_shutdown_when_the_actor_says_so(dispatcher: Dispatcher) -> None:
    report = _exit_of(dispatcher, Echo, lambda ref: ref.tell(lambda actor: actor.stop(reason="shutdown")))
    assert report.reason == "shutdown"


def test_an_exit_by_an_exception_is_abnormal_with_its_traceback(dispatcher: Dispatcher) -> None:
    def fail(_actor: Any) -> None:
        raise ValueError("broken part")

    report = _exit_of(dispatcher, Echo, lambda ref: ref.tell(fail))
    assert (report.reason, report.detail) == ("abnormal", "ValueError: broken part")
    assert isinstance(report.exception, ValueError)
    assert "in fail" in report.traceback


def test_an_exception_in_on_stop_is_an_abnormal_exit(dispatcher: Dispatcher) -> None:
    class Untidy(Actor):
        def on_stop(self) -> None:
            raise ValueError("untidy")

    assert _exit_of(dispatcher, Untidy, lambda ref: ref.stop()).reason == "abnormal"


@pytest.mark.parametrize(
    ("error", "reason", "hook"),
    [
        (SystemExit(0), "normal", "on_stop"),
        (SystemExit(), "normal", "on_stop"),
        (SystemExit(3), "abnormal", "on_failure"),
        (KeyboardInterrupt(), "abnormal", "on_failure"),
    ],
    ids=["exit 0", "exit", "exit 3", "interrupt"],
)
@pytest.mark.parametrize("base", [Echo, AsyncEcho])
def test_system_exit_in_a_handler_ends_this_actor_alone(
    dispatcher: Dispatcher, base: type[Actor], error: BaseException, reason: str, hook: str
) -> None:
    heard = Calls()

    class Leaves(base):  # type: ignore[valid-type, misc]
        def on_stop(self) -> None:
            heard("on_stop")

        def on_failure(self, exception_type: Any, exception_value: Any, traceback: Any) -> None:
            heard("on_failure")

    def leave(_actor: Any) -> None:
        raise error

    bystander = Echo.start()
    assert _exit_of(dispatcher, Leaves, lambda ref: ref.tell(leave)).reason == reason
    assert heard.items == [hook]
    asked = Leaves.start()
    with pytest.raises(pykka.ActorDeadError, match="while it handled"):
        asked.ask(leave)
    assert bystander.ask("alive") == "alive"


def test_an_exit_callback_runs_on_the_loop_when_all_is_over(dispatcher: Dispatcher) -> None:
    seen = Calls()

    def on_exit(_report: ExitReport) -> None:
        seen((threading.current_thread().name, pykka.ActorRegistry.get_all()))

    ref: Any = dispatcher.run(Echo.launch(on_exit=on_exit))
    ref.stop()
    assert seen.wait() == [("rr-loop", [])]


def test_all_stops_are_answered_before_the_exit_callback_which_may_end_the_process(dispatcher: Dispatcher) -> None:
    unanswered = Calls()
    exiting = threading.Event()
    gate = Gate()
    stops: list[Any] = []

    def on_exit(_report: ExitReport) -> None:
        unanswered(sum(not stop.done() for stop in stops))
        exiting.set()

    ref: Any = dispatcher.run(Echo.launch(on_exit=on_exit))
    ref.tell(gate)
    stops += [ref.stop(block=False) for _ in range(2)]
    stops[0].when_set(lambda: exiting.wait(0.2))  # the answer to the second one takes as long as this
    gate.open()
    assert unanswered.wait() == [0]
    assert [stop.get(timeout=5) for stop in stops] == [True, True]


def test_an_answer_to_a_stop_that_cannot_be_set_keeps_the_end_from_nobody(
    dispatcher: Dispatcher, caplog: pytest.LogCaptureFixture
) -> None:
    exits, gate = Calls(), Gate()
    with caplog.at_level(logging.ERROR, "rr_actors"):
        ref: Any = dispatcher.run(Echo.launch(on_exit=exits))
        ref.tell(gate)
        stops = [ref.stop(block=False) for _ in range(3)]
        stops[1].set(True)  # as a program may do
        gate.open()
        assert [report.reason for report in exits.wait()] == ["normal"]
        assert [stop.get(timeout=5) for stop in stops] == [True, True, True]
        eventually(lambda: "Full" in caplog.text)


def test_an_exit_callback_that_raises_is_logged(dispatcher: Dispatcher, caplog: pytest.LogCaptureFixture) -> None:
    def on_exit(_report: ExitReport) -> None:
        raise ValueError("deaf")

    with caplog.at_level(logging.ERROR, "rr_actors"):
        ref: Any = dispatcher.run(Echo.launch(on_exit=on_exit))
        ref.stop()
        eventually(lambda: "deaf" in caplog.text)


# -- rings of asks -----------------------------------------------------------------------------------------------------


def _relay(*refs: ActorRef[Any]) -> Callable[[Any], Any]:
    """A message that makes each actor ask the next one, blocking."""
    return (lambda _: refs[0].ask(_relay(*refs[1:]))) if refs else (lambda _: "arrived")


def test_an_actor_that_asks_itself_gets_an_error_that_names_it() -> None:
    ref = Echo.start()
    with pytest.raises(UsageError, match="asks itself") as refused:
        ref.ask(_relay(ref))
    assert f"Echo ({ref.actor_urn})" in str(refused.value)
    assert ref.ask("alive") == "alive"


def test_an_actor_that_waits_for_a_future_of_its_own_or_stops_itself_blocking_gets_the_error_too() -> None:
    ref = Echo.start()
    with pytest.raises(UsageError, match="asks itself"):
        ref.ask(lambda actor: actor.actor_ref.ask("later", block=False).get())
    with pytest.raises(UsageError, match="asks itself"):
        ref.ask(lambda actor: actor.actor_ref.stop())
    assert ref.ask("alive") == "alive"


def test_a_ring_of_asks_is_an_error_that_names_the_ring() -> None:
    a, b, c = Echo.start(), Echo.start(), Echo.start()
    with pytest.raises(UsageError, match="ring of asks") as refused:
        a.ask(_relay(b, c, a))
    names = [str(ref) for ref in (a, b, c, a)]
    assert refused.value.details["ring"] == tuple(names)
    assert " → ".join(names) in str(refused.value)
    assert [ref.ask("alive") for ref in (a, b, c)] == ["alive"] * 3


def test_a_ring_of_hundreds_of_actors_is_found_too() -> None:
    refs = [Echo.start() for _ in range(300)]
    with pytest.raises(UsageError, match="ring of asks") as refused:
        refs[0].ask(_relay(*refs[1:], refs[0]))
    assert len(refused.value.details["ring"]) == 301

    def ask_by_future(rest: list[ActorRef[Any]]) -> Callable[[Any], Any]:
        return lambda _: rest[0].ask(ask_by_future(rest[1:]), block=False).get() if rest else None

    with pytest.raises(UsageError, match="ring of asks"):
        refs[0].ask(ask_by_future([*refs[1:], refs[0]]))


def test_a_ring_that_futures_close_is_an_error_as_well() -> None:
    a, b = Echo.start(), Echo.start()

    def ask_back(_actor: Any) -> Any:
        return a.ask("back", block=False).get()

    def ask_there(_actor: Any) -> Any:
        return b.ask(ask_back, block=False).get()

    with pytest.raises(UsageError, match="ring of asks"):
        a.ask(ask_there)


def test_a_ring_of_async_handlers_is_an_error_as_well() -> None:
    a, b = AsyncEcho.start(), AsyncEcho.start()

    async def ask_back() -> Any:
        return await a.ask("back", block=False)

    async def ask_there() -> Any:
        return await b.ask(lambda _: ask_back(), block=False)

    with pytest.raises(UsageError, match="ring of asks"):
        a.ask(lambda _: ask_there())


def test_two_actors_that_ask_each_other_at_the_same_time_do_not_hang() -> None:
    for _ in range(20):
        a, b = Echo.start(), Echo.start()
        barrier = threading.Barrier(2)

        def ask_other(other: ActorRef[Any], barrier: threading.Barrier = barrier) -> Any:
            barrier.wait(10)
            try:
                return other.ask("hello")
            except UsageError:
                return "ring"

        first = a.ask(lambda _, ask=ask_other, other=b: ask(other), block=False)
        second = b.ask(lambda _, ask=ask_other, other=a: ask(other), block=False)
        assert sorted([first.get(timeout=10), second.get(timeout=10)]) == ["hello", "ring"]


def test_asking_an_actor_again_that_has_answered_already_is_no_ring() -> None:
    a, b = Echo.start(), Echo.start()
    answers = Calls()

    def ask_and_let_it_ask_back(_actor: Any) -> Any:
        future = b.ask("first", block=False)
        b.tell(lambda _: answers(a.ask("back")))  # b asks as soon as it has answered, while a is still waking up
        return future.get()

    for count in range(200):
        assert a.ask(ask_and_let_it_ask_back) == "first"
        assert answers.wait(count + 1)[-1] == "back"


def test_a_task_that_outlives_its_handler_may_ask_the_actor_that_started_it() -> None:
    class Background(Actor):
        def __init__(self) -> None:
            self.tasks: list[asyncio.Task[Any]] = []
            self.over = asyncio.Event()

        async def begin(self) -> None:
            self.tasks.append(asyncio.create_task(self._ask_later()))

        async def _ask_later(self) -> None:
            await self.over.wait()
            answers(await self.actor_ref.ask("hello", block=False))

        async def end(self) -> None:
            self.over.set()

        def on_receive(self, message: Any) -> Any:
            return message

    answers = Calls()
    ref = Background.start()
    ref.proxy().begin().get()
    ref.proxy().end().get()
    assert answers.wait() == ["hello"]


def test_a_blocking_ask_on_the_loop_or_in_an_async_handler_is_refused(dispatcher: Dispatcher) -> None:
    ref = Echo.start()
    outcome = Calls()

    def ask() -> None:
        for block in (lambda: ref.ask("x"), lambda: ref.stop(), lambda: ref.ask(gate_message, block=False).get()):
            try:
                outcome(block())
            except UsageError as error:
                outcome(error)

    gate = Gate()

    def gate_message(_actor: Any) -> None:
        gate()

    dispatcher.call(ask)
    assert [type(item) for item in outcome.wait(3)] == [UsageError] * 3
    gate.open()
    with pytest.raises(UsageError, match="block=False"):
        AsyncEcho.start().ask(lambda _: ref.ask("x"))


# -- actors of the framework -------------------------------------------------------------------------------------------


def test_a_loop_actor_handles_its_messages_on_the_loop_without_a_worker(dispatcher: Dispatcher) -> None:
    ref = LoopEcho.start()
    assert ref.ask(lambda _: threading.current_thread().name) == "rr-loop"
    assert len(dispatcher.workers.threads) == 0
    assert ref.proxy().mailbox_limit.get() == 100_000
    assert ref.stop() is True


def test_an_async_handler_of_a_loop_actor_holds_up_only_that_actor() -> None:
    class Waiting(LoopActor):
        def __init__(self) -> None:
            self.seen: list[Any] = []

        async def on_receive(self, message: Any) -> Any:
            if message == "wait":
                await gate.wait()
            self.seen.append(message)
            return list(self.seen)

    gate = asyncio.Event()
    slow, quick = Waiting.start(), LoopEcho.start()
    waiting = slow.ask("wait", block=False)
    behind = slow.ask("behind", block=False)
    assert quick.ask("quick") == "quick"
    assert not waiting.done()
    quick.tell(lambda _: gate.set())
    assert waiting.get(timeout=10) == ["wait"]
    assert behind.get(timeout=10) == ["wait", "behind"]


def test_a_loop_actor_with_many_messages_lets_others_have_their_turn(dispatcher: Dispatcher) -> None:
    class Notes(LoopActor):
        def on_receive(self, message: Any) -> Any:
            seen(message)

    seen = Calls()
    busy, other = Notes.start(), Notes.start()

    def burst() -> None:
        for number in range(1000):
            busy.tell(number)
        other.tell("other")

    dispatcher.call(burst)
    order = seen.wait(1001)
    assert order.index("other") == BATCH
    assert [item for item in order if item != "other"] == list(range(1000))


def test_a_thousand_loop_actors_pass_a_message_round_without_a_thread(dispatcher: Dispatcher) -> None:
    class Link(LoopActor):
        def __init__(self, following: ActorRef[Any] | None) -> None:
            self.following = following

        def on_receive(self, message: Any) -> Any:
            if self.following is None:
                arrived(message)
            else:
                self.following.tell(message + 1)

    arrived = Calls()
    ref: ActorRef[Any] | None = None
    for _ in range(1000):
        ref = Link.start(ref)
    assert ref is not None
    ref.tell(0)
    assert arrived.wait() == [999]
    assert len(dispatcher.workers.threads) == 0
