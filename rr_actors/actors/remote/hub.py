"""ActorHub: carries messages between the actors of this process and those of other processes."""

from __future__ import annotations

import functools
import signal
import threading
import time
from collections.abc import Callable
from typing import Any

import pykka
from pykka import ActorDeadError, ActorRegistry

from rr_actors.actors.messaging import ask_cycles, death_watch
from rr_actors.actors.messaging.ask_cycles import Chain
from rr_actors.actors.messaging.exit_reports import ExitReport
from rr_actors.actors.messaging.futures import Reply, StopReply
from rr_actors.actors.messaging.mailbox import Mailbox, refuse_all
from rr_actors.actors.messaging.message_notes import Stamp
from rr_actors.actors.remote.inbound import Asker, Visitor
from rr_actors.actors.remote.peer import Cut, Line, PendingCall, Whereabouts
from rr_actors.actors.remote.protocol import ASKS, KIND, PATH_URN, Ask, Dead, Halt, Inquire, Letter, Over, Tell, Watch
from rr_actors.base import pickling
from rr_actors.base.errors import ActorUnavailable, Unavailable, UsageError
from rr_actors.base.steps import Steps
from rr_actors.runtime.event_loop import Dispatcher
from rr_actors.runtime.processes import lifeline
from rr_actors.runtime.shielding import Flag
from rr_actors.wire.name_service import Directory, Presence, Turn, actor_key, registrar_key
from rr_actors.wire.transport import Attach, Hello, Link, Welcome
from rr_actors.wire.unix_sockets import paused, pid_of
from rr_actors.wire.unix_transport import UnixTransport

ASK_TIMEOUT_S = 30.0

WATCH_S = 1.0
"""How long monitor() waits until a process that a signal has stopped confirms the watch."""

CUT_S = 1.0
"""How long, after its link is lost, a process may take to die before it counts as alive."""

running: dict[str, pykka.ActorRef[Any]] = {}
"""The actors of rr_actors that run in this process, by URN. An entry keeps its actor from being collected."""


def urn_of_path(path: str) -> str:
    """Return the URN of the actor at a path of the tree, which is the same after each respawn."""
    return PATH_URN + path


