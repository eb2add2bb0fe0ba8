"""Asks by connections of their threads' own when something goes: the process, the link, the system, the actor."""

from __future__ import annotations

import contextlib
import functools
import itertools
import os
import signal
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pykka
import pytest

import rr_actors as rr
from rr_actors.actors.actor import ExitReport
from rr_actors.actors.refs import ref_to
from rr_actors.actors.remote.hub import hub, set_hub
from rr_actors.base.errors import ActorUnavailable, RrError, Unavailable
from rr_actors.wire import thread_connections
from rr_actors.wire.name_service import Presence
from rr_actors.wire.transport import Exchange, Hello
from support import Workshop, child, eventually, hang, kill, pid_of, wait_gone, wait_respawned
from support_asks import Background, Puts, idle, in_threads, line_of, warm
from support_managers import Order, Shop
from support_refs import Home, Remote, open_home

MEGABYTE = b"x" * 1_000_000
Start = Callable[..., rr.System]


@pytest.fixture
def home(tmp_path: Path) -> Iterator[Home]:
    home, state = open_home(tmp_path / "state")
    yield home
    home.close()
    state.close()


def descriptors() -> int:
    return len(os.listdir("/proc/self/fd"))


def sockets() -> int:
    found = 0
    for entry in os.scandir("/proc/self/fd"):
        with contextlib.suppress(OSError):  # that of this very listing
            found += os.readlink(entry.path).startswith("socket:")
    return found


def descriptors_of(pid: int) -> int:
    return len(os.listdir(f"/proc/{pid}/fd"))


def workers_of_ours() -> int:
    return sum(thread.name.startswith("rr-") for thread in threading.enumerate())


def is_in_use(home: Home) -> bool:
    """Whether a thread waits by a connection of its own."""
    return bool(line_of(home).connections.in_use)


def limits_of_dialling(home: Home, monkeypatch: pytest.MonkeyPatch) -> list[float]:
    """The time limits, in seconds, of the connections that threads open from now on."""
    limits: list[float] = []
    dial = home.transport.dial

    def note(address: str, hello: Hello, timeout_s: float) -> Exchange:
        limits.append(timeout_s)
        return dial(address, hello, timeout_s)

    monkeypatch.setattr(home.transport, "dial", note)
    return limits


# -- a process that hangs ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("message", [b"short", MEGABYTE], ids=["short", "long"])
def test_the_time_limit_holds_while_the_process_hangs(home: Home, message: bytes) -> None:
    other = home.start_other(a="Remote", b="RemoteThread")
    refs = [ref_to("root/a"), ref_to("root/b")]
    for ref in refs:
        warm(ref)
        hang(other.pid)
        asked = Background(lambda ref=ref: ref.ask(message, timeout=0.2))
        with pytest.raises(pykka.Timeout, match=r"no reply after 0\.2 seconds"):
            asked.result(timeout=5)
        tells = Background(lambda ref=ref: ref.tell("behind"))
        tells.result(timeout=5)
        other.send_signal(signal.SIGCONT)
        assert ref.ask("alive") == "alive"
        items = [item for item in ref.ask(lambda actor: actor.items) if item != "warm"]
        assert items in ([message, "behind", "alive"], ["behind", "alive"])


def test_the_time_limit_of_a_long_load_holds_while_its_provider_hangs(start: Start, workshop: Workshop) -> None:
    system = start(rr.ChildSpec(Shop, id="shop", args=(str(workshop.root),)))
    app = system.open_registrar("app")
    app.load("shop/thing", Order("warm")).unload()
    app.load("shop/thing", Order("warm")).unload()
    pid = pid_of(system, "shop")
    hang(pid)
    try:
        load = Background(lambda: app.load("shop/thing", Order("x" * 1_000_000), timeout_s=0.3))
        with pytest.raises(rr.LoadTimeout):
            load.result(timeout=10)
    finally:
        os.kill(pid, signal.SIGCONT)
    assert app.load("shop/thing", Order("after it")).response is not None
    eventually(lambda: [query.request.name for query in app.queries()] == ["after it"])


def test_a_process_too_busy_to_shake_hands_is_asked_by_the_link_and_not_dialled_again_for_a_second(
    home: Home, monkeypatch: pytest.MonkeyPatch
) -> None:
    other = home.start_other(a="Remote", b="Remote")
    ref = ref_to("root/a")
    assert ref.ask("by the link") == "by the link"
    dialled = limits_of_dialling(home, monkeypatch)
    now = time.monotonic()

    class Clock:
        monotonic = staticmethod(lambda: now)

    monkeypatch.setattr(thread_connections, "time", Clock)
    puts = Puts(monkeypatch)
    hang(other.pid)
    busy = Background(lambda: ref.ask("while it hangs"))
    eventually(lambda: puts.asks() == 1)
    other.send_signal(signal.SIGCONT)
    assert busy.result() == "while it hangs"
    for number in range(5):
        assert ref.ask(number) == number
    assert len(dialled) == 1
    assert puts.asks() == 6
    now += 1.01
    assert ref.ask("directly") == "directly"
    assert len(dialled) == 2
    assert puts.asks() == 6


