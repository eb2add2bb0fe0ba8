"""The sheets: what is shown at once, a table or several. A list that is named here has its verb, its key and its page.

Only its words stand here, so that the help of `rr-actors` imports no console. Its tables are imported when it is shown.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from types import ModuleType


@dataclass(frozen=True)
class Sheet:
    """A table, or several that stand one below the other.

    Attributes:
        name: its name in `top`, and in the address of its page.
        verb, says, example: its verb, with the verb's help and an example.
        match: the help of the verb's argument MATCH.
        key: the key of `top` that shows it.
        module: imports and returns the module of its tables, which tables_of() takes.
        options: the options that the verb has beside those of all lists.
        in_verb: how many of the tables the verb shows.
        title: its title in `top` while no column sorts it; "": its name.
        note: what a reader of its page should know; "": it has no page, or one of another kind.
    """

    name: str
    verb: str
    says: str
    example: str
    match: str
    key: str
    module: Callable[[], ModuleType]
    options: tuple[str, ...] = ("registrar",)
    in_verb: int = 2
    title: str = ""
    note: str = ""


def _tree() -> ModuleType:
    from rr_actors.tools.tables import child_tables

    return child_tables


def _resources() -> ModuleType:
    from rr_actors.tools.tables import resource_table

    return resource_table


def _streams() -> ModuleType:
    from rr_actors.tools.tables import stream_table

    return stream_table


def _loads() -> ModuleType:
    from rr_actors.tools.tables import load_tables

    return load_tables


def _plans() -> ModuleType:
    from rr_actors.tools.tables import plan_table

    return plan_table


SHEETS = (
    Sheet(
        "children", "ps",
        "Show the supervisor tree: each child's state, process, uptime, restarts, CPU (since its start) and memory.",
        "ps --json | jq '.[] | select(.state != \"running\")'", "Only children with this text in their paths.",
        "1", _tree, options=("parts",), in_verb=1, title="tree",
    ),
    Sheet(
        "resources", "resources", "List the resources of the running system, and who holds each.",
        "resources /dev/video --registrar cameras",
        "Only those with this text in their id, server, request or status.",
        "2", _resources, options=("registrar", "status", "holder"),
    ),
    Sheet(
        "streams", "streams",
        "List the open streams: frames and bytes a second, the age of the newest frame, readers, and what they missed.",
        "streams cameras/camera", "Only those with this text in their name or resource.", "4", _streams,
        note="Frames and bytes a second, the age of the newest frame, and who reads it.",
    ),
    Sheet(
        "loads", "loads",
        """Show which loads wait now, and how often and how long loads of each server had to wait.

        A load is shared if it joins a resource that is loaded, or is being loaded. It has waited if it was not answered
        at once. The times are those of load callbacks: the mean and the longest of all, p95 of the newest 500.
        Their own times are without those in which they waited for the loads of their parts.
        """,
        "loads cameras --sort-by p95 --watch", "Only those with this text in their id, server or request.", "5", _loads,
        title="loads: those that wait, and each server's",
        note="Since each server was registered. Shared: joined a resource that was loaded, or was being loaded. "
        "Waited: not answered at once. Mean, p95 (of the newest 500) and longest are the times of load callbacks. "
        "Own mean and own p95 are without the time in which they waited for their parts.",
    ),
    Sheet(
        "plans", "plans",
        """Show what managers plan: the tables that they declare, such as pools, what is kept, choices and graphs.

        A manager of your own declares one with @rr.table. Each row says what its manager knows now.
        """,
        "plans pools --watch", "Only those with this text in the row, the table's name or the manager's path.",
        "6", _plans, options=(),
        note="The tables that managers declare: pools, what is kept, choices, graphs of actions, and your own.",
    ),
)  # fmt: skip
