"""The handshake: how both sides of a connection prove that they are of one system, without any I/O.

Both prove that they know the system's key, in blocks of fixed size: no data of a stranger is ever parsed. Frames come
only then::

    acceptor                              dialler
      magic, version, nonce          ─→
                                     ←─  magic, version, nonce, HMAC(key, "dialler", both nonces)
      HMAC(key, "acceptor", both)    ─→                                       (now the dialler trusts its peer)
                                     ←─  frame: Hello, at most 4 KiB          (the acceptor has since the proof)
      frame: Welcome or a refusal    ─→

The key is never sent, and a proof can be neither replayed (nonces) nor reflected (the role is in it).
"""

from __future__ import annotations

import hmac
import os
import struct
from collections.abc import Callable
from typing import TypeVar

import msgspec

from rr_actors.base.errors import ConfigError, NotSerializable, RrError, Unavailable
from rr_actors.base.values.failure import Failure, error_of, failure_of
from rr_actors.wire.frames import framed
from rr_actors.wire.transport import Hello, Welcome

T = TypeVar("T")

PROTOCOL = 4
"""Version of all messages that links carry; peers of another version are refused."""

HELLO_LIMIT_BYTES = 4096
REPLY_LIMIT_BYTES = 64 * 1024
KEY_BYTES = 32

_MAGIC = b"rr_actor"
_NONCE_BYTES = 32
_GREETING = struct.Struct(f">8sH{_NONCE_BYTES}s")  # magic, version, nonce
_PROOF = struct.Struct(f">8sH{_NONCE_BYTES}s32s")  # magic, version, nonce, MAC
_LENGTH = struct.Struct(">I")


class Welcomed(msgspec.Struct, frozen=True, array_like=True, tag="welcome"):
    """The acceptor's answer that opens the link."""

    welcome: Welcome


class Refused(msgspec.Struct, frozen=True, array_like=True, tag="refused"):
    """The acceptor's answer that refuses the link."""

    failure: Failure


_decode_hello = msgspec.msgpack.Decoder(Hello).decode
_decode_reply = msgspec.msgpack.Decoder(Welcomed | Refused).decode


def check_key(key: bytes) -> bytes:
    """Return a system's key; raise ConfigError if it is shorter or longer than KEY_BYTES."""
    if len(key) != KEY_BYTES:
        raise ConfigError(f"a system's key has {KEY_BYTES} bytes, got {len(key)}", expected=KEY_BYTES, got=len(key))
    return key


class _Step(msgspec.Struct, frozen=True):
    """The next block of `size` bytes, or the next frame of at most `limit`, and the function that takes it."""

    what: str
    take: Callable[[bytes], bytes]
    size: int = 0
    limit: int = 0


class _Handshake:
    """Collects the block of each step and hands it to the step; the two roles are below.

    Attributes:
        rest: the bytes that no step has taken yet; once `done`, they belong to the link.
    """

    _step: _Step

    def __init__(self, key: bytes) -> None:
        self._key = key
        self._nonce = os.urandom(_NONCE_BYTES)
        self.done = False
        self.rest = b""

    def receive(self, data: bytes) -> bytes:
        """Take the bytes that arrived, and return the bytes to send.

        Raises:
            Unavailable: the peer is not of this system, or breaks the protocol. Close the connection.
        """
        self.rest += data
        reply = b""
        while not self.done and (size := self._block_size()) is not None:
            block, self.rest = self.rest[:size], self.rest[size:]
            reply += self._step.take(block)
        return reply

    @property
    def waits_for(self) -> str:
        """The name of the next block, for the error about a peer that does not send it."""
        return self._step.what

    def _block_size(self) -> int | None:
        """Return the length of the next block if all of it has arrived, else None."""
        size = self._step.size
        if not size:
            if len(self.rest) < _LENGTH.size:
                return None
            length: int = _LENGTH.unpack_from(self.rest)[0]
            if length > self._step.limit:
                raise Unavailable(f"{self.waits_for} has {length} bytes, over the limit of {self._step.limit}")
            size = _LENGTH.size + length
        return size if len(self.rest) >= size else None

    def _mac(self, role: bytes, acceptor_nonce: bytes, dialler_nonce: bytes) -> bytes:
        text = _MAGIC + _LENGTH.pack(PROTOCOL) + role + acceptor_nonce + dialler_nonce
        return hmac.digest(self._key, text, "sha256")


