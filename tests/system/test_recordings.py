"""Recordings: what happened in several processes, joined into one trace, drawn, exported and written to a file."""

from __future__ import annotations

import itertools
import resource
import stat
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgspec
import pytest
from opentelemetry.sdk.metrics import MeterProvider
from opentelemetry.sdk.metrics.export import InMemoryMetricReader
from opentelemetry.sdk.trace.export.in_memory_span_exporter import InMemorySpanExporter
from opentelemetry.trace import SpanKind, StatusCode

import rr_actors as rr
from rr_actors.base.errors import ConfigError, LoadError, NotFound, UsageError
from rr_actors.registrar.engine.node import Node
from rr_actors.registrar.links import recorder
from rr_actors.registrar.model.recorded import Entry
from rr_actors.system.console.console_connection import ConsoleConnection, find_console
from rr_actors.system.console.console_messages import Entries
from rr_actors.system.event_subscribers import Subscribers
from rr_actors.system.recording import figures, recordings
from rr_actors.system.recording.figures import Counters, Figure, prometheus_text
from rr_actors.system.recording.otel_export import register_metrics
from rr_actors.system.recording.recordings import LIMIT, Recording, RecordingFile, add
from rr_actors.system.recording.sequence_diagrams import sequence_of
from rr_actors.system.recording.traces import trace_of
from rr_actors.wire.unix_link import UnixLink
from support import Calls, Gate, Workshop, eventually, quickly, serve, wait_gone
from support_inside import node_of
from support_managers import Order, Shop

Start = Callable[..., rr.System]


@pytest.fixture
def shops(start: Start, workshop: Workshop) -> rr.System:
    """A system with two managers in processes of their own, `robots` and `lidars`."""
    root = str(workshop.root)
    return start(*(rr.ChildSpec(Shop, id=name, args=(root,)) for name in ("robots", "lidars")))


def names(trace: rr.Trace) -> list[str]:
    """What the entries of a trace say, in a word each: "app>robots Load", "robots load began"."""
    return [
        f"{entry.registrar}>{entry.peer} {entry.name}"
        if entry.event == "sent"
        else f"{entry.registrar} {entry.name} {entry.event}"
        for entry in trace.entries
        if entry.event in ("sent", "began", "ended")
    ]


def wait_recorded(recording: Recording, what: Any, *expected: str) -> None:
    """Return when the trace has these entries: each process sends its own, and may need long on a busy machine."""

    def arrived() -> bool:
        try:
            return set(expected) <= set(names(recording.trace(what)))
        except NotFound:
            return False

    eventually(arrived, what=f"{expected} recorded")


LOAD_WITH_A_PART = [
    "app>robots Load",
    "robots load began",
    "robots>lidars Load",
    "lidars load began",
    "lidars load ended",
    "lidars>robots Loaded",
    "robots load ended",
    "robots>app Loaded",
]

# -- one trace -------------------------------------------------------------------------------------------------------


def test_a_load_its_dependency_its_callbacks_and_the_answers_are_one_trace_over_three_processes(
    shops: rr.System,
) -> None:
    app = shops.open_registrar("app")
    with shops.record() as recording:
        query = app.load("robots/thing", Order("r2", ("lidars/thing:front",)))
        app.load("robots/thing", Order("other"))
        wait_recorded(recording, query, *LOAD_WITH_A_PART)
    trace = recording.trace(query)

    assert names(trace) == LOAD_WITH_A_PART
    assert {entry.pid for entry in trace.entries} >= {shops.ref("robots").pid, shops.ref("lidars").pid}
    assert {entry.process for entry in trace.entries if entry.pid} == {"root", "root/robots", "root/lidars"}
    assert recording.missed == 0


def test_a_load_of_what_is_loaded_has_its_own_messages_and_not_the_callback_of_the_first(shops: rr.System) -> None:
    app, other = shops.open_registrar("app"), shops.open_registrar("other")
    with shops.record() as recording:
        first = app.load("robots/thing", Order("r2"))
        second = other.load("robots/thing", Order("r2"))
        wait_recorded(recording, second, "other>robots Load", "robots>other Loaded")

    assert names(recording.trace(second)) == ["other>robots Load", "robots>other Loaded"]
    assert "robots load began" in names(recording.trace(first))
    assert set(names(recording.trace(first.resource_id))) >= {"other>robots Load", "app>robots Load"}


