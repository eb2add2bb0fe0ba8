"""A backup has the catalogs of all registrars at one moment, whatever happens meanwhile; restore() brings them back."""

from __future__ import annotations

import os
import random
import shutil
import signal
import stat
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import msgspec
import pytest

import rr_actors as rr
from rr_actors.base.errors import CatalogDamaged, CatalogVersion, ConfigError, RegistrarDown, UsageError
from rr_actors.registrar.engine import cut
from rr_actors.storage.opening import read_rows
from rr_actors.system import backups
from rr_actors.tools.inspection import check, check_state, read_state
from support import LIMIT_S, eventually, hang, kill, pid_of, wait_respawned
from support_cli import run_cli


class Parts(rr.Manager):
    @rr.server("part", recovery="keep")
    def load(self, request: str) -> str:
        return request

    @load.unload
    def unload(self, request: str, response: str) -> None:
        """Nothing outside is to be undone."""


class Wholes(rr.Manager):
    @rr.server("whole", recovery="keep")
    def load(self, request: str) -> str:
        return self.registrar.load("parts/part", request).response

    @load.unload
    def unload(self, request: str, response: str) -> None:
        """Its part is released by its registrar."""


class Tops(rr.Manager):
    @rr.server("top", recovery="keep")
    def load(self, request: str) -> str:
        return self.registrar.load("wholes/whole", request).response

    @load.unload
    def unload(self, request: str, response: str) -> None:
        """Its part is released by its registrar."""


TREE = [rr.ChildSpec(Parts, id="parts"), rr.ChildSpec(Wholes, id="wholes"), rr.ChildSpec(Tops, id="tops")]
NAMES = {"parts", "wholes", "tops", "app"}


@pytest.fixture
def running(state_dir: Path) -> Iterator[rr.System]:
    with rr.System(TREE, state_dir=state_dir) as system:
        yield system


class Load:
    """Loads and unloads of several threads.

    Attributes:
        kept: the queries whose loads have returned, and whose unloads have not begun.
        failures: what failed.
        slowest_s: the longest load.
    """

    def __init__(self, app: rr.Registrar) -> None:
        self._app = app
        self._over = threading.Event()
        self.kept: set[str] = set()
        self.failures: list[Exception] = []
        self.slowest_s = 0.0
        self.count = 0
        self._threads = [threading.Thread(target=self._run, args=(number,)) for number in range(3)]

    def __enter__(self) -> Load:
        for thread in self._threads:
            thread.start()
        return self

    def __exit__(self, *exc: object) -> None:
        self._over.set()
        for thread in self._threads:
            thread.join(LIMIT_S)
        assert not self.failures

    def _run(self, number: int) -> None:
        chosen = random.Random(number)
        mine: list[rr.Query] = []
        try:
            while not self._over.is_set():
                began = time.monotonic()
                mine.append(self._app.load("tops/top", f"{number}-{chosen.randrange(8)}"))
                self.slowest_s = max(self.slowest_s, time.monotonic() - began)
                self.kept.add(mine[-1].id)
                self.count += 1
                if len(mine) > chosen.randrange(20):
                    query = mine.pop(chosen.randrange(len(mine)))
                    self.kept.discard(query.id)
                    query.unload()
        except Exception as error:
            self.failures.append(error)


def rows_of(directory: Path) -> dict[str, set[Any]]:
    return {name: set(read_rows(directory / name / "catalog.sqlite3")) for name in NAMES}


# -- the moment --------------------------------------------------------------------------------------------------------


def test_a_backup_has_the_rows_that_the_catalogs_have(running: rr.System, state_dir: Path, tmp_path: Path) -> None:
    app = running.open_registrar("app")
    for number in range(5):
        app.load("tops/top", f"{number}")
    app.load("tops/top", "gone").unload()
    eventually(lambda: len(running.registrar("parts").resources()) == 5)
    for name in NAMES - {"app"}:
        running.registrar(name).save_catalog()
    app.save_catalog()

    backup = running.backup(tmp_path / "backup")

    assert set(backup.registrars) == NAMES
    assert rows_of(tmp_path / "backup" / "catalogs") == rows_of(state_dir)


