"""The type of a pickled value, read from its first bytes: nothing is unpickled, and no code of a user runs."""

from __future__ import annotations

import contextlib
import itertools
import pickletools
from collections.abc import Iterable, Iterator

_HEAD_BYTES = 4096
_MOST = 160  # opcodes that are read
_TUPLES = (b"\x85\x94.", b"\x86\x94.", b"\x87\x94.", b"t\x94.", b").")
_PLAIN = {
    "EMPTY_DICT": "dict",
    "EMPTY_LIST": "list",
    "EMPTY_SET": "set",
    "NONE": "None",
    "NEWTRUE": "bool",
    "NEWFALSE": "bool",
    "BININT": "int",
    "BININT1": "int",
    "BININT2": "int",
    "LONG1": "int",
    "BINFLOAT": "float",
    "BINBYTES": "bytes",
    "SHORT_BINBYTES": "bytes",
    "BYTEARRAY8": "bytearray",
    "BINUNICODE": "str",
    "SHORT_BINUNICODE": "str",
}
_CONTAINERS = ("EMPTY_DICT", "EMPTY_LIST", "EMPTY_SET")
_TEXTS = ("SHORT_BINUNICODE", "BINUNICODE")
_BY_VALUE = ("_own_or_made", "_make_skeleton_class")
"""The functions that make a class of `__main__` in another process. The class's name follows."""
_ENUM = "_make_skeleton_enum"
"""The function that makes an enum; its name is further down."""


def type_in(blob: bytes) -> str:
    """Return the name of the type of a value that pickling.dumps() has made bytes of; "" if they do not show it."""
    return _type_in(blob, blob[:_HEAD_BYTES]) or _type_in(blob, blob)  # the first opcode may be longer than the head


def _type_in(blob: bytes, head: bytes) -> str:
    ops = _opcodes(head)
    with contextlib.suppress(ValueError, StopIteration):  # the head ends within an opcode
        first, second = next(ops), next(ops)
        if first[0] in _CONTAINERS or (first[0] in _PLAIN and second[0] == "STOP"):
            return _PLAIN[first[0]]
        return "tuple" if blob.endswith(_TUPLES) else _class_in(itertools.chain((first, second), ops))
    return ""


def _opcodes(head: bytes) -> Iterator[tuple[str, object]]:
    for op, arg, _ in itertools.islice(pickletools.genops(head), _MOST):
        if op.name not in ("PROTO", "FRAME", "MEMOIZE"):
            yield op.name, arg


def _class_in(ops: Iterable[tuple[str, object]]) -> str:
    """Return the name of the class with which these opcodes begin.

    One that goes by value has its name between its metaclass and its bases.
    """
    pushed = list[object]()
    by_value = False
    for name, arg in ops:
        if name in _TEXTS or name == "BINGET":
            pushed.append(arg)
        elif name == "STACK_GLOBAL" and pushed[-1] == _ENUM:
            return "Enum"
        elif name == "STACK_GLOBAL" and not by_value:
            if (by_value := pushed[-1] in _BY_VALUE) is False:
                return str(pushed[-1])
            pushed.clear()
        elif name == "STACK_GLOBAL" and len(pushed) > 2 and isinstance(pushed[-3], str):
            return pushed[-3]
        elif name == "TUPLE1" and len(pushed) == 2 and isinstance(pushed[0], str):
            return pushed[0]
        else:
            pushed.clear()
    return ""
