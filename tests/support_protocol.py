"""Scripts of messages: what registrars decide, save, send and run, as text that a student can read.

A script is a text file (tests/registrar/protocol): what it is about, then steps, each with what followed from it.

    > app loads q1 = cameras/camera front
      app saves held q1 at cameras/camera: pending
      app sends cameras: Load q1

run() does the steps with the real decisions, one message after another, and returns the text with what followed.
To write what follows into a new script: `python tests/support_protocol.py FILE ...`; then read whether it is right.
"""

from __future__ import annotations

import re
import shlex
import sys
from collections import deque
from collections.abc import Callable
from pathlib import Path
from typing import Any

from rr_actors.base.values.failure import Failure
from rr_actors.registrar.core.decide import Item, decide
from rr_actors.registrar.core.holding import pending
from rr_actors.registrar.core.releasing import forgetting, owing
from rr_actors.registrar.model import commands as c
from rr_actors.registrar.model import effects as e
from rr_actors.registrar.model import messages as m
from rr_actors.registrar.model.catalog import Catalog, Decision, Server, key_of
from rr_actors.registrar.model.rows import (
    STANDBY,
    CallbackRun,
    Drop,
    Held,
    Notice,
    Peer,
    Put,
    Resource,
    ServedQuery,
    State,
    content_of,
)


class Side:
    """One registrar: its catalog in memory, and its disk."""

    def __init__(self, name: str) -> None:
        self.name = name
        self.disk: dict[Any, Any] = {}
        self.later: dict[Any, Any] = {}
        self.epoch = 0
        self.timers: dict[str, Any] = {}
        self.told: dict[str, Notice] = {}  # by query: what its listeners were told last
        self.statuses: dict[str, e.StartCallback] = {}  # by resource: the status callback that runs
        self.start()

    def start(self) -> None:
        """Open the catalog as the disk has it."""
        self.epoch += 1
        self.catalog = Catalog(self.name, content_of(self.disk.values()), self.epoch)
        self.later.clear()
        self.timers.clear()

    def commit(self, changes: list[Any]) -> None:
        """Write changes, behind those that waited."""
        for change in [*self.later.values(), *changes]:
            if isinstance(change, Put):
                self.disk[key_of(change)] = change.row
            else:
                self.disk.pop(key_of(change), None)
        self.later.clear()


