"""Removing a directory with all that is in it."""

from __future__ import annotations

import os
import socket
from pathlib import Path

import pytest

from rr_actors.runtime.processes.remove_tree import remove_tree


def test_a_directory_goes_with_all_that_is_in_it(tmp_path: Path) -> None:
    there = tmp_path / "there"
    (there / "names" / "deeper").mkdir(parents=True)
    (there / "empty").mkdir()
    (there / "names" / "file").write_text("x")
    (there / "names" / "deeper" / "file").write_text("x")
    (there / "names" / "r.cameras").symlink_to("up:4711-0a1b.sock")
    os.mkfifo(there / "pipe")
    with socket.socket(socket.AF_UNIX) as listener:
        listener.bind(str(there / "s"))

    remove_tree(there)

    assert list(tmp_path.iterdir()) == []


def test_what_a_link_leads_to_stays(tmp_path: Path) -> None:
    there, elsewhere = tmp_path / "there", tmp_path / "elsewhere"
    there.mkdir()
    elsewhere.mkdir()
    (elsewhere / "file").write_text("x")
    (there / "link").symlink_to(elsewhere)
    (there / "to_file").symlink_to(elsewhere / "file")

    remove_tree(there)

    assert not there.exists()
    assert (elsewhere / "file").read_text() == "x"


def test_a_link_in_the_directorys_place_stays_with_what_it_leads_to(tmp_path: Path) -> None:
    elsewhere, link = tmp_path / "elsewhere", tmp_path / "link"
    elsewhere.mkdir()
    (elsewhere / "file").write_text("x")
    link.symlink_to(elsewhere)

    remove_tree(link)

    assert link.is_symlink()
    assert (elsewhere / "file").exists()


def test_what_is_not_there_is_no_error(tmp_path: Path) -> None:
    remove_tree(tmp_path / "never")

    (tmp_path / "file").write_text("x")
    remove_tree(tmp_path / "file")
    assert (tmp_path / "file").exists()


@pytest.mark.skipif(os.geteuid() == 0, reason="root may remove anything")
def test_what_cannot_be_removed_is_left_and_the_rest_goes(tmp_path: Path) -> None:
    there = tmp_path / "there"
    (there / "closed").mkdir(parents=True)
    (there / "closed" / "file").write_text("x")
    (there / "file").write_text("x")
    (there / "closed").chmod(0o500)
    try:
        remove_tree(there)
        assert [path.name for path in there.iterdir()] == ["closed"]
    finally:
        (there / "closed").chmod(0o700)
