"""Typed values: the rows, messages, commands and effects of a registrar as text, and the same values made of that text.

A recording has them in this form. Only the classes that are named here are made of a text, so a recording from somebody
else runs no code. A value of another class, such as a caller that waits, becomes an Opaque.
"""

from __future__ import annotations

import base64
import binascii
import zlib
from enum import Enum
from types import ModuleType
from typing import Any, cast, get_args

import msgspec

from rr_actors.base.errors import shortened, shown
from rr_actors.base.values.failure import Failure
from rr_actors.registrar.decisions.decided import Began, Decided
from rr_actors.registrar.model import commands, effects
from rr_actors.registrar.model.catalog import Closing, DeliveredNotice, DueStatus, Server
from rr_actors.registrar.model.messages import FetchedQuery, Message
from rr_actors.registrar.model.rows import TABLES, Drop, Hold, Phase, Put, State


class Opaque(msgspec.Struct, frozen=True):
    """Stands for a value that no other process can have. Two of the same number stand for the same value.

    Attributes:
        kind: the name of the value's class.
    """

    kind: str
    number: int


class UnknownValue(ValueError):
    """The text is damaged, or has a class or a field that this version of the package does not have."""


def _structs_in(module: ModuleType) -> list[type[msgspec.Struct]]:
    found = [one for one in vars(module).values() if isinstance(one, type) and issubclass(one, msgspec.Struct)]
    return [one for one in found if one.__module__ == module.__name__]


CLASSES: dict[str, type[msgspec.Struct]] = {
    cls.__name__: cls
    for cls in (
        *_structs_in(commands),
        *_structs_in(effects),
        *get_args(Message),
        *TABLES.values(),
        *(FetchedQuery, Put, Drop, Server, Closing, DueStatus, DeliveredNotice, Failure, Opaque, Began, Decided),
    )
}
"""The classes that a text may have, by name."""
_ENUMS: dict[str, type[Enum]] = {cls.__name__: cls for cls in (State, Phase, Hold)}
_LONGEST = 2**30  # bytes of a value, against texts that are made to fill the memory
_SCALARS = frozenset((type(None), bool, int, float, str, bytes))
_LIST, _TUPLE, _DICT, _SET = "list", "tuple", "dict", "set"
_MISSING = object()


def _defaults_of(cls: type[msgspec.Struct]) -> list[tuple[str, Any]]:
    """Return the names of the fields, each with its default, or _MISSING."""
    found: list[tuple[str, Any]] = []
    for field in msgspec.structs.fields(cls):
        default: Any = _MISSING
        if field.default_factory is not msgspec.NODEFAULT:
            default = field.default_factory()
        elif field.default is not msgspec.NODEFAULT:
            default = field.default
        found.append((field.name, default))
    return found


_FIELDS = {cls: (name, _defaults_of(cls)) for name, cls in CLASSES.items()}


def plain(value: Any) -> Any:
    """Return a value as lists, texts and numbers. A list begins with the name of its class.

    Fields that have their default are left out, so a later version that adds a field can read the text.
    """
    if (kind := cast("type[Any]", type(value))) in _SCALARS:
        return value
    if (known := _FIELDS.get(kind)) is not None:
        name, fields = known
        parts: list[Any] = [name]
        for field, default in fields:
            one = getattr(value, field)
            if type(one) is not type(default) or one != default:
                parts += (field, plain(one))
        return parts
    if kind is _ENUMS.get(kind.__name__):
        return [kind.__name__, value.value]
    if kind is list or kind is tuple:
        return [_LIST if kind is list else _TUPLE, *map(plain, value)]
    if kind is set:
        return [_SET, *sorted(map(plain, value), key=repr)]
    if isinstance(value, dict):
        pairs: list[Any] = [_DICT]
        for key, one in value.items():  # pyright: ignore[reportUnknownVariableType]  # of any kind
            pairs += (plain(key), plain(one))
        return pairs
    return plain(Opaque(kind.__name__, id(value)))


def value_of(found: Any) -> Any:
    """Return the value that plain() was given.

    Raises:
        UnknownValue: there is no such value here.
    """
    if type(found) is not list:
        return found
    kind, *rest = cast("list[Any]", found) or [""]
    parts = [value_of(part) for part in rest]
    try:
        if kind == _LIST:
            return parts
        if kind == _TUPLE:
            return tuple(parts)
        if kind == _SET:
            return set(parts)
        if kind == _DICT:
            return dict(zip(parts[::2], parts[1::2], strict=True))
        if kind in _ENUMS:
            (text,) = parts
            return _ENUMS[kind](text)
        return CLASSES[kind](**dict(zip(parts[::2], parts[1::2], strict=True)))
    except KeyError:
        raise UnknownValue(f"no class {shown(kind)} is known here") from None
    except (TypeError, ValueError) as error:
        raise UnknownValue(f"{shortened(str(kind))}: {error}") from error


def text_from(value: Any) -> str:
    """Return a value as a text without spaces, compressed, with a checksum in it."""
    return base64.b64encode(zlib.compress(msgspec.msgpack.encode(plain(value)), 1)).decode()


def value_from(text: str) -> Any:
    """Return the value that text_from() was given.

    Raises:
        UnknownValue: the text is damaged, or of a version with other values.
    """
    try:
        reader = zlib.decompressobj()
        data = reader.decompress(base64.b64decode(text, validate=True), _LONGEST)
        if not reader.eof:
            raise UnknownValue("damaged: it is cut, or too long")
        return value_of(msgspec.msgpack.decode(data))
    except (binascii.Error, zlib.error, msgspec.MsgspecError, RecursionError) as error:
        raise UnknownValue(f"damaged: {error}") from error
