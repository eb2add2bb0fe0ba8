"""Checks of arguments (fields of specifications, the parameters of callbacks), and of installed libraries."""

from __future__ import annotations

import contextlib
import functools
import inspect
import math
import os
import shlex
from collections.abc import Callable, Generator, Mapping, Sequence
from types import FunctionType, MethodType
from typing import Any, NamedTuple, TypeGuard, cast

from msgspec import Struct

from rr_actors.base.errors import (
    InvalidName,
    InvalidSpec,
    MissingDependency,
    NotFound,
    RrError,
    exact_text,
    is_a,
    shown,
    text_of,
)
from rr_actors.base.names import NAME_RULE, check_name

# Checks of specification fields: each failure is an InvalidSpec with the field, the expected and the actual value.


@contextlib.contextmanager
def examined(who: str) -> Generator[None]:
    """Turn an error of a user's code, which the block runs to examine a user's value, into an InvalidSpec of `who`."""
    try:
        yield
    except RrError:
        raise
    except Exception as error:
        expected = "values that can be looked at"
        text = f"{who}: expected {expected}, got one whose own code raised {text_of(error)}"
        raise InvalidSpec(text, field=who, expected=expected, got=None) from error


def invalid(who: str, field: str, expected: str, got: object) -> InvalidSpec:
    """Return the error for `field` of `who` ("ChildSpec 'cameras'")."""
    text = f"{who}: {field}: expected {expected}, got {shown(got)}"
    return InvalidSpec(text, field=field, expected=expected, got=got)


def is_number(value: object) -> TypeGuard[float]:
    """Return whether the value is a finite int or float that fits into a float, as clocks and timers use floats."""
    if is_a(value, bool) or not is_a(value, (int, float)):
        return False
    try:
        return math.isfinite(cast("float", value))
    except OverflowError:
        return False


def check_number(
    value: object, who: str, field: str, *, least: float, most: float | None = None, also: str = ""
) -> None:
    """Check that the value is a finite number from `least` to `most`; `also` names an alternative, for the error."""
    expected = f"a number of at least {least:g}" if most is None else f"a number from {least:g} to {most:g}"
    expected += also
    if not is_number(value) or value < least or (most is not None and value > most):
        raise invalid(who, field, expected, value)


RELIABILITY = "reliability"
"""The label that says how far something is trusted, from 0 to 1."""


class WrongLabel(NamedTuple):
    """A label that cannot be. `key` is its name; "" if the name is wrong."""

    key: str
    expected: str
    got: object


def wrong_label(labels: Mapping[str, object]) -> WrongLabel | None:
    """Return the first of some labels, values by name, that is wrong; None if there is none."""
    for name, value in labels.items():
        if not is_a(name, str) or not name or name.startswith("-"):  # "-cost" in prefer= means less of it
            return WrongLabel("", "names that do not begin with '-'", name)
        if not is_a(value, (str, bool)) and not is_number(value):
            return WrongLabel(name, "a finite number, a text or a truth value", value)
    reliability = labels.get(RELIABILITY, 1)
    if not is_number(reliability) or not 0 <= reliability <= 1:
        return WrongLabel(RELIABILITY, "a number from 0 to 1", reliability)
    return None


def check_positive(value: object, who: str, field: str) -> None:
    """Check that the value is a finite number greater than 0."""
    if not is_number(value) or value <= 0:
        raise invalid(who, field, "a number greater than 0", value)


def check_one_of(value: object, who: str, field: str, choices: Sequence[str]) -> None:
    """Check that the value is one of the words `choices`."""
    if not is_a(value, str) or exact_text(value) not in choices:
        raise invalid(who, field, "one of " + ", ".join(map(repr, choices)), value)


def check_flag(value: object, who: str, field: str) -> None:
    """Check that the value is True or False."""
    if not isinstance(value, bool):
        raise invalid(who, field, "True or False", value)


def check_id(value: object, who: str, field: str = "id") -> None:
    """Check that the value can be a child's id, by the rules of names.check_name()."""
    try:
        check_name(value, field)
    except InvalidName as error:
        raise invalid(who, field, NAME_RULE, value) from error


def path_text(path: object) -> str:
    """Return a path as text; "" if it is no path, is a path of bytes, or its own code raises."""
    try:
        text = os.fspath(cast("str | os.PathLike[str]", path))
    except Exception:
        return ""
    return exact_text(text) if is_a(text, str) else ""


def has_home(path: str) -> bool:
    """Return False for a path that begins with "~" and the name of an unknown user, else True."""
    return not path.startswith("~") or not os.path.expanduser(path).startswith("~")


# Signatures: a callback that does not take the arguments of its later calls is refused when it is registered.


