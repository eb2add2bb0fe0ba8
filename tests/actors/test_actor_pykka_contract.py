"""What Pykka documents of actors holds for ours: each test runs with pykka.ThreadingActor and with Actor.

The last tests pin the private names of Pykka that rr_actors relies on, so that an upgrade that breaks it is seen here.
"""

from __future__ import annotations

import asyncio
import inspect
import queue
import threading
from collections.abc import Iterator
from types import TracebackType
from typing import Any

import pykka
import pytest
from pykka.messages import ProxyCall, ProxyGetAttr, ProxySetAttr

from rr_actors.actors.actor import Actor
from rr_actors.actors.messaging.futures import Reply
from support import Calls, eventually

Base = type[Any]
Event = tuple[str, Any]


class Traversable:
    """An attribute whose own methods the proxy reaches."""

    depth = 1

    def double(self, value: int) -> int:
        return 2 * value


def make_class(base: Base, heard: Calls) -> Base:
    """An actor class on `base` that notes what happens to it."""

    class Subject(base):
        plain = "class attribute"
        part = pykka.traversable(Traversable())

        def __init__(self, greeting: str = "hello") -> None:
            super().__init__()
            self.greeting = greeting
            self.items: list[Any] = []
            self._private = "hidden"

        def on_start(self) -> None:
            heard(("on_start", self.actor_ref.is_alive()))

        def on_stop(self) -> None:
            heard(("on_stop", self.actor_ref.is_alive()))

        def on_failure(
            self,
            exception_type: type[BaseException] | None,
            exception_value: BaseException | None,
            traceback: TracebackType | None,
        ) -> None:
            heard(("on_failure", (exception_type, str(exception_value), traceback is not None)))

        def on_receive(self, message: Any) -> Any:
            if message == "unexpected":
                return super().on_receive(message)
            if message == "stop yourself":
                self.stop()
                return "stopping"
            if isinstance(message, threading.Event):
                return message.wait(10)
            if isinstance(message, Exception):
                raise message
            self.items.append(message)
            return (self.greeting, message)

        def method(self, value: int, *, factor: int = 1) -> int:
            return value * factor

        def fail(self, text: str) -> None:
            raise ValueError(text)

        def where(self) -> int:
            return threading.get_ident()

        def later(self) -> None:
            self.items.append("first")
            self.actor_ref.proxy().even_later()
            self.items.append("second")

        def even_later(self) -> None:
            self.items.append("third")

        @property
        def computed(self) -> str:
            return self.greeting.upper()

    return Subject


@pytest.fixture(params=[pykka.ThreadingActor, Actor], ids=["pykka.ThreadingActor", "rr.Actor"])
def base(request: pytest.FixtureRequest) -> Iterator[Base]:
    yield request.param
    pykka.ActorRegistry.stop_all(timeout=10)


@pytest.fixture
def heard() -> Calls:
    return Calls()


@pytest.fixture
def cls(base: Base, heard: Calls) -> Base:
    return make_class(base, heard)


@pytest.fixture
def ref(cls: Base) -> Any:
    return cls.start(greeting="hi")


def events(heard: Calls) -> list[str]:
    return [name for name, _ in heard.items]


# -- start -------------------------------------------------------------------------------------------------------------


def test_start_passes_its_arguments_to_init_and_returns_a_reference(ref: Any, cls: Base) -> None:
    assert isinstance(ref, pykka.ActorRef)
    assert ref.actor_class is cls
    assert ref.actor_urn.startswith("urn:uuid:")
    assert ref.is_alive()
    assert ref.ask("you") == ("hi", "you")


def test_init_runs_in_the_thread_that_starts_the_actor(base: Base) -> None:
    class Curious(base):
        def __init__(self) -> None:
            super().__init__()
            self.thread = threading.get_ident()

        def own(self) -> int:
            return threading.get_ident()

    proxy = Curious.start().proxy()
    assert proxy.thread.get() == threading.get_ident()
    assert proxy.own().get() != threading.get_ident()


def test_an_exception_in_init_reaches_whoever_starts_the_actor(base: Base) -> None:
    class Broken(base):
        def __init__(self) -> None:
            raise ValueError("cannot be made")

    with pytest.raises(ValueError, match="cannot be made"):
        Broken.start()
    assert pykka.ActorRegistry.get_all() == []


