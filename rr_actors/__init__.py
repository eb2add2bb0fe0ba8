"""rr_actors: an actor framework on multiprocessing, and on it a Resource Registrar.

Managers (processes or threads) serve resources, and consumers load them. Each resource is loaded once, shared, tracked
with its dependencies, and unloaded when its last consumer releases it. A supervisor tree restarts a manager that
crashed, with its catalog. README.md begins with an example, docs/tutorial.md continues.
"""

from __future__ import annotations

import importlib as _importlib
import sys as _sys

if _sys.platform != "linux":
    raise ImportError(f"rr_actors needs Linux, this is {_sys.platform}: run it in a Linux container or virtual machine")

if getattr(_sys, "frozen", False) and _sys.argv[1:2] == ["--rr-actors-fork-server"]:
    from rr_actors.supervision.frozen import become_fork_server

    become_fork_server()

from rr_actors.base import __version__ as __version__
from rr_actors.runtime.garbage import left_alone as _left_alone

TYPE_CHECKING = False  # type checkers take it for true; to import that of typing takes as long as all else here

# Type checkers and freezers see these imports, and a frozen program runs them. Others import a module for a name that
# they use: see __getattr__ below, whose table has the same names.
if TYPE_CHECKING or getattr(_sys, "frozen", False):
    with _left_alone():
        from rr_actors.actors.actor import IGNORE, Actor, ExitReport
        from rr_actors.actors.actor_tables import TableColumn, table
        from rr_actors.actors.mailbox_refs import MailboxRef
        from rr_actors.actors.messaging.dead_letters import DeadLetter, DeadLetters
        from rr_actors.actors.messaging.exit_reports import Down
        from rr_actors.actors.messaging.mailbox_looks import MailboxInfo, MessageInfo
        from rr_actors.actors.monitors import Monitor, monitor
        from rr_actors.actors.refs import ActorDeadError, ActorRef
        from rr_actors.actors.timers import Timer, send_after
        from rr_actors.base.config import RegistrarConfig, SystemConfig
        from rr_actors.base.errors import (
            ActorUnavailable,
            AlreadyPresent,
            AlreadyStarted,
            AskFailed,
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
            HostUnreachable,
            InvalidName,
            InvalidRequest,
            InvalidResponse,
            InvalidSpec,
            LoadError,
            LoadFailed,
            LoadTimeout,
            MailboxFull,
            MissingDependency,
            NameTaken,
            NotExported,
            NotForDynamic,
            NotFound,
            NotHolder,
            NotRunning,
            NotSerializable,
            ProtocolMismatch,
            RegistrarDown,
            ResourceBusy,
            ResourceLost,
            RestartIntensityExceeded,
            RrError,
            StartFailed,
            SupervisionError,
            TooManyChildren,
            Unavailable,
            UnknownHost,
            UnknownQuery,
            UnknownRegistrar,
            UnknownServer,
            UnloadFailed,
            UsageError,
        )
        from rr_actors.base.values.codecs import codec
        from rr_actors.registrar.declarations import Declared, server
        from rr_actors.registrar.engine.progress import Progress
        from rr_actors.registrar.load_groups import Queries
        from rr_actors.registrar.manager import Manager, ref
        from rr_actors.registrar.model.health import Health
        from rr_actors.registrar.model.rows import State
        from rr_actors.registrar.queries import Query, ResourceInfo, Status, Subscription
        from rr_actors.registrar.registrar import Registrar
        from rr_actors.registrar.servers.callback_context import Current, current
        from rr_actors.streams.publisher import Publisher
        from rr_actors.streams.stream import Stream, StreamFrame, StreamInfo
        from rr_actors.streams.stream_file import RecordedStream
        from rr_actors.streams.stream_reader import StreamReader
        from rr_actors.supervision.core.rendering import Tree, render
        from rr_actors.supervision.core.specs import Backoff, ChildModel, ChildSpec, Exponential, Supervisor, Uniform
        from rr_actors.supervision.supervisor import Child, Counts, SupervisorRef
        from rr_actors.system.console.asking.connected_proxies import ConnectedProxy
        from rr_actors.system.console.connection import ConnectedQuery, ConnectedRegistrar, Connection, connect
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
        from rr_actors.system.hosts.host_settings import Export, Hosts
        from rr_actors.system.recording.recordings import Recording, read_recording
        from rr_actors.system.recording.stream_recordings import StreamRecording, read_stream, record_stream
        from rr_actors.system.recording.traces import Trace
        from rr_actors.system.simulated.simulated_runs import ChildOutcome, SimulatedRun, simulate
        from rr_actors.system.simulated.tree_experiments import TreeExperiment, experiment
        from rr_actors.system.snapshots import Preview
        from rr_actors.system.system import System
        from rr_actors.wire.name_service import HostInfo

