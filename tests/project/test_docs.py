"""The pages are true: every Python snippet runs and prints what it says, every link and path leads somewhere."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
PAGES = [*sorted(ROOT.glob("*.md")), *sorted((ROOT / "docs").rglob("*.md"))]
SNIPPET = re.compile(r"^```python\n(.*?)^```", re.MULTILINE | re.DOTALL)
OUTPUT = re.compile(r"^```python\n.*?^```\n\n```text\n(.*?)^```", re.MULTILINE | re.DOTALL)
FENCED = re.compile(r"^```.*?^```", re.MULTILINE | re.DOTALL)
LINK = re.compile(r"\[[^\]]*\]\(([^)#\s]*)(?:#([^)\s]*))?\)")
"""Groups: the target, and the heading or the test in it."""
HEADING = re.compile(r"^#+ (.*)", re.MULTILINE)
PATH = re.compile(r"`((?:rr_actors|docs|tests|examples|benchmarks)/[\w/.\-]*[\w/])`")
PRINTS = re.compile(r"# prints: (.*)")


def name(page: Path) -> str:
    return str(page.relative_to(ROOT))


def script(page: Path) -> str:
    """The page's snippets as one script, each on the line that it has in the page."""
    text = page.read_text()
    lines: list[str] = []
    for match in SNIPPET.finditer(text):
        lines += [""] * (text.count("\n", 0, match.start(1)) - len(lines))
        lines += match.group(1).splitlines()
    return "\n".join(lines) + "\n"


@pytest.mark.timeout(150)  # the longest page takes 12 s alone, and 50 s on a machine that is busy four times over
@pytest.mark.parametrize("page", [page for page in PAGES if SNIPPET.search(page.read_text())], ids=name)
def test_the_snippets_of_a_page_run_from_top_to_bottom(page: Path, tmp_path: Path) -> None:
    code = script(page)
    file = tmp_path / (page.stem.replace("-", "_") + ".py")
    file.write_text(code)

    ran = subprocess.run(
        [sys.executable, "-u", file], cwd=tmp_path, capture_output=True, text=True, timeout=140
    )  # unbuffered: what several processes print comes in its order

    assert ran.returncode == 0, ran.stdout + ran.stderr
    printed = iter(ran.stdout.splitlines())
    for expected in PRINTS.findall(code):
        assert any(line.strip() == expected.strip() for line in printed), (
            f"{name(page)}: {expected!r} was not printed, or not in this order:\n{ran.stdout}{ran.stderr}"
        )


TWO_OF_ONE_REQUEST = """
import rr_actors as rr

def test(manager, server, request):
    with rr.System([rr.ChildSpec(manager, id="m", placement="thread")], state_dir="state") as system:
        app = system.open_registrar("app")
        lost = app.load(f"m/{server}", request)
        system.registrar("m").send_status(lost.resource_id, rr.Status(rr.State.FATAL, "unplugged"))
        lost.wait_status(rr.State.FATAL, timeout_s=20)
        fresh = app.load(f"m/{server}", request)
        assert fresh.resource_id != lost.resource_id
        lost.unload()
        assert app.load(f"m/{server}", request).resource_id == fresh.resource_id
        for one in app.queries():
            one.unload()
        assert system.registrar("m").resources() == []
"""


@pytest.mark.parametrize(
    ("page", "manager", "server"),
    [
        ("docs/streams.md", "Cameras", "camera"),
        ("examples/camera.py", "Cameras", "camera"),
        ("examples/recipes/serial_lab.py", "Instruments", "instrument"),
        ("examples/applications/shared_model.py", "Models", "model"),
    ],
)
def test_a_manager_that_is_shown_holds_two_resources_of_one_request(
    page: str, manager: str, server: str, tmp_path: Path
) -> None:
    file = ROOT / page
    (tmp_path / "shown.py").write_text(script(file) if file.suffix == ".md" else file.read_text())
    request = "shown.instrument()" if server == "instrument" else repr("door")
    end = f'import shown\nif __name__ == "__main__":\n    test(shown.{manager}, "{server}", {request})\n'
    (tmp_path / "two.py").write_text(TWO_OF_ONE_REQUEST + end)
    ran = subprocess.run([sys.executable, "two.py"], cwd=tmp_path, capture_output=True, text=True, timeout=50)
    assert ran.returncode == 0, ran.stderr


