"""The directory of names, and the state directory it lives in."""

from __future__ import annotations

import contextlib
import os
import shutil
import signal
import stat
import subprocess
import sys
import textwrap
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from rr_actors.base.errors import CatalogLocked, ConfigError, InvalidName, UsageError
from rr_actors.tools.inspection import read_state
from rr_actors.wire import name_service
from rr_actors.wire.name_service import (
    Directory,
    NameEntry,
    Presence,
    StateDir,
    actor_key,
    open_state_dir,
    registrar_key,
)
from support import Calls
from support_asks import Background


@pytest.fixture
def directory(tmp_path: Path) -> Directory:
    return Directory(tmp_path)


@contextlib.contextmanager
def opened(path: Path) -> Iterator[StateDir]:
    state = open_state_dir(path)
    try:
        yield state
    finally:
        state.close()


@contextlib.contextmanager
def python(code: str, *args: object) -> Iterator[subprocess.Popen[str]]:
    """Another process running this code; killed at the end."""
    with subprocess.Popen(
        [sys.executable, "-c", textwrap.dedent(code), *map(str, args)],
        stdout=subprocess.PIPE,
        text=True,
        cwd=Path(__file__).parents[2],
    ) as process:
        try:
            yield process
        finally:
            process.kill()


def line_of(process: subprocess.Popen[str]) -> str:
    assert process.stdout is not None
    return process.stdout.readline().strip()


@contextlib.contextmanager
def as_somebody_else(*paths: Path) -> Iterator[None]:
    """Run without the rights of root, who may write anywhere; `paths` are made that user's."""
    if os.geteuid() != 0:
        yield
        return
    modes: dict[Path, int] = {}
    for path in paths:
        os.chown(path, 65534, 65534)
        for parent in path.parents:
            modes.setdefault(parent, mode_of(parent))
            parent.chmod(mode_of(parent) | 0o111)
    os.seteuid(65534)
    try:
        yield
    finally:
        os.seteuid(0)
        for parent, mode in modes.items():
            parent.chmod(mode)


# -- names ---------------------------------------------------------------------------------------------------------


def test_a_published_name_is_found_at_its_address(directory: Directory) -> None:
    directory.publish("r.cameras", "4711-0a1b.sock")
    assert directory.lookup("r.cameras") == NameEntry(Presence.UP, "4711-0a1b.sock")


def test_an_announced_name_is_starting_at_the_address_where_it_will_be(directory: Directory) -> None:
    directory.mark("r.cameras", Presence.STARTING)
    directory.announce("r.cameras", "4711-0a1b.sock")
    assert directory.lookup("r.cameras") == NameEntry(Presence.STARTING, "4711-0a1b.sock")
    directory.mark("r.cameras", Presence.STARTING)
    assert directory.lookup("r.cameras") == NameEntry(Presence.STARTING, "")


@pytest.mark.parametrize("status", [status for status in Presence if status is not Presence.UP])
def test_a_marked_name_has_its_status_and_no_address(directory: Directory, status: Presence) -> None:
    directory.publish("r.cameras", "somewhere")
    directory.mark("r.cameras", status)
    assert directory.lookup("r.cameras") == NameEntry(status, "")


def test_a_name_that_was_never_there_is_none(directory: Directory) -> None:
    assert directory.lookup("r.cameras") is None


def test_names_lists_them_sorted(directory: Directory) -> None:
    assert directory.names() == []
    directory.publish("r.b", "x")
    directory.mark("a.root~a", Presence.STARTING)
    assert directory.names() == ["a.root~a", "r.b"]


def test_what_another_directory_object_writes_is_seen_at_once(directory: Directory) -> None:
    other = Directory(directory.run_dir)
    other.publish("r.cameras", "here")
    assert directory.lookup("r.cameras") == NameEntry(Presence.UP, "here")


def test_an_entry_that_says_the_same_is_not_made_again_and_one_that_another_object_changed_is(tmp_path: Path) -> None:
    mine, other = Directory(tmp_path), Directory(tmp_path)
    mine.mark("a.root", Presence.STARTING)
    made = os.lstat(tmp_path / "names" / "a.root").st_ino
    mine.mark("a.root", Presence.STARTING)
    assert os.lstat(tmp_path / "names" / "a.root").st_ino == made
    other.publish("a.root", "/address")
    mine.mark("a.root", Presence.STARTING)
    assert mine.lookup("a.root") == NameEntry(Presence.STARTING, "")


