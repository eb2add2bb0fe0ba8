"""The registrars of a system: how to find and open one, and the dormant ones.

The process of a dormant registrar died, and nobody has opened it again. Its queries stay held meanwhile.
"""

from __future__ import annotations

import contextlib
import functools
import logging
import time
from collections.abc import Iterable, Mapping
from pathlib import Path

from msgspec.structs import replace

from rr_actors.base.config import CATALOG_FILE, RegistrarConfig, SystemConfig, called
from rr_actors.base.errors import CatalogError, CatalogLocked, ConfigError, NameTaken, RrError, is_a
from rr_actors.base.names import CONNECTED, check_name, is_of_another_host
from rr_actors.base.reporting.log import Log
from rr_actors.registrar.engine.node import Node
from rr_actors.registrar.model.rows import (
    TABLE_OF,
    Change,
    Content,
    Drop,
    Held,
    Notice,
    Peer,
    Put,
    Resource,
    Row,
    ServedQuery,
    content_of,
)
from rr_actors.registrar.registrar import Registrar, registrar_of
from rr_actors.registrar.remote_registrar import RegistrarHandle
from rr_actors.storage.opening import is_there, move_catalog, read_rows, remove_unneeded
from rr_actors.storage.witness import LastOpening, Witness, tell_of_missing
from rr_actors.supervision.given_up import change, contents, give_up
from rr_actors.wire.name_service import Presence

_LOCKED_S = 5.0  # the processes of a killed run end by themselves
_LOOK_AGAIN_S = 0.05
_DORMANT = (
    "registrar %s is dormant: nobody has opened it since its process died; %s. Open it, or release() what it holds; if"
    " its manager has another id now, that one's ChildSpec needs renamed_from=%r; if it has none any more,"
    " release(force=True) forgets what it serves"
)

logger = Log("rr_actors")


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
    node.owners[name] = owner
    return registrar


async def _open_in(node: Node, name: str, config: RegistrarConfig) -> Registrar:
    if node.status_of(name) in (Presence.UP, Presence.STARTING, Presence.STOPPED):
        system = node.info.name
        text = f"registrar {name!r}: the name is taken in system {system!r}; close that one, or choose another"
        raise NameTaken(text, name=name)
    actor = await node.open_registrar(name, config)
    registrar = Registrar(node, actor)
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
    registrar = registrar_of(node.registrars.get(name))
    if registrar is not None:
        return registrar
    if node.status_of(name) in (None, Presence.GONE, Presence.DORMANT):
        raise node.directory.no_registrar(name)
    return RegistrarHandle(node, name, patient=patient, owner=owner)


def left_behind(config: SystemConfig, state_dir: Path, except_for: set[str]) -> dict[str, str]:
    """Return the registrars whose catalog on disk holds or serves something, or cannot be read.

    Those of connected programs are always among them. Each has a text that says what it serves and holds. Log it
    for each that is no connected program's, as a warning if it serves something, and remove the catalogs that have
    nothing to be missed. Blocks.

    Args:
        except_for: names of registrars that are about to be opened.
    """
    found: dict[str, str] = {}
    tell_of_missing(state_dir)
    for name, catalog in catalogs_on_disk(config, state_dir).items():
        if name in except_for:
            continue
        try:
            rows = read_rows(catalog)
            asked = [row.id for row in rows if isinstance(row, Peer)]
            peers = [config.registrar(peer).catalog_path(state_dir) for peer in asked if not is_of_another_host(peer)]
            # Those of other hosts may have something: their catalogs are not here.
            there = len(peers) < len(asked) or any(isinstance(row, Held | Resource | Notice) for row in rows)
            if there or name.startswith(CONNECTED) or any(_has_something(peer, name) for peer in peers):
                found[name] = contents(rows)
                if not name.startswith(
                    CONNECTED
                ):  # one that only holds is mostly the application's, which opens it next
                    serves = any(isinstance(row, Resource) for row in rows)
                    logger.log(logging.WARNING if serves else logging.INFO, _DORMANT, name, found[name], name)
            elif config.registrar(name).location is None:
                remove_unneeded(catalog, Witness(state_dir, name))
        except CatalogError as error:
            logger.warning("%s: not read: %s", name, error)
            found[name] = "its catalog cannot be read"
    return found


def gone_and_serving(node: Node) -> list[str]:
    """Return the registrars that are gone for good, and whose catalogs still serve something. Blocks."""
    found: list[str] = []
    for name in node.directory.registrars():
        catalog = node.config.registrar(name).catalog_path(Path(node.info.state_dir))
        with contextlib.suppress(CatalogError):  # it is being opened, or removed
            if node.status_of(name) is Presence.GONE and is_there(catalog):
                found += [name] * any(isinstance(row, Resource) for row in read_rows(catalog))
    return found