class ActorHub:
    """Knows this process's actors by path and URN, answers for them, and carries messages to actors of other processes.

    Its owner passes the links of kind "actors" that the transport accepts to `accept`.

    A method that looks for an actor or sends to it raises ActorDeadError if there is no such actor, ActorUnavailable if
    it is being respawned, MailboxFull if too many messages wait for its process, NotSerializable if a message cannot be
    pickled.

    Args:
        transport: the transport at whose address other processes find this process's actors; it may listen later.
        name: the name of this process, for errors on the other side: "root/cameras".
        ask_timeout_s: the time-out of an ask that has none of its own.
        debug: whether the mailboxes of its actors can be paused.
    """

    def __init__(
        self,
        dispatcher: Dispatcher,
        transport: UnixTransport,
        directory: Directory,
        *,
        name: str = "root",
        ask_timeout_s: float = ASK_TIMEOUT_S,
        debug: bool = False,
    ) -> None:
        self.name = name
        self.debug = debug
        self.address = transport.address
        self.ask_timeout_s = ask_timeout_s
        self._dispatcher = dispatcher
        self._transport = transport
        self._large_bytes = transport.segments.large_bytes
        self._directory = directory
        self._hosted: dict[str, pykka.ActorRef[Any]] = {}
        self._parts: dict[str, pykka.ActorRef[Any]] = {}
        self._lines: dict[str, Line] = {}
        self._visitors: set[Link] = set()
        self._lock = threading.Lock()
        self._closed = False

    # -- the actors of this process ------------------------------------------------------------------------------------

    def add(self, path: str, ref: pykka.ActorRef[Any], *, once: bool = False) -> None:
        """Enter the actor at `path`, which is ready in this process, into the directory as UP.

        Args:
            once: the actor is temporary: when it has ended, it is not started again.

        Raises:
            ConfigError: the directory cannot be written.
        """
        self._hosted[path] = ref
        self._directory.publish(actor_key(path), self.address, once=once)

    def host(self, path: str, ref: pykka.ActorRef[Any]) -> None:
        """Have an actor found that is a part of another one: others find it by the entry of that."""
        self._parts[path] = ref

    def parts(self) -> list[str]:
        """Return the paths of the actors of this process that are parts of others. From any thread."""
        return list(self._parts)

    def remove(self, path: str, ref: pykka.ActorRef[Any], report: ExitReport) -> None:
        """Remove the actor at `path`, which has ended or is abandoned. Its supervisor changes the directory.

        An abandoned actor is stuck in a handler; for all others it is dead from now on.
        """
        for known in (self._hosted, self._parts):
            if known.get(path) is ref:
                del known[path]
        if running.get(ref.actor_urn) is ref:
            del running[ref.actor_urn]
            ref.actor_stopped.set()
            if isinstance(ref.actor_inbox, Mailbox):
                refuse_all(ref.actor_inbox.close(), path)
        death_watch.ended(ref.actor_stopped, report)

    def local(self, urn: str) -> pykka.ActorRef[Any] | None:
        """Return the reference to the actor with this URN, if it lives in this process."""
        if (ref := running.get(urn)) is not None:
            return ref
        if urn.startswith(PATH_URN):
            path = urn[len(PATH_URN) :]
            return self._hosted.get(path) or self._parts.get(path)
        return ActorRegistry.get_by_urn(urn)

    # -- the actors of others ------------------------------------------------------------------------------------------

    def ask(
        self, where: Whereabouts, message: Any, reply: Reply[Any], chain: Chain, stamp: Stamp | None
    ) -> Callable[[], None]:
        """Send the message; `reply` is set later. Return what to call when nobody waits for the reply any more."""
        body = pickling.dumps_large(message, f"message to {where.target.name}", self._large_bytes)
        return self._call(
            where, reply, lambda number, line: Ask(number, where.target.urn, line.parcels.pack(body), chain, stamp)
        )

    def line_to(self, where: Whereabouts) -> Line | None:
        """Return the line to the actor's process, or None if there is no line yet."""
        return self._lines.get(self._locate(where))

    def lines(self) -> list[Line]:
        """Return the lines to other processes whose links are not lost. From any thread."""
        with self._lock:
            return list(self._lines.values())

    def has(self, line: Line) -> bool:
        """Return whether the line belongs to this hub and its link is not lost."""
        return self._lines.get(line.address) is line

    def ask_now(
        self,
        line: Line,
        where: Whereabouts,
        message: Any,
        reply: Reply[Any],
        chain: Chain,
        stamp: Stamp | None,
        timeout_s: float | None,
    ) -> bool:
        """Send the message by a connection of the calling thread alone, and wait until `reply` is set.

        Return False if this way is not open: no connection is free, earlier messages may still be in flight, or the
        actor has moved. No actor got the message then.

        Raises:
            TimeoutError: no reply came in time.
            NotSerializable: the message cannot be pickled, or is too long.
        """
        body = pickling.dumps_large(message, f"message to {where.target.name}", self._large_bytes)
        call = PendingCall(line.next_number(), reply, where)
        try:
            if isinstance(body, bytes):
                answer = line.ask(Ask(call.number, where.target.urn, body, chain, stamp), timeout_s)
            else:
                answer = line.ask(Ask(call.number, where.target.urn, b"", chain, stamp), timeout_s, body)
        except TimeoutError:
            raise
        except OSError as error:
            line.cut_off(call, error)
            return True
        if answer is None:
            return False
        if type(answer) is Dead and not answer.taken and self._address(where) not in ("", self.address, line.address):
            return False  # it has moved
        line.answer(call, answer)
        return True

    def tell(self, where: Whereabouts, message: Any, stamp: Stamp | None) -> None:
        """Send the message. If the actor ends before it arrives, the message is lost, and logged."""
        body = pickling.dumps_large(message, f"message to {where.target.name}", self._large_bytes)
        line = self._line(self._locate(where))
        line.put(Tell(where.target.urn, line.parcels.pack(body), stamp))

    def inquire(self, where: Whereabouts, what: str) -> Reply[Any]:
        """Ask the actor's process about the actor: "alive", "class" or "attributes", or for what is in ORDERS."""
        reply: Reply[Any] = Reply()  # without a target: the process replies, so the actor's own handler may wait for it
        self._call(where, reply, lambda number, _: Inquire(number, where.target.urn, what))
        return reply

    def halt(
        self, where: Whereabouts, reply: StopReply, reason: str, stamp: Stamp | None, *, final: bool
    ) -> Callable[[], None]:
        """Send the actor a stop; `reply` is set when the actor has ended."""
        address = self._locate(where)

        def ended() -> None:
            if where.path is None or self._has_own_process(where.path):
                where.ended_at = address

        reply.ended = ended
        return self._call(where, reply, lambda number, _: Halt(number, where.target.urn, reason, final, stamp))

    def watch(self, where: Whereabouts, fire: Callable[[str, str], None]) -> Callable[[], None]:
        """Call fire(reason, detail), as for a Down, once, when the actor has ended. Return what ends the watch.

        Where waiting is allowed, this waits until the actor's process confirms the watch: as long as for an answer, or
        WATCH_S if a signal has stopped it.
        """
        address = self._locate(where)
        pid = pid_of(address)
        if _is_gone(address):
            raise self.missing(where)
        reply: Reply[Over] = Reply()

        placed = Flag()
        confirmed = False

        def begun() -> None:
            nonlocal confirmed
            confirmed = True
            placed.set()

        def died(killed: bool | None, _error: BaseException | None = None) -> None:
            if killed is False:  # it ended before it could take the watch
                fire("noproc", str(self.missing(where)))
            else:
                fire("killed", f"its process ({pid}) ended without a word")

        def gone(has_gone: bool | None, _error: BaseException | None = None) -> None:
            if not has_gone:
                fire("noconnection", f"the link to its process at {address} is lost")
            elif confirmed:
                died(True)
            else:
                try:
                    self._dispatcher.workers.submit(self._was_killed, where, address, done=died, patient=True)
                except Unavailable:
                    died(True)

        def told() -> None:
            placed.set()
            try:
                over = reply.get()
            except Cut:
                if pid is None or self._closed:
                    gone(False)
                    return
                try:  # the sockets of a process close a moment before it is dead
                    self._dispatcher.workers.submit(lifeline.wait_gone, (pid,), CUT_S, done=gone, patient=True)
                except Unavailable:
                    gone(False)
            except Exception as error:
                fire("noproc", str(error))
            else:
                fire(over.reason, over.detail)

        line = self._line(address)
        number = line.next_number()
        reply.when_set(told)
        line.put(Watch(number, where.target.urn), PendingCall(number, reply, where, begun))
        if self._dispatcher.may_block():
            deadline = time.monotonic() + self.ask_timeout_s
            while not placed.wait(WATCH_S) and not paused(address) and time.monotonic() < deadline:
                pass
        return lambda: line.call_off(number)

    def _was_killed(self, where: Whereabouts, address: str) -> bool:
        """Return whether the actor's process was killed, when its supervisor has said how it ended.

        True if that cannot say it any more: its system has ended, or the actor was started again meanwhile.
        """
        while where.path is not None and not self._closed:
            entry = self._directory.actor(where.path)
            if entry is None or entry.address not in ("", address):
                break
            if not entry.address:
                return bool(entry.why) if entry.status is Presence.STARTING else entry.why.startswith("killed")
            top = self._directory.actor(_top(where.path))
            if top is None or _is_gone(top.address):
                break
            time.sleep(0.01)
        return True

    def pid(self, where: Whereabouts) -> int | None:
        """Return the id of the actor's process; None if the actor is not up, or the process is not known."""
        return pid_of(self._address(where))

    def paused(self, where: Whereabouts) -> str:
        """Return words, "; it is ...", for an error if a signal has stopped the actor's process; "" else."""
        why = paused(self._address(where))
        return why and f"; it is {why}"

    def kill(self, where: Whereabouts) -> bool:
        """Kill the actor's process (SIGKILL); return False if the actor is not up.

        Raises:
            UsageError: the actor has no process of its own.
        """
        if where.path is None or "/" not in where.path or not self._has_own_process(where.path):
            raise UsageError(
                f"{where.target.name} has no process of its own that could be killed: stop() it, or give its ChildSpec "
                "placement='process'"
            )
        pid = self.pid(where)
        if pid is None:
            return False
        return lifeline.signal_if(pid, signal.SIGKILL, lambda: self.pid(where) == pid)

    def kill_before_up(self, path: str, pid: int) -> bool:
        """Kill the process of a manager whose registrar is up, and who is not yet; return False if that is not so.

        Args:
            pid: the process that its supervisor has listed.
        """
        above = self._directory.actor(path.rpartition("/")[0])

        def is_meant() -> bool:
            entry = self._directory.lookup(registrar_key(path.rpartition("/")[2]))
            if entry is None or entry.status is not Presence.UP or pid_of(entry.address) != pid:
                return False
            return above is not None and above.address != entry.address  # else the process is its supervisor's

        return lifeline.signal_if(pid, signal.SIGKILL, is_meant)

    def _has_own_process(self, path: str) -> bool:
        mine = self._directory.actor(path)
        above = self._directory.actor(path.rpartition("/")[0])
        return mine is None or mine.status is not Presence.UP or above is None or above.address != mine.address

    def missing(self, where: Whereabouts) -> ActorDeadError | ActorUnavailable:
        """Return the error for an actor that was not found: dead or being respawned, by its entry in the directory."""
        name = where.target.name
        entry = None if where.path is None else self._directory.actor(where.path)
        if entry is None:
            return ActorDeadError(f"{name} not found: it has ended, or never was")
        match entry.status:
            case Presence.UP if entry.once:
                return ActorDeadError(f"{name} not found: it has ended, and is temporary: it is not started again")
            case Presence.UP:  # the supervisor has not handled its end yet, or is still stopping it
                return ActorUnavailable(
                    f"{name} is being started again, or is stopping; this reference works again if it comes back",
                    id=where.path,
                )
            case Presence.STARTING if where.path and (why := why_too_early(self._directory, where.path, "ask")):
                return ActorUnavailable(why, id=where.path)
            case Presence.STARTING if entry.turn and not entry.why:
                return ActorUnavailable(f"{name} is not up yet; this reference works when it is", id=where.path)
            case Presence.STARTING:
                return ActorUnavailable(
                    f"{name} is being started again; this reference works again when it is up", id=where.path
                )
            case _:
                return ActorDeadError(f"{name} not found: it is {entry.status.value}{entry.because}")

    def may_be_alive(self, where: Whereabouts) -> bool:
        """Return False if the directory says that the actor is not up, else True; its process is not asked."""
        return self._address(where) not in ("", self.address)

    def close(self) -> None:
        """Close all links of kind "actors"; open calls fail. On the loop."""
        self._closed = True
        steps = Steps()
        for line in self.lines():
            steps.take("closing a line", line.close)
        for link in list(self._visitors):
            steps.take("closing a visitor's link", link.close)
        steps.end("the way to actors of other processes: not closed altogether")

    def _call(self, where: Whereabouts, reply: Reply[Any], letter: Callable[[int, Line], Letter]) -> Callable[[], None]:
        line = self._line(self._locate(where))
        number = line.next_number()
        line.put(letter(number, line), PendingCall(number, reply, where))
        return lambda: line.give_up(number)

    def _address(self, where: Whereabouts) -> str:
        """Return the address of the actor's process; "" if the actor is not up."""
        address = where.address
        if where.path is not None:
            entry = self._directory.actor(where.path)
            address = entry.address if entry is not None and entry.status is Presence.UP else ""
        return "" if address == where.ended_at else address

    def _locate(self, where: Whereabouts) -> str:
        """Return the address of the actor's process, or raise the error for a missing actor."""
        address = self._address(where)
        if where.path is None and address not in self._lines and _is_gone(address):
            address = ""  # nobody starts its actors again
        if not address or address == self.address:  # an actor of this process would have been found before
            raise self.missing(where)
        return address

    def _line(self, address: str) -> Line:
        with self._lock:
            if self._closed:
                raise Unavailable("this process's system is stopping")
            line = self._lines.get(address)
            if line is None:
                hello = Hello(KIND, address, self.name, 0)
                line = Line(self._dispatcher, self._transport, hello, self.missing, self._forget)
                self._lines[address] = line
            return line

    def _forget(self, line: Line) -> None:
        with self._lock:
            if self._lines.get(line.address) is line:
                del self._lines[line.address]

    # -- for the actors of others --------------------------------------------------------------------------------------

    def accept(self, hello: Hello) -> tuple[Welcome, Attach]:
        """Accept a link of kind "actors", or the connection of a thread that asks; for the transport's owner."""
        if self._closed:
            raise Unavailable("this process's system is stopping")
        return Welcome(0), functools.partial(self._attach, Asker if hello.kind == ASKS else Visitor)

    def _attach(self, kind: type[Visitor], link: Link) -> Visitor:
        self._visitors.add(link)
        return kind(
            self.local, self._dispatcher, link, self._visitors.discard, self._transport.segments.parcels(link.pid)
        )


