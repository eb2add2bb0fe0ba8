"""What an experiment declares beside its program: levers, and a question that its run answers. All of it is pure."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TypeAlias

from rr_actors.system.console.console_messages import Event

Value: TypeAlias = str | int | float


@dataclass(frozen=True)
class Lever:
    """A parameter of an experiment's main().

    Attributes:
        name: the parameter.
        label: the words that people read.
        choices: its values; the first is the default, as in the program.
    """

    name: str
    label: str
    choices: tuple[Value, ...]


@dataclass(frozen=True)
class Seen:
    """What a run has shown: the events of its system, and the lines that its program has printed."""

    events: Sequence[Event] = ()
    lines: Sequence[str] = ()


@dataclass(frozen=True)
class Happens:
    """A sign: this event has happened to the child at this path."""

    event: str
    path: str

    def is_in(self, seen: Seen) -> bool:
        """Return whether a run has shown it."""
        return any(one.event == self.event and one.facts.get("path") == self.path for one in seen.events)


@dataclass(frozen=True)
class Prints:
    """A sign: the program has printed a line with this text."""

    text: str

    def is_in(self, seen: Seen) -> bool:
        """Return whether a run has shown it."""
        return any(self.text in line for line in seen.lines)


@dataclass(frozen=True)
class NothingElse:
    """The sign of an answer that is right if no other one is."""

    def is_in(self, seen: Seen) -> bool:
        """Return False: the question looks at the other answers."""
        return False


@dataclass(frozen=True)
class Question:
    """What the lab asks before an experiment runs. The run itself says which answers are right.

    Attributes:
        text: the question.
        answers: each answer, with the sign in the run that makes it right.
    """

    text: str
    answers: Mapping[str, Happens | Prints | NothingElse]

    def right(self, seen: Seen) -> frozenset[str]:
        """Return the answers that a run has shown to be right."""
        found = frozenset(answer for answer, sign in self.answers.items() if sign.is_in(seen))
        return found or frozenset(answer for answer, sign in self.answers.items() if isinstance(sign, NothingElse))

    def verdict(self, given: Collection[str], seen: Seen) -> str:
        """Return a sentence that compares the given answers with what a run has shown."""
        right = self.right(seen)
        said = ", ".join(answer for answer in self.answers if answer in right)
        if not right:
            return "This run has shown none of the answers."
        if not given:
            return f"You gave no answer. It was: {said}."
        if frozenset(given) == right:
            return f"Right: {said}."
        yours = ", ".join(answer for answer in self.answers if answer in given)
        return f"Not quite. You said: {yours}. It was: {said}."


@dataclass(frozen=True)
class LabExperiment:
    """An experiment of the lab.

    Attributes:
        program: its module, below rr_actors.tools.experiments.
        levers: the parameters of its main() that the page offers.
        question: what is asked before it runs; None asks nothing.
    """

    program: str
    levers: tuple[Lever, ...] = field(default=())
    question: Question | None = None

    @property
    def name(self) -> str:
        """The module's own name."""
        return self.program.rpartition(".")[2]

    def values(self, chosen: Mapping[str, str]) -> dict[str, Value] | None:
        """Return the values of all levers, with the texts of the chosen ones; None if one is no choice."""
        known = {lever.name: {str(value): value for value in lever.choices} for lever in self.levers}
        if any(chosen[name] not in known.get(name, {}) for name in chosen):
            return None
        return {lever.name: known[lever.name][chosen.get(lever.name, str(lever.choices[0]))] for lever in self.levers}
