"""The commands of `rr-actors` that reach a running system through its console."""

from __future__ import annotations

import contextlib
import signal
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any, Literal, cast

import msgspec
import typer

from rr_actors.base.checks import needing
from rr_actors.base.errors import NotRunning, UnknownQuery, UsageError, did_you_mean, shown
from rr_actors.hosting.forwarded_logs import LogLine
from rr_actors.supervision.event_history import Record, left_records, records_of
from rr_actors.system.console import console_commands as commands
from rr_actors.system.console import console_messages as c
from rr_actors.system.console import console_questions as questions
from rr_actors.system.console.console_client import ConsoleClient
from rr_actors.system.recording.event_texts import ago
from rr_actors.tools import graphs
from rr_actors.tools.cli_commands import JsonOption, StateOption, say, say_json, say_lines, say_picture
from rr_actors.tools.explanations import explain, explain_actor
from rr_actors.tools.process_usage import facts_of
from rr_actors.tools.terminal.child_logs import LogText, log_of, new_lines, records_of_child
from rr_actors.tools.terminal.event_lines import EventFilter, EventLine, EventLines, event_line, event_of, missed_line
from rr_actors.tools.terminal.waiting import CHILD_STATES, GONE, RESOURCE_STATES, child_of, wait_for
from rr_actors.tools.verbs.console_options import (
    SHOWN,
    ChildArgument,
    DryRun,
    Limit,
    ParentOption,
    Timeout,
    carry_out,
    client_of,
    completing,
    list_children,
    list_children_or_resources,
    list_children_or_targets,
    list_registrars,
    list_resources,
    list_servers,
    list_targets,
)

app = typer.Typer()

_UNLOAD_S = 60.0  # for the unload callbacks, after a grace
_LATEST = 10  # records of a child that its status shows
_PART = "its beginning or end, or a resource's name"
_TICK_S = 0.1  # while nothing happens, lines that are settled are printed so often


# -- looking ---------------------------------------------------------------------------------------------------------


@app.command(epilog="Example: rr-actors events --follow --event exited --event restarted --json")
def events(
    follow: Annotated[bool, typer.Option("--follow", "-f", help="Go on with what happens, until Ctrl-C.")] = False,
    event: Annotated[list[str] | None, typer.Option(help="Only events of this kind; may be repeated.")] = None,
    about: Annotated[str, typer.Option(help="Only those with this text in their kind, subject or words.")] = "",
    child: Annotated[
        str, typer.Option(help="Only of this child and all below it.", autocompletion=completing(list_children))
    ] = "",
    server: Annotated[
        str, typer.Option(help="Only of this server or registrar.", autocompletion=completing(list_servers))
    ] = "",
    count: Annotated[int | None, typer.Option(min=1, help="End after so many.")] = None,
    state: StateOption = None,
    as_json: JsonOption = False,
) -> None:
    """Show the latest events of the tree; with --follow show new events, also those of resources.

    A status that spreads over many resources is one line, with the number of those that it has reached. Events that say
    the same are one line with their number. With --json each event is a line.
    """
    wanted = EventFilter.of(event or [], child, server, about)
    if not follow:
        happened = [event_of(record) for record in _history(state, "", c.PAGE_LIMIT)]
        if as_json:
            chosen = [one for one in happened if wanted.accepts(EventLine.of(one))]
            _say_facts(chosen[-(count or 20) :])
            return
        known = EventLines()
        for one in happened:
            known.take(one)
        for line in known.lines(wanted)[-(count or 20) :]:
            say(str(line))
        return
    with client_of(state) as client:
        left = sys.maxsize if count is None else count
        for lines in _following(client, wanted, as_json):
            for line in lines[:left]:
                say_json(line) if as_json else say(str(line))
            left -= len(lines)
            if left <= 0:
                return
    say("the system has ended", err=True)


