"""A system that is started by a module while that module is being imported, as web servers import an application."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

import rr_actors as rr
from rr_actors.supervision import import_guard
from rr_actors.supervision.core.specs import ChildSpec
from rr_actors.supervision.import_guard import check_children_can_import
from support import REPOSITORY

pytestmark = pytest.mark.cold

LIMIT_S = 30.0


class Empty(rr.Actor):
    pass


CLASSES = """
import rr_actors as rr


class Cameras(rr.Manager):
    @rr.server("camera")
    def open_camera(self, device: str) -> str:
        return "open " + device


class Echo(rr.Actor):
    def on_receive(self, message):
        return message
"""
START = """
system = rr.System([rr.ChildSpec(Cameras, id="cameras")], state_dir="state").start()
print(system.open_registrar("app").load("cameras/camera", "one").response)
"""
REFUSED = "refused while module 'app' is being imported"


def run(directory: Path, program: str, **modules: str) -> subprocess.CompletedProcess[str]:
    """Run a program beside these modules, in a bounded time."""
    for name, text in modules.items():
        (directory / f"{name}.py").write_text(text)
    command = [sys.executable, "-c", program]
    environment = {
        "PYTHONPATH": f"{directory}:{REPOSITORY}",
        "PATH": "/usr/bin:/bin",
        "XDG_RUNTIME_DIR": str(directory),
    }
    return subprocess.run(
        command, cwd=directory, env=environment, timeout=LIMIT_S, capture_output=True, text=True, check=False
    )


def refused(ran: subprocess.CompletedProcess[str], *words: str, error: str = "UsageError") -> None:
    assert ran.returncode != 0
    last = ran.stderr.strip().splitlines()[-1]
    assert last.startswith(f"rr_actors.base.errors.{error}: "), ran.stderr
    for word in (*words, "when the import is over"):
        assert word in last


@pytest.mark.parametrize(
    "program",
    [
        pytest.param("import app", id="import"),
        pytest.param("import importlib; importlib.import_module('app')", id="by name, as a web server does"),
        pytest.param(
            "import concurrent.futures as f; f.ThreadPoolExecutor().submit(__import__, 'app').result()",
            id="in a thread of the program",
        ),
        pytest.param(
            "import os, sys\n"
            "pid = os.fork()\n"
            "if not pid: import app\n"
            "code = os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])\n"
            "sys.exit(code)",
            id="in a worker that was forked",
        ),
    ],
)
def test_a_start_during_the_import_of_its_classes_is_refused_at_once(tmp_path: Path, program: str) -> None:
    ran = run(tmp_path, program, app=CLASSES + START)
    refused(ran, REFUSED, "root/cameras", "FastAPI", "gunicorn", "pytest")
    assert not (tmp_path / "state").exists()  # nothing was begun


def test_a_start_in_a_conftest_is_refused_at_once(tmp_path: Path) -> None:
    ran = run(
        tmp_path,
        "import pytest, sys; sys.exit(pytest.main(['-q', '-p', 'no:cacheprovider', '.']))",
        conftest=CLASSES + START,
        test_nothing="def test_nothing(): pass",
    )
    assert ran.returncode != 0
    assert "refused while module 'conftest' is being imported" in ran.stdout + ran.stderr


def test_a_start_during_the_import_of_the_package_of_its_classes_is_refused(tmp_path: Path) -> None:
    package = tmp_path / "app"
    package.mkdir()
    (package / "classes.py").write_text(CLASSES)
    (package / "__init__.py").write_text("import rr_actors as rr\nfrom app.classes import Cameras\n" + START)
    refused(run(tmp_path, "import app"), REFUSED, "'app.classes'")


def test_what_a_childs_arguments_refer_to_counts_as_its_class_does(tmp_path: Path) -> None:
    start = """
import rr_actors as rr
from classes import Given


def mine(): ...


child = rr.ChildSpec(Given, id="given", args=([mine],))
rr.System([rr.Supervisor([child], id="inner")], state_dir="state").start()
"""
    given = "\n\nclass Given(Echo):\n    def __init__(self, functions): ...\n"
    refused(run(tmp_path, "import app", app=start, classes=CLASSES + given), REFUSED, "root/inner/given")


def test_a_start_during_an_import_works_if_the_classes_have_been_imported(tmp_path: Path) -> None:
    ran = run(
        tmp_path,
        "import app; print(app.system.ref('cameras').is_alive()); app.system.stop()",
        app="import rr_actors as rr\nfrom classes import Cameras\n" + START,
        classes=CLASSES,
    )
    assert ran.stdout.splitlines() == ["open one", "True"], ran.stderr


def test_children_in_threads_and_registrars_of_the_process_start_during_an_import(tmp_path: Path) -> None:
    start = """
with rr.System([rr.ChildSpec(Cameras, id="cameras", placement="thread")], state_dir="state") as system:
    app = system.open_registrar("app")
    app.register_server("own", lambda request: request + 1)
    print(app.load("cameras/camera", "one").response, app.load("app/own", 1).response)
    echo = system.start_child(rr.ChildSpec(Echo, id="echo", placement="thread"))
    print(echo.ask("hello"))
print(Echo.start().ask("alone"))
"""
    ran = run(tmp_path, "import app", app=CLASSES + start)
    assert ran.stdout.splitlines() == ["open one 2", "hello", "alone"], ran.stderr


def test_a_child_that_is_added_during_the_import_of_its_class_is_refused(tmp_path: Path) -> None:
    start = """
with rr.System(state_dir="state") as system:
    system.start_child(rr.ChildSpec(Echo, id="echo"))
"""
    refused(run(tmp_path, "import app", app=CLASSES + start), REFUSED, "start_child()", "root/echo")


def test_a_child_that_would_start_a_system_while_it_imports_its_class_does_not(tmp_path: Path) -> None:
    """`app` is no module here that is being imported, as far as Python knows: the child finds out."""
    program = """
import importlib.util, sys
spec = importlib.util.spec_from_file_location("app", "app.py")
module = sys.modules["app"] = importlib.util.module_from_spec(spec)
spec.loader.exec_module(module)
"""
    ran = run(tmp_path, program, app=CLASSES + START)
    refused(ran, "refused in a child process", "importing 'app'", error="StartFailed")


def test_a_fork_server_that_would_start_a_system_while_it_preloads_a_module_does_not(tmp_path: Path) -> None:
    start = """
import rr_actors as rr
from classes import Cameras
config = rr.SystemConfig(preload=("app",))
system = rr.System([rr.ChildSpec(Cameras, id="cameras")], state_dir="state", config=config).start()
print(system.open_registrar("app").load("cameras/camera", "one").response)
"""
    ran = run(tmp_path, "import app; app.system.stop()", app=start, classes=CLASSES)
    assert ran.stdout.splitlines() == ["open one"], ran.stderr
    assert "refused in a child process of rr_actors that is importing 'app'" in ran.stderr


def test_a_child_in_a_thread_of_this_process_needs_no_look_at_what_is_imported(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(import_guard, "in_progress", None)
    check_children_can_import(ChildSpec(Empty, id="one", placement="thread"), "root/one", "start_child()")
