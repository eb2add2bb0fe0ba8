"""Folders: directories that are held open by a descriptor, which is closed once."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

import pytest

from rr_actors.base.folder import Folder, read_plain


def test_a_folder_that_nobody_uses_any_more_closes_its_descriptor(tmp_path: Path) -> None:
    folder = Folder.at(tmp_path)
    fd = folder.fd
    os.fstat(fd)
    del folder

    with pytest.raises(OSError):
        os.fstat(fd)


def test_a_descriptor_is_closed_once_by_whichever_comes_first(tmp_path: Path) -> None:
    folder = Folder.at(tmp_path)
    folder.close()
    with open(os.devnull) as other:  # noqa: PTH123  # it gets the same number
        folder.close()
        del folder
        os.fstat(other.fileno())


def test_each_listing_is_whole_while_another_of_the_same_folder_has_not_ended(tmp_path: Path) -> None:
    folder = Folder.at(tmp_path)
    names = [f"{number}.journal" for number in range(20)]
    for name in names:
        (tmp_path / name).touch()
    with os.scandir(folder.fd) as other:  # as another thread, or a process that has inherited the descriptor
        next(other)
        assert sorted(folder.names()) == sorted(names)
        assert 1 + len(list(other)) == 20


# -- files that users name ---------------------------------------------------------------------------------------------


def fill(path: Path) -> None:
    path.write_bytes(b"text")


def point(to: str) -> Callable[[Path], None]:
    return lambda path: path.symlink_to(to)


@pytest.mark.parametrize(
    ("make", "data"),
    [(fill, b"text"), (point(os.devnull), b""), (point("/proc/sys/kernel/ostype"), b"Linux\n")],
    ids=["a file", "/dev/null", "a file of the kernel"],
)
def test_a_file_is_read(make: Callable[[Path], None], data: bytes, tmp_path: Path) -> None:
    make(tmp_path / "file")

    assert read_plain(tmp_path / "file") == data


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (os.mkfifo, "a pipe, and no regular file"),
        (point("pipe"), "a pipe, and no regular file"),
        (point("/dev/zero"), "a device, and no regular file"),
        (Path.mkdir, "Is a directory"),
        (lambda path: None, "No such file or directory"),
        (point("file"), "Too many levels of symbolic links"),
    ],
    ids=["a pipe", "a link to a pipe", "a device", "a directory", "nothing", "a link to itself"],
)
def test_what_is_no_file_is_named_at_once(make: Callable[[Path], None], said: str, tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    make(tmp_path / "file")

    with pytest.raises(OSError) as refused:
        read_plain(tmp_path / "file")
    assert refused.value.strerror == said


def test_a_pipe_that_this_process_was_given_is_read() -> None:
    reads, writes = os.pipe()
    os.write(writes, b"text")
    os.close(writes)

    assert read_plain(f"/dev/fd/{reads}") == b"text"
    os.close(reads)