def _following(client: ConsoleClient, wanted: EventFilter, as_json: bool) -> Iterator[list[Any]]:
    """Yield what happens from now on: facts, or lines to which nothing more will be added."""
    known = EventLines()
    for part in client.follow(c.Follow(sorted(wanted.kinds)), _TICK_S):
        if isinstance(part, c.Missed):
            _say_missed(part, as_json)
        elif as_json:
            yield [_facts(one) for one in part.events if wanted.accepts(EventLine.of(one))]
        else:
            for one in part.events:
                known.take(one)
            yield list(filter(wanted.accepts, known.take_settled()))
    yield list(filter(wanted.accepts, known.take_settled(all_of_them=True)))


def _facts(event: c.Event) -> dict[str, Any]:
    seq = {"seq": event.seq} if event.seq else {}
    return {**seq, "event": event.event, "at": event.at, **event.facts}


def _say_facts(events: list[c.Event]) -> None:
    for event in events:
        say_json(_facts(event))


def _history(state: Path | None, child: str, limit: int) -> list[Record]:
    """Return the records of a running system, or those that it has left in its state directory."""
    try:
        with client_of(state) as client:
            found = client.ask(questions.ListHistory(child, limit))
    except NotRunning:
        records = left_records(state) if state is not None else []
        if not records:
            raise
        records = records_of(records, child)[-limit:]
        say(f"no system runs in {state}: this is what it has left", err=True)
        return records
    if found.left_out:
        say(f"{found.left_out} older records are not shown: they are too long for one answer", err=True)
    return found.records


def _say_missed(missed: c.Missed, as_json: bool) -> None:
    if as_json:
        say_json({"missed": missed.count, "seq": missed.seq, "total": missed.tree.total, "tree": missed.tree.rows})
    else:
        say(missed_line(missed))


@app.command(epilog="Example: rr-actors history root/cameras")
def history(
    child: Annotated[str, typer.Argument(metavar="[ID]", autocompletion=completing(list_children))] = "",
    limit: Limit = 100,
    state: StateOption = None,
    as_json: JsonOption = False,
) -> None:
    """Show the starts and exits of a child and all below it, or of all children, with reasons."""
    records = _history(state, child, min(limit, c.PAGE_LIMIT))
    if as_json:
        _say_facts([event_of(record) for record in records])
        return
    for record in records:
        say(event_line(event_of(record)))
        if record.traceback:
            say_lines(record.traceback.rstrip(), "    ")


@app.command(epilog="Example: rr-actors logs cameras --previous --lines 20")
def logs(
    child: ChildArgument,
    lines: Annotated[int, typer.Option("--lines", "-n", min=1, help="The newest so many.")] = c.PAGE_LIMIT,
    previous: Annotated[
        bool, typer.Option("--previous", "-p", help="Only those of the process before the one that runs.")
    ] = False,
    follow: Annotated[bool, typer.Option("--follow", "-f", help="Go on with new lines, until Ctrl-C.")] = False,
    state: StateOption = None,
    as_json: JsonOption = False,
) -> None:
    """Show the last log lines of a child, also of the processes that it had before.

    The system keeps 500 lines of each child in memory, and at most 256 KiB of text.
    """
    if follow and previous:
        raise UsageError("--previous: expected no --follow with it, as a process that has ended logs no more")
    with client_of(state) as client:
        log = log_of(client, child, lines, previous=previous)
        text = LogText(log.path, [] if as_json else records_of_child(client, log.path))
        _say_log(log.path, log.lines, text, as_json)
        if not log.lines:
            whose = f"{log.path}, of the process before" if previous else log.path
            say(f"no log lines of {whose}{f': {log.note}' if log.note else ''}", err=True)
        if not follow:
            if not as_json:
                say_lines("\n".join(text.end()))
            return
        with contextlib.suppress(NotRunning):
            for new in new_lines(client, log.path, log.lines[-1].seq if log.lines else 0):
                _say_log(log.path, new, text, as_json)
    say("the system has ended", err=True)


def _say_log(path: str, lines: list[LogLine], text: LogText, as_json: bool) -> None:
    if as_json:
        for line in lines:
            say_json({"path": path, **msgspec.structs.asdict(line)})
    else:
        for one in text.of(lines):
            say(one)


