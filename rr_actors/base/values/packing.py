"""Packing: a value in a form that msgspec can encode without losing a type.

Values with a form in MessagePack are not changed. The builtin types of codecs.py become extensions, and so do types
with an rr.codec. Dataclasses and similar records become extensions with the name of their class. Only a declared type
restores them; without one the reader's error has that name. Inside of a record the annotations of its fields give the
types, so nothing is added there, except in fields that may hold any value.
"""

from __future__ import annotations

import copy
import dataclasses
import datetime
import weakref
from collections.abc import Callable, Sequence
from typing import Any, cast

import msgspec
from msgspec import inspect
from msgspec.msgpack import Ext

from rr_actors.base.errors import NotSerializable, text_of
from rr_actors.base.values.codecs import (
    CODEC,
    FLAT,
    NAMED,
    NESTED,
    NoForm,
    TypeCodec,
    codec_of,
    is_pydantic_model,
    numpy_form,
    pydantic_form,
)
from rr_actors.base.values.type_shapes import shape_of, walk

_class_of: Callable[[Any], Any] = type  # typed so that the type checker accepts every use

LEAVES = frozenset({type(None), bool, int, float, str, bytes})


def packed(value: Any) -> bytes:
    """Return the canonical bytes of a value."""
    return encode_packed(value if type(value) in LEAVES else _pack(value))


def _pack(value: Any) -> Any:
    kind = _class_of(value)
    if kind in LEAVES:
        return value
    if kind is dict:
        return _pack_dict(value)
    if kind is list:
        return value if _all_leaves(value) else [_pack(item) for item in value]
    codec = codec_of(kind)
    if codec is not None:
        return _pack_own(value, codec)
    layout = _layouts.get(id(kind))
    if layout is not None:
        return _pack_named(value, layout)
    if kind in FLAT:
        return _pack_flat(value)
    if kind in NESTED:
        return Ext(NESTED[kind].code, encode_packed(_pack(list(value)) if kind is tuple else _ordered(value)))
    return _pack_foreign(value) or _pack_named(value, _layout_of(value))


def _all_leaves(values: Any) -> bool:
    return LEAVES.issuperset(map(type, values))


def _pack_dict(value: dict[Any, Any]) -> Any:
    if {str}.issuperset(map(type, value)):
        return value if _all_leaves(value.values()) else {key: _pack(item) for key, item in value.items()}
    if all(map(_is_plain_key, value)):
        pairs = [(encode_packed(key), packed(value[key])) for key in sorted(value)]
    else:
        pairs = sorted((packed(key), packed(item)) for key, item in value.items())
    return msgspec.Raw(_header(len(pairs), 0x80, 0xDE) + b"".join(key + item for key, item in pairs))


def _is_plain_key(key: Any) -> bool:
    """Return whether MessagePack keeps the key's type: an array in a key is read as a tuple."""
    return type(key) in LEAVES or (type(key) is tuple and all(map(_is_plain_key, cast("tuple[object, ...]", key))))


def _ordered(items: Any) -> Any:
    """Return a set's items in an order that does not depend on the process."""
    if _all_leaves(items):
        return set(items)  # msgspec sorts the items, and refuses items that cannot be sorted
    inside = sorted(packed(item) for item in items)
    return msgspec.Raw(_header(len(inside), 0x90, 0xDC) + b"".join(inside))


def _header(size: int, short: int, long: int) -> bytes:
    """Return MessagePack's header for an array or a map of this size."""
    if size < 16:
        return bytes((short + size,))
    return bytes((long,)) + size.to_bytes(2) if size < 1 << 16 else bytes((long + 1,)) + size.to_bytes(4)


def _pack_own(value: Any, codec: TypeCodec) -> Ext:
    done = "raised"
    try:
        data = codec.encode(value)
        done = "returned what cannot be sent:"
        return Ext(CODEC, encode_packed(codec.name) + packed(data))
    except NoForm:
        raise
    except Exception as error:
        raise NoForm(f"a {codec.name}, whose rr.codec {done} {text_of(error)}") from error


def _pack_flat(value: Any) -> Any:
    if type(value) is datetime.datetime and value.tzinfo is not None:
        return value  # MessagePack has a form for an instant
    kind = FLAT[type(value)]
    return Ext(kind.code, encode_packed(kind.plain(value)))


def _pack_foreign(value: Any) -> Ext | None:
    """Return the extension for a value of numpy or pydantic; None for any other value."""
    form = numpy_form(value)
    if form is not None:
        return Ext(form[0], encode_packed(form[1]))
    cls = _class_of(value)
    if is_pydantic_model(cls):
        return Ext(NAMED, encode_packed(cls.__name__) + packed(pydantic_form(value)))
    return None