# The start order: what the on_start of an actor cannot wait for, as it starts only after that actor.


def why_too_early(directory: Directory, path: str, wait: str, starting: str = "") -> str:
    """Say why the actor at `path` cannot come before the on_start that runs this code returns; "" if it can.

    Args:
        wait: the verb for what on_start should do later: "load", "ask".
        starting: the path of the actor whose on_start waits for this code; "": for the on_start that runs it.
    """
    asker = starting or _starting()
    if not asker:
        return ""
    mine, theirs = asker.split("/"), path.split("/")
    same = next((at for at, parts in enumerate(zip(mine, theirs, strict=False)) if parts[0] != parts[1]), 0)
    if not same:  # in other trees, or one is above the other
        return ""
    now, due = (directory.lookup(actor_key("/".join(parts[: same + 1]))) for parts in (mine, theirs))
    if now is None or now.turn is not Turn.NOW or due is None or due.turn is not Turn.DUE:
        return ""
    above, first, later = "/".join(mine[:same]), theirs[same], mine[same]
    return (
        f"{path} starts after {asker}, whose on_start has not returned: put {first!r} before {later!r} in the "
        f"list of {above}, or {wait} after on_start, in a thread"
    )


def why_registrar_too_early(directory: Directory, name: str, wait: str, starting: str = "") -> str:
    """Say as why_too_early() why a manager, whose registrar has this name, cannot come before that on_start returns."""
    asker = starting or _starting()
    entry = directory.lookup(registrar_key(name)) if asker else None
    if entry is None or entry.status is not Presence.STARTING:
        return ""
    top = asker.partition("/")[0]
    paths = [path for path in directory.actor_paths(top) if path.endswith(f"/{name}")]
    return why_too_early(directory, paths[0], wait, asker) if len(paths) == 1 else ""


