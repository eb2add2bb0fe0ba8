"""Exceptions made hostile by construction, at each crossing: the real class, or its name, and a text always arrive."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextvars import ContextVar
from typing import Any, NoReturn

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import rr_actors as rr
from rr_actors.runtime import callback_errors
from support import LIMIT_S, Gate, child, eventually, serve

_METHODS = (
    "__str__",
    "__repr__",
    "__getattr__",
    "__reduce__",
    "__reduce_ex__",
    "__format__",
    "with_traceback",
    "add_note",
)
_RAISED: dict[str, type[BaseException]] = {
    error.__name__: error
    for error in (KeyError, ValueError, SystemExit, KeyboardInterrupt, GeneratorExit, RecursionError)
}


def hostile(method: str, raised: str) -> BaseException:
    """Return an exception one of whose methods raises."""

    def bad(*_: Any, **__: Any) -> NoReturn:
        raise _RAISED[raised]("no")

    return type("Hostile", (Exception,), {method: bad})("text")


def _with_notes() -> BaseException:
    error = ValueError("noted")
    error.__dict__["__notes__"] = 3
    return error


class Unloadable:
    """An argument whose unpickling raises a hostile exception."""

    def __reduce__(self) -> Any:
        return _raise_hostile, ()


def _raise_hostile() -> NoReturn:
    raise hostile("__getattr__", "KeyError")


def _caused() -> BaseException:
    error = ValueError("caused")
    error.__cause__ = hostile("__getattr__", "KeyError")
    return error


MAKERS: dict[str, Callable[[], BaseException]] = {
    "syntax": lambda: SyntaxError("bad", ("f", 3, "4", "text")),  # type: ignore[arg-type]
    "notes": _with_notes,
    "cause": _caused,
    "group": lambda: ExceptionGroup("some", [hostile("__getattr__", "KeyError")]),  # type: ignore[list-item]
    "argument": lambda: ValueError(Unloadable()),
    "surrogate": lambda: ValueError("a name \udcff of os.listdir"),
    "long": lambda: ValueError("x" * 30_000_000),
}


def made(how: str) -> BaseException:
    """Return the exception of this name: of MAKERS, or "method raised"."""
    return MAKERS[how]() if how in MAKERS else hostile(*how.split())


class Raiser(rr.Actor):
    """Raises the exception of a name, and answers anything else."""

    def __init__(self, how: str = "") -> None:
        self.how = how

    def on_start(self) -> None:
        if self.how:
            raise made(self.how)

    def on_receive(self, message: Any) -> Any:
        if isinstance(message, str):
            raise made(message)
        return message


HOWS = [*MAKERS, *(f"{method} {raised}" for method in _METHODS for raised in _RAISED)]


def _answers(ref: rr.ActorRef[Any]) -> bool:
    try:
        return ref.ask(1, timeout=5.0) == 1
    except rr.RrError:
        return False


@settings(max_examples=8, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(hows=st.lists(st.sampled_from(HOWS), min_size=3, max_size=5), tells=st.booleans())
@pytest.mark.parametrize("placement", ["thread", "process"])
def test_whatever_an_actor_raises_reaches_the_asker_and_the_actor_lives_or_is_restarted(
    state_dir: Any, placement: Any, hows: list[str], tells: bool
) -> None:
    root = rr.Supervisor([rr.ChildSpec(Raiser, id="raiser", placement=placement)], max_restarts=1000)
    with rr.System(root, state_dir=state_dir) as system:
        ref = system.ref("raiser")
        for how in hows:
            if tells:
                ref.tell(how)
            else:
                with pytest.raises(Exception) as caught:
                    ref.ask(how, timeout=10.0)
                cls = type(made(how)).__name__
                assert type(caught.value).__name__ == cls or f"{cls}" in caught.value.args[0]
            eventually(lambda: _answers(ref), what="it answers again")
        eventually(lambda: child(system, "raiser").state == "running")  # it may answer before its supervisor says so


@pytest.mark.parametrize("placement", ["thread", "process"])
@pytest.mark.parametrize("how", [*MAKERS, "__getattr__ KeyError", "__str__ SystemExit", "__reduce__ ValueError"])
def test_whatever_on_start_raises_is_named_in_the_failed_start(
    start: Callable[..., rr.System], placement: Any, how: str
) -> None:
    system = start()
    with pytest.raises(Exception) as caught:
        system.supervisor().start_child(rr.ChildSpec(Raiser, args=(how,), id="raiser", placement=placement))
    errors = (caught.value, caught.value.__cause__)
    cls = type(made(how)).__name__
    assert any(type(error).__name__ == cls for error in errors) or cls in caught.value.args[0]
    assert system.supervisor().start_child(rr.ChildSpec(Raiser, id="other", placement=placement))


class _Hangs(Exception):
    """An exception whose text is not made before `go_on` is set."""

    asked, go_on = threading.Event(), threading.Event()

    def __str__(self) -> str:
        self.asked.set()
        self.go_on.wait(LIMIT_S)
        return "late"

    __repr__ = __str__

    def __reduce__(self) -> Any:
        return _Hangs, ()


class _HangsAtStart(rr.Actor):
    def on_start(self) -> None:
        raise _Hangs


class _HangsAtAsyncStart(rr.Actor):
    async def on_start(self) -> None:
        raise _Hangs


class _HangsInInit(rr.Actor):
    def __init__(self) -> None:
        raise _Hangs


@pytest.fixture
def hanging(monkeypatch: pytest.MonkeyPatch) -> Iterator[type[_Hangs]]:
    """The class of exceptions whose text hangs; the texts come when the test ends."""
    monkeypatch.setattr(callback_errors, "TEXT_LIMIT_S", 0.5)
    _Hangs.asked.clear()
    _Hangs.go_on.clear()
    yield _Hangs
    _Hangs.go_on.set()


@pytest.mark.parametrize("cls", [_HangsAtStart, _HangsAtAsyncStart, _HangsInInit])
def test_while_the_text_of_a_failed_start_hangs_the_process_goes_on(
    start: Callable[..., rr.System], hanging: type[_Hangs], cls: type[Any]
) -> None:
    system = start()
    app = system.open_registrar("app")
    serve(app, "thing")
    starting = rr.ChildSpec(cls, id="hanging", placement="thread")
    with ThreadPoolExecutor(1) as pool:
        started = pool.submit(system.supervisor().start_child, starting)
        hanging.asked.wait(LIMIT_S)
        assert app.load("app/thing", 1, timeout_s=LIMIT_S / 2).request == 1
        with pytest.raises(rr.StartFailed, match=r"_Hangs was raised; its str\(\) had not returned"):
            started.result(LIMIT_S)


def test_a_process_whose_start_fails_with_such_an_error_says_its_class(
    start: Callable[..., rr.System], hanging: type[_Hangs]
) -> None:
    system = start()
    with pytest.raises(rr.StartFailed, match="_Hangs was raised"):
        system.supervisor().start_child(rr.ChildSpec(_HangsInInit, id="hanging"))


@pytest.mark.parametrize("how", [*(how for how in MAKERS if how != "group"), "__getattr__ KeyError"])
def test_such_an_error_of_a_load_callback_is_told_by_its_class(app: rr.Registrar, how: str) -> None:
    def load(_: Any) -> Any:
        raise made(how)

    serve(app, "bad", load=load)
    with pytest.raises(rr.LoadFailed, match=type(made(how)).__name__):
        app.load("app/bad", 1, timeout_s=10.0)


def _divide(*_: object) -> None:
    raise ZeroDivisionError


_request: ContextVar[str] = ContextVar("request")


class _Quiet(logging.Handler):
    def emit(self, record: logging.LogRecord) -> None: ...


class _Down(_Quiet):
    def emit(self, record: logging.LogRecord) -> None:
        raise ConnectionError("the log server is down")


def _filter(_: logging.LogRecord) -> bool:
    return bool(_request.get())


@pytest.fixture(params=["filter", "emit"])
def bad_logging(request: pytest.FixtureRequest) -> Any:
    logger, handler = logging.getLogger("rr_actors"), _Quiet()
    if request.param == "filter":
        handler.addFilter(_filter)
    else:
        handler = _Down()
    logger.addHandler(handler)
    logging.getLogger("rr_actors.supervision").addHandler(handler)
    yield
    logger.removeHandler(handler)
    logging.getLogger("rr_actors.supervision").removeHandler(handler)


class _Stuck(_Quiet):
    """A handler that hangs at each record: while its log server does not read, say."""

    def __init__(self) -> None:
        super().__init__()
        self.gate = Gate()

    def emit(self, record: logging.LogRecord) -> None:
        self.gate()


@pytest.fixture
def stuck_logging() -> Iterator[_Stuck]:
    """A handler of the package's records that hangs until the test ends."""
    handler = _Stuck()
    logging.getLogger("rr_actors").addHandler(handler)
    yield handler
    logging.getLogger("rr_actors").removeHandler(handler)
    handler.gate.open()


