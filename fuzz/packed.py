"""MessagePack that stays MessagePack: a sample value of a type, and a value changed in one place."""

from __future__ import annotations

import random
import struct
from collections.abc import Callable
from typing import Any

import msgspec
from msgspec import inspect

_LENGTH = struct.Struct(">I")
_PLAIN: list[Any] = [
    None, True, 0, 1, -1, 255, 2**31, 2**63, 2**64 - 1, -(2**63), 0.0, -0.0, 1.5, float("nan"), float("inf"), "", "x",
    "a/b", "trace", "details", "args", "self", "\0", b"", b"\xff", [], [[]], {}, {"a": 1}, {1: 2}, [1, "a", None],
    {"x": 1, 2: 3}, {"name": "a"}, {(1, 2): 3}, msgspec.msgpack.Ext(5, b"x"),
]  # fmt: skip


def sample(shape: inspect.Type) -> Any:
    """A plain value of this shape."""
    match shape:
        case inspect.StructType(fields=fields, array_like=True, tag=tag):
            return [*([] if tag is None else [tag]), *(sample(field.type) for field in fields)]
        case inspect.StructType(fields=fields) | inspect.DataclassType(fields=fields):
            return {field.encode_name: sample(field.type) for field in fields}
        case inspect.TypedDictType(fields=fields):
            return {field.encode_name: sample(field.type) for field in fields}
        case inspect.NamedTupleType(fields=fields):
            return [sample(field.type) for field in fields]
        case inspect.UnionType(types=types):
            return sample(types[-1])
        case inspect.TupleType(item_types=types):
            return [sample(type_) for type_ in types]
        case inspect.ListType() | inspect.VarTupleType() | inspect.SetType() | inspect.FrozenSetType():
            return [sample(shape.item_type)]
        case inspect.DictType(key_type=key, value_type=value):
            return {sample(key): sample(value)}
        case inspect.EnumType(cls=cls):
            return next(iter(cls)).value
        case inspect.LiteralType(values=values):
            return values[0]
        case _:
            return _LEAVES.get(type(shape))


_LEAVES: dict[type[inspect.Type], Any] = {
    inspect.IntType: 7,
    inspect.FloatType: 0.5,
    inspect.StrType: "a/b",
    inspect.BytesType: b"\x01",
    inspect.BoolType: True,
    inspect.DateTimeType: "2024-02-29T12:00:00+00:00",
    inspect.UUIDType: "12345678-1234-5678-1234-567812345678",
}


def samples(type_: Any) -> list[bytes]:
    """The bytes of a value of this type; of each kind, if it is a union."""
    shape = inspect.type_info(type_)
    shapes = shape.types if isinstance(shape, inspect.UnionType) else (shape,)
    return [msgspec.msgpack.encode(sample(one)) for one in shapes]


def framed(body: bytes) -> bytes:
    """The body behind its length."""
    return _LENGTH.pack(len(body)) + body


def in_frames(head: int) -> Callable[[bytes, random.Random], bytes]:
    """Return a mutation of an input of `head` bytes and frames: the body of one is changed, doubled or dropped."""

    def mutate(data: bytes, chance: random.Random) -> bytes:
        bodies: list[bytes] = []
        at = head
        while at + 4 <= len(data):
            length = _LENGTH.unpack_from(data, at)[0]
            bodies.append(data[at + 4 : at + 4 + length])
            at += 4 + length
        if not bodies:
            return data
        which = chance.randrange(len(bodies))
        match chance.randrange(8):
            case 0:
                bodies.insert(which, chance.choice(bodies))
            case 1:
                del bodies[which]
            case _:
                bodies[which] = changed(bodies[which], chance)
        return data[:head].ljust(head, b"\0") + b"".join(map(framed, bodies))

    return mutate


def after(head: int) -> Callable[[bytes, random.Random], bytes]:
    """Return a mutation of an input that is `head` bytes and one value."""
    return lambda data, chance: data[:head].ljust(head, b"\0") + changed(data[head:], chance)


def changed(body: bytes, chance: random.Random) -> bytes:
    """The value with one part replaced, doubled or dropped; what is no value is left as it is."""
    try:
        return msgspec.msgpack.encode(_changed(msgspec.msgpack.decode(body), chance))
    except Exception:  # no value, or one that cannot be a key
        return body


def _changed(value: Any, chance: random.Random) -> Any:
    if not isinstance(value, (list, tuple, dict)) or not value or chance.random() < 0.15:
        return _other(value, chance)
    if isinstance(value, dict):
        items = list(value.items())
        at = chance.randrange(len(items))
        key, part = items[at]
        match chance.randrange(6):
            case 0:
                del items[at]
            case 1:
                items[at] = (_other(key, chance), part)
            case 2:
                items.append((_other(key, chance), chance.choice(_PLAIN)))
            case _:
                items[at] = (key, _changed(part, chance))
        return dict(items)
    parts = list(value)
    at = chance.randrange(len(parts))
    match chance.randrange(8):
        case 0:
            del parts[at]
        case 1:
            parts.insert(at, chance.choice(_PLAIN))
        case 2:
            parts += [parts[at]] * chance.choice((1, 20))
        case _:
            parts[at] = _changed(parts[at], chance)
    return parts


def _other(value: Any, chance: random.Random) -> Any:
    if isinstance(value, int) and chance.random() < 0.5:
        return value + chance.choice((-1, 1, 256))
    if isinstance(value, (str, bytes)) and value and chance.random() < 0.5:
        text: Any = value
        at = chance.randrange(len(text))
        return text[:at] + text[at + 1 :] if chance.random() < 0.5 else text + text[at:]
    return chance.choice(_PLAIN)
