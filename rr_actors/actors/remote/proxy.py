"""Proxies: Pykka's ActorProxy for the actors of rr_actors. They can be pickled, and have the operators of the object.

A proxy of an actor in another process asks for the actor's attributes once, and again for a name it does not know.
"""

from __future__ import annotations

import copyreg
import functools
from collections.abc import Callable, Generator, Iterator
from typing import Any, TypeVar, cast

import pykka
from pykka import CallableProxy
from pykka._envelope import Envelope
from pykka._introspection import AttrInfo, introspect_attrs
from pykka.messages import ProxyCall, ProxyGetAttr, ProxySetAttr

from rr_actors.base.errors import UsageError

A = TypeVar("A", bound=pykka.Actor)

AttrPath = tuple[str, ...]
Attributes = dict[AttrPath, tuple[bool, bool]]
"""For each path: whether it is callable, whether it is traversable. Operators are included, as ("__len__",)."""


# -- operators ---------------------------------------------------------------------------------------------------------


def _asking(name: str) -> Callable[..., Any]:
    def operator(self: Any, *args: Any) -> Any:
        return _ask(self, name, args)

    return operator


def _ask(proxy: Any, name: str, args: tuple[Any, ...]) -> Any:
    return proxy.actor_ref.ask(ProxyCall(attr_path=(*proxy._attr_path, name), args=args, kwargs={}))


def _iterating(name: str) -> Callable[[Any], Iterator[Any]]:
    return lambda self: iter(_ask(self, name, ()))


def _enter(self: Any) -> Any:
    entered = _ask(self, "__enter__", ())
    return self if entered == self.actor_ref else entered


def _exit(self: Any, kind: Any, error: Any, _traceback: Any) -> Any:
    return _ask(self, "__exit__", (kind, error, None))  # a traceback cannot be pickled


def _call(self: Any, *args: Any, **kwargs: Any) -> Any:
    path = (*self._attr_path, "__call__")
    return self.actor_ref.ask(ProxyCall(attr_path=path, args=args, kwargs=kwargs), block=False)


_WAITING = ("__len__", "__bool__", "__contains__", "__getitem__", "__setitem__", "__delitem__", "__int__", "__float__")

OPERATORS: dict[str, Callable[..., Any]] = {
    **{name: _asking(name) for name in _WAITING},
    **{name: _iterating(name) for name in ("__iter__", "__reversed__")},
    "__enter__": _enter,
    "__exit__": _exit,
    "__call__": _call,
}
"""The operators that a proxy has if the object has them. All but a call wait for the answer, as in Python."""


def operators_of(thing: object) -> frozenset[str]:
    """Return the operators that the object has, of those in OPERATORS."""
    return frozenset(name for name in OPERATORS if _has(type(thing), name))


def _has(cls: type, name: str) -> bool:
    for base in cls.__mro__:  # not getattr, which also looks at the metaclass
        if name in vars(base):
            return vars(base)[name] is not None
    return False


def as_answer(actor: pykka.Actor, ref: pykka.ActorRef[Any], message: object, result: Any) -> Any:
    """Return an operator's result as the asker gets it: a reference for the actor itself, a list for an iterator.

    Args:
        ref: the reference to the actor, for any process.
    """
    name = message.attr_path[-1] if isinstance(message, ProxyCall) else ""
    if name == "__enter__" and result is actor:
        return ref
    return list(result) if name in ("__iter__", "__reversed__") else result


@functools.lru_cache(256)
def _with_operators(cls: type[Any], operators: frozenset[str]) -> type[Any]:
    if not operators:
        return cls
    return type(cls.__name__, (cls,), {name: OPERATORS[name] for name in operators} | {"__module__": cls.__module__})


# -- attributes --------------------------------------------------------------------------------------------------------


class _OwnProxy:
    """Equals all proxies of one actor: introspection leaves out the attributes that are equal to it."""

    __hash__ = None  # type: ignore[assignment]

    def __init__(self, actor: pykka.Actor) -> None:
        self._urn = actor.actor_ref.actor_urn

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, pykka.ActorProxy):
            return False
        there: Any = cast("pykka.ActorProxy[Any]", other)
        return there.actor_ref.actor_urn == self._urn and not there._attr_path


