"""The picture of a supervisor tree: an element of a page. Mouse and keys can choose its nodes."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

from nicegui import ui
from nicegui.events import GenericEventArguments

from rr_actors.system.console.console_messages import ChildRow
from rr_actors.tools.web.watch import Moment

CSS = """
.rr-tree, .rr-tree ul { list-style: none; margin: 0; padding: 0; }
.rr-tree li { display: flex; align-items: flex-start; position: relative; padding: 2px 0; }
.rr-tree ul { margin-left: 14px; padding-left: 18px; border-left: 2px solid var(--rr-edge); }
.rr-tree ul > li::before { content: ""; position: absolute; left: -18px; top: 19px; width: 16px;
  border-top: 2px solid var(--rr-edge); }
.rr-tree ul::before { content: ""; position: absolute; margin-left: -33px; margin-top: 19px; width: 15px;
  border-top: 2px solid var(--rr-edge); }
.rr-node { display: grid; grid-template-columns: 1fr auto; gap: 0 8px; text-align: left; min-width: 132px;
  padding: 3px 9px; border: 1px solid var(--rr-outline); border-radius: 8px; background: var(--rr-paper);
  color: var(--rr-text); font-size: 13px;
  line-height: 1.3; cursor: pointer; transition: background 0.3s, border-color 0.3s; }
.rr-node:focus-visible { outline: 3px solid var(--rr-focus); outline-offset: 1px; }
.rr-id { font-weight: 600; white-space: nowrap; }
.rr-fact, .rr-window { grid-column: 1 / -1; font-size: 11px; color: var(--rr-fact); white-space: nowrap; }
.rr-count { font-weight: 600; color: var(--rr-count); animation: rr-pop 0.6s; }
.rr-running { border-color: var(--rr-edge); } .rr-running .rr-sign { color: var(--rr-good); }
.rr-starting, .rr-restarting { border-color: var(--rr-warm); background: var(--rr-warm-paper); border-style: dashed; }
.rr-stopped { border-color: var(--rr-still); background: var(--rr-still-paper); }
.rr-unavailable { border-color: var(--rr-bad); background: var(--rr-bad-paper); border-width: 2px; }
.rr-unknown { border-color: var(--rr-still); background: var(--rr-unknown-paper); border-style: dotted; }
.rr-unknown .rr-sign { color: var(--rr-fact); }
.rr-chosen { box-shadow: 0 0 0 3px var(--rr-halo); }
.rr-window i { display: inline-block; width: 9px; height: 9px; margin-right: 2px; border: 1px solid var(--rr-outline);
  border-radius: 2px; }
.rr-window i.full { background: var(--rr-warm); } .rr-window i.over { background: var(--rr-bad); }
.rr-window em { font-style: normal; }
@container (max-width: 480px) {
  .rr-tree li { flex-direction: column; }
  .rr-tree ul { margin-top: 4px; } .rr-tree ul::before { display: none; }
}
@keyframes rr-pop { from { transform: scale(1.8); } to { transform: scale(1); } }
"""


class TreePicture(ui.element, component="tree_picture.js"):
    """A supervisor tree as a live picture.

    Args:
        on_pick: called with the path of the node that the page's reader has chosen.
    """

    def __init__(self, on_pick: Callable[[str], Any]) -> None:
        super().__init__()
        self._props["rows"] = []
        self._props["chosen"] = ""
        self._props["unknown"] = ""

        def picked(event: GenericEventArguments) -> Any:
            return on_pick(str(event.args))

        self.on("pick", picked)

    def show(self, moment: Moment, chosen: str = "") -> None:
        """Show a moment's children, each supervisor before its own ones, and mark one as chosen.

        While the system does not answer, nobody knows the children's states: the picture says so.
        """
        rows = [_node(row) for row in moment.children]
        since = time.strftime("%H:%M:%S", time.localtime(moment.at))
        self._props["unknown"] = f"unknown since {since}" if moment.problem else ""
        if rows != self._props["rows"] or chosen != self._props["chosen"]:
            self._props["rows"], self._props["chosen"] = rows, chosen


def _node(row: ChildRow) -> dict[str, Any]:
    node: dict[str, Any] = {"path": row.path, "id": row.id, "type": row.type, "state": row.state}
    node |= {"pid": row.pid, "restarts": row.restarts, "error": row.error, "strategy": row.strategy}
    return node | {"most": row.max_restarts, "recent": row.recent_restarts, "note": row.note}
