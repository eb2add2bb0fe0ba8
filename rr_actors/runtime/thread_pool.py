"""Threads: what runs tasks, a thread each, and reuses those that are idle.

Waking a thread costs more than most callbacks take. So submitting wakes one thread, however many tasks there are. The
loop does so when it has submitted all: a thread that is woken at the first may be done with it before the next comes. A
thread that takes a task while others remain wakes the next before it starts. So a few threads do quick callbacks one
after another, and none waits for one that blocks. Creating a thread is slow on a busy machine, so only one is created
at a time: what there is to do meanwhile is left to that one.
"""

from __future__ import annotations

import contextlib
import enum
import functools
import itertools
import threading
from collections import deque
from collections.abc import Callable, Hashable
from contextvars import Context
from typing import Any

import msgspec

from rr_actors.base.errors import MailboxFull, Unavailable
from rr_actors.base.scarcity import NO_THREAD
from rr_actors.runtime.shielding import shielded
from rr_actors.runtime.thread_wakeup import Bell, new_bell
from rr_actors.runtime.user_loop import Done, is_coroutine

_QUICK = 8  # threads with a bell that takes file descriptors


class WhenFull(enum.Enum):
    """What becomes of a task when all threads that there may be are busy."""

    REFUSED = enum.auto()
    WAITS = enum.auto()
    GETS_A_THREAD = enum.auto()


REFUSED, WAITS, GETS_A_THREAD = WhenFull  # to look up an enum's member takes 0.1 µs before Python 3.12


class Task(msgspec.Struct, frozen=True, eq=False):
    """A call to be made."""

    fn: Callable[..., Any]
    args: tuple[Any, ...]
    done: Done | None
    context: Context
    when_full: WhenFull = REFUSED
    key: Hashable = None  # of the queue it is the first of; None for none
    at_once: Callable[[Any], bool] | None = None  # what its thread does with the result; True: `done` is not told

    def call(self) -> tuple[Any, BaseException | None]:
        """Make it; how it ended, as Done gets it."""
        try:
            return self.context.run(self.fn, *self.args), None
        except BaseException as error:  # SystemExit too: it is the callback's, not this thread's
            return None, error


class _Thread:
    """A worker thread. One that is idle waits for its bell."""

    __slots__ = ("bell", "idle", "leaves", "quick", "thread")

    def __init__(self, *, quick: bool) -> None:
        self.quick = quick
        self.bell: Bell = new_bell(quick=quick)
        self.idle = False  # whether it is among the idle ones; the one that takes it out rings
        self.leaves = False
        self.thread: threading.Thread | None = None


