"""Action folder: classes of actions in the Python files of a folder, which may change while the manager runs.

A file is a module of its own, and each version of it has a name of its own: what runs goes on with its class. The
texts that the classes come from are on disk beside the catalog. So a crash finds them, whatever the files say by then.
"""

from __future__ import annotations

import ast
import inspect
import itertools
import sys
import threading
import traceback
from collections.abc import Iterable, Mapping
from concurrent import futures
from pathlib import Path
from types import ModuleType

import msgspec

from rr_actors.base import pickling
from rr_actors.base.errors import ConfigError, UsageError, text_of
from rr_actors.base.folder import may_block
from rr_actors.base.reporting.log import Log
from rr_actors.base.toml import wrong
from rr_actors.managers.actions.action import Action, check_isolation, name_of, signature_of_class
from rr_actors.managers.planning.kept_record import KeptRecord
from rr_actors.registrar.manager import Beginning
from rr_actors.runtime.time_limits import RunningLimit

logger = Log("rr_actors.managers.actions")

_PYTHON = "a Python file with a class of actions"
_versions = itertools.count(1)

Kinds = Mapping[str, type[Action]]
"""Classes of actions, by the names that graphs call them by."""
_Stamp = tuple[int, int, int]


_TRIES = 2  # a process may also be killed by somebody else while a file runs; a load is given up after three deaths
_WITHIN_S = 10.0  # after so long a look waits no longer for a file that runs


class _Begun(msgspec.Struct):
    """A text of a file that runs now, or with which processes have ended: how often, in which run of the system."""

    run: str
    file: str
    text: str
    tries: int


class _Record(msgspec.Struct):
    """The run of the system that has read the files, and the texts of those that hold, by their paths.

    `unended`: what has begun to run and has not ended. A crash leaves the text that may have ended the process.
    """

    run: str = ""
    texts: dict[str, str] = {}
    unended: list[_Begun] = []


class _Running:
    """A text of a file that runs, in a thread of its own: it may wait for something for ever.

    Attributes:
        ended: has the classes of actions in it, or the ConfigError that says what is wrong.
    """

    def __init__(self, file: str, text: str) -> None:
        self.text = text
        self.ended: futures.Future[_Found] = futures.Future()
        threading.Thread(target=self._run, args=(file, text), name=f"{Path(file).name}", daemon=True).start()

    def _run(self, file: str, text: str) -> None:
        try:
            self.ended.set_result(_run_text(file, text))
        except BaseException as error:
            self.ended.set_exception(error)


