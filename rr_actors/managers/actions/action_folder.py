"""Action folder: classes of actions in the Python files of a folder, which may change while the manager runs.

A file is a module of its own, and each version of it has a name of its own: what runs goes on with its class. The
texts that the classes come from are on disk beside the catalog. So a crash finds them, whatever the files say by then.
"""

from __future__ import annotations

import ast
import inspect
import itertools
import sys
import traceback
from collections.abc import Iterable, Mapping
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

logger = Log("rr_actors.managers.actions")

_PYTHON = "a Python file with a class of actions"
_versions = itertools.count(1)

Kinds = Mapping[str, type[Action]]
"""Classes of actions, by the names that graphs call them by."""
_Stamp = tuple[int, int, int]


_TRIES = 2  # a process may also be killed by somebody else while a file runs; a load is given up after three deaths


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


class ActionFolder:
    """The files ``*.py`` of a folder whose names do not begin with an underscore. One thread at a time.

    Attributes:
        kinds: the classes of actions in them, by name. Another dict after each change.
        faults: what is wrong with a file, by its path; what it said before still holds.
    """

    def __init__(self, folder: Path, beginning: Beginning | None, taken: Kinds) -> None:
        """Run the files. After a crash, run the texts that held before it.

        Args:
            taken: actions that the manager was given; no file may have one of their names.

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
        record = None if beginning is None or beginning.by_hand or self._record is None else self._record.now
        if record is not None:
            self._unended = [begun for begun in record.unended if begun.run == self._run]
        if record is not None and record.run == self._run:
            self._go_on(record.texts)
        else:
            self._read_changed()
            for fault in self.faults.values():
                raise fault  # what held before a crash stays in the record
        self._take()

    def look(self) -> bool:
        """Run the files that have changed. Return whether `kinds` or `faults` is another one now.

        A file that is wrong leaves what it said before; a file that is gone leaves nothing.
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
        if stamps == self._stamps:
            return False
        for file in {*self._texts, *self.faults} - set(stamps):
            for known in (self._by_file, self._texts, self.faults):
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
        before = self.faults.pop(file, None)
        try:
            if may_block(Path(file)):
                raise wrong(file, "", _PYTHON, None, said="a pipe, a socket or a device")
            try:
                text = Path(file).read_text()
            except (OSError, UnicodeDecodeError) as error:
                raise wrong(file, "", _PYTHON, None, said=text_of(error)) from error
            if text == self._texts.get(file):
                return
            self._by_file[file] = self._kinds_in(file, text)
            self._texts[file] = text
        except ConfigError as error:
            self.faults[file] = error
            if str(error) != str(before):
                holds = "what it said before still holds" if file in self._texts else "it has no actions yet"
                logger.warning("%s; %s", error, holds)

    def _kinds_in(self, file: str, text: str) -> Kinds:
        """Run a text, and return its classes of actions.

        Raises:
            ConfigError: it is wrong, or the process ended each time when it ran before.
        """
        others = [begun for begun in self._unended if (begun.file, begun.text) != (file, text)]
        tries = max((begun.tries for begun in self._unended if begun not in others), default=0)
        if tries >= _TRIES:
            said = "one with which the manager's process ended; it runs again when it has changed"
            raise wrong(file, "", _PYTHON, None, said=said)
        self._note_unended([*others, _Begun(self._run, file, text, tries + 1)])
        try:
            return self._run_text(file, text)
        finally:
            self._note_unended(others)

    def _note_unended(self, unended: list[_Begun]) -> None:
        self._unended = unended
        if self._record is not None:
            self._record.now.unended = unended
            self._record.save()

    def _run_text(self, file: str, text: str) -> Kinds:
        others = {**self._taken, **_merged(kinds for name, kinds in self._by_file.items() if name != file)}
        module = ModuleType(f"{Path(file).stem}#{next(_versions)}")
        module.__file__ = file
        sys.modules[module.__name__] = module  # where msgspec and dataclasses look for the names in annotations
        try:
            tree = ast.parse(text, file)
            exec(compile(tree, file, "exec", dont_inherit=True), vars(module))  # docs/security.md: these files are code
        except (Exception, SystemExit) as error:  # it may raise anything
            del sys.modules[module.__name__]
            raise _at_line(file, _line_of(error, file), _PYTHON, text_of(error)) from error
        try:
            found = self._checked(file, module, tree, others)
        except ConfigError:
            del sys.modules[module.__name__]
            raise
        if any(kind.isolate for kind in found.values()):  # their processes cannot import the module
            pickling.send_by_value(module)
        return found

    def _checked(self, file: str, module: ModuleType, tree: ast.Module, others: Kinds) -> Kinds:
        """Return the classes of actions of a file, by name.

        Raises:
            ConfigError: there are none, or one is wrong, or has the name of another.
        """
        lines = {node.name: node.lineno for node in ast.walk(tree) if isinstance(node, ast.ClassDef)}
        found: dict[str, type[Action]] = {}
        for kind in _actions_of(module):
            line = lines.get(kind.__name__, 0)
            try:
                check_isolation(kind)
                signature_of_class(kind)
            except Exception as error:  # to read the types of its fields runs the file's code
                said = str(error) if isinstance(error, UsageError) else text_of(error)
                raise _at_line(file, line, "a class of actions that can run", said) from error
            if name_of(kind) in others or name_of(kind) in found:
                expected = "actions with different names"
                raise _at_line(file, line, expected, f"{name_of(kind)!r} again{_where(others.get(name_of(kind)))}")
            found[name_of(kind)] = kind
        if not found:
            raise wrong(file, "", _PYTHON, None, said="none")
        return found

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
