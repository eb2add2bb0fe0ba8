"""Peers that have the key and are broken: their own link is closed, with an error that has a name, and nothing else."""

from __future__ import annotations

import logging
import random
import socket
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgspec
import pytest
from test_strangers import cut_off, dialled, socket_of, use

import rr_actors as rr
from fuzz.packed import changed, samples
from rr_actors.actors.remote import protocol
from rr_actors.base.values.canonical import encode
from rr_actors.registrar.links import remote_calls
from rr_actors.registrar.links.provider_link import THREADS as DIRECT
from rr_actors.registrar.model.messages import (
    Describe,
    Fetch,
    Gone,
    Load,
    Loaded,
    Message,
    NoticesHandled,
    Probe,
    Unload,
    Unloaded,
)
from rr_actors.wire.frames import GOODBYE
from rr_actors.wire.handshake import DiallerHandshake
from rr_actors.wire.transport import Hello
from support import Workshop, eventually, pid_of
from support_inside import actor_of, node_of
from support_managers import Order, Shop
from support_transports import frame

Start = Callable[..., rr.System]
KINDS: dict[str, Any] = {
    "registrar": Message,
    remote_calls.KIND: remote_calls.HandleMessage,
    protocol.KIND: protocol.Letter,
}
LARGE = encode(Order("large"))
LOAD = Load("0" * 32, "thing", LARGE, "mistaken", "", 1, 1)


@pytest.fixture
def shop(start: Start, workshop: Workshop) -> rr.System:
    """A system with a manager, `shop`, in a process of its own."""
    return start(rr.ChildSpec(Shop, id="shop", args=(str(workshop.root),)))


@pytest.fixture
def app(shop: rr.System) -> rr.Registrar:
    """A consumer in this process."""
    return shop.open_registrar("app")


def let_in(peer: socket.socket, system: rr.System, hello: Hello) -> None:
    """Prove on a fresh connection that one has the key, and be welcomed."""
    node = node_of(system)
    handshake = DiallerHandshake(node.info.key, hello)
    while not handshake.done:
        data = peer.recv(4096)
        assert data
        peer.sendall(handshake.receive(data))
    assert handshake.refusal is None


def bodies(*messages: Any) -> bytes:
    return b"".join(frame(msgspec.msgpack.encode(message)) for message in messages)


WRONG: dict[str, bytes] = {
    "no message": frame(b"\xc1\xc1\xc1"),
    "a message of no kind": frame(msgspec.msgpack.encode([99, "x"])),
    "fields of other types": frame(msgspec.msgpack.encode([1, 5, None, [], {}, 1.5, "x", "y"])),
    "too few fields": frame(msgspec.msgpack.encode([1, "x"])),
    "a text that is no Unicode": frame(b"\x93\x04\xa2\xff\xfe\xa1x"),
    "depth without end": frame(b"\x91" * 50_000 + b"\xc0"),
    "a number over 64 bits": frame(b"\x92\x07\xd3" + b"\xff" * 3),
    "a gigabyte announced": struct.pack(">I", 2**30) + bytes(100),
    "what a provider says": bodies(Loaded("1" * 32, "2" * 32, LARGE)),
    "what another consumer holds": bodies(msgspec.structs.replace(LOAD, origin="app")),
    "another consumer's release": bodies(Unload("3" * 32, "app")),
    "another consumer's end": bodies(Gone("app")),
    "another consumer's list": bodies(Fetch("app", True, 1)),
    "a number that no catalog holds": bodies(msgspec.structs.replace(LOAD, seq=2**63)),
}
"""What closes the link."""


def test_what_no_consumer_says_closes_its_link_with_a_named_error_and_nothing_else(
    shop: rr.System, app: rr.Registrar, state_dir: Path, caplog: pytest.LogCaptureFixture
) -> None:
    held, pid = app.load("shop/thing", Order("held")), pid_of(shop, "shop")
    for incarnation, (wrong, said) in enumerate(WRONG.items(), 1):
        caplog.clear()
        with caplog.at_level(logging.ERROR, "rr_actors"), dialled(socket_of(state_dir, "shop")) as [peer]:
            let_in(peer, shop, Hello("registrar", "shop", "mistaken", incarnation))
            peer.sendall(said)
            assert cut_off(peer), wrong
            eventually(lambda: "closing the link with mistaken" in caplog.text, what=wrong)
        use(app, f"after {wrong}")
        assert pid_of(shop, "shop") == pid, wrong
        assert [query.id for query in app.fetch_queries("shop")] == [held.id], wrong


