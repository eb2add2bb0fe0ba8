"""The commands of `rr-actors` that reach a running system through its console."""

from __future__ import annotations

import json
import signal
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any

import msgspec
import typer

from rr_actors.base.checks import needing
from rr_actors.base.errors import NotRunning, UsageError, counted, shown
from rr_actors.base.folder import read_plain
from rr_actors.base.values.canonical import Codec
from rr_actors.system.console import console_commands as commands
from rr_actors.system.console import console_messages as c
from rr_actors.system.console import console_questions as questions
from rr_actors.system.console.asking.actor_calls import CallActor, given_bytes
from rr_actors.system.console.console_connection import ConsoleConnection
from rr_actors.system.recording.event_memory import Event, events_of, is_of_child, left_events
from rr_actors.tools.cli_commands import JsonOption, StateOption, say, say_json, say_lines
from rr_actors.tools.explanations import explain, explain_actor, past_of_child
from rr_actors.tools.terminal.event_lines import EventFilter, EventLine, EventLines, event_line, missed_line
from rr_actors.tools.verbs.console_options import (
    ChildArgument,
    DryRun,
    Limit,
    ParentOption,
    Timeout,
    carry_out,
    completing,
    connection_of,
    list_children,
    list_children_or_targets,
    list_registrars,
    list_resources,
    list_servers,
    list_targets,
)

app = typer.Typer()

_LEFT = 2000  # events that a system has left
_ANSWER_S = 10.0  # of the console, in addition to that of the actor
_UNLOAD_S = 60.0  # for the unload callbacks, after a grace
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
    count: Annotated[int | None, typer.Option(min=1, help="End after this many events.")] = None,
    state: StateOption = None,
    as_json: JsonOption = False,
) -> None:
    """Show what happened lately to children and resources; with --follow go on with what happens.

    Without --follow there are the ends and starts of children, and of resources the statuses, revocations, and loads
    that failed or took long.
    A status that spreads over many resources is one line, with the number of those that it has reached. Events that say
    the same within ten seconds are one line with their number. With --json each event is a line.
    """
    wanted = EventFilter.of(event or [], child, server, about)
    if not follow:
        happened = _remembered(state, questions.ListEvents(server or child.rpartition("/")[2]))
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
    with connection_of(state) as connection:
        left = sys.maxsize if count is None else count
        for lines in _following(connection, wanted, as_json):
            for line in lines[:left]:
                say_json(line) if as_json else say(str(line))
            left -= len(lines)
            if left <= 0:
                return
    say("the system has ended", err=True)


def _following(connection: ConsoleConnection, wanted: EventFilter, as_json: bool) -> Iterator[list[Any]]:
    """Yield what happens from now on: facts, or lines to which nothing more will be added."""
    known = EventLines()
    for part in connection.follow(c.Follow(sorted(wanted.kinds)), _TICK_S):
        if isinstance(part, c.Missed):
            _say_missed(part, as_json)
        elif as_json:
            yield [one.flat() for one in part.events if wanted.accepts(EventLine.of(one))]
        else:
            for one in part.events:
                known.take(one)
            yield list(filter(wanted.accepts, known.take_settled()))
    yield list(filter(wanted.accepts, known.take_settled(all_of_them=True)))


def _say_facts(events: list[Event]) -> None:
    for event in events:
        say_json(event.flat())


def _remembered(state: Path | None, question: questions.ListEvents | questions.ListHistory) -> list[Event]:
    """Return the events of a running system, or those that it has left in its state directory."""
    try:
        with connection_of(state) as connection:
            found = connection.ask(question)
    except NotRunning:
        of_children = isinstance(question, questions.ListHistory)
        events = left_events(state, _LEFT, is_of_child if of_children else None) if state is not None else []
        if not events:
            raise
        if isinstance(question, questions.ListHistory):
            events = events_of(events, question.path)
        say(f"no system runs in {state}: this is what it has left", err=True)
        return events[-question.limit :]
    if found.left_out:
        say(f"not shown: {counted(found.left_out, 'older event')}, too long for one answer", err=True)
    return found.events


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
    happened = _remembered(state, questions.ListHistory(child, min(limit, c.PAGE_LIMIT)))
    if as_json:
        _say_facts(happened)
        return
    for event in happened:
        say(event_line(event))
        if traceback := event.facts.get("traceback"):
            say_lines(traceback.rstrip(), "    ")


