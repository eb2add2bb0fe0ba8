"""How long `import rr_actors`, `rr-actors --help`, a TAB and `rr-actors ps` take, beside the libraries they need."""

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

USED = "import rr_actors as rr; rr.System; rr.Manager; rr.Supervisor; rr.Actor; rr.connect"
"""What a program does with the package at least: each name imports its module when it is used."""

COMMAND = "import os, sys; sys.argv = ['rr-actors', *{!r}]; os.environ |= {!r}; "
COMMAND += "sys.stdout = sys.stderr = open(os.devnull, 'w'); from rr_actors.tools.cli import main; main()"


def _tab(*words: str) -> str:
    """The command as a shell starts it to complete the last word."""
    told = {"COMP_WORDS": " ".join(("rr-actors", *words)), "COMP_CWORD": str(len(words))}
    return COMMAND.format((), {"_RR_ACTORS_COMPLETE": "complete_bash", **told})


STATEMENTS = {
    "import rr_actors": (ALONE + "import rr_actors", 1.7),
    "import rr_actors, and use its main classes": (ALONE + USED, None),
    "rr-actors --help": (COMMAND.format(("--help",), {}), 3.0),
    "a TAB after rr-actors": (_tab("p"), 3.0),
    "a TAB after rr-actors ps --s": (_tab("ps", "--s"), 3.0),
    "rr-actors ps, without a system": (COMMAND.format(("ps", "--state", "/no/system"), {}), 3.0),
}
"""What is compared, each in an interpreter of its own, and how many times the libraries it may take."""

BARE, THEIRS = "pass", ALONE + NEEDED

_NOT_RUNNING = 3  # the exit code of `rr-actors ps` here


def importing(times: int) -> list[Row]:
    """The import by itself; and interpreters for each statement beside one for the libraries, both less a bare one.

    All in turns. What an interpreter takes to end, some milliseconds more with all the modules, is in the latter.
    """
    ours: list[float] = []
    beside: list[float] = []
    whole: list[float] = []
    cpu: dict[str, list[float]] = {each: [] for each in (BARE, THEIRS, *(each for each, _ in STATEMENTS.values()))}
    for each in cpu:
        _run(each)
    for _ in range(times):
        taken = {each: _run(each) for each in cpu}
        ours.append(_timed(ALONE))
        beside.append(_timed(""))
        whole.append(taken[ALONE + USED][0] - taken[BARE][0])
        for each, (_, worked) in taken.items():
            cpu[each].append(worked)
    bare = Samples(tuple(cpu[BARE]))
    least = Samples(tuple(cpu[THEIRS])).median - bare.median
    rows = [
        Row("a bare Python, CPU time", bare.median * 1e3, "ms", bare.p99 * 1e3),
        Row("the libraries that rr_actors needs, less it, CPU time", least * 1e3, "ms"),
    ]
    for what, (each, at_most) in STATEMENTS.items():
        some = Samples(tuple(cpu[each]))
        more = some.median - bare.median
        rows += [
            Row(f"{what}, CPU time", some.median * 1e3, "ms", some.p99 * 1e3, some.median / bare.median, "bare"),
            Row(f"{what}, less a bare Python", more * 1e3, "ms", None, more / least, "the libraries", at_most=at_most),
        ]
    taken_s, more_s, ended_s = (Samples(tuple(some)) for some in (ours, beside, whole))
    return [
        *rows,
        Row("import rr_actors, and use its main classes", taken_s.median * 1e3, "ms", taken_s.p99 * 1e3, at_most=120.0),
        Row(
            "the same, with typing_extensions, which other packages bring", more_s.median * 1e3, "ms", more_s.p99 * 1e3
        ),
        Row("a program that does only this, less an empty one", ended_s.median * 1e3, "ms", ended_s.p99 * 1e3),
    ]


# As users have it: with the byte code kept.
_ENVIRONMENT = {name: value for name, value in os.environ.items() if name != "PYTHONDONTWRITEBYTECODE"}


def _timed(begin: str) -> float:
    """Seconds that the use of the package takes in a new interpreter, after `begin`."""
    text = f"import time; {begin}start = time.perf_counter(); {USED}; print(time.perf_counter() - start)"
    return float(subprocess.check_output([sys.executable, "-c", text], env=_ENVIRONMENT))


def _run(statement: str) -> tuple[float, float]:
    """Seconds by the clock and of CPU time, of an interpreter for that one statement."""
    start = time.perf_counter()
    pid = os.posix_spawn(sys.executable, [sys.executable, "-c", statement], _ENVIRONMENT)
    _, status, usage = os.wait4(pid, 0)
    taken = time.perf_counter() - start
    if os.waitstatus_to_exitcode(status) not in (0, _NOT_RUNNING):
        raise RuntimeError(f"{statement!r} ended with status {status}")
    return taken, usage.ru_utime + usage.ru_stime
