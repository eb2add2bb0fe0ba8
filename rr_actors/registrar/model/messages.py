"""The messages between registrars. Requests are imperative, facts are in the past tense.

Every message is a frozen msgspec Struct, encoded as a MessagePack array behind its tag. Decoding checks the types, so a
peer's bytes can make no other objects. Request and response bytes inside are canonical MessagePack
(base/values/canonical.py).

Consumer to provider: Load, Unload, Fetch, Describe, NoticesHandled, Probe, Gone. Provider to consumer: Loaded,
LoadRefused, Unloaded, UnloadRefused, Fetched, Described, Noticed, Progressed. The sender of a request sends it again,
with the same id, until it is answered. So every message may arrive twice (docs/consistency.md says what the second one
does). A Fetch with `resume` opens a link, and comes once on each.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import Any, cast

import msgspec

from rr_actors.base import errors
from rr_actors.registrar.model.rows import Int64, Notice

PROTOCOL = 2
"""Version of the messages; peers of another version are refused at the handshake."""


class Failure(msgspec.Struct, frozen=True, array_like=True):
    """An error as it is sent: the name of its class in errors.py, its text and attributes, and the frames it passed."""

    kind: str
    message: str
    details: dict[str, Any] = {}
    trace: list[tuple[str, str]] = []


class Load(msgspec.Struct, frozen=True, array_like=True, gc=False, tag=1):
    """Give `origin` a query with this id on the resource for this request; load that if it is not loaded."""

    query_id: str
    server: str
    request: bytes
    origin: str
    parent: str
    attempt: Int64
    seq: Int64


class Loaded(msgspec.Struct, frozen=True, array_like=True, gc=False, tag=2):
    """The query is held, and is on disk in the provider's catalog.

    `types`: the checksum (CRC-32) of the types in Described with which the response is to be read.
    """

    query_id: str
    resource_id: str
    response: bytes
    types: int = 0


class LoadRefused(msgspec.Struct, frozen=True, array_like=True, tag=3):
    """The query does not exist, and has left nothing."""

    query_id: str
    failure: Failure


class Unload(msgspec.Struct, frozen=True, array_like=True, gc=False, tag=4):
    """Release the query. A query that does not exist counts as released."""

    query_id: str
    origin: str


class Unloaded(msgspec.Struct, frozen=True, array_like=True, gc=False, tag=5):
    """The query is gone. If it was the last, the unload callback has run and the resource's parts are released."""

    query_id: str


class UnloadRefused(msgspec.Struct, frozen=True, array_like=True, tag=6):
    """The unload callback raised: the query is still held, and its resource is unload_failed."""

    query_id: str
    failure: Failure


class Fetch(msgspec.Struct, frozen=True, array_like=True, tag=7):
    """List all queries that `origin` holds here; with `resume`, then send the notices it has not dealt with.

    `number` comes back in the answer, because the answer to a dead incarnation may reach the next one. `spans`: the
    digests of the queries that `origin` knows (registrar/core/digests.py). Then the answer lists only the queries that
    differ.
    """

    origin: str
    resume: bool = False
    number: int = 0
    spans: list[tuple[int, bytes]] = []


class FetchedQuery(msgspec.Struct, frozen=True, array_like=True):
    """One query in Fetched. `response` is None while its resource is loading, or being unloaded."""

    query_id: str
    server: str
    resource_id: str
    request: bytes
    response: bytes | None
    parent: str
    attempt: Int64
    seq: Int64
    state: str


class Fetched(msgspec.Struct, frozen=True, array_like=True, tag=8):
    """The queries that the receiver holds at the sender at that moment; with `more`, other parts of the list follow.

    `same`: the ranges of running numbers in which nothing differs from Fetch, and which are not listed.
    """

    queries: list[FetchedQuery]
    more: bool = False
    number: int = 0
    same: list[tuple[int, int]] = []


class Describe(msgspec.Struct, frozen=True, array_like=True, tag=9):
    """Send the types of this server's requests and responses."""

    server: str


class Described(msgspec.Struct, frozen=True, array_like=True, tag=10):
    """The server's types by cloudpickle. A receiver unpickles them only if its peer has the same key."""

    server: str
    blob: bytes


class Noticed(msgspec.Struct, frozen=True, array_like=True, tag=11):
    """A status for a query. `repeated`: it may have been heard before the provider crashed."""

    notice: Notice
    repeated: bool = False


class NoticesHandled(msgspec.Struct, frozen=True, array_like=True, tag=12):
    """The notices with these ids have been dealt with; where that matters, it is on disk."""

    ids: list[str]


class Probe(msgspec.Struct, frozen=True, array_like=True, tag=13):
    """Edge chasing (Chandy, Misra, Haas 1983): does the resource of `query_id` wait, directly or not, for `waiter`?

    `waiter` is a resource that is being loaded, and `blocked` the query on which it waits. `ring` holds the
    "registrar/server" names passed so far. A probe that comes to the waiter has found a ring.
    """

    query_id: str
    waiter: str
    blocked: str
    ring: list[str]


