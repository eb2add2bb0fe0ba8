"""The first steps of a child process, and the main program of a fork server.

A process that only starts these does not import this module.
"""

from __future__ import annotations

import atexit
import contextlib
import errno
import gc
import importlib
import logging
import os
import select
import signal
import socket
import sys
import threading
import time
import traceback
import weakref
from collections.abc import Callable, Sequence
from multiprocessing import current_process, parent_process, spawn, util
from multiprocessing.reduction import ForkingPickler
from typing import Any, NoReturn

from rr_actors.base import pickling
from rr_actors.base.scarcity import wanted_by
from rr_actors.runtime import garbage, interpreter
from rr_actors.runtime.processes import fork_server, forked_process, lifeline
from rr_actors.runtime.processes.fork_server import ForkServer, Inherited
from rr_actors.runtime.processes.forked_process import EntryCall

# Private parts of the standard library; the same in Python 3.11, 3.12 and 3.13.
_run_exit_handlers: Callable[[], None] = vars(atexit)["_run_exitfuncs"]
_clear_exit_handlers: Callable[[], None] = vars(atexit)["_clear"]
_FINALIZERS: Any = weakref.finalize

PRELOAD = (
    "rr_actors.supervision.child_main",
    "rr_actors.system.system",
    "rr_actors.system.console.connection",
    "rr_actors.system.recording.stream_recordings",
    "rr_actors.actors.timers",
    "multiprocessing.resource_tracker",
    "tempfile",
)
"""What a fork server imports before it forks: the modules of all public names, so that no child imports any.

And tempfile, with random, shutil and what these need: many programs import them, at 5 ms in each child.
"""

_LEAVE_GRACE_S = 2.0
_AT_EXIT_S = 5.0
"""The longest time for the handlers that were registered with atexit."""
_REQUEST_S = 5.0  # the longest wait for a request that is connected already
_RETRY_S = 0.02  # before the next attempt to accept a connection
_FEWEST_FDS = 3  # of a request: its status, its control channel and its lifeline
_FDS = 16  # more descriptors than a request has
_SAY_WHY = "rr_actors.supervision.child_main:could_not_begin"


def enter(control: socket.socket, life: int, tracker: int | None, family: int, environment: bytes) -> NoReturn:
    """Run a child process from its launch message to its end, on its main thread.

    Args:
        life: its lifeline, by which its launch message comes first.
        tracker: the descriptor of multiprocessing's resource tracker; None: this process may start its own.
        environment: the environment_block() that this process has.
    """
    os.setpgid(0, 0)
    lifeline.mark(family)
    signal.pthread_sigmask(signal.SIG_SETMASK, [])
    fork_server.is_tracked = tracker is not None
    forked_process.run_call = lambda call: _run(call, control, environment)
    try:
        spawn.spawn_main(life, tracker_fd=tracker)
    except pickling.CUT_OFF:  # the sender has ended or given the child up, so a traceback would not help anyone
        os._exit(1)
    raise AssertionError("a child leaves at the end of its call")


def _run(call: EntryCall, control: socket.socket, environment: bytes) -> NoReturn:
    parent = parent_process()
    assert parent is not None
    assert parent.pid is not None
    code = 1
    try:
        if call.environment != environment:
            _set_environment(call.environment)
        lifeline.hold(parent.sentinel, parent.pid)
        code = _called_by_name(call.entry, Inherited(current_process().name, call.payload, control))
    except SystemExit as left:
        code = left.code if isinstance(left.code, int) else int(left.code is not None)
    except BaseException as error:
        _report(control, error)
    finally:
        leave(code)


def _set_environment(block: bytes) -> None:
    """Give this process its parent's environment. Most of it is inherited: to set a variable anew copies memory."""
    environment = dict(variable.split(b"=", 1) for variable in block.split(b"\0") if variable)
    for name in os.environb.keys() - environment.keys():
        del os.environb[name]
    for name, value in environment.items():
        if os.environb.get(name) != value:
            os.environb[name] = value


def _report(control: socket.socket, error: BaseException) -> None:
    """Tell the parent why this child cannot begin, and show the error unless it only says what is wanting."""
    if not (_say_why(control, error) and wanted_by(error)):
        traceback.print_exc()


def _say_why(control: socket.socket, error: BaseException) -> bool:
    """Tell the parent why this child cannot begin. Return False if that is not possible any more."""
    if isinstance(error, pickling.CUT_OFF) or control.fileno() < 0:
        return False
    with contextlib.suppress(Exception):
        _called_by_name(_SAY_WHY, control, error)
        return True
    return False


