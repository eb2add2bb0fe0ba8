"""Arguments: check what callers give to a registrar or a system, and bring it into one form."""

from __future__ import annotations

import contextlib
import functools
import os
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any, cast

from rr_actors.base.checks import check_takes, examined, has_home, path_text
from rr_actors.base.config import SystemConfig
from rr_actors.base.errors import (
    ConfigError,
    InvalidName,
    UsageError,
    did_you_mean,
    exact_number,
    exact_text,
    is_a,
    shown,
)
from rr_actors.base.names import ServerId, check_name, parse_server
from rr_actors.base.values.canonical import Codec
from rr_actors.registrar.declarations import Declared, id_in
from rr_actors.registrar.queries import Query, ResourceInfo
from rr_actors.runtime.callback_errors import described
from rr_actors.system.hosting.node import Node

# -- a registrar's -----------------------------------------------------------------------------------------------


def server_target(server: object, node: Node) -> ServerId:
    """Return a server's id as parse_server() does, also for the method that declares it.

    Raises:
        InvalidName: `server` is neither; for a name without a registrar the text has the id that was probably meant.
        UnknownRegistrar, UsageError: none or several of the system's children have the declaring class.
    """
    if is_a(server, Declared):
        return parse_server(id_in(cast("Declared[Any, Any, Any]", server), node.directory))
    try:
        return parse_server(server)
    except InvalidName as error:
        text = error.message
        with contextlib.suppress(InvalidName):  # a server's id or another text that is no name
            text += _meant(check_name(server), node)
        raise InvalidName(text, name=error.name) from None


def _meant(name: str, node: Node) -> str:
    """Return the end of an error about a server id that lacks its registrar: the ids that it may mean."""
    no_registrar = node.directory.no_registrar(name)
    if name in no_registrar.known:
        return f"; {name!r} is a registrar, name its server, too: '{name}/...'"
    here = list(node.registrars.items())
    known = {f"{registrar}/{server}" for registrar, actor in here for server in actor.servers.names()}
    known.update(*(list(actor.catalog.server_types) for _, actor in here))
    named = [id for id in sorted(known) if id.endswith(f"/{name}")]
    if named:
        return f"; did you mean {' or '.join(map(repr, named))}?"
    return did_you_mean(name, known) or f"; {no_registrar}"


def codec_for(response_type: Any) -> Codec:
    """Return the codec that reads responses of a type; raise NotSerializable if values of that type cannot travel."""
    try:
        return _codec_for(response_type)
    except TypeError:  # the type has no hash: Annotated with a list, say
        return _codec_for.__wrapped__(response_type)


_codec_for = functools.lru_cache(256)(functools.partial(Codec, what="load: response_type"))


def status_callback(
    callback: Callable[..., Any] | None, who: str, field: str = "on_status"
) -> Callable[..., Any] | None:
    """Return a function that calls a user's status callback; None for None.

    Raises:
        UsageError: `callback` cannot be called with a status alone.
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
    """Return the id of a query or a resource; a text is an id already.

    Raises:
        UsageError: `target` is none of these.
    """
    if is_a(target, (Query, ResourceInfo)):
        return target.id
    if is_a(target, str):
        return exact_text(target)
    raise UsageError(f"expected a Query or an id, got {type(target).__name__} ({shown(target)})")


def resource_target(target: object) -> str:
    """Return an id as target_id() does; for a query its resource's, valid also when the holder has left."""
    return target.resource_id if is_a(target, Query) else target_id(target)


# -- a system's --------------------------------------------------------------------------------------------------


def state_path(state_dir: object) -> Path:
    """Return the path of the state directory; "~" at its beginning is the user's home.

    Raises:
        ConfigError: `state_dir` is no path.
    """
    text = path_text(state_dir)
    if text and "\0" not in text and has_home(text):
        return Path(os.path.expanduser(text))
    raise _wrong("state_dir", "a directory's path", state_dir)


def system_config(config: object) -> SystemConfig:
    """Return the configuration, or the default one for None; raise ConfigError if `config` is no SystemConfig."""
    if config is None:
        return SystemConfig()
    if is_a(config, SystemConfig):
        return config
    raise _wrong("config", "a SystemConfig or None", config)


def _wrong(key: str, expected: str, got: object) -> ConfigError:
    text = f"System: {key}: expected {expected}, got {shown(got)} ({type(got).__name__})"
    return ConfigError(text, file=None, key=key, expected=expected, got=got)


def stop_limit(timeout_s: object) -> float:
    """Return the seconds that a stop may take; raise UsageError if `timeout_s` is no number of 0 or more."""
    if is_a(timeout_s, (int, float)) and not is_a(timeout_s, bool):
        seconds = exact_number(cast("float", timeout_s))
        if seconds >= 0:  # NaN is not
            return float(min(seconds, threading.TIMEOUT_MAX))
    raise UsageError(f"stop: timeout_s: expected seconds, 0 or more, or None, got {shown(timeout_s)}")


def check_text(value: object, expected: str) -> str:
    """Return the value, which must be text.

    Args:
        expected: how the error's text begins.

    Raises:
        UsageError: the value is no text.
    """
    if is_a(value, str):
        return exact_text(value)
    raise UsageError(f"{expected}, got {shown(value)} ({type(value).__name__})")
