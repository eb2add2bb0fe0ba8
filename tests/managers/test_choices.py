"""Choices: the best alternative, another one when it fails, the way back, and what crashes leave."""

from __future__ import annotations

import contextlib
import errno
import json
import os
import signal
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgspec
import pytest

import rr_actors as rr
from rr_actors.managers import Alternative, Budgets, Choices, Choose, Chosen, Pool, Share
from support import Calls, Gate, Served, eventually, hang, kill, pid_of, serve, wait_respawned
from support_cli import run_cli

Start = Callable[..., rr.System]

RATES = {"camera": 30, "lidar": 10, "sonar": 5}
LIMIT_S = 30.0
LONG_S = 600.0
BEST = Choose("range", prefer=["rate_hz"])


def sensor(name: str, **options: Any) -> Alternative:
    return Alternative("range", f"sensors/{name}", "front", {"rate_hz": RATES[name]}, **options)


SENSORS = [sensor("sonar"), sensor("camera"), sensor("lidar")]


class World:
    """A system with choices, and sensors in this process: what is done with them is in `steps`."""

    def __init__(
        self, start: Start, alternatives: Any = SENSORS, settle_s: float = LONG_S, *more: rr.ChildSpec
    ) -> None:
        choices = rr.ChildSpec(Choices, id="choices", args=(alternatives, settle_s))
        self.system = start(rr.Supervisor([choices, *more], max_restarts=1000))
        self.app, self.sensors = self.system.open_registrar("app"), self.system.open_registrar("sensors")
        self.steps, self.heard = Calls(), Calls()
        self.broken: set[str] = set()
        self.wanting = 0
        self.failures = Calls()
        self.served = {name: self._serve(name) for name in RATES}

    def _serve(self, name: str) -> Served:
        def load(request: Any) -> Any:
            if self.wanting:
                raise OSError(self.wanting, os.strerror(self.wanting))
            if name in self.broken:
                self.failures(name)
                raise OSError(f"no {name}")
            self.steps(f"load {name}")
            return {"topic": f"/{name}"}

        def unload(request: Any, response: Any) -> None:
            self.steps(f"unload {name}")

        return serve(self.sensors, name, load, unload)

    def choose(self, request: Choose = BEST) -> Any:
        return self.app.load("choices/choice", request, on_status=self.heard, timeout_s=LIMIT_S)

    def say(self, name: str, state: str, message: str = "unplugged") -> None:
        (found,) = [info for info in self.sensors.resources() if info.server == name and info.status != "FATAL"]
        self.sensors.send_status(found, rr.Status(state, message))

    def respawn(self) -> None:
        wait_respawned(self.system, "choices", kill(self.system, "choices"))

    def has(self, *names: str) -> bool:
        """Whether these sensors, and no others, are held and well, and nothing is being done."""
        infos = self.sensors.resources()
        there = sorted(info.server for info in infos for _ in info.queries)
        return there == sorted(names) and all(info.phase == "loaded" and info.status != "FATAL" for info in infos)

    def updates(self) -> list[rr.Status]:
        """Return the UPDATEs that were heard. On a busy machine a WARNING comes before one."""
        return [status for status in self.heard if status.state is rr.State.UPDATE]

    def settled(self, query: Any, *names: str) -> None:
        """Wait until the choice has the last of these sensors, and the others are on trial."""
        eventually(lambda: query.response.server == f"sensors/{names[-1]}", LIMIT_S, f"{names[-1]} in use")
        eventually(lambda: self.has(*names), LIMIT_S, f"{names} held")


@pytest.fixture
def world(start: Start) -> World:
    return World(start)


def test_the_best_alternative_is_loaded_and_released_with_the_choice(world: World) -> None:
    with world.choose() as choice:
        assert choice.response == Chosen("sensors/camera", "front", {"topic": "/camera"}, {"rate_hz": 30})
        assert world.has("camera")
    assert world.steps.items == ["load camera", "unload camera"]


def test_where_and_prefer_say_which_is_best(world: World) -> None:
    slow = world.choose(Choose("range", {"rate_hz": "<30"}, ["rate_hz"]))
    assert slow.response.server == "sensors/lidar"
    first = world.choose(Choose("range"))
    assert first.response.server == "sensors/sonar"


@pytest.mark.parametrize("wanted", [errno.ENOSPC, errno.EDQUOT, errno.EMFILE, errno.ENFILE])
def test_want_of_means_is_no_fault_of_an_alternative_and_the_search_goes_on_until_there_are_some(
    world: World, wanted: int
) -> None:
    query = world.choose()
    world.wanting = wanted
    world.say("camera", "FATAL")
    said = f"; no other one can be started now, and that is tried again: {errno.errorcode[wanted]}: "
    eventually(lambda: any(said in status.message for status in world.heard))
    told = [status for status in world.heard if not status.message.endswith("the next one is being loaded")]
    assert [(status.state, said in status.message) for status in told] == [(rr.State.WARNING, True)]
    world.wanting = 0
    world.settled(query, "lidar")
    assert not [status for status in world.heard if status.state is rr.State.FATAL]
    reliabilities = world.system.registrar("choices").directory / "reliability.json"
    assert list(json.loads(reliabilities.read_text())["reliability"]) == ['sensors/camera "front"']


def test_one_that_cannot_be_loaded_is_passed_over(world: World) -> None:
    world.broken = {"camera"}
    assert world.choose().response.server == "sensors/lidar"


