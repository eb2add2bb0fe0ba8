"""What needs attention: the rules as a table, and the command line over a running system."""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from pathlib import Path

import msgspec
import pytest

import rr_actors as rr
from rr_actors.registrar.pages import HolderRow, LoadRow, QueryRow, ResourceRow
from rr_actors.streams.stream import StreamInfo, StreamRow
from rr_actors.system.console.attention.attention_items import (
    AttentionItem,
    Choice,
    Fill,
    KeptThing,
    Known,
    PoolUse,
    Silences,
    counts_text,
    needs_attention,
)
from rr_actors.system.console.attention.attention_sources import callback_line
from rr_actors.system.console.console_messages import ChildRow
from rr_actors.system.recording.event_memory import Event
from support import eventually
from support_cli import run_cli

LEFT = "1 of 3 restarts are left (one_for_one, 3 in 5 s)"
NOW = 1_800_000_000.0
ROOT = ChildRow("root", 0, "supervisor", "running", strategy="one_for_one, 3 in 5 s", max_restarts=3, recent_restarts=2)


def resource(id: str, state: str, parts: list[str], holder: HolderRow) -> ResourceRow:
    return ResourceRow(
        id, "s/thing", f'"{id}"', "", "loaded", state, "unplugged" if not parts else "", 1, [holder], 1, [], 0,
        part_resources=parts,
    )  # fmt: skip


def died(path: str, ago_s: float) -> Event:
    return Event(0, NOW - ago_s, "exited", {"path": path, "reason": "killed", "detail": "SIGKILL"})


def child(state: str, note: str = "", error: str = "") -> ChildRow:
    return ChildRow("root/one", 1, "worker", state, note=note, error=error)


def waits(seconds: float, id: str = "") -> QueryRow:
    made = f"{int((NOW - seconds) * 1000):012x}79269bf4119f15b60dc0"
    return QueryRow(id or made, "app", "s/slow", "", "", '"y"', "pending", "OK")


def loads(p95_s: float) -> LoadRow:
    return LoadRow("s/slow", 9, 0, 9, 0, 1, p95_s, p95_s, p95_s, 9 * p95_s)


def stream(rate: float, best: float) -> StreamRow:
    return StreamRow(StreamInfo("r/images", "images", "s/camera", "r", rate, 0, 0, 0, 0.1, best), '"x"', 900, [])


