"""What an experiment declares beside its program: levers, and a question that its run answers. All of it is pure."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, TypeAlias

import msgspec

from rr_actors.system.recording.event_memory import Event

Value: TypeAlias = str | int | float


class Lever(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A parameter of an experiment's main().

    Attributes:
        name: the parameter.
        label: the words that people read.
        choices: its values; the first is the default, as in the program.
    """

    name: str
    label: str
    choices: Annotated[tuple[Value, ...], msgspec.Meta(min_length=1)]


@dataclass(frozen=True)
class Seen:
    """What a run has shown.

    Attributes:
        events: those of its system, oldest first: the newest 1,000.
        lines: those that its program has printed: the last 100.
    """

    events: Sequence[Event] = ()
    lines: Sequence[str] = ()

    def count(self, event: str, path: str) -> int:
        """Return how often something has happened to the child of a path: count("restarted", "root/team/b")."""
        return sum(one.event == event and one.path == path for one in self.events)

    def prints(self, text: str) -> bool:
        """Return whether a text is in a line that was printed."""
        return any(text in line for line in self.lines)


class Sign(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What makes an answer right: a printed line with a text, or an event of a child. An empty sign: no other is right.

    Attributes:
        prints: a text that is in a line which the program has printed.
        event, path: an event, and the path of the child to which it has happened.
    """

    prints: str = ""
    event: str = ""
    path: str = ""

    def is_in(self, seen: Seen) -> bool:
        """Return whether a run has shown it."""
        return seen.prints(self.prints) if self.prints else seen.count(self.event, self.path) > 0


class LabDeclaration(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What an experiment's file declares: its place on the page, its levers, and its question."""

    place: float = math.inf
    levers: tuple[Lever, ...] = ()
    question: str = ""
    answers: dict[str, Sign] = {}


@dataclass(frozen=True)
class Question:
    """What the lab asks before an experiment runs. The run itself says which answers are right.

    Attributes:
        text: the question.
        answers: each answer, with the sign in the run that makes it right.
    """

    text: str
    answers: Mapping[str, Sign]

    def right(self, seen: Seen) -> frozenset[str]:
        """Return the answers that a run has shown to be right."""
        found = frozenset(answer for answer, sign in self.answers.items() if sign.is_in(seen))
        return found or frozenset(answer for answer, sign in self.answers.items() if sign == Sign())

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
        program: its file.
        title, about: texts for people, from its docstring.
        look_for, why: what can be seen, and the reason. Both come after the answer to its question.
        code: its text after that.
        declared: what the file declares.
    """

    program: Path
    title: str
    about: str
    look_for: str
    why: str
    code: str
    declared: LabDeclaration

    @property
    def name(self) -> str:
        """The name of its file, without the ending."""
        return self.program.stem

    @property
    def button(self) -> str:
        """The words that the page shows in its list: the title up to its colon."""
        return self.title.partition(":")[0]

    @property
    def question(self) -> Question | None:
        """What is asked before it runs; None asks nothing."""
        return Question(self.declared.question, self.declared.answers) if self.declared.question else None

    @property
    def levers(self) -> tuple[Lever, ...]:
        """The parameters of its main() that the page offers."""
        return self.declared.levers

    def values(self, chosen: Mapping[str, str]) -> dict[str, Value] | None:
        """Return the values of all levers, with the texts of the chosen ones; None if one is no choice."""
        known = {lever.name: {str(value): value for value in lever.choices} for lever in self.levers}
        if any(chosen[name] not in known.get(name, {}) for name in chosen):
            return None
        return {lever.name: known[lever.name][chosen.get(lever.name, str(lever.choices[0]))] for lever in self.levers}