def test_alternatives_may_be_in_a_file(start: Start, tmp_path: Path) -> None:
    file = tmp_path / "choices.toml"
    file.write_text('[[alternative]]\nkind = "range"\nserver = "sensors/sonar"\nrequest = { device = "front" }\n')
    world = World(start, str(file))
    assert world.choose(Choose("range")).response.request == {"device": "front"}


class Typed(msgspec.Struct):
    """A response with the part's own as a type."""

    server: str
    response: dict[str, str]


def test_a_response_type_of_ones_own_reads_the_response(world: World) -> None:
    choice = world.app.load("choices/choice", BEST, response_type=Typed)
    assert choice.response.response["topic"] == "/camera"


# -- what is wrong -------------------------------------------------------------------------------------------------


WRONG: list[tuple[Any, str]] = [
    (Choose("sound"), "kind: expected one of range, got 'sound', which nothing provides"),
    (Choose("range", {"rate_hz": ">=fast"}), "where.rate_hz: expected a number after >=, got '>=fast'"),
    (Choose("range", {"rate": ">=1"}), "where.rate: expected one of rate_hz, reliability"),
    (Choose("range", prefer=["-price"]), r"prefer\[0\]: expected one of rate_hz, reliability"),
    (
        Choose("range", {"rate_hz": ">99"}),
        r"(?s)nothing is left for 'range':.*sensors/camera .*rate_hz is 30, expected >99",
    ),
    ({"kind": "range", "wehre": {}}, "wehre"),
    ({"kind": "range", "where": {"rate_hz": [10]}}, "where"),
]


def test_a_choice_that_cannot_be_is_refused_by_name(world: World) -> None:
    for request, says in WRONG:
        with pytest.raises(rr.RrError, match=says):
            world.choose(request)
    assert world.has()
    assert not world.system.registrar("choices").resources()


def test_a_choice_of_which_nothing_can_be_loaded_says_why_for_each(world: World) -> None:
    world.broken = set(RATES)
    with pytest.raises(rr.LoadFailed, match=r"(?s)for 'range':.*no camera.*no lidar.*no sonar"):
        world.choose()


def test_a_server_that_does_not_exist_is_one_that_cannot_be_loaded(start: Start) -> None:
    world = World(start, [Alternative("range", "sensors/radar"), sensor("sonar")])
    assert world.choose(Choose("range")).response.server == "sensors/sonar"


def test_a_file_or_settling_time_that_is_wrong_fails_the_start_by_name(start: Start, tmp_path: Path) -> None:
    (tmp_path / "choices.toml").write_text('[[alternative]]\nkind = "range"\nsevrer = "a/b"\n')
    with pytest.raises(rr.StartFailed, match=r"choices.toml: alternative\[0\].sevrer: .* did you mean 'server'"):
        start(rr.ChildSpec(Choices, id="choices", args=(str(tmp_path / "choices.toml"),)))
    with pytest.raises(rr.StartFailed, match="settle_s: expected a number of seconds, at least 0, got -1"):
        start(rr.ChildSpec(Choices, id="choices", args=(SENSORS, -1)))


# -- replacing -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("state", ["ERROR", "FATAL"])
def test_the_next_best_is_loaded_before_the_failed_one_is_released(world: World, state: str) -> None:
    choice = world.choose()
    world.say("camera", state)
    eventually(lambda: len(world.updates()) == 1, LIMIT_S, "an UPDATE")
    assert choice.response.server == "sensors/lidar"
    eventually(lambda: world.has("lidar"))
    assert world.steps.items == ["load camera", "load lidar", "unload camera"]


def test_a_warning_is_for_the_holders_and_changes_nothing(world: World) -> None:
    choice = world.choose()
    world.say("camera", "WARNING", "hot")
    assert choice.wait_status("WARNING", timeout_s=LIMIT_S).message == "hot"
    assert world.has("camera")


def test_a_new_response_of_the_alternative_is_one_of_the_choice(world: World) -> None:
    choice = world.choose()
    (camera,) = world.sensors.resources()
    world.sensors.update_response(camera, {"topic": "/new"})
    choice.wait_status("UPDATE", timeout_s=LIMIT_S)
    assert choice.response.response == {"topic": "/new"}


def test_when_nothing_is_left_fatal_says_what_was_tried_and_why_each_failed(world: World) -> None:
    choice = world.choose()
    world.broken = {"lidar", "sonar"}
    world.say("camera", "FATAL")
    message = choice.wait_status("FATAL", timeout_s=LIMIT_S).message
    assert [line.split()[0] for line in message.splitlines()[1:]] == [
        f"sensors/{name}" for name in ("camera", "lidar", "sonar")
    ]
    assert all(text in message for text in ("unplugged", "no lidar", "no sonar"))
    choice.unload()
    eventually(lambda: world.has())
    world.broken = set()
    assert world.choose().response.server == "sensors/camera"  # a new one, as the camera may have come back


def test_an_error_of_the_last_one_reaches_the_holders_and_the_first_that_is_well_takes_its_place(start: Start) -> None:
    world = World(start, settle_s=0.1)
    choice = world.choose()
    world.broken = {"lidar", "sonar"}
    world.say("camera", "ERROR", "dark")
    assert choice.wait_status("ERROR", timeout_s=LIMIT_S).message == "dark"
    assert choice.response.server == "sensors/camera"
    world.broken = {"camera", "lidar"}
    world.settled(choice, "sonar")


