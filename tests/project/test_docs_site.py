"""The docs as a site: it builds, each public name is in the reference with a program, each page says for whom it is."""

from __future__ import annotations

import dataclasses
import inspect
import json
import re
import subprocess
import sys
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import pytest

import rr_actors as rr
from support import REPOSITORY

DOCS = REPOSITORY / "docs"
PAGES = [page for page in sorted(DOCS.rglob("*.md")) if page.parent.name != "decisions"]
HELPING = [REPOSITORY / "CONTRIBUTING.md", REPOSITORY / "SECURITY.md"]
REFERENCE = sorted((DOCS / "reference").glob("*.md"))
SNIPPET = re.compile(r"^```python\n(.*?)^```", re.MULTILINE | re.DOTALL)
SHOWN = re.compile(r"^### `rr_actors\.(\w+)`$", re.MULTILINE)


def test_every_public_name_is_in_the_reference_once() -> None:
    assert sorted(name for page in REFERENCE for name in SHOWN.findall(page.read_text())) == sorted(rr.__all__)


@pytest.mark.parametrize("page", REFERENCE, ids=lambda page: page.name)
def test_a_program_on_the_page_uses_every_public_name_of_it(page: Path) -> None:
    text = page.read_text()
    used = set(re.findall(r"\brr\.(\w+)", "".join(SNIPPET.findall(text))))
    missing = set(SHOWN.findall(text)) - used
    assert missing == (BY_HAND if page.name == "errors.md" else set())


BY_HAND = {
    *("RrError", "UsageError", "LoadError", "Unavailable", "CatalogError", "SupervisionError"),  # base classes: a table
    *("CatalogDamaged", "CatalogVersion", "RegistrarDown", "RestartIntensityExceeded"),  # need a damage or a death
}


@pytest.mark.parametrize("page", [*PAGES, *HELPING], ids=lambda page: page.name)
def test_a_page_begins_with_whom_it_is_for(page: Path) -> None:
    text = page.read_text()
    if text.startswith(":::"):
        return  # a page of the site that stands beside docs
    title, first, *_ = text.split("\n\n")
    assert title.startswith("# ")
    assert first.startswith("For readers who ")


def test_the_order_of_reading_is_tutorial_how_to_explanation_reference() -> None:
    contents = (DOCS / "index.md").read_text()
    assert re.findall(r"^:caption: (.*)$", contents, re.MULTILINE) == ["Tutorial", "How-to", "Explanation", "Reference"]
    listed = set(re.findall(r"^([a-z][\w/-]+)$", contents, re.MULTILINE)) | {"index"}
    top = {str(page.relative_to(DOCS).with_suffix("")) for page in PAGES if page.parent == DOCS}
    assert top - listed == set()


class _Fetched(HTMLParser):
    """The addresses that a browser fetches to show a page."""

    def __init__(self) -> None:
        super().__init__()
        self.addresses: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        if tag in ("script", "img", "link", "iframe"):
            self.addresses += [value for name, value in attrs if name in ("src", "href") and value]


WITHOUT_NETWORK = """
import socket, sys
def refuse(*_): raise AssertionError("the build must not use the network")
socket.socket.connect = socket.getaddrinfo = refuse
from sphinx.cmd.build import main
sys.exit(main(sys.argv[1:]))
"""


@pytest.mark.slow
@pytest.mark.timeout(300)
def test_the_site_is_built_without_warnings_and_network_and_fetches_nothing(tmp_path: Path) -> None:
    pytest.importorskip("furo", reason="needs the extra docs")
    out = tmp_path / "site"
    options = ["-qWE", "--keep-going", "-c", str(DOCS / "_site"), "-d", str(tmp_path / "trees"), str(DOCS), str(out)]

    built = subprocess.run(
        [sys.executable, "-c", WITHOUT_NETWORK, *options], cwd=REPOSITORY, capture_output=True, text=True, timeout=280
    )

    assert built.returncode == 0, built.stderr
    for page in out.rglob("*.html"):
        fetched = _Fetched()
        fetched.feed(page.read_text())
        assert [address for address in fetched.addresses if "//" in address] == [], page
    search = (out / "searchindex.js").read_text()
    assert "mailbox_limit" in search
    shown = "".join(page.read_text() for page in (out / "reference").glob("*.html"))
    assert [name for name in rr.__all__ if f'id="rr_actors.{name}"' not in shown] == []
    assert "data-theme=dark" in (out / "_static" / "styles" / "furo.css").read_text()


OPTIONS = [rr.RegistrarConfig, rr.SystemConfig, rr.ChildSpec, rr.Supervisor, rr.Backoff, rr.Hosts, rr.Export]
ENTRY = re.compile(r"^    (\w+(?:, \w+)*): (.*?)(?=^    \w|^$|\Z)", re.MULTILINE | re.DOTALL)
ADVICE = re.compile(r"(?:[.;] )(?:Give|Set|Raise|Lower|Turn|Name|raise) ")


def entries(cls: object) -> dict[str, str]:
    """What the docstring of a configuration or call says of each option."""
    found = ENTRY.findall(inspect.getdoc(cls) or "")
    return {name: " ".join(text.split()) for names, text in found for name in names.split(", ")}


def default_of(field: dataclasses.Field[Any]) -> object:
    return field.default if field.default_factory is dataclasses.MISSING else field.default_factory()


@pytest.mark.parametrize("cls", OPTIONS, ids=lambda cls: cls.__name__)
def test_every_option_says_its_default_and_when_to_change_it(cls: type) -> None:
    said = entries(cls)
    for field in dataclasses.fields(cls):
        if (default := default_of(field)) is dataclasses.MISSING:
            assert "no default" in said[field.name]
            continue
        stated = re.search(r"Default: (.*?)\. [A-Z]", said[field.name])
        assert stated, field.name
        number = f"{default:,}" if isinstance(default, int) and default is not False and default is not True else ""
        shown = {repr(default).replace("'", '"'), number} - {""}
        assert any(stated.group(1).startswith(text) or f", {text}" in stated.group(1) for text in shown), field.name
        assert ADVICE.search(said[field.name]), field.name


def test_every_option_of_a_server_says_its_default_and_when_to_change_it() -> None:
    parameters = inspect.signature(rr.Registrar.register_server).parameters.values()
    options = {one.name: one.default for one in parameters if one.default is not inspect.Parameter.empty}
    said = entries(rr.Registrar.register_server) | entries(rr.server)
    for one in inspect.signature(rr.server).parameters.values():  # its docstring has the others alone
        if one.name != "name":
            options.setdefault(one.name, one.default)
    for name, default in options.items():
        assert f"Default: {default}" in said[name], name
        assert ADVICE.search(said[name]), name


def test_every_configuration_is_looked_at() -> None:
    public = [getattr(rr, name) for name in rr.__all__]
    configurations = {value for value in public if dataclasses.is_dataclass(value) and "__post_init__" in vars(value)}
    assert configurations <= set(OPTIONS) | {rr.Status}


def test_every_push_runs_what_has_to_pass_on_each_python_that_the_package_names() -> None:
    workflow = (REPOSITORY / ".github" / "workflows" / "ci.yml").read_text()
    named = re.findall(r"Python :: (3\.\d+)", (REPOSITORY / "pyproject.toml").read_text())
    matrix = re.search(r"python: (\[.*\])", workflow)
    assert matrix
    assert set(named) <= set(json.loads(matrix.group(1)))
    assert "run: .ci/run" in workflow
    assert (REPOSITORY / ".ci" / "run").exists()
