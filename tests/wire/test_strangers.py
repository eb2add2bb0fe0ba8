"""Strangers at a real system: who does not have the key is refused or bounded, everyone else is unharmed, and none of
what a stranger sends is ever unpickled."""

from __future__ import annotations

import asyncio
import base64
import contextlib
import os
import pickle
import re
import resource
import socket
import struct
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import msgspec
import pytest

import rr_actors as rr
from rr_actors.actors.remote import protocol
from rr_actors.base.errors import Unavailable
from rr_actors.base.values.canonical import encode
from rr_actors.registrar.links import remote_calls
from rr_actors.registrar.links.provider_link import THREADS as DIRECT
from rr_actors.registrar.model.messages import Describe, Described, Fetched, Load, Message
from rr_actors.wire.handshake import PROTOCOL
from rr_actors.wire.name_service import Directory, Presence, registrar_key
from rr_actors.wire.transport import Hello, Link
from rr_actors.wire.unix_transport import STRANGERS_LIMIT, UnixTransport
from support import Workshop, eventually, pid_of
from support_inside import node_of
from support_managers import Order, Shop
from support_transports import frame

Start = Callable[..., rr.System]
MAGIC = b"rr_actor"


@pytest.fixture
def shop(start: Start, workshop: Workshop) -> rr.System:
    """A system with a manager, `shop`, in a process of its own."""
    return start(rr.ChildSpec(Shop, id="shop", args=(str(workshop.root),)))


@pytest.fixture
def app(shop: rr.System) -> rr.Registrar:
    """A consumer in this process."""
    return shop.open_registrar("app")


def run_dir(state_dir: Path) -> Path:
    (found,) = (state_dir / "run").iterdir()
    return found


def socket_of(state_dir: Path, registrar: str) -> Path:
    """The socket of the process that a registrar is in."""
    entry = Directory(run_dir(state_dir)).lookup(registrar_key(registrar))
    assert entry is not None
    assert entry.status is Presence.UP
    return run_dir(state_dir) / entry.address


@contextlib.contextmanager
def dialled(path: Path, count: int = 1) -> Iterator[list[socket.socket]]:
    """Connections that say nothing yet; those for which there is no room at the door are left out."""
    peers: list[socket.socket] = []
    directory = os.open(path.parent, os.O_PATH)  # by it the name is short enough for a socket, wherever it lies
    try:
        for _ in range(count):
            peers.append(peer := socket.socket(socket.AF_UNIX))
            peer.settimeout(5.0)
            peer.connect(f"/proc/self/fd/{directory}/{path.name}")
        yield peers
    finally:
        os.close(directory)
        for peer in peers:
            peer.close()


def cut_off(peer: socket.socket) -> bool:
    """Whether the other end has closed the connection; what it said first is read."""
    try:
        while peer.recv(4096):
            pass
    except TimeoutError:
        return False
    except ConnectionError:
        return True
    return True


def use(app: rr.Registrar, name: str) -> None:
    """Load and unload something, within a time that nobody minds."""
    with app.load("shop/thing", Order(name), timeout_s=5.0) as query:
        assert query.response.name == name


WORDS = {
    "an old protocol": MAGIC + struct.pack(">H", PROTOCOL - 1) + bytes(64),
    "a newer protocol": MAGIC + struct.pack(">H", PROTOCOL + 1) + bytes(64),
    "a wrong proof": MAGIC + struct.pack(">H", PROTOCOL) + os.urandom(64),
    "HTTP": b"GET / HTTP/1.1\r\nHost: localhost\r\n\r\n" + b"x" * 100,
    "garbage": os.urandom(5000),
    "an announced gigabyte": b"\x40\x00\x00\x00" + bytes(2000),
}


@pytest.mark.parametrize("words", WORDS.values(), ids=WORDS)
def test_who_does_not_prove_himself_is_cut_off_and_nobody_else_notices(
    shop: rr.System, app: rr.Registrar, state_dir: Path, words: bytes
) -> None:
    held = app.load("shop/thing", Order("held"))
    for registrar in ("app", "shop"):
        with dialled(socket_of(state_dir, registrar)) as [peer]:
            peer.sendall(words)
            assert cut_off(peer)
    use(app, "another")
    assert [query.id for query in app.queries()] == [held.id]


