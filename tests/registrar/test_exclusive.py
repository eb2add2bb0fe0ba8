"""Exclusive servers: one holder at a time, and a line of those who wait."""

from __future__ import annotations

import asyncio
import threading
import time
from collections.abc import Callable, Iterator
from typing import Any

import pytest

import rr_actors as rr
from support import Calls, Gate, eventually, kill, serve, wait_respawned
from support_cli import run_cli

Start = Callable[..., rr.System]
LIMIT_S = 30.0
IN_LINE_S = 3.0
"""The limit of a load whose time is over in line: it has to be there by then, on a busy machine, too."""


class Scopes(rr.Manager):
    """Serves instruments that one script at a time may use."""

    def on_start(self) -> None:
        self.log: list[str] = []

    def seen(self) -> list[str]:
        return self.log

    @rr.server("scope", recovery="keep", exclusive=True, grace_s=20.0)
    def open_scope(self, name: str) -> str:
        self.log.append(f"opens {name}")
        return f"/dev/{name}"

    @open_scope.unload
    def close_scope(self, name: str, response: str) -> None:
        self.log.append(f"closes {name}")

    @rr.server("slow", recovery="keep", exclusive=True)
    def open_slow(self, name: str) -> str:
        if "opens slow" in self.log:
            rr.current().stopping.wait()
        self.log.append("opens slow")
        return f"/dev/{name}"

    @rr.server("warm", recovery="keep", exclusive=True, linger_s=60.0)
    def open_warm(self, name: str) -> str:
        self.log.append(f"opens {name}")
        return f"/dev/{name}"

    @rr.server("brief", recovery="keep", exclusive=True, grace_s=0.05)
    def open_brief(self, name: str) -> str:
        return f"/dev/{name}"


class Said(list[str]):
    """What a load that waits hears of its place."""

    def __call__(self, progress: rr.Progress) -> None:
        self.append(progress.text)


@pytest.fixture
def system(rr_system: Start) -> rr.System:
    return rr_system([rr.ChildSpec(Scopes, id="scopes", placement="thread")])


@pytest.fixture
def people(system: rr.System) -> Iterator[tuple[rr.Registrar, ...]]:
    opened = tuple(system.open_registrar(name) for name in ("anna", "ben", "cara", "dora"))
    yield opened
    for registrar in opened:
        registrar.close()


def test_the_others_wait_by_priority_and_then_in_the_order_in_which_they_came(people: Any) -> None:
    anna, ben, cara, dora = people
    first = anna.load(Scopes.open_scope, "bench", priority=5)
    heard = {who.name: Said() for who in (ben, cara, dora)}
    waiting = {}
    for who, priority in ((ben, 0), (cara, 0), (dora, 5)):
        progress = heard[who.name]
        options = {"priority": priority, "progress": progress, "timeout_s": LIMIT_S}
        waiting[who.name] = who.load(Scopes.open_scope, "bench", block=False, **options)
        assert eventually(lambda progress=progress: progress)
    assert eventually(lambda: heard["cara"][-1] == "3rd in line, behind ben; anna has it")
    assert eventually(lambda: heard["ben"][-1] == "2nd in line, behind dora; anna has it")
    assert heard["dora"][0] == "1st in line; anna has it"

    has = first
    for name in ("dora", "ben", "cara"):
        assert not waiting[name].done()
        has.unload()
        has = waiting[name].get(timeout=LIMIT_S)
    assert has.response == "/dev/bench"


def test_each_holder_has_it_opened_anew_and_another_request_is_another_line(system: rr.System, people: Any) -> None:
    anna, ben, *_ = people
    with anna.load(Scopes.open_scope, "bench"), ben.load(Scopes.open_scope, "roof"):
        waits = ben.load(Scopes.open_scope, "bench", block=False)
    waits.get(timeout=LIMIT_S).unload()
    seen = system.ref("scopes").proxy().seen().get()
    assert [line for line in seen if "bench" in line] == ["opens bench", "closes bench"] * 2


def test_what_its_server_keeps_warm_is_handed_to_the_next(system: rr.System, people: Any) -> None:
    anna, ben, *_ = people
    first = anna.load(Scopes.open_warm, "bench")
    waits = ben.load(Scopes.open_warm, "bench", block=False)
    first.unload()
    with waits.get(timeout=LIMIT_S) as second:
        assert (second.response, second.resource_id) == ("/dev/bench", first.resource_id)
    with anna.load(Scopes.open_warm, "bench", wait_s=0):  # nobody has it
        assert system.ref("scopes").proxy().seen().get() == ["opens bench"]