def test_a_foreign_file_under_a_name_is_no_entry(directory: Directory) -> None:
    (directory.run_dir / "names" / "r.file").write_text("up:x")
    (directory.run_dir / "names" / "r.link").symlink_to("/etc/passwd")
    assert directory.lookup("r.file") is None
    assert directory.lookup("r.link") is None


@pytest.mark.parametrize("name", ["", ".", "..", "../x", "a/b", ".hidden"])
def test_names_that_are_no_file_names_are_refused(directory: Directory, name: str) -> None:
    with pytest.raises(UsageError):
        directory.publish(name, "x")
    with pytest.raises(UsageError):
        directory.mark(name, Presence.GONE)


def test_up_cannot_be_marked_without_an_address(directory: Directory) -> None:
    with pytest.raises(UsageError, match="publish"):
        directory.mark("r.x", Presence.UP)


def test_publishing_in_a_directory_that_was_removed_is_a_config_error_naming_it(directory: Directory) -> None:
    (directory.run_dir / "names").rmdir()
    with pytest.raises(ConfigError, match=r"r\.cameras"):
        directory.publish("r.cameras", "x")
    assert directory.lookup("r.cameras") is None
    assert directory.names() == []


def test_marking_files_as_used_when_the_directory_was_removed_does_nothing(tmp_path: Path) -> None:
    directory = Directory(tmp_path / "run")
    shutil.rmtree(directory.run_dir)
    directory.touch()
    assert not directory.run_dir.exists()


def test_two_threads_that_miss_the_directory_at_once_make_it_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    directory = Directory(tmp_path / "run", keeps=True)
    shutil.rmtree(directory.run_dir)
    make, made = name_service.make_directories, Calls()

    def make_slowly(path: Path) -> None:
        made()
        time.sleep(0.2)
        make(path)

    monkeypatch.setattr(name_service, "make_directories", make_slowly)
    other = Background(directory.restore)
    made.wait()
    directory.publish("r.cameras", "here")
    other.result(timeout=10)
    assert len(made) == 1
    assert directory.lookup("r.cameras") == NameEntry(Presence.UP, "here")


def test_keys_of_registrars_and_actors_do_not_collide_and_are_checked() -> None:
    assert registrar_key("cameras") == "r.cameras"
    assert registrar_key("hostb/cameras") == "r.hostb~cameras"
    assert actor_key("root/cameras") == "a.root~cameras"
    for bad in ("", "a/b/c", "/a", "a/", "a~b", ".a", "x" * 65):
        with pytest.raises(InvalidName):
            registrar_key(bad)
    for bad in ("", "/", "root/", "root//a", "root/a~b"):
        with pytest.raises(InvalidName):
            actor_key(bad)


def test_a_deep_path_has_a_key_of_its_own_that_fits_a_file_name(directory: Directory) -> None:
    keys = {actor_key("/".join(["n" * 64] * 9 + [f"child{number}"])) for number in range(20)}
    assert len(keys) == 20
    for key in keys:
        assert len(key) < 250
        directory.publish(key, "x")
        assert directory.lookup(key) == NameEntry(Presence.UP, "x")


def test_no_entry_is_longer_than_any_file_system_allows(directory: Directory) -> None:
    classes = [f"robots.cameras.Camera{number}" for number in range(200)]
    directory.put_classes("cameras", classes)
    directory.mark(registrar_key("cameras"), Presence.STOPPED, "why " * 1000)
    names = directory.run_dir / "names"
    assert max(len(os.fsencode(os.readlink(path))) for path in names.iterdir()) <= 1023  # XFS
    kept = directory.manager_classes()["cameras"]
    assert kept == classes[: len(kept)]
    assert len(kept) > 20


