"""The registrars of a running system, as those of one of its processes find and open them."""

from __future__ import annotations

from rr_actors.actors.node import Node
from rr_actors.config import RegistrarConfig
from rr_actors.directory import Status
from rr_actors.errors import ConfigError, NameTaken, is_a
from rr_actors.handle import RegistrarHandle
from rr_actors.names import check_name
from rr_actors.registrar import Registrar


def check_config(name: str, config: RegistrarConfig) -> None:
    """That it is one.

    Raises:
        ConfigError: it is something else.
    """
    if not is_a(config, RegistrarConfig):
        expected, got = "a RegistrarConfig", type(config).__name__
        text = f"open_registrar({name!r}): config: expected {expected}, got {got}"
        raise ConfigError(text, file=None, key="config", expected=expected, got=got)


async def open_in(node: Node, name: str, config: RegistrarConfig) -> Registrar:
    """Open a registrar in this process, and let others in. On the loop.

    Raises:
        NameTaken: there is one of this name, or will be.
        CatalogError: its catalog is locked, damaged or too new.
    """
    entry = node.find(name)
    if entry is not None and entry.status in (Status.UP, Status.STARTING, Status.STOPPED):
        system = node.info.name
        text = f"registrar {name!r}: the name is taken in system {system!r}; close that one, or choose another"
        raise NameTaken(text, name=name)
    actor = await node.open_registrar(name, config)
    registrar = Registrar(actor)
    await node.settle(actor)
    node.serve_registrar(actor)
    return registrar


def registrar_in(node: Node, name: str, *, patient: bool, owner: object = None) -> Registrar:
    """The registrar of this process, or a handle on that of another one.

    Args:
        patient: whether a handle waits for its registrar while that is being started or respawned.
        owner: what a handle keeps alive.

    Raises:
        UnknownRegistrar: there is none of this name.
    """
    check_name(name, "registrar name")
    actor = node.registrars.get(name)
    if actor is not None and actor.audience is not None:
        return actor.audience.holder
    entry = node.find(name)
    if entry is None or entry.status in (Status.GONE, Status.DORMANT):
        raise node.directory.no_registrar(name)
    return RegistrarHandle(node, name, patient=patient, owner=owner)