def _called_by_name(function: str, *arguments: Any) -> Any:
    """Call the function "module:function"; import its module in this process, if the fork server has not."""
    module, _, name = function.partition(":")
    found = sys.modules.get(module) or importlib.import_module(module)
    return getattr(found, name)(*arguments)


def leave(code: int) -> NoReturn:
    """End this process now: run the handlers registered with atexit, flush the standard streams and the logs, and do
    not wait for threads.
    """

    def flush() -> None:
        util.info("process exiting with exitcode %d", code)
        logging.shutdown()
        for stream in (sys.stdout, sys.stderr):
            with contextlib.suppress(Exception):
                stream.flush()

    _in_thread(_run_exit_handlers, _AT_EXIT_S)
    _in_thread(flush, _LEAVE_GRACE_S)
    os._exit(code)


def _in_thread(fn: Callable[[], object], limit_s: float) -> None:
    """Run fn in a thread, at most `limit_s` seconds: another thread may never release a stream's lock, for example.

    If the machine gives no thread, run it here, without a limit.
    """
    thread = threading.Thread(target=fn, daemon=True)
    try:
        thread.start()
    except RuntimeError:
        with contextlib.suppress(Exception):
            fn()
    else:
        thread.join(limit_s)


def _ignore(*_: object) -> None:
    pass


# -- the fork server's main program ----------------------------------------------------------------------------------


def serve(listener: int, alive: int, address: int, errors: int, preload: Sequence[str], family: int) -> None:
    """Run a fork server until its launcher closes it or has ended: its main program. Called without a collector.

    Args:
        errors: the standard error for later. What is written before is the launcher's, if this server never serves.
    """
    os.set_inheritable(address, False)  # children have it, but the programs that they start do not
    fork_server.inherited = ForkServer(address, -1, os.getpid())
    lifeline.mark(family)
    signal.signal(signal.SIGINT, _ignore)  # for its children, too, until they reset their signals
    signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGTTOU])  # what it writes to a terminal may not stop it
    for module in PRELOAD:
        _preload(module)
    gc.freeze()  # the modules, which stay: to collect among them takes a tenth of this start
    gc.enable()
    for module in preload:
        _preload(module)
    interpreter.check_not_patched()
    _show_errors(errors)
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
    _prepare_for_children()
    forking = _Forking(listener, alive, family)
    garbage.share()
    forking.run()
    leave(0)  # a clean end of the interpreter would take 4 ms more, for which System.stop() waits


def _preload(module: str) -> None:
    try:
        importlib.import_module(module)
    except (Exception, SystemExit):
        sys.stderr.write(f"rr_actors: could not preload {module!r}; children start without it\n")
        traceback.print_exc()


def _prepare_for_children() -> None:
    """Do once what each child would do."""
    sys.argv[1:] = ["--multiprocessing-fork"]  # what spawn_main() expects in a child
    pickling.adopt_main()
    ForkingPickler.reducer_override = pickling.of_main_by_value


def _show_errors(errors: int) -> None:
    """Write what has been said to the standard error `errors`, which this process has from now on."""
    sys.stderr.flush()
    with contextlib.suppress(OSError), os.fdopen(os.dup(2), "rb") as said:
        said.seek(0)
        os.write(errors, said.read())
    os.dup2(errors, 2)
    os.close(errors)