class Preempted(rr.Manager):
    """Its loop loses the processor for a moment whenever it has sent an answer."""

    def on_start(self) -> None:
        send_now = UnixLink.send_now

        def send_and_wait(self: UnixLink, message: Any) -> None:
            send_now(self, message)
            time.sleep(0.02)

        UnixLink.send_now = send_and_wait

    @rr.server("thing")
    def load(self, request: str) -> str:
        return request


def test_an_answer_is_sent_before_it_is_received(start: Start) -> None:
    system = start(rr.ChildSpec(Preempted, id="preempted"))
    app = system.open_registrar("app")
    app.load("preempted/thing", "x")
    with system.record() as recording:
        query = app.load("preempted/thing", "x")
        wait_recorded(recording, query, "preempted>app Loaded")
    trace = recording.trace(query)

    assert [(entry.registrar, entry.event, entry.name) for entry in trace.entries] == [
        ("app", "sent", "Load"),
        ("preempted", "received", "Load"),
        ("preempted", "sent", "Loaded"),
        ("app", "received", "Loaded"),
    ]


def test_a_load_that_joins_one_in_flight_has_the_callback_that_it_waits_for(
    system: rr.System, app: rr.Registrar, provider: rr.Registrar, gate: Gate
) -> None:
    serve(provider, "thing", load=gate)
    other = system.open_registrar("other")
    with system.record() as recording:
        first = app.load("provider/thing", "x", block=False)
        gate.wait_arrived()
        second = other.load("provider/thing", "x", block=False)
        eventually(lambda: provider.resources()[0].queries[1:])
        gate.open()
        first.get()
        joined = second.get()

    assert "provider load began" in names(recording.trace(joined))
    assert "app>provider Load" not in names(recording.trace(joined))


def test_an_unload_and_a_status_are_in_the_trace_of_their_query(shops: rr.System) -> None:
    app = shops.open_registrar("app")
    statuses = Calls()
    with shops.record() as recording:
        query = app.load("robots/thing", Order("r2", ("lidars/thing:front",)), on_status=statuses)
        (front,) = shops.registrar("lidars").resources()
        shops.registrar("lidars").send_status(front.id, rr.Status("WARNING", "dirty"))
        statuses.wait()
        query.unload()
        wait_recorded(recording, query, "app>robots Unload", "robots>app Unloaded", "lidars unload ended")
    heard = names(recording.trace(query))

    assert heard.index("lidars>robots Noticed") < heard.index("robots status began") < heard.index("robots>app Noticed")
    assert heard.index("app>robots Unload") < heard.index("robots unload began") < heard.index("robots>app Unloaded")
    assert "lidars unload ended" in heard


def test_a_callback_that_raises_ends_with_its_error_and_the_load_is_refused(
    system: rr.System, app: rr.Registrar, provider: rr.Registrar
) -> None:
    def fail(_request: str) -> None:
        raise ValueError("no such device \udcff")  # half a character

    serve(provider, "thing", load=fail)
    with system.record() as recording, pytest.raises(LoadError):
        app.load("provider/thing", "x")
    (id,) = {entry.query for entry in recording.entries() if entry.name == "LoadRefused"}
    trace = recording.trace(id[:30])

    assert [entry.detail for entry in trace.entries if entry.event == "ended"] == ["ValueError: no such device \\udcff"]
    assert "LoadRefused" in trace.sequence()


def test_the_death_of_a_manager_in_the_middle_of_a_load_is_in_the_trace(shops: rr.System, workshop: Workshop) -> None:
    app = shops.open_registrar("app")
    workshop.shut("load r2")
    with shops.record() as recording:
        loading = app.load("robots/thing", Order("r2"), block=False)
        eventually(lambda: any(entry.event == "began" for entry in recording.entries()))
        ref = shops.ref("robots")
        pid = ref.pid
        ref.kill()
        assert pid is not None
        wait_gone(pid)
        workshop.open("load r2")
        query = loading.get(timeout=30)
        eventually(lambda: any(entry.event == "restarted" for entry in recording.entries()))
        wait_recorded(recording, query, "robots load ended")
    trace = recording.trace(query)
    diagram = trace.sequence()

    assert [entry.event for entry in trace.entries if entry.event in ("exited", "restarted")] == ["exited", "restarted"]
    assert names(trace).count("robots load began") == 2
    assert "SIGKILL" in diagram
    assert f"pid {shops.ref('robots').pid}" in diagram


