"""`rr-actors mailbox`, `why` of an actor, `pause`, `step` and `resume`: the mailbox of an actor, from a shell."""

from __future__ import annotations

import json
import os
import re
from collections.abc import Callable, Iterator
from typing import Any

import msgspec
import pytest

import rr_actors as rr
from rr_actors.actors.messaging.mailbox_looks import MailboxInfo, MessageInfo
from rr_actors.base.errors import NotFound, Unavailable
from rr_actors.tools.explanations import explain_actor, mailbox_lines
from support import Workshop, eventually
from support_cli import run_cli

pytestmark = pytest.mark.usefixtures("runtime_dir")

Start = Callable[..., rr.System]


class Reckon(msgspec.Struct):
    step: str


class Worker(rr.Actor):
    """Passes what it gets on to another actor, or works at a step of the workshop."""

    def __init__(self, root: str) -> None:
        self.work = Workshop(root)

    def on_receive(self, message: Any) -> Any:
        if isinstance(message, Reckon):
            self.work.step(message.step)
            return message
        other, passed = message
        if passed == "meet":
            self.work.step(passed)
        return other.ask(passed)


def said(*arguments: object) -> list[str]:
    """The lines that a command prints that succeeds; numbers of seconds and of processes are N."""
    ran = run_cli(*arguments)
    assert ran.returncode == 0, ran.stdout + ran.stderr
    return re.sub(r"[\d.]+ m?s\b|(?<=pid )\d+", "N", ran.stdout).splitlines()


def refused(code: int, *arguments: object) -> str:
    """What a command says in one line that is refused with this exit code."""
    ran = run_cli(*arguments)
    assert (ran.returncode, ran.stdout) == (code, "")
    (line,) = ran.stderr.splitlines()
    return line


@pytest.fixture
def workers(start: Start, workshop: Workshop) -> rr.System:
    """A system for debugging with the actors `a`, `b` and `c`, of which c is in this process."""
    args = (str(workshop.root),)
    near = rr.ChildSpec(Worker, id="c", args=args, placement="thread")
    return start(*(rr.ChildSpec(Worker, id=id, args=args) for id in "ab"), near, debug=True)


@pytest.fixture
def busy(workers: rr.System, workshop: Workshop) -> Iterator[rr.System]:
    """The same, where a waits for b, which works; a message of c's waits for b, and one of this process."""
    a, b, c = (workers.ref(id) for id in "abc")
    workshop.shut("long")
    answers = [a.ask((b, Reckon("long")), block=False)]
    workshop.wait("long")
    answers.append(c.ask((b, Reckon("short")), block=False))
    eventually(lambda: workers.mailbox("b").look().length == 1)
    answers.append(b.ask({"x": 1}, block=False))
    eventually(lambda: workers.mailbox("b").look().length == 2)
    yield workers
    workshop.open("long")
    assert answers[0].get() == Reckon("long")
    assert answers[1].get() == Reckon("short")
    assert isinstance(answers[2].exception(), ValueError)


def test_a_mailbox_is_shown_with_its_oldest_message_and_what_is_handled(busy: rr.System) -> None:
    assert said("mailbox", "b") == [
        "root/b: 2 messages wait, at most 100,000",
        "    oldest: Reckon from root/c for N",
        "    types: 1 Reckon, 1 dict",
        "    handles: Reckon from root/a for N",
    ]
    assert said("mailbox", "root/a") == [
        "root/a: no message waits, at most 100,000",
        "    handles: tuple from root (pid N) for N",
        "    waits for: root/b",
    ]
    assert said("mailbox", "root") == ["root: no message waits, at most 100,000", "    handles: nothing"]


def test_a_mailbox_is_data_for_programs(busy: rr.System) -> None:
    ran = run_cli("mailbox", "b", "--json")
    facts = json.loads(ran.stdout)
    assert facts["oldest"].pop("since_s") > 0
    assert facts["handled"].pop("since_s") > 0
    assert facts == {
        "path": "root/b",
        "limit": 100_000,
        "length": 2,
        "types": {"Reckon": 1, "dict": 1},
        "oldest": {"type": "Reckon", "sender": "root/c"},
        "handled": {"type": "Reckon", "sender": "root/a"},
        "waits_for": [],
        "is_paused": False,
    }


def test_why_says_for_whom_an_actor_waits_and_what_that_one_does(busy: rr.System) -> None:
    assert said("why", "a") == [
        "root/a has been handling `tuple` from root (pid N) for N.",
        "root/a waits for root/b, which has been handling `Reckon` from root/a for N; in its mailbox 2 messages wait.",
    ]
    assert said("why", "root/b") == [
        "root/b has been handling `Reckon` from root/a for N.",
        "In its mailbox 2 messages wait, the oldest for N: 1 Reckon, 1 dict.",
    ]
    assert said("why", "root") == ["root handles nothing."]


