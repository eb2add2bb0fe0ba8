"""Fitting: bytes as a tree of plain values and marks, and the tree brought to a shape.

A mark is an extension that was not opened. Where a type is declared the plain form is what is decoded; where any value
will do the mark stays, to be opened by `restore`, which looks codes up in the tables of codecs.py and nowhere else.
"""

from __future__ import annotations

from typing import Any, cast

import msgspec
from msgspec import inspect
from msgspec.msgpack import Ext

from rr_actors.base.errors import shown
from rr_actors.base.values.codecs import ARRAY, BY_CODE, CODEC, NAMED, SCALAR, codec_named, numpy_value, split_name
from rr_actors.base.values.packing import plain_form
from rr_actors.base.values.type_shapes import Shape, alternative, fields_of, name_of


class Mark:
    """An extension that was not opened. No Struct: msgspec is not to encode it by itself."""

    __slots__ = ("code", "data")

    def __init__(self, code: int, data: bytes) -> None:
        self.code = code
        self.data = data

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Mark) and (self.code, self.data) == (other.code, other.data)

    def __hash__(self) -> int:
        return hash((self.code, self.data))


class Misfit(msgspec.Struct, frozen=True):
    """What does not fit a shape, and where."""

    path: str
    expected: str
    got: str


class Unfit(Exception):
    """A tree cannot be brought to a shape."""

    def __init__(self, misfit: Misfit) -> None:
        super().__init__(misfit.got)
        self.misfit = misfit


# -- without a declared type ---------------------------------------------------------------------------------------


def restore(code: int, data: memoryview) -> Any:
    """Return the value of an extension.

    Raises:
        ValueError: only a declared type brings it back, or this process has no codec for it, or it is no extension of
            ours.
        Exception: its plain form is wrong; or what a codec raises.
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
"""Read bytes that no type is declared for."""


def restore_or_mark(code: int, data: memoryview) -> Any:
    """As restore(); what only a declared type brings back stays a mark."""
    return Mark(code, bytes(data)) if code == NAMED else restore(code, data)


def _undeclared(mark: Mark) -> str:
    """What is said of a mark that nothing here can open."""
    if mark.code not in (NAMED, CODEC):
        return f"the MessagePack extension {mark.code}"
    name, _ = split_name(mark.data)
    if mark.code == CODEC:
        return f"a {shown(name)} that has no codec in this process: import the module that gives it one (rr.codec)"
    return (
        f"a {_shortest(name)}, which only a declared type brings back: annotate the load callback with it (or give "
        f"request_type, response_type), or give it an rr.codec"
    )


def _shortest(name: str) -> str:
    """A class's name from a peer's bytes, fit to be shown."""
    return name if name.isidentifier() and len(name) < 80 else shown(name)


# -- trees ---------------------------------------------------------------------------------------------------------


def _mark(code: int, data: memoryview) -> Mark:
    return Mark(code, bytes(data))


read_tree = msgspec.msgpack.Decoder(ext_hook=_mark).decode
"""Read bytes as a tree."""


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
    """Return the tree with all marks opened; None in place of one that is damaged."""
    if isinstance(node, Mark):
        try:
            return plain(opened(node))
        except Exception:  # bytes of anybody's
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
    """Return the plain form of what has a class's name, other bytes as they are."""
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
    """Return the tree with the marks opened in whose place the shape declares a type.

    Raises:
        Unfit: there is a mark that nothing opens.
        Exception: a mark is damaged.
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
    """Of a union the one type that the node can be of."""
    if isinstance(node, Mark):
        if any(isinstance(part, inspect.CustomType) for part in shape.types):
            return inspect.AnyType() if node.code not in (NAMED, CODEC) else _custom_of(shape)
        node = opened(node)
    if not isinstance(node, (dict, list)):
        return inspect.NoneType()  # plain already, or it becomes so when it is opened
    if isinstance(node, dict):
        for part in shape.types:
            field = part.tag_field if isinstance(part, inspect.StructType) else None
            if field is not None and cast("dict[Any, Any]", node).get(field) == cast("inspect.StructType", part).tag:
                return part
    return alternative(shape, cast("object", node))


def _custom_of(shape: inspect.UnionType) -> Shape:
    return next(part for part in shape.types if isinstance(part, inspect.CustomType))


def _check_marks(node: Any, path: str) -> None:
    """Raise Unfit if `restore` cannot open all marks in the tree."""
    if isinstance(node, Mark):
        known = node.code in BY_CODE or node.code in (ARRAY, SCALAR)
        if not known and not (node.code == CODEC and codec_named(split_name(node.data)[0]) is not None):
            raise Unfit(Misfit(path, name_of(inspect.AnyType()), _undeclared(node)))
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
