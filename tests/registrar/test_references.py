"""References to actors in requests and responses, and by name in managers: to use what another manager holds."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal

import pytest

import rr_actors as rr
from rr_actors.actors.refs import local_of
from rr_actors.base.values.canonical import Codec, encode
from support import kill, serve, wait_respawned

Start = Callable[..., rr.System]
Placement = Literal["process", "thread"]


@dataclass
class Model:
    name: str
    owner: rr.ActorRef


class Models(rr.Manager):
    """Holds models in its memory; others have it work on them."""

    def __init__(self) -> None:
        self._loaded: dict[str, list[int]] = {}

    @rr.server("model", recovery="keep")
    def load_model(self, name: str) -> Model:
        self._loaded[name] = [1, 2, 3]
        return Model(name, self.ref("models"))

    @rr.server("plain", recovery="keep")
    def load_plain(self, name: str):
        return {"owner": self.actor_ref}

    def predict(self, name: str, by: int) -> list[int]:
        return [number * by for number in self._loaded.get(name, [0])]


class Finder(rr.Manager):
    @rr.server("who")
    def who(self, id: str) -> str | None:
        assert rr.ref(id) == self.ref(id)
        return rr.ref(id).path


class Planner(rr.Manager):
    def on_start(self) -> None:
        self.models = self.ref("models")  # which may start later

    @rr.server("plan")
    def make_plan(self, name: str) -> list[int]:
        model = self.registrar.load("models/model", name).response
        assert model.owner == self.models == rr.ref("models")
        return model.owner.proxy().predict(name, 10).get()

    @rr.server("asked")
    def asked_for(self, owner: rr.ActorRef[Any]) -> list[int]:
        return owner.proxy().predict("x", 2).get()


def models(placement: Placement = "process") -> rr.ChildSpec:
    return rr.ChildSpec(Models, id="models", placement=placement)


@pytest.mark.parametrize("placement", ["process", "thread"])
def test_a_method_of_the_resources_manager_is_called_by_the_reference_in_its_response(
    start: Start, placement: Placement
) -> None:
    system = start(rr.ChildSpec(Planner, id="planner", placement=placement), models(placement))
    app = system.open_registrar("app")

    model = app.load("models/model", "net").response
    assert model.owner.proxy().predict("net", 2).get() == [2, 4, 6]
    assert app.load("planner/plan", "net").response == [10, 20, 30]


def test_a_stored_reference_is_alive_again_after_a_respawn(start: Start) -> None:
    system = start(models())
    app = system.open_registrar("app")
    query = app.load("models/model", "net")
    wait_respawned(system, "models", kill(system, "models"))

    assert query.response.owner.proxy().predict("net", 2).get() == [0]
    assert app.load("models/model", "net").resource_id == query.resource_id


def test_a_reference_needs_no_annotation_and_may_be_a_request(start: Start) -> None:
    system = start(models(), rr.ChildSpec(Planner, id="planner"))
    app = system.open_registrar("app")
    owner = app.load("models/plain", "net").response["owner"]
    assert owner == system.ref("models")
    first = app.load("planner/asked", owner)
    assert first.response == [0]
    assert app.load("planner/asked", system.ref("models")).resource_id == first.resource_id


def test_references_to_one_actor_have_the_same_bytes_wherever_they_come_from(start: Start) -> None:
    system = start(models("thread"))
    distant = system.ref("models")
    local = local_of(distant)
    assert type(local) is not type(distant)
    assert encode(local) == encode(distant)
    assert Codec(rr.ActorRef).decode(encode(local)) == distant


class Alone(rr.Actor):
    pass


def test_a_reference_to_an_actor_that_no_supervisor_restarts_is_refused(
    app: rr.Registrar, provider: rr.Registrar
) -> None:
    alone = Alone.start()
    try:
        serve(provider, "thing", load=lambda _: alone)
        with pytest.raises(rr.LoadFailed, match="which no supervisor of a system starts again"):
            app.load("provider/thing", "x")
    finally:
        alone.stop()


def test_ref_finds_a_sibling_first_then_the_only_one_of_that_id_and_paths(start: Start) -> None:
    def pair(id: str) -> rr.Supervisor:
        return rr.Supervisor([rr.ChildSpec(Alone, id="tool"), rr.ChildSpec(Finder, id=f"{id}_finder")], id=id)

    system = start(pair("left"), pair("right"), rr.ChildSpec(Alone, id="only"), rr.ChildSpec(Finder, id="finder"))
    app = system.open_registrar("app")

    def found(finder: str, id: str) -> Any:
        return app.load(f"{finder}/who", id).response

    assert found("left_finder", "tool") == "root/left/tool"
    assert found("right_finder", "tool") == "root/right/tool"
    assert found("left_finder", "only") == "root/only"
    assert found("left_finder", "right/tool") == "root/right/tool"
    assert found("left_finder", "root/right/tool") == "root/right/tool"
    with pytest.raises(rr.LoadFailed, match=r"several have this id: root/left/tool, root/right/tool"):
        found("finder", "tool")
    with pytest.raises(rr.LoadFailed, match=r"there are: .*root/only"):
        found("finder", "typo")


def test_ref_outside_of_a_callback_says_so(system: rr.System) -> None:
    with pytest.raises(rr.UsageError, match="expected to be called in a callback"):
        rr.ref("models")