def test_many_bad_connections_are_counted_and_summed_up_in_the_log(
    system: rr.System, state_dir: Path, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("rr_actors.wire.unix_sockets.REFUSALS_S", 0.5)
    system.open_registrar("app")
    for _ in range(50):
        with dialled(socket_of(state_dir, "app"), 6) as peers:
            for peer in peers:
                peer.sendall(WORDS["HTTP"])
            assert all(map(cut_off, peers))

    def counted() -> tuple[int, int]:
        said = [record.getMessage() for record in caplog.records]
        more = [int(text.split()[0]) for text in said if " more connections were refused within " in text]
        return sum(text.startswith("closing a connection of pid") for text in said) + sum(more), len(said)

    eventually(lambda: counted()[0] == 300)
    assert counted()[1] < 30


def test_a_peer_with_another_systems_key_is_refused(shop: rr.System, state_dir: Path) -> None:
    async def dial() -> None:
        stranger = UnixTransport(run_dir(state_dir), os.urandom(32), {"registrar": Message})
        with pytest.raises(Unavailable, match="another key"):
            await stranger.connect(
                socket_of(state_dir, "shop").name, Hello("registrar", "shop", "app", 1), lambda link: Nobody()
            )
        await stranger.close()

    asyncio.run(dial())


def test_a_thousand_silent_connections_and_slow_ones_are_bounded_and_harm_nobody(
    shop: rr.System, app: rr.Registrar, state_dir: Path, workshop: Workshop
) -> None:
    held = app.load("shop/thing", Order("held"))
    pid = pid_of(shop, "shop")
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (min(hard, 4096), hard))
    before = len(os.listdir(f"/proc/{pid}/fd"))
    try:
        with dialled(socket_of(state_dir, "shop"), 1000) as peers:
            for n, peer in enumerate(peers):
                with contextlib.suppress(OSError):
                    peer.send(MAGIC[: n % 8])  # a slow one: the rest would come a byte at a time
            eventually(lambda: len(os.listdir(f"/proc/{pid}/fd")) <= before + STRANGERS_LIMIT + 10)
            for n in range(20):
                use(app, f"meanwhile-{n}")
                with contextlib.suppress(OSError):
                    peers[-1 - n].send(MAGIC[:1])
            late = shop.open_registrar("late")  # a new link, through the same door
            use(late, "late")
    finally:
        resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))
    eventually(lambda: len(os.listdir(f"/proc/{pid}/fd")) <= before + 5)
    assert pid_of(shop, "shop") == pid
    assert [query.id for query in app.queries()] == [held.id]
    assert shop.registrar("shop").resources()[0].id == held.resource_id


# -- nothing of a stranger's is unpickled --------------------------------------------------------------------------


class Trap:
    """Its pickle makes a file when it is opened."""

    def __init__(self, file: Path) -> None:
        self.file = file

    def __reduce__(self) -> tuple[Any, ...]:
        return (os.mkdir, (str(self.file),))


class Nobody:
    """Hears nothing."""

    def received(self, link: Link, message: Any) -> None:
        pass

    def lost(self, link: Link, reason: Exception | None) -> None:
        pass


def messages_with(trap: bytes) -> dict[str, tuple[str, Any]]:
    """One message of each kind that has room for bytes: the kind of its link, and itself."""
    return {
        "load": ("registrar", Load("0" * 32, "shop/thing", trap, "app", "", 1, 1)),
        "direct load": (DIRECT, Load("1" * 32, "shop/thing", trap, "app", "", 1, 1)),
        "describe": ("registrar", Describe("thing")),
        "call": (remote_calls.KIND, remote_calls.CallMethod(1, "children", trap)),
        "stored server": (remote_calls.KIND, remote_calls.CallMethod(2, "_register_stored", trap)),
        "returned": (remote_calls.KIND, remote_calls.Returned(1, trap)),
        "ask": (protocol.KIND, protocol.Ask(1, "root/shop", trap, ())),
        "tell": (protocol.KIND, protocol.Tell("root/shop", trap)),
        "answered": (protocol.KIND, protocol.Answered(1, trap)),
        "raised": (protocol.KIND, protocol.HandlerRaised(1, trap, "ValueError: x", "")),
    }


def as_frames(kind: str, message: Any) -> bytes:
    """What somebody with the key would send once he is let in."""
    hello = Hello(kind, "shop", "app", 1)
    return frame(msgspec.msgpack.encode(hello)) + frame(msgspec.msgpack.encode(message))


KINDS = list(messages_with(b""))


@pytest.mark.parametrize("kind", KINDS)
def test_no_pickle_of_a_stranger_is_opened_whatever_it_is_sent_as(
    shop: rr.System, app: rr.Registrar, state_dir: Path, tmp_path: Path, kind: str
) -> None:
    sprung = tmp_path / "sprung"
    trap = pickle.dumps(Trap(sprung))
    frames = as_frames(*messages_with(trap)[kind])
    proofs = [
        b"",
        MAGIC + struct.pack(">H", PROTOCOL),
        MAGIC + struct.pack(">H", PROTOCOL) + bytes(64),
        MAGIC + struct.pack(">H", PROTOCOL - 1) + bytes(64),
        trap,
    ]
    for registrar in ("app", "shop"):
        for proof in proofs:
            for padding in (b"", bytes(300)):  # so that a block of fixed size is complete
                with dialled(socket_of(state_dir, registrar)) as [peer]:
                    with contextlib.suppress(OSError):
                        peer.sendall(proof + frames + padding)
                        peer.shutdown(socket.SHUT_WR)
                    assert cut_off(peer)
    use(app, "after")  # what was sent has been read by then
    assert not sprung.exists()


