"""A resource never becomes its own part (docs/semantics.md, "Dependencies")."""

from __future__ import annotations

import contextlib
import itertools
import threading

import pytest

import rr_actors as rr
from support import Calls, eventually, loaded_with_parts


def test_a_resource_that_would_become_its_own_part_is_refused_by_name(
    app: rr.Registrar, provider: rr.Registrar
) -> None:
    provider.register_server("thing", lambda request: request)
    one = app.load("provider/thing", "one")
    with pytest.raises(rr.CircularDependency, match="its own part"):
        provider.load("provider/thing", "one", parent=one.resource_id)
    one.unload()
    assert provider.resources() == []


def test_resources_do_not_become_parts_of_each_other(app: rr.Registrar, provider: rr.Registrar) -> None:
    provider.register_server("thing", lambda request: request)
    whole, part = app.load("provider/thing", "whole"), app.load("provider/thing", "part")
    provider.load("provider/thing", "part", parent=whole.resource_id)
    with pytest.raises(rr.CircularDependency, match="provider/thing -> provider/thing -> provider/thing"):
        provider.load("provider/thing", "whole", parent=part.resource_id)
    whole.unload()
    part.unload()
    assert provider.resources() == []


class Ring:
    """Registrars whose resources load, when the test says so, one another's resources as parts of themselves."""

    def __init__(self, app: rr.Registrar, registrars: dict[str, rr.Registrar]) -> None:
        self.app, self.registrars = app, registrars
        self.heard = Calls()
        for registrar in registrars.values():
            registrar.register_server("thing", lambda request: request)
        self.held = {name: app.load(f"{name}/thing", "it", on_status=self.heard) for name in registrars}

    def join(self, whole: str, part: str) -> rr.Query:
        """Have the whole's registrar load the part's resource, as a status callback or a thread of it does."""
        return self.registrars[whole].load(f"{part}/thing", "it", parent=self.held[whole].resource_id)

    def release(self) -> None:
        """Release all that the application holds, and see that nothing is left of the ring."""
        for query in self.held.values():
            with contextlib.suppress(rr.UnknownQuery):
                query.unload()
        assert eventually(lambda: not any(one.resources() for one in self.registrars.values()))


@pytest.fixture
def ring(app: rr.Registrar, system: rr.System) -> Ring:
    return Ring(app, {name: system.open_registrar(name) for name in ("a", "b", "c")})


@pytest.mark.parametrize("names", ["ab", "abc"])
def test_a_ring_over_registrars_is_found_when_it_closes_and_the_part_that_closes_it_is_released(
    ring: Ring, names: str, caplog: pytest.LogCaptureFixture
) -> None:
    for whole, part in itertools.pairwise(names):
        ring.join(whole, part)
    ring.join(names[-1], "a")
    whole = ring.registrars[names[-1]]
    assert eventually(lambda: not whole.queries())
    status = ring.heard.wait(1)[0]
    way = " -> ".join(f"{name}/thing" for name in (names[-1], *names))
    assert status.state is rr.State.FATAL
    assert way in status.message
    assert any(way in record.getMessage() for record in caplog.records if record.levelname == "ERROR")
    ring.release()


def test_a_ring_that_closes_at_two_places_at_once_leaves_nothing(ring: Ring) -> None:
    ring.join("a", "b")
    closing = [threading.Thread(target=ring.join, args=pair) for pair in ("bc", "ca")]
    for thread in closing:
        thread.start()
    for thread in closing:
        thread.join()
    assert eventually(lambda: sum(len(one.queries()) for one in ring.registrars.values()) < 3)
    ring.release()


def test_a_part_that_a_loaded_resource_shares_with_others_is_no_ring(ring: Ring) -> None:
    for whole, part in ("ab", "bc", "ac"):
        ring.join(whole, part)
    spare = ring.registrars["b"].load("c/thing", "spare", parent=ring.held["b"].resource_id)
    spare.unload()
    assert [len(ring.registrars[name].queries()) for name in "abc"] == [2, 1, 0]
    assert ring.heard.items == []
    ring.release()


def test_a_ring_by_replace_part_is_broken_and_its_whole_may_take_another_part(
    app: rr.Registrar, system: rr.System
) -> None:
    one, two, parts = (system.open_registrar(name) for name in ("one", "two", "parts"))
    failed = Calls()

    def replace(request: str, status: rr.Status) -> None:
        failed(status.message)
        server, wanted = ("parts/part", "spare") if "own part" in status.message else ("two/thing", "it")
        one.replace_part(status, wanted, server)

    parts.register_server("part", lambda request: request)
    one.register_server("thing", loaded_with_parts(one, ("parts/part", "first")), status=replace)
    two.register_server("thing", loaded_with_parts(two, ("one/thing", "it")))
    whole = app.load("two/thing", "it")
    (first,) = parts.resources()
    parts.send_status(first.id, rr.Status(rr.State.FATAL, "unplugged"))
    assert eventually(lambda: [info.request for info in parts.resources()] == ["spare"])
    assert "own part" in failed.items[-1]
    whole.unload()
    assert eventually(lambda: not (one.resources() or two.resources() or parts.resources()))
