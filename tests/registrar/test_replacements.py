"""replace_part: a spare in the place of a part that failed, in one call of a status callback."""

from __future__ import annotations

import uuid
from collections.abc import Callable
from typing import Any

import pytest

import rr_actors as rr
from support import LIMIT_S, Calls, Served, eventually, serve

FATAL = rr.Status(rr.State.FATAL, "unplugged")
LAST = rr.Status(rr.State.OK, "last")
Replace = Callable[[rr.Status], Any]


class Robot:
    """A robot of two parts, "arm" and "first"; its status callback does what the test says for a FATAL part."""

    def __init__(self, app: rr.Registrar, provider: rr.Registrar, parts: rr.Registrar, replace: Replace) -> None:
        self.parts, self.provider = parts, provider
        self.replace = replace
        self.outcomes = Calls()
        self.heard = Calls()
        self.lidars = serve(parts, "lidar")
        serve(provider, "robot", load=self.load, status=self.status)
        self.query = app.load("provider/robot", None, on_status=self.heard)

    def load(self, request: Any) -> Any:
        self.provider.load("parts/lidar", "arm")
        return self.provider.load("parts/lidar", "first").response["of"]

    def status(self, request: Any, status: rr.Status) -> None:
        if status.state is not rr.State.FATAL:
            return
        try:
            self.outcomes(self.replace(status))
        except Exception as error:
            self.outcomes(error)

    def fail(self, name: str = "first", *, outcomes: int = 1) -> Any:
        (failed,) = [found for found in self.parts.resources() if found.request == name]
        self.parts.send_status(failed.id, FATAL)
        return self.outcomes.wait(outcomes)[-1]

    def settled(self) -> None:
        """Wait until a status of now has been heard: all before it have been dealt with."""
        self.provider.send_status(self.query.resource_id, LAST)
        eventually(lambda: [status.message for status in self.heard][-1:] == ["last"])

    def is_of(self, *names: str) -> bool:
        """Whether it holds exactly these parts, and nothing is held by nobody or twice."""
        held = [part.request for part in self.provider.children(self.query.resource_id)]
        there = sorted((found.request, len(found.queries)) for found in self.parts.resources())
        nothing_owed = not self.provider.owed() and not self.parts.owed()
        return sorted(held) == sorted(names) and there == sorted((name, 1) for name in names) and nothing_owed


@pytest.fixture
def robot(app: rr.Registrar, provider: rr.Registrar, parts: rr.Registrar) -> Robot:
    return Robot(app, provider, parts, lambda status: provider.replace_part(status, "second", response=of))


def of(spare: rr.Query) -> Any:
    return spare.response["of"]


def broken(spare: rr.Query) -> Any:
    raise ValueError("no such response")


def refusing(parts: rr.Registrar) -> Served:
    def load(request: Any) -> Any:
        raise ValueError("sold out")

    return serve(parts, "spares", load=load)


# -- what it does --------------------------------------------------------------------------------------------------


def test_the_spare_takes_the_place_of_the_part_and_the_holders_hear_the_new_response(robot: Robot) -> None:
    spare = robot.fail()
    assert (spare.request, spare.server_id) == ("second", "parts/lidar")
    assert robot.query.wait_status(timeout_s=LIMIT_S).state is rr.State.UPDATE
    assert robot.query.response == "second"
    eventually(lambda: robot.is_of("arm", "second"))
    robot.settled()
    assert [status.state for status in robot.heard] == [rr.State.UPDATE, rr.State.OK]  # never FATAL: it is handled
    assert robot.lidars.unloads.items[0][0] == "first"


def test_without_a_new_response_the_holders_hear_nothing(robot: Robot, provider: rr.Registrar) -> None:
    robot.replace = lambda status: provider.replace_part(status, "second")
    robot.fail()
    robot.settled()
    assert [status.message for status in robot.heard] == ["last"]
    assert robot.query.response == "first"
    eventually(lambda: robot.is_of("arm", "second"))


def test_the_same_request_again_is_a_fresh_part(robot: Robot, provider: rr.Registrar) -> None:
    robot.replace = lambda status: provider.replace_part(status, "first", response=of)
    robot.fail()
    eventually(lambda: robot.is_of("arm", "first"))
    assert robot.query.wait_status(timeout_s=LIMIT_S).state is rr.State.UPDATE


