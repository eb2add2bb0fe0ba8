"""Registrars, their clients and servers are actors: a mailbox and a turn, references, paths, monitors, dead letters."""

from __future__ import annotations

import asyncio
import random
import re
import threading
from collections.abc import Callable, Coroutine, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pykka
import pytest

import rr_actors as rr
from rr_actors.actors.turns import AT_ONCE, TurnActor
from support import REPOSITORY, eventually

LIMIT_S = 20.0
PAGE = REPOSITORY / "docs" / "life-of-a-load.md"


class Cameras(rr.Manager):
    """Serves cameras in a process of its own."""

    @rr.server("camera")
    def camera(self, request: str) -> str:
        return f"{request} is open"


class Asker(rr.Actor):
    """Asks another process's registrar for what it does not take."""

    def on_receive(self, message: Any) -> Any:
        try:
            return message.ask("open")
        except rr.UsageError as error:
            return str(error)


@pytest.fixture
def system(tmp_path: Path) -> Iterator[rr.System]:
    children = [rr.ChildSpec(Cameras, id="cameras"), rr.ChildSpec(Asker, id="asker")]
    with rr.System(children, state_dir=tmp_path) as running:
        yield running


@pytest.fixture
def app(system: rr.System) -> rr.Registrar:
    return system.open_registrar("app")


@pytest.fixture
def delivered(monkeypatch: pytest.MonkeyPatch) -> list[tuple[str, str]]:
    """What mailboxes of this process's registrars and clients took from now on: the actor's path and the message."""
    found: list[tuple[str, str]] = []
    for name in ("deliver", "enqueue"):
        put: Callable[..., None] = getattr(TurnActor, name)

        def noted(actor: TurnActor, message: Any, *args: Any, put: Callable[..., None] = put, **kwargs: Any) -> None:
            found.append((str(actor.actor_ref.path), type(message).__name__))
            put(actor, message, *args, **kwargs)

        monkeypatch.setattr(TurnActor, name, noted)
    return found


def test_a_server_ends_when_it_is_unregistered(system: rr.System, app: rr.Registrar) -> None:
    app.register_server("thing", lambda request: request)
    ref = system.ref("app/servers/thing")
    with rr.monitor(ref) as monitor:
        app.unregister_server("thing")
        down = monitor.wait(LIMIT_S)
    assert down is not None
    assert down.reason == "shutdown"
    assert not ref.is_alive()
    app.register_server("thing", lambda request: request)
    assert ref.is_alive()


PATHS = [
    "cameras/registrar",
    "root/cameras/registrar",
    "cameras/registrar/servers/camera",
    "app",
    "app/clients/cameras",
]


@pytest.mark.parametrize("path", PATHS)
def test_a_system_finds_them_by_their_paths(system: rr.System, app: rr.Registrar, path: str) -> None:
    app.load("cameras/camera", "front")
    ref = system.ref(path)
    assert ref.is_alive()
    assert str(ref) == path or str(ref) == f"root/{path}"
    assert issubclass(ref.actor_class, pykka.Actor)


def test_a_name_that_no_actor_has_is_still_not_found(system: rr.System, app: rr.Registrar) -> None:
    for path in ("other", "app/other", "cameras/other"):
        with pytest.raises(rr.NotFound):
            system.ref(path)


def test_a_monitor_hears_that_a_registrar_was_closed_and_then_that_it_is_not_there(
    system: rr.System, app: rr.Registrar
) -> None:
    ref = system.ref("app")
    with rr.monitor(ref) as monitor:
        app.close()
        down = monitor.wait(LIMIT_S)
    assert down is not None
    assert down.reason == "shutdown"
    assert not ref.is_alive()
    again = rr.monitor(ref).wait(LIMIT_S)
    assert again is not None
    assert again.reason == "noproc"


def test_a_monitor_hears_that_the_process_of_a_managers_registrar_was_killed(system: rr.System) -> None:
    with rr.monitor(system.ref("cameras/registrar")) as monitor:
        system.ref("cameras").kill()
        down = monitor.wait(LIMIT_S)
    assert down is not None
    assert down.reason in ("killed", "abnormal")


@pytest.mark.parametrize("at_once", [None, 1])
def test_a_server_answers_what_is_no_message_of_it(system: rr.System, app: rr.Registrar, at_once: int | None) -> None:
    app.register_server("thing", lambda request: request, at_once=at_once)
    for _ in range(2):
        with pytest.raises(rr.UsageError, match="takes messages of the framework alone"):
            system.ref("app/servers/thing").ask("open", timeout=LIMIT_S)
    assert app.load("app/thing", "x").response == "x"


