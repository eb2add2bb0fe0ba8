"""The state directory goes away under a running system: nothing is acknowledged that is not on disk."""

from __future__ import annotations

import logging
import os
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

import rr_actors as rr
from rr_actors.hosting import run_files
from rr_actors.hosting.run_files import RunKeeper
from rr_actors.supervision.core import restarts
from rr_actors.supervision.core.specs import Backoff
from support import eventually, kill, pid_of, wait_respawned

Start = Callable[..., rr.System]


class Maker(rr.Manager):
    """Serves its process's id."""

    @rr.server("thing")
    def load(self, request: str) -> int:
        return os.getpid()

    @load.unload
    def unload(self, request: str, response: int) -> None:
        pass


def _removed(state_dir: Path) -> None:
    shutil.rmtree(state_dir)


def _renamed(state_dir: Path) -> None:
    state_dir.rename(state_dir.with_name("moved"))


def _replaced(state_dir: Path) -> None:
    """As if something were mounted over it."""
    state_dir.rename(state_dir.with_name("moved"))
    state_dir.mkdir(0o700)


def _refusal(load: Callable[[], Any]) -> rr.RrError | None:
    try:
        load()
    except rr.RrError as error:
        return error
    return None


@pytest.fixture
def state(tmp_path: Path) -> Path:
    return tmp_path / "state"


@pytest.fixture
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(restarts, "PAUSE", Backoff(delay_s=0.05, factor=2.0, maximum_s=0.2, jitter=0.1))


WAYS = [_removed, _renamed, _replaced]


@pytest.mark.parametrize("go_away", WAYS)
def test_what_cannot_be_on_disk_is_not_acknowledged_and_the_error_names_the_directory(
    state: Path, go_away: Callable[[Path], None]
) -> None:
    system = rr.System([rr.ChildSpec(Maker, id="maker")], state_dir=state).start()
    try:
        app = system.open_registrar("app")
        app.load("maker/thing", "before")
        go_away(state)

        numbers = iter(range(10**6))
        eventually(lambda: _refusal(lambda: app.load("maker/thing", f"new {next(numbers)}")) is not None, 2.0)
        for number in range(20):
            refusal = _refusal(lambda number=number: app.load("maker/thing", f"later {number}"))
            assert str(state) in str(refusal)
            assert "the directory in use is not there any more" in str(refusal)
        with pytest.raises(rr.CatalogError, match="the directory in use is not there any more") as refused:
            system.open_registrar("other")
        assert refused.value.path == str(state)
        assert not (state / "other").exists()
    finally:
        failed = _refusal(system.stop)
    assert failed is None or "the directory in use is not there any more" in str(failed)
    assert not (state / "maker").exists()


@pytest.mark.parametrize("durability", ["process", "power"])
def test_a_catalogs_own_directory_that_goes_away_is_named_whatever_the_durability(
    start: Start, state_dir: Path, durability: Any
) -> None:
    system = start()
    made: list[str] = []
    provider = system.open_registrar("provider", config=rr.RegistrarConfig(name="provider", durability=durability))
    provider.register_server("thing", made.append)
    app = system.open_registrar("app")
    app.load("provider/thing", "before").unload()
    away = state_dir / "provider"
    away.rename(state_dir / "moved")

    numbers = iter(range(10**6))

    def named() -> bool:  # a load that had begun before the directory went away may wait for its result to be on disk
        refusal = _refusal(lambda: app.load("provider/thing", f"new {next(numbers)}", timeout_s=0.5))
        return f"{away}: the directory in use is not there any more" in str(refusal)

    eventually(named)
    count = len(made)
    assert _refusal(lambda: app.load("provider/thing", "later")) is not None
    assert len(made) == count, "nothing was done that is not on disk"

    (state_dir / "moved").rename(away)
    app.load("provider/thing", "back").unload()


def test_a_manager_that_is_respawned_meanwhile_waits_and_is_itself_when_the_directory_is_back(
    state: Path, quick: None
) -> None:
    with rr.System([rr.ChildSpec(Maker, id="maker")], state_dir=state) as system:
        app = system.open_registrar("app")
        query = app.load("maker/thing", "one")
        old = pid_of(system, "maker")
        moved = state.with_name("moved")
        state.rename(moved)

        kill(system, "maker")
        failed = eventually(lambda: [r for r in system.supervisor().history() if r.event == "start_failed"][4:])
        assert all("is not in its place" in record.detail and not record.restarts for record in failed)
        assert not state.exists()

        moved.rename(state)
        wait_respawned(system, "maker", old)
        assert [held.id for held in app.fetch_queries("maker")] == [query.id]
        eventually(lambda: _refusal(query.unload) is None)


def test_the_log_says_once_that_the_directory_is_gone_and_does_not_contradict_itself(
    state: Path, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    looks: list[RunKeeper] = []
    look = RunKeeper.look

    async def counted(keeper: RunKeeper) -> None:
        await look(keeper)
        looks.append(keeper)

    def wait_for_looks(count: int) -> None:
        looks.clear()
        eventually(lambda: len(looks) >= count)

    monkeypatch.setattr(run_files, "LOOK_S", 0.02)
    monkeypatch.setattr(RunKeeper, "look", counted)

    def said() -> list[str]:
        return [record.getMessage() for record in caplog.records if record.levelno >= logging.WARNING]

    system = rr.System([], state_dir=state).start()
    system.open_registrar("app")
    _renamed(state)
    wait_for_looks(5)
    (gone,) = said()
    assert gone.startswith(f"{state}: the directory in use is not there any more")

    state.with_name("moved").rename(state)
    wait_for_looks(3)
    system.stop()
    (back,) = said()[1:]
    assert back.endswith("the directory is in its place again, and written to")
