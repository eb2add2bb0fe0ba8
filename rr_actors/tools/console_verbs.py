"""The commands of `rr-actors` that reach a running system through its console, and `run`, which starts one."""

from __future__ import annotations

import json
import signal
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any, Literal, cast

import msgspec
import typer
from rich.console import Console
from rich.table import Table
from rich.text import Text

from rr_actors.actors.messaging.dead_letters import DeadLetters
from rr_actors.base.checks import needing
from rr_actors.base.errors import RrError, UsageError, shown
from rr_actors.supervision.event_history import Record
from rr_actors.system.console import console_messages as c
from rr_actors.system.console.console_client import ConsoleClient, find_console
from rr_actors.system.event_subscribers import kinds_for_all
from rr_actors.tools import graphs
from rr_actors.tools.cli_commands import StateOption, app
from rr_actors.tools.explanations import ago, event_line, explain, missed_line, record_line
from rr_actors.tools.process_usage import usage_of
from rr_actors.tools.tree_runner import run_tree

__all__ = ["app"]

_GRACE_S = 10.0  # for an answer, added to the time limit of the command
_SHOWN = 200  # rows of a list, unless more are asked for
_COMPLETED = 50
_NARROWEST = 80  # columns of a table: a narrower terminal wraps its lines, as cut cells would show only dots


# -- options that commands share -------------------------------------------------------------------------------------


def _completing(list_them: Callable[[ConsoleClient, str], list[str]]) -> Callable[[typer.Context, str], list[str]]:
    """Return a function that lists a shell's completions of an argument; none if no running system can be asked."""

    def complete(context: typer.Context, incomplete: str) -> list[str]:
        try:
            with _client(context.params.get("state")) as client:
                found = list_them(client, incomplete)
        except (RrError, OSError):
            return []
        return [text for text in found if text.startswith(incomplete)][:_COMPLETED]

    return complete


def _children(client: ConsoleClient, incomplete: str) -> list[str]:
    paths = [row.path for row in client.children().rows if row.depth]
    return paths if "/" in incomplete else [path.rpartition("/")[2] for path in paths]


def _servers(client: ConsoleClient, _incomplete: str) -> list[str]:
    return [server for row in client.registrars().rows for server in row.servers]


def _registrars(client: ConsoleClient, _incomplete: str) -> list[str]:
    return [row.name for row in client.registrars().rows]


def _resources(client: ConsoleClient, incomplete: str) -> list[str]:
    return [row.id for row in client.resources(match=incomplete, limit=_COMPLETED).rows]


def _queries(client: ConsoleClient, incomplete: str) -> list[str]:
    return [row.id for row in client.queries(match=incomplete, limit=_COMPLETED).rows]


def _targets(client: ConsoleClient, incomplete: str) -> list[str]:
    return list(dict.fromkeys(_resources(client, incomplete) + _queries(client, incomplete)))


JsonOption = Annotated[bool, typer.Option("--json", help="For programs instead of people.")]
DryRun = Annotated[bool, typer.Option("--dry-run", help="Change nothing; say what would be done.")]
Timeout = Annotated[
    float, typer.Option("--timeout", metavar="SECONDS", min=0.0, max=c.TIMEOUT_LIMIT_S, help="How long it may take.")
]
Limit = Annotated[int, typer.Option("--limit", min=1, help="Show at most so many.")]
ChildArgument = Annotated[
    str, typer.Argument(metavar="ID", help="A child's id, or its path.", autocompletion=_completing(_children))
]


def _client(state: Path | str | None, timeout_s: float = 60.0) -> ConsoleClient:
    return ConsoleClient(find_console(state), timeout_s=timeout_s + _GRACE_S)


def _carry_out(state: Path | None, command: c.Command, as_json: bool = False, timeout_s: float = 60.0) -> c.Done:
    """Send a command to the running system, and print what it has done."""
    with _client(state, timeout_s) as client:
        done = client.ask(command, c.Done)
    typer.echo(_json({"done": done.text, **done.facts}) if as_json else done.text)
    return done


def _json(value: object) -> str:
    return json.dumps(msgspec.to_builtins(value), ensure_ascii=False)


def _table(*columns: str, right: tuple[str, ...] = ()) -> Table:
    table = Table(box=None, pad_edge=False, header_style="bold")
    for column in columns:
        table.add_column(column, justify="right" if column in right else "left", no_wrap=True)
    return table


