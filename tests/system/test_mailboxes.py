"""The mailbox of an actor, seen from outside: what waits, what is handled, and in a debugged system pause and step."""

from __future__ import annotations

import functools
import os
import signal
from collections.abc import Callable
from typing import Any, Literal

import msgspec
import pytest

import rr_actors as rr
from support import Calls, Workshop, eventually, hang, kill, pid_of, wait_respawned
from support_asks import Background

Start = Callable[..., rr.System]


class Reckon(msgspec.Struct):
    """Have it work at a step of the workshop."""

    step: str


class Worker(rr.Actor):
    mailbox_limit = 5

    def __init__(self, root: str) -> None:
        self.work = Workshop(root)

    def on_receive(self, message: Any) -> Any:
        if isinstance(message, Reckon):
            self.work.step(message.step)
        return message


class Asker(rr.Actor):
    """Asks another actor, and waits for its answer; with a future, of which no actor across processes knows."""

    def on_receive(self, message: Any) -> Any:
        other, question = message
        return other.ask(question, block=False).get() if question == "later" else other.ask(question)


class Late(rr.Manager):
    def __init__(self, root: str) -> None:
        self.work = Workshop(root)

    def on_start(self) -> None:
        self.work.step("start")

    @rr.server("thing")
    def load_thing(self, request: str) -> str:
        return request


PLACES: tuple[Literal["process", "thread"], ...] = ("process", "thread")


@pytest.fixture(params=PLACES)
def debugged(request: pytest.FixtureRequest, start: Start, workshop: Workshop) -> rr.System:
    """A system that was started for debugging, with a worker and an actor that asks."""
    worker = rr.ChildSpec(Worker, id="worker", args=(str(workshop.root),), placement=request.param)
    return start(worker, rr.ChildSpec(Asker, id="asker", placement=request.param), debug=True)


def look(system: rr.System, id: str) -> rr.MailboxInfo:
    return system.mailbox(id).look()


def rests(system: rr.System, id: str) -> None:
    eventually(lambda: look(system, id).handled is None, what=f"rest of {id}")


def test_what_waits_and_what_is_handled_is_seen_while_the_actor_is_busy(
    debugged: rr.System, workshop: Workshop
) -> None:
    workshop.shut("long")
    worker, asker = debugged.ref("worker"), debugged.ref("asker")
    answer = asker.ask((worker, Reckon("long")), block=False)
    workshop.wait("long")
    worker.tell(Reckon("short"))
    worker.tell({"a": 1})
    eventually(lambda: look(debugged, "worker").length == 2)

    seen = look(debugged, "worker")
    assert (seen.path, seen.limit, seen.types) == ("root/worker", 5, {"Reckon": 1, "dict": 1})
    assert seen.handled is not None
    assert (seen.handled.type, seen.handled.sender) == ("Reckon", "root/asker")
    assert seen.oldest is not None
    assert seen.oldest.type == "Reckon"
    assert seen.handled.since_s is not None
    assert seen.oldest.since_s is not None
    assert 0 < seen.oldest.since_s < seen.handled.since_s
    asking = look(debugged, "asker")
    assert asking.waits_for == ["root/worker"]
    assert asking.handled is not None
    assert asking.handled.type == "tuple"

    workshop.open("long")
    answer.get()
    rests(debugged, "worker")
    rests(debugged, "asker")
    assert look(debugged, "worker") == rr.MailboxInfo("root/worker", 5)
    assert look(debugged, "asker").waits_for == []


def test_a_child_that_starts_and_the_actors_of_the_framework_are_seen(start: Start, workshop: Workshop) -> None:
    system = start(rr.ChildSpec(Late, id="late", args=(str(workshop.root),)))
    app = system.open_registrar("app")
    app.load("late/thing", "x")
    for path in ("root", "root/late", "late/registrar", "app", "app/clients/late"):
        seen = look(system, path)
        assert (seen.length, seen.handled, seen.oldest) == (0, None, None), path
        assert seen.limit == 100_000
    assert look(system, "late/registrar").path == "root/late/registrar"


def test_an_actor_that_does_not_run_has_no_mailbox(start: Start, workshop: Workshop) -> None:
    system = start(rr.ChildSpec(Worker, id="worker", args=(str(workshop.root),)))
    mailbox = system.mailbox("worker")
    system.supervisor().terminate_child("worker")
    with pytest.raises(rr.ActorDeadError, match="root/worker not found: it is stopped"):
        mailbox.look()
    with pytest.raises(rr.NotFound):
        system.mailbox("nobody")


