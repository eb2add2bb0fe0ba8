"""Large values between actors of two processes: what arrives, who owns it, and what is left when somebody is killed."""

from __future__ import annotations

import array
import contextlib
import gc
import os
import pickle
import signal
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import msgspec
import pykka
import pytest

import rr_actors as rr
from rr_actors.actors.refs import ref_to
from rr_actors.actors.remote.hub import urn_of_path
from rr_actors.actors.remote.protocol import KIND, Ask, Tell
from rr_actors.base import pickling
from rr_actors.wire.name_service import actor_key
from rr_actors.wire.segments import Parcel, Segments
from rr_actors.wire.transport import Hello, Link
from support import descriptors, eventually
from support_asks import warm
from support_refs import Home, open_home

Start = Callable[..., rr.System]

MB = 1_000_000


class Picture:
    """Has a buffer that pickle hands out of band, as numpy's arrays do."""

    def __init__(self, data: Any) -> None:
        self.data = data

    def __reduce_ex__(self, protocol: Any) -> Any:
        return Picture, (pickle.PickleBuffer(self.data),)


def picture(size: int, seed: int = 1) -> Picture:
    return Picture(bytearray(index * seed % 251 for index in range(251)) * (size // 251))


class Keeper(rr.Actor):
    """Keeps values, and says of them what a message asks for."""

    name = b""

    def __init__(self) -> None:
        super().__init__()
        self.kept: list[Any] = []

    def on_receive(self, message: Any) -> Any:
        what, value = message
        match what:
            case "echo":
                return value
            case "keep":
                self.kept.append(value)
            case "drop":
                self.kept.clear()
            case "write":
                memoryview(self.kept[-1].data)[0] = value
            case "kept":
                return [bytes(each.data) for each in self.kept]
            case "sizes":
                return [len(each.data) for each in self.kept]
            case "make":
                return picture(value)
            case "hang":
                threading.Event().wait()  # until it is killed
            case "fds":
                return len(memfds())
            case _:
                return os.getpid()
        return None

    def flip(self, value: Any) -> Any:
        return Picture(bytearray(bytes(value.data)[::-1]))


def memfds() -> set[tuple[str, str, int]]:
    return descriptors("memfd:rr_actors")


@pytest.fixture
def keeper(start: Start) -> Any:
    return start(rr.ChildSpec(Keeper, id="keeper", placement="process")).ref("keeper")


@pytest.mark.parametrize("block", [True, False])
@pytest.mark.parametrize("size", [196_607, 196_608, 196_609, 20 * MB])
def test_large_values_arrive_as_they_were(keeper: Any, size: int, block: bool) -> None:
    data = os.urandom(size)

    def ask(message: Any) -> Any:
        return keeper.ask(message) if block else keeper.ask(message, block=False).get(timeout=30)

    for value in (data, bytearray(data), {"a": [array.array("B", data), "text"]}, "x" * size):
        assert ask(("echo", value)) == value
    for buffer in (bytearray(data), array.array("B", data), memoryview(data)):
        assert bytes(ask(("echo", Picture(buffer))).data) == data


@pytest.mark.parametrize("frame_limit_bytes", [60_000, 150_000])
def test_a_value_that_is_too_long_for_a_frame_goes_through_a_segment(start: Start, frame_limit_bytes: int) -> None:
    config = rr.SystemConfig(frame_limit_bytes=frame_limit_bytes)
    keeper = start(rr.ChildSpec(Keeper, id="keeper", placement="process"), config=config).ref("keeper")
    for size in (30_000, 59_990, 70_000, 149_990, 190_000):
        assert keeper.ask(("echo", b"x" * size)) == b"x" * size


def test_what_was_told_is_the_receivers_own(keeper: Any) -> None:
    sent = picture(MB)
    before = bytes(sent.data)
    keeper.tell(("keep", sent))
    sent.data[:] = bytes(len(sent.data))  # at once
    keeper.tell(("write", 77))
    assert keeper.ask(("kept", None)) == [b"\x4d" + before[1:]]
    assert sent.data[0] == 0


def test_what_was_replied_is_the_askers_own_and_outlives_the_actors_process(start: Start) -> None:
    system = start(rr.ChildSpec(Keeper, id="keeper", placement="process"))
    keeper = system.ref("keeper")
    made = [keeper.ask(("make", MB)) for _ in range(3)]
    content = bytes(picture(MB).data)
    memoryview(made[0].data)[0] = 9
    assert keeper.kill()
    eventually(lambda: not keeper.is_alive() or keeper.pid is not None, 20)
    assert [bytes(each.data)[1:] == content[1:] for each in made] == [True, True, True]
    assert [each.data[0] for each in made] == [9, 0, 0]
    system.stop()
    assert bytes(made[1].data) == content
    del made
    gc.collect()


def test_values_that_are_kept_are_never_overwritten(keeper: Any) -> None:
    expected: list[bytes] = []
    for seed in range(1, 30):
        value = picture(70_000 + 10_000 * (seed % 7), seed)
        keeper.tell(("keep", value))
        expected.append(bytes(value.data))
        assert bytes(keeper.ask(("echo", value)).data) == expected[-1]
    assert keeper.ask(("kept", None)) == expected


def test_proxies_carry_large_values(keeper: Any) -> None:
    value = picture(MB)
    assert bytes(keeper.proxy().flip(value).get(timeout=30).data) == bytes(value.data)[::-1]


def test_any_number_of_values_takes_few_descriptors(keeper: Any) -> None:
    gc.collect()
    before = memfds()  # a test before this one may have left some to the collector
    held = [keeper.ask(("make", 100_000)) for _ in range(200)]
    for each in held:
        keeper.tell(("keep", each))
    assert keeper.ask(("fds", None)) <= 6
    assert len(memfds() - before) <= 6


def test_numpy_arrays_arrive_writable(keeper: Any) -> None:
    numpy: Any = pytest.importorskip("numpy")
    sent = numpy.arange(300_000, dtype="f8").reshape(300, 1000)
    arrived = keeper.ask(("echo", {"picture": sent, "part": sent[:, ::2]}))
    assert (arrived["picture"] == sent).all()
    assert (arrived["part"] == sent[:, ::2]).all()
    arrived["picture"][:] = 0
    assert sent[0, 1] == 1


def test_the_limit_of_the_segments_holds_and_its_error_is_the_callers(start: Start) -> None:
    config = rr.SystemConfig(segments_limit_bytes=2 * MB, frame_limit_bytes=MB)
    keeper = start(rr.ChildSpec(Keeper, id="keeper", placement="process"), config=config).ref("keeper")
    for _ in range(3):
        keeper.tell(("keep", picture(900_000)))  # the third goes in band
    assert keeper.ask(("sizes", None), timeout=30) == [900_000 // 251 * 251] * 3
    with pytest.raises(rr.MailboxFull, match="segments_limit_bytes"):
        keeper.tell(("keep", picture(3 * MB)))
    with pytest.raises(rr.MailboxFull, match="segments_limit_bytes"):
        keeper.ask(("echo", picture(3 * MB)))
    with pytest.raises(rr.MailboxFull, match="segments_limit_bytes"):
        keeper.ask(("make", 3 * MB))
    keeper.ask(("drop", None))
    assert len(keeper.ask(("echo", picture(MB))).data) > 0.9 * MB


def test_no_segments_are_made_where_the_limit_is_0(start: Start) -> None:
    config = rr.SystemConfig(segments_limit_bytes=0)
    keeper = start(rr.ChildSpec(Keeper, id="keeper", placement="process"), config=config).ref("keeper")
    before = memfds()
    assert bytes(keeper.ask(("echo", picture(MB))).data) == bytes(picture(MB).data)
    assert keeper.ask(("fds", None)) == 0
    assert not memfds() - before


# -- somebody is killed ------------------------------------------------------------------------------------------------


def test_when_the_actors_process_is_killed_in_the_middle_nothing_is_left(start: Start) -> None:
    gc.collect()
    before = memfds()
    system = start(rr.ChildSpec(Keeper, id="keeper", placement="process", restart="permanent"))
    keeper = system.ref("keeper")
    content = bytes(picture(2 * MB).data)
    for _ in range(3):
        pid = keeper.ask(("pid", None), timeout=30)
        answers = [keeper.ask(("echo", picture(2 * MB)), block=False) for _ in range(6)]
        waits = keeper.ask(("hang", picture(2 * MB)), block=False)
        os.kill(pid, signal.SIGKILL)
        for answer in answers:
            with contextlib.suppress(pykka.ActorDeadError, rr.Unavailable):
                assert bytes(answer.get(timeout=30).data) == content
        with pytest.raises((pykka.ActorDeadError, rr.Unavailable)):
            waits.get(timeout=30)
        eventually(lambda pid=pid: keeper.pid not in (None, pid), 20)
        answers.clear()
    assert bytes(keeper.ask(("echo", picture(2 * MB)), timeout=30).data) == content
    system.stop()
    gc.collect()
    assert not memfds() - before
    assert not [path for path in Path("/dev/shm").glob("*rr_actors*") if not path.is_dir()]


def test_an_ask_that_was_given_up_keeps_no_memory(keeper: Any) -> None:
    for _ in range(4):
        with contextlib.suppress(pykka.Timeout):
            keeper.ask(("echo", picture(5 * MB)), timeout=0.0001)
    assert bytes(keeper.ask(("echo", picture(MB)), timeout=30).data) == bytes(picture(MB).data)
    eventually(lambda: keeper.ask(("fds", None)) <= 6, 20)


# -- a peer that lies --------------------------------------------------------------------------------------------------


class Liar:
    """Another process's end of a link, here: it sends what it likes."""

    def __init__(self) -> None:
        self.answers: list[Any] = []
        self.lost_links: list[Link] = []

    def received(self, link: Link, message: Any) -> None:
        self.answers.append(message)

    def lost(self, link: Link, reason: Exception | None) -> None:
        self.lost_links.append(link)


LIES: list[dict[str, Any]] = [
    {"start": 2**40},
    {"start": 0},
    {"slot": 4},
    {"lengths": (2**50,)},
    {"lengths": ()},
    {"key": 1},
    {"segment_bytes": 8192},
]


@pytest.fixture(scope="module")
def home(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Home]:
    home, state = open_home(tmp_path_factory.mktemp("lies") / "state")
    try:
        home.start_other(a="Remote")
        warm(ref_to("root/a"))
        yield home
    finally:
        home.close()
        state.close()


@pytest.mark.parametrize("lie", LIES)
@pytest.mark.parametrize("asks", [True, False])
def test_a_peer_that_lies_loses_its_connection_and_nothing_else(home: Home, lie: dict[str, Any], asks: bool) -> None:
    ref: Any = ref_to("root/a")
    data = bytes(range(256)) * 1000
    assert ref.ask(data) == data
    entry = home.directory.lookup(actor_key("root/a"))
    assert entry is not None
    liar = Liar()

    async def connect() -> Link:
        return await home.transport.connect(entry.address, Hello(KIND, entry.address, "liar", 0), lambda _: liar)

    link = home.dispatcher.run(connect())
    parcel = Segments(2**24).parcels(ref.pid)
    packed = parcel.pack(pickling.dumps_large(data, "value"))
    assert isinstance(packed, Parcel)
    body = msgspec.structs.replace(packed, **lie)
    home.dispatcher.call(link.send_now, Ask(1, urn_of_path("root/a"), body, ()) if asks else Tell("", body))
    eventually(lambda: liar.lost_links == [link], 20)
    assert not liar.answers
    assert ref.ask(data) == data