class ActionFolder:
    """The files ``*.py`` of a folder whose names do not begin with an underscore. One thread at a time.

    Attributes:
        kinds: the classes of actions in them, by name. Another dict after each change.
        faults: what is wrong with a file, by its path; what it said before still holds.
    """

    def __init__(self, folder: Path, beginning: Beginning | None, taken: Kinds, within_s: float = _WITHIN_S) -> None:
        """Run the files. After a crash, run the texts that held before it.

        Args:
            taken: actions that the manager was given; no file may have one of their names.
            within_s: seconds after which a later look does not wait any longer for a file that runs.

        Raises:
            ConfigError: a file is wrong, or the folder cannot be read.
        """
        self._folder, self._taken = folder, taken
        self._stamps: dict[str, _Stamp] | None = None
        self._texts: dict[str, str] = {}
        self._by_file: dict[str, Kinds] = {}
        self.faults: dict[str, ConfigError] = {}
        self._run = "" if beginning is None else beginning.run
        self._record = None if beginning is None else KeptRecord(beginning.directory / "actions.json", _Record)
        self._unended: list[_Begun] = []
        self._running: dict[str, _Running] = {}
        self._within_s: float | None = None  # a start has a limit of its own
        record = None if beginning is None or beginning.by_hand or self._record is None else self._record.now
        if record is not None:
            self._unended = [begun for begun in record.unended if begun.run == self._run]
        if record is not None and record.run == self._run:
            self._go_on(record.texts)
        else:
            self._read_changed()
            for fault in self.faults.values():
                raise fault  # what held before a crash stays in the record
        self._within_s = within_s
        self._take()

    def look(self) -> bool:
        """Run the files that have changed. Return whether `kinds` or `faults` is another one now.

        A file that is wrong leaves what it said before; a file that is gone leaves nothing. One that has not ended in
        time is wrong until a look finds that it has ended.
        """
        before = self._stamps
        is_news = self._read_changed()
        if self._stamps is not None and self._stamps is not before:
            self._take()
        return is_news

    def _read_changed(self) -> bool:
        try:
            stamps = self._stamps_now()
        except ConfigError as error:
            is_news = self.faults.keys() != {str(self._folder)}
            self._stamps, self.faults = None, {str(self._folder): error}
            return is_news
        if stamps == self._stamps and not any(running.ended.done() for running in self._running.values()):
            return False
        for file in {*self._texts, *self.faults} - set(stamps):
            for known in (self._by_file, self._texts, self.faults, self._running):
                known.pop(file, None)
        before = self._stamps or {}
        for file in [file for file, stamp in stamps.items() if before.get(file) != stamp]:
            self._read(file)
        for file in sorted(self.faults):  # a class may have moved from one file to another
            self._read(file)
        self._stamps = stamps
        return True

    def _stamps_now(self) -> dict[str, _Stamp]:
        if not self._folder.is_dir():
            raise wrong(str(self._folder), "", "a folder with Python files of actions", None, said="none")
        found: dict[str, _Stamp] = {}
        for file in sorted(self._folder.glob("*.py")):
            try:
                stat = file.stat()
            except OSError:  # it has just been removed
                continue
            if not file.name.startswith(("_", ".")):
                found[str(file)] = stat.st_mtime_ns, stat.st_size, stat.st_ino
        return found

    def _read(self, file: str) -> None:
        """Run a file. If it is wrong, say so, and leave what it said before."""
        before, running = self.faults.pop(file, None), self._running.pop(file, None)
        try:
            if may_block(Path(file)):
                raise wrong(file, "", _PYTHON, None, said="a pipe, a socket or a device")
            try:
                text = Path(file).read_text()
            except (OSError, UnicodeDecodeError) as error:
                raise wrong(file, "", _PYTHON, None, said=text_of(error)) from error
            if text == self._texts.get(file):
                return
            self._by_file[file] = self._kinds_in(file, text, running)
            self._texts[file] = text
        except ConfigError as error:
            self.faults[file] = error
            if str(error) != str(before):
                holds = "what it said before still holds" if file in self._texts else "it has no actions yet"
                logger.warning("%s; %s", error, holds)

    def _kinds_in(self, file: str, text: str, running: _Running | None = None) -> Kinds:
        """Run a text, and return its classes of actions. `running`: what runs of this file since an earlier look.

        Raises:
            ConfigError: it is wrong, or has not ended in time, or the process ended each time when it ran before.
        """
        if running is None or running.text != text:
            others = [begun for begun in self._unended if (begun.file, begun.text) != (file, text)]
            tries = max((begun.tries for begun in self._unended if begun not in others), default=0)
            if tries >= _TRIES:
                said = "one with which the manager's process ended; it runs again when it has changed"
                raise wrong(file, "", _PYTHON, None, said=said)
            self._note_unended([*others, _Begun(self._run, file, text, tries + 1)])
            running = _Running(file, text)
            _wait(running, self._within_s)
        if not running.ended.done():
            self._running[file] = running
            raise wrong(file, "", _PYTHON, None, said=f"one that has not ended within {self._within_s or 0:g} s")
        self._note_unended([begun for begun in self._unended if (begun.file, begun.text) != (file, text)])
        return self._with_names(file, running.ended.result())

    def _note_unended(self, unended: list[_Begun]) -> None:
        self._unended = unended
        if self._record is not None:
            self._record.now.unended = unended
            self._record.save()

    def _with_names(self, file: str, found: _Found) -> Kinds:
        """Return the classes of actions of a file by name.

        Raises:
            ConfigError: one has the name of another.
        """
        others = {**self._taken, **_merged(kinds for name, kinds in self._by_file.items() if name != file)}
        named: dict[str, type[Action]] = {}
        for kind, line in found.kinds:
            name = name_of(kind)
            if name in others or name in named:
                del sys.modules[found.module.__name__]
                said = f"{name!r} again{_where(others.get(name))}"
                raise _at_line(file, line, "actions with different names", said)
            named[name] = kind
        if any(kind.isolate for kind in named.values()):  # their processes cannot import the module
            pickling.send_by_value(found.module)
        return named

    def _take(self) -> None:
        """Let the classes of all files hold, and write their texts."""
        self.kinds: Kinds = _merged(self._by_file.values())
        if self._record is not None:
            now = _Record(self._run, dict(self._texts), self._unended)
            if now != self._record.now:
                self._record.now = now
                self._record.save()

    def _go_on(self, texts: Mapping[str, str]) -> None:
        """Run the texts that held before a crash; the first look after that finds what has changed since."""
        for file, text in texts.items():
            try:
                self._by_file[file] = self._kinds_in(file, text)
            except ConfigError as error:  # the code that it uses is another one by now
                logger.warning("%s; its text before the crash does not hold any more", error)
            else:
                self._texts[file] = text


