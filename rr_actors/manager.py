"""Manager: an actor with a registrar of its own, and the decorator by which it declares its servers."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any, Generic, Literal, ParamSpec, TypeVar, cast, overload

from rr_actors import pickling
from rr_actors.actors.actor import Actor
from rr_actors.actors.node import Node
from rr_actors.actors.registrar import RegistrarActor
from rr_actors.actors.server import ARGUMENTS, ServerSpec, make_spec
from rr_actors.core.signatures import check_takes
from rr_actors.directory import Status
from rr_actors.errors import AlreadyPresent, InvalidName, InvalidSpec, NameTaken, StartFailed
from rr_actors.registrar import Registrar

P = ParamSpec("P")
R = TypeVar("R")
F = TypeVar("F", bound=Callable[..., Any])


class server(Generic[P, R]):  # noqa: N801 - used as a decorator
    """Declare a method of a Manager as the load callback of a server, and others as its further callbacks::

        @rr.server("camera")
        def load_camera(self, request: OpenCamera) -> Feed: ...

        @load_camera.unload
        def close_camera(self, request: OpenCamera, response: Feed) -> None: ...

    ``status`` and ``recover`` likewise. Options and types as in Registrar.register_server().

    Raises:
        InvalidName, InvalidSpec: an option is wrong.
    """

    def __init__(
        self,
        name: str,
        *,
        linger_s: float = 0.0,
        load_timeout_s: float | None = None,
        recovery: Literal["keep", "reload", "lost"] = "keep",
        request_type: Any = None,
        response_type: Any = None,
    ) -> None:
        if callable(name):  # @rr.server on the method itself
            meant = getattr(name, "__name__", "name")
            raise InvalidName(f"@rr.server: expected a name: write @rr.server({meant!r})", name=name)
        self._options: dict[str, Any] = {"linger_s": linger_s, "load_timeout_s": load_timeout_s, "recovery": recovery}
        self._types = (request_type, response_type)
        self._spec = make_spec(name, _nothing, **self._options)
        self.__name__ = name
        self._others: dict[str, Callable[..., Any]] = {}
        self._load: Callable[..., Any] | None = None

    def __call__(self, load: Callable[P, R]) -> server[P, R]:
        """Take the load callback."""
        self._load = load
        functools.update_wrapper(self, load)
        checked = make_spec(self._spec.name, _without_self(load), **self._options)
        request_type, response_type = self._types
        self._types = request_type or checked.request_type, response_type or checked.response_type
        return self

    @property
    def name(self) -> str:
        """The server's name."""
        return self._spec.name

    def unload(self, callback: F) -> F:
        """Take the unload callback: ``(self, request, response)``."""
        return self._take("unload", callback)

    def status(self, callback: F) -> F:
        """Take the status callback: ``(self, request, status)``."""
        return self._take("status", callback)

    def recover(self, callback: F) -> F:
        """Take the recover callback: ``(self, request, response) -> response``."""
        return self._take("recover", callback)

    def _take(self, role: str, callback: F) -> F:
        if role in self._others:
            raise AlreadyPresent(f"server {self.name!r}: its {role} callback is declared twice", id=self.name)
        if callback.__name__ == self.__name__:  # as one is used to from properties
            expected = f"a method of another name than {self.__name__!r}, the load callback, which it would replace"
            text = f"server {self.name!r}: {role}: expected {expected}"
            raise InvalidSpec(text, field=role, expected=expected, got=callback.__name__)
        check_takes(_without_self(callback), ARGUMENTS[role], f"server {self.name!r}", role)
        self._others[role] = callback
        return callback

    @overload
    def __get__(self, instance: None, owner: Any) -> server[P, R]: ...
    @overload
    def __get__(self, instance: Any, owner: Any) -> Callable[..., R]: ...
    def __get__(self, instance: Any, owner: Any) -> Any:
        if instance is None:
            return self
        assert self._load is not None
        return functools.partial(self._load, instance)

    def spec_for(self, manager: Manager) -> ServerSpec:
        """The server of one manager, its callbacks bound to it. A subclass's method overrides by its name."""
        roles = {role: _bound(manager, callback) for role, callback in self._others.items()}
        assert self._load is not None
        load = functools.partial(self._load, manager)
        request_type, response_type = self._types
        return make_spec(
            self.name, load, request_type=request_type, response_type=response_type, **roles, **self._options
        )


