"""Signatures: whether a callback can be called as it will be, found out when it is registered."""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable, Sequence
from typing import Any

from rr_actors.errors import InvalidSpec


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
