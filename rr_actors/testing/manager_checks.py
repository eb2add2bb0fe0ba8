"""check_manager: crash-tests a class of managers with scenarios that Hypothesis makes.

Every kill is at a named point, a line of a callback or the moment when none runs, and not at a time. So a scenario that
has failed fails again.
"""

from __future__ import annotations

import contextlib
import itertools
import logging
import operator
import sys
import time
from collections.abc import Callable, Generator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, cast

from rr_actors.base import pickling
from rr_actors.base.checks import is_number, needing
from rr_actors.base.config import SystemConfig
from rr_actors.base.errors import NotSerializable, UsageError, did_you_mean, is_a, shown
from rr_actors.registrar.manager import Manager, declared_servers
from rr_actors.supervision.core.specs import ChildSpec, Supervisor
from rr_actors.testing.failure_programs import program_of, written
from rr_actors.testing.scenario_notes import PROMISES, RACES, Fault
from rr_actors.testing.scenario_stage import ServerFacts, Setup, Stage
from rr_actors.testing.scenario_steps import (
    AskUsage,
    Fatal,
    Kill,
    Load,
    LoadTogether,
    Pause,
    Reload,
    Resume,
    SendStatus,
    Step,
    Unload,
    UnloadTogether,
    Update,
    Wrong,
)

if TYPE_CHECKING:
    from hypothesis.strategies import SearchStrategy

CALLBACK_S = 5.0
_WRONG: object = {"rr_actors": ["no request"]}
_STEPS = 14  # a step without a kill takes a hundredth of a start
_LINES = 12  # a callback has seldom more
_SCENARIOS_WITHOUT_KILLS = 20
_PER_KILL = 20  # scenarios: many are like others, or have no kill that strikes
_SKIPPED = 10
_FIRST_KILLS = 4  # scenarios of each kind of step in which a kill may be, before all others: chance may leave one out
_MEETINGS = 6  # scenarios in which load callbacks run at the same time, before all others
_SHOW_S = 1.0
_REFUSED_ALL = 12
_STORY = 40


class ManagerFault(AssertionError):
    """A manager has broken a promise. The text says which, with the fewest steps that show it, and a program.

    Attributes:
        promise: the promise, in words.
        steps: the steps.
        program: the source of a program that takes these steps, and ends with this error.
    """

    def __init__(self, text: str, promise: str, steps: tuple[Step, ...], program: str) -> None:
        super().__init__(text)
        self.promise, self.steps, self.program = promise, steps, program


@dataclass(frozen=True)
class ManagerCheck:
    """What check_manager() has done.

    Attributes:
        scenarios: how many were played.
        kills: how many SIGKILLs have met the manager.
        loads: how many loads have succeeded.
        seconds: how long it took.
    """

    scenarios: int
    kills: int
    loads: int
    seconds: float


