"""What a registrar would do after a restart, and about statuses: tables of small catalogs. The copy alone changes."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import replace

from rr_actors.registrar.core.foretelling import End, Foretold, foretell_restart, foretell_statuses, known_of
from rr_actors.registrar.model.catalog import Catalog, Server
from rr_actors.registrar.model.rows import (
    CallbackRun,
    Held,
    Hold,
    Notice,
    Phase,
    Resource,
    Row,
    ServedQuery,
    State,
    content_of,
    rows_of,
)

OK = Resource("r", "lens", b'"front"', b"1", Phase.LOADED, State.OK, "", 1)
HELD = ServedQuery("q", "r", "app", "", 1, 1)


def catalog_of(server: Server, *rows: Row) -> Catalog:
    catalog = Catalog("cameras", content_of(rows))
    catalog.servers[server.name] = server
    return catalog


def fates(found: Foretold) -> dict[str, str]:
    return {fate.resource.id: fate.becomes for fate in found.fates}


def told(found: Foretold) -> list[tuple[str, str]]:
    return [(notice.origin, str(notice.state)) for notice in found.notices]


KEEP, LOSE = Server("lens"), Server("lens", recovery="lost")
AGAIN, FIND = Server("lens", recovery="reload"), Server("lens", has_recover=True)

RESTARTS: dict[str, tuple[Server, list[Row], dict[str, str], list[tuple[str, str]]]] = {
    "nothing": (KEEP, [], {}, []),
    "kept": (KEEP, [OK, HELD], {}, []),
    "lost": (LOSE, [OK, HELD], {"r": "lost"}, [("app", "FATAL")]),
    "reloaded": (AGAIN, [OK, HELD], {"r": "loaded again"}, []),
    "recovered": (FIND, [OK, HELD], {"r": "recovered"}, []),
    "lost already": (LOSE, [replace(OK, state=State.FATAL), HELD], {}, []),
    "lost, and held by two": (
        LOSE,
        [OK, HELD, replace(HELD, id="p", origin="maps")],
        {"r": "lost"},
        [("app", "FATAL"), ("maps", "FATAL")],
    ),
    "an interrupted load": (KEEP, [replace(OK, phase=Phase.LOADING, response=None), HELD], {"r": "loaded again"}, []),
    "an interrupted unload": (KEEP, [replace(OK, phase=Phase.UNLOADING, tries=1)], {"r": "unloaded"}, []),
    "nobody holds it, and it may be lost": (LOSE, [OK], {"r": "unloaded"}, []),
    "its recover callback has ended three processes": (
        FIND,
        [OK, HELD, CallbackRun("recover:r", 2, begun=True)],
        {"r": "lost"},
        [("app", "FATAL")],
    ),
}


@pytest.mark.parametrize("case", RESTARTS)
def test_what_becomes_of_a_resource_when_the_process_was_killed(case: str) -> None:
    server, rows, expected, notices = RESTARTS[case]
    catalog = catalog_of(server, *rows)
    before = {table: dict(content) for table, content in catalog.tables.items()}

    found = foretell_restart(known_of(catalog), "crash")

    assert (fates(found), told(found)) == (expected, notices)
    assert found.kept == len(before["resources"]) - len(expected)
    assert catalog.tables == before


def test_a_clean_stop_blames_no_callback() -> None:
    catalog = catalog_of(FIND, OK, HELD, CallbackRun("recover:r", 2, begun=True))

    assert fates(foretell_restart(known_of(catalog), "stop")) == {"r": "recovered"}


PHASES = st.sampled_from([Phase.LOADED, Phase.LOADING, Phase.UNLOADING, Phase.UNLOAD_FAILED, Phase.PAUSED])


@given(
    st.sampled_from([KEEP, LOSE, AGAIN, FIND]),
    st.lists(st.tuples(PHASES, st.sampled_from([State.OK, State.ERROR, State.FATAL]), st.integers(0, 2)), max_size=8),
    st.sampled_from(["crash", "stop"]),
)
def test_any_catalog_is_foretold_and_stays_as_it_was(
    server: Server, resources: list[tuple[Phase, State, int]], end: End
) -> None:
    rows: list[Row] = []
    for number, (phase, state, holders) in enumerate(resources):
        rows.append(replace(OK, id=f"r{number}", request=b"%d" % number, phase=phase, state=state))
        rows += [replace(HELD, id=f"q{number}.{one}", resource_id=f"r{number}") for one in range(holders)]
    catalog = catalog_of(server, *rows)

    found = foretell_restart(known_of(catalog), end)

    assert found.kept + len(found.fates) == len(resources)
    assert {row.id for row in rows_of(catalog.tables)} == {row.id for row in rows}
    lost = {fate.resource.id for fate in found.fates if fate.becomes == "lost"}
    assert {notice.resource_id for notice in found.notices if notice.state is State.FATAL} <= lost


# -- about statuses ----------------------------------------------------------------------------------------------------

PART = Held("h", "lenses", "lens", b'"wide"', b"1", "x", "r", 1, 1, Hold.HELD, State.OK)
OWN = replace(PART, id="o", parent="")


def lost(query_id: str) -> Notice:
    return Notice(f"e:{query_id}", query_id, "cameras", "x", "e", State.FATAL, "lost", "lenses/lens")


def test_a_status_of_a_part_is_one_of_the_whole_and_goes_on_to_its_holders() -> None:
    found = foretell_statuses(known_of(catalog_of(KEEP, OK, HELD, PART)), "lenses", [lost("h")])

    assert fates(found) == {"r": "lost"}
    assert told(found) == [("app", "FATAL")]
    assert found.heard == ()


@pytest.mark.parametrize("listens", [True, False])
def test_what_a_registrar_holds_itself_is_heard_there(listens: bool) -> None:
    catalog = catalog_of(KEEP, OWN)
    catalog.listened |= {"o"} if listens else set()

    found = foretell_statuses(known_of(catalog), "lenses", [lost("o")])

    (heard,) = found.heard
    assert (heard.query_id, heard.server, heard.state, heard.listens) == ("o", "lenses/lens", "FATAL", listens)
    assert catalog.held["o"].state is State.OK


def test_a_status_of_a_query_that_is_released_is_heard_by_nobody() -> None:
    found = foretell_statuses(known_of(catalog_of(KEEP)), "lenses", [lost("h")])

    assert (found.fates, found.heard, found.notices) == ((), (), ())
