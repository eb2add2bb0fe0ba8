"""A request whose class has code of its own is read by a worker: neither the loop nor who decides runs that."""

from __future__ import annotations

import dataclasses
import enum
import threading
from pathlib import Path
from typing import Any

import msgspec
import pytest

import rr_actors as rr
from rr_actors.base.values.canonical import Codec, encode
from rr_actors.registrar.engine.monitor import is_deciding
from support import LIMIT_S, Calls, Gate, eventually, serve


class Notes:
    """Where requests are made, and what they do there."""

    def __init__(self) -> None:
        self.read = Calls()
        self.gate: Gate | None = None
        self.error: BaseException | None = None

    def made(self, name: str) -> None:
        self.read((name, threading.current_thread().name, is_deciding()))
        if threading.current_thread().name.startswith("rr-worker") and name == "slow" and self.gate is not None:
            self.gate(name)
        if self.error is not None and name == "wrong":
            raise self.error


notes = Notes()


@dataclasses.dataclass
class Order:
    """A request with code of its own."""

    name: str
    size: int = 1

    def __post_init__(self) -> None:
        notes.made(self.name)


@pytest.fixture(autouse=True)
def _fresh_notes(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(f"{__name__}.notes", Notes())


@pytest.fixture
def orders(provider: rr.Registrar) -> rr.Registrar:
    """Serves "provider/order" and "provider/plain"."""
    serve(provider, "order", load=lambda order: order.name, request_type=Order)
    serve(provider, "plain")
    return provider


WAYS = pytest.mark.parametrize("block", [True, False], ids=["by a line", "by the link"])


def load(app: rr.Registrar, server: str, request: Any, block: bool, timeout_s: float = LIMIT_S) -> rr.Query:
    app.load("provider/plain", "makes the link")
    if block:
        return app.load(server, request, timeout_s=timeout_s)
    return app.load(server, request, timeout_s=timeout_s, block=False).get(timeout=LIMIT_S)


@WAYS
def test_it_is_made_by_workers_and_never_while_anybody_decides(
    app: rr.Registrar, orders: rr.Registrar, block: bool
) -> None:
    query = load(app, "provider/order", {"name": "wheel"}, block)
    assert query.response == "wheel"
    assert notes.read.items != []
    for name, thread, deciding in notes.read:
        assert (name, deciding) == ("wheel", False)
        assert thread.startswith("rr-worker")


@WAYS
def test_requests_that_are_equal_in_other_words_get_one_resource(
    app: rr.Registrar, orders: rr.Registrar, block: bool
) -> None:
    one = load(app, "provider/order", {"name": "wheel"}, block)
    same = load(app, "provider/order", {"size": 1, "name": "wheel"}, block)
    other = load(app, "provider/order", {"name": "wheel", "size": 2}, block)
    assert one.resource_id == same.resource_id != other.resource_id


@WAYS
def test_one_that_takes_long_to_be_made_holds_up_nothing_else(
    app: rr.Registrar, orders: rr.Registrar, block: bool
) -> None:
    notes.gate = Gate()
    app.load("provider/plain", "makes the link")
    slow = app.load("provider/order", {"name": "slow"}, block=False)
    notes.gate.wait_arrived()
    assert load(app, "provider/plain", 7, block).response["of"] == 7
    assert load(app, "provider/order", {"name": "quick"}, block).response == "quick"
    notes.gate.open()
    assert slow.get(timeout=LIMIT_S).response == "slow"


@WAYS
def test_what_is_withdrawn_before_it_is_made_is_not_loaded(
    app: rr.Registrar, orders: rr.Registrar, block: bool
) -> None:
    notes.gate = Gate()
    with pytest.raises(rr.LoadTimeout):
        load(app, "provider/order", {"name": "slow"}, block, timeout_s=0.3)
    notes.gate.wait_arrived()
    eventually(lambda: app.owed() == [])
    notes.gate.open()
    assert load(app, "provider/order", {"name": "quick"}, block).response == "quick"
    eventually(lambda: [found.request.name for found in orders.resources() if found.server == "order"] == ["quick"])


@WAYS
@pytest.mark.parametrize("error", [ValueError("no such size"), SystemExit(2)], ids=["an error", "an exit"])
def test_what_its_code_raises_is_what_its_caller_hears(
    app: rr.Registrar, orders: rr.Registrar, block: bool, error: BaseException
) -> None:
    notes.error = error
    with pytest.raises(rr.RrError, match=r"no such size|2"):
        load(app, "provider/order", {"name": "wrong"}, block)
    assert load(app, "provider/order", {"name": "wheel"}, block).response == "wheel"
    assert app.stats()["queries"] == 3
    assert app._actor.loads == {}


def test_what_is_held_already_in_these_bytes_is_joined_without_being_made_again(
    app: rr.Registrar, orders: rr.Registrar
) -> None:
    def by_workers() -> int:
        return sum(thread.startswith("rr-worker") for _, thread, _ in notes.read)

    load(app, "provider/order", Order("wheel"), block=True)
    count = by_workers()
    assert count > 0
    load(app, "provider/order", Order("wheel"), block=True)
    assert by_workers() == count


class Orders(rr.Manager):
    """Says in which threads its requests were made."""

    @rr.server("order")
    def load_order(self, order: Order) -> list[str]:
        return sorted({thread for _, thread, _ in notes.read})


def test_in_a_managers_process_it_is_so_too(tmp_path: Path) -> None:
    with rr.System([rr.ChildSpec(Orders, id="orders")], state_dir=tmp_path) as system:
        app = system.open_registrar("app")
        for name in ("wheel", "bell"):
            threads = app.load("orders/order", {"name": name}).response
            assert threads
            assert all(thread.startswith("rr-worker") for thread in threads)


# -- which classes have code of their own ----------------------------------------------------------------------------


class Colour(enum.Enum):
    RED = "red"


class Lenient(enum.Enum):
    RED = "red"

    @classmethod
    def _missing_(cls, value: object) -> Lenient:
        return cls.RED


@dataclasses.dataclass
class Plain:
    colour: Colour
    sizes: list[int] = dataclasses.field(default_factory=list)


@dataclasses.dataclass
class Computed:
    sizes: list[int] = dataclasses.field(default_factory=lambda: [1])


class Struct(msgspec.Struct):
    plain: Plain
    name: str = ""


class Mapping(msgspec.Struct):
    orders: dict[str, Order]


@pytest.mark.parametrize("type_", [int, str, Colour, Plain, Struct, list[Plain], dict[str, Struct], int | None])
def test_plain_classes_are_read_where_the_load_is_decided(type_: Any) -> None:
    assert not Codec(type_).runs_code(encode(1))


@pytest.mark.parametrize("type_", [Lenient, Order, Computed, Mapping, list[Order], Order | None, rr.ActorRef])
def test_classes_with_code_of_their_own_are_read_by_workers(type_: Any) -> None:
    assert Codec(type_).runs_code(encode(1))


def test_without_a_type_it_depends_on_what_the_bytes_name() -> None:
    codec = Codec()
    assert not codec.runs_code(encode({"name": "wheel", "sizes": [1, 2.5, None]}))
    assert codec.runs_code(encode(Order("wheel")))
