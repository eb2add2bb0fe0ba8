"""Arguments: check what callers give to a registrar or a system, and bring it into one form."""

from __future__ import annotations

import asyncio
import contextlib
import functools
import inspect
import os
import threading
from collections.abc import Callable, Mapping
from pathlib import Path
from types import FunctionType, MethodType
from typing import Any, TypedDict, TypeVar, Unpack, cast

import msgspec

from rr_actors.base.checks import check_takes, examined, has_home, path_text
from rr_actors.base.config import RegistrarConfig, SystemConfig
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
from rr_actors.registrar.declarations import Declared, declaring
from rr_actors.registrar.engine.node import Node
from rr_actors.registrar.model.rows import HIGHEST, LOWEST
from rr_actors.registrar.progress_hearers import ProgressWanted
from rr_actors.registrar.queries import Query, ResourceInfo, StatusCallback
from rr_actors.registrar.servers.callback_context import Current, current_or_none
from rr_actors.runtime.callback_errors import described
from rr_actors.runtime.event_loop import check_asyncio
from rr_actors.runtime.time_limits import time_limit
from rr_actors.runtime.user_loop import CallersLoop
from rr_actors.runtime.workers import is_async

# -- a registrar's -----------------------------------------------------------------------------------------------


def server_target(server: object, node: Node) -> ServerId:
    """Return a server's id as parse_server() does, also for the method that declares it.

    Raises:
        InvalidName: `server` is neither; for a name without a registrar the text has the id that was probably meant.
        UnknownRegistrar, UsageError: none or several of the system's children have the declaring class.
        UnknownHost, NotExported, ProtocolMismatch: the server is of another host, which is unknown or refuses it.
    """
    if is_a(server, Declared):
        return parse_server(declaring(cast("Declared[Any, Any, Any]", server)).id_in(node.directory))
    try:
        parsed = parse_server(server)
        return parsed if node.info.hosts is None else node.info.hosts.provider(parsed, node.directory)
    except InvalidName as error:
        text = error.message
        if is_a(server, (FunctionType, MethodType)):
            text += ": a method that names a server has @rr.server"
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
    known.update(*([id for id in list(actor.catalog.server_types) if "/" in id] for _, actor in here))
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
    if not _takes_one(callback):
        with examined(what):
            check_takes(callback, ("status",), who, field)
    return ours


def _takes_one(callback: Callable[..., Any]) -> bool:
    """Return whether it is a plain function of one parameter, as nearly all are: no need to read its signature."""
    if type(callback) is not FunctionType or callback.__dict__:  # which may have a signature for readers
        return False
    return callback.__code__.co_argcount == 1 and not callback.__code__.co_kwonlyargcount


def checked_callback(callback: Callable[..., Any]) -> Callable[..., Any]:
    """Return what status_callback() returns for the callback of on_status(), which must not be None."""
    own = status_callback(callback, "on_status", "callback")
    if own is None:
        raise UsageError("on_status: callback: expected a callable, got None")
    return own


def target_id(target: object) -> str:
    """Return the id of a query or a resource; a text is an id already.

    Raises:
        UsageError: `target` is none of these.
    """
    if type(target) is str:
        return target
    if is_a(target, (Query, ResourceInfo)):
        return target.id
    if is_a(target, str):
        return exact_text(target)
    raise UsageError(f"expected a Query or an id, got {type(target).__name__} ({shown(target)})")


def resource_target(target: object) -> str:
    """Return an id as target_id() does; for a query its resource's, valid also when the holder has left."""
    return target.resource_id if type(target) is not str and is_a(target, Query) else target_id(target)


# -- the options of a load ---------------------------------------------------------------------------------------
#
# They are declared here once, for every method that loads and for every kind of registrar: as keywords, for type
# checkers, and, with their defaults, as the fields of LoadOptions. checked() makes the fields of the keywords; it names
# only those that it checks. The methods pass them all on.

F = TypeVar("F", bound=Callable[..., Any])

Parent = Current | Query[Any] | ResourceInfo | str
"""What load() takes as `parent`."""


class GroupKeywords(TypedDict, total=False):
    """The options of load_all()."""

    on_status: StatusCallback | None
    timeout_s: float | None
    parent: Parent | None
    priority: int | None
    wait_s: float | None


class LoadKeywords(GroupKeywords, total=False):
    """The options of load(), except `response_type` and `block`: these say what the call returns."""

    progress: ProgressWanted


