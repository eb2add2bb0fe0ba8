"""The Unix transport with peers of every kind: strangers, impostors, the slow, the mad and the dead."""

from __future__ import annotations

import asyncio
import contextlib
import gc
import logging
import os
import signal
import socket
import stat
import struct
import subprocess
import sys
import textwrap
import time
from collections.abc import AsyncIterator, Callable, Coroutine, Iterator
from pathlib import Path
from typing import Any

import pytest

from rr_actors.base.errors import ConfigError, MailboxFull, NotSerializable, Unavailable, UsageError
from rr_actors.wire import unix_link, unix_transport
from rr_actors.wire.handshake import PROTOCOL, AcceptorHandshake, DiallerHandshake
from rr_actors.wire.transport import Hello, NotAnswering, Welcome
from rr_actors.wire.unix_transport import STRANGERS_LIMIT, UnixTransport
from support_transports import HELLO, KEY, LOOPS, Door, Inbox, Note, authenticated, frame, loop_of, stream

Run = Callable[[Coroutine[Any, Any, None]], None]
ME = f"pid {os.getpid()}"


@pytest.fixture(params=LOOPS)
def run(request: pytest.FixtureRequest) -> Iterator[Run]:
    with loop_of(request.param) as loop:
        yield lambda scenario: loop.run_until_complete(asyncio.wait_for(scenario, 40))


@pytest.fixture
def others_sockets(tmp_path: Path) -> Iterator[None]:
    """Take away the socket files of impostors, and of peers that were killed: nobody else does."""
    yield
    for path in tmp_path.rglob("*"):
        if path.is_socket():
            path.unlink()


@pytest.fixture(autouse=True)
def _log(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.WARNING)


@contextlib.asynccontextmanager
async def transports(
    directory: Path,
    count: int = 1,
    *,
    buffer_limit_bytes: int = unix_link.BUFFER_LIMIT_BYTES,
    handshake_timeout_s: float = unix_transport.HANDSHAKE_TIMEOUT_S,
    **options: Any,
) -> AsyncIterator[list[UnixTransport]]:
    made = [UnixTransport(directory, KEY, {"registrar": Note}, **options) for _ in range(count)]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(unix_link, "BUFFER_LIMIT_BYTES", buffer_limit_bytes)
        patch.setattr(unix_transport, "HANDSHAKE_TIMEOUT_S", handshake_timeout_s)
        try:
            yield made
        finally:
            for transport in made:
                await transport.close()


async def rest_of(reader: asyncio.StreamReader) -> bytes:
    """All that the other side still says before it closes."""
    received = b""
    with contextlib.suppress(ConnectionError):
        while data := await asyncio.wait_for(reader.read(65536), 20):
            received += data
    return received


async def works(provider: UnixTransport, consumer: UnixTransport, door: Door) -> None:
    """A new link can be opened and used."""
    inbox = Inbox()
    link = await consumer.connect(provider.address, HELLO, inbox.attach)
    link.send(Note(77))
    link.flush()
    there = door.inboxes[-1]
    assert await there.messages_are(1) == [Note(77)]
    link.close()
    assert await inbox.is_lost() is None
    assert await there.is_lost() is None


# -- the socket file -----------------------------------------------------------------------------------------------


def test_the_socket_is_private_named_by_its_address_and_gone_after_close(run: Run, tmp_path: Path) -> None:
    async def scenario() -> None:
        async with transports(tmp_path) as [transport]:
            assert os.listdir(tmp_path) == []
            await transport.listen(Door())
            assert os.listdir(tmp_path) == [transport.address]
            mode = (tmp_path / transport.address).stat().st_mode
            assert stat.S_ISSOCK(mode)
            assert stat.S_IMODE(mode) == 0o600
        assert os.listdir(tmp_path) == []

    run(scenario())


def test_a_directory_whose_path_is_too_long_for_a_socket_works(run: Run, tmp_path: Path) -> None:
    deep = tmp_path / ("d" * 120) / ("e" * 120)
    deep.mkdir(parents=True)

    async def scenario() -> None:
        door = Door()
        async with transports(deep, 2) as [provider, consumer]:
            await provider.listen(door)
            assert stat.S_IMODE((deep / provider.address).stat().st_mode) == 0o600
            await works(provider, consumer, door)
            with pytest.raises(Unavailable):
                await provider.connect(consumer.address, HELLO, Inbox().attach)
        assert list(deep.iterdir()) == []

    run(scenario())


