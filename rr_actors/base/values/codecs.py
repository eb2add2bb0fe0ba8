"""Codecs: the bytes of values for which MessagePack has no form of its own, and rr.codec for a user's own types.

Such a value travels as a MessagePack extension: a code of the tables below, and its plain form. The reader looks up the
code in these tables, and a name among the types that its own process gave to rr.codec(): bytes never name a class to
import. docs/values.md lists the types for people; a test compares it with KINDS.
"""

from __future__ import annotations

import datetime
import decimal
import pathlib
import re
import sys
import uuid
from collections.abc import Callable
from typing import Any, TypeVar, cast

import msgspec

from rr_actors.base.checks import invalid
from rr_actors.base.errors import shown

T = TypeVar("T")

NAMED = 16  # a value of a class that only a declared type can bring back: its class's name, then its plain form
CODEC = 17  # a value of a type that was given to rr.codec(): that name, then what its `encode` returned
ARRAY = 14  # of numpy
SCALAR = 15  # of numpy


class NoForm(TypeError):
    """A value cannot be sent, though others of its type can; the text describes the value, and says what to do."""


class Kind(msgspec.Struct, frozen=True):
    """One builtin type that keeps its type without annotations."""

    code: int  # of the extension
    type: type  # exactly this class, no subclass
    plain: Callable[[Any], Any]  # returns a value's plain form, which MessagePack can carry
    make: Callable[[Any], Any]  # returns the value of a plain form, or raises any error


def _made_of(cls: Callable[..., Any], parts: Any) -> Callable[[Any], Any]:
    return lambda plain: cls(*msgspec.convert(plain, parts))


def _by_msgspec(code: int, type_: Any) -> Kind:
    """Return the Kind of a type whose plain form msgspec writes and reads itself."""
    return Kind(code, type_, lambda value: value, lambda plain: msgspec.convert(plain, type_))


_FLAT = (
    _by_msgspec(4, datetime.datetime),  # without a time zone; one with it has no need
    _by_msgspec(5, datetime.date),
    _by_msgspec(6, datetime.time),
    _by_msgspec(7, datetime.timedelta),
    _by_msgspec(8, uuid.UUID),
    _by_msgspec(9, decimal.Decimal),
    Kind(10, complex, lambda value: [value.real, value.imag], _made_of(complex, tuple[float, float])),
    Kind(11, range, lambda value: [value.start, value.stop, value.step], _made_of(range, tuple[int, int, int])),
    Kind(12, type(pathlib.Path()), str, lambda plain: pathlib.Path(msgspec.convert(plain, str))),
    Kind(13, bytearray, bytes, bytearray),
)
_NESTED = (Kind(1, tuple, list, tuple), Kind(2, set, list, set), Kind(3, frozenset, list, frozenset))
KINDS = (*_NESTED, *_FLAT)

FLAT = {kind.type: kind for kind in _FLAT}
NESTED = {kind.type: kind for kind in _NESTED}
BY_CODE = {kind.code: kind for kind in KINDS}


# -- types of one's own --------------------------------------------------------------------------------------------


class TypeCodec(msgspec.Struct, frozen=True):
    """The functions that rr.codec() was given for a type."""

    type: type
    encode: Callable[[Any], Any]
    decode: Callable[[Any], Any]

    @property
    def name(self) -> str:
        """The type's name in bytes: the same in every process that has the type."""
        return f"{self.type.__module__}.{self.type.__qualname__}"


_by_type: dict[type, TypeCodec] = {}
_by_name: dict[str, TypeCodec] = {}

codec_of: Callable[[type], TypeCodec | None] = _by_type.get
"""Return the codec of a type; None if this process has none."""

codec_named: Callable[[str], TypeCodec | None] = _by_name.get
"""Return the codec for a name in bytes; None if this process has none."""


types_of_main: dict[type, None] = {}
"""The classes of `__main__` that have a codec."""


def _put(cls: type, made: TypeCodec) -> None:
    _by_type[cls] = made
    if cls.__module__ == "__main__":
        types_of_main[cls] = None


def codec(type: type[T], encode: Callable[[T], Any], decode: Callable[[Any], T]) -> None:
    """Let values of a type travel in requests and responses, with and without annotations.

    The codec holds for this process. Call this at the top level of the module that defines the type, so that every
    process that imports the module has the codec. Children get the codecs that types of a script's `__main__` have when
    they start. A second codec for a type replaces the first.

    Args:
        type: the class. Its subclasses need codecs of their own.
        encode: ``encode(value)`` returns plain data, or values of any type that docs/values.md lists. Equal values must
            give equal data, because the bytes of a request are its identity.
        decode: ``decode(data)`` makes the value again. It raises any error for data that it refuses.

    Raises:
        InvalidSpec: `type` is no class, or travels already without a codec; or a function cannot be called.
    """
    given = cast("object", type)
    if not isinstance(given, _CLASS) or given in _KEPT or given in FLAT or given in NESTED:
        raise invalid("rr.codec", "type", "a class of your own", given)
    for field, function in (("encode", encode), ("decode", decode)):
        if not callable(function):
            raise invalid("rr.codec", field, "a callable", function)
    made = TypeCodec(type, encode, decode)
    _put(type, made)
    _by_name[made.name] = made


def codec_of_subclass(subclass: type, cls: type) -> None:
    """Give a subclass the codec of its class `cls`: the same actor then has the same bytes."""
    _put(subclass, _by_type[cls])


