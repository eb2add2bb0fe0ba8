"""Managers that a dynamic supervisor was given with ids: they, their catalogs and their holders outlive every crash."""

from __future__ import annotations

import os
import pickle
import signal
import subprocess
import sys
import textwrap
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

import rr_actors as rr
from rr_actors.base.config import RegistrarConfig, SystemConfig
from rr_actors.base.errors import AlreadyStarted, CatalogDamaged, InvalidSpec, NameTaken, NotFound, StartFailed
from rr_actors.storage.child_records import ChildRecords
from support import LIMIT_S, TEST_PATHS, Workshop, child, eventually, kill
from support_managers import Order, Shop

Start = Callable[..., rr.System]
THING = Order("lamp")


def pool(*, placement: Any = "thread", shutdown_s: float = 5.0) -> rr.Supervisor:
    template = rr.ChildSpec(Shop, id="shop", shutdown_s=shutdown_s)
    return rr.Supervisor([template], id="pool", strategy="simple_one_for_one", placement=placement)


def tree(**options: Any) -> rr.Supervisor:
    return rr.Supervisor([pool(**options)])


def state_of(system: rr.System, id: str) -> str:
    """The state of a child of the pool; "" while the pool does not answer, or has none of this id."""
    try:
        return system.supervisor("pool").which_child(id).state
    except (rr.ActorUnavailable, NotFound):
        return ""


def running(system: rr.System, id: str, *, not_: int | None = None) -> int:
    """The process of a child of the pool that runs, in another process than before."""

    def pid() -> int:
        try:
            child = system.supervisor("pool").which_child(id)
        except (rr.ActorUnavailable, NotFound):  # the pool is being started again
            return 0
        now = child.pid if child.state == "running" else None
        return 0 if now is None or now == not_ else now

    return eventually(pid, 2 * LIMIT_S, f"{id} runs in another process than {not_}")


def holds(app: rr.Registrar, system: rr.System, id: str = "ttyS0") -> bool:
    """Whether the application and the manager agree on one resource, which the application holds."""
    mine = [query.resource_id for query in app.queries()]
    return len(mine) == 1 and mine == [resource.id for resource in system.registrar(id).resources()]


@pytest.fixture
def args(workshop: Workshop) -> list[str]:
    return [str(workshop.root)]


# -- crashes ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("placement", ["thread", "process"])
def test_it_keeps_path_catalog_and_holders_over_its_own_crash_and_its_supervisors(
    start: Start, workshop: Workshop, args: list[str], placement: str
) -> None:
    system = start(tree(placement=placement))
    ref = system.supervisor("pool").start_child(args, id="ttyS0")
    assert ref is not None
    assert ref.path == "root/pool/ttyS0"
    app = system.open_registrar("app")
    query = app.load("ttyS0/thing", THING)

    pid = running(system, "ttyS0")
    os.kill(pid, signal.SIGKILL)
    running(system, "ttyS0", not_=pid)
    eventually(lambda: holds(app, system))

    pid = running(system, "ttyS0")
    if placement == "process":
        kill(system, "pool")
    else:
        system.supervisor().terminate_child("pool")
        assert state_of(system, "ttyS0") == ""
        system.supervisor().restart_child("pool")
    running(system, "ttyS0", not_=pid)
    eventually(lambda: holds(app, system))
    assert query.state is rr.State.OK
    assert system.dormant() == []
    assert workshop.lines("unload") == []


def test_it_comes_back_when_its_supervisor_has_given_up_because_of_it(start: Start, args: list[str]) -> None:
    template = rr.ChildSpec(Shop, id="shop")
    inner = rr.Supervisor([template], id="pool", strategy="simple_one_for_one", max_restarts=0)
    system = start(rr.Supervisor([inner]))
    system.supervisor("pool").start_child(args, id="ttyS0")
    app = system.open_registrar("app")
    app.load("ttyS0/thing", THING)
    pid = running(system, "ttyS0")
    os.kill(pid, signal.SIGKILL)
    running(system, "ttyS0", not_=pid)
    eventually(lambda: holds(app, system))


