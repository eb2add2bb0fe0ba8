"""A handle has every method of a registrar: the registrar's class declares which of them are called in its process."""

from __future__ import annotations

import inspect
import re
from typing import Any

import pytest

import rr_actors as rr
from rr_actors.registrar.links.remote_calls import is_for_handles, is_repeatable
from rr_actors.registrar.remote_registrar import RegistrarHandle
from tests.support import LIMIT_S


class Far(rr.Manager):
    @rr.server("thing")
    def make(self, name: str) -> str:
        return name


@pytest.fixture
def handle(system: rr.System) -> rr.Registrar:
    system.supervisor().start_child(rr.ChildSpec(Far, id="far"))
    return system.registrar("far")


def _used(name: str, seen: set[str]) -> set[str]:
    """Return the attributes of `self` that a method of Registrar uses, with those of the methods that it calls."""
    method: Any = inspect.getattr_static(rr.Registrar, name, None)
    code = method.fget if isinstance(method, property) else method
    if name in seen or not inspect.isfunction(code):
        return {name}
    seen.add(name)
    own = set(re.findall(r"\bself\.(\w+)", inspect.getsource(code)))
    return own.union(*(_used(one, seen) for one in own if one not in vars(RegistrarHandle) and not is_for_handles(one)))


def _public(of: type) -> list[str]:
    return [name for name in vars(of) if not name.startswith("_") and name != "close"]


def test_a_method_is_declared_for_handles_or_needs_nothing_that_a_handle_lacks(
    system: rr.System, handle: rr.Registrar
) -> None:
    lacking = set(vars(system.open_registrar("app"))) - set(vars(handle))
    assert lacking

    undeclared = [name for name in _public(rr.Registrar) if name not in vars(RegistrarHandle)]
    assert not [name for name in undeclared if _used(name, set()) & lacking], "@for_handles is missing there"


def test_a_call_of_a_handle_is_answered_by_the_registrar(system: rr.System, handle: rr.Registrar) -> None:
    with system.open_registrar("app").load("far/thing", "a", timeout_s=LIMIT_S) as query:
        (resource,) = handle.resources()
        assert resource.holders == ("app",)
        assert handle.children(resource) == []
        assert handle.servers() == ["far/thing"]
        assert handle.clients() == handle.queries() == handle.owed() == handle.streams() == []
        assert handle.usage() == {}
        assert handle.stats()["resources"] == 1
        handle.send_status(resource, rr.Status(rr.State.WARNING, "dim"))
        assert query.wait_status("WARNING", timeout_s=LIMIT_S).message == "dim"


def test_a_look_at_many_resources_or_queries_reads_a_few_at_a_time(
    system: rr.System, handle: rr.Registrar, monkeypatch: pytest.MonkeyPatch
) -> None:
    app = system.open_registrar("app")
    queries = app.load_all([("far/thing", f"lamp {number}") for number in range(1203)], timeout_s=LIMIT_S)
    answers: list[int] = []

    def counted(method: Any) -> Any:
        def call(self: rr.Registrar, ids: list[str]) -> Any:
            answers.append(len(found := method(self, ids)))
            return found

        return call

    for kind, name in ((RegistrarHandle, "_infos"), (rr.Registrar, "_queries_of")):
        monkeypatch.setattr(kind, name, counted(inspect.getattr_static(kind, name)))
    resources = handle.resources()
    held = app.queries()
    assert [info.request for info in resources] == [f"lamp {number}" for number in range(1203)]
    assert {info.holders for info in resources} == {("app",)}
    assert [query.id for query in held] == [query.id for query in queries]
    assert sum(answers) == 2 * 1203
    assert max(answers) <= 500


@pytest.mark.parametrize("name", ["usage", "send_status", "unload", "set_priority", "_load"])
def test_a_call_that_changes_something_or_runs_code_of_users_is_not_repeatable(name: str) -> None:
    assert is_for_handles(name)
    assert not is_repeatable(name)


def test_a_handle_calls_nothing_else() -> None:
    assert not is_for_handles("close")
    assert not is_for_handles("__reduce__")
