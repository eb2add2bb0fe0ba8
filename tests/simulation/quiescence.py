"""Rest: everything that broke is mended, all work is finished, and the promises are checked.

Then everybody lets go of everything, and nothing may be left.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from rr_actors.registrar.core.callback_runs import is_given_up
from rr_actors.registrar.core.status_changes import is_busy
from rr_actors.registrar.model.catalog import Catalog
from rr_actors.registrar.model.rows import STANDBY, Content, Hold, Notice, Phase, Resource, ServedQuery, State, rows_of
from rr_actors.tools.inspection import Contents
from rr_actors.tools.inspection import check as inspect
from simulation.oracle import Violation
from simulation.pending_steps import Key
from simulation.sim_registrar import SimRegistrar
from simulation.world import World

_LIMIT = 20_000
_WAITS_FOREVER = frozenset(("tire", "late", "timer"))


def come_to_rest(world: World) -> None:
    """Mend everything, finish all work, check; connect anew and check again; let everything go and check that."""
    world.heal()
    world.mend_hosts()
    for registrar in world.live():
        world.space(registrar.name)
        if registrar.state not in ("away", "absent"):
            world.up(registrar.name)
    finish(world)
    take_turns(world)
    while away := [r.name for r in world.live() if r.state != "up"]:
        check_disks(world)  # some of them were closed only now
        for name in away:
            world.up(name)
        finish(world)
        take_turns(world)
    check_disks(world)
    check(world, links_are_new=False)
    cut_all(world)
    finish(world)
    check(world, links_are_new=True)
    let_go(world)
    check_nothing_is_left(world)


def finish(world: World) -> None:
    """Do all that is to be done, one after another; nothing fails any more, and nobody loses patience."""
    left = _LIMIT
    while True:
        keys = [key for key in world.todo.keys if _can(world, key)]
        if not keys:  # a callback on trial may wait for one whose trial comes after it
            keys = [key for key in world.todo.keys if key[0] == "timer" and key[2] == "trial"]
        if not keys and (keys := [key for key in world.todo.keys if key[0] == "timer" and key[2][:7] == "revoke:"]):
            check_revocations(world)
        if not keys:
            return
        for key in keys:
            if key in world.todo:
                world.apply((*key, "ok") if key[0] == "call" else key)
                left -= 1
        if left < 0:
            raise Violation("no rest", f"still busy after {_LIMIT} steps: {keys[:5]}")


def take_turns(world: World) -> None:
    """Whoever has an exclusive resource for which others wait releases it, until nobody waits."""
    for _ in range(_LIMIT):
        if not any(_ends(world, query, set()) for query in _in_the_way(world)):
            return
        finish(world)


def _in_the_way(world: World) -> list[ServedQuery]:
    """The queries on exclusive resources for which others wait."""
    found: list[ServedQuery] = []
    for registrar in world.live():
        catalog = registrar.catalog
        for key in catalog.queued:
            if registrar.state == "up" and (server := catalog.servers.get(key[0])) is not None and server.exclusive:
                found += [query for resource in catalog.used(key) for query in catalog.queries_of(resource.id)]
    return found


def _ends(world: World, query: ServedQuery, seen: set[str]) -> bool:
    """Have a person release this query, or what it is for. Return whether somebody has."""
    if query.id in seen:
        return False
    seen.add(query.id)
    if not query.parent:
        return world.apply(("unload", query.origin, query.id))
    origin = world.registrars[query.origin]
    wholes = origin.catalog.queries_of(query.parent)
    if not wholes and "linger:" + query.parent in origin.timers:
        return world.apply(("timer", origin.name, "linger:" + query.parent))
    return any(_ends(world, whole, seen) for whole in wholes)


def _can(world: World, key: Key) -> bool:
    if key[0] in _WAITS_FOREVER:
        return key[0] == "timer" and key[2] == "turn"  # it waits for nothing
    if key[0] == "up":
        return world.registrars[key[1]].state not in ("away", "absent")
    if key[0] == "closing":
        return world.closing_goes_on(key[1])
    if key[0] == "dial":
        here, there = world.registrars[key[1]], world.registrars[key[2]]
        if there.state in ("away", "absent"):
            final = key[2] not in here.gone and world.unreachable(key[2], asked=False) is not None
            return final or key[2] in here.asked or here.catalog.waits_for(key[2])
        return there.state in ("up", "gone") or (there.state == "starting" and key[1] == key[2])
    if key[0] == "fence":
        return world.registrars[key[1]].state == "up"
    if key[0] == "reregister":
        return key[2] not in world.registrars[key[1]].catalog.servers
    return True


def check_revocations(world: World) -> None:
    """What is revoked and still there waits for something else: a whole that is, too, or that cannot be unloaded."""
    for registrar in world.live():
        for id in registrar.catalog.revocations:
            if registrar.state == "up" and not any(_waits(world, query) for query in registrar.catalog.queries_of(id)):
                raise Violation("revocations", f"{registrar.name}: {id} is revoked, and nothing hinders its unload")


def _waits(world: World, query: ServedQuery) -> bool:
    consumer = world.registrars[query.origin]
    whole = consumer.catalog.resources.get(query.parent)
    if consumer.state != "up" or query.origin in world.retired | world.left:
        return True
    if whole is None:
        return False
    if is_busy(consumer.catalog, whole):  # its load waits for a second resource like this one
        return True
    return whole.id in consumer.catalog.revocations or whole.phase is Phase.UNLOAD_FAILED


def check_disks(world: World) -> None:
    """`rr-actors check` finds nothing."""
    for registrar in world.live():
        if registrar.state == "up":
            registrar.save()
    state = {r.name: Contents(r.name, Path(r.name), rows_of(r.disk)) for r in world.registrars.values()}
    absent = {r.name for r in world.live() if r.state in ("away", "absent")}
    refused = {id for id in world.ledger.refused & world.ledger.let_go if world.ledger.provider.get(id) in absent}
    unheard = world.unheard | refused  # a second unload has succeeded, and a crash of both took the answer
    found = [
        text
        for text in inspect(state)
        if not any(f" {name}" in text or text.startswith(name) for name in world.retired)
        and not any(f"held query {id} is unknown to its provider" in text for id in unheard)
    ]
    if found:
        raise Violation("check", found[0])


def cut_all(world: World) -> None:
    """Every link breaks once."""
    for registrar in world.live():
        for provider in list(registrar.clients):
            world.apply(("cut", registrar.name, provider, 0, 0))


# -- what must hold at rest ------------------------------------------------------------------------------------------


def check(world: World, *, links_are_new: bool) -> None:
    """Every promise that can be checked while things are held."""
    for registrar in world.live():
        _check_memory(registrar)
        _check_waiting(world, registrar, links_are_new=links_are_new)
        _check_forgotten(world, registrar, links_are_new=links_are_new)
        _check_resources(world, registrar)
        _check_held(world, registrar, links_are_new=links_are_new)
        _check_parts(world, registrar)
        _check_priorities(world, registrar)
    _check_answers(world)
    _check_statuses(world)


def _fail(kind: str, registrar: SimRegistrar, text: str) -> None:
    raise Violation(kind, f"{registrar.name}: {text}")


def _check_memory(registrar: SimRegistrar) -> None:
    """Memory, its indexes and the disk say the same."""
    catalog = registrar.catalog
    content: Content = {table: dict(rows) for table, rows in registrar.disk.items()}
    fresh = Catalog(registrar.name, content, registrar.epoch)
    for name in ("resources", "queries", "held", "notices", "peers", "callback_runs", "revocations", *INDEXES):
        if compared(getattr(catalog, name)) != compared(getattr(fresh, name)):
            _fail("memory", registrar, f"{name} is {getattr(catalog, name)}, from disk {getattr(fresh, name)}")


def _check_forgotten(world: World, registrar: SimRegistrar, *, links_are_new: bool) -> None:
    """What lives in memory alone is about what there still is: it does not grow with what was."""
    catalog = registrar.catalog
    for name, there in (
        ("kept", catalog.held),
        ("unanswered", catalog.queries),
        ("told", catalog.notices),
        ("behind", catalog.notices_on),
        ("up", registrar.clients),
        ("consumers", registrar.links),
        ("acked", {name: None for name in world.registrars if name not in world.retired or not links_are_new}),
    ):
        left = getattr(catalog, name).keys() - there.keys()
        if left:
            _fail("forgotten by nobody", registrar, f"{name} has what is no more: {sorted(left)}")


INDEXES = (
    *("by_request", "unloading", "queued", "lost", "by_server", "holders", "by_origin", "notices_to", "notices_on"),
    *("parts", "outbound", "unsettled", "moving", "resting", "own_notices", "ranked"),
)


def compared(index: dict[Any, Any]) -> dict[Any, Any]:
    """An index as it is compared: one id may be a tuple, or a dict that has had more."""
    return {key: dict.fromkeys(ids) if type(ids) is tuple else ids for key, ids in index.items()}


def _check_waiting(world: World, registrar: SimRegistrar, *, links_are_new: bool) -> None:
    catalog = registrar.catalog
    for name in (
        "waiting",
        "recovering",
        "closings",
        "owners",
        "leaving",
        "hearing",
        "deferred",
        "next_to_hear",
        "own_notices",
        "ending",
        "doubted",
        "direct",
        "fresh",
        "in_flight",
        "suspects",
        "trial",
        "statuses",
        "touched",
        "unsent",
    ):
        left = getattr(catalog, name)
        if left:
            _fail("stuck", registrar, f"at rest, and {name} is {left}")
    if registrar.effects or catalog.unfinished is not None:
        _fail("stuck", registrar, f"at rest, and to be done: {registrar.effects}, {catalog.unfinished}")
    if registrar.waiters or registrar.runs or registrar.inbox or registrar.held_back:
        waiting = (registrar.waiters, registrar.runs)
        _fail("stuck", registrar, f"at rest, and somebody waits: {waiting}")
    if asked := registrar.routes.links():
        _fail("stuck", registrar, f"at rest, and questions by the links of these are unanswered: {asked}")
    stuck = [id for id, name in world.letting.items() if name == registrar.name]
    if stuck:
        _fail("stuck", registrar, f"at rest, and unloads are unanswered: {stuck}")
    if catalog.notices and links_are_new:
        notices = [
            notice
            for notice in catalog.notices.values()
            if world.registrars[notice.origin].state != "gone" and not _is_released(world, catalog, notice)
        ]
        if notices:
            _fail("stuck", registrar, f"at rest, and notices are undelivered: {notices}")


def _check_idleness(world: World, registrar: SimRegistrar, resource: Resource) -> None:
    """Nothing is paused that is needed, and nothing that a server pauses idles without a timer."""
    catalog = registrar.catalog
    server = catalog.servers.get(resource.server)
    idles = catalog.priority_of(resource.id) <= STANDBY
    if server is None:
        return
    if resource.phase is Phase.PAUSED and not idles and resource.state is not State.FATAL:
        _fail("idle", registrar, f"{resource} is paused, and is needed")
    waits = ("linger:" + resource.id) in registrar.timers or resource.id in catalog.idle
    if server.pauses and idles and resource.phase is Phase.LOADED and resource.state is not State.FATAL and not waits:
        _fail("idle", registrar, f"{resource} idles, and will not be paused")


def _check_resources(world: World, registrar: SimRegistrar) -> None:
    catalog = registrar.catalog
    for resource in catalog.resources.values():
        if resource.phase not in (Phase.LOADED, Phase.UNLOAD_FAILED, Phase.PAUSED):
            _fail("stuck", registrar, f"at rest, and still {resource}")
        _check_idleness(world, registrar, resource)
        _check_reloaded(world, registrar, resource)
        warm = world.lingering(registrar, resource.id)
        if resource.phase is Phase.LOADED and resource.id not in catalog.holders and not warm:
            _fail("leak", registrar, f"nobody holds {resource}")
    for query in catalog.queries.values():
        if query.resource_id not in catalog.resources:
            _fail("dangling", registrar, f"{query} points to nothing")
        consumer = world.registrars.get(query.origin)
        if consumer is None or query.origin in world.retired:
            _fail("leak", registrar, f"{query} is held for one that is gone for good")
            continue
        held = consumer.catalog.held.get(query.id)
        if held is None:
            _fail("leak", registrar, f"{query}: {query.origin} does not know of it")
        elif (held.registrar, held.parent, held.attempt, held.seq) != (
            registrar.name,
            query.parent,
            query.attempt,
            query.seq,
        ):
            _fail("disagree", registrar, f"{query} is {held} for its origin")


def _check_reloaded(world: World, registrar: SimRegistrar, resource: Resource) -> None:
    """What was unloaded to be loaded again is loaded, unless that failed for good."""
    place = registrar.name, resource.id
    life = world.ledger.lives.get(place)
    given_up = resource.state is State.FATAL or place in world.ledger.given_up_reloads
    if life is not None and life.stage in ("renewing", "renewed") and not given_up:
        _fail("callbacks", registrar, f"{resource} is held, and its reload has not ended: {life}")


def _is_released(world: World, catalog: Catalog, notice: Notice) -> bool:
    """Return whether the notice goes with its query, once somebody clears the resource that is unloaded no more."""
    origin = world.registrars[notice.origin].catalog
    if notice.origin in world.left and notice.query_id not in catalog.queries and catalog.name not in origin.peers:
        return True  # it has closed over a link to a dead process; it hears this if it ever asks here again
    held = origin.held.get(notice.query_id)
    return held is not None and held.hold is Hold.OWED and is_given_up(catalog, "unload", notice.resource_id)


def _check_held(world: World, registrar: SimRegistrar, *, links_are_new: bool) -> None:
    catalog = registrar.catalog
    for held in catalog.held.values():
        provider = world.registrars[held.registrar]
        query = provider.catalog.queries.get(held.id)
        if held.hold is Hold.OWED:
            resource = provider.catalog.resources.get(query.resource_id) if query else None
            failed = resource if resource is not None and resource.phase is Phase.UNLOAD_FAILED else None
            # Over a new link the Unload is sent again, and the callback runs again, unless three processes died in it.
            if failed is None or (links_are_new and not is_given_up(provider.catalog, "unload", failed.id)):
                _fail("stuck", registrar, f"at rest, and a release is still owed: {held}")
            continue
        if held.hold is Hold.PENDING:
            _fail("stuck", registrar, f"at rest, and still {held}")
        if query is None or provider.state == "gone":
            _fail("disagree", registrar, f"{held}: its provider does not have it, or is gone for good")
            continue
        resource = provider.catalog.resources[query.resource_id]
        if held.resource_id != resource.id or held.response != (resource.response or b""):
            _fail("disagree", registrar, f"{held} is of {resource}")
        fate = world.ledger.fate.get(held.id)
        if not held.parent and fate in ("failed", "released"):
            _fail("known to nobody", registrar, f"{held} is held, whoever asked was told that it is {fate}")
        if held.parent:
            parent = catalog.resources.get(held.parent)
            if parent is None or parent.attempt != held.attempt:
                _fail("leak", registrar, f"{held} is held for {parent}")


def _check_parts(world: World, registrar: SimRegistrar) -> None:
    """A resource holds what its callback was given, each once."""
    catalog, ledger = registrar.catalog, world.ledger
    for resource in catalog.resources.values():
        given = set(ledger.parts.get((resource.id, resource.attempt), ())) - ledger.losses
        holds = set(catalog.parts_of(resource.id))
        lost = {id for id in given - holds if ledger.provider[id] in world.retired}
        lost |= (given - holds) & world.given_back
        if (resource.id, resource.attempt) in ledger.cut_short and _stays_as_it_is(resource):
            given |= holds  # what that had loaded goes with the resource
        lost |= (given - holds) & ledger.swapped
        lost |= {id for id in given - holds if (resource.id, ledger.on.get(id)) in ledger.given_up_parts}
        if holds & ledger.replaced:
            _fail("parts", registrar, f"{resource} holds {sorted(holds & ledger.replaced)}, which were replaced")
        if given - lost != holds - ledger.losses:
            _fail("parts", registrar, f"{resource} holds {sorted(holds)}, its callback was given {sorted(given)}")


def _check_priorities(world: World, registrar: SimRegistrar) -> None:
    """Both sides have the priority that was given, or else the highest of those who hold the whole."""
    for held in registrar.catalog.held.values():
        query = world.registrars[held.registrar].catalog.queries.get(held.id)
        if held.hold is not Hold.HELD or query is None:
            continue
        if query.priority != held.priority:
            _fail("priorities", registrar, f"{held} is {query} at its provider")
        wholes = [q.priority for q in registrar.catalog.queries.values() if q.resource_id == held.parent]
        inherited = min(max(wholes, default=STANDBY), registrar.catalog.max_priority)
        if held.parent in registrar.catalog.resources:
            inherited = registrar.catalog.inherited(held.parent)
        wished = [inherited if wish is None else wish for _, wish in world.ledger.wishes.get(held.id, [(0, 0)])]
        if held.priority not in wished:
            _fail("priorities", registrar, f"{held} was to have {wished}")


def _stays_as_it_is(resource: Resource) -> bool:
    """A crash has nothing run again for it."""
    return resource.state is State.FATAL or resource.phase is Phase.UNLOAD_FAILED


def _check_answers(world: World) -> None:
    """What was acknowledged is so."""
    ledger = world.ledger
    for query_id, fate in ledger.fate.items():
        if fate != "held" or "/" in query_id:
            continue
        holder = next((r for r in world.live() if query_id in r.catalog.held), None)
        gone = (
            query_id in ledger.losses | ledger.revoked | (ledger.evicted & ledger.forgotten)
            or ledger.provider[query_id] in world.retired
            or (query_id in ledger.forgotten and ledger.provider[query_id] in world.left)
            or (query_id in ledger.forgotten and query_id in world.hosts.lapsed)
        )
        if holder is None and not gone and world.asker[query_id] not in world.retired:
            raise Violation("acknowledged", f"{query_id}: its load was acknowledged, and it is held no more")


def _check_statuses(world: World) -> None:
    """Whoever holds a query has heard of all that was said about it."""
    ledger = world.ledger
    for registrar, part, resource_id, event, query_id in ledger.on_the_way:
        told = (event, query_id) in ledger.told or (resource_id, event) in ledger.handled
        held = world.registrars[registrar].catalog.held.get(part)
        if held.hold is Hold.OWED if held is not None else ledger.provider.get(part) in world.retired:
            continue  # it waited for a load that a crash cut short, and the next attempt does not have this part
        if not told and not ledger.let_go & {query_id, part} and registrar not in world.retired:
            raise Violation("statuses", f"{event} reached {resource_id}, and went no further up to {query_id}")
    for notice in ledger.noticed.values():
        if (notice.query_id, notice.event) in ledger.heard or notice.origin in world.retired:
            continue
        consumer = world.registrars[notice.origin]
        held = consumer.catalog.held.get(notice.query_id)
        if held is not None and held.hold is Hold.HELD and not notice.released:
            raise Violation("statuses", f"{notice.query_id} is held, and its holder never heard {notice}")
        if held is not None and held.resource_id != notice.resource_id:
            continue  # it was refused the first, and holds another
        acknowledged = ledger.fate.get(notice.query_id) == "held" and "/" not in notice.query_id
        if (
            notice.released
            and acknowledged
            and notice.query_id not in ledger.losses | ledger.forgotten | ledger.revoked
        ):
            raise Violation("statuses", f"{notice.query_id} was taken away, and its holder never heard {notice}")


# -- and when everything is let go -----------------------------------------------------------------------------------


def let_go(world: World) -> None:
    """Everybody unloads everything; what lingers is not kept warm any longer; owners unload what failed to be."""
    for registrar in world.live():
        for query_id in registrar.holds():
            world.apply(("unload", registrar.name, query_id))
    finish(world)
    levels = sum(len(registrar.catalog.resources) for registrar in world.live())
    for _ in range(8 + 2 * levels):  # what lingers may hold what lingers, and each is paused, then unloaded
        if not any(registrar.catalog.resources for registrar in world.live()):
            break
        for registrar in world.live():
            for timer in list(registrar.timers):
                world.apply(("timer", registrar.name, timer))
            for resource in list(registrar.catalog.resources.values()):
                if resource.phase is Phase.UNLOAD_FAILED:
                    world.apply(("own", registrar.name, "force", resource.id))
        finish(world)
    cut_all(world)
    finish(world)


def check_nothing_is_left(world: World) -> None:
    """No rows, no waiting, nothing alive outside."""
    for registrar in world.live():
        _check_memory(registrar)
        _check_waiting(world, registrar, links_are_new=True)
        _check_forgotten(world, registrar, links_are_new=True)
        catalog = registrar.catalog
        for name in ("resources", "queries", "held", "notices"):
            left = list(getattr(catalog, name).values())
            if name == "notices":
                left = [notice for notice in left if not _is_released(world, catalog, notice)]
            if left:
                _fail("left behind", registrar, f"everybody let go of everything, and there is {left[0]}")
        left = {id for (name, id) in world.ledger.lives if name == registrar.name}
        if left:
            _fail("left behind", registrar, f"everybody let go of everything, and loaded outside are {sorted(left)}")