# -- pictures --------------------------------------------------------------------------------------------------------


def entry(at: float, event: str, registrar: str, peer: str, name: str, **more: Any) -> Entry:
    return Entry(at, event, registrar=registrar, peer=peer, name=name, seq=int(at * 1000), **more)


def test_a_message_is_one_arrow_whoever_recorded_it_and_one_that_did_not_arrive_ends_in_a_cross() -> None:
    lines = (
        trace_of(
            [
                entry(1.0, "sent", "app", "cams", "Load", query="abcd1", server="cams/cam"),
                entry(1.001, "received", "cams", "app", "Load", query="abcd1", server="cams/cam"),
                entry(1.002, "sent", "cams", "app", "Loaded", query="abcd1", resource="abcd1"),
                entry(1.003, "received", "app", "cams", "Loaded", query="abcd1", resource="abcd1"),
                entry(1.004, "sent", "app", "cams", "Unload", query="abcd1"),
            ],
            "abcd1",
        )
        .sequence()
        .splitlines()
    )

    assert lines == [
        "sequenceDiagram",
        "    participant p0 as app",
        "    participant p1 as cams",
        "    p0->>p1: 0.0 ms: Load cams/cam",
        "    p1-->>p0: 2.0 ms: Loaded",
        "    p0-xp1: 4.0 ms: Unload (no record of its arrival)",
    ]


def test_a_question_has_arrived_if_it_was_answered_before_it_was_asked_again() -> None:
    def cross(*names: str) -> list[str]:
        entries = [
            entry(float(number), "received" if "ed" in name else "sent", "app", "cams", name, query="abcd1")
            for number, name in enumerate(names)
        ]
        return [
            line.partition(": ")[2] for line in sequence_of(entries).splitlines() if "no record of its arrival" in line
        ]

    assert cross("Load", "Loaded") == []
    assert cross("Load", "Load", "LoadRefused") == ["0.0 ms: Load (no record of its arrival)"]
    assert cross("Load", "Unloaded", "Unload") == [
        "0.0 ms: Load (no record of its arrival)",
        "2000.0 ms: Unload (no record of its arrival)",
    ]


def test_a_request_has_arrived_if_a_callback_for_it_began_later() -> None:
    def crosses(*entries: Entry) -> int:
        return sequence_of(entries).count("no record of its arrival")

    load = entry(1.0, "sent", "app", "cams", "Load", query="abcd1", server="cams/cam")
    died = Entry(1.1, "exited", registrar="cams", seq=1100)
    runs = entry(1.2, "began", "cams", "", "load", resource="abcd1", server="cams/cam", detail="attempt 2")

    assert crosses(load, died, runs) == 0
    assert "load cams/cam begins, attempt 2" in sequence_of([load, died, runs])
    assert crosses(load, died) == 1
    assert crosses(load, died, msgspec.structs.replace(load, at=1.15), runs) == 1, "the second one has arrived"
    assert crosses(load, msgspec.structs.replace(runs, resource="abcd2")) == 1
    assert crosses(load, msgspec.structs.replace(runs, registrar="maps")) == 1
    assert crosses(load, msgspec.structs.replace(runs, name="unload")) == 1


def test_a_diagram_of_many_messages_without_an_answer_takes_no_longer_for_each() -> None:
    def drawn() -> float:
        many = [
            Entry(n / 1e4, "sent", seq=n, registrar="a", peer="b", name="Noticed", query=str(n)) for n in range(20_000)
        ]
        began = time.thread_time()
        assert "19,000 more entries" in sequence_of(many)
        return time.thread_time() - began

    quickly(drawn, 1.0)


def test_a_label_has_nothing_that_mermaid_would_read_as_its_own() -> None:
    odd = 'a;b#c<i>\nparticipant x %% "q" {}'
    diagram = trace_of([entry(1.0, "sent", "app", "cams", "Load", query="abcd", detail=odd)], "abcd").sequence()

    assert len(diagram.splitlines()) == 4
    assert "a#59;b#35;c#lt;i#gt; participant x #37;#37; #quot;q#quot; #123;#125;" in diagram