def _bound(manager: Manager, callback: Callable[..., Any]) -> Callable[..., Any]:
    found = getattr(type(manager), callback.__name__, None)
    method = found if callable(found) and not isinstance(found, server) else callback
    return functools.partial(method, manager)


def _without_self(load: Callable[..., Any]) -> Callable[..., Any]:
    """`load` as it is seen on an instance: its annotations are read from its second parameter on."""
    return functools.partial(load, None)


def _nothing(_request: Any) -> None:
    return None


class _NotYet:
    """Manager.registrar before there is one: the instance's own attribute comes in its place."""

    def __get__(self, instance: Manager | None, owner: type[Manager]) -> Any:
        if instance is None:
            return self
        raise AttributeError(
            f"{owner.__qualname__}: self.registrar: not there in __init__, as its catalog is not open yet; it is from "
            f"on_start on, and in every callback: move what needs it to on_start"
        )


class Manager(Actor):
    """An actor that offers resources, or uses those of others, or both, through `self.registrar`.

    Subclass it, declare servers with ``@rr.server``, and put it into a ChildSpec: its child id is its registrar's name.
    In a (re)started manager: the catalog is locked and read, the declared servers are registered (their live resources
    asked after), then ``on_start`` runs and sees ``self.registrar.queries()`` restored, then others are let in.
    """

    _has_registrar = True  # its supervisor keeps the directory's word on it

    registrar: Registrar = cast("Registrar", _NotYet())
    """This manager's registrar; there from on_start on."""

    async def _before_start(self, place: Any) -> None:
        node: Node = place.node
        self._node = node
        actor = await node.open_registrar(place.id, node.config.registrar(place.id))
        self.registrar = Registrar(actor)
        self._served = actor
        actor.on_failure = self._registrar_failed
        place.abandoned = functools.partial(self._close_registrar, None)
        try:
            await node.dispatcher.workers.run(self._register_servers, actor)
            await node.settle(actor)
        except BaseException:
            node.close_registrar(place.id, None)
            raise

    def _register_servers(self, actor: RegistrarActor) -> None:
        """In a worker: reading types and opening what was stored by value runs users' code."""
        declared = self.declared_servers()
        for declaration in declared.values():
            self.registrar.register_spec(declaration.spec_for(self))
        with actor.enter():
            stored_servers = list(actor.whole().stored_servers.values())
        for stored in stored_servers:
            if stored.id not in declared:
                self.registrar.register_spec(pickling.loads(stored.blob), restored=True)

    @classmethod
    def declared_servers(cls) -> dict[str, server[..., Any]]:
        """The servers this class and those it is derived from declare, by name.

        Raises:
            NameTaken: two methods declare the same name.
        """
        found: dict[str, server[..., Any]] = {}
        attributes: dict[str, Any] = {}
        for base in reversed(cls.__mro__):
            attributes.update(vars(base))
        for attribute in attributes.values():
            if isinstance(attribute, server):
                if attribute.name in found:
                    text = f"{cls.__name__}: server {attribute.name!r} is declared by two methods"
                    raise NameTaken(text, name=attribute.name)
                found[attribute.name] = attribute  # pyright: ignore[reportUnknownArgumentType]
        return found

    async def _after_start(self) -> None:
        if not self._is_mine():
            raise StartFailed(f"{self.registrar.name}: ready too late: it had been abandoned", id=self.registrar.name)
        self._node.serve_registrar(self._served)

    async def _after_stop(self, final: bool) -> None:
        if final and self._is_mine():
            await self._node.wind_down(self.registrar.name, self._node.config.stop_timeout_s)
            self._close_registrar(Status.GONE, erase=self.registrar.config.erase_on_destruct)
        else:
            self._close_registrar(None)

    def _close_registrar(self, status: Status | None, *, erase: bool = False) -> None:
        if self._is_mine():
            self._node.close_registrar(self.registrar.name, status, erase=erase)

    def _is_mine(self) -> bool:
        """Whether the registrar of this name is still this manager's: one that was abandoned has a successor."""
        return self._node.registrars.get(self.registrar.name) is self._served

    def _registrar_failed(self, error: BaseException) -> None:
        """A defect in the registrar ends the manager; its supervisor starts it again from the catalog."""
        self.actor_ref.tell(_RegistrarFailed(error))

    def _handle_receive(self, message: Any) -> Any:
        if isinstance(message, _RegistrarFailed):
            raise message.error
        return super()._handle_receive(message)


class _RegistrarFailed:
    def __init__(self, error: BaseException) -> None:
        self.error = error
