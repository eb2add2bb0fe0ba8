"""Scenes: what a check uses to drive a learner's file, and to say what it has found."""

from __future__ import annotations

import ast
import contextlib
import logging
import time
from collections.abc import Callable, Generator, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from types import ModuleType
from typing import Any, Literal, TypeVar, cast

import msgspec

from rr_actors.base.errors import RrError, shown
from rr_actors.supervision.core.rendering import render
from rr_actors.supervision.core.specs import ChildModel, ChildSpec, Supervisor
from rr_actors.system.recording.event_memory import Event
from rr_actors.system.recording.recordings import Recording, entry_of
from rr_actors.system.recording.sequence_diagrams import sequence_of
from rr_actors.system.recording.timelines import timeline_of
from rr_actors.system.simulated.simulated_runs import SimulatedRun, paths_of, simulate
from rr_actors.system.system import System
from rr_actors.tools.learn.text_pictures import sequence_text, timeline_text

_T = TypeVar("_T")
_LOOK_S = 0.01
_LEFT_OUT = frozenset(
    ("Fetch", "Fetched", "Describe", "Described", "Reprioritise", "Reprioritised", "NoticesHandled", "Stop")
)
"""Messages between registrars that a learner need not know."""


class Outcome(msgspec.Struct):
    """What a check has found.

    Attributes:
        passed: the exercise is mended.
        what: a sentence, if it is not.
        where: the place in the learner's file; "" if it is the whole of it.
        expected, got: what the check compared; "" if it has compared nothing.
        picture: what happened, as text.
        lines: what the check said on its way. The question's answers are in them.
        printed: the last of what the learner's file has printed.
    """

    passed: bool
    what: str = ""
    where: str = ""
    expected: str = ""
    got: str = ""
    picture: str = ""
    lines: list[str] = []
    printed: str = ""


class Wrong(Exception):
    """The exercise is not mended. str() says what is wrong; the attributes are those of an Outcome."""

    def __init__(self, what: str, where: str = "", expected: object = "", got: object = "") -> None:
        super().__init__(what)
        self.where = where
        self.expected = expected if isinstance(expected, str) else shown(expected)
        self.got = got if isinstance(got, str) else shown(got)


