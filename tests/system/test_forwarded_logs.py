"""What managers log reaches the application's logging; and the names that ps shows."""

from __future__ import annotations

import logging
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

import rr_actors as rr
from rr_actors.runtime import backlogs
from support import Calls, Gate, child, eventually, pid_of, serve

Start = Callable[..., rr.System]
log = logging.getLogger("lamps.app")


class Lamps(rr.Manager):
    @rr.server("lamp")
    def switch_on(self, room: str) -> str:
        log.debug("debug %s", room)
        log.warning("on in %s: 100%%", room)
        try:
            raise ValueError(room)
        except ValueError:
            log.exception("failed")
        return room


class OwnLogging(rr.Manager):
    def on_start(self) -> None:
        logging.basicConfig(format="here: %(message)s")

    @rr.server("lamp")
    def switch_on(self, room: str) -> str:
        log.warning("on in %s", room)
        return room


class Careless(rr.Manager):
    """Logs by a function of the module logging, as a module does that was never part of a larger program."""

    def on_start(self) -> None:
        logging.warning("careless start")  # noqa: LOG015

    @rr.server("lamp")
    def switch_on(self, room: str) -> str:
        log.warning("on in %s", room)
        return room


class Chatty(rr.Manager):
    @rr.server("line")
    def say(self, count: int) -> int:
        for number in range(count):
            log.warning("line %d", number)
        return count


class Slow(logging.Handler):
    """Waits at a gate, and notes each warning of missing records: how many, and after how many that it has taken."""

    def __init__(self, gate: Gate) -> None:
        super().__init__()
        self.missing: list[tuple[str, int]] = []
        self._gate = gate
        self._taken = 0

    def emit(self, record: logging.LogRecord) -> None:
        if record.name == log.name:
            self._taken += 1
            self._gate()
        elif "are missing" in record.getMessage():
            self.missing.append((record.getMessage(), self._taken))


class Heard(logging.Handler):
    def __init__(self) -> None:
        super().__init__()
        self.records = Calls()

    def emit(self, record: logging.LogRecord) -> None:
        if record.name == log.name:
            self.records(record)


@pytest.fixture
def heard() -> Any:
    handler = Heard()
    logging.getLogger().addHandler(handler)
    yield handler.records
    logging.getLogger().removeHandler(handler)


@pytest.mark.parametrize("deep", [False, True])
def test_what_a_manager_logs_reaches_the_applications_handlers(start: Start, heard: Calls, deep: bool) -> None:
    lamps = rr.ChildSpec(Lamps, id="lamps")
    inner = rr.Supervisor([lamps], id="inner", placement="process")
    system = start(rr.Supervisor([inner]) if deep else lamps)
    path = "root/inner/lamps" if deep else "root/lamps"

    system.open_registrar("app").load("lamps/lamp", "hall")

    on, failed = heard.wait(2)
    assert on.getMessage() == "on in hall: 100%"
    assert (on.levelno, on.processName, on.funcName, on.filename) == (
        logging.WARNING, path, "switch_on", Path(__file__).name
    )  # fmt: skip
    assert on.process != os.getpid()
    assert failed.exc_text.endswith("ValueError: hall")


def test_records_of_a_manager_wait_for_a_free_worker(start: Start, heard: Calls) -> None:
    system, gate = start(rr.ChildSpec(Lamps, id="lamps"), config=rr.SystemConfig(workers_limit=2)), Gate()
    app, provider = system.open_registrar("app"), system.open_registrar("provider")
    serve(provider, "slow", load=gate)
    waiting = [app.load("provider/slow", number, block=False) for number in range(2)]
    gate.wait_arrived(2)

    app.load("lamps/lamp", "hall")
    gate.open()
    for reply in waiting:
        reply.get(timeout=30)

    assert [record.getMessage() for record in heard.wait(2)] == ["on in hall: 100%", "failed"]


def test_a_handler_that_is_too_slow_grows_nothing_and_the_log_says_how_many_records_are_missing(
    start: Start, heard: Calls, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(backlogs, "KEPT", 50)
    put, taken = backlogs.Backlog[Any].put, Calls()

    def noted(backlog: backlogs.Backlog[Any], what: Any) -> None:
        put(backlog, what)
        taken(what)

    monkeypatch.setattr(backlogs.Backlog, "put", noted)
    gate = Gate()
    system = start(rr.ChildSpec(Chatty, id="chatty"))
    app = system.open_registrar("app")
    slow = Slow(gate)
    logging.getLogger().addHandler(slow)
    try:
        app.load("chatty/line", 1)
        gate.wait_arrived()
        app.load("chatty/line", 179)
        taken.wait(180)
        gate.open()
        said = [record.getMessage() for record in heard.wait(30)]
        eventually(lambda: len(slow.missing) == 1)
    finally:
        logging.getLogger().removeHandler(slow)

    ((told, after),) = slow.missing
    assert (told.partition(": ")[2], after) == (
        "the logging here is too slow: 150 records of its child processes are missing",
        1,
    )
    assert said == ["line 0", *(f"line {number}" for number in range(150, 179))]


def test_the_levels_of_the_applications_loggers_count(
    start: Start, heard: Calls, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.DEBUG, log.name)
    system = start(rr.ChildSpec(Lamps, id="lamps"))
    app = system.open_registrar("app")
    app.load("lamps/lamp", "hall")
    assert [record.levelname for record in heard.wait(3)] == ["DEBUG", "WARNING", "ERROR"]
    caplog.set_level(logging.ERROR, log.name)
    app.load("lamps/lamp", "attic")
    assert [record.levelname for record in heard.wait(4)[3:]] == ["ERROR"]


def test_a_manager_that_configures_its_own_logging_keeps_its_records(
    start: Start, heard: Calls, capfd: pytest.CaptureFixture[str]
) -> None:
    system = start(rr.ChildSpec(OwnLogging, id="lamps"))
    system.open_registrar("app").load("lamps/lamp", "hall")
    assert "here: on in hall" in capfd.readouterr().err
    assert list(heard) == []


def test_a_manager_that_logs_by_the_module_logging_still_reaches_the_applications_handlers(
    start: Start, heard: Calls
) -> None:
    system = start(rr.ChildSpec(Careless, id="lamps"))
    system.open_registrar("app").load("lamps/lamp", "hall")

    assert [record.getMessage() for record in heard.wait(1)] == ["on in hall"]


def test_switched_off_records_go_to_the_standard_error_of_the_child(
    start: Start, heard: Calls, capfd: pytest.CaptureFixture[str]
) -> None:
    system = start(rr.ChildSpec(Lamps, id="lamps"), config=rr.SystemConfig(logging=False))
    system.open_registrar("app").load("lamps/lamp", "hall")
    assert "on in hall: 100%" in capfd.readouterr().err
    assert list(heard) == []


def test_a_process_is_named_after_its_child(start: Start) -> None:
    system = start(rr.ChildSpec(Lamps, id="lamps"), rr.ChildSpec(Lamps, id="a_longer_name"))
    assert Path(f"/proc/{pid_of(system, 'lamps')}/comm").read_text() == "rr: lamps\n"
    assert Path(f"/proc/{child(system, 'a_longer_name').pid}/comm").read_text() == "rr: a_longer_na\n"
