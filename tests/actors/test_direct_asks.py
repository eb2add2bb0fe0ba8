"""Asks by connections of their threads' own: which go so, that nothing overtakes anything, and what comes back."""

from __future__ import annotations

import contextlib
import os
import random
import signal
import subprocess
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pykka
import pytest

from rr_actors.actors.actor import Actor
from rr_actors.actors.refs import ActorRef, DistantReply, ref_to
from rr_actors.base.errors import MailboxFull, NotSerializable, UsageError
from rr_actors.wire.name_service import Presence, StateDir, open_state_dir
from support import Workshop, eventually, hang
from support_asks import Background, Puts, idle, in_threads, line_of, make_actor, warm
from support_refs import Home, OddError, Remote, end_process, open_home, start_process

KINDS = ["Remote", "RemoteAsync", "RemoteLoop", "RemoteThread"]


@pytest.fixture(scope="module")
def neighbour(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[StateDir, subprocess.Popen[str]]]:
    state = open_state_dir(tmp_path_factory.mktemp("asks") / "state")
    process = start_process(state.run_dir, state.key, factory="Factory")
    yield state, process
    end_process(process)
    state.close()


@pytest.fixture
def home(neighbour: tuple[StateDir, subprocess.Popen[str]]) -> Iterator[Home]:
    state, _ = neighbour
    home = Home(state.run_dir, state.key, "root")
    yield home
    home.close()


@pytest.fixture(params=["Remote", "RemoteLoop", "RemoteThread"])
def keeps(request: pytest.FixtureRequest, home: Home) -> ActorRef[Any]:
    """An actor of the other process that keeps what it is sent, of each kind."""
    return make_actor(request.param)


@pytest.fixture(params=KINDS)
def each(request: pytest.FixtureRequest, home: Home) -> ActorRef[Any]:
    """An actor of the other process, of each kind."""
    return make_actor(request.param)


@pytest.fixture
def ours(home: Home) -> ActorRef[Any]:
    ref = make_actor("Remote")
    warm(ref)
    return ref


@pytest.fixture
def puts(monkeypatch: pytest.MonkeyPatch) -> Puts:
    return Puts(monkeypatch)


# -- which way ---------------------------------------------------------------------------------------------------------


def test_asks_after_the_first_go_by_a_connection_of_the_threads_own(each: ActorRef[Any], puts: Puts) -> None:
    each.ask("first")
    before = len(puts.letters)
    assert [each.ask(number) for number in range(50)] == list(range(50))
    assert len(puts.letters) == before


def test_after_what_has_no_answer_an_ask_goes_by_the_link_and_the_next_does_not(
    each: ActorRef[Any], home: Home, puts: Puts
) -> None:
    warm(each)
    other = make_actor("Remote")
    for send in (lambda: each.tell("told"), lambda: other.tell("told")):
        warm(each)
        send()
        assert puts.by_link(lambda: each.ask("behind"))
        assert not puts.by_link(lambda: each.ask("again"))


def test_while_a_future_or_a_stop_is_open_asks_go_by_the_link(ours: ActorRef[Any], puts: Puts, tmp_path: Path) -> None:
    shop = Workshop(tmp_path / "shop")
    slow, other = make_actor("Remote"), make_actor("Remote")
    warm(ours)
    shop.shut("step")
    future = slow.ask(lambda _: shop.step("step"), block=False)
    assert puts.by_link(lambda: ours.ask("behind it"))  # whose answer settles it: it was the last
    assert not puts.by_link(lambda: ours.ask("again"))
    shop.open("step")
    future.get(timeout=10)
    shop.shut("stop")
    other.tell(lambda _: shop.step("stop"))
    stopped = other.stop(block=False)
    assert puts.by_link(lambda: ours.ask("behind it"))
    assert not puts.by_link(lambda: ours.ask("again"))
    shop.open("stop")
    assert stopped.get(timeout=10) is True
    assert not puts.by_link(lambda: ours.ask("again"))


def test_an_actor_of_another_process_that_is_monitored_can_be_asked_so(ours: ActorRef[Any], puts: Puts) -> None:
    class Watcher(Actor):
        def watch(self) -> None:
            self.monitor(ours)

    watcher: Any = Watcher.start().proxy()
    watcher.watch().get(timeout=10)
    assert puts.by_link(lambda: ours.ask("behind the watch"))
    assert not puts.by_link(lambda: ours.ask("again"))


