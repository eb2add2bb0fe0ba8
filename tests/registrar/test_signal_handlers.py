"""Signal handlers of the program: those that wait run between the turns of the main thread, and cost it nothing."""

from __future__ import annotations

import asyncio
import contextlib
import functools
import os
import signal
import subprocess
import sys
import textwrap
import threading
import unittest
from collections.abc import Callable, Iterator
from pathlib import Path
from types import FrameType
from typing import Any

import pytest

import rr_actors as rr
from rr_actors.actors import turns
from support import REPOSITORY, Served, eventually
from support_inside import actor_of

Handler = Callable[[int, FrameType | None], object]


@contextlib.contextmanager
def handling(number: signal.Signals, handler: Handler) -> Iterator[None]:
    """Have a handler called for a signal, and known to the registrars."""
    before = signal.signal(number, handler)
    try:
        eventually(lambda: not turns.may_be_interrupted() and signal.getsignal(number) is not handler)
        yield
    finally:
        signal.signal(number, before)


@pytest.fixture
def in_turns(app: rr.Registrar, provider: rr.Registrar, monkeypatch: pytest.MonkeyPatch) -> list[Callable[[], object]]:
    """What is done in the middle of the next turns that this thread takes, one in each."""
    todo: list[Callable[[], object]] = []

    def commit_row(commit: Callable[[Any], bool], row: Any) -> bool:
        committed = commit(row)
        if todo and turns.has_a_turn() and turns.runs_handlers():
            todo.pop()()
        return committed

    for log in (actor_of(app).commits, actor_of(provider).commits):
        monkeypatch.setattr(log, "commit_row", functools.partial(commit_row, log.commit_row))
    return todo


def test_a_handler_that_comes_in_a_turn_is_called_behind_it(
    app: rr.Registrar, served: Served, in_turns: list[Callable[[], object]]
) -> None:
    heard: list[tuple[bool, int]] = []
    with handling(signal.SIGTERM, lambda *_: heard.append((turns.has_a_turn(), len(app.queries())))):
        in_turns.append(lambda: signal.raise_signal(signal.SIGTERM))
        query = app.load("provider/thing", "x")  # of a resource that is held: this thread takes the turns
        eventually(lambda: heard)
    assert in_turns == []
    assert heard == [(False, 2)]
    query.unload()


def test_a_handler_may_join_a_thread_that_needs_the_turn(
    app: rr.Registrar, served: Served, in_turns: list[Callable[[], object]]
) -> None:
    def join(*_: object) -> None:
        thread = threading.Thread(target=lambda: app.load("provider/thing", "x"))
        thread.start()
        thread.join(30)
        joined.append(thread.is_alive())

    joined: list[bool] = []
    with handling(signal.SIGUSR1, join):
        in_turns.append(lambda: signal.raise_signal(signal.SIGUSR1))
        app.load("provider/thing", "x")
        eventually(lambda: joined)
    assert joined == [False]


def test_what_a_handler_raises_in_a_turn_comes_out_behind_it_and_the_turn_stands(
    app: rr.Registrar, provider: rr.Registrar, served: Served, in_turns: list[Callable[[], object]]
) -> None:
    def give_up(*_: object) -> None:
        raise TimeoutError("too long")

    def load_and_wait() -> None:
        app.load("provider/thing", "x")
        threading.Event().wait(30)  # until the signal has come again

    with handling(signal.SIGUSR1, give_up):
        in_turns.append(lambda: signal.raise_signal(signal.SIGUSR1))
        with pytest.raises(TimeoutError, match="too long"):
            load_and_wait()
    assert in_turns == []
    (resource,) = provider.resources()
    assert sorted(resource.queries) == sorted(query.id for query in app.queries())


def test_a_thousand_signals_among_loads_and_unloads_call_a_handler_that_loads_and_nothing_hangs(
    app: rr.Registrar, served: Served
) -> None:
    def send() -> None:
        for number in range(1000):
            os.kill(os.getpid(), signal.SIGUSR1)
            eventually(lambda number=number: len(loaded) > number)

    loaded: list[rr.Query] = []
    sender = threading.Thread(target=send)
    with handling(signal.SIGUSR1, lambda *_: loaded.append(app.load("provider/thing", "x"))):
        sender.start()
        while sender.is_alive():
            app.load("provider/thing", "x").unload()
    assert len(loaded) == 1000
    for query in loaded:
        query.unload()
    assert len(app.queries()) == 1


def test_a_main_thread_with_handlers_takes_turns_as_any_other(
    app: rr.Registrar, served: Served, in_turns: list[Callable[[], object]]
) -> None:
    taken: list[str] = []
    with handling(signal.SIGTERM, lambda *_: None), handling(signal.SIGINT, lambda *_: None):
        in_turns += [lambda: taken.append("unload"), lambda: taken.append("load")]
        app.load("provider/thing", "x").unload()
    assert taken[0] == "load"


def test_a_program_of_asyncio_takes_turns_and_keeps_its_handlers(
    app: rr.Registrar, served: Served, in_turns: list[Callable[[], object]]
) -> None:
    async def main() -> None:
        asyncio.get_running_loop().add_signal_handler(signal.SIGTERM, lambda: None)
        before = [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)]
        in_turns.append(lambda: taken.append(1))
        with pytest.warns(RuntimeWarning, match="blocks the event loop"):
            app.load("provider/thing", "x").unload()
        assert [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)] == before

    taken: list[int] = []
    ctrl_c = signal.getsignal(signal.SIGINT)
    asyncio.run(main())
    assert taken == [1]
    assert signal.getsignal(signal.SIGINT) is ctrl_c


def test_a_handler_that_its_owner_compares_stays_as_it_is(app: rr.Registrar, served: Served) -> None:
    ctrl_c = signal.getsignal(signal.SIGINT)
    unittest.installHandler()
    try:
        installed = signal.getsignal(signal.SIGINT)
        app.load("provider/thing", "x").unload()
        eventually(lambda: not turns.may_be_interrupted())
        assert signal.getsignal(signal.SIGINT) is installed
    finally:
        unittest.removeHandler()
        signal.signal(signal.SIGINT, ctrl_c)


STOPPED = """
    import os, signal, sys
    import rr_actors as rr

    class Lamps(rr.Manager):
        @rr.server("lamp")
        def load_lamp(self, request: int) -> int:
            return request

    def end(*_):
        system.stop()
        os.write(1, b"stopped\\n")
        os._exit(0)

    signal.signal(signal.SIGTERM, end)
    system = rr.System([rr.ChildSpec(Lamps, id="lamps", placement="thread")], state_dir=sys.argv[1]).start()
    app = system.open_registrar("app")
    held = app.load("lamps/lamp", 1)
    print("loads", flush=True)
    while True:
        app.load("lamps/lamp", 1).unload()
"""


@pytest.mark.parametrize("run", range(5))
def test_a_service_that_stops_its_system_in_a_handler_stops_while_it_loads(tmp_path: Path, run: int) -> None:
    program = subprocess.Popen(
        [sys.executable, "-c", textwrap.dedent(STOPPED), str(tmp_path / f"state{run}")],
        env=dict(os.environ, PYTHONPATH=str(REPOSITORY)),
        stdout=subprocess.PIPE,
        text=True,
    )
    with program:
        assert program.stdout is not None
        assert program.stdout.readline() == "loads\n"
        for _ in range(run * 7):
            program.poll()
        program.send_signal(signal.SIGTERM)
        assert program.communicate(timeout=30)[0] == "stopped\n"
    assert program.returncode == 0
