"""Build the docs as a site with Sphinx: `make docs`. docs/decisions/0029-docs-site.md says why with Sphinx.

The pages are also read in the repository, so they are plain Markdown with links to files. README.md and others beside
docs become pages of the site. A link to a file that is no page, such as a test, becomes text with the file's path. The
heading of a public name, with the text below it (reference.py), becomes what Sphinx makes of its docstrings. A line
"::: FILE.md" becomes the text of that file.
"""

from __future__ import annotations

import enum
import importlib
import inspect
import re
import sys
from pathlib import Path
from typing import Any, is_typeddict

sys.path.insert(0, str(Path(__file__).parent))

from reference import SHOWN
from sphinx.application import Sphinx

from rr_actors import Declared

ROOT = Path(__file__).resolve().parents[2]
DOCS = ROOT / "docs"
LINK = re.compile(r"(?<!!)\[([^\]]*)\]\(([^)#\s]+)(?:#([^)\s]*))?\)")
FILE = re.compile(r"^::: (\S+\.md)$", re.MULTILINE)
PAGES = {
    "README.md": "index",
    "CHANGELOG.md": "changelog",
    "CONTRIBUTING.md": "contributing",
    "SECURITY.md": "security-policy",
}
"""The files beside docs that are pages of the site."""

project = "rr_actors"
html_title = "rr_actors"
copyright = "the authors of rr_actors"
extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon"]
root_doc = "index"
exclude_patterns = ["**.ipynb"]
html_theme = "furo"  # light and dark
html_show_sourcelink = html_copy_source = html_show_sphinx = False

myst_heading_anchors = 4
myst_links_external_new_tab = False

default_role = "code"
add_module_names = False
toc_object_entries_show_parents = "hide"
autodoc_member_order = "bysource"
autodoc_typehints_format = "short"
autodoc_class_signature = "mixed"
python_display_short_literal_types = True
autodoc_default_options = {"members": True}
napoleon_numpy_docstring = False
napoleon_use_ivar = True
napoleon_use_rtype = False
napoleon_use_param = False
maximum_signature_line_length = 100

suppress_warnings = ["ref.python"]  # a parameter that is called `type`, as attributes are

CONTENTS = "\n\n```{toctree}\n:hidden:\n:glob:\n*\n```\n"
"""What a README needs to be the head of the pages beside it."""


def text_of_file(match: re.Match[str]) -> str:
    """Return the text of a file beside docs, with links as the site has them."""
    text = (ROOT / match.group(1)).read_text().replace("](docs/", "](")
    for name, page in PAGES.items():
        text = text.replace(f"]({name})", f"]({page}.md)")
    return text


def described(match: re.Match[str]) -> str:
    """Return the directive for the docstrings of a name."""
    module, _, name = match.group(1).rpartition(".")
    value = getattr(importlib.import_module(module), name)
    if isinstance(value, type):
        kind, shown = "autoclass", any(base.__module__.startswith(("rr_actors", "pykka")) for base in value.__bases__)
        if issubclass(value, BaseException):
            kind, shown = "autoexception", True
        lines = [f".. {kind}:: {module}.{name}", *["   :show-inheritance:"] * shown]
        if is_typeddict(value) or issubclass(value, enum.Enum):
            lines.append("   :undoc-members:")
    elif inspect.isroutine(getattr(value, "__wrapped__", value)):  # it wraps a pytest fixture
        lines = [f".. autofunction:: {module}.{name}"]
    else:
        text = inspect.getdoc(value) if type(value).__module__.startswith("rr_actors") else ""
        lines = [f".. py:data:: {module}.{name}", "", f"   {text}"]
    return "\n".join(["```{eval-rst}", *lines, "```", ""])


def read(app: Sphinx, page: str, source: list[str]) -> None:
    """Change the text of a page, before it is parsed, to what the site needs."""
    here = (DOCS / page).parent

    def led(match: re.Match[str]) -> str:
        text, target, part = match.groups()
        path = (here / target).resolve()
        if "://" in target or path.is_relative_to(DOCS) or not path.is_relative_to(ROOT):
            return match.group()
        name = str(path.relative_to(ROOT))
        if name in PAGES:
            return f"[{text}]({'../' * page.count('/')}{PAGES[name]}.md)"
        return f'<span title="{name}{f": {part}" if part else ""}">{text}</span>'

    source[0] = LINK.sub(led, SHOWN.sub(described, FILE.sub(text_of_file, source[0]))) + (
        CONTENTS if page.endswith("/README") else ""
    )


def skip(app: Sphinx, what: str, name: str, value: Any, skipped: bool, options: Any) -> bool | None:
    """Leave out the callbacks of a ready-made manager: its class says what it serves."""
    return True if isinstance(value, Declared) else None


def setup(app: Sphinx) -> None:
    """Hear of each page that is read, and of each member of a class."""
    app.connect("source-read", read)
    app.connect("autodoc-skip-member", skip)
