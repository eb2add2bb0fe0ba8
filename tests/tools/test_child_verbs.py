"""`rr-actors logs`, `stack` and `ps --watch`: what children say, what they are stuck in, how they are, from a shell."""

from __future__ import annotations

import contextlib
import json
import logging
import os
import re
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator

import pytest

import rr_actors as rr
from support import LIMIT_S, Workshop, eventually, hang, kill, pid_of, wait_respawned
from support_cli import run_cli

pytestmark = pytest.mark.usefixtures("runtime_dir")

Start = Callable[..., rr.System]
log = logging.getLogger("talk")


class Talker(rr.Manager):
    """Logs what it is asked to say."""

    @rr.server("line", recovery="keep")
    def say(self, text: str) -> str:
        log.warning("%s", text)
        return text

    @rr.server("lines")
    def say_often(self, text: str, count: int) -> int:
        for _ in range(count):
            log.warning("%s", text)
        return count

    @rr.server("failure")
    def fail(self, text: str) -> str:
        try:
            raise ValueError(text)
        except ValueError:
            log.exception("it failed")
        return text


class Stuck(rr.Actor):
    """Does not return from its start before its step is opened; then it counts for ever when it is asked to."""

    def __init__(self, root: str) -> None:
        self.work = Workshop(root)

    def on_start(self) -> None:
        self.work.step("start")

    def on_receive(self, message: object) -> None:
        self.work.note("counts")
        while True:
            pass


def said(*arguments: object) -> list[str]:
    """The lines that a command prints that succeeds."""
    ran = run_cli(*arguments)
    assert ran.returncode == 0, ran.stdout + ran.stderr
    return ran.stdout.splitlines()


def refused(*arguments: object) -> str:
    """What a command says in one line that was called in a wrong way."""
    ran = run_cli(*arguments)
    assert (ran.returncode, ran.stdout) == (2, "")
    (line,) = ran.stderr.splitlines()
    return line


def texts(*arguments: object) -> list[str]:
    """The texts that `logs --json` prints."""
    return [json.loads(line)["text"] for line in said("logs", *arguments, "--json")]


@pytest.fixture
def system(start: Start) -> rr.System:
    """A system with the manager `talker`, and the same in this process, `inner/near`."""
    near = rr.ChildSpec(Talker, id="near", placement="thread")
    return start(rr.ChildSpec(Talker, id="talker"), rr.Supervisor([near], id="inner"))


@pytest.fixture
def app(system: rr.System) -> rr.Registrar:
    return system.open_registrar("app")


# -- logs ------------------------------------------------------------------------------------------------------------


def test_the_log_of_a_child_is_shown_with_that_of_the_life_before(system: rr.System, app: rr.Registrar) -> None:
    app.load("talker/line", "first")
    eventually(lambda: texts("talker") == ["first"])
    old = kill(system, "talker")
    wait_respawned(system, "talker", old)
    assert said("logs", "talker", "-p", "--json")
    app.load("talker/line", "second")
    eventually(lambda: texts("talker") == ["first", "second"])
    new = pid_of(system, "talker")

    lines = said("logs", "root/talker")
    clock = r"\d\d:\d\d:\d\d"
    patterns = [
        f"-- root/talker, process {old} --",
        rf"{clock}\.\d\d\d WARNING  talk: first",
        f"-- process {old} ended at {clock}.*: killed: SIGKILL --",
        f"-- root/talker, process {new} --",
        rf"{clock}\.\d\d\d WARNING  talk: second",
    ]
    assert [pattern for pattern, line in zip(patterns, lines, strict=True) if not re.fullmatch(pattern, line)] == []
    assert texts("talker", "--previous") == ["first"]
    assert texts("talker", "--lines", 1) == ["second"]
    (facts,) = map(json.loads, said("logs", "talker", "-n", 1, "--json"))
    assert (facts["pid"], facts["level"], facts["logger"], facts["path"]) == (new, "WARNING", "talk", "root/talker")


