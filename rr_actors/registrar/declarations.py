"""Declarations: the decorator with which a Manager's method declares a server, and the object that results."""

from __future__ import annotations

import copy
import functools
from collections.abc import Awaitable, Callable, Coroutine, Mapping
from types import FunctionType
from typing import Any, Generic, Literal, NamedTuple, Protocol, Self, TypeVar, cast, overload

from msgspec.structs import replace

from rr_actors.base.checks import check_number, examined
from rr_actors.base.errors import AlreadyPresent, InvalidName, InvalidSpec, UnknownRegistrar, UsageError, is_a, shown
from rr_actors.base.names import check_name
from rr_actors.base.notebook import warn_of_redefined
from rr_actors.registrar.engine.server import (
    RECOVER_S,
    Labels,
    ServerSpec,
    checked_callback,
    checked_spec,
    checked_whole,
)
from rr_actors.registrar.model.health import Health
from rr_actors.registrar.model.roles import LOAD, ROLES, Role
from rr_actors.registrar.model.rows import State
from rr_actors.registrar.queries import Status
from rr_actors.registrar.servers.callback_context import current
from rr_actors.runtime.workers import is_async
from rr_actors.wire.name_service import Directory, Presence, registrar_key

Request = TypeVar("Request")
Returned = TypeVar("Returned")
Response = TypeVar("Response")
End = TypeVar("End")
F = TypeVar("F", bound=Callable[..., Any])

_Fields = Mapping[str, object]
"""The request of a server whose load callback takes its fields."""
_Numbers = Mapping[str, float]
_Found = State | Status | None
Cost = Mapping[str, float] | Callable[..., Mapping[str, float]]

_SHARE_S = 60.0  # for a share of a server without a load_timeout_s


class server:  # noqa: N801 - used as a decorator
    """Declare a method of a Manager as the load callback of a server, and other methods as its other callbacks::

        @rr.server("camera")
        def load_camera(self, request: OpenCamera) -> Feed: ...

        @load_camera.unload
        def close_camera(self, request: OpenCamera, response: Feed) -> None: ...

    ``status``, ``recover``, ``upgrade``, ``usage``, ``health``, ``pause`` and ``resume`` work in the same way. A method
    with several parameters, or none, takes the fields of the request: ``def load_range(self, name: str, rate: float)``.
    The options are those of Registrar.register_server(), and two more.

    Keyword Args:
        cost: the amounts that each resource holds of pools, as ``{"watts": 4}``; or a function that takes what the load
            callback takes, without `self`, and returns such a dict. Shares of these amounts are loaded as parts of the
            resource, before the load callback runs. Default: None, nothing. Give it where Budgets limits what there is:
            see docs/planning.md, "Budgets".
        cost_from: the child of the system that runs Budgets. Default: budgets. Name another if it has another id.

    ``Cameras.load_camera`` then names the server in Registrar.load().

    Raises:
        InvalidName, InvalidSpec: an option is wrong.
    """

    def __init__(
        self,
        name: str,
        *,
        linger_s: float = 0.0,
        load_timeout_s: float | None = None,
        recover_timeout_s: float | None = RECOVER_S,
        recovery: Literal["keep", "reload", "lost"] | None = None,
        idle: Literal["unload", "pause"] = "unload",
        paused_s: float | None = None,
        health: Health | None = None,
        provides: Labels | None = None,
        at_once: int | None = None,
        exclusive: bool = False,
        grace_s: float | None = None,
        title: Callable[..., str] | None = None,
        cost: Cost | None = None,
        cost_from: str = "budgets",
        request_type: Any = None,
        response_type: Any = None,
    ) -> None:
        if callable(name):  # @rr.server on the method itself
            meant = name.__name__ if is_a(name, FunctionType) else "name"
            raise InvalidName(f"@rr.server: expected a name: write @rr.server({meant!r})", name=name)
        callbacks, types = (_nothing, None, None, None), (request_type, response_type)
        limits = linger_s, load_timeout_s, recovery, recover_timeout_s
        spec = ServerSpec(name, *callbacks, *types, *limits, idle=idle, paused_s=paused_s, health=health)
        spec = replace(spec, exclusive=exclusive, grace_s=grace_s, title=title)
        self._spec = checked_spec(replace(spec, provides=provides, at_once=at_once))
        self._cost = None if cost is None else _Cost(self._spec, cost, check_name(cost_from, "cost_from"))

    # The first overload that fits is meant: two parameters, of which one may have a default; one; any number.
    @overload
    def __call__(  # pyright: ignore[reportOverlappingOverload]
        self, load: Callable[[Any, Any, Any], Coroutine[Any, Any, Response]]
    ) -> Declared[_Fields, Coroutine[Any, Any, Response], Response]: ...
    @overload
    def __call__(  # pyright: ignore[reportOverlappingOverload]
        self, load: Callable[[Any, Any, Any], Response]
    ) -> Declared[_Fields, Response, Response]: ...
    @overload
    def __call__(  # pyright: ignore[reportOverlappingOverload]
        self, load: Callable[[Any, Request], Coroutine[Any, Any, Response]]
    ) -> Declared[Request, Coroutine[Any, Any, Response], Response]: ...
    @overload
    def __call__(  # pyright: ignore[reportOverlappingOverload]
        self, load: Callable[[Any, Request], Response]
    ) -> Declared[Request, Response, Response]: ...
    @overload
    def __call__(  # pyright: ignore[reportOverlappingOverload]
        self, load: Callable[..., Coroutine[Any, Any, Response]]
    ) -> Declared[_Fields, Coroutine[Any, Any, Response], Response]: ...
    @overload
    def __call__(  # pyright: ignore[reportOverlappingOverload]
        self, load: Callable[..., Response]
    ) -> Declared[_Fields, Response, Response]: ...
    def __call__(self, load: Callable[..., Any]) -> Declared[Any, Any, Any]:
        """Return the declaration of the server whose load callback is the decorated method.

        Raises:
            InvalidSpec: the decorated object cannot be called.
        """
        if not callable(load):
            expected = "a method to decorate"
            text = f"@rr.server({self._spec.name!r}): expected {expected}, got {shown(load)} ({type(load).__name__})"
            raise InvalidSpec(text, field="load", expected=expected, got=load)
        return Declared(self._spec, load, self._cost)


