"""References to actors of other processes: the same ask, tell, stop and proxy, picklable, good after a respawn."""

from __future__ import annotations

import asyncio
import functools
import gc
import logging
import multiprocessing
import os
import pickle
import signal
import subprocess
import threading
import time
import uuid
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pykka
import pytest

from rr_actors.actors.actor import Actor, ExitReport
from rr_actors.actors.messaging.futures import Reply
from rr_actors.actors.refs import ActorRef, DistantRef, ref_to
from rr_actors.actors.remote import peer
from rr_actors.actors.remote.hub import set_hub
from rr_actors.base.errors import ActorUnavailable, MailboxFull, NotSerializable, Unavailable, UsageError
from rr_actors.wire import unix_link
from rr_actors.wire.name_service import Presence, StateDir, open_state_dir
from support import Calls, Gate, eventually, hang
from support_refs import (
    Home,
    OddError,
    OpenedOn,
    Remote,
    RemoteAsync,
    end_process,
    forget_hubs,
    open_home,
    start_process,
)


@pytest.fixture(scope="module")
def neighbour(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[StateDir, subprocess.Popen[str]]]:
    """A system with another process, which all tests use that do not end it."""
    state = open_state_dir(tmp_path_factory.mktemp("neighbour") / "state")
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


Make = Callable[[str], ActorRef[Any]]


@pytest.fixture
def make(home: Home) -> Make:
    """Makes an actor of a class in the other process."""
    factory: Any = ref_to("root/factory").proxy()

    def make_actor(cls: str) -> ActorRef[Any]:
        id = f"a-{uuid.uuid4().hex[:8]}"
        factory.make(id, cls).get(timeout=10)
        return ref_to(f"root/{id}")

    return make_actor


@pytest.fixture(params=["Remote", "RemoteThread"])
def ref(request: pytest.FixtureRequest, make: Make) -> ActorRef[Any]:
    """An actor of the other process: one of ours, and a plain pykka.ThreadingActor."""
    return make(request.param)


@pytest.fixture
def ours(make: Make) -> ActorRef[Any]:
    return make("Remote")


# -- what Pykka's references do ----------------------------------------------------------------------------------------


def test_ask_reaches_an_actor_of_another_process(
    ref: ActorRef[Any], neighbour: tuple[StateDir, subprocess.Popen[str]]
) -> None:
    assert isinstance(ref, pykka.ActorRef)
    assert ref.ask("pid") == neighbour[1].pid
    assert ref.ask({"any": ["object", 1.5, None]}) == {"any": ["object", 1.5, None]}
    future = ref.ask("later", block=False)
    assert isinstance(future, pykka.Future)
    assert future.get(timeout=10) == "later"


def test_what_is_defined_in_a_function_travels_too(ref: ActorRef[Any]) -> None:
    class Local:
        def __init__(self, value: int) -> None:
            self.value = value

    factor = 3
    assert ref.ask(lambda actor: actor.size * factor) == 9
    assert ref.ask(lambda _: Local(7)).value == 7


def test_messages_arrive_in_the_order_they_were_sent(ref: ActorRef[Any]) -> None:
    for number in range(1000):
        ref.tell(number)
    assert ref.proxy().items.get(timeout=10) == list(range(1000))


def test_many_asks_in_flight_are_each_answered_with_their_own_reply(ref: ActorRef[Any]) -> None:
    futures = [ref.ask(number, block=False) for number in range(1000)]
    assert [future.get(timeout=10) for future in futures] == list(range(1000))


def test_a_proxy_calls_methods_reads_and_sets_attributes(ref: ActorRef[Any]) -> None:
    proxy: Any = ref.proxy()
    assert isinstance(proxy, pykka.ActorProxy)
    assert proxy.method(21, factor=2).get(timeout=10) == 42
    assert proxy.size.get(timeout=10) == 3
    setattr(proxy, "greeting", "good day")  # noqa: B010 - a type checker takes what is set for what is read
    assert proxy.greeting.get(timeout=10) == "good day"
    setattr(proxy, "added", "later")  # noqa: B010
    assert proxy.added.get(timeout=10) == "later"
    assert proxy.part.double(4).get(timeout=10) == 8
    assert proxy.method.defer(1) is None
    assert {"method", "greeting", "part"} <= set(dir(proxy))
    assert proxy == ref.proxy()
    assert hash(proxy) == hash(ref.proxy())
    assert proxy != proxy.part
    assert str(ref.path) in repr(proxy)


