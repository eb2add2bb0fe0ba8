"""Frames and the handshake as bytes in, bytes out."""

from __future__ import annotations

import gc
import itertools
import pickle
import random
import struct
import tracemalloc
from typing import Any

import msgspec
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rr_actors.base.errors import ConfigError, LoadFailed, NotSerializable, RrError, Unavailable, UnknownServer
from rr_actors.base.values.failure import failure_of
from rr_actors.registrar.model.messages import Describe, Load, Loaded, Message
from rr_actors.wire.frames import GOODBYE, FrameReader, framed
from rr_actors.wire.handshake import PROTOCOL, AcceptorHandshake, DiallerHandshake, check_key
from rr_actors.wire.transport import Hello, Welcome
from support_transports import frame

KEY = bytes(range(32))
HELLO = Hello("registrar", "cameras", "app", 7)
DECODER: msgspec.msgpack.Decoder[Any] = msgspec.msgpack.Decoder(Message)
LIMIT = 4000


def load(number: int, request: bytes = b"\xc0") -> Load:
    return Load(f"{number:032x}", "cameras/camera", request, "app", "", 1, number)


def reader(limit: int = LIMIT) -> FrameReader[Any]:
    return FrameReader(DECODER, limit)


def written(*messages: Any) -> bytes:
    return b"".join(framed(message, LIMIT) for message in messages)


# -- frames --------------------------------------------------------------------------------------------------------


@given(sizes=st.lists(st.integers(0, 3000), max_size=12), cuts=st.lists(st.integers(0, 40_000), max_size=20))
def test_messages_come_out_as_they_went_in_however_the_stream_is_cut(sizes: list[int], cuts: list[int]) -> None:
    sent = [load(number, bytes(size)) for number, size in enumerate(sizes)]
    stream = written(*sent)
    edges = [0, *sorted(cut for cut in cuts if cut < len(stream)), len(stream)]
    one = reader()
    received = [message for start, end in itertools.pairwise(edges) for message in one.feed(stream[start:end])]
    assert received == sent
    assert one.error is None


@pytest.mark.parametrize("piece", [7, 4096, 65_536, 10**6])
def test_long_messages_come_out_whatever_their_pieces_are(piece: int) -> None:
    sent = [load(number, random.Random(number).randbytes(size)) for number, size in enumerate((5000, 300_000, 1, 9000))]
    stream = b"".join(framed(message, 10**6) for message in sent)
    one = reader(10**6)
    received = [message for at in range(0, len(stream), piece) for message in one.feed(stream[at : at + piece])]
    assert received == sent
    assert not one.is_waiting


def test_a_long_message_in_single_bytes_takes_no_memory_for_each_of_them() -> None:
    stream = framed(load(1, bytes(60_000)), 10**6)
    one = reader(10**6)
    tracemalloc.start()
    try:
        for byte in stream[:-1]:
            one.feed(bytes([byte]))
        assert tracemalloc.get_traced_memory()[1] < 5 * len(stream)
    finally:
        tracemalloc.stop()
    assert one.feed(stream[-1:]) == [load(1, bytes(60_000))]


def test_a_stream_that_comes_byte_by_byte_is_read() -> None:
    sent = [load(1), Describe("cameras/camera"), load(2, bytes(500))]
    one = reader()
    assert [message for byte in written(*sent) for message in one.feed(bytes([byte]))] == sent


def test_each_message_is_given_as_soon_as_its_last_byte_is_there() -> None:
    one = reader()
    stream = written(load(1), load(2))
    half = len(stream) // 2
    assert one.feed(stream[: half - 1]) == []
    assert one.feed(stream[half - 1 : half]) == [load(1)]
    assert one.feed(stream[half:]) == [load(2)]


def test_a_frame_of_just_the_limit_is_read_and_one_byte_more_is_not() -> None:
    fits = framed(load(1), LIMIT)[4:]
    exact = FrameReader(DECODER, len(fits))
    assert exact.feed(frame(fits)) == [load(1)]
    one_less = FrameReader(DECODER, len(fits) - 1)
    assert one_less.feed(frame(fits)) == []
    assert one_less.error is not None
    assert "frame_limit_bytes" in str(one_less.error)
    assert str(len(fits)) in str(one_less.error)


def test_an_announced_length_over_the_limit_is_an_error_before_its_body_comes() -> None:
    one = reader()
    assert one.feed(written(load(1)) + b"\xff\xff\xff\xff") == [load(1)]
    assert isinstance(one.error, Unavailable)
    assert one.feed(written(load(2))) == []


