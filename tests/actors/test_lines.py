"""Line by itself, on a transport that the test has in hand: what is sent by which way, and what is held back."""

from __future__ import annotations

import gc
import itertools
import threading
import time
import weakref
from collections import deque
from collections.abc import Callable, Iterator
from typing import Any

import pykka
import pytest

from rr_actors.actors.messaging.ask_cycles import Target
from rr_actors.actors.messaging.futures import Reply
from rr_actors.actors.remote import peer
from rr_actors.actors.remote.peer import Line, PendingCall, Whereabouts
from rr_actors.actors.remote.protocol import ASKS, Answered, Ask, Dead, HandlerRaised, Over, Tell, Watching
from rr_actors.base import pickling
from rr_actors.base.errors import NotSerializable, Unavailable
from rr_actors.runtime.event_loop import Dispatcher
from rr_actors.wire import thread_connections
from rr_actors.wire.segments import Segments
from rr_actors.wire.transport import Hello
from support import Gate, eventually
from support_asks import FakeExchange, answered

HELLO = Hello("actors", "there.sock", "here (pid 1)", 0)
URN = "urn:rr-actor:root/a"
WHERE = Whereabouts(Target(URN, "root/a"), "root/a", "")


def gone(_where: Whereabouts) -> Exception:
    return pykka.ActorDeadError("gone")


class FakeLink:
    """The link of the line: notes what is sent."""

    peer = "there (pid 2)"

    def __init__(self) -> None:
        self.sent: list[Any] = []
        self.closed = False

    def send(self, letter: Any) -> None:
        self.sent.append(letter)

    def flush(self) -> None: ...

    def close(self) -> None:
        self.closed = True


class FakeTransport:
    """Connects at once; what dial() does is the test's."""

    def __init__(self) -> None:
        self.link = FakeLink()
        self.made: list[FakeExchange] = []
        self.hellos: list[Hello] = []
        self.exchange: Callable[[Any, float], Any] = lambda letter, _: answered(letter)
        self.refusal: Exception | None = None
        self.segments = Segments(0)

    async def connect(self, address: str, hello: Hello, attach: Any, **_: Any) -> FakeLink:
        attach(self.link)
        return self.link

    def dial(self, address: str, hello: Hello, timeout_s: float) -> FakeExchange:
        self.hellos.append(hello)
        if self.refusal is not None:
            raise self.refusal
        made = FakeExchange(lambda letter, limit: self.exchange(letter, limit))
        self.made.append(made)
        return made


class Bench:
    """A line whose link is there, and where nothing is on its way."""

    def __init__(self) -> None:
        self.dispatcher = Dispatcher()
        self.transport = FakeTransport()
        self.link = self.transport.link
        self.forgotten: list[Line] = []
        transport: Any = self.transport
        self.line = Line(self.dispatcher, transport, HELLO, gone, self.forgotten.append)
        self._numbers = itertools.count(1)
        self.put_ask()
        self.settle()
        assert self.line.may_ask

    def put_ask(self) -> Reply[Any]:
        reply: Reply[Any] = Reply()
        number = self.line.next_number()
        self.last = number
        self.line.put(Ask(number, URN, b"", ()), PendingCall(number, reply, WHERE))
        self.turn()
        return reply

    def hear(self, letter: Any) -> None:
        """The link brings this."""
        link: Any = self.link
        self.on_loop(lambda: self.line.received(link, letter))

    def settle(self) -> None:
        self.hear(Answered(self.last, b""))

    def ask(self, timeout_s: float | None = 10.0) -> Any:
        return self.line.ask(Ask(self.line.next_number(), URN, b"", ()), timeout_s)

    def tell(self) -> Tell:
        """Put a letter, and let the loop do all it has to do."""
        letter = Tell(URN, b"%d" % next(self._numbers))
        self.line.put(letter)
        self.turn()
        return letter

    def on_loop(self, fn: Callable[[], Any]) -> None:
        async def call() -> None:
            fn()

        self.dispatcher.run(call())

    def turn(self) -> None:
        for _ in range(3):
            self.on_loop(lambda: None)

    def lose(self, reason: Exception | None = None) -> None:
        link: Any = self.link
        self.on_loop(lambda: self.line.lost(link, reason))

    def close(self) -> None:
        assert not self.line.connections.in_use
        if not self.dispatcher.closed:
            self.lose()
            self.dispatcher.close()
        for each in self.transport.made:
            each.here.close()
            each.there.close()


@pytest.fixture
def bench() -> Iterator[Bench]:
    bench = Bench()
    yield bench
    bench.close()


def raising(error: BaseException) -> Callable[[Any, float | None], Any]:
    def exchange(_letter: Any, _limit: float | None) -> Any:
        raise error

    return exchange


# -- which way ---------------------------------------------------------------------------------------------------------


