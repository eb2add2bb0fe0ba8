"""200 loads and unloads while managers are SIGKILLed at random moments: nothing acknowledged is lost, nothing leaks.

Three witnesses are compared in the end: the catalogs of all sides, read with sqlite3; what the consumer was told; and
the journal that the callbacks wrote.
"""

from __future__ import annotations

import itertools
import os
import random
import threading
from collections import defaultdict
from collections.abc import Callable, Sequence
from pathlib import Path

import psutil
import pytest

import rr_actors as rr
from support import Calls, Workshop, catalog_path, eventually, kill, messages, pid_of, read_catalog, wait_respawned
from support_managers import Order

Start = Callable[..., rr.System]
LOADS = 100
HELD_AT_THE_END = 10


class Store(rr.Manager):
    """Serves "thing"; with `below`, each thing needs one from there. Journal: "ID load|clean|unload NAME RESOURCE_ID".

    "clean" is an unload of what an interrupted load has left, that nobody wants any more.
    """

    def __init__(self, root: str, below: str = "") -> None:
        self.work = Workshop(root)
        self.below = below

    @rr.server("thing")
    def load_thing(self, request: Order) -> str:
        self.note("load", request)
        if self.below:
            self.registrar.load(self.below, request)
        return request.name

    @load_thing.unload
    def unload_thing(self, request: Order, response: str | None) -> None:
        self.note("clean" if rr.current().interrupted else "unload", request)

    def note(self, what: str, request: Order) -> None:
        self.work.note(self.registrar.name, what, request.name, rr.current().resource_id)


class Killer:
    """Kills one of the victims after a random while, waits until it is back, and again until stopped."""

    most = 12  # each takes the time of a respawn

    def __init__(self, system: rr.System, victims: Sequence[str], seed: int) -> None:
        self.system, self.victims, self.random = system, victims, random.Random(seed)
        self.kills = 0
        self._stopped = threading.Event()
        self._thread = threading.Thread(target=self._run)

    def __enter__(self) -> Killer:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stopped.set()
        self._thread.join(20)

    def _run(self) -> None:
        while self.kills < self.most and not self._stopped.wait(self.random.uniform(0.001, 0.03)):
            victim = self.random.choice(self.victims)
            wait_respawned(self.system, victim, kill(self.system, victim))
            self.kills += 1


class Worker:
    """A consumer's thread: its share of loads, and more until `done`; each unloaded again but for the last few."""

    def __init__(
        self, app: rr.Registrar, server: str, name: str, loads: int, keep: int, done: Callable[[], bool]
    ) -> None:
        self.app, self.server, self.name, self.loads, self.keep = app, server, name, loads, keep
        self.done = done
        self.held: list[rr.Query] = []
        self.errors: list[Exception] = []
        self.thread = threading.Thread(target=self._run)
        self.thread.start()

    def _run(self) -> None:
        try:
            for n in itertools.takewhile(lambda n: n < self.loads or not self.done(), itertools.count()):
                self.held.append(self.app.load(self.server, Order(f"{self.name}-{n}"), timeout_s=20.0))
                if len(self.held) > self.keep:
                    self.app.unload(self.held.pop(0), timeout_s=20.0)
        except Exception as error:
            self.errors.append(error)


def alternates(steps: list[str]) -> bool:
    """Loads, then unloads: each perhaps run again after a kill, never one after the other had its turn."""
    return steps == sorted(steps, key=["load", "unload" if "unload" in steps else "clean"].index)