GARBAGE = {
    "no message": b"\xc0",
    "another message's tag": b"\x91\x7f",
    "wrong field type": b"\x92\x09\x01",
    "cut short": framed(load(1), LIMIT)[4:-1],
    "too much": framed(load(1), LIMIT)[4:] + b"\xc0",
    "text that is not UTF-8": b"\x92\x09\xa2\xff\xfe",
    "a reserved byte": b"\xc1",
    "an array of four thousand million": b"\xdd\xff\xff\xff\xff",
    "a list of two hundred million": b"\x93\x0c\xdd\x0f\xff\xff\xff",
    "nested without end": b"\x93\x03\xa1a\x94\xa1a\xa1b\x81\xa1c" + b"\x91" * 3000,
}


@pytest.mark.parametrize("body", GARBAGE.values(), ids=GARBAGE)
def test_a_body_that_is_no_message_is_an_error_and_ends_the_stream(body: bytes) -> None:
    one = reader()
    assert one.feed(written(load(1)) + frame(body) + written(load(2))) == [load(1)]
    assert isinstance(one.error, Unavailable)
    assert f"a frame of {len(body)} bytes that is no message" in str(one.error)
    assert not one.ended
    assert one.feed(written(load(3))) == []


def test_a_goodbye_ends_the_stream_without_an_error() -> None:
    one = reader()
    assert one.feed(written(load(1)) + GOODBYE) == [load(1)]
    assert one.ended
    assert one.error is None
    assert one.feed(written(load(2))) == []


UNSENDABLE = {
    "over the limit": (load(1, bytes(LIMIT)), "frame_limit_bytes"),
    "an object": (load(1, object()), "Load cannot travel"),  # type: ignore[arg-type]
    "an int over 64 bits": (load(2**70), "Load cannot travel"),
    "half a surrogate pair": (Describe("\ud800"), "Describe cannot travel"),
}


@pytest.mark.parametrize(("message", "words"), UNSENDABLE.values(), ids=UNSENDABLE)
def test_what_cannot_travel_is_refused_at_the_sender(message: Any, words: str) -> None:
    with pytest.raises(NotSerializable, match=words):
        framed(message, LIMIT)


def test_a_message_that_contains_itself_is_refused_at_the_sender() -> None:
    ring: list[Any] = []
    ring.append(ring)
    with pytest.raises(NotSerializable):
        framed(ring, LIMIT)


def test_the_error_about_size_says_both_sizes() -> None:
    with pytest.raises(NotSerializable) as caught:
        framed(Loaded("a", "b", bytes(100)), 50)
    assert caught.value.details["limit"] == 50
    assert caught.value.details["size"] > 100


@settings(max_examples=300)
@given(st.lists(st.binary(max_size=200), max_size=10))
def test_any_bytes_give_messages_or_an_error_and_nothing_else(chunks: list[bytes]) -> None:
    one = reader()
    for chunk in chunks:
        for message in one.feed(chunk):
            assert isinstance(message, Message)
    assert one.error is None or isinstance(one.error, Unavailable)


@pytest.mark.slow
def test_a_hundred_thousand_mutilated_streams_give_only_named_errors_and_no_memory_growth() -> None:
    rng = random.Random(20)
    healthy = written(load(1), Describe("cameras/camera"), load(2, bytes(30))) + GOODBYE
    outcomes = {"error": 0, "fine": 0}

    def mutilate() -> bytes:
        stream = bytearray(healthy)
        for _ in range(rng.randint(1, 4)):
            place = rng.randrange(len(stream))
            match rng.randrange(4):
                case 0:
                    stream[place] = rng.randrange(256)
                case 1:
                    del stream[place : place + rng.randint(1, 8)]
                case 2:
                    stream[place:place] = rng.randbytes(rng.randint(1, 8))
                case _:
                    stream[place] ^= 1 << rng.randrange(8)
            if not stream:
                break
        return bytes(stream)

    def feed(count: int) -> None:
        for _ in range(count):
            one = reader()
            stream = mutilate()
            cut = rng.randrange(len(stream) + 1)
            for message in one.feed(stream[:cut]) + one.feed(stream[cut:]):
                assert isinstance(message, Message)
            assert one.error is None or type(one.error) is Unavailable
            outcomes["error" if one.error else "fine"] += 1

    feed(1000)
    gc.collect()
    tracemalloc.start()
    try:
        before = tracemalloc.get_traced_memory()[0]
        feed(10_000)
        grown = tracemalloc.get_traced_memory()[0] - before
    finally:
        tracemalloc.stop()
    assert grown < 100_000
    feed(89_000)
    assert min(outcomes.values()) > 5000


# -- the handshake -------------------------------------------------------------------------------------------------


