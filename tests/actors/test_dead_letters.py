"""Dead letters: messages to dead actors are counted, kept and shown."""

from __future__ import annotations

import logging
import os
import signal
import threading
from collections.abc import Callable
from typing import Any

import pykka
import pytest

import rr_actors as rr
from rr_actors.actors.messaging import dead_letters
from rr_actors.actors.messaging.dead_letters import EVENTS_A_SECOND, KEPT, Office
from rr_actors.base.errors import TEXT_LIMIT
from support import Calls, Gate, eventually
from support_inside import node_of

Start = Callable[..., rr.System]


class Worker(rr.Actor):
    def on_receive(self, message: Any) -> Any:
        match message:
            case "pid":
                return os.getpid()
            case ("tell", ref, what):
                try:
                    ref.tell(what)
                except pykka.ActorDeadError as error:
                    return str(error)
            case ("ask", ref):
                return ref.ask("wait")
            case "fail":
                raise ValueError("as it was told")
        return message


class Narrow(Worker):
    mailbox_limit = 1


class Unopened:
    """It can be sent, and not opened where it arrives."""

    def __reduce__(self) -> tuple[Any, ...]:
        return getattr, (1, "x" * 10_000)


class Odd:
    """Its text cannot be had, or is too long."""

    def __init__(self, text: str | None) -> None:
        self.text = text

    def __repr__(self) -> str:
        if self.text is None:
            raise LookupError("no text")
        return self.text


def letters(system: rr.System) -> list[tuple[str, str, str]]:
    return [(letter.to, letter.message, letter.why) for letter in system.dead_letters().letters]


def test_a_message_to_a_dead_actor_is_counted_kept_and_shown(start: Start) -> None:
    system = start(rr.ChildSpec(Worker, id="a", placement="thread"))
    assert system.dead_letters() == rr.DeadLetters(0, [])
    system.supervisor().terminate_child("a")

    with pytest.raises(pykka.ActorDeadError):
        system.ref("a").tell({"some": "message"})
    with pytest.raises(pykka.ActorDeadError):
        system.ref("a").ask("another")

    found = system.dead_letters()
    assert found.count == 2
    assert [(letter.to, letter.message) for letter in found.letters] == [
        ("root/a", "{'some': 'message'}"),
        ("root/a", "'another'"),
    ]
    assert all(letter.pid == os.getpid() and letter.at > 0 for letter in found.letters)
    assert str(found).startswith("2 dead letters\n")
    assert "to root/a: 'another' (has ended" in str(found)


def test_what_an_actor_had_not_handled_when_it_stopped_are_dead_letters(system: rr.System) -> None:
    gate = Gate()

    class Busy(rr.Actor):
        def on_receive(self, message: Any) -> None:
            gate()
            self.stop("shutdown")

    busy = Busy.start()
    busy.tell("first")
    gate.wait_arrived()
    busy.tell("second")
    reply = busy.ask("third", block=False)
    gate.open()

    with pytest.raises(pykka.ActorDeadError):
        reply.get(timeout=10)
    assert [(message, why) for _, message, why in letters(system)] == [
        ("'second'", "stopped before handling it"),
        ("'third'", "stopped before handling it"),
    ]


def test_what_waits_for_an_actor_that_is_abandoned_is_refused_at_once(start: Start) -> None:
    gate = Gate()

    class Stuck(rr.Actor):
        def on_receive(self, message: Any) -> None:
            gate()

    system = start(rr.ChildSpec(Stuck, id="a", placement="thread", shutdown_s=0.1))
    ref = system.ref("a")
    ref.tell("first")
    gate.wait_arrived()
    ref.tell("second")
    reply = ref.ask("third", block=False)
    system.supervisor().terminate_child("a")

    try:
        with pytest.raises((pykka.ActorDeadError, rr.ActorUnavailable)):
            reply.get(timeout=1)
        assert [(to, message) for to, message, _ in letters(system)] == [("root/a", "'second'"), ("root/a", "'third'")]
    finally:
        gate.open()


def test_a_stop_is_no_letter(system: rr.System) -> None:
    actor = Worker.start()
    actor.stop()

    assert actor.stop() is False
    assert system.dead_letters().count == 0


