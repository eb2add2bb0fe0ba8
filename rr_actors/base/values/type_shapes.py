"""Shapes: msgspec's description of a type, and the questions about it that canonical.py asks."""

from __future__ import annotations

import types
from collections.abc import Iterator, Sequence
from hashlib import sha256
from inspect import getattr_static
from typing import Any, get_origin

import msgspec
from msgspec import NODEFAULT, inspect

from rr_actors.base.errors import NotSerializable, is_a, shown, text_of
from rr_actors.base.values.codecs import codec_of, is_known

Shape = inspect.Type
PLAIN_DATA = "plain data (numbers, strings, bytes, lists, dicts, dataclasses and the like) or a type with an rr.codec"

_RECORDS = (inspect.StructType, inspect.DataclassType, inspect.TypedDictType, inspect.NamedTupleType)
_DICTS = (inspect.DictType, inspect.StructType, inspect.DataclassType, inspect.TypedDictType)
_LISTS = (
    inspect.CollectionType,  # list, set, frozenset, and tuple of any length
    inspect.TupleType,
    inspect.NamedTupleType,
)


def shape_of(type_: Any, what: str) -> Shape:
    """Return the type's shape.

    Raise NotSerializable for a type that plain data cannot have; `.path` leads to the part.
    """
    try:
        shape = inspect.type_info(type_)
        msgspec.msgpack.Decoder(type_)
    except Exception as error:  # a name it cannot resolve, a union it cannot tell apart, no type at all
        name = type_.__qualname__ if is_a(type_, type) else shown(type_)
        why = text_of(error).partition(": ")[2] + _advice(error)
        raise NotSerializable(f"{what} type {name}: {why}", path=what) from error
    for path, part in walk(shape, f"{what} type {name_of(shape)}"):
        if isinstance(part, inspect.CustomType) and not is_known(part.cls):
            raise NotSerializable(f"{path}: expected {PLAIN_DATA}, got {part.cls.__qualname__}", path=path)
        private = [name for name in fields_of(part) or () if name.startswith("_")]
        if private and hasattr(getattr(part, "cls", None), "__attrs_attrs__"):
            raise NotSerializable(f"{path}.{private[0]}: msgspec leaves out private fields of attrs classes", path=path)
    return shape


def _advice(error: Exception) -> str:
    if "may not contain more than one" not in str(error):
        return ""
    return (
        "; a union of classes may be a whole request or response, or an item of a list or dict there; as a field make "
        "its classes msgspec Structs with a tag (class Scan(msgspec.Struct, tag=True)), or give the outer class an "
        "rr.codec"
    )


def walk(shape: Shape, path: str) -> Iterator[tuple[str, Shape]]:
    """Yield every part of the shape once, the shape included, each with a path to it."""
    ahead, seen = [(path, shape)], set[int]()
    while ahead:
        path, shape = ahead.pop()
        if id(shape) in seen:
            continue
        seen.add(id(shape))
        yield path, shape
        ahead += [(f"{path}.{name}", part) for name, part in (fields_of(shape) or {}).items()]
        parts = [getattr(shape, name, None) for name in ("item_type", "key_type", "value_type")]
        parts += [*getattr(shape, "item_types", ()), *getattr(shape, "types", ())]
        ahead += [(path, part) for part in parts if part is not None]


def digest_of(shapes: Sequence[Shape]) -> bytes:
    """Return a digest of shapes, which is the same in each process; b"" if a default's repr raises."""
    parts = [part for shape in shapes for _, part in walk(shape, "") if isinstance(part, inspect.EnumType)]
    members = [(name, member.value) for part in parts for name, member in part.cls.__members__.items()]
    try:
        return sha256(repr((shapes, members)).encode("utf-8", "backslashreplace")).digest()
    except Exception:
        return b""


def fields_of(shape: Shape) -> dict[str, Shape] | None:
    """Return the fields of a record's shape by their names on the wire; None if the shape is no record."""
    if isinstance(shape, _RECORDS):
        return {field.encode_name: field.type for field in shape.fields}
    return None


def has_class(shape: Shape) -> bool:
    """Return whether values of the shape have a class that bytes may name."""
    parts = shape.types if isinstance(shape, inspect.UnionType) else (shape,)
    return any(isinstance(part, (*_RECORDS, inspect.EnumType)) for part in parts)


def runs_code(parts: Sequence[Shape]) -> bool:
    """Return whether decoding to the shape of these parts may run a user's code, except in a place of any value."""
    return any(_runs_code(part) for part in parts)