def test_threads_that_ask_at_once_each_get_their_own_answers(ours: ActorRef[Any], home: Home, puts: Puts) -> None:
    there = [ours, make_actor("Remote"), make_actor("RemoteThread")]
    for ref in there:
        warm(ref)
    before = len(puts.letters)

    def ask(name: int) -> None:
        for number in range(60):
            assert there[number % 3].ask((name, number)) == (name, number)

    in_threads(*(lambda name=name: ask(name) for name in range(8)))
    assert len(puts.letters) == before
    assert 1 <= len(idle(line_of(home))) <= 8
    in_threads(*(lambda name=name: ask(name) for name in range(40)))
    assert len(idle(line_of(home))) <= 16


def test_many_threads_that_wait_take_few_file_descriptors(
    ours: ActorRef[Any], home: Home, puts: Puts, tmp_path: Path
) -> None:
    shop = Workshop(tmp_path / "shop")
    shop.shut("step")
    line = line_of(home)
    by_link = puts.asks()
    before = len(os.listdir("/proc/self/fd"))
    waiting = [Background(lambda: ours.ask(lambda _: shop.step("step"))) for _ in range(60)]
    eventually(lambda: len(line.connections.in_use) + puts.asks() - by_link == 60)
    assert len(os.listdir("/proc/self/fd")) <= before + 16
    shop.open("step")
    for each in waiting:
        each.result(timeout=20)


# -- nothing overtakes anything ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", range(3))
def test_what_each_thread_tells_and_asks_arrives_in_its_order(keeps: ActorRef[Any], seed: int) -> None:
    def send(name: int) -> None:
        chance = random.Random(f"{seed} {name}")
        for number in range(150):
            match chance.randrange(5):
                case 0:
                    keeps.tell((name, number))
                case 1:
                    keeps.ask((name, number), block=False)
                case _:
                    assert keeps.ask((name, number)) == (name, number)

    in_threads(*(lambda name=name: send(name) for name in range(4)))
    _in_order(keeps, 4, 150)


def _in_order(ref: ActorRef[Any], names: int, count: int) -> None:
    arrived = ref.proxy().items.get(timeout=10)
    for name in range(names):
        assert [number for sender, number in arrived if sender == name] == list(range(count))


def test_an_ask_behind_a_tell_finds_it_done(keeps: ActorRef[Any]) -> None:
    for number in range(300):
        warm(keeps)
        keeps.tell(number)
        assert keeps.ask(lambda actor: actor.items[-1]) == number


def test_what_was_told_to_one_actor_is_seen_by_who_is_asked_through_another(ours: ActorRef[Any]) -> None:
    through = [make_actor("Remote"), make_actor("RemoteThread")]

    def ask(name: int) -> None:
        for number in range(100):
            ours.tell((name, number))
            # The way through the other is the shorter one if it is direct.
            seen = through[number % 2].ask(lambda _: ours.ask(lambda actor: actor.items[-20:]))
            assert (name, number) in seen

    for other in through:
        warm(other)
    in_threads(*(lambda name=name: ask(name) for name in range(3)))


def _opens_when_let(root: str) -> str:
    Workshop(root).step("opening")
    return "slow"


class SlowToOpen:
    def __init__(self, root: Path) -> None:
        self.root = str(root)

    def __reduce__(self) -> tuple[Any, ...]:
        return _opens_when_let, (self.root,)


def test_an_ask_waits_for_what_was_told_before_and_is_slow_to_be_opened(
    keeps: ActorRef[Any], ours: ActorRef[Any], puts: Puts, tmp_path: Path
) -> None:
    """Another actor's answer says that it has come, not that it is in the mailbox: it may be opened in a worker."""
    shop = Workshop(tmp_path / "shop")
    warm(keeps)
    shop.shut("opening")
    keeps.tell(SlowToOpen(shop.root))
    shop.wait("opening")
    warm(ours)
    before = len(puts.letters)
    asked = Background(lambda: keeps.ask("behind it"))
    asked.thread.join(0.3)
    assert asked.thread.is_alive()
    assert len(puts.letters) == before
    shop.open("opening")
    assert asked.result() == "behind it"
    assert keeps.ask(lambda actor: actor.items[-2:]) == ["slow", "behind it"]


def test_what_is_sent_after_a_time_out_is_behind_what_was_asked(keeps: ActorRef[Any], home: Home) -> None:
    for number in range(50):
        warm(keeps)
        with contextlib.suppress(pykka.Timeout):  # it may be answered all the same
            keeps.ask(("asked", number), timeout=0.0)
        if number % 2:
            keeps.tell(("behind", number))
        else:
            keeps.ask(("behind", number))
    items = keeps.ask(lambda actor: [item for item in actor.items if item != "warm"])
    behind = [item for item in items if item[0] == "behind"]
    assert behind == [("behind", number) for number in range(50)]
    for place, item in enumerate(items):
        if item[0] == "asked":  # it arrives, or not at all
            assert items[place + 1] == ("behind", item[1])


