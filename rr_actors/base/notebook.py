"""How objects show themselves in a notebook: mime bundles, of which it shows the best form that it can, and tables."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence

MOST = 200
"""The most rows of a table; its last line counts the rows that are left out."""

_ESCAPES = str.maketrans({"&": "&amp;", "<": "&lt;", ">": "&gt;", '"': "&quot;", "'": "&#x27;"})


def bundle(text: str, *, html: str | None = None, svg: str | None = None, mermaid: str | None = None) -> dict[str, str]:
    """Return the result for `_repr_mimebundle_`: the text, and the other given forms."""
    forms = {"text/plain": text, "text/html": html, "image/svg+xml": svg, "text/vnd.mermaid": mermaid}
    return {name: form for name, form in forms.items() if form is not None}


def bundle_or_text(text: str, html: Callable[[], str]) -> dict[str, str]:
    """Return a bundle of the text and of what html() returns; if html() fails, the text and the error."""
    try:
        return bundle(text, html=html())
    except Exception as error:  # its process is gone, or a user's value raised: showing an object must not raise
        return bundle(f"{text} ({type(error).__name__}: {error})")


def escape(text: str) -> str:
    """Return the text escaped for HTML and XML, also within quotes.

    The standard library's html.escape does the same. Its module takes a hundredth of this package's import.
    """
    return text.translate(_ESCAPES)


def table(columns: Sequence[str], rows: Iterable[Sequence[object]], caption: str = "") -> str:
    """Return an HTML table of these rows, with everything escaped."""
    found = list(rows)
    parts = [f"<caption>{escape(caption)}</caption>" if caption else ""]
    if any(columns):
        parts.append(f"<tr>{''.join(f'<th>{escape(column)}</th>' for column in columns)}</tr>")
    parts += [f"<tr>{''.join(_cell(cell) for cell in row)}</tr>" for row in found[:MOST]]
    if len(found) > MOST:
        parts.append(f'<tr><td colspan="{len(columns)}">{len(found) - MOST} more are left out</td></tr>')
    return f"<table>{''.join(parts)}</table>"


def _cell(cell: object) -> str:
    return f'<td style="text-align:left">{escape("" if cell is None else str(cell))}</td>'
