"""Action: a user's code that a graph runs, the parameters that its class has, and the control of a run."""

from __future__ import annotations

import contextlib
import threading
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from typing import Any, ClassVar, Literal, cast

import msgspec
from msgspec import inspect

from rr_actors.actors.messaging.futures import Reply
from rr_actors.base.checks import is_number
from rr_actors.base.errors import LoadFailed, UsageError, shown
from rr_actors.managers.actions.graph_checks import Signature
from rr_actors.managers.actions.graph_model import SEPARATOR, Parameter, flat, nested
from rr_actors.registrar.model.rows import State
from rr_actors.registrar.queries import Query, Status
from rr_actors.registrar.registrar import Registrar
from rr_actors.registrar.servers.callback_context import Current, current
from rr_actors.runtime.processes.isolated import Events

_LOOK_S = 0.05  # how often a load looks whether the run is to stop: nobody notifies of the event

OnStatus = Callable[[Status], object]
_WITH_FIELDS = (inspect.StructType, inspect.DataclassType, inspect.NamedTupleType, inspect.TypedDictType)
_WORDS: dict[type[inspect.Type], str] = {
    inspect.StrType: "string",
    inspect.IntType: "number",
    inspect.FloatType: "number",
    inspect.BoolType: "bool",
}


class Action(ABC):
    """One step of a graph: subclass it, and give the class to rr_actors.managers.Actions (thesis 2.5.1)::

        class Navigate(rr.Action):
            class Input(msgspec.Struct):
                goal: str

            def run(self, given: Input) -> bool:
                robot = self.load("robots/robot", LoadRobot("rover"))
                ...
                return True

    Each run makes an instance. What it loads is released when the run has ended, in whatever way. In a graph of the
    older dialect an "asynchronous" action keeps it until the graph ends.

    Attributes:
        name: the name in graphs; "" means the name of the class.
        Input: the class of what `run` is given, a msgspec.Struct or a dataclass. Without one, run() is given a dict.
        Output: the class of what it returns.
        isolate: True: run() has a process of its own, which is killed if it does not stop. For code that may hang or
            crash. It loads nothing (docs/actions.md).
        timeout_s: seconds that an isolated run may take; then it is stopped. None: no limit.
        attempt: 1 at first; more if a crash has interrupted the run before.
        pausing: an event that is set while the action is to pause. Code that can pause looks at it.
    """

    name: ClassVar[str] = ""
    Input: ClassVar[type[Any] | None] = None
    Output: ClassVar[type[Any] | None] = None

    isolate: ClassVar[bool] = False
    timeout_s: ClassVar[float | None] = None

    attempt: int = 1
    pausing: threading.Event = threading.Event()  # each instance has its own

    def __init__(self) -> None:
        """Make the action for one run. Only the Actions manager does."""
        self.pausing = threading.Event()
        self._stopping: threading.Event | None = None
        self._current: Current | None = None
        self._registrar: Registrar | None = None

    @abstractmethod
    def run(self, given: Any) -> Any:
        """Do the step. Return an Output, True or None for on_true, and False for on_false. To raise means on_error.

        With `Output` and False, return ``(False, output)``.
        """

    @property
    def stopping(self) -> threading.Event:
        """The event that tells a run to end soon.

        It is set when the graph stops the action or is released, and when the process stops. It is set, too, when
        something that the action has loaded is lost, unless `on_status` has handled that.
        """
        if self._stopping is None:
            raise self._not_running()
        return self._stopping

    def load(
        self,
        server: str,
        request: Any,
        *,
        on_status: OnStatus | None = None,
        timeout_s: float | None = 30.0,
        priority: int | None = None,
    ) -> Query:
        """Load a resource for this run, as Registrar.load() does. It is released when the run has ended.

        Args:
            on_status: called with each of its statuses. If it does not say `status.handled()` to a FATAL, `stopping` is
                set.
            priority: None: that of the graph.

        Raises:
            RrError: as Registrar.load().
            LoadFailed: the graph stops the action while it waits, which withdraws the load.
            UsageError: the action is isolated.
        """
        me, registrar = self._current, self._registrar
        if me is None or registrar is None:
            raise self._not_running()

        def heard(status: Status) -> None:
            if on_status is not None:
                on_status(status)
            if status.state is State.FATAL and not status.is_handled:
                self.stopping.set()

        was_stopping = self.stopping.is_set()  # what a run needs to come to its end is loaded
        options: dict[str, Any] = {} if priority is None else {"priority": priority}
        begun: object = registrar.load(
            server, request, on_status=heard, timeout_s=timeout_s, parent=me, block=False, **options
        )
        loading = cast("Reply[Query]", begun)
        while not was_stopping and not loading.done():
            with contextlib.suppress(TimeoutError):
                return loading.result(_LOOK_S)
            if self.stopping.is_set() and loading.cancel():
                text = f"{name_of(type(self))}: it was told to stop while it waited for {server}: the load is withdrawn"
                raise LoadFailed(text, server=server)
        return loading.get()

    def _not_running(self) -> UsageError:
        if self._stopping is not None:
            text = (
                "it is isolated, and its process has no registrar: load in another action, and hand over what it needs"
            )
        else:
            text = "no graph runs this action: only its manager can load for it"
        return UsageError(f"{type(self).__name__}: {text}")

    def _bind(self, registrar: Registrar, attempt: int) -> None:
        self._registrar, self._current, self.attempt = registrar, current(), attempt
        self._stopping = current().stopping

    def _bind_alone(self, events: Events, attempt: int) -> None:
        self._stopping, self.pausing, self.attempt = events.stopping, events.pausing, attempt


