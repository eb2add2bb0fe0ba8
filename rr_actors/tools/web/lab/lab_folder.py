"""The folder of the lab: each Python file in it is an experiment. They are read as text, and never imported here.

An experiment has a docstring and `def main(state_dir, ...)`. The docstring's first line is the title, what follows is
what a reader knows before the run. "Look for:" says what can be seen, and "Why:" explains it: the page keeps both back
until its question is answered. A block of comments declares levers and a question, as TOML:

    # /// lab
    # question = "What becomes of the child?"
    # levers = [{name = "kills", label = "kills", choices = [1, 2]}]
    # [answers]
    # "it runs again" = {event = "restarted", path = "root/child"}
    # "it stays away" = {}
    # ///

Each lever is a parameter of main(). The run itself answers the question. `place` is the place on the page.
"""

from __future__ import annotations

import ast
import inspect
import re
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

from rr_actors.base.errors import ConfigError, UsageError
from rr_actors.base.toml import parse_typed, wrong
from rr_actors.tools.web.lab.lab_declarations import LabDeclaration, LabExperiment

_BLOCK = re.compile(r"^# /// lab\n((?:#(?: .*)?\n)*?)# ///\n", re.MULTILINE)
_LOOK_FOR, _WHY = "Look for:", "Why:"


class Lab(NamedTuple):
    """What a folder has.

    Attributes:
        experiments: in the order of the page, by their names.
        broken: what is wrong with a file that is no experiment, a sentence each.
    """

    experiments: Mapping[str, LabExperiment]
    broken: list[str]


def read_lab(folder: Path) -> Lab:
    """Read all experiments of a folder. Files whose names begin with "_" or "." are none.

    Raises:
        UsageError: there is no such folder, or it has no file of this kind.
    """
    try:
        files = sorted(path for path in folder.iterdir() if path.suffix == ".py" and path.name[0] not in "_.")
    except OSError as error:
        text = f"--lab: expected a folder with experiments, as examples/lab of the repository, got {folder}"
        raise UsageError(f"{text}: {error.strerror}") from error
    if not files:
        raise UsageError(f"--lab: {folder}: expected experiments, as in examples/lab of the repository, got no *.py")
    found: list[LabExperiment] = []
    broken: list[str] = []
    for file in files:
        try:
            found.append(read_experiment(file))
        except ConfigError as error:
            broken.append(str(error))
    found.sort(key=lambda one: one.declared.place)
    return Lab({one.name: one for one in found}, broken)


def read_experiment(file: Path) -> LabExperiment:
    """Read one experiment.

    Raises:
        ConfigError: the file is no experiment; the text names it, and says what is wrong.
    """
    name = str(file)
    if not file.stem.isidentifier():
        raise wrong(name, "", "a name that Python can import", file.name)
    try:
        text = file.read_text()
        tree = ast.parse(text)
    except (OSError, ValueError, SyntaxError) as error:
        line = f" (line {error.lineno})" if isinstance(error, SyntaxError) else ""
        raise ConfigError(f"{file}: expected a Python program, got: {error.args[0]}{line}", file=name) from error
    main = next((node for node in tree.body if isinstance(node, ast.FunctionDef) and node.name == "main"), None)
    docstring = ast.get_docstring(tree, clean=False)
    if main is None or not main.args.args or docstring is None:
        missing = "a function main(state_dir, ...)" if docstring is not None else "a docstring"
        raise wrong(name, "", missing, None, said="none")
    block = _BLOCK.search(text)
    written = "" if block is None else re.sub("^# ?", "", block[1], flags=re.MULTILINE)
    declared = parse_typed(written.encode(), f"{file}: lab", LabDeclaration)
    parameters = [argument.arg for argument in (*main.args.args[1:], *main.args.kwonlyargs)]
    for lever in declared.levers:
        if lever.name not in parameters:
            raise wrong(f"{file}: lab", "levers", f"a parameter of main(): {', '.join(parameters)}", lever.name)
    title, _, rest = inspect.cleandoc(docstring).partition("\n")
    rest, _, why = rest.partition(_WHY)
    about, _, look_for = rest.partition(_LOOK_FOR)
    code = "".join(text.splitlines(keepends=True)[tree.body[0].end_lineno :])
    code = _BLOCK.sub("", code).strip() + "\n"
    return LabExperiment(file, title.rstrip("."), _flowing(about), _flowing(look_for), _flowing(why), code, declared)


def _flowing(text: str) -> str:
    return " ".join(text.replace("`", "").split())
