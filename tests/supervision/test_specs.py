"""Specifications are checked when they are made, and every wrong field is named."""

from __future__ import annotations

import math
import pickle
from collections.abc import Callable
from dataclasses import FrozenInstanceError, replace
from pathlib import Path
from textwrap import dedent
from typing import Any

import pytest

from rr_actors.base.errors import ConfigError, InvalidSpec
from rr_actors.supervision.core.specs import Backoff, ChildSpec, Supervisor, as_child_spec, starting_with
from support_simulated import Thing, child


def test_defaults_are_as_in_the_interface() -> None:
    spec = ChildSpec(Thing)
    assert (spec.id, spec.args, spec.kwargs, spec.restart, spec.shutdown_s) == ("Thing", (), {}, "permanent", 5.0)
    assert (spec.significant, spec.placement, spec.type) == (False, "process", "worker")
    assert (spec.backoff, spec.heartbeat_s, spec.start_timeout_s) == (None, None, None)

    top = Supervisor([])
    assert (top.id, top.strategy, top.max_restarts, top.max_seconds) == ("root", "one_for_one", 3, 5.0)
    assert (top.auto_shutdown, top.placement, top.restart) == ("never", "thread", "permanent")
    assert (top.shutdown_s, top.significant) == ("infinity", False)


def test_an_id_of_none_is_the_class_name() -> None:
    assert ChildSpec(Thing, id=None).id == "Thing"  # type: ignore[arg-type]
    assert ChildSpec(Supervisor([], id="inner")).id == "inner"


def test_a_supervisor_as_a_child_is_a_child_spec_with_its_own_settings() -> None:
    inner = Supervisor([], id="inner", restart="transient", shutdown_s=9, placement="process")
    (spec,) = Supervisor([inner]).child_specs
    assert spec.actor_class_or_manager is inner
    assert (spec.id, spec.type, spec.restart, spec.shutdown_s) == ("inner", "supervisor", "transient", 9)
    assert (spec.placement, spec.significant) == ("process", False)
    assert as_child_spec(spec) is spec


def test_with_a_supervisor_all_start_that_are_known_beforehand() -> None:
    dynamic = Supervisor([child("template")], id="dynamic", strategy="simple_one_for_one")
    inner = Supervisor([child("a"), dynamic], id="inner")

    started = dict(starting_with(as_child_spec(Supervisor([inner, child("b")])), "root"))

    assert list(started) == ["root", "root/inner", "root/inner/a", "root/inner/dynamic", "root/b"]
    assert started["root/inner"].actor_class_or_manager is inner
    assert started["root/inner/a"] == child("a")


def test_what_the_caller_changes_later_does_not_change_the_spec() -> None:
    args, kwargs, children = [1], {"quality": "low"}, [child("a")]
    spec, top = ChildSpec(Thing, args=args, kwargs=kwargs), Supervisor(children)
    args.append(2)
    kwargs.clear()
    children.clear()
    assert spec.args == (1,)
    assert spec.kwargs == {"quality": "low"}
    assert [c.id for c in top.children] == ["a"]


def test_specs_are_frozen_and_travel() -> None:
    top = Supervisor([child("a", backoff=Backoff()), Supervisor([], id="inner")])
    with pytest.raises(FrozenInstanceError):
        top.max_restarts = 5  # type: ignore[misc]
    assert pickle.loads(pickle.dumps(top)) == top
    assert replace(top, max_restarts=5).max_restarts == 5


