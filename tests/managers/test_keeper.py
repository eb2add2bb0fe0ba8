"""Keeper: what is wanted comes and stays, whatever happens to it, and each thing that is not there has a reason."""

from __future__ import annotations

import contextlib
import json
import re
import resource
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

import rr_actors as rr
from rr_actors.managers import Budgets, Keeper, Kept, Pool, Share
from support import eventually, kill, pid_of, wait_respawned
from support_cli import run_cli

Start = Callable[..., rr.System]
QUICK = rr.Backoff(0.05, 2.0, 0.5, 0.0)


def keep(name: str, request: str = '"r{instance}"', server: str = "things/thing", **more: object) -> str:
    fields = {"name": name, "server": server, **more}
    return (
        "\n".join(["[[keep]]", f"request = {request}", *(f"{key} = {json.dumps(fields[key])}" for key in fields)])
        + "\n"
    )


class Place:
    """A system with a Keeper, and things in this process that are loaded when they may be."""

    def __init__(self, start: Start, folder: Path, text: str, *children: rr.ChildSpec) -> None:
        self.folder = folder
        keeper = rr.ChildSpec(Keeper, id="keeper", args=(self.write("keep.toml", text), QUICK))
        self.system = start(rr.Supervisor([*children, keeper], max_restarts=100))
        self.keeper = self.system.ref("keeper").proxy()
        self.app = self.system.open_registrar("app")
        self.broken = dict[str, Exception]()
        self.stuck, self.goes_on = set[str](), threading.Event()
        self.alive, self.opened, self.most = dict[str, int](), dict[str, int](), 0
        self.open_s, self.unload_fails = 0.0, False
        self.well = True
        self.load: float | str = 0.0

    def serve(self) -> rr.Registrar:
        self.things = self.system.open_registrar("things")
        health = rr.Health(every_s=0.05, timeout_s=10.0, fail_after=2)
        self.things.register_server(
            "thing", self._load, self._unload, health=health, probe=self._probe, usage=self._usage
        )
        return self.things

    def _load(self, request: Any) -> str:
        if request in self.stuck:
            self.goes_on.wait(60)
        if request in self.broken:
            raise self.broken[request]
        time.sleep(self.open_s)  # a device that takes so long to open
        self.opened[request] = self.opened.get(request, 0) + 1
        self.alive[request] = self.alive.get(request, 0) + 1
        self.most = max(self.most, self.alive[request])
        return f"{request} is on"

    def _unload(self, request: Any, response: str | None) -> None:
        if self.unload_fails:
            raise OSError("it is stuck")
        self.alive[request] -= 1

    def _probe(self, request: Any, response: str) -> None:
        if not self.well:
            raise OSError("no answer")

    def _usage(self, request: Any, response: str) -> dict[str, float]:
        """Share what there is to do among the things; a text is an error."""
        if isinstance(self.load, str):
            raise OSError(self.load)
        return {"load": self.load / sum(self.alive.values())}

    def write(self, name: str, text: str) -> str:
        (self.folder / name).write_text(text)
        return str(self.folder / name)

    def there(self) -> list[Any]:
        """Return what is loaded, as the provider says it."""
        return sorted(info.request for info in self.things.resources() if info.phase == "loaded" and info.holders)

    def kept(self, name: str) -> Kept:
        return next(one for one in self.keeper.get().get() if one.name == name)

    def wait_kept(self, *kept: Kept) -> bool:
        return eventually(lambda: self.keeper.get().get() == list(kept), what=f"{kept}")

    def lose(self, request: str) -> None:
        (info,) = [info for info in self.things.resources() if info.request == request and info.status != "FATAL"]
        self.things.send_status(info, rr.Status("FATAL", "it burns"))

    def restart(self) -> None:
        """Start the keeper anew by hand."""
        self.system.supervisor().terminate_child("keeper")
        self.system.supervisor().restart_child("keeper")

    def respawn(self) -> None:
        wait_respawned(self.system, "keeper", kill(self.system, "keeper"))


Make = Callable[..., Place]