def killed(state_dir: Path, workshop: Workshop, *parts: str, **tree: Any) -> None:
    """Run a program with a system and its pool, which does these parts and kills itself."""
    program = f"""
        import os, signal, threading
        import rr_actors as rr
        from support import Workshop
        from support_managers import Order, Shop
        from test_kept_children import pool, running

        def die():
            os.kill(os.getpid(), signal.SIGKILL)

        if __name__ == "__main__":
            work = Workshop({str(workshop.root)!r})
            args = [str(work.root)]
            system = rr.System([pool(**{tree!r})], state_dir={str(state_dir)!r}).start()
            ports = system.supervisor("pool")
    """
    body = "".join(textwrap.indent(textwrap.dedent(part), "    ") for part in (*parts, "die()"))
    text = textwrap.dedent(program) + body
    path = os.pathsep.join([TEST_PATHS, str(Path(__file__).parent)])
    done = subprocess.run(
        [sys.executable, "-c", text],
        env=dict(os.environ, PYTHONPATH=path),
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    assert done.returncode == -signal.SIGKILL, done.stderr


HELD = """
    ports.start_child(args, id="ttyS0")
    app = system.open_registrar("app")
    app.load("ttyS0/thing", Order("lamp"))
    app.save_catalog()
"""


def test_it_comes_back_after_a_crash_of_the_whole_system_with_its_holders(
    start: Start, state_dir: Path, workshop: Workshop, args: list[str]
) -> None:
    killed(state_dir, workshop, HELD)
    system = start(tree())
    assert running(system, "ttyS0")
    assert system.dormant() == ["app"]
    app = system.open_registrar("app")
    eventually(lambda: holds(app, system))
    with pytest.raises(AlreadyStarted, match="root/pool/ttyS0 is running"):
        system.supervisor("pool").start_child(args, id="ttyS0")
    app.unload_all()
    workshop.wait("unload lamp")
    assert len(workshop.lines("load lamp")) == 1


def test_it_comes_back_with_a_supervisor_in_a_process_of_its_own(
    start: Start, state_dir: Path, workshop: Workshop
) -> None:
    killed(state_dir, workshop, HELD, placement="process")
    system = start(tree(placement="process"))
    app = system.open_registrar("app")
    running(system, "ttyS0")
    eventually(lambda: holds(app, system))


def test_one_that_was_starting_when_the_system_was_killed_comes_back(
    start: Start, state_dir: Path, workshop: Workshop
) -> None:
    workshop.shut("start ttyS0")
    body = """
        threading.Thread(target=ports.start_child, args=(args,), kwargs={"id": "ttyS0"}, daemon=True).start()
        work.wait("start ttyS0")
    """
    killed(state_dir, workshop, body)
    workshop.open("start ttyS0")
    assert running(start(tree()), "ttyS0")


def test_one_that_was_ending_when_the_system_was_killed_comes_back_and_can_be_ended(
    start: Start, state_dir: Path, workshop: Workshop
) -> None:
    workshop.shut("unload lamp")
    body = """
        threading.Thread(target=ports.terminate_child, args=("ttyS0",), daemon=True).start()
        work.wait("unload lamp")
    """
    killed(state_dir, workshop, HELD, body)
    workshop.open("unload lamp")
    system = start(tree())
    running(system, "ttyS0")
    system.supervisor("pool").terminate_child("ttyS0")
    assert len(workshop.wait("unload lamp", 2)) == 2
    assert (system.supervisor("pool").which_children(), ChildRecords(state_dir).ids("root/pool")) == ([], [])


@pytest.mark.parametrize("ends", [True, False])
def test_one_that_had_ended_or_could_not_start_before_the_kill_does_not_come_back(
    start: Start, state_dir: Path, workshop: Workshop, ends: bool
) -> None:
    ended = """
        ports.terminate_child("ttyS0")
    """
    not_started = """
        try:
            ports.start_child(["one", "too many"], id="ttyS0")
        except rr.RrError:
            pass
    """
    killed(state_dir, workshop, *((HELD, ended) if ends else (not_started,)))
    system = start(tree())
    assert system.supervisor("pool").which_children() == []
    assert "ttyS0" not in system.dormant()


def test_a_backup_has_it_and_it_comes_back_with_what_is_restored(
    start: Start, tmp_path: Path, workshop: Workshop, args: list[str]
) -> None:
    system = start(tree())
    system.supervisor("pool").start_child(args, id="ttyS0")
    system.open_registrar("app").load("ttyS0/thing", THING)
    system.backup(tmp_path / "backup")
    system.stop()
    rr.System.restore(tmp_path / "backup", tmp_path / "restored")
    system = start(tree(), state_dir=tmp_path / "restored")
    app = system.open_registrar("app")
    eventually(lambda: holds(app, system))


# -- orderly ends ----------------------------------------------------------------------------------------------------


def test_terminate_child_unloads_what_it_serves_and_leaves_nothing(
    start: Start, state_dir: Path, workshop: Workshop, args: list[str]
) -> None:
    system = start(tree())
    ports = system.supervisor("pool")
    ports.start_child(args, id="ttyS0")
    app = system.open_registrar("app")
    app.load("ttyS0/thing", THING)
    ports.terminate_child("ttyS0")
    assert workshop.lines("unload lamp") == ["unload lamp"]
    assert ChildRecords(state_dir).supervisors() == []
    eventually(lambda: not (state_dir / "ttyS0").exists())
    assert system.dormant() == []
    with pytest.raises(NotFound):
        ports.terminate_child("ttyS0")


def test_a_clean_stop_of_the_system_leaves_nothing(start: Start, state_dir: Path, args: list[str]) -> None:
    system = start(tree())
    system.supervisor("pool").start_child(args, id="ttyS0")
    system.open_registrar("app").load("ttyS0/thing", THING)
    system.stop()
    assert ChildRecords(state_dir).supervisors() == []
    assert start(tree()).supervisor("pool").which_children() == []


def test_one_that_had_to_be_killed_at_the_stop_comes_back_and_unloads(
    start: Start, state_dir: Path, workshop: Workshop, args: list[str]
) -> None:
    system = start(tree(shutdown_s=0.2))
    system.supervisor("pool").start_child(args, id="ttyS0")
    app = system.open_registrar("app")
    app.load("ttyS0/thing", THING)
    workshop.shut("unload lamp")
    os.kill(running(system, "ttyS0"), signal.SIGSTOP)
    system.stop(timeout_s=3.0)
    assert ChildRecords(state_dir).ids("root/pool") == ["ttyS0"]
    workshop.open("unload lamp")
    system = start(tree())
    running(system, "ttyS0")
    system.supervisor("pool").terminate_child("ttyS0")
    workshop.wait("unload lamp")


def test_a_supervisor_that_is_deleted_takes_its_kept_children_along(
    start: Start, state_dir: Path, args: list[str]
) -> None:
    system = start(tree())
    system.supervisor("pool").start_child(args, id="ttyS0")
    system.supervisor().terminate_child("pool")
    assert ChildRecords(state_dir).ids("root/pool") == ["ttyS0"]
    system.supervisor().delete_child("pool")
    eventually(lambda: not ChildRecords(state_dir).supervisors())
    system.start_child(pool())
    assert system.supervisor("pool").which_children() == []


# -- what does not come back -----------------------------------------------------------------------------------------


def lost(state_dir: Path, args: bytes | None) -> None:
    """Leave three children of the pool, the second with these arguments, or with a damaged record."""
    state_dir.mkdir(mode=0o700)
    records = ChildRecords(state_dir)
    good = pickle.dumps((str(state_dir.parent / "workshop"),))
    for number, id in enumerate(("a", "b", "c")):
        records.write("root/pool", id, good if id != "b" or args is None else args, number, synced=False)
    if args is None:
        file = state_dir / ".children" / ":pool" / "b"
        file.write_bytes(file.read_bytes()[:-1])


@pytest.mark.parametrize(
    ("args", "why"),
    [
        (None, "b: expected the record of a child, got other bytes than were written"),
        (b"cno_such_module\nThing\n.", "cannot be read now: ModuleNotFoundError: No module named 'no_such_module'"),
        (pickle.dumps((1, 2)), "takes 2 positional arguments but 3 were given"),
    ],
)
def test_one_that_cannot_be_started_is_named_and_dormant_and_the_others_come_back(
    start: Start, state_dir: Path, workshop: Workshop, args: bytes | None, why: str
) -> None:
    lost(state_dir, args)
    system = start(tree())
    ports = system.supervisor("pool")
    assert {child.id: child.state for child in ports.which_children()} == {
        "a": "running",
        "b": "stopped",
        "c": "running",
    }
    assert system.dormant() == ["b"]
    (failed,) = [record for record in ports.history() if record.event == "start_failed"]
    assert failed.id == "b"
    assert why in failed.detail
    with pytest.raises(StartFailed, match="root/pool/b did not start") as caught:
        ports.restart_child("b")
    assert (args is None) == isinstance(caught.value.__cause__, CatalogDamaged)
    assert ports.start_child([str(workshop.root)], id="b") is not None
    assert system.dormant() == []
    system.open_registrar("app").load("b/thing", THING)
    ports.terminate_child("b")
    assert workshop.lines("unload lamp") == ["unload lamp"]


def test_arguments_that_never_become_ready_hold_up_nothing(start: Start, state_dir: Path, workshop: Workshop) -> None:
    lost(state_dir, pickle.dumps(_Waits()))
    system = start(tree(), config=SystemConfig(start_timeout_s=3.0))
    _release.set()
    assert state_of(system, "b") == "stopped"
    assert state_of(system, "c") == "running"
    (failed,) = [record for record in system.supervisor("pool").history() if record.event == "start_failed"]
    assert "that had not ended after 3 s (start_timeout_s)" in failed.detail


_release = threading.Event()


def _wait() -> tuple[()]:
    _release.wait(LIMIT_S)
    return ()


class _Waits:
    def __reduce__(self) -> Any:
        return _wait, ()


def test_an_id_of_another_manager_is_refused(start: Start, state_dir: Path, args: list[str]) -> None:
    system = start(pool(), rr.ChildSpec(Shop, id="cameras", args=args))
    ports = system.supervisor("pool")
    with pytest.raises(NameTaken, match="a registrar 'cameras' is in the system already"):
        ports.start_child(args, id="cameras")
    for id in ("", "a/b", ".a", "x" * 65, 3):
        with pytest.raises(InvalidSpec, match="start_child of root/pool: id: expected 1 to 64 ASCII letters"):
            ports.start_child(args, id=id)  # type: ignore[arg-type]
    assert ports.which_children() == []
    assert ChildRecords(state_dir).supervisors() == []


def test_a_tree_with_a_manager_of_the_id_of_a_kept_child_is_refused(
    start: Start, state_dir: Path, args: list[str]
) -> None:
    lost(state_dir, None)
    with pytest.raises(InvalidSpec, match="root/pool/a is kept on disk from an earlier run, and root/a has its id"):
        start(rr.ChildSpec(Shop, id="a", args=args), pool())
    assert ChildRecords(state_dir).ids("root/pool") == ["a", "b", "c"]


def test_arguments_that_cannot_be_on_disk_are_refused(start: Start, state_dir: Path) -> None:
    system = start(tree())
    with pytest.raises(StartFailed, match=r"item 0: cannot pickle '_thread\.lock' object"):
        system.supervisor("pool").start_child([threading.Lock()], id="ttyS0")
    assert system.supervisor("pool").which_children() == []
    assert ChildRecords(state_dir).supervisors() == []


def test_children_without_managers_are_kept_too(start: Start, state_dir: Path) -> None:
    template = rr.ChildSpec(Counter, id="counter", placement="thread")
    spec = rr.Supervisor([template], id="pool", strategy="simple_one_for_one")
    system = start(rr.Supervisor([spec]))
    system.supervisor("pool").start_child([7], id="seven")
    system.supervisor().terminate_child("pool")
    system.supervisor().restart_child("pool")
    assert system.ref("pool/seven").ask("value") == 7


class Counter(rr.Actor):
    def __init__(self, value: int) -> None:
        self.value = value

    def on_receive(self, message: object) -> int:
        return self.value


def test_children_of_a_supervisor_that_the_tree_has_no_more_are_named_and_start_when_it_is_added(
    start: Start, state_dir: Path, workshop: Workshop, caplog: pytest.LogCaptureFixture
) -> None:
    lost(state_dir, pickle.dumps((str(workshop.root),)))
    system = start()
    (told,) = [record.getMessage() for record in caplog.records if "on disk" in record.getMessage()]
    assert told.startswith("root/pool: its children a, b, c are on disk, and start again when the tree has this")
    assert told.endswith(str(state_dir / ".children" / ":pool"))
    system.start_child(pool())
    assert {child.state for child in system.supervisor("pool").which_children()} == {"running"}


# -- children without an id ------------------------------------------------------------------------------------------


def test_what_one_without_an_id_leaves_with_its_dead_supervisor_is_dormant_and_is_ended_by_its_template(
    start: Start, workshop: Workshop, args: list[str]
) -> None:
    system = start(tree(placement="process"))
    ref = system.supervisor("pool").start_child(args)
    assert ref is not None
    id = str(ref.path).rpartition("/")[2]
    app = system.open_registrar("app")
    query = app.load(f"{id}/thing", THING)
    kill(system, "pool")
    assert query.wait_status(rr.State.FATAL, timeout_s=LIMIT_S)
    eventually(lambda: system.dormant() == [id])
    ports = system.supervisor("pool")
    eventually(lambda: child(system, "pool").state == "running")
    assert ports.which_children() == []
    ports.start_child(args, id=id)
    assert system.dormant() == []
    ports.terminate_child(id)
    assert workshop.lines("unload lamp") == ["unload lamp"]
    eventually(lambda: system.dormant() == [])


def test_what_a_static_child_that_was_added_at_run_time_leaves_is_dormant_and_is_ended_by_its_class(
    start: Start, workshop: Workshop, args: list[str]
) -> None:
    system = start(rr.Supervisor([rr.Supervisor([], id="inner", placement="process")]))
    shop = rr.ChildSpec(Shop, id="shop", args=args)
    system.supervisor("inner").start_child(shop)
    query = system.open_registrar("app").load("shop/thing", THING)
    kill(system, "inner")
    assert query.wait_status(rr.State.FATAL, timeout_s=LIMIT_S)
    eventually(lambda: system.dormant() == ["shop"])
    eventually(lambda: child(system, "inner").state == "running")
    system.supervisor("inner").start_child(shop)
    assert system.dormant() == []
    system.supervisor("inner").terminate_child("shop")
    system.supervisor("inner").delete_child("shop")
    system.stop()
    assert workshop.lines("unload lamp") == ["unload lamp"]


def test_a_record_of_a_manager_with_power_durability_is_synced(
    start: Start, state_dir: Path, args: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    synced: list[str] = []
    fsync = os.fsync

    def noted(fd: int) -> None:
        synced.append(os.readlink(f"/proc/self/fd/{fd}"))
        fsync(fd)

    config = SystemConfig(registrars={"ttyS0": RegistrarConfig("ttyS0", durability="power")})
    system = start(tree(), config=config)
    monkeypatch.setattr(os, "fsync", noted)
    for id in ("ttyS1", "ttyS0"):
        system.supervisor("pool").start_child(args, id=id)
    assert [Path(path).name for path in synced if ".children" in path] == [".ttyS0.new", ":pool"]