def check_manager(
    manager: type[Manager] | ChildSpec,
    requests: SearchStrategy[Any] | Mapping[str, SearchStrategy[Any]],
    *,
    wrong: Sequence[Any] | Mapping[str, Sequence[Any]] | None = None,
    beside: Sequence[ChildSpec | Supervisor] = (),
    kills: int = 50,
    limit_s: float = 60.0,
    callback_s: float = CALLBACK_S,
    same: Callable[[Any, Any], bool] = operator.eq,
    seed: int = 0,
    progress: Callable[[str], object] | None = None,
    config: SystemConfig | None = None,
) -> ManagerCheck:
    """Crash-test a class of managers: load, unload, pause, send statuses, and kill its process in each callback.

    Hypothesis makes scenarios, a real system in a state directory of its own plays them, and each is checked for what
    a good manager keeps (docs/crash-test.md). The same arguments give the same scenarios. Nothing is left at the end.

    Args:
        manager: the class; or its ChildSpec, with the arguments and the id that it has in the system.
        requests: a strategy of Hypothesis for requests that the manager loads. With several servers a dict of them, by
            the names of the servers; those that are left out are not used.
        wrong: requests that the manager is expected to refuse, of each server, or by the names of servers. Default:
            None, a dict with an unknown field. Name those that your own code refuses.
        beside: children that the manager needs. They start before it, and are not killed.
        kills: the number of SIGKILLs. Default: 50. Raise it before a release; 0 makes scenarios without any.
        limit_s: seconds for all. When they are over, what was played counts. Default: 60.0.
        callback_s: how long a callback may take, in seconds. A load callback has its load_timeout_s instead, if the
            server has one. Default: 5.0. Lower it if the devices are fake.
        same: whether the response that a recover callback returns is the one that there was. Default: they are equal.
            Give a function if they contain a process id, say.
        seed: chooses the scenarios. Default: 0. Change it to look for more.
        progress: called with a line of text each second. Default: None, the line goes to standard error if that is a
            terminal.
        config: the configuration of the system. Default: None, the usual one. Use `preload` for slow imports.

    Returns:
        What was done.

    Raises:
        ManagerFault: a promise is broken. `.promise`, `.steps`, `.program`
        UsageError: an argument is wrong, the manager cannot be started, or it refuses all requests.
        MissingDependency: Hypothesis is not installed.
    """
    with needing("check_manager()", "check"):
        from hypothesis.strategies import SearchStrategy
    setup = _checked(manager, beside, callback_s, same, config)
    if type(kills) is not int or kills < 0:
        raise UsageError(f"check_manager: kills: expected a whole number from 0 on, got {shown(kills)}")
    if not is_number(limit_s) or limit_s <= 0:
        raise UsageError(f"check_manager: limit_s: expected seconds greater than 0, got {shown(limit_s)}")
    if type(seed) is not int:
        raise UsageError(f"check_manager: seed: expected a whole number, got {shown(seed)}")
    names = list(declared_servers(cast("type[Manager]", setup.child.actor_class_or_manager)))
    strategies = _by_server("requests", requests, names, SearchStrategy, "a strategy of Hypothesis")
    refused: dict[str, Sequence[Any]] = dict.fromkeys(strategies, (_WRONG,))
    if wrong is not None:
        refused |= _by_server("wrong", wrong, names, (list, tuple), "a list of requests")
    serial = cast("type[Manager]", setup.child.actor_class_or_manager).serial
    with _quiet(), Stage(setup) as stage:
        search = _Search(stage, setup, kills, time.monotonic() + limit_s, progress)
        scenarios = _scenarios(strategies, refused, stage.servers, with_kills=kills > 0, serial=serial)
        if not serial:
            search.run(_together(strategies), seed, _MEETINGS, only=RACES)
        for each in _with_one_kill(strategies, stage.servers) if kills else ():
            search.run(each, seed, _FIRST_KILLS)
        search.run(scenarios, seed, _PER_KILL * kills or _SCENARIOS_WITHOUT_KILLS)
        return search.result()


def play_steps(
    manager: type[Manager] | ChildSpec,
    steps: Sequence[Step],
    *,
    beside: Sequence[ChildSpec | Supervisor] = (),
    callback_s: float = CALLBACK_S,
    same: Callable[[Any, Any], bool] = operator.eq,
    config: SystemConfig | None = None,
) -> None:
    """Play one scenario with a class of managers, as check_manager() does, to see a fault again or that it is mended.

    Args:
        manager, beside, callback_s, same, config: as for check_manager().
        steps: what to do, one after another.

    Raises:
        ManagerFault: a promise is broken.
        UsageError: an argument is wrong, or the manager cannot be started.
    """
    setup = _checked(manager, beside, callback_s, same, config, who="play_steps")
    for step in steps:
        if not is_a(step, Step):
            raise UsageError(f"play_steps: steps: expected steps such as Load(...), got {shown(step)}")
    with _quiet(), Stage(setup) as stage:
        for step in steps:
            if isinstance(step, Load | Wrong):
                _check_server(step.server, list(stage.servers), "play_steps: steps")
        if (fault := stage.play(steps)) is not None:
            raise _fault(setup, tuple(steps), fault, stage, "")
        if stage.loads and not stage.loaded:
            raise UsageError(f"play_steps: expected a request that the manager loads, got: {stage.refusal}")


