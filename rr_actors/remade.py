"""Remade exceptions: an exception as bytes, and an exception of the same class made of them in another process.

Python pickles an exception as a call of its class with `args`, which fails where `__init__` takes anything else. Here
its parts travel instead, each on its own: one that cannot leave, or cannot be opened, takes nothing else with it. The
class's `__init__` does not run again. A class that is unknown on arrival is replaced by a subclass of its first base
that is known, and one whose text would be another by a subclass with that text: `except` catches both.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextvars import ContextVar
from typing import Any, NamedTuple, cast

from rr_actors.errors import shown

Dumps = Callable[[object], bytes]
"""Pickles a part; raises whatever the part's own code does."""

Loads = Callable[[bytes], Any]
"""Opens a part; raises whatever the part's own code does."""


class Parts(NamedTuple):
    """What an exception is made of; bytes are pickles, b"" is a part that could not leave.

    Attributes:
        name: of its class.
        classes: its class and those above it, up to the first of Python's own.
        args: what its class among Python's own is made with; text in the place of one that could not leave.
        own: what the class's own `__reduce__` returned, if it has one.
        attributes: its `__dict__`, and fields that its class among Python's own has.
        text: what str() gave; None if that failed.
    """

    name: str
    classes: tuple[bytes, ...]
    args: tuple[bytes | str, ...]
    own: bytes
    attributes: dict[str, bytes]
    cause: bytes
    suppress_context: bool
    text: str | None


_ORIGIN = "__rr_made_from__"  # of a class that was made here: what it was made from

_leaving: ContextVar[tuple[int, ...]] = ContextVar("rr_actors_leaving", default=())


def has_parts(error: BaseException) -> bool:
    """Return whether plain pickle could lose part of it; for Python's own exceptions it cannot."""
    return type(error).__module__ != "builtins" or error.__cause__ is not None or isinstance(error, BaseExceptionGroup)


def reduced(error: BaseException, dumps: Dumps, make: Callable[[Parts], BaseException]) -> tuple[Any, ...]:
    """Return what `__reduce__` should, for an exception of any class; `make` calls made_of()."""
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
            return dumps(value)
        except Exception:
            return b""

    made = type(error)
    origin: type[BaseException] = vars(made).get(_ORIGIN, made)
    above = _up_to_pythons_own(origin)
    classes = [part(cls) for cls in above]
    pythons_own: Any = above[-1]
    _, args, *state = pythons_own.__reduce__(error)  # of an OSError, say, also what is not in `args`
    attributes = {name: part(value) for name, value in (state[0] if state else vars(error)).items()}
    return Parts(
        name=made.__qualname__,
        classes=tuple(blob for blob in classes if blob),
        args=tuple(part(arg) or shown(arg) for arg in args),
        own=part(error.__reduce_ex__(4)) if _reduces_itself(origin) else b"",
        attributes={name: blob for name, blob in attributes.items() if blob},
        cause=b"" if error.__cause__ is None else part(error.__cause__),
        suppress_context=error.__suppress_context__,
        text=_text(error),
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
        return str(error)
    except Exception:
        return None


# -- on arrival --------------------------------------------------------------------------------------------------------


def made_of(parts: Parts, loads: Loads) -> BaseException:
    """Return the exception that the parts are of."""
    error = _by_itself(parts, loads) or _by_parts(parts, loads)
    for name, blob in parts.attributes.items():
        if name not in vars(error):
            try:
                setattr(error, name, loads(blob))
            except Exception:
                continue  # its class is not known here, or it is computed; the text says what matters
    if parts.cause:
        try:
            error.__cause__ = loads(parts.cause)
        except Exception as reason:
            error.add_note(f"its cause cannot be made here: {reason!r}")
    error.__suppress_context__ = parts.suppress_context
    if parts.text is not None and _text(error) != parts.text:
        made = _class_with(type(error), parts.name, parts.text)
        try:
            error.__class__ = made
        except TypeError:  # its layout forbids it
            error.add_note(parts.text)
    return error


def _by_itself(parts: Parts, loads: Loads) -> BaseException | None:
    """As its own `__reduce__` wants it."""
    if not parts.own:
        return None
    try:
        call, args, *rest = cast("Sequence[Any]", loads(parts.own))
        error = call(*args)
        state = rest[0] if rest else None
        if state is not None:
            error.__setstate__(state)
    except Exception:
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
        except Exception:
            continue  # the next class above it
    return _new(_class_with(Exception, parts.name, parts.text), args)


def _arg(arg: bytes | str, loads: Loads) -> Any:
    if isinstance(arg, str):
        return arg
    try:
        return loads(arg)
    except Exception as reason:
        return f"<cannot be made here: {reason!r}>"


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
