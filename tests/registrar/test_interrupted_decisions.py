"""A thread is interrupted (Ctrl-C) before any instruction of a decision: it has happened, or not, on disk as well."""

from __future__ import annotations

import functools
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from types import FrameType, SimpleNamespace
from typing import Any

import pytest

import rr_actors
from rr_actors.base.config import RegistrarConfig
from rr_actors.base.errors import CatalogError
from rr_actors.base.values.failure import Failure
from rr_actors.hosting.run_files import DECISIONS
from rr_actors.registrar.core import holding
from rr_actors.registrar.core.decide import Item
from rr_actors.registrar.decisions.decided import Began
from rr_actors.registrar.decisions.deciding_again import DecidedAgain
from rr_actors.registrar.decisions.typed_values import value_from
from rr_actors.registrar.engine.registrar_state import RegistrarState
from rr_actors.registrar.model import commands as c
from rr_actors.registrar.model.catalog import Catalog, Server
from rr_actors.registrar.model.messages import Fetch, Load, Loaded, Noticed, Unload, Unloaded
from rr_actors.registrar.model.rows import Notice, Peer, Put, State
from rr_actors.registrar.model.store import MemoryStore
from simulation.quiescence import compared

HERE = Path(rr_actors.__file__).parent
TABLES = ("resources", "queries", "held", "notices", "peers")
INDEXES = (
    *("by_request", "unloading", "queued", "moving", "by_server", "holders", "by_origin", "notices_to", "notices_on"),
    *("parts", "outbound", "unsettled"),
)
MEMORY = ("waiting", "unanswered", "refused", "told", "heard", "hearing", "ending", "direct", "fresh", "up", "owners")


class Loop:
    """An event loop that does nothing of what it is asked for."""

    def call_soon_threadsafe(self, *_: Any) -> None:
        """Never."""

    def call_later(self, *_: Any) -> Any:
        """Never."""


class FullDisk(MemoryStore):
    """A store whose next commit fails, if the test says so."""

    full = False

    def commit(self, changes: Any) -> None:
        if self.full:
            raise CatalogError("disk full", path="memory")
        super().commit(changes)


def load(id: str, request: bytes = b"front") -> Load:
    return Load(id, "cam", request, "app", "", 0, 1)


def tell(item: Any, sender: str | None = None) -> Item:
    return item, sender


CAM = tell(c.Register(Server("cam"), "event"))
ASKED = tell(c.AskProvider("mine", "p", "cam", b"front", "", (1 << 32) + 1))
UP = tell(c.Reconcile("p", [], "event", [], 1))
HELD = tell(Loaded("mine", "r", b"feed"), "p")
NOTICE = Notice("n", "mine", "me", "r", "event", State.ERROR, "", "p/cam")
LOADED = c.CallbackEnded("load", "q", 1, response=b"feed")
ERRED = c.CallbackEnded("load", "q", 1, Failure("LoadFailed", "no such device"))

# What had happened before, and what is interrupted.
SCENES: dict[str, tuple[list[Item], Item]] = {
    "a first load": ([CAM], tell(load("q"), "app")),
    "a load that has succeeded": ([CAM, tell(load("q"), "app")], tell(LOADED)),
    "a load that has failed": ([CAM, tell(load("q"), "app")], tell(ERRED)),
    "a join": ([CAM, tell(load("q"), "app"), tell(LOADED)], tell(load("r"), "app")),
    "a last unload": ([CAM, tell(load("q"), "app"), tell(LOADED)], tell(Unload("q", "app"), "app")),
    "an unload that is done": (
        [CAM, tell(load("q"), "app"), tell(LOADED), tell(Unload("q", "app"), "app")],
        tell(c.CallbackEnded("unload", "q", 1)),
    ),
    "a status": (
        [CAM, tell(Fetch("app", True), "app"), tell(load("q"), "app"), tell(LOADED)],
        tell(c.SetStatus("q", "e", State.FATAL, "", "ticket")),
    ),
    "a load of its own": ([UP], ASKED),
    "a load of its own that has succeeded": ([UP, ASKED], HELD),
    "a status of its own": ([UP, ASKED, HELD], tell(Noticed(NOTICE, False), "p")),
    "a release": ([UP, ASKED, HELD], tell(c.Release("mine"))),
    "a release that is done": ([UP, ASKED, HELD, tell(c.Release("mine"))], tell(Unloaded("mine"), "p")),
}


class KeptState(RegistrarState):
    """A registrar's state alone, without the loop's turns."""

    def handle(self, deliveries: Any) -> None:
        raise AssertionError("nothing is delivered here")