def test_readers_see_the_old_entry_or_the_new_and_never_none(directory: Directory) -> None:
    directory.publish("r.cameras", "0")
    done = threading.Event()
    problems: list[object] = []

    def read() -> None:
        while not done.is_set():
            entry = directory.lookup("r.cameras")
            if entry is None or (entry.status is Presence.UP and not entry.address.isdigit()):
                problems.append(entry)

    def write(offset: int) -> None:
        for number in range(500):
            directory.publish("r.cameras", str(offset + number))
            directory.mark("r.cameras", Presence.STARTING)

    readers = [threading.Thread(target=read) for _ in range(2)]
    writers = [threading.Thread(target=write, args=(1000 * number,)) for number in range(3)]
    for thread in readers + writers:
        thread.start()
    for thread in writers:
        thread.join()
    done.set()
    for thread in readers:
        thread.join()
    assert not problems
    assert directory.names() == ["r.cameras"]
    assert len(os.listdir(directory.run_dir / "names")) == 1


def test_a_process_killed_while_publishing_leaves_a_whole_entry(directory: Directory) -> None:
    code = """
        import sys
        from rr_actors.wire.name_service import Directory
        directory = Directory(sys.argv[1])
        number = 0
        while True:
            directory.publish("r.cameras", f"address-{number}-end")
            if number == 0:
                print("ready", flush=True)
            number += 1
    """
    for _ in range(5):
        with python(code, directory.run_dir) as process:
            assert line_of(process) == "ready"
            process.send_signal(signal.SIGKILL)
            process.wait()
        entry = directory.lookup("r.cameras")
        assert entry is not None
        assert entry.address.startswith("address-")
        assert entry.address.endswith("-end")


# -- the state directory -------------------------------------------------------------------------------------------


def mode_of(path: Path) -> int:
    return stat.S_IMODE(path.stat().st_mode)


def test_a_registrar_that_is_not_there_is_told_of_with_those_that_are(tmp_path: Path) -> None:
    directory = Directory(tmp_path)
    assert str(directory.no_registrar("cam")).endswith("it has: none")
    directory.publish(registrar_key("cameras"), "a")
    directory.mark(registrar_key("maps"), Presence.STARTING)
    directory.mark(registrar_key("camera"), Presence.GONE)
    directory.publish(actor_key("root/cameras"), "a")

    error = directory.no_registrar("camera")
    assert str(error).endswith(
        "'camera': there is none of this name in the system; did you mean 'cameras'? it has: cameras, maps"
    )
    assert (error.registrar, error.known) == ("camera", ("cameras", "maps"))
    assert "did you mean" not in str(directory.no_registrar("planner"))

    for number in range(20):
        directory.publish(registrar_key(f"arm{number:02}"), "a")
    assert str(directory.no_registrar("planner")).endswith("arm08, arm09, ...")


def test_a_state_directory_is_created_private_with_its_parents(tmp_path: Path) -> None:
    with opened(tmp_path / "a" / "state") as state:
        assert state.path == tmp_path / "a" / "state"
        assert mode_of(state.path) == mode_of(state.path / "run") == mode_of(state.run_dir) == 0o700
        assert mode_of(state.path / "system.lock") == 0o600
        assert len(state.key) == 32
        Directory(state.run_dir).publish("r.x", "y")
        assert mode_of(state.run_dir / "names") == 0o700


def test_a_looser_directory_of_ours_is_tightened(tmp_path: Path) -> None:
    path = tmp_path / "state"
    path.mkdir()
    path.chmod(0o755)
    (path / "run").mkdir(mode=0o777)
    (path / "catalog").mkdir()
    with opened(path):
        assert mode_of(path) == mode_of(path / "run") == 0o700
        assert (path / "catalog").is_dir()


def test_a_relative_path_and_a_link_lead_to_the_same_state_directory(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "link").symlink_to("state")
    with opened(Path("state")) as state:
        assert state.path == tmp_path / "state"
        with pytest.raises(CatalogLocked):
            open_state_dir("link")


def test_each_opening_has_a_new_key_and_a_new_run_directory(tmp_path: Path) -> None:
    with opened(tmp_path) as first:
        pass
    with opened(tmp_path) as second:
        assert second.key != first.key
        assert second.run_dir != first.run_dir


def test_closing_removes_what_only_a_living_system_needs_and_may_be_repeated(tmp_path: Path) -> None:
    with opened(tmp_path) as state:
        (tmp_path / "cameras").mkdir()
        Directory(state.run_dir).publish("r.cameras", "x")
    state.close()
    assert sorted(path.name for path in tmp_path.iterdir()) == ["cameras", "system.lock"]


