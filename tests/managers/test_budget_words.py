"""What a budget says: behind whom a share waits for room, and for whom one gives way."""

from __future__ import annotations

import pytest

from rr_actors.managers.budgets.words import Around, gives_way, has_room, waits


def name(id: str) -> str:
    return f"{id} (priority 1)"


@pytest.mark.parametrize(
    ("around", "said"),
    [
        (Around(holding=["a"]), "held by a (priority 1)"),
        (Around(), "held by nobody"),
        (Around(holding=list("abcde")), "held by a (priority 1), b (priority 1), c (priority 1) and 2 more"),
        (Around(leaving=["a"], holding=["b"]), "a (priority 1) gives way"),
        (Around(leaving=["a", "b"], reserves=1), "a (priority 1), b (priority 1) give way, a reserve starts"),
        (Around(reserves=2), "2 reserves start"),
        (Around(ahead=["a"], leaving=["b"], reserves=1), "behind a (priority 1)"),  # what is done is done for others
    ],
)
def test_a_share_that_waits_says_behind_whom_or_what_makes_room(around: Around, said: str) -> None:
    room = "pool 'watts': asked 60, free 20 of 100"
    assert waits(room, around, name) == f"waits for room in {room}; {said}"


@pytest.mark.parametrize(
    ("capacity", "needing", "said"),
    [
        (60.0, [], "its capacity is 60 now"),
        (None, ["a"], "a (priority 1) needs room"),
        (None, ["a", "b"], "a (priority 1), b (priority 1) need room"),
        (60.0, ["a"], "its capacity is 60 now, and a (priority 1) needs room"),
    ],
)
def test_a_share_that_is_revoked_says_why(capacity: float | None, needing: list[str], said: str) -> None:
    assert gives_way("watts", capacity, needing, name) == f"pool 'watts' has no room for it: {said}"


def test_no_text_is_longer_than_a_report_of_progress_may_be() -> None:
    long = [letter * 200 for letter in "abcd"]
    assert len(waits("pool 'watts'", Around(holding=long), name)) <= 400
    assert len(gives_way("watts", None, long, name)) <= 400
    assert gives_way("watts", None, [], name) == "pool 'watts' has no room for it"
    assert has_room("watts", 60, 8.04) == "has 60 of pool 'watts' after 8.0 s"
