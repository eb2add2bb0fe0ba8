"""Damage: bits flipped, files cut off, removed and swapped, in every file of catalogs in every state; then opened.

Each time one of three things must come of it: the right rows; an error that names the catalog; or a warning that says
what is lost. Never silence, but for the newest journal cut off exactly at the end of a record, which nobody can tell
from a commit that never was.

    python -m fuzz.damage [--times 10000] [--seed 1]
"""

from __future__ import annotations

import argparse
import logging
import os
import random
import shutil
import sqlite3
import struct
import sys
import tempfile
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from rr_actors.base.errors import CatalogError
from rr_actors.registrar.model.rows import Change, Drop, Peer, Phase, Put, Resource, Row, ServedQuery, State, rows_of
from rr_actors.registrar.model.store import Store
from rr_actors.storage.opening import Durability, open_store
from rr_actors.storage.sqlite_store import SqliteTables, segments_among
from rr_actors.storage.witness import Witness

_NAME = "catalog.sqlite3"
_HEADER_BYTES = 56  # of a segment
_REGISTRARS = ("cameras", "arms")
_log = logging.getLogger(__name__)


class Scene(NamedTuple):
    """A state directory as it was left: the rows of each registrar, and of which durability it is."""

    name: str
    directory: Path
    rows: dict[str, set[Row]]
    durability: Durability


class Hurt(NamedTuple):
    """What was done: to which registrars' catalogs, and whether it may go unnoticed."""

    what: str
    excused: bool = False


# -- the states ----------------------------------------------------------------------------------------------------


def _changes(registrar: str, number: int) -> list[Change]:
    id_ = f"{registrar}-{number}"
    puts: list[Change] = [
        Put(ServedQuery(id_, "r", "app", "", 1, number)),
        Put(Resource(id_, "thing", id_.encode() * 20, None, Phase.LOADED, State.OK, "", 1)),
        Put(Peer(f"peer-{registrar}-{number % 5}")),
    ]
    return [*puts, Drop("queries", f"{registrar}-{number - 3}")] if number % 3 == 0 else puts


def _play(store: Store, registrar: str, commits: range, *, folding: bool) -> None:
    for number in commits:
        store.commit(_changes(registrar, number))
        if folding and number % 4 == 0:
            (store.upkeep if number % 8 else store.tidy)()


def _closed(path: Path, registrar: str, witness: Witness, durability: Durability) -> None:
    store = open_store(path, durability=durability, witness=witness)
    _play(store, registrar, range(1, 10), folding=True)
    store.close()


def _killed(path: Path, registrar: str, witness: Witness, durability: Durability) -> Store:
    """Killed after folds, with something in its journal, and after an opening that was closed."""
    _closed(path, registrar, witness, durability)
    store = open_store(path, durability=durability, witness=witness)
    _play(store, registrar, range(10, 24), folding=True)
    return store


def _killed_young(path: Path, registrar: str, witness: Witness, durability: Durability) -> Store:
    """Killed in its first opening, before anything was folded."""
    store = open_store(path, durability=durability, witness=witness)
    _play(store, registrar, range(1, 6), folding=False)
    return store


def _killed_while_folding(path: Path, registrar: str, witness: Witness, durability: Durability) -> Store:
    """Killed with several segments, as the SQLite file could not be written for a while."""
    store = _killed(path, registrar, witness, durability)
    fold = SqliteTables.fold

    def full(*_: Any) -> None:
        raise CatalogError("full", path="")

    SqliteTables.fold = full  # type: ignore[method-assign]  # pyright: ignore[reportAttributeAccessIssue]
    try:
        for number in range(24, 30):
            store.commit(_changes(registrar, number))
            if number % 2:
                try:
                    store.tidy()
                except CatalogError:
                    _log.debug("as it should be")
    finally:
        SqliteTables.fold = fold
    return store


_KILLED: dict[str, Callable[[Path, str, Witness, Durability], Store]] = {
    "killed": _killed,
    "killed young": _killed_young,
    "killed while folding": _killed_while_folding,
}


def scenes(place: Path) -> Iterator[Scene]:
    """Make each state once."""
    durabilities: tuple[Durability, ...] = ("process", "power")
    for durability in durabilities:
        for name in ("closed", *_KILLED):
            yield _scene(place / str(len(list(place.iterdir()))), name, durability)


