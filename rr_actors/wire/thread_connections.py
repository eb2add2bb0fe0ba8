"""Connections of threads: a thread that waits for an answer writes the question and reads the answer itself.

It saves two hand-overs between threads, as this process's event loop has no part in it. The other end is an ordinary
link. Asks of actors use these connections, and loads and unloads of registrars. A thread has its connection alone until
it gives it back. If no connection is available, the question goes over the loop's link.

A task of asyncio has a connection in the same way, and awaits the answer on its own event loop.
"""

from __future__ import annotations

import asyncio
import contextlib
import math
import os
import select
import socket
import threading
import time
from collections.abc import Callable
from typing import Any, Generic, TypeVar

from rr_actors.base.errors import RrError, Unavailable
from rr_actors.base.scarcity import wanted_by
from rr_actors.wire.frames import FrameReader, framed
from rr_actors.wire.handshake import DiallerHandshake
from rr_actors.wire.segments import Segments
from rr_actors.wire.transport import Exchange, Hello
from rr_actors.wire.unix_link import Wire
from rr_actors.wire.unix_sockets import SocketDir, pid_of

_DIAL_S = 0.1  # a process with a slower handshake is busy, or hangs: then the loop waits for it
_AGAIN_S = 1.0
_LIMIT = 16  # each takes one file descriptor in this process, two in the other; more threads share the link

E = TypeVar("E", bound=Exchange)


class ThreadConnections(Generic[E]):
    """The connections of one process to another, as long as the link beside them is up. From any thread.

    Attributes:
        closed: whether close() was called.

    Args:
        dial: opens a connection within the given number of seconds; returns None if it cannot.
    """

    def __init__(self, dial: Callable[[float], E | None]) -> None:
        self._dial = dial
        self._lock = threading.Lock()  # held to begin dialling, and to close
        self._idle: list[E] = []
        self._in_use: dict[E, object] = {}  # and who uses it: a thread's number, or what a task's call is named
        self._dialling: set[int] = set()  # the threads that dial
        self._is_adding = False
        self._dial_after = 0.0
        self.closed = False

    @property
    def idle(self) -> list[E]:
        """The connections that no thread uses now."""
        return list(self._idle)

    @property
    def in_use(self) -> list[E]:
        """The connections that threads and tasks use now."""
        return list(self._in_use)

    def take(self, timeout_s: float | None) -> E | None:
        """Return a connection for the calling thread alone, which must give it back or take it out; None: none is free.

        Args:
            timeout_s: how long opening a connection may take, if that is less than the usual limit of 0.1 s.
        """
        try:
            line = self._idle.pop()
        except IndexError:
            return self._dialled(timeout_s)
        self._in_use[line] = threading.get_ident()
        if self.closed:  # perhaps after close() had cut the connections in use
            self.drop(line)
            return None
        return line

    def take_idle(self, user: str, work: Callable[[Callable[[], None]], object]) -> E | None:
        """Return a connection for a task's call alone, which must give it back or drop it; None: none is free.

        It opens none here: an event loop must not wait for a handshake. A call that blocks the event loop of the task
        has the same thread. So the connection is the call's, not the thread's. There is no reference to the task: if
        its event loop is closed before the answer comes, nothing else ends the call than that the task is collected.

        Args:
            user: a name that no other call has, such as its query's id.
            work: runs a function in another thread, or raises an RrError. If no connection is free, it is given one
                that opens another.
        """
        try:
            line = self._idle.pop()
        except IndexError:
            if not self._is_adding:
                self._is_adding = True
                try:
                    work(self._add)
                except BaseException as error:
                    self._is_adding = False
                    if not isinstance(error, RrError):  # such as KeyboardInterrupt
                        raise
                    # else no thread is free, or the workers have ended
            return None
        self._in_use[line] = user
        if self.closed:
            self.drop_mine(user)
            return None
        return line

    def _add(self) -> None:
        try:
            line = self._dialled(None)
            if line is not None:
                self.give_back(line)
        finally:
            self._is_adding = False

    def _dialled(self, timeout_s: float | None) -> E | None:
        me = threading.get_ident()
        try:
            with self._lock:
                if self.closed or len(self._in_use) + len(self._dialling) >= _LIMIT:
                    return None
                self._dialling.add(me)
            if time.monotonic() < self._dial_after:
                return None
            try:
                line = self._dial(_DIAL_S if timeout_s is None else min(timeout_s, _DIAL_S))
            except RrError:
                line = None
            if line is None:
                self._dial_after = time.monotonic() + _AGAIN_S
                return None
            self._in_use[line] = me
            if self.closed:
                self.drop(line)
                return None
            return line
        except BaseException:  # such as KeyboardInterrupt: no caller gets the connection
            self.drop_mine()
            raise
        finally:
            self._dialling.discard(me)

    def give_back(self, line: E) -> None:
        """Make a connection available to other threads: its question has been answered."""
        if self._in_use.pop(line, None) is None:
            line.close()
            return
        self._idle.append(line)
        if self.closed:  # perhaps after close() had closed the idle connections
            self._close_idle()

    def take_out(self, line: E) -> bool:
        """Remove a connection, which the caller must close; return False if the calling thread has given it back."""
        return self._take_out(line, threading.get_ident())

    def _take_out(self, line: E, user: object) -> bool:
        return self._in_use.get(line) == user and self._in_use.pop(line, None) is not None

    def drop(self, line: E) -> None:
        """Close a connection that is lost or has an answer to come, unless the calling thread has given it back."""
        if self.take_out(line):
            line.close()

    def drop_mine(self, user: str = "") -> None:
        """Close all connections of the calling thread, which may have been interrupted in take().

        Args:
            user: close those of this call of a task instead, which may have been interrupted in take_idle().
        """
        me = user or threading.get_ident()
        for line in [line for line, other in list(self._in_use.items()) if other == me]:
            if self._take_out(line, me):
                line.close()

    def cut(self, line: E) -> None:
        """End a connection that is in use: for the thread that waits on it, it is lost. Else do nothing."""
        if line in self._in_use:
            line.cut()

    def close(self) -> None:
        """Close all connections; for threads that wait on them, they are lost."""
        with self._lock:
            self.closed = True
        for line in self.in_use:
            line.cut()
        self._close_idle()

    def _close_idle(self) -> None:
        while self._idle:
            with contextlib.suppress(IndexError):  # another thread was faster
                self._idle.pop().close()


