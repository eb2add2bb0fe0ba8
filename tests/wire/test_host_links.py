"""What a link between hosts does with what a network may do: lose, double, delay, stop; and with arbitrary bytes."""

from __future__ import annotations

import asyncio
import contextlib
import os
import signal
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rr_actors.base.errors import ConfigError, MailboxFull, Unavailable
from rr_actors.wire.frames import FRAME_LIMIT_BYTES, decoder_of
from rr_actors.wire.hosts.byte_window import (
    ACKNOWLEDGED,
    BROKEN,
    DATA,
    PACKET_BYTES,
    WINDOW_BYTES,
    ReceivedBytes,
    SendWindow,
    packet,
    read_packet,
)
from rr_actors.wire.hosts.host_link import HostLink
from rr_actors.wire.hosts.zenoh_link import ZenohTransport
from rr_actors.wire.transport import Welcome
from rr_actors.wire.unix_link import Wire
from support import TEST_PATHS
from support_transports import HELLO, Door, Inbox, Note, free_port


@given(st.lists(st.binary(max_size=3 * PACKET_BYTES), max_size=6))
def test_what_is_sent_arrives_whole_and_never_more_than_the_window_is_in_flight(pieces: list[bytes]) -> None:
    window, received, arrived = SendWindow(), ReceivedBytes(), bytearray()
    for piece in pieces:
        window.add(piece)
    while not window.empty:
        packets = window.take()
        assert window.sent - window.acknowledged <= WINDOW_BYTES
        assert packets
        for data in packets:
            kind, number, rest = read_packet(data)
            assert kind == DATA
            received.take(number, rest)
            arrived += rest
        window.acknowledge(received.total)
    assert bytes(arrived) == b"".join(pieces)


@given(st.lists(st.binary(min_size=1, max_size=9), min_size=2, max_size=9), st.data())
def test_a_lost_or_doubled_packet_is_a_gap(pieces: list[bytes], data: st.DataObject) -> None:
    window = SendWindow()
    packets: list[bytes] = []
    for piece in pieces:
        window.add(piece)
        packets += window.take()
    at = data.draw(st.integers(0, len(packets) - 2))
    broken = data.draw(st.sampled_from([packets[:at] + packets[at + 1 :], packets[: at + 1] + packets[at:]]))
    with pytest.raises(Unavailable, match="gap"):
        receive(broken)


def receive(packets: list[bytes]) -> None:
    received = ReceivedBytes()
    for data in packets:
        _, number, rest = read_packet(data)
        received.take(number, rest)


class Ends:
    """One end of a link, whose packets nobody carries: the test is the network."""

    def __init__(self) -> None:
        self.put: list[bytes] = []
        self.inbox = Inbox()
        self.links: dict[tuple[str, str], HostLink] = {}
        wire = Wire(decoder_of(Note), FRAME_LIMIT_BYTES)
        self.link = HostLink(self.links, ("hostb", "1"), self.put.append, wire, HELLO, Welcome(1), "cameras")
        self.link.attach(self.inbox.attach)
        self.link.start()


@contextmanager
def ends() -> Iterator[Ends]:
    with asyncio.Runner() as runner:

        async def make() -> Ends:
            return Ends()

        yield runner.run(make())


@given(
    st.lists(st.binary(max_size=40) | st.builds(packet, st.sampled_from([0, 1, 2]), st.integers(0, 60), st.binary()))
)
def test_arbitrary_packets_end_the_link_at_most_and_lost_is_called_once(packets: list[bytes]) -> None:
    with ends() as one:
        for data in packets:
            one.link.take(data)
        assert len(one.inbox.lost_reasons) == (0 if one.links else 1)
        one.link.end(None)
        assert len(one.inbox.lost_reasons) == 1


def test_a_peer_that_acknowledges_nothing_fills_the_mailbox_and_nothing_waits() -> None:
    with ends() as one:
        with pytest.raises(MailboxFull, match="hostb"):
            send_100_mb(one.link)
        assert one.link.behind
        assert sum(map(len, one.put)) < WINDOW_BYTES + PACKET_BYTES


def send_100_mb(link: HostLink) -> None:
    for number in range(100):
        link.send_now(Note(number, bytes(1024 * 1024)))


@pytest.mark.parametrize(
    ("data", "said"),
    [
        (packet(DATA, 5, b"x"), "gap"),
        (packet(ACKNOWLEDGED, 1), "acknowledges 1 bytes"),
        (packet(9, 0), "kind 9"),
        (b"", "0 bytes"),
        (packet(DATA, 0, bytes(PACKET_BYTES + 1)), "at most"),
    ],
    ids=["gap", "acknowledged", "kind", "empty", "long"],
)
def test_a_packet_against_the_rules_breaks_the_link_on_both_sides_by_name(data: bytes, said: str) -> None:
    with ends() as one, ends() as other:
        one.link.take(data)
        assert said in str(one.inbox.lost_reasons[0])
        assert read_packet(one.put[-1])[0] == BROKEN
        other.link.take(one.put[-1])
        assert said in str(other.inbox.lost_reasons[0])


# -- over Zenoh ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("endpoint", ["tcp/0.0.0.0:7447", "tcp/10.0.0.1:7447", "tls/127.0.0.1:7447", "127.0.0.1:1", ""])
def test_listening_elsewhere_than_on_loopback_is_refused_with_the_reason(endpoint: str) -> None:
    with pytest.raises(ConfigError, match="not encrypted yet"):
        ZenohTransport("group", "hosta", {}, listen=[endpoint])


