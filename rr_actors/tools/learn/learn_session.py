"""The learner's session: it asks, checks the file when it is saved, and shows what happened. Keys do the rest."""

from __future__ import annotations

import contextlib
import difflib
import os
import select
import sys
import termios
import textwrap
import tty
from collections import deque
from collections.abc import Iterator
from typing import Self

import typer

from rr_actors.base.errors import counted
from rr_actors.tools.cli_commands import say, say_lines, say_table
from rr_actors.tools.learn.check_process import check_as_given, check_file
from rr_actors.tools.learn.learn_exercises import Exercise, all_exercises
from rr_actors.tools.learn.learn_progress import LIST_HEADS, LearnerFolder, list_rows
from rr_actors.tools.learn.scenes import Outcome
from rr_actors.tools.learn.text_pictures import WIDTH
from rr_actors.tools.log_lines import printable
from rr_actors.tools.module_watcher import SavedFile
from rr_actors.tools.web.lab.lab_declarations import Seen

_LOOK_S = 0.2  # between two looks at the file
_PRINTED = 10  # lines
_KEYS = "h hint   s solution   c check now   l list   r restore the file   q quit"


# -- what people see ---------------------------------------------------------------------------------------------------


def show_outcome(exercise: Exercise, found: Outcome) -> None:
    """Print what a check has found: the picture, what is wrong and where, what was expected; or why it is right."""
    typer.echo()
    say_lines(found.picture, "  ")
    typer.echo()
    if printed := found.printed.splitlines()[-_PRINTED:]:
        say("  the file printed:")
        say_lines("\n".join(printed), "    ")
        typer.echo()
    if found.passed:
        _say(f"✓ {exercise.file_name} is mended.", "green")
        _say_prose(exercise.why)
        return
    _say(f"✗ {exercise.file_name}: {found.what}", "red")
    for head, text in (("where", found.where), ("expected", found.expected), ("got", found.got)):
        if text:
            say_wrapped(text, f"  {head:<9} ")


def show_list(folder: LearnerFolder) -> None:
    """Print the exercises, and how far the learner is."""
    say_table(LIST_HEADS, list_rows(folder), gives_way=("title",), right=("no", "failed"))


def check_once(folder: LearnerFolder, exercise: Exercise, limit_s: float) -> bool:
    """Check the learner's file, print what was found, and return whether it is mended."""
    folder.show(exercise)
    file = folder.file(exercise)
    if not file.exists():
        _say(
            f"✗ {exercise.file_name} is gone: rr-actors learn {folder.path} --reset {exercise.name} restores it", "red"
        )
        return False
    found = check_file(exercise, file, limit_s)
    folder.judge(exercise, found.passed)
    show_outcome(exercise, found)
    return found.passed


def say_wrapped(text: str, before: str = "") -> None:
    """Print a text as lines that fit into a terminal, with the text `before` in front of the first one."""
    words = printable(text.replace("\n", " "))
    lines = textwrap.wrap(words, WIDTH, initial_indent=before, subsequent_indent=" " * len(before))
    typer.echo("\n".join(lines))


def _say_prose(text: str) -> None:
    for number, paragraph in enumerate(text.split("\n\n")):
        if number:
            typer.echo()
        say_wrapped(" ".join(paragraph.split()))


def _say(text: str, colour: str) -> None:
    typer.secho(printable(text), fg=colour, bold=True)


def _head(folder: LearnerFolder, exercise: Exercise) -> None:
    typer.echo()
    title = f"{exercise.number} of {len(all_exercises())}: {exercise.title}"
    typer.secho(title, bold=True)
    typer.echo("─" * len(title))
    _say_prose(exercise.about)
    typer.echo()
    say(f"The file: {folder.file(exercise)}")


# -- keys --------------------------------------------------------------------------------------------------------------


class Keys:
    """The keyboard, as single keys, in this block."""

    def __enter__(self) -> Self:
        self._fd = sys.stdin.fileno()
        self._before = termios.tcgetattr(self._fd)
        self._waiting: deque[str] = deque()
        tty.setcbreak(self._fd)
        return self

    def __exit__(self, *exc: object) -> None:
        termios.tcsetattr(self._fd, termios.TCSADRAIN, self._before)

    def next(self, timeout_s: float | None = None) -> str:
        """Return a key; "" after so many seconds without one.

        Raises:
            EOFError: the terminal has gone.
        """
        if not self._waiting:
            if not select.select([self._fd], [], [], timeout_s)[0]:
                return ""
            if not (data := os.read(self._fd, 64)):
                raise EOFError
            if not data.startswith(b"\x1b"):  # an arrow, say: several bytes, and no key that means anything here
                self._waiting.extend(data.decode(errors="ignore"))
        return self._waiting.popleft() if self._waiting else ""


