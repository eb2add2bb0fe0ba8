"""Which thread may call a function, and whether it has the lock: declared here, and checked while the tests run.

    @on_loop                on a function: the event loop calls it; on a class: its methods, except those marked
    @any_thread             any thread may call this method of such a class
    @with_lock              the calling thread has the lock of the registrar to which the object belongs

Nothing is checked, and a decorator returns what it is given, unless the environment variable CHECK is set when this
module is imported. A call that breaks a rule raises AssertionError, and is noted in `broken`: the caller may catch it.
"""

from __future__ import annotations

import functools
import os
import threading
from collections.abc import Callable
from types import FunctionType
from typing import Any, ParamSpec, TypeVar

CHECK = "RR_ACTORS_CHECK_THREADS"
CHECKED = CHECK in os.environ

broken: list[str] = []

_LOOP = "rr-loop"
_anywhere: set[object] = set()  # what any_thread() marks

P = ParamSpec("P")
R = TypeVar("R")
T = TypeVar("T")


def on_loop(declared: T) -> T:
    """Declare that the event loop alone calls a function, or the methods of a class."""
    if not CHECKED:
        return declared
    if isinstance(declared, type):
        for name, found in list(vars(declared).items()):
            if isinstance(found, FunctionType) and not name.startswith("__") and found not in _anywhere:
                setattr(declared, name, on_loop(found))
        return declared
    return _checked(declared, _check_loop)


def any_thread(function: Callable[P, R]) -> Callable[P, R]:
    """Declare that any thread may call a method of a class whose other methods the event loop calls."""
    if CHECKED:
        _anywhere.add(function)
    return function


def with_lock(function: Callable[P, R]) -> Callable[P, R]:
    """Declare that a thread calls a method with the lock of the registrar to which the object belongs."""
    return any_thread(_checked(function, _check_lock)) if CHECKED else function


def _checked(function: Any, check: Callable[[str, Any], None]) -> Any:
    @functools.wraps(function)
    def checked(*args: Any, **kwargs: Any) -> Any:
        check(function.__qualname__, args[0])
        return function(*args, **kwargs)

    return checked


def _check_loop(name: str, _owner: object) -> None:
    thread = threading.current_thread().name
    if thread != _LOOP and any(other.name == _LOOP for other in threading.enumerate()):  # else a test has a part alone
        _break(f"{name}: called in thread {thread!r}, not by the event loop")


def _check_lock(name: str, owner: Any) -> None:
    lock = getattr(owner, "lock", None) or owner._registrar.lock
    if hasattr(lock, "_is_owned") and not lock._is_owned():  # else it is a test's own
        _break(f"{name}: called without the lock")


def _break(text: str) -> None:
    broken.append(text)
    raise AssertionError(text)
