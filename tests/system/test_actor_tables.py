"""Tables that actors declare: what the command line shows of them, and of those that are wrong."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, cast

import pytest

import rr_actors as rr
from rr_actors.managers import Actions, Budgets, Pool
from support_cli import run_cli

Start = Callable[..., rr.System]


@dataclass
class Job:
    name: str
    left: int
    wanted: int
    parts: list[str]
    fault: str = ""


JOBS = (
    rr.TableColumn("name", "job"),
    rr.TableColumn("left", kind="bar", of="wanted"),
    rr.TableColumn("parts", kind="long"),
    rr.TableColumn("fault", kind="problem"),
)


class Jobs(rr.Manager):
    @rr.table("jobs", *JOBS)
    def jobs(self) -> list[Job]:
        """Return the jobs that are left."""
        return [Job("sweep", 1, 4, ["hall", "stairs"]), Job("cook", 3, 4, [], "no onions")]


class Broken(rr.Manager):
    @rr.table("broken", rr.TableColumn("name"))
    def broken(self) -> Any:
        """Return no rows."""
        return 7

    @rr.table("raising", rr.TableColumn("name"))
    def raising(self) -> list[Job]:
        """Return nothing at all."""
        raise LookupError("no list of jobs")


def lines(*arguments: str) -> list[str]:
    ran = run_cli(*arguments)
    assert ran.returncode == 0, ran.stderr
    return ran.stdout.splitlines()


@pytest.mark.usefixtures("runtime_dir")
def test_a_table_of_ones_own_manager_stands_beside_those_of_the_package(start: Start) -> None:
    start(rr.ChildSpec(Jobs, "jobs"), rr.ChildSpec(Budgets, "budgets", args=([Pool("watts", 100)],)))
    said = "\n".join(lines("plans", "--wide"))
    assert "left 1 of 4 ██░░░░░░░░, parts hall, stairs" in said
    assert "no onions" in said
    assert "used 0 of 100 ░░░░░░░░░░" in said
    assert [row["row"]["name"] for row in json.loads(run_cli("plans", "onions", "--json").stdout)] == ["cook"]
    assert {row["table"] for row in json.loads(run_cli("plans", "pools", "--json").stdout)} == {"pools"}
    assert len(lines("plans", "--limit", "1")) == 2
    assert run_cli("plans", "no such thing").stderr == "no plan matches\n"


@pytest.mark.usefixtures("runtime_dir")
def test_a_table_that_cannot_be_read_is_a_note_and_the_others_are_shown(start: Start) -> None:
    start(rr.ChildSpec(Jobs, "jobs"), rr.ChildSpec(Broken, "broken"))
    ran = run_cli("plans")
    assert "sweep" in ran.stdout
    assert "table broken: expected a list of rows, got 7" in ran.stderr
    assert "LookupError: no list of jobs" in ran.stderr


@pytest.mark.usefixtures("runtime_dir")
def test_a_child_that_has_no_such_table_says_which_it_has(start: Start) -> None:
    start(rr.ChildSpec(Jobs, "jobs"))
    ran = run_cli("budgets", "--budgets", "jobs")
    assert (ran.returncode, "jobs: no table 'pools'; it declares jobs" in ran.stderr) == (2, True)


@pytest.mark.usefixtures("runtime_dir")
def test_without_a_table_that_has_rows_the_verb_says_so(start: Start) -> None:
    start(rr.ChildSpec(Actions, "actions"))
    assert run_cli("plans").stderr == "no manager declares a table that has rows\n"


@pytest.mark.parametrize(
    ("name", "columns", "said"),
    [
        ("no name", (rr.TableColumn("a"),), "table 'no name': expected"),
        ("jobs", (), "expected at least one column, got none"),
        ("jobs", ("name",), "expected a TableColumn, got 'name'"),
        ("jobs", (rr.TableColumn("a", kind=cast("Any", "red")),), "kind: expected one of text, long, .* got 'red'"),
        ("jobs", (rr.TableColumn(""),), "expected a field"),
        ("jobs", (rr.TableColumn("a", kind="bar"),), "for a bar the field of the whole"),
    ],
)
def test_a_wrong_declaration_says_what_is_wrong(name: str, columns: Any, said: str) -> None:
    with pytest.raises((rr.InvalidSpec, rr.InvalidName), match=said):
        rr.table(name, *columns)
