"""Many queries let go at once (rr_actors/registrar/engine/bulk_release.py): no more at a time than both sides can see
to.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

import rr_actors as rr
from rr_actors.base.errors import RegistrarDown, RrError
from rr_actors.registrar.engine import bulk_release
from rr_actors.registrar.engine.bulk_release import Releases
from rr_actors.registrar.model.catalog import Catalog
from rr_actors.registrar.model.rows import Held, Hold, State
from support import Gate, catalog_path, eventually, loaded_with_parts, read_catalog, serve


class Holder:
    """As much of a registrar's actor as Releases needs; what is released ends when the test says so."""

    def __init__(self, held: dict[str, str]) -> None:
        self.closed = False
        self.lock = threading.RLock()
        self.catalog = Catalog("app")
        for number, (query_id, provider) in enumerate(held.items()):
            row = Held(query_id, provider, "thing", b"", b"", "r", "", 0, number, Hold.HELD, State.OK)
            self.catalog.set("held", query_id, row)
        self.begun: list[str] = []
        self.ended: list[tuple[str, RrError | None]] = []
        self.unloads: dict[str, Callable[[RrError | None], None]] = {}

    def whole(self) -> Catalog:
        return self.catalog

    def release(self, query_id: str, waiter: Callable[[RrError | None], None]) -> None:
        self.begun.append(query_id)
        self.unloads[query_id] = waiter

    def end(self, query_id: str, error: RrError | None = None) -> None:
        self.catalog.set("held", query_id, None)
        self.unloads.pop(query_id)(error)

    def close(self, error: RrError) -> None:
        self.closed = True
        for query_id in list(self.unloads):
            self.unloads.pop(query_id)(error)

    def note(self, query_id: str, error: RrError | None) -> None:
        self.ended.append((query_id, error))


@pytest.fixture(autouse=True)
def two_at_a_time(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(bulk_release, "AT_A_TIME", 2)


def releasing(held: dict[str, str]) -> tuple[Holder, Releases]:
    holder = Holder(held)
    actor: Any = holder
    return holder, Releases(actor, list(held), holder.note)


def test_the_next_is_let_go_when_one_has_ended_and_a_slow_provider_holds_up_no_other() -> None:
    holder, _ = releasing({"a1": "a", "a2": "a", "a3": "a", "b1": "b", "b2": "b", "b3": "b", "b4": "b"})
    assert holder.begun == ["a1", "a2", "b1", "b2"]
    holder.end("b2")
    holder.end("b1")
    assert holder.begun[4:] == ["b3", "b4"]
    assert holder.ended == [("b2", None), ("b1", None)]


def test_what_somebody_else_has_let_go_before_its_turn_has_ended_well() -> None:
    holder, _ = releasing({"1": "a", "2": "a", "3": "a", "4": "a", "5": "a"})
    holder.catalog.set("held", "3", None)
    holder.release("4", lambda _error: None)  # as a thread does by a line of its own
    holder.end("1")
    assert holder.begun == ["1", "2", "4", "5"]
    assert holder.ended == [("1", None), ("3", None), ("4", None)]


def test_in_a_hurry_all_are_begun() -> None:
    holder, waiting = releasing({"1": "a", "2": "a", "3": "a", "4": "a"})
    waiting.hurry()
    assert holder.begun == ["1", "2", "3", "4"]


def test_when_the_registrar_is_closed_all_hear_so_once() -> None:
    many = [str(number) for number in range(5_000)]  # more than there may be calls inside one another
    holder, _ = releasing(dict.fromkeys(many, "a"))
    down = RegistrarDown("closed", registrar="app", status="stopped")
    holder.close(down)
    assert sorted(query_id for query_id, _ in holder.ended) == sorted(many)
    assert {error for _, error in holder.ended} == {down}
    assert holder.begun == ["0", "1"]


def test_a_registrar_that_closes_lets_go_of_more_than_that_at_every_provider(
    app: rr.Registrar, provider: rr.Registrar, parts: rr.Registrar
) -> None:
    served = [serve(provider, "thing"), serve(parts, "thing")]
    for number in range(7):
        app.load("provider/thing", number)
        app.load("parts/thing", number)
    app.close()
    newest_first = [6, 5, 4, 3, 2, 1, 0]
    assert [sorted((request for request, _ in each.unloads), reverse=True) for each in served] == [newest_first] * 2
    assert list(provider.resources()) + list(parts.resources()) == []


def test_unload_all_lets_go_of_more_than_that_and_of_all_of_it_when_its_time_is_up(
    app: rr.Registrar, provider: rr.Registrar, parts: rr.Registrar, gate: Gate
) -> None:
    slow = serve(provider, "slow", unload=lambda request, response: gate())
    quick = serve(parts, "quick")
    for number in range(5):
        app.load("provider/slow", number)
        app.load("parts/quick", number)
    with pytest.raises(rr.Unavailable, match="the release is owed") as caught:
        app.unload_all(timeout_s=2)
    assert len(caught.value.__notes__) == 4
    order = [request for request, _ in quick.unloads.wait(5)]
    assert sorted(order) == [0, 1, 2, 3, 4]
    assert all(4 - request <= place + 1 for place, request in enumerate(order)), order  # newest first, two at a time
    assert (list(app.queries()), len(app.owed())) == ([], 5)
    gate.open()
    slow.unloads.wait(5)
    eventually(lambda: not provider.resources() and not app.owed())


def test_what_could_not_be_let_go_in_time_is_owed_all_of_it(
    system: rr.System, app: rr.Registrar, provider: rr.Registrar, parts: rr.Registrar, gate: Gate
) -> None:
    serve(provider, "slow", unload=lambda request, response: gate())
    quick = serve(parts, "quick")
    for number in range(5):
        app.load("provider/slow", number)
        app.load("parts/quick", number)
    app.close(timeout_s=0.5)
    quick.unloads.wait(5)
    again = system.open_registrar("app")
    assert list(again.queries()) == []
    assert len(provider.resources()) == 5
    gate.open()
    eventually(lambda: not provider.resources() and not again.owed())


def test_a_callback_that_does_not_end_in_time_keeps_nothing_but_its_own_parts(
    app: rr.Registrar, provider: rr.Registrar, parts: rr.Registrar, gate: Gate, state_dir: Path
) -> None:
    serve(provider, "camera")
    serve(app, "map", loaded_with_parts(app, ("provider/camera", "part")), lambda request, response: gate())
    parts.load("app/map", "kitchen")
    own = app.load("provider/camera", "own")
    app.close(timeout_s=0.5)
    holds = {row["id"]: Hold(row["hold"]) for row in read_catalog(catalog_path(state_dir, "app"), "held")}
    assert own.id not in holds or holds.pop(own.id) is Hold.OWED
    assert list(holds.values()) == [Hold.HELD]
    gate.open()
