"""What it costs to look into catalogs grows in step with them. Bytecodes are counted, not seconds."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from rr_actors.registrar.model.rows import Held, Hold, Notice, Peer, Phase, Resource, Row, ServedQuery, State
from rr_actors.tools.inspection import Contents, check, check_delivered
from support_steps import steps_of

EMPTY = b"\xc0"


def held(id: str, n: int, parent: str = "") -> Held:
    return Held(id, "shop", "bike", EMPTY, EMPTY, f"r{n}", parent, 1, n, Hold.HELD, State.OK)


def state_of(count: int) -> dict[str, Contents]:
    """Return catalogs in which so many resources have two queries, a part, and a notice of one that was taken away."""
    shop: list[Row] = [Peer("parts")]
    app: list[Row] = [Peer("shop")]
    parts: list[Row] = []
    for n in range(count):
        shop.append(Resource(f"r{n}", "bike", str(n).encode(), EMPTY, Phase.LOADED, State.OK, "", 1))
        shop += [ServedQuery(f"q{n}", f"r{n}", "app", "", 1, 1), ServedQuery(f"p{n}", f"r{n}", "app", "", 1, 1)]
        shop.append(Notice(f"n{n}", f"gone{n}", "app", f"r{n}", "e1", State.FATAL, "gone", f"r{n}", True))
        shop.append(Held(f"w{n}", "parts", "wheel", EMPTY, EMPTY, f"x{n}", f"r{n}", 1, n, Hold.HELD, State.OK))
        app += [held(f"q{n}", n), held(f"p{n}", n), held(f"gone{n}", n)]
        parts.append(Resource(f"x{n}", "wheel", str(n).encode(), EMPTY, Phase.LOADED, State.OK, "", 1))
        parts.append(ServedQuery(f"w{n}", f"x{n}", "shop", f"r{n}", 1, 1))
    return {name: Contents(name, Path(name), rows) for name, rows in (("shop", shop), ("app", app), ("parts", parts))}


def holders_and_parts(state: dict[str, Contents]) -> None:
    shop = state["shop"]
    for id in shop.resources:
        number = id.removeprefix("r")
        assert [query.id for query in shop.holders(id)] == [f"p{number}", f"q{number}"]
        assert [part.id for part in shop.parts(id)] == [f"w{number}"]
    assert shop.holders("r-1") == shop.parts("r-1") == []


def agreement(state: dict[str, Contents]) -> None:
    assert check(state) == []


@pytest.mark.parametrize("look", [holders_and_parts, agreement], ids=lambda look: look.__name__)
def test_a_look_takes_as_many_steps_for_each_of_many_resources_as_of_few(
    look: Callable[[dict[str, Contents]], None],
) -> None:
    def each(count: int) -> float:
        state = state_of(count)
        return steps_of(lambda: look(state))[0] / count

    assert each(1_000) <= each(100) * 1.1


def test_queries_of_other_hosts_are_not_compared() -> None:
    state = state_of(1)
    shop = state["shop"]
    rows: list[Row] = [*shop.resources.values(), *shop.held.values(), *shop.queries.values()]
    rows += [ServedQuery("far", "r0", "hostb/app", "", 1, 1), Peer("hostb/parts")]
    rows.append(Notice("told", "far", "hostb/app", "r0", "e1", State.ERROR, "dark", "r0"))
    for id, hold in (("lens", Hold.HELD), ("cap", Hold.OWED)):
        rows.append(Held(id, "hostb/parts", "wheel", EMPTY, EMPTY, "x9", "r0", 1, 9, hold, State.OK))
    state["shop"] = Contents("shop", Path("shop"), rows)
    state["app"].held.pop("gone0")
    assert check(state) == []
    assert list(check_delivered(state)) == []