def test_the_first_program_prints_what_the_page_shows_and_nothing_else(tmp_path: Path) -> None:
    page = ROOT / "README.md"
    text = page.read_text()
    (shown,) = OUTPUT.findall(text)
    (tmp_path / "first.py").write_text(script(page))

    ran = subprocess.run([sys.executable, "-u", "first.py"], cwd=tmp_path, capture_output=True, text=True, timeout=50)

    assert ran.stdout == shown, ran.stderr
    assert len(ran.stderr.splitlines()) == 1, ran.stderr  # the log's line about the kill
    assert "SIGKILL" in ran.stderr


def anchors(page: Path) -> set[str]:
    """The headings of a page, or the tests of a module, as links name them."""
    if page.suffix == ".py":
        return set(re.findall(r"^(?:async )?def (test_\w+)", page.read_text(), re.MULTILINE))
    headings = HEADING.findall(FENCED.sub("", page.read_text()))
    return {re.sub(r"[^\w\- ]", "", heading.lower()).strip().replace(" ", "-") for heading in headings}


@pytest.mark.parametrize("page", PAGES, ids=name)
def test_every_link_of_a_page_leads_to_a_file_and_to_a_heading_or_test_in_it(page: Path) -> None:
    wrong: list[str] = []
    for target, part in LINK.findall(FENCED.sub("", page.read_text())):
        file = page.parent / target if target else page
        if "://" not in target and (not file.exists() or (part and part not in anchors(file))):
            wrong.append(f"{target}#{part}")

    assert wrong == []


def test_a_picture_is_small_and_shown_somewhere() -> None:
    shown = "".join(page.read_text() for page in PAGES)
    pictures = list((ROOT / "docs" / "images").iterdir())

    assert pictures
    assert [picture.name for picture in pictures if f"images/{picture.name})" not in shown] == []
    assert {picture.name: size for picture in pictures if (size := picture.stat().st_size) > 200_000} == {}


def test_every_promise_has_a_link_to_a_test() -> None:
    _, *promises = re.split(r"^- ", (ROOT / "docs" / "semantics.md").read_text(), flags=re.MULTILINE)

    assert [
        promise for promise in promises if not any(part.startswith("test_") for _, part in LINK.findall(promise))
    ] == []
    assert len(promises) > 60


@pytest.mark.parametrize("page", PAGES, ids=name)
def test_every_path_that_a_page_names_exists(page: Path) -> None:
    assert [path for path in PATH.findall(page.read_text()) if not (ROOT / path).exists()] == []


@pytest.mark.parametrize("page", PAGES, ids=name)
def test_every_test_that_a_page_names_exists(page: Path) -> None:
    text = "".join(path.read_text() for path in (ROOT / "tests").rglob("test_*.py"))
    there = set(re.findall(r"^(?:async )?def (test_\w+)", text, re.MULTILINE))

    assert [test for test in re.findall(r"`(test_\w+)`", page.read_text()) if test not in there] == []


def test_nothing_is_installed_from_an_index_that_does_not_have_it() -> None:
    texts = [*PAGES, *(file for file in (ROOT / "examples").rglob("*") if file.suffix in (".py", ""))]
    wrong = re.compile(r"pip\s+install\s+(?:-\S+\s+)*['\"]?rr[-_]actors")
    assert [name(file) for file in texts if file.is_file() and wrong.search(file.read_text())] == []


def test_every_page_that_the_code_names_is_there() -> None:
    named = re.compile(r"docs/[\w/\-]+\.md")
    files = [
        file
        for part in ("rr_actors", "tests", "benchmarks", "examples", "fuzz")
        for file in (ROOT / part).rglob("*.py")
    ]
    pages = {page: file.name for file in files for page in named.findall(file.read_text())}
    assert "docs/semantics.md" in pages
    assert {page: file for page, file in pages.items() if not (ROOT / page).exists()} == {}
