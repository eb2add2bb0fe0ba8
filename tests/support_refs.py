"""Two processes with actors for the tests of references: `Home` is this one's side, `main` the other's.

What a Home starts says "ready" when its actors can be reached, and leaves when its standard input is closed.
"""

from __future__ import annotations

import asyncio
import os
import signal
import subprocess
import sys
import threading
from pathlib import Path
from typing import Any

import pykka

from rr_actors.actors.actor import Actor, BaseActor, LoopActor
from rr_actors.actors.refs import ActorRef
from rr_actors.actors.remote import hub
from rr_actors.actors.remote.hub import ActorHub, set_hub
from rr_actors.actors.remote.protocol import CODECS
from rr_actors.runtime.event_loop import acquire, release
from rr_actors.wire.name_service import Directory, Presence, StateDir, actor_key, open_state_dir
from rr_actors.wire.unix_transport import UnixTransport
from support import TEST_PATHS


class OddError(Exception):
    """Cannot be made again from its args."""

    def __init__(self, left: str, right: str) -> None:
        super().__init__(f"{left} and {right}")
        self.left = left
        self.right = right
        self.lock = threading.Lock()


class OpenedOn:
    """Notes in which thread it was unpickled."""

    def __init__(self) -> None:
        self.thread = ""

    def __reduce__(self) -> tuple[Any, ...]:
        return _opened_here, ()


def _opened_here() -> OpenedOn:
    made = OpenedOn()
    made.thread = threading.current_thread().name
    return made


class Part:
    """A traversable attribute."""

    def double(self, value: int) -> int:
        return 2 * value


class Common:
    """What the actors of the other process do, on whatever they are based."""

    part = pykka.traversable(Part())
    size = 3

    def __init__(self) -> None:
        super().__init__()
        self.items: list[Any] = []
        self.greeting = "hello"

    def on_receive(self, message: Any) -> Any:
        if message == "pid":
            return os.getpid()
        if message == "thread":
            return threading.current_thread().name
        if message == "unpicklable":
            return {"fine": 1, "lock": [threading.Lock()]}
        if isinstance(message, OpenedOn):
            return message.thread
        if callable(message):
            return message(self)
        self.items.append(message)
        return message

    def method(self, value: int, *, factor: int = 1) -> int:
        return value * factor

    def fail(self, text: str) -> None:
        raise KeyError(text)

    def fail_oddly(self) -> None:
        error = OddError("this", "that")
        error.add_note("look there")
        raise error from KeyError("first")

    def ask_back(self, ref: Any, message: Any) -> Any:
        return ref.ask(message)

    def start_another(self) -> Any:
        return Remote.start()

    def wait_for_ever(self) -> None:
        threading.Event().wait()

    def keep(self, ref: Any) -> bool:
        self.kept = ref
        return ref.ask("kept") == "kept"


class Remote(Common, Actor):
    """An actor of ours."""


class RemoteSmall(Remote):
    """One with a small mailbox."""

    mailbox_limit = 2


class RemoteAsync(Common, Actor):
    """One whose handlers are coroutines."""

    async def on_receive(self, message: Any) -> Any:
        await asyncio.sleep(0)
        if isinstance(message, tuple):
            ref, what = message
            return await ref.ask(what, block=False)
        return message


class RemoteLoop(Common, LoopActor):
    """One whose handlers run on the loop."""


class RemoteThread(Common, pykka.ThreadingActor):
    """A plain Pykka actor."""


class Factory(Actor):
    """Starts supervised actors in its process, so that a test need not start a process."""

    def make(self, id: str, cls: str) -> None:
        assert Home.own is not None
        Home.own.host_named(id, cls)


class Home:
    """One process's hub on a real transport and directory. The test's own is the first of a system."""

    own: Home | None = None

    def __init__(self, run_dir: Path, key: bytes, name: str, **transport_options: Any) -> None:
        self.run_dir = run_dir
        self.key = key
        self.dispatcher = acquire()
        self.directory = Directory(run_dir)
        self.transport = UnixTransport(run_dir, key, CODECS, **transport_options)
        self.hub = ActorHub(self.dispatcher, self.transport, self.directory, name=name)
        self.dispatcher.run(self.transport.listen(self.hub.accept))
        self.others: list[subprocess.Popen[str]] = []
        self.hosted: list[ActorRef[Any]] = []
        set_hub(self.hub)
        Home.own = self

    def host(self, path: str, cls: type[BaseActor]) -> ActorRef[Any]:
        """Start a supervised actor here."""
        ref: Any = self.dispatcher.run(cls.launch(path=path))
        self.hosted.append(ref)
        self.hub.add(path, ref)
        return ref

    def host_named(self, id: str, cls: str) -> None:
        """Start the actor "root/<id>" of a class of this module here."""
        if cls == "RemoteThread":
            self.hub.add(f"root/{id}", RemoteThread.start())
        else:
            self.host(f"root/{id}", globals()[cls])

    def start_other(self, **actors: str) -> subprocess.Popen[str]:
        """Start another process with these actors, class by id, and wait until they can be reached."""
        other = start_process(self.run_dir, self.key, **actors)
        self.others.append(other)
        return other

    def kill(self, other: subprocess.Popen[str]) -> None:
        """SIGKILL, and wait until it is gone."""
        other.send_signal(signal.SIGKILL)
        other.wait(10)

    def mark(self, path: str, status: Presence) -> None:
        """What a supervisor does."""
        self.directory.mark(actor_key(path), status)

    def close(self) -> None:
        """Let everything go."""
        for other in self.others:
            end_process(other)
        for ref in reversed(self.hosted):
            ref.stop(timeout=10)
        pykka.ActorRegistry.stop_all(timeout=10)
        forget_hubs()
        self.dispatcher.run(self._close())
        release()

    async def _close(self) -> None:
        self.hub.close()
        await self.transport.close()


def forget_hubs() -> None:
    """Have no system in this process, as if there had never been one."""
    while (known := hub.hub()) is not None:
        name, known.name = known.name, f"{known.name}/child"  # with the hub of a child no system has stopped
        hub.remove_hub(known)
        known.name = name


def open_home(state_dir: Path, **transport_options: Any) -> tuple[Home, StateDir]:
    """The test's side of a new system, and its state directory, to be closed after it."""
    state = open_state_dir(state_dir)
    return Home(state.run_dir, state.key, "root", **transport_options), state


def start_process(run_dir: Path, key: bytes, **actors: str) -> subprocess.Popen[str]:
    """Start a process with these actors, class by id, and wait until they can be reached."""
    process = subprocess.Popen(
        [
            *(sys.executable, "-c", "import support_refs; support_refs.main()"),
            *(str(run_dir), key.hex()),
            *(f"{id}={cls}" for id, cls in actors.items()),
        ],
        env=os.environ | {"PYTHONPATH": TEST_PATHS},
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )
    assert process.stdout is not None
    assert process.stdout.readline() == "ready\n"
    return process


def end_process(process: subprocess.Popen[str]) -> None:
    """Let it leave, and wait until it has."""
    assert process.stdin is not None
    assert process.stdout is not None
    process.send_signal(signal.SIGCONT)
    process.stdin.close()
    process.wait(10)
    process.stdout.close()


def main() -> None:
    """What the other process does."""
    run_dir, key, *actors = sys.argv[1:]
    home = Home(Path(run_dir), bytes.fromhex(key), "other")
    for each in actors:
        home.host_named(*each.split("="))
    print("ready", flush=True)
    sys.stdin.read()
    os._exit(0)  # an actor that waits for ever must not keep it
