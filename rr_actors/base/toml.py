"""TOML: the one place that reads it. What the standard library lets through or fails at otherwise is a ConfigError.

By way of msgspec, which imports the library's reader when the first file is read: most programs have none.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, cast

import msgspec

from rr_actors.base.errors import ConfigError

_INTEGERS = range(-(2**63), 2**63)  # what TOML asks a reader to take


def read_toml(file: str) -> dict[str, Any]:
    """Return what the TOML file at this path holds.

    Raises:
        ConfigError: it cannot be read; and as parse_toml(). `.file`, `.expected`, `.got`
    """
    try:
        data = Path(file).read_bytes()
    except (OSError, ValueError) as error:  # ValueError: no file has such a name
        problem = getattr(error, "strerror", None) or str(error)
        raise ConfigError(
            f"{file}: cannot be read: {problem}; expected a TOML file",
            file=file,
            key=None,
            expected="a TOML file",
            got=problem,
        ) from error
    return parse_toml(data, file)


def parse_toml(data: bytes, file: str) -> dict[str, Any]:
    """Return what the content of a TOML file called `file` says.

    Raises:
        ConfigError: it is not UTF-8 text or not TOML (saying at which line), is nested too deeply, or has a whole
            number that does not fit into 64 bits. `.file`, `.expected`, `.got`
    """
    try:
        return _parsed(data)
    except ValueError as error:
        lines = len(data.splitlines()) or 1
        problem = str(error).replace("(at end of document)", f"(at line {lines}, end of the file)")
        raise ConfigError(
            f"{file}: not valid TOML: {problem}", file=file, key=None, expected="valid TOML", got=problem
        ) from error


def _parsed(data: bytes) -> dict[str, Any]:
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
