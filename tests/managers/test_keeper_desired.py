"""The files of a Keeper: what they ask for, and what is wrong with them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

import rr_actors as rr
from rr_actors.managers import Keeper
from rr_actors.managers.keeper.desired import Desired, Member, changes, numbered, parse_desired

A = '[[keep]]\nname = "a"\nserver = "x/y"\n'
B = '[[keep]]\nname = "b"\nserver = "x/y"\n'


def parsed(*texts: str) -> Desired:
    return parse_desired("".join(texts).encode(), "keep.toml")


def test_replicas_differ_by_their_number() -> None:
    request = 'request = { name = "c{instance}", parts = ["{instance}.{instance}", 3] }\n'
    replicas = parsed(A, request, 'replicas = 2\npriority = 7\nafter = ["b"]\n', B).replicas("keeper/group")

    assert [one.slot for one, _ in replicas] == [("a", 0), ("a", 1), ("b", 0)]
    assert [replica.request for _, replica in replicas] == [
        {"name": "c0", "parts": ["0.0", 3]},
        {"name": "c1", "parts": ["1.1", 3]},
        None,
    ]
    assert [(one.priority, one.after) for one, _ in replicas] == [(7, ("b",)), (7, ("b",)), (0, ())]
    assert len({one.what for one, _ in replicas}) == 3


def test_what_is_on_standby_has_no_priority() -> None:
    ((one, _),) = parsed(A, "standby = true\n").replicas("keeper/group")
    assert one.priority is None


def test_a_replica_of_a_group_changes_with_the_group() -> None:
    keep = '[[keep]]\nname = "a"\nserver = "keeper/group"\nrequest = "g"\n[[group]]\nname = "g"\n'
    ((before, replica),) = parsed(keep, '[[group.member]]\nserver = "x/y"\n').replicas("keeper/group")
    ((after, _),) = parsed(keep, '[[group.member]]\nserver = "x/z"\n').replicas("keeper/group")
    assert replica.members == (Member("x/y"),)
    assert before.what != after.what


def group(name: str, *members: str) -> str:
    tables = [f'[[group.member]]\nserver = "keeper/group"\nrequest = "{one}"\n' for one in members]
    return "".join([f'[[group]]\nname = "{name}"\n', *(tables or ['[[group.member]]\nserver = "x/y"\n'])])


def test_a_replica_of_a_group_has_the_members_of_the_groups_in_it_each_of_them_once() -> None:
    keep = '[[keep]]\nname = "a"\nserver = "keeper/group"\nrequest = "g"\n'
    ((_, replica),) = parsed(keep, group("g", "inner", "other"), group("inner"), group("other")).replicas(
        "keeper/group"
    )
    assert replica.members == (Member("x/y"),)


def test_all_faults_of_a_file_are_named_at_once() -> None:
    with pytest.raises(rr.ConfigError) as caught:
        parsed(A, 'replicas = -1\nafter = ["c"]\n', A, group("g", "g", "h"))
    assert [line.removeprefix("  keep.toml: ").partition(":")[0] for line in str(caught.value).splitlines()] == [
        "5 faults",
        "keep[1].name",
        "keep[0].replicas",
        "keep[0].after[0]",
        "group[0].member[1].request",
        "group[0].member",
    ]
    assert caught.value.key == "keep[1].name"


def test_a_request_without_a_number_stays() -> None:
    for value in (None, 3, 2.5, True, "front", {"a": []}):
        assert numbered(value, 5) == value


def test_changes_are_lines() -> None:
    before = parsed(A, "replicas = 1\n", B, '[[group]]\nname = "g"\n')
    after = parsed(A, 'replicas = 2\nrequest = "r{instance}"\n', '[[keep]]\nname = "c"\nserver = "x/y"\n')

    assert changes(before, after) == ["+ c", "- b", "~ a: request None -> 'r{instance}', replicas 1 -> 2", "- group g"]
    assert changes(before, before) == []


WRONG: list[tuple[str, str, Any]] = [
    ('[[keep]]\nname = "a"\nserver = "keeper/group"\nrequest = {}\n', "keep[0].request: expected the name of a", {}),
    (
        '[[keep]]\nname = "a"\nserver = "keeper/group"\nrequest = "gg"\n[[group]]\nname = "g"\n',
        "keep[0].request: expected the name of a group: g, got 'gg'; did you mean 'g'?",
        "gg",
    ),
    (group("g", "g"), "group[0].member: expected names without a ring, got the ring 'g' in 'g'", ["g", "g"]),
    (
        group("g", "h") + group("h", "g"),
        "group[0].member: expected names without a ring, got the ring 'g' in 'h' in 'g'",
        ["g", "h", "g"],
    ),
    (A + "replicas = -1\n", "keep[0].replicas: expected a whole number from 0 to 10000, got -1 (int)", -1),
    (A + "replicas = 1.5\n", "keep[0].replicas: expected `int`, got 1.5 (float)", 1.5),
    (A + 'request = "{instance}"\nreplicas = 10001\n', "keep[0].replicas: expected a whole number from 0", 10001),
    (A + "priority = 1001\n", "keep[0].priority: expected a whole number from -1000 to 1000, got 1001", 1001),
    (A + "replicas = 2\n", "keep[0].request: expected a request with {instance}, so that the 2 replicas", None),
    (A + A, "keep[1].name: expected a name that no other keep has, got 'a' again", "a"),
    ('[[keep]]\nname = ""\nserver = "x/y"\n', "keep[0].name: expected a name that no other keep has, got ''", ""),
    ('[[group]]\nname = "g"\n' * 2, "group[1].name: expected a name that no other group has, got 'g' again", "g"),
    (A + "replica = 1\n", "keep[0].replica: expected one of name, server, request, replicas", "replica"),
    (
        '[[keeps]]\nname = "a"\n',
        "keeps: expected one of keep, group, got an unknown key; did you mean 'keep'?",
        "keeps",
    ),
    ('[[keep]]\nname = "a"\n', "keep[0]: expected the key server, got none", {"name": "a"}),
    ('[[keep]]\nname = "a"\nserver = "x"\n', "keep[0].server: expected the id of a server, 'registrar/server'", "x"),
    ('[[group]]\nname = "g"\n[[group.member]]\nserver = "x"\n', "group[0].member[0].server: expected the id", "x"),
    (A + 'after = ["aa"]\n' + B, "keep[0].after[0]: expected one of a, b, got 'aa'; did you mean 'a'?", "aa"),
    (A + 'after = ["a"]\n', "keep[0].after: expected names without a ring, got the ring 'a' after 'a'", ["a", "a"]),
    ("[[keep", "not valid TOML", None),
]


@pytest.mark.parametrize(("text", "said", "got"), WRONG)
def test_what_is_wrong_is_named(text: str, said: str, got: Any) -> None:
    with pytest.raises(rr.ConfigError) as caught:
        parsed(text)
    assert f"keep.toml: {said}" in str(caught.value)
    assert caught.value.file == "keep.toml"
    if caught.value.key is not None:
        assert (caught.value.key, caught.value.got) == (said.partition(":")[0], got)
        assert caught.value.expected


def test_a_ring_is_named_in_order() -> None:
    a, b = A + 'after = ["b"]\n', B + 'after = ["c"]\n'
    with pytest.raises(rr.ConfigError) as caught:
        parsed(a, b, '[[keep]]\nname = "c"\nserver = "x/y"\nafter = ["a"]\n')
    ring = str(caught.value).partition("the ring ")[2].split(" after ")
    assert ring[0] == ring[-1]
    assert "'a' after 'b' after 'c' after 'a'".count(f"{ring[0]} after {ring[1]}") == 1
    assert sorted(ring[1:]) == ["'a'", "'b'", "'c'"]


def test_a_file_that_is_not_there_is_named(tmp_path: Path) -> None:
    with pytest.raises(rr.ConfigError, match=r"nothing\.toml: cannot be read: No such file"):
        Keeper(tmp_path / "nothing.toml")
