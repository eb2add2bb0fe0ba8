"""Notebooks: the one in docs runs; cells that run again, Interrupt and a restarted kernel leave nothing behind."""

from __future__ import annotations

import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import nbformat
import pytest
from jupyter_client.manager import KernelManager
from jupyter_core.utils import ensure_event_loop

from support import REPOSITORY, TEST_PATHS, lives, wait_gone
from support_slow import few_now

ensure_event_loop()  # the client's, which this process keeps: it has two sockets

START = """
import rr_actors as rr

class Cameras(rr.Manager):
    @rr.server("camera")
    def open_camera(self, device: str) -> str:
        return "images of " + device

system = rr.System.running("state") or rr.System([rr.ChildSpec(Cameras, id="cameras")], state_dir="state").start()
try:
    app = system.open_registrar("app")
except rr.NameTaken:
    app = system.registrar("app")
print(app.load("cameras/camera", "front").response, system.ref("cameras").pid)
"""


EXECUTE = """
import sys, nbformat
from nbclient import NotebookClient

_, file, directory, executed = sys.argv
notebook = nbformat.read(file, as_version=4)
NotebookClient(notebook, timeout=50, resources={"metadata": {"path": directory}}).execute()
nbformat.write(notebook, executed)
"""


class Kernel:
    """A notebook's kernel in a directory of its own."""

    def __init__(self, directory: Path) -> None:
        self.manager = KernelManager(kernel_name="python3")
        self.manager.start_kernel(cwd=str(directory))
        self.client = self.manager.client()
        self.client.start_channels()
        self.client.wait_for_ready(timeout=30)

    def begin(self, code: str) -> str:
        """Run a cell, and do not wait for its end."""
        return self.client.execute(code)

    def run(self, code: str) -> str:
        """Run a cell; what it prints, or the name of its error."""
        return self.end(self.begin(code))

    def end(self, cell: str) -> str:
        """Wait for a cell's end."""
        said: list[str] = []
        while True:
            message: dict[str, Any] = self.client.get_iopub_msg(timeout=30)
            if message["parent_header"].get("msg_id") != cell:
                continue
            content = message["content"]
            if message["msg_type"] == "stream" and content["name"] == "stdout":
                said.append(content["text"])
            elif message["msg_type"] == "error":
                said.append(content["ename"])
            elif message["msg_type"] == "status" and content["execution_state"] == "idle":
                return "".join(said)

    @property
    def pid(self) -> int:
        return int(self.run("import os; print(os.getpid())"))

    def close(self) -> None:
        self.run("if 'system' in globals(): system.stop()")
        self.manager.shutdown_kernel(now=False)
        self.client.stop_channels()
        self.client.context.destroy()


@pytest.fixture(autouse=True)
def paths(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("PYTHONPATH", TEST_PATHS)
    monkeypatch.setenv("IPYTHONDIR", str(tmp_path / "ipython"))
    monkeypatch.setenv("JUPYTER_RUNTIME_DIR", str(tmp_path / "jupyter"))


@pytest.fixture
def kernel(tmp_path: Path) -> Iterator[Kernel]:
    kernel = Kernel(tmp_path)
    yield kernel
    kernel.close()


def cameras_pid(said: str) -> int:
    words = said.split()
    assert words[:3] == ["images", "of", "front"], said
    return int(words[3])


def test_the_notebook_in_docs_runs_and_shows_pictures(tmp_path: Path) -> None:
    executed = tmp_path / "executed.ipynb"
    ran = subprocess.run(
        [sys.executable, "-c", EXECUTE, REPOSITORY / "docs" / "notebook.ipynb", tmp_path, executed],
        capture_output=True,
        text=True,
    )
    assert ran.returncode == 0, ran.stderr
    notebook = nbformat.read(executed, as_version=4)
    shown = [set(output.get("data", ())) for cell in notebook.cells for output in cell.get("outputs", ())]

    assert sum("image/svg+xml" in forms for forms in shown) == 2
    assert sum("text/html" in forms for forms in shown) == 4
    assert any("text/vnd.mermaid" in forms and "text/html" in forms for forms in shown)
    assert not any(output["output_type"] == "error" for cell in notebook.cells for output in cell.get("outputs", ()))


def test_the_notebook_in_docs_is_small_and_has_no_outputs() -> None:
    file = REPOSITORY / "docs" / "notebook.ipynb"

    assert file.stat().st_size < 20_000
    assert all(not cell.get("outputs") for cell in nbformat.read(file, as_version=4).cells)


def test_a_cell_that_runs_again_uses_the_system_that_runs(kernel: Kernel) -> None:
    first = kernel.run(START)

    assert kernel.run(START) == first
    assert kernel.run("print(len(app.queries()), len(system.snapshot()['registrars']))") == "2 2\n"


def test_a_cell_that_is_edited_says_that_the_system_runs_the_code_from_before(kernel: Kernel) -> None:
    kernel.run("import warnings; warnings.showwarning = lambda message, *rest: print(message)")
    assert cameras_pid(kernel.run(START))
    said = kernel.run(START.replace("images of", "pictures of"))
    assert said.startswith("Cameras was defined anew, and the system still runs the code from before")
    assert "images of front" in said
    kernel.run("app.close(); system.stop()")
    assert kernel.run(START.replace("images of", "pictures of")).startswith("pictures of front")


def test_an_interrupted_cell_leaves_the_system_running_and_nothing_half_done(kernel: Kernel) -> None:
    pid = cameras_pid(kernel.run(START))
    kernel.run("import threading, time; begun = threading.Event()")
    kernel.run("slow = lambda request: (begun.set(), time.sleep(1))\napp.register_server('slow', slow)")
    cell = kernel.begin("print('begun', flush=True)\napp.load('app/slow', 'x')")
    _interrupt(kernel, cell)

    assert lives(pid)
    assert (
        kernel.run(
            "import time\n"
            "while len(app.queries()) > 1: time.sleep(0.05)\n"
            "print(app.load('cameras/camera', 'front').response)"
        )
        == "images of front\n"
    )


def _interrupt(kernel: Kernel, cell: str) -> None:
    """Interrupt a cell when it has printed something, as the notebook's button does."""
    while True:
        message: dict[str, Any] = kernel.client.get_iopub_msg(timeout=30)
        if message["parent_header"].get("msg_id") == cell and message["msg_type"] == "stream":
            break
    kernel.manager.interrupt_kernel()
    assert kernel.end(cell) == "KeyboardInterrupt"


@pytest.mark.parametrize("end", few_now(["kill"], ["restart"]))
def test_a_kernel_that_is_restarted_or_killed_leaves_no_process_and_the_next_one_starts_again(
    kernel: Kernel, end: str
) -> None:
    pid = cameras_pid(kernel.run(START))
    old = kernel.pid
    if end == "restart":
        kernel.manager.restart_kernel(now=False)
    else:
        kernel.manager.signal_kernel(signal.SIGKILL)
        wait_gone(old)
        kernel.manager.restart_kernel(now=True)
    kernel.client.wait_for_ready(timeout=30)
    wait_gone(pid)

    assert cameras_pid(kernel.run(START)) != pid
    assert kernel.run("system.stop()") == ""
