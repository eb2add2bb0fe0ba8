"""Types: what mypy, pyright and completion know of programs that use rr_actors, each as strict as it can be."""

from __future__ import annotations

import inspect
import json
import pydoc
import re
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

import rr_actors as rr

ROOT = Path(__file__).resolve().parents[2]
TYPED = ROOT / "tests" / "typed"
SNIPPET = re.compile(r"^```python\n(.*?)^```", re.MULTILINE | re.DOTALL)
EXAMPLES = sorted((ROOT / "examples").glob("*.py"))
TIME_S = 170


@pytest.fixture(scope="module")
def programs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A directory as a user would have it: the README's program, one that uses loads, one that uses every name."""
    directory = tmp_path_factory.mktemp("programs")
    (directory / "readme.py").write_text(SNIPPET.findall((ROOT / "README.md").read_text())[0])
    (directory / "every_name.py").write_text("\n".join(every_name()) + "\n")
    (directory / "wrong.py").write_text(WRONG)
    shutil.copy(TYPED / "use.py", directory)
    return directory


def every_name() -> list[str]:
    """A program with every public name, each used as the type or the value that it is."""
    lines = ["import rr_actors as rr", "", ""]
    for name in sorted(rr.__all__):
        if isinstance(getattr(rr, name), type) and name not in ("server", "Declared"):
            lines += [
                f"def take_{name.lower()}_{len(lines)}(value: rr.{name}) -> rr.{name}:",
                "    return value",
                "",
                "",
            ]
        else:
            lines += [f"{name.lower()}_: object = rr.{name}"]
    return lines


def mypy(directory: Path, *files: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "mypy", "--strict", "--cache-dir", str(directory / ".mypy"), *files]
    return subprocess.run(command, cwd=directory, capture_output=True, text=True, timeout=TIME_S)


def pyright(directory: Path, *files: str) -> list[dict[str, Any]]:
    """What pyright says in strict mode."""
    config = {"include": list(files), "typeCheckingMode": "strict", "pythonVersion": "3.11"}
    (directory / "pyrightconfig.json").write_text(json.dumps(config))
    command = [sys.executable, "-m", "pyright", "--pythonpath", sys.executable, "--outputjson", "--project", "."]
    ran = subprocess.run(command, cwd=directory, capture_output=True, text=True, timeout=TIME_S)
    return [found for found in json.loads(ran.stdout)["generalDiagnostics"] if found["severity"] == "error"]


WRONG = """\
from __future__ import annotations

import rr_actors as rr


class Cameras(rr.Manager):
    @rr.server("camera")
    def open_camera(self, device: str) -> int:
        return len(device)

    @open_camera.unload  # error
    def close_camera(self, device: str, response: str) -> None: ...

    @open_camera.status  # error
    def camera_status(self, device: str) -> None: ...

    @open_camera.recover  # error
    def recover_camera(self, device: str, response: int) -> str:
        return device

    @open_camera.usage  # error
    def camera_usage(self, device: int, response: int) -> dict[str, float]:
        return {}

    @open_camera.health  # error
    def camera_health(self, device: str, response: int) -> int:
        return 0

    @open_camera.pause  # error
    def pause_camera(self, device: str) -> None: ...

    @open_camera.resume  # error
    async def resume_camera(self, device: str, response: int) -> str:
        return device

    @rr.server("zoom")
    def zoom(self, device: str, factor: float = 1.0) -> int:
        return len(device)


def use(app: rr.Registrar) -> None:
    app.load(Cameras.open_camera, 3)  # error
    app.load(Cameras.open_camera, "a").response.upper()  # error
    app.load("cameras/camera", "a", response_type=str).response.topic  # error
    app.load("cameras/camera", "a", block=False).response  # error
    app.load(3, "a")  # error
    app.load(Cameras.zoom, "a")  # error
    app.load(Cameras.open_camera, "a", timeout=3)  # error
    app.load(Cameras.open_camera, "a", block=False).get().response.upper()  # error


async def use_async(app: rr.Registrar) -> None:
    await app.load_async(Cameras.open_camera, 3)  # error
    (await app.load_async(Cameras.open_camera, "a")).response.upper()  # error
    await app.load_async("cameras/camera", "a", timeout=3)  # error
    await app.load_async(3, "a")  # error
"""

PROGRAMS = ("readme.py", "use.py", "every_name.py")


