"""Texts of an experiment: what its page says, the program that its reader may change, and the same as a notebook."""

from __future__ import annotations

import importlib.util
import inspect
import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from rr_actors.tools.web.lab.lab_declarations import LabExperiment, Value

PACKAGE = "rr_actors.tools.experiments"
_LOOK_FOR = "Look for:"


@dataclass(frozen=True)
class Texts:
    """What the lab shows of an experiment.

    Attributes:
        title, about, look_for: texts for people, from the module's docstring.
        code: the module's text after the docstring.
    """

    title: str
    about: str
    look_for: str
    code: str


def texts_of(declared: LabExperiment) -> Texts:
    """Return the texts of an experiment, read from its module's file."""
    spec = importlib.util.find_spec(f"{PACKAGE}.{declared.program}")
    assert spec is not None
    assert spec.origin is not None
    _, docstring, code = Path(spec.origin).read_text().split('"""', 2)
    title, _, rest = inspect.cleandoc(docstring).partition("\n")
    about, _, look_for = rest.partition(_LOOK_FOR)
    return Texts(title.rstrip("."), _flowing(about), _flowing(look_for), code.strip() + "\n")


def notebook_of(declared: LabExperiment, levers: Mapping[str, Value]) -> str:
    """Return a Jupyter notebook, as JSON, that runs an experiment with these levers."""
    texts = texts_of(declared)
    question = [f"**{declared.question.text}**"] if declared.question else []
    said = "\n\n".join((f"# {texts.title}", texts.about, *question, f"Look for: {texts.look_for}"))
    arguments = "".join(f", {name}={value!r}" for name, value in levers.items())
    cells = [_cell("markdown", said), _cell("code", texts.code), _cell("code", f'main("lab_state"{arguments})')]
    kernel = {"kernelspec": {"name": "python3", "display_name": "Python 3", "language": "python"}}
    return json.dumps({"cells": cells, "metadata": kernel, "nbformat": 4, "nbformat_minor": 4}, indent=1)


def _cell(kind: str, source: str) -> dict[str, object]:
    cell: dict[str, object] = {"cell_type": kind, "metadata": {}, "source": source}
    return cell if kind == "markdown" else {**cell, "outputs": [], "execution_count": None}


def _flowing(text: str) -> str:
    return " ".join(text.replace("`", "").split())
