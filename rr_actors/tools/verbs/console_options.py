"""What the verbs that reach a running system share: options, their completion, and the way to its console."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Literal

import typer

from rr_actors.base.errors import RrError
from rr_actors.system.console import console_messages as c
from rr_actors.system.console.console_connection import ConsoleConnection, find_console
from rr_actors.system.console.console_view import Command
from rr_actors.tools.cli_commands import say, say_json

SHOWN = 200
"""Rows of a list, unless more are asked for."""
_GRACE_S = 10.0  # for an answer, added to the time limit of the command
_COMPLETED = 50


def completing(list_them: Callable[[ConsoleConnection, str], list[str]]) -> Callable[[typer.Context, str], list[str]]:
    """Return a function that lists a shell's completions of an argument; none if no running system can be asked."""

    def complete(context: typer.Context, incomplete: str) -> list[str]:
        try:
            with connection_of(context.params.get("state")) as connection:
                found = list_them(connection, incomplete)
        except (RrError, OSError):
            return []
        return [text for text in found if text.startswith(incomplete)][:_COMPLETED]

    return complete


def list_children(connection: ConsoleConnection, incomplete: str) -> list[str]:
    """Return the children: their paths if a path is being typed, else their ids."""
    rows = [row for row in connection.children().rows if row.depth]
    return [row.path if "/" in incomplete else row.id for row in rows]


def list_servers(connection: ConsoleConnection, _incomplete: str) -> list[str]:
    """Return all servers."""
    return [server for row in connection.registrars().rows for server in row.servers]


def list_registrars(connection: ConsoleConnection, _incomplete: str) -> list[str]:
    """Return all registrars."""
    return [row.name for row in connection.registrars().rows]


def list_resources(connection: ConsoleConnection, incomplete: str) -> list[str]:
    """Return the ids of the resources with this text in them."""
    return [row.id for row in connection.resources(match=incomplete, limit=_COMPLETED).rows]


def list_children_or_resources(connection: ConsoleConnection, incomplete: str) -> list[str]:
    """Return children, then resources."""
    return list_children(connection, incomplete) + list_resources(connection, incomplete)


def list_queries(connection: ConsoleConnection, incomplete: str) -> list[str]:
    """Return the ids of the queries with this text in them."""
    return [row.id for row in connection.queries(match=incomplete, limit=_COMPLETED).rows]


def list_targets(connection: ConsoleConnection, incomplete: str) -> list[str]:
    """Return the ids of resources, then of queries."""
    return list(dict.fromkeys(list_resources(connection, incomplete) + list_queries(connection, incomplete)))


def list_children_or_targets(connection: ConsoleConnection, incomplete: str) -> list[str]:
    """Return children, then the ids of resources and queries."""
    return list_children(connection, incomplete) + list_targets(connection, incomplete)


DryRun = Annotated[bool, typer.Option("--dry-run", help="Change nothing; say what would be done.")]
Timeout = Annotated[
    float, typer.Option("--timeout", metavar="SECONDS", min=0.0, max=c.TIMEOUT_LIMIT_S, help="How long it may take.")
]
Limit = Annotated[int, typer.Option("--limit", min=1, help="Show at most this many.")]
RowLimit = Annotated[
    int | None,
    typer.Option("--limit", min=1, show_default=False, help=f"Show at most this many; {SHOWN} in a table, else all."),
]
complete_child = completing(list_children)
ParentOption = Annotated[
    str, typer.Option("--under", help="The path of its supervisor. Default: the root.", autocompletion=complete_child)
]
ChildArgument = Annotated[
    str, typer.Argument(metavar="ID", help="A child's id, or its path.", autocompletion=complete_child)
]
Output = Annotated[
    Literal["json", "wide", "name"] | None,
    typer.Option(
        "--output", "-o", help="json: as --json; wide: shorten nothing; name: a name that commands take a line."
    ),
]


def connection_of(state: Path | str | None, timeout_s: float = 60.0) -> ConsoleConnection:
    """Return a connection to the running system of a state directory; None: to the only one."""
    return ConsoleConnection(find_console(state), timeout_s=timeout_s + _GRACE_S)


def carry_out(state: Path | None, command: Command[c.Done], as_json: bool = False, timeout_s: float = 60.0) -> c.Done:
    """Send a command to the running system, and print what it has done."""
    with connection_of(state, timeout_s) as connection:
        done = connection.ask(command)
    if as_json:
        say_json({"done": done.text, **done.facts})
    else:
        say(done.text)
    return done