class Declared(Generic[Request, Returned, Response]):
    """The declaration of a server. ``@rr.server("camera")`` makes it from a method of a Manager.

    Its type arguments are the request, the method's return type (the response or a coroutine of it), and the response.

    On an instance the attribute is still the method. On the class it names the server in Registrar.load().
    """

    def __init__(self, spec: ServerSpec, load: Callable[..., Any], cost: _Cost | None) -> None:
        with examined(f"@rr.server({spec.name!r})"):
            _check_self(load, LOAD, f"@rr.server({spec.name!r})")
            functools.update_wrapper(cast("Callable[..., Any]", self), load)
        self._load = load
        self._cost = cost
        self._owner: type | None = None
        self._others: dict[str, Callable[..., Any]] = {}
        self._spec = checked_spec(replace(spec, load=_without_self(load)))

    def __set_name__(self, owner: type, name: str) -> None:
        self._owner = owner

    @property
    def name(self) -> str:
        """The server's name."""
        return self._spec.name

    # Of each callback type checkers know what it takes and returns. The first overload is that of a load callback with
    # several parameters, or none: what the others take then has no type.

    @overload
    def unload(self: Declared[_Fields, Any, Any], callback: F) -> F: ...
    @overload
    def unload(self, callback: Callable[[Any, Request, Response], End]) -> Callable[[Any, Request, Response], End]: ...
    def unload(self, callback: Callable[..., Any]) -> Callable[..., Any]:
        """Declare a method as the unload callback: ``(self, request, response)``."""
        return self._take("unload", callback)

    @overload
    def status(self: Declared[_Fields, Any, Any], callback: F) -> F: ...
    @overload
    def status(self, callback: Callable[[Any, Request, Status], End]) -> Callable[[Any, Request, Status], End]: ...
    def status(self, callback: Callable[..., Any]) -> Callable[..., Any]:
        """Declare a method as the status callback: ``(self, request, status)``."""
        return self._take("status", callback)

    @overload
    def recover(self: Declared[_Fields, Any, Any], callback: F) -> F: ...
    @overload
    def recover(
        self, callback: Callable[[Any, Request, Response], Coroutine[Any, Any, Response]]
    ) -> Callable[[Any, Request, Response], Coroutine[Any, Any, Response]]: ...
    @overload
    def recover(
        self, callback: Callable[[Any, Request, Response], Response]
    ) -> Callable[[Any, Request, Response], Response]: ...
    def recover(self, callback: Callable[..., Any]) -> Callable[..., Any]:
        """Declare a method as the recover callback: ``(self, request, response) -> response``."""
        return self._take("recover", callback)

    def upgrade(self, callback: F) -> F:
        """Declare a method as the migration of what an earlier version stored: ``(self, request, response)``.

        It runs before the server is registered, for each resource that does not fit today's types. It gets plain data,
        and returns today's request and response. `response` is None if the load callback has not returned.
        """
        return self._take("upgrade", callback)

    @overload
    def usage(self: Declared[_Fields, Any, Any], callback: F) -> F: ...
    @overload
    def usage(
        self, callback: Callable[[Any, Request, Response], Coroutine[Any, Any, _Numbers]]
    ) -> Callable[[Any, Request, Response], Coroutine[Any, Any, _Numbers]]: ...
    @overload
    def usage(
        self, callback: Callable[[Any, Request, Response], _Numbers]
    ) -> Callable[[Any, Request, Response], _Numbers]: ...
    def usage(self, callback: Callable[..., Any]) -> Callable[..., Any]:
        """Declare a method that returns what a resource uses now: ``(self, request, response) -> dict[str, float]``.

        Registrar.usage() runs it for each loaded resource. The names and units of the numbers are free; "cpu_s", "cpu",
        "memory_bytes" and "threads" mean what they mean for a program (docs/programs.md).
        """
        return self._take("usage", callback)

    @overload
    def health(self: Declared[_Fields, Any, Any], callback: F) -> F: ...
    @overload
    def health(
        self, callback: Callable[[Any, Request, Response], Coroutine[Any, Any, _Found]]
    ) -> Callable[[Any, Request, Response], Coroutine[Any, Any, _Found]]: ...
    @overload
    def health(
        self, callback: Callable[[Any, Request, Response], _Found]
    ) -> Callable[[Any, Request, Response], _Found]: ...
    def health(self, callback: Callable[..., Any]) -> Callable[..., Any]:
        """Declare a method that says how well a resource is: ``(self, request, response)``. For health=rr.Health(...).

        It returns None (well), a State, or a Status with a text; or it raises. See docs/planning.md, "Health".
        """
        return self._take("probe", callback)

    @overload
    def pause(self: Declared[_Fields, Any, Any], callback: F) -> F: ...
    @overload
    def pause(self, callback: Callable[[Any, Request, Response], End]) -> Callable[[Any, Request, Response], End]: ...
    def pause(self, callback: Callable[..., Any]) -> Callable[..., Any]:
        """Declare a method that pauses an idle resource: ``(self, request, response)``. For idle="pause"."""
        return self._take("pause", callback)

    @overload
    def resume(self: Declared[_Fields, Any, Any], callback: F) -> F: ...
    @overload
    def resume(
        self, callback: Callable[[Any, Request, Response], Coroutine[Any, Any, Response | None]]
    ) -> Callable[[Any, Request, Response], Coroutine[Any, Any, Response | None]]: ...
    @overload
    def resume(
        self, callback: Callable[[Any, Request, Response], Response | None]
    ) -> Callable[[Any, Request, Response], Response | None]: ...
    def resume(self, callback: Callable[..., Any]) -> Callable[..., Any]:
        """Declare a method that resumes a paused resource: ``(self, request, response)``.

        It may return a new response. If it raises, the resource is lost: its holders hear FATAL.
        """
        return self._take("resume", callback)

    def _take(self, role: str, callback: F) -> F:
        with examined(f"server {self.name!r}: {role}: a method to decorate"):
            if role in self._others:
                raise AlreadyPresent(f"server {self.name!r}: its {role} callback is declared twice", id=self.name)
            name = callback.__name__
            if name == self._load.__name__:  # a property's setter has the name of its getter; here it must differ
                expected = f"a method of another name than {name!r}, the load callback, which it would replace"
                text = f"server {self.name!r}: {role}: expected {expected}"
                raise InvalidSpec(text, field=role, expected=expected, got=name)
            _check_self(callback, ROLES[role], f"server {self.name!r}")
            checked_callback(_without_self(callback), ROLES[role], self._spec.request_type, f"server {self.name!r}")
            self._others[role] = callback
            return callback

    @overload
    def __get__(self, instance: None, owner: Any) -> Declared[Request, Returned, Response]: ...
    @overload
    def __get__(self, instance: Any, owner: Any) -> Callable[[Request], Returned]: ...
    def __get__(self, instance: Any, owner: Any) -> Any:
        if instance is not None:
            return functools.partial(self._load, instance)
        if owner is self._owner:
            return self
        of_subclass = copy.copy(self)
        of_subclass._owner = owner
        return of_subclass

    def _spec_for(self, manager: _Manager) -> ServerSpec:
        """Return the spec of one manager's server. Its callbacks are bound; a subclass may override all but `load`."""
        roles = {role: _bound(manager, callback) for role, callback in self._others.items()}
        load: Callable[..., Any] = functools.partial(self._load, manager)
        if self._cost is not None:
            load = self._cost.paid_before(load, manager)
        return checked_whole(checked_spec(replace(self._spec, load=load, **roles)))

    def _cost_from(self) -> str:
        """Return the id of the child whose pools its resources hold amounts of; "" if they cost nothing."""
        return "" if self._cost is None else self._cost.budgets

    def _callbacks(self) -> set[str]:
        """Return the names of the methods that are its callbacks."""
        return {self._load.__name__, *(callback.__name__ for callback in self._others.values())}

    def _declaring(self) -> DeclaringClass:
        """Return which class declares the server.

        Raises:
            UsageError: the declaration is no attribute of a class.
        """
        if self._owner is None:
            raise UsageError(f"server {self.name!r}: expected an attribute of a Manager class, got a function")
        warn_of_redefined(self._owner)
        return DeclaringClass(class_name(self._owner), self._load.__name__, self.name)


