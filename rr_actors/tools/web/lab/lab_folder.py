"""The folders of the lab: each Python file in one is an experiment. They are read as text, and never imported here.

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

Each lever is a parameter of main(). The run itself answers the question. docs/console.md
has more.
"""

from __future__ import annotations

import ast
import inspect
import keyword
import re
import sys
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple, TypeVar, get_args, get_type_hints

from rr_actors.base.errors import ConfigError, UsageError, did_you_mean
from rr_actors.base.folder import read_plain
from rr_actors.base.toml import parse_typed, raise_faults, wrong
from rr_actors.system.event_subscribers import ChildEvent
from rr_actors.tools.web.lab.lab_declarations import LabDeclaration, LabExperiment, Lever, Sign

_BLOCK = re.compile(r"^# /// lab\n((?:#(?: .*)?\n)*?)# ///[ \t]*$", re.MULTILINE)
_BEGIN = re.compile(r"^[ \t]*#[ \t]*///[ \t]*lab\b.*", re.MULTILINE)
_LOOK_FOR, _WHY = "Look for:", "Why:"
_Declaration = TypeVar("_Declaration", bound=LabDeclaration)
_EVENTS: tuple[str, ...] = get_args(get_type_hints(ChildEvent)["event"])
_TYPES: Mapping[str, tuple[type, ...]] = {"int": (int,), "float": (float, int), "str": (str,)}
"""The annotations of a parameter that say which values its lever may have."""


class Lab(NamedTuple):
    """What folders have.

    Attributes:
        experiments: in the order of the page, by their names.
        broken: what is wrong with a folder, or with a file that is no experiment.
    """

    experiments: Mapping[str, LabExperiment]
    broken: list[str]


def read_lab(folders: Iterable[Path]) -> Lab:
    """Read the experiments of all folders, one folder after another. What is broken is named, and the others are read.

    Two experiments of one name, or one title, would be mistaken for each other: the first one stays.
    """
    found: dict[str, LabExperiment] = {}
    broken: list[str] = []
    for folder in folders:
        try:
            here = list(_experiments(programs_in(folder), broken))
        except UsageError as error:
            broken.append(str(error))
            continue
        for one in sorted(here, key=lambda one: one.declared.place):
            other = next((it for it in found.values() if one.name == it.name or one.button == it.button), None)
            if other is None:
                found[one.name] = one
            else:
                what, got = ("name", one.name) if one.name == other.name else ("title", one.button)
                expected = f"a {what} that no other experiment has"
                broken.append(str(wrong(str(one.program), what, expected, got, said=f"{got!r}, as {other.program}")))
    return Lab(found, broken)


def programs_in(folder: Path) -> list[Path]:
    """Return the programs of a folder, in the order of their names: no tests, and no names that begin with "_" or ".".

    Raises:
        UsageError: there is no such folder, or it has no program.
    """
    expected = "expected a folder with experiments, as examples/lab of the repository"
    try:
        files = sorted(file for file in folder.iterdir() if file.suffix == ".py" and not _is_other(file.name))
    except OSError as error:
        raise UsageError(f"--lab: {folder}: {expected}, got: {error.strerror}") from error
    if not files:
        raise UsageError(f"--lab: {folder}: {expected}, got no *.py")
    return files


def _is_other(name: str) -> bool:
    return name.startswith(("_", ".", "test_")) or name == "conftest.py"


def _experiments(files: Sequence[Path], broken: list[str]) -> Iterator[LabExperiment]:
    for file in files:
        try:
            yield read_experiment(file)
        except ConfigError as error:
            broken.append(str(error))


def read_experiment(file: Path) -> LabExperiment:
    """Read one experiment.

    Raises:
        ConfigError: the file is no experiment; the text names it, and says all that is wrong.
    """
    name = str(file)
    if not file.stem.isidentifier() or keyword.iskeyword(file.stem) or file.stem in sys.stdlib_module_names:
        raise wrong(name, "", "a name that Python can import, and no module of Python has", file.name)
    text, tree = _parsed(file)
    main = next((node for node in tree.body if isinstance(node, ast.FunctionDef) and node.name == "main"), None)
    docstring = ast.get_docstring(tree, clean=False)
    if main is None or not main.args.args or docstring is None:
        missing = "a function main(state_dir, ...)" if docstring is not None else "a docstring"
        raise wrong(name, "", missing, None, said="none")
    declared = declared_in(text, f"{file}: lab", LabDeclaration)
    raise_faults([*_faults(declared, _parameters(main), f"{file}: lab")])
    title, _, rest = inspect.cleandoc(docstring).partition("\n")
    rest, _, why = rest.partition(_WHY)
    about, _, look_for = rest.partition(_LOOK_FOR)
    code = "".join(text.splitlines(keepends=True)[tree.body[0].end_lineno :])
    code = _BLOCK.sub("", code).strip() + "\n"
    return LabExperiment(file, title.rstrip("."), _flowing(about), _flowing(look_for), _flowing(why), code, declared)