def test_a_thread_asks_by_a_connection_of_its_own_and_the_next_uses_it_again(bench: Bench) -> None:
    sent = len(bench.link.sent)
    assert isinstance(bench.ask(), Answered)
    assert isinstance(bench.ask(), Answered)
    assert [hello.kind for hello in bench.transport.hellos] == [ASKS]
    assert len(bench.transport.made[0].limits) == 2
    assert len(bench.link.sent) == sent


def test_nothing_is_asked_so_before_there_is_a_link() -> None:
    dispatcher = Dispatcher()
    transport: Any = FakeTransport()
    line = Line(dispatcher, transport, HELLO, gone, lambda _: None)
    assert not line.may_ask
    assert line.ask(Ask(1, URN, b"", ()), None) is None
    assert not transport.made
    dispatcher.close()
    assert not line.may_ask


def test_after_a_tell_it_goes_by_the_link_until_one_that_came_later_is_answered(bench: Bench) -> None:
    before = bench.put_ask()
    number = bench.last
    bench.tell()
    assert bench.ask() is None
    bench.hear(Answered(number, pickling.dumps(1)))  # it says nothing of the tell
    assert before.get() == 1
    assert bench.ask() is None
    bench.put_ask()
    assert bench.ask() is None
    bench.settle()
    assert bench.ask() is not None


@pytest.mark.parametrize("kind", [Answered, HandlerRaised, Dead, Over])
def test_each_answer_to_the_last_letter_settles_and_a_watching_does_not(bench: Bench, kind: type[Any]) -> None:
    bench.put_ask()
    bench.hear(Watching(bench.last))
    assert bench.ask() is None
    rest: dict[Any, tuple[Any, ...]] = {Answered: (b"",), HandlerRaised: (b"", "", ""), Dead: (), Over: ("normal", "")}
    bench.hear(kind(bench.last, *rest[kind]))
    assert bench.ask() is not None


def test_the_answer_to_a_call_that_was_given_up_settles_too(bench: Bench) -> None:
    bench.put_ask()
    bench.line.give_up(bench.last)
    bench.turn()
    assert bench.ask() is None
    bench.settle()
    assert bench.ask() is not None


def test_nothing_is_asked_so_after_the_loop_has_ended(bench: Bench) -> None:
    bench.dispatcher.close()
    assert not bench.line.may_ask
    assert bench.ask() is None
    assert not bench.transport.made


def test_a_finalizer_that_tells_may_run_while_its_thread_puts(monkeypatch: pytest.MonkeyPatch) -> None:
    class Waiting(deque[Any]):
        def append(self, item: Any, /) -> None:
            if item[0] is first:
                bench.line.put(second)  # as garbage that is collected here may
            super().append(item)

    first, second = Tell(URN, b"first"), Tell(URN, b"second")
    monkeypatch.setattr(peer, "deque", Waiting)
    bench = Bench()
    putter = threading.Thread(target=lambda: bench.line.put(first), daemon=True)
    putter.start()
    putter.join(10)
    assert not putter.is_alive()
    bench.turn()
    assert bench.link.sent[-2:] == [second, first]
    assert not bench.line.may_ask
    bench.close()


# -- what a thread leaves on its connection ----------------------------------------------------------------------------


@pytest.mark.parametrize("error", [TimeoutError(), KeyboardInterrupt(), SystemExit(), MemoryError()])
def test_nothing_is_sent_by_any_way_until_what_a_thread_has_left_is_read(bench: Bench, error: BaseException) -> None:
    bench.transport.exchange = raising(error)
    with pytest.raises(type(error)):
        bench.ask()
    (left,) = bench.transport.made
    assert not bench.line.may_ask
    assert bench.ask() is None
    letter = bench.tell()
    assert letter not in bench.link.sent
    left.there.send(b"a late answer")
    bench.turn()
    bench.turn()
    assert letter not in bench.link.sent
    left.there.settimeout(10)
    assert left.there.recv(100) == b""  # it has been told that nothing more comes
    left.there.close()
    eventually(lambda: letter in bench.link.sent)
    assert left.is_closed
    bench.put_ask()
    bench.settle()
    bench.transport.exchange = lambda letter, _: answered(letter)
    assert bench.ask() is not None
    assert len(bench.transport.made) == 2


def test_of_several_that_are_left_all_must_have_been_read(bench: Bench) -> None:
    gate, late = Gate(), threading.Barrier(2)

    def exchange(_letter: Any, _limit: float | None) -> Any:
        late.wait(10)
        raise TimeoutError

    bench.transport.exchange = exchange

    def ask() -> None:
        with pytest.raises(TimeoutError):
            bench.ask()
        gate()

    threads = [threading.Thread(target=ask) for _ in range(2)]
    for thread in threads:
        thread.start()
    gate.wait_arrived(2)
    gate.open()
    for thread in threads:
        thread.join()
    first, second = bench.transport.made
    letter = bench.tell()
    first.there.close()
    eventually(lambda: first.is_closed)
    bench.turn()
    assert letter not in bench.link.sent
    second.there.close()
    eventually(lambda: letter in bench.link.sent)