class Script:
    """The registrars of a script, the links between them, and what has followed."""

    def __init__(self) -> None:
        self.lines: list[str] = []
        self.sides: dict[str, Side] = {}
        self.down: set[str] = set()
        self.links: set[tuple[str, str]] = set()
        self.waiting: deque[tuple[str, Item]] = deque()
        self.events = 0
        self.numbers = 0
        self.asked = 0

    def side(self, name: str) -> Side:
        """The registrar of that name; the first time it is named it begins."""
        if name not in self.sides:
            self.sides[name] = Side(name)
        return self.sides[name]

    def event(self) -> str:
        """A fresh id."""
        self.events += 1
        return f"e{self.events}"

    def say(self, name: str, text: str) -> None:
        """Note what a registrar does."""
        self.lines.append(f"  {name} {text}")

    def step(self, line: str) -> None:
        """Do a step, and all that follows from it."""
        for pattern, action in STEPS.items():
            found = re.fullmatch(pattern, line)
            if found is not None:
                action(self, **found.groupdict())
                break
        else:
            known = "\n".join(STEPS)
            raise ValueError(f"not a step: {line!r}; steps are\n{known}")
        while self.waiting:
            name, item = self.waiting.popleft()
            if name not in self.down:
                self.decide(name, item)

    def post(self, name: str, command: c.Command) -> None:
        """Have a registrar decide a command."""
        self.waiting.append((self.side(name).name, (command, None)))

    def decide(self, name: str, item: Item) -> None:
        """Decide, commit, act."""
        side = self.side(name)
        decision = decide(side.catalog, [item])
        self.save(side, decision)
        decision.close()
        for effect in decision.effects:
            self.act(side, effect)

    def save(self, side: Side, decision: Decision) -> None:
        """Write what has to be on disk now; the rest follows with the next commit."""
        for change in decision.changes:
            self.say(side.name, f"saves {row_text(change.row)}" if isinstance(change, Put) else drop_text(change))
        for key, change in decision.later.items():
            text = f"notes {row_text(change.row)}" if isinstance(change, Put) else drop_text(change, "notes that")
            self.say(side.name, text)
            side.later[key] = change
        if decision.changes:
            side.commit(decision.changes)

    def connect(self, consumer: str, provider: str) -> None:
        """Bring the link up, as the shells do: the consumer asks what the provider has of its own."""
        if (consumer, provider) in self.links or provider in self.down or provider not in self.sides:
            return
        self.links.add((consumer, provider))
        self.numbers += 1
        self.say(consumer, f"connects to {provider}")
        fetch = m.Fetch(consumer, True, self.numbers)
        self.waiting.append((provider, (fetch, consumer)))

    def act(self, side: Side, effect: Any) -> None:
        """Do one effect, or note that it was caused."""
        name = side.name
        match effect:
            case e.SendReply(origin, message):
                self.send(name, origin, message, (origin, name))
            case e.SendRequest(registrar, message):
                self.send(name, registrar, message, (name, registrar))
            case e.Connect(registrar):
                self.connect(name, registrar)
            case e.Receive(sender, message):
                self.waiting.append((name, (message, sender)))
            case e.StartCallback("load", resource):
                self.say(name, f"runs the load callback of {resource.id}, attempt {resource.attempt}")
            case e.StartCallback("unload", resource):
                given = "" if resource.response is None else f" with {resource.response.decode()}"
                self.say(name, f"runs the unload callback of {resource.id}{given}, try {resource.tries}")
            case e.StartCallback("reload", resource):
                self.say(name, f"runs the unload callback of {resource.id}, to load it again")
            case e.StartCallback("recover", resource, reload=reload):
                self.say(name, f"runs the {'load' if reload else 'recover'} callback of {resource.id} again")
            case e.StartCallback("status", resource, notice) if notice is not None:
                side.statuses[resource.id] = effect
                self.say(name, f"runs the status callback of {resource.id}: {status_text(notice)}")
            case e.SetTimer(key, None, _):
                if side.timers.pop(key, None) is not None:
                    self.say(name, f"stops the timer {key}")
            case e.SetTimer(key, delay_s, command):
                side.timers[key] = command
                self.say(name, f"starts the timer {key}: {delay_s:g} s")
            case e.LoadResolved(held, failure):
                self.say(name, f"returns from load {held.id}: {end_text(failure)}")
            case e.UnloadResolved(query_id, failure):
                self.say(name, f"returns from unload {query_id}: {end_text(failure)}")
            case e.Hear(held, notice, repeated):
                side.told[held.id] = notice
                self.say(name, f"tells the listeners of {held.id}: {status_text(notice)}{' again' * repeated}")
            case e.AnswerCall(ticket, failure):
                self.say(name, f"returns from {ticket}: {end_text(failure)}")
            case e.Happened():
                pass
            case e.Acquitted():
                self.say(name, "says that no callback has ended its last process")
            case e.RingBroken(why):
                self.say(name, f"says: {why}")
            case e.Died(runs, given_up):
                self.say(name, f"says that its last process died in {'; '.join(runs)}")
                for text in given_up:
                    self.say(name, f"says: {text}")
            case _:
                raise TypeError(f"no effect: {effect}")

    def send(self, sender: str, to: str, message: Any, link: tuple[str, str]) -> None:
        """Give a message to the other side, if the link between them is up."""
        if link not in self.links:
            self.say(sender, f"cannot send {to}: {message_text(message)}")
            return
        self.say(sender, f"sends {to}: {message_text(message)}")
        if isinstance(message, m.Fetched):
            event = self.event()
            self.post(to, c.Reconcile(sender, message.queries, event, message.same, message.number))
        else:
            self.waiting.append((to, (message, sender)))


# -- what can be seen --------------------------------------------------------------------------------------------------