@pytest.fixture
def make(start: Start, tmp_path: Path) -> Iterator[Make]:
    places: list[Place] = []

    def made(text: str, *children: rr.ChildSpec) -> Place:
        places.append(Place(start, tmp_path, text, *children))
        return places[-1]

    yield made
    for place in places:
        place.goes_on.set()


def test_what_is_wanted_comes_when_its_server_does(make: Make) -> None:
    place = make(keep("a", replicas=3) + keep("b", '"b"'))
    assert place.wait_kept(Kept("a", 3, 0, "none registered"), Kept("b", 1, 0, "none registered"))
    place.serve()
    assert place.wait_kept(Kept("a", 3, 3), Kept("b", 1, 1))
    assert place.there() == ["b", "r0", "r1", "r2"]
    assert place.keeper.diff().get() == []


def test_what_is_lost_comes_back_and_there_is_never_a_second_one(make: Make) -> None:
    place = make(keep("a", replicas=3))
    place.serve()
    assert place.wait_kept(Kept("a", 3, 3))
    for request in ("r1", "r1", "r2"):
        first = {info.id for info in place.things.resources()}
        place.lose(request)
        eventually(lambda first=first: {info.id for info in place.things.resources()} - first)
        assert place.wait_kept(Kept("a", 3, 3))
    assert place.there() == ["r0", "r1", "r2"]
    assert place.most == 1


def test_holders_of_kept_hear_how_it_is(make: Make) -> None:
    place = make(keep("a", replicas=2))
    place.serve()
    assert place.wait_kept(Kept("a", 2, 2))
    query = place.app.load("keeper/kept", "a", response_type=Kept)
    assert query.response == Kept("a", 2, 2)
    place.broken["r1"] = OSError("no fuel")
    place.lose("r1")
    assert query.wait_status("WARNING", timeout_s=60).message.startswith("1 of 2 ready: failing")
    assert eventually(lambda: query.response == Kept("a", 2, 1, "failing"))
    place.broken["r0"] = OSError("no fuel")
    place.lose("r0")
    assert query.wait_status("ERROR", timeout_s=60).message.startswith("0 of 2 ready: all failing")
    place.broken.clear()
    assert query.wait_status("OK", timeout_s=60).message == "2 of 2 ready"
    assert query.response == Kept("a", 2, 2)
    place.keeper.apply(place.write("none.toml", "")).get()
    assert eventually(lambda: (query.response, query.fetch_state()) == (Kept("a", 0, 0, "not kept"), "WARNING"))
    with pytest.raises(rr.LoadFailed, match=r"no keep 'b': expected one of none"):
        place.app.load("keeper/kept", "b")


def test_one_that_is_unhealthy_is_not_ready(make: Make) -> None:
    place = make(keep("a"))
    place.serve()
    assert place.wait_kept(Kept("a", 1, 1))
    place.well = False
    assert place.wait_kept(Kept("a", 1, 0, "all failing"))
    assert place.keeper.diff().get() == ["a: 0 of 1 ready: all failing: health: OSError: no answer"]
    place.well = True
    assert place.wait_kept(Kept("a", 1, 1))


def test_apply_changes_no_more_than_it_says(make: Make) -> None:
    place = make(keep("a", replicas=3) + keep("b", '"b"'))
    place.serve()
    assert place.wait_kept(Kept("a", 3, 3), Kept("b", 1, 1))
    r0 = next(info.id for info in place.things.resources() if info.request == "r0")
    file = place.write("next.toml", keep("a", replicas=1, priority=5) + keep("c", '"c"', standby=True))
    said = ["+ c", "- b", "~ a: replicas 3 -> 1, priority 0 -> 5"]
    assert place.keeper.diff(file).get() == said
    assert place.keeper.apply(file).get() == said
    assert eventually(lambda: place.there() == ["c", "r0"])
    assert eventually(
        lambda: {info.request: info.priority for info in place.things.resources()} == {"r0": 5, "c": None}
    )
    assert r0 in {info.id for info in place.things.resources()}
    assert place.keeper.diff(file).get() == []
    place.keeper.apply(place.write("next.toml", keep("a", '"other"'))).get()
    assert eventually(lambda: place.there() == ["other"])
    assert place.alive == {"r0": 0, "r1": 0, "r2": 0, "b": 0, "c": 0, "other": 1}


