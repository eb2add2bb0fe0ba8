"""The protocol of the console: all messages that may come on its socket. A verb belongs to it by its declaration."""

from __future__ import annotations

import functools
from typing import Any, TypeVar, get_args

import msgspec

from rr_actors.system.console import console_commands, console_questions
from rr_actors.system.console import console_messages as c
from rr_actors.system.console.asking import actor_calls, table_questions
from rr_actors.system.console.attention import attention_questions
from rr_actors.system.console.console_view import Verb

_A = TypeVar("_A")


def answer_of(verb: type[Verb[_A]]) -> type[_A]:
    """Return the type of a verb's answer, which its base names: Verb[Children]."""
    return get_args(verb.__dict__["__orig_bases__"][0])[0]


def decoder_of(messages: tuple[type[c.Message], ...]) -> msgspec.msgpack.Decoder[c.Message]:
    """Return a decoder of these messages, of REQUESTS or of ANSWERS."""
    kinds: tuple[Any, ...] = messages
    return msgspec.msgpack.Decoder(functools.reduce(lambda one, other: one | other, kinds))


def _is_verb(kind: type) -> bool:
    """Return whether a class declares a verb, and is not only a base of verbs."""
    return issubclass(kind, Verb) and kind is not Verb and "_carry_out" in kind.__dict__


_DECLARED: list[Any] = [
    *vars(console_questions).values(),
    *vars(console_commands).values(),
    *vars(actor_calls).values(),
    *vars(attention_questions).values(),
    *vars(table_questions).values(),
]
_VERBS: list[type[Verb[c.Message]]] = [one for one in _DECLARED if isinstance(one, type) and _is_verb(one)]
REQUESTS = (c.Hello, c.Follow, c.BeginRecording, c.Keep, *_VERBS)
ANSWERS = (c.Welcome, c.Refused, c.Following, c.Events, c.Entries, c.Missed, *dict.fromkeys(map(answer_of, _VERBS)))
