"""Runs of callbacks: start them, limit them, count those that end the process, and check whether an end still matters.

A callback may end its process: a driver that segfaults, os._exit. So before each run the disk has it. The phase of the
row says it of a load and of a first unload, a CallbackRun of all else. The next process finds what was running when the
one before it died (`count_deaths`). It cannot know which of several runs has killed the process. Therefore a callback
in whose runs two processes have died runs alone among its like: its turn is its trial. A third death gives it up. A
trial that takes long does not hold up the others (TRIAL_S): one callback may wait for another.

A death that is blamed on callbacks does not count as a restart, until they are found innocent: all that ran have ended
in this process, and it lives. Then it counts after all (`acquit`), so a crash in which some callback happens to run is
never free.

A health callback runs again and again, so it may run at each crash without being its cause. After a death it waits for
some seconds (`health_waits_s`) before it runs in the next process. If that dies meanwhile, the callback is innocent.
"""

from __future__ import annotations

from hashlib import sha256

from msgspec.structs import replace

from rr_actors.registrar.model import failures
from rr_actors.registrar.model.catalog import Catalog, Decision
from rr_actors.registrar.model.commands import BeginTrial, CallbackOverdue, RefusalOver, TrialOver
from rr_actors.registrar.model.effects import Acquitted, SetTimer, StartCallback
from rr_actors.registrar.model.roles import BEGUN
from rr_actors.registrar.model.rows import LOADED, LOADING, UNLOADING, CallbackRun, Phase, Resource, State

ATTEMPTS = 3
"""How often a callback of a resource begins whose process dies each time."""

TRIAL_S = 5.0
"""How long one callback runs before the next one's trial begins."""

_HEALTH_WAITS_S = (1.0, 4.0)

_REFUSED_S = 5.0
_REFUSED_AT_MOST_S = 600.0

ROLES = tuple(name for name in BEGUN if name != "load")
"""The callbacks whose runs have rows of their own."""


def start_load(decision: Decision, resource: Resource) -> None:
    """Run the load callback; if the server is not registered (yet), the resource waits for it."""
    decision.forget(decision.catalog.early, resource.id)
    if resource.server in decision.catalog.servers:
        decision.cause(StartCallback("load", resource))
        limit_load(decision, resource)


def limit_load(decision: Decision, resource: Resource) -> None:
    """Set a timer for the end of the load callback's time, if the server limits its loads."""
    server = decision.catalog.servers.get(resource.server)
    if server is not None and server.load_timeout_s is not None:
        failure = failures.overdue(decision.catalog, resource, server.load_timeout_s)
        overdue = CallbackOverdue("load", resource.id, resource.attempt, failure)
        decision.cause(SetTimer("load:" + resource.id, server.load_timeout_s, overdue))


def end_limit(decision: Decision, resource: Resource) -> None:
    """Cancel the timer of the load callback, as that has ended."""
    server = decision.catalog.servers.get(resource.server)
    if server is not None and server.load_timeout_s is not None:
        decision.cause(SetTimer("load:" + resource.id, None, None))


def start_unload(decision: Decision, resource: Resource) -> None:
    """Run the unload callback, perhaps once more; if the server is not registered, the resource waits for it."""
    resource = replace(resource, phase=UNLOADING, tries=resource.tries + 1)
    decision.put(resource)
    if resource.server not in decision.catalog.servers:
        note_begun(decision, "unload", resource.id, begun=False)
        return
    if decision.catalog.callback_runs and run_id("unload", resource.id) in decision.catalog.callback_runs:
        note_begun(decision, "unload", resource.id)
    decision.cause(StartCallback("unload", resource))


def running(catalog: Catalog, resource_id: str, phase: Phase, run: int) -> Resource | None:
    """Return the resource if `run` is the present run of its callback in `phase`; else None."""
    resource = catalog.resources.get(resource_id)
    if resource is None or resource.phase is not phase:
        return None
    return resource if run == (resource.tries if phase is UNLOADING else resource.attempt) else None


