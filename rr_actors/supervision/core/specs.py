"""ChildSpec, Supervisor and Backoff: how to start, restart and stop children. ChildModel: how a simulated one behaves.

A specification is checked when it is made, so each one is valid. One check comes later, when the class is used: that
it is a Manager, an Actor or a plain Pykka actor. Names and meanings are those of Erlang/OTP's supervisor. The
default intensity is Elixir's. docs/otp.md lists the differences.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal, cast, get_args, get_origin

from msgspec import Struct

from rr_actors.base.checks import check_flag, check_id, check_number, check_one_of, check_positive, examined, invalid
from rr_actors.base.errors import is_a
from rr_actors.base.toml import FilePath, parse_child, read_supervisor

Strategy = Literal["one_for_one", "one_for_all", "rest_for_one", "simple_one_for_one"]
RestartType = Literal["permanent", "transient", "temporary"]
Shutdown = float | Literal["infinity", "brutal_kill"]
AutoShutdown = Literal["never", "any", "all"]
Placement = Literal["process", "thread"]


@dataclass(frozen=True)
class Backoff:
    """Growing waiting times before the restarts of a child. The child's state is "restarting" meanwhile.

    The n-th restart in a row (n from 0) waits ``min(maximum_s, delay_s * factor**n)``. A random part of that, up to
    `jitter`, is taken off: children that failed together do not restart together. A child that has run for `maximum_s`
    starts again with `delay_s`. Under one_for_all and rest_for_one the child that failed delays its group.
    Delayed restarts count: the supervisor's max_restarts within max_seconds should leave room for the first ones.

    Args:
        delay_s: seconds before the first restart, at least 0. Default: 0.1. Raise it for a device that needs time to
            come back.
        factor: growth from one wait to the next, at least 1. Default: 2.0. Set 1 for equal waits.
        maximum_s: the longest wait in seconds, at least delay_s. Default: 30.0. Lower it if the child is needed soon;
            raise it if each attempt costs.
        jitter: 0 (none) to 1 (anything between no wait and all of it). Default: 0.1. Raise it if many children restart
            together; set 0 in tests.

    Raises:
        InvalidSpec: naming the field.
    """

    delay_s: float = 0.1
    factor: float = 2.0
    maximum_s: float = 30.0
    jitter: float = 0.1

    def __post_init__(self) -> None:
        who = "Backoff"
        check_number(self.delay_s, who, "delay_s", least=0)
        check_number(self.factor, who, "factor", least=1)
        check_number(self.maximum_s, who, "maximum_s", least=0)
        check_number(self.jitter, who, "jitter", least=0, most=1)
        if self.maximum_s < self.delay_s:
            raise invalid(who, "maximum_s", f"at least delay_s ({self.delay_s:g})", self.maximum_s)

    def delay(self, attempt: int, chance: float) -> float:
        """Return the seconds before restart number `attempt` (from 0); `chance` is a random number in [0, 1]."""
        try:
            wait_s = min(self.maximum_s, self.delay_s * self.factor**attempt)
        except OverflowError:
            wait_s = self.maximum_s if self.delay_s else 0.0
        return wait_s * (1 - self.jitter * chance)


@dataclass(frozen=True)
class ChildSpec:
    """The specification of one child: how to start, restart and stop it.

    Args:
        actor_class_or_manager: a class (Manager, Actor or a Pykka actor) or a Supervisor. It has no default.
        id: the child's name among its siblings. Default: "", the class's name or the Supervisor's id. Set it for a
            second child of a class, and for every Manager: its servers are found by it.
        args, kwargs: the arguments of the class. Default: (), {}, none. Set them if its `__init__` takes any.
        restart: "permanent": always. "transient": after abnormal ends and kills. "temporary": never, and the
            specification is removed when the child ends. Default: "permanent". Set "transient" for a task that has an
            end.
        shutdown_s: seconds to stop before the child is killed; "infinity"; or "brutal_kill": killed at once. Default:
            5.0. Raise it for a slow on_stop. Use "infinity" for a ChildSpec around a Supervisor, or its whole subtree
            has only 5 s.
        significant: the child's own end may end the supervisor (auto_shutdown). Default: False. Turn it on for the
            child whose work is the supervisor's purpose.
        placement: "process" (its own process) or "thread" (its supervisor's process). Default: "process". Set "thread"
            to debug, or for a light child whose crash may end its siblings.
        backoff: the waiting times before restarts. Default: None, restart at once. Set one if what the child needs may
            be away for long.
        heartbeat_s: replace a child whose event loop has not answered for that many seconds, also in its start. And one
            that reports twice in a row that it cannot work. Default: None, off. Set it if a process may hang.
        start_timeout_s: seconds to become ready. After that the child is killed, and its start has failed. Default:
            None, the system's limit. Raise it for a child that is slower than the others.
        renamed_from: the id that this manager had in earlier runs. System.start() gives it what its registrar of that
            name left on disk, once. Default: None, it has always had this id. Set it when you rename a manager.

    Raises:
        InvalidSpec: `.field`, `.expected`, `.got`.
    """

    actor_class_or_manager: type[Any] | Supervisor
    id: str = ""  # None means the same; after the check it is a name
    args: Sequence[Any] = ()
    kwargs: Mapping[str, Any] = field(default_factory=dict[str, Any])
    restart: RestartType = "permanent"
    shutdown_s: Shutdown = 5.0
    significant: bool = False
    placement: Placement = "process"
    backoff: Backoff | None = None
    heartbeat_s: float | None = None
    start_timeout_s: float | None = None
    renamed_from: str | None = None

    def __post_init__(self) -> None:
        with examined("ChildSpec"):
            self._check()

    def _check(self) -> None:
        what = cast(object, self.actor_class_or_manager)
        if isinstance(of := get_origin(what), type):  # a generic class with its arguments: Cache[int]
            object.__setattr__(self, "actor_class_or_manager", what := of)
        if not isinstance(what, type | Supervisor):
            raise invalid("ChildSpec", "actor_class_or_manager", "a class or a Supervisor", what)
        if cast(object, self.id) is None or self.id == "":
            object.__setattr__(self, "id", what.__name__ if isinstance(what, type) else what.id)
        check_id(self.id, f"ChildSpec of {what.__name__}" if isinstance(what, type) else "ChildSpec")
        who = f"ChildSpec {self.id!r}"
        self._check_arguments(who)
        _check_as_child(who, self.restart, self.shutdown_s, self.significant, self.placement)
        if self.backoff is not None and not isinstance(cast(object, self.backoff), Backoff):
            raise invalid(who, "backoff", "a Backoff or None", self.backoff)
        if self.backoff is not None and self.restart == "temporary":
            raise invalid(who, "backoff", "None with restart='temporary', which is never restarted", self.backoff)
        if self.renamed_from is not None:
            check_id(self.renamed_from, who, "renamed_from")
            if self.renamed_from == self.id:
                raise invalid(who, "renamed_from", "an earlier id", self.renamed_from)
        for name in ("heartbeat_s", "start_timeout_s"):
            if getattr(self, name) is not None:
                check_positive(getattr(self, name), who, name)

    def _check_arguments(self, who: str) -> None:
        args, kwargs = cast(object, self.args), cast(object, self.kwargs)
        if not isinstance(args, tuple | list):
            raise invalid(who, "args", "a tuple or list", args)
        if not isinstance(kwargs, Mapping):
            raise invalid(who, "kwargs", "a dict with names as keys", kwargs)
        for key in cast("Mapping[object, object]", kwargs):
            if not isinstance(key, str):
                raise invalid(who, "kwargs", "a dict with names as keys", key)
        object.__setattr__(self, "args", tuple(self.args))  # copies, which the caller cannot change later
        object.__setattr__(self, "kwargs", dict(self.kwargs))
        if isinstance(self.actor_class_or_manager, Supervisor):
            for name, value in (("args", self.args), ("kwargs", self.kwargs)):
                if value:
                    raise invalid(who, name, "none, as a Supervisor takes none", value)

    @property
    def type(self) -> Literal["worker", "supervisor"]:
        """The type in which_children(): "worker" or "supervisor"."""
        return "supervisor" if isinstance(self.actor_class_or_manager, Supervisor) else "worker"


@dataclass(frozen=True)
class Supervisor:
    """The specification of a supervisor and its children. They start in this order, and stop in reverse order.

    Args:
        children: ChildSpecs and Supervisors. Under simple_one_for_one exactly one: the template. Default: (), none.
            Name what runs from the start; start_child() adds others.
        id: the supervisor's name among its siblings, and a part of the paths below it. Default: "root". Set it for each
            supervisor but the first.
        strategy: the children that are restarted when one ends. "one_for_one": that child. "one_for_all": all.
            "rest_for_one": that child and those started after it. "simple_one_for_one": that child; children are added
            at run time from one template. Default: "one_for_one". Set another if children need each other.
        max_restarts, max_seconds: with more than max_restarts restarts within max_seconds seconds the supervisor stops
            its children and ends with reason "shutdown". 0 restarts: the first that is needed ends it. Default: 3, 5.0.
            Raise max_restarts for many children; raise max_seconds with a Backoff.
        auto_shutdown: end when a significant child ("any"), or the last one ("all"), has ended by itself. Default:
            "never". Set it if nothing is left to do then.
        max_children: with simple_one_for_one, the largest number of children. Default: None, no limit. Set it to what
            the machine can hold.
        restart, significant: as in ChildSpec, if the supervisor is a child itself. Default: "permanent", False. Set
            them for a branch that may end.
        placement: as in ChildSpec. Default: "thread", in the process of its own supervisor. Set "process" so that a
            branch survives the crash of its siblings.
        shutdown_s: as in ChildSpec. Default: "infinity", so that each child can stop. Lower it if the branch may
            be killed.

    Raises:
        InvalidSpec: `.field`, `.expected`, `.got`.
    """

    children: Sequence[ChildSpec | Supervisor] = ()
    id: str = "root"
    strategy: Strategy = "one_for_one"
    max_restarts: int = 3
    max_seconds: float = 5.0
    auto_shutdown: AutoShutdown = "never"
    placement: Placement = "thread"
    restart: RestartType = "permanent"
    shutdown_s: Shutdown = "infinity"
    significant: bool = False
    max_children: int | None = None

    def __post_init__(self) -> None:
        with examined("Supervisor"):
            self._check()

    def _check(self) -> None:
        check_id(self.id, "Supervisor")
        who = f"Supervisor {self.id!r}"
        check_one_of(self.strategy, who, "strategy", get_args(Strategy))
        if isinstance(cast(object, self.max_restarts), float):
            raise invalid(who, "max_restarts", "a whole number of at least 0", self.max_restarts)
        check_number(self.max_restarts, who, "max_restarts", least=0)
        check_positive(self.max_seconds, who, "max_seconds")
        check_one_of(self.auto_shutdown, who, "auto_shutdown", get_args(AutoShutdown))
        self._check_max_children(who)
        _check_as_child(who, self.restart, self.shutdown_s, self.significant, self.placement)
        self._check_children(who)

    def _check_max_children(self, who: str) -> None:
        limit = cast(object, self.max_children)
        if limit is None:
            return
        if isinstance(limit, float):
            raise invalid(who, "max_children", "a whole number of at least 0, or None", limit)
        check_number(limit, who, "max_children", least=0)
        if self.strategy != "simple_one_for_one":
            raise invalid(who, "max_children", "None, as strategy is not 'simple_one_for_one'", limit)

    def _check_children(self, who: str) -> None:
        children = cast(object, self.children)
        if not isinstance(children, tuple | list):
            raise invalid(who, "children", "a list of ChildSpecs and Supervisors", children)
        object.__setattr__(self, "children", tuple(self.children))
        seen: dict[str, int] = {}
        for index, child in enumerate(self.children):
            where = f"children[{index}]"
            if isinstance(child, type):
                raise invalid(who, where, f"a ChildSpec (say ChildSpec({child.__name__})) or Supervisor", child)
            if not isinstance(cast(object, child), ChildSpec | Supervisor):
                raise invalid(who, where, "a ChildSpec or Supervisor", child)
            if child.id in seen:
                expected = f"an id of its own (children[{seen[child.id]}] has this one)"
                raise invalid(who, f"{where}.id", expected, child.id)
            seen[child.id] = index
            check_significant(child, self, where)
        if self.strategy == "simple_one_for_one" and len(self.children) != 1:
            expected = "exactly one, the template, with strategy='simple_one_for_one'"
            raise invalid(who, "children", expected, [child.id for child in self.children])

    @property
    def child_specs(self) -> tuple[ChildSpec, ...]:
        """The children as ChildSpecs. A Supervisor among them is wrapped in a ChildSpec with its settings."""
        return tuple(as_child_spec(child) for child in self.children)

    @classmethod
    def from_toml(cls, path: FilePath) -> Supervisor:
        """Read a tree from a TOML file (docs/supervision.md shows one).

        Hosts.from_toml() reads the table [hosts] of the same file.

        Raises:
            ConfigError: the file cannot be read, is not TOML, or has an unknown key or a wrong value. `.file`, `.key`,
                `.expected`, `.got`
        """
        return read_supervisor(path, cls, ChildSpec, Backoff)


def child_from_toml(text: bytes, file: str) -> ChildSpec | Supervisor:
    """Read one child from the text of a TOML file: a table as Supervisor.from_toml reads it below `children`.

    Args:
        file: the file's name, for errors.

    Raises:
        ConfigError: `.file`, `.key`, `.expected`, `.got`: not TOML, an unknown key, a wrong value, no such class.
    """
    return parse_child(text, file, Supervisor, ChildSpec, Backoff)


def as_child_spec(child: ChildSpec | Supervisor) -> ChildSpec:
    """Return the ChildSpec, or one around a Supervisor with its restart, shutdown_s, significant and placement."""
    if isinstance(child, ChildSpec):
        return child
    return ChildSpec(
        child,
        id=child.id,
        restart=child.restart,
        shutdown_s=child.shutdown_s,
        significant=child.significant,
        placement=child.placement,
    )


def starting_with(child: ChildSpec, path: str) -> Iterator[tuple[str, ChildSpec]]:
    """Yield the child at `path` and all that start with it, with their paths, supervisors before their children.

    The children of a simple_one_for_one supervisor are not known beforehand, and left out.
    """
    yield path, child
    inner = child.actor_class_or_manager
    if isinstance(inner, Supervisor) and inner.strategy != "simple_one_for_one":
        for below in inner.child_specs:
            yield from starting_with(below, f"{path}/{below.id}")


def classes_of(child: ChildSpec) -> list[type]:
    """Return the classes of a child and of all that start with it."""
    found = [below.actor_class_or_manager for _, below in starting_with(child, "")]
    return [cls for cls in found if isinstance(cls, type)]


def count_processes(supervisor: Supervisor) -> int:
    """Return how many processes the supervisor starts from its own process, with those of supervisors placed there."""
    if supervisor.strategy == "simple_one_for_one":
        return 0
    count = 0
    for child in supervisor.child_specs:
        inner = child.actor_class_or_manager
        if child.placement == "process":
            count += 1
        elif isinstance(inner, Supervisor):
            count += count_processes(inner)
    return count


def check_significant(child: ChildSpec | Supervisor, supervisor: Supervisor, where: str) -> None:
    """Raise InvalidSpec, of the field `where`.significant, if `child` is significant and auto_shutdown is "never"."""
    if child.significant and supervisor.auto_shutdown == "never":
        expected = f"False for {child.id!r}, as auto_shutdown is 'never'"
        raise invalid(f"Supervisor {supervisor.id!r}", f"{where}.significant", expected, True)


def _check_as_child(who: str, restart: object, shutdown_s: object, significant: object, placement: object) -> None:
    """Check the fields that ChildSpec and Supervisor share."""
    check_one_of(restart, who, "restart", get_args(RestartType))
    if isinstance(shutdown_s, str) and shutdown_s not in ("infinity", "brutal_kill"):
        raise invalid(who, "shutdown_s", "seconds, 'infinity' or 'brutal_kill'", shutdown_s)
    if not isinstance(shutdown_s, str):
        check_number(shutdown_s, who, "shutdown_s", least=0, also=" (seconds), 'infinity' or 'brutal_kill'")
    check_flag(significant, who, "significant")
    if significant and restart == "permanent":
        expected = "False with restart='permanent': a child that is always restarted has no end of its own"
        raise invalid(who, "significant", expected, significant)
    check_one_of(placement, who, "placement", get_args(Placement))


# -- children of simulations -------------------------------------------------------------------------------------------

Chance = Callable[[], float]
"""Returns a random number in [0, 1)."""

EndReason = Literal["killed", "abnormal", "normal"]


class Exponential(Struct, frozen=True):
    """Times that are as likely to end in each second, however long they have lasted.

    Args:
        mean_s: their mean in seconds, above 0.

    Raises:
        InvalidSpec: naming the field.
    """

    mean_s: float

    def __post_init__(self) -> None:
        check_positive(self.mean_s, "Exponential", "mean_s")

    def draw(self, chance: Chance) -> float:
        """Return one of these times, in seconds."""
        return -self.mean_s * math.log(1 - chance())


class Uniform(Struct, frozen=True):
    """Times between two limits, each as likely as the others.

    Args:
        least_s: the shortest, in seconds, at least 0.
        most_s: the longest, at least `least_s`.

    Raises:
        InvalidSpec: naming the field.
    """

    least_s: float
    most_s: float

    def __post_init__(self) -> None:
        check_number(self.least_s, "Uniform", "least_s", least=0)
        check_number(self.most_s, "Uniform", "most_s", least=0)
        if self.most_s < self.least_s:
            raise invalid("Uniform", "most_s", f"at least least_s ({self.least_s:g})", self.most_s)

    def draw(self, chance: Chance) -> float:
        """Return one of these times, in seconds."""
        return self.least_s + (self.most_s - self.least_s) * chance()


Seconds = float | Exponential | Uniform
"""A time that is always the same, or one that is drawn each time."""


def draw(seconds: Seconds, chance: Chance) -> float:
    """Return a time in seconds."""
    return seconds.draw(chance) if isinstance(seconds, Exponential | Uniform) else seconds


class ChildModel(Struct, frozen=True):
    """How long a child needs to start, how long it lives, and how it ends. `Child.fails()` makes one, and says more.

    Attributes:
        every_s: from when it is ready to its end; None: it lives for ever.
        start_s, stop_s: what a start and a stop take.
        start_fails: the part of its starts that fail, from 0 to 1.
        hangs: the part of its lives at whose end it hangs instead.
        reason: how it ends: "killed", "abnormal" or "normal".

    Raises:
        InvalidSpec: `.field`, `.expected`, `.got`.
    """

    every_s: Seconds | None = None
    start_s: Seconds = 0.1
    start_fails: float = 0.0
    hangs: float = 0.0
    stop_s: Seconds = 0.0
    reason: EndReason = "killed"

    def __post_init__(self) -> None:
        who = "Child.fails"
        with examined(who):
            if self.every_s is not None:
                _check_seconds(self.every_s, who, "every_s")
                if is_a(self.every_s, (int, float)):
                    check_positive(self.every_s, who, "every_s")
            _check_seconds(self.start_s, who, "start_s")
            _check_seconds(self.stop_s, who, "stop_s")
            check_number(self.start_fails, who, "start_fails", least=0, most=1)
            check_number(self.hangs, who, "hangs", least=0, most=1)
            check_one_of(self.reason, who, "reason", get_args(EndReason))


def _check_seconds(value: object, who: str, field: str) -> None:
    if not isinstance(value, Exponential | Uniform):
        check_number(value, who, field, least=0, also=" (seconds), an Exponential or a Uniform")