@pytest.mark.parametrize("placement", ["thread", "process"])
def test_while_a_log_handler_hangs_every_turn_goes_on(state_dir: Any, stuck_logging: _Stuck, placement: Any) -> None:
    system = rr.System([rr.ChildSpec(Raiser, id="raiser", placement=placement)], state_dir=state_dir)
    with system:
        app = system.open_registrar("app")
        serve(app, "thing", unload=_divide, status=_divide)
        held = [app.load("app/thing", number, on_status=_divide) for number in range(20)]
        for query in held:  # each is logged, on the loop or by a worker
            app.send_status(query.resource_id, rr.Status(rr.State.WARNING, "logged"))
        stuck_logging.gate.wait_arrived()
        for query in held:
            with pytest.raises(rr.UnloadFailed):
                query.unload(timeout_s=LIMIT_S)
        raiser = system.ref("raiser")
        with pytest.raises(SyntaxError):
            raiser.ask("syntax", timeout=LIMIT_S)
        eventually(lambda: _answers(system.ref("raiser")))
        assert app.load("app/thing", "after", timeout_s=LIMIT_S).request == "after"
        assert threading.active_count() < 60


@pytest.mark.usefixtures("bad_logging")
def test_logging_that_raises_ends_no_loop_and_no_system(state_dir: Any) -> None:
    system = rr.System([rr.ChildSpec(Raiser, id="raiser")], state_dir=state_dir)
    system.start()
    app = system.open_registrar("app")
    serve(app, "thing", unload=_divide)
    pid = child(system, "raiser").pid
    system.ref("raiser").kill()
    eventually(lambda: child(system, "raiser").pid not in (pid, None) and _answers(system.ref("raiser")))
    with pytest.raises(rr.UnloadFailed):
        app.load("app/thing", 1).unload()
    assert app.load("app/thing", 2, timeout_s=10.0).request == 2
    system.ref("raiser").tell("syntax")
    eventually(lambda: _answers(system.ref("raiser")))
    system.stop()
