"""The pages can be read by a student who is not a native speaker: short sentences, and no private words."""

from __future__ import annotations

import ast
import inspect
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

import rr_actors as rr
from support import REPOSITORY

LIMIT = 30  # words; 25 is the rule
PAGES = [*sorted(REPOSITORY.glob("*.md")), *sorted((REPOSITORY / "docs").rglob("*.md"))]
PRIVATE = re.compile(
    r"\b(whoever|let go|lets go|letting go|is told|are told|taken up|takes up|under way|in vain|for want of|as ever"
    r"|let it go|lets it go|letting it go|is loaded since|holds it since|waited for since|1 catalogs"
    r"|the error output|(?:stop|stops|stopped|end|ends|ended|end it|stops it|stopped it) in order(?= *[,.;:)]| and))\b",
    re.IGNORECASE,
)
"""Words that a reader stumbles on. "In order" is a sequence: a system stops cleanly."""

FENCED = re.compile(r"^```.*?^```", re.MULTILINE | re.DOTALL)
LINK = re.compile(r"\]\([^)]*\)")
ITEM = re.compile(r"^\s*(?:[-*]|\d+\.)\s", re.MULTILINE)
END = re.compile(r"(?<=[.!?:;])\s+")


def sentences(text: str) -> list[str]:
    """The sentences of a page, its code, tables and headings left out."""
    prose = LINK.sub("]", FENCED.sub("", text))
    lines = [line if not line.startswith(("|", "#", "<!--")) else "" for line in prose.splitlines()]
    blocks = re.split(r"\n\s*\n", "\n".join(lines))
    return [sentence for block in blocks for item in ITEM.split(block) for sentence in END.split(item.strip())]


def words(sentence: str) -> int:
    return sum(1 for word in sentence.split() if re.search(r"\w", word.replace("[test]", "")))


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_a_sentence_is_short(page: Path) -> None:
    text = page.read_text()
    assert [sentence for sentence in sentences(text) if words(sentence) > LIMIT] == []


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_a_page_uses_standard_words(page: Path) -> None:
    text = page.read_text()
    assert PRIVATE.findall(re.sub(r"`[^`]*`", "", FENCED.sub("", text))) == []


# -- the package itself: in an editor, in a log, in a traceback ----------------------------------------------------

MODULES = sorted((REPOSITORY / "rr_actors").rglob("*.py"))
DOCUMENTED = re.compile(r"(?<=[.!?:;])\s+|\n\s*\n")


def docstrings(names: list[str]) -> Iterator[tuple[str, str]]:
    """Those of these public names of the package, and of their public methods and properties."""
    for name in names:
        value = getattr(rr, name)
        if not str(getattr(value, "__module__", "")).startswith("rr_actors"):
            continue
        yield name, inspect.getdoc(value) or ""
        for method, found in vars(value).items() if isinstance(value, type) else ():
            if not method.startswith("_") and (callable(found) or isinstance(found, (property, classmethod))):
                yield f"{name}.{method}", inspect.getdoc(found) or ""


def test_public_docstrings_have_short_sentences_of_standard_words() -> None:
    found = dict(docstrings(rr.__all__))
    assert len(found) > 150
    assert [name for name, text in found.items() if PRIVATE.search(text)] == []
    long = {name: [part for part in DOCUMENTED.split(text) if words(part) > 25] for name, text in found.items()}
    assert {name: parts for name, parts in long.items() if parts} == {}


def texts(tree: ast.AST) -> Iterator[str]:
    """The strings of a module, without its docstrings and comments: errors, lines of the log, output."""
    for node in ast.walk(tree):
        if isinstance(node, (ast.Expr, ast.JoinedStr)) and not isinstance(getattr(node, "value", None), ast.JoinedStr):
            continue
        for child in ast.iter_child_nodes(node):
            if isinstance(child, ast.JoinedStr):
                yield "".join(str(part.value) if isinstance(part, ast.Constant) else "x" for part in child.values)
            elif isinstance(child, ast.Constant) and isinstance(child.value, str):
                yield child.value


def test_errors_and_lines_of_the_log_have_short_sentences_of_standard_words() -> None:
    wrong = [
        f"{module.relative_to(REPOSITORY)}: {text}"
        for module in MODULES
        for text in texts(ast.parse(module.read_text()))
        if PRIVATE.search(text) or any(words(part) > LIMIT for part in END.split(text))
    ]
    assert wrong == []


def test_comments_and_docstrings_of_the_package_use_standard_words() -> None:
    assert [str(module.relative_to(REPOSITORY)) for module in MODULES if PRIVATE.search(module.read_text())] == []


EXERCISES = sorted((REPOSITORY / "rr_actors" / "tools" / "learn" / "exercises").rglob("*.py.txt"))


@pytest.mark.parametrize("program", EXERCISES, ids=lambda program: f"{program.parent.name}-{program.name}")
def test_an_exercise_has_short_sentences_of_standard_words(program: Path) -> None:
    text = program.read_text()
    tree = ast.parse(text)
    hints = re.findall(r'^#     "(.*)",$', text, re.MULTILINE)
    said = [ast.get_docstring(tree) or "", *texts(tree), *hints]
    assert PRIVATE.findall(text) == []
    assert [part for one in said for part in DOCUMENTED.split(one) if words(part) > LIMIT] == []


NO_VERB = re.compile(
    r"(a|all|an|and|as|at|each|every|for|from|how|if|in|it|its|no|none|nobody|now|of|on|one|only|some|such|that|the"
    r"|their|them|there|these|they|this|those|to|two|under|what|when|where|whether|which|who|whose|with|without)\b",
    re.IGNORECASE,
)


def is_property(function: ast.FunctionDef | ast.AsyncFunctionDef) -> bool:
    return any("property" in ast.unparse(decorator) for decorator in function.decorator_list)


def test_docstrings_of_functions_begin_with_a_verb() -> None:
    """Those of properties name a thing; all others say what a call does."""
    wrong = [
        f"{module.relative_to(REPOSITORY)}:{function.lineno}: {text.splitlines()[0]}"
        for module in MODULES
        for function in ast.walk(ast.parse(module.read_text()))
        if isinstance(function, (ast.FunctionDef, ast.AsyncFunctionDef)) and not is_property(function)
        if (text := ast.get_docstring(function)) and NO_VERB.match(text)
    ]
    assert wrong == []


def test_a_long_sentence_would_be_found() -> None:
    text = "# A page\n\n- Short.\n- " + "word " * 31 + "end.\n\n| " + "cell " * 40 + "|\n"

    assert [words(sentence) for sentence in sentences(text) if words(sentence) > LIMIT] == [32]