def test_a_proxy_says_which_attribute_there_is_not(ref: ActorRef[Any]) -> None:
    proxy: Any = ref.proxy()
    for name in ("nothing", "_private"):
        with pytest.raises(AttributeError, match=name):
            getattr(proxy, name)
    with pytest.raises(KeyError, match="lost"):
        proxy.fail("lost").get(timeout=10)


def test_the_class_of_a_distant_actor_is_known(ours: ActorRef[Any]) -> None:
    assert ours.actor_class is Remote


def test_stop_ends_the_actor_and_says_whether_it_was_alive(ref: ActorRef[Any]) -> None:
    assert ref.is_alive()
    assert not ref.actor_stopped.is_set()
    assert ref.stop() is True
    assert not ref.is_alive()
    assert ref.actor_stopped.is_set()
    assert ref.stop() is False
    assert ref.stop(block=False).get(timeout=10) is False


def test_what_was_sent_before_a_stop_is_handled_first(ref: ActorRef[Any]) -> None:
    before = [ref.ask(number, block=False) for number in range(50)]
    stopped = ref.stop(block=False)
    after = ref.ask("after", block=False)
    assert [future.get(timeout=10) for future in before] == list(range(50))
    assert stopped.get(timeout=10) is True
    with pytest.raises((pykka.ActorDeadError, ActorUnavailable)):
        after.get(timeout=10)


def test_pykkas_own_code_can_use_a_distant_reference(ref: ActorRef[Any]) -> None:
    assert pykka.ActorRef.ask(ref, "through Pykka", timeout=10) == "through Pykka"
    pykka.ActorRef.tell(ref, "told")
    assert ref.actor_inbox.empty()
    assert ref.proxy().items.get(timeout=10) == ["through Pykka", "told"]


def test_a_future_can_be_awaited_on_any_loop(ref: ActorRef[Any], home: Home) -> None:
    async def ask() -> Any:
        proxy: Any = ref.proxy() if not home.dispatcher.is_loop_thread() else None
        return await ref.ask("awaited", block=False), None if proxy is None else await proxy.method(2)

    assert asyncio.run(ask()) == ("awaited", 2)
    assert home.dispatcher.run(ask()) == ("awaited", None)


def test_an_async_handler_awaits_an_actor_of_another_process(make: Make) -> None:
    there, further = make("RemoteAsync"), make("Remote")
    assert there.ask((further, "through")) == "through"
    here = RemoteAsync.start()
    assert here.ask((there, "there")) == "there"


# -- errors ------------------------------------------------------------------------------------------------------------


def test_an_exception_comes_back_as_itself_with_the_traceback_from_there(ref: ActorRef[Any]) -> None:
    with pytest.raises(KeyError, match="lost") as raised:
        ref.proxy().fail("lost").get(timeout=10)
    (note,) = raised.value.__notes__
    assert f"raised by {ref.path} in" in note
    assert "raise KeyError(text)" in note
    assert ref.ask("alive") == "alive"


def test_an_exception_whose_init_takes_other_arguments_comes_back_as_itself(ref: ActorRef[Any]) -> None:
    with pytest.raises(OddError) as raised:
        ref.proxy().fail_oddly().get(timeout=10)
    assert type(raised.value) is OddError
    assert str(raised.value) == "this and that"
    assert (raised.value.left, raised.value.right) == ("this", "that")
    assert isinstance(raised.value.__cause__, KeyError)
    assert raised.value.__notes__[0] == "look there"
    assert "fail_oddly" in raised.value.__notes__[1]


