"""The events of System.subscribe: those that occur are those that the page lists, and look as their types say."""

from __future__ import annotations

import re
import threading
import typing
from collections.abc import Callable
from typing import Any, get_args, get_type_hints

import pytest

import rr_actors as rr
from rr_actors.registrar.model.effects import Happening
from rr_actors.runtime import backlogs
from rr_actors.supervision.core.state import Event as Reported
from rr_actors.supervision.event_history import Record
from support import REPOSITORY, Calls, Gate, Workshop, child, eventually, kill, serve, wait_respawned
from support_inside import node_of
from support_managers import Order, Shop

Start = Callable[..., rr.System]
TYPES: dict[str, Any] = {cls.__name__: cls for cls in get_args(rr.Event)}
PAGE = (REPOSITORY / "docs" / "supervision.md").read_text().partition("## 12. Events")[2].partition("\n## ")[0]


def kinds(cls: Any) -> tuple[str, ...]:
    return get_args(get_type_hints(cls)["event"])


TYPE_OF = {kind: cls for cls in TYPES.values() for kind in kinds(cls)}


def check(event: dict[str, Any]) -> None:
    """An event has the keys that its type says, each of its type."""
    cls = TYPE_OF[event["event"]]
    assert cls.__required_keys__ <= set(event) <= cls.__required_keys__ | cls.__optional_keys__, event
    hints = get_type_hints(cls)
    for key, value in event.items():
        hint = hints[key]
        if typing.get_origin(hint) is typing.Literal:
            assert value in get_args(hint), (key, event)
        else:
            assert isinstance(value, (int, float) if hint is float else hint), (key, event)


def test_the_page_lists_the_events_that_there_are_each_with_its_type() -> None:
    rows = re.findall(r"^\| `(\w+)` \| `(\w+)` \| ", PAGE, re.MULTILINE)
    assert sorted(rows) == sorted((kind, cls.__name__) for kind, cls in TYPE_OF.items())


@pytest.mark.parametrize("name", TYPES)
def test_the_page_lists_the_keys_of_each_type(name: str) -> None:
    (row,) = re.findall(rf"^\| `{name}` \| (`event`.*) \| (.*)\|$", PAGE, re.MULTILINE)
    always, perhaps = (set(re.findall(r"`(\w+)`", cell)) for cell in row)
    assert (always, perhaps) == (TYPES[name].__required_keys__, TYPES[name].__optional_keys__)


def test_the_types_name_what_supervisors_and_registrars_say() -> None:
    assert set(kinds(rr.ChildEvent)) == {*get_args(Reported), "restarted"}
    assert set(kinds(rr.ResourceEvent)) == set(get_args(Happening))
    assert rr.ChildEvent.__required_keys__ | rr.ChildEvent.__optional_keys__ == set(Record.__struct_fields__)
    letter = rr.DeadLetterEvent.__required_keys__ - {"event", "count"}
    assert letter == set(rr.DeadLetter.__struct_fields__)


def failing(*_: Any) -> None:
    raise ValueError("stuck")


class Ignoring(rr.Actor):
    def on_start(self) -> Any:
        return rr.IGNORE


class Failing(rr.Actor):
    def on_start(self) -> None:
        raise ValueError("no such device")


class Worker(rr.Actor):
    pass


def pausing(app: rr.Registrar, provider: rr.Registrar) -> None:
    """Load what is paused and resumed, and what cannot be paused."""

    def pause(request: str, response: object) -> None:
        if request == "stuck":
            raise ValueError(request)

    serve(provider, "motor", idle="pause", pause=pause, resume=lambda request, response: None)
    app.load("provider/motor", "stuck").unload()
    motor = app.load("provider/motor", "front", priority=None)
    eventually(lambda: [info.phase for info in provider.resources() if info.id == motor.resource_id] == ["paused"])
    motor.priority = 1


def streaming(app: rr.Registrar, provider: rr.Registrar) -> None:
    """Open and close streams, while a reader goes on with another of them."""

    def open_one(name: str) -> rr.Stream:
        opened[name] = rr.current().open_stream(name)
        return opened[name].stream

    opened: dict[str, rr.Publisher] = {}
    serve(provider, "eyes", load=open_one, request_type=str, response_type=rr.Stream)
    first, second = (app.load("provider/eyes", name) for name in ("left", "right"))
    with first.stream() as reader:
        eventually(lambda: opened["left"].publish("l"))
        assert next(reader).value == "l"
        provider.update_response(first.resource_id, rr.Stream(second.resource_id, "right"))
        thread = threading.Thread(target=next, args=(reader,))
        thread.start()
        eventually(lambda: opened["right"].publish("r"))
        thread.join()
    first.unload()
    second.unload()


def test_a_rebound_stream_says_who_reads_it_instead_of_which(system: rr.System) -> None:
    heard = Calls()
    system.subscribe(heard)
    app, provider = system.open_registrar("app"), system.open_registrar("provider")

    streaming(app, provider)

    eventually(lambda: len([one for one in heard if "stream" in one]) >= 5)
    events = [one for one in heard if "stream" in one]
    left, right = (one["resource_id"] for one in events[:2])
    kinds = [(one["event"].removeprefix("stream_"), one["stream"], one["resource_id"]) for one in events]
    assert kinds == [
        ("opened", "left", left),
        ("opened", "right", right),
        ("rebound", "right", right),
        ("closed", "left", left),
        ("closed", "right", right),
    ]
    assert (events[2]["reader"], events[2]["before"]) == ("app", f"{left}/left")
    assert events[2]["detail"].startswith("right, read by app instead of left of resource ")