BAD_CHILDREN: list[tuple[str, dict[str, Any]]] = [
    ("actor_class_or_manager", {"actor_class_or_manager": "Thing"}),
    ("actor_class_or_manager", {"actor_class_or_manager": Thing()}),
    ("actor_class_or_manager", {"actor_class_or_manager": child}),
    ("id", {"id": "a/b"}),
    ("id", {"id": ".hidden"}),
    ("id", {"id": 7}),
    ("id", {"id": "x" * 65}),
    ("args", {"args": "abc"}),
    ("args", {"args": {"a": 1}}),
    ("kwargs", {"kwargs": [("a", 1)]}),
    ("kwargs", {"kwargs": {1: 2}}),
    ("restart", {"restart": "forever"}),
    ("restart", {"restart": None}),
    ("shutdown_s", {"shutdown_s": -1}),
    ("shutdown_s", {"shutdown_s": "soon"}),
    ("shutdown_s", {"shutdown_s": math.nan}),
    ("shutdown_s", {"shutdown_s": math.inf}),
    ("shutdown_s", {"shutdown_s": True}),
    ("shutdown_s", {"shutdown_s": None}),
    ("significant", {"significant": 1}),
    ("significant", {"significant": True}),
    ("placement", {"placement": "thraed"}),
    ("backoff", {"backoff": 1.0}),
    ("backoff", {"backoff": Backoff(), "restart": "temporary"}),
    ("heartbeat_s", {"heartbeat_s": 0}),
    ("heartbeat_s", {"heartbeat_s": "1"}),
    ("start_timeout_s", {"start_timeout_s": -3}),
    ("start_timeout_s", {"start_timeout_s": math.inf}),
    ("args", {"actor_class_or_manager": Supervisor([]), "args": [1]}),
    ("kwargs", {"actor_class_or_manager": Supervisor([]), "kwargs": {"a": 1}}),
]
BAD_SUPERVISORS: list[tuple[str, dict[str, Any]]] = [
    ("id", {"id": ""}),
    ("id", {"id": "root/inner"}),
    ("strategy", {"strategy": "one_for_two"}),
    ("max_restarts", {"max_restarts": -1}),
    ("max_restarts", {"max_restarts": 1.5}),
    ("max_restarts", {"max_restarts": True}),
    ("max_seconds", {"max_seconds": 0}),
    ("max_seconds", {"max_seconds": "5"}),
    ("auto_shutdown", {"auto_shutdown": "some"}),
    ("placement", {"placement": "moon"}),
    ("restart", {"restart": "always"}),
    ("shutdown_s", {"shutdown_s": -0.1}),
    ("significant", {"significant": True}),
    ("children", {"children": child("a")}),
    ("children[0]", {"children": ["a"]}),
    ("children[1]", {"children": [child("a"), Thing]}),
    ("children[2].id", {"children": [child("a"), child("b"), child("a")]}),
    ("children[1].id", {"children": [child("a"), Supervisor([], id="a")]}),
    ("children[0].significant", {"children": [child("a", "transient", significant=True)]}),
    ("children[0].significant", {"children": [Supervisor([], id="a", restart="temporary", significant=True)]}),
    ("children", {"children": [], "strategy": "simple_one_for_one"}),
    ("children", {"children": [child("a"), child("b")], "strategy": "simple_one_for_one"}),
]
BAD_BACKOFFS: list[tuple[str, dict[str, Any]]] = [
    ("delay_s", {"delay_s": -1}),
    ("delay_s", {"delay_s": None}),
    ("factor", {"factor": 0.5}),
    ("maximum_s", {"maximum_s": -1}),
    ("maximum_s", {"delay_s": 2, "maximum_s": 1}),
    ("jitter", {"jitter": 1.1}),
    ("jitter", {"jitter": -0.1}),
]
BAD: list[tuple[Callable[..., Any], str, dict[str, Any]]] = [
    *((ChildSpec, field, {"actor_class_or_manager": Thing, **fields}) for field, fields in BAD_CHILDREN),
    *((Supervisor, field, fields) for field, fields in BAD_SUPERVISORS),
    *((Backoff, field, fields) for field, fields in BAD_BACKOFFS),
]


@pytest.mark.parametrize(("make", "field", "fields"), BAD)
def test_a_wrong_field_is_named_with_what_was_expected(
    make: Callable[..., Any], field: str, fields: dict[str, Any]
) -> None:
    with pytest.raises(InvalidSpec) as caught:
        make(**fields)
    error: Any = caught.value
    assert error.field == field
    assert f"{field}: expected {error.expected}, got {error.got!r}" in str(error)
    assert pickle.loads(pickle.dumps(error)).field == field


