"""Arguments: what people hand to a registrar or a system, checked, and brought into the one form used inside."""

from __future__ import annotations

import functools
import os
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any, cast

from rr_actors.base.checks import check_takes, examined, has_home, path_text
from rr_actors.base.config import SystemConfig
from rr_actors.base.errors import ConfigError, UsageError, exact_number, exact_text, is_a, shown
from rr_actors.base.names import ServerId, parse_server
from rr_actors.base.values.canonical import Codec
from rr_actors.registrar.declarations import Declared, id_in
from rr_actors.registrar.queries import Query, ResourceInfo
from rr_actors.runtime.callback_errors import described
from rr_actors.wire.name_service import Directory

# -- a registrar's -----------------------------------------------------------------------------------------------


def server_target(server: object, directory: Directory) -> ServerId:
    """As parse_server(); also of the method that declares a server.

    Raises:
        InvalidName: it is neither.
        UnknownRegistrar, UsageError: not exactly one child of the system is of the class that declares it.
    """
    return parse_server(id_in(cast("Declared[Any, Any, Any]", server), directory) if is_a(server, Declared) else server)


def codec_for(response_type: Any) -> Codec:
    """The codec that reads responses of a type.

    Raises:
        NotSerializable: no values of that type can travel.
    """
    try:
        return _codec_for(response_type)
    except TypeError:  # it has no hash: Annotated with a list, say
        return Codec(response_type, _RESPONSE)


_RESPONSE = "load: response_type"
_codec_for = functools.lru_cache(256)(functools.partial(Codec, what=_RESPONSE))


def status_callback(
    callback: Callable[..., Any] | None, who: str, field: str = "on_status"
) -> Callable[..., Any] | None:
    """A callback for statuses as a function of our own; None for none.

    Raises:
        UsageError: it cannot be called, or not with a status alone.
    """
    if callback is None:
        return None
    what = f"{who}: {field}"
    if not callable(callback):
        raise UsageError(f"{what}: expected a callable, got {type(callback).__name__} ({shown(callback)})")
    ours = described(callback, what)
    with examined(what):
        check_takes(callback, ("status",), who, field)
    return ours


def target_id(target: object) -> str:
    """The id of a query or a resource, or what is given as one.

    Raises:
        UsageError: it is nothing of these.
    """
    if is_a(target, (Query, ResourceInfo)):
        return cast("Query | ResourceInfo", target).id
    if is_a(target, str):
        return exact_text(cast("str", target))
    raise UsageError(f"expected a Query or an id, got {type(target).__name__} ({shown(target)})")


def resource_target(target: object) -> str:
    """As target_id(); a query stands for its resource also when its own holder has left."""
    return cast("Query", target).resource_id if is_a(target, Query) else target_id(target)


# -- a system's --------------------------------------------------------------------------------------------------


def state_path(state_dir: object) -> Path:
    """The state directory; "~" at its beginning is the user's home.

    Raises:
        ConfigError: it is no path.
    """
    text = path_text(state_dir)
    if text and "\0" not in text and has_home(text):
        return Path(os.path.expanduser(text))
    raise _wrong("state_dir", "a directory's path", state_dir)


def system_config(config: object) -> SystemConfig:
    """The configuration; the default one for None.

    Raises:
        ConfigError: it is no SystemConfig.
    """
    if config is None:
        return SystemConfig()
    if is_a(config, SystemConfig):
        return cast("SystemConfig", config)
    raise _wrong("config", "a SystemConfig or None", config)


def _wrong(key: str, expected: str, got: object) -> ConfigError:
    text = f"System: {key}: expected {expected}, got {shown(got)} ({type(got).__name__})"
    return ConfigError(text, file=None, key=key, expected=expected, got=got)


def stop_limit(timeout_s: object) -> float:
    """The seconds that a stop may take.

    Raises:
        UsageError: it is no such number.
    """
    if is_a(timeout_s, (int, float)) and not is_a(timeout_s, bool):
        seconds = exact_number(cast("float", timeout_s))
        if seconds >= 0:  # NaN is not
            return float(min(seconds, threading.TIMEOUT_MAX))
    raise UsageError(f"stop: timeout_s: expected seconds, 0 or more, or None, got {shown(timeout_s)}")


def check_text(value: object, expected: str) -> str:
    """The value.

    Args:
        expected: what to say if it is no text.

    Raises:
        UsageError: it is none.
    """
    if is_a(value, str):
        return exact_text(cast("str", value))
    raise UsageError(f"{expected}, got {shown(value)} ({type(value).__name__})")
