"""The control lane: stop, health and exit messages never wait behind a full mailbox."""

from __future__ import annotations

import os
import signal
import threading
import time
from collections.abc import Callable
from typing import Any

import pytest

import rr_actors as rr
from rr_actors.runtime import event_loop
from support import eventually

Start = Callable[..., rr.System]

FULL = 500


class Busy(rr.Actor):
    """Takes its time for each message; its mailbox is soon full."""

    mailbox_limit = FULL

    def on_receive(self, message: Any) -> Any:
        match message:
            case "pid":
                return os.getpid()
            case "lock the loop":
                process = event_loop.current()
                assert process is not None
                process.call(threading.Event().wait)
            case "fail":
                raise ValueError("as it was told")
            case _:
                threading.Event().wait(0.05)
        return None


def fill(ref: rr.ActorRef[Any]) -> None:
    """Until there is no room left; the letters that are on their way to another process count as well."""
    for number in range(FULL + 5):
        try:
            ref.tell(number)
        except rr.MailboxFull:
            return


def child(system: rr.System) -> Any:
    return system.supervisor().which_children()[0]


@pytest.mark.parametrize("placement", ["process", "thread"])
def test_a_stop_by_the_supervisor_does_not_wait_behind_a_full_mailbox(start: Start, placement: Any) -> None:
    system = start(rr.ChildSpec(Busy, id="busy", placement=placement, shutdown_s=10.0))
    fill(system.ref("busy"))

    began = time.monotonic()
    system.supervisor().terminate_child("busy")

    assert time.monotonic() - began < 5.0  # all its messages take 25 s
    assert [(r.reason, r.detail) for r in system.supervisor().history() if r.event == "stopped"] == [
        ("shutdown", "stopped")
    ]


def test_a_stop_as_shutdown_from_another_process_overtakes_the_messages(start: Start) -> None:
    system = start(rr.ChildSpec(Busy, id="busy", restart="temporary"))
    ref = system.ref("busy")
    fill(ref)

    began = time.monotonic()
    assert ref.stop(reason="shutdown") is True

    assert time.monotonic() - began < 5.0


def test_a_full_mailbox_and_slow_handlers_are_not_taken_for_a_hung_child(start: Start) -> None:
    system = start(rr.ChildSpec(Busy, id="busy", heartbeat_s=0.5))
    ref = system.ref("busy")
    pid = ref.ask("pid")
    fill(ref)

    deadline = time.monotonic() + 2.0  # four times its limit
    eventually(lambda: time.monotonic() > deadline)

    assert child(system).pid == pid
    assert [r for r in system.supervisor().history() if r.event == "exited"] == []


@pytest.mark.parametrize("how", ["SIGSTOP", "lock the loop"])
def test_a_child_that_hangs_behind_a_full_mailbox_is_found_and_replaced(start: Start, how: str) -> None:
    system = start(rr.ChildSpec(Busy, id="busy", heartbeat_s=1.0))
    ref = system.ref("busy")
    pid = ref.ask("pid")
    if how == "SIGSTOP":
        fill(ref)
        os.kill(pid, signal.SIGSTOP)
    else:
        ref.tell(how)
        fill(ref)

    eventually(lambda: child(system).pid not in (None, pid))

    (record,) = [r for r in system.supervisor().history() if r.event == "exited"]
    assert (record.reason, record.detail.startswith("hung")) == ("abnormal", True)


def test_the_end_of_a_child_is_noticed_though_its_supervisors_process_is_flooded(start: Start) -> None:
    system = start(rr.ChildSpec(Busy, id="busy", placement="thread"), rr.ChildSpec(Busy, id="other"))
    other = system.ref("other")
    fill(system.ref("busy"))
    pid = other.ask("pid")
    down = rr.monitor(other)

    began = time.monotonic()
    os.kill(pid, signal.SIGKILL)

    assert down.wait(10) is not None
    assert time.monotonic() - began < 5.0
