"""Main functions of the child processes that test_processes.py starts."""

from __future__ import annotations

import atexit
import ctypes
import json
import multiprocessing
import os
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import weakref
from multiprocessing import util
from typing import Any

from rr_actors.runtime.processes import lifeline
from rr_actors.runtime.processes.fork_server import Inherited
from rr_actors.runtime.processes.process import Spawner


def _say(control: socket.socket, **facts: Any) -> None:
    control.sendall(json.dumps(facts).encode() + b"\n")


def until_told(child: Inherited) -> int:
    """Say who it is, then leave with the exit code it is told."""
    _say(
        child.control,
        pid=os.getpid(),
        group=os.getpgid(0),
        name=child.name,
        size=len(child.payload),
        argv=sys.argv,
        cwd=os.getcwd(),
        main=getattr(sys.modules["__main__"], "__file__", ""),
        variable=os.environ.get("RR_ACTORS_TEST_VARIABLE"),
    )
    return int(child.control.recv(16) or b"0")


def say_environment(child: Inherited) -> int:
    """Say what environment it has, and what one a program has that it starts."""
    printed = subprocess.run([sys.executable, "-c", _PRINTS], capture_output=True, check=True)
    _say(child.control, own=dict(os.environ), of_program=json.loads(printed.stdout))
    return 0


_PRINTS = "import json, os; print(json.dumps(dict(os.environ)))"


def say_process(child: Inherited) -> int:
    """Say what multiprocessing knows of this process, and how a process of its own ends."""
    own, parent = multiprocessing.current_process(), multiprocessing.parent_process()
    assert parent is not None
    grandchild = multiprocessing.Process(target=os._exit, args=(7,))
    grandchild.start()
    grandchild.join()
    _say(
        child.control,
        name=own.name,
        key=bytes(own.authkey).hex(),
        parent=(parent.name, parent.pid),
        children=len(multiprocessing.active_children()),
        method=multiprocessing.get_start_method(),
        thread=threading.main_thread().native_id,
        grandchild=(grandchild.name.rpartition(":")[2], grandchild.exitcode),
        standard_input=sys.stdin.read(),
        excepthook=sys.excepthook is sys.__excepthook__,
    )
    return 0


def raise_at_once(child: Inherited) -> int:
    raise ValueError("as it was told")


def stay_with_thread(child: Inherited) -> int:
    """Return while another thread goes on for ever."""
    threading.Thread(target=threading.Event().wait).start()
    print("last words", end="")
    return 0


def say_goodbye(child: Inherited) -> int:
    """Leave work for its exit in each of the ways that Python has."""
    says_goodbye = sys.modules["says_goodbye"]  # preloaded
    _kept.append(tempfile.TemporaryDirectory(prefix="own-"))
    weakref.finalize(_kept[0], says_goodbye.say, "finalized")
    util.Finalize(None, says_goodbye.say, ("multiprocessing",), exitpriority=0)
    atexit.register(says_goodbye.say, "own")
    return 0


_kept: list[tempfile.TemporaryDirectory[str]] = []


def hold_the_interpreter(child: Inherited) -> int:
    """Run for ever without letting any other thread run."""
    _say(child.control, pid=os.getpid())
    ctypes.PyDLL(None).pause()
    return 0


def start_programs(child: Inherited) -> int:
    """Start a program in its group, and one that leaves it."""
    program = [sys.executable, "-c", "import time; time.sleep(60)"]
    inside = subprocess.Popen(program)
    outside = subprocess.Popen(program, start_new_session=True)
    _say(child.control, pid=os.getpid(), inside=inside.pid, outside=outside.pid)
    child.control.recv(1)
    return 0


def have_a_child(child: Inherited) -> int:
    """Start a child of its own, by a Spawner of its own."""
    spawner = Spawner()
    grandchild = spawner.start("support_children:until_told", b"", name="grandchild")
    grandchild.control.recv(4096)
    parent = int(open(f"/proc/{grandchild.pid}/stat").read().rpartition(")")[2].split()[1])  # noqa: SIM115, PTH123
    _say(child.control, pid=os.getpid(), grandchild=grandchild.pid, same_server=parent == os.getppid())
    child.control.recv(1)
    grandchild.kill(signal.SIGKILL)
    lifeline.wait_gone((grandchild.pid,), 5.0)
    grandchild.close()
    spawner.close()
    return 0


def hear(control: socket.socket) -> dict[str, Any]:
    """What a child said first."""
    control.settimeout(10.0)
    with control.makefile("rb") as lines:
        return json.loads(lines.readline())
