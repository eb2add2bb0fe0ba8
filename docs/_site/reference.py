"""Write the docstrings of public names into the pages of docs/reference, so that they can be read without the site.

A page has a heading for each name. What follows it, between "```text" and "```", is written here: its signature and
docstrings. The site leaves both out, and shows the name in its own way (conf.py). `make names` runs this. A test runs
it too, and compares the pages (tests/system/test_public_names.py).
"""

from __future__ import annotations

import enum
import importlib
import inspect
import re
import textwrap
from collections.abc import Iterator
from pathlib import Path
from typing import Any, is_typeddict

from names import REFERENCE, own_names

from rr_actors import Declared

SHOWN = re.compile(r"^### `(rr_actors(?:_pytest)?\.\S+)`\n(?:\n```text\n.*?^```\n)?\n*", re.MULTILINE | re.DOTALL)
WIDTH = 100  # characters of a signature; a longer one has a line for each parameter


def text_of(annotation: Any) -> str:
    """Return an annotation as source code has it."""
    if isinstance(annotation, str):
        return annotation
    return inspect.formatannotation(annotation).replace("rr_actors.", "").replace("typing.", "")


def parameter_of(parameter: inspect.Parameter) -> str:
    """Return one parameter as source code has it."""
    stars = {parameter.VAR_POSITIONAL: "*", parameter.VAR_KEYWORD: "**"}.get(parameter.kind, "")
    text = f"{stars}{parameter.name}"
    if parameter.annotation is not parameter.empty:
        text += f": {text_of(parameter.annotation)}"
    if parameter.default is parameter.empty:
        return text
    default = repr(parameter.default)
    default = "..." if " at 0x" in default or "<" in default else default
    return f"{text} = {default}" if ":" in text else f"{text}={default}"


def signature_of(name: str, value: Any) -> str:
    """Return a name with its parameters; the name alone if they cannot be read."""
    try:
        signature = inspect.signature(value)
    except (TypeError, ValueError):
        return name
    parameters = [it for it in signature.parameters.values() if it.name not in ("self", "cls")]
    listed = list[str]()
    before = None
    for each in parameters:
        if before is inspect.Parameter.POSITIONAL_ONLY and each.kind is not before:
            listed.append("/")
        if (
            each.kind is inspect.Parameter.KEYWORD_ONLY
            and "*" not in "".join(listed)[:1]
            and not any(one.startswith("*") for one in listed)
        ):
            listed.append("*")
        listed.append(parameter_of(each))
        before = each.kind
    if before is inspect.Parameter.POSITIONAL_ONLY:
        listed.append("/")
    returned = signature.return_annotation
    end = "" if returned is signature.empty or isinstance(value, type) else f" -> {text_of(returned)}"
    line = f"{name}({', '.join(listed)}){end}"
    if len(line) <= WIDTH:
        return line
    return "\n".join([f"{name}(", *(f"    {one}," for one in listed), f"){end}"])


def members_of(cls: type) -> Iterator[tuple[str, Any]]:
    """Yield the public methods and properties of a class that its page shows, in the order of the source."""
    wanted = set(own_names(cls))
    for base in reversed(cls.__mro__):
        for name in list(vars(base)):
            if name in wanted:
                wanted.discard(name)
                yield name, inspect.getattr_static(cls, name)


def lines_of_class(name: str, cls: type) -> Iterator[str]:
    """Yield a class as text: its bases, how it is made, its docstring, its members."""
    bases = [base.__name__ for base in cls.__bases__ if base.__module__.startswith(("rr_actors", "pykka"))]
    head = f"class {name}({', '.join(bases)})" if bases else f"class {name}"
    is_plain = is_typeddict(cls) or issubclass(cls, (enum.Enum, BaseException))
    yield head
    if not is_plain and (made := signature_of(name, cls)) != f"{name}()" and "*args" not in made:
        yield made
    yield ""
    yield inspect.getdoc(cls) or ""
    if issubclass(cls, enum.Enum):
        yield "\n" + ", ".join(cls.__members__)
        return
    for member, value in members_of(cls):
        if isinstance(value, Declared):
            continue  # the docstring of the class says what it serves
        function = value.__func__ if isinstance(value, (classmethod, staticmethod)) else value
        if isinstance(function, property):
            shown = member
        elif callable(function):
            shown = signature_of(member, function)
        else:
            continue
        text = inspect.getdoc(function) or inspect.getdoc(getattr(cls, member)) or ""
        yield f"\n{shown}\n{textwrap.indent(text, '    ')}"


def described(full: str) -> str:
    """Return a public name as text: its signature, its docstring, and those of its members."""
    module, _, name = full.rpartition(".")
    value = getattr(importlib.import_module(module), name)
    if isinstance(value, type):
        return "\n".join(lines_of_class(name, value))
    if inspect.isroutine(inspect.unwrap(value)):
        return f"{signature_of(name, value)}\n\n{inspect.getdoc(value) or ''}"
    return f"{name}\n\n{inspect.getdoc(value) if type(value).__module__.startswith('rr_actors') else ''}".rstrip()


def made(page: Path) -> str:
    """Return the text of a page of the reference, with its names described anew."""

    def shown(match: re.Match[str]) -> str:
        text = "\n".join(line.rstrip() for line in described(match.group(1)).splitlines())
        return f"### `{match.group(1)}`\n\n```text\n{text}\n```\n\n"

    return SHOWN.sub(shown, page.read_text()).rstrip() + "\n"


if __name__ == "__main__":
    for each in sorted(REFERENCE.glob("*.md")):
        each.write_text(made(each))
