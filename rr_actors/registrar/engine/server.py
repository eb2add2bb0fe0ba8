"""ServerSpec: what a server is registered with, and how that is checked.

Catalogs have the ServerSpecs of servers that were registered through a handle, under the name of this module.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, NoReturn, cast

import msgspec

from rr_actors.base.checks import check_takes, examined, is_number, wrong_label
from rr_actors.base.errors import InvalidSpec, is_a, shown
from rr_actors.base.names import check_name
from rr_actors.base.reporting.log import Log
from rr_actors.registrar.engine.fields import annotated_types, by_fields, field_names, hints_of
from rr_actors.registrar.model.health import Health, HealthOf
from rr_actors.registrar.model.roles import ROLES, Role
from rr_actors.runtime.time_limits import LONGEST_GRACE_S
from rr_actors.runtime.workers import is_async
from rr_actors.wire.name_service import LABELS_BYTES

logger = Log("rr_actors.server")

Callback = Callable[..., Any]
RECOVERY = ("keep", "reload", "lost")
RECOVER_S = 30.0
"""How long a recover callback may take, if its server says nothing else."""
GRACE_S = 5.0
"""How long the holder of an exclusive resource has to release it to a more urgent one."""

Labels = Mapping[str, Mapping[str, str | int | float | bool]]
"""What the resources of a server provide, by kind: `{"range": {"rate_hz": 30}}`."""


class ServerSpec(msgspec.Struct, frozen=True):
    """The callbacks and settings that a server is registered with; Registrar.register_server describes them."""

    name: str
    load: Callback
    unload: Callback | None = None
    status: Callback | None = None
    recover: Callback | None = None
    request_type: Any = None
    response_type: Any = None
    linger_s: float = 0.0
    load_timeout_s: float | None = None
    recovery: str | None = None  # None: "keep", as nothing was said
    recover_timeout_s: float | None = RECOVER_S
    upgrade: Callback | None = None
    usage: Callback | None = None
    idle: str = "unload"
    paused_s: float | None = None
    pause: Callback | None = None
    resume: Callback | None = None
    health: Health | HealthOf | None = None
    probe: Callback | None = None
    provides: Labels | None = None
    at_once: int | None = None  # None: as many as ask
    exclusive: bool = False
    grace_s: float | None = None  # None: GRACE_S
    title: Callback | None = None

    @property
    def labels(self) -> str:
        """What it provides, as JSON; "" for nothing."""
        return msgspec.json.encode(self.provides).decode() if self.provides else ""


def checked_callback(callback: Callback, role: Role, request_type: Any, who: str) -> Callback:
    """Return a function that takes the arguments of the role: the callback itself, unless it takes fields.

    Raises:
        InvalidSpec: the callback takes others.
    """
    names = field_names(request_type)
    if names is not None:
        return by_fields(callback, role.option, role.arguments, names, who)
    check_takes(callback, role.arguments, who, role.option)
    return callback


def checked_spec(spec: ServerSpec) -> ServerSpec:
    """Check what a server is registered with; read its types from the annotations of `load` if none are given.

    Raises:
        InvalidName, InvalidSpec: a field is wrong; the error says which.
    """
    name = check_name(spec.name, "server name")
    who = f"server {name!r}"
    with examined(who):
        request, response = annotated_types(spec.load, who) if callable(spec.load) else (None, None)
        request = request if spec.request_type is None else spec.request_type
        for field, role in ROLES.items():
            callback = getattr(spec, field)
            if callable(callback):
                checked_callback(callback, role, request, who)
            elif field == "load" or callback is not None:
                _invalid(name, field, "a callable", callback)
        if spec.upgrade is not None and is_async(spec.upgrade):
            _invalid(name, "upgrade", "a function that is not async", spec.upgrade)
        if spec.recovery is not None and spec.recovery not in RECOVERY:
            _invalid(name, "recovery", "one of " + ", ".join(map(repr, RECOVERY)), spec.recovery)
        if not is_number(spec.linger_s) or spec.linger_s < 0:
            _invalid(name, "linger_s", "seconds, 0 or more", spec.linger_s)
        _check_idle(name, spec)
        if spec.health is not None and not is_a(spec.health, (Health, HealthOf)):
            _invalid(name, "health", "an rr.Health or None", spec.health)
        if spec.at_once is not None and (type(spec.at_once) is not int or spec.at_once < 1):
            _invalid(name, "at_once", "a whole number of at least 1, or None", spec.at_once)
        _check_exclusive(name, spec)
        if spec.title is not None and not callable(spec.title):
            _invalid(name, "title", "a function that takes a request and returns a text, or None", spec.title)
        for field in ("load_timeout_s", "recover_timeout_s"):
            limit_s = getattr(spec, field)
            if limit_s is not None and not (is_number(limit_s) and limit_s > 0):
                _invalid(name, field, "seconds greater than 0, or None", limit_s)
        return msgspec.structs.replace(
            spec,
            name=name,
            request_type=request,
            response_type=response if spec.response_type is None else spec.response_type,
            linger_s=float(spec.linger_s),
            provides=_checked_labels(name, spec.provides),
        )


def _checked_labels(name: str, provides: object) -> Labels | None:
    """Return the labels as plain dicts, which can travel."""
    if provides is None:
        return None
    expected = "a dict of kinds, each with a dict of what it provides"
    if not is_a(provides, Mapping):
        _invalid(name, "provides", expected, provides)
    found: dict[object, Any] = {}
    for kind, labels in cast("Mapping[object, object]", provides).items():
        if not is_a(kind, str) or not kind:
            _invalid(name, "provides", "kinds, each a text", kind)
        if not is_a(labels, Mapping):
            _invalid(name, f"provides.{kind}", expected, labels)
        if (wrong := wrong_label(cast("Mapping[str, object]", labels))) is not None:
            _invalid(name, ".".join(filter(None, ("provides", kind, wrong.key))), wrong.expected, wrong.got)
        found[kind] = dict(cast("Mapping[object, object]", labels))
    if (size := len(msgspec.json.encode(found))) > LABELS_BYTES:
        _invalid(name, "provides", f"at most {LABELS_BYTES} bytes as JSON", size)
    return cast("Labels", found)


def _check_exclusive(name: str, spec: ServerSpec) -> None:
    if type(spec.exclusive) is not bool:
        _invalid(name, "exclusive", "a bool", spec.exclusive)
    if spec.grace_s is None:
        return
    if not is_number(spec.grace_s) or not 0 <= spec.grace_s <= LONGEST_GRACE_S:
        _invalid(name, "grace_s", f"seconds from 0 to {LONGEST_GRACE_S:g}, or None", spec.grace_s)
    if not spec.exclusive:
        _invalid(name, "grace_s", "None, as the server is not exclusive", spec.grace_s)


def _check_idle(name: str, spec: ServerSpec) -> None:
    if spec.idle not in ("unload", "pause"):
        _invalid(name, "idle", "'unload' or 'pause'", spec.idle)
    if spec.paused_s is None:
        return
    if not is_number(spec.paused_s) or spec.paused_s < 0:
        _invalid(name, "paused_s", "seconds, 0 or more, or None", spec.paused_s)
    if spec.idle != "pause":
        _invalid(name, "paused_s", "None, as idle is not 'pause'", spec.paused_s)


def checked_whole(spec: ServerSpec) -> ServerSpec:
    """Check that a server has the callbacks that its options need, and no others; all are known now.

    Raises:
        InvalidSpec: pause, resume or the health callback is missing, or never called.
    """
    if spec.health is not None and spec.probe is None:
        _invalid(spec.name, "probe", "a callable, the health callback, as there is a health", spec.probe)
    if spec.health is None and spec.probe is not None:
        _invalid(spec.name, "probe", "health=rr.Health(...), without which it is never called", spec.probe)
    for field in ("pause", "resume"):
        callback = getattr(spec, field)
        if spec.idle == "pause" and callback is None:
            _invalid(spec.name, field, "a callable, as idle is 'pause'", callback)
        if spec.idle != "pause" and callback is not None:
            _invalid(spec.name, field, "idle='pause', without which it is never called", callback)
    return spec


def log_unread_types(spec: ServerSpec, server: str) -> None:
    """Log a warning if an annotation names a type that cannot be found: the values are plain then, and not checked."""
    if spec.request_type is not None or spec.response_type is not None:
        return  # the types were read, or given
    try:
        hints_of(spec.load)
    except NameError as error:
        logger.warning(
            "%s: the annotations of its load callback cannot be read (%s): requests and responses are plain values, "
            "and not checked; import the type outside TYPE_CHECKING, or give request_type and response_type",
            server,
            error,
        )
    except Exception:  # no annotation was meant as a type: `load` is a builtin, say
        return


def _invalid(name: str, field: str, expected: str, got: object) -> NoReturn:
    text = f"server {name!r}: {field}: expected {expected}, got {shown(got)} ({type(got).__name__})"
    raise InvalidSpec(text, field=field, expected=expected, got=got)