TABLE = [
    ("nothing", Known(NOW, [ROOT]), []),
    ("one death", Known(NOW, [ROOT, child("running")], [died("root/one", 9)]), []),
    ("an old death", Known(NOW, [ROOT, child("running")], [died("root/one", 601), died("root/one", 9)]), []),
    (
        "two deaths",
        Known(NOW, [ROOT, child("running")], [died("root/one", 19), died("root/one", 9)]),
        [("WARNING", f"root/one died 2 times within 10 s, last of SIGKILL; {LEFT}")],
    ),
    (
        "given up",
        Known(NOW, [ROOT, child("stopped")], [died("root/one", 9)]),
        [("ERROR", "root/one is given up: SIGKILL")],
    ),
    (
        "stopped by hand",
        Known(NOW, [ROOT, child("stopped")], [Event(0, NOW, "stopped", {"path": "root/one", "reason": "shutdown"})]),
        [("WARNING", "root/one was stopped, and stays stopped until restart")],
    ),
    (
        "ended by itself, in order",
        Known(NOW, [ROOT, child("stopped")], [Event(0, NOW, "exited", {"path": "root/one", "reason": "normal"})]),
        [],
    ),
    (
        "frozen",
        Known(NOW, [ROOT, child("unavailable", error="stopped by a signal")]),
        [("ERROR", "root/one is frozen: stopped by a signal")],
    ),
    (
        "a wrong file",
        Known(NOW, [ROOT, child("running", note="keep.toml is wrong; it goes on with the last good one")]),
        [("WARNING", "root/one: keep.toml is wrong; it goes on with the last good one")],
    ),
    ("a load in time", Known(NOW, waiting=[waits(4)], loads=[loads(0)]), []),
    ("a load whose id has no time in it", Known(NOW, waiting=[waits(9, "0123abcd-mine")]), []),
    ("a load whose id is no UUIDv7", Known(NOW, waiting=[waits(9, "f81d4fae7dec41d0a76500a0c91e6bf6")]), []),
    ("a load that is usually slow", Known(NOW, waiting=[waits(50)], loads=[loads(6)]), []),
    (
        "a load that waits",
        Known(NOW, waiting=[waits(9)], loads=[loads(0)], standing={"s/slow": "a.py:7, in A.load"}),
        [("WARNING", 'a load of s/slow "y" has waited for 9 s; the callback stands in a.py:7, in A.load')],
    ),
    (
        "a load that is usually quick",
        Known(NOW, waiting=[waits(4)], loads=[loads(0.3)]),
        [("WARNING", 'a load of s/slow "y" has waited for 4 s, usually 0.3 s at most')],
    ),
    ("a pool with room", Known(NOW, pools=[PoolUse("root/b", "watts", 100, 90, 0)]), []),
    (
        "a full pool",
        Known(NOW, pools=[PoolUse("root/b", "watts", 100, 95, 2)]),
        [("WARNING", "pool watts has 95 % in use: 95 of 100; 2 loads wait for room")],
    ),
    (
        "a pool that gives more than it has",
        Known(NOW, pools=[PoolUse("root/b", "watts", 0, 5, 0)]),
        [("ERROR", "pool watts has more than all in use: 5 of 0")],
    ),
    (
        "kept",
        Known(NOW, kept=[KeptThing("root/k", "radio", 3, 2, "failing", "no link"), KeptThing("root/k", "x", 1, 1)]),
        [("WARNING", "radio has 2 of 3 replicas ready: failing: no link")],
    ),
    (
        "the second best",
        Known(NOW, choices=[Choice("root/c", "1", "range", "b", ("a", "b"))]),
        [("WARNING", "choice of range has b in place of a")],
    ),
    ("chosen by hand", Known(NOW, choices=[Choice("root/c", "1", "range", "b", ("a", "b"), by_hand="b")]), []),
    ("a stream as ever", Known(NOW, streams=[stream(15, 29), stream(15, 0)]), []),
    (
        "a slow stream",
        Known(NOW, streams=[stream(14, 29)]),
        [("WARNING", 'stream images of s/camera "x" gives 14 frames/s, gave 29')],
    ),
    (
        "a full mailbox",
        Known(NOW, mailboxes=[Fill("root/one", 51, 100), Fill("root/two", 50, 100)]),
        [("WARNING", "the mailbox of root/one has 51 messages, its limit is 100")],
    ),
    (
        "a full disk",
        Known(NOW, disks=[Fill("/a", 2**40 - 2**28, 2**40), Fill("/b", 2**40 - 2**31, 2**40)]),
        [("ERROR", "the disk of /a is nearly full: 256 MiB are free")],
    ),
]


@pytest.mark.parametrize(("known", "said"), [row[1:] for row in TABLE], ids=[row[0] for row in TABLE])
def test_each_rule(known: Known, said: list[tuple[str, str]]) -> None:
    assert [(item.severity, item.what) for item in needs_attention(known)] == said


def test_trouble_that_spreads_is_one_item_where_it_began() -> None:
    camera = resource("camera", "ERROR", [], HolderRow("q1", "maps", "map"))
    maps = resource("map", "ERROR", ["camera"], HolderRow("q2", "plans", "plan"))
    plan = resource("plan", "WARNING", ["map"], HolderRow("q3", "app", ""))
    lamp = resource("lamp", "FATAL", [], HolderRow("q4", "gui", ""))

    items = needs_attention(
        Known(NOW, troubled=[plan, maps, camera, lamp], troubled_total=9, began={"camera": NOW - 5})
    )

    assert [(item.name, item.severity, item.since, item.touches) for item in items[:2]] == [
        ('s/thing "lamp"', "FATAL", None, ("gui",)),
        ('s/thing "camera"', "ERROR", NOW - 5, ('s/thing "map"', 's/thing "plan"', "app")),
    ]
    assert items[1].what == 's/thing "camera" is in ERROR: unplugged; 2 resources above it are not well'
    assert items[2].what == "5 more resources are in WARNING, ERROR or FATAL"


