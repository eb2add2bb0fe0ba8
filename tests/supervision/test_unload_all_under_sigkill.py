"""A consumer that holds very much lets all of it go, and dies on the way, again and again.

RR_MANY says how much: 20,000 by default, 200,000 for a long run (`RR_MANY=200000`, some minutes).
"""

from __future__ import annotations

import os
import random
import threading
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

import rr_actors as rr
from support import child, eventually, kill, pid_of

Start = Callable[..., rr.System]
MANY = int(os.environ.get("RR_MANY", "20000"))
DEATHS = 5
LIMIT_S = 60.0 + MANY / 200
SHARED = 500


class Maker(rr.Manager):
    """Counts what it loads and unloads."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._counts: Counter[str] = Counter()

    @rr.server("thing")
    def load(self, request: int) -> int:
        with self._lock:
            self._counts["loads"] += 1
        return request

    @load.unload
    def unload(self, request: int, response: int) -> None:
        with self._lock:
            self._counts["unloads"] += 1

    def on_receive(self, message: Any) -> Any:
        with self._lock:
            return dict(self._counts)


class Holder(rr.Manager):
    """Holds many, and lets all of them go when told."""

    def on_receive(self, message: Any) -> Any:
        match message:
            case ("hold", first, last):
                self.registrar.load_all([("maker/thing", number) for number in range(first, last)], timeout_s=LIMIT_S)
            case "let go":
                threading.Thread(target=self.registrar.unload_all, daemon=True).start()
            case "let all go":
                self.registrar.unload_all(timeout_s=LIMIT_S)
            case _:
                return len(self.registrar.queries())
        return None


def _pid_of_successor(system: rr.System, pid: int) -> int:
    found = child(system, "holder")
    return found.pid or 0 if found.state == "running" and found.pid != pid else 0


@pytest.mark.slow
@pytest.mark.timeout(4 * LIMIT_S)
def test_what_a_dying_consumer_lets_go_is_let_go_once_and_the_rest_stays_held(start: Start, state_dir: Path) -> None:
    spec = rr.Supervisor([rr.ChildSpec(Maker, id="maker"), rr.ChildSpec(Holder, id="holder")], max_restarts=DEATHS)
    system = start(spec)
    app, chance = system.open_registrar("app"), random.Random(1)
    holder, maker = system.ref("holder"), system.ref("maker")
    for first in range(0, MANY, 5000):
        holder.ask(("hold", first, min(MANY, first + 5000)), timeout=LIMIT_S)
    shared = app.load_all([("maker/thing", number) for number in range(SHARED)])
    assert holder.ask("count", timeout=LIMIT_S) == MANY
    left = [MANY]
    for _ in range(DEATHS):
        pid = pid_of(system, "holder")
        holder.tell("let go")
        time.sleep(chance.uniform(0.0, MANY / 50_000))
        kill(system, "holder")
        eventually(lambda pid=pid: _pid_of_successor(system, pid), LIMIT_S, "the holder is back")
        left.append(holder.ask("count", timeout=LIMIT_S))
    assert left == sorted(left, reverse=True)
    assert left[-1] < MANY
    holder.ask("let all go", timeout=LIMIT_S)
    assert holder.ask("count", timeout=LIMIT_S) == 0
    provider = system.registrar("maker")
    eventually(lambda: provider.stats()["resources"] == SHARED, LIMIT_S, "only what is shared is left")
    assert maker.ask("count") == {"loads": MANY, "unloads": MANY - SHARED}
    assert [query.id for query in app.fetch_queries("maker")] == [query.id for query in shared]
    app.unload_all()
    assert maker.ask("count") == {"loads": MANY, "unloads": MANY}
    assert provider.resources() == []
