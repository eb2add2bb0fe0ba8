"""Threads: run tasks, each in a thread, and reuse idle threads.

Waking a thread takes longer than most callbacks. So submitting wakes one thread, however many tasks there are. The loop
wakes it after the last task: woken at the first task, it could be idle again before the second comes. A thread that
takes a task while others remain wakes the next thread before it starts. So a few threads run quick callbacks one after
another, and no task waits for one that blocks. Creating a thread is slow on a busy machine, so only one is created at a
time: the tasks that come meanwhile are left to it.
"""

from __future__ import annotations

import contextlib
import enum
import functools
import itertools
import os
import select
import threading
from collections import deque
from collections.abc import Callable, Hashable
from contextvars import Context
from typing import Any

import msgspec

from rr_actors.base.errors import MailboxFull, Unavailable
from rr_actors.base.scarcity import NO_THREAD
from rr_actors.runtime.shielding import shielded
from rr_actors.runtime.user_loop import COROUTINE, Done

_LIMIT = 4096  # the most threads at a time, if SystemConfig.workers_limit says nothing else
_IDLE_S = 10.0  # a thread without work for that long ends
_QUICK = 8  # the most threads with an EventBell, which takes file descriptors


class WhenFull(enum.Enum):
    """The fate of a task when as many threads as allowed are busy."""

    REFUSED = enum.auto()
    WAITS = enum.auto()
    GETS_A_THREAD = enum.auto()


REFUSED, WAITS, GETS_A_THREAD = WhenFull  # to look up an enum's member takes 0.1 µs before Python 3.12


class Task(msgspec.Struct, frozen=True, eq=False):
    """A call for a worker thread."""

    fn: Callable[..., Any]
    args: tuple[Any, ...]
    done: Done | None
    context: Context
    when_full: WhenFull = REFUSED
    key: Hashable = None  # the key of the queue whose first task this is; None without a queue
    at_once: Callable[[Any], bool] | None = None  # called by the thread with the result; if True, `done` is not called

    def call(self) -> tuple[Any, BaseException | None]:
        """Make the call; return its result and its error, as Done takes them."""
        try:
            return self.context.run(self.fn, *self.args), None
        except BaseException as error:  # SystemExit, too: it must not end this thread
            return None, error


class _Thread:
    """A worker thread, which waits for its bell while it is idle."""

    __slots__ = ("bell", "idle", "leaves", "quick", "thread")

    def __init__(self, *, quick: bool) -> None:
        self.quick = quick
        self.bell: Bell = new_bell(quick=quick)
        self.idle = False  # whether it is in a list of idle threads; the thread that takes it out rings the bell
        self.leaves = False
        self.thread: threading.Thread | None = None