def bind(action: Action, registrar: Registrar, attempt: int) -> None:
    """Bind an action to the load callback that runs it."""
    action._bind(registrar, attempt)  # pyright: ignore[reportPrivateUsage]  # same file


def run_alone(
    kind: type[Action], inputs: Mapping[str, Any], attempt: int, events: Events
) -> tuple[str, dict[str, Any]]:
    """Run an isolated action, in its process, and return its result and outputs."""
    action = kind()
    action._bind_alone(events, attempt)  # pyright: ignore[reportPrivateUsage]  # same file
    return result_of(kind, action.run(given_to(kind, inputs)))


def check_isolation(kind: type[Action]) -> None:
    """Check what an action's class says about its process.

    Raises:
        UsageError: `isolate` is no bool, or `timeout_s` no time, or it is there although nothing can end the run.
    """
    who, limit_s = f"{kind.__name__}.timeout_s", kind.timeout_s
    if not isinstance(kind.isolate, bool):  # pyright: ignore[reportUnnecessaryIsInstance]
        raise UsageError(f"{kind.__name__}.isolate: expected True or False, got {shown(kind.isolate)}")
    if limit_s is not None and not (is_number(limit_s) and limit_s > 0):
        raise UsageError(f"{who}: expected seconds greater than 0, or None, got {shown(limit_s)}")
    if limit_s is not None and not kind.isolate:
        raise UsageError(f"{who}: expected isolate = True, without which nothing can end a run, got {shown(limit_s)}")


def name_of(kind: type[Action]) -> str:
    """Return the name that graphs call an action by."""
    return kind.name or kind.__name__


def signature_of_class(kind: type[Action]) -> Signature:
    """Return the parameters of an action's class.

    Raises:
        UsageError: Input or Output has no fields.
    """
    return Signature(_parameters(kind, "Input"), _parameters(kind, "Output"))


def _parameters(kind: type[Action], which: str) -> dict[str, Parameter]:
    fields: type[Any] | None = getattr(kind, which)
    if fields is None:
        return {}
    found = inspect.type_info(fields)
    if not isinstance(found, _WITH_FIELDS):
        expected = "a msgspec.Struct, a dataclass, a NamedTuple or a TypedDict"
        raise UsageError(f"{kind.__name__}.{which}: expected {expected}, got {shown(fields)}")
    return dict(_flat_fields(found, "", True))


def _flat_fields(found: Any, prefix: str, required: bool) -> list[tuple[str, Parameter]]:
    flat_fields: list[tuple[str, Parameter]] = []
    for field in found.fields:
        name, needed = prefix + field.encode_name, required and field.required
        if isinstance(field.type, _WITH_FIELDS):
            flat_fields += _flat_fields(field.type, name + SEPARATOR, needed)
        else:
            allowed = tuple(field.type.values) if isinstance(field.type, inspect.LiteralType) else ()
            flat_fields.append((name, Parameter(_word(field.type), required=needed, allowed=allowed)))
    return flat_fields


