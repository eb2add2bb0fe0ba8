"""Broken and hostile programs at the console: each is cut off or bounded, and nobody else notices."""

from __future__ import annotations

import contextlib
import fcntl
import os
import pickle
import socket
import struct
import termios
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import msgspec
import pytest

import rr_actors as rr
from rr_actors.base.errors import Unavailable
from rr_actors.base.values.canonical import encode
from rr_actors.system.console import console_connection, console_server
from rr_actors.system.console.console_commands import Hold, Load
from rr_actors.system.console.console_connection import ConsoleConnection, find_console
from rr_actors.system.console.console_messages import (
    ANSWER_LIMIT_BYTES,
    REQUEST_LIMIT_BYTES,
    VERSION,
    Children,
    Follow,
    Hello,
    Keep,
    Refused,
    Resources,
    Welcome,
)
from rr_actors.system.console.console_protocol import ANSWERS, decoder_of
from rr_actors.system.console.console_questions import ListChildren, ListResources
from rr_actors.wire import unix_sockets
from rr_actors.wire.frames import FrameReader, framed
from support import Gate, Served, eventually, serve
from support_inside import console_of, node_of

pytestmark = pytest.mark.usefixtures("runtime_dir")

Start = Callable[..., rr.System]
HELLO = framed(Hello(VERSION), 1000)


@pytest.fixture
def dialled(system: rr.System, state_dir: Path) -> Iterator[Callable[[], socket.socket]]:
    """Connect to the console's socket without a word."""
    with contextlib.ExitStack() as stack:

        def connect() -> socket.socket:
            peer = stack.enter_context(socket.socket(socket.AF_UNIX))
            peer.connect(str(find_console(state_dir) / "console.sock"))  # waits, if many have not been accepted yet
            peer.settimeout(15.0)
            return peer

        yield connect


def said_until_cut_off(peer: socket.socket) -> list[Any]:
    """The answers until the other end closes the connection."""
    reader = FrameReader[Any](decoder_of(ANSWERS), ANSWER_LIMIT_BYTES)
    answers: list[Any] = []
    with contextlib.suppress(ConnectionError):
        while data := peer.recv(65536):
            answers += reader.feed(data)
    return answers


def assert_unharmed(state_dir: Path) -> None:
    """Another connection is answered at once."""
    with ConsoleConnection(find_console(state_dir), timeout_s=5.0) as connection:
        assert connection.children().rows


def packed(value: object) -> bytes:
    body = msgspec.msgpack.encode(value)
    return struct.pack(">I", len(body)) + body


WORDS = {
    "a giant length": b"\xff\xff\xff\xff" + bytes(100),
    "one byte more than the limit": struct.pack(">I", REQUEST_LIMIT_BYTES + 1),
    "HTTP": b"GET / HTTP/1.1\r\n\r\n",
    "no MessagePack": struct.pack(">I", 3) + b"\xc1\xc1\xc1",
    "nested too deeply": struct.pack(">I", 100_000) + b"\x91" * 100_000,
    "an unknown request": packed({"is": "explode"}),
    "an answer": framed(Welcome(1, "x", 1, "/", 0.0), 1000),
    "an empty frame": bytes(4),
    "a list": packed([1, 2]),
    "a wrong type": packed({"is": "hello", "version": "one"}),
    "a negative page": packed({"is": "listchildren", "offset": -1}),
    "too large a page": packed({"is": "listchildren", "limit": 10**9}),
    "a pickle": struct.pack(">I", len(pickle.dumps(os.getcwd))) + pickle.dumps(os.getcwd),
}


@pytest.mark.parametrize("greeting", [b"", HELLO], ids=["at once", "after Hello"])
@pytest.mark.parametrize("words", WORDS.values(), ids=WORDS)
def test_who_breaks_the_rules_is_told_and_cut_off(
    dialled: Callable[[], socket.socket], state_dir: Path, words: bytes, greeting: bytes
) -> None:
    peer = dialled()
    if greeting:
        peer.sendall(greeting)
        assert peer.recv(1000)
    peer.sendall(words)

    (said,) = said_until_cut_off(peer)

    assert isinstance(said, Refused)
    assert_unharmed(state_dir)


def test_a_keep_is_no_greeting(dialled: Callable[[], socket.socket]) -> None:
    peer = dialled()
    peer.sendall(framed(Keep(), 1000))

    (said,) = said_until_cut_off(peer)

    assert isinstance(said, Refused)
    assert f"expected Hello of version {VERSION}, got Keep" in said.failure.message