def test_the_error_names_the_child_it_is_about() -> None:
    with pytest.raises(InvalidSpec, match=r"^ChildSpec 'cameras': restart: expected one of 'permanent', .*'forever'"):
        child("cameras", "forever")
    with pytest.raises(InvalidSpec, match=r"^Supervisor 'top': children\[1\]\.id: .*children\[0\] has this one"):
        Supervisor([child("a"), child("a")], id="top")


@pytest.mark.parametrize("shutdown_s", [0, 0.5, 30, "infinity", "brutal_kill"])
def test_every_way_of_shutting_down_is_accepted(shutdown_s: Any) -> None:
    assert child("a", shutdown_s=shutdown_s).shutdown_s == shutdown_s


@pytest.mark.parametrize("restart", ["transient", "temporary"])
@pytest.mark.parametrize("auto_shutdown", ["any", "all"])
def test_significant_children_are_accepted_where_they_mean_something(restart: str, auto_shutdown: Any) -> None:
    top = Supervisor([child("a", restart, significant=True)], auto_shutdown=auto_shutdown)
    assert top.children[0].significant


# -- backoff -------------------------------------------------------------------------------------------------------


def test_the_backoff_grows_to_its_maximum() -> None:
    backoff = Backoff(delay_s=0.5, factor=2, maximum_s=3, jitter=0)
    assert [backoff.delay(n, 0.7) for n in range(5)] == [0.5, 1.0, 2.0, 3.0, 3.0]
    assert Backoff().delay(100_000, 0.0) == 30.0


def test_the_jitter_shortens_a_delay_by_up_to_its_part() -> None:
    backoff = Backoff(delay_s=2, jitter=0.25)
    assert (backoff.delay(0, 0.0), backoff.delay(0, 0.5), backoff.delay(0, 1.0)) == (2.0, 1.75, 1.5)


# -- TOML ----------------------------------------------------------------------------------------------------------

TREE = """
    id = "top"
    strategy = "rest_for_one"
    max_restarts = 5

    [[children]]
    actor = "support_simulated:Thing"
    id = "cameras"
    args = [1, "two"]
    kwargs = { quality = "low" }
    shutdown_s = "brutal_kill"
    backoff = { delay_s = 0.2, maximum_s = 4 }

    [[children]]
    id = "arms"
    auto_shutdown = "all"
    placement = "process"

    [[children.children]]
    actor = "support_simulated:Thing"
    restart = "transient"
    significant = true
"""


def written(path: Path, text: str) -> Path:
    file = path / "tree.toml"
    file.write_text(dedent(text))
    return file


def test_a_tree_is_read_from_toml(tmp_path: Path) -> None:
    assert Supervisor.from_toml(written(tmp_path, TREE)) == Supervisor(
        [
            ChildSpec(
                Thing,
                id="cameras",
                args=(1, "two"),
                kwargs={"quality": "low"},
                shutdown_s="brutal_kill",
                backoff=Backoff(delay_s=0.2, maximum_s=4),
            ),
            Supervisor(
                [ChildSpec(Thing, restart="transient", significant=True)],
                id="arms",
                auto_shutdown="all",
                placement="process",
            ),
        ],
        id="top",
        strategy="rest_for_one",
        max_restarts=5,
    )


ACTOR = "[[children]]\nactor = 'support_simulated:Thing'\n"


