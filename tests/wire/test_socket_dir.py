"""The directory of sockets, used by two threads at the same moment."""

from __future__ import annotations

import shutil
import socket
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from rr_actors.base.folder import Folder
from rr_actors.wire.unix_sockets import SocketDir
from support import Gate, descriptors
from support_asks import Background


@pytest.fixture
def run(tmp_path: Path) -> Path:
    made = tmp_path / "run"
    made.mkdir()
    return made


@pytest.fixture
def sockets(run: Path) -> Iterator[SocketDir]:
    before = descriptors()
    made = SocketDir(run)
    yield made
    made.unlink("a.sock")
    made.close()
    assert not descriptors() - before


def connect(sockets: SocketDir) -> None:
    sockets.connect("a.sock").close()


def test_a_directory_that_is_made_again_is_found_by_both(
    run: Path, sockets: SocketDir, monkeypatch: pytest.MonkeyPatch
) -> None:
    gate, look = Gate(), Folder.is_there

    def is_there(folder: Folder) -> bool:
        if threading.current_thread() is not threading.main_thread():
            gate()
        return look(folder)

    sockets.bind("a.sock").close()
    shutil.rmtree(run)
    run.mkdir()
    with socket.socket(socket.AF_UNIX) as listening:
        listening.bind(str(run / "a.sock"))
        listening.listen()
        monkeypatch.setattr(Folder, "is_there", is_there)
        other = Background(lambda: connect(sockets))
        gate.wait_arrived()
        connect(sockets)
        gate.open()
        other.result()


def test_two_that_open_it_at_once_leave_no_descriptor(
    run: Path, sockets: SocketDir, monkeypatch: pytest.MonkeyPatch
) -> None:
    both, open_at = threading.Barrier(2, timeout=10), Folder.unlinked

    def at(*args: Any) -> Folder:
        folder = open_at(*args)
        both.wait()
        return folder

    with socket.socket(socket.AF_UNIX) as listening:
        listening.bind(str(run / "a.sock"))
        listening.listen()
        monkeypatch.setattr(Folder, "unlinked", at)
        other = Background(lambda: connect(sockets))
        connect(sockets)
        other.result()