_CLASS = type
_KEPT = {type(None), bool, int, float, str, bytes, list, dict, object}


# -- numpy and pydantic, where the program has imported them ---------------------------------------------------------

_DTYPE = re.compile(r"[<>|=][?biufc]\d{1,2}")


def numpy_form(value: Any) -> tuple[int, list[Any]] | None:
    """Return the extension's code and plain form of a numpy array or scalar; None if the value is neither."""
    numpy: Any = sys.modules.get("numpy")
    if numpy is None or not isinstance(value, (numpy.ndarray, numpy.generic)):
        return None
    is_array = type(value) is numpy.ndarray
    if not is_array and isinstance(value, numpy.ndarray):
        return None  # a subclass: its own attributes would be lost
    if not _DTYPE.fullmatch(value.dtype.str):
        raise NoForm(f"a numpy value of dtype {value.dtype}: pass .tolist() of it, or its bytes")
    if is_array:
        return ARRAY, [value.dtype.str, list(value.shape), value.tobytes()]
    return SCALAR, [value.dtype.str, value.tobytes()]


def numpy_value(code: int, plain: Any) -> Any:
    """Return the array or scalar of this plain form; raise ValueError if it is wrong, or numpy is not imported here."""
    numpy: Any = sys.modules.get("numpy")
    if numpy is None:
        raise ValueError("a numpy value, where numpy is not imported: import it in the module of the callbacks")
    name, shape, data = msgspec.convert(plain if code == ARRAY else [plain[0], [], plain[1]], _ARRAY)
    if not _DTYPE.fullmatch(name):
        raise ValueError(f"a numpy value of dtype {shown(name)}")
    if any(size < 0 for size in shape):
        raise ValueError(f"a numpy array of shape {shown(shape)}")
    flat = numpy.frombuffer(data, dtype=numpy.dtype(name))
    return flat.reshape(shape).copy() if code == ARRAY else flat[0]


_ARRAY = tuple[str, list[int], bytes]


def is_numpy_type(cls: object) -> bool:
    """Return whether the class is numpy's array or the class of a numpy scalar."""
    numpy: Any = sys.modules.get("numpy")
    return numpy is not None and isinstance(cls, type) and (cls is numpy.ndarray or issubclass(cls, numpy.generic))


def is_pydantic_model(cls: object) -> bool:
    """Return whether the class is a pydantic model."""
    pydantic: Any = sys.modules.get("pydantic")
    return pydantic is not None and isinstance(cls, type) and issubclass(cls, pydantic.BaseModel)


def pydantic_form(model: Any) -> Any:
    """Return the plain form of a pydantic model; raise NoForm if its class may not make an equal model of that."""
    if _has_set(model.model_dump()):
        raise NoForm(f"a {type(model).__name__} with a set, whose JSON has no order: give it an rr.codec")
    cls: Any = model.__class__
    raw = model.model_dump_json(by_alias=True, round_trip=True)
    try:
        if cls.model_validate_json(raw) == model:
            return msgspec.json.decode(raw)
    except ValueError as error:
        raise NoForm(
            f"a {type(model).__name__} that its own JSON does not bring back: give it an rr.codec ({error})"
        ) from error
    raise NoForm(f"a {type(model).__name__} that its own JSON does not bring back as it was: give it an rr.codec")


def _has_set(dumped: Any) -> bool:
    if isinstance(dumped, (set, frozenset)):
        return len(cast("set[object]", dumped)) > 1
    if isinstance(dumped, dict):
        return any(map(_has_set, cast("dict[object, object]", dumped).values()))
    return isinstance(dumped, (list, tuple)) and any(map(_has_set, cast("list[object]", dumped)))


def pydantic_value(cls: Any, plain: Any) -> Any:
    """Return the model of this plain form."""
    return cls.model_validate_json(msgspec.json.encode(plain))


# -- declared types -------------------------------------------------------------------------------------------------


class _OfAny(type):
    """The metaclass of Tagged: every value passes the isinstance() that msgspec applies to a type unknown to it."""

    def __instancecheck__(cls, instance: object) -> bool:
        return True


class Tagged(metaclass=_OfAny):
    """A type in the place of a union of classes that msgspec cannot tell apart: bytes tell them apart by name."""

    classes: dict[str, Any]  # by their names
    others: Any  # the type of the other values; None if the union has only classes


def is_known(cls: Any) -> bool:
    """Return whether values of a class that msgspec does not know can be sent."""
    if cls is object or codec_of(cls) is not None or cls in FLAT or is_numpy_type(cls) or is_pydantic_model(cls):
        return True
    return isinstance(cls, type) and issubclass(cls, (Tagged, pathlib.PurePath))


# -- extensions with a name ----------------------------------------------------------------------------------------


def split_name(data: bytes) -> tuple[str, bytes]:
    """Split the data of an extension into its name and its body."""
    first = data[0] if data else 0
    if 0xA0 <= first <= 0xBF:
        start, size = 1, first - 0xA0
    elif first == 0xD9 and len(data) > 1:
        start, size = 2, data[1]
    elif first == 0xDA and len(data) > 2:
        start, size = 3, int.from_bytes(data[1:3])
    else:
        raise ValueError("a MessagePack extension without a name")
    return data[start : start + size].decode(), data[start + size :]