def test_a_file_that_is_wrong_changes_nothing(make: Make) -> None:
    place = make(keep("a"))
    place.serve()
    file = place.write("wrong.toml", keep("a", replicas=-1))
    for ask in (place.keeper.apply, place.keeper.diff):
        with pytest.raises(rr.ConfigError, match=r"wrong.toml: keep\[0\].replicas: expected a whole number from 0"):
            ask(file).get()
    assert place.wait_kept(Kept("a", 1, 1))


def test_a_load_that_nobody_wants_any_more_is_withdrawn(make: Make) -> None:
    place = make(keep("a", replicas=2))
    place.stuck.add("r1")
    place.serve()
    assert place.wait_kept(Kept("a", 2, 1, "loading"))
    place.keeper.apply(place.write("next.toml", keep("a"))).get()
    assert place.wait_kept(Kept("a", 1, 1))
    held = {"r0": ("keeper",), "r1": ()}
    assert eventually(lambda: {info.request: info.holders for info in place.things.resources()} == held)
    place.goes_on.set()
    assert eventually(lambda: place.alive.get("r1") == 0)
    assert eventually(lambda: place.there() == ["r0"])


def test_what_is_after_another_waits_for_it(make: Make) -> None:
    place = make(keep("b", '"b"', after=["a"]) + keep("a", '"a"'))
    place.stuck.add("a")
    place.serve()
    assert place.wait_kept(Kept("b", 1, 0, "waits for a"), Kept("a", 1, 0, "loading"))
    place.goes_on.set()
    assert place.wait_kept(Kept("b", 1, 1), Kept("a", 1, 1))


def test_what_has_no_room_comes_when_there_is_some(make: Make) -> None:
    budgets = rr.ChildSpec(Budgets, id="budgets", args=([Pool("watts", 100)],))
    place = make(keep("a", '"lamp{instance}"', replicas=3), budgets)
    place.things = place.system.open_registrar("things")
    place.things.register_server(
        "thing", lambda request: place.things.load("budgets/share", Share("watts", 40)).response
    )
    assert place.wait_kept(Kept("a", 3, 2, "over capacity"))
    place.system.ref("budgets").proxy().set_capacity("watts", 120).get()
    assert place.wait_kept(Kept("a", 3, 3))


def test_a_group_is_loaded_as_a_whole_and_anew_when_it_changes(make: Make) -> None:
    def text(*requests: str) -> str:
        members = "".join(f'[[group.member]]\nserver = "things/thing"\nrequest = "{request}"\n' for request in requests)
        return keep("n", '"navigation"', "keeper/group") + '[[group]]\nname = "navigation"\n' + members

    place = make(text("map", "laser"))
    place.serve()
    assert eventually(lambda: place.there() == ["laser", "map"])
    place.keeper.apply(place.write("next.toml", text("map", "camera"))).get()
    assert eventually(lambda: place.there() == ["camera", "map"])
    query = place.app.load("keeper/group", "navigation")
    query.unload()
    with pytest.raises(rr.LoadFailed, match=r"no group 'navigatio': expected one of navigation; did you mean"):
        place.app.load("keeper/group", "navigatio")


def group(name: str, *members: tuple[str, str]) -> str:
    tables = [f'[[group.member]]\nserver = "{server}"\nrequest = "{request}"\n' for server, request in members]
    return "".join([f'[[group]]\nname = "{name}"\n', *tables])


def test_a_replica_whose_release_has_failed_is_not_ready_when_it_is_wanted_again(make: Make) -> None:
    place = make(keep("a", replicas=2))
    place.serve()
    assert place.wait_kept(Kept("a", 2, 2))
    place.unload_fails = True
    place.keeper.apply(place.write("one.toml", keep("a"))).get()
    assert eventually(lambda: {info.request: info.phase for info in place.things.resources()}["r1"] == "unload_failed")
    place.keeper.apply(place.write("two.toml", keep("a", replicas=2))).get()
    assert place.wait_kept(Kept("a", 2, 1, "unload failed"))
    place.unload_fails = False
    assert place.wait_kept(Kept("a", 2, 2))
    assert (place.opened, place.alive) == ({"r0": 1, "r1": 2}, {"r0": 1, "r1": 1})


