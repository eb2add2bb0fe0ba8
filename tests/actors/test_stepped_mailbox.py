"""SteppedMailbox by itself: what it gives while it is paused, and what a step gives."""

from __future__ import annotations

from typing import Any

import pytest

from rr_actors.actors.messaging.exit_reports import Down
from rr_actors.actors.messaging.mailbox import DownNotice, Envelope, StopActor
from rr_actors.actors.messaging.stepped_mailbox import SteppedMailbox
from rr_actors.base.errors import MailboxFull, Unavailable, UsageError
from support import Calls


@pytest.fixture
def scheduled() -> list[bool]:
    """With what the mailbox has scheduled its actor."""
    return []


@pytest.fixture
def mailbox(scheduled: list[bool]) -> SteppedMailbox:
    """A mailbox whose actor rests."""
    made = SteppedMailbox("root/a", 3)
    made.begin(scheduled.append)
    assert made.rest()
    return made


def given(mailbox: SteppedMailbox) -> list[Any]:
    """What the actor would handle now."""
    found: list[Any] = []
    while (envelope := mailbox.next()) is not None:
        found.append(envelope.message)
    return found


def test_while_it_is_paused_messages_wait_up_to_the_limit(mailbox: SteppedMailbox) -> None:
    mailbox.pause()
    for number in range(3):
        mailbox.put(Envelope(number))
    with pytest.raises(MailboxFull):
        mailbox.put(Envelope(3))
    assert given(mailbox) == []
    assert mailbox.rest()
    assert len(mailbox) == 3
    mailbox.resume()
    assert given(mailbox) == [0, 1, 2]


def test_the_actor_is_scheduled_when_it_is_resumed_and_when_it_is_stepped(
    mailbox: SteppedMailbox, scheduled: list[bool]
) -> None:
    mailbox.pause()
    mailbox.put(Envelope(1))
    mailbox.put(Envelope(2))
    assert given(mailbox) == []
    assert mailbox.rest()
    scheduled.clear()

    assert mailbox.step(Calls())
    assert scheduled == [True]
    assert given(mailbox) == [1]
    assert mailbox.rest()
    mailbox.resume()
    assert scheduled == [True, True]


def test_a_step_gives_one_message_and_ends_when_the_actor_comes_for_the_next(mailbox: SteppedMailbox) -> None:
    handled = Calls()
    mailbox.pause()
    mailbox.put(Envelope(1))
    mailbox.put(Envelope(2))
    assert mailbox.step(handled)

    taken = mailbox.next()
    assert taken is not None
    assert taken.message == 1
    assert handled.items == []
    with pytest.raises(UsageError, match="its last step has not ended"):
        mailbox.step(handled)
    assert mailbox.next() is None
    assert handled.items == [taken]


def test_without_a_message_there_is_no_step(mailbox: SteppedMailbox) -> None:
    mailbox.pause()
    assert not mailbox.step(Calls())
    mailbox.put(Envelope(1))
    assert given(mailbox) == []


def test_only_a_paused_mailbox_is_stepped(mailbox: SteppedMailbox) -> None:
    with pytest.raises(UsageError, match="root/a: it is not paused"):
        mailbox.step(Calls())


def test_a_supervisors_stop_is_given_while_it_is_paused_and_other_stops_and_downs_wait(mailbox: SteppedMailbox) -> None:
    down = Down(None, "normal")
    mailbox.pause()
    mailbox.put(Envelope(1))
    mailbox.put(Envelope(normal := StopActor()))
    mailbox.put(DownNotice(down, None))
    assert given(mailbox) == []
    mailbox.put(Envelope(shutdown := StopActor("shutdown")))
    assert given(mailbox) == [shutdown]
    mailbox.resume()
    assert given(mailbox) == [down, 1, normal]


def test_a_step_of_a_stop_that_came_before_it_is_not_spent(mailbox: SteppedMailbox) -> None:
    handled = Calls()
    mailbox.pause()
    mailbox.put(Envelope(1))
    mailbox.put(Envelope(StopActor("shutdown")))
    assert mailbox.step(handled)
    assert mailbox.next() is not None
    assert handled.items == []
    mailbox.close()
    assert handled.items == [None]


def test_a_step_ends_when_its_message_ends_the_actor(mailbox: SteppedMailbox) -> None:
    handled = Calls()
    mailbox.pause()
    mailbox.put(Envelope(1))
    assert mailbox.step(handled)
    taken = mailbox.next()
    mailbox.close()
    assert handled.items == [taken]


def test_after_a_refused_schedule_the_next_message_schedules(scheduled: list[bool]) -> None:
    def refuse(urgent: bool) -> None:
        scheduled.append(urgent)
        if len(scheduled) == 2:
            raise Unavailable("no thread")

    mailbox = SteppedMailbox("root/a", 3)
    mailbox.begin(refuse)
    assert mailbox.rest()
    mailbox.pause()
    mailbox.put(Envelope(1))
    assert given(mailbox) == []
    assert mailbox.rest()
    with pytest.raises(Unavailable):
        mailbox.resume()
    mailbox.put(Envelope(2))
    assert len(scheduled) == 3
    assert given(mailbox) == [1, 2]
