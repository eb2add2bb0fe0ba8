"""The tables that actors declare: one question to the console, which asks each of these actors for its rows."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any, cast

from rr_actors.actors.actor_tables import ActorTable, tables_in
from rr_actors.actors.messaging.ask_cycles import asking_as
from rr_actors.actors.refs import Timeout
from rr_actors.base.errors import NotFound, RrError, Unavailable, UsageError, is_a, shown, text_of
from rr_actors.base.values.canonical import json_of, shown_plain
from rr_actors.system.console import console_messages as c
from rr_actors.system.console.asking.actor_calls import as_heard_outside, plain_bytes
from rr_actors.system.console.connected_registrars import Caller
from rr_actors.system.console.console_questions import Listing
from rr_actors.system.console.console_view import View, room_for
from rr_actors.system.snapshots import ask_each

_LOOK_S = 1.0


class ListTables(Listing[c.TablePage], frozen=True):
    """A page of the rows of the tables that actors declare: those with `match` in the row, the table or the path.

    Attributes:
        actor: only this actor's, by its path or id; "": those of all actors that run.
        table: only the tables of this name; "": all.
        timeout_s: how long each table may take. With `actor`, a table that is late is an error, else a note.
    """

    actor: c.Text = ""
    table: c.Text = ""
    timeout_s: c.Seconds = _LOOK_S

    def _carry_out(self, view: View, caller: Caller) -> c.TablePage:
        asker = view.connected.asking(caller, "")
        wanted = list(self._declared(view))

        def ask(one: tuple[str, ActorTable]) -> list[bytes] | RrError:
            path, table = one
            try:
                with asking_as(asker):
                    answer = getattr(view.system.ref(path).proxy(), table.method)().get(timeout=self.timeout_s)
                return _rows_of(answer, f"{path}: table {table.name}")
            except Timeout:
                return Unavailable(f"{path}: table {table.name}: no answer within {self.timeout_s:g} s")
            except Exception as error:
                return as_heard_outside(path, error)

        answers = ask_each(wanted, ask)
        notes: list[str] = []
        rows: list[c.TableRow] = []
        for number, ((path, table), answer) in enumerate(zip(wanted, answers, strict=True)):
            if not isinstance(answer, RrError):
                is_all = self.match in path or self.match in table.name
                rows += [c.TableRow(number, one) for one in answer if is_all or self.match in json_of(shown_plain(one))]
            elif self.actor:
                raise answer
            else:
                notes.append(text_of(answer))
        page = rows[self.offset : self.offset + self.limit]
        shown_tables = [c.ShownTable(path, table.name, table.columns) for path, table in wanted]
        return c.TablePage(len(rows), shown_tables, page[: room_for(page, notes)], notes)

    def _declared(self, view: View) -> Iterator[tuple[str, ActorTable]]:
        """Yield the tables that are asked for, each with the path of its actor."""
        if self.actor:
            tables = list(tables_in(view.system.ref(self.actor).actor_class))
            if self.table not in ("", *(known := tuple(table.name for table in tables))):
                has = f"it declares {', '.join(known) or 'none'}"
                raise NotFound(f"{self.actor}: no table {shown(self.table)}; {has}", id=self.table, known=known)
            paths = [(self.actor, table) for table in tables]
        else:
            paths = [(path, table) for path in _running(view) for table in _tables_at(view, path)]
        yield from (one for one in paths if self.table in ("", one[1].name))


def _running(view: View) -> list[str]:
    rows = view.children(limit=2**40).rows
    return [row.path for row in rows if row.type != "supervisor" and row.state == "running"]


def _tables_at(view: View, path: str) -> Sequence[ActorTable]:
    try:
        return list(tables_in(view.system.ref(path).actor_class))
    except RrError:  # it has just ended
        return ()


def _rows_of(answer: object, where: str) -> list[bytes]:
    """Return the rows as canonical bytes, each of a dict by the names of its fields.

    Raises:
        UsageError: the method has returned no list, or a row that is no dataclass, Struct or dict.
        NotSerializable: a row has a part that is no plain data.
    """
    if not is_a(answer, list) and not is_a(answer, tuple):
        raise UsageError(f"{where}: expected a list of rows, got {shown(answer)}")
    rows: list[bytes] = []
    for row in cast("Sequence[Any]", answer):
        raw = plain_bytes(row, where)
        if not is_a(shown_plain(raw), dict):
            raise UsageError(f"{where}: expected a dataclass, a Struct or a dict for each row, got {shown(row)}")
        rows.append(raw)
    return rows