@pytest.mark.parametrize("path", ["app", "cameras/registrar"])
def test_it_refuses_what_is_no_message_of_a_registrar(system: rr.System, app: rr.Registrar, path: str) -> None:
    with pytest.raises(rr.UsageError, match="takes messages of registrars alone"):
        system.ref(path).ask("open")
    assert "takes messages of registrars alone" in system.ref("asker").ask(system.ref(path))
    assert system.ref(path).is_alive()


def test_a_told_message_that_it_does_not_take_is_a_dead_letter(system: rr.System, app: rr.Registrar) -> None:
    before = system.dead_letters().count
    system.ref("app").tell("open")
    eventually(lambda: system.dead_letters().count > before)
    letters = system.dead_letters()
    assert letters.count == before + 1
    assert letters.letters[-1].to == "app"


def test_it_is_not_stopped_by_its_reference_as_it_ends_with_its_owner(system: rr.System, app: rr.Registrar) -> None:
    with pytest.raises(rr.UsageError, match="is a part of another actor"):
        system.ref("app").stop(timeout=LIMIT_S)
    assert app.load("cameras/camera", "front").response == "front is open"


def test_a_load_over_the_loop_puts_the_messages_into_mailboxes_that_the_page_lists(
    system: rr.System, app: rr.Registrar, delivered: list[tuple[str, str]]
) -> None:
    near = system.open_registrar("near")
    near.register_server("thing", lambda request: request)
    app.load("near/thing", "the first makes the link")
    del delivered[:]
    app.load("near/thing", "x", block=False).get(timeout=LIMIT_S)
    section = PAGE.read_text().partition("## The messages of a load")[2].partition("\n## ")[0]
    assert delivered == re.findall(r"^\| `([^`]+)` \| `([^`]+)` \|$", section, re.MULTILINE)


def test_a_thread_that_joins_takes_the_turn_and_puts_nothing_into_a_mailbox(
    system: rr.System, app: rr.Registrar, delivered: list[tuple[str, str]]
) -> None:
    near = system.open_registrar("near")
    near.register_server("thing", lambda request: request)
    app.load("near/thing", "x")
    app.load("near/thing", "x")
    del delivered[:]
    query: list[rr.Query[Any]] = []
    caller = threading.Thread(target=lambda: query.append(app.load("near/thing", "x")))
    caller.start()
    caller.join(LIMIT_S)
    assert query[0].response == "x"
    assert delivered == []


# -- recordings of both ways -------------------------------------------------------------------------------------------

FIRST = ["app>{0} Load", "{0} has Load", "{0} began load", "{0} ended load", "{0}>app Loaded", "app has Loaded"]
JOINED = ["app>{0} Load", "{0} has Load", "{0}>app Loaded", "app has Loaded"]
LEFT = ["app>{0} Unload", "{0} has Unload", "{0}>app Unloaded", "app has Unloaded"]
LOADS: dict[str, Callable[[rr.Registrar, str, str], rr.Query[Any]]] = {
    "over the loop": lambda app, server, request: app.load(server, request, block=False).get(timeout=LIMIT_S),
    "by a thread's turn": lambda app, server, request: app.load(server, request),
    "by a task's turn": lambda app, server, request: asyncio.run(_awaited(app, server, request)),
}
UNLOADS: dict[str, Callable[[rr.Registrar, rr.Query[Any]], object]] = {
    "over the loop": lambda app, query: app.unload(query, block=False).get(timeout=LIMIT_S),
    "by a thread's turn": lambda app, query: app.unload(query),
    "by a task's turn": lambda app, query: asyncio.run(app.unload_async(query)),
}


async def _awaited(app: rr.Registrar, server: str, request: str) -> rr.Query[Any]:
    return await app.load_async(server, request)


def lines_of(recording: rr.Recording, query: str) -> list[str]:
    """What a recording has of the messages of a query, in its order, and of the callbacks meanwhile."""
    lines: list[str] = []
    for entry in recording.entries():
        if entry.query == query and entry.event == "sent":
            lines.append(f"{entry.registrar}>{entry.peer} {entry.name}")
        elif entry.query == query and entry.event == "received":
            lines.append(f"{entry.registrar} has {entry.name}")
        elif entry.event in ("began", "ended"):
            lines.append(f"{entry.registrar} {entry.event} {entry.name}")
    return lines


