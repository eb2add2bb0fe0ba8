"""RosBridge: the manager between nodes of ROS and the registrars of the system, the same for ROS 1 and ROS 2.

The bridge holds in its own registrar. Each hold is a resource of its own server `lease`, and what the node wants is its
part: so the catalog alone says who holds what, also after a crash. One thread does all: it hears what nodes ask and
what happens, has the HoldBook decide, and carries out. The thread that spins the node only passes on; no load waits in
it.
"""

from __future__ import annotations

import abc
import contextlib
import functools
import os
import queue
import threading
import time
from collections import defaultdict
from collections.abc import Callable, Sequence
from pathlib import Path
from types import TracebackType
from typing import Any, TypeVar

import msgspec

from rr_actors.actors.messaging.futures import Reply
from rr_actors.base.errors import RrError, UnknownQuery, UsageError, text_of
from rr_actors.base.reporting.log import Log
from rr_actors.base.values.canonical import json_of, shown_plain
from rr_actors.managers.planning.last_good import last_good_file
from rr_actors.managers.ros.hold_book import Action, Answer, Begin, Hold, HoldBook, Lease, Release, Say, Withdraw
from rr_actors.managers.ros.ros_config import (
    Exposed,
    Json,
    Switch,
    available_topic,
    check_exposed,
    hold_service,
    offered_by,
    parse_exposed,
    status_topic,
)
from rr_actors.managers.ros.ros_graph import DISCOVERY_S, Answered, RosGraph, check_free, own_name
from rr_actors.managers.ros.ros_messages import Key, Load, Renew, Unload, Verb, answer_text, error_table, key_in, parsed
from rr_actors.registrar.declarations import server
from rr_actors.registrar.manager import Manager
from rr_actors.registrar.model.rows import Phase, State
from rr_actors.registrar.queries import Query, Status, response_bytes
from rr_actors.registrar.servers.callback_context import current

logger = Log("rr_actors.managers.ros")

_LOOK_S = 0.5
_SOON_S = 0.1  # while a load waits for its owner to be in the graph
_CLASHES_S = 10.0  # between two looks for another node that offers the same names

K = TypeVar("K", Load, Unload, Renew)