@pytest.mark.parametrize("wait_s", [0, 0.05])
def test_a_load_that_may_not_wait_says_who_has_it_since_when(system: rr.System, people: Any, wait_s: float) -> None:
    anna, ben, cara, _ = people
    with anna.load(Scopes.open_scope, "bench"):
        waits = cara.load(Scopes.open_scope, "bench", block=False)
        assert eventually(lambda: _count(system) == 2)
        says = r"^scopes/scope with 'bench': anna has it, and 1 waits for it; "
        with pytest.raises(rr.ResourceBusy, match=says) as info:
            ben.load(Scopes.open_scope, "bench", wait_s=wait_s)
        busy = info.value
        assert (busy.holder, busy.waiting, busy.server) == ("anna", 1, "scopes/scope")
        assert busy.since is not None
        assert [frame.origin for frame in busy.trace] == ["scopes/scope"]
        assert _count(system) == 2  # it has left nothing
    waits.get(timeout=LIMIT_S).unload()


@pytest.mark.parametrize("way", ["a thread", "a second load of a thread", "a future", "a task"])
def test_a_load_whose_time_is_over_in_line_says_who_has_it_since_when(people: Any, way: str) -> None:
    anna, ben, *_ = people
    before = time.time()
    with anna.load(Scopes.open_scope, "bench"):
        if way == "a second load of a thread":
            ben.load(Scopes.open_scope, "roof").unload()
            ben.load(Scopes.open_scope, "roof").unload()
        says = r"^scopes/scope: not loaded .* the load is 1st in line; anna has it \(asked for it .* s ago\); "
        ways = {
            "a future": lambda: ben.load(Scopes.open_scope, "bench", timeout_s=IN_LINE_S, block=False).get(),
            "a task": lambda: asyncio.run(ben.load_async(Scopes.open_scope, "bench", timeout_s=IN_LINE_S)),
        }
        with pytest.raises(rr.LoadTimeout, match=says) as info:
            ways.get(way, lambda: ben.load(Scopes.open_scope, "bench", timeout_s=IN_LINE_S))()
        assert info.value.holder == "anna"
        assert info.value.since is not None
        assert before - 1 <= info.value.since <= time.time()


def test_a_load_whose_time_is_over_in_its_turn_names_no_holder(people: Any) -> None:
    anna, ben, *_ = people
    first, said = anna.load(Scopes.open_slow, "bench"), Said()
    waits = ben.load(Scopes.open_slow, "bench", block=False, timeout_s=2 * IN_LINE_S, progress=said)
    assert eventually(lambda: said)
    first.unload()
    with pytest.raises(rr.LoadTimeout, match="its load callback") as info:
        waits.get()
    assert (info.value.holder, info.value.since) == ("", None)
    assert said == ["1st in line; anna has it"]


def test_a_load_that_is_given_up_leaves_the_line(system: rr.System, people: Any) -> None:
    anna, ben, cara, _ = people
    first = anna.load(Scopes.open_scope, "bench")
    with pytest.raises(rr.LoadTimeout):
        ben.load(Scopes.open_scope, "bench", timeout_s=0.05)
    waits = cara.load(Scopes.open_scope, "bench", block=False)
    first.unload()
    waits.get(timeout=LIMIT_S).unload()
    assert eventually(lambda: not _count(system))


def test_a_more_urgent_load_asks_the_holder_for_it(people: Any) -> None:
    anna, ben, *_ = people
    heard = Calls()
    first = anna.load(Scopes.open_scope, "bench", on_status=heard)
    with ben.load(Scopes.open_scope, "bench", priority=1, timeout_s=LIMIT_S):
        status = first.wait_status("FATAL", timeout_s=LIMIT_S)
        assert (status.reason, status.deadline_s) == ("revoked", 20.0)
        assert status.message == "ben waits for it with priority 1; its holder has priority 0"
        assert not anna.queries()


def test_a_priority_that_changes_asks_the_holder_too(system: rr.System, people: Any) -> None:
    anna, ben, *_ = people
    first = anna.load(Scopes.open_scope, "bench", priority=7)
    waits = ben.load(Scopes.open_scope, "bench", priority=4, block=False, timeout_s=LIMIT_S)
    assert eventually(lambda: _count(system) == 2)
    first.standby()
    assert waits.get(timeout=LIMIT_S).response == "/dev/bench"


def test_a_holder_that_does_not_release_it_loses_it_after_the_grace(rr_system: Start) -> None:
    system = rr_system([rr.ChildSpec(Scopes, id="scopes", placement="thread")])
    whole, ben = system.open_registrar("whole"), system.open_registrar("ben")
    keeps = Gate()

    def load(name: str) -> str:
        return whole.load(Scopes.open_brief, name).response

    serve(whole, "bench", load, status=lambda *_: keeps())
    held = whole.load("whole/bench", "bench")
    with ben.load(Scopes.open_brief, "bench", priority=1, timeout_s=LIMIT_S) as mine:
        keeps.wait_arrived()  # it has heard that, and does not release it
        assert mine.response == "/dev/bench"
    keeps.open()
    held.unload()


