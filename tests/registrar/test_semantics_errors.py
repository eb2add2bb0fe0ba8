"""What a registrar promises about errors of load callbacks (docs/semantics.md, "Errors")."""

from __future__ import annotations

import asyncio
import errno
import pickle
from collections.abc import Callable
from typing import Any

import pytest

import rr_actors as rr
from support import eventually, loaded_with_parts, serve


class DeviceError(Exception):
    pass


def raise_(error: Exception) -> Any:
    raise error


def test_a_failing_callback_reaches_its_consumer_as_load_failed(app: rr.Registrar, provider: rr.Registrar) -> None:
    serve(provider, "camera", load=lambda request: raise_(DeviceError(f"no device {request}")))
    with pytest.raises(rr.LoadFailed, match="no device front") as caught:
        app.load("provider/camera", "front")
    assert caught.value.server == "provider/camera"
    (frame,) = caught.value.trace
    assert frame.origin == "provider/camera"
    assert "DeviceError" in frame.message
    assert "no device front" in frame.message


@pytest.mark.parametrize("asynchronous", [False, True])
def test_the_traceback_of_the_innermost_callback_is_there_from_its_first_line_on(
    system: rr.System, app: rr.Registrar, provider: rr.Registrar, asynchronous: bool
) -> None:
    maps = system.open_registrar("maps")

    def look_up(key: str) -> int:
        return {"back": 1}[key]

    async def open_later(request: str) -> int:
        return look_up(request)

    def open_camera(request: str) -> int:
        return look_up(request)

    provider.register_server("camera", open_later if asynchronous else open_camera)
    serve(maps, "map", load=loaded_with_parts(maps, ("provider/camera", "front")))
    with pytest.raises(rr.LoadFailed) as caught:
        app.load("maps/map", None)
    error: rr.LoadFailed = caught.value
    assert error.server == "maps/map"
    for told in (error, pickle.loads(pickle.dumps(error))):
        first, call, *_ = told.traceback.splitlines()
        assert first == "Traceback (most recent call last):"
        assert f'File "{__file__}", line ' in call
        assert call.endswith("in open_later" if asynchronous else "in open_camera")
        assert 'return {"back": 1}[key]' in told.traceback
        assert told.traceback.endswith("KeyError: 'front'")
    assert error.__notes__ == [f"raised in provider/camera:\n{error.traceback}"]


@pytest.mark.parametrize(
    ("error", "wanted"),
    [
        (OSError(errno.ENOSPC, "No space left on device"), "ENOSPC: the disk is full, or has no inode left"),
        (MemoryError(), "ENOMEM: there is no memory left for it"),
        (BlockingIOError(errno.EAGAIN, "the port is locked"), ""),
        (OSError(errno.ENOBUFS, "the bus is off"), ""),
        (ValueError("no such device"), ""),
    ],
)
def test_what_the_machine_had_no_more_of_is_known_to_every_consumer_of_a_failed_load(
    system: rr.System, app: rr.Registrar, provider: rr.Registrar, error: Exception, wanted: str
) -> None:
    def open_camera(request: str) -> str:
        raise error

    maps = system.open_registrar("maps")
    provider.register_server("camera", open_camera)
    serve(maps, "map", load=loaded_with_parts(maps, ("provider/camera", "front")))
    with pytest.raises(rr.LoadFailed) as caught:
        app.load("maps/map", None)
    assert caught.value.wanted == wanted


def test_what_no_line_of_a_callback_raised_has_no_traceback(app: rr.Registrar, provider: rr.Registrar) -> None:
    provider.register_server("camera", lambda request: object(), response_type=str)
    with pytest.raises(rr.LoadFailed) as caught:
        app.load("provider/camera", None)
    assert caught.value.traceback == ""
    assert not hasattr(caught.value, "__notes__")


