"""What transport.py promises, of every transport, on every event loop."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import AsyncIterator, Callable, Coroutine, Iterator
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import pytest

from rr_actors.base.errors import NameTaken, RrError, Unavailable, UnknownRegistrar, UsageError
from rr_actors.wire.hosts.zenoh_link import ZenohTransport
from rr_actors.wire.local_transport import LocalTransport
from rr_actors.wire.transport import Accept, Link, Receiver, Transport, Welcome
from rr_actors.wire.unix_transport import UnixTransport
from support_transports import HELLO, KEY, LOOPS, Door, Inbox, Note, free_port, loop_of

CODECS = {"registrar": Note}


class World:
    """Makes transports that can reach each other, and closes them. The local one reaches itself alone."""

    def __init__(self, kind: str, directory: Path) -> None:
        self.kind = kind
        self._directory = directory
        self._local = LocalTransport()
        self._endpoint = f"tcp/127.0.0.1:{free_port()}"  # of the first transport between hosts
        self._made: list[Transport] = [self._local]

    def transport(self) -> Transport:
        if self.kind == "local":
            return self._local
        made = self._between_hosts() if self.kind == "zenoh" else UnixTransport(self._directory, KEY, CODECS)
        self._made.append(made)
        return made

    def _between_hosts(self) -> Transport:
        number = len(self._made)
        endpoints = [self._endpoint]
        here, there = (endpoints, []) if number == 1 else ([], endpoints)
        return ZenohTransport("contract", f"host{number}", CODECS, listen=here, connect=there)

    async def pair(self, accept: Accept) -> tuple[Transport, Transport]:
        provider, consumer = self.transport(), self.transport()
        await provider.listen(accept)
        return provider, consumer

    async def close(self) -> None:
        for transport in self._made:
            await transport.close()


Scenario = Callable[[World], Coroutine[Any, Any, None]]
Run = Callable[[Scenario], None]


@pytest.fixture(params=LOOPS)
def loop(request: pytest.FixtureRequest) -> Iterator[asyncio.AbstractEventLoop]:
    with loop_of(request.param) as new_loop:
        yield new_loop


@pytest.fixture(params=["unix", "local", "zenoh"])
def run(request: pytest.FixtureRequest, loop: asyncio.AbstractEventLoop, tmp_path: Path) -> Run:
    """Run a scenario on the loop, with one of the transports; nothing may be left afterwards."""

    async def in_world(scenario: Scenario) -> None:
        async with world(request.param, tmp_path) as the_world:
            await asyncio.wait_for(scenario(the_world), 30)

    def run_in_world(scenario: Scenario) -> None:
        loop.run_until_complete(in_world(scenario))
        assert not list(tmp_path.iterdir())

    return run_in_world


@asynccontextmanager
async def world(kind: str, directory: Path) -> AsyncIterator[World]:
    made = World(kind, directory)
    try:
        yield made
    finally:
        await made.close()


# -- opening -------------------------------------------------------------------------------------------------------


def test_a_link_opens_and_both_ends_know_each_other(run: Run) -> None:
    async def scenario(world: World) -> None:
        door = Door()
        provider, consumer = await world.pair(door)
        inbox = Inbox()
        link = await consumer.connect(provider.address, HELLO, inbox.attach)
        assert link is inbox.link
        assert (link.hello, link.welcome) == (HELLO, Welcome(42))
        assert link.peer.startswith("cameras (")
        there = door.inboxes[0].link
        assert there is not None
        assert (there.hello, there.welcome) == (HELLO, Welcome(42))
        assert there.peer.startswith("app (")

    run(scenario)


def test_a_transport_may_connect_to_itself(run: Run) -> None:
    async def scenario(world: World) -> None:
        door = Door()
        transport = world.transport()
        await transport.listen(door)
        link = await transport.connect(transport.address, HELLO, Inbox().attach)
        link.send(Note(1))
        link.flush()
        assert await door.inboxes[0].messages_are(1) == [Note(1)]

    run(scenario)


def test_connecting_where_nobody_listens_raises_unavailable_naming_whom_and_where(run: Run) -> None:
    async def scenario(world: World) -> None:
        consumer, silent = world.transport(), world.transport()
        for address in ("nowhere", silent.address, "", "a/b", "x" * 300, "\0"):
            with pytest.raises(Unavailable, match="cameras") as caught:
                await consumer.connect(address, HELLO, Inbox().attach)
            assert address in str(caught.value) or address == "\0"

    run(scenario)


def test_connecting_to_one_that_has_closed_raises_unavailable(run: Run) -> None:
    async def scenario(world: World) -> None:
        provider, consumer = await world.pair(Door())
        await provider.close()
        with pytest.raises(Unavailable):
            await consumer.connect(provider.address, HELLO, Inbox().attach)

    run(scenario)


@pytest.mark.parametrize(
    "refusal",
    [
        UnknownRegistrar("no registrar 'cameras' here: it has 'lidars'", registrar="cameras", known=("lidars",)),
        NameTaken("app is taken", name="app"),
        Unavailable("later \N{SNOWMAN}"),
    ],
    ids=lambda error: type(error).__name__,
)
def test_connect_raises_what_accept_raised(run: Run, refusal: RrError) -> None:
    async def scenario(world: World) -> None:
        provider, consumer = await world.pair(Door(refuse=refusal))
        inbox = Inbox()
        with pytest.raises(type(refusal)) as caught:
            await consumer.connect(provider.address, HELLO, inbox.attach)
        assert str(caught.value) == str(refusal)
        assert caught.value.details == refusal.details
        assert inbox.link is None

    run(scenario)


def test_connect_raises_what_the_far_attach_raised_and_nobody_hears_of_a_link(run: Run) -> None:
    async def scenario(world: World) -> None:
        def attach(link: Link) -> Receiver:
            raise NameTaken("too late", name="app")

        provider, consumer = await world.pair(lambda hello: (Welcome(1), attach))
        inbox = Inbox()
        with pytest.raises(NameTaken, match="too late"):
            await consumer.connect(provider.address, HELLO, inbox.attach)
        assert inbox.link is None

    run(scenario)


def test_an_accept_that_fails_unexpectedly_refuses_with_its_error_and_is_logged(
    run: Run, caplog: pytest.LogCaptureFixture
) -> None:
    async def scenario(world: World) -> None:
        provider, consumer = await world.pair(Door(refuse=ZeroDivisionError("oops")))
        with pytest.raises(RrError, match="ZeroDivisionError: oops"):
            await consumer.connect(provider.address, HELLO, Inbox().attach)

    with caplog.at_level(logging.ERROR):
        run(scenario)
    assert "app" in caplog.text


def test_when_the_near_attach_raises_connect_does_and_the_far_side_hears_lost(run: Run) -> None:
    async def scenario(world: World) -> None:
        door = Door()
        provider, consumer = await world.pair(door)

        def attach(link: Link) -> Receiver:
            raise NameTaken("changed my mind", name="x")

        with pytest.raises(NameTaken, match="changed my mind"):
            await consumer.connect(provider.address, HELLO, attach)
        await door.inboxes[0].is_lost()

    run(scenario)


def test_listening_twice_is_an_error(run: Run) -> None:
    async def scenario(world: World) -> None:
        provider, _ = await world.pair(Door())
        with pytest.raises(UsageError):
            await provider.listen(Door())

    run(scenario)


def test_a_connect_that_is_cancelled_leaves_no_link_behind(run: Run) -> None:
    async def scenario(world: World) -> None:
        door = Door()
        provider, consumer = await world.pair(door)
        for turns in range(12):
            inbox = Inbox()
            task = asyncio.ensure_future(consumer.connect(provider.address, HELLO, inbox.attach))
            for _ in range(turns):
                await asyncio.sleep(0)
            task.cancel()
            results = await asyncio.gather(task, return_exceptions=True)
            if isinstance(results[0], BaseException):
                if inbox.link is not None:
                    await inbox.is_lost()
            elif inbox.link is not None:
                inbox.link.close()
        for inbox in door.inboxes:
            await inbox.is_lost()

    run(scenario)


# -- messages ------------------------------------------------------------------------------------------------------


def test_messages_arrive_whole_in_order_and_once_both_ways(run: Run) -> None:
    async def scenario(world: World) -> None:
        door = Door()
        provider, consumer = await world.pair(door)
        here = Inbox()
        link = await consumer.connect(provider.address, HELLO, here.attach)
        there = door.inboxes[0]
        assert there.link is not None
        sent = [Note(number, bytes([number % 256]) * (number * 37 % 5000)) for number in range(2000)]
        for start in range(0, len(sent), 50):
            for message in sent[start : start + 50]:
                link.send(message)
                there.link.send(message)
            link.flush()
            there.link.flush()
            await asyncio.sleep(0)
        assert await there.messages_are(2000) == sent
        assert await here.messages_are(2000) == sent

    run(scenario)


def test_a_message_of_the_greatest_size_arrives_and_those_around_it_too(run: Run) -> None:
    async def scenario(world: World) -> None:
        door = Door()
        provider, consumer = await world.pair(door)
        link = await consumer.connect(provider.address, HELLO, Inbox().attach)
        sent = [Note(1), Note(2, bytes(16 * 1024 * 1024 - 16)), Note(3)]
        for message in sent:
            link.send(message)
        link.flush()
        assert await door.inboxes[0].messages_are(3) == sent

    run(scenario)


def test_nothing_arrives_before_it_is_flushed(run: Run) -> None:
    async def scenario(world: World) -> None:
        door = Door()
        provider, consumer = await world.pair(door)
        link = await consumer.connect(provider.address, HELLO, Inbox().attach)
        other = await consumer.connect(provider.address, HELLO, Inbox().attach)
        link.send(Note(1))
        for number in range(5):
            other.send(Note(number))
            other.flush()
            await door.inboxes[1].messages_are(number + 1)
        assert door.inboxes[0].messages == []
        link.flush()
        assert await door.inboxes[0].messages_are(1) == [Note(1)]

    run(scenario)


def test_a_receiver_is_never_called_from_within_send_or_flush_or_close(run: Run) -> None:
    async def scenario(world: World) -> None:
        inside = False
        problems: list[str] = []

        def answer(link: Link, message: Any) -> None:
            nonlocal inside
            if inside:
                problems.append(f"received {message} inside another call")
            inside = True
            link.send(Note(message.number + 1))
            link.flush()
            inside = False

        here, there = Inbox(answer), Inbox(answer)
        provider, consumer = await world.pair(lambda hello: (Welcome(1), there.attach))
        link = await consumer.connect(provider.address, HELLO, here.attach)
        inside = True
        link.send(Note(0))
        link.flush()
        assert not there.messages
        inside = False
        await here.messages_are(20)
        inside = True
        link.close()
        assert not here.lost_reasons
        inside = False
        await there.is_lost()
        assert not problems

    run(scenario)


def test_what_is_sent_while_attaching_arrives_right_after_the_welcome(run: Run) -> None:
    async def scenario(world: World) -> None:
        door = Door(greeting=3)
        provider, consumer = await world.pair(door)
        here = Inbox()
        there_first = Note(99)

        def attach(link: Link) -> Receiver:
            link.send(there_first)
            link.flush()
            return here.attach(link)

        await consumer.connect(provider.address, HELLO, attach)
        assert await here.messages_are(3) == [Note(0), Note(1), Note(2)]
        assert await door.inboxes[0].messages_are(1) == [there_first]

    run(scenario)


def test_links_are_independent(run: Run) -> None:
    async def scenario(world: World) -> None:
        door = Door()
        provider, consumer = await world.pair(door)
        inboxes = [Inbox() for _ in range(50)]
        links = await asyncio.gather(*(consumer.connect(provider.address, HELLO, inbox.attach) for inbox in inboxes))
        links[0].close()
        await inboxes[0].is_lost()
        for link in links[1:]:
            link.send(Note(1))
            link.flush()
        lost = [inbox for inbox in door.inboxes if inbox.lost_reasons]
        for inbox in door.inboxes:
            await inbox.until(lambda inbox=inbox: bool(inbox.messages or inbox.lost_reasons))
        lost = [inbox for inbox in door.inboxes if inbox.lost_reasons]
        assert len(lost) == 1

    run(scenario)


# -- closing -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("closer", ["dialler", "acceptor"])
def test_close_sends_what_is_queued_and_both_hear_lost_once_without_a_reason(run: Run, closer: str) -> None:
    async def scenario(world: World) -> None:
        door = Door()
        provider, consumer = await world.pair(door)
        here = Inbox()
        link = await consumer.connect(provider.address, HELLO, here.attach)
        there = door.inboxes[0]
        assert there.link is not None
        near, far, closing = (here, there, link) if closer == "dialler" else (there, here, there.link)
        for number in range(1000):
            closing.send(Note(number, bytes(1000)))
        closing.close()
        closing.close()
        assert await far.is_lost() is None
        assert await near.is_lost() is None
        assert [message.number for message in far.messages] == list(range(1000))
        await world.close()
        assert far.lost_reasons == near.lost_reasons == [None]

    run(scenario)


def test_both_may_close_at_the_same_time(run: Run) -> None:
    async def scenario(world: World) -> None:
        door = Door()
        provider, consumer = await world.pair(door)
        here = Inbox()
        link = await consumer.connect(provider.address, HELLO, here.attach)
        there = door.inboxes[0]
        assert there.link is not None
        link.close()
        there.link.close()
        await here.is_lost()
        await there.is_lost()
        await world.close()
        assert here.lost_reasons == there.lost_reasons == [None]

    run(scenario)


def test_sending_on_a_lost_link_is_silent(run: Run) -> None:
    async def scenario(world: World) -> None:
        door = Door()
        provider, consumer = await world.pair(door)
        here = Inbox()
        link = await consumer.connect(provider.address, HELLO, here.attach)
        there = door.inboxes[0]
        link.close()
        await there.is_lost()
        await here.is_lost()
        for closed in (link, there.link):
            assert closed is not None
            closed.send(Note(1))
            closed.flush()
            closed.close()
        assert not here.messages
        assert not there.messages

    run(scenario)


def test_after_close_nothing_is_received_any_more(run: Run) -> None:
    async def scenario(world: World) -> None:
        there = Inbox(lambda link, message: link.close() if message.number == 2 else None)
        provider, consumer = await world.pair(lambda hello: (Welcome(1), there.attach))
        here = Inbox()
        link = await consumer.connect(provider.address, HELLO, here.attach)
        for number in range(10):
            link.send(Note(number))
        link.flush()
        await there.is_lost()
        await here.is_lost()
        assert [message.number for message in there.messages] == [0, 1, 2]

    run(scenario)


@pytest.mark.parametrize("closer", ["provider", "consumer"])
def test_closing_a_transport_closes_each_link_and_has_told_each_receiver_when_it_returns(run: Run, closer: str) -> None:
    async def scenario(world: World) -> None:
        door = Door()
        provider, consumer = await world.pair(door)
        inboxes = [Inbox() for _ in range(20)]
        for number, inbox in enumerate(inboxes):
            link = await consumer.connect(provider.address, HELLO, inbox.attach)
            link.send(Note(number))
        first, near, far = (
            (provider, door.inboxes, inboxes) if closer == "provider" else (consumer, inboxes, door.inboxes)
        )
        await first.close()
        assert [inbox.lost_reasons for inbox in near] == [[None]] * 20
        for inbox in far:
            assert await inbox.is_lost() is None
        if closer == "consumer" and first is not provider:  # a closing end sends, and receives no more
            assert sorted(inbox.messages[0].number for inbox in far) == list(range(20))
        await first.close()
        with pytest.raises((Unavailable, UsageError)):
            await first.connect(provider.address, HELLO, Inbox().attach)

    run(scenario)


def test_a_receiver_that_raises_loses_its_own_link_with_the_error_and_the_log_names_the_peer(
    run: Run, caplog: pytest.LogCaptureFixture
) -> None:
    async def scenario(world: World) -> None:
        failure = ZeroDivisionError("a bug")

        def fail(link: Link, message: Any) -> None:
            raise failure

        there = Inbox(fail)
        provider, consumer = await world.pair(lambda hello: (Welcome(1), there.attach))
        here = Inbox()
        link = await consumer.connect(provider.address, HELLO, here.attach)
        link.send(Note(1))
        link.send(Note(2))
        link.flush()
        assert await there.is_lost() is failure
        assert await here.is_lost() is not None
        assert there.messages == [Note(1)]

    with caplog.at_level(logging.ERROR):
        run(scenario)
    assert "app (" in caplog.text
