"""Programs that are started, or that start their managers, in a way that nobody expects."""

from __future__ import annotations

import os
import pty
import re
import signal
import subprocess
import sys
from pathlib import Path

import pytest

import rr_actors as rr
from support import REPOSITORY

pytestmark = pytest.mark.cold

LIMIT_S = 40.0
MANAGER = """
import rr_actors as rr


class Cameras(rr.Manager):
    @rr.server("camera")
    def open_camera(self, device: str) -> str:
        return "open " + device
"""
USE = """
if __name__ == "__main__":
    with rr.System([rr.ChildSpec(Cameras, id="cameras", placement=PLACEMENT)], state_dir="state") as system:
        with system.open_registrar("app").load("cameras/camera", "one") as query:
            print(query.response)
"""


def run(directory: Path, program: str, **environment: str) -> subprocess.CompletedProcess[str]:
    """Run a program from a file in this directory, in a bounded time."""
    (directory / "program.py").write_text(program)
    return subprocess.run(
        [sys.executable, "program.py"],
        cwd=directory,
        env=os.environ | {"PYTHONPATH": str(REPOSITORY), "PYTHONWARNINGS": "ignore"} | environment,
        timeout=LIMIT_S,
        capture_output=True,
        text=True,
        check=False,
    )


def last_line(ran: subprocess.CompletedProcess[str]) -> str:
    assert ran.returncode != 0, ran.stdout
    return ran.stderr.strip().splitlines()[-1]


def start_failed(ran: subprocess.CompletedProcess[str], child: str) -> str:
    """Return the text of the error with which the program ended."""
    begin = f"rr_actors.base.errors.StartFailed: child root/{child} did not start: "
    assert begin in ran.stderr, ran
    return ran.stderr.rpartition(begin)[2]


# -- patched by gevent or eventlet -----------------------------------------------------------------------------------

PATCHES = {
    "gevent": ("from gevent import monkey; monkey.patch_all", ("thread", "select", "socket", "subprocess", "queue")),
    "eventlet": ("import eventlet; eventlet.monkey_patch", ("thread", "select", "socket", "subprocess", "os")),
}


@pytest.fixture(params=PATCHES)
def patcher(request: pytest.FixtureRequest) -> str:
    pytest.importorskip(request.param)
    return request.param


@pytest.mark.parametrize("placement", ["process", "thread"])
@pytest.mark.parametrize("order", ["before the import", "after the import"])
def test_a_start_in_a_patched_process_is_refused_at_once(
    tmp_path: Path, patcher: str, order: str, placement: str
) -> None:
    patch, parts = PATCHES[patcher]
    before, after = ("", f"\n{patch}()\n") if order == "after the import" else (f"{patch}()\n", "")
    error = last_line(run(tmp_path, before + MANAGER + after + USE.replace("PLACEMENT", repr(placement))))

    assert error.startswith(f"rr_actors.base.errors.UsageError: {patcher} has patched thread, ")
    assert f"({', '.join(f'{part}=False' for part in parts)})" in error
    assert "run the system in a process that is not patched" in error


@pytest.mark.parametrize("placement", ["process", "thread"])
def test_the_patch_that_the_error_names_leaves_a_process_in_which_systems_run(
    tmp_path: Path, patcher: str, placement: str
) -> None:
    patch, parts = PATCHES[patcher]
    keywords = ", ".join(f"{part}=False" for part in parts)
    ran = run(tmp_path, f"{patch}({keywords})\n" + MANAGER + USE.replace("PLACEMENT", repr(placement)))
    assert ran.stdout == "open one\n", ran.stderr


def test_an_actor_alone_is_refused_in_a_patched_process_and_a_connection_works_there(
    tmp_path: Path, patcher: str
) -> None:
    program = """
PATCH()
import rr_actors as rr
try:
    rr.Actor.start()
except rr.UsageError as error:
    print(error)
with rr.connect("state") as connection, connection.open_registrar("app").load("served/echo", "hello") as query:
    print(query.response)
"""
    with rr.System(state_dir=tmp_path / "state") as system:
        system.open_registrar("served").register_server("echo", lambda request: request)
        ran = run(tmp_path, program.replace("PATCH", PATCHES[patcher][0]))
    refused, response = ran.stdout.splitlines()
    assert refused.startswith(f"{patcher} has patched thread")
    assert response == "hello"


