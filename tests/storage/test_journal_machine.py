"""A store with a journal, whatever is done to it in whatever order, against a dict."""

from __future__ import annotations

import resource
import shutil
import tempfile
from pathlib import Path

import pytest
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, precondition, rule

from rr_actors.base.errors import CatalogError
from rr_actors.registrar.model.rows import Change, rows_of
from rr_actors.registrar.model.store import Store
from rr_actors.storage.opening import Durability, open_store, read_rows
from support_stores import CHANGES, Rows, after, in_order, segments_of

HEADER = 56  # bytes
BATCHES = st.lists(CHANGES, min_size=1, max_size=5)


class Journaled(RuleBasedStateMachine):
    """One catalog: committed to, tidied, on a disk that is full for a while, crashed, opened again."""

    store: Store

    def __init__(self) -> None:
        super().__init__()
        self.place = Path(tempfile.mkdtemp(prefix="rr-machine-"))
        self.generation = 0
        self.durability: Durability = "process"
        self.rows: Rows = {}
        self.epoch = 0

    @property
    def path(self) -> Path:
        return self.place / str(self.generation) / "catalog.sqlite3"

    def teardown(self) -> None:
        if hasattr(self, "store"):
            self.store.close()
            names = {file.name for file in self.path.parent.iterdir()}
            assert names in ({"catalog.lock", "catalog.sqlite3"}, set() if self.rows else {"catalog.lock"})
            assert in_order(read_rows(self.path)) == in_order(self.rows.values())
        shutil.rmtree(self.place)

    @initialize(durability=st.sampled_from(["process", "power"]))
    def open(self, durability: Durability) -> None:
        self.durability = durability
        self.store = open_store(self.path, durability=durability)
        self.epoch += 1
        assert self.store.epoch == self.epoch

    @rule(changes=BATCHES)
    def commit(self, changes: list[Change]) -> None:
        self.store.commit(changes)
        self.rows = after(self.rows, changes)

    @rule()
    def tidy(self) -> None:
        self.store.tidy()
        if self.durability == "process":
            left = segments_of(self.path)  # one that is only begun, if the commit after that failed
            assert [path.stat().st_size for path in left] in ([], [HEADER])
            assert not self.store.wants_tidying()

    @rule(size=st.sampled_from([0, 40, 56, 70, 200, 4096, 40_000]), changes=BATCHES)
    def commit_to_a_full_disk(self, size: int, changes: list[Change]) -> None:
        with full_disk(size):
            try:
                self.store.commit(changes)
            except CatalogError:
                return
        self.rows = after(self.rows, changes)

    @precondition(lambda self: self.durability == "process")
    @rule(size=st.sampled_from([0, 4096, 40_000]))
    def tidy_a_full_disk(self, size: int) -> None:
        waiting, kept = self.store.wants_tidying(), segments_of(self.path)
        with full_disk(size):
            try:
                self.store.tidy()
            except CatalogError:
                assert kept, "nothing else has to be done"
                assert set(kept) <= set(segments_of(self.path))
                assert waiting or not self.store.wants_tidying()

    @rule(durability=st.sampled_from(["process", "power"]))
    def close(self, durability: Durability) -> None:
        self.store.close()
        self.open(durability)

    @rule(durability=st.sampled_from(["process", "power"]), size=st.sampled_from([0, 4096, 40_000]))
    def close_on_a_full_disk(self, durability: Durability, size: int) -> None:
        with full_disk(size):
            self.store.close()
        self.open(durability)

    @rule(durability=st.sampled_from(["process", "power"]))
    def crash(self, durability: Durability) -> None:
        left, store = self.path.parent, self.store
        self.generation += 1
        shutil.copytree(left, self.path.parent)
        store.close()
        shutil.rmtree(left)
        self.open(durability)

    @rule(size=st.sampled_from([0, 4096, 20_000]), durability=st.sampled_from(["process", "power"]))
    def crash_and_open_on_a_full_disk(self, size: int, durability: Durability) -> None:
        left, store = self.path.parent, self.store
        self.generation += 1
        shutil.copytree(left, self.path.parent)
        store.close()
        shutil.rmtree(left)
        with full_disk(size):
            try:
                self.open(durability)
                return
            except CatalogError:
                pass
        assert in_order(read_rows(self.path)) == in_order(self.rows.values())
        self.open(durability)

    @rule()
    def erase(self) -> None:
        self.store.close(erase=True)
        assert not self.path.parent.exists()
        self.rows, self.epoch = {}, 0
        self.open(self.durability)

    @invariant()
    def it_is_what_was_committed(self) -> None:
        if hasattr(self, "store"):
            expected = in_order(self.rows.values())
            assert in_order(read_rows(self.path)) == expected
            assert in_order(rows_of(self.store.load())) == expected


class full_disk:  # noqa: N801
    """No file may have more bytes than that."""

    def __init__(self, size: int) -> None:
        self.size = size

    def __enter__(self) -> None:
        self.before = resource.getrlimit(resource.RLIMIT_FSIZE)
        resource.setrlimit(resource.RLIMIT_FSIZE, (self.size, self.before[1]))

    def __exit__(self, *_: object) -> None:
        resource.setrlimit(resource.RLIMIT_FSIZE, self.before)


@pytest.mark.slow
class TestJournaledForLong(Journaled.TestCase):
    settings = settings(max_examples=25, stateful_step_count=25)


TestJournaled = Journaled.TestCase
TestJournaled.settings = settings(max_examples=8, stateful_step_count=25)
