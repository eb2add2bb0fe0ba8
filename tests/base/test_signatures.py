"""A callback that cannot be called as it will be is told of when it is registered, not when it is needed."""

from __future__ import annotations

import functools
import operator
from collections.abc import Callable
from typing import Any, Self
from unittest import mock

import pytest

import rr_actors as rr
from support import serve


def load(request: Any) -> Any:
    return request


def one(request: Any) -> None: ...


def two(request: Any, response: Any) -> None: ...


def three(camera: Any, request: Any, response: Any) -> None: ...


def with_option(request: Any, response: Any, *, port: int) -> None: ...


class Driver:
    def close(self, request: Any, response: Any) -> None: ...

    def reset(self) -> None: ...

    def __call__(self, request: Any) -> None: ...


WRONG: list[tuple[dict[str, Any], str, str]] = [
    ({"load": two}, "load: expected a callable that takes (request)", "two(request, response)"),
    ({"unload": one}, "unload: expected a callable that takes (request, response)", "one(request)"),
    ({"unload": Driver().reset}, "unload: expected a callable that takes (request, response)", "reset()"),
    ({"unload": Driver()}, "unload: expected a callable that takes (request, response)", "Driver(request)"),
    ({"unload": Driver.close}, "unload: expected a callable that takes (request, response)", "close(self, request"),
    (
        {"unload": with_option},
        "unload: expected a callable that takes (request, response)",
        "with_option(request, response, *, port): missing",
    ),
    ({"status": one}, "status: expected a callable that takes (request, status)", "one(request)"),
    ({"recover": one}, "recover: expected a callable that takes (request, response)", "one(request)"),
    (
        {"unload": functools.partial(three, "front", "usb")},
        "unload: expected a callable that takes (camera, request, request, response)",
        "three(camera, request, response): too many",
    ),
]


@pytest.mark.parametrize(("callbacks", "expected", "got"), WRONG)
def test_a_callback_that_takes_other_arguments_is_refused_naming_expected_and_got(
    provider: rr.Registrar, callbacks: dict[str, Any], expected: str, got: str
) -> None:
    with pytest.raises(rr.InvalidSpec) as caught:
        provider.register_server("camera", **{"load": load, **callbacks})

    assert str(caught.value).startswith(f"server 'camera': {expected}, got {got}")
    assert caught.value.field == next(iter(callbacks))
    assert list(provider.servers()) == []


def wrapped(function: Callable[..., Any]) -> Callable[..., Any]:
    @functools.wraps(function)
    def wrapper(*arguments: Any) -> Any:
        return function("front", *arguments)

    return wrapper


@pytest.mark.parametrize(
    "unload",
    [
        two,
        lambda *everything: None,
        lambda request, response, force=False: None,
        functools.partial(three, "front"),
        functools.partial(with_option, port=7),
        functools.partial(functools.partial(three, "front")),
        Driver().close,
        wrapped(three),
        mock.Mock(return_value=None),
        operator.eq,
        max,
    ],
)
def test_a_callback_that_can_be_called_is_taken_whatever_it_is(
    app: rr.Registrar, provider: rr.Registrar, unload: Callable[..., Any]
) -> None:
    provider.register_server("camera", load, unload)

    app.load("provider/camera", "front").unload()


def test_a_declared_method_is_refused_where_its_class_is_written() -> None:
    with pytest.raises(rr.InvalidSpec, match=r"server 'camera': load: .*takes \(self, request\), got open\(\)"):

        class NoSelf(rr.Manager):
            @rr.server("camera")  # type: ignore[arg-type]
            def open() -> str:  # type: ignore[misc]
                return ""

    with pytest.raises(rr.InvalidSpec, match=r"unload: .*takes \(self, request, response\), got close\(self, request"):

        class NoResponse(rr.Manager):
            @rr.server("camera")
            def open(self, request: str) -> str:
                return request

            @open.unload  # type: ignore[arg-type]
            def close(self, request: str) -> None: ...


def test_a_forgotten_self_is_said_where_the_class_is_written() -> None:
    with pytest.raises(rr.InvalidSpec, match=r"@rr.server\('camera'\): load: expected self .*open\(self, device, "):

        class OfAType(rr.Manager):
            @rr.server("camera")  # type: ignore[arg-type]
            def open(device: str) -> str:  # type: ignore[misc]  # noqa: N805
                return device

    with pytest.raises(rr.InvalidSpec, match=r"load: expected self as the first parameter: open\(self, request, "):

        class OfAName(rr.Manager):
            @rr.server("camera")
            def open(request):  # type: ignore[no-untyped-def]  # noqa: N805
                return request

    with pytest.raises(rr.InvalidSpec, match=r"server 'camera': unload: expected self .*close\(self, name, "):

        class InUnload(rr.Manager):
            @rr.server("camera")
            def open(self, name: str, port: int) -> str:
                return name

            @open.unload
            def close(name: str, port: int, response: str) -> None: ...  # type: ignore[misc]  # noqa: N805


def test_another_name_for_self_is_taken() -> None:
    class Named(rr.Manager):
        @rr.server("camera")
        def open(this, request: str) -> str:  # noqa: N805
            return request

        @open.unload
        def close(me: Named, request: str, response: str) -> None: ...  # noqa: N805

        @open.recover
        def again(cls: Self, request: str, response: str) -> str:  # noqa: N805
            return response

    assert Named.open.name == "camera"


def test_a_server_declared_without_its_name_is_told_how_to_write_it() -> None:
    with pytest.raises(rr.InvalidName, match=r"write @rr\.server\('open'\)"):

        class NoName(rr.Manager):
            @rr.server  # type: ignore[arg-type]
            def open(self, request: str) -> str:
                return request


@pytest.mark.parametrize("role", ["unload", "status", "recover"])
def test_a_callback_that_would_replace_the_load_callback_is_refused(role: str) -> None:
    with pytest.raises(rr.InvalidSpec, match=f"server 'camera': {role}: expected a method of another name than 'open'"):

        class LikeAProperty(rr.Manager):
            @rr.server("camera")
            def open(self, request: str) -> str:  # pyright: ignore[reportRedeclaration] - that is the mistake
                return request

            @getattr(open, role)
            def open(self, request: str, response: str) -> None: ...


def test_a_handle_refuses_it_too_before_it_travels(system: rr.System, provider: rr.Registrar) -> None:
    with pytest.raises(rr.InvalidSpec, match="recover"):
        system.registrar("provider").register_server("camera", load, recover=one)


def test_a_refused_server_can_be_registered_again_under_its_name(app: rr.Registrar, provider: rr.Registrar) -> None:
    with pytest.raises(rr.InvalidSpec):
        provider.register_server("camera", load, one)
    serve(provider, "camera")
    assert app.load("provider/camera", "x").response["of"] == "x"
