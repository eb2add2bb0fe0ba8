"""Calls of an actor's methods from outside: which methods it has for that, one call with plain data, its answer.

A connected program has no key of the system, so it sends and gets plain data alone. The methods are those that an
actor's class adds to Actor or Manager: no callbacks of servers, no hooks, nothing private.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping, Sequence
from types import FunctionType
from typing import Any, cast

import msgspec

from rr_actors.actors.actor import Actor
from rr_actors.actors.messaging.ask_cycles import asking_as
from rr_actors.actors.messaging.futures import Reply
from rr_actors.actors.refs import ActorRef, Timeout
from rr_actors.base.errors import (
    AskFailed,
    NotFound,
    NotSerializable,
    RrError,
    Unavailable,
    UsageError,
    did_you_mean,
    is_a,
    name_of_class,
    text_of,
)
from rr_actors.base.reporting.tracebacks import raised_elsewhere
from rr_actors.base.values.canonical import Codec, encode
from rr_actors.registrar.declarations import Declared, callbacks_of
from rr_actors.registrar.manager import Manager
from rr_actors.runtime.callback_errors import traceback_of
from rr_actors.system.console import console_messages as c
from rr_actors.system.console.connected_registrars import Caller
from rr_actors.system.console.console_view import Command, View

_message = Codec(None, "message")
_BASES = frozenset((*Manager.__mro__, *Actor.__mro__))


def methods_of(cls: type[Any]) -> dict[str, Callable[..., Any]]:
    """Return the methods of an actor's class that may be called from outside, by their names."""
    found: dict[str, Callable[..., Any]] = {}
    callbacks: set[str] = set()
    for base in reversed(cls.__mro__):
        if base in _BASES:
            continue
        for name, value in vars(base).items():
            attribute: Any = value
            if is_a(attribute, Declared):
                callbacks |= callbacks_of(cast("Declared[Any, Any, Any]", value))
            if name.startswith(("_", "on_")) or type(value) is not FunctionType:
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


def begin(actor: str, ref: ActorRef[Any], method: str, given: bytes) -> Reply[Any]:
    """Call a method of an actor, and return the future of its answer.

    Args:
        given: the canonical bytes of a list of the arguments and a dict of those by keyword.

    Raises:
        NotFound: the actor has no such method. `.id`, `.known`
        UsageError: the method does not take these arguments.
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
    return getattr(ref.proxy(), method)(*args, **kwargs)


def given_bytes(actor: str, method: str, args: Sequence[Any], kwargs: Mapping[str, Any] | None = None) -> bytes:
    """Return the canonical bytes of the arguments of a call, as CallActor has them.

    Raises:
        NotSerializable: an argument is no plain data.
    """
    given: list[Any] = [list(args), dict(kwargs or {})]
    return encode(given, f"arguments of {actor}.{method}")


def _arguments(actor: str, given: bytes) -> tuple[list[Any], dict[str, Any]]:
    decoded: Any = _message.decode(given, actor, "arguments")
    if is_a(decoded, list) and [type(part) for part in cast("list[Any]", decoded)] == [list, dict]:
        args, kwargs = cast("tuple[list[Any], dict[str, Any]]", decoded)
        return args, kwargs
    raise UsageError(f"{actor}: arguments: expected a list and a dict by keyword")


def plain_bytes(value: object, what: str) -> bytes:
    """Return the canonical bytes of a value as plain data: a dataclass or Struct as a dict, an enum as its value.

    Raises:
        NotSerializable: it has a part that is none of these.
    """
    try:
        plain: Any = msgspec.to_builtins(value, builtin_types=(bytes,))
    except (TypeError, ValueError, RecursionError) as error:
        raise NotSerializable(f"{what}: expected plain data, or dataclasses of it: {error}", path="") from error
    return encode(plain, what)


class CallActor(Command[c.Replied], frozen=True):
    """Call a method of an actor of the tree, by its path or id.

    Attributes:
        given: a list of the arguments and a dict of those by keyword, plain data, as canonical bytes.
    """

    actor: c.Text
    method: c.Text
    given: c.Value
    timeout_s: c.Seconds = 30.0

    def _carry_out(self, view: View, caller: Caller) -> c.Replied:
        reply = None
        try:
            with asking_as(view.connected.asking(caller, "")):
                reply = begin(self.actor, view.system.ref(self.actor), self.method, self.given)
            answer = reply.get(timeout=self.timeout_s)
        except Timeout as late:
            if reply is not None:
                reply.cancel()
            text = f"{self.actor}: it has not answered within {self.timeout_s:g} s; a later answer reaches nobody"
            raise Unavailable(text) from late
        except Exception as error:
            raise as_heard_outside(self.actor, error) from error
        return c.Replied(plain_bytes(answer, f"answer of {self.actor}.{self.method}"))


def as_heard_outside(actor: str, error: Exception) -> RrError:
    """Return the error for the connected program: one of this package stays of its class, and another is described."""
    raised = {"actor": actor, "traceback": raised_elsewhere(error) or traceback_of(error)}
    if isinstance(error, RrError):
        if raised["traceback"]:  # by the handler, not on the way to it
            error.details = raised | error.details
        return error
    return AskFailed(f"{actor}: {text_of(error)}", error=name_of_class(type(error)), **raised)