def test_the_line_is_as_it_was_after_sigkill_of_its_manager(rr_system: Start) -> None:
    system = rr_system([rr.ChildSpec(Scopes, id="scopes")])
    names = ("anna", "ben", "cara", "dora")
    anna, *others = (system.open_registrar(name) for name in names)
    first = anna.load(Scopes.open_scope, "bench", priority=5)
    waiting = {}
    for who, priority in zip(others, (0, 5, 0), strict=True):
        waiting[who.name] = who.load(Scopes.open_scope, "bench", block=False, priority=priority, timeout_s=LIMIT_S)
        assert eventually(lambda: _count(system) == 1 + len(waiting))

    pid = kill(system, "scopes")
    wait_respawned(system, "scopes", pid)
    has = first
    for name in ("cara", "ben", "dora"):
        has.unload()
        has = waiting[name].get(timeout=LIMIT_S)
        assert [one.done() for one in waiting.values()].count(True) == ("cara", "ben", "dora").index(name) + 1


def test_two_wholes_that_wait_for_what_the_other_has_are_a_ring(people: Any) -> None:
    anna, ben, cara, _ = people
    there = {"left": threading.Event(), "right": threading.Event()}

    def both(registrar: rr.Registrar, mine: str, other: str) -> Callable[[Any], str]:
        def load(request: Any) -> str:
            registrar.load(Scopes.open_scope, mine)
            there[mine].set()
            assert there[other].wait(LIMIT_S)
            registrar.load(Scopes.open_scope, other, timeout_s=LIMIT_S)
            return "both"

        return load

    serve(anna, "both", both(anna, "left", "right"))
    serve(ben, "both", both(ben, "right", "left"))
    loads = [cara.load(f"{name}/both", "it", block=False, timeout_s=LIMIT_S) for name in ("anna", "ben")]
    errors = [load.exception(LIMIT_S) for load in loads]
    assert [type(error) for error in errors if error is not None] == [rr.CircularDependency]
    next(load for load, error in zip(loads, errors, strict=True) if error is None).get().unload()


def test_a_connection_outside_waits_in_line_as_well(system: rr.System, people: Any) -> None:
    anna, *_ = people
    with rr.connect(system.state_dir) as connection:
        bench = connection.open_registrar("bench")
        with anna.load(Scopes.open_scope, "bench"):
            with pytest.raises(rr.ResourceBusy) as info:
                bench.load("scopes/scope", "bench", wait_s=0)
            assert info.value.holder == "anna"
        with bench.load("scopes/scope", "bench"), pytest.raises(rr.ResourceBusy, match=r"connection\.bench has it"):
            anna.load(Scopes.open_scope, "bench", wait_s=0)


def test_why_says_who_has_it_and_who_waits(system: rr.System, people: Any) -> None:
    anna, ben, cara, _ = people
    first = anna.load(Scopes.open_scope, "bench")
    waiting = [ben.load(Scopes.open_scope, "bench", block=False)]
    assert eventually(lambda: _count(system) == 2)
    waiting.append(cara.load(Scopes.open_scope, "bench", block=False))
    assert eventually(lambda: _count(system) == 3)
    said = run_cli("why", 'scopes/scope "bench"', "--state", system.state_dir).stdout
    assert "anna has held it since" in said
    lines = [line for line in said.splitlines() if " has waited for it since " in line]
    assert [line.split()[0] for line in lines] == ["ben", "cara"]
    assert lines[0].endswith("(1st in line; anna has it).")
    first.unload()
    for load in waiting:
        load.get(timeout=LIMIT_S).unload()


@pytest.mark.parametrize(
    ("options", "says"),
    [
        ({"exclusive": "yes"}, "exclusive: expected a bool, got 'yes' (str)"),
        ({"grace_s": 1.0}, "grace_s: expected None, as the server is not exclusive, got 1.0"),
        ({"exclusive": True, "grace_s": -1}, "grace_s: expected seconds from 0 to "),
        ({"exclusive": True, "grace_s": True}, "grace_s: expected seconds from 0 to "),
    ],
)
def test_wrong_options_are_refused(options: Any, says: str) -> None:
    with pytest.raises(rr.InvalidSpec) as info:
        rr.server("scope", **options)
    assert says in str(info.value)


@pytest.mark.parametrize("wait_s", [-1, float("nan"), "soon", True])
def test_a_wait_that_is_no_time_is_refused(people: Any, wait_s: Any) -> None:
    with pytest.raises(rr.UsageError, match=r"^load: wait_s: expected seconds, 0 or more, or None, got "):
        people[0].load(Scopes.open_scope, "bench", wait_s=wait_s)


def _count(system: rr.System) -> int:
    return len(system.registrar("scopes").resources())
