"""A request whose class has code of its own is read by a worker: neither the loop nor who decides runs that."""

from __future__ import annotations

import dataclasses
import enum
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any, Generic, NamedTuple, TypeVar

import msgspec
import pytest

import rr_actors as rr
from rr_actors.actors.turns import has_a_turn
from rr_actors.base.values.canonical import Codec, encode
from rr_actors.registrar.model.messages import Load
from support import LIMIT_S, Calls, Gate, eventually, serve
from support_inside import actor_of

T = TypeVar("T")


class Notes:
    """Where requests are made, and what they do there."""

    def __init__(self) -> None:
        self.read = Calls()
        self.gate: Gate | None = None
        self.error: BaseException | None = None

    def made(self, name: str) -> None:
        self.read((name, threading.current_thread().name, has_a_turn()))
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


def watch(monkeypatch: pytest.MonkeyPatch, registrar: rr.Registrar, decided: Calls) -> None:
    """Note what a registrar's mailbox takes, once it has been decided."""
    actor = actor_of(registrar)
    put = actor.deliver

    def noted(what: Any, sender: str | None = None, *, more: bool = False) -> None:
        put(what, sender, more=more)
        decided(what)

    monkeypatch.setattr(actor, "deliver", noted)


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
    monkeypatch: pytest.MonkeyPatch, app: rr.Registrar, orders: rr.Registrar, block: bool
) -> None:
    notes.gate = Gate()
    with pytest.raises(rr.LoadTimeout):
        load(app, "provider/order", {"name": "slow"}, block, timeout_s=0.3)
    notes.gate.wait_arrived()
    eventually(lambda: app.owed() == [])
    decided = Calls()
    watch(monkeypatch, orders, decided)
    notes.gate.open()
    decided.wait(1)  # the slow one has been read, and is refused
    assert [read.query_id for read in decided if isinstance(read, Load)] != []
    assert load(app, "provider/order", {"name": "quick"}, block).response == "quick"
    assert [found.request.name for found in orders.resources() if found.server == "order"] == ["quick"]


def test_who_comes_for_what_is_being_loaded_hears_its_report_when_the_request_is_read(
    app: rr.Registrar, provider: rr.Registrar
) -> None:
    reported, gate, heard = Calls(), Gate(), Calls()

    def load_order(order: Order) -> str:
        rr.current().progress(0.5, "half")
        reported(order)
        gate()
        return order.name

    serve(provider, "order", load=load_order, request_type=Order)
    serve(provider, "plain")
    first = app.load("provider/order", Order("slow"), block=False)
    reported.wait()
    notes.gate = Gate()
    second = app.load("provider/order", {"name": "slow"}, block=False, progress=heard)
    notes.gate.wait_arrived()
    load(app, "provider/plain", 7, block=False)  # by the same link: what there is to hear by now has been sent
    notes.gate.open()
    heard.wait()
    assert [(progress.fraction, progress.text) for progress in heard] == [(0.5, "half")]
    gate.open()
    assert first.get(timeout=LIMIT_S).resource_id == second.get(timeout=LIMIT_S).resource_id


@WAYS
def test_a_server_that_is_another_when_it_is_read_gets_it_in_its_own_form(
    app: rr.Registrar, orders: rr.Registrar, block: bool
) -> None:
    notes.gate = Gate()
    app.load("provider/plain", "makes the link")
    slow = app.load("provider/order", {"name": "slow"}, block=False)
    notes.gate.wait_arrived()
    orders.unregister_server("order")
    serve(orders, "order", load=lambda request: sorted(request), request_type=dict[str, str])
    notes.gate.open()
    assert slow.get(timeout=LIMIT_S).response == ["name"]


def test_where_no_thread_is_free_its_caller_hears_so(start: Callable[..., rr.System]) -> None:
    system = start(config=rr.SystemConfig(workers_limit=2))
    app, provider = system.open_registrar("app"), system.open_registrar("provider")
    gate = Gate()
    serve(provider, "busy", load=lambda request: gate(request))
    serve(provider, "order", load=lambda order: order.name, request_type=Order)
    busy = [app.load("provider/busy", number, block=False) for number in range(2)]
    gate.wait_arrived(2)
    with pytest.raises(rr.MailboxFull, match="workers_limit"):
        app.load("provider/order", Order("wheel"), block=False).get(timeout=LIMIT_S)
    gate.open()
    for query in busy:
        query.get(timeout=LIMIT_S)
    assert app.load("provider/order", Order("wheel")).response == "wheel"


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
    assert actor_of(app).loads == {}


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


@dataclasses.dataclass
class Checked:
    size: int

    def _set(self, size: int) -> None:
        notes.made("property")


Checked.size = property(lambda self: 1, Checked._set)  # type: ignore[assignment]


@dataclasses.dataclass
class Coded:
    name: str


rr.codec(Coded, lambda coded: coded.name, Coded)


@dataclasses.dataclass(frozen=True)
class Item:
    name: str

    def __hash__(self) -> int:
        return 1


@dataclasses.dataclass
class Looked:
    name: str

    def __getattribute__(self, name: str) -> Any:
        return object.__getattribute__(self, name)


class Base:
    def __new__(cls) -> Base:
        return object.__new__(cls)


@dataclasses.dataclass
class Derived(Base):
    name: str


@dataclasses.dataclass(slots=True)
class Slots:
    name: str
    size: int = 1


@dataclasses.dataclass
class Box(Generic[T]):
    of: T


@dataclasses.dataclass
class CheckedBox(Box[T]):
    def __post_init__(self) -> None:
        notes.made("box")


class Point(NamedTuple):
    x: int
    y: int = 0


class OwnPoint(Point):
    def __new__(cls, x: int, y: int = 1) -> OwnPoint:
        return tuple.__new__(cls, (x, y))


class Access(enum.Flag):
    READ = 1
    WRITE = 2


class Struct(msgspec.Struct):
    plain: Plain
    name: str = ""


class Mapping(msgspec.Struct):
    orders: dict[str, Order]


PLAIN = [
    int,
    str,
    Colour,
    Access,
    Plain,
    Slots,
    Box[Plain],
    Point,
    Struct,
    list[Plain],
    dict[str, Struct],
    set[str],
    int | None,
]
CODED = [
    Lenient,
    Order,
    Computed,
    Checked,
    Coded,
    Looked,
    Derived,
    CheckedBox[int],
    Box[Order],
    OwnPoint,
    Mapping,
    list[Order],
    Order | None,
]


@pytest.mark.parametrize("type_", PLAIN)
def test_plain_classes_are_read_where_the_load_is_decided(type_: Any) -> None:
    assert not Codec(type_).runs_code(encode(1))


@pytest.mark.parametrize("type_", [*CODED, set[Item], dict[Item, int], dict[str, list[Coded]], rr.ActorRef])
def test_classes_with_code_of_their_own_are_read_by_workers(type_: Any) -> None:
    assert Codec(type_).runs_code(encode(1))


def test_without_a_type_it_depends_on_what_the_bytes_name() -> None:
    codec = Codec()
    assert not codec.runs_code(encode({"name": "wheel", "sizes": [1, 2.5, None]}))
    assert codec.runs_code(encode(Order("wheel")))
