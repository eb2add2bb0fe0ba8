"""The messages between nodes and the bridge, as JSON in a String: what nodes ask, and what the bridge answers. Pure."""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Annotated, Any, Literal, TypeVar, cast

import msgspec

from rr_actors.base.errors import InvalidRequest, RrError, shortened, shown
from rr_actors.base.values.canonical import json_of
from rr_actors.base.values.failure import failure_of
from rr_actors.managers.ros.ros_config import Priority

Verb = Literal["load", "unload", "renew"]
Key = tuple[str, str]
"""What a hold is known by: its owner, and the id that the owner has chosen. The owner of a switch is ""."""

_Name = Annotated[str, msgspec.Meta(min_length=1, max_length=200)]
_PLACE = re.compile(r" - at `\$\.?([^`]*)`$")
_LONGEST_LEASE_S = 86_400.0

T = TypeVar("T", bound=msgspec.Struct)


class Load(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A node wants a resource, on `load`.

    Attributes:
        id: chosen by the owner, another one for each hold. The same id again is the same hold.
        owner: the node's full name, "/navigation".
        server, request, priority: as for Registrar.load().
        lease_s: seconds after which the hold ends if the owner does not renew it; None: it ends with its owner.
    """

    id: _Name
    owner: _Name
    server: _Name
    request: Any = {}
    lease_s: Annotated[float, msgspec.Meta(gt=0, le=_LONGEST_LEASE_S)] | None = None
    priority: Priority | None = 0


class Unload(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A node needs the resource no more, on `unload`: the id and the owner are those of its Load."""

    id: _Name
    owner: _Name


class Renew(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A node still needs the resource, on `renew`."""

    id: _Name
    owner: _Name


def parsed(topic: str, text: str, kind: type[T]) -> T:
    """Return what a node has written on a topic.

    Raises:
        InvalidRequest: it is no JSON, or has other fields. `.server` is the topic; `.path`, `.expected`, `.got`
    """
    try:
        value: object = msgspec.json.decode(text)
    except (msgspec.DecodeError, UnicodeError, RecursionError) as error:
        raise invalid(topic, "", "a JSON object", text, f"{shown(text)} ({error})") from None
    try:
        asked = msgspec.convert(value, kind)
    except msgspec.ValidationError as error:
        problem = str(error)
        found = _PLACE.search(problem)
        path = found[1] if found is not None else ""
        expected = _PLACE.sub("", problem).partition(", got ")[0].removeprefix("Expected ").replace("`", "")
        got = _table(value).get(path, value)
        if "unknown field" in problem or "missing required field" in problem:
            expected = f"the fields {', '.join(kind.__struct_fields__)}; {expected[0].lower()}{expected[1:]}"
        raise invalid(topic, path, expected, got) from None
    owner: str = getattr(asked, "owner", "")
    return msgspec.structs.replace(asked, owner=f"/{owner.lstrip('/')}")


def invalid(topic: str, path: str, expected: str, got: object, said: str | None = None) -> InvalidRequest:
    """Return the error for what a node has written at `path` of a message; "": the whole."""
    place = f"{topic}: {path}" if path else topic
    text = f"{place}: expected {expected}, got {said or shown(got)}"
    return InvalidRequest(text, server=topic, path=path, expected=expected, got=shown(got))


def key_in(text: str) -> Key:
    """Return the owner and the id in a message that cannot be read, as far as it has them, for its answer."""
    try:
        value: object = msgspec.json.decode(text)
    except (msgspec.DecodeError, UnicodeError, RecursionError):
        return "", ""
    owner, id = (_table(value).get(name) for name in ("owner", "id"))
    return (shortened(owner) if isinstance(owner, str) else "", shortened(id) if isinstance(id, str) else "")


def _table(value: object) -> Mapping[str, object]:
    """Return a JSON object; an empty one for any other value."""
    return cast("Mapping[str, object]", value) if isinstance(value, dict) else {}


def answer_text(verb: Verb, key: Key, error: RrError | None, query: str = "", response: object = None) -> str:
    """Return the answer to a message: {for, id, owner, ok, query, response}, or with `error` in place of the last."""
    head = {"for": verb, "id": key[1], "owner": key[0], "ok": error is None, "query": query}
    return json_of({**head, "error": error_table(error)} if error is not None else {**head, "response": response})


def error_table(error: RrError) -> dict[str, object]:
    """Return an error as a table: {type, message, trace, details}."""
    failure = failure_of(error)
    trace = [{"origin": frame.origin, "message": frame.message} for frame in getattr(error, "trace", ())]
    table: dict[str, object] = {"type": failure.kind, "message": failure.message, "trace": trace}
    details = {name: value for name, value in failure.details.items() if name not in ("traceback", "wanted")}
    return {**table, "details": details}