def shake(acceptor: AcceptorHandshake, dialler: DiallerHandshake) -> None:
    """Carry bytes between the two until the acceptor has the Hello."""
    to_dialler = acceptor.greeting
    for _ in range(5):
        to_acceptor = dialler.receive(to_dialler)
        to_dialler = acceptor.receive(to_acceptor)
        if acceptor.done:
            return


def test_both_prove_themselves_and_the_hello_arrives() -> None:
    acceptor, dialler = AcceptorHandshake(KEY), DiallerHandshake(KEY, HELLO)
    shake(acceptor, dialler)
    assert acceptor.hello == HELLO
    assert dialler.receive(acceptor.welcome(Welcome(3)) + b"rest") == b""
    assert dialler.welcome == Welcome(3)
    assert dialler.refusal is None
    assert dialler.rest == b"rest"


@given(st.lists(st.integers(1, 60), min_size=1, max_size=100))
def test_a_handshake_works_in_whatever_pieces_it_arrives(sizes: list[int]) -> None:
    def pieces(data: bytes) -> list[bytes]:
        cut: list[bytes] = []
        for size in sizes:
            cut.append(data[:size])
            data = data[size:]
        return [*cut, data]

    acceptor, dialler = AcceptorHandshake(KEY), DiallerHandshake(KEY, HELLO)
    to_dialler = acceptor.greeting
    while not acceptor.done:
        to_acceptor = b"".join(dialler.receive(piece) for piece in pieces(to_dialler))
        to_dialler = b"".join(acceptor.receive(piece) for piece in pieces(to_acceptor))
    for piece in pieces(acceptor.welcome(Welcome(1))):
        dialler.receive(piece)
    assert dialler.welcome == Welcome(1)


@pytest.mark.parametrize(
    "error",
    [
        UnknownServer("no server 'a/b'", server="a/b", known=("a/c",)),
        LoadFailed("it failed", server="a/b"),
        RrError("a" * 200_000),
        Unavailable("half a pair: \ud800"),
        ValueError("not one of ours"),
    ],
    ids=lambda error: type(error).__name__,
)
def test_a_refusal_reaches_the_dialler_as_the_error_it_was(error: Exception) -> None:
    acceptor, dialler = AcceptorHandshake(KEY), DiallerHandshake(KEY, HELLO)
    shake(acceptor, dialler)
    dialler.receive(acceptor.refuse(error))
    assert dialler.welcome is None
    assert type(dialler.refusal) is (type(error) if isinstance(error, RrError) else RrError)
    assert str(error)[:10] in str(dialler.refusal)


def test_without_the_key_neither_side_gets_anywhere_and_learns_nothing() -> None:
    acceptor, dialler = AcceptorHandshake(KEY), DiallerHandshake(bytes(32), HELLO)
    proof = dialler.receive(acceptor.greeting)
    with pytest.raises(Unavailable, match="does not have the key"):
        acceptor.receive(proof)
    assert KEY not in acceptor.greeting + proof

    stranger, dialler = AcceptorHandshake(bytes(32)), DiallerHandshake(KEY, HELLO)
    proof = dialler.receive(stranger.greeting)
    assert b"cameras" not in proof  # nothing of the Hello before the acceptor has proved itself
    with pytest.raises(Unavailable, match="does not have the key"):
        dialler.receive(bytes(32))


def test_a_proof_cannot_be_replayed() -> None:
    first, dialler = AcceptorHandshake(KEY), DiallerHandshake(KEY, HELLO)
    proof = dialler.receive(first.greeting)
    first.receive(proof)
    with pytest.raises(Unavailable, match="does not have the key"):
        AcceptorHandshake(KEY).receive(proof)


def test_a_proof_cannot_be_reflected() -> None:
    acceptor = AcceptorHandshake(KEY)
    their_nonce = acceptor.greeting[-32:]
    victim = DiallerHandshake(KEY, HELLO)  # it is made to dial the attacker, who repeats the acceptor's nonce
    proof = victim.receive(acceptor.greeting)
    victims_mac = proof[-32:]
    with pytest.raises(Unavailable, match="does not have the key"):
        victim.receive(victims_mac)
    assert their_nonce in acceptor.greeting


def test_nonces_are_never_the_same() -> None:
    assert len({AcceptorHandshake(KEY).greeting for _ in range(100)}) == 100


def test_nothing_but_blocks_of_fixed_size_is_read_before_the_proof() -> None:
    acceptor = AcceptorHandshake(KEY)
    block = b"rr_actor" + struct.pack(">H", PROTOCOL) + bytes(64)
    assert acceptor.receive(block[:-1]) == b""
    with pytest.raises(Unavailable, match="does not have the key"):
        acceptor.receive(block[-1:] + frame(b"\xc1"))


