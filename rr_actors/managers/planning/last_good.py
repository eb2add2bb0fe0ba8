"""LastGood: the configuration that a manager goes on with after a crash, whatever its file says by then.

A file is read when somebody asks for it: at the start of the system, at a start by hand (start_child, restart_child),
and by a message such as Keeper.apply(). A wrong file is an error then. When the supervisor restarts the manager, nobody
has asked: the manager goes on with the texts of its last good configuration, which are on disk beside its catalog. If
the file is wrong, missing, or another one by then, the log has a WARNING, and `ps`, `status`, `top` and the web page
say so beside the manager.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Generic, TypeVar

import msgspec

from rr_actors.base.checks import path_text
from rr_actors.base.errors import ConfigError, GraphError
from rr_actors.base.folder import may_block
from rr_actors.base.reporting.log import Log
from rr_actors.base.toml import read_bytes, wrong
from rr_actors.managers.planning.kept_record import KeptRecord
from rr_actors.registrar.manager import Beginning

logger = Log("rr_actors.managers")

C = TypeVar("C")
V = TypeVar("V")

Sources = Mapping[str, bytes]
"""The contents of the files of a configuration, by their paths."""


class _Record(msgspec.Struct):
    """The run of the system that has read the files, what they said, and what has been applied in their place."""

    run: str = ""
    given: dict[str, str] | None = None
    applied: dict[str, str] | None = None


class LastGood(Generic[C]):
    """The configuration of a manager that reads files. Make it in the manager's __init__::

        self._configuration = LastGood(self._rr_beginning(), lambda: one_file(path), self._parsed)

    Attributes:
        now: the configuration that holds.
        problem: why the files do not say what holds, since a restart; "" if they do.
    """

    def __init__(self, beginning: Beginning | None, read: Callable[[], Sources], parse: Callable[[Sources], C]) -> None:
        """Take the configuration from the files; at a restart by the supervisor, from the record beside the catalog.

        Args:
            beginning: of the manager; None: it is made outside a system, and nothing is kept.
            read: returns what the files say now.
            parse: makes a configuration of their contents, or of contents that were kept. It reads no file.

        Raises:
            ConfigError, GraphError: the files cannot be read, or are wrong.
        """
        self._parse = parse
        self._record: KeptRecord[_Record] | None = None
        self.problem = ""
        if beginning is None:
            self.now = parse(read())
            return
        record = self._record = KeptRecord(beginning.directory / "configuration.json", _Record)
        kept = record.now
        if kept.given is not None and kept.run == beginning.run and not beginning.by_hand:
            try:
                self.now = parse(_bytes_of(kept.applied or kept.given))
            except (ConfigError, GraphError) as error:  # the code is another one by now
                logger.warning("%s: its last good configuration does not hold any more: %s", beginning.name, error)
            else:
                beginning.note(self._go_on(beginning.name, read, kept.given))
                return
        beginning.note("")
        self._begin(beginning, read, record)

    def _go_on(self, name: str, read: Callable[[], Sources], given: Mapping[str, str]) -> str:
        """Return what an operator should know."""
        self.problem = self._difference(read, given)
        if self.problem:
            said = f"goes on with its last good configuration: {self.problem}"
            logger.warning("%s %s. A change takes effect at the next start.", name, said)
            return said
        return ""

    def _begin(self, beginning: Beginning, read: Callable[[], Sources], record: KeptRecord[_Record]) -> None:
        sources, kept = read(), record.now
        self.now = self._parse(sources)
        given = _texts_of(sources)
        applied = kept.applied if kept.given == given else None
        if applied is not None:
            try:
                self.now = self._parse(_bytes_of(applied))
            except (ConfigError, GraphError) as error:  # another version has applied it
                logger.warning("%s: what was applied does not hold any more: %s", beginning.name, error)
                applied = None
        record.now = _Record(beginning.run, given, applied)
        record.save()

    def apply(self, sources: Sources) -> bool:
        """Let other contents hold in place of the files, until the files say something else at a start.

        Return whether that is on disk.

        Raises:
            ConfigError, GraphError: they are wrong. Nothing has changed.
        """
        self.now = self._parse(sources)
        applied = _texts_of(sources)
        if self._record is None:
            return True
        kept = self._record.now
        self._record.now = _Record(kept.run, kept.given, applied)
        return self._record.save()

    def catch_up(self) -> bool:
        """Write what was applied, if the disk has refused that. Return whether it is on disk."""
        return self._record is None or self._record.catch_up()

    def _difference(self, read: Callable[[], Sources], given: Mapping[str, str]) -> str:
        """Return how what the files say now differs from what they said; "" if it does not."""
        try:
            sources = read()
            said = {file: data.decode(errors="replace") for file, data in sources.items()}
            if said == given:
                return ""
            self._parse(sources)
        except (ConfigError, GraphError) as error:
            return str(error)
        changed = sorted(file for file in {*said, *given} if said.get(file) != given.get(file))
        return f"{', '.join(changed)}: changed since it was read"


def path_of(given: object, where: str, argument: str) -> Path:
    """Return the absolute path of a file that is given to a manager; `where` is its class.

    Raises:
        ConfigError: it is no path.
    """
    text = path_text(given)
    if not text:
        raise wrong(None, argument, "the path of a file", given, where=where)
    return Path(text).absolute()


def one_file(path: str | Path) -> Sources:
    """Return the contents of one file, for LastGood.

    Raises:
        ConfigError: it cannot be read.
    """
    if may_block(Path(path)):
        raise wrong(str(path), "", "a file", path, said="a pipe, a socket or a device")
    return {str(path): read_bytes(str(path))}


def last_good_file(beginning: Beginning | None, path: Path, parse: Callable[[bytes, str], C]) -> LastGood[C]:
    """Return the configuration that is one file; `parse` is called with its contents and its path."""

    def parsed(sources: Sources) -> C:
        ((file, data),) = sources.items()
        return parse(data, file)

    return LastGood(beginning, lambda: one_file(path), parsed)


def still_standing(overrides: Mapping[str, tuple[V, V]], configured: Mapping[str, V]) -> dict[str, tuple[V, V]]:
    """Return the overrides that still hold, of pairs (what the file said, what was set in its place).

    Call it at a start, and keep only what it returns: once the file has said something else, or nothing, what
    was set is gone for good. It does not come back with an earlier text of the file.
    """
    return {name: pair for name, pair in overrides.items() if name in configured and configured[name] == pair[0]}


def _texts_of(sources: Sources) -> dict[str, str]:
    return {file: data.decode() for file, data in sources.items()}


def _bytes_of(texts: Mapping[str, str]) -> dict[str, bytes]:
    return {file: text.encode() for file, text in texts.items()}