def row_text(row: Any) -> str:
    """A row, in words."""
    match row:
        case Resource():
            attempt = f", attempt {row.attempt}" if row.attempt > 1 else ""
            state = f", {row.state.name}" if row.state is not State.OK else ""
            return f"resource {row.id} of {row.server}: {row.phase.value}{attempt}{state}"
        case ServedQuery():
            return f"query {row.id} of {row.origin} on {row.resource_id}{priority_text(row.priority)}"
        case Held():
            parent = f" for {row.parent}" if row.parent else ""
            state = f", {row.state.name}" if row.state is not State.OK else ""
            priority = priority_text(row.priority)
            return f"held {row.id} at {row.registrar}/{row.server}{parent}: {row.hold.value}{state}{priority}"
        case Notice():
            whose = f"query {row.query_id}" if row.query_id else "its own server"
            return f"notice for {whose}: {status_text(row)}"
        case Peer():
            return f"peer {row.id}" + (", with all queries so far released" if row.released else "")
        case CallbackRun():
            begun = ", begun" if row.begun else ""
            return f"run {row.id}: {row.deaths} deaths{begun}"
        case _:
            return f"{type(row).__name__} {row.id}"


def priority_text(priority: int) -> str:
    """A priority in words; that of most is not said."""
    return f", priority {'standby' if priority == STANDBY else priority}" if priority else ""


def drop_text(change: Drop, verb: str = "saves that") -> str:
    """A row that is gone, in words."""
    one = {"resources": "resource", "queries": "query", "held": "held", "notices": "notice", "peers": "peer"}
    one["callback_runs"] = "run"
    return f"{verb} {one[change.table]} {change.id} is gone"


def status_text(notice: Notice) -> str:
    """A status, in words."""
    text = f"{notice.state.name} {notice.message!r} of {notice.source}"
    return text + (", taken away" if notice.released else "")


def end_text(failure: Failure | None) -> str:
    """How a call ended."""
    return "done" if failure is None else f"{failure.kind}: {failure.message}"


def message_text(message: Any) -> str:
    """A message, in words."""
    name = type(message).__name__
    match message:
        case m.Load():
            text = f"{name} {message.query_id} {message.server} {message.request.decode()}"
            return text + priority_text(message.priority)
        case m.Loaded():
            return f"{name} {message.query_id} {message.response.decode()}"
        case m.LoadRefused() | m.UnloadRefused():
            return f"{name} {message.query_id} {end_text(message.failure)}"
        case m.Unload() | m.Unloaded():
            return f"{name} {message.query_id}"
        case m.Fetched():
            return f"{name} {', '.join(query.query_id for query in message.queries) or 'nothing'}"
        case m.Noticed():
            again = ", again" if message.repeated else ""
            return f"{name} {message.notice.query_id} {status_text(message.notice)}{again}"
        case m.NoticesHandled():
            return f"{name} {' '.join(message.ids)}"
        case m.Probe():
            verb = "hold" if message.holds else "wait for"
            return f"{name} {message.query_id}: does it {verb} {message.waiter}?"
        case m.Gone():
            return f"{name} {message.origin}"
        case m.Reprioritise() | m.Reprioritised():
            return f"{name} {message.query_id}{priority_text(message.priority) or ', priority 0'}"
        case _:
            raise TypeError(f"no message: {message}")


# -- steps -------------------------------------------------------------------------------------------------------------

R = r"(?P<name>[\w-]+)"


def _begins(script: Script, name: str, server: str, options: str) -> None:
    given = dict(option.split("=") for option in shlex.split(options))
    spec = Server(
        server,
        linger_s=float(given.pop("linger", 0)),
        load_timeout_s=float(given.pop("timeout")) if "timeout" in given else None,
        recovery=given.pop("recovery", "keep"),
        has_status=given.pop("status", "") == "yes",
        has_recover=given.pop("recover", "") == "yes",
        recover_timeout_s=float(given.pop("limit")) if "limit" in given else None,
    )
    if given:
        raise ValueError(f"unknown options: {given}")
    script.post(name, c.Register(spec, script.event()))


def _loads(
    script: Script,
    name: str,
    query: str,
    provider: str,
    server: str,
    request: str,
    parent: str | None,
    priority: str | None,
) -> None:
    script.side(provider)
    script.asked += 1
    number = script.side(name).catalog.since + script.asked
    given = (int(priority or 0), priority is not None)
    script.post(name, c.AskProvider(query, provider, server, request.encode(), parent or "", number, *given))


def _gives(script: Script, name: str, id: str, priority: str) -> None:
    value = STANDBY if priority == "standby" else int(priority)
    script.post(name, c.SetPriority(id, value, "set_priority"))


