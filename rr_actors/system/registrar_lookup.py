"""The registrars of a system: how to find and open one, and the dormant ones.

The process of a dormant registrar died, and nobody has opened it again. Its queries stay held meanwhile.
"""

from __future__ import annotations

import functools
import logging
import os
from collections.abc import Callable, Collection, Iterable, Sequence
from pathlib import Path

from msgspec.structs import replace

from rr_actors.base.config import CATALOG_FILE, RegistrarConfig, SystemConfig, called
from rr_actors.base.errors import CatalogError, ConfigError, NameTaken, RrError, is_a
from rr_actors.base.names import CLIENTS, check_name
from rr_actors.registrar.model.rows import OWED, Change, Content, Drop, Held, Peer, Put, Resource
from rr_actors.registrar.registrar import Registrar
from rr_actors.registrar.remote_registrar import RegistrarHandle
from rr_actors.storage.opening import open_store, read_rows
from rr_actors.storage.witness import Witness, tell_of_missing
from rr_actors.system.hosting.node import Node
from rr_actors.wire.name_service import Status

logger = logging.getLogger("rr_actors")


def open_registrar(node: Node, name: str, config: RegistrarConfig, owner: object) -> Registrar:
    """Open a registrar in this process, and serve other processes. Not on the loop.

    Args:
        owner: an object that stays alive while the registrar is open.

    Raises:
        NameTaken: the system has a registrar of this name, or will have one.
        ConfigError: `config` is no RegistrarConfig, or has another name.
        CatalogError: its catalog is locked, damaged or of another version.
    """
    if not is_a(config, RegistrarConfig):
        expected, got = "a RegistrarConfig", type(config).__name__
        text = f"open_registrar({name!r}): config: expected {expected}, got {got}"
        raise ConfigError(text, file=None, key="config", expected=expected, got=got)
    registrar = node.dispatcher.run(_open_in(node, name, called(config, name)))
    node.owner = owner
    return registrar


async def _open_in(node: Node, name: str, config: RegistrarConfig) -> Registrar:
    if node.status_of(name) in (Status.UP, Status.STARTING, Status.STOPPED):
        system = node.info.name
        text = f"registrar {name!r}: the name is taken in system {system!r}; close that one, or choose another"
        raise NameTaken(text, name=name)
    actor = await node.open_registrar(name, config)
    registrar = Registrar(actor)
    await node.settle(actor)
    node.serve_registrar(actor)
    return registrar


def registrar_in(node: Node, name: str, *, patient: bool, owner: object = None) -> Registrar:
    """Return the registrar of this process, or a handle on a registrar of another process.

    Args:
        patient: whether a handle waits while its registrar is being started or respawned.
        owner: an object that the handle keeps alive.

    Raises:
        UnknownRegistrar: the system has no registrar of this name.
    """
    check_name(name, "registrar name")
    actor = node.registrars.get(name)
    if actor is not None and actor.audience is not None:
        return actor.audience.holder
    if node.status_of(name) in (None, Status.GONE, Status.DORMANT):
        raise node.directory.no_registrar(name)
    return RegistrarHandle(node, name, patient=patient, owner=owner)


def left_behind(config: SystemConfig, state_dir: Path, except_for: set[str]) -> list[str]:
    """Return the registrars whose catalog on disk holds or serves something, or cannot be read, and all of clients.

    Blocks.

    Args:
        except_for: names of registrars that are about to be opened.
    """
    found: list[str] = []
    tell_of_missing(state_dir)
    placed = {name: config.registrar(name).catalog_path(state_dir) for name in config.registrars}
    others = set(state_dir.glob(f"*/{CATALOG_FILE}")) - {*placed.values()}
    for name, catalog in sorted(({catalog.parent.name: catalog for catalog in others} | placed).items()):
        if name in except_for or not os.path.exists(catalog):  # False, too, if it cannot be looked at
            continue
        try:
            rows = read_rows(catalog)
            if name.startswith(CLIENTS) or any(isinstance(row, Held | Peer | Resource) for row in rows):
                found.append(name)
        except CatalogError as error:
            logger.warning("%s: not read: %s", name, error)
            found.append(name)
    return found


async def give_up_clients(node: Node, names: Iterable[str]) -> None:
    """Give up the registrars in `names` that clients of a killed application have left, and erase their catalogs.

    On the loop.
    """
    for name in names:
        if name.startswith(CLIENTS):
            try:
                await give_up(node, name, erase=True)
            except RrError as error:  # a damaged catalog, for instance: the system starts all the same
                logger.warning("%s: what it holds is not released, and it stays dormant: %s", name, error)


async def give_up(node: Node, name: str, *, erase: bool = False) -> None:
    """Have the providers of a dormant registrar release what it holds, and delete that from its catalog. On the loop.

    What providers hold that are down stays in the catalog, as owed. They read in the directory that the registrar is
    gone, if the application lives until they are back; else its next start finds the registrar dormant again.

    Args:
        erase: remove the catalog from disk.

    Raises:
        CatalogError: its catalog cannot be opened.
    """
    config, state_dir = node.config.registrar(name), Path(node.info.state_dir)
    await node.dispatcher.workers.run(owe, config, state_dir)
    told = await node.retire(name)
    down = {other for other, status in node.statuses().items() if status is not Status.UP or other not in told}
    await node.dispatcher.workers.run(functools.partial(forget, config, state_dir, down=down, erase=erase))


def owe(config: RegistrarConfig, state_dir: Path) -> None:
    """Mark all that a registrar holds which nobody has open as owed: if it is opened again, it releases that. Blocks.

    Raises:
        CatalogError: its catalog cannot be opened or written.
    """
    _change(config, state_dir, lambda content: [Put(replace(row, hold=OWED)) for row in content["held"].values()])


def forget(config: RegistrarConfig, state_dir: Path, *, down: Collection[str] = (), erase: bool = False) -> None:
    """Delete what a registrar holds that nobody has open, and its providers, from its catalog. Blocks.

    Args:
        down: the providers whose rows stay. So do the rows of the registrar itself, if it is one of its consumers.
        erase: remove the catalog from disk, too.

    Raises:
        CatalogError: its catalog cannot be opened or written.
    """

    def changes(content: Content) -> list[Change]:
        staying = {*down, *({query.origin for query in content["queries"].values()} & {config.name})}
        held = [row.id for row in content["held"].values() if row.registrar not in staying]
        peers = [name for name in content["peers"] if name not in staying]
        return [*(Drop("held", id) for id in held), *(Drop("peers", name) for name in peers)]

    _change(config, state_dir, changes, erase=erase)


def _change(
    config: RegistrarConfig, state_dir: Path, changes: Callable[[Content], Sequence[Change]], *, erase: bool = False
) -> None:
    durability = "power" if config.durability == "power" else "process"
    path, witness = config.catalog_path(state_dir), Witness(state_dir, config.name)
    store = open_store(path, durability=durability, on_damage=config.on_damage, witness=witness)
    try:
        store.commit(changes(store.load()))
    except BaseException:
        store.close()
        raise
    store.close(erase=erase)