@app.command(epilog="Example: rr-actors stack cameras --timeout 10")
def stack(
    child: ChildArgument, timeout_s: Timeout = 5.0, state: StateOption = None, as_json: JsonOption = False
) -> None:
    """Show where each thread of a child's process is now, also if the child is stuck."""
    with client_of(state, timeout_s) as client:
        found = client.ask(questions.ListStacks(child, timeout_s))
    if as_json:
        say_json({"path": found.path, **msgspec.to_builtins(found.stacks)})
        return
    left_out = f", {found.stacks.left_out} of them left out" if found.stacks.left_out else ""
    count = len(found.stacks.threads) + found.stacks.left_out
    say(f"{found.path}: process {found.stacks.pid}, {count} threads{left_out}")
    for one in found.stacks.threads:
        say(f"{one.thread}:")
        for frame in one.frames:
            place, *source = frame.splitlines()
            say(f"    {place}")
            say_lines("\n".join(source), "        ")


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
    prefix: Annotated[str, typer.Option(help="The path at which a proxy serves the page; {port} is its port.")] = "",
    host_name: Annotated[list[str] | None, typer.Option(help="A host at which a proxy serves the page.")] = None,
    lab: Annotated[
        Path | None,
        typer.Option(
            "--lab", metavar="DIR", help="A folder with experiments to serve in place of a system: examples/lab, say."
        ),
    ] = None,
    child: Annotated[bool, typer.Option("--child", hidden=True)] = False,
) -> None:
    """Serve a live web page of a running system: its tree, its resources, the last minutes; print its address."""
    with needing("web", "web"):  # the other verbs work without it
        from rr_actors.tools.web.web_server import serve
    names = host_name or ()
    serve(state, lab=lab, host=host, port=port, prefix=prefix, names=names, is_child=child, say=say)


@app.command(epilog="Example: rr-actors why 01a2085d3f7c")
def why(
    id: Annotated[
        str,
        typer.Argument(
            help="The id of a query or resource, its beginning or end, or a resource's name; or an actor's id or path.",
            autocompletion=completing(list_children_or_targets),
        ),
    ],
    state: StateOption = None,
) -> None:
    """Say who holds a resource, for whom, since when, and what it waits for; or whom an actor waits for.

    An actor that asks waits for the one that it has asked. If these wait for each other, the ring is named.
    """
    with client_of(state) as client:
        for line in explain_actor(lambda one: client.ask(questions.LookAtMailbox(one)).mailbox, id) or explain(
            client, id
        ):
            say(line)


@app.command(epilog="Example: rr-actors graph --of dependencies --format svg > system.svg")
def graph(
    what: Annotated[
        Literal["check", "show", "run", "change"] | None,
        typer.Argument(help="Without it the system is drawn. With it, FILE.json is a graph of actions."),
    ] = None,
    file: Annotated[Path | None, typer.Argument(metavar="[FILE.json]")] = None,
    id: Annotated[str, typer.Argument(metavar="[ID]", help="Of `change`: the resource of a graph that runs.")] = "",
    format: Annotated[
        Literal["mermaid", "dot", "svg", "png"],
        typer.Option("--format", help="dot is for Graphviz; png needs the program rsvg-convert."),
    ] = "mermaid",
    of: Annotated[Literal["tree", "dependencies", "both"], typer.Option("--of", help="What to draw.")] = "both",
    limit: Limit = SHOWN,
    inputs: Annotated[str, typer.Option(metavar="JSON", help="Of `run`: what the first actions are given.")] = "{}",
    start: Annotated[str, typer.Option("--from", metavar="ACTION", help="Of `change`: what runs then.")] = "",
    timeout_s: Timeout = 3600.0,
    state: StateOption = None,
) -> None:
    """Draw the tree, and the resources with their holders: as SVG or PNG, or as text for Mermaid or Graphviz.

    With `check`, `show` or `run` and FILE.json: check a graph of actions, draw it, or have the child `actions` run it.
    With `change`, FILE.json and ID: have a graph that runs go on as the one in the file.
    """
    if format == "png" and sys.stdout.isatty():
        raise UsageError("--format png: expected a file, got a terminal: rr-actors graph --format png > graph.png")
    if what is not None:
        if file is None:
            raise UsageError(f"graph {what}: expected a file with a graph of actions, got none")
        from rr_actors.tools.terminal import action_graphs  # the managers, which the other verbs do without

        if what == "check":
            action_graphs.check(file)
        elif what == "show":
            action_graphs.show(file, format)
        elif what == "change":
            action_graphs.change(file, id, state, start)
        else:
            action_graphs.run(file, state, inputs, timeout_s)
        return
    with client_of(state) as client:
        rows = client.children().rows
        page = c.Resources(0, []) if of == "tree" else client.resources(limit=limit)
    draw = {"mermaid": graphs.mermaid, "dot": graphs.dot, "svg": graphs.svg, "png": graphs.svg}[format]
    say_picture(draw(rows, page.rows, of), format)
    if page.total > len(page.rows):
        say(f"{page.total - len(page.rows)} resources are left out: raise --limit", err=True)