@pytest.mark.parametrize("preload", [(), ("cameras",)], ids=["imported by the child", "preloaded"])
def test_a_module_that_patches_the_process_of_a_child_is_named_so(
    tmp_path: Path, patcher: str, preload: tuple[str, ...]
) -> None:
    (tmp_path / "cameras.py").write_text(f"{PATCHES[patcher][0]}()\n{MANAGER}")
    program = f"""
import rr_actors as rr


class Later:
    def __reduce__(self):
        return __import__, ("cameras",)


class Held(rr.Manager):
    def __init__(self, module): ...


if __name__ == "__main__":
    config = rr.SystemConfig(preload={preload!r})
    rr.System([rr.ChildSpec(Held, id="held", args=(Later(),))], state_dir="state", config=config).start()
"""
    error = start_failed(run(tmp_path, program), "held")
    assert f"{patcher} has patched thread" in error


def test_a_start_after_a_crash_clears_up_in_a_program_that_has_imported_eventlet(tmp_path: Path) -> None:
    """eventlet imports shutil so that it refuses the descriptor of a directory."""
    pytest.importorskip("eventlet")
    (tmp_path / "state" / "run" / "01234567").mkdir(parents=True)
    ran = run(tmp_path, "import eventlet\n" + MANAGER + USE.replace("PLACEMENT", "'process'"))
    assert ran.stdout == "open one\n", ran.stderr
    assert not (tmp_path / "state" / "run" / "01234567").exists()


# -- what keeps a child from coming up -------------------------------------------------------------------------------

START = """
try:
    with rr.System([rr.ChildSpec(Cameras, id="cameras")], state_dir="state") as system:
        print(system.open_registrar("app").load("cameras/camera", "one").response)
except rr.RrError as error:
    print(f"{type(error).__name__}: {error}")
"""


def start(directory: Path, before: str, **environment: str) -> str:
    """Return what a program prints that does `before` and then starts a manager: the response, or the error."""
    return run(directory, f"import os, sys\n{MANAGER}\n{before}\n{START}", **environment).stdout


def test_a_module_that_hides_one_of_the_standard_library_is_named_with_its_file(tmp_path: Path) -> None:
    hiding = tmp_path / "hiding"
    hiding.mkdir()
    (hiding / "selectors.py").write_text("mine = 1\n")
    said = start(tmp_path, "sys.path.insert(0, 'hiding')")
    assert said.startswith("StartFailed: child root/cameras did not start: "), said
    assert "hiding/selectors.py" in said


def test_an_interpreter_that_is_not_known_is_asked_for(tmp_path: Path) -> None:
    for unknown in ("sys.executable = None", "sys.executable = ''"):
        said = start(tmp_path, f"{unknown}; import multiprocessing.spawn as spawn; spawn._python_exe = None")
        assert said.startswith("StartFailed: child root/cameras did not start: "), said
        assert "sys.executable is not set" in said
        assert "multiprocessing.set_executable(" in said


def test_an_interpreter_that_is_gone_is_named(tmp_path: Path) -> None:
    said = start(tmp_path, "import multiprocessing; multiprocessing.set_executable('/gone/bin/python')")
    assert said.startswith("StartFailed: child root/cameras did not start: "), said
    assert "No such file or directory: '/gone/bin/python'" in said


def test_a_wrong_pythonhome_is_shown_in_the_words_of_the_interpreter(tmp_path: Path) -> None:
    said = start(tmp_path, "os.environ['PYTHONHOME'] = '/nowhere'")
    assert said.startswith("StartFailed: child root/cameras did not start: "), said
    assert "PYTHONHOME = '/nowhere'" in said
    assert "No module named 'encodings'" in said


