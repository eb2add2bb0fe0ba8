"""Plant: the system that is harmed. Dependencies are three deep; makers and crews run in processes of their own.

root ── east, west                     serve things made of nothing
 │      mill, forge                    need east; east and west
 │      harbour, market                need mill and forge; forge
 │      crew-1                         uses harbour, mill
 └─ inner (a process of its own)
        north                          serves things made of nothing; market needs it
        crew-2                         uses market, forge
"""

from __future__ import annotations

import shutil
import signal
import tempfile
import threading
import time
from collections.abc import Callable
from pathlib import Path

from rr_actors.base.errors import RrError
from rr_actors.supervision.core.specs import ChildSpec, Supervisor
from rr_actors.system.system import System
from rr_actors.testing.callback_log import check_journal, read_journal
from rr_actors.testing.invariants import check_at_rest, check_empty, check_told, settled
from rr_actors.testing.load_threads import Consumer
from rr_actors.testing.process_census import Census, Mark
from rr_actors.testing.report import Tally
from rr_actors.testing.victim_managers import Crew, Maker
from rr_actors.testing.watchdog import Watch
from rr_actors.tools.inspection import Contents, check_state, read_state

ROOT_MAKERS = {
    "east": (),
    "west": (),
    "mill": ("east/thing",),
    "forge": ("east/thing", "west/warm"),
    "harbour": ("mill/thing", "forge/thing"),
    "market": ("forge/warm", "north/thing"),
}
CREWS = ("crew-1", "crew-2")
MANAGERS = (*ROOT_MAKERS, "north", *CREWS)
_USED = ("harbour/thing", "market/thing", "harbour/warm", "mill/thing", "forge/thing", "forge/warm", "east/warm")
_APPS = 3
_THREADS = 6
_SETTLE_S = 30.0
_ABANDON_S = 20.0


