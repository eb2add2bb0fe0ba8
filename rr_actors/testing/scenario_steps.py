"""The steps of a scenario: what check_manager() does with a manager, one step after another.

`which` counts the resources that are held, the oldest first, and begins again at their end. A step that finds nothing
to act on does nothing. `kill_at` is where the manager's process gets SIGKILL: before the line of the callback with this
number, as Python runs them, counted from 0; or at the end of a callback that runs fewer lines. The callback's own file
counts, and no other. None: nowhere.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar


@dataclass(frozen=True)
class Step:
    """The base of all steps."""

    role: ClassVar[str] = ""
    """The name of the callback that the step runs, and in which it may kill; "" for none."""


@dataclass(frozen=True)
class Load(Step):
    """A request is loaded, and held."""

    role: ClassVar[str] = "load"
    server: str
    request: Any
    kill_at: int | None = None


@dataclass(frozen=True)
class Unload(Step):
    """A resource is released."""

    role: ClassVar[str] = "unload"
    which: int = 0
    kill_at: int | None = None


@dataclass(frozen=True)
class LoadTogether(Step):
    """Several requests are loaded at the same time, and held: their load callbacks run at once."""

    role: ClassVar[str] = "load"
    server: str
    requests: tuple[Any, ...]


@dataclass(frozen=True)
class UnloadTogether(Step):
    """All that is held is released at the same time: the unload callbacks run at once."""

    role: ClassVar[str] = "unload"


@dataclass(frozen=True)
class SendStatus(Step):
    """The manager hears a status of a resource of its own: OK, WARNING or ERROR."""

    role: ClassVar[str] = "status"
    which: int = 0
    state: str = "WARNING"
    kill_at: int | None = None


@dataclass(frozen=True)
class Fatal(Step):
    """A resource is FATAL, and its request is loaded again: two resources of one request are held then."""

    which: int = 0


@dataclass(frozen=True)
class Update(Step):
    """The response of a resource is sent to its holders again."""

    role: ClassVar[str] = "status"
    which: int = 0
    kill_at: int | None = None


@dataclass(frozen=True)
class Reload(Step):
    """A resource is unloaded and loaded again, for the same holders."""

    which: int = 0


@dataclass(frozen=True)
class Pause(Step):
    """All holders have a resource on standby. For a server with idle="pause"."""

    role: ClassVar[str] = "pause"
    which: int = 0
    kill_at: int | None = None


@dataclass(frozen=True)
class Resume(Step):
    """A resource that is on standby is needed again."""

    role: ClassVar[str] = "resume"
    which: int = 0
    kill_at: int | None = None


@dataclass(frozen=True)
class AskUsage(Step):
    """The manager says what its resources use now."""

    role: ClassVar[str] = "usage"
    kill_at: int | None = None


@dataclass(frozen=True)
class Kill(Step):
    """The manager's process gets SIGKILL while no callback runs. With `kill_at` its next one does, in a recovery."""

    role: ClassVar[str] = "recover"
    kill_at: int | None = None


@dataclass(frozen=True)
class Wrong(Step):
    """A request is loaded that the manager is expected to refuse."""

    server: str
    request: Any


STEPS = (
    Load,
    Unload,
    LoadTogether,
    UnloadTogether,
    SendStatus,
    Fatal,
    Update,
    Reload,
    Pause,
    Resume,
    AskUsage,
    Kill,
    Wrong,
)
