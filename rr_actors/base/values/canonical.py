"""Canonical bytes: equal requests have equal bytes, so a request's bytes are its identity. Also the typed way back.

Requests and responses are plain data: docs/values.md lists the types. They travel as MessagePack with sorted keys and
fields (packing.py). A value keeps its type on the way, or is refused by an error that says what to do. If a server has
a type, the provider decodes to it and encodes again. Then a dict equals the dataclass with the same fields, 30 equals
30.0 in a float field, and an omitted field equals its default.
"""

from __future__ import annotations

import contextlib
import datetime
import pathlib
import re
import types
import typing
from collections.abc import Iterator, Sequence
from typing import Annotated, Any, NoReturn, cast

import msgspec
from msgspec.inspect import AnyType, DictType

from rr_actors.base.errors import (
    InvalidRequest,
    InvalidResponse,
    NotSerializable,
    did_you_mean,
    name_of_class,
    readable,
    shortened,
    shown,
    text_of,
)
from rr_actors.base.values.codecs import (
    NAMED,
    NoForm,
    Tagged,
    is_numpy_type,
    is_pydantic_model,
    pydantic_value,
    split_name,
)
from rr_actors.base.values.fitting import (
    Mark,
    Misfit,
    bare,
    fit,
    plain,
    read_tree,
    restore,
    restore_or_mark,
    write_tree,
)
from rr_actors.base.values.packing import LEAVES, encode_packed, field_names, packed
from rr_actors.base.values.type_shapes import (
    PLAIN_DATA,
    Shape,
    alternative,
    fields_of,
    gaps_of,
    has_class,
    name_of,
    runs_code,
    shape_at,
    shape_of,
    walk,
)

_LOOK_DEEP = 100  # levels of a value that are searched for the part to name in an error
_may_be_extension = re.compile(rb"[\xc7-\xc9\xd4-\xd8]").search  # an extension's first byte; others have it by chance


def encode(value: object, what: str = "request") -> bytes:
    """Return the value's canonical bytes.

    Raises:
        NotSerializable: a part is not plain data; `.path` leads to it ("request.options[2].callback").
    """
    try:
        return encode_packed(value) if type(value) in LEAVES else packed(value)
    except Exception as error:
        _refuse_value(value, what, error)