def test_what_is_exclusive_is_released_before_another_is_loaded(start: Start) -> None:
    world = World(start, [sensor("camera"), sensor("lidar", break_first=True), sensor("sonar")])
    choice = world.choose()
    world.say("camera", "FATAL")
    world.settled(choice, "lidar")
    world.say("lidar", "FATAL")
    world.settled(choice, "sonar")
    order = ["load camera", "unload camera", "load lidar", "unload lidar", "load sonar"]
    assert world.steps.items == order
    eventually(lambda: len(world.updates()) == 2, LIMIT_S, "two UPDATEs")


def test_after_an_exclusive_one_that_cannot_be_loaded_the_next_is_or_nothing_is_left(start: Start) -> None:
    world = World(start, [sensor("camera"), sensor("lidar", break_first=True), sensor("sonar")])
    choice = world.choose()
    world.broken = {"lidar"}
    world.say("camera", "ERROR")
    world.settled(choice, "sonar")
    world.broken = set(RATES)
    world.say("sonar", "FATAL")
    assert "no lidar" in choice.wait_status("FATAL", timeout_s=LIMIT_S).message


def test_what_is_revoked_is_replaced_and_keeps_its_reliability(world: World) -> None:
    choice = world.choose(Choose("range", prefer=["reliability", "rate_hz"]))
    (camera,) = world.sensors.resources()
    world.sensors.revoke(camera, "no power", grace_s=LIMIT_S)
    world.settled(choice, "lidar")
    other = world.choose(Choose("range", {"reliability": ">=1"}, ["rate_hz"]))
    assert other.response.server == "sensors/lidar"  # the camera is the last resort for a while
    assert "UPDATE" in [status.state for status in world.heard]


def test_a_choice_whose_last_one_is_revoked_is_revoked_itself(start: Start) -> None:
    world = World(start, [sensor("camera")])
    choice = world.choose()
    (camera,) = world.sensors.resources()
    world.sensors.revoke(camera, "no power", grace_s=LIMIT_S)
    assert choice.wait_status("FATAL", timeout_s=LIMIT_S).reason == "revoked"
    eventually(lambda: world.has())


def test_a_failure_lowers_the_reliability_also_after_a_restart(start: Start) -> None:
    world = World(start)
    trusted = Choose("range", prefer=["reliability", "rate_hz"])
    choice = world.choose(trusted)
    world.say("camera", "FATAL")
    world.settled(choice, "lidar")
    choice.unload()
    world.respawn()
    assert world.choose(trusted).response.server == "sensors/lidar"


def test_what_serves_as_two_kinds_provides_what_each_says(start: Start) -> None:
    light = Alternative("light", "sensors/camera", "front", {"lumen": 5})
    world = World(start, [light, *SENSORS])
    choice, other = world.choose(), world.choose(Choose("light"))
    (camera,) = world.sensors.resources()
    world.sensors.update_response(camera, {"topic": "/new"})
    for query, provided in ((choice, {"rate_hz": 30}), (other, {"lumen": 5})):
        query.wait_status("UPDATE", timeout_s=LIMIT_S)
        assert query.response.provides == provided
    world.say("camera", "FATAL")
    assert other.wait_status("FATAL", timeout_s=LIMIT_S).message.startswith("nothing is left for 'light'")
    choice.wait_status("UPDATE", timeout_s=LIMIT_S)
    assert choice.response.server == "sensors/lidar"


def test_choices_of_several_share_what_they_choose(world: World) -> None:
    one, other = world.choose(), world.choose(Choose("range", {"rate_hz": ">=10"}, ["rate_hz"]))
    world.say("camera", "FATAL")
    world.settled(one, "lidar", "lidar")
    world.settled(other, "lidar", "lidar")
    assert world.steps.items.count("load lidar") == 1


def several(world: World) -> list[Any]:
    return [world.choose(Choose("range", {"rate_hz": f">{-i}"}, ["rate_hz"])) for i in range(1, 8)]


def test_one_failure_counts_once_however_many_choices_have_it(world: World) -> None:
    choices = several(world)
    world.broken = {"lidar"}
    world.say("camera", "FATAL")
    for choice in choices:
        world.settled(choice, *["sonar"] * len(choices))
    world.broken = set()
    failures = {10: world.failures.items.count("lidar"), 30: 1}  # a busy machine may try the lidar once more
    for rate, count in failures.items():
        trusted = Choose("range", {"reliability": f">={0.5**count}", "rate_hz": rate})
        assert world.choose(trusted).response.provides["rate_hz"] == rate


def test_an_error_that_comes_again_after_a_return_is_another_failure(start: Start) -> None:
    world = World(start, settle_s=0.3)
    choice, began = world.choose(), 0.0
    with world.app.load("sensors/camera", "front"):  # so it stays the same resource
        for _ in range(3):
            world.say("camera", "ERROR")
            began = time.monotonic()
            eventually(lambda: choice.response.server == "sensors/lidar", LIMIT_S)
            world.say("camera", "OK")
            eventually(lambda: choice.response.server == "sensors/camera", LIMIT_S)
    assert time.monotonic() - began > 1.2  # the delay doubles each time: 0.3 s, 0.6 s, 1.2 s


def test_the_way_back_takes_as_long_for_many_choices_as_for_one(start: Start) -> None:
    world = World(start, settle_s=0.5)
    choices = several(world)
    world.say("camera", "FATAL")
    for choice in choices:
        eventually(lambda choice=choice: choice.response.server == "sensors/lidar", LIMIT_S)
    began = time.monotonic()
    for choice in choices:
        eventually(lambda choice=choice: choice.response.server == "sensors/camera", LIMIT_S)
    assert time.monotonic() - began < 15  # if each choice had doubled the delay: 32 s


