"""Consumers: threads of this process that load, wait, send statuses and unload, and note the answers."""

from __future__ import annotations

import random
import threading
import time
import uuid
from collections import Counter

from rr_actors.base.errors import RrError
from rr_actors.registrar.engine.status import Status
from rr_actors.registrar.model.rows import State
from rr_actors.registrar.queries import Query
from rr_actors.registrar.registrar import Registrar
from rr_actors.system.system import System
from rr_actors.testing.report import Tally
from rr_actors.testing.victim_managers import PATIENCE_S, Want

_STATES = (State.OK, State.UPDATE, State.WARNING, State.ERROR, State.FATAL)
_TOLD = "told-"  # the beginning of a consumer's messages; a registrar's begin otherwise


class Consumer:
    """One thread that uses a registrar of this process, which other threads use, too.

    Attributes:
        app: the registrar.
        held: the queries that it holds by its registrar's answers, each with the messages that it sent successfully.
    """

    def __init__(self, system: System, app: Registrar, servers: tuple[str, ...], seed: int, tally: Tally) -> None:
        self._system = system
        self.app = app
        self._servers = servers
        self._plan = random.Random(seed)
        self._tally = tally
        self._stopped = threading.Event()
        self._lock = threading.Lock()
        self._heard: dict[str, Counter[str]] = {}  # by query: each message, and how often it was heard
        self.held: list[tuple[Query, list[str]]] = []
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
            self._tally.violation(f"{self._thread.name}: a call hangs")

    def check_heard(self) -> None:
        """Check that each held query heard every status that was sent successfully, and none of them twice."""
        for query, sent in self.held:
            heard = self._check_twice(query.id)
            for message in sent:
                if message not in heard:
                    self._tally.violation(f"{self.app.name}: query {query.id} never heard of {message}")

    def _check_twice(self, query_id: str) -> Counter[str]:
        """Check that a query heard no message twice, and return the messages, which are then forgotten."""
        with self._lock:
            heard = self._heard.pop(query_id, Counter[str]())
        for message, count in heard.items():
            if count > 1:
                self._tally.violation(f"{self.app.name}: query {query_id} heard of {message} {count} times")
        return heard

    def release(self) -> None:
        """Unload all held queries; a failure is a violation, as nothing is harmed any more."""
        for query, _ in self.held:
            try:
                query.unload(timeout_s=PATIENCE_S)
            except RrError as error:
                self._tally.violation(f"{self.app.name}: query {query.id} not released: {error!r}")

    def _run(self) -> None:
        while not self._stopped.wait(self._plan.uniform(0.0, 0.02)):
            kind = self._next()
            started = time.monotonic()
            what = ""
            try:
                what = self._do(kind)
            except RrError as error:
                self._tally.error(kind, type(error).__name__)
            except Exception as error:
                self._tally.violation(f"{self.app.name}: {kind} raised {error!r}")
            else:
                self._tally.operation(kind, time.monotonic() - started, what)

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
                query = self.app.load(server, want, on_status=self._hear, timeout_s=timeout_s)
                self.held.append((query, []))
                return server
            case "status":
                query, sent = self._plan.choice(self.held)
                message = f"{_TOLD}{uuid.uuid4().hex}"
                state = self._plan.choices(_STATES, (40, 10, 30, 15, 5))[0]
                self._system.registrar(query.registrar).send_status(query.resource_id, Status(state, message))
                sent.append(message)
                return query.server_id
            case _:
                query, _ = self.held.pop(self._plan.randrange(len(self.held)))
                try:
                    query.unload(timeout_s=PATIENCE_S if kind == "unload" else self._plan.choice([0.001, 0.01, 0.1]))
                finally:
                    self._check_twice(query.id)
                return query.server_id

    def _hear(self, status: Status) -> None:
        if not status.repeated and status.message.startswith(_TOLD):
            with self._lock:
                self._heard.setdefault(status.query_id, Counter())[status.message] += 1