def wrong_version(block: bytes) -> bytes:
    return block[:8] + struct.pack(">H", PROTOCOL + 1) + block[10:]


def test_another_version_is_named_on_both_sides() -> None:
    acceptor, dialler = AcceptorHandshake(KEY), DiallerHandshake(KEY, HELLO)
    with pytest.raises(Unavailable, match=f"protocol {PROTOCOL + 1}, expected {PROTOCOL}"):
        dialler.receive(wrong_version(acceptor.greeting))
    dialler = DiallerHandshake(KEY, HELLO)
    with pytest.raises(Unavailable, match=f"protocol {PROTOCOL + 1}, expected {PROTOCOL}"):
        acceptor.receive(wrong_version(dialler.receive(acceptor.greeting)))


def test_what_does_not_speak_rr_actors_is_told_so() -> None:
    with pytest.raises(Unavailable, match="does not speak rr_actors"):
        DiallerHandshake(KEY, HELLO).receive(b"HTTP/1.1 400 Bad Request\r\nContent-Type: text/plain\r\n")
    with pytest.raises(Unavailable, match="does not speak rr_actors"):
        AcceptorHandshake(KEY).receive(b"GET / HTTP/1.1\r\n" + bytes(100))


@pytest.mark.parametrize(
    ("block", "words"),
    [
        (b"\x00\x00\x10\x01", "over the limit of 4096"),
        (b"\xff\xff\xff\xff", "over the limit of 4096"),
        (frame(b""), "Hello is not one"),
        (frame(b"\xc1"), "Hello is not one"),
        (frame(b"\x91" * 3000), "Hello is not one"),
        (frame(b"\x95\xa1\xff\xa1a\xa1a\x01\x01"), "Hello is not one"),
    ],
)
def test_a_hello_that_is_none_is_refused(block: bytes, words: str) -> None:
    acceptor, dialler = AcceptorHandshake(KEY), DiallerHandshake(KEY, HELLO)
    acceptor.receive(dialler.receive(acceptor.greeting))
    with pytest.raises(Unavailable, match=words):
        acceptor.receive(block)


def test_a_hello_that_is_too_long_is_refused_at_the_dialler() -> None:
    with pytest.raises(NotSerializable, match="4096"):
        DiallerHandshake(KEY, Hello("registrar", "x" * 5000, "app", 7))


@pytest.mark.parametrize("key", [b"", bytes(31), bytes(33)])
def test_a_key_of_the_wrong_length_is_a_config_error(key: bytes) -> None:
    with pytest.raises(ConfigError, match="32 bytes"):
        check_key(key)


def test_ten_thousand_mutilated_handshakes_give_only_named_errors() -> None:
    rng = random.Random(21)
    finished = 0

    def mutilate(data: bytes) -> bytes:
        if not data or rng.random() < 0.6:
            return data
        changed = bytearray(data)
        changed[rng.randrange(len(changed))] ^= 1 << rng.randrange(8)
        return bytes(changed) if rng.random() < 0.7 else bytes(changed[: rng.randrange(len(changed))])

    for _ in range(10_000):
        acceptor, dialler = AcceptorHandshake(KEY), DiallerHandshake(KEY, HELLO)
        try:
            to_dialler = acceptor.greeting
            for _ in range(4):
                to_acceptor = dialler.receive(mutilate(to_dialler))
                to_dialler = acceptor.receive(mutilate(to_acceptor))
                if acceptor.done:
                    to_dialler = rng.choice([acceptor.welcome(Welcome(1)), acceptor.refuse(ValueError("x" * 20))])
                    dialler.receive(mutilate(to_dialler))
                    finished += dialler.done
                    break
        except Unavailable:
            pass
    assert finished > 100


@settings(max_examples=300)
@given(
    details=st.dictionaries(
        st.sampled_from(["self", "cls", "message", "args", "trace", "details", "__reduce__", "x y", ""]),
        st.integers(-9, 9),
    )
)
def test_a_refusal_with_strange_attributes_is_an_error_of_ours(details: dict[str, Any]) -> None:
    acceptor, dialler = AcceptorHandshake(KEY), DiallerHandshake(KEY, HELLO)
    shake(acceptor, dialler)
    answer = msgspec.msgpack.encode(["refused", ["Unavailable", "text", details, []]])
    try:
        dialler.receive(frame(answer))
    except Unavailable:
        return
    assert isinstance(dialler.refusal, RrError)
    assert type(pickle.loads(pickle.dumps(dialler.refusal))) is type(dialler.refusal)
    assert failure_of(dialler.refusal, "a/b").trace == [("a/b", "Unavailable: text")]