def _starting() -> str:
    asker = ask_cycles.starting()
    return "" if asker is None else asker.name


def _is_gone(address: str) -> bool:
    """Return whether the process at this address has ended."""
    pid = pid_of(address)
    return pid is not None and lifeline.wait_gone((pid,), 0.0)


_hubs: dict[str, ActorHub] = {}  # by the first part of the paths of their actors: one for each System of the process
_stopped: set[str] = set()  # the first parts of the paths of Systems that ran in this process and have stopped


def set_hub(hub: ActorHub) -> None:
    """Set the hub of this process for the tree of its name; references use it from then on."""
    _stopped.discard(_top(hub.name))
    _hubs.pop(_top(hub.name), None)  # the newest is last
    _hubs[_top(hub.name)] = hub


def remove_hub(hub: ActorHub) -> bool:
    """Remove the hub if it is still set; return whether it was."""
    if _hubs.get(_top(hub.name)) is not hub:
        return False
    del _hubs[_top(hub.name)]
    if hub.name == _top(hub.name):  # not the hub of a child, whose system may live on
        _stopped.add(hub.name)
    return True


def has_stopped(path: str | None) -> bool:
    """Return whether the System of `path` ran in this process and has stopped with all its actors."""
    return path is not None and _top(path) in _stopped


def hub(path: str | None = None) -> ActorHub | None:
    """Return this process's hub for the tree of `path`; the newest hub if there is no such tree here, or no path."""
    found = None if path is None else _hubs.get(_top(path))
    return found or next(reversed(_hubs.values()), None)


def is_debugged(path: str | None) -> bool:
    """Return whether the tree of `path` was started for debugging."""
    found = None if path is None else _hubs.get(_top(path))
    return found is not None and found.debug


def ask_timeout_s() -> float:
    """Return the time-out, in seconds, of an ask that has none of its own."""
    process = hub()
    return ASK_TIMEOUT_S if process is None else process.ask_timeout_s


def _top(path: str) -> str:
    return path.partition("/")[0]