def _checked(
    manager: object,
    beside: Sequence[ChildSpec | Supervisor],
    callback_s: float,
    same: Callable[[Any, Any], bool],
    config: SystemConfig | None,
    who: str = "check_manager",
) -> Setup:
    cls: object = manager.actor_class_or_manager if is_a(manager, ChildSpec) else manager
    if not isinstance(cls, type) or not issubclass(cls, Manager):
        got = f"{shown(cast('object', cls))} ({type(cast('object', cls)).__name__})"
        raise UsageError(f"{who}: manager: expected a class of rr.Manager, or a ChildSpec of one, got {got}")
    child = manager if is_a(manager, ChildSpec) else ChildSpec(cls, id=cls.__name__.lower())
    if not declared_servers(cls):
        raise UsageError(f"{who}: {cls.__qualname__}: expected a manager with a server (@rr.server), got none")
    if not is_number(callback_s) or callback_s <= 0:
        raise UsageError(f"{who}: callback_s: expected seconds greater than 0, got {shown(callback_s)}")
    if not callable(same):
        raise UsageError(f"{who}: same: expected a function of two responses, got {shown(same)}")
    others = list(beside) if isinstance(cast(object, beside), list | tuple) else [beside]
    for other in cast("list[object]", others):
        if not is_a(other, (ChildSpec, Supervisor)):
            raise UsageError(f"{who}: beside: expected a list of ChildSpecs and Supervisors, got {shown(other)}")
    try:
        pickling.dumps((cls, child.args, child.kwargs, same), f"{who}: {cls.__qualname__}")
    except NotSerializable as error:
        text = f"{who}: {cls.__qualname__}: expected a manager that can travel to another process: {error}"
        raise UsageError(f"{text}; define it in a module, and give what it needs as args") from error
    return Setup(child, tuple(cast("list[ChildSpec | Supervisor]", others)), float(callback_s), same, config)


def _check_server(server: str, names: Sequence[str], who: str) -> None:
    if server not in names:
        expected = f"one of its servers ({', '.join(names)})"
        raise UsageError(f"{who}: expected {expected}, got {shown(server)}{did_you_mean(server, names)}")


def _by_server(what: str, given: Any, names: list[str], kind: Any, expected: str) -> dict[str, Any]:
    """Return what is given for each server, by its name."""
    who = f"check_manager: {what}"
    if isinstance(given, kind):
        if len(names) > 1 and what == "requests":
            expected = f"a dict with {expected} for each server that is to be used ({', '.join(names)})"
            raise UsageError(f"{who}: expected {expected}, as the manager has {len(names)} servers, got {shown(given)}")
        return dict.fromkeys(names, given)
    if not isinstance(given, Mapping) or not given:
        got = shown(cast("object", given))
        raise UsageError(f"{who}: expected {expected}, or a dict of them by servers, got {got}")
    found = cast("Mapping[str, Any]", given)
    for server, one in found.items():
        _check_server(server, names, who)
        if not isinstance(one, kind):
            raise UsageError(f"{who}: {server}: expected {expected}, got {shown(one)}")
    return dict(found)


@contextlib.contextmanager
def _quiet() -> Generator[None]:
    """Keep the log of the package quiet: it has a line for each kill."""
    logger = logging.getLogger("rr_actors")
    before = logger.level
    logger.setLevel(logging.CRITICAL + 1)
    try:
        yield
    finally:
        logger.setLevel(before)


def _scenarios(
    requests: Mapping[str, SearchStrategy[Any]],
    wrong: Mapping[str, Sequence[Any]],
    servers: Mapping[str, ServerFacts],
    *,
    with_kills: bool,
    serial: bool,
) -> SearchStrategy[list[Step]]:
    """Return the strategy of scenarios. What it gives first is what a failure is shrunk to."""
    from hypothesis import strategies as st

    line = st.none() | st.none() | st.integers(0, _LINES) if with_kills else st.none()
    which = st.integers(0, 3)
    roles = {role for server in requests for role in servers[server].roles}
    loads = [st.builds(Load, st.just(server), of, line) for server, of in requests.items()]
    steps: list[SearchStrategy[Any]] = [
        *([st.builds(Kill, line if "recover" in roles else st.none())] if with_kills else []),
        st.one_of(loads),
        st.builds(Unload, which, line),
        st.builds(Fatal, which),
        *(st.builds(SendStatus, which, st.just(state), line) for state in ("WARNING", "ERROR", "OK")),
        st.builds(Update, which, line),
        st.builds(Reload, which),
        st.one_of(loads),
    ]
    if not serial:
        steps += [_together(requests).map(operator.itemgetter(0)), st.builds(UnloadTogether)]
    if "pause" in roles:
        steps += [st.builds(Pause, which, line), st.builds(Resume, which, line)]
    if "usage" in roles:
        steps.append(st.builds(AskUsage, line))
    refused = [st.builds(Wrong, st.just(server), st.sampled_from(of)) for server, of in wrong.items() if of]
    if refused:
        steps.append(st.one_of(refused))
    drawn = st.lists(st.none() | st.one_of(steps), min_size=_STEPS, max_size=_STEPS)  # None is left out: it is simplest
    return st.builds(_without_none, st.one_of(st.none(), *loads, *loads), drawn)


