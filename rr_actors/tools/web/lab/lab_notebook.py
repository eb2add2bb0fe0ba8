"""An experiment as a notebook."""

from __future__ import annotations

import json
from collections.abc import Mapping

from rr_actors.tools.web.lab.lab_declarations import LabExperiment, Value


def notebook_of(experiment: LabExperiment, levers: Mapping[str, Value]) -> str:
    """Return a Jupyter notebook, as JSON, that runs an experiment with these levers."""
    question = [f"**{experiment.question.text}**"] if experiment.question else []
    asked = "\n\n".join((f"# {experiment.title}", experiment.about, *question))
    arguments = "".join(f", {name}={value!r}" for name, value in levers.items())
    cells = [_cell("markdown", asked), _cell("code", experiment.code), _cell("code", f'main("lab_state"{arguments})')]
    if experiment.why:
        cells.append(_cell("markdown", f"Why: {experiment.why}"))
    kernel = {"kernelspec": {"name": "python3", "display_name": "Python 3", "language": "python"}}
    return json.dumps({"cells": cells, "metadata": kernel, "nbformat": 4, "nbformat_minor": 4}, indent=1)


def _cell(kind: str, source: str) -> dict[str, object]:
    cell: dict[str, object] = {"cell_type": kind, "metadata": {}, "source": source}
    return cell if kind == "markdown" else {**cell, "outputs": [], "execution_count": None}