def test_a_message_to_an_actor_that_is_being_started_again_is_one(start: Start) -> None:
    backoff = rr.Backoff(delay_s=30.0)
    system = start(rr.ChildSpec(Worker, id="a", backoff=backoff))
    ref = system.ref("a")
    os.kill(ref.ask("pid"), signal.SIGKILL)
    eventually(lambda: system.supervisor().which_children()[0].state == "restarting")

    with pytest.raises(rr.ActorUnavailable):
        ref.tell("hello")

    assert letters(system) == [("root/a", "'hello'", "is being started again")]


def test_a_full_mailbox_makes_no_dead_letters(system: rr.System) -> None:
    gate = Gate()

    class Small(rr.Actor):
        mailbox_limit = 1

        def on_receive(self, message: Any) -> None:
            gate()

    small = Small.start()
    small.tell(1)
    gate.wait_arrived()
    small.tell(2)
    with pytest.raises(rr.MailboxFull):
        small.tell(3)
    gate.open()
    small.stop()

    assert system.dead_letters().count == 0


def test_letters_lost_between_processes_are_noted_where_they_are_lost(start: Start) -> None:
    system = start(rr.ChildSpec(Worker, id="a"))
    mine = Worker.start()
    mine.stop()

    a = system.ref("a")
    a.ask(("tell", mine, "hello"))  # it cannot know yet

    eventually(lambda: system.dead_letters().count == 1)
    ((to, message, why),) = letters(system)
    assert to == str(mine.actor_urn)
    assert message.endswith("bytes>")
    assert why == f"sent by root/a (pid {a.ask('pid')}), found nobody"


def test_a_told_message_that_a_full_mailbox_refuses_in_another_process_is_one_there(
    start: Start, caplog: pytest.LogCaptureFixture
) -> None:
    gate, events = Gate(), Calls()

    class Keeper(rr.Actor):
        def on_receive(self, message: Any) -> None:
            gate()

    system = start(rr.ChildSpec(Narrow, id="a"))
    system.subscribe(lambda event: events(event) if event["event"] == "dead_letter" else None)
    a = system.ref("a")
    pid = a.ask("pid")
    keeper = Keeper.start()
    a.tell(("ask", keeper))
    gate.wait_arrived()
    for _ in range(3):
        a.tell("hello")

    heard = events.wait(2)
    gate.open()
    ((to, message, why),) = set(letters(system))
    assert to == "root/a"
    assert message.endswith("bytes>")
    assert why.startswith(f"sent by root (pid {os.getpid()}), not taken: MailboxFull: mailbox of root/a: holds 1 mess")
    assert {event["pid"] for event in heard} == {pid}
    assert system.dead_letters().count == 2
    assert "Traceback" not in caplog.text
    keeper.stop()


def test_a_full_mailbox_of_this_process_makes_letters_of_what_others_tell_it(start: Start) -> None:
    gate = Gate()

    class Small(rr.Actor):
        mailbox_limit = 1

        def on_receive(self, message: Any) -> None:
            gate()

    system = start(rr.ChildSpec(Worker, id="a"))
    a = system.ref("a")
    small = Small.start()
    small.tell(1)
    gate.wait_arrived()
    small.tell(2)
    a.ask(("tell", small, 3))

    eventually(lambda: system.dead_letters().count == 1)
    gate.open()
    ((to, _, why),) = letters(system)
    assert to == str(small.actor_urn)
    assert why.startswith(f"sent by root/a (pid {a.ask('pid')}), not taken: MailboxFull: mailbox of Small")
    small.stop()


def test_a_told_message_that_cannot_be_opened_is_one(start: Start) -> None:
    system = start(rr.ChildSpec(Worker, id="a"))
    system.ref("a").tell(Unopened())

    eventually(lambda: system.dead_letters().count == 1)
    ((to, message, why),) = letters(system)
    assert to == "root/a"
    assert message.endswith("bytes>")
    assert why.startswith("cannot be opened: AttributeError: 'int' object has no attribute 'xxx")
    assert len(why) < TEXT_LIMIT + 20
    assert system.ref("a").ask("pid") > 0  # it lives on


def test_a_message_that_is_too_long_for_its_connection_is_one(start: Start) -> None:
    config = rr.SystemConfig(frame_limit_bytes=100_000, segments_limit_bytes=0)
    system = start(rr.ChildSpec(Worker, id="a"), config=config)
    system.ref("a").tell(b"x" * 200_000)

    eventually(lambda: system.dead_letters().count == 1)
    ((to, message, why),) = letters(system)
    assert to == "root/a"
    assert message.endswith("bytes>")
    assert "over the limit of 100000" in why


