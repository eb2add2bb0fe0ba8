"""World: some registrars, their links and disks, the callbacks they run and the people who use them.

A step is a tuple that says all that happens: which key of the Todo is done and with what outcome, or what somebody
does, or what breaks. `apply` performs it, or refuses it if it cannot happen now; nothing in here is random. Histories
are lists of steps: the same history, the same world.
"""

from __future__ import annotations

from typing import Any

from rr_actors.base.values.failure import Failure
from rr_actors.registrar.model import commands as c
from rr_actors.registrar.model.rows import Hold, State, is_revocation
from simulation.hosts import Hosted
from simulation.sim_process import Run, SimShell
from simulation.sim_registrar import Killed, SimRegistrar

Step = tuple[Any, ...]

RAISED = Failure("LoadFailed", "the callback raised")
STUCK = Failure("UnloadFailed", "the callback raised")


class World(Hosted):
    """Everything of one simulated run. Steps, besides those of the classes above: wake, save, register, timer, call."""

    def apply(self, step: Step) -> bool:
        """Perform a step; False: it cannot happen in this world now."""
        if self.stands_still(step):
            return False
        perform = _PERFORM[step[0]]
        if self.trace is not None:
            self.trace.append(describe(step))
        done = perform(self, *step[1:])
        if self.trace is not None and not done:
            self.trace.pop()
        return done

    def wake(self, name: str, count: int = 1_000_000, fault: str = "", effects: int = 0) -> bool:
        """A registrar handles what came in."""
        if ("wake", name) not in self.todo:
            return False
        registrar = self.registrars[name]
        if self.trace is not None:
            for item, sender in list(registrar.inbox)[:count]:
                self.note(f"{name} <- {sender or 'itself'}: {item!r}"[:220])
        try:
            registrar.wake(count, fault, effects)
            while name in self.hasty and registrar.inbox and not registrar.disk_is_full and not fault:
                registrar.wake(1_000_000, "", 0)
        except Killed:
            self.crash(name)
        return True

    def act(self, name: str) -> bool:
        """A registrar's loop does what a thread has decided."""
        if ("act", name) not in self.todo:
            return False
        self.registrars[name].act()
        return True

    def save(self, name: str) -> bool:
        """What was to be written later is written."""
        if ("save", name) not in self.todo or self.registrars[name].disk_is_full:
            return False
        self.registrars[name].save()
        return True

    def register(self, name: str, server: str) -> bool:
        """A server is registered."""
        key = ("register", name, server)
        if key not in self.todo:
            return False
        self.todo.discard(key)
        registrar = self.registrars[name]
        registrar.registered.add(server)
        registrar.post(c.Register(registrar.offers[server], self.new_event()))
        return True

    def timer(self, name: str, timer: str) -> bool:
        """A timer fires: whenever it likes, as correctness must not depend on it."""
        key = ("timer", name, timer)
        if key not in self.todo:
            return False
        self.todo.discard(key)
        registrar = self.registrars[name]
        if timer.startswith("revoke:"):
            self.ledger.forced.add(timer.removeprefix("revoke:"))
        registrar.post(registrar.timers.pop(timer))
        return True

    def catch_up(self, name: str, fault: str) -> None:
        """A registrar handles what came in before it goes on."""
        self.wake(name, fault=fault)

    def listen(self, name: str, query_id: str) -> bool:
        """Somebody listens to a part of a resource, and may deal with what it says."""
        registrar = self.registrars[name]
        held = registrar.catalog.held.get(query_id)
        if held is None or held.hold is not Hold.HELD or query_id in registrar.catalog.listened:
            return False
        registrar.catalog.listened.add(query_id)
        return True

    # -- callbacks -----------------------------------------------------------------------------------------------

    def call(self, name: str, kind: str, id: str, number: Any, how: str, *place: Any) -> bool:
        """A callback goes on: "sub" loads something, "ok" returns, "raise" raises, "tell" returns and tells so itself.

        A status callback that raises is one that has dealt with the status; "say": it says something of its resource.

        Args:
            place: of "sub", what it loads, and perhaps that its thread asks itself, and a priority; of "tell", the
                disk's fault then; of "say", the state.
        """
        key = ("call", name, kind, id, number)
        if key not in self.todo:
            return False
        registrar = self.registrars[name]
        run = registrar.runs[key]
        self.todo.discard(key)
        if how == "sub":
            run.subs += 1
            run.waits = f"{id}/{number}.{run.subs}"
            provider, server, request, *rest = place
            own = [priority for priority in rest if isinstance(priority, int)]
            ask = c.AskProvider(run.waits, provider, server, request, run.id, registrar.next_seq(), *own, own=bool(own))
            if not ("directly" in rest and self.ask_directly(registrar, ask, run)):
                registrar.ask(ask, run)
            return True
        if how == "say":
            event = self.new_event()
            self.ledger.said.add(event)
            registrar.post(c.SetStatus(id, event, State(place[0]), "", self.new_ticket(), id))
            self.todo.add(key)
            return True
        del registrar.runs[key]
        if how == "tell":
            return self._tell(registrar, self._outcome(registrar, run, ok=True, with_change=False), *place)
        registrar.post(self._outcome(registrar, run, ok=how != "raise", with_change=how == "change"))
        return True

    def _tell(self, registrar: SimRegistrar, done: c.Command, fault: str) -> bool:
        """The callback's own thread tells how it ended, if that is one of those that can."""
        told = False
        if isinstance(done, c.CallbackEnded) and done.role in ("load", "unload") and done.failure is None:
            try:
                told = registrar.tell(done, fault)
            except Killed:
                self.crash(registrar.name)
                return True
        if not told:
            registrar.post(done)
        return True

    def _outcome(self, registrar: SimShell, run: Run, *, ok: bool, with_change: bool) -> c.Command:
        name, ledger = registrar.name, self.ledger
        ledger.callback_ended(name, run.kind, run.id)
        place = run.id, run.number
        match run.kind:
            case "load":
                ledger.run_ended(name, run.id, "loaded" if ok else "gone")
                response = f"{run.id}:{run.number}".encode() if ok else None
                return c.CallbackEnded("load", *place, None if ok else RAISED, response)
            case "unload":
                ledger.run_ended(name, run.id, "gone" if ok else "unload_failed")
                return c.CallbackEnded("unload", *place, None if ok else STUCK)
            case "renew":
                ledger.run_ended(name, run.id, "renewed" if ok else "loaded")
                if not ok:
                    registrar.reloading.discard(run.id)
                return c.CallbackEnded("reload", *place, None if ok else STUCK, event=self.new_event())
            case "hear":
                ledger.dealt_with(*place)
                handled = bool(run.listener) and not ok
                if handled:
                    ledger.handled.add((run.listener, run.number))
                return c.Heard(*place, handled, run.notice is not None and is_revocation(run.notice))
            case "status":
                assert run.notice is not None
                ledger.own_heard.add(place)
                if not ok:
                    ledger.handled.add(place)
                return c.CallbackEnded("status", run.id, notice=run.notice, handled=not ok)
            case "pause":
                return c.CallbackEnded("pause", *place, None if ok else RAISED)
            case kind:
                event = self.new_event()
                changed = with_change or kind == "reload"
                if kind == "reload":
                    registrar.reloading.discard(run.id)
                response = f"{run.id}:{run.number}:{event}".encode() if ok and changed else None
                role = "resume" if kind == "resume" else "recover"
                return c.CallbackEnded(role, *place, None if ok else RAISED, response, event)


_STEPS = (
    *("wake", "act", "net", "dial", "save", "register", "serve", "up", "timer", "call", "load", "line", "tire", "rank"),
    *("unload", "join", "owe", "late", "own", "reregister", "crash", "retire", "cut", "snap", "part", "heal"),
    *("dup", "full", "space", "listen", "close", "closing", "delete", "generation"),
    *("tick", "round", "meet", "beat", "beaten", "lapse", "known", "fence", "freeze", "thaw", "stumble", "gap"),
)
_PERFORM: dict[str, Any] = {name: getattr(World, name) for name in _STEPS}


def describe(step: Step) -> str:
    """A step, for people."""
    return " ".join(part.decode() if isinstance(part, bytes) else str(part) for part in step)
