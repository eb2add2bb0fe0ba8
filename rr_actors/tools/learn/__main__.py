"""`python -m rr_actors.tools.learn CHECK FILE FOLDER OUTCOME`: run one check on one file, while its parent lives.

CHECK is the check's program, FILE the learner's file, FOLDER an empty directory. What was found is written to OUTCOME.
"""

from __future__ import annotations

import importlib
import os
import sys
import traceback
from pathlib import Path
from types import ModuleType

import msgspec

from rr_actors.runtime.processes import lifeline
from rr_actors.tools.learn.scenes import Outcome, Scene, Wrong, quiet


def main() -> None:
    """Run the check that the arguments name. It ends when the process that holds its standard input ends."""
    check, file, folder, outcome = map(Path, sys.argv[1:])
    lifeline.hold(sys.stdin.fileno(), os.getppid())
    quiet()
    sys.path.append(str(file.parent))  # the children of its systems import it, too
    found = _judged(check, file, folder)
    outcome.write_bytes(msgspec.json.encode(found))


def _judged(check: Path, file: Path, folder: Path) -> Outcome:
    try:
        module = importlib.import_module(file.stem)
    except (Exception, SystemExit) as error:
        return _raised(error, file, "the file cannot be imported")
    scene = Scene(module, folder)
    judge = ModuleType("check")
    exec(compile(check.read_bytes(), "check.py", "exec"), judge.__dict__)
    try:
        judge.__dict__["check"](scene)
    except Wrong as wrong:
        found = Outcome(False, str(wrong), wrong.where, wrong.expected, wrong.got)
    except (Exception, SystemExit) as error:
        found = _raised(error, file, "the file raised an error")
    else:
        found = Outcome(True)
    found.lines, found.picture = scene.lines, scene.picture
    return found


def _raised(error: BaseException, file: Path, what: str) -> Outcome:
    """Return the outcome for an error: the place in the learner's file, and the error itself."""
    frames = [frame for frame in traceback.extract_tb(error.__traceback__) if frame.filename == str(file)]
    where = f"line {frames[-1].lineno} of {file.name}: {frames[-1].line}" if frames else file.name
    got = "".join(traceback.format_exception_only(error)).strip()
    return Outcome(False, what, where, "no error", got)


if __name__ == "__main__":
    main()
