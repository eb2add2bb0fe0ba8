"""A supervisor tree without the rest of a System, and the actors that its tests put into it.

The actors are in this module, and not in a test's, so that a child process need not import the tests.
"""

from __future__ import annotations

import ctypes
import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path
from typing import Any, ClassVar

import pykka

from rr_actors.actors.actor import IGNORE, Actor, ExitReport
from rr_actors.actors.refs import ActorRef, ref_to
from rr_actors.base.config import SystemConfig
from rr_actors.hosting.process_node import SystemInfo
from rr_actors.registrar.declarations import server
from rr_actors.registrar.engine.node import Node
from rr_actors.registrar.manager import Manager
from rr_actors.runtime import event_loop
from rr_actors.storage.child_records import ChildRecords
from rr_actors.storage.opening import open_catalog, remove_catalogs
from rr_actors.supervision.core.specs import ChildSpec, Supervisor, as_child_spec
from rr_actors.supervision.hosted import Hosted, prepare
from rr_actors.supervision.name_entries import Entries
from rr_actors.supervision.supervisor import Child, SupervisorRef, target_of
from rr_actors.wire.name_service import StateDir, open_state_dir
from support import eventually


class Tree:
    """A running tree. A context manager; leaving it stops all.

    Args:
        root: a Supervisor, or children for one.
    """

    def __init__(
        self, state_dir: Path, *children: ChildSpec | Supervisor, config: SystemConfig | None = None, **options: Any
    ):
        only = children[0] if len(children) == 1 else None
        self.spec = only if isinstance(only, Supervisor) and only.id == "root" else Supervisor(children, **options)
        self.events: list[dict[str, Any]] = []
        self.exits: list[ExitReport] = []
        self.exited = threading.Event()
        self.state: StateDir = open_state_dir(state_dir)
        self.config = config or SystemConfig(logging=False)  # the events here are those that people see
        self.dispatcher = event_loop.acquire()
        self.node: Node
        self.hosted: Hosted | None = None

    def start(self) -> None:
        info = SystemInfo("test", str(self.state.path), str(self.state.run_dir), self.state.key, self.config)
        self.dispatcher.run(self._start(info), 60)

    async def _start(self, info: SystemInfo) -> None:
        self.node = Node(info, on_event=self.events.append, open_catalog=open_catalog, remove_unneeded=remove_catalogs)
        await self.node.start()
        spec = as_child_spec(self.spec)
        Entries(self.node.directory, ChildRecords(self.state.path)).announce(spec, "root")
        cls, args, kwargs = target_of(spec)
        self.hosted = prepare(self.node, cls, "root", self._exited)
        await self.hosted.start(args, kwargs, None)

    def _exited(self, report: ExitReport) -> None:
        self.exits.append(report)
        self.exited.set()

    def stop(self, timeout_s: float = 10.0, *, final: bool = True) -> float:
        """Stop the tree; how many seconds it took."""
        assert self.hosted is not None
        began = time.monotonic()
        self.dispatcher.run(self.hosted.stop(timeout_s, final=final), 30)
        return time.monotonic() - began

    def __enter__(self) -> Tree:
        try:
            self.start()
        except BaseException:
            self.close()
            raise
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()
        self.close()

    def close(self) -> None:
        self.dispatcher.run(self.node.close(), 30)
        self.state.close()
        event_loop.release()

    # -- looking at it ---------------------------------------------------------------------------------------------

    def supervisor(self, path: str = "root") -> SupervisorRef:
        return SupervisorRef(path, timeout_s=20.0)

    def child(self, path: str) -> Child:
        above, _, id = path.rpartition("/")
        return {child.id: child for child in self.supervisor(above).which_children()}[id]

    def pid(self, path: str, *, not_: int | None = None) -> int:
        """The process of a child once it is running (in another process than `not_`)."""

        def running() -> int | None:
            child = self.child(path)
            return child.pid if child.state == "running" and child.pid != not_ else None

        pid = eventually(running, what=f"{path} running in another process than {not_}")
        assert pid is not None
        return pid

    def run(self, path: str) -> int:
        """Which start of the child is the last one."""
        above, _, id = path.rpartition("/")
        records = [r for r in self.supervisor(above).history() if r.id == id and r.event in ("started", "restarted")]
        return records[-1].run if records else 0

    def ref(self, path: str) -> ActorRef[Any]:
        return ref_to(path)

    def ask(self, path: str, message: Any, **options: Any) -> Any:
        return ref_to(path).ask(message, **options)

    def kill(self, path: str, sig: int = signal.SIGKILL) -> int:
        """Send a signal to a child's process; the process id."""
        pid = self.pid(path)
        os.kill(pid, sig)
        return pid

    def records(self, event: str, path: str = "root") -> list[Any]:
        return [record for record in self.supervisor(path).history() if record.event == event]


# -- actors ----------------------------------------------------------------------------------------------------------