def test_dialling_a_process_that_hangs_does_not_go_beyond_a_short_time_limit(
    home: Home, monkeypatch: pytest.MonkeyPatch
) -> None:
    other = home.start_other(a="Remote")
    ref = ref_to("root/a")
    assert ref.ask("by the link") == "by the link"
    limits = limits_of_dialling(home, monkeypatch)
    hang(other.pid)
    with pytest.raises(pykka.Timeout, match=r"no reply after 0\.02 seconds"):
        ref.ask("while it hangs", timeout=0.02)
    other.send_signal(signal.SIGCONT)
    assert limits == [0.02]
    assert ref.ask("alive") == "alive"


# -- a process that dies -----------------------------------------------------------------------------------------------


def test_threads_that_ask_a_process_that_is_killed_hear_it_at_once_and_ask_the_next_one(
    home: Home, tmp_path: Path
) -> None:
    shop = Workshop(tmp_path / "shop")
    ref = ref_to("root/a")
    numbers = itertools.count()
    done = threading.Event()

    def ask_once(number: int) -> tuple[int, str]:
        try:
            ref.ask(lambda _: shop.note("handled", number), timeout=20)
        except (ActorUnavailable, pykka.ActorDeadError) as error:
            return number, type(error).__name__
        return number, ""

    def ask() -> list[tuple[int, str]]:
        outcomes: list[tuple[int, str]] = []
        while not done.is_set():
            outcomes.append(ask_once(next(numbers)))
        return outcomes

    other = home.start_other(a="Remote")
    warm(ref)
    threads = [Background(ask) for _ in range(4)]
    for _ in range(4):
        seen = len(shop.lines("handled"))
        eventually(lambda seen=seen: len(shop.lines("handled")) > seen + 20)
        home.kill(other)
        home.mark("root/a", Presence.STARTING)
        other = home.start_other(a="Remote")
    done.set()
    outcomes = [outcome for each in threads for outcome in each.result(timeout=15)]
    handled = [int(line.split()[1]) for line in shop.lines("handled")]
    assert len(handled) == len(set(handled))
    answered = {number for number, error in outcomes if not error}
    assert answered <= set(handled)
    assert {error for _, error in outcomes} == {"", "ActorUnavailable"}
    warm(ref)
    assert ref.ask("pid") == other.pid


def test_a_thread_in_an_exchange_hears_at_once_that_the_process_was_killed(home: Home) -> None:
    other = home.start_other(a="Remote")
    ref = ref_to("root/a")
    for status, error in ((Presence.UP, ActorUnavailable), (Presence.GONE, pykka.ActorDeadError)):
        warm(ref)
        waiting = Background(lambda: ref.ask(lambda actor: actor.wait_for_ever(), timeout=None))
        eventually(lambda: is_in_use(home))
        if status is Presence.GONE:
            home.mark("root/a", status)
        home.kill(other)
        with pytest.raises(error, match="root/a"):
            waiting.result(timeout=5)
        if status is Presence.UP:
            other = home.start_other(a="Remote")
            assert eventually(lambda: ref.ask("pid")) == other.pid


def test_no_descriptor_and_no_thread_is_left_of_a_process_that_died(home: Home) -> None:
    ref = ref_to("root/a")

    def ask_at_once() -> None:
        barrier = threading.Barrier(8)

        def ask() -> None:
            barrier.wait(10)
            for number in range(20):
                assert ref.ask(number) == number

        in_threads(*[ask] * 8)
        with pytest.raises(pykka.Timeout):
            ref.ask(lambda _: time.sleep(0.2), timeout=0.01)

    counts: list[int] = []
    for _ in range(3):
        other = home.start_other(a="Remote")
        ref.ask("first")
        ask_at_once()
        home.kill(other)
        other.communicate()
        eventually(lambda: not home.hub.lines())
        eventually(lambda: not counts or descriptors() <= counts[0], what="descriptors")
        counts.append(descriptors())
    home.others.clear()