# -- one connection ----------------------------------------------------------------------------------------------------

_CHUNK_BYTES = 65536
_DONT_WAIT = int(socket.MSG_DONTWAIT)  # a plain number: an enum's member is converted in each call


class BlockingLink:
    """An Exchange over a Unix socket.

    Args:
        sockets: the directory of the system's sockets. It stays open: an interrupted thread loses no descriptor.
        key: the system's 32 secret bytes.
        address: the address of the transport to connect to.
        timeout_s: how long the handshake may take.

    Attributes:
        parcels: the large values of this connection.

    Raises:
        RrError: the error with which the other side refused. Unavailable: no transport listens at the address.
    """

    def __init__(
        self,
        sockets: SocketDir,
        key: bytes,
        address: str,
        hello: Hello,
        wire: Wire,
        timeout_s: float,
        segments: Segments,
    ) -> None:
        self._limit = wire.frame_limit_bytes
        self._reader: FrameReader[Any] = FrameReader(wire.decoder, self._limit)
        self._spin = AdaptiveSpin()
        self.parcels = segments.parcels(pid_of(address))
        try:
            self._socket = sockets.connect(address)
        except (OSError, ValueError) as error:
            why = wanted_by(error) or f"nobody listens at {address}: {error}"
            raise Unavailable(f"cannot connect to {hello.to}: {why}") from error
        try:
            self._socket.setblocking(True)
            poll = select.poll()
            poll.register(self._socket, select.POLLIN)
            self._readable = poll.poll
            self._shake_hands(DiallerHandshake(key, hello), timeout_s)
        except OSError as error:
            self.close()
            raise Unavailable(f"{hello.to}: the handshake failed: {error}") from error
        except BaseException:
            self.close()
            raise

    def _shake_hands(self, handshake: DiallerHandshake, timeout_s: float) -> None:
        deadline = time.monotonic() + timeout_s
        while not handshake.done:
            data = self._receive(max(deadline, time.monotonic() + 0.001))
            answer = handshake.receive(data)
            if answer:
                self._socket.sendall(answer)
        if handshake.refusal is not None:
            raise handshake.refusal
        assert handshake.welcome is not None
        self.epoch = handshake.welcome.epoch

    def exchange(self, message: Any, deadline: float) -> Any:
        frame = framed(message, self._limit)
        sent = self._send(frame)
        if sent < len(frame):  # seldom: the buffer of the socket is empty before
            self._send_rest(memoryview(frame)[sent:], deadline)
        messages = self._reader.feed(self._receive_soon(deadline)) or self._rest(deadline)
        return messages[0]

    async def exchange_awaited(self, message: Any, deadline: float) -> Any:
        """Exchange as exchange() does, in a task of asyncio. If it is cancelled, drop the connection.

        Like a thread it spins first, but not for longer than a turn of an event loop takes.
        """
        frame = framed(message, self._limit)
        rest = memoryview(frame)[self._send(frame) :]
        loop = asyncio.get_running_loop()
        while rest:
            await self._is_ready(loop.add_writer, loop.remove_writer, deadline)
            rest = rest[self._send(rest) :]
        data = self._spun(time.monotonic(), _TASK_SPIN_S) if self._spin.worthwhile else b""
        if data and (messages := self._reader.feed(data)):
            return messages[0]
        parked = time.monotonic()
        while True:
            self._check_reader()
            await self._is_ready(loop.add_reader, loop.remove_reader, deadline)
            with contextlib.suppress(BlockingIOError):
                if messages := self._reader.feed(self._read(_DONT_WAIT)):
                    self._spin.parked(time.monotonic() - parked)
                    return messages[0]

    async def _is_ready(self, add: Callable[..., object], remove: Callable[[int], object], deadline: float) -> None:
        loop, fd = asyncio.get_running_loop(), self._socket.fileno()
        ready: asyncio.Future[None] = loop.create_future()
        timer = None if deadline == math.inf else loop.call_later(deadline - time.monotonic(), _set_late, ready)
        add(fd, _set_ready, ready)
        try:
            await ready
        finally:
            if not loop.is_closed():  # else the task is dropped
                remove(fd)
            if timer is not None:
                timer.cancel()
            del ready  # the error that it has has this frame

    def _send(self, data: bytes | memoryview) -> int:
        """Write as much as the kernel takes at once; return the number of bytes."""
        try:
            return self._socket.send(data, _DONT_WAIT)
        except BlockingIOError:
            return 0

    def _send_rest(self, rest: memoryview, deadline: float) -> None:
        """Write the rest as the other side reads it."""
        poll = select.poll()
        poll.register(self._socket, select.POLLOUT)
        while rest:
            if not poll.poll(_milliseconds_until(deadline)):
                raise TimeoutError
            rest = rest[self._send(rest) :]

    def _rest(self, deadline: float) -> list[Any]:
        """Read until a message is complete, and return all messages that are then complete."""
        while True:
            self._check_reader()
            if messages := self._reader.feed(self._receive(deadline)):
                return messages

    def _check_reader(self) -> None:
        if self._reader.error is not None or self._reader.ended:
            raise ConnectionResetError(f"the link has ended: {self._reader.error or 'closed'}")

    def _receive_soon(self, deadline: float) -> bytes:
        """Wait for data as _receive() does, but spin first: a quick answer comes before a thread could wake up."""
        began = time.monotonic()
        if deadline - began < SPIN_LIMIT_S:
            return self._receive(deadline)
        if not self._spin.worthwhile:
            data = self._receive(deadline)
            self._spin.parked(time.monotonic() - began)
            return data
        return self._spun(began, SPIN_LIMIT_S) or self._receive(deadline)

    def _spun(self, began: float, limit_s: float) -> bytes:
        """Return the data that arrives while this thread spins; empty: none has."""
        while True:
            os.sched_yield()  # for the thread that answers, if it waits for this core
            try:
                data = self._read(_DONT_WAIT)  # this call releases Python's lock for other threads
            except BlockingIOError:
                data = b""
            took_s = time.monotonic() - began
            if data or took_s >= limit_s:
                break
        self._spin.spun(took_s, bool(data))
        return data

    def _receive(self, deadline: float) -> bytes:
        # not recv() alone: it also wakes up when the other side has read the question, which costs both sides time
        if not self._readable(_milliseconds_until(deadline)):
            raise TimeoutError
        return self._read()

    def _read(self, flags: int = 0) -> bytes:
        data = self._socket.recv(_CHUNK_BYTES, flags)
        if not data:
            raise ConnectionResetError("closed by the other side")
        return data

    def fileno(self) -> int:
        """Return the descriptor of the connection."""
        return self._socket.fileno()

    def leave(self) -> None:
        """Write nothing any more. The other side ends the connection when it has read all that was written."""
        with contextlib.suppress(OSError):  # the connection is lost
            self._socket.shutdown(socket.SHUT_WR)

    def has_ended(self) -> bool:
        """Read and drop all data that has arrived; return whether the connection has ended."""
        try:
            while self._socket.recv(_CHUNK_BYTES, _DONT_WAIT):
                pass
        except BlockingIOError:
            return False
        except OSError:
            return True
        return True

    def cut(self) -> None:
        with contextlib.suppress(OSError):  # the connection is lost, or its thread has closed it
            self._socket.shutdown(socket.SHUT_RDWR)

    def close(self) -> None:
        """Close the connection."""
        self._socket.close()
        self.parcels.close()


