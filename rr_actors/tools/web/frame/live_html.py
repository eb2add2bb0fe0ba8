"""HTML of a page that changes in place, and tells of the buttons that are pressed in it."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from nicegui import ui
from nicegui.events import GenericEventArguments


class LiveHtml(ui.element, component="live_html.js"):
    """HTML whose elements stay while their words change, so a click or the focus is never lost.

    Args:
        on_act: called with `data-act` and `data-of` of the button that was pressed.
    """

    def __init__(self, on_act: Callable[[str, str], Any] | None = None) -> None:
        super().__init__()
        self._props["content"] = ""
        if on_act is not None:

            def acted(event: GenericEventArguments) -> Any:
                act, of = event.args
                return on_act(str(act), str(of))

            self.on("act", acted)

    def show(self, html: str) -> None:
        """Show other HTML. Whatever comes from a system is escaped before."""
        if html != self._props["content"]:
            self._props["content"] = html