def _show(table: Table) -> None:
    """Print a table as wide as the terminal, but at least 80 columns; without a terminal, as wide as needed."""
    if sys.stdout.isatty():
        Console(width=max(Console().width, _NARROWEST)).print(table)
        return
    console = Console(width=10_000)
    with console.capture() as captured:
        console.print(table)
    typer.echo("\n".join(line.rstrip() for line in captured.get().splitlines()))


# -- looking ---------------------------------------------------------------------------------------------------------


@app.command(epilog="Example: rr-actors ps --json | jq '.[] | select(.state != \"running\")'")
def ps(state: StateOption = None, as_json: JsonOption = False) -> None:
    """Show the supervisor tree: each child's state, process, uptime, restarts, CPU (since its start) and memory."""
    with _client(state) as client:
        rows = client.children().rows
    usages = {row.pid: usage_of(row.pid) for row in rows if row.pid is not None}
    if as_json:
        typer.echo(_json([_child_facts(row, usages) for row in rows]))
        return
    table = _table(
        "child", "state", "pid", "up", "restarts", "cpu", "memory", "", right=("pid", "up", "restarts", "cpu")
    )
    seen: set[int] = set()
    for row in rows:
        usage = usages.get(row.pid) if row.pid is not None and row.pid not in seen else None
        seen.add(row.pid or 0)
        table.add_row(
            Text("  " * row.depth + row.path.rpartition("/")[2]),
            row.state,
            "" if row.pid is None else str(row.pid),
            "" if row.up_s is None else ago(row.up_s),
            str(row.restarts),
            "" if usage is None else f"{usage.cpu_percent:.1f} %",
            "" if usage is None else f"{usage.memory_bytes / 2**20:.0f} MiB",
            Text(row.error or row.strategy),
        )
    _show(table)


def _child_facts(row: c.ChildRow, usages: dict[int, Any]) -> dict[str, Any]:
    usage = None if row.pid is None else usages.get(row.pid)
    used = {"cpu_percent": None, "memory_bytes": None} if usage is None else msgspec.to_builtins(usage)
    return {name: getattr(row, name) for name in row.__struct_fields__} | used


@app.command(epilog="Example: rr-actors resources /dev/video --registrar cameras")
def resources(
    match: Annotated[
        str, typer.Argument(help="Only those with this text in their id, server, request or status.")
    ] = "",
    registrar: Annotated[str, typer.Option(help="Only this one's.", autocompletion=_completing(_registrars))] = "",
    limit: Limit = _SHOWN,
    state: StateOption = None,
    as_json: JsonOption = False,
) -> None:
    """List the resources of the running system, and who holds each."""
    with _client(state) as client:
        page = client.resources(registrar, match, limit)
    if as_json:
        typer.echo(_json(page.rows))
        return
    table = _table("resource", "server", "request", "state", "holders", "held by")
    for row in page.rows:
        held_by = ", ".join(dict.fromkeys(holder.origin for holder in row.holders))
        shown_state = row.state if row.phase == "loaded" else f"{row.phase} {row.message}".rstrip()
        table.add_row(row.id, row.server, Text(row.request), Text(shown_state), str(row.holder_count), Text(held_by))
    _show(table)
    if page.total > len(page.rows):
        typer.echo(f"{page.total - len(page.rows)} more: choose with MATCH, or raise --limit", err=True)
    for note in page.notes:
        typer.echo(f"not asked: {note}", err=True)


@app.command(epilog="Example: rr-actors events --follow --event exited --event restarted --json")
def events(
    follow: Annotated[bool, typer.Option("--follow", "-f", help="Go on with what happens, until Ctrl-C.")] = False,
    event: Annotated[list[str] | None, typer.Option(help="Only events of this kind; may be repeated.")] = None,
    about: Annotated[str, typer.Option(help="Only those with this text in a fact: a path, server, id ...")] = "",
    count: Annotated[int | None, typer.Option(min=1, help="End after so many.")] = None,
    state: StateOption = None,
    as_json: JsonOption = False,
) -> None:
    """Show the latest events of the tree; with --follow show new events, also those of resources."""
    kinds = event or []
    known = kinds_for_all()
    if unknown := [kind for kind in kinds if kind not in known]:
        raise UsageError(f"--event: expected one of {', '.join(known)}, got {shown(unknown[0])}")
    with _client(state) as client:
        if not follow:
            records = _history(client, "", c.PAGE_LIMIT)
            chosen = [one for one in records if (not kinds or one.event in kinds) and c.mentions(one.facts(), about)]
            for record in chosen[-(count or 20) :]:
                _say_record(record, as_json)
            return
        left = count
        for part in client.follow(c.Follow(kinds, about)):
            if isinstance(part, c.Missed):
                _say_missed(part, as_json)
                continue
            for one in part.events[:left]:
                _say_event(one, as_json)
            left = None if left is None else left - len(part.events)
            if left is not None and left <= 0:
                return
    typer.echo("the system has ended", err=True)


