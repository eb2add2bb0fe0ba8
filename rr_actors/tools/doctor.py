"""The doctor: what this machine lacks, or limits, of what a system needs, each with what to do."""

from __future__ import annotations

import functools
import gc
import os
import platform
import resource
import shutil
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Literal

import msgspec

from rr_actors.base import __version__
from rr_actors.base.config import SystemConfig
from rr_actors.base.errors import counted
from rr_actors.base.scarcity import group_limit
from rr_actors.registrar.declarations import server
from rr_actors.registrar.manager import Manager
from rr_actors.runtime import interpreter
from rr_actors.runtime.processes.control_groups import CONTROLLERS, ControlGroups
from rr_actors.supervision.core.specs import ChildSpec
from rr_actors.system.system import System
from rr_actors.wire.unix_sockets import NO_PROC, has_proc

_OWN_FDS = 64  # descriptors of an application with a system and no children
_CHILD_FDS = 6  # descriptors that the application has open for each child
_FEW_CHILDREN = 100
_CHILD_THREADS = 8
_FEW_BYTES = 64 * 2**20
_REAL_FSYNC_S = 20e-6  # a disk with a battery takes longer
_SLOW_CLOCK_S = 1e-6
_SHARED = ("nfs", "cifs", "smb", "9p", "ceph", "gluster", "lustre", "afs")
_GONE_AT_BOOT = ("tmpfs", "ramfs", "overlay")
_FUSE = "fuse"


class Finding(msgspec.Struct, frozen=True):
    """What was found of one thing. "limits": a system runs, with less than elsewhere. "lacks": something fails."""

    level: Literal["ok", "limits", "lacks"]
    what: str
    found: str
    todo: str = ""


def examine(state_dir: Path) -> list[Finding]:
    """Examine this machine, and the file system that `state_dir` is on or would be on."""
    wanted = state_dir.expanduser().absolute()
    place = next(path for path in (wanted, *wanted.parents) if path.exists())
    checks: list[Callable[[], Iterator[Finding]]] = [
        _python,
        _descriptors,
        _processes,
        _proc,
        _control_groups,
        _program_groups,
        _shared_memory,
        _debugging,
        _clock,
        functools.partial(_files, place),
        functools.partial(_system, place if os.access(place, os.W_OK) else Path(tempfile.gettempdir())),
        _terminal,
    ]
    return [finding for check in checks for finding in check()]


def _judge(what: str, found: str, *, limits: bool = False, lacks: bool = False, todo: str) -> Finding:
    """Return a finding that says what to do only if there is something to do."""
    level = "lacks" if lacks else "limits" if limits else "ok"
    return Finding(level, what, found, "" if level == "ok" else todo)


def _python() -> Iterator[Finding]:
    machine = f"Python {platform.python_version()}, {platform.system()} {platform.release()}"
    yield Finding("ok", "versions", f"rr_actors {__version__}, {machine}")
    patched = interpreter.patched()
    found = "threads are real" if not patched else patched.partition(":")[0]
    yield _judge("threads", found, lacks=bool(patched), todo=patched.partition(": ")[2])


