"""OpenTelemetry: timings as its spans, and a system's figures as its metrics. Imported only when they are used."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable

from opentelemetry.metrics import CallbackOptions, MeterProvider, Observation
from opentelemetry.sdk.resources import Resource
from opentelemetry.sdk.trace import ReadableSpan
from opentelemetry.trace import SpanContext, SpanKind, Status, StatusCode, TraceFlags

from rr_actors.system.recording.figures import COUNTERS, HELP, Figure
from rr_actors.system.recording.timings import Timing

_FRESH_S = 0.5  # a collection reads the instruments one after another: they share one reading of the figures
_KINDS = {"client": SpanKind.CLIENT, "server": SpanKind.SERVER}


def span_of(timing: Timing) -> ReadableSpan:
    """Return the span of a timing, with its process as the resource."""
    ended = timing.ended
    attributes = {"rr.registrar": timing.registrar, "rr.server": timing.server, "rr.query": timing.query}
    attributes |= {"rr.resource": timing.resource, "rr.unfinished": ended is None}
    failed = Status(StatusCode.ERROR, timing.error) if timing.error else Status(StatusCode.OK)
    return ReadableSpan(
        timing.name,
        context=_context(timing, timing.id),
        parent=_context(timing, timing.parent) if timing.parent else None,
        resource=Resource({"service.name": timing.process or timing.registrar, "process.pid": timing.pid}),
        attributes=attributes,
        kind=_KINDS[timing.kind],
        status=Status(StatusCode.UNSET) if ended is None else failed,
        start_time=_ns(timing.began),
        end_time=_ns(time.time() if ended is None else ended),
    )


def _context(timing: Timing, id: str) -> SpanContext:
    return SpanContext(int(timing.trace_id, 16), int(id, 16), is_remote=True, trace_flags=TraceFlags(1))


def _ns(seconds: float) -> int:
    return int(seconds * 1e9)


def register_metrics(figures: Callable[[], list[Figure]], provider: MeterProvider) -> None:
    """Make a meter of the provider read a system's figures at each collection.

    Args:
        figures: System.figures.
    """
    meter = provider.get_meter("rr_actors")
    latest: list[Figure] = []
    looked = -_FRESH_S

    def now() -> list[Figure]:
        nonlocal latest, looked
        if time.monotonic() - looked >= _FRESH_S:
            latest, looked = figures(), time.monotonic()
        return latest

    def observe(name: str) -> Callable[[CallbackOptions], Iterable[Observation]]:
        return lambda _options: [Observation(one.value, one.labels) for one in now() if one.name == name]

    for name, text in HELP.items():
        make = meter.create_observable_counter if name in COUNTERS else meter.create_observable_gauge
        make(name, [observe(name)], description=text)
