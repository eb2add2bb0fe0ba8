"""Replaying: what real registrars decided, recorded in a file, is decided again; what is different is found."""

from __future__ import annotations

import json
import os
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgspec
import pytest

import rr_actors as rr
from rr_actors.base.errors import ConfigError
from rr_actors.registrar.core.decide import Item, decide
from rr_actors.registrar.decisions import deciding_again
from rr_actors.registrar.decisions.decided import Began, Decided
from rr_actors.registrar.engine import registrar_state
from rr_actors.registrar.model.catalog import Catalog, Decision
from rr_actors.registrar.model.effects import SendReply
from rr_actors.registrar.model.messages import Load, Loaded
from rr_actors.registrar.model.recorded import DECIDED, Entry
from rr_actors.system.console.console_feed import Reader
from rr_actors.system.console.console_messages import ANSWER_LIMIT_BYTES, BeginRecording, Entries
from rr_actors.system.rewound.decision_texts import facts_of, step_lines
from rr_actors.system.rewound.replaying import Replay, replay
from rr_actors.system.rewound.rewinding import rewind
from support import Served, Workshop, eventually, kill, wait_respawned
from support_cli import run_cli
from support_inside import actor_of, on_loop
from support_managers import Order, Shop

Start = Callable[..., rr.System]


@pytest.fixture
def shops(start: Start, workshop: Workshop) -> rr.System:
    """A system with two managers in processes of their own."""
    root = str(workshop.root)
    return start(rr.ChildSpec(Shop, id="robots", args=(root,)), rr.ChildSpec(Shop, id="lidars", args=(root,)))


@pytest.fixture
def recorded(app: rr.Registrar, system: rr.System, served: Served, tmp_path: Path) -> Path:
    """The file of a recording in which "app" loads and unloads a thing of "provider"."""
    with system.record(tmp_path / "run.jsonl", decisions=True):
        app.load("provider/thing", "y").unload()
    return tmp_path / "run.jsonl"


def decided(found: Replay, registrar: str) -> list[Decided]:
    return [step.what for step in found.steps.get(registrar, ()) if isinstance(step.what, Decided)]


def items_of(found: Replay, registrar: str) -> list[str]:
    return [type(item).__name__ for one in decided(found, registrar) for item, _ in one.items]


def test_what_real_processes_decided_is_decided_again_and_leads_to_what_they_know(
    shops: rr.System, tmp_path: Path
) -> None:
    """Loads with parts, a status, a kill within them, unloads; and a second recording that says what is known then."""
    app = shops.open_registrar("app")
    front = app.load("lidars/thing", Order("front"))
    with shops.record(tmp_path / "crash.jsonl", decisions=True) as recording:
        robot = app.load("robots/thing", Order("r2", ("lidars/thing:front", "lidars/thing:back")))
        shops.registrar("lidars").send_status(front.resource_id, rr.Status(rr.State.ERROR, "dust"))
        eventually(lambda: "SetStatus" in items_of(replay(recording), "lidars"), what="the status is in the file")
        wait_respawned(shops, "lidars", kill(shops, "lidars"))
        with shops.record(decisions=True):
            robot.unload()
            front.unload()
            again = app.load("lidars/thing", Order("front"))
        with shops.record(decisions=True) as last:
            again.unload()

    found = replay(tmp_path / "crash.jsonl")

    assert (found.differences, found.notes, recording.missed) == ([], [], 0)
    assert found.not_decided == []
    assert {"app", "robots", "lidars"} == set(found.steps)
    assert {"AskProvider", "Loaded", "Noticed", "Release", "Unloaded"} <= set(items_of(found, "app"))
    assert {"BeginAgain", "Register", "Load", "CallbackEnded", "SetStatus"} <= set(items_of(found, "lidars"))
    known = [step.what for steps in found.steps.values() for step in steps if isinstance(step.what, Began)]
    assert sum(one.again for one in known) >= 3, "the later recordings said what they knew, and it was compared"
    assert replay(last).differences == []


def test_every_load_of_such_a_recording_is_decided_and_none_goes_by_a_fast_path(
    system: rr.System, app: rr.Registrar, served: Served
) -> None:
    for request in ("x", "y"):
        app.load("provider/thing", request)  # by now there are lines, and there is what others can join
    with system.record(decisions=True) as recording:
        app.load("provider/thing", "x").unload()
    app.load("provider/thing", "x").unload()

    found = replay(recording)
    assert items_of(found, "provider") == ["Load", "Unload"]
    assert items_of(found, "app") == ["AskProvider", "Loaded", "Release", "Unloaded"]
    assert found.differences == []


