"""TOML: the one place that reads it. Every fault is a ConfigError, also a fault that the standard library accepts.

The errors for wrong keys and values are made here, too, for files and for arguments.

msgspec imports the standard library's reader when the first file is read: most programs read none.
"""

from __future__ import annotations

from collections.abc import Collection
from pathlib import Path
from typing import Any, cast

import msgspec

from rr_actors.base.checks import path_text
from rr_actors.base.errors import ConfigError, did_you_mean, shortened, shown

_INTEGERS = range(-(2**63), 2**63)  # the range that TOML requires of a reader


def wrong(
    file: str | None, key: str, expected: str, got: object, *, where: str = "from_toml", said: str | None = None
) -> ConfigError:
    """Return the error for the value of a key in the file, or, without a file, in the arguments of `where`.

    An empty key means the whole file. The text shows `said`, or else the value and its type.
    """
    if said is None:
        said = shown(got) if got is None else f"{shown(got)} ({type(got).__name__})"
    place = ": ".join(filter(None, (file or where, shortened(key))))
    return ConfigError(f"{place}: expected {expected}, got {said}", file=file, key=key, expected=expected, got=got)


def check_keys(table: Collection[str], known: Collection[str], file: str, prefix: str = "") -> None:
    """Check that each key of the table at `prefix` ("registrars.cameras.") is known.

    The text of the ConfigError has a similar known key.
    """
    for key in table:
        if key not in known:
            said = f"an unknown key{did_you_mean(key, known)}"
            raise wrong(file, prefix + key, f"one of {', '.join(known)}", key, said=said)


def file_name(path: object) -> str:
    """Return the path of a TOML file as text; raise ConfigError if `path` is no path."""
    text = path_text(path)
    if text == "":
        raise wrong(None, "path", "the path of a TOML file", path)
    return text


def read_toml(file: str) -> dict[str, Any]:
    """Return the content of the TOML file at this path; raise ConfigError if it cannot be read, or parsed."""
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
    """Decode the bytes of a TOML file called `file`.

    Raise ConfigError if they are not UTF-8 text or not TOML (the error has the line), are nested too deeply, or have a
    whole number that does not fit into 64 bits.
    """
    try:
        table = msgspec.toml.decode(data.decode())
        _check_integers(table)
        return table
    except (ValueError, RecursionError) as error:
        lines = len(data.splitlines()) or 1
        problem = str(error).replace("(at end of document)", f"(at line {lines}, end of the file)")
        if isinstance(error, RecursionError):
            problem = "nested too deeply"
        elif isinstance(error, UnicodeDecodeError):
            line = data[: error.start].count(b"\n") + 1
            problem = f"not UTF-8 text (at line {line})"
        raise ConfigError(
            f"{file}: not valid TOML: {problem}", file=file, key=None, expected="valid TOML", got=problem
        ) from error


def _check_integers(value: object) -> None:
    if isinstance(value, dict):
        for inner in cast("dict[str, object]", value).values():
            _check_integers(inner)
    elif isinstance(value, list):
        for inner in cast("list[object]", value):
            _check_integers(inner)
    elif isinstance(value, int) and value not in _INTEGERS:
        raise ValueError("a whole number that does not fit into 64 bits")
