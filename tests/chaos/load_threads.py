"""Consumers and residents: threads of this process that load, wait and unload, and note the answers."""

from __future__ import annotations

import abc
import functools
import random
import threading
import time
import uuid
from collections import Counter
from collections.abc import Callable
from typing import NamedTuple

from chaos.report import Tally
from chaos.victim_managers import PATIENCE_S, Want
from rr_actors.base.errors import RrError
from rr_actors.registrar.model.rows import State
from rr_actors.registrar.queries import Query, Status
from rr_actors.registrar.registrar import Registrar
from rr_actors.system.system import System

_STATES = (State.OK, State.UPDATE, State.WARNING, State.ERROR, State.FATAL)
_AFTER_FATAL = (State.FATAL, State.UPDATE)
_TOLD = "told"  # a consumer's messages are "told-NANOSECONDS-ID", with when its call began; a registrar's are others


class Sent(NamedTuple):
    """A status that a consumer has sent successfully, and when the call returned (time.monotonic_ns())."""

    message: str
    state: State
    returned_ns: int


class Consumer:
    """One thread that uses a registrar of this process, which other threads use, too.

    Attributes:
        system, app: the system, and the registrar.
        tally: where violations are noted.
        held: the queries that it holds by its registrar's answers, each with the statuses that it sent successfully.
    """

    def __init__(self, system: System, app: Registrar, servers: tuple[str, ...], seed: int, tally: Tally) -> None:
        self.system = system
        self.app = app
        self._servers = servers
        self._plan = random.Random(seed)
        self.tally = tally
        self._stopped = threading.Event()
        self._lock = threading.Lock()
        self._heard: dict[str, list[Status]] = {}  # by query
        self.held: list[tuple[Query, list[Sent]]] = []
        self._thread = threading.Thread(target=self._run, name=f"consumer of {app.name}", daemon=True)

    def start(self) -> None:
        """Start the thread."""
        self._thread.start()

    def stop(self) -> None:
        """Have the thread begin no further operation."""
        self._stopped.set()

    def join(self, deadline: float) -> None:
        """Wait for the thread's last operation; note a violation if it runs after `deadline` (time.monotonic())."""
        self._thread.join(max(0.0, deadline - time.monotonic()))
        if self._thread.is_alive():
            self.tally.violation(f"{self._thread.name}: a call hangs")

    def load(self, server: str, want: Want, timeout_s: float) -> None:
        """Load, and hold the query."""
        self.held.append((self.app.load(server, want, on_status=self.hear, timeout_s=timeout_s), []))

    def send(self, place: int, state: State) -> None:
        """Send a status of the resource of the query at this place of `held`."""
        query, sent = self.held[place]
        message = f"{_TOLD}-{time.monotonic_ns()}-{uuid.uuid4().hex}"
        self.system.registrar(query.registrar).send_status(query.resource_id, Status(state, message))
        sent.append(Sent(message, state, time.monotonic_ns()))

    def hear(self, status: Status) -> None:
        """Note a status, as the callback of each load."""
        if status.message.startswith(_TOLD):
            with self._lock:
                self._heard.setdefault(status.query_id, []).append(status)

    def check_heard(self) -> None:
        """Check that each held query heard every status that was sent successfully, and none of them twice.

        A query hears no OK, WARNING or ERROR of its resource after the resource's own FATAL. So it need not have heard
        one if its call had not returned when the call with such a FATAL began. A status that is marked as repeated may
        be the first that a query hears of it: its provider may have died between the commit and the sending.
        """
        for query, sent in self.held:
            heard = self._check_twice(query.id)
            messages = {status.message for status in heard}
            fatal = (one for one in heard if one.state is State.FATAL and one.source == query.server_id)
            first_ns = min((int(one.message.split("-")[1]) for one in fatal), default=None)
            for one in sent:
                passed_over = first_ns is not None and one.returned_ns > first_ns and one.state not in _AFTER_FATAL
                if one.message not in messages and not passed_over:
                    of = [f"{other.state} {other.message}" for other in heard]
                    text = f"query {query.id} never heard of {one.state} {one.message}, only of {of}"
                    self.tally.violation(f"{self.app.name}: {text}")

    def _check_twice(self, query_id: str) -> list[Status]:
        """Check that a query heard no status twice, and return what it heard, which is then forgotten."""
        with self._lock:
            heard = self._heard.pop(query_id, [])
        for message, count in Counter(status.message for status in heard if not status.repeated).items():
            if count > 1:
                self.tally.violation(f"{self.app.name}: query {query_id} heard of {message} {count} times")
        return heard

    def release(self) -> None:
        """Unload all held queries; a failure is a violation, as nothing is harmed any more."""
        for query, _ in self.held:
            try:
                query.unload(timeout_s=PATIENCE_S)
            except RrError as error:
                self.tally.violation(f"{self.app.name}: query {query.id} not released: {error!r}")

    def _run(self) -> None:
        while not self._stopped.wait(self._plan.uniform(0.0, 0.02)):
            kind = self._next()
            started = time.monotonic()
            what = ""
            try:
                what = self._do(kind)
            except RrError as error:
                self.tally.error(kind, type(error).__name__)
            except Exception as error:
                self.tally.violation(f"{self.app.name}: {kind} raised {error!r}")
            else:
                self.tally.operation(kind, time.monotonic() - started, what)

    def _next(self) -> str:
        chance = self._plan.random()
        if len(self.held) < 2 or (chance < 0.4 and len(self.held) < 8):
            return "load" if self._plan.random() < 0.8 else "hasty load"
        if chance < 0.55:
            return "status"
        return "unload" if chance < 0.9 else "hasty unload"

    def _do(self, kind: str) -> str:
        match kind:
            case "load" | "hasty load":
                timeout_s = PATIENCE_S if kind == "load" else self._plan.choice([0.001, 0.01, 0.1])
                server, want = self._plan.choice(self._servers), Want(self._plan.randrange(30))
                self.load(server, want, timeout_s)
                return server
            case "status":
                place = self._plan.randrange(len(self.held))
                self.send(place, self._plan.choices(_STATES, (40, 10, 30, 15, 5))[0])
                return self.held[place][0].server_id
            case _:
                query, _ = self.held.pop(self._plan.randrange(len(self.held)))
                try:
                    query.unload(timeout_s=PATIENCE_S if kind == "unload" else self._plan.choice([0.001, 0.01, 0.1]))
                finally:
                    self._check_twice(query.id)
                return query.server_id