class _Forking:
    """The loop of a fork server: fork a child for each connection, collect the children, and send their exit codes.

    multiprocessing's own loop (multiprocessing.forkserver.main) ends at the first fork that fails. This one answers
    with the error's number, and goes on.
    """

    def __init__(self, listener: int, alive: int, family: int) -> None:
        self._family = family
        self._listener = socket.socket(fileno=listener)
        self._alive = alive
        self._wake, wake = os.pipe2(os.O_NONBLOCK | os.O_CLOEXEC)
        self._own = [alive, self._wake, wake]
        self._statuses: dict[int, int] = {}  # the pipe for the exit code of each child
        self._spare = -1  # without a descriptor left, a connection could not even be refused
        self._signals = {signal.SIGCHLD: signal.signal(signal.SIGCHLD, _ignore)}
        # The parent decides what a ^C means. Not SIG_IGN: programs that a child starts would inherit that.
        self._signals[signal.SIGINT] = _ignore
        signal.signal(signal.SIGINT, signal.SIG_IGN)
        if signal.getsignal(signal.SIGTERM) is not signal.SIG_DFL:
            self._signals[signal.SIGTERM] = signal.SIG_DFL
        signal.set_wakeup_fd(wake)
        self._environment = fork_server.environment_block()

    def run(self) -> None:
        """Serve until the pipe `alive` closes."""
        ready = select.poll()
        for fd in (self._listener.fileno(), self._alive, self._wake):
            ready.register(fd, select.POLLIN)
        while True:
            with contextlib.suppress(MemoryError):
                self._keep_spare()
                fds = {fd for fd, _ in ready.poll()}
                if self._alive in fds:
                    return
                if self._wake in fds:
                    os.read(self._wake, 65536)
                    self._collect()
                if self._listener.fileno() in fds:
                    self._serve()

    def _keep_spare(self) -> None:
        if self._spare < 0:
            with contextlib.suppress(OSError):
                self._spare = os.open(os.devnull, os.O_RDONLY | os.O_CLOEXEC)

    def _collect(self) -> None:
        with contextlib.suppress(ChildProcessError):
            while (ended := os.waitpid(-1, os.WNOHANG))[0]:
                status = self._statuses.pop(ended[0], -1)
                if status >= 0:
                    with contextlib.suppress(BrokenPipeError):  # its parent has ended
                        os.write(status, fork_server.signed(os.waitstatus_to_exitcode(ended[1])))
                    os.close(status)

    def _serve(self) -> None:
        """Answer one connection: with the new process's id, or with an error's number, made negative."""
        try:
            client = self._listener.accept()[0]
        except OSError:  # the connection waits until this process has a descriptor for it
            if self._spare >= 0:
                os.close(self._spare)
                self._spare = -1
            else:
                time.sleep(_RETRY_S)
            return
        with client:
            try:
                answer = self._fork(client)
            except OSError as error:
                answer = -(error.errno or errno.EIO)
            except MemoryError:
                answer = -errno.ENOMEM
            with contextlib.suppress(OSError):  # the client has ended
                client.sendall(fork_server.signed(answer))

    def _fork(self, client: socket.socket) -> int:
        client.settimeout(_REQUEST_S)
        kind, fds, flags, _ = socket.recv_fds(client, 1, _FDS, socket.MSG_CMSG_CLOEXEC)
        try:
            if flags & socket.MSG_CTRUNC:
                raise OSError(errno.EMFILE, os.strerror(errno.EMFILE))
            if len(fds) < _FEWEST_FDS + (kind == fork_server.TRACKED):
                raise ConnectionResetError(errno.ECONNRESET, os.strerror(errno.ECONNRESET))
            status, *trackers, control, life = fds
            pid = os.fork()
            if pid == 0:
                self._be_child(client, status, control, life, trackers[0] if trackers else None)
            self._statuses[pid] = status
            fds.remove(status)
            return pid
        finally:
            for fd in fds:
                os.close(fd)

    def _be_child(self, client: socket.socket, status: int, control: int, life: int, tracker: int | None) -> NoReturn:
        try:
            end = socket.socket(fileno=control)
            try:
                client.close()
                self._leave_to_server(status)
                enter(end, life, tracker, self._family, self._environment)
            except BaseException as error:
                _report(end, error)
        finally:
            os._exit(1)

    def _leave_to_server(self, status: int) -> None:
        """Close what is the server's, in a child, and let signals have their usual effects."""
        signal.set_wakeup_fd(-1)
        for number, handler in self._signals.items():
            signal.signal(number, handler)
        self._listener.close()
        for fd in (*self._own, status, *self._statuses.values()):
            os.close(fd)
        if self._spare >= 0:
            os.close(self._spare)


def _forget_exit_handlers() -> None:
    """Leave the handlers registered with atexit to the fork server: those of its coverage and its preloaded modules.

    Some belong to each process, but are registered once: this package's, and that of multiprocessing, which ends the
    processes that it has started. The next finalizer registers that of weakref.finalize.
    """
    _clear_exit_handlers()
    for finalizer in list(_FINALIZERS._registry):
        finalizer.atexit = False
    _FINALIZERS._registered_with_atexit = False
    for handler in (forked_process.end_multiprocessing, *interpreter.of_each_process):
        atexit.register(handler)


def _see_children_end() -> None:
    """Wait up to 2 s for the end of this process's children, whose lifelines end them, as their parents have ended."""
    deadline = time.monotonic() + _LEAVE_GRACE_S
    with contextlib.suppress(ChildProcessError):
        while time.monotonic() < deadline:
            if os.waitpid(-1, os.WNOHANG)[0] == 0:
                time.sleep(0.002)
