"""Control groups: which can be made, by trees that are like the kernel's; and freezing, by the kernel's own."""

from __future__ import annotations

import os
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest

from rr_actors.runtime.processes.control_groups import ControlGroup, ControlGroups, group_of, read_number


def a_group(path: Path, *, controllers: str = "", on: str = "", pids: str = "", **limits: str) -> Path:
    """Make a directory with the files of a control group. The topmost one of a tree has no type."""
    path.mkdir()
    files = {"cgroup.controllers": controllers, "cgroup.subtree_control": on, "cgroup.procs": pids, **limits}
    for name, text in files.items():
        (path / name.replace("_max", ".max")).write_text(text)
    if (path.parent / "cgroup.procs").exists():
        (path / "cgroup.type").write_text("domain")
    return path


def placed(own: Path, mounted: Path, *limits: str) -> Path | None:
    group = ControlGroups(own, mounted).place("rr-x", limits)
    return group and group.path


def test_without_limits_a_group_is_below_the_own_one(tmp_path: Path) -> None:
    top = a_group(tmp_path / "top", controllers="cpu memory", on="cpu memory")
    own = a_group(top / "own", pids="1")
    assert placed(own, top) == own / "rr-x"
    assert placed(own, top, "cpu") == top / "rr-x"


def test_controllers_can_be_switched_on_where_no_process_is_and_at_the_top(tmp_path: Path) -> None:
    top = a_group(tmp_path / "top", controllers="cpu memory", pids="1")
    unit = a_group(top / "unit", controllers="cpu")
    own = a_group(unit / "own", controllers="cpu memory", pids="2")
    assert placed(own, unit, "cpu") == unit / "rr-x"
    assert placed(own, top, "cpu") == unit / "rr-x"
    assert placed(own, top, "cpu", "memory_bytes") == top / "rr-x"
    assert ControlGroups(own, unit).limits() == ["cpu"]
    assert ControlGroups(own, own).limits() == []


@pytest.mark.parametrize(("limit", "allowed"), [({"memory_max": "1000"}, False), ({"cpu_max": "max 100000"}, True)])
def test_a_program_does_not_escape_a_limit_of_its_system(tmp_path: Path, limit: dict[str, str], allowed: bool) -> None:
    top = a_group(tmp_path / "top", controllers="cpu memory", on="cpu memory")
    own = a_group(top / "own", pids="1", **limit)
    assert ControlGroups(own, top).limits() == (["cpu", "memory_bytes"] if allowed else [])


@pytest.mark.parametrize("made", [False, True])
def test_without_a_group_that_can_be_written_none_can_be_made(tmp_path: Path, made: bool) -> None:
    own = a_group(tmp_path / "top") if made else None
    if own is not None:
        (own / "cgroup.procs").unlink()
    groups = ControlGroups(own, own)
    assert groups.place("rr-x", ["cpu"]) is None
    assert groups.limits() == []


def test_limits_are_written_as_the_kernel_reads_them_and_those_that_hold_are_said(tmp_path: Path) -> None:
    top = a_group(tmp_path / "top", controllers="cpu memory", on="memory")
    group = ControlGroups(top, top).place("rr-x", ["cpu"])
    assert group is not None
    assert group.make({"cpu": 0.5}) == {"cpu": 0.5}
    assert (top / "cgroup.subtree_control").read_text() == "+cpu"
    assert (group.path / "cpu.max").read_text() == "50000 100000"
    (top / "cgroup.subtree_control").write_text("cpu memory")
    assert group.make({"memory_bytes": 2e8}) == {"memory_bytes": 2e8}
    assert (top / "cgroup.subtree_control").read_text() == "cpu memory"
    assert (group.path / "memory.max").read_text() == "200000000"
    assert group.make({"cpu": 0.0}) == {"cpu": 0.0}
    assert (group.path / "cpu.max").read_text() == "1000 100000"
    (group.path / "memory.max").unlink()
    (group.path / "memory.max").mkdir()  # cannot be written
    assert group.make({"memory_bytes": 1.0}) == {}


def test_a_group_without_these_files_can_be_neither_frozen_nor_removed(tmp_path: Path) -> None:
    group = ControlGroup(a_group(tmp_path / "top", pids="5"))
    (group.path / "cgroup.freeze").mkdir()
    assert not group.freeze(4)
    assert not group.freeze(5)
    assert not group.is_frozen()
    assert not group.remove()
    assert ControlGroup(tmp_path / "none").remove()


def test_numbers_are_read_behind_their_key(tmp_path: Path) -> None:
    (tmp_path / "cpu.stat").write_text("usage_usec 5\nuser_usec 3\n")
    (tmp_path / "memory.max").write_text("max\n")
    assert read_number(tmp_path / "cpu.stat", "user_usec") == 3
    assert read_number(tmp_path / "memory.max") == read_number(tmp_path / "none") == 0


# -- the kernel's own --------------------------------------------------------------------------------------------------


@pytest.fixture
def real() -> Iterator[ControlGroup]:
    group = ControlGroups.of_this_process().place(f"rr-test-{os.getpid()}")
    if group is None:
        pytest.skip("no control groups of version 2 that can be written")
    group.make({})
    yield group
    assert group.remove()


def test_what_is_in_a_frozen_group_stands_still_until_it_is_let_on_or_killed(real: ControlGroup) -> None:
    program = subprocess.Popen(["sh", "-c", "setsid sleep 600 & echo $! >&2; cat"], stdin=-1, stdout=-1, stderr=-1)
    assert program.stdin is not None
    assert program.stdout is not None
    assert program.stderr is not None
    sleeper = int(program.stderr.readline())
    assert not real.freeze(program.pid)  # it is not in the group
    for pid in (program.pid, sleeper):
        (real.path / "cgroup.procs").write_text(str(pid))
    assert group_of(program.pid) == real.path
    assert real.freeze(program.pid)
    assert real.is_frozen()
    assert real.freeze(program.pid)  # again
    assert not real.remove()
    program.stdin.write(b"go on\n")
    program.stdin.flush()
    real.thaw()
    assert program.stdout.readline() == b"go on\n"
    assert real.freeze(program.pid)
    for pid in real.pids():
        os.kill(pid, 9)
    program.wait()
    assert real.remove()
