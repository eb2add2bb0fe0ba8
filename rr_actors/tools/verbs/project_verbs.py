"""The commands of `rr-actors` that need neither a system nor a state directory."""

from __future__ import annotations

import importlib.util
import keyword
import re
from pathlib import Path
from typing import Annotated

import typer

from rr_actors.base import __version__
from rr_actors.base.checks import needing
from rr_actors.base.errors import UsageError, shown
from rr_actors.tools.cli_commands import say_lines

app = typer.Typer()


@app.command()
def version() -> None:
    """Print the version."""
    typer.echo(__version__)


_TOOLS = Path(__file__).parents[1]


@app.command(epilog="Example: rr-actors new robot")
def new(
    name: Annotated[
        str, typer.Argument(metavar="NAME", help="The project's: lower-case letters, digits and single hyphens.")
    ],
    experiment: Annotated[
        bool, typer.Option("--experiment", help="Make NAME.py instead: an experiment for rr-actors web --lab DIR.")
    ] = False,
) -> None:
    """Make a small project: two managers, an application, a test that kills one, a systemd unit, a Dockerfile."""
    module = name.replace("-", "_")
    if not re.fullmatch(r"[a-z][a-z0-9]*(-[a-z0-9]+)*", name):
        raise UsageError(f"NAME: expected lower-case letters, digits and single hyphens, got {shown(name)}")
    if keyword.iskeyword(module) or importlib.util.find_spec(module) is not None:
        raise UsageError(f"NAME: expected no word of Python and no name of an installed module, got {shown(name)}")
    if experiment:
        _copy(_TOOLS / "new_experiment", Path(), name, module)
        typer.echo(f"made {module}.py: change it, and see it with: rr-actors web --lab .")
        return
    Path(name).mkdir()
    _copy(_TOOLS / "new_project", Path(name), name, module)
    typer.echo(f"made {name}: see {name}/README.md, or: cd {name}; pip install -e '.[test]'; python -m pytest")


def _copy(templates: Path, place: Path, name: str, module: str) -> None:
    """Write each file of a folder of templates below a directory. None of them may be there."""
    for template in sorted(templates.rglob("*.txt")):
        path, text = (
            text.replace("_NAME_", name).replace("_MODULE_", module)
            for text in (str(template.relative_to(templates)), template.read_text())
        )
        target = place / path.removesuffix(".txt")
        target.parent.mkdir(exist_ok=True)
        with target.open("x") as file:
            file.write(text)


@app.command(epilog="Example: rr-actors import-temoto components.yaml pipes.yaml > pipes.toml")
def import_temoto(
    files: Annotated[
        list[Path], typer.Argument(metavar="FILE.yaml...", help="A components.yaml and a pipes.yaml, or several.")
    ],
) -> None:
    """Print the files of a temoto_component_manager as one TOML file for the manager Pipes."""
    with needing("import-temoto", "temoto"):
        from rr_actors.managers.pipes import temoto_files

    say_lines(temoto_files.import_temoto(files))