def test_a_second_system_in_the_same_process_is_refused_with_the_pid(tmp_path: Path) -> None:
    with opened(tmp_path) as first:
        Directory(first.run_dir).publish("r.cameras", "x")
        with pytest.raises(CatalogLocked, match=rf"by a system of this same process \(pid {os.getpid()}\)") as caught:
            open_state_dir(tmp_path)
        assert caught.value.details == {"path": str(tmp_path), "pid": os.getpid()}
        assert Directory(first.run_dir).lookup("r.cameras") == NameEntry(Presence.UP, "x")
    with opened(tmp_path):
        pass


HOLD = """
    import sys, time
    from rr_actors.wire.name_service import Directory, open_state_dir
    state = open_state_dir(sys.argv[1])
    Directory(state.run_dir).publish("r.cameras", "x")
    print(state.run_dir, flush=True)
    sys.stdin.read()
"""


def test_a_system_of_another_process_is_named_and_its_death_by_sigkill_frees_the_directory(tmp_path: Path) -> None:
    with subprocess.Popen(
        [sys.executable, "-c", textwrap.dedent(HOLD), str(tmp_path)],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        cwd=Path(__file__).parents[2],
    ) as process:
        run_dir = Path(line_of(process))
        with pytest.raises(CatalogLocked) as caught:
            open_state_dir(tmp_path)
        assert caught.value.details["pid"] == process.pid
        process.kill()
        process.wait()
    assert run_dir.exists()
    with opened(tmp_path) as state:
        assert not run_dir.exists()
        assert list((tmp_path / "run").iterdir()) == [state.run_dir]
        assert (tmp_path / "system.lock").read_text() == f"{os.getpid()}\n"


def test_a_straggler_of_a_dead_system_cannot_publish_to_the_next(tmp_path: Path) -> None:
    with opened(tmp_path) as dead:
        straggler = Directory(dead.run_dir)
        straggler.publish("r.cameras", "old")
    with opened(tmp_path) as living:
        with pytest.raises(ConfigError):
            straggler.publish("r.cameras", "old")
        assert Directory(living.run_dir).lookup("r.cameras") is None


def test_a_directory_of_another_user_is_refused_and_left_as_it_is(tmp_path: Path) -> None:
    path = Path("/")  # root's
    if os.geteuid() == 0:
        path = tmp_path / "theirs"
        path.mkdir(mode=0o755)
        os.chown(path, 65534, 65534)
    before = mode_of(path)
    with pytest.raises(ConfigError, match="belongs to user") as caught:
        open_state_dir(path)
    assert caught.value.details["key"] == "state_dir"
    assert caught.value.details["file"] == str(path)
    assert mode_of(path) == before
    assert not (path / "system.lock").exists()


def test_a_directory_shared_by_all_users_is_refused_and_left_as_it_is(tmp_path: Path) -> None:
    path = tmp_path / "tmp"
    path.mkdir()
    path.chmod(0o1777)
    with pytest.raises(ConfigError, match="shared by all users"):
        open_state_dir(path)
    assert mode_of(path) == 0o1777


@pytest.mark.parametrize("inside", ["main.py", "robot/main.py"])
def test_of_a_directory_with_files_that_are_no_systems_the_log_warns(
    tmp_path: Path, inside: str, caplog: pytest.LogCaptureFixture
) -> None:
    file = tmp_path / "project" / inside
    file.parent.mkdir(parents=True)
    file.write_text("mine")
    for _ in range(2):  # the second time a system has used it
        with opened(tmp_path / "project"):
            pass
    [warning] = [record.getMessage() for record in caplog.records if record.levelname == "WARNING"]
    assert warning.startswith(f"state directory {tmp_path / 'project'}: it has files of others")
    assert repr(inside.partition("/")[0]) in warning
    assert file.read_text() == "mine"


@pytest.mark.parametrize(
    "there", [[".git/config", "lost+found/1"], ["system.lock", "notes.txt"], ["cameras/catalog.sqlite3", "notes.txt"]]
)
def test_a_directory_that_a_system_has_used_or_could_be_new_is_used_without_a_word(
    tmp_path: Path, there: list[str], caplog: pytest.LogCaptureFixture
) -> None:
    for name in there:
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).touch()
    with opened(tmp_path):
        pass
    assert [record for record in caplog.records if record.levelname == "WARNING"] == []


