"""Figures: the numbers that describe a system, for Prometheus's text format and OpenTelemetry's metrics."""

from __future__ import annotations

import threading
from collections import Counter, OrderedDict, defaultdict
from collections.abc import Iterable, Iterator, Mapping
from typing import Any

import msgspec

from rr_actors.registrar.model.recorded import Entry
from rr_actors.registrar.pages import LoadRow

HELP = {
    "rr_children": "Children of the supervisor tree, by state.",
    "rr_child_restarts": "Restarts of a child, as far as its supervisor remembers.",
    "rr_registrar_up": "Whether a registrar answers: 1 or 0.",
    "rr_registrar_resources": "Resources that a registrar serves.",
    "rr_registrar_queries": "Queries that a registrar holds.",
    "rr_registrar_loading": "Loads of a registrar that are in flight.",
    "rr_registrar_unheard": "Statuses that a registrar has not dealt with.",
    "rr_registrar_mailbox": "Messages and commands that a registrar has not decided yet.",
    "rr_registrar_commits_total": "Commits of a registrar's catalog since it was opened.",
    "rr_registrar_timed_commits_total": "Those of them that were timed: the ones during a recording.",
    "rr_registrar_commit_seconds_total": "Seconds that the timed commits took together.",
    "rr_server_loads_total": "Loads of a server since it was registered, also those that shared a resource.",
    "rr_server_shared_loads_total": "Those of them that shared a resource, which others had loaded or were loading.",
    "rr_server_waited_loads_total": "Those of them that were not answered at once.",
    "rr_server_waiting_loads": "Loads of a server that wait now.",
    "rr_server_load_failures_total": "Load callbacks of a server that raised.",
    "rr_server_load_callback_seconds_total": "Seconds that the load callbacks of a server took together.",
    "rr_server_load_callback_p95_seconds": "Time within which 95 % of a server's newest 500 load callbacks ended.",
    "rr_callback_failures_total": "Status callbacks that raised.",
    "rr_dead_letters_total": "Messages that reached nobody.",
    "rr_loads_total": "Loads that ended during a recording, by server and outcome.",
    "rr_load_seconds_total": "Seconds that these loads took together.",
    "rr_exits_total": "Ends of children during a recording, by reason.",
}
COUNTERS = frozenset(name for name in HELP if name.endswith("_total"))


class Figure(msgspec.Struct, frozen=True):
    """One measured value: its name, which is in HELP, the labels that say which thing it is about, and the number."""

    name: str
    labels: dict[str, str]
    value: float