def test_the_log_of_a_child_that_has_left_the_tree_stays(system: rr.System, app: rr.Registrar) -> None:
    system.start_child(rr.ChildSpec(Talker, id="guest", restart="temporary"))
    app.load("guest/line", "here I am")
    eventually(lambda: texts("guest") == ["here I am"])
    kill(system, "guest")
    eventually(lambda: "root/guest" not in said("ps", "-o", "name"))
    assert texts("guest") == texts("root/guest") == ["here I am"]


def test_a_hostile_line_controls_no_terminal_and_a_traceback_is_indented(app: rr.Registrar) -> None:
    app.load("talker/line", "\x1b[2J\x07 \u202e <b>\nnext")
    app.load("talker/failure", "no such device")
    lines = eventually(lambda: said("logs", "talker") if len(texts("talker")) == 2 else [])
    assert lines[1].endswith("talk: \\x1b[2J\\x07 \\u202e <b>")
    assert lines[2] == "    next"
    assert lines[3].endswith(" ERROR    talk: it failed")
    assert lines[4] == "    Traceback (most recent call last):"
    assert lines[-1] == "    ValueError: no such device"


def test_a_child_keeps_its_last_lines_and_no_more(app: rr.Registrar) -> None:
    app.load("talker/lines", {"text": "many", "count": 700})
    app.load("talker/line", "last")
    lines = eventually(lambda: found if (found := texts("talker"))[-1:] == ["last"] else [])
    assert lines == ["many"] * 499 + ["last"]
    app.load("talker/lines", {"text": "x" * 30_000, "count": 20})
    app.load("talker/line", "the end")
    lines = eventually(lambda: found if (found := texts("talker"))[-1:] == ["the end"] else [])
    assert len(lines) == 9  # 256 KiB have room for eight of the long ones
    assert set(lines[:-1]) == {"x" * 30_000}


