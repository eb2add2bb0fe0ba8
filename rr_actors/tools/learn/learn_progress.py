"""A learner's directory: the files to mend, and how far the learner is. A teacher reads those of a class."""

from __future__ import annotations

import contextlib
import getpass
import itertools
import os
import time
from collections.abc import Sequence
from pathlib import Path

import msgspec

from rr_actors.base.errors import UsageError
from rr_actors.base.folder import read_plain
from rr_actors.tools.learn.learn_exercises import Exercise, all_exercises

FILE = "progress.json"
_NEW = f".{FILE}."  # before the id of the process that writes it
_BEFORE = ".before"  # after the name of a file that a reset has moved away; further ones have a number


class Step(msgspec.Struct):
    """How far a learner is with one exercise.

    Attributes:
        began_at: when it was shown first, in seconds since the epoch; 0.0 if it was not.
        done_at: when its check first passed; 0.0 if it has not.
        answer: what the learner expected; "" without an answer.
        tries: how many checks of the learner's file have failed.
        hints: how many were taken.
        has_read_solution: whether the learner has read it.
    """

    began_at: float = 0.0
    done_at: float = 0.0
    answer: str = ""
    tries: int = 0
    hints: int = 0
    has_read_solution: bool = False


class LearnerProgress(msgspec.Struct):
    """What the file has.

    Attributes:
        version: of its format.
        learner: the name of the user who began.
        steps: by the names of the exercises.
    """

    version: int
    learner: str
    steps: dict[str, Step] = {}


class LearnerFolder:
    """A learner's directory. For one process at a time.

    Attributes:
        path: of the directory.
        progress: as its file has it.
    """

    def __init__(self, path: Path, progress: LearnerProgress) -> None:
        self.path = path
        self.progress = progress

    @classmethod
    def begin(cls, path: Path) -> LearnerFolder:
        """Open a learner's directory; make it if it is missing or empty. Add the files of exercises not shown yet.

        Raises:
            UsageError: the path names something else, or it cannot be read or written.
        """
        try:
            if (path / FILE).exists() or (path.exists() and not path.is_dir()):
                folder = cls.open(path)
            else:
                if path.is_dir() and any(not one.name.startswith(_NEW) for one in path.iterdir()):
                    raise _no_folder(path, f"a directory with other files, and without {FILE}")
                path.mkdir(parents=True, exist_ok=True)
                folder = cls(path, LearnerProgress(1, _user()))
                folder.save()  # first: what a kill leaves here is a learner's directory, and the next call goes on
            folder._add_files()
        except OSError as error:
            raise _cannot_write(path, error) from error
        return folder

    @classmethod
    def open(cls, path: Path) -> LearnerFolder:
        """Open a learner's directory.

        Raises:
            UsageError: it is none, or cannot be read.
        """
        try:
            progress = msgspec.json.decode(read_plain(path / FILE), type=LearnerProgress)
        except (FileNotFoundError, NotADirectoryError):
            what = "nothing of that name" if not path.exists() else f"no {FILE} in it" if path.is_dir() else "a file"
            raise _no_folder(path, what) from None
        except (OSError, msgspec.MsgspecError) as error:
            said = getattr(error, "strerror", None) or f"a {FILE} that is damaged: {error}"
            raise _no_folder(path, said) from error
        if progress.version != 1:
            raise _no_folder(path, f"a {FILE} of version {progress.version}")
        return cls(path, progress)

    def file(self, exercise: Exercise) -> Path:
        """Return the learner's file of an exercise."""
        return self.path / exercise.file_name

    def step(self, exercise: Exercise) -> Step:
        """Return how far the learner is with an exercise. Changes last when they are saved."""
        return self.progress.steps.setdefault(exercise.name, Step())

    def at(self) -> Exercise | None:
        """Return the first exercise that is not done; None after the last."""
        return next((one for one in all_exercises() if not self._is_done(one)), None)

    def done(self) -> int:
        """Return how many exercises are done."""
        return sum(map(self._is_done, all_exercises()))

    def _is_done(self, exercise: Exercise) -> bool:
        return bool(self.progress.steps.get(exercise.name, Step()).done_at)

    def show(self, exercise: Exercise) -> None:
        """Note that the learner sees an exercise."""
        step = self.step(exercise)
        if not step.began_at:
            step.began_at = time.time()
            self.save()

    def judge(self, exercise: Exercise, passed: bool) -> None:
        """Note what a check of the learner's file has found."""
        step = self.step(exercise)
        if passed:
            step.done_at = step.done_at or time.time()
        else:
            step.tries += 1
        self.save()

    def take_hint(self, exercise: Exercise) -> str:
        """Return the next hint with its number, or the last one again."""
        step, hints = self.step(exercise), exercise.declared.hints
        step.hints = min(step.hints + 1, len(hints))
        self.save()
        return f"hint {step.hints} of {len(hints)}: {hints[step.hints - 1]}"

    def reset(self, exercise: Exercise) -> Path | None:
        """Restore the file of an exercise as it was given; return where the learner's text is now, if it was another.

        Raises:
            UsageError: the directory cannot be written.
        """
        file, before = self.file(exercise), None
        try:
            if not file.is_file() or read_plain(file) != exercise.text.encode():
                if os.path.lexists(file):
                    before = _free_name(file)
                    file.replace(before)
                file.write_text(exercise.text, "utf-8")
        except OSError as error:
            raise _cannot_write(self.path, error) from error
        self.step(exercise).done_at = 0.0
        self.save()
        return before

    def _add_files(self) -> None:
        """Write the files that are missing, but not of an exercise that the learner has seen: that one was deleted."""
        for one in all_exercises():
            if one.name not in self.progress.steps and not os.path.lexists(self.file(one)):
                self.file(one).write_text(one.text, "utf-8")

    def save(self) -> None:
        """Write the progress, whole.

        Raises:
            UsageError: the directory cannot be written.
        """
        new = self.path / f"{_NEW}{os.getpid()}"
        try:
            new.write_bytes(msgspec.json.format(msgspec.json.encode(self.progress), indent=1))
            new.replace(self.path / FILE)
        except OSError as error:
            with contextlib.suppress(OSError):
                new.unlink(missing_ok=True)
            raise _cannot_write(self.path, error) from error


