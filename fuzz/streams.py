"""Streams: frames of messages, the handshake before them, and the channel between a supervisor and its child."""

from __future__ import annotations

import pickle
from typing import Any, cast

import msgspec

from fuzz.packed import framed, in_frames, samples
from fuzz.target import Target, pieces
from rr_actors.actors.remote import protocol
from rr_actors.base.errors import NotSerializable, RrError, Unavailable
from rr_actors.base.values.failure import Failure, error_of, failure_of
from rr_actors.registrar.links import remote_calls
from rr_actors.registrar.model.messages import Message
from rr_actors.supervision import control_channel
from rr_actors.wire import frames, handshake
from rr_actors.wire.frames import GOODBYE, FrameReader
from rr_actors.wire.handshake import AcceptorHandshake, DiallerHandshake
from rr_actors.wire.transport import Hello, Welcome

_LIMIT_BYTES = 100_000
_WIRES: list[Any] = [Message, remote_calls.HandleMessage, protocol.Letter]
_DECODERS = [msgspec.msgpack.Decoder(wire) for wire in _WIRES]


# -- frames --------------------------------------------------------------------------------------------------------


def _frame_seeds() -> list[bytes]:
    bodies = [(bytes([wire]), samples(type_)) for wire, type_ in enumerate(_WIRES)]
    single = [wire + b"\0" + framed(body) for wire, some in bodies for body in some]
    return [*single, *(wire + b"\5" + b"".join(map(framed, some)) + GOODBYE for wire, some in bodies)]


def _feed_frames(data: bytes) -> None:
    """Byte 0: which messages; byte 1: how the rest arrives. However it does, the same comes out."""
    if len(data) < 2:
        return
    decoder: Any = _DECODERS[data[0] % len(_DECODERS)]
    whole = FrameReader[Any](decoder, _LIMIT_BYTES)
    messages = whole.feed(data[2:])
    cut = FrameReader[Any](decoder, _LIMIT_BYTES)
    again = [message for piece in pieces(data[2:], data[1]) for message in cut.feed(piece)]
    assert [_bytes_of(message) for message in messages] == [_bytes_of(message) for message in again]
    assert (str(whole.error), whole.ended) == (str(cut.error), cut.ended)
    assert whole.error is None or type(whole.error) is Unavailable
    if whole.error is not None or whole.ended:
        assert whole.feed(data[2:]) == []
    for message in messages:
        raw = _bytes_of(message)
        if raw is not None:
            assert _bytes_of(decoder.decode(raw)) == raw
        failure = getattr(message, "failure", None)
        if failure is not None:
            _check_error(error_of(failure))


def _bytes_of(message: Any) -> bytes | None:
    assert isinstance(message, msgspec.Struct)
    try:
        return frames.framed(message, 2 * _LIMIT_BYTES)[4:]
    except NotSerializable:  # an error's details are any plain value
        return None


def _check_error(error: RrError) -> None:
    """It can be shown, pickled, and sent on."""
    assert isinstance(error, RrError)
    assert str(error) == error.message
    again = pickle.loads(pickle.dumps(error))
    assert type(again) is type(error)
    assert again.message == error.message
    sent_on = failure_of(error, "a/b")
    assert type(error_of(sent_on)) is type(error)
    assert len(AcceptorHandshake.refuse(error)) <= handshake.REPLY_LIMIT_BYTES + 4


FRAMES = Target(
    "frames of messages between registrars, handles and actors, in arbitrary pieces",
    lambda directory: _feed_frames,
    _frame_seeds,
    in_frames(2),
)


# -- handshakes ----------------------------------------------------------------------------------------------------

_KEY = bytes(range(32))
_HELLO = Hello("registrar", "cameras", "app", 7)


def _handshake_seeds() -> list[bytes]:
    acceptor, stranger = AcceptorHandshake(_KEY), DiallerHandshake(bytes(32), _HELLO)
    failure = Failure("LoadFailed", "x", {"name": "a", "known": ["b"]}, [("a/b", "c")])
    kinds = ("LoadFailed", "UnknownServer", "CircularDependency", "MailboxFull", "Frame", "annotations", "no such")
    refusals = [handshake.Refused(msgspec.structs.replace(failure, kind=kind)) for kind in kinds]
    replies = [handshake.Welcomed(Welcome(7)), *refusals, handshake.Refused(Failure("Unavailable", ""))]
    return [
        b"\0\0" + stranger.receive(acceptor.greeting),
        b"\1\0" + acceptor.greeting + bytes(32),
        b"\2\0" + framed(msgspec.msgpack.encode(_HELLO)),
        b"\2\1" + framed(msgspec.msgpack.encode(_HELLO)) + b"what follows",
        *(b"\3\0" + framed(msgspec.msgpack.encode(reply)) for reply in replies),
    ]


def _feed_handshake(data: bytes) -> None:
    """Byte 0: to whom, and whether the other side has proved itself before; byte 1: how the rest arrives."""
    if len(data) < 2:
        return
    acceptor, dialler = AcceptorHandshake(_KEY), DiallerHandshake(_KEY, _HELLO)
    side, known = (dialler if data[0] & 1 else acceptor), bool(data[0] & 2)
    if known:
        proof = acceptor.receive(dialler.receive(acceptor.greeting))
        if side is dialler:
            dialler.receive(proof)
    refused = False
    for piece in pieces(data[2:], data[1]):
        try:
            side.receive(piece)
        except Unavailable as error:
            assert type(error) is Unavailable
            refused = True
            break
        assert side.done or len(side.rest) <= 4 + (handshake.REPLY_LIMIT_BYTES if known else 0) + 128
    if side.done:
        assert known
        assert not refused
        assert data.endswith(side.rest)
        if side is acceptor:
            assert type(acceptor.hello) is Hello
        elif dialler.refusal is not None:
            assert dialler.welcome is None
            _check_error(dialler.refusal)
        else:
            assert type(dialler.welcome) is Welcome


HANDSHAKE = Target(
    "what a stranger says in a handshake, and what a peer says after its proof",
    lambda directory: _feed_handshake,
    _handshake_seeds,
    in_frames(2),
    words=(b"rr_actor\0\1", b"LoadFailed", b"details", b"trace", b"message"),
)


# -- control -------------------------------------------------------------------------------------------------------


class _Line:
    """A transport that is asked one thing: whether it was closed."""

    aborted = False

    def abort(self) -> None:
        self.aborted = True


def _feed_control(data: bytes) -> None:
    received: list[Any] = []
    line = _Line()
    channel = control_channel.Channel("root/a", received.append, lambda: None)
    channel.connection_made(cast("Any", line))
    for piece in pieces(data[1:], data[0] if data else 0):
        channel.data_received(piece)
        if line.aborted:
            break
    assert all(isinstance(message, control_channel.Message) for message in received)


CONTROL = Target(
    "the channel between a supervisor and its child's process",
    lambda directory: _feed_control,
    lambda: [b"\0" + framed(body) for body in samples(control_channel.Message)],
    in_frames(1),
)