@app.command(epilog="Example: rr-actors wait 'cameras/camera \"/dev/video0\"' --for OK --timeout 10")
def wait(
    target: Annotated[
        str,
        typer.Argument(
            help="A child's id or path; or a resource's name, or its id, or the beginning or end of that.",
            autocompletion=completing(list_children_or_resources),
        ),
    ],
    wanted: Annotated[
        str,
        typer.Option(
            "--for",
            metavar="STATE",
            help=f"Of a child: {', '.join(CHILD_STATES)}; of a resource: {', '.join(RESOURCE_STATES)}; or {GONE}. "
            "Default: that the child runs, or the resource is loaded.",
        ),
    ] = "",
    timeout_s: Timeout = 30.0,
    state: StateOption = None,
    as_json: JsonOption = False,
) -> None:
    """Wait until a child or a resource is in a state; before the system runs, for that, too; exit code 1 if in vain."""
    began = time.monotonic()
    done, seen = wait_for(lambda: client_of(state), target, wanted, timeout_s)
    waited_s = round(time.monotonic() - began, 1)
    if as_json:
        say_json({"target": target, "state": seen, "waited_s": waited_s, "done": done})
    else:
        say(f"{target}: {seen} after {waited_s:g} s", err=not done)
    if not done:
        raise typer.Exit(1)


# -- driving ---------------------------------------------------------------------------------------------------------


@app.command(epilog="Example: rr-actors load cameras/camera '\"/dev/video0\"' --hold")
def load(
    server: Annotated[str, typer.Argument(help="REGISTRAR/SERVER.", autocompletion=completing(list_servers))],
    request: Annotated[str, typer.Argument(metavar="REQUEST-AS-JSON", help="The request: '\"front\"', '{\"x\": 1}'.")],
    hold: Annotated[
        bool, typer.Option("--hold", help="Hold it, by the system's registrar `console`, until unload.")
    ] = False,
    holder: Annotated[
        str,
        typer.Option(
            "--as", metavar="NAME", help="Hold it in this registrar's name.", autocompletion=completing(list_registrars)
        ),
    ] = "",
    priority: Annotated[str, typer.Option(help="From -1000 to 1000, or `standby`.")] = "0",
    timeout_s: Timeout = 30.0,
    state: StateOption = None,
    as_json: JsonOption = False,
    dry_run: DryRun = False,
) -> None:
    """Load a resource and show its response; without --hold or --as it is released again at once."""
    keep = hold or bool(holder)
    urgency = commands.priority_from("--priority", priority)
    command = commands.Load(server, request, holder, keep, timeout_s, dry_run, urgency)
    done = carry_out(state, command, as_json, timeout_s)
    if "response" in done.facts and not as_json:
        say_json(done.facts["response"])