class DeclaringClass(NamedTuple):
    """A class of managers, as the directory of names has it, one of its methods, and the server that this declares."""

    owner: str
    method: str
    server: str

    def id_in(self, directory: Directory) -> str:
        """Return "registrar/server". The registrar is that of the one child of the system that has the class.

        Raises:
            UnknownRegistrar: no child has that class.
            UsageError: several children have it.
        """
        found = [name for name, classes in directory.manager_classes().items() if self.owner in classes]
        alive = [name for name in found if _is_alive(directory, name)]
        if len(alive) == 1:
            return f"{alive[0]}/{self.server}"
        owner = self.owner.rpartition(":")[2].rpartition(".")[2]
        if not alive:
            there = ", ".join(directory.registrars()) or "none"
            text = f"{owner}.{self.method}: no child of this system is a {self.owner}; its registrars are: {there}"
            raise UnknownRegistrar(text, registrar="", known=())
        names = " or ".join(f'load("{name}/{self.server}", ...)' for name in alive)
        text = f"{owner}.{self.method}: {len(alive)} children of this system are a {owner}: name one: {names}"
        raise UsageError(text)


# For the package's own modules. As private methods they stay out of an editor's list of names.
spec_for = Declared[Any, Any, Any]._spec_for  # pyright: ignore[reportPrivateUsage] - same file
declaring = Declared[Any, Any, Any]._declaring  # pyright: ignore[reportPrivateUsage]
callbacks_of = Declared[Any, Any, Any]._callbacks  # pyright: ignore[reportPrivateUsage]
cost_from = Declared[Any, Any, Any]._cost_from  # pyright: ignore[reportPrivateUsage]