def test_the_same_frames_from_a_peer_with_the_key_do_open_it(shop: rr.System, state_dir: Path, tmp_path: Path) -> None:
    """So the test above would see it: the frames are right, it is the key that is missing."""
    sprung = tmp_path / "sprung"
    trap = pickle.dumps(Trap(sprung))
    node = node_of(shop)
    key = node.info.key
    codecs = {remote_calls.KIND: remote_calls.HandleMessage, protocol.KIND: protocol.Letter}

    async def dial(kind: str, message: Any) -> None:
        friend = UnixTransport(run_dir(state_dir), key, codecs)
        link = await friend.connect(socket_of(state_dir, "shop").name, Hello(kind, "shop", "x", 1), lambda _: Nobody())
        link.send(message)
        link.flush()
        await friend.close()

    for name in ("call", "tell"):
        kind, message = messages_with(trap)[name]
        if name == "tell":
            message = protocol.Tell(shop.ref("root/shop").actor_urn, trap)
        asyncio.run(dial(kind, message))
        eventually(sprung.exists)
        sprung.rmdir()


@pytest.mark.parametrize(
    "message",
    [
        Fetched([]),
        Described("thing", b""),
        Load("q", "thing", encode(Order("large")), "mistaken", "", 0, 2**63),
        Load("q", "thing", encode(Order("large")), "mistaken", "", 2**64 - 1, 1),
    ],
    ids=["fetched", "described", "a number that no catalog holds", "an attempt that no catalog holds"],
)
def test_a_peer_that_says_what_it_may_not_loses_its_link_alone(
    shop: rr.System, app: rr.Registrar, state_dir: Path, message: Any
) -> None:
    """Even with the key: the registrar goes on, and so does everyone else."""
    pid = pid_of(shop, "shop")
    node = node_of(shop)
    key = node.info.key

    async def dial() -> None:
        lost = asyncio.Event()

        class Mistaken(Nobody):
            def lost(self, link: Link, reason: Exception | None) -> None:
                lost.set()

        friend = UnixTransport(run_dir(state_dir), key, {"registrar": Message})
        hello = Hello("registrar", "shop", "mistaken", 1)
        link = await friend.connect(socket_of(state_dir, "shop").name, hello, lambda _: Mistaken())
        link.send(message)
        link.flush()
        await asyncio.wait_for(lost.wait(), 5.0)
        await friend.close()

    asyncio.run(dial())
    use(app, "after")
    assert pid_of(shop, "shop") == pid


def test_a_pickle_in_place_of_a_request_stays_bytes(shop: rr.System, app: rr.Registrar, tmp_path: Path) -> None:
    sprung = tmp_path / "sprung"
    trap = pickle.dumps(Trap(sprung))
    with pytest.raises(rr.InvalidRequest):
        app.load("shop/thing", trap)
    provider = shop.open_registrar("provider")
    provider.register_server("echo", lambda request: request)
    with app.load("provider/echo", trap) as query:
        assert query.request == query.response == trap
    assert not sprung.exists()


def test_the_key_is_in_no_file_environment_or_command_line(shop: rr.System, app: rr.Registrar, state_dir: Path) -> None:
    use(app, "something")
    node = node_of(shop)
    key = node.info.key
    secrets = (key, key.hex().encode(), base64.b64encode(key))
    processes = [os.getpid(), pid_of(shop, "shop")]
    places = [path for path in state_dir.rglob("*") if path.is_file()]
    places += [Path(f"/proc/{pid}/{what}") for pid in processes for what in ("environ", "cmdline")]
    assert len(places) > 6
    for place in places:
        content = place.read_bytes()
        assert not any(secret in content for secret in secrets), place


ROOT = Path(__file__).parents[2]


def test_the_page_names_every_place_where_pickles_are_opened() -> None:
    """Whoever opens pickles somewhere else has to say in docs/security.md whose they are."""
    opening = {
        str(path.relative_to(ROOT))
        for path in (ROOT / "rr_actors").rglob("*.py")
        if re.search(r"\bpickling\.loads\b|\bfrom rr_actors\.base\.pickling import .*\bloads\b", path.read_text())
    }
    table = (ROOT / "docs" / "security.md").read_text().partition("| place |")[2].partition("\n\n")[0]
    assert set(re.findall(r"`(rr_actors/[\w/]+\.py)`", table)) == opening


def test_pickle_itself_is_used_in_one_place() -> None:
    uses = re.compile(r"^\s*(import|from) (pickle|marshal|shelve|dill)\b|[cC]onnection\.recv\(", re.MULTILINE)
    using = {path.name for path in (ROOT / "rr_actors").rglob("*.py") if uses.search(path.read_text())}
    assert using == {"pickling.py"}
