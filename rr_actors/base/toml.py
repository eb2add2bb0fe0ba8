"""TOML: the one place that reads it. What the standard library lets through or fails at otherwise is an error here.

By way of msgspec, which imports the library's reader when the first file is read: most programs have none.
"""

from __future__ import annotations

from typing import Any, cast

import msgspec

_INTEGERS = range(-(2**63), 2**63)  # what TOML asks a reader to take


def parse_toml(data: bytes) -> dict[str, Any]:
    """Return what a TOML file holds.

    Raises:
        ValueError: it is not UTF-8 text or not TOML (saying at which line), is nested too deeply, or has a whole number
            that does not fit into 64 bits.
    """
    try:
        table = msgspec.toml.decode(data.decode())
        _check_integers(table)
    except UnicodeDecodeError as error:
        line = data[: error.start].count(b"\n") + 1
        raise ValueError(f"not UTF-8 text (at line {line})") from error
    except RecursionError as error:
        raise ValueError("nested too deeply") from error
    return table


def _check_integers(value: object) -> None:
    if isinstance(value, dict):
        for inner in cast("dict[str, object]", value).values():
            _check_integers(inner)
    elif isinstance(value, list):
        for inner in cast("list[object]", value):
            _check_integers(inner)
    elif isinstance(value, int) and value not in _INTEGERS:
        raise ValueError("a whole number that does not fit into 64 bits")