def test_an_exception_of_a_class_of_the_other_side_alone_comes_back_as_itself(ref: ActorRef[Any]) -> None:
    def fail(_actor: Any) -> None:
        class Special(Exception):
            pass

        raise Special("made there")

    with pytest.raises(Exception, match="made there") as raised:
        ref.ask(fail)
    assert type(raised.value).__name__ == "Special"


def test_a_message_that_does_not_pickle_is_refused_at_the_sender_with_its_path(ref: ActorRef[Any]) -> None:
    message = {"fine": 1, "parts": [1, threading.Lock()]}
    for send in (ref.ask, ref.tell):
        with pytest.raises(NotSerializable, match=r"parts") as refused:
            send(message)
        assert str(ref.path) in str(refused.value)
        assert "parts" in refused.value.details["path"]
    assert ref.proxy().items.get(timeout=10) == []


def test_a_reply_that_does_not_pickle_is_the_askers_error_and_names_the_path(ref: ActorRef[Any]) -> None:
    with pytest.raises(NotSerializable, match="lock"):
        ref.ask("unpicklable")
    assert ref.ask("alive") == "alive"


def test_the_end_of_a_pipe_is_refused_both_ways_and_closes_nothing_there(ref: ActorRef[Any]) -> None:
    here, there = multiprocessing.Pipe()
    with here, there:
        ref.ask(_keep_pipe)
        for send in (ref.ask, ref.tell):
            with pytest.raises(
                NotSerializable, match=r"multiprocessing\.connection\.Connection.*reference of an actor"
            ):
                send({"report to": there})
        with pytest.raises(NotSerializable, match=r"reply of .*: cannot pickle 'multiprocessing\.connection\.Conn"):
            ref.ask(lambda actor: actor.pipe)
        assert ref.ask(_use_pipe) == "still open"


def _keep_pipe(actor: Any) -> None:
    actor.pipe, actor.other_end = multiprocessing.Pipe()


def _use_pipe(actor: Any) -> Any:
    gc.collect()
    actor.pipe.send("still open")
    return actor.other_end.recv()


def test_without_shared_memory_a_message_over_the_frame_limit_is_refused(tmp_path: Path) -> None:
    home, state = open_home(tmp_path / "state", frame_limit_bytes=100_000, segments_limit_bytes=0)
    try:
        home.start_other(a="Remote")
        ref = ref_to("root/a")
        with pytest.raises(NotSerializable, match="100000"):
            ref.ask(b"x" * 200_000)
        assert ref.ask("alive") == "alive"
    finally:
        home.close()
        state.close()


def test_a_reply_over_the_frame_limit_is_the_askers_error(ours: ActorRef[Any]) -> None:
    ours.ask(lambda actor: setattr(actor, "memfd_create", os.__dict__.pop("memfd_create")))  # no shared memory there
    try:
        with pytest.raises(NotSerializable):
            ours.ask(lambda _: b"x" * 20_000_000)
    finally:
        ours.ask(lambda actor: setattr(os, "memfd_create", actor.memfd_create))
    assert ours.ask("alive") == "alive"


def test_ask_times_out_and_a_late_reply_is_nobodys(ref: ActorRef[Any], home: Home) -> None:
    with pytest.raises(pykka.Timeout, match=str(ref.path)):
        ref.ask(lambda _: time.sleep(0.5), timeout=0.01)
    assert ref.ask("alive") == "alive"
    (line,) = home.hub.lines()
    eventually(lambda: line.open_calls == 0)


def test_ask_has_a_time_out_by_default(ours: ActorRef[Any], home: Home) -> None:
    home.hub.ask_timeout_s = 0.02
    with pytest.raises(pykka.Timeout):
        ours.ask(lambda _: time.sleep(0.5))
    home.hub.ask_timeout_s = 30.0
    assert ours.ask("alive") == "alive"


def test_a_process_that_does_not_say_what_an_actor_is_is_named(ours: ActorRef[Any], home: Home) -> None:
    pid = ours.ask("pid")
    home.hub.ask_timeout_s = 0.02
    hang(pid)
    try:
        with pytest.raises(pykka.Timeout, match=rf"no reply after 0\.02 seconds: the class of {ours.path}"):
            _ = ref_to(str(ours.path)).actor_class
    finally:
        os.kill(pid, signal.SIGCONT)


