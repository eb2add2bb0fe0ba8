"""BlockingLink: the connection that a thread writes and reads itself."""

from __future__ import annotations

import os
import socket
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import msgspec
import pytest

from rr_actors.base.errors import NotSerializable, Unavailable
from rr_actors.runtime.event_loop import Dispatcher
from rr_actors.runtime.time_limits import deadline_of
from rr_actors.wire.segments import Segments
from rr_actors.wire.thread_connections import BlockingLink
from rr_actors.wire.transport import Link, Welcome
from rr_actors.wire.unix_link import Wire
from rr_actors.wire.unix_sockets import SocketDir
from rr_actors.wire.unix_transport import UnixTransport
from support import Calls, eventually
from support_asks import Background
from support_transports import HELLO, KEY, Note

LONG = Note(1, os.urandom(4_000_000))
SHORT = Note(2)


class Peer:
    """The other end: a link on a loop of its own. `answer` is what it does with a message."""

    def __init__(self, directory: Path) -> None:
        self.directory = directory
        self.dispatcher = Dispatcher()
        self.transport = UnixTransport(directory, KEY, {HELLO.kind: Note})
        self.messages = Calls()
        self.lost_reasons = Calls()
        self.links: list[Link] = []
        self.answer: Callable[[Link, Note], None] = self.echo
        self.dispatcher.run(self.transport.listen(lambda _: (Welcome(42), self._attach)))

    def _attach(self, link: Link) -> Peer:
        self.links.append(link)
        return self

    def received(self, link: Link, message: Note) -> None:
        self.messages(message)
        self.answer(link, message)

    def lost(self, link: Link, reason: Exception | None) -> None:
        self.lost_reasons(reason)

    @staticmethod
    def echo(link: Link, message: Note) -> None:
        link.send(message)
        link.flush()

    def dial(self, limit_s: float = 10.0) -> BlockingLink:
        return self.transport.dial(self.transport.address, HELLO, limit_s)

    def hang(self) -> threading.Event:
        """Its loop does nothing until the event is set."""
        hangs, goes_on = threading.Event(), threading.Event()
        self.dispatcher.call(lambda: (hangs.set(), goes_on.wait(20)))
        assert hangs.wait(10)
        return goes_on

    def close(self) -> None:
        self.dispatcher.run(self.transport.close())
        self.dispatcher.close()


@pytest.fixture
def peer(tmp_path: Path) -> Iterator[Peer]:
    peer = Peer(tmp_path)
    yield peer
    peer.close()


@pytest.fixture
def line(peer: Peer) -> Iterator[BlockingLink]:
    line = peer.dial()
    yield line
    line.close()


def silent(_link: Link, _message: Note) -> None: ...


@pytest.mark.parametrize("limit_s", [None, 10.0])
@pytest.mark.parametrize("message", [SHORT, LONG], ids=["short", "long"])
def test_messages_of_any_length_go_there_and_back(line: BlockingLink, message: Note, limit_s: float | None) -> None:
    assert line.epoch == 42
    for _ in range(3):
        assert line.exchange(message, deadline_of(limit_s)) == message


def test_a_long_message_to_who_does_not_read_is_given_up_in_time(peer: Peer, line: BlockingLink) -> None:
    goes_on = peer.hang()
    writer = Background(lambda: line.exchange(LONG, deadline_of(0.05)))
    with pytest.raises(TimeoutError):
        writer.result(timeout=5)
    goes_on.set()
    assert not peer.messages.items


def test_a_message_that_the_kernel_has_no_room_for_is_given_up_in_time_however_short(
    peer: Peer, line: BlockingLink
) -> None:
    with socket.socket(fileno=os.dup(line.fileno())) as same:
        same.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 4096)
    goes_on = peer.hang()
    writer = Background(lambda: line.exchange(Note(3, b"x" * 60_000), deadline_of(0.05)))
    with pytest.raises(TimeoutError):
        writer.result(timeout=5)
    goes_on.set()


