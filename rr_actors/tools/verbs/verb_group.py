"""The command `rr-actors` itself: which verbs it has, in groups, and the import of the one that is called.

A verb's module imports the console, storage or a whole system, which takes longer than all else. So the list of the
verbs stands here, for the help and for completion, and one function for each module imports it when a verb is called.
These are import statements, and no names in a table, so that freezers and the tests of layers see them.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Annotated, Any, Protocol, cast, get_type_hints

import typer
from typer.core import TyperCommand, TyperGroup

from rr_actors.base import __version__
from rr_actors.base.checks import needing
from rr_actors.base.errors import UsageError
from rr_actors.runtime.garbage import left_alone
from rr_actors.tools.tables.sheets import SHEETS, Sheet


class Declaring(Protocol):
    """A module that declares verbs, or what declares one."""

    app: typer.Typer


def _console() -> ModuleType:
    from rr_actors.tools.verbs import console_verbs

    return console_verbs


def _lists() -> ModuleType:
    from rr_actors.tools.verbs import list_verbs

    return list_verbs


def _listed(sheet: Sheet) -> Callable[[], Declaring]:
    """Return a function that imports and returns the verb of a sheet."""

    def listed() -> Declaring:
        from rr_actors.tools.verbs import list_verbs

        return list_verbs.ListVerb(sheet)

    return listed


def _planner() -> ModuleType:
    from rr_actors.tools.verbs import planner_verbs

    return planner_verbs


def _mailboxes() -> ModuleType:
    from rr_actors.tools.verbs import mailbox_verbs

    return mailbox_verbs


def _recording() -> ModuleType:
    from rr_actors.tools.verbs import recording_verbs

    return recording_verbs


def _chaos() -> ModuleType:
    from rr_actors.tools.verbs import chaos_verb

    return chaos_verb


def _state() -> ModuleType:
    from rr_actors.tools.verbs import state_verbs

    return state_verbs


def _system() -> ModuleType:
    from rr_actors.tools.verbs import system_verbs

    return system_verbs


def _backup() -> ModuleType:
    from rr_actors.tools.verbs import backup_verbs

    return backup_verbs


def _project() -> ModuleType:
    from rr_actors.tools.verbs import project_verbs

    return project_verbs


VERBS: dict[str, dict[Callable[[], ModuleType | Declaring], dict[str, str]]] = {
    "Look at a running system": {
        **{_listed(sheet): {sheet.verb: sheet.says.partition("\n")[0].rstrip(".")} for sheet in SHEETS},
        _lists: {
            "attention": (
                "Show what needs attention, the worst first: what, since when, whom it touches, and the command that "
                "leads on"
            ),
            "usage": "Show what each resource uses now, CPU and memory for instance, of servers that can say it",
            "dead-letters": "Show how many messages could not be delivered, and the newest of them",
            "hosts": (
                "Show the other hosts that the system knows: whether each is reachable, since when, and what it exports"
            ),
        },
        _console: {
            "events": "Show what happened lately to children and resources; with --follow go on with what happens",
            "history": "Show the starts and exits of a child and all below it, or of all children, with reasons",
            "stack": "Show where each thread of a child's process is now, also if the child is stuck",
            "top": "Watch the tree, the registrars and the events live; kill, terminate, restart and unload with keys",
            "web": (
                "Serve a live web page of a running system: its tree, its resources, the last minutes; "
                "print its address"
            ),
            "why": (
                "Say who holds a resource, for whom, since when, and what it waits for; or whom an actor waits for"
            ),
        },
        _recording: {
            "logs": (
                "Show the last log lines of a child, also of the processes that it had before; or the output of a "
                "program"
            ),
            "graph": (
                "Draw the tree, and the resources with their holders: as SVG or PNG, or as text for Mermaid or Graphviz"
            ),
            "stream": (
                "Show a stream's rate; or read it as one reader more, and show its frames, save one, or record them"
            ),
        },
        _mailboxes: {
            "mailbox": (
                "Show how many messages wait for an actor, since when, of what types, and what it handles, "
                "from whom, since when"
            ),
            "wait": (
                "Wait until a child or a resource is in a state; before the system runs, for that, too; "
                "exit code 1 if late"
            ),
        },
        _planner: {
            "keep": "Show what a Keeper keeps, how many replicas are ready, and why others are not",
            "budgets": (
                "Show the pools of a Budgets: how much each has, what is used and free, and how many "
                "loads wait for room"
            ),
            "choices": (
                "Show the choices of a Choices: which alternative each has, and what was chosen by hand, by whom"
            ),
        },
    },
    "Change its resources": {
        _console: {
            "load": "Load a resource and show its response; without --hold or --as it is released again at once",
            "priority": "Give a query of any holder a priority; what its resource depends on follows",
            "unload": (
                "Release a query of any holder; with --force take a resource away from all its holders, "
                "which hear FATAL"
            ),
            "revoke": (
                "Take a resource away from its holders in its owner's name: what depends on it ends "
                "first, or replaces it"
            ),
            "reload": (
                "Unload a resource and load it again for the same request; its holders keep it, and hear "
                "the new response"
            ),
        },
        _mailboxes: {
            "status": (
                "Show how a child or a resource is; with STATE, send a resource's status to its holders "
                "in its owner's name"
            )
        },
        _planner: {
            "apply": (
                "Have a Keeper keep what another file wants, and show what changes: + is added, - is removed, ~ differs"
            ),
            "choose": (
                "Fix which alternative a choice has, until --freely takes that back; while it fails, another one serves"
            ),
        },
    },
    "Run, change and stop it": {
        _console: {
            "call": (
                "Call a method of an actor with plain data, and show its answer; without METHOD, show which "
                "methods there are"
            ),
            "kill": "Send a signal to a child's process; if the child ends, its supervisor handles that as any end",
            "terminate": "Stop a child cleanly",
            "restart": "Start a child again",
            "start": "Add a child to the running tree, and start it",
            "shutdown": "Stop the whole system cleanly, as its own stop() does",
        },
        _mailboxes: {
            "pause": (
                "Keep the messages of an actor in its mailbox, in a system that was started for debugging (--debug)"
            ),
            "step": "Have a paused actor handle one message, and say which",
            "resume": "Have a paused actor handle its messages again",
        },
        _chaos: {
            "chaos": (
                "Kill children of the running system at random, and check that it recovers; exit code 1 if it does not"
            )
        },
        _system: {
            "run": (
                "Run a system from files alone until SIGTERM or Ctrl-C, which end it cleanly; a second "
                "one kills what is left"
            ),
            "verify": (
                "Say what cannot start of a tree: wrong keys, unknown classes, an on_start that waits for what "
                "starts later"
            ),
            "simulate": (
                "Say what a tree does while children die, in virtual time: who is available, who restarts, when it "
                "gives up"
            ),
        },
    },
    "Record what happens": {
        _recording: {
            "record": "Record the events, exits, callbacks and messages of the system: of its actors and registrars",
            "trace": (
                "List the loads and messages that a recording has; of a name, id or actor, show what happened, a "
                "line each"
            ),
            "sequence": "Draw loads, a message, or the messages of actors as a Mermaid sequence diagram",
            "timeline": (
                "Draw what happened: a lane for each child, a bar for each life, marks for events and their reasons"
            ),
        },
        _state: {
            "rewind": (
                "Show the tree and the resources as they were at any moment of a recording; in a terminal, step by step"
            ),
            "replay": (
                "Decide again what registrars decided in a recording; exit code 1 if today's code decides in another "
                "way"
            ),
        },
    },
    "Look into a state directory, whether its system runs or not": {
        _state: {
            "inspect": "Show every registrar's resources, the queries on them, and the queries that it holds elsewhere",
            "tree": "Show each registrar's own queries, and below them the resources that they depend on",
            "check": "Check the catalogs against each other; exit code 1 if they disagree",
        }
    },
    "Keep its state, and bring it back": {
        _backup: {
            "backup": (
                "Copy all catalogs of a system as they are at one moment, while it runs or not, to a new directory"
            ),
            "restore": "Make a new state directory from a backup",
        }
    },
    "This machine, and projects": {
        _system: {
            "doctor": (
                "Say what this machine lacks or limits of what a system needs, each with what to do; exit "
                "code 1 if it lacks any"
            ),
            "learn": "Learn supervision and resources by exercises: mend a file, save it, and see what happens",
        },
        _project: {
            "version": "Print the version",
            "new": (
                "Make a small project: two managers, an application, a test that kills one, a systemd "
                "unit, a Dockerfile"
            ),
            "import-temoto": "Print the files of a temoto_component_manager as one TOML file for the manager Pipes",
        },
    },
}
"""Of each group, its verbs: the module that declares them, and the first sentence of each one's help."""