def test_those_of_all_processes_are_told_as_events_and_shown(start: Start) -> None:
    system = start(rr.ChildSpec(Worker, id="a"), rr.ChildSpec(Worker, id="b"))
    events = Calls()
    system.subscribe(lambda event: events(event) if event["event"] == "dead_letter" else None)
    system.supervisor().terminate_child("b")

    said = system.ref("a").ask(("tell", system.ref("b"), "hello"))
    with pytest.raises(pykka.ActorDeadError):
        system.ref("b").tell("hello")

    assert "root/b not found" in said
    heard = events.wait(2)
    assert {event["pid"] for event in heard} == {os.getpid(), system.ref("a").ask("pid")}
    assert {(event["to"], event["message"]) for event in heard} == {("root/b", "'hello'")}
    assert system.dead_letters().count == 2
    assert [letter.message for letter in system.dead_letters().letters] == ["'hello'"] * 2


def test_the_newest_are_kept_and_all_are_counted(system: rr.System) -> None:
    dead = Worker.start()
    dead.stop()
    for number in range(KEPT + 5):
        with pytest.raises(pykka.ActorDeadError):
            dead.tell(number)

    found = system.dead_letters()
    assert found.count == KEPT + 5
    assert len(found.letters) == KEPT
    assert (found.letters[0].message, found.letters[-1].message) == ("5", str(KEPT + 4))


def test_a_message_is_shown_shortened_and_need_not_have_a_text(system: rr.System) -> None:
    dead = Worker.start()
    dead.stop()
    for message in (Odd("x" * 10_000), Odd(None), "y" * 10_000):
        with pytest.raises(pykka.ActorDeadError):
            dead.tell(message)

    shown = [letter.message for letter in system.dead_letters().letters]
    assert all(len(text) <= TEXT_LIMIT for text in shown)
    assert shown[0].startswith("xxx")
    assert "Odd" in shown[1]


def test_what_other_processes_tell_does_not_wait_for_the_text_of_a_message_of_this_one(start: Start) -> None:
    gate = Gate()

    class Slow:
        def __repr__(self) -> str:
            gate()
            return "slow"

    system = start(rr.ChildSpec(Worker, id="a"))
    gone = Worker.start()
    gone.stop()
    node = node_of(system)
    node.dispatcher.call(lambda: dead_letters.office.record("somebody", [Slow()], "test", unheard=1))
    gate.wait_arrived()
    system.ref("a").ask(("tell", gone, "hello"))

    try:
        eventually(lambda: [to for to, _, _ in letters(system)] == [str(gone.actor_urn)])
    finally:
        gate.open()


def test_the_text_of_a_message_is_never_made_on_the_loop(system: rr.System) -> None:
    threads: list[str] = []

    class Noted:
        def __repr__(self) -> str:
            threads.append(threading.current_thread().name)
            return "noted"

    node = node_of(system)
    node.dispatcher.call(lambda: dead_letters.office.record("somebody", [Noted()], "test", unheard=1))

    eventually(lambda: letters(system) == [("somebody", "noted", "test")])
    assert threads
    assert "rr-loop" not in threads


def test_there_is_one_log_line_for_many_and_none_where_the_sender_has_an_error(
    caplog: pytest.LogCaptureFixture,
) -> None:
    caplog.set_level(logging.WARNING, "rr_actors")
    office = Office()

    for number in range(50):
        office.record("root/a", [f"message {number}"], "has ended", unheard=1)
    office.record("root/a", ["asked"], "has ended", unheard=0)

    assert [record.getMessage() for record in caplog.records] == ["dead letter to root/a: 'message 0' (has ended)"]
    assert office.count == 51


def test_events_are_limited_and_the_count_is_not() -> None:
    office, told = Office(), Calls()
    office.listener = told

    office.record("root/a", list(range(EVENTS_A_SECOND * 10)), "stopped before handling it", unheard=0)
    assert told.items[-1][1] == office.count == EVENTS_A_SECOND * 10
    office.record("root/a", list(range(EVENTS_A_SECOND * 10)), "stopped before handling it", unheard=0)

    assert len(told) <= 2 * EVENTS_A_SECOND  # a second may end in between
    assert office.count == EVENTS_A_SECOND * 20