def test_each_event_of_a_busy_system_is_as_its_type_says(start: Start, workshop: Workshop) -> None:
    heard = Calls()
    system = start(
        rr.Supervisor(
            [
                rr.ChildSpec(Shop, id="shop", args=(str(workshop.root),)),
                rr.ChildSpec(Worker, id="worker", restart="temporary"),
            ],
            id="root",
        )
    )
    system.subscribe(heard)
    app, provider = system.open_registrar("app"), system.open_registrar("provider")
    served = serve(provider, "camera")
    query = app.load("provider/camera", "front")
    query.priority = 5
    provider.send_status(query.resource_id, rr.Status(rr.State.WARNING, "low light"))
    served.do_unload = failing
    with pytest.raises(rr.UnloadFailed):
        query.unload()
    served.do_unload = None
    query.unload()
    with app.load("provider/camera", "again") as again:
        provider.reload(again.resource_id)
    served.do_load = failing
    with pytest.raises(rr.LoadFailed):
        app.load("provider/camera", "back")
    served.do_load = lambda _: rr.current().progress(0.5, "opening")
    left = app.load("provider/camera", "left")
    provider.revoke(left, "in the way")
    pausing(app, provider)
    streaming(app, provider)
    app.load("shop/thing", Order("wheel"))
    wait_respawned(system, "shop", kill(system, "shop"))
    worker = system.ref("worker")
    system.start_child(rr.ChildSpec(Ignoring, id="ignoring"))
    with pytest.raises(rr.RrError):
        system.start_child(rr.ChildSpec(Failing, id="failing"))
    supervisor = system.supervisor()
    supervisor.terminate_child("shop")
    supervisor.restart_child("shop")
    supervisor.terminate_child("shop")
    supervisor.delete_child("shop")
    worker.stop()
    eventually(lambda: "worker" not in [found.id for found in supervisor.which_children()])
    with pytest.raises(rr.ActorDeadError):
        worker.tell("is anybody there?")
    missing = {"gave_up", "auto_shutdown", "ended", "missed"}

    def all_heard() -> bool:
        return {event["event"] for event in heard} >= set(TYPE_OF) - missing

    eventually(all_heard, what=f"all of {set(TYPE_OF) - missing}")
    for event in heard:
        check(event)


@pytest.mark.parametrize("how", ["gave_up", "auto_shutdown"])
def test_the_events_of_a_system_that_ends_are_as_their_types_say(start: Start, how: str) -> None:
    heard = Calls()
    significant = how == "auto_shutdown"
    spec = rr.ChildSpec(
        Worker, id="worker", restart="transient" if significant else "permanent", significant=significant
    )
    ending = "any" if significant else "never"
    system = start(rr.Supervisor([spec], id="root", max_restarts=0, auto_shutdown=ending))
    system.subscribe(heard)
    assert child(system, "worker").state == "running"
    if significant:
        system.ref("worker").stop()
    else:
        kill(system, "worker")
    eventually(lambda: {how, "ended"} <= {event["event"] for event in heard}, what=f"{how} in {list(heard)}")
    for event in heard:
        check(event)


# -- a callback that is too slow -------------------------------------------------------------------------------------


@pytest.mark.parametrize("is_async", [False, True])
def test_a_callback_that_is_too_slow_hears_in_order_how_many_events_it_has_missed(
    start: Start, monkeypatch: pytest.MonkeyPatch, is_async: bool
) -> None:
    monkeypatch.setattr(backlogs, "KEPT", 50)
    slow, quick, gate = Calls(), Calls(), Gate()
    system = start()
    provider = system.open_registrar("provider")
    serve(provider, "camera")
    query = system.open_registrar("app").load("provider/camera", "front")

    def hear(event: Any) -> None:
        slow(event)
        gate()

    async def hear_async(event: Any) -> None:
        hear(event)

    system.subscribe(hear_async if is_async else hear)
    system.subscribe(quick)
    for number in range(180):
        provider.send_status(query.resource_id, rr.Status(rr.State.WARNING, str(number)))
        gate.wait_arrived()
        quick.wait(number + 1)  # so that it misses nothing, however busy the machine is
    assert [event["detail"] for event in quick.wait(180)] == [f"WARNING {number}" for number in range(180)]
    gate.open()

    heard = slow.wait(31)
    assert heard[0]["detail"] == "WARNING 0"
    assert heard[1] == {"event": "missed", "count": 150}
    assert [event["detail"] for event in heard[2:]] == [f"WARNING {number}" for number in range(151, 180)]
    check(heard[1])


def test_events_wait_for_a_free_worker(start: Start) -> None:
    system, gate, heard = start(config=rr.SystemConfig(workers_limit=2)), Gate(), Calls()
    app, provider = system.open_registrar("app"), system.open_registrar("provider")
    serve(provider, "slow", load=gate)
    system.subscribe(heard)
    waiting = [app.load("provider/slow", number, block=False) for number in range(2)]
    gate.wait_arrived(2)
    published = Calls()
    node = node_of(system)
    node.dispatcher.call(lambda: published(node.emit("progress")))
    published.wait()
    gate.open()
    for reply in waiting:
        reply.get(timeout=30)

    assert [event["event"] for event in heard.wait(3)] == ["progress", "loaded", "loaded"]
