"""What can be done to the thing of a row, and when: the keys of `top` and the buttons of the pages follow from this."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import msgspec

from rr_actors.base.names import short_id
from rr_actors.system.console import console_commands as commands
from rr_actors.system.console import console_messages as c
from rr_actors.system.console.console_view import Command
from rr_actors.tools.tables.table import Row

Obstacle = Callable[[Row], str]


@dataclass(frozen=True)
class RowCommand:
    """A command for the thing of a row.

    Attributes:
        name: on its button.
        key: its key in `top`; of several with one key, that acts which can be done.
        phrase: what it does to the thing {}, in words.
        obstacle: returns why it cannot be done to a row; "" if it can.
        command: returns what is sent to the system.
        warning: what it does that cannot be taken back: then it is done after a question. "" for no question.
        label: beside its key at the bottom of `top`; "" for none.
        harms: whether it takes something away.
    """

    name: str
    key: str
    phrase: str
    obstacle: Obstacle
    command: Callable[[Row], Command[c.Done]]
    warning: str = ""
    label: str = ""
    harms: bool = True

    def said_of(self, row: Row) -> str:
        """Return what it does to the thing of a row: "kill root/shop"."""
        thing = row.child.path if row.child else row.name or short_id(row.resource or row.query)
        return self.phrase.format(thing)

    def dry_run(self, row: Row) -> Command[c.Done]:
        """Return the command that changes nothing, and says what would happen."""
        return msgspec.structs.replace(self.command(row), dry_run=True)


def _child(obstacle: Callable[[c.ChildRow], str]) -> Obstacle:
    """Return why something cannot be done to the child of a row, if it is a child that can be driven."""

    def said(row: Row) -> str:
        if row.child is None:
            return "choose a child in the tree"
        if "/" not in row.child.path:
            return f"{row.child.path}: it is the root supervisor; to end it, shut the system down"
        why = obstacle(row.child)
        return f"{row.child.path}: {why}" if why else ""

    return said


def _path(row: Row) -> str:
    return row.child.path if row.child else ""


def _stopped(child: c.ChildRow) -> str:
    return "it is stopped" if child.state == "stopped" else ""


def _without_process(child: c.ChildRow) -> str:
    return f"it is {child.state}, and has no process to be killed" if child.pid is None else ""


def _no_resource(row: Row) -> str:
    return "" if row.resource and row.key == row.resource else "choose a resource on the right (Tab goes there)"


def no_query(row: Row) -> str:
    """Return why a row has no query that could be released; "" if it has one."""
    if not (row.query or row.resource):
        return "choose a resource or a holder on the right (Tab goes there)"
    return "" if row.query else "it has no holder, or several: Enter shows them; U takes it away from all"


CHILD_COMMANDS = (
    RowCommand(
        "kill -9", "K", "kill {}", _child(_without_process), lambda row: commands.Kill(_path(row)),
        "It cannot finish what it does.", "kill",
    ),
    RowCommand(
        "stop", "t", "stop {}", _child(_stopped), lambda row: commands.Terminate(_path(row)),
        "It stays stopped until it is started.", "stop",
    ),
    RowCommand(
        "restart", "r", "restart {}", _child(_stopped), lambda row: commands.Restart(_path(row)),
        label="restart", harms=False,
    ),
    RowCommand(
        "start", "r", "start {}", _child(lambda child: "" if _stopped(child) else f"it is {child.state}"),
        lambda row: commands.Restart(_path(row)), harms=False,
    ),
)  # fmt: skip
QUERY_COMMANDS = (
    RowCommand("unload", "u", "unload query {}", no_query, lambda row: commands.Unload(row.query), label="unload"),
)
RESOURCE_COMMANDS = (
    RowCommand(
        "unload from all", "U", "unload {} from all", _no_resource,
        lambda row: commands.Unload(row.resource, force=True), "Its holders lose it at once, and hear FATAL.", "all",
    ),
    RowCommand(
        "revoke", "R", "revoke {}", _no_resource, lambda row: commands.Revoke(row.resource, "revoked by hand"),
        "Its holders have 5 s to release it.",
    ),
    RowCommand(
        "reload", "l", "reload {}", _no_resource, lambda row: commands.Reload(row.resource),
        "It does not work until it is loaded again.",
    ),
)  # fmt: skip
ROW_COMMANDS = (*CHILD_COMMANDS, *QUERY_COMMANDS, *RESOURCE_COMMANDS)
KEYS = {one.key: one.label for one in ROW_COMMANDS if one.name != "start"}
"""The keys of `top`, and their labels."""