def _parsed(file: Path) -> tuple[str, ast.Module]:
    try:
        text = read_plain(file).decode()
        return text, ast.parse(text)
    except OSError as error:
        said = error.strerror or str(error)
    except SyntaxError as error:
        said = f"{error.msg} (line {error.lineno})"
    except (ValueError, RecursionError) as error:
        said = str(error)
    raise ConfigError(f"{file}: expected a Python program, got: {said}", file=str(file))


def declared_in(text: str, name: str, kind: type[_Declaration]) -> _Declaration:
    """Return what the block of a program declares; nothing without a block. Errors have the lines of the file.

    Raises:
        ConfigError: the block has another form, an unknown key or a wrong value, or it is one of several.
    """
    begun, blocks = list(_BEGIN.finditer(text)), list(_BLOCK.finditer(text))
    if len(begun) > 1:
        raise wrong(name, "", "one block", None, said=f"another at line {_line(text, begun[1].start())}")
    if begun and not blocks:
        expected = 'lines from "# /// lab" to "# ///" that begin with "# "'
        raise wrong(name, "", expected, None, said=f"another form at line {_line(text, begun[0].start())}")
    if not blocks:
        return kind()
    above = "\n" * (_line(text, blocks[0].start(1)) - 1)
    return parse_typed((above + re.sub("^# ?", "", blocks[0][1], flags=re.MULTILINE)).encode(), name, kind)


def _line(text: str, at: int) -> int:
    return text.count("\n", 0, at) + 1


class _Parameter(NamedTuple):
    """A parameter of main(): the text of its annotation, and its default as source code; "" if there is none."""

    annotation: str
    default: str


def _parameters(main: ast.FunctionDef) -> dict[str, _Parameter]:
    """Return the parameters of main() after the first one, by their names."""
    arguments = main.args
    missing = [None] * (len(arguments.args) - len(arguments.defaults))
    pairs = zip(
        (*arguments.args, *arguments.kwonlyargs), (*missing, *arguments.defaults, *arguments.kw_defaults), strict=False
    )
    found = {one.arg: _Parameter(_source(one.annotation), _source(default)) for one, default in pairs}
    del found[arguments.args[0].arg]
    return found


def _source(node: ast.expr | None) -> str:
    return "" if node is None else ast.unparse(node)


def _faults(declared: LabDeclaration, parameters: Mapping[str, _Parameter], name: str) -> Iterator[ConfigError]:
    """Yield what is wrong in a declaration whose types are right."""
    names = [lever.name for lever in declared.levers]
    for index, lever in enumerate(declared.levers):
        yield from _faults_of_lever(lever, parameters, names[:index], name, f"levers[{index}]")
    for parameter, known in parameters.items():
        if not known.default and parameter not in names:
            yield wrong(name, "levers", f"a lever for {parameter}, a parameter without a default", None, said="none")
    if declared.answers and not declared.question:
        yield wrong(name, "question", "a text, as there are answers", None, said="none")
    if declared.question and not declared.answers:
        yield wrong(name, "answers", "a table, as there is a question", None, said="none")
    for answer, sign in declared.answers.items():
        yield from _faults_of_sign(sign, name, f"answers.{answer}")


def _faults_of_lever(
    lever: Lever, parameters: Mapping[str, _Parameter], before: Sequence[str], name: str, key: str
) -> Iterator[ConfigError]:
    if lever.name in before:
        yield wrong(name, f"{key}.name", "a name that no other lever has", lever.name)
    if (parameter := parameters.get(lever.name)) is None:
        listed = ", ".join(parameters) or "it has only the first"
        yield wrong(name, f"{key}.name", f"a parameter of main(): {listed}", lever.name)
        return
    texts = [str(choice) for choice in lever.choices]
    for place, choice in enumerate(lever.choices):
        if str(choice) in texts[:place]:
            yield wrong(name, f"{key}.choices[{place}]", "a value that no other choice has", choice)
        if not isinstance(choice, _TYPES.get(parameter.annotation, (object,))):
            yield wrong(name, f"{key}.choices[{place}]", f"`{parameter.annotation}`, as main() has it", choice)
    if _literal(parameter.default) not in (..., lever.choices[0]):
        yield wrong(name, f"{key}.choices[0]", f"the default of main(), {parameter.default}", lever.choices[0])


def _literal(source: str) -> object:
    """Return the value of source code, or ... if that takes more than to read it."""
    try:
        return ast.literal_eval(source)
    except (ValueError, TypeError, SyntaxError):
        return ...


def _faults_of_sign(sign: Sign, name: str, key: str) -> Iterator[ConfigError]:
    if sign.prints and (sign.event or sign.path):
        yield wrong(name, key, "either prints, or event and path", None, said="both")
    elif bool(sign.event) != bool(sign.path):
        missing = "path" if sign.event else "event"
        yield wrong(name, f"{key}.{missing}", "event and path together", None, said="none")
    elif sign.event and sign.event not in _EVENTS:
        said = f"{sign.event!r}{did_you_mean(sign.event, _EVENTS)}"
        yield wrong(name, f"{key}.event", f"one of {', '.join(_EVENTS)}", sign.event, said=said)


def _flowing(text: str) -> str:
    return " ".join(text.replace("`", "").split())
