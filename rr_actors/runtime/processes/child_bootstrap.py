"""Forked: a child process's first steps, and the fork server's main program. Not imported by who only starts them.

With rr_actors/runtime/processes/fork_server.py the only user of multiprocessing.
"""

from __future__ import annotations

import atexit
import contextlib
import importlib
import logging
import multiprocessing.forkserver
import os
import signal
import socket
import sys
import threading
import time
import traceback
import weakref
from collections.abc import Callable, Sequence
from multiprocessing import resource_tracker, util
from types import TracebackType
from typing import Any, NoReturn

from rr_actors.base.pickling import CUT_OFF
from rr_actors.runtime import garbage, interpreter
from rr_actors.runtime.processes import fork_server, lifeline
from rr_actors.runtime.processes.fork_server import ForkServer, Inherited, call_by_name

# What the standard library keeps for itself; the same in Python 3.11, 3.12 and 3.13.
_SERVER: Any = vars(multiprocessing.forkserver)["_forkserver"]
_TRACKER: Any = vars(resource_tracker)["_resource_tracker"]
_run_exit_handlers: Callable[[], None] = vars(atexit)["_run_exitfuncs"]
_clear_exit_handlers: Callable[[], None] = vars(atexit)["_clear"]
_end_multiprocessing: Callable[[], None] = vars(util)["_exit_function"]
_FINALIZERS: Any = weakref.finalize

_LEAVE_GRACE_S = 2.0
_AT_EXIT_S = 5.0
"""How long handlers that were registered with atexit may take."""


def enter(entry: str, payload: bytes, name: str, environment: dict[str, str], parent_pid: int, family: int) -> NoReturn:
    """The first function a child runs, on its main thread."""
    code = 1
    sys.excepthook = _Hook.before
    try:
        os.setpgid(0, 0)
        lifeline.mark(family)
        _reset_signals()
        os.environ.clear()
        os.environ.update(environment)
        control, life = _SERVER._inherited_fds
        lifeline.hold(life, parent_pid)
        os.close(_SERVER._forkserver_alive_fd)  # nothing: who launched the server has it
        _forget_false_tracker()
        code = call_by_name(entry, Inherited(name, payload, socket.socket(fileno=control)))
    except SystemExit as left:
        code = left.code if isinstance(left.code, int) else int(left.code is not None)
    except BaseException:
        traceback.print_exc()
    finally:
        leave(code)


class _Hook:
    before = sys.excepthook
    """What shows what nobody has handled, here and in the programs of children."""


def _show_unless_cut_off(kind: type[BaseException], error: BaseException, trace: TracebackType | None) -> None:
    """In place of sys.excepthook, until a child calls enter(): quiet about a launch message that ends too early.

    Who sent it has ended meanwhile, or has given the child up: it knows, and a traceback would tell people nothing.
    """
    if not isinstance(error, CUT_OFF):
        _Hook.before(kind, error, trace)


def leave(code: int) -> NoReturn:
    """End this process now: the handlers registered with atexit run, and what is written to the standard streams and
    logs goes out; threads are not waited for.
    """

    def flush() -> None:
        logging.shutdown()
        for stream in (sys.stdout, sys.stderr):
            with contextlib.suppress(Exception):
                stream.flush()

    _in_thread(_run_exit_handlers, _AT_EXIT_S)
    _in_thread(flush, _LEAVE_GRACE_S)
    os._exit(code)


def _in_thread(fn: Callable[[], object], limit_s: float) -> None:
    """Run it, and wait no longer than that: a thread that holds a stream's lock, say, may never release it."""
    thread = threading.Thread(target=fn, daemon=True)
    thread.start()
    thread.join(limit_s)


def _reset_signals() -> None:
    signal.pthread_sigmask(signal.SIG_SETMASK, [])
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    # The parent decides what a ^C means. Not SIG_IGN: that would be passed on to programs this process starts.
    signal.signal(signal.SIGINT, _ignore)


def _ignore(*_: object) -> None:
    pass


def _forget_false_tracker() -> None:
    """Where the parent had no resource tracker, the child was given /dev/null: it starts one itself if it needs one."""
    if _TRACKER._fd is None:
        return
    os.set_inheritable(_TRACKER._fd, False)
    if os.fstat(_TRACKER._fd).st_rdev == os.stat(os.devnull).st_rdev:
        os.close(_TRACKER._fd)
        _TRACKER._fd = None


# -- the fork server's main program ----------------------------------------------------------------------------------


def serve(listener: int, alive: int, address: int, preload: Sequence[str], family: int) -> None:
    """The main program of a fork server; ends when its launcher closes it or has ended."""
    os.set_inheritable(address, False)  # children have it, and not what they start
    fork_server.inherited = ForkServer(address, -1, os.getpid())
    lifeline.mark(family)
    signal.signal(signal.SIGINT, _ignore)  # of its children, too, until they reset their signals
    garbage.set_aside()
    for module in preload:
        try:
            importlib.import_module(module)
        except Exception:
            sys.stderr.write(f"rr_actors: could not preload {module!r}; children start without it\n")
            traceback.print_exc()
    server = os.getpid()

    def clean_up() -> None:
        if os.getpid() == server:
            _see_children_end()
            lifeline.sweep(family)  # what they started, by now without anyone to end it

    def leave_handlers() -> None:
        if os.getppid() == server:  # a child of the server, and not what one has forked itself
            _forget_exit_handlers()

    atexit.register(clean_up)
    os.register_at_fork(after_in_child=leave_handlers)
    garbage.share()
    _Hook.before, sys.excepthook = sys.excepthook, _show_unless_cut_off
    try:
        multiprocessing.forkserver.main(listener, alive, [])
    except SystemExit:  # in the server alone: its children end inside
        leave(0)  # to take the interpreter apart would take 4 ms more, for which System.stop() waits


def _forget_exit_handlers() -> None:
    """Leave the handlers registered with atexit to the fork server: of its coverage, of what it has preloaded.

    Some are each process's, and registered once: this package's, that of multiprocessing, which ends what it has
    started, and that of weakref.finalize, which the next finalizer registers.
    """
    _clear_exit_handlers()
    for finalizer in list(_FINALIZERS._registry):
        finalizer.atexit = False
    _FINALIZERS._registered_with_atexit = False
    for handler in (_end_multiprocessing, *interpreter.of_each_process):
        atexit.register(handler)


def _see_children_end() -> None:
    """Wait until the children of this process are gone: their lifelines end them, as their parents are gone."""
    deadline = time.monotonic() + _LEAVE_GRACE_S
    with contextlib.suppress(ChildProcessError):
        while time.monotonic() < deadline:
            if os.waitpid(-1, os.WNOHANG)[0] == 0:
                time.sleep(0.002)
