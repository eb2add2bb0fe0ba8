"""Run a system from the shell: its tree, its configuration and its log. SIGTERM and Ctrl-C end it cleanly."""

from __future__ import annotations

import functools
import importlib
import os
import signal
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any, cast

from rr_actors.base.config import SystemConfig
from rr_actors.base.errors import ConfigError, SupervisionError, did_you_mean, is_a, shown, text_of
from rr_actors.base.reporting.log import Log
from rr_actors.base.toml import read_toml, wrong
from rr_actors.registrar.arguments import state_path
from rr_actors.supervision.core.specs import ChildSpec, Supervisor
from rr_actors.system.system import System
from rr_actors.tools.log_lines import begin_logging
from rr_actors.tools.module_watcher import LOOK_S, ModuleWatcher
from rr_actors.tools.tree_check import misordered
from rr_actors.wire.name_service import HostSettings


class _Told(BaseException):
    """A signal came that ends the system."""


def run_tree(
    tree: str,
    state_dir: Path,
    config: Path | None,
    name: str,
    *,
    log_level: str,
    log_json: bool = False,
    watch: bool = False,
    debug: bool = False,
) -> bool:
    """Run a tree until a signal ends it, or it ends by itself; return False if the tree gave up.

    A second signal kills the processes that still run. With `watch`, children whose modules change are restarted. With
    `debug`, actors can be paused.

    Args:
        tree: as read_tree() takes it.
        name: the system's; "": the id of the tree.

    Raises:
        RrError: a file cannot be read, or the system does not start.
    """
    begin_logging(log_level, as_json=log_json)
    state = state_path(state_dir).absolute()  # before the tree is read: that may change the directory
    settings = SystemConfig() if config is None else SystemConfig.from_toml(config)
    hosts = read_hosts(tree, config)
    root = read_tree(tree)
    named = name or (root.id if root.id != _UNNAMED else "system")
    system = System(root, name=named, state_dir=state, config=settings, debug=debug, hosts=hosts)
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, _told)
    try:
        with system:
            Log("rr_actors").info("system %s runs in %s (pid %d)", named, state_dir, os.getpid())
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


def verified(tree: str, config: Path | None) -> list[str]:
    """Return what of a tree cannot start, a sentence each. Modules that the tree names are imported.

    Raises:
        ConfigError: a file cannot be read, or has a wrong value.
    """
    if config is not None:
        SystemConfig.from_toml(config)
    read_hosts(tree, config)
    return misordered(read_tree(tree))


_UNNAMED = "root"  # the id of a tree that gives none
_OBJECT = "TREE"
_EXPECTED = "a TOML file, FILE.py, FILE.py:OBJECT or MODULE:OBJECT"


def read_hosts(tree: str, config: Path | None) -> HostSettings | None:
    """Return what the table [hosts] says in the file of a tree, or in that of its configuration; None without one.

    Raises:
        ConfigError: both files have the table, or something in it is wrong. `.file`, `.key`, `.expected`, `.got`
    """
    places = [Path(tree).expanduser().absolute()] if _is_toml(tree) else []
    places += [] if config is None else [config]
    files = [str(file) for file in places if file.is_file() and "hosts" in read_toml(str(file))]
    if len(files) > 1:
        raise wrong(files[1], "hosts", f"one table [hosts], as {files[0]} has one", None, said="a second one")
    if not files:
        return None
    settings = importlib.import_module("rr_actors.system.hosts.host_settings")  # what few systems need
    return settings.Hosts.from_toml(files[0])


def _is_toml(tree: str) -> bool:
    return tree.endswith(".toml") or not (":" in tree or tree.endswith(".py"))


def read_tree(tree: str) -> Supervisor:
    """Return the tree that a TOML file describes, or that a Python file or module has.

    Modules and files that a TOML file names are looked for beside it: its directory becomes the current one. After that
    modules are looked for in the directory in which the command began.

    Args:
        tree: "robot.toml"; "robot.py" or "robot.managers:TREE". OBJECT is a Supervisor, a list of its children, or a
            function that returns one of these; in a file it is TREE, if nothing else is said.

    Raises:
        ConfigError: there is no such file or object, or it is no tree. `.file`, `.key`, `.expected`, `.got`
    """
    place, colon, name = tree.rpartition(":")
    if _is_toml(tree):
        file = Path(tree).expanduser().absolute()
        _look_in(Path.cwd())
        _look_in(file.parent)
        if file.is_file():
            os.chdir(file.parent)
        return Supervisor.from_toml(file)
    if not colon:
        place, name = tree, _OBJECT
    if place.endswith(".py"):
        file = Path(place).expanduser().absolute()
        if not file.is_file():
            raise _wrong(tree, "a file that can be read", "no such file")
        if not file.stem.isidentifier():
            raise _wrong(tree, "a file whose name is that of a module, as its children import it", shown(file.name))
        _look_in(file.parent)
        place = file.stem
    else:
        _look_in(Path.cwd())
    return _tree_of(tree, place, name)


def _tree_of(tree: str, module: str, name: str) -> Supervisor:
    try:
        found = importlib.import_module(module)
    except ModuleNotFoundError as error:
        if error.name is None or not (module == error.name or module.startswith(f"{error.name}.")):
            raise _wrong(tree, "a module that can be imported", text_of(error)) from error
        raise _wrong(tree, _EXPECTED, f"no module {shown(module)} here or among what is installed") from error
    except Exception as error:
        raise _wrong(tree, "a module that can be imported", text_of(error)) from error
    try:
        thing: Any = functools.reduce(getattr, name.split("."), found)
    except AttributeError:
        known = [key for key, value in vars(found).items() if is_a(value, Supervisor)]
        hint = did_you_mean(name, known) or (f"; it has {', '.join(known)}" if known else "")
        raise _wrong(tree, f"an object {shown(name)} in {module}", f"none{hint}") from None
    if callable(thing) and not is_a(thing, Supervisor):
        thing = thing()
    if is_a(thing, Supervisor):
        return thing
    if is_a(thing, (list, tuple)):
        return Supervisor(cast("Sequence[ChildSpec | Supervisor]", thing))
    raise _wrong(tree, "a Supervisor, or a list of its children", f"{shown(thing)} ({type(thing).__name__})")


def _wrong(tree: str, expected: str, got: str) -> ConfigError:
    return ConfigError(f"{tree}: expected {expected}, got {got}", file=tree, key=None, expected=expected, got=got)


def _look_in(folder: Path) -> None:
    if str(folder) not in sys.path:
        sys.path.insert(0, str(folder))


def _told(number: int, _frame: object) -> None:
    raise _Told(signal.Signals(number).name)
