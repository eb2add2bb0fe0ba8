"""Messages between actors in recordings: each where it is sent and handled, with its cause, over all processes."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pykka
import pytest

import rr_actors as rr
from rr_actors.registrar.model.recorded import Entry
from rr_actors.system.recording.sequence_diagrams import sequence_of
from support import eventually

Start = Callable[..., rr.System]


class Pong(rr.Actor):
    """Adds one; "raise" raises, and "ended" is a message to an actor that has ended."""

    def on_receive(self, message: Any) -> Any:
        if message == "raise":
            raise ValueError("no number")
        if message == "poison":
            os._exit(3)
        return message + 1 if isinstance(message, int) else None

    def twice(self, value: int) -> int:
        return 2 * value


class Ping(rr.Actor):
    """Sends as its message says: for ("ask", ref, 1, 2) it asks the actor of `ref` with each number."""

    def on_receive(self, message: Any) -> Any:
        match message:
            case ("ask", pong, *numbers):
                return [pong.ask(number) for number in numbers]
            case ("ask async", pong, number):
                return pong.ask(number, block=False).get(timeout=30)
            case ("tell", pong, number):
                pong.tell(number)
            case ("later", pong, number):
                rr.send_after(0.01, pong, number)
            case ("watch", pong):
                self.monitor(pong)
            case _:
                pass
        return None


class Cameras(rr.Manager):
    """Asks an actor in its load callback."""

    @rr.server("camera")
    def open_camera(self, name: str) -> int:
        return int(self.ref("pong").ask(len(name)))


@pytest.fixture(params=["process", "thread"])
def system(request: pytest.FixtureRequest, start: Start) -> rr.System:
    def child(actor: type, id: str) -> rr.ChildSpec:
        return rr.ChildSpec(actor, id=id, placement=request.param, restart="permanent")

    return start(child(Pong, "pong"), child(Ping, "ping"), child(Cameras, "cameras"))


def said(trace: rr.Trace) -> list[str]:
    """What a trace says, in a line each: "ping>pong Ask 1" where it is sent, "pong Ask" where it is handled."""

    def name(path: str) -> str:
        return path.rpartition("/")[2]

    return [
        f"{name(entry.registrar)}>{name(entry.peer)} {entry.name} {entry.detail}"
        if entry.event == "sent"
        else f"{name(entry.registrar)} {entry.name}"
        for entry in trace.entries
        if entry.event in ("sent", "received")
    ]


def wait_for(recording: rr.Recording, *actors: str, expected: list[str]) -> None:
    """Return when the messages of these actors have these lines: each process sends its own a moment later."""

    def arrived() -> bool:
        try:
            return set(expected) <= set(said(recording.messages(*actors)))
        except rr.NotFound:
            return False

    eventually(arrived, what=f"{expected} recorded")


def id_of(recording: rr.Recording, kind: str) -> str:
    """The id of the first message of a kind."""
    return next(entry.query for entry in recording.entries() if entry.name == kind)


def test_an_ask_has_its_answer_and_what_its_handler_asked(system: rr.System) -> None:
    with system.record() as recording:
        assert system.ref("ping").ask(("ask", system.ref("pong"), 1, 2)) == [2, 3]
        expected = [
            "ping Ask",
            "ping>pong Ask 1",
            "pong Ask",
            "pong>ping Answer 2",
            "ping Answer",
            "ping>pong Ask 2",
            "pong>ping Answer 3",
        ]
        wait_for(recording, expected=[*expected, "ping>root Answer [2, 3]", "root Answer"])
        trace = recording.trace(id_of(recording, "Ask"))
        assert said(trace) == [
            f"root>ping Ask ('ask', {system.ref('pong')!r}, 1, 2)",
            *expected[:5],
            "ping>pong Ask 2",
            "pong Ask",
            "pong>ping Answer 3",
            "ping Answer",
            "ping>root Answer [2, 3]",
            "root Answer",
        ]
        timings = trace.timings()
    assert [(one.name.replace("root/", ""), one.kind) for one in timings] == [
        ("ask ping", "client"), ("handle Ask", "server"),
        ("ask pong", "client"), ("handle Ask", "server"),
        ("ask pong", "client"), ("handle Ask", "server"),
    ]  # fmt: skip
    assert [one.parent for one in timings] == [
        "", timings[0].id, timings[1].id, timings[2].id, timings[1].id, timings[4].id
    ]  # fmt: skip
    assert all(one.ended is not None and one.ended >= one.began for one in timings)
    asked, handled = timings[0], timings[1]
    assert handled.ended is not None
    assert asked.ended is not None
    assert handled.ended < asked.ended  # the answer was on its way
    for some in (trace, recording.messages("pong"), recording.messages()):
        assert len({span.context.trace_id for span in some.spans()}) == 1


def test_a_tell_and_a_timer_have_the_message_that_caused_them(system: rr.System) -> None:
    with system.record() as recording:
        system.ref("ping").tell(("tell", system.ref("pong"), 7))
        system.ref("ping").tell(("later", system.ref("pong"), 8))
        wait_for(recording, "pong", expected=["ping>pong Tell 7", "ping>pong Timer 8", "pong Tell", "pong Timer"])
        wait_for(recording, "ping", expected=["ping Tell"])
        entries = recording.entries()
        sent = {entry.query: entry for entry in entries if entry.event == "sent" and entry.peer.endswith("ping")}
        caused = [entry for entry in entries if entry.event == "sent" and entry.peer.endswith("pong")]
    assert [sent[entry.parent].detail.split(",")[0] for entry in caused] == ["('tell'", "('later'"]


def test_an_error_is_a_dashed_arrow_back(system: rr.System) -> None:
    with system.record() as recording:
        with pytest.raises(ValueError, match="no number"):
            system.ref("pong").ask("raise")
        wait_for(recording, "pong", expected=["pong Ask", "pong>root Raised ValueError: no number"])
        trace = recording.messages("pong")
    assert [one.error for one in trace.timings()] == ["ValueError: no number"] * 2
    drawn = trace.sequence()
    assert "->>" in drawn
    assert "-->>" in drawn
    assert "did not arrive" not in drawn


def test_a_method_of_a_proxy_is_written_as_a_call(system: rr.System) -> None:
    with system.record() as recording:
        assert system.ref("pong").proxy().twice(4).get(timeout=30) == 8
        wait_for(recording, "pong", expected=["root>pong Ask twice(4)", "pong>root Answer 8"])


def test_the_answer_of_a_future_is_drawn_as_arrived(system: rr.System) -> None:
    with system.record() as recording:
        assert system.ref("ping").ask(("ask async", system.ref("pong"), 5)) == 6
        wait_for(recording, "pong", expected=["pong>ping Answer 6"])
        assert "did not arrive" not in recording.messages("pong").sequence()


def test_the_trace_of_a_load_has_what_its_callback_asked(system: rr.System) -> None:
    app = system.open_registrar("app")
    with system.record() as recording:
        query = app.load("cameras/camera", "left")
        wait_for(recording, "pong", expected=["cameras>pong Ask 4", "pong>cameras Answer 5"])
        assert {"cameras>pong Ask 4", "pong>cameras Answer 5"} <= set(said(recording.trace(query)))
        assert {"cameras>pong Ask 4", "pong>cameras Answer 5"} <= set(said(recording.trace(query.resource_id)))
        assert recording.trace(query.resource_id).spans()


def test_a_down_comes_from_the_actor_that_ended(start: Start) -> None:
    system = start(rr.ChildSpec(Pong, id="pong", restart="permanent"), rr.ChildSpec(Ping, id="ping"))
    system.ref("ping").ask(("watch", system.ref("pong")))
    with system.record() as recording:
        assert system.ref("pong").kill()
        wait_for(recording, "ping", expected=["pong>ping Down killed", "ping Down"])
        eventually(lambda: "exited" in recording.messages("pong").sequence(), what="its end")


def test_a_message_to_a_dead_actor_is_an_arrow_that_ends_in_a_cross(start: Start) -> None:
    system = start(rr.ChildSpec(Pong, id="pong", restart="temporary"))
    pong = system.ref("pong")
    pong.stop()
    with system.record() as recording:
        with pytest.raises(pykka.ActorDeadError):
            pong.tell(1)
        wait_for(recording, "pong", expected=["root>pong Tell 1"])
        eventually(lambda: "dead_letter" in recording.messages("pong").sequence(), what="the dead letter")
        assert "did not arrive" in recording.messages("pong").sequence()


@pytest.mark.parametrize("send", ["tell", "ask"])
def test_a_message_that_ends_its_receiver_is_not_drawn_as_one_that_did_not_arrive(start: Start, send: str) -> None:
    system = start(rr.ChildSpec(Pong, id="pong", restart="temporary"))
    pong = system.ref("pong")

    def is_refused() -> bool:
        try:
            pong.tell(1)
        except pykka.ActorDeadError:
            return True
        return False

    with system.record() as recording:
        if send == "tell":
            pong.tell("poison")
        else:
            with pytest.raises(pykka.ActorDeadError):
                pong.ask("poison", timeout=30)
        eventually(is_refused, what="its end")
        wait_for(recording, "pong", expected=[f"root>pong {send.title()} 'poison'", "root>pong Tell 1"])
        eventually(lambda: "dead_letter" in recording.messages("pong").sequence(), what="the dead letter")
        drawn = recording.messages("pong").sequence().splitlines()

    ends = [line.partition(" ms: ")[2] for line in drawn if "-x" in line]
    assert ends[0] == f"{send.title()} 'poison' (no record of its arrival)"
    assert ends[-1] == "Tell 1 (did not arrive)"


def test_of_equal_messages_the_last_is_the_one_of_a_dead_letter() -> None:
    def tell(at: float, text: str, pid: int = 1) -> Entry:
        return Entry(at, "sent", registrar="app", peer="cam", name="Tell", query=f"{at}", detail=text, pid=pid)

    def letter(at: float, text: str, pid: int = 1, why: str = "has ended") -> Entry:
        return Entry(at, "dead_letter", registrar="cam", pid=pid, facts={"message": text, "why": why})

    def undelivered(*entries: Entry) -> list[str]:
        lines = sequence_of(entries).splitlines()
        return [line.partition(": ")[2].removesuffix(" (did not arrive)") for line in lines if "did not" in line]

    twice = tell(0, "1"), tell(1, "1")
    assert undelivered(*twice) == []
    assert undelivered(*twice, letter(2, "1")) == ["1000.0 ms: Tell 1"]
    assert undelivered(*twice, letter(2, "1"), letter(3, "1")) == ["0.0 ms: Tell 1", "1000.0 ms: Tell 1"]
    assert undelivered(*twice, letter(2, "<12 bytes>")) == ["1000.0 ms: Tell 1"]
    assert undelivered(*twice, letter(2, "<12 bytes>", pid=2)) == []
    assert undelivered(letter(0, "1"), tell(1, "1")) == []
    assert undelivered(*twice, letter(2, "<12 bytes>", why="lost with its process at a.sock")) == []


def test_messages_of_all_of_some_and_of_nobody(system: rr.System, tmp_path: Path) -> None:
    app = system.open_registrar("app")
    with system.record() as recording:
        system.ref("pong").ask(1)
        app.load("cameras/camera", "left")
        wait_for(recording, expected=["pong>root Answer 2", "cameras>app Loaded ", "pong>cameras Answer 5"])
    assert {"root>pong Ask 1", 'app>cameras Load "left"'} <= set(said(recording.messages()))
    of_pong = said(recording.messages("root/pong"))
    assert "root>pong Ask 1" in of_pong
    assert 'app>cameras Load "left"' not in of_pong
    with pytest.raises(rr.NotFound, match=r"'nobody': .* no message of an actor or registrar of this name; there are"):
        recording.messages("nobody")
    recording.save(tmp_path / "file")
    assert said(rr.read_recording(tmp_path / "file").messages("pong")) == said(recording.messages("pong"))


def test_questions_about_children_are_not_noted(system: rr.System) -> None:
    with system.record() as recording:
        assert len(system.supervisor().which_children()) == 3
        system.ref("pong").ask(1)
        wait_for(recording, "pong", expected=["pong>root Answer 2"])
    assert {entry.peer.rpartition("/")[2] for entry in recording.entries() if entry.name == "Ask"} == {"pong", "root"}


def test_a_message_that_was_sent_before_the_recording_is_answered_and_not_noted(system: rr.System) -> None:
    ping, pong = system.ref("ping"), system.ref("pong")
    assert ping.ask(("ask", pong, 1)) == [2]
    with system.record() as recording:
        pong.ask(3)
        wait_for(recording, "pong", expected=["pong>root Answer 4"])
    assert ping.ask(("ask", pong, 5)) == [6]
    assert not [entry for entry in recording.entries() if entry.registrar.endswith("ping")]


def test_of_two_systems_in_a_process_the_recorded_one_has_its_messages(start: Start, tmp_path: Path) -> None:
    one = start(rr.ChildSpec(Pong, id="pong", placement="thread"))
    child = rr.ChildSpec(Pong, id="pong", placement="thread")
    with rr.System([child], name="other", state_dir=tmp_path / "other") as other:
        with other.record() as recording:
            assert other.ref("pong").ask(1) == 2
            wait_for(recording, "pong", expected=["pong Ask"])
        assert one.ref("pong").ask(1) == 2
    with one.record() as recording:
        assert one.ref("pong").ask(2) == 3
        wait_for(recording, "pong", expected=["pong Ask"])
