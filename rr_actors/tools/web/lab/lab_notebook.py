"""An experiment as a notebook."""

from __future__ import annotations

import json
from collections.abc import Mapping

from rr_actors.tools.web.lab.lab_declarations import LabExperiment, Value

_TIMELINE = """\
from rr_actors.system.recording.timelines import read_timeline

read_timeline(f"{state_dir}/history.jsonl")"""


def notebook_of(experiment: LabExperiment, levers: Mapping[str, Value]) -> str:
    """Return a Jupyter notebook, as JSON, that runs an experiment with these levers, and draws what has happened.

    It leaves out what to look for, which speaks of the lab's page.
    """
    asked = [f"# {experiment.title}", experiment.about]
    if experiment.question:
        asked += [f"**{experiment.question.text}**", "\n".join(f"- {it}" for it in experiment.question.answers)]
    arguments = "".join(f", {name}={value!r}" for name, value in levers.items())
    cells = [
        _cell("markdown", "\n\n".join(asked)),
        _cell("code", experiment.code),
        _cell("code", f"import tempfile\n\nstate_dir = tempfile.mkdtemp()\nmain(state_dir{arguments})"),
        _cell("markdown", "What has happened: a line for each child, a bar for each of its lives."),
        _cell("code", _TIMELINE),
    ]
    if experiment.why:
        cells.append(_cell("markdown", f"Why: {experiment.why}"))
    kernel = {"kernelspec": {"name": "python3", "display_name": "Python 3", "language": "python"}}
    return json.dumps({"cells": cells, "metadata": kernel, "nbformat": 4, "nbformat_minor": 4}, indent=1)


def _cell(kind: str, source: str) -> dict[str, object]:
    cell: dict[str, object] = {"cell_type": kind, "metadata": {}, "source": source}
    return cell if kind == "markdown" else {**cell, "outputs": [], "execution_count": None}