class Codec:
    """A reader and writer of values of one type, or of any plain type if the type is None.

    Raises:
        NotSerializable: plain data cannot be read as the type ("request type Scan: field 'lock': ...").
    """

    def __init__(self, type_: Any = None, what: str = "request") -> None:
        self.type = type_
        wanted = Any if type_ is None else _declared_type(type_)
        self.shape = shape_of(wanted, what)
        parts = [part for _, part in walk(self.shape, "")]
        self._gaps = gaps_of(parts)
        self._has_class = has_class(self.shape)
        self._runs_code = runs_code(parts)
        self._takes_any = any(isinstance(part, AnyType) for part in parts)
        self._read = msgspec.msgpack.Decoder(wanted, ext_hook=restore, dec_hook=_value_of).decode
        self._read_marked = msgspec.msgpack.Decoder(wanted, ext_hook=restore_or_mark, dec_hook=_value_of).decode

    def encode(self, value: object, server: str = "", what: str = "response") -> bytes:
        """Return the canonical bytes of a value of this type. They are decoded once as a check.

        Raises:
            NotSerializable: a part of the value is not plain data.
            InvalidResponse: the value is not of this type (InvalidRequest for a request). `.server`, `.path`,
                `.expected`
        """
        raw = encode(value, f"{server}: {what}" if server else what)
        if self.type is not None or type(value) not in LEAVES:
            self._decode(raw, server, what)
        return raw

    def decode(self, raw: bytes, server: str = "", what: str = "request") -> Any:
        """Return the value of these bytes.

        Raises:
            InvalidRequest: the bytes do not fit the type, or are no MessagePack. `.server`, `.path`, `.expected`
            InvalidResponse: the same for a response.
        """
        value = self._decode(raw, server, what)
        if self._gaps:
            self._fill(value)
        return value

    def _decode(self, raw: bytes, server: str, what: str) -> Any:
        try:
            return self._read(bare(raw) if self._has_class else raw)
        except Exception as error:  # besides msgspec's own: bad UTF-8, RecursionError, whatever a __post_init__ raises
            return self._decode_fitted(raw, server, what, error)

    def _decode_fitted(self, raw: bytes, server: str, what: str, first: Exception) -> Any:
        """Decode bytes that name classes inside of declared types: perhaps that is the only reason for an error."""
        try:
            fitted = write_tree(fit(read_tree(raw), self.shape, what))
        except Misfit as misfit:
            _refuse(misfit, server, what, first)
        except Exception:
            _refuse(_misfit(first, raw, self.shape, what), server, what, first)
        try:
            return self._read_marked(fitted)
        except Exception as error:
            _refuse(_misfit(error, fitted, self.shape, what), server, what, error)

    def runs_code(self, raw: bytes) -> bool:
        """Return whether decoding these bytes may run a user's code: a __post_init__, a pydantic model, an rr.codec."""
        return self._runs_code or (self._takes_any and _may_be_extension(raw) is not None)

    def show(self, raw: bytes) -> Any:
        """Return the value of these bytes; a plain value if they do not fit the type, None if they are damaged."""
        try:
            return self.decode(raw)
        except (InvalidRequest, InvalidResponse):
            return shown_plain(raw)

    def show_stored(self, raw: bytes) -> Any:
        """Return the value of a request that an earlier version may have stored.

        It is a plain value if it does not fit the type, also by today(): the type could only be guessed.
        """
        try:
            self.today(raw)
        except (InvalidRequest, NotSerializable):
            return shown_plain(raw)
        return self.decode(raw)

    def canonical(self, raw: bytes, server: str = "", what: str = "request") -> bytes:
        """Return the canonical bytes for a value's bytes: equal requests have equal canonical bytes.

        Raises:
            InvalidRequest: the bytes do not fit the type, have a field that the type lacks, or are no MessagePack.
                `.server`, `.path`, `.expected`
            NotSerializable: the value has no canonical bytes, such as a dict whose keys cannot be put in order.
        """
        canonical = encode(self.decode(raw, server, what), f"{server}: {what}" if server else what)
        if canonical != raw and self.type is not None:
            try:
                misfit = _unknown_field(plain(read_tree(raw)), self.shape, what)
            except RecursionError as error:  # msgspec may go deeper than Python
                misfit = Misfit(what, "a value of some hundred levels at most", f"one that is deeper: {error}")
            if misfit is not None:
                _refuse(misfit, server, what, None)
        return canonical

    def today(self, raw: bytes) -> bytes:
        """Return the canonical bytes that a stored request has by this type, which may be newer than the request.

        A field that the type lacks is dropped, unless the type has another one that the request lacks: that may be the
        same field under a new name.

        Raises:
            InvalidRequest: the request does not fit the type. `.path`, `.expected`
            NotSerializable: the value has no canonical bytes.
        """
        canonical = encode(self.decode(raw))
        if canonical != raw and self.type is not None:
            old, new = shown_plain(raw), shown_plain(canonical)
            misfit = _unknown_field(old, self.shape, "request")
            if misfit is not None and isinstance(old, dict) and set(new) - set(cast("Any", old)):
                _refuse(misfit, "", "request", None)
        return canonical

    def _fill(self, value: object) -> None:
        """Set the defaults that msgspec left on the class: it encodes only the attributes of the instance."""
        ahead = [value]
        for value in ahead:  # grows in the loop
            gaps = self._gaps.get(type(value))
            if gaps is not None:
                for name, default in gaps.defaults:
                    value.__dict__.setdefault(name, default)  # frozen or not
                if gaps.within:
                    ahead += [getattr(value, name) for name in gaps.within]
            elif isinstance(value, dict):
                ahead += cast("dict[object, object]", value).values()
            elif isinstance(value, (list, tuple, set, frozenset)):
                ahead += cast("list[object]", value)


_SHOWN = 400  # characters of a request or response


def shown_plain(raw: bytes) -> Any:
    """Return these bytes as plain values, without classes; None if they are damaged."""
    try:
        return plain(read_tree(raw))
    except Exception:  # the bytes may come from anywhere
        return None


def text_of_value(raw: bytes | None) -> str:
    """Return a request's or response's bytes as the text that is shown; "" for None."""
    if raw is None:
        return ""
    value: Any = shown_plain(raw)
    if value is None and raw != b"\xc0":
        return f"<{len(raw)} bytes>"
    text = readable(json_of(value))
    return text if len(text) <= _SHOWN else text[: _SHOWN - 1] + "…"