def test_the_spare_may_come_from_another_server(robot: Robot, provider: rr.Registrar, parts: rr.Registrar) -> None:
    serve(parts, "spares")
    robot.replace = lambda status: provider.replace_part(status, "second", "parts/spares")
    assert robot.fail().server_id == "parts/spares"
    eventually(lambda: robot.is_of("arm", "second"))


def test_a_spare_that_fails_is_replaced_in_its_turn(robot: Robot, provider: rr.Registrar) -> None:
    names = iter(["second", "third", "fourth"])
    robot.replace = lambda status: provider.replace_part(status, next(names), response=of)
    for number, name in enumerate(["first", "second", "third"], 1):
        robot.fail(name, outcomes=number)
    eventually(lambda: robot.is_of("arm", "fourth"))
    robot.settled()
    assert robot.query.response == "fourth"


def test_called_twice_for_a_status_it_returns_what_took_the_place(robot: Robot, provider: rr.Registrar) -> None:
    def twice(status: rr.Status) -> Any:
        return [provider.replace_part(status, "second"), provider.replace_part(status, "third")]

    robot.replace = twice
    first, again = robot.fail()
    assert first == again
    eventually(lambda: robot.is_of("arm", "second"))


def test_the_ids_of_spares_are_uuid7_too(robot: Robot) -> None:
    id = uuid.UUID(robot.fail().id)
    assert (id.version, id.variant) == (7, uuid.RFC_4122)


def test_a_part_whose_unload_callback_raises_does_not_come_back(robot: Robot) -> None:
    def unload(request: Any, response: Any) -> None:
        if request == "first":
            raise ValueError("stuck")

    robot.lidars.do_unload = unload
    robot.fail()
    eventually(lambda: "unload_failed" in [found.phase for found in robot.parts.resources()])
    assert [part.request for part in robot.provider.children(robot.query.resource_id)] == ["second", "arm"] or [
        part.request for part in robot.provider.children(robot.query.resource_id)
    ] == ["arm", "second"]
    assert len(robot.provider.owed()) == 1  # and tried again with the next link
    robot.lidars.do_unload = None
    (stuck,) = [found for found in robot.parts.resources() if found.phase == "unload_failed"]
    robot.parts.unload(stuck, force=True)
    eventually(lambda: [found.request for found in robot.parts.resources()] == ["arm", "second"])


def test_a_part_that_its_provider_took_away_is_replaced(robot: Robot) -> None:
    (failed,) = [found for found in robot.parts.resources() if found.request == "first"]
    robot.parts.unload(failed, force=True)
    assert robot.outcomes.wait()[0].request == "second"
    eventually(lambda: robot.is_of("arm", "second"))


def test_a_status_of_the_resource_itself_may_be_the_occasion_to_replace_a_part_that_works(
    robot: Robot, provider: rr.Registrar
) -> None:
    def replace_named(status: rr.Status) -> Any:
        part = next(part for part in provider.children(robot.query.resource_id) if part.request == "first")
        return provider.replace_part(status, "second", part=part, response=of)

    robot.replace = replace_named
    provider.send_status(robot.query.resource_id, FATAL)
    assert robot.outcomes.wait()[0].request == "second"
    update = robot.query.wait_status(timeout_s=LIMIT_S)
    assert (update.state, robot.query.response) == (rr.State.UPDATE, "second")
    assert update.message == "parts/lidar takes the place of parts/lidar: unplugged"
    eventually(lambda: robot.is_of("arm", "second"))
    robot.settled()
    assert [status.state for status in robot.heard] == [rr.State.UPDATE, rr.State.OK]


def test_a_named_part_that_is_not_held_is_an_error(robot: Robot, provider: rr.Registrar) -> None:
    robot.replace = lambda status: provider.replace_part(status, "second", part="0" * 32)
    assert isinstance(robot.fail(), rr.UnknownQuery)


# -- what fails ----------------------------------------------------------------------------------------------------