class Gone(msgspec.Struct, frozen=True, array_like=True, tag=14):
    """The registrar `origin` does not come back: release every query that it holds here."""

    origin: str


class Progressed(msgspec.Struct, frozen=True, array_like=True, gc=False, tag=15):
    """The progress of a load for which these queries of the receiver wait. May be lost."""

    query_ids: list[str]
    resource_id: str
    server: str
    fraction: float
    text: str


def retired(name: str) -> str:
    """Return the origin of a link on which the registrar `name` is said to be gone; no registrar's name has a colon."""
    return f"{name}:retired"


Message = (
    Load
    | Loaded
    | LoadRefused
    | Unload
    | Unloaded
    | UnloadRefused
    | Fetch
    | Fetched
    | Describe
    | Described
    | Noticed
    | NoticesHandled
    | Probe
    | Gone
    | Progressed
)


_LONGEST_TEXT = 10_000
_LONGEST_TRACE = 30_000
_NO_DETAILS = ("self", "details", "trace")  # an error with such details could not be pickled or sent on


def failure_of(error: BaseException, origin: str | None = None) -> Failure:
    """Describe `error` for the wire. With `origin` ("registrar/server") a frame is added to its trace.

    The frames of its cause or context come first, as these errors have come the same way. An error of a user's class
    may be unusual: its `trace` or `details` may be of another kind, say. Then only its text is used. Of a very long
    trace only the first frames are kept, as the message could be too long for a frame of the wire.
    """
    text = readable(errors.text_of(error))
    frames = [] if origin is None else [(origin, text)]
    try:
        trace = [] if origin is None else _trace_of(error)
        if not isinstance(error, errors.RrError):
            return Failure("RrError", text, {}, _first_of(trace + frames))
        trace = trace or _own_trace(error)
        details = {k: _readable(v) for k, v in error.details.items() if k != "trace" and _is_plain(v)}
        return Failure(type(error).__name__, readable(error.message), details, _first_of(trace + frames))
    except Exception:
        return Failure("RrError", text, {}, frames)


def _first_of(frames: list[tuple[str, str]]) -> list[tuple[str, str]]:
    lengths = itertools.accumulate(len(origin) + len(text) for origin, text in frames)
    return [frame for frame, length in zip(frames, lengths, strict=True) if length <= _LONGEST_TRACE]


def _own_trace(error: BaseException) -> list[tuple[str, str]]:
    return [(f.origin, f.message) for f in getattr(error, "trace", ())] if isinstance(error, errors.RrError) else []


def _trace_of(error: BaseException) -> list[tuple[str, str]]:
    """Return the frames of an error, or of the nearest one behind it, in the order in which Python shows them."""
    left: list[BaseException | None] = [error]
    seen: set[int] = set()
    while left:
        error_now = left.pop()
        if error_now is None or id(error_now) in seen:
            continue
        seen.add(id(error_now))
        if trace := _own_trace(error_now):
            return trace
        left.append(None if error_now.__suppress_context__ else error_now.__context__)
        left.append(error_now.__cause__)
        if isinstance(error_now, BaseExceptionGroup):  # from an asyncio.TaskGroup, say
            left.extend(reversed(cast("BaseExceptionGroup[BaseException]", error_now).exceptions))
    return []


def readable(text: str) -> str:
    """Return a text for people in a form that can be sent and stored; half a character becomes its code.

    File names may have such half characters. A very long text is cut: otherwise a frame could be too long, and would
    never be sent.
    """
    text = errors.exact_text(text)
    if len(text) > _LONGEST_TEXT:
        text = f"{text[: _LONGEST_TEXT - 50]} ... ({len(text) - _LONGEST_TEXT + 50} characters more)"
    return text if text.isascii() else text.encode("utf-8", "backslashreplace").decode()


def error_of(failure: Failure) -> errors.RrError:
    """Return the error that a Failure describes; one of a class that this version does not know becomes RrError."""
    cls = getattr(errors, failure.kind, errors.RrError)
    if not (isinstance(cls, type) and issubclass(cls, errors.RrError)):
        cls = errors.RrError
    details: dict[str, Any] = {}
    for key, value in failure.details.items():
        if key.isidentifier() and key not in _NO_DETAILS and not hasattr(errors.RrError, key):  # a peer's
            details[key] = tuple(cast("Sequence[object]", value)) if isinstance(value, list) else value
    if failure.trace or issubclass(cls, (errors.LoadFailed, errors.UnloadFailed)):
        details["trace"] = tuple(errors.Frame(origin, message) for origin, message in failure.trace)
    error = cls(failure.message, **details)
    if lines := details.get("traceback"):
        error.add_note(f"raised in {failure.trace[0][0] if failure.trace else 'a callback'}:\n{lines}")
    return error


def _readable(value: object) -> object:
    if isinstance(value, (list, tuple)):
        return [_readable(item) for item in cast("Sequence[object]", value)]
    return readable(value) if isinstance(value, str) else value


def _is_plain(value: object) -> bool:
    if isinstance(value, (list, tuple)):
        return all(_is_plain(item) for item in cast("Sequence[object]", value))
    return value is None or isinstance(value, (str, int, float, bool))