class LoadOptions(msgspec.Struct, frozen=True):
    """The options of one call, checked. Registrar.load() says what each means.

    Attributes:
        own: the caller gave the `priority`, so that a part does not inherit that of its whole.
        codec: of the `response_type`; None: that of the server.
        loop: the event loop that awaits the load and runs an async `on_status`; None: another one does.
    """

    on_status: StatusCallback | None = None
    timeout_s: float | None = 30.0
    parent: Parent | None = None
    progress: ProgressWanted = False
    priority: int | None = 0
    own: bool = False
    wait_s: float | None = None
    codec: Codec | None = None
    loop: CallersLoop | None = None


DEFAULTS = LoadOptions()
"""The options of a call that gives none."""


def checked(called: str, response_type: Any = None, /, **given: Unpack[LoadKeywords]) -> LoadOptions:
    """Return the options that a caller has given to the method `called`.

    Raises:
        TypeError: the method takes no such keyword.
        UsageError, NotSerializable: the value of an option is wrong.
    """
    check_keywords(called, given, LoadKeywords)
    if "timeout_s" in given:
        given["timeout_s"] = time_limit(given["timeout_s"])
    if "wait_s" in given:
        given["wait_s"] = _checked_wait(given["wait_s"], called)
    codec = None if response_type is None else codec_for(response_type)
    on_status = given.get("on_status")
    status_callback(on_status, called.removesuffix("_async"))
    loop: CallersLoop | None = None
    if called.endswith("_async"):
        check_asyncio(called)
        loop = callers_loop(on_status)
    if "priority" in given:
        given["priority"] = checked_priority(given["priority"], called)
    return LoadOptions(**given, own="priority" in given, codec=codec, loop=loop)


def passed_on(**options: Unpack[LoadKeywords]) -> Any:
    """Return the options, checked. Of a function that passes its own on, Jedi shows them by their names."""
    return checked("load", **options)


def check_keywords(called: str, given: Mapping[str, object], names: type[GroupKeywords]) -> None:
    """Raise TypeError if the method `called` does not take a keyword that its caller has given."""
    known = names.__annotations__
    for name in given:
        if name not in known:
            hint = did_you_mean(name, known)
            raise TypeError(f"Registrar.{called}() got an unexpected keyword argument {name!r}{hint}")


def _checked_wait(value: object, called: str) -> float | None:
    """Return how long a load may wait in line; None: as long as the load may take.

    Raises:
        UsageError: it is neither None nor a number of 0 or more.
    """
    if value is None:
        return None
    if is_a(value, (int, float)) and not is_a(value, bool):
        seconds = exact_number(cast("float", value))
        if seconds >= 0:  # NaN is not
            return float(min(seconds, threading.TIMEOUT_MAX))
    raise UsageError(f"{called}: wait_s: expected seconds, 0 or more, or None, got {shown(value)}")


def callers_loop(callback: StatusCallback | None) -> CallersLoop | None:
    """Return the event loop that runs here, for an async status callback; None: the callback runs elsewhere."""
    if callback is None or not is_async(callback) or asyncio._get_running_loop() is None:
        return None
    return CallersLoop() if current_or_none() is None else None  # a server's context ends before the statuses come


def checked_priority(value: object, called: str) -> int | None:
    """Return the priority that a caller gives; None for standby.

    Raises:
        UsageError: it is neither None nor a whole number from -1000 to 1000.
    """
    if value is None:
        return None
    if is_a(value, int) and not is_a(value, bool) and LOWEST <= (number := int(exact_number(value))) <= HIGHEST:
        return number
    expected = f"expected a whole number from {LOWEST} to {HIGHEST}, or None for standby"
    raise UsageError(f"{called}: priority: {expected}, got {shown(value)} ({type(value).__name__})")


def check_allowed(priority: int | None, config: RegistrarConfig) -> None:
    """Raise UsageError if a registrar may not hold a query of this priority."""
    if priority is not None and priority > config.max_priority:
        limit = f"expected {config.max_priority} at most, as the max_priority of registrar {config.name!r} says"
        raise UsageError(f"priority: {limit}, got {priority}")


def shows(names: type[Mapping[str, Any]]) -> Callable[[F], F]:
    """Have help() and completion show the keywords of a method, in place of its ``**options``."""

    def show(method: F) -> F:
        signature = inspect.signature(method)
        parameters = list(signature.parameters.values())
        options = parameters.pop()
        assert options.kind is inspect.Parameter.VAR_KEYWORD
        for name, annotation in names.__annotations__.items():
            default, shown = getattr(DEFAULTS, name), getattr(annotation, "__forward_arg__", annotation)
            parameters.append(
                inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, default=default, annotation=shown)
            )
        method.__signature__ = signature.replace(parameters=parameters)  # type: ignore[attr-defined]  # as in inspect
        return method

    return show


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