class Counters:
    """Counts the loads and exits of recordings. The loop counts; any thread may read."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._began: OrderedDict[str, tuple[float, str]] = OrderedDict()
        self._loads: Counter[tuple[str, str]] = Counter()
        self._load_s: dict[tuple[str, str], float] = defaultdict(float)
        self._exits: Counter[tuple[str, str]] = Counter()

    def take(self, entries: Iterable[Entry]) -> None:
        """Count the loads and exits among the entries. On the loop."""
        with self._lock:
            for entry in entries:
                if entry.event == "sent" and entry.name == "Load":
                    self._began.setdefault(entry.query, (entry.at, entry.server))
                    if len(self._began) > _OPEN:
                        self._began.popitem(last=False)  # the oldest: its answer may never come
                elif entry.event == "received" and entry.name in ("Loaded", "LoadRefused"):
                    began = self._began.pop(entry.query, None)
                    if began is not None:
                        key = began[1], "loaded" if entry.name == "Loaded" else "failed"
                        self._loads[key] += 1
                        self._load_s[key] += max(0.0, entry.at - began[0])
                elif entry.event == "exited":
                    self._exits[entry.process, str(entry.facts.get("reason", ""))] += 1

    def figures(self) -> Iterator[Figure]:
        """Return the counts as figures. From any thread."""
        with self._lock:
            loads, load_s, exits = dict(self._loads), dict(self._load_s), dict(self._exits)
        for (server, outcome), count in loads.items():
            labels = {"server": server, "outcome": outcome}
            yield Figure("rr_loads_total", labels, count)
            yield Figure("rr_load_seconds_total", labels, load_s[server, outcome])
        for (path, reason), count in exits.items():
            yield Figure("rr_exits_total", {"path": path, "reason": reason}, count)


_OPEN = 100_000  # how many loads may wait for their answers


def figures_of(
    tree: Mapping[str, Any], registrars: Mapping[str, Mapping[str, Any]], servers: Iterable[LoadRow], dead: int
) -> Iterator[Figure]:
    """Return the figures of a moment.

    Args:
        tree: System.snapshot()["tree"].
        registrars: their stats(), by name; empty for a registrar that does not answer.
        servers: how often and how long loads of each server waited.
        dead: the number of dead letters.
    """
    states: Counter[str] = Counter()
    for node in _walk(tree):
        states["unavailable" if "error" in node else node.get("state", "running")] += 1
        if "restarts" in node:
            yield Figure("rr_child_restarts", {"path": node["path"]}, node["restarts"])
    yield from (Figure("rr_children", {"state": state}, count) for state, count in states.items())
    for name, stats in registrars.items():
        labels = {"registrar": name}
        yield Figure("rr_registrar_up", labels, 1 if stats else 0)
        for key, figure in _OF_STATS.items():
            if key in stats:
                yield Figure(figure, labels, stats[key] / 1e6 if key.endswith("_us") else stats[key])
    for row in servers:
        for field, figure in _OF_SERVERS.items():
            yield Figure(figure, {"server": row.server}, getattr(row, field))
    yield Figure("rr_dead_letters_total", {}, dead)


_OF_STATS = {
    "resources": "rr_registrar_resources",
    "queries": "rr_registrar_queries",
    "loading": "rr_registrar_loading",
    "unheard": "rr_registrar_unheard",
    "mailbox": "rr_registrar_mailbox",
    "commits": "rr_registrar_commits_total",
    "timed_commits": "rr_registrar_timed_commits_total",
    "commit_us": "rr_registrar_commit_seconds_total",
    "callback_failures": "rr_callback_failures_total",
}

_OF_SERVERS = {
    "loads": "rr_server_loads_total",
    "shared": "rr_server_shared_loads_total",
    "waited": "rr_server_waited_loads_total",
    "loading": "rr_server_waiting_loads",
    "failed": "rr_server_load_failures_total",
    "seconds": "rr_server_load_callback_seconds_total",
    "p95_s": "rr_server_load_callback_p95_seconds",
}


def _walk(node: Mapping[str, Any]) -> Iterator[Mapping[str, Any]]:
    yield node
    for child in node.get("children", ()):
        yield from _walk(child)


def prometheus_text(figures: Iterable[Figure]) -> str:
    """Return figures in Prometheus's text format, version 0.0.4 (`text/plain; version=0.0.4`)."""
    grouped: dict[str, list[Figure]] = {name: [] for name in HELP}
    for figure in figures:
        grouped.setdefault(figure.name, []).append(figure)
    lines: list[str] = []
    for name, group in grouped.items():
        if group:
            lines.append(f"# HELP {name} {HELP.get(name, name)}")
            lines.append(f"# TYPE {name} {'counter' if name in COUNTERS else 'gauge'}")
            lines += [f"{name}{_labels(figure.labels)} {_number(figure.value)}" for figure in group]
    return "\n".join(lines) + "\n"


def _labels(labels: Mapping[str, str]) -> str:
    if not labels:
        return ""
    return "{" + ",".join(f'{name}="{_escaped(value)}"' for name, value in labels.items()) + "}"


def _escaped(value: str) -> str:
    return value.replace("\\", "\\\\").replace('"', '\\"').replace("\n", "\\n")


def _number(value: float) -> str:
    return str(int(value)) if value == int(value) else repr(float(value))
