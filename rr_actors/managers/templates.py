"""Descriptions: read TOML files into typed values, and fill the templates in them with parameters."""

from __future__ import annotations

import re
import string
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar

import msgspec

from rr_actors.base.errors import ConfigError, shortened, shown
from rr_actors.base.toml import read_toml

T = TypeVar("T")
Parameter = str | int | float | bool
Parameters = Mapping[str, Parameter]

_EXPECTED = re.compile(r"Expected (?P<expected>.+?)(?:, got (?P<got>.+?))?(?: - at `\$\.?(?P<key>.*)`)?\Z")
_AT = re.compile(r"(?P<what>.+?)(?: - at `\$\.?(?P<key>.*)`)?\Z")


def read_description(path: str | Path, kind: type[T]) -> T:
    """Read a TOML file as a `kind`, a msgspec Struct.

    Raises:
        ConfigError: the file cannot be read or is not TOML, or a key is unknown, missing or of the wrong type. `.file`,
            `.key`, `.expected`, `.got`
    """
    file = str(path)
    data = read_toml(file)
    try:
        return msgspec.convert(data, kind)
    except msgspec.ValidationError as error:
        raise _config_error(file, str(error)) from error


def check_unique(path: Path, table: str, names: Sequence[str]) -> None:
    """Check that no two entries of `[[table]]` have the same name.

    Raises:
        ConfigError: two have; it names the second. `.file`, `.key`, `.expected`, `.got`
    """
    for i, name in enumerate(names):
        if name in names[:i]:
            key, expected = f"{table}[{i}].name", f"a name that no other {table} has"
            text = f"{path}: {key}: expected {expected}, got {shown(name)} again"
            raise ConfigError(text, file=str(path), key=key, expected=expected, got=name)


def fill(text: str, parameters: Parameters, where: str) -> str:
    """Replace each ``${name}`` by its parameter, and ``$$`` by a dollar sign.

    Raises:
        ConfigError: there is no such parameter, or a "$" begins no name. `.key` is `where`.
    """
    values = {name: plain(value) for name, value in parameters.items()}
    try:
        return string.Template(text).substitute(values)
    except KeyError as error:
        known = ", ".join(sorted(parameters)) or "none"
        text = f"{where}: expected parameters {known}, got ${{{shortened(error.args[0])}}} in {shown(text)}"
        raise ConfigError(text, key=where, expected=known, got=error.args[0]) from None
    except ValueError:
        text = f"{where}: expected ${{name}} or $$ after a dollar sign, got {shown(text)}"
        raise ConfigError(text, key=where, expected="${name} or $$", got=text) from None


def fill_all(parameters: Parameters, given: Parameters, where: str) -> dict[str, str]:
    """Fill the templates of `parameters` from `given`; return both, where `parameters` override `given`."""
    return {**{name: plain(value) for name, value in given.items()}} | {
        name: fill(plain(value), given, f"{where}.{name}") for name, value in parameters.items()
    }


def plain(value: Parameter) -> str:
    """Return a parameter as text; true and false as in TOML."""
    return str(value).lower() if isinstance(value, bool) else str(value)


def _config_error(file: str, message: str) -> ConfigError:
    """Translate a message of msgspec: "Expected `int`, got `str` - at `$.component[0].reliability`"."""
    expected = _EXPECTED.match(message)
    if expected is not None:
        found: dict[str, Any] = expected.groupdict()
        text = f"{file}: {found['key'] or 'the whole file'}: expected {found['expected']}"
        return ConfigError(text + (f", got {found['got']}" if found["got"] else ""), file=file, **found)
    other = _AT.match(message)
    key = (other and other["key"]) or None
    what = other["what"] if other else message
    return ConfigError(f"{file}: {key or 'the whole file'}: {what}", file=file, key=key, expected=what, got=None)
