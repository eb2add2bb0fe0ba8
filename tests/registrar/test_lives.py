"""The life of a registrar: opened, closed, deleted, absent from one run of the system and back in the next.

Real processes. At the end of each test `rr-actors check` finds nothing in the state directory.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from test_semantics_recovery import run_and_be_killed

import rr_actors as rr
from rr_actors.registrar.model.rows import Notice, ServedQuery
from rr_actors.storage.opening import read_rows
from rr_actors.tools import inspection
from support import Workshop, catalog_path, eventually, kill, pid_of, wait_respawned
from support_managers import Order, Shop

Start = Callable[..., rr.System]


def check_state(state_dir: Path) -> list[str]:
    """Return what is found; nothing if no catalog is left."""
    return inspection.check_state(state_dir) if list(state_dir.glob("*/catalog.sqlite3")) else []


@pytest.fixture(autouse=True)
def nothing_is_found(state_dir: Path) -> Iterator[None]:
    yield
    assert check_state(state_dir) == []


def shop(workshop: Workshop, id: str = "shop") -> rr.ChildSpec:
    return rr.ChildSpec(Shop, id=id, args=(str(workshop.root),))


def served(state_dir: Path, name: str = "shop") -> list[object]:
    return [row for row in read_rows(catalog_path(state_dir, name)) if isinstance(row, ServedQuery | Notice)]


# -- a provider that is away while its consumer is opened and closed ------------------------------------------------


@pytest.mark.parametrize("away", ["absent", "terminated"])
def test_what_a_killed_application_had_loaded_is_released_if_its_next_run_ends_without_the_provider(
    start: Start, workshop: Workshop, state_dir: Path, away: str
) -> None:
    run_and_be_killed(workshop, state_dir, "app.load('shop/thing', Order('wheel'))")
    if away == "absent":
        system = start()
        assert sorted(system.dormant()) == ["app", "shop"]
    else:
        system = start(shop(workshop))
        system.supervisor().terminate_child("shop")
    system.open_registrar("app").close()
    system.stop()
    assert check_state(state_dir) == []

    system = start(shop(workshop))
    assert system.dormant() == ["app"]  # it was closed, and the provider has not heard so
    assert list(system.open_registrar("app").queries()) == []
    workshop.wait("unload wheel")
    eventually(lambda: not system.registrar("shop").resources())
    system.stop()
    assert served(state_dir) == []
    assert start().dormant() == []


def test_a_stop_does_not_wait_for_a_manager_that_was_stopped_and_what_it_is_owed_follows(
    start: Start, workshop: Workshop, caplog: pytest.LogCaptureFixture
) -> None:
    system = start(shop(workshop), config=rr.SystemConfig(stop_timeout_s=50.0))
    system.open_registrar("app").load("shop/thing", Order("wheel"))
    system.supervisor().terminate_child("shop")
    began = time.monotonic()
    system.stop()
    assert time.monotonic() - began < 25, "half of the limit"
    assert "app: 1 releases are owed to shop, and follow when that is opened again: it is stopped" in caplog.messages

    system = start(shop(workshop))
    assert list(system.open_registrar("app").queries()) == []
    workshop.wait("unload wheel")
    eventually(lambda: not system.registrar("shop").resources())


def test_what_was_loaded_just_before_a_kill_and_released_while_its_provider_was_down_is_not_held_again(
    start: Start, workshop: Workshop, state_dir: Path
) -> None:
    run_and_be_killed(workshop, state_dir, "app.load('shop/thing', Order('wheel'))")
    system = start(shop(workshop))
    system.supervisor().terminate_child("shop")
    system.release("app")
    app = system.open_registrar("app")
    system.supervisor().restart_child("shop")
    workshop.wait("unload wheel")
    assert list(app.queries()) == []


# -- a registrar that is being closed -------------------------------------------------------------------------------


def test_a_manager_that_is_being_closed_loads_nothing_any_more(
    start: Start, workshop: Workshop, state_dir: Path
) -> None:
    yard = rr.ChildSpec(Shop, id="yard", args=(str(workshop.root),), restart="temporary")
    system = start(shop(workshop), yard)
    app = system.open_registrar("app")
    app.load("yard/thing", Order("bike", ("shop/thing:chain",)))
    workshop.shut("unload chain")
    stopping = threading.Thread(target=system.supervisor().terminate_child, args=("yard",))
    stopping.start()  # it is closed for good: it has unloaded the bike, and waits for the chain
    workshop.wait("unload chain")
    with pytest.raises(rr.RegistrarDown, match="loads nothing any more"):
        app.load("yard/thing", Order("boat"))
    workshop.open("unload chain")
    stopping.join()
    assert workshop.lines("load boat") == []
    system.stop()
    assert served(state_dir, "yard") == []


# -- a manager that is deleted ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("back", ["in the same run", "in the next run"])
def test_a_deleted_manager_that_is_started_again_agrees_with_the_others(
    start: Start, workshop: Workshop, state_dir: Path, back: str
) -> None:
    system = start(shop(workshop), shop(workshop, "garage"))
    app = system.open_registrar("app")
    heard: list[rr.State] = []
    app.load("garage/thing", Order("car", ("shop/thing:wheel",)), on_status=lambda status: heard.append(status.state))
    system.supervisor().terminate_child("garage")
    system.supervisor().delete_child("garage")
    workshop.wait("unload wheel")
    eventually(lambda: heard == [rr.State.FATAL])
    eventually(lambda: not app.queries())
    eventually(lambda: check_state(state_dir) == [])

    if back == "in the same run":
        system.start_child(shop(workshop, "garage"))
    else:
        system.stop()
        system = start(shop(workshop), shop(workshop, "garage"))
        app = system.open_registrar("app")
    workshop.wait("unload car")
    eventually(lambda: not system.registrar("garage").resources())
    assert list(app.queries()) == []
    eventually(lambda: not app.owed())
    assert list(system.registrar("garage").queries()) == []
    assert heard == [rr.State.FATAL]
    assert app.load("garage/thing", Order("car", ("shop/thing:wheel",))).response.name == "car"
    assert len(workshop.lines("load wheel")) == 2


# -- notices ---------------------------------------------------------------------------------------------------------


def test_an_orderly_stop_leaves_no_notices_behind(start: Start, workshop: Workshop, state_dir: Path) -> None:
    garage, customers = shop(workshop, "garage"), shop(workshop)
    system = start(garage, customers)  # the shop stops first, and takes the wheel from the garage
    app = system.open_registrar("app")
    app.load("garage/thing", Order("car", ("shop/thing:wheel",)))
    kill(system, "garage")  # it holds a wheel, and its application has gone on
    wait_respawned(system, "garage", pid_of(system, "garage"))
    system.stop()
    assert served(state_dir) == []
    assert served(state_dir, "garage") == []


def test_a_query_that_joins_a_resource_in_warning_says_so(start: Start, workshop: Workshop) -> None:
    system = start(shop(workshop))
    app, other = system.open_registrar("app"), system.open_registrar("other")
    first = app.load("shop/thing", Order("wheel"))
    system.registrar("shop").send_status(first.resource_id, rr.Status(rr.State.WARNING, "worn"))
    assert app.load("shop/thing", Order("wheel")).state is rr.State.WARNING
    assert other.load("shop/thing", Order("wheel")).state is rr.State.WARNING
    assert other.load_all([("shop/thing", Order("wheel"))])[0].state is rr.State.WARNING