class Threads:
    """Worker threads: one for each running task, and those that became idle lately.

    Args:
        tell: called as tell(task, result, error, idle) when a task has ended, or the system gives no thread for it.
            `idle`: the calling thread ran the task, and has no other task now.
        go_on: called as go_on(task, result, error) instead for a task with a key, or one that gave a coroutine; returns
            the task that the thread runs next.
        deliver: that of Workers.

    Attributes:
        limit: the most threads at a time. While not all are known to be busy, more tasks are accepted, and wait.
    """

    def __init__(
        self,
        tell: Callable[[Task, Any, BaseException | None, bool], None],
        go_on: Callable[[Task, Any, BaseException | None], Task | None],
        deliver: Callable[..., None],
    ) -> None:
        self.limit = _LIMIT
        self._tell = tell
        self._go_on = go_on
        self._deliver = deliver
        self._lock = threading.Lock()
        self._tasks: deque[Task] = deque()  # not begun; while it is not empty, a thread is coming, or all are busy
        self._coming: _Thread | None = None  # a thread that was woken or started, and has not taken a task yet
        self._starting = False  # whether a thread that has come is starting another, and will then take a task
        self._idle_quick: list[_Thread] = []  # last in, first out: so only the surplus threads grow old
        self._idle_others: list[_Thread] = []
        self._all: set[_Thread] = set()
        self._quick = 0
        self._gathering = False  # whether submitted tasks wait for go()
        self._numbers = itertools.count(1)
        self._closed = False

    def __len__(self) -> int:
        return len(self._all)

    def start(self, task: Task) -> None:
        """Submit a task to the threads. Returns at once."""
        try:
            with self._lock:
                self._add(task)
                worker = None if self._gathering else self._fetch()
            if worker is not None:
                self._bring_for(task, worker)
        except Unavailable:
            raise
        except BaseException:  # a signal handler's error: the task may be queued, so a thread must come
            with contextlib.suppress(Unavailable):
                self._deliver(self._come_again, None, None)
            raise

    def _bring_for(self, task: Task, worker: _Thread) -> None:
        try:
            self._bring(worker)
        except MailboxFull:
            with self._lock:
                if task not in self._tasks or (task.when_full is WAITS and self._all):
                    return  # a thread has taken the task, or will
                self._tasks.remove(task)
            raise

    def _add(self, task: Task) -> None:
        if self._closed:
            raise Unavailable("the workers are closed: this process is stopping")
        if task.when_full is GETS_A_THREAD:
            self._tasks.appendleft(task)  # before the tasks that wait for a free thread
        elif self._idle_quick or self._coming or self._starting or task.when_full is WAITS or not self._is_full():
            self._tasks.append(task)
        else:
            raise MailboxFull(
                f"workers: all {self.limit} threads are running callbacks; expected fewer callbacks that block at a "
                f"time. Let them return, make them `async def`, or raise SystemConfig.workers_limit",
                name="workers",
                limit=self.limit,
            )

    def _come_again(self, _result: None, _error: None) -> None:
        """Bring a worker, perhaps once too often, because the thread that brought it was interrupted. On the loop."""
        with self._lock:
            worker = self._coming or self._fetch()
        self._bring_or_refuse(worker)

    def gather(self) -> None:
        """Wake no thread for tasks submitted from now on, until go(), which must follow at once. On the loop."""
        self._gathering = True

    def go(self) -> None:
        """Bring a thread for the gathered tasks. On the loop."""
        self._gathering = False
        if not self._tasks:  # a submitting thread appends its task first, and then reads _gathering
            return
        with self._lock:
            worker = self._fetch()
        self._bring_or_refuse(worker)

    def _bring_or_refuse(self, worker: _Thread | None) -> None:
        if worker is None:
            return
        try:
            self._bring(worker)
        except MailboxFull as error:
            self._refuse(error)

    def close(self) -> list[threading.Thread]:
        """End the idle threads at once, and the others after their tasks; return the threads that still run."""
        with self._lock:
            self._closed = True
            idle = [*self._idle_quick, *self._idle_others]
            self._idle_quick.clear()
            self._idle_others.clear()
            threads = [worker.thread for worker in self._all if worker.thread is not None and worker.thread.is_alive()]
        for worker in idle:
            worker.idle = False
            worker.bell.ring()  # there is no task for it: it ends
        return threads

    def abandon(self) -> None:
        """Refuse everything, in a forked child: it does not have the threads."""
        self._lock = threading.Lock()  # another thread may have held it at the fork
        self._closed = True

    def _is_full(self) -> bool:
        return len(self._all) >= self.limit and not (self._idle_quick or self._idle_others)

    def _fetch(self) -> _Thread | None:
        """Choose an idle or new thread for the first task, with the lock; bring it then, without the lock.

        Return None if a thread is coming, or none can come: the next free thread takes the task.
        """
        if self._coming or not self._tasks:
            return None
        idle = self._idle_quick or self._idle_others
        if idle:
            worker = idle[-1]
            # From here on no call is made, so no signal handler can run in between.
            self._coming = worker
            worker.idle = False
            del idle[-1]
        elif self._starting or (self._is_full() and self._tasks[0].when_full is not GETS_A_THREAD):
            return None
        else:
            quick = self._quick < _QUICK
            worker = _Thread(quick=quick)
            self._all.add(worker)
            self._quick += quick
            self._coming = worker
        return worker

    def _bring(self, worker: _Thread) -> None:
        if worker.thread is not None:
            worker.bell.ring()
        else:
            shielded(functools.partial(self._begin, worker))

    def _begin(self, worker: _Thread) -> None:
        name = f"rr-worker-{next(self._numbers)}"
        worker.thread = threading.Thread(target=self._work, args=(worker,), name=name, daemon=True)
        try:
            worker.thread.start()
        except RuntimeError as error:  # the system's own limit of threads
            with self._lock:
                self._coming = None
            self._left(worker)
            threads = len(self._all)
            text = f"workers: the system gives no more than {threads} threads ({error}): {NO_THREAD}"
            raise MailboxFull(text, name="workers", limit=threads) from error

    def _work(self, worker: _Thread) -> None:
        while True:
            task = self._take(worker)
            while task is not None:
                task = self._run(worker, task)
            if worker.leaves or not self._wait(worker):
                break
        self._left(worker)

    def _left(self, worker: _Thread) -> None:
        with self._lock:
            self._all.discard(worker)
            self._quick -= worker.quick
        worker.bell.close()

    def _take(self, worker: _Thread) -> Task | None:
        """Return a task for a thread that has come, or None if others were faster; bring threads for the other tasks.

        While the thread starts others it gives its task back: they take the first tasks, and it takes one that is left.
        """
        other: _Thread | None = None
        while True:
            with self._lock:
                if other is None:
                    self._coming = None
                else:
                    self._starting = False
                task = self._next(worker)
                other = self._fetch()
                if task is None or other is None or other.thread is not None:
                    break
                self._starting = True
                self._tasks.appendleft(task)
            try:
                self._bring(other)
            except MailboxFull as error:
                with self._lock:
                    self._starting = False
                    task = self._next(worker)
                self._refuse(error)
                return task
        if other is not None:
            self._bring(other)
        return task

    def _refuse(self, error: MailboxFull) -> None:
        """End waiting tasks with the error that no thread is left; those without `done`, or with a key, wait on."""
        refused: list[Task] = []
        with self._lock:
            waiting = list(self._tasks)
            self._tasks.clear()
            for task in waiting:
                is_heard = task.done is not None and task.key is None
                may_wait = task.when_full is WAITS and self._all
                (refused if is_heard and not may_wait else self._tasks).append(task)
        for task in refused:
            self._tell(task, None, error, False)

    def _next(self, worker: _Thread) -> Task | None:
        """Return the next task, with the lock; without a task, mark the thread as idle."""
        if self._tasks:
            return self._tasks.popleft()
        if self._closed:
            worker.leaves = True
        else:
            worker.idle = True
            (self._idle_quick if worker.quick else self._idle_others).append(worker)
        return None

    def _wait(self, worker: _Thread) -> bool:
        """Wait for the bell; return False if the thread was idle for `_IDLE_S` seconds."""
        while worker.bell.wait(_IDLE_S):
            if not worker.idle:
                return True  # otherwise the bell was rung twice for an earlier task
        with self._lock:
            if worker.idle:
                worker.idle = False
                (self._idle_quick if worker.quick else self._idle_others).remove(worker)
                return False
        return worker.bell.wait()  # _fetch() chose this thread at the last moment

    def _run(self, worker: _Thread, task: Task) -> Task | None:
        """Run a task and return the next; without one the thread is idle."""
        result, error = task.call()
        if task.key is None and type(result) is not COROUTINE:
            with self._lock:  # idle before `done` is called: a task that it submits finds this thread
                following = self._next(worker)
            self._tell(task, result, error, following is None)
            return following
        following = self._go_on(task, result, error)
        if following is not None:
            return following
        with self._lock:
            return self._next(worker)


