"""What docs/in-your-application.md shows: each example is run as the page says, with real servers and real signals."""

from __future__ import annotations

import configparser
import contextlib
import json
import os
import pstats
import re
import shlex
import shutil
import signal
import subprocess
import sys
import time
import tomllib
import urllib.error
import urllib.request
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from support import REPOSITORY, eventually

EXAMPLES = REPOSITORY / "examples" / "applications"
BIN = Path(sys.executable).parent
START_S = 30.0
STOP_S = 20.0
ADDRESS = re.compile(r"(http://127\.0\.0\.1:[1-9]\d*)")


@pytest.fixture
def place(tmp_path: Path) -> Path:
    """A directory with the examples, where they run and keep their state."""
    return Path(shutil.copytree(EXAMPLES, tmp_path / "application"))


class Program:
    """A program that runs: what it has written, and how it ends."""

    def __init__(self, place: Path, command: list[str]) -> None:
        self._log = place / "log"
        environment = {**os.environ, "PYTHONPATH": str(REPOSITORY), "PYTHONUNBUFFERED": "1"}
        with self._log.open("wb") as log:
            self.process = subprocess.Popen(command, cwd=place, env=environment, stdout=log, stderr=log)

    @property
    def log(self) -> str:
        return self._log.read_text()

    def wait_for(self, pattern: str, count: int = 1) -> list[str]:
        """What the pattern finds in the log, once it is there so often."""

        def found() -> list[str]:
            assert self.process.poll() is None, self.log
            matches = re.findall(pattern, self.log)
            return matches if len(matches) >= count else []

        return eventually(found, START_S, f"{pattern} in the log")

    def stop(self, number: int = signal.SIGTERM) -> int:
        """Send the signal; the exit code."""
        self.process.send_signal(number)
        return self.process.wait(STOP_S)


@contextlib.contextmanager
def running(place: Path, *command: str | Path) -> Iterator[Program]:
    program = Program(place, [str(word) for word in command])
    try:
        yield program
    finally:
        if program.process.poll() is None:
            program.process.kill()
            program.process.wait()


def get(url: str) -> str:
    with urllib.request.urlopen(url, timeout=10) as answer:
        assert answer.status == 200
        return answer.read().decode()


def get_json(url: str) -> dict[str, Any]:
    return json.loads(get(url))


def still_running(place: Path) -> list[str]:
    """The systems whose state is below this directory, and which run."""
    return [str(path) for path in place.rglob("console.sock")]


# -- web servers ---------------------------------------------------------------------------------------------------


def test_fastapi_starts_the_system_with_the_application_and_stops_it_at_sigterm(place: Path) -> None:
    with running(place, BIN / "uvicorn", "--port", "0", "fastapi_app:app") as server:
        url = server.wait_for(ADDRESS.pattern)[0]
        assert get_json(f"{url}/cameras/front")["topic"] == "/images/front"
        assert still_running(place)
        server.stop()
    assert "Application shutdown complete" in server.log
    assert "Traceback" not in server.log
    assert still_running(place) == []


@pytest.mark.slow
def test_fastapi_has_a_system_in_each_of_several_workers(place: Path) -> None:
    with running(place, BIN / "uvicorn", "--port", "0", "--workers", "2", "fastapi_workers:app") as server:
        url = server.wait_for(ADDRESS.pattern)[0]
        server.wait_for("Application startup complete", 2)
        workers: set[int] = set()

        def both() -> bool:
            workers.add(get_json(f"{url}/cameras/front")["worker"])
            return len(workers) == 2

        eventually(both, START_S)
        assert len(still_running(place)) == 2
        server.stop()
    assert "Traceback" not in server.log
    assert still_running(place) == []