def test_a_directory_that_is_not_there_is_a_config_error_naming_it(run: Run, tmp_path: Path) -> None:
    async def scenario() -> None:
        async with transports(tmp_path / "gone") as [transport]:
            with pytest.raises(ConfigError, match="gone"):
                await transport.listen(Door())

    run(scenario())


def test_nothing_is_left_open_whatever_became_of_the_links(run: Run, tmp_path: Path) -> None:
    async def scenario() -> None:
        async def once() -> None:
            door = Door()
            async with transports(tmp_path, 2) as [provider, consumer]:
                await provider.listen(door)
                await works(provider, consumer, door)
                stranger = UnixTransport(tmp_path, bytes(32), {"registrar": Note})
                with pytest.raises(Unavailable):
                    await stranger.connect(provider.address, HELLO, Inbox().attach)
                await stranger.close()
                door.refuse = Unavailable("no")
                with pytest.raises(Unavailable):
                    await consumer.connect(provider.address, HELLO, Inbox().attach)
                door.refuse = None
                await consumer.connect(provider.address, HELLO, Inbox().attach)
                with pytest.raises(Unavailable):
                    await consumer.connect("nowhere", HELLO, Inbox().attach)

        await once()
        before = len(os.listdir("/proc/self/fd"))
        for _ in range(20):
            await once()
        for _ in range(1000):  # the loop closes its descriptors a turn or two later
            if len(os.listdir("/proc/self/fd")) <= before:
                return
            await asyncio.sleep(0.003)
        raise AssertionError("descriptors are left open")

    run(scenario())


# -- strangers -----------------------------------------------------------------------------------------------------

STRANGE = {
    "garbage": (os.urandom(500), "does not speak rr_actors"),
    "HTTP": (b"GET / HTTP/1.1\r\nHost: localhost\r\n" + b"x" * 100, "does not speak rr_actors"),
    "an older version": (
        b"rr_actor" + struct.pack(">H", PROTOCOL - 1) + bytes(64),
        f"protocol {PROTOCOL - 1}, expected",
    ),
    "no key": (b"rr_actor" + struct.pack(">H", PROTOCOL) + bytes(64), "does not have the key"),
    "no key, and a Hello": (
        b"rr_actor" + struct.pack(">H", PROTOCOL) + bytes(64) + frame(b"\x95"),
        "does not have the key",
    ),
}


@pytest.mark.parametrize(("said", "words"), STRANGE.values(), ids=STRANGE)
def test_a_stranger_is_cut_off_and_logged_with_its_pid_and_nobody_else_notices(
    run: Run, tmp_path: Path, caplog: pytest.LogCaptureFixture, said: bytes, words: str
) -> None:
    async def scenario() -> None:
        door = Door()
        async with transports(tmp_path, 2) as [provider, consumer]:
            await provider.listen(door)
            inbox = Inbox()
            link = await consumer.connect(provider.address, HELLO, inbox.attach)
            async with stream(tmp_path / provider.address) as (reader, writer):
                writer.write(said)
                assert len(await rest_of(reader)) == 42  # the greeting, and nothing more
            link.send(Note(1))
            link.flush()
            assert await door.inboxes[0].messages_are(1) == [Note(1)]
            assert len(door.hellos) == 1
            await works(provider, consumer, door)
            assert not inbox.lost_reasons

    run(scenario())
    assert len(caplog.records) == 1
    assert ME in caplog.text
    assert words in caplog.text