def test_a_directory_that_cannot_be_written_is_a_config_error_naming_it(tmp_path: Path) -> None:
    closed = tmp_path / "closed"
    closed.mkdir()
    closed.chmod(0o500)
    with as_somebody_else(closed):
        for path in (closed, closed / "state"):
            with pytest.raises(ConfigError, match="Permission denied") as caught:
                open_state_dir(path)
            assert str(closed) in str(caught.value)
            assert str(caught.value).endswith(": make it writable, or choose another state_dir")
    closed.chmod(0o700)


def test_a_run_directory_that_cannot_be_read_is_a_config_error_naming_it(tmp_path: Path) -> None:
    state, run = tmp_path / "state", tmp_path / "state" / "run"
    run.mkdir(parents=True, mode=0o700)
    with as_somebody_else(state, run):
        run.chmod(0)
        with pytest.raises(ConfigError, match=f"cannot use {run}: Permission denied: make it writable") as caught:
            open_state_dir(state)
        run.chmod(0o700)
    assert caught.value.file == str(run)


def test_in_the_run_directory_only_what_a_dead_system_left_is_removed(tmp_path: Path) -> None:
    run = tmp_path / "run"
    (run / "0123abcd" / "names").mkdir(parents=True)
    (run / "catalog.sqlite3").write_text("a registrar's that is called run")
    for _ in range(2):
        with opened(tmp_path):
            pass
    assert [entry.name for entry in run.iterdir()] == ["catalog.sqlite3"]


def test_of_what_a_dead_system_left_links_go_and_what_they_lead_to_stays(tmp_path: Path) -> None:
    run, elsewhere = tmp_path / "run", tmp_path / "elsewhere"
    elsewhere.mkdir()
    (elsewhere / "file").write_text("x")
    left = run / "0123abcd"
    (left / "names").mkdir(parents=True)
    (left / "names" / "r.cameras").symlink_to("up:4711-0a1b.sock")
    (left / "to_directory").symlink_to(elsewhere)
    (left / "to_file").symlink_to(elsewhere / "file")
    os.mkfifo(left / "pipe")
    (run / "4567abcd").symlink_to(elsewhere)
    with opened(tmp_path):
        assert len(list(run.iterdir())) == 1  # its own
    assert (elsewhere / "file").read_text() == "x"


def test_a_catalog_that_may_not_be_looked_for_is_named_by_who_reads_the_state_directory(tmp_path: Path) -> None:
    closed = tmp_path / "state" / "app"
    closed.mkdir(parents=True)
    with as_somebody_else(tmp_path / "state", closed):
        closed.chmod(0)
        found = read_state(tmp_path / "state")
        closed.chmod(0o700)
    assert list(found) == ["app"]
    assert "Permission denied" in found["app"].damage


@pytest.mark.parametrize(
    ("inside", "told"),
    [
        ("", "file: it is a file, not a directory: choose another state_dir"),
        ("state", "state: Not a directory: {file} is a file; choose another state_dir"),
        ("a/b", "a/b: Not a directory: {file} is a file; choose another state_dir"),
    ],
)
def test_a_file_in_its_place_is_a_config_error_naming_it(tmp_path: Path, inside: str, told: str) -> None:
    file = tmp_path / "file"
    file.write_text("mine")
    with pytest.raises(ConfigError) as caught:
        open_state_dir(file / inside)
    assert str(caught.value).endswith(told.format(file=file))
    assert file.read_text() == "mine"


def test_a_path_that_is_too_long_is_a_config_error_that_says_what_helps(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="File name too long: choose a shorter state_dir"):
        open_state_dir(tmp_path / ("x" * 300))


def test_a_lock_file_that_is_a_link_is_not_followed(tmp_path: Path) -> None:
    (tmp_path / "precious").write_text("mine")
    (tmp_path / "system.lock").symlink_to("precious")
    with pytest.raises(ConfigError, match=r"system\.lock"):
        open_state_dir(tmp_path)
    assert (tmp_path / "precious").read_text() == "mine"


def test_a_failed_opening_gives_the_lock_back(tmp_path: Path) -> None:
    (tmp_path / "run").write_text("in the way")
    with pytest.raises(ConfigError, match="run"):
        open_state_dir(tmp_path)
    (tmp_path / "run").unlink()
    with opened(tmp_path):
        pass
