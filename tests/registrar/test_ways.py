"""By whichever way a load or an unload goes, the same is promised: a full disk refuses it, every config keeps it."""

from __future__ import annotations

import gc
import os
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

import rr_actors as rr
from rr_actors.base.errors import CatalogError
from rr_actors.registrar.model.rows import ServedQuery
from rr_actors.storage.opening import read_rows
from support import Calls, Gate, Served, catalog_path, eventually, serve
from support_inside import actor_of


@contextmanager
def full(registrar: rr.Registrar, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Nothing can be written to the registrar's catalog."""

    def refuse(_changes: Any) -> None:
        raise CatalogError("disk full")

    with monkeypatch.context() as patch:
        patch.setattr(actor_of(registrar).commits.store, "commit", refuse)
        yield


Load = Callable[[rr.Registrar, str], rr.Query]
Unload = Callable[[rr.Registrar, rr.Query], None]


def by_the_callers_thread(app: rr.Registrar, request: str) -> rr.Query:
    return app.load("provider/thing", request)


def by_the_loop(app: rr.Registrar, request: str) -> rr.Query:
    return app.load("provider/thing", request, block=False).get(timeout=10)


LOADS: dict[str, tuple[Load, str]] = {
    "a join by its thread": (by_the_callers_thread, "x"),
    "a first load by its thread": (by_the_callers_thread, "y"),
    "a join by the loop": (by_the_loop, "x"),
    "a first load by the loop": (by_the_loop, "y"),
}


def unload(app: rr.Registrar, query: rr.Query) -> None:
    app.unload(query)


def unload_later(app: rr.Registrar, query: rr.Query) -> None:
    app.unload(query, block=False).get(timeout=10)


def unload_all(app: rr.Registrar, _query: rr.Query) -> None:
    app.unload_all()


UNLOADS: dict[str, Unload] = {"by its thread": unload, "by the loop": unload_later, "of all": unload_all}


def on_disk(state_dir: Path) -> list[str]:
    return [row.id for row in read_rows(catalog_path(state_dir, "provider")) if isinstance(row, ServedQuery)]


@pytest.mark.parametrize("way", LOADS)
def test_a_full_disk_of_the_provider_refuses_a_load_and_leaves_nothing(
    app: rr.Registrar,
    provider: rr.Registrar,
    served: Served,
    state_dir: Path,
    monkeypatch: pytest.MonkeyPatch,
    way: str,
) -> None:
    load, request = LOADS[way]
    before = on_disk(state_dir)
    with full(provider, monkeypatch), pytest.raises(CatalogError, match="disk full"):
        load(app, request)
    assert on_disk(state_dir) == before
    assert len(app.queries()) == 1
    assert [len(resource.queries) for resource in provider.resources()] == [1]
    query = load(app, request)
    assert query.id in on_disk(state_dir)
    assert len(app.queries()) == 2


@pytest.mark.parametrize("way", UNLOADS)
def test_a_full_disk_of_the_holder_refuses_an_unload_and_it_is_still_held(
    app: rr.Registrar, provider: rr.Registrar, served: Served, monkeypatch: pytest.MonkeyPatch, way: str
) -> None:
    (query,) = app.queries()
    app.save_catalog()
    with full(app, monkeypatch), pytest.raises(CatalogError, match="disk full"):
        UNLOADS[way](app, query)
    assert app.queries() == [query]
    assert list(served.unloads) == []
    UNLOADS[way](app, query)
    assert app.queries() == []
    assert len(served.unloads) == 1


@pytest.mark.parametrize("way", UNLOADS)
def test_while_the_providers_disk_is_full_an_unload_waits(
    app: rr.Registrar, provider: rr.Registrar, served: Served, monkeypatch: pytest.MonkeyPatch, way: str
) -> None:
    (query,) = app.queries()
    outcome = Calls()
    thread = threading.Thread(target=lambda: outcome(UNLOADS[way](app, query)))
    with full(provider, monkeypatch):
        thread.start()
        eventually(lambda: actor_of(provider).waiting)
        assert len(outcome) == 0
    thread.join()
    assert len(outcome) == 1
    assert provider.resources() == []
    assert len(served.unloads) == 1


@pytest.mark.parametrize("options", [{}, {"save_on_modify": False}, {"durability": "none"}, {"durability": "power"}])
@pytest.mark.parametrize("way", UNLOADS)
def test_every_config_of_provider_and_holder_loads_and_unloads(
    system: rr.System, options: dict[str, Any], way: str
) -> None:
    config = rr.RegistrarConfig(**options)
    provider = system.open_registrar("provider", config=config)
    holder = system.open_registrar("holder", config=config)
    served = serve(provider, "thing")
    for load in (by_the_callers_thread, by_the_loop):
        for request in ("x", "x", "y"):
            query = load(holder, request)
            assert query.response["of"] == request
            UNLOADS[way](holder, query)
            assert holder.queries() == []
            with pytest.raises(rr.UnknownQuery, match=query.id):
                query.unload()
    assert len(served.loads) == len(served.unloads) == 6
    assert provider.resources() == []


class Holds:
    """In a circle with itself: the garbage collector ends it, whenever it likes."""

    def __init__(self, query: rr.Query, ended: Calls) -> None:
        self.me = self
        self.query, self.ended = query, ended

    def __del__(self) -> None:
        try:
            self.query.unload()
            self.ended("unloaded")
        except rr.RrError as error:
            self.ended(error)


class Looks(Holds):
    """The same, which asks what is held."""

    def __init__(self, holder: rr.Registrar, ended: Calls) -> None:
        super().__init__(holder.load("provider/thing", "x"), ended)
        self.holder = holder

    def __del__(self) -> None:
        try:
            self.ended(self.holder.queries())
        except rr.RrError as error:
            self.ended(error)


@pytest.fixture
def collected_in_decisions_only() -> Iterator[None]:
    """Python's own collections might end a Holds before."""
    gc.disable()
    yield
    gc.enable()


def collecting(registrar: rr.Registrar, monkeypatch: pytest.MonkeyPatch) -> None:
    """The garbage collector runs each time that something is written, under the lock."""
    ledger = actor_of(registrar).commits
    commit = ledger.store.commit

    def written(changes: Any) -> None:
        assert actor_of(registrar).is_inside()
        gc.collect()
        commit(changes)

    monkeypatch.setattr(ledger.store, "commit", written)


@pytest.mark.slow
@pytest.mark.usefixtures("collected_in_decisions_only")
@pytest.mark.parametrize("way", LOADS)
def test_a_finalizer_that_unloads_in_the_middle_of_a_decision_does_it_later(
    app: rr.Registrar, provider: rr.Registrar, served: Served, monkeypatch: pytest.MonkeyPatch, way: str
) -> None:
    load, request = LOADS[way]
    ended = Calls()
    Holds(app.load("provider/thing", "z"), ended)
    collecting(provider, monkeypatch)
    load(app, request)
    assert ended.wait(1) == ["unloaded"]
    eventually(lambda: [request for request, _ in served.unloads] == ["z"])
    eventually(lambda: len(app.queries()) == 2)


@pytest.mark.slow
@pytest.mark.usefixtures("collected_in_decisions_only")
@pytest.mark.parametrize("way", LOADS)
def test_a_finalizer_that_would_wait_in_the_middle_of_a_decision_is_refused(
    app: rr.Registrar, provider: rr.Registrar, served: Served, monkeypatch: pytest.MonkeyPatch, way: str
) -> None:
    load, request = LOADS[way]
    ended = Calls()
    Looks(provider, ended)
    collecting(provider, monkeypatch)
    query = load(app, request)
    (error,) = ended.wait(1)
    assert isinstance(error, rr.UsageError)
    assert "__del__" in str(error)
    assert query in app.queries()


@pytest.mark.filterwarnings("ignore:.*fork.*:DeprecationWarning")
def test_who_forks_while_another_thread_decides_waits_for_nobody_in_the_child(
    app: rr.Registrar, provider: rr.Registrar, served: Served, gate: Gate
) -> None:
    """That thread is not there: it never gives the lock back."""

    def decide() -> None:
        with actor_of(provider).lock, actor_of(app).lock:
            gate()

    thread = threading.Thread(target=decide)
    thread.start()
    gate.wait_arrived()
    (query,) = actor_of(app).catalog.held
    child = os.fork()
    if child == 0:
        refused = 0
        for call in (app.queries, lambda: app.load("provider/thing", "x"), lambda: app.unload(query)):
            try:
                call()
            except rr.RegistrarDown:
                refused += 1
        os._exit(refused)
    gate.open()
    thread.join()
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 3
    app.unload(query)
