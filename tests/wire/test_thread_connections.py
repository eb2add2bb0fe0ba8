"""ThreadConnections: how many connections there are for threads that ask, and what becomes of them."""

from __future__ import annotations

import itertools
from collections.abc import Callable

from rr_actors.base.errors import MailboxFull, Unavailable
from rr_actors.wire.thread_connections import ThreadConnections
from rr_actors.wire.transport import Exchange
from support import Gate
from support_asks import Background, FakeExchange, answered


def pool(made: list[FakeExchange]) -> ThreadConnections:
    def dial(_limit: float) -> Exchange:
        made.append(FakeExchange(lambda letter, _: answered(letter)))
        return made[-1]

    return ThreadConnections(dial)


def let_go(made: list[FakeExchange]) -> None:
    for each in made:
        each.here.close()
        each.there.close()


def test_there_are_no_more_than_sixteen_at_a_time() -> None:
    made: list[FakeExchange] = []
    lines = pool(made)
    taken = [lines.take(None) for _ in range(20)]
    assert taken == [*made, *[None] * 4]
    assert len(made) == 16
    for line in made[:3]:
        lines.give_back(line)
    lines.take_out(made[3])
    again = {lines.take(None) for _ in range(5)}
    assert again == {*made[:3], made[16], None}
    for line in [*made[:3], *made[4:]]:
        lines.give_back(line)
    assert not any(each.is_closed for each in made)
    lines.close()
    assert [each.is_closed for each in made] == [number != 3 for number in range(17)]
    assert not any(each.was_cut.is_set() for each in made)
    let_go(made)


def test_those_that_are_being_dialled_count() -> None:
    made: list[FakeExchange] = []
    gate, numbers = Gate(), itertools.count()

    def dial(_limit: float) -> Exchange:
        gate()
        if next(numbers) >= 10:
            raise Unavailable("busy")
        line = FakeExchange(lambda letter, _: answered(letter))
        made.append(line)
        return line

    lines = ThreadConnections(dial)
    dialling = [Background(lambda: lines.take(None)) for _ in range(16)]
    gate.wait_arrived(16)
    assert lines.take(None) is None
    gate.open()
    taken = [line for each in dialling if (line := each.result()) is not None]
    assert len(taken) == 10
    for line in taken:
        lines.give_back(line)
    assert [lines.take(None) is None for _ in range(11)] == [False] * 10 + [True]  # nobody dials for a second now
    lines.close()
    let_go(made)


def test_closing_cuts_what_is_in_use_and_what_comes_back_then_is_closed() -> None:
    made: list[FakeExchange] = []
    lines = pool(made)
    used, taken_out = lines.take(None), lines.take(None)
    assert used is not None
    assert taken_out is not None
    lines.take_out(taken_out)
    lines.close()
    assert [each.was_cut.is_set() for each in made] == [True, False]
    assert not any(each.is_closed for each in made)
    lines.give_back(used)
    assert made[0].is_closed
    assert lines.take(None) is None
    assert len(made) == 2
    let_go(made)


def test_a_task_takes_what_is_free_and_has_another_thread_open_more() -> None:
    made: list[FakeExchange] = []
    lines = pool(made)
    task, other = "query 1", "query 2"
    wanted: list[Callable[[], None]] = []
    assert lines.take_idle(task, refuse) is None
    for _ in range(2):
        assert lines.take_idle(task, wanted.append) is None
    (add,) = wanted  # the refusal is forgotten, and one is enough at a time
    add()
    line = lines.take_idle(task, wanted.append)
    assert line is made[0]
    lines.drop_mine()
    lines.drop(line)
    lines.drop_mine(other)
    assert not made[0].is_closed
    lines.drop_mine(task)
    assert made[0].is_closed
    assert lines.in_use == []
    let_go(made)


def refuse(_work: Callable[[], None]) -> None:
    raise MailboxFull("all threads run")


def test_what_was_dialled_while_it_closed_is_for_nobody() -> None:
    made: list[FakeExchange] = []

    def dial(_limit: float) -> Exchange:
        lines.close()
        made.append(FakeExchange(lambda letter, _: answered(letter)))
        return made[-1]

    lines = ThreadConnections(dial)
    assert lines.take(None) is None
    assert made[0].is_closed
    let_go(made)


def test_a_transport_without_such_connections_is_asked_once_a_second() -> None:
    dialled: list[float] = []

    def dial(limit: float) -> None:
        dialled.append(limit)

    lines = ThreadConnections(dial)
    assert lines.take(0.01) is None
    assert lines.take(0.01) is None
    assert dialled == [0.01]