def test_a_peer_with_another_key_is_refused_and_its_connect_says_so(
    run: Run, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    async def scenario() -> None:
        door = Door()
        async with transports(tmp_path, 2) as [provider, consumer]:
            await provider.listen(door)
            stranger = UnixTransport(tmp_path, os.urandom(32), {"registrar": Note})
            with pytest.raises(Unavailable, match=rf"cameras \({ME}\).*another key"):
                await stranger.connect(provider.address, HELLO, Inbox().attach)
            await stranger.close()
            assert door.hellos == []
            await works(provider, consumer, door)

    run(scenario())
    assert "does not have the key" in caplog.text


@pytest.mark.usefixtures("others_sockets")
@pytest.mark.parametrize(
    ("says", "words"),
    [
        (b"HTTP/1.1 400 Bad Request" + bytes(100), "does not speak rr_actors"),
        (b"rr_actor" + struct.pack(">H", PROTOCOL + 1) + bytes(32), "protocol"),
        (b"rr_actor" + struct.pack(">H", PROTOCOL) + bytes(32) + bytes(32), "does not have the key"),
    ],
    ids=["HTTP", "another version", "no key"],
)
def test_an_impostor_in_the_socket_directory_gets_no_hello(run: Run, tmp_path: Path, says: bytes, words: str) -> None:
    heard: list[bytes] = []

    async def scenario() -> None:
        over = asyncio.Event()

        async def impostor(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
            writer.write(says)
            heard.append(await rest_of(reader))
            writer.close()
            over.set()

        server = await asyncio.start_unix_server(impostor, tmp_path / "impostor")
        async with transports(tmp_path) as [transport]:
            with pytest.raises(Unavailable, match=words):
                await transport.connect("impostor", HELLO, Inbox().attach)
        await over.wait()
        server.close()
        await server.wait_closed()

    run(scenario())
    assert b"cameras" not in b"".join(heard)


def test_who_says_nothing_is_cut_off_after_the_time_limit_and_logged(
    run: Run, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    async def scenario() -> None:
        async with transports(tmp_path, handshake_timeout_s=0.2) as [provider]:
            await provider.listen(Door())
            async with stream(tmp_path / provider.address) as (reader, writer):
                writer.write(b"rr_a")
                started = time.monotonic()
                await rest_of(reader)
                assert 0.1 < time.monotonic() - started < 5

    run(scenario())
    assert ME in caplog.text
    assert "its proof within 0.2 s" in caplog.text


def test_who_drips_a_byte_at_a_time_is_cut_off_after_the_time_limit_too(run: Run, tmp_path: Path) -> None:
    async def scenario() -> None:
        async with transports(tmp_path, handshake_timeout_s=0.2) as [provider]:
            await provider.listen(Door())
            async with stream(tmp_path / provider.address) as (reader, writer):

                async def drip() -> None:
                    with contextlib.suppress(ConnectionError):
                        for byte in b"rr_actor" * 1000:
                            writer.write(bytes([byte]))
                            await asyncio.sleep(0.02)

                dripping = asyncio.ensure_future(drip())
                await rest_of(reader)
                dripping.cancel()
                await asyncio.gather(dripping, return_exceptions=True)

    run(scenario())


def test_a_process_of_another_user_is_cut_off_before_a_word_is_said(
    run: Run, tmp_path: Path, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    async def scenario() -> None:
        async with transports(tmp_path) as [provider]:
            await provider.listen(Door())
            os.chmod(tmp_path / provider.address, 0o666)
            with socket.socket(socket.AF_UNIX) as raw:
                with another_user(tmp_path):
                    raw.connect(provider.address)
                raw.setblocking(False)
                try:
                    said = await asyncio.get_running_loop().sock_recv(raw, 100)
                except ConnectionError:
                    said = b""
                assert said == b""

    @contextlib.contextmanager
    def another_user(directory: Path) -> Iterator[None]:
        monkeypatch.chdir(directory)  # whose parents may be closed to others
        if os.geteuid() != 0:
            monkeypatch.setattr(os, "geteuid", lambda: 12345)  # then it is we who are another
            yield
            return
        directory.chmod(0o711)
        os.seteuid(65534)
        try:
            yield
        finally:
            os.seteuid(0)

    run(scenario())
    assert ME in caplog.text
    assert "it runs as user" in caplog.text


def test_a_thousand_connections_that_say_nothing_are_bounded_and_harm_nobody(
    run: Run, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    async def scenario() -> None:
        door = Door()
        async with transports(tmp_path, 2) as [provider, consumer]:
            await provider.listen(door)
            inbox = Inbox()
            link = await consumer.connect(provider.address, HELLO, inbox.attach)
            silent: list[socket.socket] = []
            for _ in range(1000):
                silent.append(connected := socket.socket(socket.AF_UNIX))
                connected.connect(str(tmp_path / provider.address))
                if len(silent) % 100 == 0:
                    await asyncio.sleep(0)
            await works(provider, consumer, door)
            assert len(provider.strangers) <= STRANGERS_LIMIT
            link.send(Note(1))
            link.flush()
            assert await door.inboxes[0].messages_are(1) == [Note(1)]
            for connected in silent:
                connected.close()

    run(scenario())
    assert sum("no room for more" in record.message for record in caplog.records) == 1


def test_three_hundred_peers_may_connect_at_the_same_moment(run: Run, tmp_path: Path) -> None:
    async def scenario() -> None:
        door = Door()
        async with transports(tmp_path, 2) as [provider, consumer]:
            await provider.listen(door)
            await asyncio.gather(*(consumer.connect(provider.address, HELLO, Inbox().attach) for _ in range(300)))
            assert len(door.inboxes) == 300

    run(scenario())


# -- peers that listen and do not answer ----------------------------------------------------------------------------


@contextlib.contextmanager
def deaf(path: Path, backlog: int) -> Iterator[None]:
    """A socket that never accepts."""
    with socket.socket(socket.AF_UNIX) as listening:
        listening.bind(str(path))
        listening.listen(backlog)
        yield


@pytest.mark.usefixtures("others_sockets")
@pytest.mark.parametrize("connections", [1, 4])
def test_connecting_to_one_that_does_not_answer_raises_unavailable_in_time(
    run: Run, tmp_path: Path, connections: int
) -> None:
    async def scenario() -> None:
        async with transports(tmp_path, handshake_timeout_s=0.2) as [transport]:
            started = time.monotonic()
            results = await asyncio.gather(
                *(transport.connect("deaf", HELLO, Inbox().attach) for _ in range(connections)), return_exceptions=True
            )
            assert [type(result) for result in results] == [NotAnswering] * connections
            assert all("cameras" in str(result) for result in results)
            assert time.monotonic() - started < 5

    with deaf(tmp_path / "deaf", 0):
        run(scenario())


@pytest.mark.usefixtures("others_sockets")
def test_connecting_to_one_that_closes_at_once_is_tried_again_until_the_time_limit(run: Run, tmp_path: Path) -> None:
    tries = 0

    async def close_at_once(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        nonlocal tries
        tries += 1
        writer.close()

    async def scenario() -> None:
        server = await asyncio.start_unix_server(close_at_once, tmp_path / "busy")
        async with transports(tmp_path, handshake_timeout_s=0.5) as [transport]:
            with pytest.raises(Unavailable, match=r"closes each connection|did not send its greeting"):
                await transport.connect("busy", HELLO, Inbox().attach)
        server.close()
        await server.wait_closed()

    run(scenario())
    assert tries > 2


@pytest.mark.usefixtures("others_sockets")
def test_one_whose_handshake_made_room_for_others_tries_again(run: Run, tmp_path: Path) -> None:
    """A provider that was busy for PATIENCE_S greets, and gives the place to another before it reads the answer."""

    async def scenario() -> None:
        door = Door()
        async with transports(tmp_path, 2) as [provider, consumer]:
            await provider.listen(door)

            async def make_room(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
                writer.write(AcceptorHandshake(KEY).greeting)
                await reader.read(1)
                await asyncio.sleep(unix_transport.PATIENCE_S)
                (tmp_path / provider.address).rename(tmp_path / "busy")  # from now on there is room
                writer.close()

            server = await asyncio.start_unix_server(make_room, tmp_path / "busy")
            link = await consumer.connect("busy", HELLO, Inbox().attach)
            assert door.hellos == [HELLO]
            link.close()
            server.close()
            await server.wait_closed()

    run(scenario())


@pytest.mark.usefixtures("others_sockets")
def test_closing_a_transport_ends_the_connects_it_is_in(run: Run, tmp_path: Path) -> None:
    async def scenario() -> None:
        async with transports(tmp_path) as [transport]:
            connects = [asyncio.ensure_future(transport.connect("deaf", HELLO, Inbox().attach)) for _ in range(4)]
            await asyncio.sleep(0.05)
            await transport.close()
            for result in await asyncio.gather(*connects, return_exceptions=True):
                assert isinstance(result, Unavailable)
                assert "closed" in str(result)

    with deaf(tmp_path / "deaf", 0):
        run(scenario())


@pytest.mark.usefixtures("others_sockets")
def test_a_connection_that_is_given_up_before_it_is_made_is_closed_once(run: Run, tmp_path: Path) -> None:
    async def scenario() -> None:
        async with transports(tmp_path) as [transport]:
            connect = asyncio.ensure_future(transport.connect("deaf", HELLO, Inbox().attach))
            await asyncio.sleep(0)  # it is connected, and the loop has not called the protocol yet
            await transport.close()
            assert isinstance((await asyncio.gather(connect, return_exceptions=True))[0], Unavailable)
        opened = [os.open(os.devnull, os.O_RDONLY | os.O_CLOEXEC) for _ in range(8)]  # one gets the same number
        del connect
        gc.collect()
        for descriptor in opened:
            os.close(descriptor)  # OSError if somebody has closed it

    with deaf(tmp_path / "deaf", 0):
        run(scenario())


# -- peers with the key that misbehave ------------------------------------------------------------------------------

MAD = {
    "a frame over the limit": (struct.pack(">I", 1_000_001), "over the limit of 1000000"),
    "a frame of four gigabytes": (b"\xff\xff\xff\xff", "over the limit of 1000000"),
    "no message": (frame(b"\xc1\xc1"), "no message"),
    "a message of another kind": (frame(b"\x92\x63\x01"), "no message"),
    "too deep": (frame(b"\x91" * 100_000), "no message"),
}


@pytest.mark.parametrize(("said", "words"), MAD.values(), ids=MAD)
def test_a_peer_that_sends_what_it_may_not_loses_its_link_alone_and_the_log_names_it(
    run: Run, tmp_path: Path, caplog: pytest.LogCaptureFixture, said: bytes, words: str
) -> None:
    async def scenario() -> None:
        door = Door()
        async with transports(tmp_path, 2, frame_limit_bytes=1_000_000) as [provider, consumer]:
            await provider.listen(door)
            inbox = Inbox()
            link = await consumer.connect(provider.address, HELLO, inbox.attach)
            async with stream(tmp_path / provider.address) as (reader, writer):
                await authenticated(reader, writer, Hello("registrar", "cameras", "mad", 1))
                writer.write(frame(b"\x92\x01\x05") + said + frame(b"\x92\x01\x06"))
                assert await rest_of(reader) == b""
            mad = door.inboxes[1]
            reason = await mad.is_lost()
            assert isinstance(reason, Unavailable)
            assert f"mad ({ME})" in str(reason)
            assert words in str(reason)
            assert mad.messages == [Note(5)]
            link.send(Note(1))
            link.flush()
            assert await door.inboxes[0].messages_are(1) == [Note(1)]
            assert not inbox.lost_reasons

    run(scenario())
    assert len(caplog.records) == 1
    assert f"mad ({ME})" in caplog.text
    assert words in caplog.text


def test_a_hello_of_an_unknown_kind_is_refused(run: Run, tmp_path: Path) -> None:
    async def scenario() -> None:
        door = Door()
        async with transports(tmp_path) as [provider]:
            await provider.listen(door)
            other = UnixTransport(tmp_path, KEY, {"registrar": Note, "actors": Note})
            with pytest.raises(Unavailable, match="takes no links of kind 'actors'"):
                await other.connect(provider.address, Hello("actors", "cameras", "app", 7), Inbox().attach)
            await other.close()
            assert door.hellos == []

    run(scenario())


def test_connecting_with_a_kind_that_has_no_codec_is_a_usage_error(run: Run, tmp_path: Path) -> None:
    async def scenario() -> None:
        async with transports(tmp_path) as [transport]:
            with pytest.raises(UsageError, match="actors"):
                await transport.connect("x", Hello("actors", "cameras", "app", 7), Inbox().attach)

    run(scenario())


def test_what_is_refused_at_the_sender_leaves_nothing_in_the_batch_and_the_link_goes_on(
    run: Run, tmp_path: Path
) -> None:
    async def scenario() -> None:
        door = Door()
        async with transports(tmp_path, 2, frame_limit_bytes=1000) as [provider, consumer]:
            await provider.listen(door)
            link = await consumer.connect(provider.address, HELLO, Inbox().attach)
            link.send(Note(0))
            with pytest.raises(NotSerializable, match=r"limit of 1000 \(frame_limit_bytes\)") as caught:
                link.send(Note(1, bytes(1000)))
            assert caught.value.details["limit"] == 1000
            with pytest.raises(NotSerializable, match="object cannot travel"):
                link.send(object())
            link.send(Note(2))
            link.flush()
            assert await door.inboxes[0].messages_are(2) == [Note(0), Note(2)]

    run(scenario())


def test_send_raises_mailbox_full_naming_peer_and_limit_and_works_again_when_the_peer_has_read(
    run: Run, tmp_path: Path
) -> None:
    async def scenario() -> None:
        door = Door()
        async with transports(tmp_path, 2, buffer_limit_bytes=100_000) as [provider, consumer]:
            await provider.listen(door)
            link = await consumer.connect(provider.address, HELLO, Inbox().attach)
            sent = 0

            def send_until_it_is_full() -> None:
                nonlocal sent
                while sent < 100_000:
                    link.send(Note(sent, bytes(1000)))
                    link.flush()
                    sent += 1

            with pytest.raises(MailboxFull) as caught:
                send_until_it_is_full()
            assert caught.value.details["limit"] == 100_000
            assert caught.value.details["name"] == link.peer
            assert link.peer in str(caught.value)
            there = door.inboxes[0]
            assert [message.number for message in await there.messages_are(sent)] == list(range(sent))
            link.send(Note(-1))
            link.flush()
            assert (await there.messages_are(sent + 1))[-1] == Note(-1)

    run(scenario())


def test_one_that_does_not_read_fills_its_own_buffer_only_and_does_not_hold_up_the_close(
    run: Run, tmp_path: Path
) -> None:
    async def scenario() -> None:
        door = Door()
        async with transports(tmp_path, 2, buffer_limit_bytes=1_000_000) as [provider, consumer]:
            await provider.listen(door)
            with socket.socket(socket.AF_UNIX) as raw:
                raw.setblocking(False)
                raw.connect(str(tmp_path / provider.address))
                handshake = DiallerHandshake(KEY, Hello("registrar", "cameras", "deaf", 1))
                loop = asyncio.get_running_loop()
                while not handshake.done:
                    await loop.sock_sendall(raw, handshake.receive(await loop.sock_recv(raw, 4096)))
                link = door.inboxes[0].link
                assert link is not None

                def fill() -> None:
                    for number in range(10_000):
                        link.send(Note(number, bytes(10_000)))
                        link.flush()

                with pytest.raises(MailboxFull, match=rf"deaf \({ME}\).*over the limit"):
                    fill()
                await works(provider, consumer, door)
                started = time.monotonic()
                await provider.close()
                assert time.monotonic() - started < 3
                assert door.inboxes[0].lost_reasons == [None]

    run(scenario())


def test_a_frame_that_never_ends_holds_no_more_than_what_was_sent(run: Run, tmp_path: Path) -> None:
    async def scenario() -> None:
        door = Door()
        async with transports(tmp_path, 2) as [provider, consumer]:
            await provider.listen(door)
            async with stream(tmp_path / provider.address) as (reader, writer):
                await authenticated(reader, writer)
                writer.write(struct.pack(">I", 10_000_000) + bytes(1000))
                await works(provider, consumer, door)
            reason = await door.inboxes[0].is_lost()
            assert isinstance(reason, Unavailable)
            assert door.inboxes[0].messages == []

    run(scenario())


# -- peers in other processes ---------------------------------------------------------------------------------------

CHILD = """
    import asyncio, os, sys
    from pathlib import Path
    sys.path.insert(0, "tests")
    from rr_actors.wire.transport import Hello, Welcome
    from rr_actors.wire.unix_transport import UnixTransport
    from support_transports import KEY, Door, Inbox, Note

    async def main(directory, address, count):
        transport = UnixTransport(Path(directory), KEY, {"registrar": Note})
        echo = Inbox(lambda link, message: (link.send(message), link.flush()))
        await transport.listen(lambda hello: (Welcome(9), echo.attach))
        print(transport.address, flush=True)
        if address:
            link = await transport.connect(address, Hello("registrar", "parent", "child", 1), echo.attach)
            for number in range(count):
                link.send(Note(number, bytes(1000)))
            link.flush()
        await asyncio.Event().wait()

    asyncio.run(main(sys.argv[1], sys.argv[2], int(sys.argv[3])))
"""


@contextlib.contextmanager
def child(directory: Path, address: str = "", count: int = 0) -> Iterator[tuple[subprocess.Popen[str], str]]:
    """A process with a transport that echoes; given an address, it connects there and sends `count` messages."""
    with subprocess.Popen(
        [sys.executable, "-c", textwrap.dedent(CHILD), str(directory), address, str(count)],
        stdout=subprocess.PIPE,
        text=True,
        cwd=Path(__file__).parents[2],
    ) as process:
        assert process.stdout is not None
        try:
            yield process, process.stdout.readline().strip() if not address else ""
        finally:
            process.kill()


@pytest.mark.usefixtures("others_sockets")
def test_a_peer_in_another_process_is_named_with_its_pid_at_both_ends(run: Run, tmp_path: Path) -> None:
    async def scenario() -> None:
        door = Door()
        async with transports(tmp_path) as [transport]:
            await transport.listen(door)
            with child(tmp_path, transport.address, 1) as (process, _):
                arriving = await door.opened()
                await arriving.messages_are(1)
                assert arriving.link is not None
                assert arriving.link.peer == f"child (pid {process.pid})"
            with child(tmp_path) as (process, address):
                link = await transport.connect(address, HELLO, Inbox().attach)
                assert link.peer == f"cameras (pid {process.pid})"
                assert link.welcome == Welcome(9)

    run(scenario())


@pytest.mark.usefixtures("others_sockets")
def test_a_killed_peer_is_lost_once_with_a_reason_that_names_it(run: Run, tmp_path: Path) -> None:
    async def scenario() -> None:
        async with transports(tmp_path) as [transport]:
            with child(tmp_path) as (process, address):
                inbox = Inbox()
                link = await transport.connect(address, HELLO, inbox.attach)
                link.send(Note(1))
                link.flush()
                assert await inbox.messages_are(1) == [Note(1)]
                process.send_signal(signal.SIGKILL)
                reason = await inbox.is_lost()
                assert isinstance(reason, Unavailable)
                assert f"cameras (pid {process.pid})" in str(reason)
                link.send(Note(2))
                link.flush()
                with pytest.raises(Unavailable):
                    await transport.connect(address, HELLO, Inbox().attach)
        assert inbox.lost_reasons == [reason]

    run(scenario())


@pytest.mark.usefixtures("others_sockets")
def test_all_that_a_killed_peer_had_sent_arrives_before_it_is_lost(run: Run, tmp_path: Path) -> None:
    async def scenario() -> None:
        door = Door()
        async with transports(tmp_path) as [transport]:
            await transport.listen(door)
            with child(tmp_path, transport.address, 20_000) as (process, _):
                inbox = await door.opened()
                await inbox.messages_are(1)
                process.send_signal(signal.SIGKILL)
                assert isinstance(await inbox.is_lost(), Unavailable)
                numbers = [message.number for message in inbox.messages]
                assert numbers == list(range(len(numbers)))

    run(scenario())


@pytest.mark.usefixtures("others_sockets")
def test_a_stopped_peer_takes_messages_up_to_the_limit_and_answers_when_it_goes_on(run: Run, tmp_path: Path) -> None:
    async def scenario() -> None:
        async with transports(tmp_path, buffer_limit_bytes=1_000_000, handshake_timeout_s=1.0) as [transport]:
            with child(tmp_path) as (process, address):
                inbox = Inbox()
                link = await transport.connect(address, HELLO, inbox.attach)
                process.send_signal(signal.SIGSTOP)
                sent = 0

                def fill() -> None:
                    nonlocal sent
                    for _ in range(10_000):
                        link.send(Note(sent, bytes(10_000)))
                        sent += 1
                        link.flush()

                with pytest.raises(MailboxFull, match=rf"cameras \(pid {process.pid}\)"):
                    fill()
                with pytest.raises(Unavailable, match="did not send its greeting within 1 s"):
                    await transport.connect(address, HELLO, Inbox().attach)
                process.send_signal(signal.SIGCONT)
                echoed = await inbox.messages_are(sent)
                assert [message.number for message in echoed] == list(range(sent))

    run(scenario())
