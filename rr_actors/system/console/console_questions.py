"""Questions of a console: the tree, the registrars, and what they have, each as a page."""

from __future__ import annotations

from collections.abc import Collection
from typing import Annotated, Any, ClassVar, TypeVar

import msgspec

from rr_actors.actors.mailbox_refs import MailboxRef
from rr_actors.base.errors import NotSerializable, UsageError, shown
from rr_actors.registrar.declarations import DeclaringClass
from rr_actors.registrar.pages import LOAD_ORDERS, RESOURCE_ORDERS, STREAM_ORDERS, RowPage, Wanted, What
from rr_actors.registrar.registrar import has_all_streams
from rr_actors.system.console import console_messages as c
from rr_actors.system.console.asking import actor_calls
from rr_actors.system.console.connected_registrars import Caller
from rr_actors.system.console.console_view import Look, Verb, View, room_for
from rr_actors.system.recording.event_memory import Event
from rr_actors.system.snapshots import ask_each

_A = TypeVar("_A")


class Listing(Look[_A], frozen=True):
    """A page of the rows that have the text `match` in them: at most `limit`, and as many as have room in an answer."""

    match: c.Text = ""
    offset: c.Offset = 0
    limit: c.Limit = c.PAGE_LIMIT


class ListRows(Listing[_A], frozen=True):
    """A page of the rows of one registrar, or of all. They are searched, sorted and cut where they are.

    `sort`: one of `orders`, which has the most first; "": as their registrars have them.
    """

    registrar: c.Text = ""
    sort: c.Text = ""
    orders: ClassVar[Collection[str]] = ()

    def _page(self, view: View, what: What, **more: Any) -> tuple[RowPage, list[str]]:
        if self.sort and self.sort not in self.orders:
            raise UsageError(f"sort: expected one of {', '.join(self.orders) or 'none'}, got {shown(self.sort)}")
        wanted = Wanted(what, self.match, self.offset, self.limit, self.sort, **more)
        return view.page(wanted, self.registrar)


class ListChildren(Listing[c.Children], frozen=True):
    """A page of the supervisor tree, each supervisor before its children: the rows with `match` in their paths."""

    def _carry_out(self, view: View, caller: Caller) -> c.Children:
        return view.children(self.match, self.offset, self.limit)


class ListRegistrars(Listing[c.Registrars], frozen=True):
    """A page of the registrars, by name: the rows with `match` in their names."""

    def _carry_out(self, view: View, caller: Caller) -> c.Registrars:
        names = [name for name in view.node.statuses() if self.match in name]
        wanted = names[self.offset : self.offset + self.limit]
        return c.Registrars(len(names), ask_each(wanted, view.described))


class ListResources(ListRows[c.Resources], frozen=True):
    """A page of the resources of one registrar, or of all: the rows with `match` in id, server, request or status.

    `states`, `holder`: only those in one of these states, and with a holder of this name.
    """

    states: Annotated[tuple[c.Text, ...], msgspec.Meta(max_length=50)] = ()
    holder: c.Text = ""
    orders = RESOURCE_ORDERS

    def _carry_out(self, view: View, caller: Caller) -> c.Resources:
        states = tuple(state.lower() for state in self.states)
        found, notes = self._page(view, "resources", states=states, holder=self.holder)
        return c.Resources(found.total, found.resources[: room_for(found.resources, notes)], notes)


class ListServers(Look[c.Servers], frozen=True):
    """The servers of all registrars: how many resources of each are in each state, and what these hold elsewhere."""

    def _carry_out(self, view: View, caller: Caller) -> c.Servers:
        found, notes = view.page(Wanted("servers"))
        return c.Servers(found.total, found.servers[: c.SERVERS_LIMIT], notes)


class ListHosts(Look[c.HostRows], frozen=True):
    """The other hosts that the system knows."""

    def _carry_out(self, view: View, caller: Caller) -> c.HostRows:
        if (hosts := view.node.info.hosts) is None:
            raise UsageError(f"system {view.node.info.name!r}: expected one with hosts=, it ends at this host")
        return c.HostRows(hosts.host, hosts.known(view.node.directory))


class ListLoads(ListRows[c.Loads], frozen=True):
    """A page of the loads that wait, of one registrar or of all, and how often and how long those of its servers did.

    With `match`: those with this text in ids, server or request, and the servers with it in their names. `sort` is the
    order of the servers.
    """

    orders = LOAD_ORDERS

    def _carry_out(self, view: View, caller: Caller) -> c.Loads:
        found, notes = self._page(view, "loads")
        said = found.said
        providers = dict.fromkeys(row.server.rpartition("/")[0] for row in found.queries if self.registrar)
        providers = [name for name in providers if "/" not in name]  # what another host's says stays there
        for reported in ask_each(providers, view.load_reports):
            said |= reported
        rows = [msgspec.structs.replace(row, said=said.get(row.id, "")) for row in found.queries]
        servers = sorted(found.loads, key=LOAD_ORDERS[self.sort], reverse=True) if self.sort else found.loads
        return c.Loads(found.total, rows, servers[: c.SERVERS_LIMIT], notes)


class ListUsages(ListRows[c.Usages], frozen=True):
    """A page of resources as ListResources finds them, with what each of them uses now."""

    orders = RESOURCE_ORDERS

    def _carry_out(self, view: View, caller: Caller) -> c.Usages:
        found, notes = self._page(view, "resources")
        usages, failures = view.usages([(row.server.partition("/")[0], row.id) for row in found.resources], notes)
        rows = [
            c.UsageRow(row.id, row.server, row.request, usages.get(row.id, {}), failures.get(row.id, ""), row.title)
            for row in found.resources
        ]
        return c.Usages(found.total, rows[: room_for(rows, notes)], notes)


