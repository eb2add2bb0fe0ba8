"""Write docs/names.md: each public name with the first sentence of its docstring, and the names of its class.

`make names` runs this. A test runs it too, and compares the page (tests/system/test_public_names.py).
"""

from __future__ import annotations

import inspect
import re
from pathlib import Path
from typing import is_typeddict

import rr_actors as rr

PAGE = Path(__file__).resolve().parents[1] / "names.md"
REFERENCE = PAGE.parent / "reference"
HEAD = """\
# Public names

For readers who want to know what later versions keep. `rr.__all__` and `dir(rr)`
list what `import rr_actors as rr` offers. The table has each name with its
first sentence, and the public names of each class: completion shows them. The
link leads to the page that has its signature and an example.

A class also has the names of its base classes, such as `pykka.Actor`,
`pykka.ActorRef` and `RrError`. Names that begin with an underscore may change.

`make names` writes this page from the code.

| name | what it is | its names |
|---|---|---|
"""


def foreign_names(cls: type) -> set[str]:
    """Return the names that a class has from classes of other packages: their manuals have them."""
    bases = [base for base in cls.__mro__ if not base.__module__.startswith("rr_actors")]
    return {name for base in bases for name in (*dir(base), *vars(base).get("__annotations__", ()))}


def own_names(cls: type) -> list[str]:
    """Return the public names of a class, those that its public base classes have left out."""
    if is_typeddict(cls):
        return []  # its keys: docs/supervision.md has them
    names = {*dir(cls), *_annotated(cls), *_attributes(cls)} - foreign_names(cls)
    for base in cls.__mro__[1:]:
        if getattr(rr, base.__name__, None) is base:
            names -= set(own_names(base))
    return sorted(name for name in names if not name.startswith("_"))


def _annotated(cls: type) -> set[str]:
    bases = [base for base in cls.__mro__ if base.__module__.startswith("rr_actors")]
    return {name for base in bases for name in vars(base).get("__annotations__", ())}


def _attributes(cls: type) -> list[str]:
    """Return what the docstring of a class says that its objects have: the arguments are kept, too."""
    sections = re.findall(
        r"^(?:Args|Attributes):\n(.*?)(?:\n\n|\Z)", inspect.getdoc(cls) or "", re.MULTILINE | re.DOTALL
    )
    named = re.findall(r"^    (\w+(?:, \w+)*):", "\n".join(sections), re.MULTILINE)
    return [name for names in named for name in names.split(", ")]


def _first_sentence(name: str) -> str:
    value = getattr(rr, name)
    text = inspect.getdoc(value) if str(getattr(value, "__module__", "")).startswith("rr_actors") else None
    found = re.match(r"(?:\([^)]*\)|[.:](?=\w)|[^.:])+", text or "Pykka's error: the actor has ended.")
    assert found, f"{name} has no docstring"
    return " ".join(found.group().split()) + "."


def pages() -> dict[str, str]:
    """Return the page of the reference that has each name."""
    found: dict[str, str] = {}
    for page in sorted(REFERENCE.glob("*.md")):
        for name in re.findall(r"^### `rr_actors\.(\w+)`$", page.read_text(), re.MULTILINE):
            assert name not in found, f"{name} is in {found[name]} and in {page.name}"
            found[name] = page.name
    return found


def made() -> str:
    """Return the text of the page."""
    where = pages()
    rows: list[str] = []
    for name in sorted(rr.__all__, key=str.lower):
        value = getattr(rr, name)
        names = own_names(value) if isinstance(value, type) else []
        listed = ", ".join(f"`{each}`" for each in names)
        rows.append(f"| [`{name}`](reference/{where[name]}) | {_first_sentence(name)} | {listed} |\n")
    return HEAD + "".join(rows)


if __name__ == "__main__":
    PAGE.write_text(made())
