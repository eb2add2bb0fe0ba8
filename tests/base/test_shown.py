"""What a message shows of what it got: enough to know it by, however large it is."""

from __future__ import annotations

import enum
import tomllib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

import rr_actors as rr
from rr_actors.base.errors import counted, shown
from rr_actors.base.names import NAME_LIMIT, NAME_WIDTH, named
from rr_actors.registrar.core.decide import decide
from rr_actors.registrar.model.catalog import Catalog

HUGE: Any = "h" * 1_000_000
NO_TEXT: Any = [HUGE]
LONGEST = 600
"""Characters of a whole message: what it got, and what it says besides."""


class Fuel(enum.Enum):
    PETROL = "petrol"


@dataclass
class Car:
    fuel: Fuel


class Broken:
    def __repr__(self) -> str:
        raise ValueError("no text")


class BrokenList(list[Any]):
    __repr__ = Broken.__repr__


@pytest.mark.parametrize(
    ("value", "text"),
    [
        ("x" * 198, f"'{'x' * 198}'"),
        (None, "None"),
        ({"one": [1, 2.5, (3,)], "two": b"x"}, "{'one': [1, 2.5, (3,)], 'two': b'x'}"),
        (list(range(20)), repr(list(range(20)))),
        (Car(Fuel.PETROL), repr(Car(Fuel.PETROL))),
        (10**150, str(10**150)),
    ],
)
def test_what_is_short_is_shown_whole(value: object, text: str) -> None:
    assert shown(value) == text


@pytest.mark.parametrize(
    "value",
    [HUGE, HUGE.encode(), [HUGE] * 100, {HUGE: HUGE}, Car(HUGE), 10**5000, list(range(10**6)), [[[[[[HUGE]]]]]]],
    ids=["text", "bytes", "list", "dict", "dataclass", "number", "numbers", "nested"],
)
def test_what_is_huge_is_cut(value: object) -> None:
    assert 1 <= len(shown(value)) <= 300


def test_what_cannot_say_what_it_is_is_shown_by_its_class() -> None:
    assert "Broken" in shown(Broken())
    assert "BrokenList" in shown(BrokenList())


Wrong = Callable[[rr.System, rr.Registrar, rr.Registrar], object]

WRONG: dict[str, Wrong] = {
    "server": lambda _, app, provider: app.load(HUGE, 1),
    "server's name": lambda _, app, provider: app.load(f"provider/{HUGE}", 1),
    "no server id": lambda _, app, provider: app.load(NO_TEXT, 1),
    "key": lambda _, app, provider: app.load("provider/thing", {HUGE: object()}),
    "other key": lambda _, app, provider: app.load("provider/thing", {f" {HUGE}": object()}),
    "enum": lambda _, app, provider: app.load("provider/car", {"fuel": HUGE}),
    "field": lambda _, app, provider: app.load("provider/car", {"fuel": "petrol", HUGE: 1}),
    "on_status": lambda _, app, provider: app.load("provider/thing", 1, on_status=HUGE),
    "timeout_s": lambda _, app, provider: app.load("provider/thing", 1, timeout_s=HUGE),
    "parent": lambda _, app, provider: app.load("provider/thing", 1, parent=HUGE),
    "query": lambda _, app, provider: app.unload(HUGE),
    "no query": lambda _, app, provider: app.unload(NO_TEXT),
    "resource": lambda _, app, provider: provider.unload(HUGE, force=True),
    "children": lambda _, app, provider: app.children(HUGE),
    "no status": lambda _, app, provider: provider.send_status("x", HUGE),
    "state": lambda _, app, provider: rr.Status(HUGE),
    "response": lambda _, app, provider: app.load("provider/bad", 1),
    "unregister": lambda _, app, provider: provider.unregister_server(HUGE),
    "register": lambda _, app, provider: provider.register_server("x", HUGE),
    "registrar": lambda system, *_: system.registrar(HUGE),
    "release": lambda system, *_: system.release(HUGE),
    "ref": lambda system, *_: system.ref(HUGE),
    "child": lambda system, *_: system.supervisor().terminate_child(HUGE),
    "start_child": lambda system, *_: system.start_child(HUGE),
    "stop": lambda system, *_: system.stop(HUGE),
    "spec": lambda *_: rr.ChildSpec(rr.Manager, id=HUGE),
    "restart": lambda *_: rr.ChildSpec(rr.Manager, id="x", restart=HUGE),
    "arguments": lambda system, *_: system.start_child(rr.ChildSpec(rr.Manager, id="x", args=(HUGE,))),
    "strategy": lambda *_: rr.Supervisor([], strategy=HUGE),
    "durability": lambda *_: rr.RegistrarConfig(durability=HUGE),
    "state_dir": lambda *_: rr.System(state_dir=NO_TEXT),
}


@pytest.mark.parametrize("what", WRONG)
def test_an_error_about_a_huge_value_has_a_message_that_people_can_read(
    system: rr.System, app: rr.Registrar, provider: rr.Registrar, what: str
) -> None:
    provider.register_server("thing", lambda request: request)
    provider.register_server("car", lambda car: None, request_type=Car)
    provider.register_server("bad", lambda _request: {HUGE: object()})
    with pytest.raises(rr.RrError) as caught:
        WRONG[what](system, app, provider)
    assert len(str(caught.value)) < LONGEST
    assert "hhh" in str(caught.value)


@pytest.mark.parametrize("text", [f"durability = '{HUGE}'", f"{HUGE} = 1"])
def test_so_has_one_about_a_toml_file(tmp_path: Path, text: str) -> None:
    path = tmp_path / "config.toml"
    path.write_text(text)
    assert tomllib.loads(text)
    with pytest.raises(rr.ConfigError) as caught:
        rr.RegistrarConfig.from_toml(path)
    assert len(str(caught.value)) < LONGEST + len(str(path))


@pytest.mark.parametrize("sender", ["peer", None])
def test_so_has_one_about_what_is_no_message(sender: str | None) -> None:
    with pytest.raises(TypeError) as caught:
        decide(Catalog("p"), [(HUGE, sender)])
    assert len(str(caught.value)) < LONGEST


def test_a_name_is_not_shortened_to_save_a_few_characters() -> None:
    lease = '{"instrument":"psu","wait_s":30.0,"who":"anna1"}'
    assert named("leases/lease", lease) == f"leases/lease {lease}"
    long = named("leases/lease", lease.replace("anna1", "anna" * 10))
    assert (len(long), long[:13], long[-6:]) == (60, "leases/lease ", 'anna"}')


@pytest.mark.parametrize(
    ("count", "noun", "expected"),
    [
        (1, "catalog", "1 catalog"),
        (0, "query", "0 queries"),
        (2, "more entry", "2 more entries"),
        (2, "day", "2 days"),
        (2000, "child process", "2,000 child processes"),
    ],
)
def test_a_count_has_the_noun_in_the_form_for_it(count: int, noun: str, expected: str) -> None:
    assert counted(count, noun) == expected


@pytest.mark.parametrize("width", [NAME_WIDTH, NAME_LIMIT])
def test_a_name_that_is_longer_by_few_characters_is_not_cut(width: int) -> None:
    server = "cameras/camera"

    def of_length(length: int) -> str:
        return "r" * (length - len(server) - 1)

    for more in range(-1, 16):
        request = of_length(width + more)
        assert named(server, request, width) == f"{server} {request}"
    short = named(server, of_length(width + 16), width)
    assert len(short) == width
    assert "…" in short