def test_a_time_out_of_a_long_message_lets_nothing_pass(
    neighbour: tuple[StateDir, subprocess.Popen[str]], ours: ActorRef[Any], puts: Puts
) -> None:
    """The other process reads a long one in pieces: a short one on another connection would be there before it."""
    _, process = neighbour
    for size in (100_000, 150_000, 2_000_000):
        warm(ours)
        hang(process.pid)
        try:
            with pytest.raises(pykka.Timeout):
                ours.ask((size, b"x" * size), timeout=0.3)
            by_link = puts.asks()
            behind = Background(lambda size=size: ours.ask((size, b"behind")))
            eventually(lambda by_link=by_link: puts.asks() > by_link)
        finally:
            process.send_signal(signal.SIGCONT)
        behind.result()
        sizes = ours.ask(lambda actor: [len(item[1]) for item in actor.items if item != "warm"])
        assert sizes[-1] == len(b"behind")


# -- time limits -------------------------------------------------------------------------------------------------------


def test_a_time_out_says_the_same_as_by_the_link(home: Home) -> None:
    ours = make_actor("Remote")
    texts: set[str] = set()
    for _ in range(3):
        with pytest.raises(pykka.Timeout, match=str(ours.path)) as refused:
            ours.ask(lambda _: time.sleep(0.2), timeout=0.01)
        texts.add(str(refused.value))
        warm(ours)
    assert texts == {f"no reply after 0.01 seconds: the reply of {ours.path}"}


def test_a_late_answer_reaches_nobody(ours: ActorRef[Any], home: Home, tmp_path: Path) -> None:
    shop = Workshop(tmp_path / "shop")
    for number in range(10):
        warm(ours)
        connections = idle(line_of(home))
        shop.shut(f"late{number}")
        with pytest.raises(pykka.Timeout):
            ours.ask(lambda _, number=number: (shop.step(f"late{number}"), "late")[1], timeout=0.05)
        assert len(idle(line_of(home))) < len(connections)
        shop.open(f"late{number}")
        assert ours.ask(("behind", number)) == ("behind", number)
        assert ours.ask(("again", number)) == ("again", number)


def test_a_handler_at_work_holds_up_no_other_actor_after_a_time_out(ours: ActorRef[Any], tmp_path: Path) -> None:
    shop, other = Workshop(tmp_path / "shop"), make_actor("Remote")
    warm(ours)
    shop.shut("work")
    with pytest.raises(pykka.Timeout):
        ours.ask(lambda _: shop.step("work"), timeout=0.05)
    assert other.ask("at once", timeout=10) == "at once"
    shop.open("work")


