"""rr_actors: an actor framework on multiprocessing, and on it a Resource Registrar.

Managers (processes or threads) serve resources, and consumers load them. Each resource is loaded once, shared, tracked
with its dependencies, and unloaded when its last consumer releases it. A supervisor tree restarts a manager that
crashed, with its catalog. README.md begins with an example, docs/tutorial.md continues.
"""

from __future__ import annotations

import sys as _sys

if _sys.platform != "linux":
    raise ImportError(f"rr_actors needs Linux, this is {_sys.platform}: run it in a Linux container or virtual machine")

if getattr(_sys, "frozen", False) and _sys.argv[1:2] == ["--rr-actors-fork-server"]:
    from rr_actors.supervision.frozen import become_fork_server

    become_fork_server()

from rr_actors.base import __version__ as __version__
from rr_actors.runtime.garbage import left_alone as _left_alone

with _left_alone():  # saves a tenth of the time: these objects stay until the process ends
    import importlib as _importlib
    import typing as _typing

    from rr_actors.actors.actor import IGNORE, Actor, ExitReport
    from rr_actors.actors.messaging.dead_letters import DeadLetter, DeadLetters
    from rr_actors.actors.messaging.exit_reports import Down
    from rr_actors.actors.monitors import Monitor, monitor
    from rr_actors.actors.refs import ActorDeadError, ActorRef
    from rr_actors.actors.timers import Timer, send_after
    from rr_actors.base.config import RegistrarConfig, SystemConfig
    from rr_actors.base.errors import (
        ActorUnavailable,
        AlreadyPresent,
        AlreadyStarted,
        CatalogDamaged,
        CatalogError,
        CatalogLocked,
        CatalogVersion,
        ChildRestarting,
        ChildRunning,
        CircularDependency,
        ConfigError,
        Frame,
        GraphError,
        InvalidName,
        InvalidRequest,
        InvalidResponse,
        InvalidSpec,
        LoadError,
        LoadFailed,
        LoadTimeout,
        MailboxFull,
        NameTaken,
        NotForDynamic,
        NotFound,
        NotHolder,
        NotRunning,
        NotSerializable,
        RegistrarDown,
        ResourceLost,
        RestartIntensityExceeded,
        RrError,
        StartFailed,
        SupervisionError,
        TooManyChildren,
        Unavailable,
        UnknownQuery,
        UnknownRegistrar,
        UnknownServer,
        UnloadFailed,
        UsageError,
    )
    from rr_actors.base.values.codecs import codec
    from rr_actors.hosting.streams import Publisher, Stream, StreamFrame, StreamInfo, StreamReader
    from rr_actors.registrar.declarations import Declared, server
    from rr_actors.registrar.engine.progress import Progress
    from rr_actors.registrar.engine.server import Current, current
    from rr_actors.registrar.engine.status import Status
    from rr_actors.registrar.load_groups import Queries
    from rr_actors.registrar.manager import Manager, ref
    from rr_actors.registrar.model.health import Health
    from rr_actors.registrar.model.rows import State
    from rr_actors.registrar.queries import Query, ResourceInfo
    from rr_actors.registrar.registrar import Registrar
    from rr_actors.supervision.core.rendering import Tree, render
    from rr_actors.supervision.core.specs import Backoff, ChildSpec, Supervisor
    from rr_actors.supervision.supervisor import Child, Counts, SupervisorRef
    from rr_actors.system.console.connected_client import Client, ClientQuery, ClientRegistrar, connect
    from rr_actors.system.event_subscribers import (
        ChildEvent,
        DeadLetterEvent,
        EndedEvent,
        Event,
        MissedEvent,
        ProgressEvent,
        ResourceEvent,
        StreamEvent,
    )
    from rr_actors.system.recording.recordings import Recording, read_recording
    from rr_actors.system.recording.traces import Trace
    from rr_actors.system.system import System

__all__ = [
    "IGNORE",
    "Action",
    "Actor",
    "ActorDeadError",
    "ActorRef",
    "ActorUnavailable",
    "AlreadyPresent",
    "AlreadyStarted",
    "Backoff",
    "CatalogDamaged",
    "CatalogError",
    "CatalogLocked",
    "CatalogVersion",
    "Child",
    "ChildEvent",
    "ChildRestarting",
    "ChildRunning",
    "ChildSpec",
    "CircularDependency",
    "Client",
    "ClientQuery",
    "ClientRegistrar",
    "ConfigError",
    "Counts",
    "Current",
    "DeadLetter",
    "DeadLetterEvent",
    "DeadLetters",
    "Declared",
    "Down",
    "EndedEvent",
    "Event",
    "ExitReport",
    "Frame",
    "GraphError",
    "GraphResult",
    "Health",
    "InvalidName",
    "InvalidRequest",
    "InvalidResponse",
    "InvalidSpec",
    "LoadError",
    "LoadFailed",
    "LoadTimeout",
    "MailboxFull",
    "Manager",
    "MissedEvent",
    "Monitor",
    "NameTaken",
    "NotForDynamic",
    "NotFound",
    "NotHolder",
    "NotRunning",
    "NotSerializable",
    "Progress",
    "ProgressEvent",
    "Publisher",
    "Queries",
    "Query",
    "Recording",
    "Registrar",
    "RegistrarConfig",
    "RegistrarDown",
    "ResourceEvent",
    "ResourceInfo",
    "ResourceLost",
    "RestartIntensityExceeded",
    "RrError",
    "StartFailed",
    "State",
    "Status",
    "Stream",
    "StreamEvent",
    "StreamFrame",
    "StreamInfo",
    "StreamReader",
    "SupervisionError",
    "Supervisor",
    "SupervisorRef",
    "System",
    "SystemConfig",
    "Timer",
    "TooManyChildren",
    "Trace",
    "Tree",
    "Unavailable",
    "UnknownQuery",
    "UnknownRegistrar",
    "UnknownServer",
    "UnloadFailed",
    "UsageError",
    "codec",
    "connect",
    "current",
    "monitor",
    "read_recording",
    "ref",
    "render",
    "run_graph",
    "send_after",
    "server",
]


def __dir__() -> list[str]:
    """Return the public names, which completion shows of the package."""
    return __all__


if _typing.TYPE_CHECKING:
    from rr_actors import managers as managers
    from rr_actors.managers import Action, GraphResult, run_graph
else:
    _OF_MANAGERS = {"Action", "GraphResult", "run_graph"}

    def __getattr__(name: str) -> object:
        """Import the ready-made managers when `rr.managers` or one of these names is asked for: most need none."""
        if name == "managers":
            return _importlib.import_module("rr_actors.managers")
        if name in _OF_MANAGERS:
            return getattr(_importlib.import_module("rr_actors.managers"), name)
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}", name=name, obj=_sys.modules[__name__])
