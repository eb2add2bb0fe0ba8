"""Calls of an actor's methods from outside: which methods it has for that, one call with plain data, its answer.

A client has no key of the system, so it sends and gets plain data alone. The methods are those that an actor's class
adds to Actor or Manager: no callbacks of servers, no hooks, nothing private.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable
from typing import Any, cast

import msgspec

from rr_actors.actors.actor import Actor
from rr_actors.actors.messaging.futures import Reply
from rr_actors.actors.refs import ActorRef
from rr_actors.base.errors import (
    NotFound,
    NotSerializable,
    RrError,
    Unavailable,
    UsageError,
    did_you_mean,
    is_a,
    text_of,
)
from rr_actors.base.values.canonical import Codec, encode
from rr_actors.registrar.declarations import Declared, callbacks_of
from rr_actors.registrar.manager import Manager
from rr_actors.system.console import console_messages as c

_message = Codec(None, "message")
_BASES = frozenset((*Manager.__mro__, *Actor.__mro__))


def ask(actor: str, ref: ActorRef[Any], message: object, timeout_s: float) -> Any:
    """Ask an actor for a client, and return its answer.

    Raises:
        Unavailable: it has not answered in time.
        RrError: the actor could not be asked, or its handler raised.
    """
    return _heard(actor, ref.ask(message, block=False), timeout_s)


def _heard(actor: str, reply: Reply[Any], timeout_s: float) -> Any:
    try:
        error = reply.exception(timeout_s)
    except TimeoutError as late:
        reply.cancel()
        text = f"{actor}: it has not answered within {timeout_s:g} s; a later answer reaches nobody"
        raise Unavailable(text) from late
    if error is not None and not isinstance(error, RrError):  # raised by the actor's handler
        raise RrError(f"{actor}: {text_of(error)}") from error
    return reply.get()


def methods_of(cls: type[Any]) -> dict[str, Callable[..., Any]]:
    """Return the methods of an actor's class that may be called from outside, by their names."""
    found: dict[str, Callable[..., Any]] = {}
    callbacks: set[str] = set()
    for base in reversed(cls.__mro__):
        if base in _BASES:
            continue
        for name, value in vars(base).items():
            if is_a(value, Declared):
                callbacks |= callbacks_of(cast("Declared[Any, Any, Any]", value))
            if name.startswith(("_", "on_")) or not is_a(value, type(ask)):
                found.pop(name, None)
            else:
                found[name] = value
    return {name: found[name] for name in sorted(found) if name not in callbacks}


def described(cls: type[Any]) -> list[c.MethodRow]:
    """Return what people need to call the methods of a class: the names, the parameters, and what they do."""
    return [
        c.MethodRow(name, name + _parameters(method), inspect.getdoc(method) or "")
        for name, method in methods_of(cls).items()
    ]


def _parameters(method: Callable[..., Any]) -> str:
    """Return the parameters of a method as its source shows them, without `self`."""
    signature = inspect.signature(method)
    parameters = [one.replace(annotation=_unquoted(one.annotation)) for one in signature.parameters.values()]
    returned = _unquoted(signature.return_annotation)
    return str(signature.replace(parameters=parameters[1:], return_annotation=returned))


def _unquoted(annotation: Any) -> Any:
    return _Source(annotation) if is_a(annotation, str) else annotation


class _Source(str):
    """An annotation that a module has as text, as it stands there."""

    __slots__ = ()

    def __repr__(self) -> str:
        return str(self)


def call(actor: str, ref: ActorRef[Any], method: str, given: bytes, timeout_s: float) -> bytes:
    """Call a method of an actor, and return the canonical bytes of its answer.

    Args:
        given: the canonical bytes of a list of the arguments and a dict of those by keyword.

    Raises:
        NotFound: the actor has no such method. `.id`, `.known`
        UsageError: the method does not take these arguments.
        NotSerializable: the answer is no plain data, and nothing that becomes plain data.
    """
    methods = methods_of(ref.actor_class)
    if method not in methods:
        known = tuple(methods)
        there = did_you_mean(method, known) or f"; it has {', '.join(known) or 'none'}"
        raise NotFound(f"{actor}: no method {method!r} that may be called from outside{there}", id=method, known=known)
    args, kwargs = _arguments(actor, given)
    try:
        inspect.signature(methods[method]).bind(None, *args, **kwargs)
    except TypeError as error:
        raise UsageError(f"{actor}: {method}{_parameters(methods[method])}: {error}") from None
    reply: Reply[Any] = getattr(ref.proxy(), method)(*args, **kwargs)
    answer = _heard(actor, reply, timeout_s)
    return encode(plain(answer, f"answer of {actor}.{method}"), f"answer of {actor}.{method}")


def _arguments(actor: str, given: bytes) -> tuple[list[Any], dict[str, Any]]:
    match _message.decode(given, actor, "arguments"):
        case [list() as args, dict() as kwargs]:
            return cast("list[Any]", args), cast("dict[str, Any]", kwargs)
        case _:
            raise UsageError(f"{actor}: arguments: expected a list and a dict by keyword")


def plain(value: object, what: str) -> Any:
    """Return a value as plain data: a dataclass or Struct as a dict, an enum as its value, a set as a list.

    Raises:
        NotSerializable: it has a part that none of these is.
    """
    try:
        return msgspec.to_builtins(value, builtin_types=(bytes,))
    except (TypeError, ValueError, RecursionError) as error:
        raise NotSerializable(f"{what}: expected plain data, or dataclasses of it: {error}", path="") from error