def test_a_ring_that_several_processes_close_together_is_named(workers: rr.System, workshop: Workshop) -> None:
    a, b = workers.ref("a"), workers.ref("b")
    workshop.shut("meet")
    answers = [a.ask((b, "meet"), block=False), b.ask((a, "meet"), block=False)]
    workshop.wait("meet", 2)
    workshop.open("meet")
    eventually(lambda: workers.mailbox("a").look().waits_for and workers.mailbox("b").look().waits_for)
    assert said("why", "a") == [
        "root/a has been handling `tuple` from root (pid N) for N.",
        "In its mailbox 1 message waits, the oldest for N: 1 str.",
        "root/a waits for root/b, which has been handling `tuple` from root (pid N) for N; "
        "in its mailbox 1 message waits.",
        "root/b waits for root/a: that is a ring of asks, root/a → root/b → root/a. "
        "It lasts until the time limit of one of them.",
    ]
    b.kill()
    for answer in answers:
        assert answer.exception() is not None


def test_why_of_what_is_no_actor_is_of_a_resource(busy: rr.System) -> None:
    assert "no query and no resource has this id" in refused(2, "why", "nobody")
    assert "no query and no resource has this id" in refused(2, "why", "b/nobody")
    assert "there are: root/a, root/b, root/c" in refused(2, "mailbox", "nobody")


def test_an_actor_is_paused_stepped_and_resumed(workers: rr.System, workshop: Workshop) -> None:
    assert said("pause", "b") == ["paused root/b: 0 wait"]
    assert said("step", "b") == ["root/b handled nothing: no message waits"]
    b = workers.ref("b")
    answers = [b.ask(Reckon(step), block=False) for step in ("one", "two")]
    eventually(lambda: workers.mailbox("b").look().length == 2)
    assert said("mailbox", "b")[0] == "root/b: 2 messages wait, at most 100,000, paused"
    assert said("why", "b")[0] == "root/b is paused, and handles nothing."
    assert said("step", "b") == ["root/b handled Reckon from root (pid N); 1 wait"]
    assert workshop.lines() == ["one"]
    assert json.loads(run_cli("step", "b", "--json").stdout) == {
        "done": f"root/b handled Reckon from root (pid {os.getpid()}); 0 wait",
        "path": "root/b",
        "waiting": 0,
        "is_paused": True,
        "type": "Reckon",
    }
    assert said("resume", "b") == ["resumed root/b: 0 waited"]
    assert [answer.get() for answer in answers] == [Reckon("one"), Reckon("two")]
    assert "root/b: it is not paused" in refused(2, "step", "b")


def test_a_system_without_debug_is_not_paused(start: Start, workshop: Workshop) -> None:
    start(rr.ChildSpec(Worker, id="b", args=(str(workshop.root),)))
    for verb in ("pause", "step", "resume"):
        assert "root/b: its system was not started for debugging" in refused(2, verb, "b")


def test_an_actor_that_does_not_run_is_named(workers: rr.System) -> None:
    workers.supervisor().terminate_child("b")
    assert "root/b not found: it is stopped" in refused(4, "mailbox", "b")


# -- the texts ---------------------------------------------------------------------------------------------------------


def looks(*infos: MailboxInfo) -> Callable[[str], MailboxInfo]:
    """Return what looks at these."""
    known = {info.path: info for info in infos}

    def look(path: str) -> MailboxInfo:
        if path == "root/gone":
            raise Unavailable("root/gone: its process has not answered within 5 s")
        if path not in known:
            raise NotFound(f"no {path}")
        return known[path]

    return look


def asking(path: str, *others: str) -> MailboxInfo:
    return MailboxInfo(path, 5, handled=MessageInfo("Go", since_s=2.0), waits_for=list(others))


def test_a_ring_of_asks_is_named() -> None:
    look = looks(asking("root/a", "root/b"), asking("root/b", "root/c"), asking("root/c", "root/b"))
    assert explain_actor(look, "root/a") == [
        "root/a has been handling `Go` for 2.0 s.",
        "root/a waits for root/b, which has been handling `Go` for 2.0 s.",
        "root/b waits for root/c, which has been handling `Go` for 2.0 s.",
        "root/c waits for root/b: that is a ring of asks, root/b → root/c → root/b. "
        "It lasts until the time limit of one of them.",
    ]


def test_one_that_cannot_be_asked_is_named_with_the_reason() -> None:
    assert explain_actor(looks(asking("root/a", "root/gone", "root/nobody")), "root/a")[1:] == [
        "root/a waits for root/gone: root/gone: its process has not answered within 5 s.",
        "root/a waits for root/nobody: no root/nobody.",
    ]


def test_an_actor_that_starts_is_said_to_start() -> None:
    info = MailboxInfo("root/a", 5, handled=MessageInfo("on_start", since_s=90.0))
    assert explain_actor(looks(info), "root/a") == ["root/a has been in its on_start for 2 min."]


def test_of_many_messages_the_first_are_counted_by_type() -> None:
    info = MailboxInfo("root/a", 5000, 4000, {"Go": 200, "": 56}, MessageInfo(""))
    assert list(mailbox_lines(info)) == [
        "root/a: 4,000 messages wait, at most 5,000",
        "    oldest: a message",
        "    types: 200 Go, 56 of unknown type (of the first 256)",
        "    handles: nothing",
    ]
