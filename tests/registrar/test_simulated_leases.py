"""Leases between hosts in simulated worlds: the promise is kept, and a broken one is noticed."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest

from rr_actors.registrar.core import reconciliation
from rr_actors.registrar.model.catalog import Decision, Server
from rr_actors.registrar.model.commands import LeaseOver
from rr_actors.wire.hosts import leases
from rr_actors.wire.hosts.leases import GivenLease, TakenLease
from simulation import report, run
from simulation.hosts import LEASE_S, Hosted, SimHosts
from simulation.oracle import Violation
from simulation.process_faults import HOSTS_FIRST
from simulation.quiescence import come_to_rest
from simulation.runner import kind_of
from simulation.world import Step, World
from support_mutations import in_tables

Patch = Callable[[object, str, Any], None]

WORLDS = 40
WORLDS_FOR_A_MUTATION = 3000


def assert_kept(seed: int, steps: int = 400) -> None:
    outcome = run(seed, steps)
    if outcome.violation is not None:
        pytest.fail(report(outcome), pytrace=False)


def test_leases_end_on_both_sides_and_the_promise_is_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    looked: list[str] = []
    plain = Hosted.check_promise

    def check_promise(world: Hosted, query_id: str, origin: str, provider: str) -> None:
        looked.append(query_id)
        plain(world, query_id, origin, provider)

    monkeypatch.setattr(Hosted, "check_promise", check_promise)
    for seed in range(HOSTS_FIRST, HOSTS_FIRST + WORLDS):
        assert_kept(seed)
    assert looked


@pytest.mark.slow
@pytest.mark.timeout(240)
def test_more_worlds_keep_the_promise() -> None:
    for seed in range(HOSTS_FIRST + WORLDS, HOSTS_FIRST + 10 * WORLDS):
        assert_kept(seed)
    for seed in range(HOSTS_FIRST, HOSTS_FIRST + WORLDS // 4):
        assert_kept(seed, steps=4000)


# -- broken on purpose ---------------------------------------------------------------------------------------------


def counts_from_the_answer(patch: Patch) -> None:
    """The consumer counts from when it hears that its heartbeat was heard."""

    def acknowledge(hosts: SimHosts, lease: TakenLease, host: str, number: int) -> None:
        if lease.acknowledged(number, LEASE_S):
            lease.until = hosts.clock(host) + LEASE_S

    patch(SimHosts, "acknowledge", acknowledge)


def counts_from_the_sending(patch: Patch) -> None:
    """The provider counts from when a heartbeat was sent, by the clock of the other host."""
    patch(SimHosts, "hear", lambda _hosts, given, _host, sent: given.hear(sent))


def ignores_gaps(patch: Patch) -> None:
    """What the network has dropped is not missed."""

    def drop(world: Hosted, consumer: str, provider: str, way: int, place: int) -> None:
        queue = world.registrars[consumer].clients[provider].link.ways[way]
        del queue[place]
        if not queue:
            world.todo.discard(("net", consumer, provider, way))

    patch(Hosted, "drop", drop)


def forgets_its_fence(patch: Patch) -> None:
    """What is still on its way on the links of an ended lease is listened to."""
    patch(Hosted, "close_fenced", lambda *_: None)


def lets_in_too_early(patch: Patch) -> None:
    """A host gets new links before what it held is released."""
    patch(SimHosts, "barred", lambda *_: False)


def tells_nobody(patch: Patch) -> None:
    """The consumer's registrars do not hear that the lease is over."""
    in_tables(patch, reconciliation.lease_over, lambda _decision, _command: None)


def takes_late_answers(patch: Patch) -> None:
    """An answer that comes to a thread from an ended lease counts."""
    plain = reconciliation.lease_over

    def lease_over(decision: Decision, command: LeaseOver) -> None:
        plain(decision, command)
        decision.forget(decision.catalog.lapsed, command.registrar)

    in_tables(patch, plain, lease_over)


def knows_at_once(patch: Patch) -> None:
    """A gateway that was started again takes all hosts that have not come yet for such without a lease."""
    patch(SimHosts, "unknown_s", lambda _hosts: 0.0)


def looks_too_rarely(patch: Patch) -> None:
    """The consumer does not look whether its lease is over."""
    patch(Hosted, "end_leases", lambda _world: None)