class Stage:
    """A registrar's state, and what it has written."""

    def __init__(self, before: list[Item], *, noted: bool = False) -> None:
        self.store = FullDisk()
        self.texts: list[str] = []  # the notes of decisions
        loop: Any = Loop()
        workers: Any = None
        watched: Any = SimpleNamespace(level=bytearray([DECISIONS if noted else 0]))
        self.level: bytearray = watched.level
        self.state = KeptState("me", RegistrarConfig(name="me"), self.store, loop, workers, watched, self._send)
        for item in before:
            self.state.commit([item])

    def _send(self, _registrar: str, number: int, parts: Sequence[str]) -> bool:
        self.texts.append("".join(parts))
        return True

    def picture(self) -> dict[str, Any]:
        """What is known, in memory and on disk."""
        self.state.commits.save()
        catalog = self.state.catalog
        seen = {name: dict(getattr(catalog, name)) for name in (*TABLES, *MEMORY)}
        return {**seen, "disk": self.store.load()}

    def torn(self) -> list[str]:
        """The indexes that do not say what the rows say."""
        content: Any = {table: dict(rows) for table, rows in self.state.catalog.tables.items()}
        fresh = Catalog("me", content)
        kept = self.state.catalog
        return [name for name in INDEXES if compared(getattr(fresh, name)) != compared(getattr(kept, name))]


WITH = {
    getattr(RegistrarState, name).__code__ for name in ("commit", "join", "leave", "hold", "owe", "forget_released")
}


class Interrupts:
    """Raises KeyboardInterrupt before one instruction of the package's, by its number; counts them all."""

    def __init__(self, *places: int) -> None:
        self.places = places
        self.count = 0

    def _trace(self, frame: FrameType, event: str, _argument: Any) -> Any:
        code = frame.f_code
        if code in WITH or not code.co_filename.startswith(str(HERE)):
            return self._trace  # the `with` itself: Python looks for signals in it only where it is safe
        frame.f_trace_opcodes = True
        frame.f_trace_lines = False
        if event == "opcode":
            self.count += 1
            if self.count in self.places:
                raise KeyboardInterrupt
        return self._trace

    @contextmanager
    def __call__(self) -> Iterator[None]:
        before = sys.gettrace()
        sys.settrace(self._trace)
        try:
            yield
        finally:
            sys.settrace(before)


def interrupted(stage: Stage, item: Item, *places: int, full: bool = False) -> int:
    """Do it, interrupted there; how many instructions there were."""
    stage.store.full = full
    interrupts = Interrupts(*places)
    try:
        with interrupts():
            stage.state.commit([item])
    except (KeyboardInterrupt, CatalogError):
        pass
    stage.store.full = False
    with stage.state.enter():
        stage.state.whole()
    return interrupts.count


@functools.cache
def pictures(name: str) -> tuple[dict[str, Any], dict[str, Any]]:
    """Before and after."""
    before, item = SCENES[name]
    stage = Stage(before)
    first = stage.picture()
    stage.state.commit([item])
    return first, stage.picture()


def assert_whole(stage: Stage, name: str, *places: int) -> None:
    picture = stage.picture()
    assert picture in pictures(name), f"{name}: torn, interrupted at {places}"
    assert stage.torn() == [], f"{name}: interrupted at {places}"


SOME_OR_ALL = pytest.mark.parametrize(
    "step", [pytest.param(7, id="each seventh"), pytest.param(1, id="each", marks=pytest.mark.slow)]
)
"""How many instructions lie between the places at which it is interrupted."""


@SOME_OR_ALL
@pytest.mark.parametrize("name", SCENES)
def test_a_decision_that_is_interrupted_anywhere_has_happened_or_not(name: str, step: int) -> None:
    before, item = SCENES[name]
    count = interrupted(Stage(before), item)
    assert count > 100
    for place in range(1, count + 1, step):
        stage = Stage(before)
        interrupted(stage, item, place)
        assert_whole(stage, name, place)


@SOME_OR_ALL
@pytest.mark.parametrize("name", SCENES)
def test_a_decision_that_cannot_be_written_and_is_interrupted_has_not_happened(name: str, step: int) -> None:
    before, item = SCENES[name]
    for place in range(1, interrupted(Stage(before), item, full=True) + 1, step):
        stage = Stage(before)
        interrupted(stage, item, place, full=True)
        assert_whole(stage, name, place)


@SOME_OR_ALL
@pytest.mark.parametrize("full", [False, True])
@pytest.mark.parametrize("name", SCENES)
def test_what_is_noted_of_a_decision_that_is_interrupted_leads_to_what_is_known(
    name: str, full: bool, step: int
) -> None:
    before, item = SCENES[name]
    count = interrupted(Stage(before, noted=True), item, full=full)
    for place in range(1, count + 1, 31 * step):
        stage = Stage(before, noted=True)
        interrupted(stage, item, place, full=full)
        stage.state.commit([tell(c.AddInFlight())])
        stage.level[0] += 1  # another recording begins, and says what is known now
        stage.state.commit([tell(c.AddInFlight())])
        again = DecidedAgain()
        notes = [value_from(text) for text in stage.texts]
        for note in notes:
            if isinstance(note, Began):
                assert again.begin(note) == (), f"{name}: interrupted at {place}"
            else:
                assert again.decide(note).differences == (), f"{name}: interrupted at {place}"
                assert note.end == "raised" or again.is_known
        assert again.is_known
        last = notes[-1]
        assert not isinstance(last, Began)
        assert last.items == [tell(c.AddInFlight())]


