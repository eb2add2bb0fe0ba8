"""Bad bytes, guided by what they reach: `python -m fuzz` runs every target under atheris and prints a table.

A target stops at the first input that breaks a promise; the input is in a file, and `--again FILE` gives it to the
target once more, without atheris. Corpora are kept in out/fuzz, so that the next run begins where this one ended.
"""

from __future__ import annotations

import argparse
import os
import re
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import msgspec

from fuzz.environment import ROOT, interpreter
from fuzz.targets import TARGETS

OUT = ROOT / "out" / "fuzz"
_PROGRESS_S = 10.0
_HANG_S = 10
_MEMORY = Path("/dev/shm")  # a file there costs no disk
_MEMORY_MB = 1024  # ends it
_GROWTH_MB = 64  # since its corpus was read; in 100,000 inputs it is 1
_STATUS = re.compile(r"#(?P<inputs>\d+)\s+(?P<what>\w+)\s.*?cov: (?P<cover>\d+) .*rss: (?P<mb>\d+)Mb")
_FILE = re.compile(r"Test unit written to (?P<file>\S+)")


class Result(msgspec.Struct):
    """What came of one target. `before`: what the corpus reached, when the changing began."""

    inputs: int = 0
    seconds: float = 0.0
    mb_before: int = 0
    mb: int = 0
    cover_before: int = 0
    cover: int = 0
    failing: str = ""


def main() -> int:
    """Return the number of targets that failed."""
    parser = argparse.ArgumentParser(prog="fuzz", description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--runs", type=int, default=100_000, metavar="N", help="inputs for each target (100000)")
    parser.add_argument("--limit-s", type=int, default=600, metavar="S", help="seconds for each target, at most (600)")
    parser.add_argument("--only", action="append", choices=TARGETS, metavar="TARGET", help=", ".join(TARGETS))
    parser.add_argument(
        "--again", type=Path, metavar="FILE", help="give this file to the --only TARGET, and nothing else"
    )
    arguments = parser.parse_args()
    if arguments.again is not None:
        if len(arguments.only or ()) != 1:
            parser.error("--again needs one --only TARGET")
        again(arguments.only[0], arguments.again)
        return 0
    python = interpreter()
    results = {name: _run(python, name, arguments.runs, arguments.limit_s) for name in arguments.only or TARGETS}
    print(_text(results))
    return sum(bool(result.failing) for result in results.values())


def again(name: str, file: Path) -> None:
    """Give one input to a target, in this process: what is wrong comes out as an exception."""
    with tempfile.TemporaryDirectory(prefix="rr-fuzz-") as directory:
        TARGETS[name].prepare(Path(directory))(file.read_bytes())
    print(f"{name}: {file}: nothing is wrong with it")


def _run(python: str, name: str, runs: int, limit_s: int) -> Result:
    directory = OUT / name
    directory.mkdir(parents=True, exist_ok=True)
    log = directory / "log"
    command = [python, "-m", "fuzz.engine", name, str(directory), f"-runs={runs}", f"-max_total_time={limit_s}"]
    command += [f"-timeout={_HANG_S}", f"-rss_limit_mb={_MEMORY_MB}"]
    result = Result()
    start = shown = time.monotonic()
    print(f"{name}: {TARGETS[name].about}", file=sys.stderr)
    with (
        log.open("w") as kept,
        tempfile.TemporaryDirectory(prefix="rr-fuzz-", dir=_MEMORY if _MEMORY.is_dir() else None) as scratch,
        subprocess.Popen(
            command, cwd=ROOT, env=os.environ | {"TMPDIR": scratch}, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT, text=True, errors="replace",
        ) as process,
    ):  # fmt: skip
        assert process.stdout is not None
        for line in process.stdout:
            kept.write(line)
            take(line, result)
            now = time.monotonic()
            if now - shown >= _PROGRESS_S:
                shown = now
                print(f"{name}: {result.inputs} of {runs} inputs, {result.mb} MB", file=sys.stderr)
    result.seconds = time.monotonic() - start
    judged(result, process.returncode, str(log))
    if result.failing:
        print(f"{name}: FAILED, see {log}", file=sys.stderr)
    if result.failing not in ("", str(log)):
        print(f'  again: make fuzz ARGS="--only {name} --again {result.failing}"', file=sys.stderr)
    return result


def judged(result: Result, code: int, log: str) -> Result:
    """Name the log as what failed if no input did, but libFuzzer ended wrongly, grew, or fed nothing."""
    if not result.failing and (code != 0 or result.mb - result.mb_before > _GROWTH_MB or not result.inputs):
        result.failing = log
    return result


def take(line: str, result: Result) -> None:
    """Note what a line of libFuzzer's says: "#4096 pulse cov: 82 ft: 200 corp: 33/1kb lim: 98 exec/s: 9 rss: 61Mb"."""
    if found := _STATUS.match(line):
        result.inputs = int(found["inputs"])
        result.mb = max(result.mb, int(found["mb"]))
        result.cover = int(found["cover"])
        if found["what"] == "INITED":
            result.mb_before, result.cover_before = int(found["mb"]), int(found["cover"])
    elif found := _FILE.search(line):
        result.failing = found["file"]


def _text(results: dict[str, Result]) -> str:
    lines = [f"{'target':16}{'inputs':>10}{'seconds':>9}{'growth':>9}{'branches':>10}{'new':>6}  failing"]
    for name, result in results.items():
        new, growth = result.cover - result.cover_before, f"{result.mb - result.mb_before} MB"
        lines.append(
            f"{name:16}{result.inputs:10}{result.seconds:9.1f}{growth:>9}{result.cover:10}{new:6}"
            f"  {result.failing or 'none'}"
        )
    return "\n".join(lines)


if __name__ == "__main__":
    sys.exit(main())