def _together(requests: Mapping[str, SearchStrategy[Any]]) -> SearchStrategy[list[Step]]:
    """Return the strategy of scenarios of one step, in which load callbacks of one server run at the same time."""
    from hypothesis import strategies as st

    some = {server: st.lists(of, min_size=2, max_size=3) for server, of in requests.items()}

    def alone(step: Step) -> list[Step]:
        return [step]

    loads = [st.builds(LoadTogether, st.just(server), of.map(tuple)) for server, of in some.items()]
    return st.one_of(loads).map(alone)


def _with_one_kill(
    requests: Mapping[str, SearchStrategy[Any]], servers: Mapping[str, ServerFacts]
) -> list[SearchStrategy[list[Step]]]:
    """Return strategies of a load and a step that kills, one for each kind of step."""
    from hypothesis import strategies as st

    line, which = st.integers(0, _LINES // 3), st.just(0)
    roles = {role for server in requests for role in servers[server].roles}
    load = st.one_of([st.builds(Load, st.just(server), of) for server, of in requests.items()])
    killed = st.one_of([st.builds(Load, st.just(server), of, st.none() | line) for server, of in requests.items()])
    steps: list[tuple[type[Step], SearchStrategy[Step]]] = [
        (Unload, st.builds(Unload, which, line)),
        (Kill, st.builds(Kill)),
        (Kill, st.builds(Kill, line)),
        (SendStatus, st.builds(SendStatus, which, st.just("WARNING"), line)),
        (Pause, st.builds(Pause, which, line)),
        (AskUsage, st.builds(AskUsage, line)),
    ]
    kills = [step for kind, step in steps if kind.role in roles or kind is Kill]
    some = [st.builds(_without_none, load, st.lists(st.none() | step, min_size=1, max_size=1)) for step in kills]
    return [st.builds(_without_none, killed, st.just(list[Step | None]())), *some]


def _without_none(first: Step | None, more: list[Step | None]) -> list[Step]:
    return [step for step in (first, *more) if step is not None]


def _normal(steps: Sequence[Step]) -> list[Step]:
    """Return the steps without those that find nothing to act on, and with the least `which` for the same."""
    held, found = 0, list[Step]()
    for step in steps:
        which = getattr(step, "which", None)
        if which is not None:
            if not held:
                continue
            step = replace(step, which=which % held)  # pyright: ignore[reportCallIssue] - it has that field
        if isinstance(step, UnloadTogether):
            if not held:
                continue
            held = 0
        held += isinstance(step, Load | Fatal) - isinstance(step, Unload)
        held += len(step.requests) if isinstance(step, LoadTogether) else 0
        found.append(step)
    return found


class _Found(Exception):
    """A scenario shows a fault. Hypothesis shrinks those of one class together."""


_FOUND = {promise: type("Found", (_Found,), {}) for promise in PROMISES}


class _Search:
    """Plays scenarios until there were enough kills, the time is over, or a fault is shrunk."""

    def __init__(
        self, stage: Stage, setup: Setup, kills: int, deadline: float, progress: Callable[[str], object] | None
    ) -> None:
        self._stage, self._setup, self._kills, self._deadline = stage, setup, kills, deadline
        self._progress = progress or (_to_terminal if sys.stderr.isatty() else None)
        self._began = self._told = time.monotonic()
        self._known: dict[bytes, Fault | None] = {}
        self._stories: dict[bytes, str] = {}
        self._covered: set[object] = set()
        self._skipped = 0
        self._last: tuple[list[Step], Fault] | None = None
        self.scenarios = 0

    def run(self, scenarios: SearchStrategy[list[Step]], seed: int, count: int, only: str = "") -> None:
        """Play scenarios, at most `count`.

        Args:
            only: the promise that they are about; "": all.

        Raises:
            ManagerFault: one shows a fault.
        """
        import hypothesis as h

        @h.seed(seed)
        @h.settings(
            max_examples=count,
            deadline=None,
            database=None,
            phases=(h.Phase.generate, h.Phase.shrink),
            suppress_health_check=cast("list[h.HealthCheck]", list(h.HealthCheck)),
            report_multiple_bugs=False,
            print_blob=False,
        )
        @h.given(scenarios)
        def play(steps: list[Step]) -> None:
            steps = _normal(steps)
            fault = self._play(steps)
            if fault is not None and only in ("", fault.promise):
                self._last = steps, fault
                raise _FOUND[fault.promise]

        try:
            play()
        except _Found:
            assert self._last is not None
            steps, fault = self._last
            story = self._stories[_bytes(steps)]
            raise _fault(self._setup, tuple(steps), fault, self._stage, self._line(), story) from None
        if not self.scenarios:
            raise UsageError("check_manager: limit_s: expected time for a scenario, and it was over at the first start")
        if self._stage.loads and not self._stage.loaded:
            expected = f"expected requests that the manager loads, and it refused all {self._stage.loads}"
            raise UsageError(f"check_manager: requests: {expected}; the last: {self._stage.refusal}")

    def _play(self, steps: list[Step]) -> Fault | None:
        key = _bytes(steps)
        if key in self._known:
            return self._known[key]
        if time.monotonic() > self._deadline:
            return None
        if self._last is None:
            enough = self._kills > 0 and self._stage.kills >= self._kills
            none_loaded = not self._stage.loaded and self._stage.loads >= _REFUSED_ALL
            if enough or none_loaded or not self._is_new(steps):
                return None
        self.scenarios += 1
        fault = self._known[key] = self._stage.play(steps)
        if fault is not None:
            self._stories[key] = _story(self._stage)
        self._tell()
        return fault

    def _is_new(self, steps: list[Step]) -> bool:
        """Return whether a scenario has a step, or two in a row, that no other has had; now and then True anyway."""
        killed = [(type(step), getattr(step, "kill_at", None) is not None) for step in steps]
        single = [(type(step), _kind(step), getattr(step, "kill_at", None)) for step in steps]
        new = {*single, *itertools.pairwise(killed)} - self._covered
        self._skipped = 0 if new else self._skipped + 1
        self._covered |= new
        return bool(new) or self._skipped % _SKIPPED == 0

    def _line(self) -> str:
        kills = f"{self._stage.kills} of {self._kills} kills"
        return f"scenario {self.scenarios}, {kills}, {time.monotonic() - self._began:.0f} s"

    def _tell(self) -> None:
        now = time.monotonic()
        if self._progress is not None and now - self._told >= _SHOW_S:
            self._told = now
            found = "; a fault is found, and is shrunk" if self._last is not None else ""
            self._progress(f"check_manager {self._setup.child.id}: {self._line()}{found}")

    def result(self) -> ManagerCheck:
        """Return what was done."""
        if self._progress is _to_terminal:
            sys.stderr.write("\n")
        seconds = round(time.monotonic() - self._began, 1)
        return ManagerCheck(self.scenarios, self._stage.kills, self._stage.loaded, seconds)


def _kind(step: Step) -> object:
    """Return in what a step differs from others of its class, other than by where it kills."""
    if isinstance(step, LoadTogether):
        return step.server, len({pickling.dumps(request) for request in step.requests})
    return getattr(step, "state", "")


def _to_terminal(line: str) -> None:
    sys.stderr.write(f"\r{line}\x1b[K")
    sys.stderr.flush()


def _bytes(steps: Sequence[Step]) -> bytes:
    return pickling.dumps(tuple(steps))


def _story(stage: Stage) -> str:
    return "\n".join(f"    {note}" for note in stage.story[-_STORY:] if note.what not in ("server", "census"))


def _fault(
    setup: Setup, steps: tuple[Step, ...], fault: Fault, stage: Stage, line: str, story: str | None = None
) -> ManagerFault:
    options: dict[str, object] = {"same": setup.same} if setup.same is not operator.eq else {}
    if setup.config is not None:
        options["config"] = setup.config
    arguments: dict[str, Any] = {"beside": setup.beside, "callback_s": setup.callback_s, "options": options}
    program = program_of(setup.child, steps, fault, **arguments)
    listed = "\n".join(f"    {number}. {written(step)}" for number, step in enumerate(steps, 1))
    name = getattr(setup.child.actor_class_or_manager, "__qualname__", setup.child.id)
    text = (
        f"{name}: expected: {fault.promise}\n{_indented(fault.text)}\nThe fewest steps that were found"
        f"{f' ({line})' if line else ''}:\n{listed}\nWhat the manager's processes noted, with their ids:\n"
        f"{_story(stage) if story is None else story}\nThe same as a program:\n\n{program}"
    )
    return ManagerFault(text, fault.promise, steps, program)


def _indented(text: str) -> str:
    return "\n".join(f"    {line}" for line in text.strip().splitlines())
