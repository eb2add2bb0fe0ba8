"""What completion shows: the names in docs/names.md, which is made from the code, and no others."""

from __future__ import annotations

import ast
import inspect
import itertools
import re
import runpy
import textwrap
from functools import cached_property
from pathlib import Path
from types import FunctionType
from typing import Any

import pytest

import rr_actors as rr
from support import REPOSITORY, serve

_numbers = itertools.count()
PAGE = REPOSITORY / "docs" / "names.md"
MAKER = runpy.run_path(str(REPOSITORY / "docs" / "_site" / "names.py"))


def documented() -> dict[str, set[str]]:
    """The table of the page: each class with its public names, those of its bases in the table left out."""
    rows = re.findall(r"^\| \[`(\w+)`\]\(\S+\) \| .* \| (.*) \|$", PAGE.read_text(), re.MULTILINE)
    assert [name for name, _ in rows] == sorted(rr.__all__, key=str.lower)
    return {name: set(re.findall(r"`(\w+)`", names)) for name, names in rows}


def shown(value: object) -> set[str]:
    return {name for name in dir(value) if not name.startswith("_")}


def described(cls: type) -> set[str]:
    """What the page must say of a class and all its bases that are in it."""
    table = documented()
    return {name for base in cls.__mro__ for name in table.get(base.__name__, ())}


def inherited(cls: type) -> set[str]:
    """What a class has from classes that are not ours: it is in their manuals."""
    return MAKER["foreign_names"](cls)


CLASSES = sorted((name for name in rr.__all__ if isinstance(getattr(rr, name), type)), key=str)


def test_the_page_is_what_the_code_says() -> None:
    assert PAGE.read_text() == MAKER["made"](), "run: make names"


@pytest.mark.parametrize("page", sorted((PAGE.parent / "reference").glob("*.md")), ids=lambda page: page.name)
def test_a_page_of_the_reference_has_the_docstrings(page: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(REPOSITORY / "docs" / "_site")
    made = runpy.run_path(str(REPOSITORY / "docs" / "_site" / "reference.py"))["made"]
    assert page.read_text() == made(page), "run: make names"


def test_the_package_shows_what_it_exports_and_nothing_else() -> None:
    assert dir(rr) == sorted(rr.__all__)


@pytest.mark.parametrize("name", CLASSES)
def test_a_class_shows_its_documented_names_and_no_others(name: str) -> None:
    cls = getattr(rr, name)
    assert shown(cls) - inherited(cls) - described(cls) == set()


def test_the_page_has_no_names_that_are_not_there(system: rr.System) -> None:
    instances = {type(value).__name__: value for value in _instances(system)}
    for name, names in documented().items():
        value = instances.get({"ActorRef": "DistantRef", "RrError": "NotFound"}.get(name, name), getattr(rr, name))
        declared = set(vars(value).get("__annotations__", ())) if isinstance(value, type) else set()
        assert {attribute for attribute in names - declared if not hasattr(value, attribute)} == set(), name


def test_objects_show_their_documented_names_and_no_others(system: rr.System) -> None:
    others: dict[str, set[str]] = {}
    for value in _instances(system):
        cls = type(value)
        if left := shown(value) - inherited(cls) - described(cls):
            others[cls.__name__] = left
    assert others == {}


def test_what_is_private_to_the_package_works_without_being_shown(system: rr.System) -> None:
    for hidden in ("forget", "hear", "register_stored", "register_spec", "loaded_directly", "leave_to_parent"):
        for value in _instances(system):
            assert not hasattr(value, hidden)


def _instances(system: rr.System) -> list[Any]:
    """One of each kind that people are given."""
    name = f"app{next(_numbers)}"
    app = system.open_registrar(name)
    found: list[Any] = []
    serve(app, "thing", lambda _request: found.append(rr.current()))
    query = app.load(f"{name}/thing", 1)
    spec = rr.ChildSpec(rr.Actor, id=name, placement="thread")
    system.start_child(spec)
    found.append(spec)
    app.send_status(query.id, rr.Status("ok"))
    ref = system.ref(name)
    supervisor = system.supervisor()
    monitor = rr.monitor(ref)
    monitor.demonitor()
    found += [system, app, query, query.wait_status(timeout_s=10), *app.resources(), ref, supervisor, monitor]
    found += [*supervisor.which_children(), supervisor.count_children(), rr.Supervisor([]), rr.Backoff(), app.config]
    found += [system.config, system.tree(), system.dead_letters(), rr.ExitReport("normal")]
    found += [rr.NotFound("x", id="x", known=()), rr.LoadFailed("x", server="x"), rr.Recording("x"), rr.Trace("x", [])]
    simulated = rr.simulate(rr.Supervisor([spec]), until_s=1)
    found += [
        simulated,
        *simulated.children.values(),
        rr.experiment(rr.Supervisor([spec]), (), vary={"max_restarts": [1]}, runs=1),
    ]
    with rr.connect(system.state_dir) as connection:
        worker = connection.open_registrar(name)
        found += [connection, worker, worker.load(f"{name}/thing", 1)]
    return found


def test_each_public_attribute_of_a_public_class_is_documented() -> None:
    classes = [cls for cls in (getattr(rr, name) for name in rr.__all__) if isinstance(cls, type)]
    owned = {(cls, name, owner_of(cls, name)) for cls in classes for name in shown(cls)}
    ours = {one for one in owned if one[2].__module__.startswith("rr_actors.")}

    assert len(ours) > 500
    assert sorted(f"{cls.__name__}.{name}" for cls, name, owner in ours if not is_documented(cls, name, owner)) == []


def owner_of(cls: type, name: str) -> type:
    return next(base for base in cls.__mro__ if name in vars(base))


def is_documented(cls: type, name: str, owner: type) -> bool:
    """Whether a method or property has a docstring; or a field a text below it, or a line in a class's docstring."""
    member = vars(owner)[name]
    if isinstance(member, FunctionType | property | classmethod | staticmethod | cached_property):
        return bool(inspect.getdoc(getattr(cls, name) if isinstance(member, classmethod) else member))
    texts = [inspect.getdoc(base) or "" for base in cls.__mro__ if base.__module__.startswith("rr_actors.")]
    line = rf"^ +([\w, ]+, )?{name}(, [\w, ]+)?:|`\.{name}`"
    return any(re.search(line, text, re.MULTILINE) for text in texts) or name in texts_below_fields(owner)


def texts_below_fields(cls: type) -> set[str]:
    """The fields of a class that have a string below them in the source."""
    (declared,) = ast.parse(textwrap.dedent(inspect.getsource(cls))).body
    assert isinstance(declared, ast.ClassDef)
    return {
        ast.unparse(field.target if isinstance(field, ast.AnnAssign) else field.targets[0])
        for field, text in itertools.pairwise(declared.body)
        if isinstance(field, ast.AnnAssign | ast.Assign)
        and isinstance(text, ast.Expr)
        and isinstance(text.value, ast.Constant)
    }