def test_a_step_says_what_was_decided_what_it_changed_and_what_followed(recorded: Path) -> None:
    found = replay(recorded)
    (step,) = [step for step in found.of("provider") if items_of_step(step.what) == ["Load"]]

    assert [(change.table, change.before) for change in step.rows] == [("resources", None), ("queries", None)]
    text = "\n".join(step_lines(step))
    for words in ("Load from app", 'request: "y"', "resources", "phase: loading", "StartCallback", "role: load"):
        assert words in text
    ended = found.step("provider", step.number + 1)
    assert "phase loading → loaded" in "\n".join(step_lines(ended))
    assert json.loads(msgspec.json.encode(facts_of(step)))["items"][0]["item"]["request"] == '"y"'


def items_of_step(what: Began | Decided) -> list[str]:
    return [] if isinstance(what, Began) else [type(item).__name__ for item, _ in what.items]


# -- today's code is another -------------------------------------------------------------------------------------------


def test_where_todays_code_decides_in_another_way_is_found_and_said(
    recorded: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def twice(catalog: Catalog, items: list[Item]) -> Decision:
        decision = decide(catalog, items)
        for item, _ in items:
            if type(item) is Load:
                decision.cause(SendReply(item.origin, Loaded(item.query_id, "nothing", b"")))
        return decision

    monkeypatch.setattr(deciding_again, "decide", twice)
    found = replay(recorded)

    (step,) = found.differences
    assert (step.registrar, items_of_step(step.what)) == ("provider", ["Load"])
    (difference,) = step.differences
    assert (difference.of, difference.recorded, type(difference.today)) == ("effect", None, SendReply)
    assert [one.number for one in found.not_decided] == [one.number for one in found.of("provider")[step.number :]]
    ran = run_cli("replay", recorded)
    assert ran.returncode == 1
    assert "after a difference" in ran.stderr
    shown = run_cli("replay", recorded, "--different")
    assert (shown.returncode, shown.stdout.count("recorded: nothing")) == (1, 1)
    assert run_cli("replay", recorded, "app").returncode == 0


def test_a_defect_of_the_field_is_seen_and_that_it_is_mended(
    system: rr.System, app: rr.Registrar, served: Served, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fails(catalog: Catalog, items: list[Item]) -> Decision:
        if type(items[0][0]) is Load:
            raise ZeroDivisionError("of the field")
        return decide(catalog, items)

    with monkeypatch.context() as patch, system.record(decisions=True) as recording:
        patch.setattr(registrar_state, "decide", fails)
        with pytest.raises(rr.RrError):
            app.load("provider/thing", "y", timeout_s=10.0)
    (step,) = replay(recording).differences
    assert (step.differences[0].of, step.differences[0].today) == ("error", None)
    assert step.differences[0].recorded == "ZeroDivisionError: of the field"

    monkeypatch.setattr(deciding_again, "decide", fails)
    assert replay(recording).differences == []


# -- what could not be written, what is missing ------------------------------------------------------------------------


def test_a_decision_that_could_not_be_written_is_undone_again_and_refused_again(
    system: rr.System, app: rr.Registrar, provider: rr.Registrar, served: Served, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(_changes: Any) -> None:
        raise rr.CatalogError("disk full", path="")

    with system.record(decisions=True) as recording:
        with monkeypatch.context() as patch:
            patch.setattr(actor_of(provider).commits.store, "commit", full)
            with pytest.raises(rr.RrError, match="disk full"):
                app.load("provider/thing", "y")
        app.load("provider/thing", "y").unload()
        with system.record(decisions=True):
            app.load("provider/thing", "x").unload()

    found = replay(recording)
    assert [one.end for one in decided(found, "provider")][:2] == ["undone", "refused"]
    assert (found.differences, found.not_decided) == ([], [])


def test_a_catalog_that_is_read_again_begins_anew(
    system: rr.System, app: rr.Registrar, provider: rr.Registrar, served: Served
) -> None:
    with system.record(decisions=True) as recording:
        app.load("provider/thing", "y").unload()
        provider.load_catalog()
        app.load("provider/thing", "y").unload()

    found = replay(recording)
    assert sum(isinstance(step.what, Began) for step in found.of("provider")) == 2
    assert (found.differences, found.not_decided) == ([], [])


def test_a_registrar_that_is_closed_and_opened_again_begins_anew(system: rr.System, served: Served) -> None:
    with system.record(decisions=True) as recording:
        for _ in range(2):
            guest = system.open_registrar("guest")
            guest.load("provider/thing", "y").unload()
            guest.close()

    found = replay(recording)
    assert sum(isinstance(step.what, Began) for step in found.of("guest")) == 2
    assert (found.differences, found.not_decided, found.notes) == ([], [], [])


def lines_of(path: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in path.read_text().splitlines()]


def written(path: Path, lines: list[dict[str, Any]]) -> Path:
    path.write_text("".join(json.dumps(line) + "\n" for line in lines))
    return path


def of_decisions(line: dict[str, Any]) -> bool:
    return line.get("event") == DECIDED and line["registrar"] == "provider"


def test_decisions_after_missing_ones_are_not_decided_again(recorded: Path, tmp_path: Path) -> None:
    lines = lines_of(recorded)
    places = [place for place, line in enumerate(lines) if of_decisions(line)]
    del lines[places[1]]

    found = replay(written(tmp_path / "gap.jsonl", lines))

    assert found.differences == []
    assert found.notes == ["provider: 1 decision is missing before its step 2"]
    assert [step.registrar for step in found.not_decided] == ["provider"] * (len(places) - 2)
    del lines[places[0]]
    assert {step.is_decided for step in replay(written(tmp_path / "late.jsonl", lines)).of("provider")} == {False}


def test_a_note_of_many_parts_is_read_as_a_whole_or_is_missing(
    system: rr.System, app: rr.Registrar, served: Served, tmp_path: Path
) -> None:
    with system.record(tmp_path / "long.jsonl", decisions=True):
        app.load("provider/thing", os.urandom(150_000).hex()).unload()
    lines = lines_of(tmp_path / "long.jsonl")
    parts = [place for place, line in enumerate(lines) if of_decisions(line) and line["facts"]["parts"] > 1]
    assert len(parts) > 2
    assert replay(tmp_path / "long.jsonl").differences == []

    del lines[parts[1]]
    found = replay(written(tmp_path / "gap.jsonl", lines))
    assert found.differences == []
    assert "missing" in found.notes[0]


def spoiled(lines: list[dict[str, Any]], **facts: Any) -> list[dict[str, Any]]:
    place = next(place for place, line in enumerate(lines) if of_decisions(line))
    return [*lines[:place], lines[place] | {"facts": lines[place]["facts"] | facts}, *lines[place + 1 :]]


@pytest.mark.parametrize(
    ("facts", "why"),
    [
        ({"note": "AAAA"}, "damaged"),
        ({"note": 7}, "Expected `str`, got `int`"),
        ({"number": "first"}, "Expected `int`, got `str`"),
        ({"note": "eJyb4JOfmKIAAAbNAf4="}, "damaged"),
    ],
)
def test_a_damaged_decision_is_named(recorded: Path, tmp_path: Path, facts: dict[str, Any], why: str) -> None:
    damaged = written(tmp_path / "damaged.jsonl", spoiled(lines_of(recorded), **facts))
    with pytest.raises(ConfigError, match=rf"damaged\.jsonl: the decisions in it cannot be read: .*{why}"):
        replay(damaged)
    ran = run_cli("replay", damaged)
    assert (ran.returncode, "Traceback" in ran.stderr) == (2, False)


def test_a_file_that_a_crash_has_cut_is_replayed_to_its_last_whole_line(recorded: Path, tmp_path: Path) -> None:
    whole = recorded.read_bytes()
    (tmp_path / "cut.jsonl").write_bytes(whole[: len(whole) - 40])
    found = replay(tmp_path / "cut.jsonl")
    assert (found.differences, found.not_decided) == ([], [])


# -- beside the other uses of a recording ------------------------------------------------------------------------------


def test_a_recording_without_decisions_says_how_to_record_them(system: rr.System, tmp_path: Path) -> None:
    with system.record(tmp_path / "quiet.jsonl"):
        pass
    with pytest.raises(ConfigError, match=r"quiet\.jsonl: it has no decisions: .*--decisions"):
        replay(tmp_path / "quiet.jsonl")


def test_other_recordings_at_the_same_time_have_no_decisions(
    system: rr.System, app: rr.Registrar, served: Served
) -> None:
    with system.record() as other, system.record(decisions=True) as recording:
        app.load("provider/thing", "y").unload()
    assert (other.decisions(), other.missed) == ([], 0)
    assert {entry.event for entry in recording.decisions()} == {DECIDED}
    assert [(entry.event, entry.name) for entry in recording.entries()] == [
        (entry.event, entry.name) for entry in other.entries()
    ]


def test_rewinding_and_tracing_pass_decisions_over(recorded: Path, tmp_path: Path) -> None:
    without = written(tmp_path / "without.jsonl", [one for one in lines_of(recorded) if one.get("event") != DECIDED])
    for verb in ("trace", "timeline", "sequence"):
        assert run_cli(verb, recorded).stdout == run_cli(verb, without).stdout
    assert [step.changes for step in rewind(recorded).steps] == [step.changes for step in rewind(without).steps]


def test_a_recording_in_memory_can_be_replayed_and_saved(
    system: rr.System, app: rr.Registrar, served: Served, tmp_path: Path
) -> None:
    with system.record(decisions=True) as recording:
        app.load("provider/thing", "y").unload()
    recording.save(tmp_path / "saved.jsonl")
    assert replay(tmp_path / "saved.jsonl").steps == replay(recording).steps


@pytest.mark.parametrize("wrong", [1, "yes", None])
def test_decisions_are_wanted_or_not(system: rr.System, wrong: Any) -> None:
    with pytest.raises(rr.UsageError, match="record: decisions: expected True or False"):
        system.record(decisions=wrong)


# -- the commands ------------------------------------------------------------------------------------------------------


def test_a_system_of_another_process_is_recorded_with_its_decisions(
    system: rr.System, app: rr.Registrar, served: Served, state_dir: Path, tmp_path: Path
) -> None:
    file = tmp_path / "live.jsonl"
    ran: list[Any] = []
    words = ("record", file, "--decisions", "--state", state_dir)
    thread = threading.Thread(target=lambda: ran.append(run_cli(*words)))
    thread.start()
    level = actor_of(app).watched.level
    eventually(lambda: level[0] >= 4, what="the recording has begun")
    app.load("provider/thing", "y").unload()

    eventually(lambda: '"name":"Unloaded"' in file.read_text(), what="the answer is in the file")
    system.stop()
    thread.join(30)

    assert ran[0].returncode == 0
    found = replay(file)
    assert "Load" in items_of(found, "provider")
    assert (found.differences, found.not_decided) == ([], [])


def test_long_notes_fit_into_the_frames_of_a_console() -> None:
    frames: list[bytes] = []
    reader = Reader(BeginRecording(decisions=True), frames.append, lambda: None)
    note = {"number": 1, "part": 1, "parts": 1, "note": "n" * 65_536}
    entries = [Entry(1.0, DECIDED, seq, registrar="app", facts=note) for seq in range(200)]
    reader.take(entries, 0)
    reader.flush()

    sent = [msgspec.msgpack.decode(frame[4:], type=Entries) for frame in frames]
    assert [entry for part in sent for entry in part.entries] == entries
    assert max(map(len, frames)) <= ANSWER_LIMIT_BYTES


def test_the_command_counts_lists_and_shows(recorded: Path) -> None:
    counted = run_cli("replay", recorded)
    assert counted.returncode == 0
    assert [line.split()[0] for line in counted.stdout.splitlines()] == ["registrar", "app", "provider"]
    listed = run_cli("replay", recorded, "provider").stdout
    assert 'Load thing "y" from app' in listed
    shown = run_cli("replay", recorded, "provider", "--step", 1).stdout
    assert shown.startswith("step 1 of provider")
    facts = [json.loads(line) for line in run_cli("replay", recorded, "provider", "--json").stdout.splitlines()]
    assert [one["step"] for one in facts] == list(range(1, len(facts) + 1))


@pytest.mark.parametrize(
    ("words", "why"),
    [
        (("nobody",), "no decision of a registrar 'nobody'; it has those of app, provider"),
        (("provider", "--step", "0"), "step: expected a number from 1 to"),
        (("provider", "--step", "999"), "step: expected a number from 1 to"),
        (("--step", "1"), "expected the name of a registrar before --step"),
        (("provider", "--step", "1", "--different"), "expected one of --step and --different"),
    ],
)
def test_what_cannot_be_shown_is_said(recorded: Path, words: tuple[str, ...], why: str) -> None:
    ran = run_cli("replay", recorded, *words)
    assert (ran.returncode, why in ran.stderr) == (2, True), ran.stderr


def test_no_recording_of_decisions_is_left_on_behind_its_end(system: rr.System, app: rr.Registrar) -> None:
    level = actor_of(app).watched.level
    with system.record(decisions=True):
        first = level[0]
        with system.record(decisions=True):
            assert level[0] not in (first, 0)
        assert level[0] == first
    assert level[0] == 0


def test_what_cannot_be_noted_ends_no_registrar(
    system: rr.System, app: rr.Registrar, provider: rr.Registrar, served: Served, caplog: pytest.LogCaptureFixture
) -> None:
    actor = actor_of(provider)
    with system.record(decisions=True) as recording:
        on_loop(provider, lambda: actor.catalog.chased.__setitem__("\ud800", "half a character"))
        app.load("provider/thing", "y").unload()
        on_loop(provider, actor.catalog.chased.clear)
        app.load("provider/thing", "y").unload()
    assert "a decision could not be recorded" in caplog.text
    assert replay(recording).differences == []