def test_what_was_loaded_under_load_is_there_agrees_and_can_be_unloaded(
    running: rr.System, state_dir: Path, tmp_path: Path
) -> None:
    app = running.open_registrar("app")
    promised: list[set[str]] = []
    with Load(app) as load:
        for number in range(3):
            eventually(lambda wanted=load.count + 30: load.count >= wanted)
            before = set(load.kept)
            running.backup(tmp_path / f"backup-{number}")
            promised.append(before & load.kept)
    running.stop()

    for number, kept in enumerate(promised):
        state = tmp_path / f"state-{number}"
        rr.System.restore(tmp_path / f"backup-{number}", state)
        assert check_state(state) == [], "the catalogs are of one moment"
        with rr.System(TREE, state_dir=state) as system:
            again = system.open_registrar("app")
            queries = again.queries()
            assert kept <= {query.id for query in queries}
            assert {query.state for query in queries} <= {rr.State.OK}
            again.unload_all()
            assert again.queries() == []
            eventually(lambda system=system: not system.registrar("parts").resources())


def test_backups_while_managers_are_killed_agree_each(state_dir: Path, tmp_path: Path) -> None:
    """RR_MANY=80: so many backups, with a SIGKILL after every second one."""
    chosen = random.Random(1)
    tree = rr.Supervisor(TREE, max_restarts=1000)
    with rr.System(tree, state_dir=state_dir) as system, Load(system.open_registrar("app")) as load:
        for number in range(int(os.environ.get("RR_MANY", "4"))):
            eventually(lambda wanted=load.count + 5: load.count >= wanted)
            if number % 2:
                kill(system, chosen.choice(["parts", "wholes", "tops"]))
            system.backup(tmp_path / "backup")
            assert check(read_state(tmp_path / "backup" / "catalogs")) == []
            shutil.rmtree(tmp_path / "backup")


def test_a_load_in_flight_does_not_keep_a_backup_waiting_and_is_not_lost_track_of(
    running: rr.System, tmp_path: Path
) -> None:
    loading, go_on = threading.Event(), threading.Event()

    def slowly(request: str) -> str:
        loading.set()
        go_on.wait(LIMIT_S)
        return request

    app = running.open_registrar("app")
    app.register_server("slow", slowly, recovery="keep")
    reply = app.load("app/slow", "x", block=False)
    assert loading.wait(LIMIT_S)
    try:
        running.backup(tmp_path / "backup")
    finally:
        go_on.set()
    reply.get(timeout=LIMIT_S)
    running.stop()

    rr.System.restore(tmp_path / "backup", tmp_path / "new")
    with rr.System(TREE, state_dir=tmp_path / "new") as system:
        again = system.open_registrar("app")
        again.register_server("slow", lambda request: request, recovery="keep")
        again.unload_all()
        eventually(lambda: not again.resources() and not again.queries())