def test_a_full_mailbox_of_another_process_is_the_askers_error(make: Make) -> None:
    ref = make("RemoteSmall")
    gate = ref.ask(lambda _: time.sleep(0.5), block=False)
    futures = [ref.ask(number, block=False) for number in range(20)]
    gate.get(timeout=10)
    outcomes = Calls()
    for future in futures:
        try:
            outcomes(future.get(timeout=10))
        except MailboxFull as error:
            outcomes(error.details["limit"])
    assert 2 in outcomes.items[2:]
    assert ref.ask("alive") == "alive"


def test_a_process_that_does_not_read_fills_the_way_to_it_and_works_again_when_it_reads(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(peer, "WAITING_LIMIT", 200)
    monkeypatch.setattr(unix_link, "BUFFER_LIMIT_BYTES", 100_000)
    home, state = open_home(tmp_path / "state")
    try:
        other = home.start_other(a="Remote")
        ref = ref_to("root/a")
        assert ref.ask("alive") == "alive"
        other.send_signal(signal.SIGSTOP)
        sent, refused = _tell_until_refused(ref)
        assert "does not read" in str(refused)
        assert refused.details["limit"] == 200
        other.send_signal(signal.SIGCONT)
        eventually(lambda: _told(ref))
        assert ref.ask(lambda actor: len(actor.items)) == sent + 2  # and nothing that was taken got lost
    finally:
        home.close()
        state.close()


def _tell_until_refused(ref: ActorRef[Any]) -> tuple[int, MailboxFull]:
    for sent in range(100_000):
        try:
            ref.tell(b"x" * 10_000)
        except MailboxFull as refused:
            return sent, refused
        time.sleep(0.0001)  # the loop gets a turn
    raise AssertionError("never refused")


def _told(ref: ActorRef[Any]) -> bool:
    try:
        ref.tell("room again")
    except MailboxFull:
        return False
    return True


# -- where values are opened -------------------------------------------------------------------------------------------


def test_messages_are_opened_off_the_loop_there_and_replies_off_the_loop_here(ref: ActorRef[Any], home: Home) -> None:
    assert ref.ask(OpenedOn()) != "rr-loop"
    reply = ref.ask(lambda _: OpenedOn())
    assert reply.thread == "MainThread"

    async def ask() -> Any:
        return await ref.ask(lambda _: OpenedOn(), block=False)

    assert home.dispatcher.run(ask()).thread.startswith("rr-worker-")


def test_a_message_that_cannot_be_opened_there_is_the_askers_error_and_harms_nobody(ref: ActorRef[Any]) -> None:
    class Closed:
        def __reduce__(self) -> tuple[Any, ...]:
            return _fails_to_open, ()

    with pytest.raises(ZeroDivisionError):
        ref.ask(Closed())
    ref.tell(Closed())
    assert ref.ask("alive") == "alive"


def _fails_to_open() -> Any:
    if threading.current_thread().name != "MainThread" or not isinstance(signal.getsignal(signal.SIGINT), type):
        raise ZeroDivisionError("on the way in")


# -- references that travel --------------------------------------------------------------------------------------------


def test_references_pickle_and_are_equal_where_they_arrive(ours: ActorRef[Any]) -> None:
    copy = pickle.loads(pickle.dumps(ours))
    assert copy == ours
    assert hash(copy) == hash(ours)
    assert copy.ask("copy") == "copy"
    assert copy != ref_to("root/factory")
    assert (str(copy), repr(copy)) == (ours.path, f"<ActorRef for {ours.path}>")
    assert copy.actor_urn == f"urn:rr-actor:{ours.path}"


def test_an_actor_of_this_process_can_be_asked_from_another_one(ref: ActorRef[Any]) -> None:
    here = Remote.start()
    assert ref.proxy().ask_back(here, "from there").get(timeout=10) == "from there"
    assert here.proxy().items.get() == ["from there"]
    plain = ref.proxy().ask_back(here, "pid").get(timeout=10)
    assert plain == here.ask("pid")


def test_a_reference_that_comes_home_is_the_local_one(ours: ActorRef[Any]) -> None:
    here = Remote.start()
    assert ours.ask(here) is here


def test_an_unsupervised_actor_of_another_process_is_reached_by_its_address(home: Home, ours: ActorRef[Any]) -> None:
    other = home.start_other(b="Remote")
    another = ref_to("root/b").proxy().start_another().get(timeout=10)
    assert isinstance(another, DistantRef)
    assert another.ask("pid") == other.pid
    passed_on = ours.proxy().keep(another).get(timeout=10)
    assert passed_on is True
    assert another.stop() is True
    with pytest.raises(pykka.ActorDeadError):
        another.ask("anybody")


def test_a_supervised_actor_of_this_process_is_asked_directly(home: Home) -> None:
    local = home.host("root/here", Remote)
    by_path = ref_to("root/here")
    assert by_path == local
    lock = threading.Lock()
    assert by_path.ask(lock) is lock  # nothing is pickled
    assert by_path.actor_class is Remote
    assert by_path.proxy().method(2, factor=4).get() == 8
    by_path.tell("told")
    assert by_path.proxy().items.get() == [lock, "told"]
    assert pickle.loads(pickle.dumps(local)) == by_path
    assert by_path.stop() is True


def test_without_a_system_a_local_reference_does_not_pickle_and_says_why(home: Home) -> None:
    here = Remote.start()
    forget_hubs()
    try:
        with pytest.raises(NotSerializable, match="no System runs here"):
            pickle.dumps(here)
        with pytest.raises(ActorUnavailable, match="no System runs"):
            ref_to("root/a").ask("anybody")
    finally:
        set_hub(home.hub)


def test_without_a_system_no_actor_elsewhere_is_alive_in_an_async_handler_either(home: Home) -> None:
    class Looks(Actor):
        async def on_receive(self, message: Any) -> Any:
            return ref_to("root/a").is_alive()

    here = Looks.start()
    forget_hubs()
    try:
        assert ref_to("root/a").is_alive() is False
        assert here.ask("look") is False
    finally:
        set_hub(home.hub)


@pytest.mark.parametrize("limit", [-1, float("nan"), "1", True])
def test_a_time_limit_that_is_none_is_refused_before_anything_is_sent(ref: ActorRef[Any], limit: Any) -> None:
    here = Remote.start()
    for actor in (ref, here):
        for wait in (functools.partial(actor.ask, "told"), actor.stop, Reply().get):
            with pytest.raises(UsageError, match="timeout: expected seconds, 0 or more, or None for no limit, got"):
                wait(timeout=limit)
        assert actor.is_alive()
        assert actor.proxy().items.get() == []
    here.stop()


def test_an_actor_dead_error_that_a_handler_raises_is_about_the_actor_it_names(ref: ActorRef[Any], home: Home) -> None:
    home.host("root/here", Remote)
    with pytest.raises(pykka.ActorDeadError, match="root/nobody"):
        ref.ask(lambda _: ref_to("root/nobody").ask("anybody"))
    with pytest.raises(pykka.ActorDeadError, match="root/nobody"):
        ref_to("root/here").ask(lambda _: ref_to("root/nobody").ask("anybody"))
    assert ref.ask("alive") == "alive"


# -- death and respawn -------------------------------------------------------------------------------------------------


def test_an_actor_that_never_was_is_dead(home: Home) -> None:
    ref = ref_to("root/nobody")
    with pytest.raises(pykka.ActorDeadError, match="root/nobody"):
        ref.ask("anybody")
    with pytest.raises(pykka.ActorDeadError):
        ref.tell("anybody")
    with pytest.raises(pykka.ActorDeadError):
        ref.proxy()
    assert ref.stop() is False
    assert not ref.is_alive()


@pytest.mark.parametrize(
    ("status", "error"),
    [
        (Presence.STARTING, ActorUnavailable),
        (Presence.STOPPED, pykka.ActorDeadError),
        (Presence.GONE, pykka.ActorDeadError),
    ],
)
def test_the_directory_says_what_a_missing_actor_is(home: Home, status: Presence, error: type[Exception]) -> None:
    home.mark("root/a", status)
    ref = ref_to("root/a")
    with pytest.raises(error, match="root/a"):
        ref.ask("anybody")
    with pytest.raises(error):
        ref.tell("anybody")
    assert not ref.is_alive()


def test_open_asks_fail_when_the_process_is_killed_and_the_reference_works_again_after_the_respawn(home: Home) -> None:
    first = home.start_other(a="Remote")
    ref = ref_to("root/a")
    proxy: Any = ref.proxy()
    open_asks = [proxy.wait_for_ever(), ref.ask("behind it", block=False)]
    assert ref.is_alive()
    home.kill(first)
    for future in open_asks:
        with pytest.raises(ActorUnavailable, match="root/a is being started again"):
            future.get(timeout=10)
    with pytest.raises(ActorUnavailable):
        ref.ask("still marked as up")
    home.mark("root/a", Presence.STARTING)
    with pytest.raises(ActorUnavailable):
        ref.ask("starting")
    second = home.start_other(a="Remote")
    assert ref.ask("pid") == second.pid
    assert proxy.method(3).get(timeout=10) == 3
    home.kill(second)
    home.mark("root/a", Presence.GONE)
    with pytest.raises(pykka.ActorDeadError):
        ref.ask("gone")


def test_an_open_ask_fails_with_actor_dead_error_if_the_actor_is_gone_for_good(home: Home) -> None:
    other = home.start_other(a="Remote")
    future = ref_to("root/a").proxy().wait_for_ever()
    home.mark("root/a", Presence.GONE)
    home.kill(other)
    with pytest.raises(pykka.ActorDeadError):
        future.get(timeout=10)


def test_an_unsupervised_actor_dies_with_its_process(home: Home) -> None:
    other = home.start_other(a="Remote")
    another = ref_to("root/a").proxy().start_another().get(timeout=10)
    waiting = another.proxy().wait_for_ever()
    home.kill(other)
    with pytest.raises(pykka.ActorDeadError):
        waiting.get(timeout=10)
    with pytest.raises(pykka.ActorDeadError):
        another.ask("anybody")


def test_a_local_actor_that_is_respawned_in_place_keeps_its_reference(home: Home) -> None:
    first = home.host("root/here", Remote)
    ref = ref_to("root/here")
    gate = Gate()
    first.tell(lambda _: gate())
    gate.wait_arrived()
    waiting = ref.ask("behind", block=False)
    stopped = first.stop(block=False, reason="shutdown")
    gate.open()
    assert stopped.get(timeout=10) is True
    with pytest.raises(ActorUnavailable):
        waiting.get(timeout=10)
    home.hub.remove("root/here", first, ExitReport("shutdown"))
    with pytest.raises(ActorUnavailable):
        ref.ask("between")
    home.host("root/here", Remote)
    assert ref.ask("again") == "again"


def test_an_abandoned_actor_is_dead_for_everybody_else(home: Home) -> None:
    gate = Gate()
    stuck = home.host("root/stuck", Remote)
    ref = ref_to("root/stuck")
    stuck.tell(lambda _: gate())
    gate.wait_arrived()
    waiting = stuck.ask("behind", block=False)
    home.hub.remove("root/stuck", stuck, ExitReport("killed"))
    home.mark("root/stuck", Presence.GONE)
    with pytest.raises(pykka.ActorDeadError):
        waiting.get(timeout=10)
    with pytest.raises(pykka.ActorDeadError):
        ref.ask("anybody")
    gate.open()


def test_messages_told_to_a_process_that_dies_are_lost_and_logged(home: Home, caplog: pytest.LogCaptureFixture) -> None:
    other = home.start_other(a="Remote")
    home.kill(other)  # the directory does not know yet
    with caplog.at_level(logging.WARNING, "rr_actors"):
        ref_to("root/a").tell("into the void")
        eventually(lambda: "lost" in caplog.text)


def test_closing_the_hub_fails_open_asks(tmp_path: Path) -> None:
    home, state = open_home(tmp_path / "state")
    try:
        home.start_other(a="Remote")
        future = ref_to("root/a").proxy().wait_for_ever()
        ref_to("root/a").is_alive()
        home.dispatcher.run(_close(home))
        with pytest.raises(ActorUnavailable):
            future.get(timeout=10)
        with pytest.raises(Unavailable):
            ref_to("root/a").ask("anybody")
    finally:
        home.close()
        state.close()


async def _close(home: Home) -> None:
    home.hub.close()


# -- rings and blocking ------------------------------------------------------------------------------------------------


def test_a_ring_of_asks_through_two_processes_is_an_error(ours: ActorRef[Any], home: Home) -> None:
    class Asker(Actor):
        def ask_there(self) -> Any:
            return ours.ask(_ask_back(self.actor_ref))

    here = Asker.start()
    with pytest.raises(UsageError, match="ring of asks") as refused:
        here.proxy().ask_there().get(timeout=10)
    assert str(ours.path) in str(refused.value)
    assert here.is_alive()
    assert ours.ask("alive") == "alive"


def _ask_back(ref: Any) -> Callable[[Any], Any]:
    return lambda _: ref.ask("back")


def test_a_ring_of_asks_within_the_other_process_is_an_error(make: Make) -> None:
    a, b = make("Remote"), make("Remote")
    with pytest.raises(UsageError, match=f"{a} → {b} → {a}"):
        a.ask(lambda _: b.ask(lambda _: a.ask("back")))
    with pytest.raises(UsageError, match=f"{a} asks itself"):
        a.ask(lambda _: a.ask("myself"))


def test_blocking_on_a_distant_actor_is_refused_on_the_loop(ours: ActorRef[Any], home: Home) -> None:
    outcome = Calls()

    def block() -> None:
        for act in (lambda: ours.ask("x"), lambda: ours.stop(), lambda: ours.actor_class):
            try:
                outcome(act())
            except UsageError as error:
                outcome(error)

    home.dispatcher.call(block)
    assert [type(each) for each in outcome.wait(3)] == [UsageError] * 3


def test_where_waiting_is_refused_the_directory_says_whether_an_actor_is_alive(ours: ActorRef[Any], home: Home) -> None:
    alive = Calls()
    home.dispatcher.call(lambda: alive(ours.is_alive()))
    home.dispatcher.call(lambda: alive(ref_to("root/nobody").is_alive()))
    assert alive.wait(2) == [True, False]


def test_an_async_handler_uses_a_proxy_of_a_distant_actor(make: Make) -> None:
    there = make("Remote")

    class Caller(Actor):
        async def call(self) -> Any:
            proxy: Any = there.proxy()
            return await proxy.method(4, factor=2), await proxy.part.double(4), await proxy.size

        async def miss(self) -> Any:
            proxy: Any = there.proxy()
            return await proxy.nothing()

    here = Caller.start().proxy()
    assert here.call().get(timeout=10) == (8, 8, 3)
    with pytest.raises(AttributeError, match="nothing"):
        here.miss().get(timeout=10)


# -- the hub by itself -------------------------------------------------------------------------------------------------


def test_letters_of_the_wrong_side_close_the_link(home: Home, caplog: pytest.LogCaptureFixture) -> None:
    from rr_actors.actors.remote.protocol import Answered
    from rr_actors.wire.transport import Hello

    class Bystander:
        def received(self, link: Any, message: Any) -> None: ...

        def lost(self, link: Any, reason: Exception | None) -> None:
            lost(reason)

    lost = Calls()

    async def intrude() -> None:
        link = await home.transport.connect(
            home.hub.address, Hello("actors", "x", "intruder", 0), lambda _: Bystander()
        )
        link.send(Answered(1, b""))
        link.flush()

    with caplog.at_level(logging.ERROR, "rr_actors"):
        home.dispatcher.run(intrude())
        lost.wait()
    assert "sent Answered on a link that it opened" in caplog.text