def json_of(value: Any) -> str:
    """Return a value as JSON; what JSON does not have is shown as in Python."""
    try:
        return msgspec.json.encode(value, enc_hook=repr).decode()
    except Exception:  # a key is no text, a number is too long, or the nesting is too deep
        return repr(value)


# -- declared types that msgspec does not know, and unions of classes that it cannot tell apart -----------------------


def _declared_type(type_: Any) -> Any:
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
    tagged = cast("Any", type(Tagged))(" | ".join(names), (Tagged,), members)
    return tagged | None if type(None) in alternatives else tagged


def _union(types_: Sequence[Any]) -> Any:
    return cast("Any", typing.Union)[tuple(types_)]


def _is_class(part: Any) -> bool:
    """Return whether bytes carry the name of this class."""
    return (
        hasattr(part, "__dataclass_fields__")
        or hasattr(part, "__attrs_attrs__")
        or issubclass(part, msgspec.Struct)
        or is_pydantic_model(part)
    )


def _value_of(type_: Any, read: Any) -> Any:
    """Return the value of a type that msgspec does not know (its dec_hook), made of the plain value or mark `read`.

    Raise TypeError or ValueError if `read` is not a value of the type.
    """
    cls: Any = typing.get_origin(type_) or type_
    if issubclass(cls, Tagged):
        return _one_of(cls, read)
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


def _one_of(cls: type[Tagged], read: Any) -> Any:
    if isinstance(read, Mark) and read.code == NAMED:
        name, body = split_name(read.data)
        if name in cls.classes:
            codec = Codec(cls.classes[name])
            codec.canonical(body)  # refuses unknown fields
            return codec.decode(body)
        raise TypeError(f"expected one of {', '.join(cls.classes)}, got a {shown(name)}")
    if cls.others is not None:
        return msgspec.convert(read, cls.others)
    raise TypeError(f"expected a value of one of the classes {', '.join(cls.classes)}, got {type(read).__name__}")


# -- a value that cannot be encoded: where and why -----------------------------------------------------------------


def _refuse_value(value: object, what: str, error: Exception) -> NoReturn:
    path = what
    above = [id(value)]
    while (found := _failing_part(value)) is not None:
        suffix, value, error = found
        path += suffix
        if id(value) in above:
            got = f"a {type(value).__name__} that contains itself"
            break
        above.append(id(value))
        if len(above) > _LOOK_DEEP:
            path, got = what, "one that is nested too deeply"
            break
    else:
        try:
            got = _described(value, error)
        except Exception:
            got = f"an object of type {name_of_class(type(value))}, whose own code raised {text_of(error)}"
    raise NotSerializable(f"{path}: expected {PLAIN_DATA}, got {got}", path=path) from error


def _failing_part(value: object) -> tuple[str, object, Exception] | None:
    try:
        parts = list(_each_part(value))
    except Exception:  # of the value's own code
        return None
    for suffix, part in parts:
        try:
            packed(part)
        except Exception as error:
            return suffix, part, error
    return None


def _each_part(value: object) -> Iterator[tuple[str, object]]:
    names = field_names(value)
    if names is not None:
        for name in names:
            yield f".{name}", getattr(value, name, None)
    elif isinstance(value, dict):
        for key, item in cast("dict[object, object]", value).items():
            yield f": key {shown(key)}", key
            yield f".{shortened(key)}" if isinstance(key, str) and key.isidentifier() else f"[{shown(key)}]", item
    elif isinstance(value, (list, tuple, set, frozenset)):
        for index, item in enumerate(cast("list[object]", value)):
            yield f"[{index}]", item


def _described(value: Any, error: Exception) -> str:
    if isinstance(error, NoForm):
        return str(error)
    if isinstance(error, OverflowError) and isinstance(value, int):
        return "an integer of more than 64 bits"
    if isinstance(value, datetime.datetime):
        return "a datetime whose year in UTC is not within 1 to 9999"
    if isinstance(error, UnicodeError):
        return "a string with a lone surrogate"
    if isinstance(value, dict):
        return "a dict whose keys cannot be put in order"
    if isinstance(value, (set, frozenset)):
        return "a set whose items cannot be put in order"
    if isinstance(value, type):
        return f"the class {value.__qualname__}"
    if callable(value) and hasattr(value, "__qualname__"):
        return f"a {type(value).__name__} ({value.__qualname__})"
    text = f"an object of type {type(value).__module__}.{type(value).__qualname__}"
    return text if isinstance(error, TypeError) else f"{text}, whose own code raised {text_of(error)}"