def check_one_side(path: Path, served: bool) -> dict[str, set[str]]:
    """Check a catalog in itself; return the ids of its live resources, the queries on them and the queries it holds."""
    resources = {row["id"]: row for row in read_catalog(path, "resources")} if served else {}
    queries = read_catalog(path, "queries") if served else []
    assert {row["phase"] for row in resources.values()} <= {"loaded"}
    assert {row["resource_id"] for row in queries} == set(resources)  # no resource without holder, no query to nothing
    held = read_catalog(path, "held")
    assert {row["hold"] for row in held} <= {"held"}
    return {"resources": set(resources), "queries": {row["id"] for row in queries}, "held": {row["id"] for row in held}}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("victims", "seed"), [(("store",), 1), (("store",), 2), (("middle",), 3), (("middle", "store"), 4)]
)
def test_two_hundred_loads_and_unloads_survive_sigkill_at_random_moments(
    start: Start, workshop: Workshop, state_dir: Path, victims: tuple[str, ...], seed: int
) -> None:
    root = str(workshop.root)
    system = start(
        rr.Supervisor(
            [
                rr.ChildSpec(Store, id="store", args=(root,)),
                rr.ChildSpec(Store, id="middle", args=(root, "store/thing")),
            ],
            id="root",
            max_restarts=10_000,
            max_seconds=1.0,
        )
    )
    app = system.open_registrar("app")
    server = "middle/thing" if "middle" in victims else "store/thing"
    with Killer(system, victims, seed) as killer:
        share, keep = LOADS // 4, HELD_AT_THE_END // 2
        workers = [
            Worker(app, server, f"w{n}", share, keep if n < 2 else 0, lambda: killer.kills >= 2) for n in range(4)
        ]
        for worker in workers:
            worker.thread.join(40)
            assert not worker.thread.is_alive(), "a load or unload hangs"
    assert [error for worker in workers for error in worker.errors] == []
    assert killer.kills >= 2
    told = {query.id: query for worker in workers for query in worker.held}
    assert len(told) == HELD_AT_THE_END

    names = ["app", "middle", "store"] if "middle" in victims else ["app", "store"]

    def settled() -> bool:
        handles = [system.registrar(name) for name in names[1:]]
        phases = [resource.phase for handle in handles for resource in handle.resources()]
        return phases == ["loaded"] * (HELD_AT_THE_END * len(handles))

    eventually(settled, 10.0, "all sides settled")
    for name in names:
        system.registrar(name).save_catalog()
    sides = {name: check_one_side(catalog_path(state_dir, name), name != "app") for name in names}

    # what the consumer was told, its own catalog, and the providers' catalogs say the same
    assert sides["app"]["held"] == set(told) == {query.id for query in app.queries()}
    for consumer, provider in itertools.pairwise(names):
        assert sides[provider]["queries"] == sides[consumer]["held"]
    for query in told.values():
        assert query.resource_id in sides[names[1]]["resources"]

    # and so does the journal: per resource, loads come before unloads, and what was loaded and not unloaded lives
    steps: dict[str, dict[str, list[str]]] = {name: defaultdict(list) for name in names}
    for line in workshop.lines():
        name, what, _, resource_id = line.split()
        steps[name][resource_id].append(what)
    for name in names[1:]:
        assert all(alternates(each) for each in steps[name].values())
        assert all(each[0] == "load" for each in steps[name].values())
        assert {id for id, each in steps[name].items() if "unload" not in each} == sides[name]["resources"]
        repeated = sum(len(each) - len(set(each)) for each in steps[name].values())
        assert repeated <= 8 * killer.kills  # a kill interrupts what four workers wait for and what follows from that


@pytest.mark.slow
@pytest.mark.parametrize("seed", [1, 2])
def test_acknowledged_statuses_survive_sigkill_and_are_heard_once_in_order(
    start: Start, workshop: Workshop, seed: int
) -> None:
    system = start(
        rr.Supervisor(
            [rr.ChildSpec(Store, id="store", args=(str(workshop.root),))], id="root", max_restarts=10_000, max_seconds=1
        )
    )
    app, store, heard = system.open_registrar("app"), system.registrar("store"), Calls()
    query = app.load("store/thing", Order("wheel"), on_status=heard)
    told: list[str] = []
    with Killer(system, ["store"], seed) as killer:
        for n in itertools.takewhile(lambda _: killer.kills < 6, itertools.count()):
            try:
                store.send_status(query.resource_id, rr.Status(rr.State.WARNING, str(n)))
                told.append(str(n))
            except rr.Unavailable:
                continue  # it died while it was asked: this one may be heard or not
    store.send_status(query.resource_id, rr.Status(rr.State.OK, "last"))
    eventually(lambda: "last" in messages(heard))
    assert set(told) <= set(messages(heard))
    assert messages(heard) == [*sorted(set(messages(heard)) - {"last"}, key=int), "last"]