# -- the session -------------------------------------------------------------------------------------------------------


class Session:
    """A learner at a terminal, from the first exercise that is not done. For one thread."""

    def __init__(self, folder: LearnerFolder, limit_s: float) -> None:
        self._folder = folder
        self._limit_s = limit_s

    def run(self) -> None:
        """Go on until the last exercise is done, or the learner quits."""
        with Keys() as keys, contextlib.suppress(KeyboardInterrupt, EOFError):
            while (exercise := self._folder.at()) is not None:
                if not self._mend(exercise, keys):
                    self._leave()
                    return
            _say(f"All {len(all_exercises())} exercises are done.", "green")

    def _leave(self) -> None:
        typer.echo()
        done = f"{self._folder.done()} of {len(all_exercises())} are done"
        say(f"{done}. Go on with: rr-actors learn {self._folder.path}")

    def _mend(self, exercise: Exercise, keys: Keys) -> bool:
        """Go through one exercise, and return whether another one may follow."""
        self._folder.show(exercise)
        _head(self._folder, exercise)
        if not self._folder.step(exercise).answer and not self._ask(exercise, keys):
            return False
        saved = SavedFile(self._folder.file(exercise))  # before the check: a save during it is seen
        passed = check_once(self._folder, exercise, self._limit_s)
        self._say_keys(passed)
        for key in self._events(saved, keys):
            match key:
                case "q":
                    return False
                case "h" if not passed:
                    say_wrapped(self._folder.take_hint(exercise))
                case "s" if not passed:
                    self._show_solution(exercise, keys)
                case "l":
                    show_list(self._folder)
                case "r":
                    self._restore(exercise, keys)
                case "n" | "\n" if passed:
                    return True
                case "c" | "saved":
                    passed = check_once(self._folder, exercise, self._limit_s)
                    self._say_keys(passed)
                case _:
                    continue
        return False

    def _say_keys(self, passed: bool) -> None:
        typer.echo()
        if not passed:
            say("It is checked when you save it.")
        say("n next exercise   l list   q quit" if passed else _KEYS)

    def _events(self, saved: SavedFile, keys: Keys) -> Iterator[str]:
        """Yield each key, and "saved" for each save of the file."""
        while True:
            if saved.look():
                yield "saved"
            elif key := keys.next(_LOOK_S):
                yield key

    def _ask(self, exercise: Exercise, keys: Keys) -> bool:
        """Ask what will happen, show it, and compare; return False if the learner quits."""
        question = exercise.question
        answers = list(question.answers)
        typer.echo()
        typer.secho(printable(question.text), bold=True)
        for number, answer in enumerate(answers, 1):
            say(f"  {number}  {answer}")
        say(f"Press 1 to {len(answers)}; q quits.")
        while (key := keys.next()) not in [str(number) for number in range(1, len(answers) + 1)]:
            if key == "q":
                return False
        given = answers[int(key) - 1]
        found = check_as_given(exercise, self._limit_s)
        self._folder.step(exercise).answer = given
        self._folder.save()
        typer.echo()
        say_wrapped(question.verdict([given], Seen(lines=found.lines)))
        return True

    def _show_solution(self, exercise: Exercise, keys: Keys) -> None:
        hints = self._folder.step(exercise).hints
        untaken = "" if hints >= 3 else f" And there are {counted(3 - hints, 'more hint')} (h)."
        say_wrapped(f"Have you tried {exercise.declared.tried}?{untaken} Show the solution? y/N")
        if keys.next() not in ("y", "Y"):
            say("Good: try it.")
            return
        self._folder.step(exercise).has_read_solution = True
        self._folder.save()
        say_lines(solution_of(exercise), "  ")

    def _restore(self, exercise: Exercise, keys: Keys) -> None:
        file = self._folder.file(exercise)
        if file.exists():
            say(f"Put {file.name} back as it was given? Your text is kept beside it. y/N")
            if keys.next() not in ("y", "Y"):
                return
        before = self._folder.reset(exercise)
        say(f"{file.name} is as it was given" + (f"; your text is in {before.name}" if before else ""))


def solution_of(exercise: Exercise) -> str:
    """Return what a solution changes in the file as it was given: lines with - and +."""
    lines = difflib.unified_diff(exercise.text.splitlines(), exercise.solution.splitlines(), n=2, lineterm="")
    return "\n".join(list(lines)[2:])