class Threads:
    """Worker threads: as many as there are running tasks, and those that have not been idle for long.

    Args:
        tell: called as tell(task, result, error, idle) when a task has ended, or the system gives no thread for it.
            `idle`: the thread that ran it, and calls this, has nothing more to do now.
        go_on: called as go_on(task, result, error) instead for a task with a key, or one that gave a coroutine; returns
            what the thread is to run next for it.
        deliver: called as deliver(done, result, error) from any thread; brings `done` to the loop.
        limit: the most threads at a time. While not all are known to be busy, more is taken, and waits for a free one.
        idle_s: after how many seconds without work a thread ends.
    """

    def __init__(
        self,
        tell: Callable[[Task, Any, BaseException | None, bool], None],
        go_on: Callable[[Task, Any, BaseException | None], Task | None],
        deliver: Callable[..., None],
        *,
        limit: int,
        idle_s: float,
        name: str,
    ) -> None:
        self.limit = limit
        self._tell = tell
        self._go_on = go_on
        self._deliver = deliver
        self._idle_s = idle_s
        self._name = name
        self._lock = threading.Lock()
        self._tasks: deque[Task] = deque()  # not begun; while there are any, a thread is coming, or all are busy
        self._coming: _Thread | None = None  # one that is woken or started, and has not looked for a task yet
        self._starting = False  # whether one that has come is starting another, and will then look for what is left
        self._idle_quick: list[_Thread] = []  # last in, first out: the surplus is what grows old
        self._idle_others: list[_Thread] = []
        self._all: set[_Thread] = set()
        self._quick = 0
        self._gathering = False  # whether what is submitted waits for go()
        self._numbers = itertools.count(1)
        self._closed = False

    def __len__(self) -> int:
        return len(self._all)

    def start(self, task: Task) -> None:
        """Have a thread run it; returns at once."""
        try:
            with self._lock:
                self._add(task)
                worker = None if self._gathering else self._fetch()
            if worker is not None:
                self._bring_for(task, worker)
        except Unavailable:
            raise
        except BaseException:  # what a signal's handler raises, an Exception or not: whatever is done, a thread comes
            with contextlib.suppress(Unavailable):
                self._deliver(self._come_again, None, None)
            raise

    def _bring_for(self, task: Task, worker: _Thread) -> None:
        try:
            self._bring(worker)
        except MailboxFull:
            with self._lock:
                if task not in self._tasks or (task.when_full is WAITS and self._all):
                    return  # a thread has become free, or will be
                self._tasks.remove(task)
            raise

    def _add(self, task: Task) -> None:
        if self._closed:
            raise Unavailable("the workers are closed: this process is stopping")
        if task.when_full is GETS_A_THREAD:
            self._tasks.appendleft(task)  # before those that wait for a free one
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
        """A thread that was to bring a worker was interrupted: bring it, perhaps once more. On the loop."""
        with self._lock:
            worker = self._coming or self._fetch()
        self._bring_or_refuse(worker)

    def gather(self) -> None:
        """Wake nobody for what is submitted from now on, until go(), which must follow at once. On the loop."""
        self._gathering = True

    def go(self) -> None:
        """Have a thread come for what was gathered. On the loop."""
        self._gathering = False
        if not self._tasks:  # a submitting thread appends first, and looks then whether it is gathered
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
        """End the idle threads, and the others after what they are doing; returns those that have not ended yet."""
        with self._lock:
            self._closed = True
            idle = [*self._idle_quick, *self._idle_others]
            self._idle_quick.clear()
            self._idle_others.clear()
            threads = [worker.thread for worker in self._all if worker.thread is not None and worker.thread.is_alive()]
        for worker in idle:
            worker.idle = False
            worker.bell.ring()  # with no task: it ends
        return threads

    def abandon(self) -> None:
        """In a forked child: refuse everything, since the threads are not there."""
        self._lock = threading.Lock()  # another thread may have held it at the fork
        self._closed = True

    def _is_full(self) -> bool:
        return len(self._all) >= self.limit and not (self._idle_quick or self._idle_others)

    def _fetch(self) -> _Thread | None:
        """With the lock: the thread that comes for the first task, idle or new; then bring it, without the lock.

        None if one is coming, or none can: the next thread that is free takes the task.
        """
        if self._coming or not self._tasks:
            return None
        idle = self._idle_quick or self._idle_others
        if idle:
            worker = idle[-1]
            # From here on nothing is called, so that no signal handler comes between.
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
        name = f"{self._name}-worker-{next(self._numbers)}"
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
        """A thread has come: what it is to do, unless another was faster; what is left, others come for.

        While it starts others it has no task of its own: they take what was there first, and it takes what is left.
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
        """Tell those that wait that the system gives them no thread; what nobody hears of, a free thread does."""
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
        """With the lock: the next task; without one the thread is idle from now on."""
        if self._tasks:
            return self._tasks.popleft()
        if self._closed:
            worker.leaves = True
        else:
            worker.idle = True
            (self._idle_quick if worker.quick else self._idle_others).append(worker)
        return None

    def _wait(self, worker: _Thread) -> bool:
        """Wait for the bell; False if the thread has grown old."""
        while worker.bell.wait(self._idle_s):
            if not worker.idle:
                return True  # else it was rung twice for what it did before
        with self._lock:
            if worker.idle:
                worker.idle = False
                (self._idle_quick if worker.quick else self._idle_others).remove(worker)
                return False
        return worker.bell.wait()  # fetched at the last moment

    def _run(self, worker: _Thread, task: Task) -> Task | None:
        """Run it, and take the next; the thread is idle if there is none."""
        result, error = task.call()
        if task.key is None and not is_coroutine(result):
            with self._lock:  # idle before `done` is called: what it submits next finds this thread
                following = self._next(worker)
            self._tell(task, result, error, following is None)
            return following
        following = self._go_on(task, result, error)
        if following is not None:
            return following
        with self._lock:
            return self._next(worker)