class AcceptorHandshake(_Handshake):
    """The side that accepts. Send `greeting` first; once `done`, answer `hello` with `welcome` or `refuse`."""

    hello: Hello

    def __init__(self, key: bytes) -> None:
        super().__init__(key)
        self.greeting = _GREETING.pack(_MAGIC, PROTOCOL, self._nonce)
        self._step = _Step("its proof", self._check_proof, size=_PROOF.size)

    def _check_proof(self, block: bytes) -> bytes:
        magic, version, nonce, mac = _PROOF.unpack(block)
        _check_version(magic, version)
        if not hmac.compare_digest(mac, self._mac(b"dialler ", self._nonce, nonce)):
            raise Unavailable("it does not have the key of this system")
        self._step = _Step("its Hello", self._take_hello, limit=HELLO_LIMIT_BYTES)
        return self._mac(b"acceptor", self._nonce, nonce)

    def _take_hello(self, block: bytes) -> bytes:
        self.hello = _decode(_decode_hello, block, "Hello")
        self.done = True
        return b""

    @staticmethod
    def welcome(welcome: Welcome) -> bytes:
        """Return the answer that opens the link."""
        return framed(Welcomed(welcome), REPLY_LIMIT_BYTES)

    @staticmethod
    def refuse(error: Exception) -> bytes:
        """Return the answer that makes connect() of the dialler raise `error`."""
        failure = failure_of(error)
        try:
            return framed(Refused(failure), REPLY_LIMIT_BYTES)
        except NotSerializable:  # too long, or not Unicode: the first 1000 bytes of the text still fit
            text = failure.message.encode("utf-8", "replace")[:1000].decode("utf-8", "ignore")
            return framed(Refused(Failure(failure.kind, text)), REPLY_LIMIT_BYTES)


class DiallerHandshake(_Handshake):
    """The side that connects. Once `done`, either `welcome` or `refusal` is set."""

    def __init__(self, key: bytes, hello: Hello) -> None:
        """Make the handshake of a link; raise NotSerializable if the Hello is too long."""
        super().__init__(key)
        self._hello = framed(hello, HELLO_LIMIT_BYTES, "names and paths are to be shorter")
        self._expected = b""
        self.greeted = False
        self.welcome: Welcome | None = None
        self.refusal: RrError | None = None
        self._step = _Step("its greeting", self._take_greeting, size=_GREETING.size)

    def _take_greeting(self, block: bytes) -> bytes:
        magic, version, nonce = _GREETING.unpack(block)
        _check_version(magic, version)
        self.greeted = True
        self._expected = self._mac(b"acceptor", nonce, self._nonce)
        self._step = _Step("its proof", self._check_proof, size=len(self._expected))
        return _PROOF.pack(_MAGIC, PROTOCOL, self._nonce, self._mac(b"dialler ", nonce, self._nonce))

    def _check_proof(self, block: bytes) -> bytes:
        if not hmac.compare_digest(block, self._expected):
            raise Unavailable("it does not have the key of this system")
        self._step = _Step("its answer to Hello", self._take_reply, limit=REPLY_LIMIT_BYTES)
        return self._hello

    def _take_reply(self, block: bytes) -> bytes:
        answer = _decode(_read_answer, block, "answer to Hello")
        if isinstance(answer, Welcome):
            self.welcome = answer
        else:
            self.refusal = answer
        self.done = True
        return b""


def _read_answer(raw: bytes) -> Welcome | RrError:
    reply = _decode_reply(raw)
    return reply.welcome if isinstance(reply, Welcomed) else error_of(reply.failure)


def _check_version(magic: bytes, version: int) -> None:
    if magic != _MAGIC:
        raise Unavailable(f"it does not speak rr_actors: it began with {magic!r}")
    if version != PROTOCOL:
        raise Unavailable(f"it speaks protocol {version}, expected {PROTOCOL}: run the same rr_actors on both sides")


def _decode(decode: Callable[[bytes], T], block: bytes, what: str) -> T:
    try:
        return decode(block[_LENGTH.size :])
    except Exception as error:  # msgspec's own, UnicodeDecodeError, RecursionError
        raise Unavailable(f"its {what} is not one: {error}") from error
