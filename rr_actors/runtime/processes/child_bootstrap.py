"""The first steps of a child process, and the main program of a fork server.

A process that only starts these does not import this module. Only this module and
rr_actors/runtime/processes/fork_server.py use multiprocessing.
"""

from __future__ import annotations

import atexit
import contextlib
import gc
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

# Private parts of the standard library; the same in Python 3.11, 3.12 and 3.13.
_SERVER: Any = vars(multiprocessing.forkserver)["_forkserver"]
_TRACKER: Any = vars(resource_tracker)["_resource_tracker"]
_run_exit_handlers: Callable[[], None] = vars(atexit)["_run_exitfuncs"]
_clear_exit_handlers: Callable[[], None] = vars(atexit)["_clear"]
_end_multiprocessing: Callable[[], None] = vars(util)["_exit_function"]
_FINALIZERS: Any = weakref.finalize

_LEAVE_GRACE_S = 2.0
_AT_EXIT_S = 5.0
"""The longest time for the handlers that were registered with atexit."""


def enter(entry: str, payload: bytes, name: str, environment: dict[str, str], parent_pid: int, family: int) -> NoReturn:
    """Run a child process from its first step to its end, on its main thread."""
    code = 1
    sys.excepthook = _Hook.before
    try:
        os.setpgid(0, 0)
        lifeline.mark(family)
        signal.pthread_sigmask(signal.SIG_SETMASK, [])
        signal.signal(signal.SIGTERM, signal.SIG_DFL)
        # The parent decides what a ^C means. Not SIG_IGN: programs that this process starts would inherit that.
        signal.signal(signal.SIGINT, _ignore)
        os.environ.clear()
        os.environ.update(environment)
        control, life = _SERVER._inherited_fds
        lifeline.hold(life, parent_pid)
        os.close(_SERVER._forkserver_alive_fd)  # /dev/null here: the server's launcher has the real one
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
    """The hook for unhandled errors, here and in the programs of children."""


def _show_unless_cut_off(kind: type[BaseException], error: BaseException, trace: TracebackType | None) -> None:
    """Show an unhandled error, but not that of an incomplete launch message (sys.excepthook until enter()).

    The sender of that message has ended or given the child up, so a traceback would not help anyone.
    """
    if not isinstance(error, CUT_OFF):
        _Hook.before(kind, error, trace)


def leave(code: int) -> NoReturn:
    """End this process now: run the handlers registered with atexit, flush the standard streams and the logs, and do
    not wait for threads.
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
    """Run fn in a thread, at most `limit_s` seconds: another thread may never release a stream's lock, for example."""
    thread = threading.Thread(target=fn, daemon=True)
    thread.start()
    thread.join(limit_s)


def _ignore(*_: object) -> None:
    pass


def _forget_false_tracker() -> None:
    """Forget /dev/null in the place of a resource tracker, if the parent had none: the child may start its own."""
    if _TRACKER._fd is None:
        return
    os.set_inheritable(_TRACKER._fd, False)
    if os.fstat(_TRACKER._fd).st_rdev == os.stat(os.devnull).st_rdev:
        os.close(_TRACKER._fd)
        _TRACKER._fd = None


# -- the fork server's main program ----------------------------------------------------------------------------------


def serve(listener: int, alive: int, address: int, preload: Sequence[str], family: int) -> None:
    """Run a fork server until its launcher closes it or has ended: its main program."""
    os.set_inheritable(address, False)  # children have it, but the programs that they start do not
    fork_server.inherited = ForkServer(address, -1, os.getpid())
    lifeline.mark(family)
    signal.signal(signal.SIGINT, _ignore)  # for its children, too, until they reset their signals
    gc.freeze()  # the modules, which stay: to collect among them takes a tenth of this start
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
            lifeline.sweep(family)  # their descendants, which no process would end any more

    def leave_handlers() -> None:
        if os.getppid() == server:  # a child of the server, not a process that such a child has forked
            _forget_exit_handlers()

    atexit.register(clean_up)
    os.register_at_fork(after_in_child=leave_handlers)
    garbage.share()
    _Hook.before, sys.excepthook = sys.excepthook, _show_unless_cut_off
    try:
        multiprocessing.forkserver.main(listener, alive, [])
    except SystemExit:  # in the server alone: its children end inside
        leave(0)  # an orderly end of the interpreter would take 4 ms more, for which System.stop() waits


def _forget_exit_handlers() -> None:
    """Leave the handlers registered with atexit to the fork server: those of its coverage and its preloaded modules.

    Some belong to each process, but are registered once: this package's, and that of multiprocessing, which ends the
    processes that it has started. The next finalizer registers that of weakref.finalize.
    """
    _clear_exit_handlers()
    for finalizer in list(_FINALIZERS._registry):
        finalizer.atexit = False
    _FINALIZERS._registered_with_atexit = False
    for handler in (_end_multiprocessing, *interpreter.of_each_process):
        atexit.register(handler)


def _see_children_end() -> None:
    """Wait up to 2 s for the end of this process's children, whose lifelines end them, as their parents have ended."""
    deadline = time.monotonic() + _LEAVE_GRACE_S
    with contextlib.suppress(ChildProcessError):
        while time.monotonic() < deadline:
            if os.waitpid(-1, os.WNOHANG)[0] == 0:
                time.sleep(0.002)