# -- what a resource costs -----------------------------------------------------------------------------------------


class _Loading(Protocol):
    """The part of a Registrar by which shares are loaded."""

    @overload
    def load(self, server: str, request: object, *, timeout_s: float) -> object: ...
    @overload
    def load(self, server: str, request: object, *, block: Literal[False], timeout_s: float) -> Awaitable[object]: ...


class _Manager(Protocol):
    """A manager, as declarations know it."""

    @property
    def registrar(self) -> _Loading: ...


def costing(spec: ServerSpec, cost: Cost, cost_from: str, manager: _Manager) -> ServerSpec:
    """Return a server of a ready-made manager as `cost` and `cost_from` of @rr.server would have made it."""
    return replace(spec, load=_Cost(spec, cost, cost_from).paid_before(spec.load, manager))


class _Cost:
    """What each resource of a server holds of pools.

    Raises:
        InvalidSpec: the cost is neither a function nor a dict of amounts.
    """

    def __init__(self, spec: ServerSpec, cost: Cost, budgets: str) -> None:
        self._who = f"server {spec.name!r}"
        self.budgets, self._share = budgets, f"{budgets}/share"
        self._timeout_s = spec.load_timeout_s or _SHARE_S
        self._amounts = cost if callable(cost) else self._checked(cost)

    def _checked(self, cost: object) -> Mapping[str, float]:
        expected = "a dict of pools and the amounts of them, or a function that returns one"
        if not is_a(cost, Mapping):
            text = f"{self._who}: cost: expected {expected}, got {shown(cost)} ({type(cost).__name__})"
            raise InvalidSpec(text, field="cost", expected=expected, got=cost)
        amounts: dict[str, float] = {}
        for pool, amount in cast("Mapping[object, Any]", cost).items():
            check_number(amount, self._who, f"cost of {shown(pool)}", least=0)
            amounts[check_name(pool, f"{self._who}: cost: pool")] = amount
        return dict(sorted(amounts.items()))

    def paid_before(self, load: Callable[..., Any], manager: _Manager) -> Callable[..., Any]:
        """Return a load callback that loads the shares, one after another by the pools' names, and then runs `load`."""
        if not is_async(load):

            @functools.wraps(load)
            def pay(*given: Any, **fields: Any) -> Any:
                for request in self._requests(given, fields):
                    manager.registrar.load(self._share, request, timeout_s=self._timeout_s)
                return load(*given, **fields)

            return pay

        @functools.wraps(load)
        async def pay_async(*given: Any, **fields: Any) -> Any:
            for request in self._requests(given, fields):
                await manager.registrar.load(self._share, request, block=False, timeout_s=self._timeout_s)
            return await load(*given, **fields)

        return pay_async

    def _requests(self, given: tuple[Any, ...], fields: dict[str, Any]) -> list[dict[str, object]]:
        amounts = self._checked(self._amounts(*given, **fields)) if callable(self._amounts) else self._amounts
        whose: dict[str, object] = {"instance": current().resource_id, "whose": current().name}
        return [{"pool": pool, "amount": amount, **whose} for pool, amount in amounts.items()]


