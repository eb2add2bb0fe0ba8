"""Graph log: the ends of actions since the response of a graph was written.

A response is the whole graph, so to write it at each transition costs bytes with the square of the graph's size. Of a
large graph, an end that comes soon after the last response is written here alone. After a crash the run is the one in
the response, with the ends in the log.
"""

from __future__ import annotations

import contextlib
import io
import os
import zlib
from pathlib import Path
from typing import Any

from rr_actors.base.errors import CatalogError, RrError
from rr_actors.base.folder import Folder, make_directories
from rr_actors.base.values.canonical import Codec
from rr_actors.managers.actions.graph_runs import NodeEnded
from rr_actors.storage.journaled_store import RecordEnd, is_torn, record, records, write_whole

_BEFORE, _AFTER = "graph-", ".log"
_LONGEST = 2**14
_MOST = 2**16
"""The longest event, and log, in bytes. Others are written with the response, which refuses what is too long."""


class GraphLog:
    """The log of one graph, in a file beside the catalog. One thread at a time."""

    def __init__(self, directory: Path, graph_id: str) -> None:
        self._path = path = directory / f"{_BEFORE}{graph_id}{_AFTER}"
        self._file: io.FileIO | None = None
        self._end = _begin(path)

    def append(self, step: int, event: NodeEnded) -> bool:
        """Write the end that has made this step of the run. Return False, and write nothing, if it is too long.

        Raises:
            NotSerializable: an output is no plain data.
            CatalogError: the disk refuses it, and nothing is written.
        """
        body = _EVENT.encode([step, event.node, event.number, event.result, event.outputs, event.why], what="output")
        if len(body) > _LONGEST or self._end.at > _MOST:
            return False
        data, checksum = record(body, self._end.checksum)
        try:
            if self._file is None:
                make_directories(self._path.parent)
                with Folder.at(self._path.parent) as folder:
                    self._file = folder.open(self._path.name, os.O_CREAT | os.O_TRUNC | os.O_WRONLY)
            self._end = RecordEnd(write_whole(self._file.fileno(), data, self._end.at), checksum)
        except OSError as error:
            raise CatalogError(f"{self._path}: {error.strerror}", path=str(self._path)) from error
        return True

    def since(self, step: int) -> list[NodeEnded]:
        """Return the ends after this step of the run, in their order.

        Raises:
            CatalogError: the file cannot be read, or a record of it is damaged or missing.
        """
        try:
            with Folder.at(self._path.parent) as folder:
                data = folder.read(self._path.name)
        except FileNotFoundError:
            return []
        except OSError as error:
            raise CatalogError(f"{self._path}: {error.strerror}", path=str(self._path)) from error
        end, ends = _begin(self._path), list[NodeEnded]()
        for body, after in records(data, end):
            end = after
            number, *rest = self._read(body)
            if number == step + len(ends) + 1:
                ends.append(NodeEnded(*rest))
            elif number > step:
                raise CatalogError(f"{self._path}: no record of step {step + len(ends) + 1}", path=str(self._path))
        if end.at < len(data) and not is_torn(data, end):
            raise CatalogError(f"{self._path}: damaged from byte {end.at} on", path=str(self._path))
        return ends

    def _read(self, body: bytes) -> list[Any]:
        try:
            return _EVENT.decode(body)
        except RrError as error:
            raise CatalogError(f"{self._path}: a bad record: {error}", path=str(self._path)) from error

    def clear(self) -> None:
        """Forget all: the response has it. If the file cannot be removed, it is ignored: it is of steps before."""
        if self._end.at:
            self.remove()
            self._end = _begin(self._path)

    def close(self) -> None:
        """Close the file. A second call does nothing."""
        if self._file is not None:
            self._file.close()
            self._file = None

    def remove(self) -> None:
        """Close the file, and remove it."""
        self.close()
        with contextlib.suppress(OSError), Folder.at(self._path.parent) as folder:
            folder.discard(self._path.name)


def logged(directory: Path) -> set[str]:
    """Return the ids of the graphs that have a log beside this catalog."""
    with contextlib.suppress(OSError), Folder.at(directory) as folder:
        names = [name for name in folder.names() if name.startswith(_BEFORE) and name.endswith(_AFTER)]
        return {name.removeprefix(_BEFORE).removesuffix(_AFTER) for name in names}
    return set()


_EVENT = Codec(list[Any])


def _begin(path: Path) -> RecordEnd:
    """Return where the log of a graph begins: a record of another graph's log does not fit."""
    return RecordEnd(0, zlib.crc32(path.name.encode()))
