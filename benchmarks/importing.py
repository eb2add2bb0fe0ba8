"""How long `import rr_actors`, `rr-actors --help` and a TAB take, beside a bare Python and the libraries needed."""

from __future__ import annotations

import os
import subprocess
import sys
import time

from benchmarks.measure import Samples
from benchmarks.table import Row

NEEDED = "import asyncio, sqlite3, msgspec, pykka, cloudpickle"
"""What no implementation on these libraries can do without."""

ALONE = "import sys; sys.modules['typing_extensions'] = None; "
"""Begins a statement that is to run as where rr_actors and what it depends on is all that is installed.

msgspec imports typing_extensions where it finds it. Here the tools bring it; rr_actors does not.
"""


COMMAND = "import os, sys; sys.modules['pydantic'] = None; sys.argv = ['rr-actors', {!r}]; os.environ |= {!r}; "
COMMAND += "sys.stdout = open(os.devnull, 'w'); from rr_actors.tools.cli import main; main()"
"""The command with one argument and these variables; without pydantic, which Typer imports for a TAB if it is there."""

STATEMENTS = {
    "bare": "pass",
    "theirs": ALONE + NEEDED,
    "import rr_actors": ALONE + "import rr_actors",
    "rr-actors --help": COMMAND.format("--help", {}),
    "a TAB after rr-actors": COMMAND.format(
        "", {"_RR_ACTORS_COMPLETE": "complete_bash", "COMP_WORDS": "rr-actors p", "COMP_CWORD": "1"}
    ),
}
"""What is compared: each runs in an interpreter of its own."""


def importing(times: int) -> list[Row]:
    """The import by itself; and interpreters for each statement, beside a bare one, and less it beside the libraries.

    All in turns. What an interpreter takes to end, some milliseconds more with all the modules, is in the latter.
    """
    for statement in STATEMENTS.values():
        _run(statement)
    ours: list[float] = []
    beside: list[float] = []
    whole: list[float] = []
    cpu: dict[str, list[float]] = {what: [] for what in STATEMENTS}
    for _ in range(times):
        taken = {what: _run(statement) for what, statement in STATEMENTS.items()}
        ours.append(_timed(ALONE))
        beside.append(_timed(""))
        whole.append(taken["import rr_actors"][0] - taken["bare"][0])
        for what, (_, worked) in taken.items():
            cpu[what].append(worked)
    bare, theirs, *rest = (Samples(tuple(some)) for some in cpu.values())
    least = theirs.median - bare.median
    rows = [
        Row("a bare Python, CPU time", bare.median * 1e3, "ms", bare.p99 * 1e3),
        Row("the libraries that rr_actors needs, less it, CPU time", least * 1e3, "ms"),
    ]
    for what, some in zip(list(STATEMENTS)[2:], rest, strict=True):
        more = some.median - bare.median
        rows += [
            Row(f"{what}, CPU time", some.median * 1e3, "ms", some.p99 * 1e3, some.median / bare.median, "bare"),
            Row("  less a bare Python", more * 1e3, "ms", None, more / least, "theirs"),
        ]
    taken_s, more_s, ended_s = (Samples(tuple(some)) for some in (ours, beside, whole))
    return [
        *rows,
        Row("import rr_actors", taken_s.median * 1e3, "ms", taken_s.p99 * 1e3, at_most=120.0),
        Row(
            "the same, with typing_extensions, which other packages bring", more_s.median * 1e3, "ms", more_s.p99 * 1e3
        ),
        Row("a program that only imports it, less an empty one", ended_s.median * 1e3, "ms", ended_s.p99 * 1e3),
    ]


# As users have it: with the byte code kept.
_ENVIRONMENT = {name: value for name, value in os.environ.items() if name != "PYTHONDONTWRITEBYTECODE"}


def _timed(begin: str) -> float:
    """Seconds that the statement takes in a new interpreter, after `begin`."""
    text = f"import time; {begin}start = time.perf_counter(); import rr_actors; print(time.perf_counter() - start)"
    return float(subprocess.check_output([sys.executable, "-c", text], env=_ENVIRONMENT))


def _run(statement: str) -> tuple[float, float]:
    """Seconds by the clock and of CPU time, of an interpreter for that one statement."""
    start = time.perf_counter()
    pid = os.posix_spawn(sys.executable, [sys.executable, "-c", statement], _ENVIRONMENT)
    _, status, usage = os.wait4(pid, 0)
    taken = time.perf_counter() - start
    if status:
        raise RuntimeError(f"{statement!r} ended with status {status}")
    return taken, usage.ru_utime + usage.ru_stime
