"""The names that the palette of a page finds: its pages, children, servers, registrars and resources."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator

from nicegui import app

from rr_actors.base.errors import RrError
from rr_actors.system.console import console_questions as questions
from rr_actors.tools.terminal.terminal_rows import LOOK_S
from rr_actors.tools.web.frame.page_addresses import link_to
from rr_actors.tools.web.watch import Watch

_OF_EACH = 8


def add_names(watch: Watch, pages: dict[str, str]) -> None:
    """Add the address to the web server at which a palette asks for names.

    Args:
        pages: the names of the pages, with their addresses.
    """

    @app.get("/names")
    def _(match: str = "") -> list[dict[str, str]]:
        """Return what has this text in its name. As it is no coroutine, it runs in a thread."""
        return [{"kind": kind, "name": name, "href": href} for kind, name, href in _found(watch, pages, match[:200])]


def _found(watch: Watch, pages: dict[str, str], match: str) -> Iterator[tuple[str, str, str]]:
    def found(*names: str) -> list[str]:
        return [name for name in names if match.lower() in name.lower()][:_OF_EACH]

    now = watch.now
    yield from (("page", name, pages[name]) for name in found(*pages))
    yield from (("child", path, link_to("child", path)) for path in found(*(row.path for row in now.children)))
    yield from (
        ("registrar", name, link_to("registrar", name)) for name in found(*(row.name for row in now.registrars))
    )
    servers = [server for row in now.registrars for server in row.servers]
    yield from (("server", name, link_to("server", name)) for name in found(*servers))
    with contextlib.suppress(RrError):  # the page says why there is no answer
        for row in watch.link.ask(questions.ListResources(match, 0, _OF_EACH), LOOK_S).rows:
            yield "resource", row.name, link_to("resource", row.id)