class Verb(TyperCommand):
    """A verb."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        _convert_no_more_than_needed(self, ctx)
        try:
            return super().parse_args(ctx, args)
        except Exception as error:
            if type(error).__name__ != "BadOptionUsage":  # click's: an option without its value
                raise
            wrong: Any = error
            option: Any = next(param for param in self.get_params(ctx) if wrong.option_name in param.opts)
            raise UsageError(f"{wrong.message.rstrip('.')}: {option.help}") from error


class _Verbs(TyperGroup):
    """The verbs, in groups. An option before the verb is an error that says where options stand."""

    def __init__(self, **attributes: Any) -> None:
        super().__init__(**attributes)
        for name, says in (each for modules in VERBS.values() for verbs in modules.values() for each in verbs.items()):
            self.add_command(TyperCommand(name, help=says))  # for lists alone

    def format_commands(self, ctx: Any, formatter: Any) -> None:
        for group, modules in VERBS.items():
            with formatter.section(group):
                formatter.write_dl([each for verbs in modules.values() for each in verbs.items()])

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        _convert_no_more_than_needed(self, ctx)
        try:
            return super().parse_args(ctx, args)
        except Exception as error:
            if type(error).__name__ != "NoSuchOption":  # click's, of which newer versions of typer have a copy
                raise
            order = "a command's options stand after it: rr-actors ps --state DIR"
            raise UsageError(f"{cast('Any', error).message}; {order}") from error

    def resolve_command(self, ctx: Any, args: list[str]) -> Any:
        name, listed, rest = super().resolve_command(ctx, args)
        return name, listed and whole(listed.name or ""), rest


def whole(name: str) -> Verb:
    """Return a verb with its arguments and options; import its module for that."""
    (module,) = (module for modules in VERBS.values() for module, verbs in modules.items() if name in verbs)
    with needing("the command line", "cli"), left_alone():
        declared = module().app
    for info in declared.registered_commands:
        if (info.name or typer.main.get_command_name(cast("Any", info.callback).__name__)) == name:
            info.cls = Verb
            found = typer.main.get_command_from_info(info, pretty_exceptions_short=False, rich_markup_mode=None)
            return cast("Verb", found)
    raise KeyError(name)


_PLAIN: dict[Any, Callable[[str], object]] = {str: str, str | None: str, Path: Path, Path | None: Path}


def _convert_no_more_than_needed(command: Any, ctx: Any) -> None:
    """Have typer convert no default, which has its type already, no text, no path, and nothing for a completion.

    Newer versions of typer import pydantic for the first value that they convert, which takes as long as all libraries
    that a verb needs.
    """
    types = get_type_hints(command.callback)
    for param in command.get_params(ctx):
        param.process_value = functools.partial(_process, param, _PLAIN.get(types.get(param.name)))


def _process(param: Any, plain: Callable[[str], object] | None, ctx: Any, value: Any) -> Any:
    if ctx.resilient_parsing or (ctx.get_parameter_source(param.name).name == "DEFAULT" and not param.required):
        return () if value is None and (param.multiple or param.nargs == -1) else value
    if plain is not None and isinstance(value, str):
        return plain(value)
    return cast("Any", type(param)).process_value(param, ctx, value)


app = typer.Typer(
    name="rr-actors",
    cls=_Verbs,
    no_args_is_help=True,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},  # of each verb, too
)


def _version_wanted(wanted: bool) -> None:
    if wanted:
        typer.echo(__version__)
        raise typer.Exit


@app.callback()
def _options(
    _version: Annotated[
        bool, typer.Option("--version", callback=_version_wanted, is_eager=True, help="Print the version.")
    ] = False,
) -> None:
    """See and drive a running system of rr_actors; look into the state of one that has ended; run one from files.

    A command finds its system by --state DIR (after the command), by RR_STATE, or takes the one that runs.

    Exit codes: 0 done; 1 the answer is no; 2 the call was wrong, or names something that does not exist; 3 no running
    system was reached; 4 the system tried, and could not do it.
    """