def test_backups_at_the_same_time_come_one_after_another(running: rr.System, tmp_path: Path) -> None:
    running.open_registrar("app").load("tops/top", "x")
    made: list[object] = []

    def back_up(number: int) -> None:
        made.append(running.backup(tmp_path / f"backup-{number}"))

    threads = [threading.Thread(target=back_up, args=(number,)) for number in range(3)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(LIMIT_S)
    assert len(made) == 3


# -- what happens meanwhile --------------------------------------------------------------------------------------------


def at_first_go(monkeypatch: pytest.MonkeyPatch, do: Callable[[], object]) -> None:
    """Have `do` called once while all registrars hold still."""
    go, done = backups.Barrier.go, threading.Event()

    def do_and_go(self: Any) -> float:
        if not done.is_set():
            done.set()
            do()
        return go(self)

    monkeypatch.setattr(backups.Barrier, "go", do_and_go)


def test_a_manager_that_is_killed_while_all_hold_still_only_delays_the_backup(
    running: rr.System, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    app = running.open_registrar("app")
    app.load("tops/top", "x")
    at_first_go(monkeypatch, lambda: kill(running, "wholes"))

    running.backup(tmp_path / "backup")

    assert check_state(tmp_path / "backup" / "catalogs") == []
    assert app.load("tops/top", "y").response == "y"
    assert [path.name for path in tmp_path.glob("*backup*")] == ["backup"]


def test_a_process_that_does_not_answer_is_named_and_nobody_waits_for_it(running: rr.System, tmp_path: Path) -> None:
    app = running.open_registrar("app")
    app.load("wholes/whole", "x")
    pid = pid_of(running, "tops")
    hang(pid)
    try:
        with pytest.raises(RegistrarDown, match=r"no backup was made: registrar 'tops': its process has not answered"):
            running.backup(tmp_path / "backup", timeout_s=0.5)
        began = time.monotonic()
        app.load("wholes/whole", "y")
        assert time.monotonic() - began < cut.HOLD_S, "nothing holds still any more"
    finally:
        os.kill(pid, signal.SIGCONT)
    assert list(tmp_path.glob("*backup*")) == []

    running.backup(tmp_path / "backup")


def test_a_process_that_stops_while_the_others_hold_still_does_not_keep_them(
    running: rr.System, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    app = running.open_registrar("app")
    pid = pid_of(running, "tops")
    monkeypatch.setattr(backups, "HOLD_S", 1.0)
    hear = cut.hear
    waiting = threading.Event()

    def stopped_then(line: Any, expected: bytes) -> None:
        if expected == cut.HOLD:
            os.kill(pid, signal.SIGSTOP)
            waiting.set()
        hear(line, expected)

    monkeypatch.setattr(cut, "hear", stopped_then)  # in this process, for the registrar of the application
    try:
        with pytest.raises(RegistrarDown, match="registrar 'tops'"):
            running.backup(tmp_path / "backup", timeout_s=3.0)
        assert waiting.is_set()
        app.load("wholes/whole", "y", timeout_s=LIMIT_S)
    finally:
        os.kill(pid, signal.SIGCONT)


def test_an_asker_that_hangs_holds_nobody_for_longer_than_the_limit(
    running: rr.System, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    app = running.open_registrar("app")
    app.load("tops/top", "x")
    holding, loaded = threading.Event(), threading.Event()

    def hang() -> None:
        holding.set()
        assert loaded.wait(cut.HOLD_S + LIMIT_S), "each process has given its turns back by itself"

    at_first_go(monkeypatch, hang)
    thread = threading.Thread(target=running.backup, args=(tmp_path / "backup",))
    thread.start()
    assert holding.wait(LIMIT_S)
    app.load("tops/top", "y", timeout_s=cut.HOLD_S + LIMIT_S)
    loaded.set()
    thread.join(LIMIT_S)
    assert (tmp_path / "backup").is_dir(), "it is tried again"


def test_a_backup_that_is_interrupted_holds_nobody_and_leaves_nothing(
    running: rr.System, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    app = running.open_registrar("app")

    def interrupt() -> None:
        raise KeyboardInterrupt

    at_first_go(monkeypatch, interrupt)
    with pytest.raises(KeyboardInterrupt):
        running.backup(tmp_path / "backup")
    began = time.monotonic()
    app.load("tops/top", "y")
    assert time.monotonic() - began < cut.HOLD_S
    assert list(tmp_path.glob("*backup*")) == []


KILLED = """
import os, signal, sys
from pathlib import Path
import rr_actors as rr
import test_backups as tests
from rr_actors.system import backups

if __name__ == "__main__":
    with rr.System(tests.TREE, state_dir=sys.argv[1]) as system:
        system.open_registrar("app").load("tops/top", "x")
        backups.Barrier.go = lambda self: os.kill(os.getpid(), signal.SIGKILL)
        system.backup(sys.argv[2])
"""


def test_an_application_that_is_killed_while_all_hold_still_leaves_no_backup_and_no_damage(
    state_dir: Path, tmp_path: Path
) -> None:
    program = tmp_path / "killed.py"
    program.write_text(KILLED)
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}
    ended = subprocess.run(
        [sys.executable, program, state_dir, tmp_path / "backup"], env=environment, timeout=60, check=False
    )
    assert ended.returncode == -signal.SIGKILL
    assert not (tmp_path / "backup").exists()
    with rr.System(TREE, state_dir=state_dir) as system:
        app = system.open_registrar("app")
        assert [query.response for query in app.queries()] == ["x"]
        app.unload_all()


def test_a_manager_that_comes_back_from_its_catalog_is_waited_for(running: rr.System, tmp_path: Path) -> None:
    app = running.open_registrar("app")
    app.load("tops/top", "x")
    pid = kill(running, "parts")
    running.backup(tmp_path / "backup")
    wait_respawned(running, "parts", pid)
    assert check_state(tmp_path / "backup" / "catalogs") == []


def test_what_nobody_has_open_is_in_the_backup(state_dir: Path, tmp_path: Path) -> None:
    with rr.System(TREE, state_dir=state_dir) as system:
        app = system.open_registrar("app")
        app.load("tops/top", "x")
        app.save_catalog()
        shutil.copytree(state_dir / "app", tmp_path / "app")
    # the application of a system that was killed: its catalog is there, and nobody opens it
    shutil.rmtree(state_dir, ignore_errors=True)
    shutil.copytree(tmp_path / "app", state_dir / "app")
    with rr.System(TREE, state_dir=state_dir) as system:
        assert system.dormant() == ["app"]
        backup = system.backup(tmp_path / "backup")
    assert backup.registrars["app"].rows["held"] == 1


# -- the directory of a backup, and where it comes back ----------------------------------------------------------------


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A backup of three managers and an application, with one resource each and a file of a manager's own."""
    place = tmp_path_factory.mktemp("made")
    state = place / "state"
    with rr.System(TREE, state_dir=state) as system:
        system.open_registrar("app").load("tops/top", "x")
        (state / "parts" / "own.json").write_text("{}")
        (state / ".kept").mkdir()
        (state / ".kept" / "child").write_text("args")
        system.backup(place / "backup")
    return place / "backup"


@pytest.fixture
def backup(made: Path, tmp_path: Path) -> Path:
    """A copy of that backup, which a test may damage."""
    return shutil.copytree(made, tmp_path / "backup")


def test_a_backup_is_private_and_sha256sum_can_check_it(backup: Path) -> None:
    for path in (backup, *backup.rglob("*")):
        assert stat.S_IMODE(path.stat().st_mode) == (0o700 if path.is_dir() else 0o600)
    checked = subprocess.run(["sha256sum", "--strict", "-c", "SHA256SUMS"], cwd=backup, capture_output=True, check=True)
    assert b"catalogs/parts/own.json: OK" in checked.stdout


def test_files_beside_a_catalog_and_records_of_the_state_directory_come_back(backup: Path, tmp_path: Path) -> None:
    rr.System.restore(backup, tmp_path / "new")
    assert (tmp_path / "new" / "parts" / "own.json").read_text() == "{}"
    assert (tmp_path / "new" / ".kept" / "child").read_text() == "args"
    assert stat.S_IMODE((tmp_path / "new").stat().st_mode) == 0o700


@pytest.mark.parametrize("name", ["manifest.json", "SHA256SUMS"])
def test_each_damaged_byte_is_noticed_and_nothing_is_made(backup: Path, tmp_path: Path, name: str) -> None:
    good = (backup / name).read_bytes()
    for at in range(len(good)):
        (backup / name).write_bytes(good[:at] + bytes([good[at] ^ 1 << at % 8]) + good[at + 1 :])
        with pytest.raises(CatalogDamaged):
            rr.System.restore(backup, tmp_path / "new")
        assert not (tmp_path / "new").exists()
    for length in range(0, len(good), 7):
        (backup / name).write_bytes(good[:length])
        with pytest.raises(CatalogDamaged):
            rr.System.restore(backup, tmp_path / "new")


def test_a_damaged_or_missing_file_is_named_and_nothing_is_made(backup: Path, tmp_path: Path) -> None:
    for path in sorted(path for path in backup.glob("*/**/*") if path.is_file()):
        good = path.read_bytes()
        for bad in (good[:-1], good[:-1] + bytes([good[-1] ^ 1]), None):
            path.unlink() if bad is None else path.write_bytes(bad)
            with pytest.raises(CatalogDamaged, match="nothing is restored") as caught:
                rr.System.restore(backup, tmp_path / "new")
            assert caught.value.path == str(path)
            assert list(tmp_path.glob("*new*")) == []
        path.write_bytes(good)
        path.chmod(0o600)
    rr.System.restore(backup, tmp_path / "new")


def rewrite_manifest(backup: Path, **changes: object) -> None:
    path = backup / "manifest.json"
    path.write_bytes(msgspec.json.encode(msgspec.json.decode(path.read_bytes()) | changes))
    sums = (backup / "SHA256SUMS").read_text().splitlines(keepends=True)
    (backup / "SHA256SUMS").write_text("".join([backups.sum_line(path, "manifest.json"), *sums[1:]]))


@pytest.mark.parametrize("key", ["format", "schema"])
def test_a_backup_of_a_newer_version_is_refused_by_name(backup: Path, tmp_path: Path, key: str) -> None:
    rewrite_manifest(backup, **{key: 1000, "version": "9.9"})
    with pytest.raises(CatalogVersion, match=r"got one of 9\.9"):
        rr.System.restore(backup, tmp_path / "new")


@pytest.mark.parametrize("file", ["catalogs/../../own", "/etc/own", "own", "state/x/../../../own", "catalogs/.."])
def test_a_manifest_that_leads_elsewhere_is_refused(backup: Path, tmp_path: Path, file: str) -> None:
    rewrite_manifest(backup, files={file: 1})
    with pytest.raises(CatalogDamaged, match="files of a backup alone"):
        rr.System.restore(backup, tmp_path / "new")


def test_a_directory_that_is_no_backup_is_refused(tmp_path: Path) -> None:
    for place in (tmp_path / "nothing", tmp_path):
        with pytest.raises(ConfigError, match="expected a backup"):
            rr.System.restore(place, tmp_path / "new")


def test_a_directory_with_something_in_it_is_refused_and_left_as_it_is(
    running: rr.System, backup: Path, tmp_path: Path
) -> None:
    full = tmp_path / "full"
    full.mkdir()
    (full / "mine").write_text("x")
    file = tmp_path / "file"
    file.write_text("x")
    for place in (full, file):
        with pytest.raises(ConfigError, match="expected a"):
            running.backup(place)
        with pytest.raises(ConfigError, match="expected a"):
            rr.System.restore(backup, place)
    assert [path.name for path in full.iterdir()] == ["mine"]
    empty = tmp_path / "empty"
    empty.mkdir()
    running.backup(empty)
    assert (empty / "manifest.json").exists()


def test_a_system_that_does_not_run_cannot_be_backed_up_by_itself(state_dir: Path, tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="not running"):
        rr.System(TREE, state_dir=state_dir).backup(tmp_path / "backup")


def placed(elsewhere: Path) -> rr.SystemConfig:
    return rr.SystemConfig(registrars={"parts": rr.RegistrarConfig(location=elsewhere)})


def test_a_catalog_with_a_location_of_its_own_goes_back_there(state_dir: Path, tmp_path: Path) -> None:
    elsewhere, other = tmp_path / "disk", tmp_path / "other"
    with rr.System(TREE, state_dir=state_dir, config=placed(elsewhere)) as system:
        system.open_registrar("app").load("tops/top", "x")
        backup = system.backup(tmp_path / "backup")
    assert backup.registrars["parts"].location == str(elsewhere)

    with pytest.raises(ConfigError, match="expected a location of parts without a catalog"):
        rr.System.restore(tmp_path / "backup", tmp_path / "new")
    assert not (tmp_path / "new").exists()
    with pytest.raises(ConfigError, match="expected registrars of the backup"):
        rr.System.restore(tmp_path / "backup", tmp_path / "new", locations={"nobody": other})

    rr.System.restore(tmp_path / "backup", tmp_path / "second", locations={"parts": other})
    shutil.rmtree(elsewhere)
    rr.System.restore(tmp_path / "backup", tmp_path / "new")

    for state, place in ((tmp_path / "new", elsewhere), (tmp_path / "second", other)):
        with rr.System(TREE, state_dir=state, config=placed(place)) as system:
            app = system.open_registrar("app")
            assert [query.state for query in app.queries()] == [rr.State.OK]
            app.unload_all()
            eventually(lambda system=system: not system.registrar("parts").resources())


def test_a_restore_that_fails_takes_back_what_it_put_elsewhere(
    state_dir: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    elsewhere = tmp_path / "disk"
    with rr.System(TREE, state_dir=state_dir, config=placed(elsewhere)) as system:
        system.open_registrar("app").load("tops/top", "x")
        system.backup(tmp_path / "backup")
    shutil.rmtree(elsewhere)

    def refuse(_old: object, new: object) -> None:
        raise OSError(28, os.strerror(28), str(new))

    monkeypatch.setattr(backups.os, "rename", refuse)
    with pytest.raises(ConfigError, match="No space left"):
        rr.System.restore(tmp_path / "backup", tmp_path / "new")
    assert list(elsewhere.iterdir()) == []
    assert list(tmp_path.glob("*new*")) == []


class Port(rr.Manager):
    def __init__(self, device: str) -> None:
        self._device = device

    @rr.server("port", recovery="keep")
    def load(self, request: str) -> str:
        return f"{self._device} {request}"


def test_dynamic_children_with_an_id_come_back_with_what_they_serve(state_dir: Path, tmp_path: Path) -> None:
    pool = rr.Supervisor([rr.ChildSpec(Port, id="port")], id="pool", strategy="simple_one_for_one")
    with rr.System([pool], state_dir=state_dir) as system:
        system.supervisor("pool").start_child(["/dev/ttyS0"], id="ttyS0")
        system.open_registrar("app").load("ttyS0/port", "x")
        system.backup(tmp_path / "backup")
    rr.System.restore(tmp_path / "backup", tmp_path / "new")
    with rr.System([pool], state_dir=tmp_path / "new") as system:
        app = system.open_registrar("app")
        assert [(query.response, query.state) for query in app.queries()] == [("/dev/ttyS0 x", rr.State.OK)]
        assert app.load("ttyS0/port", "y").response == "/dev/ttyS0 y"
        app.unload_all()


def test_a_manager_that_was_renamed_since_has_what_it_had(backup: Path, tmp_path: Path) -> None:
    rr.System.restore(backup, tmp_path / "new")
    tree = [rr.ChildSpec(Parts, id="pieces", renamed_from="parts"), *TREE[1:]]
    with rr.System(tree, state_dir=tmp_path / "new") as system:
        assert len(system.registrar("pieces").resources()) == 1


# -- from the command line, and from another program -------------------------------------------------------------------


def test_the_commands_back_a_running_system_up_and_bring_it_back(
    running: rr.System, state_dir: Path, tmp_path: Path
) -> None:
    running.open_registrar("app").load("tops/top", "x")
    said = run_cli("backup", tmp_path / "backup", "--state", state_dir)
    assert said.returncode == 0, said.stderr
    assert "4 catalogs" in said.stdout
    again = run_cli("backup", tmp_path / "backup", "--state", state_dir)
    assert (again.returncode, "expected a new or an empty directory" in again.stderr) == (2, True)
    dry = run_cli("backup", tmp_path / "dry", "--dry-run", "--state", state_dir)
    assert (dry.returncode, (tmp_path / "dry").exists()) == (0, False)

    back = run_cli("restore", tmp_path / "backup", "--state", tmp_path / "new", "--json")
    assert back.returncode == 0, back.stderr
    assert msgspec.json.decode(back.stdout)["catalogs"] == 4
    assert run_cli("check", tmp_path / "new").stdout.startswith("4 catalogs")
    assert run_cli("restore", tmp_path / "backup", "--state", tmp_path / "new").returncode == 2
    assert run_cli("restore", tmp_path / "backup", "--state", tmp_path / "x", "--location", "parts").returncode == 2


def test_a_connected_program_has_the_system_back_itself_up(running: rr.System, state_dir: Path, tmp_path: Path) -> None:
    running.open_registrar("app").load("tops/top", "x")
    with rr.connect(state_dir) as connection:
        backup = connection.backup(tmp_path / "backup")
        with pytest.raises(ConfigError, match="expected a new or an empty directory"):
            connection.backup(tmp_path / "backup")
    assert set(backup.registrars) == NAMES


def test_the_state_of_a_system_that_does_not_run_is_backed_up_from_its_files(state_dir: Path, tmp_path: Path) -> None:
    elsewhere = tmp_path / "disk"
    with rr.System(TREE, state_dir=state_dir, config=placed(elsewhere)) as system:
        system.open_registrar("app").load("tops/top", "x")
        shutil.copytree(state_dir, tmp_path / "killed", ignore=shutil.ignore_patterns("run", "system.lock"))
        shutil.copytree(elsewhere, tmp_path / "kept")
    shutil.rmtree(elsewhere)
    shutil.copytree(tmp_path / "kept", elsewhere)  # as a SIGKILL would have left it

    said = run_cli("backup", tmp_path / "backup", "--state", tmp_path / "killed")
    assert said.returncode == 0, said.stderr
    assert "4 catalogs" in said.stdout
    shutil.rmtree(elsewhere)
    rr.System.restore(tmp_path / "backup", tmp_path / "new")
    with rr.System(TREE, state_dir=tmp_path / "new", config=placed(elsewhere)) as system:
        app = system.open_registrar("app")
        assert [query.state for query in app.queries()] == [rr.State.OK]
        app.unload_all()

    assert run_cli("backup", tmp_path / "other", "--state", tmp_path / "nothing").returncode == 2
    assert not (tmp_path / "nothing").exists()
