"""Remade exceptions: an exception as bytes, and an exception of the same class made of them in another process.

Python pickles an exception as a call of its class with `args`, which fails if `__init__` takes other arguments. Here
the parts of an exception travel one by one: if a part cannot be pickled or unpickled, the others still arrive. The
class's `__init__` does not run again. If the receiver does not know the class, it makes a subclass of the first known
base. If the remade exception has another text, it gets a subclass with the original text: `except` catches both.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Sequence
from contextvars import ContextVar
from typing import Any, NamedTuple, cast

from rr_actors.base.errors import exact_text, shown, text_of
from rr_actors.base.reporting.tracebacks import add_note

Dumps = Callable[[object], bytes]
"""Pickle a part; raise what the part's own code raises."""

Loads = Callable[[bytes], Any]
"""Unpickle a part; raise what the part's own code raises."""


class Parts(NamedTuple):
    """The parts of an exception; bytes are pickles, b"" stands for a part that could not be pickled."""

    name: str  # of its class
    classes: tuple[bytes, ...]  # its class and the bases, up to the first builtin class
    args: tuple[bytes | str, ...]  # for that builtin class; text in the place of what could not be pickled
    own: bytes  # the result of the class's own `__reduce__`, if it has one that does not raise
    attributes: dict[str, bytes]  # its `__dict__`, and the fields of the builtin class
    cause: bytes
    suppress_context: bool
    text: str | None  # the result of str(); None if str() failed


PART_LIMIT_BYTES = 2 * 1024 * 1024
"""Longer parts do not travel: with them the exception would not fit into a frame, and its class would be lost."""

_ORIGIN = "__rr_made_from__"  # attribute of a class that was made here: the class it was made from

_leaving: ContextVar[tuple[int, ...]] = ContextVar("rr_actors_leaving", default=())


def has_parts(error: BaseException) -> bool:
    """Return whether plain pickle may lose a part; it keeps a builtin exception that has no cause and is no group."""
    return type(error).__module__ != "builtins" or error.__cause__ is not None or isinstance(error, BaseExceptionGroup)


def reduced(error: BaseException, dumps: Dumps, make: Callable[[Parts], BaseException]) -> tuple[Any, ...]:
    """Return the `__reduce__` value for an exception of any class; `make` calls made_of()."""
    if id(error) in _leaving.get():  # a part of itself
        return RuntimeError, (f"{type(error).__name__}, which is its own part",)
    token = _leaving.set((*_leaving.get(), id(error)))
    try:
        return make, (_parts(error, dumps),)
    finally:
        _leaving.reset(token)


def _parts(error: BaseException, dumps: Dumps) -> Parts:
    def part(value: object) -> bytes:
        try:
            blob = dumps(value)
        except BaseException:  # the code of its class may raise anything
            return b""
        return blob if len(blob) <= PART_LIMIT_BYTES else b""

    def attribute(value: object) -> bytes:
        """Pickle it; a dict, such as the `details` of an RrError, with text in the place of what cannot be pickled."""
        if (blob := part(value)) or type(value) is not dict:
            return blob
        named = cast("dict[object, object]", value)
        return part({name: inner if part(inner) else shown(inner) for name, inner in named.items()})

    made = type(error)
    origin: type[BaseException] = vars(made).get(_ORIGIN, made)
    own = b""
    if _reduces_itself(origin):
        with contextlib.suppress(BaseException):
            own = dumps(error.__reduce_ex__(4))
    above = _up_to_pythons_own(origin)
    classes = [part(cls) for cls in above]
    pythons_own: Any = above[-1]
    _, args, *state = pythons_own.__reduce__(error)  # an OSError's, for example, has more than its `args`
    attributes = {name: attribute(value) for name, value in (state[0] if state else vars(error)).items()}
    return Parts(
        name=made.__qualname__,
        classes=tuple(blob for blob in classes if blob),
        args=tuple(part(arg) or shown(arg) for arg in args),
        own=own,
        attributes={name: blob for name, blob in attributes.items() if blob},
        cause=b"" if error.__cause__ is None else part(error.__cause__),
        suppress_context=error.__suppress_context__,
        text=text if (text := _text(error)) is None or len(text) <= PART_LIMIT_BYTES else None,
    )


def _up_to_pythons_own(cls: type[BaseException]) -> list[type[BaseException]]:
    found: list[type[BaseException]] = []
    for base in cls.__mro__:
        if issubclass(base, BaseException):
            found.append(base)
            if base.__module__ == "builtins":
                break
    return found


def _reduces_itself(cls: type) -> bool:
    names = {"__reduce__", "__reduce_ex__", "__getstate__", "__setstate__"}
    return any(base.__module__ != "builtins" and not names.isdisjoint(vars(base)) for base in cls.__mro__)


def _text(error: BaseException) -> str | None:
    try:
        return exact_text(str(error))
    except BaseException:
        return None


# -- on arrival --------------------------------------------------------------------------------------------------------


def made_of(parts: Parts, loads: Loads) -> BaseException:
    """Return an exception that is made of these parts."""
    error = _by_itself(parts, loads)
    if error is None:  # `or` would call the __bool__ of its class
        error = _by_parts(parts, loads)
    for name, blob in parts.attributes.items():
        if name not in vars(error):
            try:
                setattr(error, name, loads(blob))
            except BaseException:
                continue  # the class of the value is unknown here, or the attribute is a property: the text must do
    if parts.cause:
        try:
            error.__cause__ = loads(parts.cause)
        except BaseException as reason:
            add_note(error, f"its cause cannot be made here: {text_of(reason)}")
    error.__suppress_context__ = parts.suppress_context
    if parts.text is not None and _text(error) != parts.text:
        made = _class_with(type(error), parts.name, parts.text)
        try:
            error.__class__ = made
        except TypeError:  # its layout forbids it
            add_note(error, parts.text)
    return error


def _by_itself(parts: Parts, loads: Loads) -> BaseException | None:
    """Return the exception made by its class's own `__reduce__` value; None without one, or if that fails."""
    if not parts.own:
        return None
    try:
        call, args, *rest = cast("Sequence[Any]", loads(parts.own))
        error = call(*args)
        state = rest[0] if rest else None
        if state is not None:
            error.__setstate__(state)
    except BaseException:
        return None
    return error if isinstance(error, BaseException) else None


def _by_parts(parts: Parts, loads: Loads) -> BaseException:
    args = tuple(_arg(arg, loads) for arg in parts.args)
    for position, blob in enumerate(parts.classes):
        try:
            cls: type[BaseException] = loads(blob)
            if position:
                cls = _class_with(cls, parts.name, parts.text)
            return _new(cls, args)
        except BaseException:
            continue  # the next class above it
    return _new(_class_with(Exception, parts.name, parts.text), args)


def _arg(arg: bytes | str, loads: Loads) -> Any:
    if isinstance(arg, str):
        return arg
    try:
        return loads(arg)
    except BaseException as reason:
        return f"<cannot be made here: {text_of(reason)}>"


def _new(cls: type[BaseException], args: tuple[Any, ...]) -> BaseException:
    pythons_own: Any = _up_to_pythons_own(cls)[-1]
    error: BaseException = pythons_own.__new__(cls, *args)
    pythons_own.__init__(error, *args)
    return error


def _class_with(cls: type[BaseException], name: str, text: str | None) -> type[BaseException]:
    def to_text(_error: BaseException) -> str:
        return text or ""

    namespace: dict[str, Any] = {_ORIGIN: cls, "__module__": cls.__module__, "__qualname__": name}
    if text is not None:
        namespace["__str__"] = to_text
    return type(name.rpartition(".")[2], (cls,), namespace)