def test_children_have_a_variable_that_is_too_long_for_a_program(tmp_path: Path) -> None:
    before = """
class Cameras(rr.Manager):
    @rr.server("camera")
    def open_camera(self, device: str) -> int:
        return len(os.environ["LONG"])
os.environ["LONG"] = "x" * 200_000
"""
    assert start(tmp_path, before) == "200000\n"


def test_a_system_starts_where_only_its_state_directory_can_be_written(tmp_path: Path) -> None:
    """As in `docker run --read-only -v state:/state`."""
    (tmp_path / "state").mkdir()
    read_only = [f"mount -t tmpfs none {at} && mount -o remount,ro {at}" for at in ("/var/tmp", "/dev/shm", "/tmp")]
    steps = [f"mount --bind {tmp_path} /mnt", "cd /mnt", *read_only, f"exec {sys.executable} program.py"]
    if subprocess.run(["unshare", "-m", "true"], check=False, capture_output=True).returncode:
        pytest.skip("this user may not make a mount namespace")
    if sys.prefix.startswith(("/tmp/", "/var/tmp/", "/dev/shm/")):
        pytest.skip("the interpreter itself lies where nothing can be seen then")
    (tmp_path / "program.py").write_text(MANAGER + START)
    environment = {"PATH": os.environ["PATH"], "PYTHONPATH": str(REPOSITORY)}
    ran = subprocess.run(
        ["unshare", "-m", "sh", "-c", " && ".join(steps)],
        capture_output=True,
        text=True,
        timeout=LIMIT_S,
        env=environment,
        check=False,
    )
    assert ran.stdout == "open one\n", ran.stderr


# -- frozen programs -------------------------------------------------------------------------------------------------

CLASSES = MANAGER.replace("Cameras", "Others")
COUNTED = """
import os, sys
with open("runs", "a") as file:
    file.write(f"{sys.argv[1:2]}\\n")
"""
APP = f"""
{COUNTED}
import others
{MANAGER}

def main():
    with open("mains", "a") as file:
        file.write("main\\n")
    both = [rr.ChildSpec(Cameras, id="cameras"), rr.ChildSpec(others.Others, id="others")]
    with rr.System(both, state_dir=f"state{{os.getpid()}}") as system:
        app = system.open_registrar("app")
        print(app.load("cameras/camera", "one").response, app.load("others/camera", "two").response)


if __name__ == "__main__":
    main()
"""
SERVER_RUN = "['--rr-actors-fork-server']"


def frozen(directory: Path, program: str) -> subprocess.CompletedProcess[str]:
    """Run a program that is its own interpreter, as frozen ones are."""
    (directory / "others.py").write_text(CLASSES)
    file = directory / "program"
    file.write_text(f"#!{sys.executable}\nimport sys\nsys.frozen, sys.executable = True, {str(file)!r}\n{program}")
    file.chmod(0o700)
    environment = os.environ | {"PYTHONPATH": f"{REPOSITORY}:{directory}"}
    return subprocess.run(
        [file], cwd=directory, env=environment, timeout=LIMIT_S, capture_output=True, text=True, check=False
    )


def runs(directory: Path) -> list[str]:
    return (directory / "runs").read_text().splitlines()


@pytest.mark.parametrize("imported", [False, True], ids=["as a program", "imported by a program"])
def test_a_child_of_a_frozen_program_never_runs_its_main(tmp_path: Path, imported: bool) -> None:
    program = APP
    if imported:  # the imports of the program are in progress where it becomes a fork server
        (tmp_path / "application.py").write_text(APP)
        program = "from application import main; main()"
    ran = frozen(tmp_path, program)
    assert ran.stdout == "open one open two\n", ran.stderr
    assert runs(tmp_path) == ["[]", SERVER_RUN, *["[]"] * imported]  # a child imports the module of its class
    assert (tmp_path / "mains").read_text() == "main\n"