def class_name(cls: type) -> str:
    """Return the name of a manager's class in the directory."""
    return f"{cls.__module__}:{cls.__qualname__}"


def class_names(cls: type) -> list[str]:
    """Return the names of a manager's class and of its base classes."""
    return [class_name(base) for base in cls.__mro__ if base is not object]


def _is_alive(directory: Directory, registrar: str) -> bool:
    entry = directory.lookup(registrar_key(registrar))
    return entry is not None and entry.status is not Presence.GONE


def _bound(manager: object, callback: Callable[..., Any]) -> Callable[..., Any]:
    found = getattr(type(manager), callback.__name__, None)
    method = found if callable(found) and not isinstance(found, Declared) else callback
    return functools.partial(method, manager)


def _check_self(callback: Callable[..., Any], role: Role, who: str) -> None:
    """Refuse a method whose first parameter is not the manager.

    The name `self` is always right. Another name is wrong if it is that of an argument, or if it has the annotation of
    a request. A manager has none, or its own class.

    Raises:
        InvalidSpec: `self` is forgotten.
    """
    if not is_a(callback, FunctionType) or not callback.__code__.co_argcount:
        return  # a function without parameters is refused with its signature
    first = callback.__code__.co_varnames[0]
    annotation = callback.__annotations__.get(first)
    owner = callback.__qualname__.rpartition(".")[0].rpartition(".")[2]
    is_manager = annotation is None or is_a(annotation, TypeVar) or annotation is Self or annotation in (owner, "Self")
    if first != "self" and (first in role.arguments or not is_manager):
        expected = f"self as the first parameter: {callback.__name__}(self, {first}, ...)"
        text = f"{who}: {role.option}: expected {expected}, got {callback.__name__}({first}, ...)"
        raise InvalidSpec(text, field=role.option, expected=expected, got=callback)


def _without_self(load: Callable[..., Any]) -> Callable[..., Any]:
    """Return a callback without its `self`, so that its annotations are read from the second parameter on."""
    return functools.partial(load, None)


def _nothing(_request: Any) -> None:
    return None