def _free_name(file: Path) -> Path:
    """Return a name beside a file that no earlier text has."""
    name = file.with_name(file.name + _BEFORE)
    numbers = itertools.count(2)
    while os.path.lexists(name):
        name = file.with_name(f"{file.name}{_BEFORE}{next(numbers)}")
    return name


def _no_folder(path: Path, got: str) -> UsageError:
    expected = "expected a learner's directory, or the name of a new one"
    return UsageError(f"learn: {path}: {expected}, got {got}")


def _cannot_write(path: Path, error: OSError) -> UsageError:
    return UsageError(f"learn: {path}: expected a directory that you can write, got: {error.strerror or error}")


def _user() -> str:
    try:
        return getpass.getuser()
    except (KeyError, OSError):  # a container whose user has no name
        return str(os.getuid())


# -- a class -----------------------------------------------------------------------------------------------------------

HEADS = ("learner", "directory", "done", "at", "since", "failed", "hints", "solutions")


def read_class(folders: Sequence[Path]) -> tuple[list[LearnerFolder], list[str]]:
    """Return the learners' directories among these, and one level below them, and what is wrong with others.

    Raises:
        UsageError: there is none, or a directory cannot be read.
    """
    found: list[LearnerFolder] = []
    broken: list[str] = []
    for folder in folders:
        try:
            places = [folder] if (folder / FILE).is_file() else sorted(folder.iterdir())
        except OSError as error:
            expected = "expected a directory with learners' directories"
            raise UsageError(f"--class: {folder}: {expected}, got: {error.strerror}") from error
        for place in places:
            try:
                if (place / FILE).is_file():
                    found.append(LearnerFolder.open(place))
            except UsageError as error:
                broken.append(str(error))
            except OSError as error:  # another user's, and closed
                broken.append(f"--class: {place}: expected a directory that you can read, got: {error.strerror}")
    if not found and not broken:
        names = ", ".join(map(str, folders))
        raise UsageError(f"--class: expected learners' directories below {names}, got none with a {FILE}")
    return found, broken


def class_rows(learners: Sequence[LearnerFolder], now: float) -> list[tuple[str, ...]]:
    """Return a row for each learner, those who are behind first."""
    return [_row(one, now) for one in sorted(learners, key=lambda one: (one.done(), -_since(one, now)))]


def _row(learner: LearnerFolder, now: float) -> tuple[str, ...]:
    at, steps = learner.at(), learner.progress.steps
    step = Step() if at is None else steps.get(at.name, Step())
    since = f"{_since(learner, now) / 60:.0f} min" if step.began_at else ""
    return (
        learner.progress.learner,
        learner.path.name,
        f"{learner.done()} of {len(all_exercises())}",
        "all done" if at is None else f"{at.number} {at.name}",
        since,
        str(step.tries or ""),
        str(step.hints or ""),
        str(sum(one.has_read_solution for one in steps.values()) or ""),
    )


def _since(learner: LearnerFolder, now: float) -> float:
    """Return for how many seconds a learner has been at the present exercise."""
    at = learner.at()
    began = 0.0 if at is None else learner.progress.steps.get(at.name, Step()).began_at
    return max(0.0, now - began) if began else 0.0


def list_rows(folder: LearnerFolder) -> list[tuple[str, ...]]:
    """Return a row for each exercise, for its learner."""
    rows: list[tuple[str, ...]] = []
    at = folder.at()
    for one in all_exercises():
        step = folder.progress.steps.get(one.name, Step())
        state = "done" if step.done_at else "here" if one is at else ""
        missing = "" if folder.file(one).exists() else "gone: --reset restores it"
        hints = f"{step.hints} of 3" if step.hints else ""
        title = one.title.partition(":")[0]
        rows.append((str(one.number), one.name, title, state, str(step.tries or ""), hints, missing))
    return rows


LIST_HEADS = ("no", "name", "title", "state", "failed", "hints", "file")