def _history(client: ConsoleClient, child: str, limit: int) -> list[Record]:
    found = client.ask(c.ListHistory(child, limit), c.Happenings)
    if found.left_out:
        typer.echo(f"{found.left_out} older records are not shown: they are too long for one answer", err=True)
    return found.records


def _say_event(event: c.Event, as_json: bool) -> None:
    if as_json:
        typer.echo(_json({"seq": event.seq, "at": event.at, "event": event.event, **event.facts}))
        return
    typer.echo(event_line(event))


def _say_missed(missed: c.Missed, as_json: bool) -> None:
    if as_json:
        typer.echo(
            _json({"missed": missed.count, "seq": missed.seq, "total": missed.tree.total, "tree": missed.tree.rows})
        )
    else:
        typer.echo(missed_line(missed))


def _say_record(record: Record, as_json: bool) -> None:
    if as_json:
        typer.echo(_json({"event": record.event, "at": record.at, **record.facts()}))
    else:
        typer.echo(record_line(record))


@app.command(epilog="Example: rr-actors history root/cameras")
def history(
    child: Annotated[str, typer.Argument(metavar="[ID]", autocompletion=_completing(_children))] = "",
    limit: Limit = 100,
    state: StateOption = None,
    as_json: JsonOption = False,
) -> None:
    """Show the starts and exits of a child and all below it, or of all children, with reasons."""
    with _client(state) as client:
        records = _history(client, child, min(limit, c.PAGE_LIMIT))
    for record in records:
        _say_record(record, as_json)
        if record.traceback and not as_json:
            typer.echo("".join(f"    {line}\n" for line in record.traceback.rstrip().splitlines()), nl=False)


@app.command("dead-letters", epilog="Example: rr-actors dead-letters --limit 5")
def dead_letters(limit: Limit = 20, state: StateOption = None, as_json: JsonOption = False) -> None:
    """Show how many messages could not be delivered, and the newest of them."""
    with _client(state) as client:
        letters = client.ask(c.ListDeadLetters(min(limit, c.PAGE_LIMIT)), c.Letters)
    if as_json:
        typer.echo(_json({"count": letters.count, "letters": letters.letters}))
    else:
        typer.echo(str(DeadLetters(letters.count, letters.letters)))


@app.command(epilog="Example: rr-actors top --state rr_state")
def top(state: StateOption = None) -> None:
    """Watch the tree, the registrars and the events live; kill, terminate, restart and unload with keys."""
    with needing("top", "top"):  # the other verbs work without it
        from rr_actors.tools.terminal.terminal_app import watch
    watch(state)


@app.command(epilog="Example: rr-actors web --port 8080")
def web(
    state: StateOption = None,
    port: Annotated[int, typer.Option(min=0, max=65535, help="0 for a free one.")] = 0,
    host: Annotated[str, typer.Option(help="The address to listen at; a browser needs the token, too.")] = "127.0.0.1",
    lab: Annotated[bool, typer.Option("--lab", help="Serve experiments to learn from, and no system.")] = False,
    child: Annotated[bool, typer.Option("--child", hidden=True)] = False,
) -> None:
    """Serve a live web page of a running system: its tree, its resources, the last minutes; print its address."""
    with needing("web", "web"):  # the other verbs work without it
        from rr_actors.tools.web.web_server import serve
    serve(state, lab=lab, host=host, port=port, is_child=child, say=typer.echo)


@app.command(epilog="Example: rr-actors why 01a2085d3f7c")
def why(
    id: Annotated[
        str,
        typer.Argument(help="The id of a query or resource, or its beginning.", autocompletion=_completing(_targets)),
    ],
    state: StateOption = None,
) -> None:
    """Say who holds a resource, for whom, since when, and what it waits for."""
    with _client(state) as client:
        for line in explain(client, id):
            typer.echo(line)


