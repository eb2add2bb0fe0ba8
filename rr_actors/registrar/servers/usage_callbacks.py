"""Usage: what the usage callbacks of one server say that its resources use."""

from __future__ import annotations

from collections.abc import Mapping
from concurrent.futures import Future
from typing import Any, cast

from rr_actors.base.checks import is_number
from rr_actors.base.errors import InvalidResponse, is_a, readable, shown
from rr_actors.registrar.core.callback_runs import deaths_of, is_given_up
from rr_actors.registrar.model import commands as c
from rr_actors.registrar.model.failures import not_run_again
from rr_actors.registrar.model.roles import USAGE
from rr_actors.registrar.model.rows import LOADED, PAUSED, Resource
from rr_actors.registrar.servers.callback_failures import said
from rr_actors.registrar.servers.server_base import ServerBase
from rr_actors.runtime.thread_rules import on_loop

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
            self._server.submit(USAGE, resource, resource.attempt, done)

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
