"""Run a system from files alone: its tree, its configuration and its log. SIGTERM and Ctrl-C end it in order."""

from __future__ import annotations

import os
import signal
import sys
from pathlib import Path

from rr_actors.base.config import SystemConfig
from rr_actors.base.errors import SupervisionError
from rr_actors.base.reporting.log import Log
from rr_actors.supervision.core.specs import Supervisor
from rr_actors.system.system import System
from rr_actors.tools.log_lines import begin_logging
from rr_actors.tools.module_watcher import LOOK_S, ModuleWatcher
from rr_actors.tools.tree_check import misordered


class _Told(BaseException):
    """A signal came that ends the system."""


def run_tree(
    tree: Path,
    state_dir: Path,
    config: Path | None,
    name: str,
    *,
    log_level: str,
    log_json: bool = False,
    watch: bool = False,
    debug: bool = False,
) -> bool:
    """Run the tree of a TOML file until a signal ends it, or it ends by itself; return False if the tree gave up.

    Modules that the tree names are looked for in the current directory, too. A second signal kills the processes that
    still run. With `watch`, children whose modules change are restarted. With `debug`,
    actors can be paused.

    Raises:
        RrError: a file cannot be read, or the system does not start.
    """
    begin_logging(log_level, as_json=log_json)
    root, settings = _read(tree, config)
    system = System(root, name=name, state_dir=state_dir, config=settings, debug=debug)
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, _told)
    try:
        with system:
            Log("rr_actors").info("system %s runs in %s (pid %d)", name, state_dir, os.getpid())
            if watch:
                watcher = ModuleWatcher(system, root)
                while not system.wait(LOOK_S):
                    watcher.look()
            else:
                system.wait()
    except _Told:
        return True
    except SupervisionError:
        return False  # the log has it
    ended = system.ended
    return ended is not None and ended.reason in ("normal", "shutdown") and ended.exception is None


def verified(tree: Path, config: Path | None) -> list[str]:
    """Return what of the tree of a TOML file cannot start, a sentence each. Modules that the tree names are imported.

    Raises:
        ConfigError: a file cannot be read, or has a wrong value.
    """
    return misordered(_read(tree, config)[0])


def _read(tree: Path, config: Path | None) -> tuple[Supervisor, SystemConfig]:
    if os.getcwd() not in sys.path:
        sys.path.insert(0, os.getcwd())
    settings = SystemConfig() if config is None else SystemConfig.from_toml(config)
    return Supervisor.from_toml(tree), settings


def _told(number: int, _frame: object) -> None:
    raise _Told(signal.Signals(number).name)
