"""Inspection: read a system's catalogs from outside, while it runs or later, and check them against each other.

Reading takes no lock and changes nothing. Each catalog is read as it was after some commit, but not all of them at the
same moment. A message in flight between two registrars of a running system may therefore look like a violation:
`check_state` looks a second time before it reports one.
"""

from __future__ import annotations

import os
import time
from collections.abc import Collection, Iterable, Iterator, Mapping
from functools import cached_property
from pathlib import Path
from typing import TypeVar

from rr_actors.base.config import CATALOG_FILE
from rr_actors.base.errors import CatalogError, ConfigError
from rr_actors.base.names import is_of_another_host
from rr_actors.base.values.canonical import shown_plain
from rr_actors.registrar.model.rows import (
    RESTING,
    Held,
    Hold,
    Notice,
    Peer,
    Phase,
    Resource,
    Row,
    ServedQuery,
    State,
    StoredServer,
    content_of,
    is_own,
)
from rr_actors.storage.opening import is_there, read_rows

_SECOND_LOOK_S = 0.5


_R = TypeVar("_R")


class Contents:
    """The rows of one catalog, by id; `damage` says why it could not be read."""

    def __init__(self, name: str, path: Path, rows: Iterable[Row] = (), damage: str = "") -> None:
        self.name = name
        self.path = path
        self.damage = damage
        tables = content_of(rows)
        self.resources: dict[str, Resource] = tables["resources"]
        self.queries: dict[str, ServedQuery] = tables["queries"]
        self.held: dict[str, Held] = tables["held"]
        self.notices: dict[str, Notice] = tables["notices"]
        self.peers: dict[str, Peer] = tables["peers"]
        self.stored_servers: dict[str, StoredServer] = tables["stored_servers"]

    def holders(self, resource_id: str) -> list[ServedQuery]:
        """Return the queries on a resource, in the order of their ids, and so of their creation."""
        return self._holders.get(resource_id, [])

    def parts(self, resource_id: str) -> list[Held]:
        """Return the queries that a resource holds elsewhere, oldest first."""
        return self._parts.get(resource_id, [])

    @cached_property
    def taken(self) -> set[str]:
        """The queries whose resource was taken away, and whose notice of that is not delivered yet."""
        return {notice.query_id for notice in self.notices.values() if notice.released}

    @cached_property
    def _holders(self) -> dict[str, list[ServedQuery]]:
        rows = sorted(self.queries.values(), key=lambda query: query.id)
        return _grouped((query.resource_id, query) for query in rows)

    @cached_property
    def _parts(self) -> dict[str, list[Held]]:
        rows = sorted(self.held.values(), key=lambda held: held.seq)
        return _grouped((held.parent, held) for held in rows)


def _grouped(pairs: Iterable[tuple[str, _R]]) -> dict[str, list[_R]]:
    found: dict[str, list[_R]] = {}
    for key, row in pairs:
        found.setdefault(key, []).append(row)
    return found


def read_state(state_dir: str | os.PathLike[str]) -> dict[str, Contents]:
    """Read every catalog below a state directory, and return them by registrar.

    A catalog that cannot be read is returned with its `damage`. Catalogs whose configured location is elsewhere are not
    found.

    Raises:
        ConfigError: the directory does not exist, cannot be read, or holds no catalog.
    """
    root = Path(os.path.expanduser(state_dir))
    try:
        paths = _catalogs(root) if root.is_dir() else None
    except OSError as error:
        raise ConfigError(f"{root}: cannot be read: {error.strerror}", file=str(root)) from error
    if paths is None:
        got = "a file" if root.exists() else "nothing of that name"
        raise ConfigError(f"{root}: expected a state directory of a system, got {got}", file=str(root))
    if not paths:
        raise ConfigError(
            f"{root}: expected the state directory of a system, got one without a catalog (*/{CATALOG_FILE}); "
            "give the directory that rr.System was given as state_dir",
            file=str(root),
        )
    return {path.parent.name: _read(path) for path in paths}


def _catalogs(root: Path) -> list[Path]:
    """Return the catalogs below `root`, also those without permission, for which the reader raises the error."""
    found: list[Path] = []
    for name in sorted(os.listdir(root)):
        path = root / name / CATALOG_FILE
        try:
            path.stat()
        except (FileNotFoundError, NotADirectoryError):
            if not is_there(path):
                continue
        except OSError:
            pass
        found.append(path)
    return found


def _read(path: Path) -> Contents:
    try:
        return Contents(path.parent.name, path, read_rows(path))
    except CatalogError as error:
        return Contents(path.parent.name, path, damage=str(error))


def check_state(state_dir: str | os.PathLike[str]) -> list[str]:
    """Return a sentence for each violation between the catalogs of a state directory.

    If there are violations, the catalogs are read again after half a second. Only those found twice are returned.

    Raises:
        ConfigError: see read_state.
    """
    found = check(read_state(state_dir))
    if found:
        time.sleep(_SECOND_LOOK_S)
        again = set(check(read_state(state_dir)))
        found = [violation for violation in found if violation in again]
    return found