def test_a_changed_group_reaches_what_is_kept_also_if_it_is_in_another_one_or_somebody_shares_it(make: Make) -> None:
    def text(*sensors: str) -> str:
        inner = [("things/thing", one) for one in sensors]
        outer = [("things/thing", "map"), ("keeper/group", "sensors")]
        return keep("n", '"nav"', "keeper/group") + group("nav", *outer) + group("sensors", *inner)

    place = make(text("laser"))
    place.serve()
    assert eventually(lambda: place.there() == ["laser", "map"])
    shared = place.app.load("keeper/group", "sensors")
    place.keeper.apply(place.write("next.toml", text("laser", "sonar"))).get()
    assert eventually(lambda: place.there() == ["laser", "map", "sonar"])
    assert place.wait_kept(Kept("n", 1, 1))
    assert shared.wait_status("WARNING", timeout_s=60).message.startswith("the group has other members by now")
    shared.unload()
    assert place.app.load("keeper/group", "sensors").state == "OK"
    assert place.there() == ["laser", "map", "sonar"]


def test_a_keeper_that_is_killed_goes_on_with_what_was_applied(make: Make) -> None:
    place = make(keep("a", replicas=2))
    place.serve()
    assert place.wait_kept(Kept("a", 2, 2))
    place.keeper.apply(place.write("next.toml", keep("a", replicas=3))).get()
    assert place.wait_kept(Kept("a", 3, 3))
    before = {info.id for info in place.things.resources()}
    place.respawn()
    assert place.wait_kept(Kept("a", 3, 3))
    assert {info.id for info in place.things.resources()} == before
    place.write("keep.toml", keep("a"))  # an edit that nobody has applied
    place.respawn()
    assert place.wait_kept(Kept("a", 3, 3))
    place.restart()  # the first file, changed, replaces what was applied
    assert place.wait_kept(Kept("a", 1, 1))
    assert eventually(lambda: place.there() == ["r0"])


def test_what_was_applied_does_not_come_back_with_an_earlier_text_of_the_file(make: Make) -> None:
    place = make(keep("a"))
    place.serve()
    place.keeper.apply(place.write("next.toml", keep("a", replicas=3))).get()
    for replicas in (2, 1):
        place.write("keep.toml", keep("a", replicas=replicas) if replicas > 1 else keep("a"))
        place.restart()
        assert place.wait_kept(Kept("a", replicas, replicas))


@pytest.mark.parametrize("replicas", [3, 20])
@pytest.mark.parametrize("open_s", [0.0, 0.1])
def test_each_replica_is_opened_once_at_the_start_and_never_at_a_respawn(
    make: Make, replicas: int, open_s: float
) -> None:
    place = make(keep("a", replicas=replicas))
    place.open_s = open_s
    place.serve()
    assert place.wait_kept(Kept("a", replicas, replicas))
    for _ in range(2):
        place.respawn()
        assert place.wait_kept(Kept("a", replicas, replicas))
        place.keeper.apply(str(place.folder / "keep.toml")).get()  # a look, and nothing to do
    assert place.opened == {f"r{i}": 1 for i in range(replicas)}
    assert set(place.alive.values()) == {1}


def test_holders_of_kept_hear_each_reason_also_if_only_its_text_is_another(make: Make) -> None:
    place = make(keep("a", '"r0"'))
    place.serve()
    query = place.app.load("keeper/kept", "a", response_type=Kept)
    assert place.wait_kept(Kept("a", 1, 1))
    place.broken["r0"] = OSError("no fuel")
    place.lose("r0")
    for text in ("no fuel", "no fuse"):
        place.broken["r0"] = OSError(text)
        assert eventually(lambda text=text: text in query.wait_status("ERROR", timeout_s=60).message)


