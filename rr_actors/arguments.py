"""Arguments: what people hand to a registrar's methods, checked, and as its actor understands it."""

from __future__ import annotations

import functools

from rr_actors.errors import UsageError
from rr_actors.names import ServerId, parse_server_id
from rr_actors.queries import Query, ResourceInfo

_LONGEST_S = 2_000_000  # 23 days

_parse = functools.lru_cache(1024)(parse_server_id)


def parse_server(server: object) -> ServerId:
    """The two names in "registrar/server".

    Raises:
        InvalidName: it is not of that form.
    """
    return _parse(server) if isinstance(server, str) else parse_server_id(server)


def check_callback(on_status: object) -> None:
    """That a load's `on_status`, if there is one, can be called.

    Raises:
        UsageError: it cannot.
    """
    if on_status is not None and not callable(on_status):
        raise UsageError(f"load: on_status: expected a callable, got {type(on_status).__name__} ({on_status!r})")


def time_limit(timeout_s: float | None) -> float | None:
    """The seconds, or None for no limit, which more than clocks and sockets can count comes to.

    Raises:
        UsageError: it is no such number.
    """
    if timeout_s is None:
        return None
    number = isinstance(timeout_s, (int, float)) and not isinstance(timeout_s, bool)  # pyright: ignore[reportUnnecessaryIsInstance] - users' own calls
    if not number or not timeout_s >= 0:  # NaN is not
        raise UsageError(f"timeout_s: expected seconds, 0 or more, or None for no limit, got {timeout_s!r}")
    return timeout_s if timeout_s < _LONGEST_S else None


def target_id(target: object) -> str:
    """The id of a query or a resource, or what is given as one.

    Raises:
        UsageError: it is nothing of these.
    """
    if isinstance(target, Query):
        return target.id
    if isinstance(target, ResourceInfo):
        return target.id
    if isinstance(target, str):
        return target
    raise UsageError(f"expected a Query or an id, got {type(target).__name__} ({target!r})")


def resource_target(target: object) -> str:
    """As target_id(); a query stands for its resource also when its own holder has left."""
    return target.resource_id if isinstance(target, Query) else target_id(target)
