"""Trials of the lab's experiments: each is a run with some values of its levers, and what it is expected to show.

A test says which answers are right under which levers. So an experiment does what its labels say, and a student who is
right hears so. docs/console.md has an example.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from rr_actors.base.errors import UsageError, did_you_mean, shown
from rr_actors.tools.web.lab.lab_declarations import LabExperiment, Seen, Value
from rr_actors.tools.web.lab.lab_folder import read_experiment
from rr_actors.tools.web.lab.lab_runs import Run

__all__ = ["Seen", "Trial", "check_levers", "check_trials"]


@dataclass(frozen=True)
class Trial:
    """A run of an experiment, and what it is expected to show.

    Args:
        file: the experiment.
        levers: values by the names of levers. A lever that is not named has its first choice.
        right: the answers that the run shows to be right. Empty for an experiment without a question.
        shows: called with what the run has shown; returns whether that is what the labels of the levers say. Default:
            None, the answers say it.
    """

    file: str | os.PathLike[str]
    levers: Mapping[str, Value] = field(default_factory=dict[str, Value])
    right: Collection[str] = ()
    shows: Callable[[Seen], bool] | None = None

    def __str__(self) -> str:
        chosen = ", ".join(f"{name}={value!r}" for name, value in self.levers.items())
        return f"{Path(self.file).stem}({chosen})"


def check_levers(trials: Sequence[Trial]) -> None:
    """Check that each value of each lever is in a trial. Nothing runs.

    Raises:
        AssertionError: a value is in none; the text has the lever's label. All such values are named.
        ConfigError: a file is no experiment.
        UsageError: a trial names a lever, a value or an answer that its experiment does not have.
    """
    found = {Path(trial.file).absolute(): read_experiment(Path(trial.file)) for trial in trials}
    missing: list[str] = []
    for file, experiment in found.items():
        values = [_values(trial, experiment) for trial in trials if Path(trial.file).absolute() == file]
        for lever in experiment.levers:
            played = [one[lever.name] for one in values]
            missing += [
                f"{experiment.program}: {lever.name} ({lever.label}): expected a trial with {choice!r}, got none"
                for choice in lever.choices
                if choice not in played
            ]
    if missing:
        raise AssertionError("\n".join(missing))


def check_trials(trials: Sequence[Trial], *, at_once: int = 4) -> list[Seen]:
    """Play each trial in a process and a state directory of its own; return what each has shown.

    A run that has not come to its end after 90 s is ended. When this returns or raises, nothing is left of any run.

    Args:
        trials: the trials.
        at_once: how many run side by side. Fewer of them disturb each other less on a slow machine.

    Raises:
        AssertionError: a run has failed, has shown other answers, or `shows` has returned False. The text names each
            such trial, with what it has printed.
        ConfigError: a file is no experiment.
        UsageError: a trial names a lever, a value or an answer that its experiment does not have.
    """
    if at_once < 1:
        raise UsageError(f"check_trials: at_once: expected a number from 1 on, got {shown(at_once)}")
    planned = [(trial, experiment := read_experiment(Path(trial.file)), _values(trial, experiment)) for trial in trials]
    seen: list[Seen] = []
    faults: list[str] = []
    for first in range(0, len(planned), at_once):
        played: list[tuple[Trial, LabExperiment, Run]] = []
        try:
            for trial, experiment, values in planned[first : first + at_once]:
                played.append((trial, experiment, Run(experiment.program.absolute(), values)))
            for trial, experiment, run in played:
                run.wait()
                seen.append(run.seen)
                faults += [f"{trial}: {fault}\n{_printed(run)}" for fault in _faults(trial, experiment, run)]
        finally:
            for _, _, run in played:
                run.stop()
    if faults:
        raise AssertionError("\n".join(faults))
    return seen


def _values(trial: Trial, experiment: LabExperiment) -> dict[str, Value]:
    """Return the values of all levers of a trial."""
    levers = {lever.name: lever for lever in experiment.levers}
    for name, value in trial.levers.items():
        if name not in levers:
            raise UsageError(f"{trial}: levers: {_expected(list(levers), name)}")
        if value not in levers[name].choices:
            raise UsageError(f"{trial}: levers.{name}: {_expected(list(map(str, levers[name].choices)), value)}")
    for answer in trial.right:
        if answer not in experiment.declared.answers:
            raise UsageError(f"{trial}: right: {_expected(list(experiment.declared.answers), answer)}")
    return {name: trial.levers.get(name, lever.choices[0]) for name, lever in levers.items()}


def _expected(known: Sequence[str], got: Value) -> str:
    return f"expected one of {', '.join(known) or 'none'}, got {shown(got)}{did_you_mean(str(got), known)}"


def _faults(trial: Trial, experiment: LabExperiment, run: Run) -> Iterator[str]:
    if not run.has_finished:
        yield "expected a run that comes to its end, got an error or the time limit"
    elif (question := experiment.question) is not None and question.right(run.seen) != frozenset(trial.right):
        yield f"right: expected {_listed(trial.right)}, got {_listed(question.right(run.seen))}"
    elif trial.shows is not None and not trial.shows(run.seen):
        yield "shows: expected True of what the run has shown, got False"


def _listed(answers: Collection[str]) -> str:
    return ", ".join(map(repr, sorted(answers))) or "no answer"


def _printed(run: Run) -> str:
    return "\n".join(f"    {line}" for line in run.lines) or "    (it has printed nothing)"