def test_on_start_runs_before_the_first_message(ref: Any, heard: Calls) -> None:
    ref.ask("message")
    assert heard.items[0] == ("on_start", True)


def test_an_exception_in_on_start_ends_the_actor_without_on_stop_or_on_failure(base: Base, heard: Calls) -> None:
    class Broken(make_class(base, heard)):
        def on_start(self) -> None:
            heard(("on_start", None))
            raise ValueError("will not start")

    try:
        started = Broken.start()
    except ValueError:  # ours tells whoever starts it; Pykka's start() has returned by then
        assert base is Actor
    else:
        assert base is pykka.ThreadingActor
        eventually(lambda: not started.is_alive())
    eventually(lambda: pykka.ActorRegistry.get_all() == [])
    assert events(heard) == ["on_start"]


# -- ask and tell ------------------------------------------------------------------------------------------------------


def test_ask_returns_what_on_receive_returns(ref: Any) -> None:
    assert ref.ask({"any": "object"}) == ("hi", {"any": "object"})


def test_ask_without_blocking_returns_a_future(ref: Any) -> None:
    future = ref.ask("later", block=False)
    assert isinstance(future, pykka.Future)
    assert future.get(timeout=10) == ("hi", "later")
    assert future.get() == ("hi", "later")


def test_ask_times_out_with_pykkas_timeout(ref: Any) -> None:
    gate = threading.Event()
    with pytest.raises(pykka.Timeout):
        ref.ask(gate, timeout=0.02)
    gate.set()
    assert ref.ask("still there") == ("hi", "still there")


def test_a_future_times_out_and_can_be_asked_again(ref: Any) -> None:
    gate = threading.Event()
    future = ref.ask(gate, block=False)
    with pytest.raises(pykka.Timeout):
        future.get(timeout=0.02)
    gate.set()
    assert future.get(timeout=10) is True


def test_messages_are_handled_one_at_a_time_in_the_order_they_were_sent(ref: Any) -> None:
    for number in range(500):
        ref.tell(number)
    assert ref.proxy().items.get() == list(range(500))