def test_a_spare_that_cannot_be_loaded_changes_nothing_and_the_status_goes_up(
    robot: Robot, provider: rr.Registrar, parts: rr.Registrar
) -> None:
    refusing(parts)
    robot.replace = lambda status: provider.replace_part(status, "second", "parts/spares", response=of)
    assert isinstance(robot.fail(), rr.LoadFailed)
    robot.settled()
    assert next(status.state for status in robot.heard) is rr.State.FATAL
    assert robot.is_of("arm", "first")


def test_after_a_spare_that_cannot_be_loaded_another_one_may_be_tried(
    robot: Robot, provider: rr.Registrar, parts: rr.Registrar
) -> None:
    tried = refusing(parts)

    def try_three(status: rr.Status) -> Any:
        for _ in range(2):
            with pytest.raises(rr.LoadFailed):
                provider.replace_part(status, "second", "parts/spares")
        return provider.replace_part(status, "third")

    robot.replace = try_three
    assert robot.fail().request == "third"
    assert len(tried.loads) == 2
    eventually(lambda: robot.is_of("arm", "third"))


def test_a_response_that_cannot_be_made_leaves_no_spare(robot: Robot, provider: rr.Registrar) -> None:
    robot.replace = lambda status: provider.replace_part(status, "second", response=broken)
    assert isinstance(robot.fail(), ValueError)
    eventually(lambda: robot.is_of("arm", "first"))
    robot.settled()
    assert next(status.state for status in robot.heard) is rr.State.FATAL


def test_a_response_that_cannot_travel_leaves_no_spare(robot: Robot, provider: rr.Registrar) -> None:
    robot.replace = lambda status: provider.replace_part(status, "second", response=lambda spare: object())
    assert isinstance(robot.fail(), rr.NotSerializable)
    eventually(lambda: robot.is_of("arm", "first"))


def test_a_spare_that_takes_too_long_is_withdrawn(robot: Robot, provider: rr.Registrar, gate: Any) -> None:
    robot.lidars.do_load = lambda request: gate() if request == "second" else {"of": request}
    robot.replace = lambda status: provider.replace_part(status, "second", timeout_s=0.05)
    assert isinstance(robot.fail(), rr.LoadTimeout)
    gate.open()
    eventually(lambda: robot.is_of("arm", "first"))


def test_a_part_that_was_released_meanwhile_is_not_replaced(robot: Robot, provider: rr.Registrar) -> None:
    def release_first(status: rr.Status) -> Any:
        provider.unload(status.query_id)
        return provider.replace_part(status, "second")

    robot.replace = release_first
    error = robot.fail()
    assert isinstance(error, rr.UnknownQuery)
    assert "does not hold this part any more" in str(error)
    eventually(lambda: robot.is_of("arm"))


def test_a_part_that_is_released_while_the_spare_loads_is_not_replaced(robot: Robot, provider: rr.Registrar) -> None:
    def release_meanwhile(spare: rr.Query) -> Any:
        (failed,) = [part for part in provider.queries() if part.request == "first"]
        failed.unload()
        return "new"

    robot.replace = lambda status: provider.replace_part(status, "second", response=release_meanwhile)
    assert isinstance(robot.fail(), rr.UnknownQuery)
    eventually(lambda: robot.is_of("arm"))


def test_a_status_of_the_resource_itself_is_refused(robot: Robot, provider: rr.Registrar) -> None:
    provider.send_status(robot.query.resource_id, FATAL)
    (error,) = robot.outcomes.wait()
    assert isinstance(error, rr.UsageError)
    assert "of the resource itself" in str(error)


def test_outside_a_status_callback_it_is_refused(system: rr.System, provider: rr.Registrar) -> None:
    for registrar in (provider, system.registrar("provider")):
        with pytest.raises(rr.UsageError, match="expected to be called in a status callback"):
            registrar.replace_part(FATAL, "second")


@pytest.mark.parametrize(
    ("status", "options", "said"),
    [
        ("FATAL", {}, "expected the Status of the callback"),
        (FATAL, {"response": "new"}, "expected a function"),
        (FATAL, {"timeout_s": "soon"}, "timeout_s"),
    ],
)
def test_bad_arguments_are_named(provider: rr.Registrar, status: Any, options: dict[str, Any], said: str) -> None:
    with pytest.raises(rr.UsageError, match=said):
        provider.replace_part(status, "second", **options)