class LoadThread(abc.ABC):
    """A thread that does one operation after another, by a registrar of its own, and notes how each has ended.

    Attributes:
        app: the registrar.

    Args:
        role: what the thread is, and of what its operations are, for reports.
        pause_s: the longest time between two operations.
    """

    _refusals: tuple[type[Exception], ...] = (RrError,)  # what an operation may raise while the system is harmed
    _release_s = PATIENCE_S

    def __init__(self, app: Registrar, seed: int, tally: Tally, role: tuple[str, str], pause_s: float) -> None:
        self.app = app
        self._plan = random.Random(seed)
        self._tally, self._pause_s = tally, pause_s
        who, self._of = role
        self._stopped = threading.Event()
        self._thread = threading.Thread(target=self._run, name=f"{who} of {app.name}", daemon=True)

    def start(self) -> None:
        """Start the thread."""
        self._thread.start()

    def stop(self) -> None:
        """Have the thread begin no further operation."""
        self._stopped.set()

    def join(self, deadline: float) -> None:
        """Wait for the thread's last operation; note a violation if it runs after `deadline` (time.monotonic())."""
        self._thread.join(max(0.0, deadline - time.monotonic()))
        if self._thread.is_alive():
            self._tally.violation(f"{self._thread.name}: a call hangs")

    def release(self) -> None:
        """Unload all that it holds."""
        try:
            self.app.unload_all(timeout_s=self._release_s)
        except RrError as error:
            self._tally.violation(f"{self.app.name}: a release failed: {error!r}")

    def _run(self) -> None:
        while not self._stopped.wait(self._plan.uniform(0, self._pause_s)):
            kind, do = self._next()
            started = time.monotonic()
            try:
                do()
            except self._refusals as error:
                self._tally.error(kind, type(error).__name__)
            except Exception as error:
                self._tally.violation(f"{self.app.name}: {kind} raised {error!r}")
            else:
                self._tally.operation(kind, time.monotonic() - started, self._of)

    @abc.abstractmethod
    def _next(self) -> tuple[str, Callable[[], object]]:
        """Return the kind of the next operation, and what does it."""


class Resident(LoadThread):
    """A thread that switches devices of the house on and off, and changes their priorities."""

    def __init__(self, app: Registrar, seed: int, tally: Tally) -> None:
        super().__init__(app, seed, tally, ("resident", "of the house"), 0.05)

    def _next(self) -> tuple[str, Callable[[], object]]:
        held, chance = self.app.queries(), self._plan.random()
        priority = self._plan.choice([None, 0, 1, 2, 5, 9])
        if len(held) < 2 or (chance < 0.4 and len(held) < 6):
            name, watts = f"device-{self._plan.randrange(12)}", self._plan.choice([10.0, 20.0, 35.0])
            request = {"name": name, "watts": watts, "program": self._plan.random() < 0.5}
            load = functools.partial(self.app.load, "house/device", request, priority=priority, timeout_s=5.0)
            return "load of a device", load
        query = self._plan.choice(held)
        if chance < 0.7:
            return "priority of a device", functools.partial(setattr, query, "priority", priority)
        return "unload of a device", functools.partial(query.unload, timeout_s=5.0)
