"""The managers of the system: makers serve things made of other things, crews use them, and a house has devices."""

from __future__ import annotations

import contextlib
import hashlib
import logging
import os
import random
import re
import socket
import subprocess
import threading
import time
from collections.abc import Generator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from chaos.callback_log import Journal
from rr_actors.base.errors import RrError
from rr_actors.managers import Pool, Reserve, RunProgram, Share, Supply
from rr_actors.registrar.declarations import server
from rr_actors.registrar.manager import Manager
from rr_actors.registrar.queries import Query
from rr_actors.registrar.servers.callback_context import Current, current

PATIENCE_S = 25.0
"""The limit of a load that does not give up early."""
UNLOAD_S = 0.001
"""How long an unload callback takes."""
CREW, SUCCEEDED, UNEXPECTED = "crew-", "-", "unexpected"
"""Words with which crews note the results of their loads and unloads in the journal."""
LOG_TO = "RR_ACTORS_CHAOS_LOG"
OWNER = "RR_ACTORS_CHAOS_OWNER"
"""A daemon's variable: the pid of the manager that started it."""
RESERVE = 30.0
WATTS = Pool("watts", 100.0, reserve=(Reserve("house/generator", RESERVE),))
"""The pool of the house's devices."""
LESS = 60.0
"""What its capacity is lowered to now and then."""
_LINKS = re.compile(r"\d+-[0-9a-f]{8}\.sock$")


@dataclass(frozen=True)
class Want:
    """A request. Loads of every tenth number fail now and then."""

    number: int


class Recorded(Manager):
    """A manager that records the runs of its load and unload callbacks in the journal.

    Args:
        directory: the journal's directory.
    """

    def __init__(self, directory: str) -> None:
        self.journal = Journal(directory)

    @contextlib.contextmanager
    def recorded(self, what: str) -> Generator[Current]:
        """Record the beginning of a callback, and how it ends. `what`: load or unload."""
        now, name = current(), self.registrar.name
        self.journal.note(name, what, now.resource_id, now.attempt)
        try:
            yield now
        except BaseException:
            self.journal.note(name, "failed", now.resource_id, now.attempt)
            raise
        self.journal.note(name, f"{what}ed", now.resource_id, now.attempt)

    def unmake(self) -> None:
        """Unload a resource."""
        with self.recorded("unload"):
            time.sleep(UNLOAD_S)


class Maker(Recorded):
    """Serves "thing" and "warm" (which lingers for 0.1 s), each made of one thing from each of `needs`.

    Args:
        directory: the journal's directory.
        needs: the ids of servers.
    """

    def __init__(self, directory: str, needs: tuple[str, ...] = ()) -> None:
        super().__init__(directory)
        self.needs = needs

    @server("thing")
    def load_thing(self, request: Want) -> str:
        return self._make(request)

    @load_thing.unload
    def unload_thing(self, request: Want, response: str) -> None:
        self.unmake()

    @server("warm", linger_s=0.1)
    def load_warm(self, request: Want) -> str:
        return self._make(request)

    @load_warm.unload
    def unload_warm(self, request: Want, response: str) -> None:
        self.unmake()

    def on_receive(self, message: Any) -> Any:
        if message == "cut":
            cut_links()
        elif message == "stray":
            owned = {**os.environ, OWNER: str(os.getpid())}
            subprocess.run(["setsid", "--fork", "sleep", "1000"], env=owned, check=True)
        return message

    def _make(self, request: Want) -> str:
        with self.recorded("load") as now:
            for need in self.needs:
                self.registrar.load(need, Want(request.number // 2), timeout_s=PATIENCE_S)
            luck = hashlib.sha256(f"{now.resource_id} {now.attempt}".encode()).digest()
            time.sleep(luck[0] / 255 * 0.01)
            if request.number % 10 == 0 and luck[1] < 80:
                raise ValueError("out of luck")
        return f"{self.registrar.name} {request.number}"


class House(Manager):
    """A device needs watts, and those with a program run that as well. The generator is the reserve of the watts."""

    @server("device", recovery="keep")
    def switch_on(self, name: str, watts: float, program: bool) -> float:
        self.registrar.load("budgets/share", Share(WATTS.name, watts, wait_s=0.2), timeout_s=PATIENCE_S)
        if program:
            run = RunProgram("sleep", ("1000",), instance=name)
            self.registrar.load("programs/program", run, timeout_s=PATIENCE_S)
        return watts

    @server("generator", recovery="keep")
    def start_generator(self) -> None:
        self.registrar.load("budgets/supply", Supply(WATTS.name, RESERVE), timeout_s=PATIENCE_S)


class Crew(Manager):
    """A consumer in a process of its own: loads and unloads in a thread, and after a crash goes on with its queries.

    At the message "rest" it stops, and answers how many queries it holds. At "release" it unloads all of them.
    """

    def __init__(self, directory: str, servers: tuple[str, ...]) -> None:
        self.journal = Journal(directory)
        self.servers = servers
        self._resting = threading.Event()
        self._thread = threading.Thread(target=self._work, name="crew", daemon=True)

    def on_start(self) -> None:
        self._thread.start()

    def on_stop(self) -> None:
        self._resting.set()

    def on_receive(self, message: Any) -> Any:
        if message == "cut":
            cut_links()
        elif message == "rest":
            self._resting.set()
            self._thread.join()
            return len(self.registrar.queries())
        elif message == "release":
            self.registrar.unload_all()
        return None

    def _work(self) -> None:
        plan = random.Random()
        held: list[Query] = self.registrar.queries()
        while not self._resting.wait(plan.uniform(0.0, 0.05)):
            kind = "load" if len(held) < 3 or (len(held) < 8 and plan.random() < 0.5) else "unload"
            try:
                if kind == "load":
                    held.append(self.registrar.load(plan.choice(self.servers), Want(plan.randrange(20)), timeout_s=5.0))
                else:
                    held.pop(plan.randrange(len(held))).unload(timeout_s=5.0)
            except RrError as error:
                self.journal.note(self.registrar.name, f"{CREW}{kind}", type(error).__name__)
            except Exception as error:
                self.journal.note(self.registrar.name, UNEXPECTED, type(error).__name__)
                raise
            else:
                self.journal.note(self.registrar.name, f"{CREW}{kind}", SUCCEEDED)


def cut_links() -> int:
    """Shut down every connection of this process to others of its system; return the number."""
    found = 0
    for name in os.listdir("/proc/self/fd"):
        try:
            if not os.readlink(f"/proc/self/fd/{name}").startswith("socket:"):  # nor a socket's file, opened as a path
                continue
            fd = os.dup(int(name))
        except OSError:
            continue
        with socket.socket(fileno=fd) as end:
            try:
                if _LINKS.search(str(end.getsockname())) or _LINKS.search(str(end.getpeername())):
                    end.getpeername()  # raises for a socket that listens
                    end.shutdown(socket.SHUT_RDWR)
                    found += 1
            except OSError:
                continue
    return found


def log_to(directory: Path) -> None:
    """Write this process's log to a file of the directory, and not to standard error."""
    logger = logging.getLogger("rr_actors")
    if logger.handlers:
        return
    logging.raiseExceptions = False  # a full disk is one of the faults
    handler = logging.FileHandler(directory / f"{os.getpid()}.log", delay=True)
    handler.setFormatter(logging.Formatter("%(asctime)s %(levelname)s %(name)s: %(message)s"))
    logger.addHandler(handler)
    logger.propagate = False


if LOG_TO in os.environ:  # in a process of the plant, also a supervisor's, which imports its children's classes here
    log_to(Path(os.environ[LOG_TO]))
