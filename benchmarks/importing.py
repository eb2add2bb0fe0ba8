"""How long `import rr_actors` takes, and how much of that what it needs takes by itself."""

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


def importing(times: int) -> list[Row]:
    """The statement by itself; and interpreters that import it, or only what it needs, less one that does nothing.

    All in turns. What an interpreter takes to end, some milliseconds more with all the modules, is in the latter.
    """
    _run("import rr_actors")
    ours: list[float] = []
    beside: list[float] = []
    whole: list[float] = []
    cpu: list[float] = []
    needed: list[float] = []
    for _ in range(times):
        bare, needs, all_of_it = _run("pass"), _run(ALONE + NEEDED), _run(ALONE + "import rr_actors")
        ours.append(_timed(ALONE))
        beside.append(_timed(""))
        whole.append(max(0.0, all_of_it[0] - bare[0]))
        cpu.append(max(0.0, all_of_it[1] - bare[1]))
        needed.append(max(1e-6, needs[1] - bare[1]))
    taken, more, ended, worked, least = (Samples(tuple(some)) for some in (ours, beside, whole, cpu, needed))
    return [
        Row("the libraries that rr_actors needs, CPU time", least.median * 1e3, "ms", least.p99 * 1e3),
        Row(
            "import rr_actors, with them, CPU time",
            worked.median * 1e3,
            "ms",
            worked.p99 * 1e3,
            ratio=worked.median / least.median,
            against="theirs",
        ),
        Row("import rr_actors", taken.median * 1e3, "ms", taken.p99 * 1e3, at_most=120.0),
        Row("the same, with typing_extensions, which other packages bring", more.median * 1e3, "ms", more.p99 * 1e3),
        Row("a program that only imports it, less an empty one", ended.median * 1e3, "ms", ended.p99 * 1e3),
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