@app.command(epilog="Example: rr-actors stack cameras --timeout 10")
def stack(
    child: ChildArgument, timeout_s: Timeout = 5.0, state: StateOption = None, as_json: JsonOption = False
) -> None:
    """Show where each thread of a child's process is now, also if the child is stuck."""
    with connection_of(state, timeout_s) as connection:
        found = connection.ask(questions.ListStacks(child, timeout_s))
    if as_json:
        say_json({"path": found.path, **msgspec.to_builtins(found.stacks)})
        return
    left_out = f", {found.stacks.left_out} of them left out" if found.stacks.left_out else ""
    count = len(found.stacks.threads) + found.stacks.left_out
    say(f"{found.path}: process {found.stacks.pid}, {counted(count, 'thread')}{left_out}")
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
        list[Path] | None,
        typer.Option(
            "--lab", metavar="DIR", help="A folder with experiments to serve in place of a system; or several of them."
        ),
    ] = None,
    child: Annotated[bool, typer.Option("--child", hidden=True)] = False,
) -> None:
    """Serve a live web page of a running system: its tree, its resources, the last minutes; print its address."""
    with needing("web", "web"):  # the other verbs work without it
        from rr_actors.tools.web.web_server import serve
    names = host_name or ()
    serve(state, lab=lab or (), host=host, port=port, prefix=prefix, names=names, is_child=child, say=say)


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

    An actor that asks waits for the one that it has asked. If these wait for each other, the ring is named. The events
    that the system remembers say since when a resource or child has its state, and what came before.
    """
    with connection_of(state) as connection:
        lines = explain_actor(lambda one: connection.ask(questions.LookAtMailbox(one)).mailbox, id)
        for line in [*lines, *past_of_child(connection, id)] if lines else explain(connection, id):
            say(line)


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


@app.command(
    epilog="Example: rr-actors call budgets set_capacity watts 60",
    context_settings={"ignore_unknown_options": True},  # a negative number is no option
)
def call(
    actor: ChildArgument,
    method: Annotated[str, typer.Argument(help="One of its methods; without one, all are shown.")] = "",
    given: Annotated[
        list[str] | None,
        typer.Argument(metavar="[JSON]...", help="Its arguments: 60, '{\"x\": 1}'; a word that is no JSON is a text."),
    ] = None,
    timeout_s: Timeout = 30.0,
    state: StateOption = None,
    as_json: JsonOption = False,
) -> None:
    """Call a method of an actor with plain data, and show its answer; without METHOD, show which methods there are."""
    if not method:
        with connection_of(state, timeout_s) as connection:
            rows = connection.ask(questions.ListMethods(actor)).rows
        if as_json:
            say_json(rows)
        elif not rows:
            say(f"{actor} has no methods of its own", err=True)
        for row in rows if not as_json else ():
            say(row.signature)
            say_lines("\n".join(f"    {line}".rstrip() for line in row.help.splitlines()))
        return
    data = given_bytes(actor, method, [_argument(text) for text in given or ()])
    with connection_of(state, timeout_s + _ANSWER_S) as connection:
        answer = connection.ask(CallActor(actor, method, data, timeout_s)).answer
    say_json(Codec(None, "answer").show(answer))


def _argument(text: str) -> Any:
    """Return what a person has typed as an argument: JSON, or a word that stands for itself."""
    try:
        return json.loads(text)
    except ValueError as error:
        if text[:1] in ("{", "[", '"'):
            raise UsageError(f"expected JSON, got {shown(text)}: {error}") from None
        return text


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


@app.command(epilog="Example: rr-actors reload 'cameras/camera \"/dev/video0\"'")
def reload(
    id: Annotated[str, typer.Argument(help=f"The resource's id, {_PART}.", autocompletion=completing(list_resources))],
    timeout_s: Timeout = 30.0,
    state: StateOption = None,
    as_json: JsonOption = False,
    dry_run: DryRun = False,
) -> None:
    """Unload a resource and load it again for the same request; its holders keep it, and hear the new response."""
    carry_out(state, commands.Reload(id, timeout_s, dry_run), as_json, timeout_s)


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
    """Stop a child cleanly. It stays stopped until restart; a temporary child is forgotten."""
    carry_out(state, commands.Terminate(child, dry_run), as_json)


@app.command(epilog="Example: rr-actors restart cameras")
def restart(
    child: ChildArgument, state: StateOption = None, as_json: JsonOption = False, dry_run: DryRun = False
) -> None:
    """Start a child again. If it runs, it is stopped cleanly first."""
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
        text = spec if id else read_plain(spec).decode()
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
    """Stop the whole system cleanly, as its own stop() does. A program that waits for the system's end goes on."""
    if not wait or dry_run:
        carry_out(state, commands.ShutDown(dry_run), as_json)
        return
    with connection_of(state) as connection:
        happens = connection.follow(c.Follow())
        carry_out(state, commands.ShutDown(), as_json)
        for _ in happens:  # until the system's console ends, after its children
            pass
