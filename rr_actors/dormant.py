"""Dormant registrars: their process died, and nobody has opened them again. What they hold stays held meanwhile."""

from __future__ import annotations

import logging
from pathlib import Path

from rr_actors.actors.node import Node
from rr_actors.config import CATALOG_FILE, RegistrarConfig
from rr_actors.directory import Directory, Status, registrar_key
from rr_actors.errors import CatalogError
from rr_actors.records import Drop, Held, Peer, Resource, Table
from rr_actors.stores.opening import open_store, read_rows
from rr_actors.stores.witness import Witness, tell_of_missing

_HELD: tuple[Table, ...] = ("held", "peers")

logger = logging.getLogger("rr_actors")


def dormant_in(directory: Directory) -> list[str]:
    """The registrars that the directory of a running system calls dormant."""
    entries = [(name, directory.lookup(registrar_key(name))) for name in directory.registrars()]
    return [name for name, entry in entries if entry is not None and entry.status is Status.DORMANT]


def left_behind(state_dir: Path, except_for: set[str]) -> list[str]:
    """The registrars with a catalog on disk that holds or serves something, or cannot be read. In a worker.

    Args:
        except_for: names of those that are about to be opened.
    """
    found: list[str] = []
    tell_of_missing(state_dir)
    for catalog in sorted(state_dir.glob(f"*/{CATALOG_FILE}")):
        name = catalog.parent.name
        if name in except_for:
            continue
        try:
            if any(isinstance(row, Held | Peer | Resource) for row in read_rows(catalog)):
                found.append(name)
        except CatalogError as error:
            logger.warning("%s: not read: %s", name, error)
            found.append(name)
    return found


async def give_up(node: Node, name: str, config: RegistrarConfig, state_dir: Path) -> None:
    """Take what a dormant registrar holds out of its catalog, and have its providers release it. On the loop.

    Raises:
        CatalogError: its catalog cannot be opened.
    """
    await node.dispatcher.workers.run(forget_held, config, state_dir)
    await node.retire(name)


def forget_held(config: RegistrarConfig, state_dir: Path) -> None:
    """Take what a registrar holds that nobody has open out of its catalog. Blocks.

    Raises:
        CatalogError: its catalog cannot be opened or written.
    """
    durability = "power" if config.durability == "power" else "process"
    store = open_store(
        config.catalog_path(state_dir),
        durability=durability,
        on_damage=config.on_damage,
        witness=Witness(state_dir, config.name) if config.name else None,
    )
    try:
        content = store.load()
        store.commit([Drop(table, id) for table in _HELD for id in content[table]])
    finally:
        store.close()
