"""Manager: an actor with a registrar of its own, and the servers that it declares."""

from __future__ import annotations

import contextlib
import functools
from collections.abc import Callable
from pathlib import Path
from typing import Any, ClassVar, NoReturn, cast

import msgspec
from pykka import ActorDeadError

from rr_actors.actors.actor import Actor
from rr_actors.actors.refs import ActorRef
from rr_actors.base import pickling
from rr_actors.base.errors import NameTaken, StartFailed, UsageError, shown
from rr_actors.registrar.arguments import check_text
from rr_actors.registrar.declarations import Declared, spec_for
from rr_actors.registrar.engine.node import Node
from rr_actors.registrar.engine.registrar_actor import RegistrarActor
from rr_actors.registrar.engine.server import ServerSpec
from rr_actors.registrar.registrar import Registrar, register_spec
from rr_actors.registrar.servers.callback_context import current, serving
from rr_actors.runtime.workers import Gate
from rr_actors.wire.name_service import Presence


def _unnoted(text: str) -> None:
    """Take no note: no system makes the manager."""


class Beginning(msgspec.Struct, frozen=True):
    """The facts of a start of a manager.

    Attributes:
        name: of its registrar.
        directory: the private directory of its catalog, which may not exist yet.
        run: identifies the run of the system.
        by_hand: start_child or restart_child asks for this start, and not the supervisor.
        note: has the console show a text beside the manager, until another is given; "": none.
    """

    name: str
    directory: Path
    run: str
    by_hand: bool
    note: Callable[[str], None] = _unnoted


class _NotYet:
    """The class attribute Manager.registrar. It raises until the instance has an attribute of its own."""

    def __get__(self, instance: Manager | None, owner: type[Manager]) -> Any:
        if instance is None:
            return self
        raise AttributeError(
            f"{owner.__qualname__}: self.registrar does not exist in __init__, because its catalog is not open yet: "
            f"use it in on_start, or in a callback"
        )


