"""What managers log reaches the application's logging; and the names that ps shows."""

from __future__ import annotations

import logging
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

import rr_actors as rr
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


def test_a_manager_whose_records_find_no_free_worker_lives_on_and_the_log_says_what_was_lost(
    start: Start, heard: Calls, caplog: pytest.LogCaptureFixture
) -> None:
    system, gate = start(rr.ChildSpec(Lamps, id="lamps"), config=rr.SystemConfig(workers_limit=2)), Gate()
    pid = pid_of(system, "lamps")
    app, provider = system.open_registrar("app"), system.open_registrar("provider")
    serve(provider, "slow", load=gate)
    waiting = [app.load("provider/slow", number, block=False) for number in range(2)]
    gate.wait_arrived(2)

    app.load("lamps/lamp", "hall")
    eventually(lambda: all(f"its record {said!r} is lost" in caplog.text for said in ("on in hall: 100%", "failed")))
    gate.open()
    for reply in waiting:
        reply.get(timeout=30)
    app.load("lamps/lamp", "kitchen")

    assert heard.wait(2)[0].getMessage() == "on in kitchen: 100%"
    assert pid_of(system, "lamps") == pid


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