def check(state: Mapping[str, Contents]) -> list[str]:
    """Return a sentence for each violation between these catalogs.

    Catalogs of other hosts are not there, so what is held there, and by them, is taken to be right.
    Rows that a crash may leave and the next start settles are no violations: a provider's query that its origin does
    not know yet, if the origin knows that provider; a release that is owed; a load that has not been answered.
    """
    return sorted(
        violation
        for contents in state.values()
        for violation in (
            *([f"{contents.name}: cannot be read: {contents.damage}"] if contents.damage else ()),
            *_check_resources(contents),
            *_check_queries(contents, state),
            *_check_held(contents, state),
            *_check_notices(contents),
        )
    )


def _check_resources(contents: Contents) -> Iterator[str]:
    shared: dict[tuple[str, bytes], str] = {}
    held = {query.resource_id for query in contents.queries.values()}
    for resource in contents.resources.values():
        what = f"{contents.name}/{resource.server}: resource {resource.id}"
        loaded = resource.phase is Phase.LOADED or resource.phase in RESTING
        if loaded and resource.response is None:
            yield f"{what} is {resource.phase} without a response"
        if resource.phase is Phase.QUEUED and resource.id not in held:
            yield f"{what} waits to be loaded and nobody wants it"
        if loaded and resource.state is not State.FATAL:
            other = shared.setdefault((resource.server, resource.request), resource.id)
            if other != resource.id:
                yield f"{what} is loaded for the same request as {other}"


def _check_queries(contents: Contents, state: Mapping[str, Contents]) -> Iterator[str]:
    for query in contents.queries.values():
        what = f"{contents.name}: query {query.id} of {query.origin}"
        if query.resource_id not in contents.resources:
            yield f"{what} points to resource {query.resource_id}, which does not exist"
        origin = state.get(query.origin)
        if is_of_another_host(query.origin):
            continue
        if origin is None:
            yield f"{what} belongs to a registrar without a catalog here"
        elif not origin.damage and query.id not in origin.held and contents.name not in origin.peers:
            yield f"{what} is unknown there, and {query.origin} does not know that it asked {contents.name}"


def _check_held(contents: Contents, state: Mapping[str, Contents]) -> Iterator[str]:
    for held in contents.held.values():
        what = f"{contents.name}: held query {held.id}"
        if held.parent and held.hold is not Hold.OWED and held.parent not in contents.resources:
            yield f"{what} belongs to resource {held.parent}, which does not exist"
        provider = state.get(held.registrar)
        if (
            held.hold is not Hold.HELD
            or (provider is not None and provider.damage)
            or is_of_another_host(held.registrar)
        ):
            continue
        if provider is None:
            yield f"{what} is on {held.registrar}/{held.server}, a registrar without a catalog here"
        elif held.id not in provider.queries and held.id not in provider.taken:
            yield f"{what} is unknown to its provider {held.registrar}/{held.server}"


def _check_notices(contents: Contents) -> Iterator[str]:
    for notice in contents.notices.values():
        if is_own(notice) and notice.resource_id not in contents.resources:
            yield f"{contents.name}: notice {notice.id} is about resource {notice.resource_id}, which does not exist"
        elif not is_own(notice) and notice.query_id not in contents.queries and notice.query_id not in contents.taken:
            yield f"{contents.name}: notice {notice.id} is about query {notice.query_id}, which does not exist"


def check_delivered(state: Mapping[str, Contents], down: Collection[str] = ()) -> Iterator[str]:
    """Yield a sentence for each row that one of two registrars lacks or owes, if neither of them is `down`.

    What is in flight looks the same: a row counts if it is found again and again, for longer than a message takes.
    """
    for name in state.keys() - down:
        contents = state[name]
        for query in contents.queries.values():
            resource = contents.resources.get(query.resource_id)
            is_moving = resource is not None and resource.phase not in (Phase.LOADED, *RESTING)
            if query.origin in down or is_moving or is_of_another_host(query.origin):
                continue
            origin = state.get(query.origin)
            mine = origin.held.get(query.id) if origin is not None else None
            if mine is None:
                yield f"{name}: query {query.id} is unknown to {query.origin}, which should hold it"
            elif mine.hold is Hold.HELD and (mine.resource_id, mine.parent) != (query.resource_id, query.parent):
                yield f"{name}: query {query.id} is on another resource, or for another, than {query.origin} says"
        for held in contents.held.values():
            if held.hold is Hold.OWED and held.registrar not in down and not is_of_another_host(held.registrar):
                yield f"{name}: its query {held.id} at {held.registrar} is {held.hold}"
        for notice in contents.notices.values():
            if notice.origin not in down and not is_of_another_host(notice.origin):
                whom = notice.origin or f"the server of resource {notice.resource_id}"
                yield f"{name}: notice {notice.id} for {whom} is not delivered"


def readable(encoded: bytes | None, limit: int = 60) -> str:
    """Return a request or response for people: its values without their types, cut at `limit` characters."""
    if encoded is None:
        return ""
    value = shown_plain(encoded)
    if value is None and encoded != b"\xc0":
        return f"<{len(encoded)} bytes>"
    text = repr(value)
    return text if len(text) <= limit else text[: limit - 1] + "…"
