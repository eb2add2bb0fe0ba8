"""Plant: the system that is harmed. Dependencies are three deep; managers run in processes of their own.

root ── east, west                     serve things made of nothing
 │      mill, forge                    need east; east and west
 │      harbour, market                need mill and forge; forge
 │      crew-1                         uses harbour, mill
 │      budgets, programs, house       devices of the house need watts, and programs, which pause
 │      sensors-1, sensors-2           are chosen, kept, and loaded by actions, by the three
 │      choices, keeper, actions
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

from chaos.callback_log import check_journal, read_journal
from chaos.invariants import check_at_rest, check_empty, check_house, check_told, settled, used_by
from chaos.load_threads import Consumer, Resident
from chaos.mission.mission_managers import PLANNERS, SENSORS
from chaos.mission.mission_part import APP_NAMES, Mission
from chaos.mission.mission_threads import Operator
from chaos.process_census import Census, Mark, stands
from chaos.report import Tally
from chaos.victim_managers import LESS, RESERVE, WATTS, Crew, House, Maker
from chaos.watchdog import Watch
from rr_actors.base.errors import RrError
from rr_actors.managers import Budgets, Programs
from rr_actors.supervision.core.specs import ChildSpec, Supervisor
from rr_actors.system.system import System
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
MAKERS = (*ROOT_MAKERS, "north", *SENSORS)
HOUSE = ("budgets", "programs", "house")
MANAGERS = (*MAKERS, *CREWS, *HOUSE, *PLANNERS)
_USED = ("harbour/thing", "market/thing", "harbour/warm", "mill/thing", "forge/thing", "forge/warm", "east/warm")
_APPS = 3
_THREADS = 6
_RESIDENTS = 2
_APP_NAMES = (*(f"app-{n}" for n in range(1, _APPS + 1)), *(f"home-{n}" for n in range(1, _RESIDENTS + 1)), *APP_NAMES)
_GRACE_S = 60.0  # longer than any restart: what is revoked is unloaded, top first, and never by force
_WATCH_S = 0.05
_PROGRAMS = {"idle": "pause", "linger_s": 0.1, "paused_s": 2.0}
SETTLE_S = 30.0
ABANDON_S = 20.0


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
        self.mission = Mission(self.journal_dir, tally)
        self.system = System(self._tree(), name="chaos", state_dir=self.state_dir)
        self._seed = seed
        self.consumers: list[Consumer] = []
        self.residents: list[Resident] = []
        self._capacity = self._limit = WATTS.capacity  # that was set, and that holds
        self._lock = threading.Lock()
        self._at_rest = threading.Event()
        self._watcher = threading.Thread(target=self._watch_house, name="chaos: the house", daemon=True)

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
        house = [
            ChildSpec(Budgets, id="budgets", args=([WATTS], _GRACE_S)),
            ChildSpec(Programs, id="programs", kwargs=_PROGRAMS),
            ChildSpec(House, id="house"),
        ]
        children = [inner, *makers, crew_1, *house, *self.mission.children()]
        return Supervisor(children, id="root", max_restarts=1_000_000)

    def __enter__(self) -> Plant:
        self.system.start()
        apps = [self.system.open_registrar(f"app-{n}") for n in range(1, _APPS + 1)]
        for n in range(_THREADS):
            self.consumers.append(Consumer(self.system, apps[n % _APPS], _USED, self._seed * 1000 + n, self.tally))
        for n in range(1, _RESIDENTS + 1):
            app = self.system.open_registrar(f"home-{n}")
            self.residents.append(Resident(app, self._seed * 1000 - n, self.tally))
        self.mission.open(self.system, self._seed)
        for thread in self._threads():
            thread.start()
        self._watcher.start()
        return self

    def __exit__(self, *exc: object) -> None:
        self._stop_threads()
        self.system.stop()
        self.mark.remove()
        left = settled(lambda: [f"process {pid} is left" for pid in self.mark.processes()], 5.0)
        self.tally.violation(*left)

    def _stop_threads(self) -> None:
        self._at_rest.set()
        self.mission.stop()
        for thread in self._threads():
            thread.stop()

    def _threads(self) -> list[Consumer | Resident | Operator]:
        return [*self.consumers, *self.residents, *self.mission.operators]

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
        self._stop_threads()
        self.mark.remove()
        stopping = threading.Thread(target=self.system.stop, name="chaos: stopping", daemon=True)
        stopping.start()
        deadline = time.monotonic() + ABANDON_S
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
        begin("checking the house")
        self._settle_house()
        begin("checking the mission")
        self.tally.violation(*self.mission.settle(self._look, SETTLE_S))
        begin("checking what is held")
        told = self._told()
        look = self._look
        self.tally.violation(*settled(lambda: [*check_at_rest(look()), *check_told(look(), told)], SETTLE_S))
        self.tally.violation(*check_state(self.state_dir))
        self.tally.violation(
            *settled(lambda: [f"daemon {pid} outlives its manager" for pid in self.mark.strays()], 5.0)
        )
        for consumer in self.consumers:
            consumer.check_heard()
        living = {name: set(contents.resources) for name, contents in look().items() if name not in (*HOUSE, *PLANNERS)}
        self.tally.violation(*check_journal(read_journal(self.journal_dir), living))
        if self.tally.violations:
            return False
        begin("releasing everything")
        for thread in self._threads():
            thread.release()
        self.tally.violation(*self.mission.give_up(SETTLE_S))
        for crew in CREWS:
            watch.phase(f"releasing what {crew} holds")
            self._tell(crew, "release")
        watch.phase("checking that nothing is left")
        self.tally.violation(*settled(lambda: [f"after release: {left}" for left in check_empty(look())], SETTLE_S))
        self.tally.violation(*check_journal(read_journal(self.journal_dir), {}))
        return True

    def _look(self) -> dict[str, Contents]:
        for name in [*MANAGERS, *_APP_NAMES]:
            try:
                self.system.registrar(name).save_catalog()  # commits what might be written a moment later
            except RrError:
                continue
        return read_state(self.state_dir)

    def _rest(self, watch: Watch) -> None:
        deadline = time.monotonic() + 60.0
        self._stop_threads()
        for thread in self._threads():
            thread.join(deadline)
        self._watcher.join(max(0.0, deadline - time.monotonic()))
        self.mission.join(max(0.0, deadline - time.monotonic()))
        for crew in CREWS:
            watch.phase(f"waiting for {crew}")
            self._tell(crew, "rest")

    # -- the house -------------------------------------------------------------------------------------------------

    def set_capacity(self, capacity: float) -> bool:
        """Set the watts; return False if Budgets cannot be asked now, and may have heard of it."""
        with self._lock:
            self._capacity = self._limit = WATTS.capacity
        try:
            self.system.ref("root/budgets").proxy().set_capacity(WATTS.name, capacity).get(timeout=10)
        except Exception:  # it is being respawned
            return False
        self._capacity = capacity
        return True

    def _watch_house(self) -> None:
        """Check that the devices use no more than there is, outside the grace after a lowered capacity."""
        while not self._at_rest.wait(_WATCH_S):
            capacity = self._capacity
            try:
                used = used_by(self.system.registrar("house").resources())
            except RrError:
                continue  # it is being respawned
            with self._lock:
                if used <= capacity + RESERVE and capacity == self._capacity:
                    self._limit = capacity
            if used > self._limit + RESERVE:
                self.tally.violation(f"house: {used:g} W are used of {self._limit:g}, and {RESERVE:g} in reserve")

    def _settle_house(self) -> None:
        def lower() -> list[str]:
            return [] if self.set_capacity(LESS) else ["house: the watts cannot be set"]

        def look() -> list[str]:
            budgets, programs, devices = (self.system.registrar(name).resources() for name in HOUSE)
            found = check_house(devices, budgets, programs, stands)
            return [*found, *([f"{used} W are used"] if (used := used_by(devices)) > LESS + RESERVE else [])]

        self.tally.violation(*settled(lower, SETTLE_S), *settled(look, SETTLE_S))

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

        self.tally.violation(*settled(ask, SETTLE_S))

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