class Log:
    """A file to which actors in any process append lines."""

    def __init__(self, path: Path | str) -> None:
        self.path = Path(path)

    def note(self, *words: object) -> None:
        file = os.open(self.path, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o600)
        try:
            os.write(file, (" ".join(map(str, words)) + "\n").encode())
        finally:
            os.close(file)

    def lines(self) -> list[str]:
        return self.path.read_text().splitlines() if self.path.exists() else []


let_go = threading.Event()
"""Set at the end of a test, so that what hung in this process does not stay."""


class Worker(Actor):
    """Does what it is told: a message is the name of a method, or a tuple of it and its arguments."""

    def __init__(self, log: str | None = None, name: str = "", on_start: str = "", on_stop: str = "") -> None:
        self.log = Log(log) if log else None
        self.name = name
        self.do_on_start = on_start
        self.do_on_stop = on_stop

    def note(self, *words: object) -> None:
        if self.log is not None:
            self.log.note(*words, self.name)

    def on_start(self) -> Any:
        self.note("start")
        if self.do_on_start:
            return getattr(self, self.do_on_start)()
        return None

    def on_stop(self) -> None:
        if self.do_on_stop:
            getattr(self, self.do_on_stop)()
        self.note("stop")

    def on_receive(self, message: Any) -> Any:
        name, *args = (message,) if isinstance(message, str) else message
        return getattr(self, name)(*args)

    def pid(self) -> int:
        return os.getpid()

    def fail(self, text: str = "as it was told") -> None:
        raise ValueError(text)

    def ignore(self) -> Any:
        return IGNORE

    def end(self, reason: Any = "normal") -> None:
        self.stop(reason)

    def leave(self, code: int | None = None) -> None:
        sys.exit(code)

    def os_exit(self, code: int = 0) -> None:
        os._exit(code)

    def pause(self, seconds: float = 0.1) -> str:
        time.sleep(seconds)
        return "rested"

    def hang(self) -> None:
        let_go.wait()

    def hang_once(self) -> None:
        """Hang, but the first time only."""
        assert self.log is not None
        if self.log.lines().count(f"start {self.name}".strip()) == 1:
            self.hang()

    def fail_again(self) -> None:
        """Fail, but not the first time."""
        assert self.log is not None
        if self.log.lines().count(f"start {self.name}".strip()) > 1:
            self.fail()

    def hold_the_interpreter(self) -> None:
        ctypes.PyDLL(None).sleep(3600)

    def block_the_loop(self) -> None:
        process = event_loop.current()
        assert process is not None
        process.call(threading.Event().wait)

    def start_program(self, new_session: bool = False) -> int:
        code = "import time; time.sleep(60)"
        return subprocess.Popen([sys.executable, "-c", code], start_new_session=new_session).pid

    def start_child_of(self, path: str, id: str) -> Any:
        return SupervisorRef(path).start_child(ChildSpec(Worker, id=id))


class Threaded(pykka.ThreadingActor):
    """An ordinary Pykka actor with the same orders as a Worker."""

    def __init__(self, on_start: str = "") -> None:
        super().__init__()
        self.do_on_start = on_start

    def on_start(self) -> Any:
        return getattr(self, self.do_on_start)() if self.do_on_start else None

    def on_receive(self, message: Any) -> Any:
        name, *args = (message,) if isinstance(message, str) else message
        return getattr(self, name)(*args)

    def pid(self) -> int:
        return os.getpid()

    def fail(self) -> None:
        raise ValueError("as it was told")

    def ignore(self) -> Any:
        return IGNORE

    def end(self) -> None:
        self.stop()

    def leave(self, code: int | None = None) -> None:
        sys.exit(code)


class StuckManager(Manager):
    """Does not stop, or start, before `let_go` is set."""

    def __init__(self, on_start: bool = False) -> None:
        self.hangs_at_start = on_start

    def on_start(self) -> None:
        if self.hangs_at_start:
            let_go.wait()

    def on_stop(self) -> None:
        name, threading.current_thread().name = threading.current_thread().name, "stuck"
        let_go.wait()
        threading.current_thread().name = name

    def on_receive(self, message: Any) -> str:
        return "served"


class _Slow:
    """An attribute of a class that cannot be read before `let_go` is set."""

    def __get__(self, instance: object, owner: type) -> Any:
        let_go.wait()
        return lambda manager, request, response: None


class _Thing(Manager):
    @server("thing")
    def load_thing(self, request: int) -> int:
        return request

    @load_thing.unload
    def unload_thing(self, request: int, response: int) -> None:
        """Do nothing."""


class SlowToRegister(_Thing):
    """Has a server that is not registered before `let_go` is set. `made`: the instances."""

    made: ClassVar[list[SlowToRegister]] = []
    unload_thing: Any = _Slow()

    def __init__(self) -> None:
        self.made.append(self)


class Idle(Manager):
    """Has a registrar and nothing to do."""