def test_the_next_one_is_tried_beside_one_that_hangs_and_the_holders_hear_of_it(world: World) -> None:
    choice, gate = world.choose(), Gate()
    world.served["lidar"].do_load = lambda request: gate()
    world.say("camera", "FATAL")
    heard = [(status.state, status.message) for status in world.heard.wait(2, LIMIT_S)]
    assert choice.response.server == "sensors/sonar"
    assert [state for state, _ in heard] == [rr.State.WARNING, rr.State.UPDATE]
    assert heard[0][1] == 'sensors/camera "front": unplugged; the next one is being loaded'
    gate.open()
    eventually(lambda: world.has("lidar", "sonar"), LIMIT_S, "the lidar is on trial, and held once")


def test_the_best_one_that_hangs_costs_a_new_choice_some_seconds_and_not_its_whole_time(world: World) -> None:
    gate = Gate()
    world.served["camera"].do_load = lambda request: gate()
    choice = world.app.load("choices/choice", BEST, timeout_s=25.0)
    assert choice.response.server == "sensors/lidar"
    gate.open()
    eventually(lambda: world.has("camera", "lidar"), LIMIT_S, "the camera is on trial, and held once")


def test_nothing_is_tried_beside_one_that_is_exclusive_in_a_new_choice(start: Start) -> None:
    world = World(start, [sensor("camera", break_first=True), sensor("lidar")])

    beside, serve = threading.Event(), world.served["lidar"].do_load
    assert serve is not None

    def note(request: Any) -> Any:
        response = serve(request)
        beside.set()
        return response

    def give_up_late(request: Any) -> None:
        beside.wait(6)  # beside another one, the next is tried after five seconds
        world.steps("the camera has failed")
        raise OSError("no camera")

    world.served["lidar"].do_load, world.served["camera"].do_load = note, give_up_late
    assert world.choose().response.server == "sensors/lidar"
    assert list(world.steps) == ["the camera has failed", "load lidar"]


def test_what_another_choice_has_is_preferred_to_what_is_not_loaded(world: World) -> None:
    world.choose(Choose("range", {"rate_hz": "<10"}))
    choice = world.choose()
    world.say("camera", "FATAL")
    eventually(lambda: len(world.updates()) == 1, LIMIT_S, "an UPDATE")
    assert choice.response.server == "sensors/sonar"


@pytest.mark.parametrize("file", ["reliability.json", "choices.json"])
def test_a_failure_that_cannot_be_noted_on_disk_is_replaced_all_the_same(start: Start, file: str) -> None:
    world = World(start, [sensor("camera"), sensor("lidar", break_first=True)])
    (world.system.state_dir / "choices" / file).mkdir(parents=True)
    choice = world.choose()
    world.say("camera", "FATAL")
    world.settled(choice, "lidar")


def test_what_is_lost_again_and_again_waits_longer_each_time_and_the_holders_hear_that(start: Start) -> None:
    world = World(start, [sensor("camera"), sensor("lidar")])
    choice = world.choose()
    warned = "as it has failed repeatedly"

    def waits() -> list[float]:
        said = [status.message for status in world.heard if warned in status.message]
        return [float(message.split(" in ")[1].split(" s,")[0]) for message in said]

    while len(set(waits())) < 2:  # on a slow machine an alternative is well for so long that it begins again
        world.say(choice.response.server.removeprefix("sensors/"), "FATAL")
        seen = choice.response.server
        eventually(lambda: choice.response.server != seen, LIMIT_S)  # noqa: B023
    assert len(world.steps.items) < 30
    assert all(status.state is rr.State.WARNING for status in world.heard if warned in status.message)
    assert waits()[-1] > waits()[0]


RINGS = {
    "itself": [Alternative("range", "choices/choice", {"kind": "range"}), sensor("lidar")],
    "another": [
        Alternative("range", "choices/choice", Choose("distance")),
        sensor("lidar"),
        Alternative("distance", "choices/choice", {"kind": "range", "where": {}}),
    ],
}


@pytest.mark.parametrize("alternatives", RINGS.values(), ids=RINGS)
def test_alternatives_that_hold_each_other_in_a_ring_are_refused_by_name(start: Start, alternatives: Any) -> None:
    with pytest.raises(rr.StartFailed, match=r"alternative\[0\]: expected alternatives .* got the ring choices/choice"):
        start(rr.ChildSpec(Choices, id="choices", args=(alternatives,)))


def test_a_choice_may_be_an_alternative_of_another_kind(start: Start) -> None:
    world = World(start, [Alternative("distance", "choices/choice", {"kind": "range"}), *SENSORS])
    choice = world.choose(Choose("distance"))
    assert choice.response.response["server"] == "sensors/sonar"
    choice.unload()
    eventually(lambda: world.has() and not world.system.registrar("choices").resources())


# -- the way back --------------------------------------------------------------------------------------------------


def test_a_better_one_that_is_well_again_takes_its_place_back(start: Start) -> None:
    world = World(start, settle_s=0.2)
    choice = world.choose()
    world.say("camera", "FATAL")
    eventually(lambda: len(world.updates()) == 1, LIMIT_S, "an UPDATE")
    assert choice.response.server == "sensors/lidar"
    world.settled(choice, "camera")
    assert len(world.updates()) == 2
    assert world.steps.items[-2:] == ["load camera", "unload lidar"]
    assert "takes the place of sensors/lidar: returns to sensors/camera" in world.updates()[1].message