@pytest.mark.timeout(TIME_S + 10)
def test_mypy_finds_nothing_in_programs_that_are_right(programs: Path) -> None:
    ran = mypy(programs, *PROGRAMS)
    assert ran.returncode == 0, ran.stdout + ran.stderr


@pytest.mark.timeout(TIME_S + 10)
def test_mypy_finds_nothing_in_the_examples(programs: Path) -> None:
    ran = mypy(programs, *(str(file) for file in EXAMPLES if file.stem != "mission"))
    assert ran.returncode == 0, ran.stdout + ran.stderr


@pytest.mark.timeout(TIME_S + 10)
def test_pyright_finds_nothing_in_programs_that_are_right(programs: Path) -> None:
    assert pyright(programs, *PROGRAMS) == []


def wrong_lines() -> list[int]:
    """Those that say "error": each is a mistake, and the others are none."""
    return [number for number, line in enumerate(WRONG.splitlines(), 1) if line.endswith("# error")]


@pytest.mark.timeout(TIME_S + 10)
def test_mypy_finds_the_mistakes(programs: Path) -> None:
    found = re.findall(r"^wrong\.py:(\d+): error", mypy(programs, "wrong.py").stdout, re.MULTILINE)
    assert sorted({int(number) for number in found}) == wrong_lines()


@pytest.mark.timeout(TIME_S + 10)
def test_pyright_finds_the_mistakes(programs: Path) -> None:
    lines = {found["range"]["start"]["line"] + 1 for found in pyright(programs, "wrong.py")}
    assert sorted(lines) == wrong_lines()


def test_the_typed_program_runs(programs: Path) -> None:
    ran = subprocess.run([sys.executable, "use.py"], cwd=programs, capture_output=True, text=True, timeout=50)
    assert (ran.returncode, ran.stdout) == (0, "used\n"), ran.stderr


COMPLETE = """
import json, sys
import jedi
environment = jedi.InterpreterEnvironment()
names, signatures = [], []
for code in json.load(sys.stdin):  # one after the other: the next Script reads the code of the last one anew
    script = jedi.Script(code, environment=environment)
    names.append([found.name for found in script.complete()])
    signatures.append([[one.name for one in found.params] for found in script.get_signatures()])
json.dump([names, signatures], sys.stdout)
"""
COMPLETED = {
    "app.load('cameras/camera', 1).re": {"response", "request", "registrar", "released", "resource_id"},
    "app.lo": {"load", "load_async", "load_catalog"},
    "app.load('cameras/camera', 1).response_": set[str](),
    "system.open_re": {"open_registrar"},
    "rr.co": {"codec"},
}
OPTIONS = ["on_status", "timeout_s", "parent", "progress", "priority", "wait_s"]


def jedi(*lines: str) -> tuple[list[list[str]], list[list[list[str]]]]:
    """What Jedi offers at the end of each line: the names, and the parameters of each signature."""
    before = "import rr_actors as rr\nsystem = rr.System()\napp = system.open_registrar('app')\n"
    programs = json.dumps([before + line for line in lines])
    # In a process of its own: here pytest has loaded rr_actors in a way that Jedi cannot read.
    ran = subprocess.run(
        [sys.executable, "-c", COMPLETE], input=programs, capture_output=True, text=True, timeout=60, check=True
    )
    names, signatures = json.loads(ran.stdout)
    return names, signatures


@pytest.mark.slow
def test_completion_offers_what_there_is() -> None:
    names, _ = jedi(*COMPLETED)
    for (line, expected), offered in zip(COMPLETED.items(), map(set, names), strict=True):
        assert expected <= offered, line
        assert bool(expected) == bool(offered), line


@pytest.mark.slow
def test_completion_shows_the_options_of_a_load_by_name() -> None:
    _, (load, load_async) = jedi("app.load(", "app.load_async(")
    first = ["server", "request", "response_type"]
    assert load == [[*first, "block", *OPTIONS]] * 2
    assert load_async == [[*first, *OPTIONS]]


def test_help_shows_the_options_of_a_load_and_what_each_means() -> None:
    for name in ("load", "load_async"):
        assert set(OPTIONS) < set(inspect.signature(getattr(rr.Registrar, name)).parameters)
    text = pydoc.render_doc(rr.Registrar.load)
    assert all(re.search(rf"^ +{option}: \w", text, re.MULTILINE) for option in OPTIONS)
