"""Matching: which alternatives a choice allows, and which of these it prefers. Without IO.

What a choice says is compared with all alternatives of its kind first. So a name or a comparison that can never match
is an error that says so, and not a choice for which there is nothing.
"""

from __future__ import annotations

import math
import operator
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

import msgspec

from rr_actors.base.checks import RELIABILITY, is_number
from rr_actors.base.errors import ConfigError, did_you_mean, shown
from rr_actors.base.toml import wrong
from rr_actors.managers.choices.alternatives import Alternative
from rr_actors.managers.templates import Parameter, plain

_OPERATORS: dict[str, Callable[[Any, Any], bool]] = {
    ">=": operator.ge,
    "<=": operator.le,
    "==": operator.eq,
    "!=": operator.ne,
    ">": operator.gt,
    "<": operator.lt,
}
_COMPARISON = re.compile(r"\s*(>=|<=|==|!=|>|<)\s*([^\s<>=!].*?)\s*\Z", re.DOTALL)
_EXPECTED = "a value, or a comparison such as '>=10', '<3', '==roof' or '!=roof'"

Provided = Mapping[str, Parameter]
Trust = Callable[[Alternative], float]
"""Returns the reliability of an alternative now, from 0 to 1."""


class Comparison(msgspec.Struct, frozen=True):
    """An operator and its right side: as text, and as a number if it is one."""

    operator: str
    text: str
    number: float | None

    def holds(self, value: Parameter | None) -> bool:
        """Return whether a provided value is as asked. What is not provided, or of another type, is not."""
        if value is None or not self.fits(value):
            return False
        if isinstance(value, (str, bool)):
            return _OPERATORS[self.operator](plain(value), self.text)
        return _OPERATORS[self.operator](value, self.number)

    def fits(self, value: Parameter) -> bool:
        """Return whether the value can be compared at all: numbers with numbers, texts with == and !=."""
        if isinstance(value, (str, bool)):
            return self.operator in ("==", "!=")
        return self.number is not None

    def __str__(self) -> str:
        return f"{self.operator}{self.text}"


def parse_comparison(path: str, given: Parameter) -> Comparison:
    """Read the right side of `where`; a value alone means that it is to be equal.

    Raises:
        ConfigError: it is no comparison. `.key`, `.expected`, `.got`
    """
    if not isinstance(given, str):
        number = given if is_number(given) else None
        if number is None and not isinstance(given, bool):
            raise _wrong(path, _EXPECTED, given)
        return Comparison("==", plain(given), number)
    found = _COMPARISON.match(given)
    if found is None and (not given.strip() or given.lstrip()[0] in "<>=!"):
        raise _wrong(path, _EXPECTED, given)
    sign, text = found.groups() if found else ("==", given)
    number = _number(text)
    if number is None and sign not in ("==", "!="):
        raise _wrong(path, f"a number after {sign}", given)
    return Comparison(sign, text, number)


def _number(text: str) -> float | None:
    try:
        number = float(text)
    except ValueError:
        return None
    return number if math.isfinite(number) else None


def ranked(
    alternatives: Iterable[Alternative], kind: str, where: Provided, prefer: Sequence[str], trust: Trust
) -> list[Alternative]:
    """Return the alternatives that a choice allows, the best first; of equal ones the first that was given.

    An alternative that does not provide what is preferred comes after those that do.

    Raises:
        ConfigError: there is no such kind, a name is unknown, or a comparison is none. `.key`, `.expected`, `.got`
    """
    of_kind = _of_kind(alternatives, kind)
    provided = {one.key: provided_now(one, trust) for one in of_kind}
    comparisons = _comparisons(where, provided.values())
    _check_preferred(prefer, provided.values())

    def place(one: Alternative) -> list[tuple[bool, float]]:
        return [_place(provided[one.key], name) for name in prefer]

    allowed = [one for one in of_kind if not _against(provided[one.key], comparisons)]
    return sorted(allowed, key=place)


def why_none(alternatives: Iterable[Alternative], kind: str, where: Provided, trust: Trust) -> str:
    """Return, for a choice that no alternative fits, what each of its kind has against it."""
    of_kind = _of_kind(alternatives, kind)
    provided = {one.key: provided_now(one, trust) for one in of_kind}
    comparisons = _comparisons(where, provided.values())
    return "\n".join(f"{one.key}: {', '.join(_against(provided[one.key], comparisons))}" for one in of_kind)


def provided_now(one: Alternative, trust: Trust) -> dict[str, Parameter]:
    """Return what an alternative provides, with its reliability as it is now."""
    return {**one.provides, RELIABILITY: trust(one)}


def _of_kind(alternatives: Iterable[Alternative], kind: str) -> list[Alternative]:
    every = list(alternatives)
    found = [one for one in every if one.kind == kind]
    if not found:
        known = sorted({one.kind for one in every})
        expected = f"one of {', '.join(known) or 'none'}"
        raise _wrong("kind", expected, kind, f"{shown(kind)}, which nothing provides{did_you_mean(kind, known)}")
    return found


def _comparisons(where: Provided, provided: Iterable[Provided]) -> dict[str, Comparison]:
    """Read `where`, and check that at least one alternative can be compared by each of its names."""
    rows = list(provided)
    comparisons: dict[str, Comparison] = {}
    for name, given in where.items():
        path = f"where.{name}"
        comparison = comparisons[name] = parse_comparison(path, given)
        values = [row[name] for row in rows if name in row]
        if not values:
            raise _unknown(path, name, rows)
        if not any(comparison.fits(value) for value in values):
            texts = isinstance(values[0], (str, bool))
            expected = (
                "== or !=, as the alternatives provide no number" if texts else "a number, or a comparison with one"
            )
            raise _wrong(path, expected, given)
    return comparisons


def _check_preferred(prefer: Sequence[str], provided: Iterable[Provided]) -> None:
    rows = list(provided)
    for i, given in enumerate(prefer):
        name, path = given.removeprefix("-"), f"prefer[{i}]"
        values = [row[name] for row in rows if name in row]
        if not values:
            raise _unknown(path, name, rows)
        texts = [value for value in values if isinstance(value, str)]
        if texts:
            raise _wrong(path, "the name of a number", given, f"{shown(name)}, which is {shown(texts[0])} for one")


def _unknown(path: str, name: str, rows: Sequence[Provided]) -> ConfigError:
    known = sorted({name for row in rows for name in row})
    said = f"{shown(name)}, which no alternative provides{did_you_mean(name, known)}"
    return _wrong(path, f"one of {', '.join(known)}", name, said)


def _against(provided: Provided, comparisons: Mapping[str, Comparison]) -> list[str]:
    """Return what speaks against an alternative: each comparison that does not hold, with what is provided."""
    return [
        f"{name} is {shown(provided[name]) if name in provided else 'not provided'}, expected {comparison}"
        for name, comparison in comparisons.items()
        if not comparison.holds(provided.get(name))
    ]


def _place(provided: Provided, preferred: str) -> tuple[bool, float]:
    name = preferred.removeprefix("-")
    value = provided.get(name)
    if value is None or isinstance(value, str):
        return True, 0.0
    return False, float(value) if preferred.startswith("-") else -float(value)


def _wrong(path: str, expected: str, got: object, said: str | None = None) -> ConfigError:
    return wrong(None, path, expected, got, where="Choose", said=said)