ODD: dict[str, bytes] = {
    "answers to what nobody asked": bodies(Unload("4" * 32, "mistaken"), NoticesHandled(["x" * 1000] * 50)),
    "ids without end": bodies(msgspec.structs.replace(LOAD, query_id="5" * 500_000), Unload("6" * 500_000, "mistaken")),
    "ids that are none": bodies(msgspec.structs.replace(LOAD, query_id="", parent="\0", server="a/b/c")),
    "the same again and again": bodies(*[LOAD] * 300, *[Unload(LOAD.query_id, "mistaken")] * 300),
    "a probe that goes in a ring": bodies(Probe(LOAD.query_id, "x", LOAD.query_id, ["shop/thing"] * 1000)),
    "servers that are not there": bodies(*(Describe(f"none-{n}") for n in range(300))),
    "half a frame": bodies(LOAD)[:-5],
    "half a length": bodies(LOAD) + b"\0\0",
    "a goodbye, and more": bodies(LOAD) + GOODBYE + bodies(LOAD),
}
"""What is heard, and harms nobody."""


@pytest.mark.parametrize("kind", ["registrar", DIRECT])
def test_what_is_odd_harms_nobody_else(shop: rr.System, app: rr.Registrar, state_dir: Path, kind: str) -> None:
    held, pid = app.load("shop/thing", Order("held")), pid_of(shop, "shop")
    for incarnation, (odd, said) in enumerate(ODD.items(), 1):
        with dialled(socket_of(state_dir, "shop"), 2) as [first, peer]:
            let_in(first, shop, Hello("registrar", "shop", "mistaken", incarnation))
            if kind == DIRECT:
                let_in(peer, shop, Hello(DIRECT, "shop", "mistaken", incarnation))
            (peer if kind == DIRECT else first).sendall(said)
            use(app, f"while {odd}")
        use(app, f"after {odd}")
        assert pid_of(shop, "shop") == pid, odd
        assert [query.id for query in app.fetch_queries("shop")] == [held.id], odd


@pytest.mark.parametrize("kind", KINDS)
def test_messages_with_a_part_that_is_wrong_harm_nobody_else(
    shop: rr.System, app: rr.Registrar, state_dir: Path, kind: str
) -> None:
    chance, held, pid = random.Random(kind), app.load("shop/thing", Order("held")), pid_of(shop, "shop")
    good = samples(KINDS[kind])
    where = [socket_of(state_dir, name) for name in ("shop", "app")]
    for number in range(120):
        with dialled(where[number % 2]) as [peer]:
            let_in(peer, shop, Hello(kind, ("shop", "app")[number % 2], f"mistaken-{number}", number))
            some = [chance.choice(good) for _ in range(4)]
            try:
                peer.sendall(b"".join(frame(changed(body, chance)) for body in some))
            except OSError:
                continue  # it was cut off already
    use(app, "after")
    assert pid_of(shop, "shop") == pid
    assert [query.id for query in app.fetch_queries("shop")] == [held.id]


def test_an_answer_that_a_provider_gives_unasked_or_twice_is_nobodys(shop: rr.System, app: rr.Registrar) -> None:
    """The link to a good provider, on which answers come again: whatever was lost may have been sent twice."""
    held = app.load("shop/thing", Order("held"))
    actor: Any = actor_of(app)
    client = actor.clients["shop"]
    node = node_of(shop)

    async def say() -> None:
        for _ in range(3):
            client.received(client.link, Loaded(held.id, held.resource_id, LARGE))
            client.received(client.link, Loaded("7" * 32, "8" * 32, LARGE))
            client.received(client.link, Unloaded("9" * 32))

    node.dispatcher.run(say(), 5.0)
    assert [query.id for query in app.queries()] == [held.id]
    use(app, "after")
    assert [query.id for query in app.fetch_queries("shop")] == [held.id]
