"""The monkey: harms a plant with faults that it draws from a seed."""

from __future__ import annotations

import heapq
import random
import resource
import signal
import socket
import time
from collections.abc import Callable, Sequence
from pathlib import Path

from chaos.mission.mission_managers import PLANNERS
from chaos.report import KILLS, Tally
from chaos.victim_managers import LESS, WATTS, cut_links
from chaos.victim_system import CREWS, HOUSE, MAKERS, ROOT_MAKERS, Plant
from rr_actors.base.errors import CatalogDamaged, CatalogError, RrError
from rr_actors.storage.opening import read_rows
from rr_actors.wire.handshake import PROTOCOL

_FULL_BYTES = 16 * 1024
"""The largest size of a process's files on a full disk. The SQLite file of its catalog is larger, so nothing can be
folded. A segment of the catalog's journal (journaled_store.py) soon is. A file of the callbacks' journal never is."""


class Monkey:
    """Does one deed at a time. A deed that lasts (a stop, a full disk) is undone after its time, or by `recover`.

    Args:
        pace_s: the mean seconds between two deeds.
    """

    def __init__(self, plant: Plant, tally: Tally, seed: int, pace_s: float) -> None:
        self._plant = plant
        self._tally = tally
        self._plan = random.Random(seed)
        self._pace_s = pace_s
        self._due: list[tuple[float, int, Callable[[], object]]] = []
        self._garbage: list[socket.socket] = []
        self._deeds: dict[Callable[[], str | None], int] = {
            self._kill_manager: 50,
            self._kill_house: 30,
            self._kill_planner: 40,
            self._kill_crew: 12,
            self._kill_starting: 6,
            self._kill_supervisor: 4,
            self._kill_fork_server: 3,
            self._stop: 9,
            self._cut: 8,
            self._babble: 6,
            self._fill_disk: 5,
            self._damage: 3,
            self._let_stray: 8,
            self._change_watts: 8,
        }

    def pause(self, meanwhile: Callable[[], None]) -> None:
        """Wait a little before the next deed. `meanwhile` is called again and again; what it raises ends the wait."""
        until = time.monotonic() + self._plan.uniform(0.0, 2 * self._pace_s)
        while (left := until - time.monotonic()) > 0:
            meanwhile()
            self._undo_due()
            time.sleep(min(left, 0.02))

    def step(self) -> None:
        """Do one deed."""
        (deed,) = self._plan.choices([*self._deeds], [*self._deeds.values()])
        done = deed()
        if done is not None:
            self._tally.fault(done)

    def recover(self) -> None:
        """Undo at once all deeds that last, and close the connections with garbage."""
        while self._due:
            heapq.heappop(self._due)[2]()
        for peer in self._garbage:
            peer.close()

    def _later(self, delay_s: float, undo: Callable[[], object]) -> None:
        heapq.heappush(self._due, (time.monotonic() + delay_s, len(self._due) + self._plan.getrandbits(30), undo))

    def _undo_due(self) -> None:
        while self._due and self._due[0][0] <= time.monotonic():
            heapq.heappop(self._due)[2]()

    # -- signals ---------------------------------------------------------------------------------------------------

    def _kill_manager(self) -> str | None:
        return self._kill("a manager", self._pids(MAKERS))

    def _kill_house(self) -> str | None:
        """Kill one of those that plan, revoke, pause and resume."""
        return self._kill("a manager of the house", self._pids(HOUSE))

    def _kill_planner(self) -> str | None:
        """Kill one of those that choose, keep, and run graphs."""
        return self._kill("a manager of the mission", self._pids(PLANNERS))

    def _kill_crew(self) -> str | None:
        return self._kill("a consumer", self._pids(CREWS))

    def _pids(self, names: tuple[str, ...]) -> list[int]:
        return [pid for name, pid in self._plant.census().managers.items() if name in names]

    def _kill_starting(self) -> str | None:
        inner = self._inner()
        return self._kill("a process that starts", [pid for pid in self._plant.census().others if pid != inner])

    def _kill_supervisor(self) -> str | None:
        return self._kill("a nested supervisor", [pid for pid in (self._inner(),) if pid])

    def _kill_fork_server(self) -> str | None:
        return self._kill("the fork server", [*self._plant.census().fork_servers])

    def _kill(self, whom: str, pids: list[int]) -> str | None:
        if pids and self._plant.mark.signal(self._plan.choice(pids), signal.SIGKILL):
            return f"{KILLS} to {whom}"
        return None

    def _inner(self) -> int:
        children = self._plant.system.supervisor().which_children()
        return next((child.pid or 0 for child in children if child.id == "inner"), 0)

    def _stop(self) -> str | None:
        pids = [*self._plant.census().managers.values(), self._inner()]
        pid = self._plan.choice(pids)
        if not pid or not self._plant.mark.signal(pid, signal.SIGSTOP):
            return None
        self._later(self._plan.uniform(0.05, 1.5), lambda: self._plant.mark.signal(pid, signal.SIGCONT))
        return "SIGSTOP, SIGCONT"

    def _let_stray(self) -> str | None:
        """Have a manager start a daemon, which must not outlive the manager."""
        return "daemon started by a manager" if self._tell("stray", [*ROOT_MAKERS]) else None

    def _tell(self, what: str, names: Sequence[str]) -> bool:
        name = self._plan.choice(names)
        try:
            self._plant.system.ref(f"root/{name}").tell(what)
        except Exception:
            return False  # it is being respawned
        return True

    def _change_watts(self) -> str | None:
        changed = self._plant.set_capacity(self._plan.choice([WATTS.capacity, LESS]))
        return "capacity of a pool changed" if changed else None

    # -- connections -----------------------------------------------------------------------------------------------

    def _cut(self) -> str | None:
        if self._plan.random() < 0.5:
            return "links of this process cut" if cut_links() else None
        return "links of a manager cut" if self._tell("cut", [*ROOT_MAKERS, *PLANNERS]) else None

    def _babble(self) -> str | None:
        sockets = sorted((self._plant.state_dir / "run").glob("*/*.sock"))
        if not sockets:
            return None
        peer = socket.socket(socket.AF_UNIX)
        peer.settimeout(0.5)
        head = b"rr_actor" + self._plan.choice([PROTOCOL, PROTOCOL - 1, 0xFFFF]).to_bytes(2, "big")
        words = self._plan.choice([b"", self._plan.randbytes(500), head, head + self._plan.randbytes(5000)])
        try:
            peer.connect(str(self._plan.choice(sockets)))
            peer.sendall(words)
        except OSError:
            peer.close()
            return None
        self._garbage.append(peer)  # stays open, and sends nothing more
        if len(self._garbage) > 20:
            self._garbage.pop(0).close()
        return "garbage from a stranger"

    # -- disks -----------------------------------------------------------------------------------------------------

    def _fill_disk(self) -> str | None:
        managers = self._plant.census().managers
        if not managers:
            return None
        pid = self._plan.choice([*managers.values()])
        if not self._limit_files(pid, _FULL_BYTES):
            return None
        self._later(self._plan.uniform(0.1, 1.0), lambda: self._limit_files(pid, None))
        return "disk full for a manager"

    def _limit_files(self, pid: int, size: int | None) -> bool:
        if not self._plant.mark.is_on(pid):
            return False
        try:
            hard = resource.prlimit(pid, resource.RLIMIT_FSIZE)[1]
            resource.prlimit(pid, resource.RLIMIT_FSIZE, (hard if size is None else size, hard))
        except (OSError, ValueError):
            return False
        return True

    def _damage(self) -> str | None:
        """Stop a manager, spoil a byte of its catalog, check that it is refused, put the byte back, start it again."""
        name = self._plan.choice([*ROOT_MAKERS])
        supervisor = self._plant.system.supervisor()
        catalog = self._plant.state_dir / name / "catalog.sqlite3"
        try:
            supervisor.terminate_child(name)
        except RrError as error:
            self._tally.violation(f"{name}: could not be terminated: {error!r}")
            return None
        try:
            return self._spoil(name, catalog)
        finally:
            self._plant.start_again(name)

    def _spoil(self, name: str, catalog: Path) -> str | None:
        if not catalog.exists() or [*catalog.parent.glob("catalog.sqlite3-wal"), *catalog.parent.glob("*.journal.*")]:
            return None  # the manager was killed before it had closed its catalog
        good = catalog.read_bytes()
        bad = self._spoil_byte(good, catalog)
        try:
            self._plant.system.supervisor().restart_child(name)
        except Exception as error:
            refused = f"{error!r} {error.__cause__!r} {getattr(error, '__notes__', '')}"
            if CatalogDamaged.__name__ not in refused and "expected a catalog" not in refused:
                self._tally.violation(f"{name}: its damaged catalog was refused otherwise than expected: {refused}")
        else:
            self._tally.violation(f"{name}: started with a damaged catalog")
        if catalog.read_bytes() != bad:
            self._tally.violation(f"{name}: its damaged catalog was not left as it was")
        catalog.write_bytes(good)
        return "byte of a closed catalog spoilt"

    def _spoil_byte(self, good: bytes, catalog: Path) -> bytes:
        """Change a byte that makes the catalog damaged, which few do: most of a small catalog is free space."""
        for _ in range(200):
            bad = bytearray(good)
            bad[self._plan.randrange(len(bad))] ^= self._plan.randrange(1, 256)
            catalog.write_bytes(bad)
            try:
                read_rows(catalog)
            except CatalogDamaged:
                return bytes(bad)
            except CatalogError:
                continue  # this byte makes it a catalog of another version
        catalog.write_bytes(bad := b"?" + good[1:])
        return bad