def test_a_frozen_program_that_imports_the_package_in_its_main_runs_it_to_there(tmp_path: Path) -> None:
    program = """
def main():
    import others
    import rr_actors as rr
    with rr.System([rr.ChildSpec(others.Others, id="others")], state_dir="state") as system:
        print(system.open_registrar("app").load("others/camera", "two").response)

try:
    main()
except Exception as error:
    print("caught", error)
"""
    ran = frozen(tmp_path, COUNTED + program)
    assert ran.stdout == "open two\n", ran.stderr
    assert runs(tmp_path) == ["[]", SERVER_RUN]


@pytest.mark.parametrize(
    ("program", "words"),
    [
        pytest.param(
            "try:\n    import others\nexcept BaseException:\n    import sys; sys.modules.pop('rr_actors', None)\n"
            "    sys.argv.append(sys.argv.pop(1))\n" + APP.replace(COUNTED, ""),
            "a frozen program must not catch what an import raises",
            id="catches everything",
        ),
        pytest.param(
            "import threading\nthread = threading.Thread(target=__import__, args=('rr_actors',))\n"
            "thread.start(); thread.join()\n" + APP.replace(COUNTED, ""),
            "must import rr_actors in its main thread",
            id="imports in a thread",
        ),
    ],
)
def test_a_frozen_program_that_cannot_become_a_fork_server_ends_with_an_error_that_says_what_to_write(
    tmp_path: Path, program: str, words: str
) -> None:
    ran = frozen(tmp_path, COUNTED + program)
    assert words in ran.stderr, ran
    assert 2 <= len(runs(tmp_path)) <= 3


def test_what_needs_an_interpreter_is_refused_in_a_frozen_program(tmp_path: Path) -> None:
    program = """
import rr_actors as rr
from rr_actors.managers.programs import Programs
if __name__ == "__main__":
    with rr.System([rr.ChildSpec(Programs, id="programs")], state_dir="state") as system:
        try:
            system.open_registrar("app").load("programs/program", {"command": "sleep", "arguments": ["100"]})
        except rr.LoadFailed as error:
            print(error)
        try:
            system.serve_web()
        except rr.UsageError as error:
            print(error)
"""
    ran = frozen(tmp_path, COUNTED + program)
    assert ran.stdout.count("refused in a frozen program, which has no Python interpreter") == 2, ran
    assert runs(tmp_path) == ["[]", SERVER_RUN]


BOTH_FORMS = """
optional = ["numpy", "IPython", "matplotlib", "pytest", "nicegui", "rich", "pygments", "PIL", "opentelemetry", "yaml"]
found = Analysis(["app.py"], excludes=optional)
modules = PYZ(found.pure)
alone = EXE(modules, found.scripts, [], exclude_binaries=True, name="app")
COLLECT(alone, found.binaries, found.datas, name="folder")
EXE(modules, found.scripts, found.binaries, found.datas, [], name="single")
"""
"""A program with its libraries beside it, and one that is a single file."""


@pytest.mark.slow
@pytest.mark.timeout(400)
def test_a_program_that_pyinstaller_has_frozen_runs_in_both_its_forms(tmp_path: Path) -> None:
    pytest.importorskip("PyInstaller")
    (tmp_path / "app.py").write_text(APP)
    (tmp_path / "others.py").write_text(CLASSES)
    (tmp_path / "app.spec").write_text(BOTH_FORMS)
    command = [sys.executable, "-m", "PyInstaller", "--log-level=ERROR", "app.spec"]
    subprocess.run(command, cwd=tmp_path, check=True, timeout=300)
    for program in (tmp_path / "dist" / "folder" / "app", tmp_path / "dist" / "single"):
        for name in ("rr_actors", "others.py"):
            assert not (program.parent / name).exists()  # nothing but what was frozen
        where = tmp_path / f"run of {program.name}"
        where.mkdir()
        ran = subprocess.run([program], cwd=where, timeout=LIMIT_S, capture_output=True, text=True, check=False)
        assert ran.stdout == "open one open two\n", ran.stderr
        assert runs(where) == ["[]", SERVER_RUN]
        assert (where / "mains").read_text() == "main\n"


# -- the terminal ----------------------------------------------------------------------------------------------------