def test_what_is_left_when_the_link_is_lost_is_let_go(bench: Bench) -> None:
    bench.transport.exchange = raising(TimeoutError())
    with pytest.raises(TimeoutError):
        bench.ask()
    waiting = bench.put_ask()
    bench.lose()
    assert bench.transport.made[0].is_closed
    with pytest.raises(pykka.ActorDeadError):
        waiting.get(timeout=1)
    assert bench.forgotten == [bench.line]


def test_what_is_left_just_after_the_link_was_lost_holds_nothing_up(bench: Bench) -> None:
    left_and_put = threading.Event()
    late = Tell(URN, b"late")

    def hold_up() -> None:
        assert left_and_put.wait(10)

    def exchange(_letter: Any, _limit: float | None) -> Any:
        bench.lose()
        bench.dispatcher.call(hold_up)
        bench.line.put(late)  # by a thread that had the line before it was forgotten; looked at before the other
        raise TimeoutError

    bench.transport.exchange = exchange
    with pytest.raises(TimeoutError):
        bench.ask()
    left_and_put.set()
    eventually(lambda: late in bench.link.sent)
    assert bench.transport.made[0].is_closed


def test_what_is_left_when_the_loop_has_ended_is_closed(bench: Bench) -> None:
    def exchange(_letter: Any, _limit: float | None) -> Any:
        bench.dispatcher.close()
        raise TimeoutError

    bench.transport.exchange = exchange
    with pytest.raises(TimeoutError):
        bench.ask()
    assert bench.transport.made[0].is_closed
    left = weakref.ref(bench.transport.made.pop())
    gc.collect()
    assert left() is None  # nor does the line keep it


# -- answers -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "wrong", [Answered(0, b""), HandlerRaised(0, b"", "", ""), Dead(0), Over(1, "", ""), Tell(URN, b"")]
)
def test_what_is_not_the_answer_to_this_question_reaches_nobody(bench: Bench, wrong: Any) -> None:
    bench.transport.exchange = lambda _letter, _limit: wrong
    with pytest.raises(ConnectionResetError, match="instead of the answer"):
        bench.ask()
    assert bench.transport.made[0].is_closed
    bench.transport.exchange = lambda letter, _: answered(letter)
    assert bench.ask() is not None
    assert len(bench.transport.made) == 2


def test_a_connection_that_is_lost_is_closed_and_holds_nothing_up(bench: Bench) -> None:
    bench.transport.exchange = raising(BrokenPipeError())
    with pytest.raises(OSError):
        bench.ask()
    assert bench.transport.made[0].is_closed
    assert bench.tell() in bench.link.sent


def test_a_message_that_is_too_long_leaves_the_connection_as_it_was(bench: Bench) -> None:
    bench.transport.exchange = raising(NotSerializable("too long", path="Ask"))
    with pytest.raises(NotSerializable):
        bench.ask()
    bench.transport.exchange = lambda letter, _: answered(letter)
    assert bench.ask() is not None
    assert len(bench.transport.made) == 1
    assert bench.tell() in bench.link.sent


def test_threads_that_wait_hear_that_the_link_is_lost(bench: Bench) -> None:
    def exchange(_letter: Any, _limit: float | None) -> Any:
        assert bench.transport.made[0].was_cut.wait(10)
        raise ConnectionResetError

    bench.transport.exchange = exchange
    loser = threading.Thread(target=lambda: (eventually(lambda: bench.transport.made), bench.lose()))
    loser.start()
    with pytest.raises(ConnectionResetError):
        bench.ask()
    loser.join()
    assert bench.transport.made[0].is_closed
    assert bench.ask() is None


# -- the connections ---------------------------------------------------------------------------------------------------


def test_dialling_takes_from_the_time_limit(bench: Bench) -> None:
    dial = bench.transport.dial

    def slowly(address: str, hello: Hello, timeout_s: float) -> FakeExchange:
        assert timeout_s <= 0.05
        time.sleep(0.02)
        return dial(address, hello, timeout_s)

    bench.transport.dial = slowly
    bench.ask(0.05)
    (limit,) = bench.transport.made[0].limits
    assert limit is not None
    assert limit <= 0.03
    bench.ask(None)
    assert bench.transport.made[0].limits[1] is None


def test_who_does_not_answer_when_dialled_is_not_dialled_again_for_a_second(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    now = time.monotonic()

    class Clock:
        monotonic = staticmethod(lambda: now)

    monkeypatch.setattr(thread_connections, "time", Clock)
    bench.transport.refusal = Unavailable("busy")
    assert bench.ask() is None
    bench.transport.refusal = None
    assert bench.ask() is None
    now += 0.99
    assert bench.ask() is None
    assert len(bench.transport.hellos) == 1
    now += 0.02
    assert bench.ask() is not None
    assert len(bench.transport.hellos) == 2