def test_an_id_that_is_unknown_or_begins_several_is_refused_by_name() -> None:
    entries = [entry(1.0, "sent", "app", "cams", "Load", query=query) for query in ("abcd1", "abcd2")]

    with pytest.raises(UsageError, match="several ids begin so: abcd1, abcd2"):
        trace_of(entries, "abcd")
    with pytest.raises(NotFound, match="'ffff': the recording has no query, resource or message"):
        trace_of(entries, "ffff")


# -- OpenTelemetry ---------------------------------------------------------------------------------------------------


def test_spans_have_their_parents_in_other_processes(shops: rr.System) -> None:
    app = shops.open_registrar("app")
    with shops.record() as recording:
        query = app.load("robots/thing", Order("r2", ("lidars/thing:front",)))
        wait_recorded(recording, query, *LOAD_WITH_A_PART)
    exporter = InMemorySpanExporter()
    exporter.export(recording.trace(query).spans())
    spans: dict[str, Any] = {span.name: span for span in exporter.get_finished_spans()}
    chain = ["load robots/thing", "callback load robots/thing", "load lidars/thing", "callback load lidars/thing"]
    places = [(spans[name].resource.attributes["service.name"], spans[name].kind) for name in chain]

    assert list(spans) == chain
    assert {f"{span.context.trace_id:032x}" for span in spans.values()} == {query.id}
    assert spans[chain[0]].parent is None
    for above, below in itertools.pairwise(chain):
        assert spans[below].parent.span_id == spans[above].context.span_id
        assert spans[above].start_time <= spans[below].start_time <= spans[below].end_time <= spans[above].end_time
    assert places == [
        ("root", SpanKind.CLIENT),
        ("root/robots", SpanKind.SERVER),
        ("root/robots", SpanKind.CLIENT),
        ("root/lidars", SpanKind.SERVER),
    ]


def test_a_refused_load_is_a_span_with_an_error(system: rr.System, app: rr.Registrar, provider: rr.Registrar) -> None:
    def fail(_request: str) -> None:
        raise ValueError("no such device")

    serve(provider, "thing", load=fail)
    with system.record() as recording, pytest.raises(LoadError):
        app.load("provider/thing", "x")
    (id,) = {entry.query for entry in recording.entries() if entry.name == "LoadRefused"}
    load, callback = recording.trace(id).spans()

    assert (load.status.status_code, callback.status.status_code) == (StatusCode.ERROR, StatusCode.ERROR)
    assert "no such device" in load.status.description


def test_metrics_have_loads_restarts_mailboxes_and_commit_times(shops: rr.System) -> None:
    app = shops.open_registrar("app")
    reader = InMemoryMetricReader()
    register_metrics(shops.figures, MeterProvider([reader]))
    with shops.record():
        app.load("robots/thing", Order("r2"))
        shops.ref("lidars").kill()
        eventually(lambda: [one for one in shops.figures() if one.name == "rr_exits_total"])
        eventually(lambda: [one for one in shops.figures() if one.name == "rr_child_restarts" and one.value == 1])
    data: Any = reader.get_metrics_data()
    found = {
        (metric.name, *sorted(point.attributes.values())): point.value
        for metric in data.resource_metrics[0].scope_metrics[0].metrics
        for point in metric.data.data_points
    }

    assert found["rr_loads_total", "loaded", "robots/thing"] == 1
    assert found["rr_child_restarts", "root/lidars"] == 1
    assert found["rr_registrar_mailbox", "robots"] == 0
    assert found["rr_registrar_timed_commits_total", "robots"] >= 1
    assert found["rr_registrar_commit_seconds_total", "robots"] > 0
    assert found["rr_exits_total", "killed", "root/lidars"] == 1