# -- bells: an idle thread waits for its own ---------------------------------------------------------------------------
#
# A thread that is woken while its waker holds Python's lock sleeps again at once, until it gets the lock: that is most
# of the cost of a hand-over between threads. An EventBell is rung without the lock. It takes two file descriptors, so
# only a few workers have one.


def new_bell(*, quick: bool) -> Bell:
    """Return an EventBell if `quick` is true and file descriptors are left, else a LockBell."""
    if quick:
        try:
            return EventBell()
        except OSError:
            pass  # no descriptors: a LockBell is slower
    return LockBell()


class LockBell:
    """A bell without a descriptor: there may be any number of them."""

    __slots__ = ("_lock",)

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._lock.acquire()

    def ring(self) -> None:
        """End the present wait, or the next one."""
        with contextlib.suppress(RuntimeError):  # it has been rung
            self._lock.release()

    def wait(self, timeout_s: float = -1) -> bool:
        """Wait for a ring, at most `timeout_s` seconds (for ever if negative); return whether there was one."""
        return self._lock.acquire(timeout=timeout_s)

    def close(self) -> None:
        """Close the bell's descriptors, of which this one has none. No thread may ring it any more."""


class EventBell:
    """A bell that wakes quickly, with the methods of LockBell.

    The thread that rings it releases Python's lock, so the woken thread can begin at once. It is closed at the latest
    when its last reference is gone.

    Raises:
        OSError: the process has no file descriptors left.
    """

    __slots__ = ("_fd", "_held", "_poll")

    def __init__(self) -> None:
        self._held: list[int] = []
        self._poll = select.epoll()
        # All in C: a signal handler runs before this line or after it, so the descriptor is never lost.
        self._held.extend(map(os.eventfd, (0,)))
        self._fd = self._held[0]
        self._poll.register(self._fd, select.EPOLLIN | select.EPOLLET)  # each ring is seen once: no need to read it

    def ring(self) -> None:
        os.eventfd_write(self._fd, 1)

    def wait(self, timeout_s: float = -1) -> bool:
        return bool(self._poll.poll(timeout_s, 1))

    def close(self) -> None:
        """Close the bell's descriptors. A second call does nothing."""
        self._poll.close()
        self._fd = -1
        deque(map(os.close, map(self._held.pop, (0,) * len(self._held))), maxlen=0)  # in C, as above

    def __del__(self) -> None:
        if getattr(self, "_held", None):  # it is missing if __init__ was interrupted at once
            self.close()


Bell = LockBell | EventBell
"""A bell that any thread rings, once for each wait."""