@pytest.mark.parametrize("depth", [2, 3, 6])
def test_the_trace_has_one_frame_per_registrar_innermost_first(
    system: rr.System, app: rr.Registrar, depth: int
) -> None:
    for n in range(depth):
        member = system.open_registrar(f"r{n}")
        if n:
            serve(member, "x", load=loaded_with_parts(member, (f"r{n - 1}/x", None)))
        else:
            serve(member, "x", load=lambda request: raise_(ValueError("no such device")))
    with pytest.raises(rr.LoadFailed, match="no such device") as caught:
        app.load(f"r{depth - 1}/x", None)
    assert [frame.origin for frame in caught.value.trace] == [f"r{n}/x" for n in range(depth)]
    assert caught.value.trace[0].message == "ValueError: no such device"


def from_what_failed(registrar: rr.Registrar) -> None:
    try:
        registrar.load("parts/lens", None)
    except rr.LoadFailed as error:
        raise DeviceError("camera has no lens") from error


def while_it_is_handled(registrar: rr.Registrar) -> None:
    try:
        registrar.load("parts/lens", None)
    except rr.LoadFailed:
        raise DeviceError("camera has no lens")  # noqa: B904 - as people write it


def from_a_group(registrar: rr.Registrar) -> None:
    async def load() -> None:
        async with asyncio.TaskGroup() as group:
            group.create_task(registrar.load_async("parts/lens", None))

    try:
        asyncio.run(load())
    except ExceptionGroup as errors:
        raise DeviceError("camera has no lens") from errors


@pytest.mark.parametrize("attempt", [from_what_failed, while_it_is_handled, from_a_group])
def test_a_callback_may_say_more_about_a_failed_part(
    app: rr.Registrar, provider: rr.Registrar, parts: rr.Registrar, attempt: Callable[[rr.Registrar], None]
) -> None:
    serve(parts, "lens", load=lambda request: raise_(ValueError("scratched")))
    serve(provider, "camera", load=lambda request: attempt(provider))
    with pytest.raises(rr.LoadFailed, match="no lens") as caught:
        app.load("provider/camera", None)
    assert [frame.origin for frame in caught.value.trace] == ["parts/lens", "provider/camera"]
    assert "scratched" in caught.value.trace[0].message
    assert "no lens" in caught.value.trace[1].message


def test_what_alone_failed_in_a_task_group_is_told_as_itself(app: rr.Registrar, provider: rr.Registrar) -> None:
    async def load(request: str) -> None:
        async with asyncio.TaskGroup() as group:
            if request == "ring":
                group.create_task(provider.load_async("provider/camera", request))
            else:
                raise DeviceError("scratched")

    serve(provider, "camera", load=load)
    with pytest.raises(rr.CircularDependency) as caught:
        app.load("provider/camera", "ring")
    assert caught.value.ring == ("provider/camera",)
    with pytest.raises(rr.LoadFailed, match="scratched") as failed:
        app.load("provider/camera", "other")
    assert [frame.message for frame in failed.value.trace] == ["DeviceError: scratched"]


def test_an_error_that_hides_what_it_was_raised_from_is_the_whole_trace(
    app: rr.Registrar, provider: rr.Registrar, parts: rr.Registrar
) -> None:
    serve(parts, "lens", load=lambda request: raise_(ValueError("scratched")))

    def load(request: Any) -> Any:
        try:
            provider.load("parts/lens", None)
        except rr.LoadFailed:
            raise DeviceError("camera has no lens") from None

    serve(provider, "camera", load=load)
    with pytest.raises(rr.LoadFailed, match="no lens") as caught:
        app.load("provider/camera", None)
    assert [frame.origin for frame in caught.value.trace] == ["provider/camera"]


def test_an_unknown_server_below_is_told_to_the_first_consumer(app: rr.Registrar, provider: rr.Registrar) -> None:
    serve(provider, "camera", load=loaded_with_parts(provider, ("provider/nothing", None)))
    with pytest.raises(rr.LoadFailed, match="provider/nothing"):
        app.load("provider/camera", None)


