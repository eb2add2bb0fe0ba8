"""How long `import rr_actors` takes."""

from __future__ import annotations

import os
import subprocess
import sys
import time

from benchmarks.measure import Samples
from benchmarks.table import Row


def importing(times: int) -> list[Row]:
    """An interpreter that imports it, less one that does nothing, in turns."""
    _run("import rr_actors")
    seconds = [max(0.0, _run("import rr_actors") - _run("pass")) for _ in range(times)]
    taken = Samples(tuple(seconds))
    return [Row("import rr_actors", taken.median * 1e3, "ms", taken.p99 * 1e3, at_most=120.0)]


# As users have it: with the byte code kept.
_ENVIRONMENT = {name: value for name, value in os.environ.items() if name != "PYTHONDONTWRITEBYTECODE"}


def _run(statement: str) -> float:
    start = time.perf_counter()
    subprocess.run([sys.executable, "-c", statement], check=True, env=_ENVIRONMENT)
    return time.perf_counter() - start