if TYPE_CHECKING:
    from rr_actors import managers as managers
    from rr_actors.managers import Action, GraphResult, run_graph
    from rr_actors.managers.ros import ros2 as ros2
    from rr_actors.testing.started_systems import StartSystem

__all__ = [
    "IGNORE",
    "Action",
    "Actor",
    "ActorDeadError",
    "ActorRef",
    "ActorUnavailable",
    "AlreadyPresent",
    "AlreadyStarted",
    "AskFailed",
    "Backoff",
    "CatalogDamaged",
    "CatalogError",
    "CatalogLocked",
    "CatalogVersion",
    "Child",
    "ChildEvent",
    "ChildModel",
    "ChildOutcome",
    "ChildRestarting",
    "ChildRunning",
    "ChildSpec",
    "CircularDependency",
    "ConfigError",
    "ConnectedProxy",
    "ConnectedQuery",
    "ConnectedRegistrar",
    "Connection",
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
    "Exponential",
    "Export",
    "Frame",
    "GraphError",
    "GraphResult",
    "Health",
    "HostInfo",
    "HostUnreachable",
    "Hosts",
    "InvalidName",
    "InvalidRequest",
    "InvalidResponse",
    "InvalidSpec",
    "LoadError",
    "LoadFailed",
    "LoadTimeout",
    "MailboxFull",
    "MailboxInfo",
    "MailboxRef",
    "Manager",
    "MessageInfo",
    "MissedEvent",
    "MissingDependency",
    "Monitor",
    "NameTaken",
    "NotExported",
    "NotForDynamic",
    "NotFound",
    "NotHolder",
    "NotRunning",
    "NotSerializable",
    "Preview",
    "Progress",
    "ProgressEvent",
    "ProtocolMismatch",
    "Publisher",
    "Queries",
    "Query",
    "RecordedStream",
    "Recording",
    "Registrar",
    "RegistrarConfig",
    "RegistrarDown",
    "ResourceBusy",
    "ResourceEvent",
    "ResourceInfo",
    "ResourceLost",
    "RestartIntensityExceeded",
    "RrError",
    "SimulatedRun",
    "StartFailed",
    "StartSystem",
    "State",
    "Status",
    "Stream",
    "StreamEvent",
    "StreamFrame",
    "StreamInfo",
    "StreamReader",
    "StreamRecording",
    "Subscription",
    "SupervisionError",
    "Supervisor",
    "SupervisorRef",
    "System",
    "SystemConfig",
    "TableColumn",
    "Timer",
    "TooManyChildren",
    "Trace",
    "Tree",
    "TreeExperiment",
    "Unavailable",
    "Uniform",
    "UnknownHost",
    "UnknownQuery",
    "UnknownRegistrar",
    "UnknownServer",
    "UnloadFailed",
    "UsageError",
    "codec",
    "connect",
    "current",
    "experiment",
    "monitor",
    "read_recording",
    "read_stream",
    "record_stream",
    "ref",
    "render",
    "run_graph",
    "send_after",
    "server",
    "simulate",
    "table",
]


def __dir__() -> list[str]:
    """Return the public names, which completion shows of the package."""
    return __all__