def test_a_failing_query_leaves_nothing_behind_and_trying_again_starts_clean(
    app: rr.Registrar, provider: rr.Registrar, parts: rr.Registrar
) -> None:
    part = serve(parts, "part")
    broken = [True]

    def load(request: Any) -> Any:
        provider.load("parts/part", "wheel")
        if broken:
            raise ValueError("broken")
        return rr.current().attempt

    served = serve(provider, "bike", load=load)
    for _ in range(3):
        with pytest.raises(rr.LoadFailed, match="broken"):
            app.load("provider/bike", None)
        assert list(app.queries()) == []
        eventually(lambda: not provider.queries() and not provider.resources() and not parts.resources())
    assert len(part.unloads) == 3
    assert len(served.unloads) == 0
    broken.clear()
    bike = app.load("provider/bike", None)
    assert bike.response == 1
    assert len(served.loads) == 4
    assert len(parts.resources()) == 1


def test_a_failing_load_of_one_request_harms_no_other(app: rr.Registrar, provider: rr.Registrar) -> None:
    serve(provider, "camera", load=lambda request: raise_(ValueError("bad")) if request == "bad" else request)
    good = app.load("provider/camera", "good")
    with pytest.raises(rr.LoadFailed):
        app.load("provider/camera", "bad")
    assert [query.id for query in app.queries()] == [good.id]
    assert app.load("provider/camera", "good").resource_id == good.resource_id


@pytest.mark.parametrize("error", [SystemExit(3), KeyboardInterrupt(), GeneratorExit()])
def test_even_what_is_no_exception_is_a_failed_load(
    app: rr.Registrar, provider: rr.Registrar, error: BaseException
) -> None:
    def load(request: Any) -> Any:
        raise error

    serve(provider, "camera", load=load)
    serve(provider, "lidar")
    with pytest.raises(rr.LoadFailed, match=type(error).__name__):
        app.load("provider/camera", None, timeout_s=5.0)
    assert app.load("provider/lidar", "x").response["of"] == "x"


class Mute(Exception):
    def __str__(self) -> str:
        raise RuntimeError("no words")


class Traced(Exception):
    trace = "of its own"


class Numbered(rr.RrError):
    def __init__(self, number: int) -> None:  # without RrError's own
        self.number = number


def misled() -> rr.LoadFailed:
    return rr.LoadFailed("led astray", trace="of its own")


@pytest.mark.parametrize(
    ("error", "text"),
    [(Mute(), "Mute"), (Traced("lost"), "Traced: lost"), (Numbered(7), "Numbered: 7"), (misled(), "led astray")],
)
def test_an_error_of_an_odd_class_is_told_like_any_other(
    app: rr.Registrar, provider: rr.Registrar, error: Exception, text: str
) -> None:
    serve(provider, "camera", load=lambda request: raise_(error))
    serve(provider, "lidar", unload=lambda request, response: raise_(error))
    with pytest.raises(rr.LoadFailed, match=f"provider/camera: .*{text}") as caught:
        app.load("provider/camera", None, timeout_s=5.0)
    assert [frame.origin for frame in caught.value.trace] == ["provider/camera"]
    assert not provider.resources()
    with pytest.raises(rr.UnloadFailed, match=f"provider/lidar: .*{text}"):
        app.load("provider/lidar", None).unload(timeout_s=5.0)


def test_a_response_of_the_wrong_kind_is_a_failed_load(app: rr.Registrar, provider: rr.Registrar) -> None:
    serve(provider, "camera", load=lambda request: {"stream": object()})
    with pytest.raises(rr.LoadFailed, match="stream"):
        app.load("provider/camera", None)
    eventually(lambda: not provider.resources())


def test_the_error_says_who_what_and_why_in_one_line_and_can_be_pickled(
    app: rr.Registrar, provider: rr.Registrar
) -> None:
    serve(provider, "camera", load=lambda request: raise_(ValueError("no such device")))
    with pytest.raises(rr.LoadFailed) as caught:
        app.load("provider/camera", "front")
    assert "provider/camera" in str(caught.value).splitlines()[0]
    again = pickle.loads(pickle.dumps(caught.value))
    assert type(again) is rr.LoadFailed
    assert (again.trace, str(again)) == (caught.value.trace, str(caught.value))
