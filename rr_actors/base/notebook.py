"""Notebooks: how objects show themselves there, in mime bundles and tables; and classes that a cell defines anew.

A child gets its class when it starts, and keeps that code when it is restarted. To define the class anew changes
nothing in it, and raises no error. So the program is warned.
"""

from __future__ import annotations

import sys
import warnings
import weakref
from collections.abc import Callable, Iterable, Sequence
from types import CodeType, FunctionType
from typing import Any, cast

import msgspec

MOST = 200
"""The most rows of a table; its last line counts the rows that are left out."""

_ESCAPES = str.maketrans({"&": "&amp;", "<": "&lt;", ">": "&gt;", '"': "&quot;", "'": "&#x27;"})


def bundle(text: str, *, html: str | None = None, svg: str | None = None, mermaid: str | None = None) -> dict[str, str]:
    """Return the result for `_repr_mimebundle_`: the text, and the other given forms."""
    forms = {"text/plain": text, "text/html": html, "image/svg+xml": svg, "text/vnd.mermaid": mermaid}
    return {name: form for name, form in forms.items() if form is not None}


def bundle_or_text(text: str, html: Callable[[], str]) -> dict[str, str]:
    """Return a bundle of the text and of what html() returns; if html() fails, the text and the error."""
    try:
        return bundle(text, html=html())
    except Exception as error:  # its process is gone, or a user's value raised: showing an object must not raise
        return bundle(f"{text} ({type(error).__name__}: {error})")


def escape(text: str) -> str:
    """Return the text escaped for HTML and XML, also within quotes.

    The standard library's html.escape does the same. Its module takes a hundredth of this package's import.
    """
    return text.translate(_ESCAPES)


def table(columns: Sequence[str], rows: Iterable[Sequence[object]], caption: str = "") -> str:
    """Return an HTML table of these rows, with everything escaped."""
    found = list(rows)
    parts = [f"<caption>{escape(caption)}</caption>" if caption else ""]
    if any(columns):
        parts.append(f"<tr>{''.join(f'<th>{escape(column)}</th>' for column in columns)}</tr>")
    parts += [f"<tr>{''.join(_cell(cell) for cell in row)}</tr>" for row in found[:MOST]]
    if len(found) > MOST:
        parts.append(f'<tr><td colspan="{len(columns)}">{len(found) - MOST} more are left out</td></tr>')
    return f"<table>{''.join(parts)}</table>"


def _cell(cell: object) -> str:
    return f'<td style="text-align:left">{escape("" if cell is None else str(cell))}</td>'


# -- classes that are defined anew -------------------------------------------------------------------------------------

_started: weakref.WeakValueDictionary[tuple[str, str], type] = weakref.WeakValueDictionary()
_named: weakref.WeakSet[type] = weakref.WeakSet()  # of those the program was warned
_MADE = frozenset(
    ("__dict__", "__weakref__", "__module__", "__firstlineno__", "__static_attributes__", "__abstractmethods__")
)
_PLAIN = (str, bytes, int, float, bool, type(None))


def note_started(classes: Iterable[type]) -> None:
    """Note the classes that children of this process's systems are started with."""
    _started.update({_key(cls): cls for cls in classes})


def warn_of_redefined(cls: type, *, by_name: bool = False) -> None:
    """Warn, once for each class, if a class of the same name with other code was noted.

    Args:
        by_name: `cls` was noted itself: warn of the class that has its name now.
    """
    if by_name:
        cls = _now(cls)
    started = _started.get(_key(cls))
    if started is None or started is cls or cls in _named or not _differ(started, cls):
        return
    _named.add(cls)
    text = (
        f"{cls.__qualname__} was defined anew, and the system still runs the code from before. To bring the new code"
        " in, stop the system (system.stop()) and start it again: what managers hold is read from their catalogs"
    )
    warnings.warn_explicit(text, RuntimeWarning, cls.__module__, 1)  # with no registry: it is shown each time


def _key(cls: type) -> tuple[str, str]:
    return cls.__module__, cls.__qualname__


def _now(cls: type) -> type:
    """Return the class that has the name of this one now."""
    found: object = sys.modules.get(cls.__module__)
    for name in cls.__qualname__.split("."):
        found = getattr(found, name, None)
    return found if isinstance(found, type) else cls


def _differ(before: Any, now: Any) -> bool:
    """Return whether two classes, or what they have, differ in code or in plain data. Line numbers do not count."""
    if type(before) is not type(now):
        return True
    if isinstance(before, type):
        if _key(before) != _key(now):
            return before is not now
        return _any_differs(_table(before), _table(now))
    if isinstance(before, CodeType):
        return _any_differs(_parts(before), _parts(now))
    if isinstance(before, FunctionType):
        return _any_differs(*({"code": f.__code__, "defaults": f.__defaults__} for f in (before, now)))
    if isinstance(before, staticmethod | classmethod):
        return _differ(cast("Any", before).__func__, now.__func__)
    if isinstance(before, property):
        return any(_differ(getattr(before, part), getattr(now, part)) for part in ("fget", "fset"))
    if isinstance(before, tuple | list):
        pair = cast("list[Any]", before), cast("list[Any]", now)
        return len(pair[0]) != len(pair[1]) or any(map(_differ, *pair))
    if isinstance(before, dict):
        return _any_differs(cast("dict[Any, Any]", before), now)
    if isinstance(before, msgspec.Struct):
        return _any_differs(msgspec.structs.asdict(before), msgspec.structs.asdict(now))
    if hasattr(before, "__wrapped__"):  # a decorated function, as the declaration of a server is
        return _any_differs(_table(before), _table(now))
    return isinstance(before, _PLAIN) and before != now


def _any_differs(before: dict[Any, Any], now: dict[Any, Any]) -> bool:
    return before.keys() != now.keys() or any(_differ(value, now[key]) for key, value in before.items())


def _table(one: object) -> dict[str, Any]:
    """Return what a class, or a decorated function, has."""
    names: dict[str, Any] = {**vars(one)}
    names.pop("_owner", None)  # of a server's declaration: its class
    return {name: value for name, value in names.items() if name not in _MADE and not name.startswith("_abc_")}


def _parts(code: CodeType) -> dict[str, Any]:
    return {"code": code.co_code, "of": [*code.co_consts], "names": code.co_names, "variables": code.co_varnames}