def test_one_that_is_broken_still_is_tried_again_until_it_is_well(start: Start) -> None:
    world = World(start, settle_s=0.05)
    choice = world.choose()
    world.broken = {"camera"}
    world.say("camera", "FATAL")
    eventually(lambda: len(world.served["camera"].loads) >= 3, LIMIT_S)
    assert choice.response.server == "sensors/lidar"
    world.broken = set()
    world.settled(choice, "camera")


def test_one_that_fails_on_trial_is_not_taken(start: Start) -> None:
    world = World(start, settle_s=0.5)
    choice = world.choose()
    world.say("camera", "FATAL")
    world.settled(choice, "camera", "lidar")  # the camera is on trial
    world.say("camera", "ERROR")
    eventually(lambda: world.has("lidar"), LIMIT_S)
    assert choice.response.server == "sensors/lidar"
    world.settled(choice, "camera")  # after another trial


def test_one_on_trial_is_taken_at_once_if_the_one_in_use_fails(start: Start) -> None:
    world = World(start, settle_s=1.0)
    choice = world.choose()
    world.say("camera", "FATAL")
    world.settled(choice, "camera", "lidar")
    loads = len(world.served["camera"].loads)
    world.say("lidar", "FATAL")
    world.settled(choice, "camera")
    assert len(world.served["camera"].loads) == loads


def test_a_trial_ends_with_the_choice_that_wanted_it(start: Start) -> None:
    world = World(start, settle_s=1.0)
    choice = world.choose()
    world.say("camera", "FATAL")
    world.settled(choice, "camera", "lidar")
    choice.unload()
    eventually(lambda: world.has(), LIMIT_S)


def test_a_trial_is_the_least_urgent_load_until_it_takes_its_place(start: Start) -> None:
    world = World(start, settle_s=1.0)
    choice = world.app.load("choices/choice", BEST, priority=7)
    world.say("camera", "FATAL")
    world.settled(choice, "camera", "lidar")

    def urgency() -> list[int | None]:
        return [info.priority for info in world.sensors.resources() if info.server == "camera"]

    assert urgency() == [-1000]
    world.settled(choice, "camera")
    assert urgency() == [7]


def test_a_trial_takes_no_room_of_others(start: Start) -> None:
    pools = [Pool("watts", 40)]
    world = World(start, SENSORS, 0.05, rr.ChildSpec(Budgets, id="budgets", args=(pools,)))
    is_broken = threading.Event()

    def open_camera(request: Any) -> Any:
        world.sensors.load("budgets/share", Share("watts", 30))
        if is_broken.is_set():
            raise OSError("no camera")
        world.steps("load camera")
        return {"topic": "/camera"}

    world.served["camera"].do_load = open_camera
    choice = world.app.load("choices/choice", BEST, priority=9)
    is_broken.set()
    world.say("camera", "FATAL")
    world.settled(choice, "lidar")
    heater = world.app.load("budgets/share", Share("watts", 30, instance="heater"), priority=1, timeout_s=LIMIT_S)
    seen = len(world.served["camera"].loads)
    eventually(lambda: len(world.served["camera"].loads) > seen + 1, LIMIT_S, "trials of the camera")
    assert heater.fetch_state() == "OK"
    assert not heater.released
    heater.unload()
    is_broken.clear()
    world.settled(choice, "camera")


def test_a_choice_does_not_return_to_what_is_exclusive(start: Start) -> None:
    world = World(start, [sensor("camera", break_first=True), sensor("lidar"), sensor("sonar")], 0.1)
    choice = world.choose()
    world.say("camera", "FATAL")
    world.settled(choice, "lidar")
    world.broken = {"sonar"}
    world.say("lidar", "FATAL")
    world.settled(choice, "camera")  # as the one in use has failed, and before that not
    assert world.steps.items.count("load camera") == 2


# -- streams -------------------------------------------------------------------------------------------------------


def test_the_reader_of_a_stream_goes_on_with_that_of_the_next(start: Start) -> None:
    world = World(start)
    publishers: dict[str, rr.Publisher] = {}

    def opening(name: str) -> Callable[[Any], rr.Stream]:
        def load(request: Any) -> rr.Stream:
            publishers[name] = rr.current().open_stream("ranges")
            return publishers[name].stream

        return load

    for name in ("camera", "lidar"):
        world.sensors.unregister_server(name)
        world.sensors.register_server(name, opening(name))
    ended = threading.Event()

    def publish() -> None:
        while not ended.wait(0.005):
            for name, publisher in list(publishers.items()):
                publisher.publish(name)

    thread = threading.Thread(target=publish)
    thread.start()
    try:
        reader = world.choose().stream("ranges", timeout_s=LIMIT_S)
        assert next(reader).value == "camera"
        world.say("camera", "FATAL")
        assert next(frame.value for frame in reader if frame.value != "camera") == "lidar"
    finally:
        ended.set()
        thread.join()


# -- crashes -------------------------------------------------------------------------------------------------------


class Cars(rr.Manager):
    """Has a radar, which its process takes with it when it ends, and one that it keeps."""

    @rr.server("radar", recovery="lost")
    def load_radar(self, request: str) -> str:
        return request

    @rr.server("kept", recovery="keep")
    def load_kept(self, request: str) -> str:
        return request


def radar(name: str = "radar") -> Alternative:
    return Alternative("range", f"cars/{name}", "front", {"rate_hz": 60})