def is_unwanted(catalog: Catalog, resource_id: str, phase: Phase, run: int) -> bool | None:
    """Return whether nobody needs a run of a load or recover callback any more; None if it has ended as it should."""
    resource = catalog.resources.get(resource_id)
    if resource is None or resource.attempt != run or resource.state is State.FATAL:
        return True
    if phase is LOADING and resource.phase is LOADING:
        return resource_id not in catalog.holders
    return False if phase is LOADED and resource_id in catalog.recovering else None


# -- runs that end the process -----------------------------------------------------------------------------------------


def run_id(role: str, resource_id: str) -> str:
    """Return the id of the row about the runs of a callback of a resource."""
    return f"{role}:{resource_id}"


def deaths_of(catalog: Catalog, role: str, resource_id: str) -> int:
    """Return how many processes in a row have died in runs of this callback."""
    runs = catalog.callback_runs
    if not runs or (run := runs.get(run_id(role, resource_id))) is None:
        return 0
    return run.deaths


def deaths_of_load(catalog: Catalog, resource: Resource) -> int:
    """Return how many processes have died in the attempts of this load, of which some may have ended cleanly."""
    run = catalog.callback_runs.get(run_id("load", resource.id))
    return resource.attempt - 1 if run is None else run.deaths


def is_given_up(catalog: Catalog, role: str, resource_id: str) -> bool:
    """Return whether the callback is not run any more for this resource."""
    return deaths_of(catalog, role, resource_id) >= ATTEMPTS


def awaits_trial(decision: Decision, role: str, resource_id: str) -> bool:
    """Return whether the callback may run only in its turn; BeginTrial says that it has come."""
    if deaths_of(decision.catalog, role, resource_id) != ATTEMPTS - 1:
        return False
    return not is_its_turn(decision, run_id(role, resource_id))


def is_its_turn(decision: Decision, id: str) -> bool:
    """Return whether the callback may run alone among its like now; else it does so later, in its turn."""
    catalog = decision.catalog
    if id in catalog.trial:
        return True
    if catalog.trial or catalog.suspects:
        decision.note(catalog.suspects, id, True)
        return False
    decision.note(catalog.trial, id, True)
    limit_trial(decision, id)
    return True


def limit_trial(decision: Decision, id: str) -> None:
    """Set a timer for TrialOver, as the callback on trial begins now."""
    decision.cause(SetTimer("trial", TRIAL_S, TrialOver(id)))


def end_trial(decision: Decision, id: str) -> None:
    """End the trial of this callback, if it is on trial, and begin the next one."""
    suspects = decision.catalog.suspects
    if not decision.forget(decision.catalog.trial, id):
        return
    decision.cause(SetTimer("trial", None, None))
    if suspects:
        following = next(iter(suspects))
        decision.forget(suspects, following)
        decision.note(decision.catalog.trial, following, True)
        decision.cause(SetTimer("turn", 0.0, BeginTrial(following)))


def note_begun(decision: Decision, role: str, resource_id: str, *, begun: bool = True) -> None:
    """Write that a run of the callback begins; with `begun` false, that the phase of the resource does not say so."""
    id = run_id(role, resource_id)
    run = decision.catalog.callback_runs.get(id, CallbackRun(id))
    if run.begun is not begun or id not in decision.catalog.callback_runs:
        decision.put(replace(run, begun=begun))


def note_ended(decision: Decision, role: str, resource_id: str) -> None:
    """Write that a run of the callback has ended: deaths in earlier runs do not count any more."""
    catalog = decision.catalog
    if catalog.accused:
        acquit(decision, run_id(role, resource_id))
    if catalog.callback_runs and (run := catalog.callback_runs.get(run_id(role, resource_id))) is not None:
        if run.deaths < ATTEMPTS:
            decision.drop(run)
        end_trial(decision, run.id)


