"""Mailbox by itself: what becomes of messages when the actor cannot be scheduled."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Any

import pytest
from pykka import ActorDeadError

from rr_actors.actors.messaging.futures import Reply
from rr_actors.actors.messaging.mailbox import Envelope, Mailbox, StopActor, refuse_all
from rr_actors.base.errors import MailboxFull, Unavailable

FULL = MailboxFull("no thread", name="workers", limit=1)


class Schedule:
    """Calls what the test gives it, one after another; after those it only counts."""

    def __init__(self, *acts: Callable[[], object]) -> None:
        self.acts = list(acts)
        self.urgent: list[bool] = []

    def __call__(self, urgent: bool) -> None:
        self.urgent.append(urgent)
        if self.acts:
            self.acts.pop(0)()


def refuse(error: BaseException = FULL) -> Callable[[], None]:
    def act() -> None:
        raise error

    return act


def at_rest(schedule: Callable[[bool], None], limit: int = 100) -> Mailbox:
    mailbox = Mailbox("root/a", limit)
    mailbox.begin(schedule)
    assert mailbox.rest()
    return mailbox


def drained(mailbox: Mailbox) -> list[Any]:
    found: list[Any] = []
    while (envelope := mailbox.next()) is not None:
        found.append(envelope.message)
    return found


def test_the_actor_is_scheduled_by_the_first_message_and_not_again_until_it_rests() -> None:
    schedule = Schedule()
    mailbox = at_rest(schedule)
    mailbox.put(Envelope(1))
    mailbox.put(Envelope(2))
    assert schedule.urgent == [False]
    assert drained(mailbox) == [1, 2]
    assert mailbox.rest()
    mailbox.put(Envelope(StopActor()))
    assert schedule.urgent == [False, True]


def test_the_lock_is_free_while_the_actor_is_scheduled() -> None:
    """Its thread may run, and take the message, and rest, before schedule() returns."""

    def run() -> None:
        thread = threading.Thread(target=lambda: rested.append((drained(mailbox), mailbox.rest())), daemon=True)
        thread.start()
        thread.join(10)

    rested: list[Any] = []
    schedule = Schedule(run)
    mailbox = at_rest(schedule)
    mailbox.put(Envelope(1))
    assert rested == [([1], True)]
    mailbox.put(Envelope(2))
    assert schedule.urgent == [False, False]


def test_a_message_for_which_there_is_no_thread_is_refused_and_the_next_schedules_again() -> None:
    schedule = Schedule(refuse())
    mailbox = at_rest(schedule)
    with pytest.raises(MailboxFull):
        mailbox.put(Envelope("refused"))
    assert mailbox.empty()
    mailbox.put(Envelope("next"))
    assert schedule.urgent == [False, False]
    assert drained(mailbox) == ["next"]


@pytest.mark.parametrize("late", [Envelope("late"), Envelope(StopActor("shutdown"))])
def test_others_that_came_while_one_was_refused_are_handled(late: Envelope) -> None:
    def overtake() -> None:
        mailbox.put(late)
        raise FULL

    schedule = Schedule(overtake)
    mailbox = at_rest(schedule)
    with pytest.raises(MailboxFull):
        mailbox.put(Envelope("refused"))
    assert schedule.urgent == [False, True]
    assert drained(mailbox) == [late.message]
    assert mailbox.rest()


def test_others_that_got_no_thread_either_are_handled_with_the_next() -> None:
    def overtake() -> None:
        mailbox.put(Envelope("late"))
        raise FULL

    schedule = Schedule(overtake, refuse())
    mailbox = at_rest(schedule)
    with pytest.raises(MailboxFull):
        mailbox.put(Envelope("refused"))
    mailbox.put(Envelope("next"))
    assert schedule.urgent == [False, True, False]
    assert drained(mailbox) == ["late", "next"]


@pytest.mark.parametrize("error", [FULL, Unavailable("the loop has ended")])
def test_a_message_that_was_refused_with_all_others_meanwhile_is_refused_once(error: Exception) -> None:
    def close() -> None:
        refuse_all(mailbox.close(), "root/a")
        raise error

    reply: Reply[Any] = Reply()
    schedule = Schedule(close)
    mailbox = at_rest(schedule)
    mailbox.put(Envelope("message", reply))
    with pytest.raises(ActorDeadError):
        reply.get()
    with pytest.raises(ActorDeadError):
        mailbox.put(Envelope("next"))
    assert len(schedule.urgent) == 1


def test_ctrl_c_before_the_actor_was_scheduled_takes_the_message_back() -> None:
    schedule = Schedule(refuse(KeyboardInterrupt()))
    mailbox = at_rest(schedule)
    with pytest.raises(KeyboardInterrupt):
        mailbox.put(Envelope("interrupted"))
    mailbox.put(Envelope("next"))
    assert schedule.urgent == [False, False]
    assert drained(mailbox) == ["next"]


def test_ctrl_c_after_the_actor_has_taken_the_message_does_not_have_it_run_twice() -> None:
    def taken() -> None:
        envelope = mailbox.next()
        assert envelope is not None
        handled.append(envelope.message)
        raise KeyboardInterrupt

    handled: list[Any] = []
    schedule = Schedule(taken)
    mailbox = at_rest(schedule)
    with pytest.raises(KeyboardInterrupt):
        mailbox.put(Envelope("interrupted"))
    mailbox.put(Envelope("next"))  # the actor is at work, and will find it
    assert schedule.urgent == [False]
    assert not mailbox.rest()
    assert [*handled, *drained(mailbox)] == ["interrupted", "next"]
    assert mailbox.rest()


def test_ctrl_c_while_the_mailbox_was_closed_is_raised() -> None:
    def close() -> None:
        refuse_all(mailbox.close(), "root/a")
        raise KeyboardInterrupt

    reply: Reply[Any] = Reply()
    mailbox = at_rest(Schedule(close))
    with pytest.raises(KeyboardInterrupt):
        mailbox.put(Envelope("message", reply))
    with pytest.raises(ActorDeadError):
        reply.get()
