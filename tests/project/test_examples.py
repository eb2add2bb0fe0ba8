"""Every example runs, says what it should, and leaves nothing behind."""

from __future__ import annotations

from pathlib import Path

import pytest

from support import REPOSITORY, run_example

EXPECTED = {
    "first_resource": ["loaded: Feed(topic='/camera/dev/video0')", "unloaded: nothing is held any more"],
    "sharing": [
        "two holders, one camera: True, opened 1 time",
        "first leaves: camera stays open",
        "last leaves: camera closed",
    ],
    "dependencies": [
        "robot stands on: arm, lidar",
        "a robot with a broken part: LoadFailed",
        "  1. parts/part: ValueError: no part called 'warp drive'",
        "  2. robots/robot: ",
        "nothing of it is left: True",
        "unloaded: robot, lidar, arm",
    ],
    "status": [
        "app hears WARNING: battery low",
        "robot manager hears FATAL: lidar unplugged",
        "robot manager takes another lidar",
        "app hears nothing of that: True",
    ],
    "ping_pong": [
        "ping, pong, pong",
        "sequenceDiagram",
        "    participant p1 as root/ping",
        "    p1->>p2: ",
        "    p2-->>p1: ",
    ],
    "replacing": [
        "killed, with both lidars held",
        "the app hears UPDATE: /scan/spare",
        "lidar front is released",
        "the robot holds: spare",
        "lidar spare is released",
    ],
    "crash": [
        "killed, and back in another process: True",
        "the counter kept its place: True",
        "nothing was loaded twice: True",
    ],
    "camera": [
        "both have pictures of 307200 bytes: True",
        "display goes on with picture ",
        "recorder goes on with picture ",
    ],
    "brownout": [
        "100 W                radio, lamp, camera, map, arm",
        "the pump needs 40 W  camera, map, arm, pump",
        "at most 100 W were in use",
        "60 W                 arm, pump",
        "100 W again          camera, map, arm, pump",
    ],
    "keep": [
        "three are wanted   3 of 3",
        "one is killed      2 of 3  failing",
        "one is silent      2 of 3  failing",
        "one is wanted      1 of 1",
        "radio 0 ██··████████",
        "radio 1 ██████··██··",
        "radio 2 ██████████··",
    ],
    "generator": [
        "100 of 100 W, 0 W too much: arm, camera, lamp, radio",
        "140 of 140 W, 0 W too much: arm, camera, lamp, pump, radio",
        "140 of 140 W, 0 W too much: alarm, arm, camera, pump",
    ],
    "run_time_registration": ["twice 21 is 42", "it ran in another process: True", "after a respawn, twice 4 is 8"],
    "async_load": [
        "ten loads at once: [0, 1, 4, 9, 16, 25, 36, 49, 64, 81]",
        "one at a time they would have taken longer: True",
    ],
    "strategies": [
        "SIGKILL to b             a     b     c",
        "one_for_one              -   new     -",
        "one_for_all            new   new   new",
        "rest_for_one             -   new   new",
        "simple_one_for_one       -   new     -",
    ],
    "restart_storm": [
        "root/broken: exited abnormal",
        "root/broken: restarted",
        "4 restarts needed within 5 s, 3 allowed: it gives up",
        "root/innocent: stopped shutdown",
        "the supervisor has ended: shutdown",
        "the program hears it, too: RestartIntensityExceeded",
    ],
    "escalation": [
        "  root/base/wheel/motor: restarted",
        "  root/base/wheel: gives up",
        "  root/base/wheel: restarted",
        "  root/base: gives up",
        "  root/base: restarted",
        "   └─ wheel     supervisor",
    ],
    "hung_child": [
        "slow for two heartbeats, and still the same: True",
        "replaced by another process: True",
        "why: hung: its loop had not answered",
    ],
    "poisoned_message": [
        "one: ONE",
        "poison: no answer (ActorUnavailable)",
        "two: TWO",
        "three: nobody is there",
        "dead letters: [('root/parser', \"'three'\")]",
    ],
    "state_that_survives": [
        "before: pages, open printers: 2 ['laser', 'plotter']",
        "after:  pages, open printers: 1 ['laser', 'plotter']",
        "the same resource, not another one: True",
    ],
    "tell_and_ask": [
        "told three times, then asked: 30",
        "asked, and heard the error: only upward",
        "the actor lives, and has: 30",
        "told, and heard nothing",
        "the actor is another one, and has: 0",
    ],
    "bounded_buffer": ["has [4", "takes 4", "takes 3", "takes 2", "takes 1", "takes 0"],
    "philosophers": [
        "each takes the left fork first",
        "  refused: a ring of 3 forks",
        "  2 of 3 have eaten",
        "each takes the fork with the lower number first",
        "  3 of 3 have eaten",
    ],
    "token_ring": ["root/c is down: normal", "turns: 3 of a, 3 of b"],
    "state_machine": [
        "push: stays locked",
        "coin: unlocks",
        "coin: keeps the coin",
        "kick: unlocked: expected coin or push, got kick",
        "push: lets one through, and locks after 2 coins",
    ],
    "full_mailbox": ["waiting: 3 refused: [4, 5]", "asked, one after another: [4, 5]"],
    "dead_letter": [
        "hello, world",
        "the sender hears: root/greeter not found: it is stopped",
        "dead letter to root/greeter: 'is anybody there?'",
        "dead letters: 1",
    ],
    "monitors": [
        "root/a: normal",
        "root/b: abnormal (ValueError: no such device)",
        "root/c: killed",
        "root/d: shutdown",
        "root/a: noproc",
    ],
}