def _scene(directory: Path, name: str, durability: Durability) -> Scene:
    live = directory / "live"
    live.mkdir(parents=True)
    stores: list[Store] = []
    rows: dict[str, set[Row]] = {}
    try:
        for registrar in _REGISTRARS:
            path, witness = live / registrar / _NAME, Witness(live, registrar)
            if name == "closed":
                _closed(path, registrar, witness, durability)
                store = open_store(path, durability=durability, witness=witness)
                rows[registrar] = set(rows_of(store.load()))
                store.close()
            else:
                store = _KILLED[name](path, registrar, witness, durability)
                rows[registrar] = set(rows_of(store.load()))
                stores.append(store)
        shutil.copytree(live, directory / "left")
    finally:
        for store in stores:
            store.close()
    shutil.rmtree(live)
    return Scene(f"{name}, {durability}", directory / "left", rows, durability)


# -- what is done to it --------------------------------------------------------------------------------------------


def _flip(file: Path, chance: random.Random, _scene: Scene) -> Hurt:
    data = bytearray(file.read_bytes())
    at, bit = chance.randrange(len(data)), chance.randrange(8)
    data[at] ^= 1 << bit
    file.write_bytes(data)
    return Hurt(f"bit {bit} of byte {at} of {file.name} flipped")


def _cut(file: Path, chance: random.Random, scene: Scene) -> Hurt:
    data = file.read_bytes()
    size = chance.randrange(len(data))
    file.write_bytes(data[:size])
    return Hurt(f"{file.name} cut to {size} of {len(data)} bytes", _is_at_an_end(file, data, size))


def _remove(file: Path, _chance: random.Random, _scene: Scene) -> Hurt:
    file.unlink()
    return Hurt(f"{file.name} removed")


def _empty(file: Path, chance: random.Random, _scene: Scene) -> Hurt:
    size = file.stat().st_size
    file.write_bytes(bytes(size) if chance.random() < 0.5 else b"")
    return Hurt(f"{file.name} made zeros, or empty")


def _swap(file: Path, _chance: random.Random, scene: Scene) -> Hurt:
    other = next(name for name in _REGISTRARS if name != file.parent.name)
    theirs = file.parent.with_name(other) / file.name
    if not theirs.exists():
        return Hurt(f"{file.name} left as it was")
    spare = file.with_name("spare")
    file.rename(spare)
    theirs.rename(file)
    spare.rename(theirs)
    return Hurt(f"{file.name} of two registrars swapped")


def _swap_inside(file: Path, chance: random.Random, _scene: Scene) -> Hurt:
    others = [path for path in file.parent.iterdir() if "journal" in path.name and path != file]
    if "journal" not in file.name or not others:
        return Hurt(f"{file.name} left as it was")
    other, spare = chance.choice(sorted(others)), file.with_name("spare")
    file.rename(spare)
    other.rename(file)
    spare.rename(other)
    return Hurt(f"{file.name} and {other.name} swapped")


def _remove_directory(file: Path, _chance: random.Random, _scene: Scene) -> Hurt:
    shutil.rmtree(file.parent)
    return Hurt(f"{file.parent.name}/ removed")


def _swap_directories(file: Path, _chance: random.Random, _scene: Scene) -> Hurt:
    one, two = (file.parent.with_name(name) for name in _REGISTRARS)
    spare = file.parent.with_name("spare")
    one.rename(spare)
    two.rename(one)
    spare.rename(two)
    return Hurt("the directories of two registrars swapped")


HURTS: Sequence[tuple[int, Callable[[Path, random.Random, Scene], Hurt]]] = (
    (60, _flip),
    (20, _cut),
    (6, _remove),
    (4, _empty),
    (5, _swap),
    (3, _swap_inside),
    (1, _remove_directory),
    (1, _swap_directories),
)
"""How often each is done, of a hundred times."""


def _is_at_an_end(file: Path, data: bytes, size: int) -> bool:
    """Whether it is the newest journal, cut exactly at the end of a record."""
    newest = segments_among(os.listdir(file.parent), file.with_name(_NAME))[-1:]
    return [file.name] == newest and size in _ends(data)