def attributes_of(actor: pykka.Actor) -> Attributes:
    """Return the actor's public attributes, as Pykka's proxies see them, and its operators."""
    own: Any = _OwnProxy(actor)
    found: dict[AttrPath, AttrInfo] = introspect_attrs(root=actor, proxy=own)
    attributes = {path: (info.callable, info.traversable) for path, info in found.items()}
    parts: list[tuple[AttrPath, object]] = [((), actor)]
    parts += [(path, _at(actor, path)) for path, info in found.items() if info.traversable]
    return attributes | {(*path, name): (True, False) for path, part in parts for name in operators_of(part)}


def _at(thing: Any, path: AttrPath) -> Any:
    for name in path:
        thing = getattr(thing, name)
    return thing


class _Stub:
    """Stands for a part of an actor of another process, for code of Pykka that looks at the actor itself."""


class _Method(_Stub):
    def __call__(self) -> None:
        """Exist only so that callable() returns True."""


class Mirror(_Stub):
    """An object with the attributes of an actor of another process, for pykka.ActorProxy to look at.

    Args:
        inquire: asks the actor's process for the attributes; may raise ActorDeadError.
    """

    def __init__(self, ref: pykka.ActorRef[Any], inquire: Callable[[], Attributes]) -> None:
        self._ref = ref
        self._inquire = inquire

    def __dir__(self) -> list[str]:
        """Copy the attributes again, and return their names: Pykka calls this for a name that it does not know."""
        parts: dict[AttrPath, _Stub] = {(): self}
        for path, (is_callable, is_traversable) in sorted(self._inquire().items(), key=lambda item: len(item[0])):
            stub = _Method() if is_callable else _Stub()
            vars(stub)["_pykka_traversable"] = is_traversable
            parts[path] = stub
            vars(parts[path[:-1]])[path[-1]] = stub
        return list(vars(self))

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Mirror) and other._ref == self._ref

    def __hash__(self) -> int:
        return hash(self._ref)

    def __str__(self) -> str:
        return str(self._ref)


class DistantInbox:
    """The DistantRef.actor_inbox of an actor in another process, to which Pykka's own code sends envelopes."""

    def __init__(self, ref: pykka.ActorRef[Any]) -> None:
        self._ref = ref

    def put(self, envelope: Envelope[Any], /) -> None:
        """Send the envelope's message; get() of its future returns the reply."""
        wanted = envelope.reply_to
        if wanted is None:
            self._ref.tell(envelope.message)
            return
        reply = self._ref.ask(envelope.message, block=False)
        wanted.set_get_hook(lambda timeout: reply.get(timeout=timeout))

    def get(self) -> Envelope[Any]:
        """Raise LookupError: another process's messages cannot be taken."""
        raise LookupError(f"the mailbox of {self._ref} is in another process")

    def empty(self) -> bool:
        """Return True: no message can be taken from here."""
        return True


# -- proxies -----------------------------------------------------------------------------------------------------------


class _Proxy(pykka.ActorProxy[A]):
    """A proxy that equals another if both are of the same part of the same actor."""

    # Pykka looks for these two names in each attribute of an actor. An attribute may be a proxy, and its actor may hold
    # a proxy of the first one.
    _pykka_traversable = False
    pykka_traversable = False

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, pykka.ActorProxy):
            return False
        there: Any = cast("pykka.ActorProxy[Any]", other)
        return (self.actor_ref, self._attr_path) == (there.actor_ref, there._attr_path)

    def __hash__(self) -> int:
        return hash((self.actor_ref, self._attr_path))


def _reduce(self: Any) -> tuple[Any, ...]:
    actor = self._actor
    known = attributes_of(actor) if isinstance(actor, pykka.Actor) else None
    return _arrive, (self.actor_ref, self._attr_path, known)


class LocalProxy(_Proxy[A]):
    """Pykka's own proxy, of an actor of this process."""

    __reduce__ = _reduce

    def __getattr__(self, name: str) -> Any:
        found: Any = super().__getattr__(name)
        return local_proxy(self.actor_ref, found._attr_path) if isinstance(found, pykka.ActorProxy) else found

    def __dir__(self) -> list[str]:
        return sorted({*super().__dir__(), *vars(pykka.ActorProxy)})


def local_proxy(ref: pykka.ActorRef[A], path: AttrPath = ()) -> pykka.ActorProxy[A]:
    """Return the proxy of an actor of this process, or of the part of it at `path`.

    Raises:
        pykka.ActorDeadError: the actor has ended.
    """
    part = _at(ref._actor_weakref(), path)  # pyright: ignore[reportPrivateUsage]
    return _with_operators(LocalProxy, operators_of(part))(actor_ref=ref, attr_path=path)