CRASHES = {"restart_storm", "monitors"}
"""Their actors raise, which is logged."""


@pytest.mark.parametrize("name", sorted(EXPECTED))
def test_the_example_runs_and_says_what_it_shows(name: str, tmp_path: Path) -> None:
    script = REPOSITORY / "examples" / f"{name}.py"
    said = run_example(tmp_path, script, limit_s=30, may_log_errors=name in CRASHES)
    lines = said.splitlines()
    for expected in EXPECTED[name]:
        assert any(line.startswith(expected) for line in lines), (expected, said)


IN_THREADS = ("async_load", "dependencies", "first_resource", "sharing", "status")
"""Those that kill no process: each runs in one process, too, with no other change."""

PROGRAM = """
import functools, runpy, sys
import rr_actors as rr

rr.ChildSpec = functools.partial(rr.ChildSpec, placement="thread")
runpy.run_path(sys.argv[1], run_name="__main__")
"""


@pytest.mark.parametrize("name", IN_THREADS)
def test_the_example_says_the_same_when_its_managers_are_threads(name: str, tmp_path: Path) -> None:
    said = run_example(tmp_path, "-c", PROGRAM, REPOSITORY / "examples" / f"{name}.py", limit_s=30)
    lines = said.splitlines()
    for expected in EXPECTED[name]:
        assert any(line.startswith(expected) for line in lines), (expected, said)


@pytest.mark.parametrize("name", sorted(EXPECTED))
def test_the_example_is_short_and_begins_with_what_it_shows(name: str) -> None:
    text = (REPOSITORY / "examples" / f"{name}.py").read_text()
    assert len(text.splitlines()) < 60
    assert text.startswith('"""')


ABOUT_MESSAGES = (
    "ping_pong", "bounded_buffer", "philosophers", "token_ring", "state_machine", "tell_and_ask", "full_mailbox",
    "dead_letter",
)  # fmt: skip


@pytest.mark.parametrize("name", ABOUT_MESSAGES)
def test_an_example_about_messages_has_at_most_thirty_lines_of_code(name: str) -> None:
    _, _, code = (REPOSITORY / "examples" / f"{name}.py").read_text().split('"""', 2)
    assert len([line for line in code.splitlines() if line.strip() and not line.lstrip().startswith("#")]) <= 30