def test_a_replica_that_cannot_be_unloaded_has_no_second_one(make: Make) -> None:
    place = make(keep("a", '"r0"'))
    place.serve()
    assert place.wait_kept(Kept("a", 1, 1))
    place.unload_fails = True
    place.lose("r0")
    assert place.wait_kept(Kept("a", 1, 0, "unload failed"))
    assert "it is stuck" in place.keeper.diff().get()[0]
    assert [info.phase for info in place.things.resources()] == ["unload_failed"]
    place.unload_fails = False
    assert place.wait_kept(Kept("a", 1, 1))
    assert (place.opened, place.alive, len(place.things.resources())) == ({"r0": 2}, {"r0": 1}, 1)


def scaled(most: int = 4, **on: object) -> str:
    table = {"usage": "load", "target": 1.0, "every_s": 0.05, "down_s": 0.5, **on}
    text = "".join(f"{key} = {json.dumps(value)}\n" for key, value in table.items())
    return f"{keep('a', min=1, max=most)}[keep.scale_on]\n{text}"


def test_replicas_come_and_go_with_what_they_have_to_do_also_after_a_crash(make: Make) -> None:
    place = make(scaled())
    place.serve()
    assert place.wait_kept(Kept("a", 1, 1, min=1, max=4))
    place.load = 2.5
    assert eventually(lambda: (kept := place.kept("a")).wanted == kept.ready == 3)
    assert place.kept("a").scaled == "1 -> 3: load is 2.5, the target 1"
    place.load = 1.0
    place.keeper.apply(place.write("slow.toml", scaled(down_s=600.0))).get()  # before half a second is over
    before = place.kept("a")
    place.respawn()
    assert place.wait_kept(before)  # its number is on disk, with the reason
    assert {info.request for info in place.things.resources()} >= {"r0", "r1"}
    place.keeper.apply(place.write("quick.toml", scaled())).get()
    assert eventually(lambda: place.kept("a").wanted == 1)
    assert eventually(lambda: place.there() == ["r0"])
    place.load = 900.0
    assert eventually(lambda: place.there() == ["r0", "r1", "r2", "r3"])
    place.keeper.apply(place.write("less.toml", scaled(most=2))).get()
    assert eventually(lambda: place.there() == ["r0", "r1"])
    assert place.kept("a").scaled == "4 -> 2: max is 2"
    assert place.most == 1


def test_what_cannot_be_read_changes_nothing_and_is_a_warning(make: Make, runtime_dir: object) -> None:
    place = make(scaled())
    place.serve()
    place.load = 2.0
    assert eventually(lambda: (kept := place.kept("a")).wanted == kept.ready == 2)
    query = place.app.load("keeper/kept", "a", response_type=Kept)
    assert (
        run_cli("keep", "diff").stdout == "all is as it is wanted\n"
    )  # imported before tracebacks are made: gh-106905
    place.load = "no meter"
    assert query.wait_status("WARNING", timeout_s=60).message.startswith("2 of 2 ready: no reading: load: ")
    assert query.response.why == "no reading"
    assert "OSError: no meter" in run_cli("keep", "diff").stdout
    (row,) = run_cli("keep", "get").stdout.splitlines()[1:]
    assert re.match(r"a +2 of 2 +1-4 +1 -> 2: load is 2, the target 1 +no reading +load: ", row)
    assert place.there() == ["r0", "r1"]
    place.load = 2.0
    assert query.wait_status("OK", timeout_s=60).message == "2 of 2 ready"
    place.keeper.apply(place.write("other.toml", scaled(usage="loads"))).get()
    assert query.wait_status("WARNING", timeout_s=60).message.endswith(
        "loads: not among what they use: load; did you mean 'load'?"
    )
    assert place.there() == ["r0", "r1"]


def test_a_thing_that_is_kept_already_goes_on_with_as_many_when_it_begins_to_scale(make: Make) -> None:
    place = make(keep("a", replicas=3))
    place.serve()
    assert place.wait_kept(Kept("a", 3, 3))
    place.keeper.apply(place.write("scaled.toml", scaled(down_s=600.0))).get()
    assert place.wait_kept(Kept("a", 3, 3, min=1, max=4))


