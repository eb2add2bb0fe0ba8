"""A child that has itself terminated would wait for itself: it hears so at once, and lives."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Any

import pytest

import rr_actors as rr
from support import LIMIT_S, child, eventually

Start = Callable[..., rr.System]
both = pytest.mark.parametrize("placement", ["process", "thread"])


class Tired(rr.Actor):
    """Does what a message says: ("terminate", supervisor, child), ("ask", actor, message) ..."""

    def on_receive(self, message: Any) -> Any:
        verb, where, what = message
        if verb == "ask":
            return where.ask(what)
        if verb == "stop":
            return where.actor_ref.stop()
        if verb == "later":
            threading.Thread(target=rr.SupervisorRef(where).terminate_child, args=(what,)).start()
            return None
        return rr.SupervisorRef(where).terminate_child(what)


class Served(rr.Manager):
    @rr.server("thing")
    def load_thing(self, request: list[str]) -> str:
        where, what = request
        with pytest.raises(rr.UsageError, match="would wait for itself") as caught:
            rr.SupervisorRef(where).terminate_child(what)
        return str(caught.value)


@pytest.fixture
def tired(start: Start, placement: Any) -> rr.System:
    def actor(id: str) -> rr.ChildSpec:
        return rr.ChildSpec(Tired, id=id, placement=placement)

    served = rr.ChildSpec(Served, id="served", placement=placement)
    return start(actor("one"), actor("two"), rr.Supervisor([actor("three"), served], id="inner", placement=placement))


@both
@pytest.mark.parametrize(
    ("asked", "message"),
    [
        ("one", ("terminate", "root", "one")),
        ("three", ("terminate", "root/inner", "three")),
        ("three", ("terminate", "root", "inner")),
        ("one", ("ask", "two", ("terminate", "root", "one"))),
        ("three", ("ask", "two", ("terminate", "root", "inner"))),
    ],
)
@pytest.mark.timeout(LIMIT_S)
def test_terminate_child_of_a_waiting_actor_is_refused(tired: rr.System, asked: str, message: Any) -> None:
    pid = tired.ref(asked).pid
    if message[0] == "ask":
        message = ("ask", tired.ref(message[1]), message[2])
    with pytest.raises(rr.UsageError, match=r"terminate_child\(.*would wait for itself"):
        tired.ref(asked).ask(message)
    assert tired.ref(asked).pid == pid


@both
@pytest.mark.timeout(LIMIT_S)
def test_a_child_that_stops_its_own_supervisor_is_refused(tired: rr.System) -> None:
    with pytest.raises(rr.UsageError, match=r"stop\(\) of root/inner waits .* would wait for itself"):
        tired.ref("three").ask(("stop", tired.supervisor("inner"), None))
    assert tired.ref("three").is_alive()


@both
@pytest.mark.parametrize(("where", "what"), [("root/inner", "served"), ("root", "inner")])
@pytest.mark.timeout(LIMIT_S)
def test_terminate_child_in_a_callback_of_that_child_is_refused(tired: rr.System, where: str, what: str) -> None:
    said = tired.open_registrar("app").load("served/thing", [where, what]).response
    assert f"terminate_child({what!r})" in said
    assert "the callback that loads resource" in said
    assert "start a thread for it" in said


@both
@pytest.mark.timeout(LIMIT_S)
def test_a_child_may_have_another_terminated_and_itself_by_a_thread(tired: rr.System) -> None:
    tired.ref("one").ask(("terminate", "root", "two"))
    assert child(tired, "two").state == "stopped"
    tired.ref("one").ask(("later", "root", "one"))
    eventually(lambda: child(tired, "one").state == "stopped")
