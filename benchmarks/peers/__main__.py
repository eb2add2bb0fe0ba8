"""Run every contestant, each in a process of its own, and print one table: `python -m benchmarks.peers`."""

from __future__ import annotations

import argparse
import ctypes
import json
import os
import platform
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import psutil

from benchmarks.peers.contest import CONTESTANTS, IN_FLIGHT, PAYLOAD
from benchmarks.peers.environment import interpreter

_LIMIT_S = 120.0
_PR_SET_CHILD_SUBREAPER = 36
_ROOT = Path(__file__).parent.parent.parent

Result = dict[str, Any]


def main() -> None:
    """Measure, print, write JSON. A contestant that is missing or fails is a line in the table, too."""
    parser = argparse.ArgumentParser(prog="benchmarks.peers", description=__doc__)
    parser.add_argument("--quick", action="store_true", help="few repetitions: shows that it works, not how fast")
    parser.add_argument("--only", action="append", choices=CONTESTANTS, metavar="NAME", help=", ".join(CONTESTANTS))
    parser.add_argument("--json", type=Path, default=Path("bench-peers.json"), metavar="FILE")
    parser.add_argument("--limit-s", type=float, default=_LIMIT_S, help="seconds that each may take")
    arguments = parser.parse_args()
    # Orphans come to us, not to init: what a contestant leaves behind is found and ended.
    ctypes.CDLL(None).prctl(_PR_SET_CHILD_SUBREAPER, 1)
    python = interpreter()
    results: dict[str, Result] = {}
    for name in arguments.only or CONTESTANTS:
        start = time.monotonic()
        results[name] = _run(python, name, arguments.quick, arguments.limit_s)
        print(f"{name}: {time.monotonic() - start:.1f} s", file=sys.stderr)
    print(_text(results))
    arguments.json.write_text(json.dumps(results, indent=2) + "\n")


def _run(python: str, name: str, quick: bool, limit_s: float) -> Result:
    with tempfile.TemporaryDirectory(prefix="rr-", ignore_cleanup_errors=True) as directory:
        out = Path(directory, "result.json")
        command = [python, "-m", "benchmarks.peers.contest", name, str(out)]
        command += ["--calls", "300", "--kills", "1"] if quick else ["--calls", "3000", "--kills", "5"]
        errors = Path(directory, "errors")
        with errors.open("wb") as log:
            environment = os.environ | {"TMPDIR": directory}  # what one that is killed leaves there goes, too
            process = subprocess.Popen(
                command, cwd=_ROOT, env=environment, stdout=log, stderr=log, stdin=subprocess.DEVNULL
            )
            try:
                code = process.wait(limit_s)
                why = f"exit {code}: {_last_line(errors)}"
            except subprocess.TimeoutExpired:
                why = f"not done within {limit_s:g} s"
            finally:
                _end_descendants()
        return json.loads(out.read_text()) if out.exists() else {"error": why}


def _last_line(log: Path) -> str:
    lines = log.read_text(errors="replace").strip().splitlines()
    return lines[-1][:150] if lines else "nothing said"


def _end_descendants() -> None:
    """Everything the contestant started and has not ended, in whatever session it is now."""
    while left := psutil.Process().children(recursive=True):
        for process in left:
            try:
                process.kill()
            except psutil.NoSuchProcess:
                pass
        psutil.wait_procs(left, timeout=5.0)
        _reap()


def _reap() -> None:
    try:
        while os.waitpid(-1, os.WNOHANG)[0]:
            pass
    except ChildProcessError:
        pass


def _text(results: dict[str, Result]) -> str:
    head = ("", "version", "median µs", "p99 µs", "× raw pipe", f"calls/s, {IN_FLIGHT} in flight", "SIGKILL to answer")
    lines = [head, *(_cells(CONTESTANTS[name], result) for name, result in results.items())]
    widths = [max(len(line[column]) for line in lines) for column in range(len(head))]
    shown = [
        "  ".join(
            cell.rjust(width) if i > 1 else cell.ljust(width)
            for i, (cell, width) in enumerate(zip(line, widths, strict=True))
        )
        for line in lines
    ]
    pipes = sorted(result["pipe"] for result in results.values() if "error" not in result)
    machine = f"{os.cpu_count()} cores, Python {platform.python_version()}, {sys.platform}"
    about = [f"An echo of {len(PAYLOAD)} bytes; {machine}."]
    if pipes:
        about.append(
            f"Raw pipe echo, measured in turns with each: median {pipes[len(pipes) // 2] * 1e6:.1f} µs "
            f"({pipes[0] * 1e6:.1f} to {pipes[-1] * 1e6:.1f})."
        )
    about += _aims(results)
    failed = [f"{CONTESTANTS[name]}: {result['error']}" for name, result in results.items() if "error" in result]
    return "\n".join([*about, *(line.rstrip() for line in shown), *failed])


def _aims(results: dict[str, Result]) -> list[str]:
    """The project's aims beside the fastest peer, in ratios to its pipe and its run."""
    ours, theirs = results.get("load", {"error": ""}), results.get("xoscar", {"error": ""})
    if "error" in ours or "error" in theirs:
        return []
    slower = (ours["median"] / ours["pipe"]) / (theirs["median"] / theirs["pipe"])
    faster = ours["rate"] / theirs["rate"]
    return [
        f"A warm durable load takes {slower:.2f} x as long as a plain call of xoscar (aim: at most 0.5); "
        f"in flight, {faster:.1f} x as many a second (aim: at least 3)."
    ]


def _cells(title: str, result: Result) -> tuple[str, ...]:
    if "error" in result:
        return (title, "-", "failed", "-", "-", "-", "-")
    return (
        title,
        result["version"],
        f"{result['median'] * 1e6:,.0f}",
        f"{result['p99'] * 1e6:,.0f}",
        f"{result['median'] / result['pipe']:.2f}",
        "-" if result["rate"] is None else f"{result['rate']:,.0f}",
        "-" if result["recovery"] is None else f"{result['recovery'] * 1e3:,.0f} ms",
    )


if __name__ == "__main__":
    main()