def test_writing_and_waiting_have_one_time_limit(peer: Peer, line: BlockingLink) -> None:
    def answer_late(link: Link, message: Note) -> None:
        peer.dispatcher.loop.call_later(0.2, peer.echo, link, message)

    peer.answer = answer_late
    for limit_s in (20.0, None):
        peer.dispatcher.call(time.sleep, 0.2)  # it cannot all be written before
        line.exchange(LONG, deadline_of(limit_s))
    peer.dispatcher.call(time.sleep, 0.2)
    with pytest.raises(TimeoutError):  # neither alone takes as long
        line.exchange(LONG, deadline_of(0.3))


def test_the_beginning_and_the_rest_of_an_answer_have_one_time_limit(peer: Peer, line: BlockingLink) -> None:
    goes_on = threading.Event()

    def answer_the_beginning(link: Link, _message: Note) -> None:
        time.sleep(2.0)
        peer.echo(link, LONG)  # as much as the kernel takes
        goes_on.wait(20)

    peer.answer = answer_the_beginning
    began = time.monotonic()
    with pytest.raises(TimeoutError):
        line.exchange(SHORT, deadline_of(2.4))
    goes_on.set()
    assert time.monotonic() - began < 2.0 + 2.4 - 0.5  # two limits would end half a second later


@pytest.mark.parametrize("message", [SHORT, LONG], ids=["waits", "writes"])
@pytest.mark.parametrize("by", ["cut", "peer"])
def test_a_thread_hears_that_the_connection_is_lost(peer: Peer, line: BlockingLink, message: Note, by: str) -> None:
    peer.answer = silent
    goes_on = peer.hang() if message is LONG and by == "cut" else threading.Event()
    waiting = Background(lambda: line.exchange(message, deadline_of(None)))
    if by == "cut":
        if message is SHORT:
            peer.messages.wait()
        line.cut()
    else:
        peer.dispatcher.call(lambda: peer.links[0].close())
    with pytest.raises(OSError):
        waiting.result(timeout=5)
    goes_on.set()
    line.cut()  # again is nothing


def test_a_message_over_the_limit_leaves_it_as_it_was(peer: Peer) -> None:
    wire = Wire(msgspec.msgpack.Decoder(Note), 100)
    sockets = SocketDir(peer.directory)
    line = BlockingLink(sockets, KEY, peer.transport.address, HELLO, wire, 5.0, Segments(0))
    with pytest.raises(NotSerializable, match="100"):
        line.exchange(LONG, deadline_of(1.0))
    assert line.exchange(SHORT, deadline_of(1.0)) == SHORT
    line.close()
    sockets.close()


def test_who_leaves_is_read_to_the_end_and_hears_when_that_is_done(peer: Peer, line: BlockingLink) -> None:
    peer.answer = silent
    goes_on = peer.hang()
    with pytest.raises(TimeoutError):
        line.exchange(Note(3, b"x" * 50_000), deadline_of(0.0))
    line.leave()
    assert not line.has_ended()
    goes_on.set()
    eventually(line.has_ended)
    assert peer.messages.items == [Note(3, b"x" * 50_000)]
    line.leave()  # again is nothing


def test_late_answers_are_no_end(peer: Peer, line: BlockingLink) -> None:
    def answer_late(link: Link, message: Note) -> None:
        link.send(message)
        link.send(message)
        link.flush()

    peer.answer = answer_late
    goes_on = peer.hang()
    with pytest.raises(TimeoutError):
        line.exchange(Note(3, b"x" * 60_000), deadline_of(0.0))
    goes_on.set()
    peer.messages.wait()
    peer.dispatcher.run(_nothing())
    assert not line.has_ended()
    assert not line.has_ended()
    line.leave()
    eventually(line.has_ended)


async def _nothing() -> None: ...


def test_a_lost_connection_has_ended(peer: Peer, line: BlockingLink) -> None:
    peer.dispatcher.call(lambda: peer.links[0].close())
    eventually(line.has_ended)


def test_dialling_who_hangs_or_is_not_there_is_refused_in_time(peer: Peer) -> None:
    goes_on = peer.hang()
    began = time.monotonic()
    with pytest.raises(Unavailable):
        peer.dial(0.02)
    assert time.monotonic() - began < 5
    goes_on.set()
    with pytest.raises(Unavailable, match="nobody"):
        peer.transport.dial("1-00000000.sock", HELLO, 1.0)