@pytest.mark.slow
def test_workers_of_a_web_service_share_a_model_that_is_loaded_again_after_a_kill(place: Path) -> None:
    with running(place, sys.executable, "shared_model.py") as owner:
        eventually(lambda: still_running(place), START_S)
        with running(place, BIN / "uvicorn", "--port", "0", "--workers", "2", "shared_model:app") as server:
            url = server.wait_for(ADDRESS.pattern)[0]
            server.wait_for("Application startup complete", 2)
            seen: list[dict[str, Any]] = []

            def both() -> bool:
                seen.append(get_json(f"{url}/numbers/two"))
                return len({answer["worker"] for answer in seen}) == 2

            eventually(both, START_S)
            (model,) = {answer["model_pid"] for answer in seen}
            os.kill(model, signal.SIGKILL)

            def answered() -> bool:
                with contextlib.suppress(urllib.error.HTTPError):  # 503
                    seen.append(get_json(f"{url}/numbers/two"))
                return seen[-1]["model_pid"] != model

            eventually(answered, START_S)
            assert {answer["number"] for answer in seen} == {2}
            server.stop()
        assert "Traceback" not in server.log
        assert owner.stop() == 0
    assert still_running(place) == []


@pytest.mark.slow
@pytest.mark.parametrize("preload", [(), ("--preload",)], ids=["without preload", "with preload"])
def test_gunicorn_has_a_system_in_each_worker(place: Path, preload: tuple[str, ...]) -> None:
    options = ("--workers", "2", "--bind", "127.0.0.1:0", "--config", "gunicorn_hooks.py", *preload)
    with running(place, BIN / "gunicorn", *options, "gunicorn_app:application") as server:
        url = server.wait_for(ADDRESS.pattern)[0]
        eventually(lambda: len(still_running(place)) == 2, START_S)
        workers: dict[str, str] = {}

        def both() -> bool:
            topic, worker = get(f"{url}/cameras/front").split()
            workers[worker] = topic
            return len(workers) == 2

        eventually(both, START_S)
        assert set(workers.values()) == {"/images/front"}
        os.kill(int(next(iter(workers))), signal.SIGKILL)  # gunicorn starts another, which takes its state directory
        workers.clear()
        eventually(both, START_S)
        assert server.stop() == 0
    assert "Traceback" not in server.log
    assert still_running(place) == []
    assert sorted(path.name for path in (place / "rr_state").iterdir()) == ["worker0", "worker1"]


@pytest.mark.slow
def test_django_starts_the_system_at_the_first_request(place: Path) -> None:
    with running(place, BIN / "gunicorn", "--bind", "127.0.0.1:0", "django_app:application") as server:
        url = server.wait_for(ADDRESS.pattern)[0]
        assert still_running(place) == []
        assert get_json(f"{url}/cameras/front") == {"topic": "/images/front"}
        assert still_running(place)
        assert server.stop() == 0
    assert "Traceback" not in server.log
    assert still_running(place) == []


# -- tests and notebooks -------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_the_tests_of_an_application_use_the_fixture(place: Path) -> None:
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "test_cameras.py"]
    environment = {**os.environ, "PYTHONPATH": str(REPOSITORY)}
    ran = subprocess.run(command, cwd=place, env=environment, capture_output=True, text=True, timeout=START_S)
    assert ran.returncode == 0, ran.stdout + ran.stderr
    assert "2 passed" in ran.stdout


def cells(place: Path) -> list[str]:
    return (place / "notebook.py").read_text().split("# %%")[1:]


@pytest.mark.slow
def test_a_notebook_starts_a_system_once_however_often_its_cell_runs(place: Path) -> None:
    start, use, stop = cells(place)
    code = {"cell_type": "code", "metadata": {}, "outputs": [], "execution_count": None}
    notebook = {"nbformat": 4, "nbformat_minor": 4, "metadata": {}, "cells": []}
    notebook["cells"] = [{**code, "source": f"# %%{source}"} for source in (start, start, use, stop)]
    (place / "notebook.ipynb").write_text(json.dumps(notebook))
    environment = {**os.environ, "PYTHONPATH": str(REPOSITORY), "IPYTHONDIR": str(place / "ipython")}
    ran = subprocess.run(
        [BIN / "jupyter-execute", "--inplace", "notebook.ipynb"],
        cwd=place,
        env=environment,
        capture_output=True,
        text=True,
        timeout=START_S,
        check=False,
    )
    assert ran.returncode == 0, ran.stderr
    (output,) = [out for cell in json.loads((place / "notebook.ipynb").read_text())["cells"] for out in cell["outputs"]]
    assert "".join(output["text"]) == "/images/front OK\n"
    assert still_running(place) == []


# -- services ------------------------------------------------------------------------------------------------------


def _may_make_pid_namespaces() -> bool:
    return subprocess.run(["unshare", "--pid", "--fork", "--mount-proc", "true"], capture_output=True).returncode == 0