def test_a_long_status_is_shortened_and_what_stands_on_it_is_said() -> None:
    lens = msgspec.structs.replace(
        resource("1" * 32, "ERROR", [], HolderRow("q", "app", "")), message="\N{BELL}" * 9_000
    )
    camera = resource("2" * 32, "ERROR", ["1" * 32], HolderRow("q", "app", ""))
    (item,) = needs_attention(Known(NOW, troubled=[lens, camera], troubled_total=2))
    assert len(item.what) == 500
    assert item.what.startswith(f"{lens.name} is in ERROR: ")
    assert item.what.endswith("; 1 resource above it is not well")


def test_a_ring_of_resources_in_trouble_is_shown() -> None:
    one = resource("one", "ERROR", ["two"], HolderRow("q1", "s", "two"))
    two = resource("two", "ERROR", ["one"], HolderRow("q2", "s", "one"))

    assert {item.resource for item in needs_attention(Known(NOW, troubled=[one, two]))} == {"one", "two"}


def test_the_line_of_the_callback_is_the_users_own() -> None:
    run = (
        'File "/x/rr_actors/registrar/servers/server_actor.py", line 415, in ServerActor._wrapped.<locals>.run\nanswer'
    )
    mine = 'File "/home/me/cameras.py", line 9, in Cameras.load_slow\ntime.sleep(30)'
    other = 'File "/home/me/cameras.py", line 20, in Cameras.load_map\nself.read()'

    assert callback_line([["idle"], [run, mine]], "map") == "cameras.py:9, in Cameras.load_slow: time.sleep(30)"
    assert callback_line([[run, other], [run, mine]], "slow") == "cameras.py:9, in Cameras.load_slow: time.sleep(30)"
    assert callback_line([[run, other], [run, mine]], "lamp") == ""
    assert callback_line([["idle"]], "slow") == ""


def test_a_silence_ends(monkeypatch: pytest.MonkeyPatch) -> None:
    silences = Silences()
    monkeypatch.setattr(time, "time", lambda: NOW)
    assert silences.add("a", 60) == NOW + 60
    silences.add("b", 60)
    silences.add("b", 0)
    assert silences.now() == {"a": NOW + 60}
    monkeypatch.setattr(time, "time", lambda: NOW + 60)
    assert silences.now() == {}


def test_the_head_counts_by_severity() -> None:
    items = [AttentionItem("1", "ERROR", "disk", "", ""), AttentionItem("2", "WARNING", "disk", "", "")]

    assert counts_text([]) == "all is well"
    assert counts_text([], ["x"]) == "all is well (1 silenced)"
    assert counts_text(items[:1]) == "1 needs attention: 1 ERROR"
    assert counts_text(items, ["x"]) == "2 need attention: 1 ERROR, 1 WARNING (1 silenced)"


class Cameras(rr.Manager):
    @rr.server("camera", recovery="keep")
    def load_camera(self, device: str) -> str:
        return device


@pytest.mark.usefixtures("runtime_dir")
def test_the_verb_shows_it_silences_it_and_has_an_exit_code(start: Callable[..., rr.System], state_dir: Path) -> None:
    system = start(rr.Supervisor([rr.ChildSpec(Cameras, id="cameras")]))
    query = system.open_registrar("app").load("cameras/camera", "front")
    well = run_cli("attention", "--state", str(state_dir))
    assert (well.returncode, well.stdout) == (0, "all is well\n")

    system.registrar("cameras").send_status(query.resource_id, rr.Status("ERROR", "unplugged"))

    def shown() -> bool:
        return "unplugged" in run_cli("attention", "--state", str(state_dir)).stdout

    eventually(shown)
    bad = run_cli("attention", "--state", str(state_dir), "--json")
    (item,) = json.loads(bad.stdout)["items"]
    assert bad.returncode == 1
    assert (item["severity"], item["resource"], item["touches"]) == ("ERROR", query.resource_id, ["app"])
    assert item["since"] is not None

    silenced = run_cli("attention", "--state", str(state_dir), "--silence", query.resource_id, "--for", "10m")
    assert silenced.returncode == 0, silenced.stderr
    quiet = run_cli("attention", "--state", str(state_dir))
    assert quiet.returncode == 0
    assert "all is well (1 silenced)" in quiet.stdout
    assert f"resource:{query.resource_id}" in quiet.stdout

    for wrong in (("x" * 20, "10m"), (query.resource_id, "10y"), (query.resource_id, "nan")):
        refused = run_cli("attention", "--state", str(state_dir), "--silence", wrong[0], "--for", wrong[1])
        assert refused.returncode == 2, refused