@pytest.mark.timeout(60)
def test_of_a_stopped_process_the_error_says_why_it_does_not_answer(start: Start, workshop: Workshop) -> None:
    system = start(rr.ChildSpec(Worker, id="worker", args=(str(workshop.root),)))
    worker = system.ref("worker")
    mailbox = system.mailbox("worker")
    pid = worker.pid
    assert pid is not None
    hang(pid)
    try:
        with pytest.raises(rr.Unavailable, match=r"its process has not answered within 5 s; it is .*stopped"):
            mailbox.look()
    finally:
        os.kill(pid, signal.SIGCONT)


# -- pause, step, resume ----------------------------------------------------------------------------------------------


def test_a_paused_actor_handles_what_a_step_gives_it_and_the_rest_when_it_is_resumed(
    debugged: rr.System, workshop: Workshop
) -> None:
    worker, mailbox = debugged.ref("worker"), debugged.mailbox("worker")
    assert mailbox.pause().is_paused
    answers = [worker.ask(Reckon(step), block=False) for step in ("one", "two", "three")]
    eventually(lambda: mailbox.look().length == 3)
    assert workshop.lines() == []

    stepped = mailbox.step()
    assert stepped is not None
    assert stepped.type == "Reckon"
    assert workshop.lines() == ["one"]
    assert mailbox.look().length == 2
    assert mailbox.look().is_paused
    mailbox.resume()
    assert [answer.get() for answer in answers] == [Reckon("one"), Reckon("two"), Reckon("three")]
    assert workshop.lines() == ["one", "two", "three"]
    mailbox.resume()
    mailbox.pause()
    assert mailbox.step() is None


def test_the_bound_of_a_paused_mailbox_holds(debugged: rr.System) -> None:
    worker, mailbox = debugged.ref("worker"), debugged.mailbox("worker")
    mailbox.pause()
    answers = [worker.ask(number, block=False) for number in range(5)]
    eventually(lambda: mailbox.look().length == 5)
    with pytest.raises(rr.MailboxFull):
        worker.ask(6)
    mailbox.resume()
    assert [answer.get() for answer in answers] == list(range(5))


def test_what_is_handled_is_finished_and_a_step_ends_with_its_handler(debugged: rr.System, workshop: Workshop) -> None:
    worker, mailbox = debugged.ref("worker"), debugged.mailbox("worker")
    workshop.shut("one")
    workshop.shut("two")
    first, second = worker.ask(Reckon("one"), block=False), worker.ask(Reckon("two"), block=False)
    workshop.wait("one")
    assert mailbox.pause().handled is not None
    workshop.open("one")
    assert first.get() == Reckon("one")
    stepping = Background(mailbox.step)
    workshop.wait("two")
    assert not second.done()
    with pytest.raises(rr.UsageError, match="its last step has not ended"):
        mailbox.step()
    workshop.open("two")
    assert second.get() == Reckon("two")
    assert stepping.result().type == "Reckon"


def test_a_step_has_a_time_limit_and_its_handler_goes_on(debugged: rr.System, workshop: Workshop) -> None:
    worker, mailbox = debugged.ref("worker"), debugged.mailbox("worker")
    mailbox.pause()
    workshop.shut("long")
    answer = worker.ask(Reckon("long"), block=False)
    eventually(lambda: mailbox.look().length == 1)
    with pytest.raises(rr.Unavailable, match=r"root/worker: its handler has not returned within 0.2 s"):
        mailbox.step(0.2)
    workshop.open("long")
    assert answer.get() == Reckon("long")


def test_a_supervisor_stops_a_paused_actor_and_its_next_incarnation_is_not_paused(debugged: rr.System) -> None:
    worker, mailbox = debugged.ref("worker"), debugged.mailbox("worker")
    mailbox.pause()
    waiting = worker.ask("lost", block=False)
    eventually(lambda: mailbox.look().length == 1)
    debugged.supervisor().terminate_child("worker")
    with pytest.raises((rr.ActorDeadError, rr.ActorUnavailable)):
        waiting.get()
    debugged.supervisor().restart_child("worker")
    assert worker.ask("here") == "here"
    assert not mailbox.look().is_paused


