"""DistantProxy: Pykka's ActorProxy for an actor in another process. The attributes are asked for once."""

from __future__ import annotations

from collections.abc import Callable, Generator
from typing import Any, TypeVar, cast

import pykka
from pykka import CallableProxy
from pykka.messages import ProxyGetAttr, ProxySetAttr

from rr_actors.errors import UsageError

A = TypeVar("A", bound=pykka.Actor)

AttrPath = tuple[str, ...]
Attributes = dict[AttrPath, tuple[bool, bool]]
"""For each path: whether it is callable, whether it is traversable."""


class DistantProxy(pykka.ActorProxy[A]):
    """Behaves as pykka.ActorProxy: methods give futures, attributes are read as futures and set at once.

    Args:
        inquire: asks the actor's process for its attributes; may raise ActorDeadError. Where waiting is refused, in an
            `async def` handler, what a name stands for shows when it is called, or awaited.
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
        self._known = _if_allowed(inquire) if known is None else known

    def __getattr__(self, name: str) -> Any:
        """A method to call, a part to go into, or the future of an attribute's value."""
        if name.startswith("_"):
            raise AttributeError(f"{self!r} has no attribute {name!r}: such names are private")
        path = (*self._attr_path, name)
        if self._known is None or path not in self._known:
            self._known = _if_allowed(self._inquire)
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
        """Set an attribute of the actor, and wait until it is."""
        if name == "actor_ref" or name.startswith("_"):
            object.__setattr__(self, name, value)
        else:
            self.actor_ref.ask(ProxySetAttr(attr_path=(*self._attr_path, name), value=value))

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, DistantProxy):
            return False
        there = cast("DistantProxy[Any]", other)
        return (self.actor_ref, self._attr_path) == (there.actor_ref, there._attr_path)

    def __hash__(self) -> int:
        return hash((self.actor_ref, self._attr_path))

    def __repr__(self) -> str:
        return f"<ActorProxy for {self.actor_ref}, attr_path={self._attr_path!r}>"

    def __dir__(self) -> list[str]:
        depth = len(self._attr_path)
        known = self._known or ()
        return sorted({path[depth] for path in known if path[:depth] == self._attr_path and len(path) > depth})


class _Unknown(CallableProxy[A]):
    """Something of the actor that is a method if it is called, an attribute if awaited, a part if it has parts."""

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
