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
    there = {str(path.relative_to(REPOSITORY)) for path in (REPOSITORY / "rr_actors").rglob("*") if path.is_file()}
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


def test_the_wheel_alone_runs_the_first_program_of_the_readme_in_a_fresh_environment(
    wheel: Path, tmp_path: Path
) -> None:
    run(sys.executable, "-m", "venv", "--without-pip", tmp_path / "fresh", cwd=tmp_path)
    python = tmp_path / "fresh" / "bin" / "python"
    install = (sys.executable, "-m", "pip", "--python", python, "install", "-q", "--no-deps", "--no-index")
    run(*install, wheel, cwd=tmp_path)
    (libraries,) = (tmp_path / "fresh" / "lib").glob("python*/site-packages")
    for name in dependencies(facts(wheel).get_all("Requires-Dist", [])):
        files = metadata.files(name) or []
        for top in {file.parts[0] for file in files if file.parts[0] not in ("..", "__pycache__")}:
            (libraries / top).symlink_to(str(metadata.distribution(name).locate_file(top)))  # not fetched
    page = (REPOSITORY / "README.md").read_text()
    program, shown = re.findall(r"^```python\n(.*?)^```\n\n```text\n(.*?)^```", page, re.MULTILINE | re.DOTALL)[0]
    (tmp_path / "first.py").write_text(program + "print(rr.__file__)\n")

    printed = run(python, "-uI", "first.py", cwd=tmp_path).splitlines()

    assert printed[:-1] == shown.splitlines()
    assert Path(printed[-1]) == libraries / "rr_actors" / "__init__.py"


def test_the_changelog_has_the_form_of_keep_a_changelog() -> None:
    headings = re.findall(r"^(#+) (.*)", (REPOSITORY / "CHANGELOG.md").read_text(), re.MULTILINE)
    versions = [text for level, text in headings if level == "##"]
    assert headings[0] == ("#", "Changelog")
    assert versions
    form = re.compile(r"\[Unreleased\]|\[\d+\.\d+\.\d+\] - \d{4}-\d\d-\d\d")
    assert [text for text in versions if not form.fullmatch(text)] == []
    kinds = {text for level, text in headings if level == "###"}
    assert kinds <= {"Added", "Changed", "Deprecated", "Removed", "Fixed", "Security"}
