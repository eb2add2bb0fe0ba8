"""Tables that an actor declares of its own: the command line, `top` and the web pages show them beside their own."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any, Literal, TypeVar, cast, get_args

import msgspec

from rr_actors.base.errors import InvalidSpec, shown
from rr_actors.base.names import check_name

Kind = Literal["text", "long", "number", "bar", "yes", "id", "problem"]
_F = TypeVar("_F", bound=Callable[..., Any])
_MARK = "__rr_table__"
_KINDS: tuple[str, ...] = get_args(Kind)


class TableColumn(msgspec.Struct, frozen=True):
    """A column of a table that an actor declares.

    Attributes:
        field: the field of the row that it shows. A list or a dict is shown as its parts.
        head: Default: the name of the field. Give one that people understand.
        kind: Default: "text". "long" is shortened where there is little room, "number" stands at the right, and "bar"
            draws a bar of a number with `of`. "yes" is yes or no, and "id" is shown by its end. "problem" is a text
            that says what is wrong, or "".
        of: the field of the whole that this number is a part of: "2 of 3". Default: none.
    """

    field: str
    head: str = ""
    kind: Kind = "text"
    of: str = ""

    @property
    def title(self) -> str:
        """What stands above it."""
        return self.head or self.field


class ActorTable(msgspec.Struct, frozen=True):
    """A table that an actor's class declares: its name, its columns, and the method that returns its rows."""

    name: str
    columns: tuple[TableColumn, ...]
    method: str


def table(name: str, *columns: TableColumn) -> Callable[[_F], _F]:
    """Declare a method of an actor or Manager as the source of a table::

        @rr.table("jobs", rr.TableColumn("name", "job"), rr.TableColumn("left", kind="number"))
        def jobs(self) -> list[Job]: ...

    `rr-actors plans`, the list of plans in `top` and the web page Plans show its rows. The method takes no arguments,
    and returns dataclasses, Structs or dicts of plain data. It is called as a message: so a look waits its turn.

    Args:
        name: what its rows are, in one word.
        columns: in the order in which they are shown. The first one that is no id is the name of the row.

    Raises:
        InvalidName: the name is none.
        InvalidSpec: there is no column, or a column has no field or another kind than those of TableColumn.
    """
    check_name(name, "table")
    if not columns:
        raise InvalidSpec(f"table {name}: expected at least one column, got none")
    for column in columns:
        if not isinstance(cast("object", column), TableColumn):
            raise InvalidSpec(f"table {name}: expected a TableColumn, got {shown(column)}")
        where = f"table {name}: column {shown(column.field)}"
        if column.kind not in _KINDS:
            raise InvalidSpec(f"{where}: kind: expected one of {', '.join(_KINDS)}, got {shown(column.kind)}")
        if not column.field or (column.kind == "bar" and not column.of):
            raise InvalidSpec(f"{where}: expected a field, and for a bar the field of the whole (of=), got none")

    def declared(method: _F) -> _F:
        setattr(method, _MARK, (name, columns))
        return method

    return declared


def tables_in(cls: type[Any]) -> Iterator[ActorTable]:
    """Yield the tables that an actor's class declares, those of its bases first."""
    names = dict.fromkeys(name for base in reversed(cls.__mro__) for name, one in vars(base).items() if _has(one))
    for method in names:
        if _has(found := getattr(cls, method)):  # a subclass may have another attribute of this name
            name, columns = getattr(found, _MARK)
            yield ActorTable(name, columns, method)


def _has(attribute: object) -> bool:
    return hasattr(attribute, "__code__") and hasattr(attribute, _MARK)
