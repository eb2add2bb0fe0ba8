"""Titles: what people read in the place of a request, in all lists, pictures and events."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, get_args

from rr_actors.base.errors import readable, shortened, text_of
from rr_actors.base.reporting.log import Log
from rr_actors.base.values.canonical import Codec
from rr_actors.registrar.engine.fields import by_fields, field_names
from rr_actors.registrar.engine.server import ServerSpec

logger = Log("rr_actors.server")

METHOD = "__rr_title__"
"""The method of a request's class that returns its title."""


def title_maker(spec: ServerSpec, origin: str) -> Callable[[bytes], str] | None:
    """Return a function that returns the title of a request, given as canonical bytes; None if there are no titles.

    The function may be called from any thread. It returns "" for a request that cannot be read, or whose title raises.
    """
    kinds = get_args(spec.request_type) or (spec.request_type,)
    if spec.title is None and not any(callable(getattr(kind, METHOD, None)) for kind in kinds):
        return None
    codec = Codec(spec.request_type, f"{origin}: request")
    make = spec.title
    if make is not None and (names := field_names(spec.request_type)) is not None:
        make = by_fields(make, "title", ("request",), names, f"server {spec.name!r}")

    def title(raw: bytes) -> str:
        try:
            request: Any = codec.decode(raw, origin)
            said: object = getattr(request, METHOD, str)() if make is None else make(request)
        except Exception as error:  # of the user's function, or the request is of an earlier version
            logger.debug("%s: a request has no title: %s", origin, text_of(error))
            return ""
        return readable(shortened(" ".join(str(said).split())))

    return title