def _ends(data: bytes) -> Iterator[int]:
    at = _HEADER_BYTES
    while at <= len(data):
        yield at
        if at + 12 > len(data):
            return
        at += 12 + struct.unpack_from("<I", data, at)[0]


# -- what comes of it ----------------------------------------------------------------------------------------------


class Warnings(logging.Handler):
    """The warnings of the stores."""

    def __init__(self) -> None:
        super().__init__(logging.WARNING)
        self.texts: list[str] = []

    def emit(self, record: logging.LogRecord) -> None:
        self.texts.append(record.getMessage())


def outcome(state_dir: Path, scene: Scene, warnings: list[str]) -> dict[str, str]:
    """Open the catalogs; return what comes of each: "right", "error", "warning", or what is wrong."""
    found: dict[str, str] = {}
    for registrar in _REGISTRARS:
        warnings.clear()
        path = state_dir / registrar / _NAME
        try:
            store = open_store(path, durability=scene.durability, witness=Witness(state_dir, registrar))
        except CatalogError as error:
            found[registrar] = "error" if str(path) in str(error) else f"an error that does not name it: {error}"
            continue
        except (sqlite3.Error, OSError) as error:
            found[registrar] = f"an error of no name: {error!r}"
            continue
        try:
            rows = set(rows_of(store.load()))
        finally:
            store.close()
        right = rows == scene.rows[registrar]
        told = any(str(path) in text or text.startswith(f"{registrar}: ") for text in warnings)
        found[registrar] = "right" if right else "warning" if told else f"SILENCE: {len(rows)} rows"
    return found


class Result(NamedTuple):
    """How often what came of what, and what must not have been."""

    counts: Counter[tuple[str, str]]
    failures: list[str]


def run(times: int, seed: int, place: Path) -> Result:
    """Hurt the catalogs so many times, in every state in turn.

    Args:
        place: an empty directory.
    """
    all_scenes = list(scenes(place))
    counts: Counter[tuple[str, str]] = Counter()
    failures: list[str] = []
    handler = Warnings()
    logger = logging.getLogger("rr_actors.storage")
    logger.addHandler(handler)
    propagates, logger.propagate = logger.propagate, False
    try:
        for number in range(times):
            chance = random.Random(f"{seed}-{number}")
            scene = all_scenes[number % len(all_scenes)]
            work = place / "work"
            shutil.copytree(scene.directory, work)
            files = sorted(path for path in work.rglob("*") if path.is_file() and path.stat().st_size)
            file = chance.choice([path for path in files if path.parent.name in _REGISTRARS or chance.random() < 0.3])
            ((_, hurt),) = chance.choices(HURTS, [weight for weight, _ in HURTS])
            if file.parent.name not in _REGISTRARS and hurt not in (_flip, _cut, _remove, _empty):
                hurt = _flip
            done = hurt(file, chance, scene)
            for registrar, came in outcome(work, scene, handler.texts).items():
                excused = done.excused and came.startswith("SILENCE")
                if excused or came in ("right", "error", "warning"):
                    counts[hurt.__name__.strip("_"), "excused" if excused else came] += 1
                else:
                    failures.append(f"{number}: {scene.name}: {done.what}: {registrar}: {came}")
            shutil.rmtree(work)
    finally:
        logger.removeHandler(handler)
        logger.propagate = propagates
    return Result(counts, failures)


def main() -> int:
    """Run it from the command line; return the exit code."""
    parser = argparse.ArgumentParser(prog="python -m fuzz.damage", description="Hurt catalogs, and open them.")
    parser.add_argument("--times", type=int, default=10_000)
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    memory = Path("/dev/shm")
    with tempfile.TemporaryDirectory(prefix="rr-damage-", dir=memory if os.access(memory, os.W_OK) else None) as place:
        counts, failures = run(options.times, options.seed, Path(place))
    outcomes = ("right", "error", "warning", "excused")
    print(f"{'':18}" + "".join(f"{outcome:>9}" for outcome in outcomes))
    for hurt in sorted({hurt for hurt, _ in counts}):
        print(f"{hurt:18}" + "".join(f"{counts[hurt, outcome]:9}" for outcome in outcomes))
    for failure in failures:
        print(failure)
    print(f"{options.times} times; {len(failures)} must not have been")
    return 1 if failures else 0


if __name__ == "__main__":
    sys.exit(main())
