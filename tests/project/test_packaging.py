"""What is published works: the wheel is built from the sdist, and runs alone with the dependencies that it declares."""

from __future__ import annotations

import re
import subprocess
import sys
import tarfile
import zipfile
from email.message import Message
from email.parser import Parser
from importlib import metadata
from pathlib import Path

import pytest
from packaging.requirements import Requirement

import rr_actors as rr
from support import REPOSITORY

pytest.importorskip("hatchling", reason="needs hatchling: the extra test has it")
pytestmark = pytest.mark.timeout(180)


def run(*command: str | Path, cwd: Path) -> str:
    done = subprocess.run(command, cwd=cwd, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The wheel that the sdist gives."""
    place = tmp_path_factory.mktemp("dist")
    build = (sys.executable, "-m", "hatchling", "build", "-d", place)
    run(*build, "-t", "sdist", cwd=REPOSITORY)
    (sdist,) = place.glob("*.tar.gz")
    with tarfile.open(sdist) as archive:
        archive.extractall(place, filter="data")
    run(*build, "-t", "wheel", cwd=place / f"rr_actors-{rr.__version__}")
    (wheel,) = place.glob("*.whl")
    return wheel


def facts(wheel: Path) -> Message:
    with zipfile.ZipFile(wheel) as archive:
        return Parser().parsestr(archive.read(f"rr_actors-{rr.__version__}.dist-info/METADATA").decode())


def test_the_wheel_has_the_package_alone_with_all_its_files(wheel: Path) -> None:
    folders = [REPOSITORY / "rr_actors", REPOSITORY / "rr_actors_pytest"]
    there = {str(path.relative_to(REPOSITORY)) for one in folders for path in one.rglob("*") if path.is_file()}
    there = {path for path in there if "__pycache__" not in path}
    packed = set(zipfile.ZipFile(wheel).namelist())
    assert {path for path in packed if ".dist-info/" not in path} == there
    assert facts(wheel)["Version"] == rr.__version__


def dependencies(requirements: list[str]) -> set[str]:
    """The names of these distributions and of those that they need, without extras."""
    found: set[str] = set()
    for requirement in map(Requirement, requirements):
        if requirement.marker is None or requirement.marker.evaluate({"extra": ""}):
            found |= {requirement.name} | dependencies(metadata.requires(requirement.name) or [])
    return found


def environment(place: Path, *requirements: str) -> tuple[Path, Path]:
    """The interpreter of a fresh environment that has what these distributions need; the folder of its libraries."""
    run(sys.executable, "-m", "venv", "--without-pip", place / "fresh", cwd=place)
    python = place / "fresh" / "bin" / "python"
    (libraries,) = (place / "fresh" / "lib").glob("python*/site-packages")
    for name in dependencies(list(requirements)):
        files = metadata.files(name) or []
        for top in {file.parts[0] for file in files if file.parts[0] not in ("..", "__pycache__")}:
            (libraries / top).symlink_to(str(metadata.distribution(name).locate_file(top)))  # not fetched
    return python, libraries


def pip(python: Path, *command: str | Path) -> None:
    run("env", "-u", "PYTHONPATH", sys.executable, "-m", "pip", "--python", python, "-q", *command, cwd=python.parent)


def test_the_wheel_alone_runs_the_first_program_of_the_readme_in_a_fresh_environment(
    wheel: Path, tmp_path: Path
) -> None:
    python, libraries = environment(tmp_path, *facts(wheel).get_all("Requires-Dist", []))
    pip(python, "install", "--no-deps", "--no-index", wheel)
    page = (REPOSITORY / "README.md").read_text()
    program, shown = re.findall(r"^```python\n(.*?)^```\n\n```text\n(.*?)^```", page, re.MULTILINE | re.DOTALL)[0]
    (tmp_path / "first.py").write_text(program + "print(rr.__file__)\n")

    printed = run(python, "-uI", "first.py", cwd=tmp_path).splitlines()

    assert printed[:-1] == shown.splitlines()
    assert Path(printed[-1]) == libraries / "rr_actors" / "__init__.py"


TESTS = """
import sys, threading
import pytest

def test_of_another_project():
    assert [name for name in sys.modules if name.partition(".")[0] == "rr_actors"] == []

def test_that_uses_it(rr_system):
    import rr_actors as rr
    class Lamps(rr.Manager):
        @rr.server("lamp")
        def switch_on(self, room: str) -> str:
            return f"{room} is lit"
    system = rr_system(rr.ChildSpec(Lamps, id="lamps", placement="thread"))
    assert system.open_registrar("app").load("lamps/lamp", "hall").response == "hall is lit"
"""


def test_pytest_imports_nothing_of_the_package_until_it_is_used_and_an_uninstall_leaves_nothing(
    wheel: Path, tmp_path: Path
) -> None:
    python, libraries = environment(tmp_path, *facts(wheel).get_all("Requires-Dist", []), "pytest")
    zipfile.ZipFile(wheel).extractall(libraries)  # as pip does, in less time
    (tmp_path / "test_both.py").write_text(TESTS)
    run(python, "-I", "-m", "pytest", "-p", "no:cacheprovider", "test_both.py", cwd=tmp_path)
    assert list(libraries.rglob("rr_actors*/**/*-pytest-*.pyc")) == []  # what pytest has rewritten
    pip(python, "uninstall", "--yes", "rr-actors")
    assert list(libraries.glob("rr_actors*")) == []
    assert list(libraries.glob("__pycache__/rr_actors*")) == []


def test_the_changelog_has_the_form_of_keep_a_changelog() -> None:
    headings = re.findall(r"^(#+) (.*)", (REPOSITORY / "CHANGELOG.md").read_text(), re.MULTILINE)
    versions = [text for level, text in headings if level == "##"]
    assert headings[0] == ("#", "Changelog")
    assert versions
    form = re.compile(r"\[Unreleased\]|\[\d+\.\d+\.\d+\] - \d{4}-\d\d-\d\d")
    assert [text for text in versions if not form.fullmatch(text)] == []
    kinds = {text for level, text in headings if level == "###"}
    assert kinds <= {"Added", "Changed", "Deprecated", "Removed", "Fixed", "Security"}