class ListStreams(ListRows[c.Streams], frozen=True):
    """A page of the open streams of one registrar's resources, or of all: those with `match` in name or resource."""

    orders = STREAM_ORDERS

    def _carry_out(self, view: View, caller: Caller) -> c.Streams:
        found, notes = self._page(view, "streams")
        return c.Streams(found.total, found.streams[: room_for(found.streams, notes)], notes)


class ListQueries(ListRows[c.QueryPage], frozen=True):
    """A page of the queries that one registrar holds, or all: the rows with `match` in ids, server or request."""

    def _carry_out(self, view: View, caller: Caller) -> c.QueryPage:
        found, notes = self._page(view, "queries")
        return c.QueryPage(found.total, found.queries, notes)


class Find(Verb[c.Found], frozen=True):
    """The resources and queries of an id, of the beginning or end of an id, or of a resource's name."""

    id: c.Text
    registrar: c.Text = ""

    def _carry_out(self, view: View, caller: Caller) -> c.Found:
        return view.find(self.id, self.registrar)


class FindServer(Verb[c.ServerFound], frozen=True):
    """The server that a method of a Manager class declares, at the one child of the system that has the class."""

    owner: c.Text
    method: c.Text
    server: c.Text

    def _carry_out(self, view: View, caller: Caller) -> c.ServerFound:
        return c.ServerFound(DeclaringClass(self.owner, self.method, self.server).id_in(view.node.directory))


class HasAllStreams(Verb[c.AllStreams], frozen=True):
    """Whether nobody will open another stream for a connected program's query: the manager has run since the load.

    The program asks after it has looked at the streams that there are.
    """

    registrar: c.Text
    query_id: c.Text

    def _carry_out(self, view: View, caller: Caller) -> c.AllStreams:
        return c.AllStreams(has_all_streams(view.connected.named(self.registrar).registrar, self.query_id))


class ListMethods(Verb[c.Methods], frozen=True):
    """The methods of an actor that CallActor may call, by its path or id."""

    actor: c.Text

    def _carry_out(self, view: View, caller: Caller) -> c.Methods:
        return c.Methods(actor_calls.described(view.system.ref(self.actor).actor_class))


class ReadResponse(Verb[c.Response], frozen=True):
    """The whole response of the resource with this id."""

    id: c.Text
    registrar: c.Text

    def _carry_out(self, view: View, caller: Caller) -> c.Response:
        text = view.page(Wanted("response", self.id), self.registrar)[0].response
        if len(text.encode()) > c.RESPONSE_LIMIT_BYTES:
            raise NotSerializable(f"resource {self.id}: its response is longer than {c.RESPONSE_LIMIT_BYTES:,} bytes")
        return c.Response(text)


class ListHistory(Verb[c.Happenings], frozen=True):
    """The newest events of the child at a path and of all below it; with "", of all children."""

    path: c.Text = ""
    limit: c.Limit = 100

    def _carry_out(self, view: View, caller: Caller) -> c.Happenings:
        return _with_room(view.history(self.path)[-self.limit :])


class ListEvents(Verb[c.Happenings], frozen=True):
    """The newest events of children and resources that the system remembers, with the text `about` in them."""

    about: c.Text = ""
    limit: c.Limit = c.PAGE_LIMIT

    def _carry_out(self, view: View, caller: Caller) -> c.Happenings:
        return _with_room(view.memory.newest(self.limit, about=self.about))


def _with_room(events: list[Event]) -> c.Happenings:
    older = len(events) - room_for(events[::-1])
    return c.Happenings(events[older:], older)


class ListLog(Verb[c.ChildLog], frozen=True):
    """The newest log lines of a child, which its path or id names, with higher numbers than `after`."""

    child: c.Text
    after: c.Offset = 0
    limit: c.Limit = c.PAGE_LIMIT

    def _carry_out(self, view: View, caller: Caller) -> c.ChildLog:
        path, note = view.logging_child(self.child)
        lines = view.child_logs.lines(path, self.after)
        return c.ChildLog(path, len(lines), lines[-self.limit :], note)


class ListStacks(Verb[c.ChildStacks], frozen=True):
    """The stacks of all threads of the process of a child, which its path or id names."""

    child: c.Text
    limit_s: c.Seconds = 5.0

    def _carry_out(self, view: View, caller: Caller) -> c.ChildStacks:
        path = view.running_child(self.child)
        return c.ChildStacks(path, view.node.dispatcher.run(view.node.stacks.of(path, self.limit_s)))


class LookAtMailbox(Verb[c.MailboxSeen], frozen=True):
    """The mailbox of an actor, which its path or id names: a child, a supervisor, a registrar, a client or a server."""

    actor: c.Text

    def _carry_out(self, view: View, caller: Caller) -> c.MailboxSeen:
        return c.MailboxSeen(view.at_mailbox(self.actor, MailboxRef.look))


class ListDeadLetters(Verb[c.Letters], frozen=True):
    """The newest dead letters."""

    limit: c.Limit = 100

    def _carry_out(self, view: View, caller: Caller) -> c.Letters:
        letters = view.system.dead_letters()
        return c.Letters(letters.count, letters.letters[-self.limit :])


class ListFigures(Verb[c.Figures], frozen=True):
    """The figures of the system, as System.figures() returns them."""

    def _carry_out(self, view: View, caller: Caller) -> c.Figures:
        return c.Figures(view.system.figures())