def _loads_directly(script: Script, name: str, query: str, provider: str, server: str, request: str) -> None:
    script.asked += 1
    catalog = script.side(name).catalog
    asked = pending(c.AskProvider(query, provider, server, request.encode(), "", catalog.since + script.asked))
    catalog.in_flight[query] = asked
    load = m.Load(query, server, asked.request, name, "", 0, asked.seq)
    script.waiting.append((provider, (load, name)))


def _finds_gone(script: Script, name: str, other: str) -> None:
    failure = Failure("RegistrarDown", "gone for good")
    script.post(name, c.PeerGone(other, failure, final=True, event=script.event()))


def _load_ends(script: Script, name: str, id: str, how: str, text: str) -> None:
    attempt = script.side(name).catalog.resources[id].attempt
    if how == "returns":
        script.post(name, c.CallbackEnded("load", id, attempt, response=text.encode()))
    else:
        script.post(name, c.CallbackEnded("load", id, attempt, Failure("LoadFailed", text)))


def _unload_ends(script: Script, name: str, id: str, how: str, text: str | None) -> None:
    tries = script.side(name).catalog.resources[id].tries
    if how == "returns":
        script.post(name, c.CallbackEnded("unload", id, tries))
    else:
        script.post(name, c.CallbackEnded("unload", id, tries, Failure("UnloadFailed", text or "")))


def _unload_first_ends(script: Script, name: str, id: str, how: str, text: str | None) -> None:
    attempt = script.side(name).catalog.resources[id].attempt
    failure = None if how == "returns" else Failure("UnloadFailed", text or "")
    script.post(name, c.CallbackEnded("reload", id, attempt, failure, event=script.event()))


def _recover_ends(script: Script, name: str, id: str, how: str, text: str) -> None:
    attempt, event = script.side(name).catalog.resources[id].attempt, script.event()
    if how == "returns":
        script.post(name, c.CallbackEnded("recover", id, attempt, response=text.encode(), event=event))
    else:
        script.post(name, c.CallbackEnded("recover", id, attempt, Failure("LoadFailed", text), event=event))


def _says(script: Script, name: str, id: str, state: str, text: str) -> None:
    script.post(name, c.SetStatus(id, script.event(), State[state], text, "set_status"))


def _updates(script: Script, name: str, id: str, text: str) -> None:
    script.post(name, c.SetResponse(id, script.event(), text.encode(), "", "update_response"))


def _heard(script: Script, name: str, id: str, verb: str) -> None:
    script.post(name, c.Heard(id, script.side(name).told.pop(id).event, handled=verb == "handle"))


def _status_done(script: Script, name: str, id: str, verb: str) -> None:
    start = script.side(name).statuses.pop(id)
    script.post(name, c.CallbackEnded("status", id, notice=start.notice, handled=verb == "handles it"))


def _fires(script: Script, name: str, key: str) -> None:
    script.post(name, script.side(name).timers.pop(key))


def _breaks(script: Script, name: str, other: str) -> None:
    script.links.discard((name, other))
    script.post(name, c.LinkLost(other))
    script.post(other, c.ConsumerLost(name))


def _comes_up(script: Script, name: str, other: str) -> None:
    script.connect(name, other)


def _killed(script: Script, name: str) -> None:
    script.down.add(name)
    for link in [link for link in script.links if name in link]:
        script.links.discard(link)
        consumer, provider = link
        if provider == name:
            script.post(consumer, c.LinkLost(name))
        else:
            script.post(provider, c.ConsumerLost(name))


def _respawned(script: Script, name: str) -> None:
    side = script.side(name)
    side.start()
    script.down.discard(name)
    script.post(name, c.BeginAgain())
    script.post(name, c.BeginServing("serving"))  # as a registrar without an on_start


def _gone(script: Script, name: str) -> None:
    _killed(script, name)
    for other in list(script.sides):
        if other != name:
            script.waiting.append((other, (m.Gone(name), name)))
            failure = Failure("RegistrarDown", "gone for good")
            script.post(other, c.PeerGone(name, failure, final=True, event=script.event(), empty=True))


