"""Mission: the part of the plant with what is chosen, what is kept, and graphs of actions."""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping
from pathlib import Path

from chaos.callback_log import Journal, read_journal
from chaos.invariants import settled
from chaos.mission.mission_checks import check_acts, check_choices, check_graphs, check_kept, check_replicas
from chaos.mission.mission_managers import (
    ALTERNATIVES,
    SENSORS,
    SETTLE_S,
    STEPS,
    Caretaker,
    Chooser,
    Patrol,
    Sensors,
    desired_file,
    graphs_folder,
    write_files,
)
from chaos.mission.mission_threads import LIMIT_S, Operator
from chaos.report import Tally
from rr_actors.base.errors import RrError
from rr_actors.registrar.model.rows import State
from rr_actors.registrar.queries import Status
from rr_actors.supervision.core.specs import Backoff, ChildSpec
from rr_actors.system.system import System
from rr_actors.tools.inspection import Contents

_OPERATORS = 2
_WATCH_S = 0.05
_BACKOFF = Backoff(delay_s=0.05, factor=2.0, maximum_s=0.5, jitter=0.0)
APP_NAMES = tuple(f"desk-{n}" for n in range(1, _OPERATORS + 1))


class Mission:
    """Makes its managers and operators, watches it while it is harmed, and checks it when nothing is harmed any more.

    Attributes:
        operators: the threads that use it; made by open().
    """

    def __init__(self, directory: Path, tally: Tally) -> None:
        self.operators: list[Operator] = []
        self._directory, self._tally = directory, tally
        self._at_rest = threading.Event()
        self._watcher = threading.Thread(target=self._watch, name="chaos: the mission", daemon=True)
        write_files(directory)

    def children(self) -> list[ChildSpec]:
        """Return its managers."""
        file = desired_file(self._directory, "all")
        sensors = [ChildSpec(Sensors, id=name, args=(str(self._directory),)) for name in SENSORS]
        return [
            *sensors,
            ChildSpec(Chooser, id="choices", args=(ALTERNATIVES, SETTLE_S)),
            ChildSpec(Caretaker, id="keeper", args=(str(file), _BACKOFF)),
            ChildSpec(Patrol, id="actions", args=(STEPS, str(graphs_folder(self._directory)), 2.0)),
        ]

    def open(self, system: System, seed: int) -> None:
        """Make the operators of a system that runs, and begin to watch."""
        self._system = system
        journal = Journal(self._directory)
        for n, name in enumerate(APP_NAMES):
            app = system.open_registrar(name)
            self.operators.append(Operator(system, app, journal, self._apply, seed * 1000 + 500 + n, self._tally))
        self._watcher.start()

    def stop(self) -> None:
        """Watch no more."""
        self._at_rest.set()

    def join(self, timeout_s: float) -> None:
        """Wait until it is watched no more."""
        if self._watcher.is_alive():
            self._watcher.join(timeout_s)

    def settle(self, look: Callable[[], Mapping[str, Contents]], settle_s: float) -> list[str]:
        """Let it come to rest, and return what is wrong then. `look`: reads the catalogs."""
        found = settled(lambda: self._applied("all"), settle_s)
        return found or settled(lambda: self._healed() or self._wrongs(look()), settle_s)

    def give_up(self, settle_s: float) -> list[str]:
        """Have the keeper keep nothing more."""
        return settled(lambda: self._applied("nothing"), settle_s)

    def _healed(self) -> list[str]:
        """Have the sensors that have said ERROR be well again: a keeper leaves those as they are."""
        for name in SENSORS:
            try:
                sensors = self._system.registrar(name)
                for info in sensors.resources():
                    if info.status is State.ERROR:
                        sensors.send_status(info, Status(State.OK, "healed"))
            except RrError as error:  # it is being respawned
                return [f"{name}: cannot be healed: {error!r}"]
        return []

    def _wrongs(self, state: Mapping[str, Contents]) -> list[str]:
        found = [wrong for one in self.operators for wrong in (*one.unfinished(), *one.wrong_fatals())]
        found += check_graphs(state["actions"])
        try:
            keeper = self._system.ref("root/keeper").proxy()
            kept, differences = keeper.get().get(timeout=LIMIT_S), keeper.diff().get(timeout=LIMIT_S)
            found += check_kept(kept, differences, state["keeper"])
            found += check_replicas(self._system.registrar("keeper").resources())
        except Exception as error:  # it is being respawned
            found.append(f"keeper: it does not answer: {error!r}")
        found += check_choices(state["choices"], state)
        return [*found, *check_acts(read_journal(self._directory))]

    def _apply(self, name: str) -> None:
        path = str(desired_file(self._directory, name))
        self._system.ref("root/keeper").proxy().apply(path).get(timeout=LIMIT_S)

    def _applied(self, name: str) -> list[str]:
        try:
            self._apply(name)
        except Exception as error:  # it is being respawned
            return [f"keeper: cannot be given another file: {error!r}"]
        return []

    def _watch(self) -> None:
        """Check that there is never a second replica."""
        while not self._at_rest.wait(_WATCH_S):
            try:
                infos = self._system.registrar("keeper").resources()
            except RrError:
                continue  # it is being respawned
            self._tally.violation(*check_replicas(infos))