def test_a_manager_that_is_killed_knows_its_choices_and_goes_on(start: Start) -> None:
    world = World(start, settle_s=0.2)
    choice = world.choose()
    world.respawn()
    assert world.has("camera")
    world.say("camera", "FATAL")
    eventually(lambda: len(world.updates()) == 1, LIMIT_S, "an UPDATE")
    assert choice.response.server == "sensors/lidar"
    world.respawn()
    world.settled(choice, "camera")


def test_trials_of_a_manager_that_is_killed_begin_anew(start: Start) -> None:
    world = World(start, settle_s=0.7)
    choice = world.choose()
    world.say("camera", "FATAL")
    world.settled(choice, "camera", "lidar")
    world.respawn()
    world.settled(choice, "camera")


class SlowCars(rr.Manager):
    """Has a radar whose first load is quick and fails, and whose next one goes on until a file is there."""

    @rr.server("radar", recovery="keep")
    def load_radar(self, request: str) -> str:
        if not Path(request, "failed").exists():
            Path(request, "failed").touch()
            raise OSError("no radar")
        Path(request, "begun").touch()
        eventually(Path(request, "go").exists, LIMIT_S)
        return request


def test_a_trial_is_released_when_its_provider_is_back_after_a_kill(start: Start, tmp_path: Path) -> None:
    best = Alternative("range", "cars/radar", str(tmp_path), {"rate_hz": 60})
    world = World(start, [best, sensor("camera")], 0.1, rr.ChildSpec(SlowCars, id="cars"))
    choice = world.choose()
    assert choice.response.server == "sensors/camera"
    eventually((tmp_path / "begun").exists, LIMIT_S)

    cars, choices, handle = (
        pid_of(world.system, "cars"),
        pid_of(world.system, "choices"),
        world.system.registrar("cars"),
    )
    hang(choices)  # it does not hear that the radar is loaded
    (tmp_path / "go").touch()
    eventually(lambda: [info.phase for info in handle.resources()] == ["loaded"], LIMIT_S)
    hang(cars)  # and does not ask for what it had, until it has started again
    try:
        wait_respawned(world.system, "choices", kill(world.system, "choices"))
    finally:
        os.kill(cars, signal.SIGCONT)

    eventually(lambda: choice.response.server == "cars/radar", LIMIT_S)
    eventually(lambda: [info.holders for info in handle.resources()] == [("choices",)], LIMIT_S)


@pytest.mark.parametrize("breaks", [False, True])
def test_killed_at_any_moment_of_a_replacement_it_has_one_part_in_the_end(start: Start, breaks: bool) -> None:
    every = [sensor(name, break_first=breaks) for name in RATES]
    world = World(start, every)
    choice = world.choose(Choose("range", prefer=["reliability"]))
    for delay_s in (0.0, 0.002, 0.004, 0.008):
        failed = choice.response.server.removeprefix("sensors/")
        old = pid_of(world.system, "choices")
        world.say(failed, "FATAL")
        time.sleep(delay_s)  # a moment to be killed at, and no wait
        kill(world.system, "choices")
        wait_respawned(world.system, "choices", old)

        def is_well() -> bool:
            """Whether it has one part. On a busy machine a better sensor may be slower than that, and is on trial."""
            used = choice.response.server.removeprefix("sensors/")
            parts = world.system.registrar("choices").children(choice.resource_id)
            held = [info.server for info in world.sensors.resources() for _ in info.queries]
            return used != failed and [part.server for part in parts] == [used] and len(held) == len(set(held))  # noqa: B023

        def is_heard() -> bool:
            """Say OK of the sensor in use. After a crash it may be replaced once more, so say it until it is heard."""
            if not is_well():
                return False
            with contextlib.suppress(ValueError):  # it has just been released
                world.say(choice.response.server.removeprefix("sensors/"), "OK", f"after {delay_s}")  # noqa: B023
            return f"after {delay_s}" in [status.message for status in world.heard]  # noqa: B023

        eventually(is_heard, LIMIT_S)
        eventually(is_well, LIMIT_S)
    choice.unload()
    eventually(world.has, LIMIT_S, "nothing is held")
    assert rr.State.FATAL not in [status.state for status in world.heard]


def test_killed_while_it_loads_it_keeps_nothing_of_the_first_attempt(start: Start) -> None:
    world, gate = World(start), Gate()
    world.broken = {"camera"}
    world.served["lidar"].do_load = lambda request: gate()
    load = world.app.load("choices/choice", BEST, timeout_s=LIMIT_S, block=False)
    gate.wait_arrived()
    old = pid_of(world.system, "choices")
    world.broken = set()
    kill(world.system, "choices")
    wait_respawned(world.system, "choices", old)
    choice = load.get(timeout=LIMIT_S)
    gate.open()
    world.settled(choice, "camera")
    assert len(world.system.registrar("choices").children(choice.resource_id)) == 1


def test_killed_when_it_has_released_an_exclusive_one_it_chooses_anew(start: Start) -> None:
    world = World(start, [sensor("camera", break_first=True), sensor("lidar"), sensor("sonar")])
    choice, gate = world.choose(), Gate()
    world.served["lidar"].do_load = lambda request: gate()
    world.say("camera", "FATAL")
    gate.wait_arrived()
    old = kill(world.system, "choices")
    gate.open()
    wait_respawned(world.system, "choices", old)
    choice.wait_status("UPDATE", timeout_s=LIMIT_S)
    world.settled(choice, choice.response.server.removeprefix("sensors/"))