def test_the_other_process_keeps_nothing_of_who_has_left(home: Home) -> None:
    other = home.start_other(a="Remote", b="RemoteThread")
    warm(ref_to("root/a"))
    before = descriptors_of(other.pid)
    in_threads(*[lambda: warm(ref_to("root/a"))] * 8)
    with pytest.raises(pykka.Timeout):
        ref_to("root/b").ask(lambda _: time.sleep(0.1), timeout=0.01)
    warm(ref_to("root/a"))
    # two for each connection: its own, and the outlet's
    assert descriptors_of(other.pid) <= before + 2 * len(idle(line_of(home))) + 2
    line = line_of(home)
    home.dispatcher.call(line.close)
    eventually(lambda: not home.hub.lines())
    eventually(lambda: descriptors_of(other.pid) <= before - 2, what="descriptors")


# -- the link, the hub, the system -------------------------------------------------------------------------------------


def test_a_thread_in_an_exchange_hears_that_the_link_is_lost(home: Home) -> None:
    home.start_other(a="Remote")
    ref = ref_to("root/a")
    warm(ref)
    waiting = Background(lambda: ref.ask(lambda actor: actor.wait_for_ever(), timeout=None))
    eventually(lambda: is_in_use(home))
    home.dispatcher.call(line_of(home).close)
    with pytest.raises(ActorUnavailable, match="root/a"):
        waiting.result(timeout=5)


@pytest.mark.parametrize("message", ["waits", "writes"])
def test_a_thread_in_an_exchange_hears_that_the_hub_is_closed(home: Home, message: str) -> None:
    other = home.start_other(a="Remote")
    ref = ref_to("root/a")
    warm(ref)
    before = descriptors()
    if message == "waits":
        waiting = Background(lambda: ref.ask(lambda actor: actor.wait_for_ever(), timeout=None))
    else:
        hang(other.pid)
        waiting = Background(lambda: ref.ask(MEGABYTE, timeout=None))
    eventually(lambda: is_in_use(home))

    async def close() -> None:
        home.hub.close()

    home.dispatcher.run(close())
    with pytest.raises(ActorUnavailable):
        waiting.result(timeout=5)
    with pytest.raises(Unavailable):
        ref.ask("anybody")
    eventually(lambda: descriptors() <= before - 2, what="descriptors of the link and the connection")


class Slow(rr.Actor):
    """Waits where the test says so."""

    def __init__(self, root: str) -> None:
        self.shop = Workshop(root)

    def on_receive(self, message: Any) -> Any:
        if isinstance(message, str) and message.startswith("step"):
            self.shop.step(message)
        return os.getpid() if message == "pid" else message


def test_system_stop_lets_threads_go_that_are_in_an_exchange(start: Start, workshop: Workshop) -> None:
    before_sockets = sockets()
    for _ in range(2):
        system = start(rr.ChildSpec(Slow, id="slow", args=(str(workshop.root),), shutdown_s=0.1))
        ref = system.ref("slow")
        warm(ref)
        workshop.shut("step")
        before = len(workshop.lines("step"))
        waiting = [Background(functools.partial(ref.ask, "step", timeout=None)) for _ in range(3)]
        workshop.wait("step", before + 1)
        system.stop()
        for each in waiting:
            with pytest.raises((ActorUnavailable, pykka.ActorDeadError)):
                each.result(timeout=10)
        with pytest.raises(pykka.ActorDeadError, match="its system has stopped"):
            ref.ask("anybody")
        eventually(lambda: workers_of_ours() == 0)
        eventually(lambda: sockets() <= before_sockets, what="sockets")
        workshop.open("step")


def test_two_systems_one_after_another_and_at_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def run(name: str) -> rr.System:
        spec = rr.ChildSpec(Slow, id="slow", args=(str(tmp_path / name),))
        system = rr.System([spec], state_dir=tmp_path / name)
        system.start()
        return system

    first = run("first")
    ref = first.ref("slow")
    warm(ref)
    pid = ref.ask("pid")
    first.stop()
    second = run("first")
    try:
        assert second.ref("slow").ask("pid") != pid
        warm(second.ref("slow"))
        warm(ref)
        assert ref.ask("pid") == second.ref("slow").ask("pid")
    finally:
        second.stop()


def test_two_homes_at_once_keep_their_connections_apart(tmp_path: Path) -> None:
    first, first_state = open_home(tmp_path / "first")
    first.start_other(a="Remote")
    ref = ref_to("root/a")
    warm(ref)
    line = line_of(first)
    second, second_state = open_home(tmp_path / "second")  # the newest answers for "root" from now on
    try:
        other = second.start_other(a="Remote")
        assert ref.ask("pid") == other.pid
        warm(ref)
        assert line_of(second) is not line
        set_hub(first.hub)
        assert ref.ask("pid") == first.others[0].pid
        warm(ref)
        assert line_of(first) is line
    finally:
        second.close()
        first.close()
        for state in (first_state, second_state):
            state.close()
    assert hub() is None