@pytest.mark.parametrize("way", LOADS)
@pytest.mark.parametrize("provider", ["near", "cameras"])
def test_a_recording_has_the_same_of_a_load_whoever_takes_the_turn(
    system: rr.System, app: rr.Registrar, delivered: list[tuple[str, str]], provider: str, way: str
) -> None:
    near = system.open_registrar("near")
    near.register_server("camera", lambda request: request)
    load, unload, server = LOADS[way], UNLOADS[way], f"{provider}/camera"
    for _ in range(3):  # the first loads of a thread and a task make their connections
        load(app, server, "warm")

    def recorded(call: Callable[[], rr.Query[Any]], *expected: str) -> None:
        wanted = [line.format(provider) for line in expected]
        with system.record() as recording:
            query = call()
            eventually(lambda: len(lines_of(recording, query.id)) >= len(wanted), what=f"all of {wanted}")
        assert lines_of(recording, query.id) == wanted

    def join_and_leave() -> rr.Query[Any]:
        query = load(app, server, "x")
        unload(app, query)
        return query

    recorded(lambda: load(app, server, "x"), *FIRST)
    del delivered[:]
    recorded(join_and_leave, *JOINED, *LEFT)
    taken = [message for actor, message in delivered if actor == "near"]
    by_mailbox = provider == "near" and way == "over the loop"
    assert ("Load" in taken) == by_mailbox  # an Unload is put into it also behind what the loop has not done yet


# -- the order of one sender's messages --------------------------------------------------------------------------------


class Shelf(rr.Manager):
    """Notes the callbacks of its server in their order: "x" loads, "-x" unloads."""

    def __init__(self) -> None:
        self.order: list[str] = []

    @rr.server("thing", at_once=1)
    def thing(self, request: str) -> str:
        self.order.append(request)
        return request

    @thing.unload
    def unload_thing(self, request: str, response: str) -> None:
        self.order.append(f"-{request}")

    def on_receive(self, message: Any) -> list[str]:
        return self.order


async def mixed(app: rr.Registrar, wait: Waits, seed: int) -> list[str]:
    """Load and unload at random, waiting for some calls while others are in flight; return what was asked for."""
    choose = random.Random(seed)
    asked: list[str] = []
    held: list[rr.Query[Any]] = []
    for turn in range(25):
        loads: list[Any] = []
        unloads: list[Any] = []
        for number in range(choose.randrange(1, 6)):
            if held and choose.random() < 0.4:
                query = held.pop(choose.randrange(len(held)))
                asked.append(f"-{query.response}")
                unloads.append(app.unload(query, block=False))
            else:
                asked.append(f"{seed}.{turn}.{number}")
                loads.append(app.load("shelf/thing", asked[-1], block=False))
        if held and turn % 3 == 0:
            query = held.pop()
            asked.append(f"-{query.response}")
            await wait.unload(app, query)
        else:
            asked.append(f"{seed}.{turn}.last")
            held.append(await wait.load(app, asked[-1]))
        held += [one.get(timeout=LIMIT_S) for one in loads]
        for one in unloads:
            one.get(timeout=LIMIT_S)
    return asked


class InThread:
    """The blocking calls of a thread."""

    async def load(self, app: rr.Registrar, request: str) -> rr.Query[Any]:
        return app.load("shelf/thing", request)

    async def unload(self, app: rr.Registrar, query: rr.Query[Any]) -> None:
        app.unload(query)

    def run(self, program: Coroutine[Any, Any, list[str]]) -> list[str]:
        """Run the program, which awaits nothing, in a thread without an event loop."""

        def steps() -> list[str]:
            try:
                program.send(None)
            except StopIteration as end:
                return end.value
            raise AssertionError("it has awaited something")

        with ThreadPoolExecutor(1) as threads:
            return threads.submit(steps).result(LIMIT_S * 3)


class InTask:
    """The awaited calls of a task."""

    async def load(self, app: rr.Registrar, request: str) -> rr.Query[Any]:
        return await app.load_async("shelf/thing", request)

    async def unload(self, app: rr.Registrar, query: rr.Query[Any]) -> None:
        await app.unload_async(query)

    def run(self, program: Coroutine[Any, Any, list[str]]) -> list[str]:
        """Run the program as a task of an event loop."""
        return asyncio.run(program)


Waits = InThread | InTask


@pytest.mark.parametrize("wait", [InThread(), InTask()], ids=["a thread", "a task"])
@pytest.mark.parametrize("placement", ["process", "thread"])
def test_the_messages_of_one_sender_keep_their_order_over_both_ways_with_others_in_flight(
    start: Callable[..., rr.System], placement: Any, wait: Waits
) -> None:
    system = start(rr.ChildSpec(Shelf, id="shelf", placement=placement))
    app = system.open_registrar("app")
    asked = [one for seed in (1, 2) for one in wait.run(mixed(app, wait, seed))]
    assert system.ref("shelf").ask("order") == asked


def test_all_requests_are_sent_also_if_there_are_more_than_share_a_turn(system: rr.System, app: rr.Registrar) -> None:
    loads = [app.load("cameras/camera", f"camera {number}", block=False) for number in range(3 * AT_ONCE)]
    assert [load.get(timeout=LIMIT_S).response for load in loads] == [
        f"camera {number} is open" for number in range(3 * AT_ONCE)
    ]