def acquit(decision: Decision, id: str) -> None:
    """Note that a callback is innocent of the last process's death. If all are, that death counts as a restart."""
    accused = decision.catalog.accused
    if decision.forget(accused, id) and not accused:
        decision.cause(Acquitted())


def health_waits_s(deaths: int) -> float:
    """Return how long a health callback waits in whose runs so many processes have died."""
    return _HEALTH_WAITS_S[min(deaths, len(_HEALTH_WAITS_S)) - 1] if deaths else 0.0


def forget_runs(decision: Decision, resource_id: str) -> None:
    """Drop what is known of the runs of a resource's callbacks, as the resource goes."""
    catalog = decision.catalog
    decision.forget(catalog.statuses, resource_id)
    decision.forget(catalog.idle, resource_id)
    decision.forget(catalog.rising, resource_id)
    decision.forget(catalog.late, resource_id)
    decision.forget(catalog.unread, resource_id)
    for role in ("load", *ROLES) if catalog.accused else ():
        acquit(decision, run_id(role, resource_id))
    if catalog.callback_runs:
        for role in ("load", *ROLES):
            if (run := catalog.callback_runs.get(run_id(role, resource_id))) is not None:
                decision.drop(run)
                decision.forget(catalog.suspects, run.id)
                end_trial(decision, run.id)


# -- requests whose load was given up ----------------------------------------------------------------------------------
#
# A caller may ask again at once. Each time three processes would die. So the request is refused for a while.


def request_id(server: str, request: bytes) -> str:
    """Return the id of the row that says how often the load of this request was given up."""
    return f"request:{server}:{sha256(request).hexdigest()[:32]}"


def refused_for_s(rounds: int) -> float:
    """Return for how long a request is refused whose load was given up that often."""
    return min(_REFUSED_S * 2 ** min(rounds - 1, 16), _REFUSED_AT_MOST_S)


def refuse_for_a_while(decision: Decision, id: str) -> None:
    """Refuse the request from now on, until RefusalOver says that the time is over."""
    run = decision.catalog.callback_runs[id]
    decision.note(decision.catalog.refusing, id, True)
    decision.cause(SetTimer(id, refused_for_s(run.deaths), RefusalOver(id)))


def give_up_request(decision: Decision, resource: Resource) -> float:
    """Note that the load of this request is given up once more; return the seconds for which it is refused."""
    id = request_id(resource.server, resource.request)
    run = decision.catalog.callback_runs.get(id, CallbackRun(id))
    decision.put(replace(run, deaths=run.deaths + 1))
    return refused_for_s(run.deaths + 1)


def forget_request(decision: Decision, resource: Resource) -> None:
    """Forget that the load of this request was given up, as it has ended in another way."""
    run = decision.catalog.callback_runs.get(request_id(resource.server, resource.request))
    if run is not None:
        decision.drop(run)
        decision.forget(decision.catalog.refusing, run.id)
        decision.cause(SetTimer(run.id, None, None))


def refusal_over(decision: Decision, over: RefusalOver) -> None:
    """Take the request again; forget that it was given up if nobody asks for it in the same time once more."""
    run = decision.catalog.callback_runs.get(over.run_id)
    if run is None:
        return
    if decision.forget(decision.catalog.refusing, run.id):
        decision.cause(SetTimer(run.id, refused_for_s(run.deaths), RefusalOver(run.id)))
    else:
        decision.drop(run)


# -- what waits until on_start has returned ----------------------------------------------------------------------------

MOVE, LEAVE, RELOAD, REST = "move", "leave", "reload", "rest"
"""How a resource goes on when on_start has returned."""


def waits_for_start(decision: Decision, resource: Resource, what: str) -> bool:
    """Return whether on_start has not returned yet; the resource then goes on with `what` when it has."""
    if "" not in decision.catalog.early:
        return False
    if resource.id not in decision.catalog.early:
        decision.note(decision.catalog.early, resource.id, what)
    return True