@app.command(epilog="Example: rr-actors graph --of dependencies --format svg > system.svg")
def graph(
    format: Annotated[
        Literal["mermaid", "dot", "svg", "png"],
        typer.Option("--format", help="dot is for Graphviz; png needs the program rsvg-convert."),
    ] = "mermaid",
    of: Annotated[Literal["tree", "dependencies", "both"], typer.Option("--of", help="What to draw.")] = "both",
    limit: Limit = _SHOWN,
    state: StateOption = None,
) -> None:
    """Draw the tree, and the resources with their holders: as SVG or PNG, or as text for Mermaid or Graphviz."""
    if format == "png" and sys.stdout.isatty():
        raise UsageError("--format png: expected a file, got a terminal: rr-actors graph --format png > graph.png")
    with _client(state) as client:
        rows = client.children().rows
        page = c.Resources(0, []) if of == "tree" else client.resources(limit=limit)
    draw = {"mermaid": graphs.mermaid, "dot": graphs.dot, "svg": graphs.svg, "png": graphs.svg}[format]
    drawn = draw(rows, page.rows, of)
    typer.echo(graphs.png(drawn) if format == "png" else drawn, nl=format != "png")
    if page.total > len(page.rows):
        typer.echo(f"{page.total - len(page.rows)} resources are left out: raise --limit", err=True)


# -- driving ---------------------------------------------------------------------------------------------------------


@app.command(epilog="Example: rr-actors load cameras/camera '\"/dev/video0\"' --hold")
def load(
    server: Annotated[str, typer.Argument(help="REGISTRAR/SERVER.", autocompletion=_completing(_servers))],
    request: Annotated[str, typer.Argument(metavar="REQUEST-AS-JSON", help="The request: '\"front\"', '{\"x\": 1}'.")],
    hold: Annotated[
        bool, typer.Option("--hold", help="Hold it, by the system's registrar `console`, until unload.")
    ] = False,
    holder: Annotated[
        str,
        typer.Option(
            "--as", metavar="NAME", help="Hold it in this registrar's name.", autocompletion=_completing(_registrars)
        ),
    ] = "",
    timeout_s: Timeout = 30.0,
    state: StateOption = None,
    as_json: JsonOption = False,
    dry_run: DryRun = False,
) -> None:
    """Load a resource and show its response; without --hold or --as it is released again at once."""
    keep = hold or bool(holder)
    command = c.Load(server, request, holder, keep, timeout_s, dry_run)
    done = _carry_out(state, command, as_json, timeout_s)
    if "response" in done.facts and not as_json:
        typer.echo(json.dumps(done.facts["response"], ensure_ascii=False))


@app.command(epilog="Example: rr-actors unload 01a2085d3f7c")
def unload(
    id: Annotated[
        str,
        typer.Argument(
            help="The id of a query, or its beginning; with --force a resource's.", autocompletion=_completing(_targets)
        ),
    ],
    force: Annotated[bool, typer.Option("--force", help="Take the resource away from all its holders.")] = False,
    timeout_s: Timeout = 30.0,
    state: StateOption = None,
    as_json: JsonOption = False,
    dry_run: DryRun = False,
) -> None:
    """Release a query of any holder; with --force take a resource away from all its holders, which hear FATAL."""
    _carry_out(state, c.Unload(id, force, timeout_s, dry_run), as_json, timeout_s)


@app.command(epilog="Example: rr-actors status cameras/01a2085d3f7c WARNING 'the lens is dirty'")
def status(
    target: Annotated[
        str,
        typer.Argument(
            metavar="SERVER/RESOURCE",
            help="The resource's id, or its beginning, after its server.",
            autocompletion=_completing(_resources),
        ),
    ],
    said: Annotated[str, typer.Argument(metavar="STATE", help="OK, UPDATE, WARNING, ERROR or FATAL.")],
    message: Annotated[str, typer.Argument(help="For people.")] = "",
    state: StateOption = None,
    as_json: JsonOption = False,
    dry_run: DryRun = False,
) -> None:
    """Send a resource's status in its owner's name to its holders, and to the resources that depend on it."""
    states = ("OK", "UPDATE", "WARNING", "ERROR", "FATAL")
    if said.upper() not in states:
        raise UsageError(f"STATE: expected {', '.join(states)}, got {shown(said)}")
    before, _, id = target.rpartition("/")
    registrar = before.partition("/")[0]
    _carry_out(state, c.SendStatus(id, cast("Any", said.upper()), message, registrar, dry_run), as_json)