def test_the_time_limit_is_of_both_ways_together(
    ours: ActorRef[Any], home: Home, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """An actor that is not to be had by the one is asked by the other within what is left."""
    shop = Workshop(tmp_path / "shop")
    limits: list[float | None] = []
    get = DistantReply.get

    def ask_now(*_: Any) -> bool:
        time.sleep(0.1)
        return False

    def note(reply: DistantReply, *, timeout: float | None = None) -> Any:
        limits.append(timeout)
        return get(reply, timeout=timeout)

    monkeypatch.setattr(home.hub, "ask_now", ask_now)
    monkeypatch.setattr(DistantReply, "get", note)
    shop.shut("work")
    with pytest.raises(pykka.Timeout, match=r"no reply after 0\.3 seconds"):
        ours.ask(lambda _: shop.step("work"), timeout=0.3)
    shop.open("work")
    (limit,) = limits
    assert limit is not None
    assert limit <= 0.2
    assert ours.ask("alive", timeout=None) == "alive"
    assert limits[-1] is None


# -- what comes back ---------------------------------------------------------------------------------------------------


def test_an_exception_says_the_same_as_by_the_link(ours: ActorRef[Any], puts: Puts) -> None:
    notes: list[str] = []
    for direct in (False, True):
        warm(ours)
        if not direct:
            ours.tell("settle it first")
        before = len(puts.letters)
        with pytest.raises(KeyError, match="what") as raised:
            ours.ask(lambda actor: actor.fail("what"))
        assert (len(puts.letters) == before) is direct
        notes.append("".join(raised.value.__notes__))
    assert notes[0] == notes[1]
    assert f"raised by {ours.path} in " in notes[1]
    assert "(pid " in notes[1].splitlines()[0]
    with pytest.raises(OddError, match="this and that"):
        ours.ask(lambda actor: actor.fail_oddly())


@pytest.mark.parametrize("kind", ["Remote", "RemoteLoop", "RemoteThread"])
def test_what_does_not_pickle_and_what_is_large_leave_the_connection_in_use(home: Home, puts: Puts, kind: str) -> None:
    ref = make_actor(kind)
    warm(ref)
    (connection,) = idle(line_of(home))
    before = len(puts.letters)
    with pytest.raises(NotSerializable, match="lock"):
        ref.ask({"lock": threading.Lock()})
    with pytest.raises(NotSerializable, match="lock"):
        ref.ask("unpicklable")
    assert ref.ask(b"x" * 17_000_000) == b"x" * 17_000_000
    assert ref.ask(lambda _: b"x" * 17_000_000) == b"x" * 17_000_000
    assert len(puts.letters) == before
    assert idle(line_of(home)) == [connection]


def test_a_full_mailbox_and_an_actor_that_has_ended_are_the_askers_errors(
    home: Home, puts: Puts, tmp_path: Path
) -> None:
    small, other, shop = make_actor("RemoteSmall"), make_actor("Remote"), Workshop(tmp_path / "shop")
    for ref in (small, other):
        warm(ref)
    shop.shut("busy")
    busy = small.ask(lambda _: shop.step("busy"), block=False)
    shop.wait("busy")
    for _ in range(2):
        small.tell("fills it")
    warm(other)
    with pytest.raises(MailboxFull, match="2"):
        small.ask("one more")
    shop.open("busy")
    busy.get(timeout=10)
    other.stop()
    home.mark(str(other.path), Presence.GONE)
    warm(small)
    before = len(puts.letters)
    with pytest.raises(pykka.ActorDeadError, match=str(other.path)):
        other.ask("anybody")
    assert len(puts.letters) == before


def test_a_proxy_and_asks_mix(ours: ActorRef[Any]) -> None:
    proxy: Any = ours.proxy()
    for number in range(50):
        setattr(proxy, "greeting", number)  # noqa: B010 - a type checker takes what is set for what is read
        assert ours.ask(lambda actor: actor.greeting) == number
        assert proxy.method(number, factor=2).get(timeout=10) == 2 * number
        assert proxy.part.double(number).get(timeout=10) == 2 * number


# -- where it must not wait --------------------------------------------------------------------------------------------


def test_a_ring_through_two_processes_is_an_error_with_both_ways_warm(ours: ActorRef[Any], home: Home) -> None:
    here = home.host(f"root/here-{ours.path.rpartition('/')[2]}", Remote)  # type: ignore[union-attr]
    back = ref_to(here.path)  # type: ignore[arg-type]
    for _ in range(3):
        assert ours.ask(lambda _: back.ask("back")) == "back"
        assert back.ask(lambda _: ours.ask("there")) == "there"
    for _ in range(3):
        with pytest.raises(UsageError, match="ring of asks") as refused:
            back.ask(lambda _: ours.ask(lambda _: back.ask("round")))
        assert str(ours.path) in str(refused.value)
    assert ours.ask("alive") == "alive"
    assert here.ask("alive") == "alive"


def test_an_async_handler_and_the_loop_are_refused_as_before(ours: ActorRef[Any], home: Home) -> None:
    class Impatient(Actor):
        async def on_receive(self, message: Any) -> Any:
            return ours.ask(message)

    with pytest.raises(UsageError, match="async def"):
        Impatient.start().ask("go")
    before = idle(line_of(home))

    async def on_loop() -> None:
        with pytest.raises(UsageError, match="loop"):
            ours.ask("blocks")

    home.dispatcher.run(on_loop())
    assert idle(line_of(home)) == before
    assert ours.ask("alive") == "alive"


def test_handlers_of_many_actors_ask_each_other_at_once(ours: ActorRef[Any], home: Home) -> None:
    class Caller(Actor):
        def on_receive(self, message: Any) -> Any:
            return [ours.ask((message, number)) for number in range(20)]

    callers = [Caller.start() for _ in range(10)]
    futures = [caller.ask(name, block=False) for name, caller in enumerate(callers)]
    for name, future in enumerate(futures):
        assert future.get(timeout=20) == [(name, number) for number in range(20)]


# -- limits that are set -----------------------------------------------------------------------------------------------


def test_the_frame_limit_of_the_configuration_holds(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    home, state = open_home(tmp_path / "state", frame_limit_bytes=100_000, segments_limit_bytes=0)
    try:
        home.start_other(a="Remote")
        ref = ref_to("root/a")
        warm(ref)
        puts = Puts(monkeypatch)
        with pytest.raises(NotSerializable, match="100000"):
            ref.ask(b"x" * 200_000)
        assert ref.ask(b"x" * 70_000) == b"x" * 70_000
        assert ref.ask("alive") == "alive"
        assert not puts.letters
    finally:
        home.close()
        state.close()