def _word(kind: inspect.Type) -> str:
    if isinstance(kind, inspect.ListType):
        return f"{_WORDS[type(kind.item_type)]}s" if type(kind.item_type) in _WORDS else "list"
    if isinstance(kind, inspect.LiteralType):
        return "string" if all(isinstance(value, str) for value in kind.values) else "number"
    return _WORDS.get(type(kind), "any")


def given_to(kind: type[Action], inputs: Mapping[str, Any]) -> Any:
    """Return what run() is given.

    Raises:
        msgspec.ValidationError: the inputs do not fit the class.
    """
    values = nested(inputs)
    return values if kind.Input is None else msgspec.convert(values, kind.Input)


def result_of(kind: type[Action], returned: Any) -> tuple[str, dict[str, Any]]:
    """Return the result and the outputs, by flat names, of what run() has returned.

    Raises:
        UsageError: it is nothing that run() may return.
    """
    output: object = returned
    succeeded = True
    if isinstance(returned, tuple) and len(cast("tuple[object, ...]", returned)) == 2:
        succeeded, output = cast("tuple[bool, object]", returned)
        if not isinstance(succeeded, bool):  # pyright: ignore[reportUnnecessaryIsInstance]
            raise _wrong_end(kind, cast("object", returned))
    if isinstance(output, bool) or output is None:
        return ("on_false" if output is False else "on_true"), {}
    if kind.Output is not None and isinstance(output, kind.Output):
        output = _table(output, inspect.type_info(kind.Output))
    if not isinstance(output, dict):
        raise _wrong_end(kind, cast("object", returned))
    leaves = {name for name, one in signature_of_class(kind).outputs.items() if one.type == "any"}
    return ("on_true" if succeeded else "on_false"), flat(cast("dict[str, Any]", output), leaves)


def _wrong_end(kind: type[Action], returned: object) -> UsageError:
    expected = "an Output, a dict of outputs, True, False, None, or (False, outputs)"
    return UsageError(f"{kind.__name__}.run(): expected {expected}, got {shown(returned)}")


def _table(value: Any, kind: Any) -> Any:
    """Return what has fields as a table, and the tables in it. All other values stay as they are, with their types."""
    if not isinstance(kind, _WITH_FIELDS):
        return value
    if isinstance(kind, inspect.TypedDictType):
        return {one.encode_name: _table(value[one.name], one.type) for one in kind.fields if one.name in value}
    return {one.encode_name: _table(getattr(value, one.name), one.type) for one in kind.fields}


# -- the control of a run ----------------------------------------------------------------------------------------------
#
# Whether a run may begin, and what it hears, in the manager that runs it. The engine commits a stop or a pause, and
# then tells it to the run. The load of a run travels on another way, so it may arrive before that or after it. So a run
# makes its control first, asks the engine what holds now, and begins under the lock of the control. What was told,
# and confirmed, before a run has begun keeps it from beginning.

Word = Literal["run", "pause", "stop"]
"""What holds for a run: it may run, it is to pause, or it is to stop and is not to begin."""

_CONTROL_LOOK_S = 0.1  # the registrar sets `stopping` itself, and notifies nobody


class RunControl:
    """The control of one run. From any thread.

    Attributes:
        over: is set when the run has ended, or will not begin.
    """

    def __init__(self, action: Action) -> None:
        self.over = threading.Event()
        self._action = action
        self._step = -1
        self._changed = threading.Condition()

    def tell(self, word: Word, step: int) -> None:
        """Take what holds for the run since a step of its graph; what an earlier step said is ignored.

        When it returns, a run that has not begun, and is to stop or to pause, does not begin.
        """
        with self._changed:
            if step < self._step:
                return
            self._step = step
            if word == "stop":
                self._action.stopping.set()
            elif word == "pause":
                self._action.pausing.set()
            else:
                self._action.pausing.clear()
            self._changed.notify_all()

    def begin(self, start: Callable[[], object] = lambda: None) -> bool:
        """Wait while the run is to pause, then call `start`. Return False, and do not call it, if it is to stop."""
        with self._changed:
            while self._action.pausing.is_set() and not self._action.stopping.is_set():
                self._changed.wait(_CONTROL_LOOK_S)
            if self._action.stopping.is_set():
                return False
            start()
            return True