class Plant:
    """One system with its consumers. Its with block stops everything.

    Args:
        state_dir: for the catalogs; if None, a temporary directory (see discard).
    """

    def __init__(self, state_dir: Path | None, seed: int, tally: Tally) -> None:
        self._temporary = Path(tempfile.mkdtemp(prefix="rr-chaos-")) if state_dir is None else None
        self.state_dir = state_dir.absolute() if state_dir is not None else Path(str(self._temporary), "state")
        self.journal_dir = self.state_dir.with_name(f"{self.state_dir.name}-journal")
        self.journal_dir.mkdir(parents=True, exist_ok=True)
        self.tally = tally
        self.mark = Mark(self.journal_dir)
        self.system = System(self._tree(), name="chaos", state_dir=self.state_dir)
        self._seed = seed
        self.consumers: list[Consumer] = []

    def _tree(self) -> Supervisor:
        place = str(self.journal_dir)
        makers = [
            ChildSpec(Maker, id=name, args=(place, needs), shutdown_s=2.0, heartbeat_s=1.0 if name == "mill" else None)
            for name, needs in ROOT_MAKERS.items()
        ]
        crew_1 = ChildSpec(Crew, id="crew-1", args=(place, ("harbour/thing", "mill/warm")))
        inner = Supervisor(
            [
                ChildSpec(Maker, id="north", args=(place,)),
                ChildSpec(Crew, id="crew-2", args=(place, ("market/warm", "forge/thing"))),
            ],
            id="inner",
            placement="process",
            max_restarts=1_000_000,
        )
        return Supervisor([inner, *makers, crew_1], id="root", max_restarts=1_000_000)

    def __enter__(self) -> Plant:
        self.system.start()
        apps = [self.system.open_registrar(f"app-{n}") for n in range(1, _APPS + 1)]
        for n in range(_THREADS):
            self.consumers.append(Consumer(self.system, apps[n % _APPS], _USED, self._seed * 1000 + n, self.tally))
        for consumer in self.consumers:
            consumer.start()
        return self

    def __exit__(self, *exc: object) -> None:
        for consumer in self.consumers:
            consumer.stop()
        self.system.stop()
        self.mark.remove()
        left = settled(lambda: [f"process {pid} is left" for pid in self.mark.processes()], 5.0)
        self.tally.violation(*left)

    def census(self) -> Census:
        """Return the living processes by role."""
        return self.mark.census(self.state_dir, MANAGERS)

    def start_again(self, name: str) -> None:
        """Start a stopped manager below the root; note a violation if 50 attempts fail."""
        supervisor = self.system.supervisor()
        error: Exception | None = None
        for _ in range(50):
            try:
                supervisor.restart_child(name)
                return
            except Exception as caught:
                error = caught
            if any(child.id == name and child.state != "stopped" for child in supervisor.which_children()):
                return
            time.sleep(0.05)
        self.tally.violation(f"{name}: could not be started again: {error!r}")

    def abandon(self) -> None:
        """Kill the processes of a system that stands still, and try to stop it in this process, for 20 s at most."""
        for consumer in self.consumers:
            consumer.stop()
        self.mark.remove()
        stopping = threading.Thread(target=self.system.stop, name="chaos: stopping", daemon=True)
        stopping.start()
        deadline = time.monotonic() + _ABANDON_S
        while (living := self.mark.processes()) and time.monotonic() < deadline:
            for pid in living:
                self.mark.signal(pid, signal.SIGKILL)
            stopping.join(0.1)
        stopping.join(max(0.0, deadline - time.monotonic()))

    def check(self, watch: Watch, show: Callable[[str], None]) -> bool:
        """Let everything come to rest, check, release everything, check again. Return whether all was checked.

        Violations go to the tally. If the system has any at rest, nothing is released, so that it can be looked into.
        """

        def begin(what: str) -> None:
            watch.phase(what)
            show(what)

        if self.tally.violations:
            return False
        begin("waiting for the consumers")
        self._rest(watch)
        if self.tally.violations:
            return False
        begin("checking what is held")
        told = self._told()
        look = self._look
        self.tally.violation(*settled(lambda: [*check_at_rest(look()), *check_told(look(), told)], _SETTLE_S))
        self.tally.violation(*check_state(self.state_dir))
        self.tally.violation(
            *settled(lambda: [f"daemon {pid} outlives its manager" for pid in self.mark.strays()], 5.0)
        )
        for consumer in self.consumers:
            consumer.check_heard()
        living = {name: set(contents.resources) for name, contents in look().items()}
        self.tally.violation(*check_journal(read_journal(self.journal_dir), living))
        if self.tally.violations:
            return False
        begin("releasing everything")
        for consumer in self.consumers:
            consumer.release()
        for crew in CREWS:
            watch.phase(f"releasing what {crew} holds")
            self._tell(crew, "release")
        watch.phase("checking that nothing is left")
        self.tally.violation(*settled(lambda: [f"after release: {left}" for left in check_empty(look())], _SETTLE_S))
        self.tally.violation(*check_journal(read_journal(self.journal_dir), {}))
        return True

    def _look(self) -> dict[str, Contents]:
        for name in [*MANAGERS, *(f"app-{n}" for n in range(1, _APPS + 1))]:
            try:
                self.system.registrar(name).save_catalog()  # commits what might be written a moment later
            except RrError:
                continue
        return read_state(self.state_dir)

    def _rest(self, watch: Watch) -> None:
        deadline = time.monotonic() + 60.0
        for consumer in self.consumers:
            consumer.stop()
        for consumer in self.consumers:
            consumer.join(deadline)
        for crew in CREWS:
            watch.phase(f"waiting for {crew}")
            self._tell(crew, "rest")

    def _tell(self, crew: str, what: str) -> None:
        """Send a crew a message, and repeat that while the crew is being restarted."""
        path = crew if crew == "crew-1" else f"inner/{crew}"
        error: Exception | None = None

        def ask() -> list[str]:
            nonlocal error
            try:
                self.system.ref(f"root/{path}").ask(what, timeout=40)
            except Exception as caught:
                error = caught
                return [f"{crew}: {what}: {error!r}"]
            return []

        self.tally.violation(*settled(ask, _SETTLE_S))

    def _told(self) -> dict[str, set[str]]:
        told: dict[str, set[str]] = {f"app-{n}": set() for n in range(1, _APPS + 1)}
        for consumer in self.consumers:
            for query, _ in consumer.held:
                told[query.origin].add(query.id)
        return told

    def discard(self) -> None:
        """Remove the temporary directory, if the state is in one."""
        if self._temporary is not None:
            shutil.rmtree(self._temporary, ignore_errors=True)
