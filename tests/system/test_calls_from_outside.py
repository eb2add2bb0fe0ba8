"""connection.proxy() and `rr-actors call`: what an actor's methods do, everybody of the user can ask from outside."""

from __future__ import annotations

import dataclasses
import enum
import json
from collections.abc import Callable, Iterator

import pytest

import rr_actors as rr
from rr_actors.managers import Budgets, Pool
from support_cli import run_cli

Start = Callable[..., rr.System]
LIMIT_S = 30.0


class Mode(enum.Enum):
    FAST = "fast"


@dataclasses.dataclass
class Level:
    name: str
    mode: Mode


class Tanks(rr.Manager):
    """Has levels, and a server whose callbacks are nobody's to call."""

    def fill(self, amount: float, into: str = "left") -> float:
        """Fill a tank.

        And say what was filled.
        """
        if amount < 0:
            raise ValueError(f"{into} cannot be filled with {amount}")
        return 2 * amount

    def level(self) -> list[Level]:
        return [Level("left", Mode.FAST)]

    def odd(self) -> object:
        return object()

    def _drain(self) -> None: ...

    def on_stop(self) -> None: ...

    @rr.server("tank")
    def open_tank(self, name: str) -> str:
        return name

    @open_tank.unload
    def close_tank(self, name: str, response: str) -> None: ...


class Pumps(Tanks):
    fill = None  # type: ignore[assignment]  # it has none


@pytest.fixture
def system(rr_system: Start) -> rr.System:
    budgets = rr.ChildSpec(Budgets, id="budgets", args=([Pool("watts", 100)],), placement="thread")
    tanks = rr.ChildSpec(Tanks, id="tanks", placement="thread")
    return rr_system([tanks, rr.ChildSpec(Pumps, id="pumps", placement="thread"), budgets])


@pytest.fixture
def connection(system: rr.System) -> Iterator[rr.Connection]:
    with rr.connect(system.state_dir) as connection:
        yield connection


def test_a_connection_calls_a_method_and_gets_plain_data(connection: rr.Connection) -> None:
    tanks = connection.proxy("tanks")
    assert tanks.fill(2.5).get(timeout=LIMIT_S) == 5.0
    assert tanks.fill(amount=1, into="right").get(timeout=LIMIT_S) == 2
    assert tanks.level().get(timeout=LIMIT_S) == [{"name": "left", "mode": "fast"}]


def test_a_ready_made_manager_is_changed_from_outside(connection: rr.Connection) -> None:
    budgets = connection.proxy("budgets")
    budgets.set_capacity("watts", 60).get(timeout=LIMIT_S)
    (pool,) = budgets.pools().get(timeout=LIMIT_S)
    assert (pool["name"], pool["capacity"]) == ("watts", 60.0)


def test_a_proxy_shows_the_methods_and_no_callbacks_or_hooks(connection: rr.Connection) -> None:
    assert dir(connection.proxy("tanks")) == ["fill", "level", "odd"]
    assert dir(connection.proxy("pumps")) == ["level", "odd"]
    assert repr(connection.proxy("tanks")) == "<ConnectedProxy of tanks>"


@pytest.mark.parametrize("method", ["open_tank", "close_tank", "stop", "on_stop", "registrar"])
def test_what_is_no_method_of_its_own_is_refused(connection: rr.Connection, method: str) -> None:
    with pytest.raises(rr.NotFound, match=f"no method '{method}' that may be called from outside") as info:
        getattr(connection.proxy("tanks"), method)().get(timeout=LIMIT_S)
    assert info.value.known == ("fill", "level", "odd")


def test_wrong_calls_say_what_was_expected(connection: rr.Connection) -> None:
    tanks = connection.proxy("tanks")
    with pytest.raises(rr.UsageError, match=r"fill\(amount: float, into: str = 'left'\) -> float: missing"):
        tanks.fill().get(timeout=LIMIT_S)
    with pytest.raises(rr.NotFound, match="did you mean 'level'"):
        tanks.levl().get(timeout=LIMIT_S)
    with pytest.raises(rr.NotSerializable, match="arguments of tanks"):
        tanks.fill(object()).get(timeout=LIMIT_S)
    with pytest.raises(rr.NotSerializable, match="answer of tanks"):
        tanks.odd().get(timeout=LIMIT_S)
    with pytest.raises(rr.NotFound, match="tank5"):
        connection.proxy("tank5").fill(1).get(timeout=LIMIT_S)
    with pytest.raises(rr.RrError, match="tanks: ValueError: left cannot be filled with -1"):
        tanks.fill(-1).get(timeout=LIMIT_S)
    with pytest.raises(AttributeError):
        getattr(tanks, f"_{'drain'}")


def test_the_command_calls_and_shows_what_there_is(system: rr.System) -> None:
    state = ("--state", system.state_dir)
    assert json.loads(run_cli("call", "tanks", "fill", "-0", "right", *state).stdout) == 0.0
    assert json.loads(run_cli("call", "budgets", "set_capacity", "watts", "60", *state).stdout) is None
    shown = run_cli("call", "tanks", *state).stdout
    assert "fill(amount: float, into: str = 'left') -> float\n    Fill a tank.\n" in shown
    wrong = run_cli("call", "tanks", "fill", "{1", *state)
    assert (wrong.returncode, "expected JSON, got '{1'" in wrong.stderr) == (2, True)