def _descriptors() -> Iterator[Finding]:
    soft = resource.getrlimit(resource.RLIMIT_NOFILE)[0]
    soft = 2**30 if soft == resource.RLIM_INFINITY else soft
    fits = max(0, (soft - _OWN_FDS) // _CHILD_FDS)
    yield _judge(
        "descriptors",
        f"{soft} a process: room for {counted(fits, 'child process')} below one application",
        limits=fits < _FEW_CHILDREN,
        lacks=fits < 2,
        todo="ulimit -n 65536 in the shell that starts the system, or LimitNOFILE=65536 in its systemd unit",
    )


def _processes() -> Iterator[Finding]:
    soft = resource.getrlimit(resource.RLIMIT_NPROC)[0]
    fits = soft // _CHILD_THREADS
    yield _judge(
        "processes",
        "no limit" if soft < 0 else f"{soft} of this user, threads included: room for {counted(fits, 'child process')}",
        limits=0 <= fits < _FEW_CHILDREN,
        todo="raise ulimit -u, or TasksMax= in the systemd unit",
    )


def _proc() -> Iterator[Finding]:
    found, _, todo = NO_PROC.partition(": ")
    yield _judge("/proc", "mounted" if has_proc() else found, lacks=not has_proc(), todo=todo)


def _control_groups() -> Iterator[Finding]:
    """Look for limits of this process's control groups, of version 2 and 1, and of the groups above."""
    limits = {
        "memory": ("memory.max", "memory.limit_in_bytes", 512 * 2**20, "MiB"),
        "tasks": ("pids.max", "pids.max", _FEW_CHILDREN * _CHILD_THREADS, ""),
    }
    for what, (new, old, little, unit) in limits.items():
        least = 2**62 if (limit := group_limit(new, old)) is None else limit
        shown = "no limit" if least >= 2**60 else f"{least // 2**20} MiB" if unit else str(least)
        yield _judge(
            f"control group: {what}",
            shown,
            limits=least < little,
            todo="raise it: docker run --memory, --pids-limit; MemoryMax=, TasksMax= in a systemd unit",
        )


def _program_groups() -> Iterator[Finding]:
    """Say what Programs can do with control groups, by those of this process."""
    groups = ControlGroups.of_this_process()
    limits, freezes = groups.limits(), groups.place("rr-doctor") is not None
    yield _judge(
        "control group: programs",
        f"paused by {'freezing' if freezes else 'SIGSTOP'}; shares enforced: {', '.join(limits) or 'none'}",
        limits=not freezes or len(limits) < len(CONTROLLERS),
        todo="to freeze and limit programs, give the system a writable group of version 2 with cpu and memory: "
        "Delegate=yes and DelegateSubgroup=system in its systemd unit",
    )


def _shared_memory() -> Iterator[Finding]:
    try:
        os.close(os.memfd_create("rr-doctor"))
        failed = ""
    except OSError as error:
        failed = str(error)
    todo = "a system starts children by it: allow memfd_create in the seccomp filter of the container"
    yield _judge("memfd", failed or "works", lacks=bool(failed), todo=todo)
    free = shutil.disk_usage("/dev/shm").free if os.access("/dev/shm", os.W_OK) else 0
    yield _judge(
        "/dev/shm",
        f"{free // 2**20} MiB free" if free else "cannot be written",
        limits=free < _FEW_BYTES,
        todo="callbacks that use multiprocessing's locks and shared memory need it: docker run --shm-size 1g",
    )


def _debugging() -> Iterator[Finding]:
    scope = _read(Path("/proc/sys/kernel/yama/ptrace_scope")) or "0"
    yield _judge(
        "ptrace",
        "allowed" if scope == "0" else f"restricted (kernel.yama.ptrace_scope = {scope})",
        limits=scope != "0" and os.geteuid() != 0,
        todo="run a debugger or sampling profiler (gdb -p, py-spy) of a child by sudo; a system itself needs none",
    )


def _clock() -> Iterator[Finding]:
    """Time the clock that each message reads: some clock sources take a call of the kernel."""
    began = time.perf_counter()
    for _ in range(1000):
        time.monotonic()
    each_s = (time.perf_counter() - began) / 1000
    source = _read(Path("/sys/devices/system/clocksource/clocksource0/current_clocksource")) or "unknown"
    is_early = time.gmtime().tm_year < 2024
    yield _judge(
        "clock",
        f"{source}, {each_s * 1e9:.0f} ns a look, {time.strftime('%Y-%m-%d %H:%M:%S')}",
        limits=is_early or each_s > _SLOW_CLOCK_S,
        todo="set the time" if is_early else "see which clock sources the kernel has; tsc and kvm-clock are fast",
    )


def _files(place: Path) -> Iterator[Finding]:
    kind, free = _file_system(place), shutil.disk_usage(place).free
    is_shared, is_fuse = kind.removeprefix("fuse.").startswith(_SHARED), kind.startswith(_FUSE)
    todo = "nothing here outlives the container or the machine's start: give the state directory a volume or disk"
    if is_shared:
        todo = "catalogs are not safe where locks cross machines: use a local disk"
    elif is_fuse:
        todo = "a directory stays while a removed file in it is open, and goes later; a local disk is faster, and safer"
    limits = is_fuse or kind in _GONE_AT_BOOT
    yield _judge("state: file system", f"{kind}, {place}", limits=limits, lacks=is_shared, todo=todo)
    yield _judge("state: room", f"{free // 2**20} MiB free", limits=free < _FEW_BYTES, todo="make room on this disk")
    try:
        taken_s = _fsync_s(place)
    except OSError as error:
        todo = "choose another with --state, or change its owner or mode"
        yield Finding("lacks", "state: fsync", f"{place} cannot be written: {error.strerror}", todo)
        return
    yield _judge(
        "state: fsync",
        f"{taken_s * 1e6:.0f} us" + (", faster than any disk" if taken_s < _REAL_FSYNC_S else ""),
        limits=taken_s < _REAL_FSYNC_S,
        todo='durability="power" promises nothing where fsync reaches no disk: use another for it',
    )


def _file_system(place: Path) -> str:
    """Return the type of the file system: that of the last mount whose point is nearest above the place."""
    found = ("", "unknown")
    for line in _read(Path("/proc/self/mountinfo")).splitlines():
        mounted, _, source = line.partition(" - ")
        point = mounted.split()[4].encode().decode("unicode_escape")  # a space is \040
        if place.resolve().is_relative_to(point) and len(point) >= len(found[0]):
            found = (point, source.split()[0])
    return found[1]


def _fsync_s(place: Path) -> float:
    with tempfile.TemporaryFile(dir=place, buffering=0) as file:
        taken: list[float] = []
        for _ in range(7):
            file.write(bytes(4096))
            began = time.perf_counter()
            os.fsync(file.fileno())
            taken.append(time.perf_counter() - began)
    return sorted(taken)[3]


class Patient(Manager):
    """A manager that the doctor starts and asks."""

    @server("pulse")
    def feel(self) -> int:
        """Return the id of its process."""
        return os.getpid()


def _serve_once(state: str) -> None:
    children = [ChildSpec(Patient, id="patient")]
    with System(children, state_dir=state, config=SystemConfig(console=False)) as system:
        system.open_registrar("doctor").load("patient/pulse").unload()


def _system(place: Path) -> Iterator[Finding]:
    """Start a system beside the state: fork server, sockets, locks, links and the lifeline have to work."""
    try:
        with tempfile.TemporaryDirectory(prefix="rr-doctor-", dir=place, ignore_cleanup_errors=True) as state:
            began = time.perf_counter()
            _serve_once(state)
            taken_s = time.perf_counter() - began
        gc.collect()  # closes the file that all processes of the system map:
        shutil.rmtree(state, ignore_errors=True)  # until then its directory stays on NFS and FUSE
    except Exception as error:  # whatever it is, it is what a user's system would raise
        first, *rest = str(error).splitlines() or [type(error).__name__]
        yield Finding("lacks", "fork server", first, " ".join(rest) or "this is what System.start() raises here")
    else:
        yield Finding("ok", "fork server", f"a system has started, served and stopped: {taken_s:.2f} s")


def _terminal() -> Iterator[Finding]:
    columns, lines = shutil.get_terminal_size()
    encoding = (sys.stdout.encoding or "none").lower()
    is_small = sys.stdout.isatty() and (columns < 80 or lines < 24 or os.environ.get("TERM", "dumb") == "dumb")
    shown = f"{columns} x {lines}, {os.environ.get('TERM', 'no TERM')}" if sys.stdout.isatty() else "none"
    yield _judge(
        "terminal",
        f"{shown}, {encoding}",
        limits=is_small or encoding not in ("utf-8", "utf8"),
        todo="rr-actors top needs 80 x 24, a TERM that moves the cursor, and UTF-8 (PYTHONUTF8=1)",
    )


def _read(path: Path) -> str:
    try:
        return path.read_text().strip()
    except OSError:
        return ""