def test_loads_are_counted_however_many_before_were_never_answered(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(figures, "_OPEN", 10)
    counters = Counters()
    counters.take(entry(1.0, "sent", "app", "cams", "Load", query=str(n), server="cams/cam") for n in range(20))
    counters.take([entry(2.0, "received", "app", "cams", "Loaded", query="19")])

    assert [one.value for one in counters.figures() if one.name == "rr_loads_total"] == [1]


def test_figures_are_prometheus_text(shops: rr.System) -> None:
    text = prometheus_text([*shops.figures(), Figure("rr_registrar_up", {"registrar": 'a"\\\nb'}, 0.5)])

    assert '# TYPE rr_children gauge\nrr_children{state="running"} 3\n' in text
    assert "# TYPE rr_registrar_commits_total counter\n" in text
    assert 'rr_registrar_up{registrar="a\\"\\\\\\nb"} 0.5\n' in text
    assert all(line.startswith("#") or len(line.rsplit(" ", 1)) == 2 for line in text.splitlines())


# -- bounds ----------------------------------------------------------------------------------------------------------


def test_nobody_records_by_default_and_after_the_last_has_stopped(system: rr.System) -> None:
    watched = node_of(system).watched
    assert watched.level[0] <= 1
    with system.record() as one, system.record() as two:
        assert watched.level[0] > 1
        one.stop()
        assert watched.level[0] > 1
    two.stop()

    assert watched.level[0] <= 1
    assert not watched


def test_of_a_bounded_recording_the_oldest_entries_go_first_and_are_counted(
    system: rr.System, app: rr.Registrar, provider: rr.Registrar, tmp_path: Path
) -> None:
    serve(provider, "thing")
    with system.record(limit=5) as recording:
        for number in range(5):
            app.load("provider/thing", number)
    entries = recording.entries()

    recording.save(tmp_path / "saved.jsonl")
    read = rr.read_recording(tmp_path / "saved.jsonl")

    assert len(entries) == 5
    assert recording.missed > 5
    assert (read.entries(), read.missed) == (entries, recording.missed)
    assert entries[-1].name == "Loaded"
    assert LIMIT == 100_000


def test_what_a_process_has_no_room_for_is_counted(
    system: rr.System, app: rr.Registrar, provider: rr.Registrar, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    serve(provider, "thing")
    monkeypatch.setattr(recorder, "KEPT", 1)
    with system.record() as recording, system.record(tmp_path / "one.jsonl") as filed:
        app.load("provider/thing", "x")

    assert recording.missed >= 1
    assert rr.read_recording(tmp_path / "one.jsonl").missed == filed.missed == recording.missed


@pytest.mark.parametrize("limit", [0, -1, 1.5, "many", True])
def test_a_limit_that_is_none_is_refused(system: rr.System, limit: Any) -> None:
    with pytest.raises(UsageError, match="limit: expected a whole number above 0"):
        system.record(limit=limit)


def test_a_system_that_does_not_run_is_not_recorded(state_dir: Path) -> None:
    with pytest.raises(UsageError, match="not running"):
        rr.System([], state_dir=state_dir).record()


def test_a_recording_outlives_its_system(start: Start) -> None:
    system = start()
    with system.record() as recording:
        app, provider = system.open_registrar("app"), system.open_registrar("provider")
        serve(provider, "thing")
        query = app.load("provider/thing", "x")
        system.stop()

    assert "app>provider Load" in names(recording.trace(query))


@pytest.mark.parametrize("name", [None, "one.jsonl"])
def test_a_recording_ends_with_its_system_and_a_restart_does_not_take_it_up(
    start: Start, tmp_path: Path, name: str | None
) -> None:
    system = start()
    recording = system.record(None if name is None else tmp_path / name)
    serve(system.open_registrar("provider"), "thing")
    query = system.open_registrar("app").load("provider/thing", "x")
    system.stop()
    before = recording.entries()
    system.start()
    assert not node_of(system).watched
    serve(system.open_registrar("provider"), "thing")
    app = system.open_registrar("app")
    app.load("provider/thing", "y")
    again = app.load("provider/thing", "z")
    recording.stop()

    assert "app>provider Load" in names(recording.trace(query))
    assert recording.entries() == before
    assert again.response


def test_what_records_or_listens_within_the_package_harms_nothing_by_raising(
    start: Start, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    attend, attending = Subscribers.attend, list[Subscribers]()

    def noted(subscribers: Subscribers, node: Node) -> None:
        attending.append(subscribers)
        attend(subscribers, node)

    monkeypatch.setattr(Subscribers, "attend", noted)
    system = start()
    (subscribers,) = attending
    app, provider = system.open_registrar("app"), system.open_registrar("provider")

    def fail(_event: dict[str, Any]) -> None:
        raise ValueError("a defect")

    heard = Calls()
    ends = [subscribers.listen(fail, records=True), subscribers.listen(fail), system.subscribe(heard)]
    serve(provider, "thing")
    app.load("provider/thing", "x")

    assert app.load("provider/thing", "y").response
    eventually(lambda: [event["event"] for event in heard] == ["loaded", "loaded"])
    assert "an event was not delivered" in caplog.text
    for end in ends:
        end()


# -- files -----------------------------------------------------------------------------------------------------------


def test_a_recording_to_a_file_goes_on_when_all_workers_are_busy_and_so_does_every_registrar(
    start: Start, tmp_path: Path
) -> None:
    system, gate = start(config=rr.SystemConfig(workers_limit=2)), Gate()
    app, provider = system.open_registrar("app"), system.open_registrar("provider")
    serve(provider, "slow", load=gate)
    serve(provider, "thing")
    with system.record(tmp_path / "one.jsonl") as recording:
        waiting = [app.load("provider/slow", number, block=False) for number in range(2)]
        gate.wait_arrived(2)
        with pytest.raises(LoadError):  # there is no thread for its callback
            app.load("provider/thing", "x")
        gate.open()
        assert [reply.get(timeout=30).request for reply in waiting] == [0, 1]
        query = app.load("provider/thing", "y")

    assert "provider load began" in names(recording.trace(query))
    assert recording.missed == 0


def test_a_disk_that_is_slow_holds_up_nobody_and_what_there_is_no_room_for_is_counted(
    system: rr.System, app: rr.Registrar, provider: rr.Registrar, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    disk, write = Gate(), RecordingFile.write

    def slow(file: RecordingFile, entries: list[Entry], missed: int) -> None:
        disk()
        write(file, entries, missed)

    monkeypatch.setattr(RecordingFile, "write", slow)
    monkeypatch.setattr(recordings, "WAITING", 5)
    serve(provider, "thing")
    everything = system.record()
    with system.record(tmp_path / "one.jsonl") as recording:
        app.load("provider/thing", "first")
        disk.wait_arrived()
        for number in range(10):
            app.load("provider/thing", number)
        eventually(lambda: recording.missed > 10)
        eventually(lambda: sum(e.event == "received" and e.name == "Loaded" for e in everything.entries()) == 11)
        disk.open()
    everything.stop()

    read = rr.read_recording(tmp_path / "one.jsonl")
    assert len(recording) + recording.missed == len(everything)
    assert len(recording)
    assert (len(read), read.missed) == (len(recording), recording.missed)


@pytest.mark.parametrize("error", [OSError(28, "No space left on device"), ValueError("a defect")])
def test_what_could_not_be_written_is_logged_once_and_stop_says_so_also_after_its_system(
    start: Start, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture, error: Exception
) -> None:
    def fail(_file: RecordingFile, _entry: Entry) -> bytes:
        raise error

    system = start()
    monkeypatch.setattr(RecordingFile, "_line", fail)
    app, provider = system.open_registrar("app"), system.open_registrar("provider")
    serve(provider, "thing")
    recording = system.record(tmp_path / "one.jsonl")
    app.load("provider/thing", "x")
    system.stop()

    assert caplog.text.count("the recording ends here") == 1
    with pytest.raises(ConfigError, match=f"not all of the recording was written: .*{error.args[-1]}"):
        recording.stop()
    recording.stop()


def test_a_recording_in_a_file_is_private_and_read_as_it_was(
    system: rr.System, app: rr.Registrar, provider: rr.Registrar, tmp_path: Path
) -> None:
    serve(provider, "thing")
    file = tmp_path / "one.jsonl"
    with system.record(file) as recording:
        query = app.load("provider/thing", "x")
    copy = tmp_path / "two.jsonl"
    recording.save(copy)

    assert stat.S_IMODE(file.stat().st_mode) == 0o600
    assert rr.read_recording(file).trace(query.id).entries == recording.trace(query).entries
    assert rr.read_recording(copy).entries() == recording.entries()
    assert rr.read_recording(file).system == "system"


def test_a_file_that_is_there_is_not_overwritten(system: rr.System, tmp_path: Path) -> None:
    file = tmp_path / "mine.jsonl"
    file.write_text("mine")

    with pytest.raises(ConfigError, match="there is a file already"):
        system.record(file)
    assert file.read_text() == "mine"


@pytest.mark.parametrize(("free", "says"), [(10, "cannot be written: .*too large; make room"), (200, "not all of")])
def test_a_recording_that_the_disk_has_no_room_for_is_not_saved_by_half(tmp_path: Path, free: int, says: str) -> None:
    recording = Recording("system")
    add(recording, [entry(1.0, "sent", "app", "cams", "Load", query="abcd1") for _ in range(1000)])
    file = tmp_path / "one.jsonl"
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (free, before[1]))
    try:
        with pytest.raises(ConfigError, match=f"one.jsonl: {says}"):
            recording.save(file)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)

    recording.save(file)
    assert len(rr.read_recording(file)) == 1000


def test_a_file_is_read_to_its_last_whole_line_and_refused_where_it_is_damaged(tmp_path: Path) -> None:
    whole = Recording("system")
    add(whole, [entry(1.0, "sent", "app", "cams", "Load", query="abcd1"), entry(2.0, "exited", "", "", "")])
    file = tmp_path / "whole.jsonl"
    whole.save(file)
    lines = file.read_bytes().splitlines(keepends=True)
    cut, damaged, foreign, uncounted = (tmp_path / name for name in ("cut", "damaged", "foreign", "uncounted"))
    cut.write_bytes(b"".join(lines)[:-5])
    damaged.write_bytes(lines[0] + b"nonsense\n" + lines[1])
    foreign.write_bytes(b'{"recording": 99, "system": "x", "at": 1.0}\n')
    uncounted.write_bytes(lines[0] + b'{"at": 1.0, "event": "missed", "facts": {"count": -1}}\n')

    assert len(rr.read_recording(cut).entries()) == 1
    with pytest.raises(ConfigError, match="line 2: expected what rr-actors record writes"):
        rr.read_recording(damaged)
    with pytest.raises(ConfigError, match="version 99"):
        rr.read_recording(foreign)
    with pytest.raises(ConfigError, match='line 2: "missed": expected a whole number as "count"'):
        rr.read_recording(uncounted)
    with pytest.raises(ConfigError, match="cannot be read"):
        rr.read_recording(tmp_path / "missing")


def test_of_an_entry_that_is_too_long_for_a_line_the_facts_are_left_out(tmp_path: Path) -> None:
    whole = Recording("system")
    long = Entry(1.0, "exited", detail="ValueError", facts={"traceback": "x" * recordings.LINE_LIMIT})
    add(whole, [long, Entry(2.0, "restarted")])

    whole.save(tmp_path / "long.jsonl")

    exited, restarted = rr.read_recording(tmp_path / "long.jsonl").entries()
    assert exited.detail == "ValueError"
    assert "over the limit" in exited.facts["lost"]
    assert restarted.event == "restarted"


# -- from another process --------------------------------------------------------------------------------------------


def test_a_console_hears_what_is_recorded_and_only_while_it_listens(shops: rr.System, state_dir: Path) -> None:
    app = shops.open_registrar("app")
    watched = node_of(shops).watched
    heard = Calls()
    connection = ConsoleConnection(find_console(state_dir))
    parts = connection.record()

    def read() -> None:
        for part in parts:
            if isinstance(part, Entries):
                for one in part.entries:
                    heard(one)

    thread = threading.Thread(target=read)
    thread.start()
    eventually(lambda: watched.level[0] > 1)
    query = app.load("robots/thing", Order("r2"))
    ends = {("app", "received", "Loaded"), ("robots", "ended", "load"), ("robots", "sent", "Loaded")}
    eventually(lambda: ends <= {(one.registrar, one.event, one.name) for one in heard})
    connection.close()
    thread.join()
    eventually(lambda: watched.level[0] <= 1)
    entries = list(heard)

    assert [one.seq for one in entries] == list(range(1, len(entries) + 1))
    assert "robots load began" in names(trace_of(sorted(entries, key=lambda one: one.at), query.id))
    assert msgspec.json.decode(msgspec.json.encode(entries[0]), type=Entry) == entries[0]