@pytest.mark.parametrize("begin", [b"", HELLO[:3], HELLO[:-1], HELLO + b"\0\0", HELLO + b"\0\0\1\0abc"])
def test_who_stops_in_the_middle_of_a_frame_is_cut_off(
    dialled: Callable[[], socket.socket], state_dir: Path, begin: bytes, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(console_server, "FRAME_S", 0.3)
    peer = dialled()
    peer.sendall(begin)

    said_until_cut_off(peer)

    assert_unharmed(state_dir)


def test_who_drips_is_cut_off_all_the_same(
    dialled: Callable[[], socket.socket], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(console_server, "FRAME_S", 0.5)
    peer, began = dialled(), time.monotonic()
    peer.sendall(HELLO + struct.pack(">I", 1000))

    with pytest.raises(ConnectionError):  # noqa: PT012 - until it happens
        while time.monotonic() - began < 10:
            peer.sendall(b"x")
            time.sleep(0.02)


def test_who_is_quiet_after_its_greeting_stays(
    dialled: Callable[[], socket.socket], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(console_server, "FRAME_S", 0.5)
    peer = dialled()
    peer.sendall(HELLO)
    assert peer.recv(1000)

    assert said_until_cut_off(dialled()) == []  # which took longer than FRAME_S
    peer.sendall(framed(ListChildren(), 1000))

    assert peer.recv(1000)


def test_a_hundred_silent_connections_harm_nobody_and_more_than_there_is_room_for_are_told(
    dialled: Callable[[], socket.socket], state_dir: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    silent = [dialled() for _ in range(100)]
    assert_unharmed(state_dir)
    monkeypatch.setattr(console_server, "SOCKETS_LIMIT", 100)

    (refused,) = said_until_cut_off(dialled())

    assert "100 consoles are connected already" in refused.failure.message
    silent.pop().close()
    eventually(lambda: _is_unharmed(state_dir))


def _is_unharmed(state_dir: Path) -> bool:
    try:
        assert_unharmed(state_dir)
    except Unavailable:
        return False
    return True


def test_a_connection_that_asks_on_and_on_and_never_reads_has_one_answer_waiting_and_is_cut_off(
    system: rr.System, app: rr.Registrar, served: Served, dialled: Callable[[], socket.socket], state_dir: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    monkeypatch.setattr(console_server, "STALLED_S", 1.0)
    app.load_all([("provider/thing", "x" * 300 + str(number)) for number in range(500)])
    peer = dialled()
    peer.sendall(HELLO)
    peer.setblocking(False)
    request = framed(ListResources(), 1000)
    console = console_of(system)
    eventually(lambda: console.sockets and not console.programs[""])  # its Hello was read
    (far_end,) = console.sockets
    with contextlib.suppress(ConnectionError):
        for _ in range(100_000):
            with contextlib.suppress(BlockingIOError):
                peer.send(request)
            if far_end.is_gone:
                break
            assert far_end.unread_bytes < 2**20

    eventually(lambda: far_end.is_gone)
    assert_unharmed(state_dir)


def test_many_requests_at_once_are_answered_in_their_order(
    system: rr.System, app: rr.Registrar, served: Served, dialled: Callable[[], socket.socket]
) -> None:
    peer = dialled()
    peer.sendall(HELLO + framed(ListChildren(), 1000) * 20 + framed(ListResources(), 1000))
    reader = FrameReader[Any](decoder_of(ANSWERS), ANSWER_LIMIT_BYTES)
    answers: list[Any] = []
    while len(answers) < 22:
        answers += reader.feed(peer.recv(65536))

    assert [type(answer) for answer in answers] == [Welcome, *[Children] * 20, Resources]


@pytest.mark.parametrize("before", [b"", framed(ListChildren(), 1000)], ids=["at once", "behind a request"])
def test_a_request_after_follow_is_refused(
    dialled: Callable[[], socket.socket], system: rr.System, before: bytes
) -> None:
    peer = dialled()
    peer.sendall(HELLO + before + framed(Follow(), 1000))
    node = node_of(system)
    eventually(lambda: bool(node.watched))
    peer.sendall(framed(ListChildren(), 1000))

    assert isinstance(said_until_cut_off(peer)[-1], Refused)
    eventually(lambda: not node.watched)


def test_another_version_is_refused_by_name(system: rr.System, dialled: Callable[[], socket.socket]) -> None:
    peer = dialled()
    peer.sendall(framed(Hello(VERSION + 1), 1000))

    (refused,) = said_until_cut_off(peer)

    assert f"expected Hello of version {VERSION}, got version {VERSION + 1}" in refused.failure.message


def test_a_process_of_another_user_is_cut_off_without_a_word(
    dialled: Callable[[], socket.socket], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(console_server, "peer_of", lambda transport: unix_sockets.SocketPeer(4711, 12345))
    peer = dialled()

    assert said_until_cut_off(peer) == []


def test_a_connection_does_not_speak_to_another_users_system(
    system: rr.System, state_dir: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    place = find_console(state_dir)
    monkeypatch.setattr(console_connection, "peer_at", lambda connected: unix_sockets.SocketPeer(4711, 12345))

    with pytest.raises(Unavailable, match="got one of user 12345"):
        ConsoleConnection(place)


@pytest.fixture
def secrets(monkeypatch: pytest.MonkeyPatch) -> list[bytes]:
    """The random bytes that this process makes from now on."""
    secrets, urandom = list[bytes](), os.urandom

    def noted(count: int) -> bytes:
        secrets.append(made := urandom(count))
        return made

    monkeypatch.setattr(os, "urandom", noted)
    return secrets


def test_no_answer_has_a_key_of_the_system(secrets: list[bytes], dialled: Callable[[], socket.socket]) -> None:
    peer = dialled()
    peer.sendall(HELLO + framed(ListChildren(), 1000) + framed(ListResources(), 1000) + b"\xff" * 8)
    heard = b""
    with contextlib.suppress(ConnectionError):
        while data := peer.recv(65536):
            heard += data

    assert len(heard) > 100
    keys = [secret for secret in secrets if len(secret) == 32]
    assert keys
    assert not any(key in heard or key.hex().encode() in heard for key in keys)


WAITS_FROM_BYTES = 64 * 1024  # as asyncio's transports have it


def leave_unread(system: rr.System, app: rr.Registrar, peer: socket.socket) -> Any:
    """Ask until an answer waits in the server, but not yet so much that the server waits; return the server's end."""
    app.load_all([("provider/thing", "x" * 300 + str(number)) for number in range(30)])
    peer.sendall(HELLO)
    assert peer.recv(1000)
    console = console_of(system)
    (far_end,) = console.sockets
    with ConsoleConnection(find_console(system.state_dir)) as connection:
        length = len(framed(connection.ask(ListResources()), ANSWER_LIMIT_BYTES))
    for number in range(1, 1000):
        peer.sendall(framed(ListResources(), 1000))
        eventually(lambda number=number: _waiting(peer) + far_end.unread_bytes == number * length)
        if far_end.unread_bytes:
            break
    assert far_end.unread_bytes < WAITS_FROM_BYTES
    return far_end


def _waiting(peer: socket.socket) -> int:
    return struct.unpack("i", fcntl.ioctl(peer, termios.FIONREAD, bytes(4)))[0]


def break_the_rules(peer: socket.socket) -> None:
    peer.sendall(b"\xff" * 8)


def send_no_more(peer: socket.socket) -> None:
    peer.shutdown(socket.SHUT_WR)


@pytest.mark.parametrize("how", [break_the_rules, send_no_more])
def test_a_connection_that_is_to_leave_and_does_not_read_is_cut_off(
    system: rr.System, app: rr.Registrar, served: Served, dialled: Callable[[], socket.socket],
    monkeypatch: pytest.MonkeyPatch, how: Callable[[socket.socket], None],
) -> None:  # fmt: skip
    monkeypatch.setattr(console_server, "STALLED_S", 0.3)
    peer = dialled()
    far_end = leave_unread(system, app, peer)
    console = console_of(system)

    how(peer)

    eventually(lambda: far_end not in console.sockets)


def test_a_connection_that_leaves_with_requests_unread_is_noticed_while_its_first_one_is_carried_out(
    system: rr.System, provider: rr.Registrar, gate: Gate, dialled: Callable[[], socket.socket],
    monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    monkeypatch.setattr(console_server, "LOOK_S", 0.1)
    serve(provider, "slow", load=gate)
    console, peer = console_of(system), dialled()
    assert console is not None
    peer.sendall(HELLO + framed(Load("provider/slow", "1", keep=True), 1000) + framed(ListChildren(), 1000))
    gate.wait_arrived()

    peer.close()

    eventually(lambda: not console.sockets, timeout=5.0)  # the gate is shut
    gate.open()
    eventually(lambda: not provider.resources())


def test_a_load_that_its_connection_cannot_hear_of_any_more_is_released_once(
    system: rr.System, app: rr.Registrar, provider: rr.Registrar, served: Served, gate: Gate,
    dialled: Callable[[], socket.socket], caplog: pytest.LogCaptureFixture,
) -> None:  # fmt: skip
    slow = serve(provider, "slow", load=gate)
    console, peer = console_of(system), dialled()
    assert console is not None
    far_end = leave_unread(system, app, peer)
    with rr.connect(system.state_dir) as connection:
        holder = connection.open_registrar("worker")
        peer.sendall(framed(Hold(holder.name, "provider/slow", encode("1")), 1000))
        gate.wait_arrived()
        send_no_more(peer)
        eventually(lambda: far_end.is_gone)
        gate.open()
        slow.unloads.wait(1)

        peer.close()

        eventually(lambda: far_end not in console.sockets)
        eventually(lambda: holder.queries() == [])
    eventually(lambda: not console.sockets)
    assert "is not released" not in caplog.text
