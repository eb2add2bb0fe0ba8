"""Plugin of pytest: the fixture `rr_system`, which starts systems for a test and checks that they leave nothing behind.

pytest finds it wherever the package is installed, also where no test uses it: so it imports nothing of the package.
This folder has no __init__.py, because pytest rewrites the asserts of the packages that have a plugin, in the files
that an uninstall leaves behind (docs/decisions/0084-a-plugin-that-costs-nothing.md).
"""

from __future__ import annotations

import sys
from collections.abc import Iterator, Sequence
from importlib.abc import MetaPathFinder
from importlib.machinery import ModuleSpec, PathFinder
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING

import pytest

if TYPE_CHECKING:
    import rr_actors as rr


class _AsWritten(MetaPathFinder):
    """Finds the modules of rr_actors before pytest's own finder does, which would rewrite the asserts of each."""

    def find_spec(
        self, fullname: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        """Return where a module of rr_actors is; None for every other module."""
        if fullname.partition(".")[0] != "rr_actors":
            return None
        return PathFinder.find_spec(fullname, path, target)


sys.meta_path.insert(0, _AsWritten())
_HOME = Path(__file__).parents[1]  # of a checkout, where the package's own tests run


def pytest_addoption(parser: pytest.Parser) -> None:
    """Add --rr-races."""
    text = "fail tests in which callbacks of a manager in rr_system read and write an attribute at the same time"
    parser.getgroup("rr_actors").addoption("--rr-races", action="store_true", help=text)


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_makereport(item: pytest.Item, call: pytest.CallInfo[None]) -> None:
    """Show the user's own lines of a failing test: without --full-trace pytest hides the package's frames.

    The package's own tests show all frames.
    """
    if call.excinfo is not None and item.config.rootpath != _HOME:
        for name, module in list(sys.modules.items()):
            if name.partition(".")[0] == "rr_actors":
                vars(module)["__tracebackhide__"] = True  # which pytest looks for in a frame's globals


@pytest.fixture
def rr_system(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, pytestconfig: pytest.Config) -> Iterator[rr.StartSystem]:
    """Start a system of rr_actors: rr_system(rr.ChildSpec(Cameras, id="cameras"), config=...).

    Its state is in the test's tmp_path, unless `state_dir` says otherwise. After the test each system is stopped, which
    releases what the test holds. The test fails if a process, a thread, a socket or a loaded resource is left then.
    With `pytest --rr-races` it also fails if callbacks of a manager race for an attribute.
    """
    from rr_actors.testing.started_systems import started_systems

    races = pytestconfig.getoption("--rr-races") is True
    wrong = yield from started_systems(tmp_path, monkeypatch.setenv, races=races)
    if wrong:
        pytest.fail("\n".join(f"rr_system: {line}" for line in wrong), pytrace=False)