def catalogs_on_disk(config: SystemConfig, state_dir: Path) -> dict[str, Path]:
    """Return the catalogs on disk, by the names of their registrars, which are sorted."""
    placed = {name: config.registrar(name).catalog_path(state_dir) for name in config.registrars}
    others = {place / CATALOG_FILE for place in state_dir.iterdir()} - {*placed.values()}
    found = sorted(({catalog.parent.name: catalog for catalog in others} | placed).items())
    return {name: catalog for name, catalog in found if is_there(catalog)}


def take_over(config: SystemConfig, state_dir: Path, renamed: Mapping[str, str]) -> None:
    """Give what registrars left on disk to those that have their place now, once. Blocks.

    Nobody may have a catalog open. The record of the old name (Witness) is removed last: if a crash comes before, the
    next start goes on.

    Args:
        renamed: old names, by the new ones.

    Raises:
        CatalogLocked: a process of a killed run still has it, also after some seconds.
        CatalogError: the new one has something, too, or files cannot be read or written.
    """
    deadline = time.monotonic() + _LOCKED_S
    for name, old in renamed.items():
        while True:
            try:
                _take_over(config, state_dir, name, old)
                break
            except CatalogLocked:
                if time.monotonic() > deadline:
                    raise
                time.sleep(_LOOK_AGAIN_S)


def _take_over(config: SystemConfig, state_dir: Path, name: str, old: str) -> None:
    before, after = (config.registrar(one).catalog_path(state_dir) for one in (old, name))
    theirs = Witness(state_dir, old)
    if theirs.known() is None:
        if not is_there(before):
            return
        theirs.note(LastOpening("", 0, str(before)))  # without a file it has none, and the next start goes on by that
    if before.parent != after.parent and is_there(before):
        remove_unneeded(after, Witness(state_dir, name))
        move_catalog(before, after)
    changes = functools.partial(_in_the_name_of, name, old)
    if is_there(after):
        change(config.registrar(name), state_dir, changes, formerly=old)
    for peer, catalog in catalogs_on_disk(config, state_dir).items():
        if peer not in (name, old):
            try:
                if changes(content_of(read_rows(catalog)), 0):
                    change(config.registrar(peer), state_dir, changes)
            except CatalogLocked:
                raise
            except CatalogError as error:
                logger.warning("%s: it goes on knowing %s by its old name %s: %s", peer, name, old, error)
    theirs.forget(0)
    logger.info("registrar %s: has taken over what %s left", name, old)


def _in_the_name_of(name: str, old: str, content: Content, _epoch: int) -> list[Change]:
    """Return the changes that give the rows of a catalog a registrar's new name."""

    def renamed(text: str) -> str:
        """Return a registrar's name, or a server's "registrar/server", with the new name."""
        registrar, slash, server = text.partition("/")
        return f"{name}{slash}{server}" if registrar == old else text

    rows: list[tuple[Row, Row]] = [
        *((row, replace(row, registrar=renamed(row.registrar))) for row in content["held"].values()),
        *((row, replace(row, origin=renamed(row.origin))) for row in content["queries"].values()),
        *(
            (row, replace(row, origin=renamed(row.origin), source=renamed(row.source)))
            for row in content["notices"].values()
        ),
        *((row, replace(row, id=renamed(row.id))) for row in content["peers"].values()),
        *((row, replace(row, id=renamed(row.id))) for row in content["server_types"].values()),
    ]
    changed = [(before, now) for before, now in rows if now != before]
    return [it for before, now in changed for it in (Drop(TABLE_OF[type(before)], before.id), Put(now))]


def _has_something(catalog: Path, origin: str) -> bool:
    """Return whether a provider's catalog has a query of `origin`, or a notice for it."""
    rows = read_rows(catalog) if is_there(catalog) else ()
    return any(isinstance(row, ServedQuery | Notice) and row.origin == origin for row in rows)


async def give_up_connected(node: Node, names: Iterable[str]) -> None:
    """Give up the registrars in `names` that connected programs have left, and erase their catalogs.

    On the loop.
    """
    for name in names:
        if name.startswith(CONNECTED):
            try:
                await give_up(node, name, erase=True)
            except RrError as error:  # a damaged catalog, for instance: the system starts all the same
                logger.warning("%s: what it holds is not released, and it stays dormant: %s", name, error)
