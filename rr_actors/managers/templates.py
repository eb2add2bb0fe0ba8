"""Templates: fill the templates in the texts of a description with parameters."""

from __future__ import annotations

import string
from collections.abc import Mapping, Sequence
from pathlib import Path

from rr_actors.base.errors import ConfigError, shortened, shown
from rr_actors.base.toml import raise_faults, wrong

Parameter = str | int | float | bool
Parameters = Mapping[str, Parameter]


def with_parameters(name: str, parameters: Parameters, instance: str = "") -> str:
    """Return the title of a request: "camera (device=/dev/video0; left)"."""
    given = ", ".join(f"{key}={plain(value)}" for key, value in parameters.items())
    said = "; ".join(filter(None, (given, instance)))
    return f"{name} ({said})" if said else name


def check_unique(path: Path, table: str, names: Sequence[str]) -> None:
    """Check that each entry of `[[table]]` has a name, and that no two have the same.

    Raises:
        ConfigError: the names of some are wrong. `.file`, `.key`, `.expected`, `.got`
    """
    faults: list[ConfigError] = []
    for i, name in enumerate(names):
        if not name or name in names[:i]:
            expected = f"a name that no other {table} has"
            said = f"{shown(name)} again" if name else None
            faults.append(wrong(str(path), f"{table}[{i}].name", expected, name, said=said))
    raise_faults(faults)


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