def test_restarted_in_order_when_it_has_released_an_exclusive_one_it_chooses_anew(start: Start) -> None:
    world = World(start, [sensor("camera", break_first=True), sensor("lidar"), sensor("sonar")])
    choice, gate = world.choose(), Gate()
    world.served["lidar"].do_load = lambda request: gate()
    world.say("camera", "FATAL")
    gate.wait_arrived()
    world.system.supervisor().terminate_child("choices")
    gate.open()
    world.system.supervisor().restart_child("choices")
    choice.wait_status("UPDATE", timeout_s=LIMIT_S)
    world.settled(choice, choice.response.server.removeprefix("sensors/"))


def test_stopped_in_order_while_it_searches_it_logs_no_error(start: Start, caplog: pytest.LogCaptureFixture) -> None:
    every = [Alternative("range", f"sensors/{name}", "front", break_first=True) for name in ("camera", "lidar")]
    system = start(rr.ChildSpec(Choices, id="choices", args=(every,), placement="thread"))
    sensors, gate = system.open_registrar("sensors"), Gate()
    serve(sensors, "camera")
    serve(sensors, "lidar", lambda request: gate())
    system.open_registrar("app").load("choices/choice", Choose("range"))
    sensors.send_status(sensors.resources()[0], rr.Status("FATAL", "unplugged"))
    gate.wait_arrived()
    system.supervisor().terminate_child("choices")
    gate.open()
    assert [record.getMessage() for record in caplog.records if "choice" in record.getMessage()] == []
    system.supervisor().restart_child("choices")
    (query,) = system.registrar("app").queries()
    eventually(lambda: query.state is rr.State.UPDATE, LIMIT_S)


def test_killed_while_its_part_says_error_it_takes_the_next_that_is_well(start: Start) -> None:
    world = World(start, settle_s=0.1)
    choice = world.choose()
    world.broken = {"lidar", "sonar"}
    world.say("camera", "ERROR", "dark")
    choice.wait_status("ERROR", timeout_s=LIMIT_S)
    world.respawn()
    world.broken = {"camera", "lidar"}
    world.settled(choice, "sonar")


def test_killed_when_it_has_been_told_to_return_it_returns(start: Start) -> None:
    world = World(start, settle_s=0.2)
    choice = world.choose()
    world.say("camera", "FATAL")
    world.settled(choice, "camera", "lidar")
    old = pid_of(world.system, "choices")
    world.system.subscribe(lambda event: kill(world.system, "choices") if "returns to" in str(event) else None)
    wait_respawned(world.system, "choices", old)
    world.settled(choice, "camera")


def test_the_end_of_an_alternatives_manager_is_a_failure_if_its_resource_is_lost_with_it(start: Start) -> None:
    world = World(start, [*SENSORS, radar()], LONG_S, rr.ChildSpec(Cars, id="cars"))
    choice = world.choose()
    assert choice.response.server == "cars/radar"
    kill(world.system, "cars")
    world.settled(choice, "camera")


def test_the_end_of_an_alternatives_manager_changes_nothing_if_its_resource_is_kept(start: Start) -> None:
    world = World(start, [*SENSORS, radar("kept")], LONG_S, rr.ChildSpec(Cars, id="cars"))
    choice = world.choose()
    wait_respawned(world.system, "cars", kill(world.system, "cars"))
    assert choice.response.server == "cars/kept"
    assert choice.fetch_state() == "OK"
    assert not world.steps.items


def test_a_manager_that_ends_for_good_is_replaced_and_does_not_come_back(start: Start) -> None:
    world = World(start, [*SENSORS, radar()], 0.05, rr.ChildSpec(Cars, id="cars", restart="temporary"))
    choice = world.choose()
    kill(world.system, "cars")
    world.settled(choice, "camera")


# -- chosen by hand ----------------------------------------------------------------------------------------------------


class ByHand(World):
    """A world with a manager that an operator drives."""

    def fix(self, choice: Any, alternative: str, **options: Any) -> Any:
        return self.system.ref("choices").proxy().choose(choice.resource_id, alternative, **options).get()

    def free(self, choice: Any) -> Any:
        return self.system.ref("choices").proxy().choose_freely(choice.resource_id).get()

    def info(self) -> Any:
        (info,) = self.system.ref("choices").proxy().choices().get()
        return info


def test_what_is_chosen_by_hand_takes_the_place_and_stays_until_it_is_taken_back(start: Start) -> None:
    world = ByHand(start, settle_s=0.1)
    choice = world.choose()
    world.fix(choice, "sensors/sonar", by="eve")
    world.settled(choice, "sonar")
    assert world.updates()[-1].state is rr.State.UPDATE
    info = world.info()
    assert (info.kind, info.present, info.by_hand, info.by, info.why) == (
        *("range", 'sensors/sonar "front"', 'sensors/sonar "front"', "eve"),
        "",
    )
    assert info.allowed[0] == info.present
    assert abs(info.at - time.time()) < LONG_S

    assert world.free(choice).by_hand == ""
    world.settled(choice, "camera")  # by itself, as it is better


def test_while_what_is_chosen_by_hand_fails_another_one_serves_and_it_comes_back(start: Start) -> None:
    world = ByHand(start, settle_s=0.1)
    choice = world.choose()
    world.fix(choice, "sensors/lidar")
    world.settled(choice, "lidar")
    world.broken = {"lidar"}
    world.say("lidar", "FATAL", "the cable is out")
    eventually(lambda: choice.response.server == "sensors/camera", LIMIT_S)
    assert world.info().why == "it is not in use yet, or has failed"
    world.broken = set()
    world.settled(choice, "lidar")
    assert world.info().why == ""


