"""Declared types that msgspec does not know, and unions of classes that it cannot tell apart."""

from __future__ import annotations

import pathlib
import types
import typing
from collections.abc import Callable, Sequence
from typing import Annotated, Any, cast

import msgspec

from rr_actors.base.errors import shown
from rr_actors.base.values.codecs import NAMED, Tagged, is_numpy_type, is_pydantic_model, pydantic_value, split_name
from rr_actors.base.values.fitting import Mark, plain


def declared_type(type_: Any) -> Any:
    """Return the type with a Tagged class in place of each union that msgspec cannot tell apart."""
    try:
        msgspec.msgpack.Decoder(type_)
    except Exception:  # shape_of() reports the error
        return _replaced(type_)
    return type_


def _replaced(type_: Any) -> Any:
    origin, arguments = typing.get_origin(type_), typing.get_args(type_)
    if origin in (typing.Union, types.UnionType):
        return _tagged(arguments) if _needs_names(type_) else type_
    if origin is Annotated:
        return Annotated[(_replaced(arguments[0]), *arguments[1:])]
    if origin is None or not isinstance(origin, type) or not issubclass(origin, (list, dict, tuple, set, frozenset)):
        return type_
    return cast("Any", origin)[tuple(argument if argument is ... else _replaced(argument) for argument in arguments)]


def _needs_names(type_: Any) -> bool:
    try:
        msgspec.msgpack.Decoder(type_)
    except TypeError as error:
        return any(text in str(error) for text in ("may not contain more than one", "must be tagged", "a custom type"))
    except Exception:
        return False
    return False


def _tagged(alternatives: tuple[Any, ...]) -> Any:
    classes = [part for part in alternatives if isinstance(part, type) and _is_class(part)]
    names = [part.__name__ for part in classes]
    rest = [part for part in alternatives if part not in classes and part is not type(None)]
    if len(set(names)) != len(names):
        return _union(alternatives)  # their names do not tell either
    members = {"classes": dict(zip(names, classes, strict=True)), "others": _union(rest) if rest else None}
    tagged = _METACLASS(" | ".join(names), (Tagged,), members)
    return tagged | None if type(None) in alternatives else tagged


def _union(types_: Sequence[Any]) -> Any:
    return cast("Any", typing.Union)[tuple(types_)]


_METACLASS: Any = type(Tagged)


def _is_class(part: Any) -> bool:
    """Return whether bytes carry the name of this class."""
    return (
        hasattr(part, "__dataclass_fields__")
        or hasattr(part, "__attrs_attrs__")
        or issubclass(part, msgspec.Struct)
        or is_pydantic_model(part)
    )


def value_of(type_: Any, read: Any, decode: Callable[[Any, bytes], Any]) -> Any:
    """Return the value of a type that msgspec does not know.

    Args:
        read: the plain value or mark that was read in the type's place.
        decode: decodes bytes to one type of a union.

    Raises:
        TypeError, ValueError: `read` is not a value of the type.
    """
    cls: Any = typing.get_origin(type_) or type_
    if issubclass(cls, Tagged):
        return _one_of(cls, read, decode)
    if isinstance(read, cls):
        return read
    if is_pydantic_model(cls):
        return pydantic_value(cls, plain(read))
    if cls is complex and isinstance(read, (int, float)):
        return complex(read)
    if is_numpy_type(cls) and cls.__name__ != "ndarray" and isinstance(read, (bool, int, float, complex)):
        return cls(read)
    if issubclass(cls, pathlib.PurePath) and isinstance(read, str):
        return cls(read)
    raise TypeError(f"expected {cls.__name__}, got {type(read).__name__} ({shown(read)})")


def _one_of(cls: type[Tagged], read: Any, decode: Callable[[Any, bytes], Any]) -> Any:
    if isinstance(read, Mark) and read.code == NAMED:
        name, body = split_name(read.data)
        if name in cls.classes:
            return decode(cls.classes[name], body)
        raise TypeError(f"expected one of {', '.join(cls.classes)}, got a {shown(name)}")
    if cls.others is not None:
        return msgspec.convert(read, cls.others)
    raise TypeError(f"expected a value of one of the classes {', '.join(cls.classes)}, got {type(read).__name__}")
