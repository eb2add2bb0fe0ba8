"""Fitting: bytes as a tree of plain values and marks, and the tree adapted to a shape.

A mark is an extension that was not opened. If a type is declared in its place, the plain form is decoded to that type.
If any value is allowed, the mark stays, and `restore` opens it, by the tables of codecs.py and nothing else.
"""

from __future__ import annotations

from typing import Any, cast

import msgspec
from msgspec import inspect
from msgspec.msgpack import Ext

from rr_actors.base.errors import shown, with_article
from rr_actors.base.values.codecs import ARRAY, BY_CODE, CODEC, NAMED, SCALAR, codec_named, numpy_value, split_name
from rr_actors.base.values.packing import plain_form
from rr_actors.base.values.type_shapes import Shape, alternative, fields_of, name_of


class Mark:
    """An extension that was not opened. It is no Struct, so that msgspec does not encode it by itself."""

    __slots__ = ("code", "data")

    def __init__(self, code: int, data: bytes) -> None:
        self.code = code
        self.data = data

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Mark) and (self.code, self.data) == (other.code, other.data)

    def __hash__(self) -> int:
        return hash((self.code, self.data))


class Misfit(Exception):
    """A value that does not fit a shape, and the path to it."""

    def __init__(self, path: str, expected: str, got: str) -> None:
        super().__init__(got)
        self.path = path
        self.expected = expected
        self.got = got


# -- without a declared type ---------------------------------------------------------------------------------------


def restore(code: int, data: memoryview) -> Any:
    """Return the value of an extension.

    Raises:
        ValueError: only a declared type restores the value, or this process has no codec for it, or the code is
            unknown.
        Exception: the plain form is wrong, or a codec raises.
    """
    raw = bytes(data)
    kind = BY_CODE.get(code)
    if kind is not None:
        return kind.make(read(raw))
    if code in (ARRAY, SCALAR):
        return numpy_value(code, read(raw))
    if code == CODEC:
        name, body = split_name(raw)
        codec = codec_named(name)
        if codec is not None:
            return codec.decode(read(body))
    raise ValueError(_undeclared(Mark(code, raw)))


read = msgspec.msgpack.Decoder(ext_hook=restore).decode
"""Decode bytes without a declared type."""


def restore_or_mark(code: int, data: memoryview) -> Any:
    """Return the value of an extension as restore() does, or a mark if only a declared type restores the value."""
    return Mark(code, bytes(data)) if code == NAMED else restore(code, data)


def _undeclared(mark: Mark) -> str:
    """Return the text of the error for a mark that this process cannot open."""
    if mark.code not in (NAMED, CODEC):
        return f"the MessagePack extension {mark.code}"
    name, _ = split_name(mark.data)
    if mark.code == CODEC:
        of = with_article(shown(name))
        return f"{of} that has no codec in this process: import the module that gives it one (rr.codec)"
    of = with_article(_shortest(name))
    return (
        f"{of}, which only a declared type brings back: annotate the load callback with it (or give request_type, "
        "response_type), or give it an rr.codec"
    )


def _shortest(name: str) -> str:
    """Return a class's name from a peer's bytes in a form that is safe to show."""
    return name if name.isidentifier() and len(name) < 80 else shown(name)


# -- trees ---------------------------------------------------------------------------------------------------------


def _mark(code: int, data: memoryview) -> Mark:
    return Mark(code, bytes(data))


read_tree = msgspec.msgpack.Decoder(ext_hook=_mark).decode
"""Decode bytes to a tree."""


def _unmark(value: object) -> Ext:
    if isinstance(value, Mark):
        return Ext(value.code, value.data)
    raise TypeError(f"no part of a tree: {type(value).__name__}")


write_tree = msgspec.msgpack.Encoder(enc_hook=_unmark).encode
"""Return a tree's bytes."""


def opened(mark: Mark) -> Any:
    """Return the tree of a mark's plain form."""
    if mark.code == SCALAR:
        return numpy_value(SCALAR, read(mark.data)).item()
    data = split_name(mark.data)[1] if mark.code in (NAMED, CODEC) else mark.data
    return read_tree(data)


def plain(node: Any) -> Any:
    """Return the tree with all marks opened; None in the place of a damaged mark."""
    if isinstance(node, Mark):
        try:
            return plain(opened(node))
        except Exception:  # the bytes may come from anywhere
            return None
    if isinstance(node, dict):
        return {_plain_key(key): plain(part) for key, part in cast("dict[object, object]", node).items()}
    if isinstance(node, (list, tuple)):
        return [plain(part) for part in cast("list[object]", node)]
    return node