def test_a_forked_child_uses_none_of_its_parents_connections(home: Home) -> None:
    home.start_other(a="Remote")
    ref = ref_to("root/a")
    warm(ref)
    (connection,) = idle(line_of(home))
    child_pid = os.fork()
    if child_pid == 0:
        try:
            ref.ask("from the child", timeout=2)
        except RrError as error:
            os._exit(0 if "forked" in str(error) else 1)
        except BaseException:
            os._exit(2)
        os._exit(3)
    _, status = os.waitpid(child_pid, 0)
    assert os.waitstatus_to_exitcode(status) == 0
    assert ref.ask(lambda actor: actor.items) == ["warm"] * 3
    assert idle(line_of(home)) == [connection]


# -- the actor ---------------------------------------------------------------------------------------------------------


def test_an_actor_that_lives_in_another_process_now_is_asked_there(home: Home) -> None:
    first = home.start_other(a="Remote", keeps="Remote")
    ref = ref_to("root/a")
    warm(ref)
    warm(ref_to("root/keeps"))
    assert ref.ask("pid") == first.pid
    ref.stop()
    home.mark("root/a", Presence.STARTING)
    with pytest.raises(ActorUnavailable):
        ref.ask("between")
    second = home.start_other(a="Remote")
    warm(ref_to("root/keeps"))
    for _ in range(3):
        assert ref.ask("pid") == second.pid
    assert ref.ask(lambda actor: actor.items) == []
    warm(ref_to("root/keeps"))


def test_what_an_actor_ended_with_is_not_asked_again_elsewhere(home: Home, tmp_path: Path) -> None:
    """It is up again in another process when its asker hears that it has ended: it had the message all the same."""
    shop = Workshop(tmp_path / "shop")
    home.start_other(a="Remote", keeps="Remote")
    ref = ref_to("root/a")
    warm(ref)
    shop.shut("poison")

    def poison(_actor: Any) -> None:
        shop.step("poison")
        raise SystemExit

    waiting = Background(lambda: ref.ask(poison))
    shop.wait("poison")
    second = home.start_other(a="Remote")  # as after an abandoned one
    shop.open("poison")
    with pytest.raises((ActorUnavailable, pykka.ActorDeadError)):
        waiting.result()
    assert len(shop.lines("poison")) == 1
    assert ref_to("root/a").ask("pid") == second.pid


def test_an_abandoned_actor_is_dead_for_those_that_ask_so(home: Home, tmp_path: Path) -> None:
    shop = Workshop(tmp_path / "shop")
    home.start_other(a="Remote", other="Remote")
    ref, other = ref_to("root/a"), ref_to("root/other")
    warm(ref)
    shop.shut("stuck")
    stuck = Background(lambda: ref.ask(lambda _: (shop.step("stuck"), "late")[1]))
    shop.wait("stuck")
    behind = Background(lambda: ref.ask("behind it"))
    eventually(lambda: other.ask(_waiting) == 1)
    home.mark("root/a", Presence.GONE)
    other.ask(_abandon)
    with pytest.raises(pykka.ActorDeadError):
        behind.result()
    with pytest.raises(pykka.ActorDeadError):
        ref.ask("anybody")
    shop.open("stuck")
    assert stuck.result() == "late"


def _waiting(_actor: Any) -> int:
    own = Home.own
    assert own is not None
    found: Any = own.hub.local("urn:rr-actor:root/a")
    return len(found.actor_inbox)


def _abandon(_actor: Any) -> None:
    own = Home.own
    assert own is not None
    found: Any = own.hub.local("urn:rr-actor:root/a")
    own.hub.remove("root/a", found, ExitReport("killed"))


def test_an_actor_that_comes_home_is_asked_here(home: Home, monkeypatch: pytest.MonkeyPatch) -> None:
    home.start_other(a="Remote", keeps="Remote")
    ref = ref_to("root/a")
    warm(ref)
    ref.stop()
    home.host("root/a", Remote)
    puts = Puts(monkeypatch)
    assert ref.ask("pid") == os.getpid()
    assert not puts.letters


def test_killed_children_of_a_system_are_asked_again_after_their_respawn(start: Start, workshop: Workshop) -> None:
    system = start(rr.ChildSpec(Slow, id="slow", args=(str(workshop.root),)))
    ref = system.ref("slow")
    for _ in range(3):
        warm(ref)
        workshop.shut("step")
        before = len(workshop.lines("step"))
        waiting = Background(lambda: ref.ask("step", timeout=None))
        workshop.wait("step", before + 1)
        pid = kill(system, "slow")
        with pytest.raises(ActorUnavailable):
            waiting.result(timeout=5)
        wait_gone(pid)
        workshop.open("step")
        new = wait_respawned(system, "slow", pid)
        assert eventually(lambda: ref.ask("pid")) == new
    eventually(lambda: child(system, "slow").state == "running")