@pytest.mark.parametrize("name", SCENES)
def test_whoever_is_interrupted_again_while_it_is_rolled_back_leaves_it_to_the_next(name: str) -> None:
    before, item = SCENES[name]
    count = interrupted(Stage(before), item)
    for first in range(1, count + 1, 23):
        whole = interrupted(Stage(before), item, first)
        for second in range(first + 1, whole + 1, 7):
            stage = Stage(before)
            interrupted(stage, item, first, second)
            assert_whole(stage, name, first, second)


# -- the fast paths ------------------------------------------------------------------------------------------------

IN_FLIGHT = holding.pending(c.AskProvider("mine", "p", "cam", b"front", "", (1 << 32) + 1))
GOT = c.Got("mine", "r", b"feed")


def begins(state: RegistrarState) -> None:
    state.catalog.in_flight["mine"] = IN_FLIGHT


def holds(state: RegistrarState) -> None:
    assert state.hold(GOT)


def saves(state: RegistrarState) -> None:
    state.commits.save()


def owes(state: RegistrarState) -> None:
    assert state.owe("mine")


def lets_go(state: RegistrarState) -> None:
    assert state.forget_released("mine")


def joins(state: RegistrarState) -> None:
    assert state.join(load("r")) is not None


def leaves(state: RegistrarState) -> None:
    assert state.leave(Unload("r", "app")) is not None


# What had happened before by decisions, and by threads; and what is interrupted.
QUICK: dict[str, tuple[list[Any], list[Any], Callable[[RegistrarState], None]]] = {
    "a join": ([CAM, tell(load("q"), "app"), tell(LOADED)], [], joins),
    "an unload that leaves others": ([CAM, tell(load("q"), "app"), tell(LOADED)], [joins], leaves),
    "a load by line": ([UP], [begins], holds),
    "a release by line": ([UP], [begins, holds], owes),
    "a release by line of what is on disk": ([UP], [begins, holds, saves], owes),
    "a release by line that is done": ([UP], [begins, holds, owes], lets_go),
    "a release by line that is done of what is on disk": ([UP], [begins, holds, saves, owes], lets_go),
}


def quick(name: str, *places: int) -> tuple[Stage, int]:
    """Do it, interrupted there; and how many instructions there were."""
    before, threads, work = QUICK[name]
    stage = Stage(before)
    for thread in threads:
        thread(stage.state)
    interrupts = Interrupts(*places)
    try:
        with interrupts():
            work(stage.state)
    except KeyboardInterrupt:
        pass
    with stage.state.enter():
        stage.state.whole()
    return stage, interrupts.count


@SOME_OR_ALL
@pytest.mark.parametrize("name", QUICK)
def test_a_fast_path_that_is_interrupted_anywhere_has_been_taken_or_not(name: str, step: int) -> None:
    before, threads, _ = QUICK[name]
    first = Stage(before)
    for thread in threads:
        thread(first.state)
    last, count = quick(name)
    whole = (known(first), known(last))
    assert count > 30
    for place in range(1, count + 1, step):
        stage, _ = quick(name, place)
        assert known(stage) in whole, f"{name}: torn, interrupted at {place}"
        assert stage.torn() == [], f"{name}: interrupted at {place}"


def known(stage: Stage) -> dict[str, Any]:
    """What is known, in memory and on disk."""
    return {**stage.picture(), "in_flight": dict(stage.state.catalog.in_flight)}


def test_a_decision_goes_on_after_one_that_was_interrupted_in_another_thread() -> None:
    before, item = SCENES["a first load"]
    stage = Stage(before)
    thread = threading.Thread(target=lambda: interrupted(stage, item, 60))
    thread.start()
    thread.join()
    stage.state.commit([item])
    assert stage.picture() == pictures("a first load")[1]
    assert stage.torn() == []


@SOME_OR_ALL
def test_what_is_let_go_after_a_commit_that_was_interrupted_is_not_left_on_disk(step: int) -> None:
    """The commit may have written what is held briefly, and not have noted that."""
    item = tell(c.SetRows([Put(Peer("other"))]))

    def holding_briefly() -> Stage:
        stage = Stage([UP])
        begins(stage.state)
        holds(stage.state)
        return stage

    for place in range(1, interrupted(holding_briefly(), item) + 1, step):
        stage = holding_briefly()
        interrupted(stage, item, place)
        owes(stage.state)
        lets_go(stage.state)
        assert stage.picture()["disk"]["held"] == {}, f"interrupted at {place}"