def test_messages_of_many_threads_all_arrive_each_threads_in_order(ref: Any) -> None:
    def send(name: int) -> None:
        for number in range(200):
            ref.tell((name, number))

    threads = [threading.Thread(target=send, args=(name,)) for name in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    items = ref.proxy().items.get()
    assert len(items) == 800
    for name in range(4):
        assert [number for who, number in items if who == name] == list(range(200))


def test_the_default_on_receive_logs_a_warning_and_returns_none(ref: Any, caplog: pytest.LogCaptureFixture) -> None:
    assert ref.ask("unexpected") is None
    assert "Unexpected message received by" in caplog.text


def test_an_exception_under_ask_is_raised_by_the_asker_and_the_actor_lives_on(ref: Any, heard: Calls) -> None:
    with pytest.raises(KeyError, match="lost"):
        ref.ask(KeyError("lost"))
    assert ref.ask("alive") == ("hi", "alive")
    assert "on_failure" not in events(heard)


def test_the_traceback_of_an_exception_under_ask_leads_to_the_handler(ref: Any) -> None:
    with pytest.raises(ValueError, match="here") as raised:
        ref.proxy().fail("here").get()
    assert [entry.name for entry in raised.traceback][-1] == "fail"


def test_an_exception_under_tell_ends_the_actor_with_on_failure_and_not_on_stop(ref: Any, heard: Calls) -> None:
    ref.tell(ValueError("told"))
    assert heard.wait(2)[1] == ("on_failure", (ValueError, "told", True))
    eventually(lambda: not ref.is_alive())
    assert pykka.ActorRegistry.get_all() == []
    with pytest.raises(pykka.ActorDeadError):
        ref.ask("anybody")
    assert events(heard) == ["on_start", "on_failure"]


def test_an_exception_in_on_failure_is_logged_and_the_actor_ends(
    base: Base, heard: Calls, caplog: pytest.LogCaptureFixture
) -> None:
    class Broken(make_class(base, heard)):
        def on_failure(self, *_args: Any) -> None:
            raise RuntimeError("failing to fail")

    ref = Broken.start()
    ref.tell(ValueError("told"))
    eventually(lambda: "failing to fail" in caplog.text)
    eventually(lambda: not ref.is_alive())


# -- stop --------------------------------------------------------------------------------------------------------------


def test_stop_runs_on_stop_and_returns_true(ref: Any, heard: Calls) -> None:
    assert ref.stop() is True
    assert heard.items[-1] == ("on_stop", False)
    assert not ref.is_alive()
    assert pykka.ActorRegistry.get_all() == []


def test_stopping_a_dead_actor_returns_false(ref: Any, heard: Calls) -> None:
    ref.stop()
    assert ref.stop() is False
    assert events(heard).count("on_stop") == 1


def test_stop_without_blocking_returns_a_future(ref: Any) -> None:
    future = ref.stop(block=False)
    assert isinstance(future, pykka.Future)
    assert future.get(timeout=10) is True


def test_stop_times_out_while_a_message_is_being_handled(ref: Any) -> None:
    gate = threading.Event()
    ref.tell(gate)
    with pytest.raises(pykka.Timeout):
        ref.stop(timeout=0.02)
    gate.set()
    eventually(lambda: not ref.is_alive())


def test_messages_before_a_stop_are_handled_those_after_it_fail_with_actor_dead_error(ref: Any) -> None:
    gate = threading.Event()
    blocked = ref.ask(gate, block=False)
    before = ref.ask("before", block=False)
    stopped = ref.stop(block=False)
    after = ref.ask("after", block=False)
    again = ref.stop(block=False)
    gate.set()
    assert blocked.get(timeout=10) is True
    assert before.get(timeout=10) == ("hi", "before")
    assert stopped.get(timeout=10) is True
    with pytest.raises(pykka.ActorDeadError):
        after.get(timeout=10)
    assert again.get(timeout=10) is True


def test_a_dead_actor_refuses_ask_tell_and_proxy(ref: Any) -> None:
    proxy = ref.proxy()
    ref.stop()
    with pytest.raises(pykka.ActorDeadError):
        ref.ask("anybody")
    with pytest.raises(pykka.ActorDeadError):
        ref.ask("anybody", block=False).get()
    with pytest.raises(pykka.ActorDeadError):
        ref.tell("anybody")
    with pytest.raises(pykka.ActorDeadError):
        ref.proxy()
    with pytest.raises(pykka.ActorDeadError):
        proxy.method(1).get()


def test_an_actor_can_stop_itself_and_finishes_the_message_first(ref: Any, heard: Calls) -> None:
    assert ref.ask("stop yourself") == "stopping"
    eventually(lambda: not ref.is_alive())
    assert heard.wait(2)[-1] == ("on_stop", False)


def test_an_exception_in_on_stop_is_logged_and_the_actor_ends(
    base: Base, heard: Calls, caplog: pytest.LogCaptureFixture
) -> None:
    class Broken(make_class(base, heard)):
        def on_stop(self) -> None:
            raise RuntimeError("cannot clean up")

    ref = Broken.start()
    assert ref.stop() is True
    assert "cannot clean up" in caplog.text
    assert not ref.is_alive()


# -- proxies -----------------------------------------------------------------------------------------------------------


def test_a_proxy_calls_methods_with_arguments(ref: Any) -> None:
    proxy = ref.proxy()
    assert proxy.method(21, factor=2).get() == 42


def test_a_proxy_reads_and_sets_attributes(ref: Any) -> None:
    proxy = ref.proxy()
    assert proxy.greeting.get() == "hi"
    assert proxy.plain.get() == "class attribute"
    setattr(proxy, "greeting", "good day")  # noqa: B010 - a type checker takes what is set for what is read
    assert proxy.greeting.get() == "good day"
    assert proxy.computed.get() == "GOOD DAY"


def test_a_proxy_sees_attributes_made_after_it(ref: Any) -> None:
    proxy = ref.proxy()
    setattr(proxy, "added", 5)  # noqa: B010
    assert proxy.added.get() == 5


def test_a_proxy_has_no_private_or_unknown_attributes(ref: Any) -> None:
    proxy = ref.proxy()
    for name in ("_private", "nothing_of_that_name"):
        with pytest.raises(AttributeError, match=name):
            getattr(proxy, name)
    with pytest.raises(AttributeError):
        proxy.part.nothing_of_that_name  # noqa: B018


def test_a_proxy_goes_into_traversable_attributes(ref: Any) -> None:
    proxy = ref.proxy()
    assert proxy.part.double(4).get() == 8
    assert proxy.part.depth.get() == 1


def test_an_exception_of_a_proxied_method_is_raised_by_get_and_the_actor_lives_on(ref: Any) -> None:
    proxy = ref.proxy()
    with pytest.raises(ValueError, match="on purpose"):
        proxy.fail("on purpose").get()
    assert ref.is_alive()


def test_an_exception_of_a_deferred_method_ends_the_actor_with_on_failure(ref: Any, heard: Calls) -> None:
    assert ref.proxy().fail.defer("deferred") is None
    assert heard.wait(2)[1] == ("on_failure", (ValueError, "deferred", True))
    eventually(lambda: not ref.is_alive())


def test_an_exception_when_setting_an_attribute_is_raised_at_once(ref: Any) -> None:
    with pytest.raises(AttributeError):
        ref.proxy().computed = "read only"


def test_a_proxy_to_itself_schedules_work_behind_what_waits(ref: Any) -> None:
    proxy = ref.proxy()
    proxy.later().get()
    assert proxy.items.get() == ["first", "second", "third"]


def test_pykkas_messages_work_without_a_proxy(ref: Any) -> None:
    assert ref.ask(ProxyCall(attr_path=("method",), args=(2,), kwargs={"factor": 3})) == 6
    ref.ask(ProxySetAttr(attr_path=("greeting",), value="set"))
    assert ref.ask(ProxyGetAttr(attr_path=("greeting",))) == "set"


def test_proxies_are_equal_if_they_are_of_the_same_actor_and_part(ref: Any, cls: Base) -> None:
    assert ref.proxy() == ref.proxy()
    assert hash(ref.proxy()) == hash(ref.proxy())
    assert ref.proxy() != ref.proxy().part
    assert ref.proxy() != cls.start().proxy()
    assert "method" in dir(ref.proxy())


# -- futures -----------------------------------------------------------------------------------------------------------


def test_futures_map_filter_join_and_reduce(ref: Any) -> None:
    proxy = ref.proxy()
    assert proxy.method(3).map(lambda value: value + 1).get() == 4
    assert proxy.method(1).join(proxy.method(2), proxy.method(3)).get() == [1, 2, 3]
    joined = proxy.method(1).join(proxy.method(2), proxy.method(3))
    assert list(joined.filter(lambda value: value > 1).get()) == [2, 3]
    assert joined.reduce(lambda total, value: total + value, 10).get() == 16
    assert pykka.get_all([proxy.method(1), proxy.method(2)], timeout=10) == [1, 2]


def test_a_mapped_future_calls_its_function_once(ref: Any) -> None:
    calls = Calls()
    future = ref.proxy().method(3).map(calls)
    future.get()
    future.get()
    assert calls.items == [3]


def test_futures_can_be_awaited(ref: Any) -> None:
    async def main() -> Any:
        proxy = ref.proxy()
        with pytest.raises(ValueError, match="awaited"):
            await proxy.fail("awaited")
        mapped = await proxy.method(4).map(lambda value: value + 1)
        return (await proxy.method(2, factor=2), mapped, await ref.ask("asked", block=False))

    assert asyncio.run(main()) == (4, 5, ("hi", "asked"))


@pytest.mark.parametrize("future_class", [pykka.ThreadingFuture, Reply], ids=["pykka.ThreadingFuture", "Reply"])
class TestFuture:
    def test_a_value_can_be_set_once(self, future_class: Any) -> None:
        future = future_class()
        future.set("value")
        with pytest.raises(queue.Full):
            future.set("another")
        with pytest.raises(queue.Full):
            future.set_exception((ValueError, ValueError("late"), None))
        with pytest.raises(queue.Full):
            future.set_get_hook(lambda timeout: timeout)
        assert future.get() == "value"

    def test_set_without_a_value_sets_none(self, future_class: Any) -> None:
        future = future_class()
        future.set()
        assert future.get(timeout=0) is None

    def test_an_exception_is_raised_by_every_get(self, future_class: Any) -> None:
        future = future_class()
        try:
            raise ValueError("being handled")
        except ValueError:
            future.set_exception()
        for _ in range(2):
            with pytest.raises(ValueError, match="being handled"):
                future.get()

    def test_an_exception_class_alone_is_enough(self, future_class: Any) -> None:
        future = future_class()
        future.set_exception((ValueError, None, None))
        with pytest.raises(ValueError):
            future.get()

    def test_a_get_hook_makes_the_value_once_and_hears_the_time_out(self, future_class: Any) -> None:
        future = future_class()
        timeouts = Calls()
        future.set_get_hook(lambda timeout: (timeouts(timeout), "made")[1])
        assert future.get(timeout=3) == "made"
        assert future.get(timeout=4) == "made"
        assert timeouts.items == [3]
        with pytest.raises(queue.Full):
            future.set("too late")

    def test_all_waiters_wake_up(self, future_class: Any) -> None:
        future = future_class()
        got = Calls()
        threads = [threading.Thread(target=lambda: got(future.get(timeout=10))) for _ in range(5)]
        for thread in threads:
            thread.start()
        future.set("value")
        assert got.wait(5) == ["value"] * 5
        for thread in threads:
            thread.join()


# -- registry ----------------------------------------------------------------------------------------------------------


def test_the_registry_finds_running_actors(ref: Any, cls: Base) -> None:
    registry = pykka.ActorRegistry
    other = cls.start()
    assert registry.get_all() == [ref, other]
    assert registry.get_by_urn(ref.actor_urn) == ref
    assert registry.get_by_class(cls) == [ref, other]
    assert registry.get_by_class_name("Subject") == [ref, other]
    registry.broadcast("to all", "Subject")
    assert ref.proxy().items.get() == other.proxy().items.get() == ["to all"]


def test_the_registry_stops_all_last_started_first(base: Base) -> None:
    stopped = Calls()

    class Named(base):
        def __init__(self, name: str) -> None:
            super().__init__()
            self.name = name

        def on_stop(self) -> None:
            stopped(self.name)

    for name in "abc":
        Named.start(name)
    assert pykka.ActorRegistry.stop_all(timeout=10) == [True, True, True]
    assert stopped.items == ["c", "b", "a"]
    assert pykka.ActorRegistry.get_all() == []


# -- what rr_actors relies upon ----------------------------------------------------------------------------------------


def test_pykka_is_of_the_version_that_was_read() -> None:
    from importlib.metadata import version

    assert version("pykka").startswith("4.5.")


def test_the_hooks_for_actor_types_are_the_ones_that_rr_actors_fills_in() -> None:
    assert pykka.Actor.__abstractmethods__ == {"_create_actor_inbox", "_create_future", "_start_actor_loop"}


def test_a_reference_takes_from_its_actor_what_ours_has_when_it_is_made() -> None:
    source = inspect.getsource(pykka.ActorRef.__init__)
    used = {line.split("actor.")[1].split("(")[0].strip() for line in source.splitlines() if "= actor." in line}
    assert used == {"__class__", "actor_urn", "actor_inbox", "actor_stopped"}
    assert "_actor_weakref" in source


def test_private_names_that_are_used_exist_and_mean_what_they_did() -> None:
    from pykka._envelope import Envelope
    from pykka._introspection import AttrInfo, introspect_attrs
    from pykka.messages import _ActorStop  # pyright: ignore[reportPrivateUsage]

    assert Envelope.__slots__ == ["message", "reply_to"]
    assert _ActorStop() == ()
    assert AttrInfo._fields == ("callable", "traversable")
    assert list(inspect.signature(introspect_attrs).parameters) == ["root", "proxy"]
    assert list(inspect.signature(pykka.CallableProxy.__init__).parameters) == ["self", "actor_ref", "attr_path"]
    assert "    def _handle_receive(self, message:" in inspect.getsource(pykka.Actor)


def test_pykkas_own_reference_stops_an_actor_with_the_message_that_mailboxes_let_pass() -> None:
    assert "_ActorStop()" in inspect.getsource(pykka.ActorRef.stop)
    assert "_ActorStop" in inspect.getsource(pykka.Actor.stop)