def test_a_probe_says_what_there_is_to_do(make: Make, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    queue = tmp_path / "queue"
    queue.write_text("0")
    monkeypatch.setenv("RR_TEST_QUEUE", str(queue))
    on = {"usage": "", "probe": "support_managers:queue_length", "target": 5, "timeout_s": 0.2}
    place = make(scaled(**on).replace("min = 1", "min = 0"))
    place.serve()
    assert place.wait_kept(Kept("a", 0, 0, min=0, max=4))
    queue.write_text("13")
    assert eventually(lambda: place.there() == ["r0", "r1", "r2"])
    assert place.kept("a").scaled == "0 -> 3: support_managers:queue_length is 13, the target 5 each"
    for text, said in (
        ("nan", "returned nan, not a finite number"),
        ("many", "raised ValueError: could not convert string to float: 'many'"),
        ("cancel", "raised CancelledError"),
        ("hang", "has not been read within 0.2 s"),
    ):
        queue.write_text(text)
        assert eventually(lambda said=said: any(said in line for line in place.keeper.diff().get()), what=said)
        assert place.there() == ["r0", "r1", "r2"]


def test_a_full_disk_ends_no_keeper_and_what_is_wanted_comes_when_there_is_room(make: Make) -> None:
    place = make(keep("a", replicas=2))
    place.serve()
    assert place.wait_kept(Kept("a", 2, 2))
    query = place.app.load("keeper/kept", "a", response_type=Kept)
    pid = pid_of(place.system, "keeper")
    before = resource.prlimit(pid, resource.RLIMIT_FSIZE)
    resource.prlimit(pid, resource.RLIMIT_FSIZE, (2048, before[1]))  # its catalog is longer
    assert place.keeper.apply(place.write("more.toml", keep("a", replicas=3, priority=4))).get()
    assert eventually(lambda: place.kept("a").wanted == 3)
    place.keeper.apply(place.write("least.toml", keep("a", replicas=1))).get()
    assert eventually(lambda: place.kept("a").wanted == 1)
    resource.prlimit(pid, resource.RLIMIT_FSIZE, before)
    assert place.wait_kept(Kept("a", 1, 1))
    assert eventually(lambda: query.response == Kept("a", 1, 1))
    assert eventually(lambda: place.there() == ["r0"])
    assert pid_of(place.system, "keeper") == pid


def test_kills_and_losses_at_any_time_leave_what_is_wanted_and_no_second_one(make: Make) -> None:
    place = make(keep("a", replicas=3))
    place.serve()
    for round in range(4):
        wanted = 3 - round % 2
        place.keeper.apply(place.write("next.toml", keep("a", replicas=wanted))).get()
        pid = kill(place.system, "keeper")
        for info in place.things.resources()[:2]:
            if info.phase == "loaded":
                place.things.send_status(info, rr.Status("FATAL", "it burns"))
        wait_respawned(place.system, "keeper", pid)
        assert place.wait_kept(Kept("a", wanted, wanted))
        assert eventually(lambda wanted=wanted: place.there() == [f"r{i}" for i in range(wanted)])
    assert place.most == 1
    assert eventually(lambda: len(place.things.resources()) == 2)


def test_the_command_line(make: Make, runtime_dir: object) -> None:
    place = make(keep("a", replicas=2) + keep("b", '"b"', "nobody/there"))
    place.serve()
    assert place.wait_kept(Kept("a", 2, 2), Kept("b", 1, 0, "none registered"))
    rows = json.loads(run_cli("keep", "get", "--json").stdout)
    assert [(row["name"], row["ready"], row["wanted"], row["why"]) for row in rows] == [
        ("a", 2, 2, ""),
        ("b", 0, 1, "none registered"),
    ]
    assert "none registered" in run_cli("keep", "get").stdout
    ran = run_cli("keep", "diff")
    assert (ran.returncode, ran.stdout.startswith("b: 0 of 1 ready: none registered: ")) == (1, True)
    file = place.write("next.toml", keep("a", replicas=1))
    for command in (("apply", "--dry-run", file), ("keep", "diff", file), ("apply", file)):
        assert run_cli(*command).stdout == "- b\n~ a: replicas 2 -> 1\n"
    assert place.wait_kept(Kept("a", 1, 1))
    assert run_cli("keep", "diff").stdout == "all is as it is wanted\n"
    assert run_cli("apply", file).stdout == "keeper keeps all of this already\n"
    ran = run_cli("apply", place.write("wrong.toml", keep("a", replicas=-1)))
    assert ran.returncode != 0
    assert "wrong.toml: keep[0].replicas: expected a whole number from 0 to 10000, got -1" in ran.stderr
    assert "expected no file" in run_cli("keep", "get", file).stderr
    assert "no_such" in run_cli("keep", "get", "--keeper", "no_such").stderr
    (place.folder / "binary.toml").write_bytes(b"\xff")
    assert "not UTF-8" in run_cli("apply", place.folder / "binary.toml").stderr
    assert "No such file" in run_cli("apply", place.folder / "none.toml").stderr
    place.keeper.apply(place.write("none.toml", "")).get()
    assert run_cli("keep", "get").stderr == "nothing is kept\n"
    with pytest.raises(rr.UsageError, match="expected a question to a Keeper"):
        place.system.ref("keeper").ask({"what": 1})


def test_a_file_that_is_wrong_fails_the_start_by_name(start: Start, tmp_path: Path) -> None:
    (tmp_path / "keep.toml").write_text(keep("a", replica=2))
    with pytest.raises(
        rr.StartFailed, match=r"keep.toml: keep\[0\].replica: expected one of name.*did you mean 'replicas'"
    ):
        start(rr.ChildSpec(Keeper, id="keeper", args=(str(tmp_path / "keep.toml"),)))


class SlowToAnswer(Keeper):
    """Its holders' responses are on their way until the test lets them go on."""

    answers, goes_on = threading.Event(), threading.Event()

    @rr.server("kept", recovery="keep")
    def load_kept(self, request: str) -> Kept:
        kept = super().load_kept(request)
        self.answers.set()
        self.goes_on.wait(60)
        return kept


def test_a_holder_hears_what_has_changed_while_its_response_was_on_its_way(start: Start, tmp_path: Path) -> None:
    (tmp_path / "keep.toml").write_text(keep("one", '"only"'))
    args = (str(tmp_path / "keep.toml"), QUICK)
    system = start(rr.ChildSpec(SlowToAnswer, id="keeper", args=args, placement="thread"))
    loading = system.open_registrar("app").load("keeper/kept", "one", block=False, timeout_s=None)
    assert SlowToAnswer.answers.wait(30)
    system.open_registrar("things").register_server("thing", lambda request: request, lambda request, response: None)
    keeper = system.ref("keeper").proxy()
    assert eventually(lambda: keeper.get().get()[0].ready == 1)
    SlowToAnswer.goes_on.set()
    query = loading.get(timeout=30)
    assert eventually(lambda: query.response.ready == 1)


class Defective(Keeper):
    """It has a defect, which shows once."""

    shows = threading.Event()

    def _look(self, now: float) -> float | None:
        if self.shows.is_set():
            self.shows.clear()
            raise ValueError("a defect")
        return super()._look(now)


def test_a_defect_of_the_loop_is_logged_and_the_keeper_starts_again(
    start: Start, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    (tmp_path / "keep.toml").write_text(keep("one", '"only"'))
    args = (str(tmp_path / "keep.toml"), QUICK)
    system = start(rr.ChildSpec(Defective, id="keeper", args=args, placement="thread"))
    keeper = system.ref("keeper").proxy()
    Defective.shows.set()
    with contextlib.suppress(ValueError, rr.ActorDeadError):  # unless the loop has looked by itself before
        keeper.apply(str(tmp_path / "keep.toml")).get()
    assert eventually(lambda: [one.event for one in system.supervisor().history() if one.event == "restarted"])
    assert "ValueError: a defect" in caplog.text
    system.open_registrar("things").register_server("thing", lambda request: request, lambda request, response: None)
    assert eventually(lambda: system.ref("keeper").proxy().get().get()[0].ready == 1)
