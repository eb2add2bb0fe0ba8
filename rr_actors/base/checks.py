"""Checks of what people pass, and of what is installed.

What they pass: fields of specifications, and callbacks that cannot be called as they will be.
"""

from __future__ import annotations

import contextlib
import functools
import inspect
import math
import os
from collections.abc import Callable, Generator, Sequence
from types import TracebackType
from typing import Any, TypeGuard, cast

from rr_actors.base.errors import InvalidName, InvalidSpec, RrError, UsageError, exact_text, is_a, shown, text_of
from rr_actors.base.names import check_name

# Checks of specification fields: each failure is an InvalidSpec naming the field, what it expected and what it got.


@contextlib.contextmanager
def examined(who: str) -> Generator[None, None, None]:
    """Look at what a user has given: what its own code raises meanwhile becomes an InvalidSpec.

    Raises:
        InvalidSpec: `.field` is `who`.
    """
    try:
        yield
    except RrError:
        raise
    except Exception as error:
        expected = "values that can be looked at"
        text = f"{who}: expected {expected}, got one whose own code raised {text_of(error)}"
        raise InvalidSpec(text, field=who, expected=expected, got=None) from error


def invalid(who: str, field: str, expected: str, got: object) -> InvalidSpec:
    """The error for `field` of `who` ("ChildSpec 'cameras'")."""
    text = f"{who}: {field}: expected {expected}, got {shown(got)}"
    return InvalidSpec(text, field=field, expected=expected, got=got)


def is_number(value: object) -> TypeGuard[float]:
    """Whether it is a finite int or float, and not more than a float can be: what is counted on becomes one."""
    if is_a(value, bool) or not is_a(value, (int, float)):
        return False
    try:
        return math.isfinite(cast("float", value))
    except OverflowError:
        return False


def check_number(
    value: object, who: str, field: str, *, least: float, most: float | None = None, also: str = ""
) -> None:
    """A finite int or float, at least `least` and at most `most`; `also` says what else would do."""
    expected = f"a number of at least {least:g}" if most is None else f"a number from {least:g} to {most:g}"
    expected += also
    if not is_number(value):
        raise invalid(who, field, expected, value)
    if value < least or (most is not None and value > most):
        raise invalid(who, field, expected, value)


def check_positive(value: object, who: str, field: str) -> None:
    """A finite number greater than 0."""
    if not is_number(value) or value <= 0:
        raise invalid(who, field, "a number greater than 0", value)


def check_one_of(value: object, who: str, field: str, choices: Sequence[str]) -> None:
    """One of the given words."""
    if not is_a(value, str) or exact_text(cast("str", value)) not in choices:
        raise invalid(who, field, "one of " + ", ".join(map(repr, choices)), value)


def check_flag(value: object, who: str, field: str) -> None:
    """True or False."""
    if not isinstance(value, bool):
        raise invalid(who, field, "True or False", value)


def check_id(value: object, who: str) -> None:
    """A child's id: what names.check_name takes."""
    try:
        check_name(value, "id")
    except InvalidName as error:
        expected = "1 to 64 ASCII letters, digits, '_', '-' or '.', not starting with '.'"
        raise invalid(who, "id", expected, value) from error


def has_home(path: str) -> bool:
    """Whether the user is known whom a path names by "~" at its beginning; also true of a path without."""
    return not path.startswith("~") or not os.path.expanduser(path).startswith("~")


# Signatures: whether a callback can be called as it will be, found out when it is registered.


def check_takes(callback: Callable[..., Any], names: Sequence[str], who: str, field: str) -> None:
    """That `callback` can be called with these arguments, by position. What has no signature to be read may pass.

    Raises:
        InvalidSpec: it takes others; `.field`, `.expected` and `.got`, both as signatures.
    """
    function, given, keywords = callback, (), dict[str, Any]()
    while isinstance(function, functools.partial):
        given, keywords = (*function.args, *given), {**function.keywords, **keywords}
        function = function.func
    try:
        # Not of what it wraps: a wrapper may take other arguments than it passes on.
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


# Checks of what is installed: the libraries of an extra are imported where they are first needed.


class Extra:
    """Guard the import of a module that needs the libraries of an extra, as the context of a `with` block.

    Args:
        what: needs them, for the error: "web".
        extra: the name of the extra that installs them.
        instead: what else a caller may do, for the error.

    Raises:
        UsageError: a library is not installed; the text names the library and the extra.
    """

    def __init__(self, what: str, extra: str, instead: str = "") -> None:
        self._what = what
        self._extra = extra
        self._instead = instead

    def missing(self, library: str) -> UsageError:
        """Return the error for a library that is not installed."""
        install = f"pip install 'rr-actors[{self._extra}]'{self._instead}"
        text = f"{self._what} needs the library {library}, which is not installed. Install it with: {install}"
        return UsageError(text, library=library, extra=self._extra)

    def __enter__(self) -> None:
        pass

    def __exit__(self, _kind: object, error: BaseException | None, _traceback: TracebackType | None) -> None:
        if isinstance(error, ModuleNotFoundError):
            library = (error.name or "").partition(".")[0]
            if library not in ("", "rr_actors"):
                raise self.missing(library) from error
