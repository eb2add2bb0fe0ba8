"""The type of a pickled value, read from its first bytes: nothing is unpickled, and no code of a user runs.

The standard library's pickletools reads all of a pickle, and its import takes longer than that of this package's base.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Iterator

_MOST = 160  # opcodes that are read
_TUPLES = (b"\x85\x94.", b"\x86\x94.", b"\x87\x94.", b"t\x94.", b").")
_CONTAINERS = {b"}": "dict", b"]": "list", b"\x8f": "set"}
_VALUES = {
    b"N": "None",
    b"\x88": "bool",
    b"\x89": "bool",
    b"J": "int",
    b"K": "int",
    b"M": "int",
    b"\x8a": "int",
    b"G": "float",
    b"B": "bytes",
    b"C": "bytes",
    b"\x96": "bytearray",
    b"X": "str",
    b"\x8c": "str",
}
_TEXTS = (b"\x8c", b"X")
_MEMOIZE, _STACK_GLOBAL, _BINGET, _TUPLE1, _STOP = b"\x94", b"\x93", b"h", b"\x85", b"."
_SKIPPED = (b"\x80", b"\x95", _MEMOIZE)  # of these three only the length counts
_FIXED = {b"\x80": 1, b"\x95": 8, b"h": 1, b"j": 4, b"J": 4, b"K": 1, b"M": 2, b"G": 8}
"""How many bytes follow an opcode; none, if it is in neither table."""
_COUNTED = {b"\x8c": 1, b"X": 4, b"\x8a": 1, b"B": 4, b"C": 1, b"\x96": 8}
"""In how many bytes an opcode has the length of what follows."""
_BY_VALUE = ("_own_or_made", "_make_skeleton_class")
"""The functions that make a class of `__main__` in another process. The class's name follows."""
_ENUM = "_make_skeleton_enum"
"""The function that makes an enum; its name is further down."""


def type_in(blob: bytes) -> str:
    """Return the name of the type of a value that pickling.dumps() has made bytes of; "" if they do not show it."""
    ops = _opcodes(blob)
    first, second = next(ops, (b"", b"")), next(ops, (b"", b""))
    if first[0] in _CONTAINERS:
        return _CONTAINERS[first[0]]
    if first[0] in _VALUES and second[0] == _STOP:
        return _VALUES[first[0]]
    return "tuple" if blob.endswith(_TUPLES) else _class_in(itertools.chain((first, second), ops))


def _opcodes(blob: bytes) -> Iterator[tuple[bytes, bytes]]:
    """Yield the first opcodes, each with what follows it."""
    at = 0
    for _ in range(_MOST):
        op = blob[at : at + 1]
        at += 1
        end = at + _FIXED.get(op, 0)
        if op in _COUNTED:
            at += _COUNTED[op]
            end = at + int.from_bytes(blob[at - _COUNTED[op] : at], "little")
        if op not in _SKIPPED:
            yield op, blob[at:end]
        if not op or op == _STOP:
            return
        at = end


def _class_in(ops: Iterable[tuple[bytes, bytes]]) -> str:
    """Return the name of the class with which these opcodes begin.

    One that goes by value has its name between its metaclass and its bases.
    """
    pushed = list[str]()  # "" for what was pushed before
    by_value = False
    for op, argument in ops:
        if op in _TEXTS or op == _BINGET:
            pushed.append("" if op == _BINGET else argument.decode(errors="replace"))
        elif op == _STACK_GLOBAL and pushed and pushed[-1] == _ENUM:
            return "Enum"
        elif op == _STACK_GLOBAL and pushed and not by_value:
            if pushed[-1] not in _BY_VALUE:
                return pushed[-1]
            by_value, pushed = True, []
        elif (op == _STACK_GLOBAL and len(pushed) > 2 and pushed[-3]) or (
            op == _TUPLE1 and len(pushed) == 2 and pushed[0]
        ):
            return pushed[-3] if op == _STACK_GLOBAL else pushed[0]
        else:
            pushed = []
    return ""
