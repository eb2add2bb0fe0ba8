"""Folders: directories that are held open by a descriptor, which is closed once."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from rr_actors.base.folder import Folder


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
