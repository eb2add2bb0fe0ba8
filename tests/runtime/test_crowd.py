"""Callbacks of which there are very many: a few threads take them in turn, and none of them is refused or stuck."""

from __future__ import annotations

import os
import signal
import threading
import time
from pathlib import Path
from typing import Any

import pytest

import rr_actors as rr
from rr_actors.base.errors import Unavailable
from rr_actors.runtime.event_loop import Dispatcher
from support import Calls, eventually, wait_respawned


def submit(dispatcher: Dispatcher, count: int, fn: Any, done: Calls) -> None:
    def all_at_once() -> None:
        for number in range(count):
            try:
                dispatcher.workers.submit(fn, number, done=done, patient=True)
            except Unavailable as error:
                done(None, error)

    dispatcher.call(all_at_once)


def test_a_crowd_of_quick_callbacks_takes_few_threads_and_each_result_comes_to_the_loop(dispatcher: Dispatcher) -> None:
    done = Calls()
    threads: set[int] = set()

    def callback(number: int) -> int:
        threads.add(threading.get_ident())
        return number * 2

    submit(dispatcher, 3000, callback, done)

    outcomes = done.wait(3000)
    assert sorted(result for result, error in outcomes if error is None) == list(range(0, 6000, 2))
    assert len(threads) < 100


def test_callbacks_that_wait_for_one_another_all_run(dispatcher: Dispatcher) -> None:
    done = Calls()
    together = threading.Barrier(100)
    submit(dispatcher, 100, lambda _number: together.wait(20.0) >= 0, done)
    assert [error for _, error in done.wait(100)] == [None] * 100


def test_no_callback_is_refused_because_all_threads_are_taken(dispatcher: Dispatcher) -> None:
    dispatcher.workers.threads.limit = 4
    release, running, done = threading.Event(), threading.Semaphore(0), Calls()

    def callback(_number: int) -> None:
        running.release()
        assert release.wait(20.0)

    for _ in range(2):
        dispatcher.workers.submit(callback, 0)
    submit(dispatcher, 50, callback, done)
    for _ in range(4):
        assert running.acquire(timeout=20.0)
    release.set()
    assert [error for _, error in done.wait(50)] == [None] * 50
    assert len(dispatcher.workers.threads) <= 4


def test_what_a_callback_raises_is_its_own(dispatcher: Dispatcher) -> None:
    done = Calls()

    def callback(number: int) -> int:
        if number % 2:
            raise SystemExit(number)
        return number

    submit(dispatcher, 10, callback, done)
    outcomes = done.wait(10)
    assert sorted(str(error) for _, error in outcomes if error is not None) == ["1", "3", "5", "7", "9"]


def test_async_callbacks_and_those_that_return_a_coroutine_run_as_well(dispatcher: Dispatcher) -> None:
    done = Calls()

    async def callback(number: int) -> int:
        return number

    submit(dispatcher, 5, callback, done)
    submit(dispatcher, 5, lambda number: callback(number), done)
    assert sorted(result for result, _ in done.wait(10)) == [0, 0, 1, 1, 2, 2, 3, 3, 4, 4]


def test_what_is_submitted_when_the_process_is_stopping_hears_so(dispatcher: Dispatcher) -> None:
    done = Calls()
    dispatcher.workers.close()
    submit(dispatcher, 2, lambda number: number, done)
    assert [type(error) for _, error in done.wait(2)] == [Unavailable, Unavailable]


# -- registrars with very many resources -------------------------------------------------------------------------------


class Shelf(rr.Manager):
    """Writes down what is put on it, asked after, and taken away."""

    def note(self, what: str) -> None:
        with (self.registrar.directory.parent.parent / "log").open("a") as file:  # beside the state directory
            file.write(what + "\n")

    @rr.server("thing")
    def put(self, request: int) -> int:
        return request

    @put.unload
    def take_away(self, request: int, response: int) -> None:
        time.sleep(0.001)  # longer than it takes to begin the next
        self.note(f"unload {request}")

    @put.recover
    def ask_after(self, request: int, response: int) -> int:
        time.sleep(0.001)
        self.note(f"recover {request}")
        return response


class Box(Shelf):
    """A box holds things of its own."""

    @rr.server("box")
    def fill(self, request: int) -> int:
        for number in range(3):
            self.registrar.load(f"{self.registrar.name}/thing", request * 10 + number)
        return request

    @fill.unload
    def empty(self, request: int, response: int) -> None:
        self.note(f"unload box {request}")


def system_with(manager: type[Shelf], tmp_path: Path) -> rr.System:
    config = rr.SystemConfig(workers_limit=16)
    consumer = rr.ChildSpec(rr.Manager, id="early")
    return rr.System([consumer, rr.ChildSpec(manager, id="shelf")], state_dir=tmp_path / "state", config=config)


def lines(tmp_path: Path) -> list[str]:
    log = tmp_path / "log"
    return log.read_text().splitlines() if log.exists() else []


def load(consumer: rr.Registrar, server: str, count: int) -> list[rr.Query]:
    return [consumer.load(server, number) for number in range(count)]


def test_more_resources_than_there_may_be_threads_are_all_asked_after(tmp_path: Path) -> None:
    with system_with(Shelf, tmp_path) as system:
        queries = load(system.open_registrar("app"), "shelf/thing", 300)
        (pid,) = [child.pid for child in system.supervisor().which_children() if child.id == "shelf"]
        assert pid is not None
        os.kill(pid, signal.SIGKILL)
        eventually(lambda: len(lines(tmp_path)) == 300)
        wait_respawned(system, "shelf", pid)  # its servers are asked before it is up
        eventually(lambda: len(system.registrar("shelf").resources()) == 300)
        assert {resource.status for resource in system.registrar("shelf").resources()} == {rr.State.OK}
        assert {query.state for query in queries} == {rr.State.OK}


def test_a_system_that_holds_thousands_lets_go_of_all_of_them_when_it_stops(tmp_path: Path) -> None:
    with system_with(Shelf, tmp_path) as system:
        load(system.open_registrar("app"), "shelf/thing", 2000)
        began = time.monotonic()
        system.stop()
        assert time.monotonic() - began < system.config.stop_timeout_s, "it did not come to its time limit"
    assert sorted(lines(tmp_path)) == sorted(f"unload {number}" for number in range(2000))
    with system_with(Shelf, tmp_path) as system:
        assert system.registrar("shelf").resources() == []
        assert system.open_registrar("app").queries() == []


def test_what_a_stopping_manager_serves_goes_with_what_it_depends_on_behind_it(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    with system_with(Box, tmp_path) as system:
        load(system.registrar("early"), "shelf/box", 40)  # held by one that stops later
        system.stop()
    log = lines(tmp_path)
    assert len(log) == 160
    for box in range(40):
        at = log.index(f"unload box {box}")
        things = [log.index(f"unload {box * 10 + number}") for number in range(3)]
        assert at < things[2] < things[1] < things[0], log
    assert "expected" not in caplog.text