def _begins_to_close(script: Script, name: str) -> None:
    script.post(name, c.BeginClosing(Failure("RegistrarDown", f"{name} is being closed")))


def _deleted(script: Script, name: str) -> None:
    _killed(script, name)
    side = script.side(name)
    content = content_of(side.disk.values())
    side.commit(owing(content, side.epoch))
    script.say(name, "is given up: all that it holds is owed, and what it serves is to be unloaded")
    for other in list(script.sides):
        if other != name:
            script.waiting.append((other, (m.Gone(name), name)))
            _finds_gone(script, other, name)
    side.commit(forgetting(content_of(side.disk.values()), name, ()))


STEPS: dict[str, Callable[..., None]] = {
    rf"{R} registers (?P<server>\w+)(?P<options>.*)": _begins,
    rf"{R} loads (?P<query>\w+) = (?P<provider>\w+)/(?P<server>\w+) (?P<request>\w+)(?: for (?P<parent>\w+))?"
    r"(?: with priority (?P<priority>-?\d+))?": _loads,
    rf"{R} gives (?P<id>\w+) the priority (?P<priority>-?\d+|standby)": _gives,
    rf"a thread of {R} loads (?P<query>\w+) = (?P<provider>\w+)/(?P<server>\w+) (?P<request>\w+)": _loads_directly,
    rf"the connection of {R} for (?P<id>\w+) breaks": lambda script, name, id: script.post(name, c.SendAgain(id)),
    rf"{R} unloads (?P<id>\w+)": lambda script, name, id: script.post(name, c.Release(id)),
    rf"{R}: the load callback of (?P<id>\S+) (?P<how>returns|raises) (?P<text>.+)": _load_ends,
    rf"{R}: the unload callback of (?P<id>\S+) (?P<how>returns|raises)(?: (?P<text>.+))?": _unload_ends,
    rf"{R}: the recover callback of (?P<id>\S+) (?P<how>returns|raises) (?P<text>.+)": _recover_ends,
    rf"{R}: the status callback of (?P<id>\S+) (?P<verb>handles it|returns)": _status_done,
    rf"{R}: the listeners of (?P<id>\w+) (?P<verb>handle|have heard) it": _heard,
    rf"{R} reports (?P<id>\w+) (?P<state>[A-Z]+) (?P<text>.+)": _says,
    rf"{R} updates (?P<id>\w+) to (?P<text>.+)": _updates,
    rf"{R} unloads (?P<id>\S+) by force": lambda script, name, id: script.post(
        name, c.ForceUnload(id, script.event(), "force_unload", clears=True)
    ),
    rf"{R} reloads (?P<id>\S+)": lambda script, name, id: script.post(name, c.Reload(id, "reload")),
    rf"{R}: the unload callback of (?P<id>\S+), to load it again, (?P<how>returns|raises)(?: (?P<text>.+))?": (
        _unload_first_ends
    ),
    rf"{R} unregisters (?P<server>\w+)": lambda script, name, server: script.post(
        name, c.Unregister(server, script.event(), "unregister_server")
    ),
    rf"{R}: the timer (?P<key>\S+) fires": _fires,
    rf"{R} writes what it has noted": lambda script, name: script.side(name).commit([]),
    rf"the link of {R} to (?P<other>\w+) breaks": _breaks,
    rf"the link of {R} to (?P<other>\w+) comes up": _comes_up,
    rf"{R} is killed": _killed,
    rf"{R} is respawned": _respawned,
    rf"{R} is gone for good": _gone,
    rf"{R} is deleted": _deleted,
    rf"{R} finds that (?P<other>\w+) is gone for good": _finds_gone,
    rf"{R} begins to close": _begins_to_close,
    rf"{R} has closed": lambda script, name: script.post(name, c.EndClosing()),
}


def run(text: str) -> str:
    """The script's text with what follows from each of its steps."""
    script = Script()
    title, _, steps = text.partition("\n>")
    for line in ("> " + steps.strip()).splitlines():
        if line.startswith(">"):
            script.lines.append(line.replace(">  ", "> ").rstrip())
            script.step(line[1:].strip())
    return title.rstrip() + "\n\n" + "\n".join(script.lines) + "\n"


if __name__ == "__main__":
    for name in sys.argv[1:]:
        Path(name).write_text(run(Path(name).read_text()))