def _runs_code(part: Shape) -> bool:
    cls: Any = getattr(part, "cls", type(None))
    cls = get_origin(cls) or cls
    if isinstance(part, inspect.CustomType) or codec_of(cls) is not None:
        return True  # an rr.codec, or a model of pydantic
    for keys in (
        getattr(part, "key_type", None),
        getattr(part, "item_type", None) if isinstance(part, _SETS) else None,
    ):
        if keys is not None and any(isinstance(inner, _RECORDS) for _, inner in walk(keys, "")):
            return True  # a record's __hash__ and __eq__ may be a user's code
    if isinstance(part, inspect.EnumType):
        return _has_own(cls, "_missing_", "__hash__", "__eq__")
    if isinstance(part, inspect.NamedTupleType):
        return cls.__bases__ != (tuple,)  # a subclass may have a __new__ of its own
    if isinstance(part, inspect.TypedDictType) or not isinstance(part, _RECORDS):
        return False
    factories = [getattr(field, "default_factory", NODEFAULT) for field in part.fields]
    if any(factory is not NODEFAULT and factory not in _EMPTY for factory in factories):
        return True
    if hasattr(cls, "__attrs_attrs__") or _has_own(cls, "__post_init__", "__new__", "__getattribute__", "__getattr__"):
        return True
    return any(_is_computed(getattr_static(cls, field.name, None)) for field in part.fields)


_EMPTY = (list, dict, set, frozenset, tuple, bytes, bytearray, str, int, float, bool)
_SETS = (inspect.SetType, inspect.FrozenSetType)
_PLAIN_MODULES = ("abc", "builtins", "enum", "msgspec", "msgspec._core", "typing")


def _has_own(cls: type, *names: str) -> bool:
    """Return whether the class has one of these special methods from elsewhere than Python and msgspec."""
    return any(name in vars(base) for base in cls.__mro__ if base.__module__ not in _PLAIN_MODULES for name in names)


def _is_computed(attribute: object) -> bool:
    """Return whether reading or setting the attribute runs code, such as that of a property."""
    return hasattr(type(attribute), "__set__") and not isinstance(attribute, types.MemberDescriptorType)


class Gaps(msgspec.Struct, frozen=True):
    """The defaults that msgspec does not set when it decodes to a class: it leaves a dataclass's defaults on the class.

    `defaults`: those of this class. `within`: its attributes that contain more such classes.
    """

    defaults: tuple[tuple[str, Any], ...]
    within: tuple[str, ...]


def gaps_of(parts: Sequence[Shape]) -> dict[type, Gaps]:
    """Return the gaps of all classes in the shape of these parts; {} if there are none."""
    records = [part for part in parts if isinstance(part, _RECORDS)]
    unset = {part.cls: _unset_defaults(part) for part in records}

    def leads_on(part: Shape) -> bool:
        return any(unset.get(getattr(inner, "cls", object)) for _, inner in walk(part, ""))

    if not any(unset.values()):
        return {}
    return {
        part.cls: Gaps(unset[part.cls], tuple(field.name for field in part.fields if leads_on(field.type)))
        for part in records
        if not isinstance(part, inspect.TypedDictType)
    }


def _unset_defaults(shape: Any) -> tuple[tuple[str, Any], ...]:
    if not isinstance(shape, inspect.DataclassType):
        return ()
    return tuple(
        (field.name, field.default)
        for field in shape.fields
        if field.default is not NODEFAULT
        and not isinstance(getattr_static(shape.cls, field.name, None), types.MemberDescriptorType)
    )


def alternative(shape: Shape, value: object) -> Shape:
    """Return the one type of a union that fits `value`; any type if not exactly one fits."""
    if not isinstance(shape, inspect.UnionType):
        return shape
    fitting = [part for part in shape.types if isinstance(part, _LISTS if isinstance(value, list) else _DICTS)]
    return fitting[0] if len(fitting) == 1 else inspect.AnyType()


def shape_at(shape: Shape, steps: Sequence[str]) -> Shape:
    """Return the shape at these steps: names of fields, indices, or "..." for an item of a dict or set."""
    for step in steps:
        shape = alternative(shape, [] if step.isdigit() else {})
        fields = fields_of(shape) or {}
        items: Sequence[Shape] = getattr(shape, "item_types", None) or list(fields.values())
        if step in fields:
            shape = fields[step]
        elif step.isdigit() and int(step) < len(items):
            shape = items[int(step)]
        else:
            shape = getattr(shape, "item_type", None) or getattr(shape, "value_type", None) or inspect.AnyType()
    return shape


def name_of(shape: Any) -> str:
    """Return the type's name as in source code."""
    match shape:
        case inspect.AnyType():
            return "any plain value"
        case inspect.NoneType():
            return "None"
        case inspect.UnionType():
            return " | ".join(name_of(part) for part in shape.types)
        case inspect.EnumType():
            return "one of " + ", ".join(repr(member.value) for member in shape.cls)
        case inspect.LiteralType():
            return "one of " + ", ".join(map(repr, shape.values))
        case inspect.DictType():
            return f"dict[{name_of(shape.key_type)}, {name_of(shape.value_type)}]"
        case inspect.TupleType():
            return f"tuple[{', '.join(map(name_of, shape.item_types))}]"
        case inspect.VarTupleType():
            return f"tuple[{name_of(shape.item_type)}, ...]"
        case inspect.CollectionType():
            return f"{type(shape).__name__.removesuffix('Type').lower()}[{name_of(shape.item_type)}]"
        case _:
            cls = getattr(shape, "cls", None)
            return cls.__name__ if cls is not None else type(shape).__name__.removesuffix("Type").lower()
