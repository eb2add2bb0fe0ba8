"""Parameters: values by flat names, "nav_goal::x", in the place of nested ones, and the types that UMRF knows."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from typing import Any, cast

from rr_actors.base.errors import did_you_mean
from rr_actors.managers.actions.graph_model import Parameter

SEPARATOR = "::"
_KINDS: dict[str, type | tuple[type, ...]] = {"string": str, "number": (int, float), "bool": bool}
_OTHER_WORDS = ("boolean", "booleans")  # types of which nothing is known, although they look like one of the known


def is_of_type(value: object, type_name: str) -> bool:
    """Return whether a value is of a UMRF type. Of types that it does not know, every value is."""
    if type_name.removesuffix("s") in _KINDS and type_name.endswith("s"):
        return isinstance(value, list) and all(is_of_type(item, type_name[:-1]) for item in cast("list[object]", value))
    kind = _KINDS.get(type_name)
    return kind is None or (isinstance(value, kind) and (kind is bool or not isinstance(value, bool)))


def known_types(type_name: str) -> bool:
    """Return whether this is a type whose values can be told apart."""
    return type_name in _KINDS or (type_name.endswith("s") and type_name[:-1] in _KINDS)


def likely_type(type_name: str) -> str:
    """Return "; did you mean 'string'?" for a misspelt type, else ""."""
    known = [*_KINDS, *(f"{kind}s" for kind in _KINDS)]
    return "" if type_name in _OTHER_WORDS or known_types(type_name) else did_you_mean(type_name, known)


def flat(values: Mapping[str, Any], leaves: Collection[str] = (), prefix: str = "") -> dict[str, Any]:
    """Return nested values by their flat names. A mapping whose name is one of `leaves` is a value itself."""
    found: dict[str, Any] = {}
    for key, value in values.items():
        name = prefix + key
        if isinstance(value, dict) and value and name not in leaves:
            found |= flat(cast("dict[str, Any]", value), leaves, name + SEPARATOR)
        else:
            found[name] = value
    return found


def nested(values: Mapping[str, Any]) -> dict[str, Any]:
    """Return the values of flat names, nested."""
    found: dict[str, Any] = {}
    for name, value in values.items():
        *above, last = name.split(SEPARATOR)
        place = found
        for key in above:
            place = place.setdefault(key, {})
        place[last] = value
    return found


def accepts(parameter: Parameter, value: object) -> bool:
    """Return whether an input may have this value."""
    return is_of_type(value, parameter.type) and (not parameter.allowed or value in parameter.allowed)
