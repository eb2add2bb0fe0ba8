"""`rr-actors doctor` says what a machine lacks, limits, and what to do, on real limits."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

import rr_actors as rr
from rr_actors.tools import doctor
from support import REPOSITORY
from support_cli import run_cli

EXAMINED = (
    "versions", "threads", "descriptors", "processes", "/proc", "control group: memory", "control group: tasks",
    "control group: programs", "memfd", "/dev/shm", "ptrace", "clock", "state: file system", "state: room",
    "state: fsync", "fork server", "terminal",
)  # fmt: skip
MAIN = "from rr_actors.tools.cli import main; main()"


def findings(output: str) -> dict[str, dict[str, str]]:
    return {finding["what"]: finding for finding in json.loads(output)}


def in_a_shell(
    place: Path, before: str, program: str = MAIN, *, apart: tuple[str, ...] = ()
) -> subprocess.CompletedProcess[str]:
    """Run `rr-actors doctor --json` after these words of a shell."""
    command = f'{before}exec {sys.executable} -c "$0" doctor --json --state state'
    environment = {"PYTHONPATH": str(REPOSITORY), "PATH": "/usr/bin:/bin"}
    return subprocess.run(
        [*apart, "/bin/sh", "-c", command, program],
        cwd=place,
        env=environment,
        capture_output=True,
        text=True,
        timeout=50,
    )


def test_where_a_system_runs_the_doctor_lacks_nothing_and_leaves_nothing(tmp_path: Path) -> None:
    ran = run_cli("doctor", "--state", tmp_path / "not" / "there")
    assert ran.returncode == 0, ran.stdout + ran.stderr
    assert [line[7:31].rstrip() for line in ran.stdout.splitlines() if line[:7].strip()] == list(EXAMINED)
    assert list(tmp_path.iterdir()) == []


def test_what_is_not_well_says_what_to_do_and_what_is_well_does_not(tmp_path: Path) -> None:
    ran = run_cli("doctor", "--state", tmp_path, "--json")
    found = findings(ran.stdout)
    assert found["fork server"]["level"] == "ok"
    assert [what for what, one in found.items() if (one["level"] == "ok") == bool(one["todo"])] == []


def test_the_doctor_examines_the_place_of_a_running_system_and_leaves_it_alone(tmp_path: Path) -> None:
    with rr.System([rr.ChildSpec(rr.Actor, id="one")], state_dir=tmp_path) as system:
        assert run_cli("doctor", "--state", tmp_path).returncode == 0
        assert system.ref("one").is_alive()


def test_too_few_descriptors_for_two_children_are_a_lack(tmp_path: Path) -> None:
    ran = in_a_shell(tmp_path, "ulimit -n 70; ")
    assert ran.returncode == 1, ran.stderr
    found = findings(ran.stdout)["descriptors"]
    assert (found["level"], found["found"].split()[0]) == ("lacks", "70")
    assert "LimitNOFILE=" in found["todo"]


def test_without_proc_the_doctor_and_the_error_of_a_system_say_that_it_is_not_mounted(tmp_path: Path) -> None:
    if subprocess.run(["unshare", "-m", "true"], check=False, capture_output=True).returncode:
        pytest.skip("this user may not make a mount namespace")
    ran = in_a_shell(tmp_path, "umount -l /proc && ", apart=("unshare", "-m"))
    assert ran.returncode == 1, ran.stderr
    found = findings(ran.stdout)
    assert (found["/proc"]["level"], found["fork server"]["level"]) == ("lacks", "lacks")
    assert "mount -t proc proc /proc" in found["/proc"]["todo"]
    assert "/proc is not mounted" in found["fork server"]["found"]


def test_few_descriptors_are_a_limit_and_no_lack(tmp_path: Path) -> None:
    ran = in_a_shell(tmp_path, "ulimit -n 256; ")
    assert ran.returncode == 0, ran.stderr
    assert findings(ran.stdout)["descriptors"]["level"] == "limits"


def test_patched_threads_are_a_lack_and_the_doctor_names_the_patch(tmp_path: Path) -> None:
    pytest.importorskip("gevent", reason="the extra test has it")
    ran = in_a_shell(tmp_path, "", f"from gevent import monkey; monkey.patch_all(); {MAIN}")
    assert ran.returncode == 1, ran.stderr
    found = findings(ran.stdout)
    assert found["threads"]["level"] == found["fork server"]["level"] == "lacks"
    assert "gevent has patched thread" in found["threads"]["found"]
    assert "thread=False" in found["threads"]["todo"]


def test_a_state_directory_that_cannot_be_written_is_a_lack(tmp_path: Path) -> None:
    file = tmp_path / "file"
    file.touch()
    ran = run_cli("doctor", "--state", file, "--json")
    assert ran.returncode == 1
    found = findings(ran.stdout)["state: fsync"]
    assert (found["level"], "Not a directory" in found["found"], "--state" in found["todo"]) == ("lacks", True, True)


@pytest.mark.parametrize(("kind", "level"), [("fuse.sshfs", "limits"), ("fuse.glusterfs", "lacks"), ("nfs4", "lacks")])
def test_a_file_system_that_keeps_removed_files_or_shares_locks_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, kind: str, level: str
) -> None:
    monkeypatch.setattr("rr_actors.tools.doctor._file_system", lambda _place: kind)
    (found,) = [finding for finding in doctor.examine(tmp_path) if finding.what == "state: file system"]
    assert (found.level, kind in found.found, "local disk" in found.todo) == (level, True, True)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.skipif("tmpfs /dev/shm" not in Path("/proc/self/mounts").read_text(), reason="/dev/shm is no tmpfs here")
def test_a_file_system_in_memory_is_a_limit_and_its_fsync_is_not_real() -> None:
    found = findings(run_cli("doctor", "--state", "/dev/shm", "--json").stdout)
    assert found["state: file system"]["found"] == "tmpfs, /dev/shm"
    assert found["state: file system"]["level"] == found["state: fsync"]["level"] == "limits"