class Manager(Actor):
    """An actor that serves resources, or uses those of others, or both, through `self.registrar`.

    Subclass it, declare servers with ``@rr.server``, and put it into a ChildSpec: its child id is its registrar's name.

    Its callbacks and on_receive run **side by side**, hundreds at once over one `self`, unless it is serial::

        class Cameras(rr.Manager, serial=True): ...

    Then one of them runs at a time, as the messages of every other actor do: load, unload, status, recover, usage,
    health, pause and resume callbacks, status callbacks of what it holds, on_receive, and methods that are called by a
    proxy. One that waits for a load, an unload or a reply lets another in meanwhile. What `self` has may differ after
    that. on_start and on_stop may run beside them, so that on_stop can end one that hangs. Where one server alone
    needs it, ``@rr.server(..., at_once=1)`` does the same for that.

    A start or restart has four steps. The manager locks and reads its catalog. It registers the declared servers: their
    recover callbacks begin, and the manager waits for them, though not for long. ``on_start`` runs, with
    ``self.registrar.queries()`` restored. Other registrars connect, and all other callbacks begin: those that a crash
    has interrupted, and probes.
    """

    serial: ClassVar[bool] = False
    """Whether one callback runs at a time. The class statement sets it: ``class Cameras(rr.Manager, serial=True)``."""

    registrar: Registrar = cast("Registrar", _NotYet())
    """This manager's registrar. It exists before the first recover callback, and so before on_start."""

    _rr_side_by_side: ClassVar[bool] = False  # it must not be serial: of a ready-made manager

    _rr_gate: Gate | None = None  # of a serial manager

    def __init_subclass__(cls, *, serial: bool | None = None, **kwargs: Any) -> None:
        """Make a class of managers; `serial`: whether one callback runs at a time. Default: as its base class."""
        super().__init_subclass__(**kwargs)
        if serial is not None:
            if type(serial) is not bool:
                raise UsageError(f"class {cls.__name__}: serial: expected True or False, got {shown(serial)}")
            cls.serial = serial
        if cls.serial and cls._rr_side_by_side:
            ready_made = next(base.__name__ for base in cls.__mro__ if vars(base).get("_rr_side_by_side"))
            why = "a ready-made manager, whose callbacks wait for each other"
            raise UsageError(f"class {cls.__name__}: serial: expected False, as it is a {ready_made}: {why}")

    def ref(self, id: str) -> ActorRef[Any]:
        """Return a reference to another actor of the system; from on_start on, and in every callback.

        The actor may be in any process. It need not run yet: the reference is to whatever runs there later.

        Args:
            id: the actor's child id, or its path ("inner/models"). Of several, that of the same supervisor is meant.

        Raises:
            NotFound: no actor has this id, or several have it; `.known` has the paths that exist.
        """
        where = check_text(id, "ref: expected a child's id or path")
        return self._rr_node.ref(where, self.actor_ref.path or "")

    @classmethod
    def start(cls, *_args: Any, **_kwargs: Any) -> NoReturn:
        """Refuse to start: only a system starts a manager, from its ChildSpec, and has a place for its catalog.

        Raises:
            UsageError: always.
        """
        raise UsageError(
            f"{cls.__name__}.start(): only a system can start a manager: write "
            f"rr.System([rr.ChildSpec({cls.__name__}, id='...')]).start(), or system.start_child(...) if a system runs"
        )

    def _rr_beginning(self) -> Beginning | None:
        """Return the facts of this start, for __init__; None if no system makes this manager."""
        place = self._rr_place
        if place is None:
            return None
        node: Node = place.node
        directory = node.config.registrar(place.id).catalog_path(node.info.state_dir).parent
        note = functools.partial(node.directory.put_note, place.id)
        return Beginning(place.id, directory, node.info.run_dir, place.by_hand, note)

    async def _rr_before_start(self, place: Any) -> None:
        node: Node = place.node
        self._rr_node = node
        actor = await node.open_registrar(place.id, node.config.registrar(place.id), place.path)
        self.registrar = Registrar(node, actor)
        self._rr_served = actor
        actor.gate = self._rr_gate = Gate(1) if self.serial else None
        actor.on_defect = self._rr_failed
        place.abandoned = functools.partial(self._rr_close_registrar, None)
        try:
            await node.dispatcher.workers.run(self._rr_register_servers, actor)
            await node.settle(actor)
        except BaseException:
            self._rr_close_registrar(None)
            raise

    def _rr_register_servers(self, actor: RegistrarActor) -> None:
        """Register the declared and the stored servers. In a worker: reading types and unpickling run users' code."""
        declared = self._rr_declared_servers()
        for declaration in declared.values():
            register_spec(self.registrar, self._rr_adapted(spec_for(declaration, self)))
        with actor.enter():
            stored_servers = list(actor.whole().stored_servers.values())
        for stored in stored_servers:
            if stored.id not in declared:
                register_spec(self.registrar, pickling.loads(stored.blob), restored=True)

    def _rr_adapted(self, spec: ServerSpec) -> ServerSpec:
        """Return a declared server as this instance registers it; a ready-made manager's arguments may change it."""
        return spec

    @classmethod
    def _rr_declared_servers(cls) -> dict[str, Declared[Any, Any, Any]]:
        """Return the servers that this class and its base classes declare, by name.

        Raises:
            NameTaken: two methods declare the same name.
        """
        found: dict[str, Declared[Any, Any, Any]] = {}
        attributes = {name: attribute for base in reversed(cls.__mro__) for name, attribute in vars(base).items()}
        for attribute in attributes.values():
            if isinstance(attribute, Declared):
                if attribute.name in found:
                    text = f"{cls.__name__}: two methods declare server {attribute.name!r}"
                    raise NameTaken(text, name=attribute.name)
                found[attribute.name] = attribute  # pyright: ignore[reportUnknownArgumentType]
        return found

    async def _rr_after_start(self) -> None:
        if not self._rr_is_mine():
            raise StartFailed(
                f"{self.registrar.name}: on_start returned too late: the supervisor has abandoned it",
                id=self.registrar.name,
            )
        self._rr_node.serve_registrar(self._rr_served)

    async def _rr_after_stop(self, final: bool) -> None:
        if final and self._rr_is_mine():
            await self._rr_node.wind_down(self.registrar.name, self._rr_node.config.stop_timeout_s)
            self._rr_close_registrar(Presence.GONE)
        else:
            self._rr_close_registrar(None)

    def _rr_close_registrar(self, status: Presence | None) -> None:
        if self._rr_is_mine():
            self._rr_node.close_registrar(self.registrar.name, status)

    def _rr_is_mine(self) -> bool:
        """Return whether this manager still owns the registrar of its name: an abandoned one may have a successor."""
        return self._rr_node.registrars.get(self.registrar.name) is self._rr_served

    def _rr_failed(self, error: BaseException) -> None:
        """Make the manager fail with an error of its registrar, or of a thread of its own. From any thread.

        Its supervisor then starts it again from the catalog.
        """
        with contextlib.suppress(ActorDeadError):  # it has ended already
            self.actor_ref.tell(_Failed(error))

    def _handle_receive(self, message: Any) -> Any:
        if isinstance(message, _Failed):
            raise message.error
        if self._rr_gate is None:
            return super()._handle_receive(message)
        return self._rr_gate.around(super()._handle_receive, enters=True)(message)


def ref(id: str) -> ActorRef[Any]:
    """Return a reference to an actor of the system, in a load, unload, status or recover callback; see Manager.ref().

    Raises:
        NotFound: no actor has this id, or several have it; `.known` has the paths that exist.
        UsageError: this code does not run in a callback.
    """
    where = check_text(id, "rr.ref: expected a child's id or path")
    node = serving(current()).node
    return node.ref(where, node.path)


class _Failed:
    def __init__(self, error: BaseException) -> None:
        self.error = error


def declared_servers(cls: type[Manager]) -> dict[str, Declared[Any, Any, Any]]:
    """Return the servers that a class of managers declares, by name, for the package's own modules.

    Raises:
        NameTaken: two methods declare the same name.
    """
    return cls._rr_declared_servers()  # pyright: ignore[reportPrivateUsage] - same file
