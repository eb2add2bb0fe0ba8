"""The callbacks that are begun by BeginRun: usage, when somebody asks, and health, in rounds."""

from __future__ import annotations

import functools
import math
import time
from collections.abc import Mapping, Sequence
from concurrent.futures import Future
from typing import Any, cast

from rr_actors.base.checks import is_number
from rr_actors.base.errors import InvalidResponse, RrError, Unavailable, is_a, readable, shown
from rr_actors.base.names import new_id
from rr_actors.base.reporting.log import Log
from rr_actors.registrar.core.callback_runs import deaths_of, is_given_up
from rr_actors.registrar.engine.status import StatusMessage
from rr_actors.registrar.model import commands as c
from rr_actors.registrar.model.failures import not_run_again
from rr_actors.registrar.model.health import (
    LOOK_S,
    WELL,
    Health,
    HealthOf,
    ProbeCounts,
    ProbeResult,
    first_counts,
    judged,
)
from rr_actors.registrar.model.roles import HEALTH, USAGE
from rr_actors.registrar.model.rows import LOADED, PAUSED, Resource, State
from rr_actors.registrar.servers.server_base import OnDemandRun, ServerBase, said
from rr_actors.runtime.callback_errors import log_raised
from rr_actors.runtime.thread_rules import on_loop
from rr_actors.runtime.time_limits import Probes, ProbeTimes

_MOST_NUMBERS = 50
_TOO_GREAT = 2**63  # as a console's answer has room for


class Usages(dict[str, dict[str, float]]):
    """What resources use: by resource id, the numbers that the usage callback of its server has returned.

    Attributes:
        failures: by resource id, why a usage is not known: its callback raised, has not returned in time, or returned
            something else than a dict of finite numbers.
    """

    def __init__(self, usages: Mapping[str, dict[str, float]], failures: dict[str, str]) -> None:
        super().__init__(usages)
        self.failures = failures


Measured = dict[str, float] | str | None
"""The usage of a resource, or why it is not known; None if the resource is not loaded any more."""


class UsageCallbacks:
    """Runs the usage callback of one server."""

    def __init__(self, server: ServerBase) -> None:
        self._registrar, self._server, self._origin = server.registrar, server, server.origin
        self._measuring: dict[str, Future[Measured]] = {}
        server.add(USAGE, server.request_and_response_of, self._numbers)

    @on_loop
    def measure(self, resource: Resource) -> Future[Measured]:
        """Have the usage callback run; the future gets its numbers, or why there are none; None if it is unloaded.

        While a callback runs, no other one begins for the same resource: one that hangs takes one thread.
        """
        known = self._measuring.get(resource.id)
        if known is not None:
            return known
        future = Future[Measured]()
        catalog = self._registrar.catalog
        if is_given_up(catalog, "usage", resource.id):
            future.set_result(not_run_again(catalog, resource, "usage", deaths_of(catalog, "usage", resource.id)))
            return future
        self._measuring[resource.id] = future
        self._registrar.post(c.BeginRun("usage", resource))
        return future

    @on_loop
    def start(self, resource_id: str) -> None:
        """Run a usage callback that the disk has."""
        future = self._measuring.get(resource_id) or Future[Measured]()

        def done(numbers: dict[str, float] | None, error: BaseException | None) -> None:
            self._measuring.pop(resource_id, None)
            self._registrar.post(c.CallbackEnded("usage", resource_id))
            left = self._registrar.catalog.resources.get(resource_id)
            if left is None or left.phase not in (LOADED, PAUSED):
                future.set_result(None)
            else:
                future.set_result(numbers if error is None else f"{self._origin}: usage: {readable(said(error))}")

        resource = self._registrar.catalog.resources.get(resource_id)
        if resource is None:
            done(None, None)
        else:
            self._server.deliver(OnDemandRun(USAGE.name, resource, done))

    def _numbers(self, answer: object) -> dict[str, float]:
        expected = f"a dict of at most {_MOST_NUMBERS} finite numbers by name"
        numbers = cast("dict[Any, Any] | None", answer if is_a(answer, dict) else None)
        if numbers is None or len(numbers) > _MOST_NUMBERS:
            got = cast("object", answer)
            text = f"expected {expected}, got {shown(got)} ({type(got).__name__})"
            raise InvalidResponse(text, server=self._origin, path="", expected=expected)
        for name, number in numbers.items():
            if type(name) is not str or not is_number(number) or abs(number) >= _TOO_GREAT:
                text = f"expected {expected}, got {shown(number)} ({type(number).__name__}) as {shown(name)}"
                raise InvalidResponse(text, server=self._origin, path=shown(name), expected=expected)
        return {name: number + 0 for name, number in numbers.items()}  # of the plain types: they travel


logger = Log("rr_actors.server")

_CAREFUL_S = 60.0  # so long after its start, a process writes down which health callbacks run


# -- health -----------------------------------------------------------------------------------------------------------


