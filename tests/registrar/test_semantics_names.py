"""What a registrar promises about names (docs/semantics.md, "Names")."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any, cast

import pytest

import rr_actors as rr
from support import Workshop, serve
from support_managers import Order, Shop

GOOD = ["a", "A", "7", "camera_2", "front-left", "v1.2", "_", "-", "x" * 64]
BAD = ["", " ", "a b", "a/b", "ä", "a\n", "a\0", ".hidden", "..", "x" * 65, "a:b", "a*"]
NO_STRINGS: list[Any] = [None, 7, b"name", ["a"]]


@pytest.mark.parametrize("name", GOOD)
def test_names_have_letters_digits_underscores_hyphens_and_dots(
    system: rr.System, app: rr.Registrar, name: str
) -> None:
    registrar = system.open_registrar(name)
    serve(registrar, name)
    assert registrar.name == name
    assert app.load(f"{name}/{name}", "x").response["of"] == "x"


@pytest.mark.parametrize("name", BAD + NO_STRINGS)
def test_other_names_of_registrars_are_refused(system: rr.System, name: Any) -> None:
    with pytest.raises(rr.InvalidName) as caught:
        system.open_registrar(name)
    assert caught.value.name == name
    assert repr(name) in str(caught.value)


@pytest.mark.parametrize("name", BAD + NO_STRINGS)
def test_other_names_of_servers_are_refused(provider: rr.Registrar, name: Any) -> None:
    with pytest.raises(rr.InvalidName) as caught:
        provider.register_server(name, lambda request: request)
    assert repr(name) in str(caught.value)
    assert list(provider.servers()) == []


@pytest.mark.parametrize(
    "server", ["camera", "", "/", "a/", "/a", "a/b/c/d", "a//b", "a b/c", "a\0b", "x" * 500, None, 7]
)
def test_a_server_is_addressed_as_registrar_slash_server(app: rr.Registrar, server: Any) -> None:
    with pytest.raises(rr.InvalidName):
        app.load(server, "x")


def test_a_server_without_its_registrar_is_refused_with_the_one_that_was_probably_meant(
    app: rr.Registrar, provider: rr.Registrar
) -> None:
    serve(provider, "camera")
    asks: list[Callable[[str], object]] = [
        lambda server: app.load(server, 1),
        lambda server: app.load(server, 1, block=False),
        lambda server: asyncio.run(app.load_async(server, 1)),
        lambda server: app.load_all([(server, 1)]),
        lambda server: app.on_status(server, print),
        lambda server: app.unload_client(server),
    ]
    for ask in asks:
        with pytest.raises(rr.InvalidName, match=r"got no '/'; did you mean 'provider/camera'\?"):
            ask("camera")
    with pytest.raises(rr.InvalidName, match=r"did you mean 'provider/camera'\?"):
        app.load("provider.camera", 1)
    with pytest.raises(rr.InvalidName, match=r"got no '/'; registrar 'map': there is none .*app, provider") as caught:
        app.load("map", 1)
    assert caught.value.name == "map"
    with pytest.raises(rr.InvalidName, match="'provider' is a registrar, name its server, too"):
        app.load("provider", 1)
    with pytest.raises(rr.InvalidName, match=r"got method .*: a method that names a server has @rr.server"):
        app.load(cast("Any", app.resources), 1)


def test_taking_a_registrars_name_twice_is_an_error_and_leaves_the_first_untouched(
    system: rr.System, app: rr.Registrar, provider: rr.Registrar
) -> None:
    served = serve(provider, "thing")
    query = app.load("provider/thing", "x")
    with pytest.raises(rr.NameTaken, match="provider") as caught:
        system.open_registrar("provider")
    assert caught.value.name == "provider"
    assert app.load("provider/thing", "x").resource_id == query.resource_id
    assert len(served.loads) == 1


def test_of_many_who_take_a_registrars_name_at_once_one_has_it_and_the_others_hear_that_it_is_taken(
    system: rr.System,
) -> None:
    def open_it(_number: int) -> object:
        try:
            return system.open_registrar("app")
        except rr.RrError as error:
            return error

    with ThreadPoolExecutor(8) as threads:
        found = list(threads.map(open_it, range(8)))
    assert [type(one) for one in found if isinstance(one, rr.RrError)] == [rr.NameTaken] * 7
    assert sum(isinstance(one, rr.Registrar) for one in found) == 1


def test_taking_a_managers_name_is_an_error_and_leaves_the_manager_untouched(
    start: Callable[..., rr.System], workshop: Workshop
) -> None:
    system = start(rr.ChildSpec(Shop, id="shop", args=(str(workshop.root),), placement="thread"))
    with pytest.raises(rr.NameTaken, match="shop"):
        system.open_registrar("shop")
    assert system.open_registrar("app").load("shop/thing", Order("wheel")).response.name == "wheel"


def test_a_manager_cannot_take_the_name_of_an_open_registrar(system: rr.System, workshop: Workshop) -> None:
    serve(system.open_registrar("shop"), "thing")
    with pytest.raises(rr.RrError, match="shop"):
        system.start_child(rr.ChildSpec(Shop, id="shop", args=(str(workshop.root),), placement="thread"))
    assert system.open_registrar("app").load("shop/thing", "x").response["of"] == "x"


def test_taking_a_servers_name_twice_is_an_error_and_leaves_the_first_untouched(
    app: rr.Registrar, provider: rr.Registrar
) -> None:
    serve(provider, "thing", load=lambda request: "first")
    query = app.load("provider/thing", "x")
    with pytest.raises(rr.NameTaken, match="thing"):
        serve(provider, "thing", load=lambda request: "second")
    assert app.load("provider/thing", "x").resource_id == query.resource_id
    assert app.load("provider/thing", "y").response == "first"


def test_servers_of_different_registrars_may_have_the_same_name(
    app: rr.Registrar, provider: rr.Registrar, parts: rr.Registrar
) -> None:
    serve(provider, "thing", load=lambda request: "provider's")
    serve(parts, "thing", load=lambda request: "parts'")
    assert app.load("provider/thing", "x").response == "provider's"
    assert app.load("parts/thing", "x").response == "parts'"


def test_a_name_is_free_again_when_its_registrar_is_closed(system: rr.System, app: rr.Registrar) -> None:
    serve(system.open_registrar("passing"), "thing", load=lambda request: "old")
    system.registrar("passing").close()
    serve(system.open_registrar("passing"), "thing", load=lambda request: "new")
    assert app.load("passing/thing", "x").response == "new"


def test_two_children_of_one_supervisor_cannot_have_the_same_id(workshop: Workshop) -> None:
    spec = rr.ChildSpec(Shop, id="shop", args=(str(workshop.root),))
    with pytest.raises(rr.UsageError, match="shop"):
        rr.System(rr.Supervisor([spec, spec], id="root"))


def test_a_child_with_a_registrars_name_is_refused_and_the_registrar_keeps_all_it_holds(
    system: rr.System, workshop: Workshop
) -> None:
    system.start_child(rr.ChildSpec(Shop, id="shop", args=(str(workshop.root),)))
    app = system.open_registrar("app")
    query = app.load("shop/thing", Order("wheel"))
    with pytest.raises(rr.NameTaken, match="app"):
        system.start_child(rr.ChildSpec(Shop, id="app", args=(str(workshop.root),)))
    assert [held.id for held in app.queries()] == [query.id]
    assert app.load("shop/thing", Order("wheel")).resource_id == query.resource_id
    assert workshop.lines("unload") == []