@app.command(
    epilog="Example: rr-actors priority 01a2085d3f7c standby",
    context_settings={"ignore_unknown_options": True},  # a negative number is no option
)
def priority(
    id: Annotated[
        str, typer.Argument(help="The id of a query, its beginning or end.", autocompletion=completing(list_targets))
    ],
    value: Annotated[str, typer.Argument(metavar="PRIORITY", help="From -1000 to 1000, or `standby`.")],
    state: StateOption = None,
    as_json: JsonOption = False,
    dry_run: DryRun = False,
) -> None:
    """Give a query of any holder a priority; what its resource depends on follows."""
    carry_out(state, commands.GivePriority(id, commands.priority_from("PRIORITY", value), dry_run), as_json)


@app.command(epilog="Example: rr-actors unload 01a2085d3f7c")
def unload(
    id: Annotated[
        str,
        typer.Argument(
            help="The id of a query, its beginning or end, or a resource's name; with --force also a resource's id, or "
            "a server that is not registered.",
            autocompletion=completing(list_targets),
        ),
    ],
    force: Annotated[bool, typer.Option("--force", help="Take the resource away from all its holders.")] = False,
    timeout_s: Timeout = 30.0,
    state: StateOption = None,
    as_json: JsonOption = False,
    dry_run: DryRun = False,
) -> None:
    """Release a query of any holder; with --force take a resource away from all its holders, which hear FATAL."""
    carry_out(state, commands.Unload(id, force, timeout_s, dry_run), as_json, timeout_s)


@app.command(epilog="Example: rr-actors revoke 'cameras/camera \"/dev/video0\"' 'low battery' --grace 10")
def revoke(
    id: Annotated[str, typer.Argument(help=f"The resource's id, {_PART}.", autocompletion=completing(list_resources))],
    why: Annotated[str, typer.Argument(help="The reason, which its holders hear.")],
    grace_s: Annotated[
        float,
        typer.Option(
            "--grace", metavar="SECONDS", min=0.0, max=c.TIMEOUT_LIMIT_S, help="After them it is unloaded by force."
        ),
    ] = 5.0,
    state: StateOption = None,
    as_json: JsonOption = False,
    dry_run: DryRun = False,
) -> None:
    """Take a resource away from its holders in its owner's name: what depends on it ends first, or replaces it."""
    carry_out(state, commands.Revoke(id, why, grace_s, dry_run), as_json, grace_s + _UNLOAD_S)


@app.command(epilog="Example: rr-actors status cameras/01a2085d3f7c WARNING 'the lens is dirty'")
def status(
    target: Annotated[
        str,
        typer.Argument(
            metavar="CHILD|SERVER/RESOURCE",
            help="A child's id or path; or a resource's id, its beginning or end, after its server; or its name.",
            autocompletion=completing(list_children_or_resources),
        ),
    ],
    said: Annotated[str, typer.Argument(metavar="[STATE]", help="OK, UPDATE, WARNING, ERROR or FATAL.")] = "",
    message: Annotated[str, typer.Argument(help="For people.")] = "",
    state: StateOption = None,
    as_json: JsonOption = False,
    dry_run: DryRun = False,
) -> None:
    """Show how a child or a resource is; with STATE, send a resource's status to its holders in its owner's name."""
    if not said:
        _show_status(state, target, as_json)
        return
    states = ("OK", "UPDATE", "WARNING", "ERROR", "FATAL")
    if said.upper() not in states:
        raise UsageError(f"STATE: expected {', '.join(states)}, got {shown(said)}")
    before, _, id = target.rpartition("/") if " " not in target else ("", "", target)
    registrar = before.partition("/")[0]
    carry_out(state, commands.SendStatus(id, cast("Any", said.upper()), message, registrar, dry_run), as_json)


def _show_status(state: Path | None, target: str, as_json: bool) -> None:
    """Show a child with its latest history, or explain a resource; exit code 1 if a child does not run."""
    with client_of(state) as client:
        if (row := child_of(client, target)) is None:
            try:
                lines = explain(client, target.rpartition("/")[2] if " " not in target else target)
            except UnknownQuery as error:
                hint = did_you_mean(target, list_children(client, target))
                raise UnknownQuery(f"{error}{hint}", query_id=target) from error
            say_json({"text": lines}) if as_json else say_lines("\n".join(lines))
            return
        served = [one for one in client.registrars().rows if one.name == row.id]
        records = client.ask(questions.ListHistory(row.path, _LATEST)).records
    facts = facts_of(row)
    if as_json:
        say_json(facts | {"registrars": served, "history": [_facts(event_of(record)) for record in records]})
    else:
        say_lines("\n".join(_child_lines(row, facts, served)))
        say_lines("\n".join(event_line(event_of(record)) for record in records), "    ")
    if row.state != "running":
        raise typer.Exit(1)


