"""Tally and Report: the counts of a run while it lasts, and its report in the end."""

from __future__ import annotations

import json
import threading
import time
from collections import Counter
from collections.abc import Iterable
from dataclasses import asdict, dataclass, field

KILLS = "SIGKILL"


class Tally:
    """The counts of a run. Any thread may count."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self.faults: Counter[str] = Counter()
        self.operations: Counter[str] = Counter()
        self.errors: Counter[str] = Counter()
        self.longest_wait_s = 0.0
        self.longest_wait_for = ""
        self.violations: list[str] = []
        self.since = time.monotonic()

    def fault(self, kind: str) -> None:
        """Count a fault that was caused on purpose."""
        with self._lock:
            self.faults[kind] += 1

    def operation(self, kind: str, took_s: float, what: str) -> None:
        """Count a consumer's call that succeeded."""
        with self._lock:
            self.operations[kind] += 1
            if took_s > self.longest_wait_s:
                self.longest_wait_s, self.longest_wait_for = took_s, f"{kind} {what}"

    def error(self, kind: str, error: str) -> None:
        """Count a consumer's call that failed with an error of the package."""
        with self._lock:
            self.errors[f"{kind}: {error}"] += 1

    def violation(self, *sentences: str) -> None:
        """Note broken promises."""
        with self._lock:
            self.violations.extend(sentences)

    @property
    def kills(self) -> int:
        """The number of SIGKILLs."""
        with self._lock:
            return sum(count for kind, count in self.faults.items() if kind.startswith(KILLS))

    def line(self) -> str:
        """Return the present counts as one line."""
        with self._lock:
            kills = sum(count for kind, count in self.faults.items() if kind.startswith(KILLS))
            others = self.faults.total() - kills
            return (
                f"{time.monotonic() - self.since:6.1f} s  {kills} kills, {others} other faults,"
                f" {self.operations.total()} operations, {self.errors.total()} errors,"
                f" longest wait {self.longest_wait_s:.2f} s, {len(self.violations)} violations"
            )


@dataclass
class Report:
    """The result of a run.

    Attributes:
        faults: by kind. operations: consumers' calls that succeeded, by kind. errors: calls that failed, by error.
        longest_wait_s: the longest time that a successful call of a consumer took.
        callbacks: the runs in the callbacks' journal, by kind. repeated: runs that crashes made necessary.
        catalogs_damaged: catalogs that are damaged at the end; the monkey has repaired its own damage by then.
        growth: the result of a soak, one line for each figure.
        violations: the broken promises, one sentence each.
        verdict: whether everything was checked. If not, the run has failed.
    """

    seed: int
    seconds: float = 0.0
    faults: dict[str, int] = field(default_factory=dict[str, int])
    operations: dict[str, int] = field(default_factory=dict[str, int])
    errors: dict[str, int] = field(default_factory=dict[str, int])
    longest_wait_s: float = 0.0
    longest_wait_for: str = ""
    callbacks: dict[str, int] = field(default_factory=dict[str, int])
    repeated: int = 0
    catalogs: int = 0
    catalogs_damaged: int = 0
    state_dir: str = ""
    growth: list[str] = field(default_factory=list[str])
    violations: list[str] = field(default_factory=list[str])
    verdict: bool = False

    @property
    def kills(self) -> int:
        """The number of SIGKILLs."""
        return sum(count for kind, count in self.faults.items() if kind.startswith(KILLS))

    @property
    def passed(self) -> bool:
        """True if every promise was checked, and kept."""
        return self.verdict and not self.violations

    def json(self) -> str:
        """Return the report as JSON, for programs."""
        return json.dumps({**asdict(self), "kills": self.kills, "passed": self.passed}, indent=2) + "\n"

    def text(self) -> str:
        """Return the report as text, for people."""
        lines = [f"seed {self.seed}, {self.seconds:.1f} s"]
        if self.faults:
            lines += [f"faults: {sum(self.faults.values())}, of which {self.kills} SIGKILLs", *_table(self.faults)]
        lines += [f"operations: {sum(self.operations.values())}", *_table(self.operations)]
        lines += [f"failed operations: {sum(self.errors.values())}", *_table(self.errors)]
        lines += [f"callbacks: {sum(self.callbacks.values())}, of which {self.repeated} repeated after a crash"]
        lines += [f"longest wait of a consumer: {self.longest_wait_s:.2f} s ({self.longest_wait_for})"]
        lines += [f"catalogs damaged: {self.catalogs_damaged} of {self.catalogs}", *self.growth]
        if not self.verdict:
            lines += ["no verdict on the rest: not everything was checked"]
        lines += [f"violations: {len(self.violations)}", *(f"  {violation}" for violation in self.violations)]
        if not self.passed:
            lines += [f"seed {self.seed}; what was left is in {self.state_dir}"]
        return "\n".join(lines)


def _table(counts: dict[str, int]) -> Iterable[str]:
    return [f"  {count:8}  {name}" for name, count in sorted(counts.items())]