class _Found(msgspec.Struct, frozen=True):
    """What a text that has run has: its module, and the classes of actions in it, each with its line."""

    module: ModuleType
    kinds: list[tuple[type[Action], int]]


def _wait(running: _Running, within_s: float | None) -> None:
    """Wait until a text has ended, for so many seconds in which this process runs; None: without a limit."""
    limit = None if within_s is None else RunningLimit(within_s)
    while not running.ended.done() and not (limit is not None and limit.is_over()):
        futures.wait([running.ended], None if limit is None else limit.slice_s)


def _run_text(file: str, text: str) -> _Found:
    """Run a text, and return what it has.

    Raises:
        ConfigError: it raises, or has no action, or one is wrong.
    """
    module = ModuleType(f"{Path(file).stem}#{next(_versions)}")
    module.__file__ = file
    sys.modules[module.__name__] = module  # where msgspec and dataclasses look for the names in annotations
    try:
        tree = ast.parse(text, file)
        exec(compile(tree, file, "exec", dont_inherit=True), vars(module))  # docs/security.md: these files are code
    except BaseException as error:  # it may raise anything
        del sys.modules[module.__name__]
        raise _at_line(file, _line_of(error, file), _PYTHON, text_of(error)) from error
    try:
        return _Found(module, _checked(file, module, tree))
    except ConfigError:
        del sys.modules[module.__name__]
        raise


def _checked(file: str, module: ModuleType, tree: ast.Module) -> list[tuple[type[Action], int]]:
    """Return the classes of actions of a file, each with its line.

    Raises:
        ConfigError: there are none, or one is wrong.
    """
    lines = {node.name: node.lineno for node in ast.walk(tree) if isinstance(node, ast.ClassDef)}
    found = [(kind, lines.get(kind.__name__, 0)) for kind in _actions_of(module)]
    for kind, line in found:
        try:
            check_isolation(kind)
            signature_of_class(kind)
        except BaseException as error:  # to read the types of its fields runs the file's code
            said = str(error) if isinstance(error, UsageError) else text_of(error)
            raise _at_line(file, line, "a class of actions that can run", said) from error
    if not found:
        raise wrong(file, "", _PYTHON, None, said="none")
    return found


def _merged(some: Iterable[Kinds]) -> dict[str, type[Action]]:
    return {name: kind for kinds in some for name, kind in kinds.items()}


def _actions_of(module: ModuleType) -> list[type[Action]]:
    """Return the classes of actions that a module itself has, without abstract ones."""
    values = dict.fromkeys(value for value in vars(module).values() if isinstance(value, type))
    own = [value for value in values if issubclass(value, Action) and value.__module__ == module.__name__]
    return [kind for kind in own if not inspect.isabstract(kind)]


def _at_line(file: str, line: int, expected: str, said: str) -> ConfigError:
    return wrong(file, f"line {line}" if line else "", expected, None, said=said)


def _line_of(error: BaseException, file: str) -> int:
    """Return the line of a file that an error is about; 0: none."""
    if isinstance(error, SyntaxError) and error.filename == file:
        return error.lineno or 0
    lines = [frame.lineno or 0 for frame in traceback.extract_tb(error.__traceback__) if frame.filename == file]
    return lines[-1] if lines else 0


def _where(other: type[Action] | None) -> str:
    file = getattr(sys.modules.get(other.__module__), "__file__", None) if other is not None else None
    return f", as in {file}" if file else ""