ASKING = """
import fcntl, os, subprocess, sys, termios
import rr_actors as rr


class Asking(rr.Manager):
    @rr.server("input")
    def ask(self, question: str) -> str:
        return input(question)

    @rr.server("terminal")
    def read(self, question: str) -> str:
        return open("/dev/tty").readline()

    @rr.server("output")
    def write(self, words: str) -> str:
        os.write(2, words.encode())
        return words


if __name__ == "__main__":
    fcntl.ioctl(2, termios.TIOCSCTTY, 0)
    attributes = termios.tcgetattr(2)
    attributes[3] |= termios.TOSTOP
    termios.tcsetattr(2, termios.TCSANOW, attributes)
    with rr.System([rr.ChildSpec(Asking, id="asking", shutdown_s=1)], state_dir="state") as system:
        app = system.open_registrar("app")
        try:
            app.load(f"asking/{sys.argv[1]}", "words", timeout_s=3.0)
        except rr.RrError as error:
            print("failed:", error)
        print(subprocess.run([sys.executable, "-m", "rr_actors", "ps"], capture_output=True, text=True).stdout)
"""


def at_a_terminal(directory: Path, *arguments: str) -> str:
    """Return what ASKING prints where its standard error is its terminal."""
    (directory / "program.py").write_text(ASKING)
    ours, theirs = pty.openpty()
    try:
        ran = subprocess.run(
            [sys.executable, "program.py", *arguments],
            cwd=directory,
            env=os.environ | {"PYTHONPATH": str(REPOSITORY), "COLUMNS": "300"},
            timeout=LIMIT_S,
            stdin=theirs,
            stdout=subprocess.PIPE,
            stderr=theirs,
            start_new_session=True,
            text=True,
            check=False,
        )
    finally:
        os.close(ours)
        os.close(theirs)
    return ran.stdout


def test_the_standard_input_of_a_child_is_at_its_end(tmp_path: Path) -> None:
    assert "failed: asking/input: EOFError" in at_a_terminal(tmp_path, "input")


@pytest.mark.parametrize("server", ["terminal", "output"])
def test_a_child_that_the_terminal_has_stopped_is_named_so(tmp_path: Path, server: str) -> None:
    said = at_a_terminal(tmp_path, server)
    assert re.search(
        rf"failed: asking/{server}: not loaded within 3 s; asking is stopped by a signal, .*kill -CONT", said
    )
    assert re.search(r"asking +unavailable .*stopped by a signal, ", said), said


class Stopping(rr.Actor):
    def on_start(self) -> None:
        while True:  # the kernel continues the stopped processes of a group that nobody controls any more
            os.kill(os.getpid(), signal.SIGSTOP)


def test_a_child_that_is_stopped_by_a_signal_while_it_starts_is_named_so(tmp_path: Path) -> None:
    child = rr.ChildSpec(Stopping, id="stopping", start_timeout_s=1.0)
    with pytest.raises(rr.StartFailed, match=r"on_start had not returned after 1 s .*it was stopped by a signal, "):
        rr.System([child], state_dir=tmp_path / "state").start()


# -- process 1 of a container ----------------------------------------------------------------------------------------