# -- bytes that do not fit the type: where and why -----------------------------------------------------------------


def _refuse(misfit: Misfit, server: str, what: str, error: Exception | None) -> NoReturn:
    kind = InvalidResponse if what == "response" else InvalidRequest
    raise kind(
        f"{server + ': ' if server else ''}{misfit.path}: expected {misfit.expected}, got {misfit.got}",
        server=server,
        path=misfit.path,
        expected=misfit.expected,
    ) from error


# Compiled when the first request is refused, and kept by re.
_MESSAGE = r"(?P<problem>.*?)(?: - at (?P<key>`key` in )?`\$(?P<path>.*)`)?"
_EXPECTED = r"Expected `[^`]*`(?P<bound>.*?)(?:, got `?(?P<got>.*?)`?)?"
_MISSING = r"Object missing required field `(?P<field>.*)`"
_STEP = r"\.([^.\[]+)|\[(\d+|\.\.\.)\]"
_GOT = {"object": "a dict", "array": "a list", "null": "None", "ext": "a MessagePack extension"}


def _misfit(error: Exception, raw: bytes, shape: Shape, what: str) -> Misfit:
    if not isinstance(error, msgspec.ValidationError):
        if isinstance(error, (msgspec.DecodeError, UnicodeDecodeError, RecursionError)):
            return Misfit(what, "well-formed MessagePack", f"{len(raw)} bytes that are not: {error}")
        return Misfit(what, name_of(shape), f"one it refuses: {type(error).__name__}: {error}")
    message = re.fullmatch(_MESSAGE, str(error), re.DOTALL)
    assert message is not None  # the pattern takes every text
    problem, path = message["problem"], message["path"] or ""
    steps = [name or index for name, index in re.findall(_STEP, path)]
    missing = re.fullmatch(_MISSING, problem)
    if missing is not None:
        with contextlib.suppress(RecursionError, msgspec.DecodeError):  # deeper than Python goes; bytes after the value
            if (mistyped := _unknown_field(plain(read_tree(raw)), shape, what)) is not None:
                return mistyped
        path, steps = f"{path}.{missing['field']}", [*steps, missing["field"]]
        return Misfit(what + path, name_of(shape_at(shape, steps)), "nothing")
    here = shape_at(shape, steps)
    if message["key"] is not None:
        path, here = path + " (a key)", getattr(here, "key_type", AnyType())
    expected = re.fullmatch(_EXPECTED, problem)
    if expected is None:
        refused = shortened(problem) if problem.startswith("Invalid enum value") else problem  # msgspec says which one
        return Misfit(what + path, name_of(here), f"one it refuses: {refused}")
    got = expected["got"] or "one that is not"
    return Misfit(what + path, name_of(here) + expected["bound"], _GOT.get(got, got))


def _unknown_field(value: object, shape: Shape, path: str) -> Misfit | None:
    """Return the first field in the plain value that the type lacks: msgspec ignores such fields."""
    ahead = [(value, shape, path)]
    while ahead:
        value, shape, path = ahead.pop()
        shape = alternative(shape, value)
        fields = fields_of(shape)
        if isinstance(value, dict) and fields is not None:
            for key, part in cast("dict[object, object]", value).items():
                if key in fields:
                    ahead.append((part, fields[str(key)], f"{path}.{key}"))
                elif key != getattr(shape, "tag_field", None):
                    got = f"the unknown field {shown(key)}{did_you_mean(key, fields)}"
                    return Misfit(path, f"fields {', '.join(fields)}", got)
        elif isinstance(value, dict) and isinstance(shape, DictType):
            items = cast("dict[object, object]", value).items()
            ahead += [(part, shape.value_type, f"{path}[{shown(key)}]") for key, part in items]
        elif isinstance(value, list) and not isinstance(shape, AnyType):
            parts = enumerate(cast("list[object]", value))
            ahead += [(part, shape_at(shape, [str(index)]), f"{path}[{index}]") for index, part in parts]
    return None