@pytest.mark.parametrize(("group", "address"), [("a/b", "hosta"), ("group", "*"), ("", "hosta"), ("group", "x" * 65)])
def test_a_name_that_is_no_part_of_a_key_is_refused(group: str, address: str) -> None:
    with pytest.raises(ConfigError, match="expected 1 to 64"):
        ZenohTransport(group, address, {})


PEER = """
import asyncio, sys
from rr_actors.wire.hosts.zenoh_link import ZenohTransport
from support_transports import HELLO, Inbox, Note

async def main():
    transport = ZenohTransport("group", "hostb", {"registrar": Note}, connect=[sys.argv[1]])
    link = await transport.connect("hosta", HELLO, Inbox().attach)
    link.send_now(Note(1))
    await asyncio.Event().wait()

asyncio.run(main())
"""


def test_a_process_killed_at_the_other_end_is_a_lost_link_that_names_it() -> None:
    async def scenario() -> None:
        endpoint = f"tcp/127.0.0.1:{free_port()}"
        door = Door()
        transport = ZenohTransport("group", "hosta", {"registrar": Note}, listen=[endpoint])
        await transport.listen(door)
        program = (sys.executable, "-c", PEER, endpoint)
        peer = await asyncio.create_subprocess_exec(*program, env=os.environ | {"PYTHONPATH": TEST_PATHS})
        try:
            async with asyncio.timeout(30):
                inbox = await door.opened()
            await inbox.messages_are(1)
            peer.kill()
            reason = await inbox.is_lost()
            assert isinstance(reason, Unavailable)
            assert "hostb" in str(reason)
        finally:
            if peer.returncode is None:
                with contextlib.suppress(ProcessLookupError):
                    peer.kill()
            await peer.wait()
            await transport.close()

    asyncio.run(scenario())


def test_a_port_that_is_taken_is_named() -> None:
    async def scenario() -> None:
        endpoint = f"tcp/127.0.0.1:{free_port()}"
        first, second = (ZenohTransport("group", name, {}, listen=[endpoint]) for name in ("hosta", "hostb"))
        await first.listen(Door())
        try:
            with pytest.raises(ConfigError, match=endpoint):
                await second.listen(Door())
        finally:
            await second.close()
            await first.close()

    asyncio.run(scenario())


FROZEN = """
import asyncio, sys
from rr_actors.wire.hosts.zenoh_link import ZenohTransport
from rr_actors.wire.transport import Welcome
from support_transports import Inbox, Note

async def main():
    transport = ZenohTransport("group", sys.argv[1], {"registrar": Note}, connect=[sys.argv[2]])
    echo = lambda link, note: link.send_now(Note(note.number))
    await transport.listen(lambda hello: (Welcome(1), Inbox(echo).attach))
    print("ready", flush=True)
    await asyncio.Event().wait()

asyncio.run(main())
"""
HELD_UP_S = 3.5
"""Zenoh gives a call to a host that reads nothing up after 5 s."""


def test_a_host_that_is_frozen_holds_up_no_other() -> None:
    async def scenario() -> None:
        endpoint = f"tcp/127.0.0.1:{free_port()}"
        transport = ZenohTransport("group", "hosta", {"registrar": Note}, listen=[endpoint])
        await transport.listen(Door())
        peers: list[asyncio.subprocess.Process] = []
        try:
            for name in ("hostb", "hostc"):
                program = (sys.executable, "-c", FROZEN, name, endpoint)
                pipe = asyncio.subprocess.PIPE
                env = os.environ | {"PYTHONPATH": TEST_PATHS}
                peers.append(await asyncio.create_subprocess_exec(*program, stdout=pipe, env=env))
                out = peers[-1].stdout
                assert out is not None
                assert await out.readline() == b"ready\n"
            links = [await transport.connect("hostb", HELLO, Inbox().attach) for _ in range(16)]
            answers = Inbox()
            link = await transport.connect("hostc", HELLO, answers.attach)
            peers[0].send_signal(signal.SIGSTOP)
            for one in links:
                one.send_now(Note(1, bytes(WINDOW_BYTES)))
            began = time.monotonic()
            for number in range(1, 40):
                link.send_now(Note(number))
                await answers.messages_are(number)
            assert time.monotonic() - began < HELD_UP_S
        finally:
            for peer in peers:
                peer.kill()
                await peer.wait()
            await transport.close()

    asyncio.run(scenario())


def test_a_link_that_has_ended_at_the_other_side_alone_is_lost_with_the_first_message() -> None:
    async def scenario() -> None:
        endpoint = f"tcp/127.0.0.1:{free_port()}"
        door, inbox = Door(), Inbox()
        one = ZenohTransport("group", "hosta", {"registrar": Note}, listen=[endpoint])
        other = ZenohTransport("group", "hostb", {"registrar": Note}, connect=[endpoint])
        try:
            await one.listen(door)
            link = await other.connect("hosta", HELLO, inbox.attach)
            there = (await door.opened()).link
            assert isinstance(there, HostLink)
            there.end(None)  # as though the network had said that hostb is gone, and hostb had heard nothing
            link.send_now(Note(1))
            assert "has ended at this side" in str(await inbox.is_lost())
        finally:
            await other.close()
            await one.close()

    asyncio.run(scenario())