class RosBridge(Manager):
    """What both versions' bridges do. A version's class joins its graph."""

    _rr_side_by_side = True
    _discovery_s = DISCOVERY_S

    def __init__(
        self, file: str | os.PathLike[str] | None = None, *, switches: Sequence[Switch] = (), json: Json | None = None
    ) -> None:
        """Take what is exposed from a TOML file, or as it is given.

        Raises:
            ConfigError: the file cannot be read, or it or an argument is wrong. `.file`, `.key`, `.expected`, `.got`
            UsageError: both a file and something else is given.
        """
        if file is None:
            self._exposed = Exposed(tuple(switches), json)
            check_exposed(self._exposed)
        elif switches or json is not None:
            raise UsageError(f"{type(self).__name__}: expected a file, or switches and json, got both")
        else:
            self._exposed = last_good_file(self._rr_beginning(), Path(file).absolute(), parse_exposed).now
        self._switches = {one.name: one for one in self._exposed.switch}
        self._events = queue.SimpleQueue[Callable[[], Sequence[Action]] | None]()
        self._thread: threading.Thread | None = None
        self._graph: RosGraph | None = None
        self._loads: dict[int, Reply[Query]] = {}
        self._clash = ""  # the one that is in the log
        self._causes: dict[Key, RrError] = {}  # of loads that have failed
        self._calls: dict[tuple[Verb, str], list[Answered]] = defaultdict(list)  # of switches, which wait for an answer
        self._statuses: dict[str, Callable[[str], object]] = {}
        self._available: dict[str, Callable[[bool], object]] = {}

    @abc.abstractmethod
    def _join(self, node: str) -> RosGraph:
        """Be a node of this name in the graph. If its thread ends by an error, this manager fails with that.

        Raises:
            MissingDependency: the libraries of ROS cannot be imported.
        """

    def on_start(self) -> None:
        """Join the graph, check that all names are free, and offer them. What was held before is held on.

        Raises:
            MissingDependency: the libraries of ROS cannot be imported.
            NameTaken: another node offers one of the names.
        """
        graph = self._graph = self._join(own_name(self.registrar.name, self.registrar.directory))
        try:
            time.sleep(self._discovery_s)
            check_free(graph, offered_by(self._exposed))
            json = self._exposed.json
            topic = f"{json.namespace}/load" if json is not None else "load"
            self._book = HoldBook(json, topic, self._lease_server)
            self._restore()
            for switch in self._exposed.switch:
                self._offer_switch(graph, switch)
            self._answer_json, self._say_json, self._show_servers = _nowhere, _nowhere, _nowhere
            if json is not None:
                self._offer_json(graph, json)
        except BaseException:
            graph.close()
            raise
        self._thread = threading.Thread(target=self._run, args=(graph,), name="ros bridge", daemon=True)
        self._thread.start()

    def on_stop(self) -> None:
        """Leave the graph. What is held is released with the manager, or held on if it is restarted."""
        self._events.put(None)
        if self._thread is not None:
            self._thread.join()
        if self._graph is not None:
            self._graph.close()

    def on_failure(
        self,
        exception_type: type[BaseException] | None,
        exception_value: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        """Leave the graph, so that the bridge that takes its place may join it. What is held is held on."""
        self.on_stop()

    # -- the server of the holds -------------------------------------------------------------------------------------

    @server("lease", recovery="keep")
    def load_lease(self, request: Lease) -> Any:
        """Load what a node wants, as the part of its lease."""
        try:
            return _plain_response(self.registrar.load(request.server, request.request, timeout_s=None))
        except RrError as error:
            if self._book.hold(request.key) is not None:
                self._causes[request.key] = error  # it knows more than the error of the lease
            raise

    @load_lease.status
    def lease_status(self, request: Lease, status: Status) -> None:
        """Pass a new response of the part on."""
        part = status.query
        if part is not None and status.state is State.UPDATE:
            self.registrar.update_response(current().resource_id, _plain_response(part), status.message)
            status.handled()

    # -- what is offered ---------------------------------------------------------------------------------------------

    def _offer_switch(self, graph: RosGraph, switch: Switch) -> None:
        name = switch.name
        self._statuses[name] = graph.publish(status_topic(name), latched=True)
        self._available[name] = graph.show(available_topic(name))
        hold = self._book.hold(("", name))
        self._available[name](_is_usable(hold))

        def called(data: bool, answered: Answered) -> None:
            self._tell(functools.partial(self._switched, switch, data, answered))

        graph.serve(hold_service(name), called)

    def _offer_json(self, graph: RosGraph, json: Json) -> None:
        self._answer_json = graph.publish(f"{json.namespace}/answers")
        self._say_json = graph.publish(f"{json.namespace}/status")
        self._show_servers = graph.publish(f"{json.namespace}/servers", latched=True)
        self._show_servers(json_of(self._servers(json)))
        self._hear(graph, json, "load", Load, self._load)
        self._hear(graph, json, "unload", Unload, self._book.unload)
        self._hear(graph, json, "renew", Renew, lambda asked: self._book.renew(asked, time.monotonic()))

    def _servers(self, json: Json) -> dict[str, object]:
        return {"allow": json.allow, "max_priority": json.max_priority, "switches": list(self._switches)}

    def _hear(
        self, graph: RosGraph, json: Json, verb: Verb, kind: type[K], handle: Callable[[K], Sequence[Action]]
    ) -> None:
        topic = f"{json.namespace}/{verb}"

        def asked(text: str) -> Sequence[Action]:
            try:
                message = parsed(topic, text, kind)
            except RrError as error:
                self._answer_json(answer_text(verb, key_in(text), error))
                return ()
            return handle(message)

        graph.hear(topic, lambda text: self._tell(functools.partial(asked, text)))

    # -- the thread --------------------------------------------------------------------------------------------------

    def _tell(self, event: Callable[[], Sequence[Action]]) -> None:
        """Have the thread call `event`, and carry out what it returns. From any thread."""
        self._events.put(event)

    def _run(self, graph: RosGraph) -> None:
        try:
            self._go_on(graph)
        except Exception as error:
            self._rr_failed(error)

    def _go_on(self, graph: RosGraph) -> None:
        look_at = clashes_at = time.monotonic()
        while True:
            now = time.monotonic()
            if now >= look_at:
                self._carry_out(self._book.tick(now, _present(graph)))
                look_at = now + _LOOK_S
            if now >= clashes_at:
                self._look_for_clashes(graph)
                clashes_at = now + _CLASHES_S
            if self._book.awaits:
                look_at = min(look_at, now + _SOON_S)
            try:
                event = self._events.get(timeout=max(0.0, look_at - time.monotonic()))
            except queue.Empty:
                continue
            if event is None:
                return
            self._carry_out(event())

    def _look_for_clashes(self, graph: RosGraph) -> None:
        """Log that another node has come that offers the same. It started at the same time, or is no bridge."""
        try:
            check_free(graph, offered_by(self._exposed))
        except RrError as error:
            clash = str(error)
            if clash != self._clash:
                logger.warning("%s: %s", self.registrar.name, clash)
            self._clash = clash
        else:
            self._clash = ""

    def _load(self, asked: Load) -> Sequence[Action]:
        graph = self._graph
        return self._book.load(asked, time.monotonic(), frozenset() if graph is None else _present(graph))

    def _switched(self, switch: Switch, data: bool, answered: Answered) -> Sequence[Action]:
        if data:
            self._calls["load", switch.name].append(answered)
            return self._book.switch_on(switch.name, switch.server, switch.request, switch.priority, time.monotonic())
        self._calls["unload", switch.name].append(answered)
        return self._book.switch_off(switch.name)

    def _carry_out(self, actions: Sequence[Action]) -> None:
        for action in actions:
            match action:
                case Begin():
                    self._begin_load(action)
                case Withdraw(number):
                    if (load := self._loads.get(number)) is not None:
                        load.cancel()  # if it has just ended, the book has it released
                case Release(number, query):
                    self._release(number, query)
                case Answer():
                    self._answer(action)
                case Say():
                    self._say(action)

    def _begin_load(self, action: Begin) -> None:
        number = action.number
        try:
            load = self.registrar.load(
                self._lease_server,
                action.lease,
                priority=action.lease.priority,
                timeout_s=None,
                on_status=functools.partial(self._heard, number),
                block=False,
            )
        except RrError as error:  # MailboxFull, say
            self._carry_out(self._book.failed(number, error))
            return
        assert isinstance(load, Reply)
        self._loads[number] = load
        load.add_done_callback(lambda done: self._tell(functools.partial(self._loaded, number, action.lease.key, done)))

    def _loaded(self, number: int, key: Key, load: Reply[Query]) -> Sequence[Action]:
        self._loads.pop(number, None)
        cause = self._causes.pop(key, None)
        if load.cancelled():
            return []
        try:
            query = load.take()
        except RrError as error:
            return self._book.failed(number, cause or error)
        return self._book.loaded(number, query.id, _plain_response(query), time.monotonic())

    def _release(self, number: int, query: str) -> None:
        def ended(done: Reply[None]) -> Sequence[Action]:
            try:
                done.take()
            except RrError as error:
                if not isinstance(error, UnknownQuery):
                    logger.warning("%s: query %s cannot be released: %s", self.registrar.name, query, text_of(error))
                return self._book.released(number, error, time.monotonic())
            return self._book.released(number, None, time.monotonic())

        try:
            release = self.registrar.unload(query, timeout_s=None, block=False)
        except RrError as error:
            self._carry_out(self._book.released(number, error, time.monotonic()))
            return
        assert isinstance(release, Reply)
        release.add_done_callback(lambda done: self._tell(functools.partial(ended, done)))

    def _restore(self) -> None:
        """Go on with what a process before this one has held or begun to load. Release what is exposed no more.

        The callback of an interrupted load runs again after on_start, if somebody wants its resource by then.
        """
        own = [
            query for query in self.registrar.queries() if query.server_id == self._lease_server and not query.parent
        ]
        for query in own:
            lease: Lease = query.request
            if not self._book.is_exposed(lease, self._switches):
                logger.warning("%s: %s is exposed no more, and is released", self.registrar.name, lease.__rr_title__())
                self._carry_out(self._book.owe(query.id))
                continue
            facts = query.id, _plain_response(query), str(query.state)
            number = self._book.restored(lease, *facts, time.monotonic())
            with contextlib.suppress(UnknownQuery):  # it has just gone
                query.on_status(functools.partial(self._heard, number))
        for info in self.registrar.resources():
            if info.server == "lease" and info.phase is Phase.LOADING:
                lease = info.request
                if self._book.is_exposed(lease, self._switches):
                    self._carry_out(self._book.interrupted(lease, time.monotonic()))

    @property
    def _lease_server(self) -> str:
        return f"{self.registrar.name}/lease"

    # -- what nodes hear ---------------------------------------------------------------------------------------------

    def _heard(self, number: int, status: Status) -> None:
        """Pass a status of a hold on to the thread."""
        query = status.query
        response = _plain_response(query) if query is not None and status.state is State.UPDATE else None
        facts = (str(status.state), status.message, status.source, status.reason, response)
        self._tell(lambda: self._book.heard(number, Say(("", ""), status.query_id, *facts)))

    def _answer(self, action: Answer) -> None:
        owner, id = action.key
        calls = self._calls.pop((action.verb, id), []) if not owner else []
        if not owner and id in self._switches:
            table = {"error": error_table(action.error)} if action.error is not None else {}
            text = json_of(table or {"query": action.query, "response": action.response})
            hold = self._book.hold(action.key)  # the node that is answered looks at it
            self._available[id](_is_usable(hold))
            for answered in calls:
                answered(action.error is None, text)
            return
        self._answer_json(answer_text(action.verb, action.key, action.error, action.query, action.response))

    def _say(self, action: Say) -> None:
        owner, id = action.key
        facts = msgspec.structs.asdict(action)
        del facts["key"]
        if action.response is None:
            del facts["response"]
        if owner:
            self._say_json(json_of({"id": id, "owner": owner, **facts}))
        elif id in self._statuses:
            self._statuses[id](json_of(facts))
            if action.state == "FATAL":
                self._available[id](False)


def _is_usable(hold: Hold | None) -> bool:
    return hold is not None and hold.phase == "held" and hold.state != "FATAL"


def _present(graph: RosGraph) -> frozenset[str]:
    """Return the nodes that may hold something: the bridge itself would never leave."""
    return graph.nodes() - {graph.node}


def _plain_response(query: Query) -> Any:
    """Return the newest response as plain values: its class may not be importable here."""
    return shown_plain(response_bytes(query))


def _nowhere(_text: str) -> None:
    """Publish nothing: there is no such topic."""
