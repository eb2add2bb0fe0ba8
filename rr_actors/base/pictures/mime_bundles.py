"""Mime bundles: what a notebook takes of an object, in several forms. It shows the best that it can."""

from __future__ import annotations

from collections.abc import Callable


def bundle(text: str, *, html: str | None = None, svg: str | None = None, mermaid: str | None = None) -> dict[str, str]:
    """Return what `_repr_mimebundle_` gives: the text, and the other forms that there are."""
    forms = {"text/plain": text, "text/html": html, "image/svg+xml": svg, "text/vnd.mermaid": mermaid}
    return {name: form for name, form in forms.items() if form is not None}


def bundle_or_text(text: str, html: Callable[[], str]) -> dict[str, str]:
    """As bundle(), of an object that has to ask: where that fails, the text has to do."""
    try:
        return bundle(text, html=html())
    except Exception as error:  # of its process, which is gone, or of users' values: to look at it must not raise
        return bundle(f"{text} ({type(error).__name__}: {error})")
