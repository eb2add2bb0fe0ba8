"""The picture of a supervisor tree: an element of a page. Mouse and keys can choose its nodes."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

from nicegui import ui
from nicegui.events import GenericEventArguments

from rr_actors.system.console.console_messages import ChildRow

CSS = """
.rr-tree, .rr-tree ul { list-style: none; margin: 0; padding: 0; }
.rr-tree li { display: flex; align-items: flex-start; position: relative; padding: 2px 0; }
.rr-tree ul { margin-left: 14px; padding-left: 18px; border-left: 2px solid #b0bec5; }
.rr-tree ul > li::before { content: ""; position: absolute; left: -18px; top: 19px; width: 16px;
  border-top: 2px solid #b0bec5; }
.rr-tree ul::before { content: ""; position: absolute; margin-left: -33px; margin-top: 19px; width: 15px;
  border-top: 2px solid #b0bec5; }
.rr-node { display: grid; grid-template-columns: 1fr auto; gap: 0 8px; text-align: left; min-width: 132px;
  padding: 3px 9px; border: 2px solid #78909c; border-radius: 7px; background: #fff; color: #1c2529; font-size: 13px;
  line-height: 1.3; cursor: pointer; transition: background 0.3s, border-color 0.3s; }
.rr-node:focus-visible { outline: 3px solid #1565c0; outline-offset: 1px; }
.rr-id { font-weight: 600; white-space: nowrap; }
.rr-fact, .rr-window { grid-column: 1 / -1; font-size: 11px; color: #455a64; white-space: nowrap; }
.rr-count { font-weight: 600; color: #b23c00; animation: rr-pop 0.6s; }
.rr-running { border-color: #2e7d32; } .rr-running .rr-sign { color: #2e7d32; }
.rr-starting, .rr-restarting { border-color: #ef8f00; background: #fff3d6; border-style: dashed; }
.rr-stopped { border-color: #757575; background: #e6e6e6; }
.rr-unavailable { border-color: #c62828; background: #ffdede; border-style: double; border-width: 4px; }
.rr-chosen { box-shadow: 0 0 0 3px #90caf9; }
.rr-window i { display: inline-block; width: 9px; height: 9px; margin-right: 2px; border: 1px solid #78909c;
  border-radius: 2px; }
.rr-window i.full { background: #ef8f00; } .rr-window i.over { background: #c62828; }
.rr-window em { font-style: normal; }
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

        def picked(event: GenericEventArguments) -> Any:
            return on_pick(str(event.args))

        self.on("pick", picked)

    def show(self, children: Iterable[ChildRow], chosen: str = "") -> None:
        """Show these children, each supervisor before its own ones, and mark one as chosen."""
        rows = [_node(row) for row in children]
        if rows != self._props["rows"] or chosen != self._props["chosen"]:
            self._props["rows"], self._props["chosen"] = rows, chosen


def _node(row: ChildRow) -> dict[str, Any]:
    node: dict[str, Any] = {"path": row.path, "id": row.path.rpartition("/")[2], "type": row.type, "state": row.state}
    node |= {"pid": row.pid, "restarts": row.restarts, "error": row.error, "strategy": row.strategy}
    return node | {"most": row.max_restarts, "recent": row.recent_restarts}
