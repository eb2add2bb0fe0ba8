"""How long the loop waits for Python's lock beside a callback that computes: in this package's own processes alone."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

import rr_actors as rr
from rr_actors.storage.journaled_store import JournaledStore


class Intervals(rr.Manager):
    """Tells its process's switch interval: as callbacks see it, and during commits."""

    def on_start(self) -> None:
        super().on_start()
        self.during: list[float] = []
        commit = JournaledStore.commit

        def watched(store: JournaledStore, changes: list[object]) -> None:
            self.during.append(sys.getswitchinterval())
            commit(store, changes)  # pyright: ignore[reportArgumentType]

        JournaledStore.commit = watched  # type: ignore[method-assign]  # this process is the test's own

    @rr.server("interval")
    def load_interval(self, request: int) -> list[float]:
        if request < 0:
            sys.setswitchinterval(0.002)
        return [sys.getswitchinterval(), *self.during]


def test_a_commit_hurries_in_a_child_process_and_the_interval_is_what_it_was_again(tmp_path: Path) -> None:
    before = sys.getswitchinterval()
    with rr.System([rr.ChildSpec(Intervals, id="child")], state_dir=tmp_path) as system:
        app = system.open_registrar("app")
        normal, *_ = app.load("child/interval", 0).response
        again, *during = app.load("child/interval", 1).response
        assert normal == again < 0.001
        assert during
        assert max(during) < normal
        app.load("child/interval", -1)
        own, *_ = app.load("child/interval", 2).response
        assert own == pytest.approx(0.002)  # a callback's own choice is kept
        assert sys.getswitchinterval() == before


def test_in_the_users_process_nothing_is_changed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    before = sys.getswitchinterval()
    during: list[float] = []
    commit = JournaledStore.commit

    def noted(store: JournaledStore, changes: list[object]) -> None:
        during.append(sys.getswitchinterval())
        commit(store, changes)  # pyright: ignore[reportArgumentType]

    monkeypatch.setattr(JournaledStore, "commit", noted)
    with rr.System([], state_dir=tmp_path) as system:
        here = system.open_registrar("here")
        here.register_server("thing", load=str)
        here.load("here/thing", 1)
    assert set(during) == {before}
    assert sys.getswitchinterval() == before
