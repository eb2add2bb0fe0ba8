"""`rr-actors import-temoto`: TeMoto's files on the command line."""

from __future__ import annotations

import sys
import tomllib
from pathlib import Path

import pytest
from typer.testing import CliRunner

import rr_actors as rr
from rr_actors.tools.verbs.verb_group import app

TEXT = """
Components:
- component_name: Café
  component_type: "2d_camera"
  package_name: eyes
  executable: front
  output_topics: { camera_data: image }
"""


@pytest.fixture
def file(tmp_path: Path) -> Path:
    path = tmp_path / "components.yaml"
    path.write_text(TEXT)
    return path


def test_the_file_for_pipes_is_printed(file: Path) -> None:
    ran = CliRunner().invoke(app, ["import-temoto", str(file)], catch_exceptions=False)

    assert ran.exit_code == 0
    (component,) = tomllib.loads(ran.stdout)["component"]
    assert (component["name"], component["outputs"]) == ("Café", ["camera_data"])


def test_a_wrong_file_is_an_error_and_nothing_is_printed(file: Path) -> None:
    wrong = file.with_name("pipes.yaml")
    wrong.write_text("tests: 1\n")

    ran = CliRunner().invoke(app, ["import-temoto", str(file), str(wrong)])

    assert isinstance(ran.exception, rr.ConfigError)
    assert (ran.exception.details["file"], ran.exception.details["key"]) == (str(wrong), "tests")
    assert ran.stdout == ""


def test_without_pyyaml_the_error_says_what_to_install(file: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delitem(sys.modules, "rr_actors.managers.pipes.temoto_files", raising=False)
    monkeypatch.delattr("rr_actors.managers.pipes.temoto_files", raising=False)
    monkeypatch.setitem(sys.modules, "yaml", None)

    ran = CliRunner().invoke(app, ["import-temoto", str(file)])

    assert isinstance(ran.exception, rr.UsageError)
    assert "needs the library yaml" in str(ran.exception)
    assert "pip install '.[temoto]'" in str(ran.exception)
