"""The exercises of `rr-actors learn`: folders of the package, each with a file to mend, its check and a solution.

A folder has three programs, as text:

    exercise.py.txt   what the learner gets. Its docstring has the title, and what is to be done
    check.py.txt      a function check(scene), the reason in its docstring, and a block "# /// lab", as in the lab
    solution.py.txt   the file as it may be in the end

The block has the question, its answers and three hints. The check of the file as it was given answers the question.
"""

from __future__ import annotations

import ast
import functools
import inspect
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import msgspec

from rr_actors.base.errors import UsageError, did_you_mean, shown
from rr_actors.tools.web.lab.lab_declarations import LabDeclaration, Question
from rr_actors.tools.web.lab.lab_folder import declared_in

_FOLDER = Path(__file__).with_name("exercises")


class ExerciseDeclaration(LabDeclaration, frozen=True):
    """What a check declares: the place of its exercise, its question, and its hints.

    Attributes:
        hints: each says more than the one before.
        tried: what a learner should have tried before reading the solution.
    """

    hints: Annotated[tuple[str, ...], msgspec.Meta(min_length=3, max_length=3)] = ()
    tried: str = ""


@dataclass(frozen=True)
class Exercise:
    """An exercise.

    Attributes:
        number: its place, from 1 on.
        name: as the command line takes it.
        title, about: from the docstring of its file.
        why: the reason, for those who have mended it.
        text, solution, check: the three programs.
        declared: what the check declares.
    """

    number: int
    name: str
    title: str
    about: str
    why: str
    text: str
    solution: str
    check: str
    declared: ExerciseDeclaration

    @property
    def file_name(self) -> str:
        """The name of the learner's file."""
        return f"ex{self.number:02}_{self.name}.py"

    @property
    def question(self) -> Question:
        """What is asked before the learner sees what happens."""
        return Question(self.declared.question, self.declared.answers)


@functools.cache
def all_exercises() -> Sequence[Exercise]:
    """Return the exercises in their order."""
    read = [(folder, *_read(folder)) for folder in _FOLDER.iterdir() if (folder / "check.py.txt").is_file()]
    read.sort(key=lambda one: one[2].place)
    return [_exercise(number, *one) for number, one in enumerate(read, 1)]


def _read(folder: Path) -> tuple[str, ExerciseDeclaration]:
    check = (folder / "check.py.txt").read_text("utf-8")
    return check, declared_in(check, str(folder / "check.py.txt"), ExerciseDeclaration)


def _exercise(number: int, folder: Path, check: str, declared: ExerciseDeclaration) -> Exercise:
    text, solution = ((folder / f"{part}.py.txt").read_text("utf-8") for part in ("exercise", "solution"))
    title, _, about = _docstring(text).partition("\n")
    return Exercise(
        number, folder.name, title.rstrip("."), about.strip(), _docstring(check), text, solution, check, declared
    )


def _docstring(text: str) -> str:
    return inspect.cleandoc(ast.get_docstring(ast.parse(text)) or "")


def exercise_named(name: str, option: str) -> Exercise:
    """Return the exercise with a name, a number, or the name of its file.

    Raises:
        UsageError: there is none.
    """
    for one in all_exercises():
        if Path(name).name.removesuffix(".py") in (one.name, str(one.number), one.file_name.removesuffix(".py")):
            return one
    names = [one.name for one in all_exercises()]
    expected = f"expected the name or number of an exercise ({', '.join(names)})"
    raise UsageError(f"{option}: {expected}, got {shown(name)}{did_you_mean(name, names)}")