def _child_lines(row: c.ChildRow, facts: dict[str, Any], served: list[c.RegistrarRow]) -> Iterator[str]:
    yield f"{row.path}: {row.state}{f', {row.error}' if row.error else ''}"
    if row.pid is not None:
        up = "" if row.up_s is None else f", up for {ago(row.up_s)}"
        yield f"    process {row.pid}{up}, {row.restarts} restart{'' if row.restarts == 1 else 's'}"
    if facts["memory_bytes"] is not None:
        yield f"    {facts['cpu_percent']:.1f} % of a core, {facts['memory_bytes'] / 2**20:.0f} MiB"
    for text in filter(None, (row.strategy, row.note)):
        yield f"    {text}"
    for one in served:
        counts = ", ".join(f"{count} {name}" for name, count in one.counts.items() if count)
        yield f"    registrar {one.name}: {one.status}, serves {', '.join(one.servers) or 'nothing'}"
        if counts:
            yield f"        {counts}"


@app.command(epilog="Example: rr-actors kill cameras --signal SIGSTOP")
def kill(
    child: ChildArgument,
    signal_name: Annotated[str, typer.Option("--signal", "-s", help="A signal's name or number.")] = "SIGKILL",
    state: StateOption = None,
    as_json: JsonOption = False,
    dry_run: DryRun = False,
) -> None:
    """Send a signal to a child's process; if the child ends, its supervisor handles that as any end."""
    carry_out(state, commands.Kill(child, _signal_number(signal_name), dry_run), as_json)


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
    carry_out(state, commands.Terminate(child, dry_run), as_json)


@app.command(epilog="Example: rr-actors restart cameras")
def restart(
    child: ChildArgument, state: StateOption = None, as_json: JsonOption = False, dry_run: DryRun = False
) -> None:
    """Start a child again. If it runs, it is stopped in order first."""
    carry_out(state, commands.Restart(child, dry_run), as_json)


@app.command(epilog="Example: rr-actors start lidar.toml --under root/sensors")
def start(
    spec: Annotated[
        str,
        typer.Argument(
            metavar="SPEC.toml",
            help="actor = 'module:class', id = ...; or a supervisor. With --id: a JSON list of arguments.",
        ),
    ],
    under: ParentOption = "",
    id: Annotated[str, typer.Option(help="The id of a child of a dynamic supervisor, which has the class.")] = "",
    state: StateOption = None,
    as_json: JsonOption = False,
    dry_run: DryRun = False,
) -> None:
    """Add a child to the running tree, and start it. Its class is imported by the running system, by its name."""
    try:
        text = spec if id else Path(spec).read_text()
    except (OSError, UnicodeDecodeError) as error:
        raise UsageError(f"{spec}: cannot be read: {getattr(error, 'strerror', None) or error}") from error
    carry_out(state, commands.StartChild(text, under, "" if id else spec, dry_run, id), as_json)


@app.command(epilog="Example: rr-actors shutdown --state rr_state")
def shutdown(
    wait: Annotated[bool, typer.Option("--wait", help="End when all children have stopped.")] = False,
    state: StateOption = None,
    as_json: JsonOption = False,
    dry_run: DryRun = False,
) -> None:
    """Stop the whole system in order, as its own stop() does. A program that waits for the system's end goes on."""
    if not wait or dry_run:
        carry_out(state, commands.ShutDown(dry_run), as_json)
        return
    with client_of(state) as client:
        happens = client.follow(c.Follow())
        carry_out(state, commands.ShutDown(), as_json)
        for _ in happens:  # until the system's console ends, after its children
            pass