REAPING = """
import ctypes, os, pathlib, signal, subprocess, sys, time
import rr_actors as rr
from rr_actors.hosting import run_files
from rr_actors.managers.programs import Programs

run_files.LOOK_S = 0.2


class Leaving(rr.Manager):
    @rr.server("orphans")
    def leave(self, number: int) -> int:
        own = subprocess.Popen(["sh", "-c", "exit 5"])
        ended = pathlib.Path("ended").resolve()
        for _ in range(number):  # each shell ends at once, and its child somewhat later, when the shell is gone
            subprocess.run(["sh", "-c", f"(sleep 0.3; echo >> {ended}) &"])
        while not ended.exists() or len(ended.read_bytes()) < number:
            time.sleep(0.01)
        return own.wait()


def zombies():
    found = {}
    for stat in pathlib.Path("/proc").glob("[0-9]*/stat"):
        try:
            state, parent = stat.read_text().rpartition(") ")[2].split()[:2]
        except OSError:
            continue
        if state == "Z" and int(parent) == os.getpid():
            found[int(stat.parent.name)] = stat
    return set(found)


def reaped(but=()):
    deadline = time.monotonic() + 10
    while zombies() - set(but) and time.monotonic() < deadline:
        time.sleep(0.05)
    return zombies() == set(but)


if __name__ == "__main__":
    if os.getpid() != 1:
        ctypes.CDLL(None).prctl(36, 1, 0, 0, 0)  # PR_SET_CHILD_SUBREAPER
    children = [rr.ChildSpec(Leaving, id="leaving"), rr.ChildSpec(Programs, id="programs")]
    with rr.System(children, state_dir="state") as system:
        app = system.open_registrar("app")
        own = subprocess.Popen(["sh", "-c", "exit 7"])
        print("its own", app.load("leaving/orphans", 20).response, "reaped", reaped([own.pid]))
        program = app.load("programs/program", {"command": "sleep", "arguments": ["100"]})
        (before,) = [child.pid for child in system.supervisor().which_children() if child.id == "programs"]
        os.kill(before, signal.SIGKILL)
        program.unload(timeout_s=20)
        print("of programs", reaped([own.pid]))
        print("code", own.wait())
"""
REAPED = "its own 5 reaped True\nof programs True\ncode 7\n"


def test_a_subreaper_reaps_what_its_managers_leave_and_takes_no_exit_status(tmp_path: Path) -> None:
    ran = run(tmp_path, REAPING)
    assert ran.stdout == REAPED, ran.stderr


def test_process_1_reaps_what_its_managers_leave_and_takes_no_exit_status(tmp_path: Path) -> None:
    inside = ["unshare", "--pid", "--fork", "--mount-proc", "--kill-child"]
    if subprocess.run([*inside, "true"], check=False, capture_output=True).returncode:
        pytest.skip("this user may not make a process namespace")
    (tmp_path / "program.py").write_text(REAPING)
    ran = subprocess.run(
        [*inside, sys.executable, "program.py"],
        cwd=tmp_path,
        env=os.environ | {"PYTHONPATH": str(REPOSITORY)},
        timeout=LIMIT_S,
        capture_output=True,
        text=True,
        check=False,
    )
    assert ran.stdout == REAPED, ran.stderr


# -- more children than descriptors ----------------------------------------------------------------------------------


@pytest.mark.parametrize("placement", ["thread", "process"])
def test_children_for_whom_there_are_too_few_descriptors_are_refused_before_any_starts(
    tmp_path: Path, placement: str
) -> None:
    program = f"""{MANAGER}
import resource

if __name__ == "__main__":
    resource.setrlimit(resource.RLIMIT_NOFILE, (1024, 2048))
    children = [rr.ChildSpec(Cameras, id=f"cameras{{number}}") for number in range(247)]
    many = rr.Supervisor(children, id="many", placement={placement!r})
    system = rr.System([many], state_dir="state")
    events = []
    system.subscribe(events.append)
    try:
        system.start()
    except rr.StartFailed as error:
        print(error)
    print([event for event in events if "cameras" in event.get("path", "")])
"""
    ran = run(tmp_path, program)
    words, started = ran.stdout.splitlines()
    where = "root: " if placement == "thread" else "child root/many did not start: root/many: "
    assert words.startswith(f"{where}expected at least 10"), ran
    assert "got 1024 (the hard limit is 2048): 4 for each of 247 child processes" in words
    assert started == "[]"


def test_children_for_whom_the_descriptors_just_suffice_start(tmp_path: Path) -> None:
    program = f"""{MANAGER}
import resource

if __name__ == "__main__":
    resource.setrlimit(resource.RLIMIT_NOFILE, (64, 64))
    children = [rr.ChildSpec(Cameras, id=f"cameras{{number}}") for number in range(5)]
    with rr.System(children, state_dir="state") as system:
        queries = [system.open_registrar("app").load("cameras4/camera", "one")]
        print(queries[0].response)
"""
    assert run(tmp_path, program).stdout == "open one\n"