@dataclass
class Scene:
    """A learner's file, and what a check sees of it.

    Attributes:
        module: the file, imported.
        folder: an empty directory for systems and files.
        lines: what the check said.
        picture: the newest picture.
    """

    module: ModuleType
    folder: Path
    lines: list[str] = field(default_factory=list[str])
    picture: str = ""
    _systems: int = 0

    def say(self, line: str) -> None:
        """Note a fact. A fact may answer the question of the exercise."""
        self.lines.append(line)

    # -- what the file has ---------------------------------------------------------------------------------------------

    def get(self, name: str) -> Any:
        """Return what the file calls by a name.

        Raises:
            Wrong: it has no such name.
        """
        if (found := getattr(self.module, name, None)) is None:
            raise Wrong(f"{name} is missing in the file", self.file, name, "none")
        return found

    def tree(self, ids: Iterable[str], name: str = "tree") -> Supervisor:
        """Return the tree that a function of the file makes.

        Args:
            ids: the children that it must have, under any supervisors.
            name: of the function.

        Raises:
            Wrong: it returns something else, or has not just these children.
        """
        made: object = self.get(name)()
        if not isinstance(made, Supervisor):
            raise Wrong(f"{name}() makes no tree", self.where(name), "a Supervisor", made)
        there = [path.rpartition("/")[2] for path, spec in paths_of(made).items() if spec.type != "supervisor"]
        self.picture = render(made)
        if sorted(there) != sorted(ids):
            expected = f"the children {', '.join(sorted(ids))}"
            raise Wrong("the tree has other children than before", self.where(name), expected, ", ".join(sorted(there)))
        return made

    @property
    def file(self) -> str:
        """The name of the file."""
        return Path(self.module.__file__ or "").name

    def where(self, name: str) -> str:
        """Return the place of a function, class or variable, for people; "Camera.on_receive" names a method."""
        tree: ast.AST = ast.parse(Path(self.module.__file__ or "").read_bytes())
        line = 0
        for part in name.split("."):
            found = next((node for node in ast.iter_child_nodes(tree) if part in _names(node)), None)
            if found is None:
                break
            tree, line = found, cast("ast.stmt", found).lineno
        return f"{name} in {self.file}, line {line}" if line else self.file

    # -- in virtual time -----------------------------------------------------------------------------------------------

    def simulate(
        self,
        tree: Supervisor,
        scenario: Mapping[str, ChildModel] | Sequence[tuple[str, float]],
        *,
        models: Mapping[str, ChildModel] | None = None,
        until_s: float,
        seed: int = 1,
    ) -> SimulatedRun:
        """Run a tree in virtual time, as rr.simulate(); the picture is its timeline."""
        run = simulate(tree, scenario, models=models, until_s=until_s, seed=seed)
        picture = run.timeline
        if run.ended_at is not None:  # what comes later is empty
            picture.until = picture.since + 1.25 * run.ended_at
        self.picture = timeline_text(picture)
        return run

    # -- in real time --------------------------------------------------------------------------------------------------

    @contextlib.contextmanager
    def system(
        self,
        root: Supervisor | Sequence[ChildSpec | Supervisor] = (),
        draws: Literal["timeline", "sequence", "nothing"] = "timeline",
    ) -> Generator[Stage]:
        """Run a system in this block; afterwards the picture is its timeline, its messages, or as before."""
        self._systems += 1
        system = System(cast("Any", root), state_dir=self.folder / f"state{self._systems}")
        events: list[Event] = []
        recording: Recording | None = None
        system.subscribe(lambda event: events.append(Event.of(cast("dict[str, Any]", event))))
        try:
            system.start()
            recording = system.record()
            yield Stage(system, events)
        finally:
            until = time.time()
            with contextlib.suppress(RrError):  # a tree that has given up
                system.stop(5.0)
            if recording is not None:
                recording.stop()
            if draws == "sequence" and recording is not None:
                sent = [one for one in recording.messages().entries if one.at <= until and one.name not in _LEFT_OUT]
                self.picture = sequence_text(sequence_of(sent))
            elif draws == "timeline":
                heard = [one for one in events if one.at <= until]
                self.picture = timeline_text(timeline_of(map(entry_of, heard)))


def _names(node: ast.AST) -> list[str]:
    """Return the names that a statement gives to something."""
    match node:
        case ast.FunctionDef(name=name) | ast.AsyncFunctionDef(name=name) | ast.ClassDef(name=name):
            return [name]
        case ast.AnnAssign(target=ast.Name(id=name)):
            return [name]
        case ast.Assign(targets=targets):
            return [target.id for target in targets if isinstance(target, ast.Name)]
        case _:
            return []


@dataclass(frozen=True)
class Stage:
    """A system that runs, for a check.

    Attributes:
        system: it.
        events: what happened, oldest first; others are added meanwhile.
    """

    system: System
    events: list[Event]

    def count(self, event: str, path: str) -> int:
        """Return how often something has happened to the child of a path."""
        return sum(one.event == event and one.path == path for one in self.events.copy())


def eventually(look: Callable[[], _T], timeout_s: float = 5.0) -> _T:
    """Return the first true value of a function that is asked again and again, or its last one in time."""
    until = time.monotonic() + timeout_s
    while not (found := look()) and time.monotonic() < until:
        time.sleep(_LOOK_S)
    return found


def quiet() -> None:
    """Leave the log of the framework out: the picture shows the events."""
    logging.getLogger("rr_actors").addHandler(logging.NullHandler())
    logging.getLogger("rr_actors").propagate = False