def test_a_system_stops_although_its_actors_are_paused(debugged: rr.System) -> None:
    for id in ("worker", "asker"):
        debugged.mailbox(id).pause()
    debugged.ref("worker").tell("waits")
    events = Calls()
    debugged.subscribe(events)
    debugged.stop()
    reasons = {event["path"]: event["reason"] for event in events.items if event["event"] == "stopped"}
    assert reasons["root/worker"] == reasons["root/asker"] == "shutdown"


def test_a_killed_actor_comes_back_and_is_not_paused(start: Start, workshop: Workshop) -> None:
    system = start(rr.ChildSpec(Worker, id="worker", args=(str(workshop.root),)), debug=True)
    worker, mailbox = system.ref("worker"), system.mailbox("worker")
    mailbox.pause()
    pid = pid_of(system, "worker")
    assert worker.kill()
    wait_respawned(system, "worker", pid)
    assert not mailbox.look().is_paused
    assert worker.ask("here") == "here"


def test_a_system_that_is_not_debugged_refuses_it_by_name(start: Start, workshop: Workshop) -> None:
    system = start(rr.ChildSpec(Worker, id="worker", args=(str(workshop.root),)))
    mailbox = system.mailbox("worker")
    for order in (mailbox.pause, mailbox.step, mailbox.resume):
        with pytest.raises(rr.UsageError, match=r"root/worker: its system was not started for debugging.*debug=True"):
            order()
    assert system.ref("worker").ask("here") == "here"


def test_the_actors_of_the_framework_are_not_paused(debugged: rr.System) -> None:
    debugged.open_registrar("app")
    for path in ("root", "app"):
        with pytest.raises(rr.UsageError, match=f"{path}: it is an actor of the framework"):
            debugged.mailbox(path).pause()


class Printers(rr.Manager):
    """One page is printed at a time."""

    def __init__(self, root: str) -> None:
        self.work = Workshop(root)

    @rr.server("page", at_once=1)
    def print_page(self, page: str) -> str:
        self.work.step("print", page)
        return page

    @print_page.unload
    def take_page(self, page: str, response: str) -> None:
        self.work.note("took", page)


@pytest.mark.parametrize("placement", PLACES)
def test_loads_that_wait_for_room_wait_in_the_mailbox_of_their_server(
    start: Start, workshop: Workshop, placement: Literal["process", "thread"]
) -> None:
    system = start(rr.ChildSpec(Printers, id="printers", args=(str(workshop.root),), placement=placement))
    app = system.open_registrar("app")
    workshop.shut("print")
    loads = [app.load("printers/page", page, block=False) for page in ("one", "two", "three")]
    server = "printers/registrar/servers/page"
    eventually(lambda: look(system, server).length == 2, what="two that wait")
    workshop.wait("print")
    found = look(system, server)
    assert found.types == {"StartCallback": 2}
    assert found.oldest is not None
    assert (found.oldest.type, found.oldest.sender) == ("StartCallback", "printers")
    assert found.oldest.since_s is not None
    assert found.oldest.since_s > 0
    workshop.open("print")
    assert [load.get(timeout=30.0).response for load in loads] == ["one", "two", "three"]
    assert look(system, server).length == 0
    assert [line.split()[1] for line in workshop.lines("print")] == ["one", "two", "three"]


def test_what_waits_for_a_stored_server_goes_to_the_one_that_replaces_it(start: Start, workshop: Workshop) -> None:
    system = start(rr.ChildSpec(Late, id="shop", args=(str(workshop.root),)))
    app, shop, root = system.open_registrar("app"), system.registrar("shop"), str(workshop.root)

    def load(word: str, request: str) -> str:
        Workshop(root).step(word, request)
        return word

    shop.register_server("late", functools.partial(load, "old"), request_type=str, response_type=str, at_once=1)
    workshop.shut("old")
    loads = [app.load("shop/late", request, block=False) for request in ("one", "two")]
    workshop.wait("old")
    wait_respawned(system, "shop", kill(system, "shop"))
    workshop.wait("old", 2)
    eventually(lambda: look(system, "shop/registrar/servers/late").length == 1, what="one that waits")
    shop.register_server("late", functools.partial(load, "new"), request_type=str, response_type=str, at_once=1)
    workshop.wait("new")
    workshop.open("old")
    assert sorted(load.get(timeout=30.0).response for load in loads) == ["new", "old"]