def _pack_unknown(value: Any) -> Any:
    """Pack a value that msgspec does not know, in a dataclass or a similar record (msgspec's enc_hook)."""
    kind = _class_of(value)
    codec = codec_of(kind)
    if codec is not None:
        return _pack_own(value, codec)
    made = _pack_flat(value) if kind in FLAT else _pack_foreign(value)
    if made is None:
        raise TypeError(f"no plain data: {kind.__name__}")
    return made


encode_packed = msgspec.msgpack.Encoder(order="sorted", enc_hook=_pack_unknown).encode
"""Return the canonical bytes of a value that is packed, as a leaf always is."""


# -- records: dataclasses and similar classes ----------------------------------------------------------------------


class _Layout(msgspec.Struct, frozen=True):
    """How the values of one class are packed."""

    head: bytes  # the class's name, packed
    open: tuple[str, ...]  # the attributes that may hold any value, by the class's annotations
    cls: weakref.ref[type]


_layouts: dict[int, _Layout] = {}


def _layout_of(value: Any) -> _Layout:
    cls = _class_of(value)
    key = id(cls)
    layout = _Layout(
        encode_packed(cls.__name__), tuple(_open_fields(value)), weakref.ref(cls, lambda _: _layouts.pop(key, None))
    )
    _layouts[key] = layout
    return layout


def _pack_named(value: Any, layout: _Layout) -> Ext:
    if not layout.open:
        try:
            return Ext(NAMED, layout.head + encode_packed(value))
        except TypeError:  # the value may differ from its annotations: a dict with other keys than strings
            return Ext(NAMED, layout.head + encode_packed(_with_packed(value, field_names(value) or ())))
    return Ext(NAMED, layout.head + encode_packed(_with_packed(value, layout.open)))


def plain_form(value: Any) -> bytes:
    """Return the bytes of a record without its class's name, also for a class that has an rr.codec."""
    cls = _class_of(value)
    return bytes(_pack_named(value, _Layout(b"", tuple(_open_fields(value)), weakref.ref(cls))).data)


def _open_fields(value: Any) -> Sequence[str]:
    names = field_names(value)
    if names is None:
        return ("",) if isinstance(value, (dict, list, tuple, set, frozenset)) else ()
    try:
        shape: Any = shape_of(type(value), "")
    except NotSerializable:  # its annotations do not give the types
        return tuple(names)
    return tuple(field.name for field in getattr(shape, "fields", ()) if _is_open(field.type))


def _is_open(shape: inspect.Type) -> bool:
    return any(
        isinstance(part, inspect.AnyType)
        or (isinstance(part, inspect.CustomType) and part.cls is object)
        or (isinstance(part, inspect.DictType) and not isinstance(part.key_type, inspect.StrType))
        for _, part in walk(shape, "")
    )


def _with_packed(value: Any, names: Sequence[str]) -> Any:
    """Return a copy of the value for the encoder, with these attributes packed."""
    cls = _class_of(value)
    if isinstance(value, tuple):
        return [_pack(item) for item in cast("tuple[object, ...]", value)]
    if isinstance(value, dict):
        return _pack(dict(cast("dict[object, object]", value)))
    if isinstance(value, list):
        return _pack(list(cast("list[object]", value)))
    if isinstance(value, (set, frozenset)):
        return _ordered(value)
    if not names:
        return value
    if isinstance(value, msgspec.Struct):  # it has no __new__ without its fields
        struct = copy.copy(value)
        for name in names:
            if hasattr(value, name):
                msgspec.structs.force_setattr(struct, name, _pack(getattr(value, name)))
        return struct
    clone: Any = cls.__new__(cls)
    for name in field_names(value) or ():
        if hasattr(value, name):
            part = getattr(value, name)
            object.__setattr__(clone, name, _pack(part) if name in names else part)
    return clone


def field_names(value: Any) -> Sequence[str] | None:
    """Return the names of a record's attributes; None if the value is no record."""
    if isinstance(value, type):
        return None
    if isinstance(value, msgspec.Struct):
        return value.__struct_fields__
    if dataclasses.is_dataclass(value):
        return [field.name for field in dataclasses.fields(value)]
    if hasattr(value, "__attrs_attrs__"):
        return [attribute.name for attribute in value.__attrs_attrs__]
    if isinstance(value, tuple):
        return getattr(cast("Any", value), "_fields", None)
    return None