def test_what_cannot_be_loaded_is_taken_when_it_can(start: Start) -> None:
    world = ByHand(start, settle_s=0.1)
    choice = world.choose()
    world.broken = {"sonar"}
    world.fix(choice, "sensors/sonar")
    world.failures.wait()
    assert choice.response.server == "sensors/camera"
    world.broken = set()
    world.settled(choice, "sonar")


def test_what_is_exclusive_is_taken_if_it_is_chosen_by_hand(start: Start) -> None:
    world = ByHand(start, [sensor("camera"), sensor("sonar", break_first=True)], 0.1)
    choice = world.choose()
    world.fix(choice, "sensors/sonar")
    world.settled(choice, "sonar")
    assert world.steps.items == ["load camera", "unload camera", "load sonar"]
    world.broken = {"sonar"}
    world.say("sonar", "FATAL")
    world.settled(choice, "camera")


def test_an_exclusive_one_that_cannot_be_loaded_leaves_the_next_in_its_place(start: Start) -> None:
    world = ByHand(start, [sensor("camera"), sensor("sonar", break_first=True)], 0.1)
    choice = world.choose()
    world.broken = {"sonar"}
    world.fix(choice, "sensors/sonar")
    world.failures.wait()
    world.settled(choice, "camera")


def test_what_is_chosen_by_hand_is_known_after_a_kill_and_forgotten_with_the_choice(start: Start) -> None:
    world = ByHand(start, settle_s=0.1)
    choice = world.choose()
    world.fix(choice, "sensors/sonar")
    world.settled(choice, "sonar")
    world.respawn()
    assert world.info().by_hand == 'sensors/sonar "front"'
    kept = world.system.registrar("choices").directory / "choices.json"
    assert list(json.loads(kept.read_text())["by_hand"]) == [choice.resource_id]
    choice.unload()
    eventually(lambda: json.loads(kept.read_text())["by_hand"] == {})
    assert world.choose().response.server == "sensors/camera"


@pytest.mark.parametrize(
    ("choice", "alternative", "error", "said"),
    [
        ("nothing", "sensors/sonar", rr.NotFound, "no choice 'nothing': there are "),
        ("range", "sensors/radar", rr.NotFound, "no alternative 'sensors/radar': the choice allows sensors/camera "),
        ("range", "sensors/sonar", rr.NotFound, "the choice allows sensors/camera "),
        ("range", 5, rr.UsageError, "expected an alternative, as 'registrar/server' or with its request, got 5"),
        (None, "sensors/sonar", rr.UsageError, "expected the id or the kind of a choice, got None"),
    ],
)
def test_what_cannot_be_chosen_is_refused_by_name(
    start: Start, choice: Any, alternative: Any, error: type[Exception], said: str
) -> None:
    world = ByHand(start)
    world.choose(Choose("range", {"rate_hz": ">=10"}, ["rate_hz"]))
    with pytest.raises(error, match=said):
        world.system.ref("choices").proxy().choose(choice, alternative).get()
    with pytest.raises(rr.UsageError, match="nothing is chosen for it by hand"):
        world.system.ref("choices").proxy().choose_freely("range").get()
    assert world.info().by_hand == ""


def test_a_choice_that_is_one_of_several_is_named_by_its_id(start: Start) -> None:
    world = ByHand(start)
    one = world.choose()
    world.choose(Choose("range"))
    with pytest.raises(rr.UsageError, match="'range' means several choices"):
        world.system.ref("choices").proxy().choose("range", "sensors/sonar").get()
    assert world.fix(one, 'sensors/sonar "front"', dry_run=True).by_hand == ""
    part = one.resource_id[-8:]
    assert world.system.ref("choices").proxy().choose(part, "sensors/sonar").get().id == one.resource_id


@pytest.mark.usefixtures("runtime_dir")
def test_the_list_of_choices_says_why_a_better_one_was_passed_over(start: Start) -> None:
    world = ByHand(start, settle_s=60.0)
    world.broken = {"camera"}
    assert world.choose().response.server == "sensors/lidar"
    (row,) = json.loads(run_cli("choices", "--json").stdout)
    ((passed, why),) = row["passed_over"].items()
    assert (passed, row["present"]) == ('sensors/camera "front"', 'sensors/lidar "front"')
    assert "OSError" in why
    assert 'sensors/camera "front": ' in run_cli("plans", "--wide").stdout


@pytest.mark.usefixtures("runtime_dir")
def test_the_command_line_chooses_and_says_what_is_chosen(start: Start) -> None:
    def said(*arguments: object, code: int = 0) -> str:
        ran = run_cli(*arguments)
        assert ran.returncode == code, ran.stdout + ran.stderr
        return ran.stdout or ran.stderr

    world = ByHand(start)
    choice = world.choose()
    assert said("choose", "range", "sensors/sonar", "--dry-run").startswith("would choose sensors/sonar for choice ")
    assert world.info().by_hand == ""
    assert said("choose", "range", "sensors/sonar", "--by", "eve").startswith('chose sensors/sonar "front" for choice ')
    world.settled(choice, "sonar")
    (row,) = said("choices").splitlines()[1:]
    assert row.split(maxsplit=1)[1].split("  ") == ["range", 'sensors/sonar "front"', 'sensors/sonar "front"', "eve"]
    assert said("choose", "range", "--freely").startswith("took back what was chosen by hand for choice ")
    assert json.loads(said("choices", "--json"))[0]["by_hand"] == ""
    assert "expected an alternative or --freely, and not both" in said("choose", "range", code=2)
    assert "no alternative 'sensors/radar': the choice allows " in said("choose", "range", "sensors/radar", code=2)
