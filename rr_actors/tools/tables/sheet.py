"""Sheet: what is shown at once, and its words: those of its verb, of its key in `top`, and of its page."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from types import ModuleType


@dataclass(frozen=True)
class Sheet:
    """A table, or several that stand one below the other.

    Attributes:
        name: its name in `top`, and in the address of its page.
        verb, says, example: its verb, with the verb's help and an example.
        match: the help of the verb's argument MATCH.
        key: the key of `top` that shows it.
        module: imports and returns the module of its tables, which tables_of() asks for them.
        options: the options that the verb has beside those of all lists.
        in_verb: how many of the tables the verb shows.
        title: its title in `top` while no column sorts it; "": its name.
        note: what a reader of its page should know; "": it has no page, or one of another kind.
    """

    name: str
    verb: str
    says: str
    example: str
    match: str
    key: str
    module: Callable[[], ModuleType]
    options: tuple[str, ...] = ("registrar",)
    in_verb: int = 2
    title: str = ""
    note: str = ""