class DistantProxy(_Proxy[A]):
    """Behaves as pykka.ActorProxy: methods give futures, attributes are read as futures and set at once.

    Args:
        inquire: asks the actor's process for its attributes; may raise ActorDeadError. In an `async def` handler,
            which must not wait, a name is taken as a method when it is called, as an attribute when it is awaited.
        known: the attributes, if they are known. If None, the proxy asks now; if empty, when a name is first used.
    """

    def __init__(
        self,
        *,
        actor_ref: pykka.ActorRef[A],
        inquire: Callable[[], Attributes],
        attr_path: AttrPath = (),
        known: Attributes | None = None,
    ) -> None:
        self.actor_ref = actor_ref
        self._attr_path = attr_path
        self._inquire = inquire
        self._known: Attributes | None = None
        self._learn(_if_allowed(inquire) if known is None else known)

    def _learn(self, known: Attributes | None) -> None:
        self._known = known
        depth = len(self._attr_path)
        mine = [path[depth] for path in known or () if len(path) == depth + 1 and path[:depth] == self._attr_path]
        self.__class__ = _with_operators(DistantProxy, frozenset(OPERATORS).intersection(mine))

    def __getattr__(self, name: str) -> Any:
        """Return a method to call, a proxy of a part, or the future of an attribute's value."""
        if name.startswith("_"):
            raise AttributeError(f"{self!r} has no attribute {name!r}: such names are private")
        path = (*self._attr_path, name)
        if self._known is None or path not in self._known:
            self._learn(_if_allowed(self._inquire))
        if self._known is None:
            return _Unknown(actor_ref=self.actor_ref, attr_path=path)
        if path not in self._known:
            raise AttributeError(f"{self!r} has no attribute {name!r}")
        is_callable, is_traversable = self._known[path]
        if is_callable:
            return CallableProxy(actor_ref=self.actor_ref, attr_path=path)
        if is_traversable:
            return DistantProxy(actor_ref=self.actor_ref, inquire=self._inquire, attr_path=path, known=self._known)
        return self.actor_ref.ask(ProxyGetAttr(attr_path=path), block=False)

    def __setattr__(self, name: str, value: Any) -> None:
        """Set an attribute of the actor, and wait until it is set."""
        if name == "actor_ref" or name.startswith("_"):
            object.__setattr__(self, name, value)
        else:
            self.actor_ref.ask(ProxySetAttr(attr_path=(*self._attr_path, name), value=value))

    def __dir__(self) -> list[str]:
        depth = len(self._attr_path)
        known = self._known or ()
        there = {path[depth] for path in known if path[:depth] == self._attr_path and len(path) > depth}
        return sorted({*there, *vars(type(self)), *vars(DistantProxy), *vars(self), "__class__", "__dict__"})

    def __reduce__(self) -> tuple[Any, ...]:
        return _arrive, (self.actor_ref, self._attr_path, self._known)


def _arrive(ref: Any, attr_path: AttrPath, known: Attributes | None) -> pykka.ActorProxy[Any]:
    """Make an unpickled proxy, without asking the actor: this runs while a message is opened."""
    inquire = getattr(ref, "attributes", None)
    if inquire is None:  # a copy, within its process, of the proxy of a plain Pykka actor
        return pykka.ActorProxy(actor_ref=ref, attr_path=attr_path)
    return DistantProxy(actor_ref=ref, inquire=inquire, attr_path=attr_path, known=known or {})


copyreg.pickle(pykka.ActorProxy, _reduce)  # for proxies that a user makes from a reference


class _Unknown(CallableProxy[A]):
    """A name of the actor: a method if it is called, an attribute if it is awaited, a part if a name of it is used."""

    def __getattr__(self, name: str) -> _Unknown[A]:
        if name.startswith("_"):
            raise AttributeError(f"{self!r} has no attribute {name!r}: such names are private")
        return _Unknown(actor_ref=self.actor_ref, attr_path=(*self._attr_path, name))

    def __await__(self) -> Generator[Any, None, Any]:
        return self.actor_ref.ask(ProxyGetAttr(attr_path=self._attr_path), block=False).__await__()


def _if_allowed(inquire: Callable[[], Attributes]) -> Attributes | None:
    try:
        return inquire()
    except UsageError:
        return None
