"""What the shell has reached in the counts of `make figures` stays reached."""

from __future__ import annotations

import statistics

from package_figures import (
    MACHINERY,
    function_lengths,
    imports_up,
    passed,
    private_uses,
    registrar_entries,
    shared_class_names,
    untyped_hubs,
)

import rr_actors as rr
from rr_actors import managers

REMEMBERING = {
    f"rr_actors/{name}.py"
    for name in (
        "base/errors", "base/folder", "base/values/canonical", "base/values/fitting", "hosting/process_node",
        "supervision/child_main", "supervision/child_runs", "supervision/control_channel",
        "system/endings", "system/recording/event_memory", "system/system",
    )
}  # fmt: skip
"""The files that a status passes on its way into the system's memory (docs/decisions/0076), not to its holders."""

BESIDE = {
    f"rr_actors/{name}.py"
    for name in (
        # a journal is folded 0.1 s after a commit, by a worker
        "storage/sqlite_store", "storage/sql_tables", "storage/catalog_lock", "storage/damage", "storage/witness",
        # a dial that nobody answers yet is tried again
        "base/scarcity",
        # the acknowledgement of the status, and the types of the servers, come before or after the holder hears
        "registrar/core/notices", "registrar/engine/registrar_actor",
        # looks at the disk, each some seconds
        "hosting/run_files", "system/console/console_server",
    )
}  # fmt: skip
"""The files of other work that comes into a restore at times, or nearly always: that takes most of a second."""


def test_no_room_imports_a_room_above_it() -> None:
    assert imports_up() == []


def test_what_has_the_registrar_knows_its_type() -> None:
    assert untyped_hubs() == []


def test_no_other_class_has_the_name_of_a_public_one() -> None:
    assert {*rr.__all__, *managers.__all__}.intersection(shared_class_names()) == set()


def test_functions_are_as_short_as_they_were() -> None:
    lengths = function_lengths()
    assert statistics.median(lengths) <= 7
    assert lengths[len(lengths) * 9 // 10] <= 18


def test_a_load_a_status_and_a_restore_pass_no_more_files_than_they_did() -> None:
    assert len(registrar_entries("load")) <= 3
    assert len(passed("load")) <= 25
    assert len(passed("status") - REMEMBERING) <= 25
    assert len(passed("restore") - BESIDE) <= 55


def test_no_more_lines_of_tests_use_a_private_attribute() -> None:
    assert len(private_uses()) <= 4


def test_no_two_classes_of_the_machinery_share_a_name() -> None:
    assert shared_class_names(*MACHINERY) == {}
