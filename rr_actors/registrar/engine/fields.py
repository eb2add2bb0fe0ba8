"""The types of a server's requests and responses, as the load callback is declared.

Fields: a load callback of several parameters, or none, takes the fields of the request. Its server's request type is
a dataclass that is made of these parameters, so defaults are filled in before requests are compared.
"""

from __future__ import annotations

import contextlib
import copy
import dataclasses
import functools
import inspect
import typing
from collections.abc import Callable, Sequence
from typing import Any, cast

from rr_actors.base.errors import InvalidSpec, NotSerializable, shown
from rr_actors.base.values.canonical import encode

Callback = Callable[..., Any]
_VARIABLE = (inspect.Parameter.VAR_POSITIONAL, inspect.Parameter.VAR_KEYWORD)
_EMPTY = inspect.Parameter.empty
_REQUEST, _REST = 0, 1  # what a parameter takes if it takes no field


class Fields:
    """The base of the request types that are made of parameters."""


def field_names(request_type: object) -> list[str] | None:
    """Return the fields that the callbacks of a server take; None if they take the whole request."""
    if isinstance(request_type, type) and issubclass(request_type, Fields):
        return [field.name for field in dataclasses.fields(cast("Any", request_type))]
    return None


def annotated_types(load: Callback, who: str) -> tuple[Any, Any]:
    """Return the request and response type of a load callback: its annotations, or a type made of its parameters.

    None for each one not found.
    """
    hints: dict[str, Any] = {}
    parameters: list[inspect.Parameter] = []
    with contextlib.suppress(Exception):  # names that cannot be resolved, builtins without a signature: any plain value
        parameters = list(inspect.signature(load).parameters.values())
        hints = hints_of(load)
    request = fields_type(load, hints, who) or (hints.get(parameters[0].name) if parameters else None)
    return _plain(request), _plain(hints.get("return"))


def hints_of(load: Callback) -> dict[str, Any]:
    """Return annotations as types; look up names in text where the function is defined, and in the calling frames."""
    function = load.func if isinstance(load, functools.partial) else load
    if not inspect.isroutine(function):
        function = type(function).__call__  # a callable object's annotations are its method's
    try:
        return typing.get_type_hints(function, include_extras=True)
    except NameError:  # classes of a function's body: they are in the frames that led here
        names: dict[str, Any] = {}
        frame = inspect.currentframe()
        while frame is not None:
            names = {**frame.f_locals, **names}
            frame = frame.f_back
        return typing.get_type_hints(function, localns=names, include_extras=True)


def _plain(hint: Any) -> Any:
    return None if hint in (None, type(None), Any, object) else hint


def fields_type(load: Callback, hints: dict[str, Any], who: str) -> type[Fields] | None:
    """Return the request type that the parameters of a load callback make; None if it takes the whole request.

    It does so if it has one parameter, or the first is named `request`, is positional only, or begins with "_".

    Args:
        hints: the annotations of `load`, as types.

    Raises:
        InvalidSpec: the default of a parameter cannot stand in a request.
    """
    parameters = _parameters(load)
    if parameters is None or (len(parameters) == 1 and parameters[0].kind is not inspect.Parameter.KEYWORD_ONLY):
        return None
    if parameters and (
        parameters[0].kind is inspect.Parameter.POSITIONAL_ONLY
        or parameters[0].name == "request"
        or parameters[0].name.startswith("_")
    ):
        return None
    fields: list[Any] = []
    for parameter in parameters:
        hint, default = hints.get(parameter.name, Any), parameter.default
        if default is _EMPTY:
            fields.append((parameter.name, hint))
            continue
        try:
            encode(default)
        except NotSerializable as error:
            expected = "a default that a request can have (or name the first parameter `request`, to get all of it)"
            text = f"{who}: load: parameter {parameter.name}: expected {expected}, got {shown(default)}"
            raise InvalidSpec(text, field="load", expected=expected, got=default) from error
        is_plain = default is None or isinstance(default, (bool, int, float, str, bytes))
        field: Any = dataclasses.field(default=default)
        if not is_plain:
            field = dataclasses.field(default_factory=functools.partial(copy.deepcopy, default))
        fields.append((parameter.name, hint | None if default is None and hint is not Any else hint, field))
    name = f"{_name(load)}({', '.join(parameter.name for parameter in parameters)})"
    made: Any = dataclasses.make_dataclass(name, fields, bases=(Fields,), frozen=True, kw_only=True)
    return made


def by_fields(callback: Callback, role: str, arguments: Sequence[str], names: Sequence[str], who: str) -> Callback:
    """Return a function that gives a callback the fields that it has parameters for; it takes `arguments`.

    A parameter named `request` takes the whole request, and one other the response or the status.

    Args:
        role: "load", "unload", "status" or "recover".
        arguments: "request", and what else callbacks of this role get.
        names: the fields.

    Raises:
        InvalidSpec: the callback needs other arguments.
    """
    parameters = _parameters(callback)
    if parameters is None:
        return callback
    plan: list[tuple[str | None, str | int]] = []
    free = [_REST] * (len(arguments) - 1)
    for parameter in parameters:
        keyword = None if parameter.kind is inspect.Parameter.POSITIONAL_ONLY else parameter.name
        if parameter.name in names:
            plan.append((keyword, parameter.name))
        elif parameter.name == "request":
            plan.append((keyword, _REQUEST))
        elif free and (parameter.default is _EMPTY or parameter.name in arguments):
            plan.append((keyword, free.pop()))
        elif parameter.default is _EMPTY:
            expected = f"a callable that takes ({', '.join((*names, *arguments[1:]))})"
            text = f"{who}: {role}: expected {expected}, got {_name(callback)}{inspect.signature(callback)}"
            raise InvalidSpec(text, field=role, expected=expected, got=callback)
    return functools.partial(_call, callback, tuple(plan))


def _call(callback: Callback, plan: Sequence[tuple[str | None, str | int]], request: Any, *rest: Any) -> Any:
    given, keywords = list[Any](), dict[str, Any]()
    for keyword, source in plan:
        value = getattr(request, source) if isinstance(source, str) else (request, *rest)[source]
        if keyword is None:
            given.append(value)
        else:
            keywords[keyword] = value
    return callback(*given, **keywords)


def _parameters(callback: Any) -> list[inspect.Parameter] | None:
    """Return the parameters that can take fields; None if they cannot be read, or there may be any number of them."""
    try:
        signature = inspect.signature(callback, follow_wrapped=False)
        if {parameter.kind for parameter in signature.parameters.values()} == set(_VARIABLE):
            signature = inspect.signature(callback)  # a wrapper that passes on whatever it gets
    except (ValueError, TypeError):
        return None
    parameters = list(signature.parameters.values())
    if any(parameter.kind in _VARIABLE for parameter in parameters):
        return None
    bound: Any = cast("Any", callback).keywords if isinstance(callback, functools.partial) else ()
    is_lambda = _name(cast("Any", callback)) == "<lambda>"  # its defaults capture variables
    return [
        parameter
        for parameter in parameters
        if parameter.name not in bound
        and (parameter.default is _EMPTY or not (is_lambda or parameter.name.startswith("_")))
    ]


def _name(callback: Any) -> str:
    function: Any = callback
    while isinstance(function, functools.partial):
        function = cast("Any", function).func
    return getattr(function, "__name__", type(function).__name__)