def test_the_log_is_followed_over_a_restart_until_the_system_ends(system: rr.System, app: rr.Registrar) -> None:
    app.load("talker/line", "first")
    eventually(lambda: texts("talker") == ["first"])
    command = [sys.executable, "-m", "rr_actors", "logs", "talker", "--follow", "--json"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as follows:
        assert follows.stdout is not None
        lines = [follows.stdout.readline()]
        wait_respawned(system, "talker", kill(system, "talker"))
        app.load("talker/line", "second")
        lines.append(follows.stdout.readline())
        pid = pid_of(system, "talker")
        system.stop()
        _, told = follows.communicate(timeout=LIMIT_S)
    facts = [json.loads(line) for line in lines]
    assert [one["text"] for one in facts] == ["first", "second"]
    assert facts[1]["pid"] == pid
    assert (follows.returncode, told) == (0, "the system has ended\n")


def test_an_unknown_child_is_refused_with_the_nearest_name_and_one_without_a_process_is_explained(
    system: rr.System,
) -> None:
    assert refused("logs", "talkre") == (
        "rr-actors: 'talkre': there is no child of this path or id; did you mean 'talker'?"
    )
    assert "did you mean 'root/inner/near'?" in refused("logs", "root/iner/near")
    assert refused("status", "talkre").endswith("; did you mean 'talker'?")
    assert "--previous: expected no --follow" in refused("logs", "talker", "-p", "-f")
    ran = run_cli("logs", "near")
    told = "no log lines of root/inner/near: it runs in the application's process, whose own logging has its records\n"
    assert (ran.returncode, ran.stdout, ran.stderr) == (0, "", told)
    assert run_cli("logs", "talker").stderr == "no log lines of root/talker\n"


def test_several_children_of_one_id_are_named(start: Start) -> None:
    there = rr.Supervisor([rr.ChildSpec(rr.Actor, id="same")], id="inner")
    start(rr.ChildSpec(rr.Actor, id="same"), there)
    for verb in ("logs", "stack", "status", "wait"):
        assert "'same': several children have this id: root/inner/same, root/same" in refused(verb, "same")


# -- stack -----------------------------------------------------------------------------------------------------------


def frames(*arguments: object) -> str:
    """What `stack` shows of a child."""
    return "\n".join(said("stack", *arguments))


def test_the_stack_of_a_child_is_shown_while_it_starts_and_while_its_thread_is_busy(
    start: Start, workshop: Workshop
) -> None:
    workshop.shut("start")
    spec = rr.ChildSpec(Stuck, id="stuck", args=(str(workshop.root),), shutdown_s="brutal_kill")
    started: list[rr.System] = []
    starting = threading.Thread(target=lambda: started.append(start(spec)))
    starting.start()
    workshop.wait("start")
    assert re.search(r'test_child_verbs.py", line \d+, in Stuck.on_start\n +self.work.step', frames("stuck"))
    workshop.open("start")
    starting.join(LIMIT_S)
    (system,) = started

    system.ref("stuck").tell("count")
    workshop.wait("counts")
    counting = re.compile(r"in Stuck.on_receive\n +(pass|while True:)")
    shown = eventually(lambda: found if counting.search(found := frames("root/stuck")) else "")
    assert shown.startswith(f"root/stuck: process {pid_of(system, 'stuck')}, ")
    facts = json.loads(said("stack", "stuck", "--json")[0])
    assert facts["pid"] == pid_of(system, "stuck")
    assert any("Stuck.on_receive" in frame for one in facts["threads"] for frame in one["frames"])


def test_the_stacks_of_processes_further_below_and_of_the_application_are_shown(start: Start) -> None:
    deep = rr.Supervisor([rr.ChildSpec(Talker, id="deep")], id="inner", placement="process")
    system = start(rr.Supervisor([deep]))
    pid = system.supervisor("inner").which_child("deep").pid
    assert pid is not None
    assert frames("deep").startswith(f"root/inner/deep: process {pid}, ")
    assert frames("root").startswith(f"root: process {os.getpid()}, ")
    assert "test_child_verbs.py" in frames("root")

    hang(pid)
    told = rf"rr-actors: root/inner/deep: process {pid} did not answer within 0.8 s: it is stopped by a signal, .*\n"

    def is_told() -> bool:  # the process above may have been too slow to pass that on in time
        ran = run_cli("stack", "deep", "--timeout", "1")
        assert (ran.returncode, ran.stdout) == (4, "")
        return re.fullmatch(told, ran.stderr) is not None

    eventually(is_told)
    os.kill(pid, signal.SIGCONT)
    assert frames("deep")


def test_a_child_that_does_not_run_has_no_stack(system: rr.System) -> None:
    said("terminate", "talker")
    ran = run_cli("stack", "talker")
    assert (ran.returncode, ran.stderr) == (4, "rr-actors: root/talker: it has no process now: it is stopped\n")
    assert "did you mean 'near'?" in refused("stack", "neer")
    assert frames("near").startswith(f"root/inner/near: process {os.getpid()}, ")


# -- tables that are shown again -------------------------------------------------------------------------------------


def test_a_table_is_shown_again_until_the_system_ends(system: rr.System, app: rr.Registrar) -> None:
    app.load("talker/line", "here")
    verbs = [("ps", "-o", "name"), ("resources", "--json"), ("usage", "--json")]
    with contextlib.ExitStack() as ends:
        watching = [ends.enter_context(watched(*verb)) for verb in verbs]
        names, resources, _ = (one.stdout for one in watching)
        assert names is not None
        assert resources is not None
        children = [names.readline().strip() for _ in range(4)]
        assert children == ["root", "root/talker", "root/inner", "root/inner/near"]
        assert len(json.loads(resources.readline())) == 1
        system.start_child(rr.ChildSpec(Talker, id="third"))
        app.unload_all()
        while "root/third\n" not in (line := names.readline()):
            assert line
        while json.loads(resources.readline()):
            pass
        system.stop()
        for one in watching:
            _, told = one.communicate(timeout=LIMIT_S)
            assert (one.returncode, told.splitlines()[-1]) == (0, "the system has ended")


@contextlib.contextmanager
def watched(*verb: str) -> Iterator[subprocess.Popen[str]]:
    """A command that shows a table again and again."""
    command = [sys.executable, "-m", "rr_actors", *verb, "--watch"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        try:
            yield process
        finally:
            process.kill()