class HealthCallbacks:
    """Runs the health callback of one server, in rounds.

    Attributes:
        probes: the rounds.
    """

    def __init__(self, server: ServerBase) -> None:
        self._registrar, self._server, self._origin = server.registrar, server, server.origin
        loop, health = server.registrar.node.dispatcher.loop, server.spec.health
        look_s = health.every_s if isinstance(health, Health) else LOOK_S
        self.probes = Probes(loop, look_s, self._probed, self._probe, self._probe_late)
        self._counts = dict[str, ProbeCounts]()  # by resource
        self._inherited = self._held_before() if server.spec.health else frozenset[str]()
        self._careful_until = math.inf
        server.add(HEALTH, self._probe_arguments, self._found)

    @on_loop
    def open(self) -> None:
        """Begin to probe. Before on_start has returned, the health callback may lack what that makes."""
        if self._server.spec.health is not None:
            self._careful_until = time.monotonic() + _CAREFUL_S
            self.probes.open()

    @on_loop
    def _probed(self) -> dict[str, ProbeTimes]:
        """Return the resources that can be probed now, and forget the results of the others."""
        with self._registrar.lock:
            ids = list(self._registrar.whole().by_server.get(self._server.spec.name, ()))
        healths = {id: health for id in ids if self._is_probed(id) and (health := self._health_of(id)) is not None}
        self._counts = {id: counts for id in healths if (counts := self._counts.get(id)) is not None}
        return {id: ProbeTimes(health.every_s, health.timeout_s) for id, health in healths.items()}

    def _health_of(self, resource_id: str) -> Health | None:
        health = self._server.spec.health
        return health.of(resource_id) if isinstance(health, HealthOf) else health

    def _is_probed(self, resource_id: str) -> bool:
        catalog = self._registrar.catalog
        resource = catalog.resources.get(resource_id)
        lives = resource is not None and resource.phase is LOADED and resource.state is not State.FATAL
        return lives and resource_id not in catalog.recovering and resource_id not in catalog.revocations

    @on_loop
    def _probe(self, ids: Sequence[str]) -> None:
        """Have the health callback run for each of these resources."""
        self._registrar.workers.threads.gather()
        try:
            for id in ids:
                resource = self._registrar.catalog.resources.get(id)
                if resource is not None and self._is_suspect(id):
                    self._registrar.post(c.BeginRun("health", resource))
                elif resource is None:
                    self.probes.ended(id)
                else:
                    self._server.deliver(OnDemandRun(HEALTH.name, resource, functools.partial(self._probe_ended, id)))
        finally:
            self._registrar.workers.threads.go()

    def _held_before(self) -> frozenset[str]:
        with self._registrar.lock:
            return frozenset(self._registrar.whole().by_server.get(self._server.spec.name, ()))

    def _is_suspect(self, resource_id: str) -> bool:
        """Return whether the process before may have died in this callback: the disk has its next runs first.

        A row for each run would cost too much for ever. The first death of a process in a health callback counts as any
        other crash does.
        """
        return resource_id in self._inherited and time.monotonic() < self._careful_until

    @on_loop
    def start(self, resource_id: str) -> None:
        """Run a health callback that the disk has."""
        resource = self._registrar.catalog.resources.get(resource_id)
        if not self.probes.is_waiting(resource_id):  # for a server of this name that was here before
            self._registrar.post(c.CallbackEnded("health", resource_id))
        elif resource is None:
            self.probes.ended(resource_id)
        else:
            done = functools.partial(self._suspect_ended, resource_id)
            self._server.deliver(OnDemandRun(HEALTH.name, resource, done))

    def _suspect_ended(self, resource_id: str, found: ProbeResult | None, error: BaseException | None) -> None:
        self._registrar.post(c.CallbackEnded("health", resource_id))
        self._probe_ended(resource_id, found, error)

    def _probe_arguments(self, resource: Resource) -> tuple[Any, Any]:
        if not self.probes.begins(resource.id, self._is_probed):
            raise Unavailable(f"{self._origin}: resource {resource.id} is not probed now")
        return self._server.request_and_response_of(resource)

    def _found(self, answer: object) -> ProbeResult:
        if answer is None:
            return WELL
        status = answer if is_a(answer, StatusMessage) else None
        state = answer if status is None else status.state
        if not is_a(state, State) or state is State.UPDATE:
            expected = "None, or the State OK, WARNING, ERROR or FATAL, or a Status with one"
            text = f"expected {expected}, got {shown(answer)} ({type(answer).__name__})"
            raise InvalidResponse(text, server=self._origin, path="", expected=expected)
        return ProbeResult(State(state), "" if status is None else status.message)

    def _probe_ended(self, resource_id: str, found: ProbeResult | None, error: BaseException | None) -> None:
        if self.probes.ended(resource_id):
            self._judge(resource_id, found or ProbeResult(State.ERROR, "" if error is None else said(error)), error)

    def _probe_late(self, resource_id: str) -> None:
        if (health := self._health_of(resource_id)) is not None:
            self._judge(resource_id, ProbeResult(State.ERROR, f"not returned within {health.timeout_s:g} s"))

    def _judge(self, resource_id: str, found: ProbeResult, error: BaseException | None = None) -> None:
        """Count a result, and set the status of the resource if its state changes by that."""
        health = self._health_of(resource_id)
        if self._registrar.closed or health is None or not self._is_probed(resource_id):
            return
        counts = self._counts.get(resource_id) or first_counts(self._registrar.catalog.resources[resource_id].state)
        self._counts[resource_id], state = judged(health, counts, found, self.probes.ran_s())
        if state is None:
            return
        text = readable(f"health: {found.message or found.state}")

        def done(refused: RrError | None) -> None:
            if refused is not None:  # a full disk, for instance: the next results announce it
                self._counts.pop(resource_id, None)
            elif error is not None:
                what = "%s: %s; resource %s has the state %s"
                log_raised(logger, error, what, self._origin, text, resource_id, state)

        self._registrar.post(c.SetStatus(resource_id, new_id(), state, text, done))