if not TYPE_CHECKING:
    _NAMES = {
        "rr_actors.actors.actor": "Actor ExitReport IGNORE",
        "rr_actors.actors.actor_tables": "TableColumn table",
        "rr_actors.actors.mailbox_refs": "MailboxRef",
        "rr_actors.actors.messaging.dead_letters": "DeadLetter DeadLetters",
        "rr_actors.actors.messaging.exit_reports": "Down",
        "rr_actors.actors.messaging.mailbox_looks": "MailboxInfo MessageInfo",
        "rr_actors.actors.monitors": "Monitor monitor",
        "rr_actors.actors.refs": "ActorDeadError ActorRef",
        "rr_actors.actors.timers": "Timer send_after",
        "rr_actors.base.config": "RegistrarConfig SystemConfig",
        "rr_actors.base.values.codecs": "codec",
        "rr_actors.streams.publisher": "Publisher",
        "rr_actors.streams.stream": "Stream StreamFrame StreamInfo",
        "rr_actors.streams.stream_file": "RecordedStream",
        "rr_actors.streams.stream_reader": "StreamReader",
        "rr_actors.managers": "Action GraphResult run_graph",
        "rr_actors.registrar.declarations": "Declared server",
        "rr_actors.registrar.engine.progress": "Progress",
        "rr_actors.registrar.servers.callback_context": "Current current",
        "rr_actors.registrar.load_groups": "Queries",
        "rr_actors.registrar.manager": "Manager ref",
        "rr_actors.registrar.model.health": "Health",
        "rr_actors.registrar.model.rows": "State",
        "rr_actors.registrar.queries": "Query ResourceInfo Status Subscription",
        "rr_actors.registrar.registrar": "Registrar",
        "rr_actors.supervision.core.rendering": "Tree render",
        "rr_actors.supervision.core.specs": "Backoff ChildModel ChildSpec Exponential Supervisor Uniform",
        "rr_actors.supervision.supervisor": "Child Counts SupervisorRef",
        "rr_actors.system.console.asking.connected_proxies": "ConnectedProxy",
        "rr_actors.system.console.connection": "Connection ConnectedQuery ConnectedRegistrar connect",
        "rr_actors.system.event_subscribers": (
            "ChildEvent DeadLetterEvent EndedEvent Event MissedEvent ProgressEvent ResourceEvent StreamEvent"
        ),
        "rr_actors.system.hosts.host_settings": "Export Hosts",
        "rr_actors.system.recording.recordings": "Recording read_recording",
        "rr_actors.system.recording.stream_recordings": "StreamRecording read_stream record_stream",
        "rr_actors.system.recording.traces": "Trace",
        "rr_actors.system.simulated.simulated_runs": "ChildOutcome SimulatedRun simulate",
        "rr_actors.system.simulated.tree_experiments": "TreeExperiment experiment",
        "rr_actors.system.snapshots": "Preview",
        "rr_actors.system.system": "System",
        "rr_actors.wire.name_service": "HostInfo",
        "rr_actors.testing.started_systems": "StartSystem",
    }
    _MODULES = dict.fromkeys(__all__, "rr_actors.base.errors")  # but for these
    _MODULES |= {name: module for module, names in _NAMES.items() for name in names.split()}

    def __getattr__(name: str) -> object:
        """Import the module of a public name when that name is asked for: no program needs all of them.

        Raises:
            AttributeError: there is no such name.
            ImportError: its module cannot be imported.
        """
        if name == "managers":
            return _importlib.import_module("rr_actors.managers")
        if name == "ros2":
            return _importlib.import_module("rr_actors.managers.ros.ros2")
        if name not in _MODULES:
            raise AttributeError(
                f"module {__name__!r} has no attribute {name!r}", name=name, obj=_sys.modules[__name__]
            )
        where = _MODULES[name]
        try:
            if where not in _sys.modules:
                with _left_alone():  # saves a tenth of the time: these objects stay until the process ends
                    _importlib.import_module(where)
            module = _importlib.import_module(where)  # another thread may be importing it: this waits
        except AttributeError as error:  # which would say that there is no such name, and hasattr() would believe it
            raise ImportError(f"rr_actors.{name} cannot be imported: {error}", name=where) from error
        found = globals()[name] = getattr(module, name)
        return found