MUTATIONS: dict[str, Callable[[Patch], None]] = {
    "the provider counts from the sending": counts_from_the_sending,
    "a gap ignored": ignores_gaps,
    "let in before it is released": lets_in_too_early,
    "nobody told": tells_nobody,
}


@pytest.mark.parametrize("name", MUTATIONS)
def test_a_broken_lease_is_noticed(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    MUTATIONS[name](monkeypatch.setattr)
    for seed in range(HOSTS_FIRST, HOSTS_FIRST + WORLDS_FOR_A_MUTATION):
        if run(seed).violation is not None:
            return
    pytest.fail(f"{name}: not noticed in {WORLDS_FOR_A_MUTATION} worlds")


# -- and in the world directed at it ---------------------------------------------------------------------------------

APP, CAM = "h0/app", "h1/cam"
LINK = [("wake", APP), ("dial", APP, CAM), ("net", APP, CAM, 0), ("wake", CAM), ("net", APP, CAM, 1), ("wake", APP)]
STARTED = [("register", CAM, "s0"), ("serve", CAM), ("wake", CAM), ("serve", APP)]
HELD = [
    *STARTED,
    ("load", "q1", APP, CAM, "s0", b"p"),
    *LINK,
    *(("net", APP, CAM, 0), ("wake", CAM), ("call", CAM, "load", "q1", 1, "ok"), ("wake", CAM)),
    *(("net", APP, CAM, 1), ("wake", APP)),
]
PARTED = ("part", (APP,), "hold")
OVER = [("tick", 120), ("lapse", "h1", "h0"), ("fence", CAM), ("wake", CAM)]

DRIFTING = {"h0": 0.957, "h1": 1.043}

DIRECTED: dict[str, tuple[Callable[[Patch], None], str, list[Step]]] = {
    "the consumer counts from the answer": (
        counts_from_the_answer,
        "leases",
        [
            *HELD,
            *(("beat", "h0", "h1"), ("beaten", "h0", "h1", 0), ("tick", 40), ("beaten", "h0", "h1", 1)),
            *(PARTED, ("tick", 70), ("lapse", "h1", "h0"), ("fence", CAM), ("wake", CAM)),
        ],
    ),
    "released before the margin": (
        lambda patch: patch(leases, "MARGIN", 0.0),
        "leases",
        [*HELD, PARTED, ("tick", 103), ("lapse", "h1", "h0"), ("fence", CAM), ("wake", CAM)],
    ),
    "released at once": (
        lambda patch: patch(GivenLease, "is_over", lambda _lease, _now: True),
        "leases",
        [*HELD, ("lapse", "h1", "h0"), ("fence", CAM), ("wake", CAM)],
    ),
    "an end not looked for": (looks_too_rarely, "leases", [*HELD, PARTED, *OVER]),
    "a fence forgotten": (
        forgets_its_fence,
        "fence",
        [
            *HELD,
            *(("load", "q2", APP, CAM, "s0", b"q"), ("wake", APP), PARTED, *OVER, ("heal",)),
            *(("net", APP, CAM, 0), ("wake", CAM)),
        ],
    ),
    "a late answer taken": (
        takes_late_answers,
        "acknowledged",
        [
            *HELD,
            *(("load", "q2", APP, CAM, "s0", b"q", True), ("line", "q2", 0), ("wake", CAM)),
            *(("call", CAM, "load", "q2", 1, "ok"), ("wake", CAM), PARTED, *OVER, ("heal",)),
            *(("line", "q2", 1), ("wake", APP)),
        ],
    ),
    "no grace after a start": (
        knows_at_once,
        "leases",
        [*HELD, PARTED, ("tick", 20), ("stumble", "h1"), ("known", "h1"), ("fence", CAM), ("wake", CAM)],
    ),
}


def directed(steps: list[Step]) -> Exception | None:
    """Return what breaks if these steps are done, and then everything comes to rest; all of them can be done."""
    world = World({APP: (), CAM: (Server("s0"),)}, rates=DRIFTING)
    try:
        for step in steps:
            world.apply(step)
        come_to_rest(world)
    except Violation as error:
        return error
    return None


@pytest.mark.parametrize("name", DIRECTED)
def test_a_broken_lease_is_noticed_in_the_world_directed_at_it(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    mutation, broken, steps = DIRECTED[name]
    assert directed(steps) is None
    mutation(monkeypatch.setattr)
    assert kind_of(directed(steps)) == broken