@app.command(epilog="Example: rr-actors kill cameras --signal SIGSTOP")
def kill(
    child: ChildArgument,
    signal_name: Annotated[str, typer.Option("--signal", "-s", help="A signal's name or number.")] = "SIGKILL",
    state: StateOption = None,
    as_json: JsonOption = False,
    dry_run: DryRun = False,
) -> None:
    """Send a signal to a child's process; if the child ends, its supervisor handles that as any end."""
    _carry_out(state, c.Kill(child, _signal_number(signal_name), dry_run), as_json)


def _signal_number(text: str) -> int:
    name = text.upper() if text.upper().startswith("SIG") else f"SIG{text.upper()}"
    if text.isdecimal() and len(text) < 10 and 1 <= int(text) <= 64:
        return int(text)
    if name not in signal.Signals.__members__:
        raise UsageError(f"--signal: expected a signal's name or number (SIGTERM, 15), got {shown(text)}")
    return signal.Signals[name].value


@app.command(epilog="Example: rr-actors terminate root/inner/cameras")
def terminate(
    child: ChildArgument, state: StateOption = None, as_json: JsonOption = False, dry_run: DryRun = False
) -> None:
    """Stop a child in order. It stays stopped until restart; a temporary child is forgotten."""
    _carry_out(state, c.Terminate(child, dry_run), as_json)


@app.command(epilog="Example: rr-actors restart cameras")
def restart(
    child: ChildArgument, state: StateOption = None, as_json: JsonOption = False, dry_run: DryRun = False
) -> None:
    """Start a child again. If it runs, it is stopped in order first."""
    _carry_out(state, c.Restart(child, dry_run), as_json)


@app.command(epilog="Example: rr-actors start lidar.toml --under root/sensors")
def start(
    spec: Annotated[
        Path, typer.Argument(metavar="SPEC.toml", help="actor = 'module:class', id = ...; or a supervisor.")
    ],
    under: Annotated[
        str, typer.Option(help="The path of its supervisor. Default: the root.", autocompletion=_completing(_children))
    ] = "",
    state: StateOption = None,
    as_json: JsonOption = False,
    dry_run: DryRun = False,
) -> None:
    """Add a child to the running tree, and start it. Its class is imported by the running system, by its name."""
    try:
        text = spec.read_text()
    except (OSError, UnicodeDecodeError) as error:
        raise UsageError(f"{spec}: cannot be read: {getattr(error, 'strerror', None) or error}") from error
    _carry_out(state, c.StartChild(text, under, str(spec), dry_run), as_json)


@app.command(epilog="Example: rr-actors shutdown --state rr_state")
def shutdown(state: StateOption = None, as_json: JsonOption = False, dry_run: DryRun = False) -> None:
    """Stop the whole system in order, as its own stop() does. A program that waits for the system's end goes on."""
    _carry_out(state, c.ShutDown(dry_run), as_json)


@app.command(epilog="Example: rr-actors run robot.toml --state /var/lib/robot --log debug")
def run(
    tree: Annotated[Path, typer.Argument(metavar="TREE.toml", help="The tree, as Supervisor.from_toml reads it.")],
    state: Annotated[
        Path, typer.Option("--state", envvar="RR_STATE", metavar="DIR", help="Its state directory.")
    ] = Path("rr_state"),
    config: Annotated[Path | None, typer.Option(help="Its configuration, as SystemConfig.from_toml reads it.")] = None,
    name: Annotated[str, typer.Option(help="Its name, for logs.")] = "system",
    log: Annotated[Literal["debug", "info", "warning", "error"], typer.Option(help="What its log tells.")] = "info",
    as_json: Annotated[bool, typer.Option("--json", help="The log as one object of JSON a line.")] = False,
    watch: Annotated[bool, typer.Option("--watch", help="Restart a child whose module has changed.")] = False,
) -> None:
    """Run a system from files alone until SIGTERM or Ctrl-C, which end it in order; a second one kills what is left.

    Exit code 1 if the tree gave up by itself.
    """
    if not run_tree(tree, state, config, name, log_level=log, log_json=as_json, watch=watch):
        raise typer.Exit(1)