@pytest.mark.parametrize(
    ("text", "key", "expected"),
    [
        ("id = 'a'", "children", "a list of tables"),
        ("childen = []", "childen", "one of children, id, strategy"),
        ("children = 7", "children", "a list of tables"),
        ("children = [7]", "children[0]", "a table"),
        (f"colour = 'red'\n{ACTOR}", "colour", "one of children, id, strategy"),
        (f"strategy = 'all'\n{ACTOR}", "strategy", "one of 'one_for_one'"),
        (f"max_restarts = 'three'\n{ACTOR}", "max_restarts", "a number of at least 0"),
        (f"{ACTOR}colour = 'red'", "children[0].colour", "one of actor, id, args"),
        (f"{ACTOR}restart = 'forever'", "children[0].restart", "one of 'permanent'"),
        (f"{ACTOR}backoff = 3", "children[0].backoff", "a table"),
        (f"{ACTOR}backoff = {{ wait = 3 }}", "children[0].backoff.wait", "one of delay_s, factor"),
        (f"{ACTOR}backoff = {{ factor = 0 }}", "children[0].backoff.factor", "a number of at least 1"),
        (f"{ACTOR}{ACTOR}", "children[1].id", "an id of its own"),
        ("[[children]]\nid = 'x'", "children[0]", "either actor"),
        (f"{ACTOR}children = []", "children[0]", "either actor"),
        ("[[children]]\nactor = 7", "children[0].actor", "'module:class'"),
        ("[[children]]\nactor = 'Thing'", "children[0].actor", "'module:class'"),
        ("[[children]]\nactor = 'no_such_module:Thing'", "children[0].actor", "'module:class'"),
        ("[[children]]\nactor = 'support_simulated:Nothing'", "children[0].actor", "'module:class'"),
        ("[[children]]\nactor = 'support_simulated:child'", "children[0].actor", "'module:class'"),
        ("[[children]]\nid = 'x'\nchildren = [{ id = 'y' }]", "children[0].children[0]", "either actor"),
    ],
)
def test_a_wrong_tree_file_is_an_error_with_file_key_and_expectation(
    tmp_path: Path, text: str, key: str, expected: str
) -> None:
    file = written(tmp_path, text)
    with pytest.raises(ConfigError) as caught:
        Supervisor.from_toml(file)
    error: Any = caught.value
    assert (error.file, error.key) == (str(file), key)
    assert error.expected.startswith(expected)
    assert str(error).startswith(f"{file}: {key}: expected {expected}")


def test_a_misspelt_key_of_a_tree_file_is_named_with_the_one_that_is_near(tmp_path: Path) -> None:
    for text, near in (("childen = []", "children"), (f"{ACTOR}aktor = 'a'", "actor")):
        with pytest.raises(ConfigError, match=f"got an unknown key; did you mean '{near}'"):
            Supervisor.from_toml(written(tmp_path, text))


def test_a_module_of_a_tree_file_that_ends_the_program_is_an_error(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "leaves_at_import.py").write_text("import sys\nsys.exit('no camera is attached')")
    monkeypatch.syspath_prepend(str(tmp_path))
    file = written(tmp_path, "[[children]]\nactor = 'leaves_at_import:Thing'")
    with pytest.raises(
        ConfigError, match=r"actor: .* got 'leaves_at_import:Thing' \(SystemExit: no camera is attached\)"
    ):
        Supervisor.from_toml(file)


def test_the_name_of_a_field_in_python_is_no_key_of_a_tree_file(tmp_path: Path) -> None:
    for text, key in ((ACTOR, r"children\[0\]\.actor_class_or_manager"), ("children = []\n", "actor_class_or_manager")):
        file = written(tmp_path, f"{text}actor_class_or_manager = 'a:B'")
        with pytest.raises(ConfigError, match=rf"tree\.toml: {key}: expected one of .*, got an unknown key"):
            Supervisor.from_toml(file)


def test_a_tree_file_that_cannot_be_read_is_an_error_that_names_it(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"nothing\.toml: cannot be read: No such file .*; expected a TOML file"):
        Supervisor.from_toml(tmp_path / "nothing.toml")
    with pytest.raises(ConfigError, match="cannot be read: embedded null byte"):
        Supervisor.from_toml("a\0b")
    (tmp_path / "latin1.toml").write_bytes(b"id = '\xe9'")
    with pytest.raises(ConfigError, match=r"latin1\.toml: not valid TOML: not UTF-8 text \(at line 1\)"):
        Supervisor.from_toml(str(tmp_path / "latin1.toml"))
    file = written(tmp_path, "children = [")
    with pytest.raises(ConfigError, match=r"not valid TOML: .*\(at line 1, end of the file\)") as caught:
        Supervisor.from_toml(file)
    assert (caught.value.file, caught.value.key, caught.value.expected) == (str(file), None, "valid TOML")
