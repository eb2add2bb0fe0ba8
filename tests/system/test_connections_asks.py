"""A connection asks an actor: the actor hears who asks, and the connection hears what went wrong, and where."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Literal

import pytest

import rr_actors as rr
from rr_actors.base.errors import UnknownRegistrar

pytestmark = pytest.mark.usefixtures("runtime_dir")


@dataclasses.dataclass
class Open:
    port: int


class Bench(rr.Manager):
    @rr.server("scope")
    def open_scope(self, name: str) -> str:
        return f"{name} for {rr.current().origin}"

    def on_receive(self, message: Any) -> Any:
        match message:
            case "who asks":
                return rr.current().origin
            case "volt":
                holders = {name for info in self.registrar.resources() for name in info.holders}
                if (asker := rr.current().origin) not in holders:
                    raise rr.UsageError(f"{asker} does not hold the scope")
                return 1.25
            case "not running":
                raise rr.NotRunning("no scope runs")
            case "key":
                return {}[5]
            case "progress":
                return rr.current().progress(0.5)
            case "load":
                return self.registrar.load("bench/scope", "a", parent=rr.current())
            case _:
                return message


class Asking(rr.Actor):
    def on_start(self) -> None:
        with pytest.raises(rr.UsageError, match="expected to be called in a callback"):
            rr.current()

    def on_receive(self, message: Any) -> Any:
        who, actor = message
        return actor.ask("who asks") if who == "waits" else actor.ask("who asks", block=False).get()


@pytest.fixture(scope="module", params=["process", "thread"])
def placement(request: pytest.FixtureRequest) -> Literal["process", "thread"]:
    return request.param


@pytest.fixture
def system(state_dir: Path, placement: Literal["process", "thread"]) -> Iterator[rr.System]:
    children = [rr.ChildSpec(Bench, id="bench", placement=placement), rr.ChildSpec(Asking, id="asking")]
    with rr.System(children, state_dir=state_dir) as system:
        yield system


@pytest.fixture
def connection(system: rr.System, state_dir: Path) -> Iterator[rr.Connection]:
    with rr.connect(state_dir) as connection:
        yield connection


def test_a_handler_hears_who_asks(system: rr.System, connection: rr.Connection) -> None:
    anna, bert = connection.open_registrar("anna"), connection.open_registrar("bert")
    bench = system.ref("bench")

    assert anna.ask("bench", "who asks") == "connection.anna"
    assert bert.ask("bench", "who asks") == "connection.bert"
    assert connection.ask("bench", "who asks") == f"connection.pid-{os.getpid()}"
    assert bench.ask("who asks") == ""
    assert system.ref("asking").ask(("waits", bench)) == "root/asking"
    assert system.ref("asking").ask(("does not", bench)) == ""
    with anna.load("bench/scope", "big") as scope:
        assert scope.response == "big for connection.anna"
        assert anna.ask("bench", "volt") == 1.25
        with pytest.raises(rr.UsageError, match=r"connection\.bert does not hold the scope") as caught:
            bert.ask("bench", "volt")
        assert "does not hold the scope" in caught.value.__notes__[0]


def test_nobody_asks_in_the_name_of_another_connection(
    system: rr.System, connection: rr.Connection, state_dir: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    anna = connection.open_registrar("anna")
    with rr.connect(state_dir) as other:
        mine = other.open_registrar("bert")
        monkeypatch.setattr(mine, "_name", anna.name)  # as a connection would that was changed
        with pytest.raises(UnknownRegistrar, match=r"'connection\.anna': another connection has opened it"):
            mine.ask("bench", "who asks")


def test_the_context_of_a_message_is_of_no_resource(connection: rr.Connection) -> None:
    for message in ("progress", "load"):
        with pytest.raises(rr.UsageError, match="expected that of a callback, got that of a message"):
            connection.ask("bench", message)


def test_an_exception_of_a_handler_has_its_class_and_its_traceback(connection: rr.Connection) -> None:
    with pytest.raises(rr.AskFailed, match=r"^bench: KeyError: 5\n") as caught:
        connection.ask("bench", "key")

    error = caught.value
    assert (error.actor, error.error) == ("bench", "KeyError")
    assert "return {}[5]" in error.traceback
    assert error.__notes__ == [f"raised in bench:\n{error.traceback}"]


def test_a_handler_that_raises_not_running_does_not_end_the_connection(connection: rr.Connection) -> None:
    with pytest.raises(rr.NotRunning, match=r"^no scope runs"):
        connection.ask("bench", "not running")

    assert connection.ended is None
    assert connection.ask("bench", "who asks").startswith("connection.pid-")


def test_a_message_with_an_object_is_refused_with_advice_that_applies(connection: rr.Connection) -> None:
    for message, got in ((Open(1), "an Open"), ([{"a": Open(1)}], "an Open"), (lambda: 1, "function")):
        with pytest.raises(
            rr.NotSerializable, match=f"message to bench: expected numbers.*got .*{got}.*fields"
        ) as told:
            connection.ask("bench", message)
        assert "dataclass" not in str(told.value)
        assert "load callback" not in str(told.value)
    with pytest.raises(rr.NotSerializable, match="over a connection's limit"):
        connection.ask("bench", "x" * 1_000_000)
    assert connection.ask("bench", dataclasses.asdict(Open(1))) == {"port": 1}
