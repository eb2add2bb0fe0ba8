"""A system is killed at random moments of its calls about dynamic children: what was answered is so afterwards."""

from __future__ import annotations

import contextlib
import json
import os
import random
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

import rr_actors as rr
from support import LIMIT_S, TEST_PATHS, Workshop, eventually
from support_managers import Order, Shop

IDS = ("ttyS0", "ttyS1", "ttyS2")
ROUNDS = 5


def tree(placement: Any) -> rr.Supervisor:
    template = rr.ChildSpec(Shop, id="shop")
    return rr.Supervisor(
        [rr.Supervisor([template], id="pool", strategy="simple_one_for_one", placement=placement)], max_restarts=1000
    )


def work(state_dir: str, workshop: str, placement: str, seed: int) -> None:
    """Make random calls until the process is killed. Each is noted before it begins and when it is answered."""
    chance, shop = random.Random(seed), Workshop(workshop)

    def note(*words: object) -> None:
        shop.note("call", seed, json.dumps(words))

    with rr.System(tree(placement), state_dir=state_dir) as system:
        pool, app = system.supervisor("pool"), system.open_registrar("app")
        note("up", *sorted(child.id for child in pool.which_children() if child.state == "running"))
        while True:
            id = chance.choice(IDS)
            if id not in {child.id for child in pool.which_children()}:
                note("starts", id)
                pool.start_child([workshop], id=id)
                note("started", id)
            elif chance.random() < 0.5:
                note("ends", id)
                pool.terminate_child(id)
                note("ended", id)
            else:
                query = app.load(f"{id}/thing", Order(f"{id}-{chance.randrange(2)}"))
                if chance.random() < 0.3:
                    query.unload()


@pytest.mark.slow
@pytest.mark.timeout(240)
@pytest.mark.parametrize("placement", ["thread", "process"])
def test_what_was_answered_before_a_kill_is_so_after_it_and_nothing_is_left(
    state_dir: Path, workshop: Workshop, placement: str
) -> None:
    moment = random.Random(5)
    sure, unanswered = set[str](), set[str]()
    for seed in range(ROUNDS):
        calls = _killed(state_dir, workshop, placement, seed, moment.uniform(0.0, 2.0))
        there = set(calls[0][1:])
        assert sure <= there <= sure | unanswered, f"round {seed}"
        sure, unanswered = there, set()
        for call, id in calls[1:]:
            sure.discard(id)
            unanswered.discard(id)
            if call in ("starts", "ends"):
                unanswered.add(id)
            elif call == "started":
                sure.add(id)

    with rr.System(tree(placement), state_dir=state_dir) as system:
        system.open_registrar("app")
        pool = system.supervisor("pool")
        for child in pool.which_children():
            pool.terminate_child(child.id)
        eventually(lambda: system.dormant() == [])
    last = {line.split()[1]: line.split()[0] for line in workshop.lines() if line.split()[0] in ("made", "unload")}
    assert {*last.values()} == {"unload"}, "each thing that was made is unloaded at last"


def _killed(state_dir: Path, workshop: Workshop, placement: str, seed: int, after_s: float) -> list[list[str]]:
    """Have a process work until some moment after its start; return its calls."""
    arguments = f"{str(state_dir)!r}, {str(workshop.root)!r}, {placement!r}, {seed}"
    program = f"from test_kept_under_sigkill import work; work({arguments})"
    path = os.pathsep.join([TEST_PATHS, str(Path(__file__).parent)])
    process = subprocess.Popen(
        [sys.executable, "-c", f"if __name__ == '__main__': {program}"],
        env=dict(os.environ, PYTHONPATH=path),
        stderr=subprocess.DEVNULL,
    )
    try:
        workshop.wait(f"call {seed} ", timeout=3 * LIMIT_S)
        with contextlib.suppress(subprocess.TimeoutExpired):
            process.wait(after_s)
    finally:
        process.send_signal(signal.SIGKILL)
        process.wait()
    assert process.returncode == -signal.SIGKILL
    return [json.loads(line.partition(f"call {seed} ")[2]) for line in workshop.lines(f"call {seed} ")]