def _set_ready(ready: asyncio.Future[None]) -> None:
    if not ready.done():
        ready.set_result(None)


def _set_late(ready: asyncio.Future[None]) -> None:
    if not ready.done():
        ready.set_exception(TimeoutError())


def _milliseconds_until(deadline: float) -> float | None:
    return None if deadline == math.inf else max(0.0, deadline - time.monotonic()) * 1e3


# -- spin, then park ---------------------------------------------------------------------------------------------------
#
# Waking a thread takes longer than a quick answer. Spinning instead occupies a core, and is wasted if the answer takes
# longer, or if other threads have the core or Python's lock. So the thread remembers how useful spinning was lately, as
# adaptive mutexes do.

SPIN_LIMIT_S = 200e-6

_TASK_SPIN_S = 100e-6  # other tasks of the event loop wait meanwhile

_QUICK_S = 2 * SPIN_LIMIT_S  # a parked thread sees the answer only when it has been woken
_EARNED_SPINNING_S = 50e-6  # two wake-ups are saved
_EARNED_PARKED_S = 6e-6
_BUDGET_MAX_S = 2 * SPIN_LIMIT_S
_BUDGET_MIN_S = -20e-3


class AdaptiveSpin:
    """Decides for one thread at a time whether to spin for the next answer.

    It keeps an account of time. Wasted spinning costs the time it took, including what other threads took meanwhile.
    An answer that comes while spinning earns 50 µs, a quick one to a parked thread 6 µs, a slow one nothing. With
    nothing left, a thread does not spin. So any number of slow answers cost SPIN_LIMIT_S twice in all. Answers that are
    always a little late, or always wait for other threads during the spinning, cost 6 µs each.

    Attributes:
        worthwhile: whether to spin for the next answer, for SPIN_LIMIT_S at most.
    """

    __slots__ = ("_budget_s", "worthwhile")

    def __init__(self) -> None:
        self._budget_s = SPIN_LIMIT_S
        self.worthwhile = True

    def spun(self, took_s: float, answered: bool) -> None:
        """Note that spinning has ended after `took_s` seconds, and whether the answer had come by then."""
        if answered and took_s <= SPIN_LIMIT_S:
            if self._budget_s < _BUDGET_MAX_S:
                self._budget_s = min(_BUDGET_MAX_S, self._budget_s + _EARNED_SPINNING_S)
        else:
            self._budget_s = max(_BUDGET_MIN_S, self._budget_s - took_s)
            self.worthwhile = self._budget_s > 0

    def parked(self, took_s: float) -> None:
        """Note that an answer has come after `took_s` seconds to a thread that did not spin."""
        if took_s <= _QUICK_S:
            self._budget_s += _EARNED_PARKED_S
            self.worthwhile = self._budget_s > 0