@pytest.mark.slow
@pytest.mark.parametrize("seed", [1, 2])
def test_loads_given_up_at_random_while_managers_are_killed_leave_nothing(
    start: Start, workshop: Workshop, seed: int
) -> None:
    root = str(workshop.root)
    children = [
        rr.ChildSpec(Store, id="store", args=(root,)),
        rr.ChildSpec(Store, id="middle", args=(root, "store/thing")),
    ]
    system = start(rr.Supervisor(children, id="root", max_restarts=10_000, max_seconds=1.0))
    apps = [system.open_registrar(f"app{n}") for n in range(2)]
    errors: list[Exception] = []

    def use(n: int) -> None:
        plan = random.Random(seed * 10 + n)
        app = apps[n % 2]
        for _ in range(25):
            server, name = plan.choice(["middle/thing", "store/thing"]), f"n{plan.randrange(4)}"
            try:
                query = app.load(server, Order(name), timeout_s=plan.choice([0.001, 0.01, 0.05, 0.3]))
                query.unload(timeout_s=plan.choice([0.001, 0.01, 20.0]))
            except (rr.LoadTimeout, rr.Unavailable):
                continue
            except Exception as error:
                errors.append(error)

    with Killer(system, ["store", "middle"], seed):
        threads = [threading.Thread(target=use, args=(n,)) for n in range(4)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join(40)
    assert not any(thread.is_alive() for thread in threads)
    assert errors == []
    handles = [system.registrar(name) for name in ("middle", "store")]
    eventually(lambda: not any(handle.resources() or handle.queries() for handle in handles))
    assert not any(app.queries() for app in apps)
    steps: dict[str, list[str]] = defaultdict(list)
    for line in workshop.lines():
        name, what, _, resource_id = line.split()
        steps[f"{name} {resource_id}"].append(what)
    for each in steps.values():
        assert alternates(each)
        assert each[0] in ("load", "clean")  # killed when the row was written, and the callback had not noted anything


class Buyer(rr.Manager):
    """Its own threads load and unload without end, and note what they were told."""

    def __init__(self, root: str) -> None:
        self.work = Workshop(root)

    def on_start(self) -> None:
        for n in range(2):
            threading.Thread(target=self.buy, args=(f"w{n}-{os.getpid()}",), daemon=True).start()

    def buy(self, name: str) -> None:
        held: list[rr.Query] = []
        for n in itertools.count():
            held.append(self.registrar.load("store/thing", Order(f"{name}-{n}")))
            self.work.note("told held", held[-1].id)
            if n % 4:
                query = held.pop(0)
                self.work.note("asks release", query.id)
                query.unload()
                self.work.note("told released", query.id)


@pytest.mark.slow
@pytest.mark.parametrize(("victims", "seed"), [(("buyer",), 1), (("buyer", "store"), 2)])
def test_what_a_consumer_was_told_before_it_was_killed_is_so(
    start: Start, workshop: Workshop, victims: tuple[str, ...], seed: int
) -> None:
    root = str(workshop.root)
    children = [rr.ChildSpec(Store, id="store", args=(root,)), rr.ChildSpec(Buyer, id="buyer", args=(root,))]
    system = start(rr.Supervisor(children, id="root", max_restarts=10_000, max_seconds=1.0))
    with Killer(system, victims, seed) as killer:
        eventually(lambda: killer.kills >= 8, 30.0)
    pid = pid_of(system, "buyer")
    system.supervisor().terminate_child("buyer")
    assert not psutil.pid_exists(pid)

    def told(what: str) -> set[str]:
        return {line.split()[2] for line in workshop.lines(what)}

    store = system.registrar("store")
    held = {id for resource in store.resources() for id in resource.queries}
    assert told("told held") - told("asks release") <= held
    assert not told("told released") & held
    system.supervisor().delete_child("buyer")
    eventually(lambda: not store.resources())
    steps: dict[str, list[str]] = defaultdict(list)
    for line in workshop.lines("store"):
        _, what, _, resource_id = line.split()
        steps[resource_id].append(what)
    assert all(alternates(each) and each[0] == "load" and each[-1] == "unload" for each in steps.values())