def _plain_key(key: Any) -> Any:
    key = plain(key)
    return tuple(map(_plain_key, cast("list[object]", key))) if isinstance(key, list) else key


def bare(raw: bytes) -> bytes:
    """Return the plain form of an extension with a class's name; return other bytes unchanged."""
    first = raw[0] if raw else 0
    if 0xC7 <= first <= 0xC9:
        start = 2 + (1 << (first - 0xC7))
        size = int.from_bytes(raw[1 : start - 1])
    elif 0xD4 <= first <= 0xD8:
        start, size = 2, 1 << (first - 0xD4)
    else:
        return raw
    if start + size != len(raw) or raw[start - 1] != NAMED:
        return raw
    return split_name(raw[start:])[1]


# -- to a shape ----------------------------------------------------------------------------------------------------


def fit(node: Any, shape: Shape, path: str) -> Any:
    """Open each mark for which the shape declares a type, and return the tree.

    Raise Misfit for a mark that this process cannot open, and any error for a damaged one.
    """
    if isinstance(shape, inspect.UnionType):
        shape = _chosen(shape, node)
    if isinstance(shape, inspect.AnyType):
        _check_marks(node, path)
        return node
    if isinstance(shape, inspect.CustomType):
        if shape.cls is object:
            _check_marks(node, path)
        return node
    if isinstance(node, Mark):
        return fit(_opened_for(node, shape), shape, path)
    if isinstance(node, dict):
        return _fit_dict(cast("dict[Any, Any]", node), shape, path)
    if isinstance(node, list):
        return _fit_list(cast("list[Any]", node), shape, path)
    return node


def _opened_for(mark: Mark, shape: Any) -> Any:
    if mark.code == CODEC:
        codec = codec_named(split_name(mark.data)[0])
        if codec is not None and codec.type is getattr(shape, "cls", None):
            return read_tree(plain_form(codec.decode(read(split_name(mark.data)[1]))))
    return opened(mark)


def _fit_dict(node: dict[Any, Any], shape: Shape, path: str) -> dict[Any, Any]:
    fields = fields_of(shape)
    if fields is not None:
        return {
            key: fit(part, fields[key], f"{path}.{key}") if key in fields else plain(part) for key, part in node.items()
        }
    if isinstance(shape, inspect.DictType):
        return {
            _plain_key(fit(key, shape.key_type, path)): fit(part, shape.value_type, f"{path}[{shown(key)}]")
            for key, part in node.items()
        }
    return plain(node)


def _fit_list(node: list[Any], shape: Shape, path: str) -> list[Any]:
    fields = fields_of(shape)
    item: Shape | None = getattr(shape, "item_type", None)
    items: list[Shape] = list(fields.values()) if fields is not None else list(getattr(shape, "item_types", ()))
    if item is not None:
        items = [item] * len(node)
    return [
        fit(part, items[index], f"{path}[{index}]") if index < len(items) else plain(part)
        for index, part in enumerate(node)
    ]


def _chosen(shape: inspect.UnionType, node: Any) -> Shape:
    """Return the one type of a union that fits the node."""
    if isinstance(node, Mark):
        customs = [part for part in shape.types if isinstance(part, inspect.CustomType)]
        if customs:
            return customs[0] if node.code in (NAMED, CODEC) else inspect.AnyType()
        node = opened(node)
    if not isinstance(node, (dict, list)):
        return inspect.NoneType()  # the node is plain, or becomes plain when it is opened
    if isinstance(node, dict):
        for part in shape.types:
            field = part.tag_field if isinstance(part, inspect.StructType) else None
            if field is not None and cast("dict[Any, Any]", node).get(field) == cast("inspect.StructType", part).tag:
                return part
    return alternative(shape, cast("object", node))


def _check_marks(node: Any, path: str) -> None:
    """Raise Misfit if `restore` cannot open all marks in the tree."""
    if isinstance(node, Mark):
        known = node.code in BY_CODE or node.code in (ARRAY, SCALAR)
        if not known and not (node.code == CODEC and codec_named(split_name(node.data)[0]) is not None):
            raise Misfit(path, name_of(inspect.AnyType()), _undeclared(node))
        if node.code not in (ARRAY, SCALAR):
            _check_marks(opened(node), path)
    elif isinstance(node, dict):
        for key, part in cast("dict[Any, Any]", node).items():
            _check_marks(key, f"{path}: key {shown(key)}")
            _check_marks(
                part, f"{path}.{key}" if isinstance(key, str) and key.isidentifier() else f"{path}[{shown(key)}]"
            )
    elif isinstance(node, (list, tuple)):
        for index, part in enumerate(cast("list[Any]", node)):
            _check_marks(part, f"{path}[{index}]")
