"""Immovable objects: objects that are of use in their own process only, and what to use instead.

They hold a descriptor, a lock, a thread or a loop. Some of them can be pickled, as numbers and settings: the copy of a
pipe's end would close a descriptor of the receiver, and the copy of an asyncio.Event would never be set. Types are
known by name, so none of their modules has to be imported.
"""

from __future__ import annotations

import sys
import weakref

REPORT = "pass the reference of an actor (self.actor_ref) and tell it what you would send"
_PIPE = f"{REPORT}; messages between actors need no pipe"
_QUEUE = f"{REPORT}: an actor's mailbox is the queue"
_LOCK = "let one actor own what the lock protects, and ask that actor"
_EVENT = f"{REPORT}; or watch for an actor's end with rr_actors.monitor"
_SHARED = "let one actor own the value, and ask that actor; multiprocessing.shared_memory.SharedMemory may travel"
_FUTURE = "send its result (.result(), .get()), or return the future's value from the handler"
_FILE = "send the path and open it there, or send what you have read"
_OPEN_THERE = "send what is needed to open it (an address, a path), and open it there"
_PROCESS = "make what it runs a child of a supervisor (ChildSpec), and send that child's reference"
_ACTOR = "send its reference (actor_ref)"
_PLAIN_REF = (
    "only references of rr_actors reach other processes: derive the actor from rr_actors.Actor, or make it a child "
    "(ChildSpec) and send what system.ref(id) returns"
)
_LAZY = "send a list of what it yields"

NEEDLES = (b"multiprocessing.connection", b"asyncio.locks", b"asyncio.queues")
"""The modules of those immovable classes that plain pickle accepts: each pickle of such an object has the name."""

_INSTEAD: dict[str, str | None] = {
    "_io.StringIO": None,
    "_io.BytesIO": None,
    "multiprocessing.connection._ConnectionBase": _PIPE,
    "multiprocessing.connection.Listener": _OPEN_THERE,
    "multiprocessing.queues.Queue": _QUEUE,
    "multiprocessing.queues.SimpleQueue": _QUEUE,
    "multiprocessing.synchronize.SemLock": _LOCK,
    "multiprocessing.synchronize.Condition": _LOCK,
    "multiprocessing.synchronize.Event": _EVENT,
    "multiprocessing.sharedctypes.SynchronizedBase": _SHARED,
    "multiprocessing.process.BaseProcess": _PROCESS,
    "multiprocessing.pool.Pool": _PROCESS,
    "_socket.socket": _OPEN_THERE,
    "sqlite3.Connection": _OPEN_THERE,
    "sqlite3.Cursor": _OPEN_THERE,
    "subprocess.Popen": _PROCESS,
    "mmap.mmap": _SHARED,
    "_io._IOBase": _FILE,
    "tempfile._TemporaryFileWrapper": _FILE,
    "_thread.lock": _LOCK,
    "_thread.RLock": _LOCK,
    "threading.Condition": _LOCK,
    "threading.Semaphore": _LOCK,
    "threading.Barrier": _LOCK,
    "threading.Event": _EVENT,
    "threading.Thread": _PROCESS,
    "queue.Queue": _QUEUE,
    "_queue.SimpleQueue": _QUEUE,
    "asyncio.locks.Lock": _LOCK,
    "asyncio.locks.Condition": _LOCK,
    "asyncio.locks.Semaphore": _LOCK,
    "asyncio.locks.Barrier": _LOCK,
    "asyncio.locks.Event": _EVENT,
    "asyncio.queues.Queue": _QUEUE,
    "_asyncio.Future": _FUTURE,
    "asyncio.futures.Future": _FUTURE,
    "concurrent.futures._base.Future": _FUTURE,
    "concurrent.futures._base.Executor": _PROCESS,
    "pykka._future.Future": _FUTURE,
    "pykka._actor.Actor": _ACTOR,
    "pykka._ref.ActorRef": _PLAIN_REF,
    "builtins.generator": _LAZY,
    "builtins.coroutine": "await it here, and send its result",
}

_STREAMS = ("stdin", "stdout", "stderr", "__stdin__", "__stdout__", "__stderr__")

_known: weakref.WeakKeyDictionary[type, str | None] = weakref.WeakKeyDictionary()


def instead_of(value: object) -> str | None:
    """Return what to use instead of `value`, if it cannot leave its process; None if it can."""
    cls = type(value)
    try:
        hint = _known[cls]
    except KeyError:
        hint = _known[cls] = _hint(cls)
    if hint is _FILE and any(value is getattr(sys, name, None) for name in _STREAMS):
        return None  # travels as "the standard output of the process it comes to"
    return hint


def name_of(value: object) -> str:
    """Return how an error calls an immovable object: "multiprocessing.connection.Connection"."""
    cls = type(value)
    return cls.__qualname__ if cls.__module__ == "builtins" else f"{cls.__module__}.{cls.__qualname__}"


def _hint(cls: type) -> str | None:
    for base in cls.__mro__:
        name = f"{base.__module__}.{base.__qualname__}"
        if name in _INSTEAD:
            return _INSTEAD[name]
        if base.__module__ not in _MODULES and not _TAUGHT.isdisjoint(vars(base)):
            return None  # this class has pickling code of its own
    return None


_TAUGHT = {"__reduce__", "__reduce_ex__", "__getstate__"}
_MODULES = {name.rpartition(".")[0] for name in _INSTEAD} | {"socket", "builtins"}
