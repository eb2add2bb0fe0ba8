"""Registrars that are given up while nobody has them open: a dormant one that is released, a manager that is deleted.

Their providers release what they held, and their catalogs keep nothing of that. What they serve stays there: only their
own servers could unload it. It is unloaded when they are opened again, as their consumers owe the release of what they
held there. `clear` removes it from the catalog instead, for what no server will unload.
"""

from __future__ import annotations

import functools
from collections import Counter
from collections.abc import Callable, Collection, Sequence
from pathlib import Path

from rr_actors.base.config import RegistrarConfig
from rr_actors.base.names import is_of_another_host
from rr_actors.base.reporting.log import Log
from rr_actors.registrar.core.releasing import forgetting, owing
from rr_actors.registrar.engine.node import Node
from rr_actors.registrar.model.rows import Change, Content, Held, Notice, Peer, Resource, Row, apply, rows_of
from rr_actors.registrar.model.store import is_needed
from rr_actors.storage.opening import is_there, open_store
from rr_actors.storage.witness import Witness
from rr_actors.wire.name_service import Presence

logger = Log("rr_actors")

Changes = Callable[[Content, int], Sequence[Change]]
"""Returns the changes of a catalog with this content, in this epoch."""


async def give_up(node: Node, name: str, *, clear: bool = False, erase: bool = False) -> None:
    """Have the providers of a registrar that nobody has open release what it holds, and delete that from its catalog.

    What providers hold that are down stays in the catalog, as owed. They read in the directory that the registrar is
    gone, if the application lives until they are back; else its next start finds the registrar dormant. On the loop.

    Args:
        clear: delete what it serves, too; no unload callback runs.
        erase: remove the catalog from disk.

    Raises:
        CatalogError: its catalog cannot be opened.
    """
    config, state_dir = node.config.registrar(name), Path(node.info.state_dir)
    if not await node.dispatcher.workers.run(is_there, config.catalog_path(state_dir)):
        await node.retire(name)
        return
    await node.dispatcher.workers.run(owe, config, state_dir)
    told = await node.retire(name)
    down = {other for other, status in node.statuses().items() if status is not Presence.UP or other not in told}
    forgets = functools.partial(forget, config, state_dir, down=down, told=told, clear=clear, erase=erase)
    await node.dispatcher.workers.run(forgets)


def owe(config: RegistrarConfig, state_dir: Path) -> None:
    """Commit what releasing.owing() says. Blocks.

    Raises:
        CatalogError: its catalog cannot be opened or written.
    """
    change(config, state_dir, owing)


def forget(
    config: RegistrarConfig,
    state_dir: Path,
    *,
    down: Collection[str] = (),
    told: Collection[str] = (),
    clear: bool = False,
    erase: bool = False,
) -> None:
    """Commit what releasing.forgetting() says. A catalog that then has nothing to be missed is removed. Blocks.

    Args:
        down: the registrars of this host that have not decided that this one is gone.
        told: those of this host and others that have.
        clear: delete what it serves, too.
        erase: remove the catalog from disk, too.

    Raises:
        CatalogError: its catalog cannot be opened or written.
    """

    def changes(content: Content, _epoch: int) -> list[Change]:
        if content["resources"] and not erase:
            what = "goes on until it is opened, under this name or by renamed_from"
            if clear:
                what = "is forgotten, and no unload callback has run"
            logger.warning("registrar %s: %s; what it serves %s", config.name, contents(rows_of(content)), what)
        asked = {*(row.registrar for row in content["held"].values()), *content["peers"]}
        away = {peer for peer in asked if is_of_another_host(peer) and peer not in told}
        return forgetting(content, config.name, {*down, *away}, clear=clear)

    change(config, state_dir, changes, erase=erase, unneeded=config.location is None)


def change(
    config: RegistrarConfig,
    state_dir: Path,
    changes: Changes,
    *,
    erase: bool = False,
    unneeded: bool = False,
    formerly: str = "",
) -> None:
    """Commit changes to a catalog that nobody has open. Blocks.

    Args:
        erase: remove the catalog then, unless it owes releases at other hosts.
        unneeded: remove it if it has nothing to be missed.
        formerly: the name of its registrar in earlier runs, which it may have.

    Raises:
        CatalogError: it cannot be opened or written.
    """
    durability = "power" if config.durability == "power" else "process"
    path, witness = config.catalog_path(state_dir), Witness(state_dir, config.name, formerly)
    store = open_store(path, durability=durability, on_damage=config.on_damage, witness=witness)
    try:
        content = store.load()
        made = changes(content, store.epoch)
        store.commit(made)
        apply(content, made)
    except BaseException:
        store.close()
        raise
    asked = [*content["peers"], *(row.registrar for row in content["held"].values())]
    owes_hosts = any(map(is_of_another_host, asked))  # they cannot see that the catalog is gone
    store.close(erase=(erase and not owes_hosts) or (unneeded and not is_needed(content)))


def contents(rows: Sequence[Row]) -> str:
    """Return what a catalog has, "it serves 2 x program, and holds 1 x cameras/camera"."""
    serves = Counter(row.server for row in rows if isinstance(row, Resource))
    holds = Counter(f"{row.registrar}/{row.server}" for row in rows if isinstance(row, Held))
    said = [
        f"{verb} {', '.join(f'{count} x {server}' for server, count in counts.items())}"
        for verb, counts in (("serves", serves), ("holds", holds))
        if counts
    ]
    asked = ", ".join(row.id for row in rows if isinstance(row, Peer))
    told = ", ".join(sorted({row.origin for row in rows if isinstance(row, Notice) and row.origin}))
    return "it " + (", and ".join(said) or (f"may hold something at {asked}" if asked else f"has statuses for {told}"))