def check_takes(callback: Callable[..., Any], names: Sequence[str], who: str, field: str) -> None:
    """Check that `callback` takes these positional arguments. A callable without a readable signature passes.

    Raises:
        InvalidSpec: `callback` takes others; `.field`, `.expected` and `.got`, both as signatures.
    """
    function, given, keywords = callback, (), dict[str, Any]()
    while isinstance(function, functools.partial):
        given, keywords = (*function.args, *given), {**function.keywords, **keywords}
        function = function.func
    if _plainly_takes(function, len(given) + len(names), keywords):
        return
    try:
        # The wrapper's own signature: it may take other arguments than the function that it wraps.
        signature = inspect.signature(function, follow_wrapped=False)
    except (ValueError, TypeError):  # a builtin
        return
    try:
        signature.bind(*given, *names, **keywords)
    except TypeError as error:
        bare = [parameter.replace(annotation=parameter.empty) for parameter in signature.parameters.values()]
        before = [bare[index].name if index < len(bare) else "self" for index in range(len(given))]
        expected = f"a callable that takes ({', '.join((*before, *names))})"
        name = getattr(function, "__name__", type(function).__name__)
        got = f"{name}{signature.replace(parameters=bare, return_annotation=signature.empty)}"
        raise InvalidSpec(
            f"{who}: {field}: expected {expected}, got {got}: {error}", field=field, expected=expected, got=got
        ) from error


def _plainly_takes(function: object, positional: int, keywords: Mapping[str, object]) -> bool:
    """Return whether a function of Python takes so many positional arguments, and none by keyword.

    False: it does not, or its signature has to be read, which takes ten times as long.
    """
    if keywords:
        return False
    if isinstance(function, MethodType):
        function, positional = function.__func__, positional + 1
    if type(function) is not FunctionType or "__signature__" in function.__dict__:
        return False
    code, defaults = function.__code__, function.__defaults__ or ()
    if code.co_kwonlyargcount:
        return False
    most = positional if code.co_flags & inspect.CO_VARARGS else code.co_argcount
    return code.co_argcount - len(defaults) <= positional <= most


# Checks of installed libraries: those of an extra are imported where they are first needed.


@contextlib.contextmanager
def needing(what: str, extra: str, instead: str = "") -> Generator[None]:
    """Guard the import of a module that needs the libraries of an extra.

    Args:
        what: the part that needs the libraries, for the error: "web".
        extra: the name of the extra that installs them.
        instead: an alternative for the caller, for the error.

    Raises:
        MissingDependency: a library is not installed; the text names the library and the extra.
    """
    try:
        yield
    except ModuleNotFoundError as error:
        library = (error.name or "").partition(".")[0]
        if library in ("", "rr_actors"):
            raise
        raise missing_library(library, what, extra, instead) from error


EXTRAS = {
    "progress": ("rich>=13.7",),
    "cli": ("rich>=13.7", "typer>=0.20"),
    "top": ("rich>=13.7", "typer>=0.20", "textual>=8.2"),
    "web": ("rich>=13.7", "typer>=0.20", "nicegui>=3.5"),
    "otel": ("opentelemetry-sdk>=1.27",),
    "hosts": ("eclipse-zenoh>=1.10",),
    "temoto": ("rich>=13.7", "typer>=0.20", "pyyaml>=6.0"),
    "check": ("hypothesis>=6.112",),
}
"""What the extras of this package install, as in pyproject.toml."""


def missing_library(library: str, what: str, extra: str, instead: str = "") -> MissingDependency:
    """Return the error for a library that is not installed; the other arguments are those of needing().

    It names the libraries themselves, and not this package's extra: the package is on no index.
    """
    wanted = shlex.join(EXTRAS[extra])
    install = f"pip install {wanted}"
    here = f"(in a checkout of rr_actors: pip install '.[{extra}]'){instead}"
    text = f"{what} needs the library {library}, which is not installed. Install it with: {install} {here}"
    return MissingDependency(text, module=library, install=install)


# A check of messages. SupervisorCall is here, since actors, which lie below supervision, have to refuse it.


class SupervisorCall(Struct, frozen=True):
    """A message that only a supervisor understands. Handlers of other actors never get it."""


class SupervisorLook(SupervisorCall, frozen=True):
    """The base of calls that change nothing. A recording does not have them: consoles send many."""


class NoSupervisor(NotFound):
    """The call went to an actor that is no supervisor."""


def check_for_actor(message: object, actor: object) -> None:
    """Raise NoSupervisor if a message to `actor`, which is no supervisor, is a call for one."""
    if isinstance(message, SupervisorCall):
        raise NoSupervisor(f"it is no supervisor, but a child of class {type(actor).__qualname__}")
