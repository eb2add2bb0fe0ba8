"""Mime bundles: an object in several forms for a notebook, which shows the best form that it can."""

from __future__ import annotations

from collections.abc import Callable


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