def test_a_service_in_a_container_stops_in_order_as_process_1(place: Path) -> None:
    """As the Dockerfile starts it. Where the kernel lets nobody make a namespace, it is not process 1."""
    command = re.findall(r"^CMD (.*)$", (place / "Dockerfile").read_text(), re.MULTILINE)[0]
    program = [sys.executable if word == "python" else word for word in json.loads(command)]
    namespace = ("unshare", "--pid", "--fork", "--mount-proc", "--kill-child") if _may_make_pid_namespaces() else ()
    with running(place, *namespace, *program) as outer:
        outer.wait_for("the front camera is open")
        if namespace:
            children = Path(f"/proc/{outer.process.pid}/task/{outer.process.pid}/children")
            os.kill(int(children.read_text()), signal.SIGTERM)
            assert outer.process.wait(STOP_S) == 0
        else:
            assert outer.stop() == 0
    assert "the front camera is closed" in outer.log
    assert still_running(place) == []


def test_the_image_of_the_container_has_the_program_and_all_that_installs_the_package(tmp_path: Path) -> None:
    instructions = (EXAMPLES / "Dockerfile").read_text()
    for sources, target in re.findall(r"^COPY (.*) (\S+)$", instructions, re.MULTILINE):
        place = tmp_path / target.lstrip("/")
        for source in map(REPOSITORY.joinpath, sources.split()):
            if source.is_dir():
                shutil.copytree(source, place)
            else:
                place.mkdir(parents=True, exist_ok=True)
                shutil.copy(source, place)
    (installed,) = re.findall(r"^RUN pip install .*?(\S+)$", instructions, re.MULTILINE)
    package = tmp_path / installed.lstrip("/")
    project = tomllib.loads((package / "pyproject.toml").read_text())
    needed = [project["project"]["readme"], *project["project"]["license-files"]]
    needed += project["tool"]["hatch"]["build"]["targets"]["wheel"]["packages"]
    assert [name for name in needed if not (package / name).exists()] == []
    (directory,) = re.findall(r"^WORKDIR (\S+)$", instructions, re.MULTILINE)
    assert (tmp_path / directory.lstrip("/") / "service.py").exists()


def test_the_systemd_unit_runs_a_tree_that_stops_in_order_in_time(place: Path) -> None:
    unit = configparser.ConfigParser(interpolation=None)
    unit.optionxform = str  # type: ignore[assignment, method-assign]
    unit.read(place / "cameras.service")
    service = unit["Service"]
    program, *arguments = shlex.split(service["ExecStart"])
    assert Path(program).name == "rr-actors"
    assert arguments[-2:] == ["--state", "/var/lib/" + service["StateDirectory"]]
    with running(place, sys.executable, "-m", "rr_actors", *arguments[:-1], place / "state") as process:
        process.wait_for("the front camera is open")
        began = time.monotonic()
        assert process.stop() == 0
        assert time.monotonic() - began < float(service["TimeoutStopSec"])
    assert "the front camera is closed" in process.log
    assert still_running(place) == []


# -- looking inside ------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_coverage_counts_what_runs_in_managers(place: Path) -> None:
    coverage = (sys.executable, "-m", "coverage")
    with running(place, *coverage, "run", "--rcfile", "coverage.ini", "service.py") as service:
        service.wait_for("the front camera is open")
        assert service.stop() == 0
    assert "Exception ignored" not in service.log
    for command in (("combine", "-q"), ("json", "-q", "-o", "coverage.json")):
        subprocess.run([*coverage, *command, "--rcfile", "coverage.ini"], cwd=place, check=True, timeout=START_S)
    files = json.loads((place / "coverage.json").read_text())["files"]
    assert files["service.py"]["missing_lines"] == []


def test_a_profile_of_a_callback_is_written_where_it_runs(place: Path) -> None:
    environment = {**os.environ, "PYTHONPATH": str(REPOSITORY)}
    command = [sys.executable, "profiling.py"]
    subprocess.run(command, cwd=place, env=environment, check=True, timeout=START_S, capture_output=True)
    stats = pstats.Stats(str(place / "camera.prof"))
    functions = {name for _, _, name in stats.stats}  # type: ignore[attr-defined]
    assert "calibrate" in functions
