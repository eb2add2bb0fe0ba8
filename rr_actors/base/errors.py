"""All errors that rr_actors raises, under one base class.

"You misused this" (UsageError) stands apart from "the other side failed" (the rest)::

    RrError
    ├─ UsageError           InvalidName NameTaken UnknownServer UnknownRegistrar UnknownHost NotExported UnknownQuery
    │                       NotHolder NotAllowed InvalidRequest InvalidResponse InvalidSpec ConfigError NotSerializable
    │                       MissingDependency
    │                       AlreadyStarted AlreadyPresent NotFound ChildRunning ChildRestarting NotForDynamic
    │                       TooManyChildren
    ├─ LoadError            LoadFailed(.trace) ─ CircularDependency(.ring), OverCapacity, ResourceBusy, GraphError;
    │                       LoadTimeout ─ HostUnreachable
    ├─ UnloadFailed(.trace)
    ├─ ResourceLost
    ├─ Unavailable          RegistrarDown ProtocolMismatch ActorUnavailable MailboxFull NotRunning
    ├─ CatalogError         CatalogLocked CatalogDamaged CatalogVersion
    └─ SupervisionError     StartFailed RestartIntensityExceeded

The names, paths and limits in an error's text are its attributes too: ``raise UnknownServer("...", server="a/b")`` has
``.server == "a/b"``. Errors can be pickled, and travel between registrars as an
:class:`rr_actors.base.values.failure.Failure`.
"""

from __future__ import annotations

import difflib
import reprlib
from collections.abc import Iterable
from typing import Any, TypeGuard, TypeVar

import msgspec

_K = TypeVar("_K")


class Frame(msgspec.Struct, frozen=True):
    """A registrar that an error passed through.

    Attributes:
        origin: the server whose callback failed, "registrar/server".
        message: the error of that callback, "ValueError: no such device".
    """

    origin: str
    message: str

    def __str__(self) -> str:
        return f"{self.origin}: {self.message}"


class RrError(Exception):
    """Base of every error of this package. Keyword arguments become attributes.

    Attributes:
        details: the keyword arguments.
    """

    def __init__(self, message: str = "", **details: Any) -> None:
        super().__init__(message)
        self.details: dict[str, Any] = details
        self.__dict__.update(details)

    @property
    def message(self) -> str:
        """The text, as str() gives it."""
        return str(self.args[0]) if self.args else ""

    def __reduce__(self) -> tuple[Any, ...]:
        return (_rebuild, (type(self), self.message, self.details))


class DescribedError(Exception):
    """An error of a user's class, with its text and its trace, which were made where they may take long.

    Attributes:
        error: the error itself. Do not examine it on a loop.
        text: the error, as "ValueError: no such device".
        trace: its traceback, as Python prints it.
    """

    def __init__(self, error: BaseException, text: str, trace: str) -> None:
        super().__init__(text)
        self.error, self.text, self.trace = error, text, trace


def text_of(error: BaseException) -> str:
    """Return class and text, "ValueError: no such device", for people and in a form that can be sent and stored.

    It is the class alone if the error's own str() raises.
    """
    if is_a(error, DescribedError):
        return error.text
    name = name_of_class(type(error))
    try:
        return readable(f"{name}: {error}")
    except BaseException as reason:
        return f"{name} (its text is not known: its str() raised {name_of_class(type(reason))})"


def name_of_class(cls: type) -> str:
    """Return the name of a class without asking its metaclass."""
    return type.__dict__["__name__"].__get__(cls)


def is_a(value: object, kind: type[_K] | tuple[type[_K], ...]) -> TypeGuard[_K]:
    """Return whether the value's type is of this kind; isinstance() would run a user's code in `__class__`."""
    return issubclass(type(value), kind)


def exact_number(number: float) -> float:
    """Return the number as a plain int or float, also for a user's subclass of these."""
    if type(number) in (int, float):
        return number
    return float.__float__(number) if issubclass(type(number), float) else int.__int__(number)  # pyright: ignore[reportArgumentType] - it is the other


def exact_text(text: str) -> str:
    """Return the characters as a plain str, also for a user's subclass of str, whose methods may do anything."""
    return text if type(text) is str else str.__str__(text)


_LONGEST_TEXT = 10_000
_FEW = 5


def readable(text: str, limit: int = _LONGEST_TEXT) -> str:
    """Return a text for people in a form that can be sent and stored; half a character becomes its code.

    File names may have such half characters. A very long text is cut: otherwise a frame could be too long, and would
    never be sent.
    """
    text = exact_text(text)
    if len(text) > limit:
        text = f"{text[: limit - 50]} ... ({len(text) - limit + 50} characters more)"
    return text if text.isascii() else text.encode("utf-8", "backslashreplace").decode()


TEXT_LIMIT = 300
"""The most characters of a value or an id that messages show."""

_short = reprlib.Repr()
_short.maxstring = _short.maxother = _short.maxlong = TEXT_LIMIT
_short.maxlist = _short.maxtuple = _short.maxset = _short.maxfrozenset = _short.maxdict = 20
_short.maxlevel = 4


def shown(value: object) -> str:
    """Return the repr of a value for a message, at most TEXT_LIMIT characters."""
    try:
        text = _short.repr(value)
    except Exception as reason:
        text = f"<{name_of_class(type(value))}, whose repr raised {name_of_class(type(reason))}>"
    return shortened(exact_text(text))


def with_article(noun: str) -> str:
    """Return "a camera", "an Open"."""
    return f"{'an' if noun[:1].lower() in 'aeiou' else 'a'} {noun}"


def counted(count: int, noun: str) -> str:
    """Return "1 catalog", "0 queries", "2,000 processes": a number, and the noun in the form for it."""
    return f"{count:,} {noun if count == 1 else _plural(noun)}"


def _plural(noun: str) -> str:
    if noun.endswith("y") and noun[-2:-1] not in "aeiou":
        return f"{noun[:-1]}ies"
    return f"{noun}es" if noun.endswith(("s", "x", "ch", "sh")) else f"{noun}s"


def shortened(text: str) -> str:
    """Return the beginning of a user's text, such as an id, for a message: at most TEXT_LIMIT characters."""
    return text if len(text) <= TEXT_LIMIT else f"{text[: TEXT_LIMIT - 1]}…"


def few(texts: Iterable[str]) -> str:
    """Return a list of texts for a message: the first five, and how many more there are."""
    known = list(texts)
    more = f" and {len(known) - _FEW} more" if len(known) > _FEW else ""
    return ", ".join(known[:_FEW]) + more


def did_you_mean(name: object, known: Iterable[str]) -> str:
    """Return "; did you mean 'cameras'?" if one of the known names is like this one, else ""."""
    near = difflib.get_close_matches(shortened(str(name)), known, n=1)
    return f"; did you mean {near[0]!r}?" if near else ""


def _rebuild(cls: type[RrError], message: str, details: dict[str, Any]) -> RrError:
    return cls(message, **details)


# -- you misused this ----------------------------------------------------------------------------------------------


class UsageError(RrError):
    """The call itself was wrong; nothing was changed."""


class InvalidName(UsageError, ValueError):
    """A name with characters that names may not have. `.name`"""

    name: object


class NameTaken(UsageError):
    """A registrar, server or child of that name exists already, and is not changed. `.name`"""

    name: str


class UnknownServer(UsageError, LookupError):
    """The registrar exists, and has no such server. `.server`, `.known`"""

    server: str
    known: tuple[str, ...]


class UnknownRegistrar(UsageError, LookupError):
    """No registrar of that name is in the system. `.registrar`, `.known`"""

    registrar: str
    known: tuple[str, ...] = ()


class UnknownHost(UsageError, LookupError):
    """No host of that name has been seen, or is named in the settings. `.host`, `.known`"""

    host: str
    known: tuple[str, ...] = ()


class NotExported(UsageError, LookupError):
    """The host does not let this one use that registrar. `.host`, `.registrar`, and the `.known` ones"""

    host: str
    registrar: str
    known: tuple[str, ...] = ()


class UnknownQuery(UsageError, LookupError):
    """The query or resource never existed, or is unloaded already. `.query_id`"""

    query_id: str


class NotHolder(UsageError):
    """The query is another registrar's. `.query_id`, `.origin`, `.caller`"""

    query_id: str
    origin: str
    caller: str


class NotAllowed(UsageError):
    """A bridge of rr_actors.ros2 does not offer this server to nodes. `.server`; `.allowed`: what it offers"""

    server: str
    allowed: tuple[str, ...] = ()


class InvalidRequest(UsageError, TypeError):
    """The request is not of the server's type. `.server`, `.path`, `.expected`"""

    server: str
    path: str
    expected: str


class InvalidResponse(UsageError, TypeError):
    """A response, from a callback or from the catalog, is not of the server's type. `.server`, `.path`, `.expected`"""

    server: str
    path: str
    expected: str


class InvalidSpec(UsageError, ValueError):
    """A child or supervisor specification is wrong. `.field`, `.expected`, `.got`"""

    field: str
    expected: str
    got: Any


class ConfigError(UsageError, ValueError):
    """A configuration is wrong. `.file`, `.key`, `.expected`, `.got`"""

    file: str | None
    key: str | None
    expected: Any
    got: Any


class NotSerializable(UsageError, TypeError):
    """A value cannot be sent. `.path` leads to the part that is the reason."""

    path: str


class MissingDependency(UsageError, ImportError):
    """A package that this part of rr_actors needs cannot be imported. `.module`; `.install`: how to get it"""

    module: str
    install: str


class AlreadyStarted(UsageError):
    """The child runs already (OTP: already_started). `.id`"""

    id: str


class AlreadyPresent(UsageError):
    """A child specification of that id exists; its child is not running (OTP: already_present). `.id`"""

    id: str


class NotFound(UsageError, LookupError):
    """No such child or supervisor (OTP: not_found). `.id`; for a supervisor `.known`, the paths of all supervisors."""

    id: str
    known: tuple[str, ...]


class ChildRunning(UsageError):
    """Only a stopped child can be restarted or deleted, and this one runs (OTP: running). `.id`"""


class ChildRestarting(UsageError):
    """Only a stopped child can be restarted or deleted, and this one is being restarted (OTP: restarting). `.id`"""


class NotForDynamic(UsageError):
    """The call makes no sense under simple_one_for_one (OTP: simple_one_for_one). `.id`"""


class TooManyChildren(UsageError):
    """The supervisor has max_children already (Elixir: max_children). `.id` of the supervisor, `.limit`"""

    id: str
    limit: int


# -- the other side failed -----------------------------------------------------------------------------------------


class LoadError(RrError):
    """A load failed, and leaves nothing behind."""


class LoadFailed(LoadError):
    """The provider could not load the resource; most often its load callback raised.

    Or the callback took longer than `load_timeout_s`, its response cannot be sent, no thread was free for it, or its
    process died in each attempt. Or the resource was unloaded by force, or its server unregistered, while it loaded.

    `.trace`: one Frame per registrar on the way, innermost first; `.server`.
    `.traceback`: the lines of the innermost callback as Python prints them, where it ran; a note shows them, too.
    `.wanted`: what the machine had no more of, "ENOSPC: ..."; "" if the load failed for another reason.
    """

    server: str
    trace: tuple[Frame, ...] = ()
    traceback: str = ""
    wanted: str = ""


class CircularDependency(LoadFailed):
    """A request would have waited for itself. `.ring`: the "registrar/server" names around the ring; `.trace`."""

    ring: tuple[str, ...] = ()


class OverCapacity(LoadFailed):
    """A pool of rr_actors.managers.Budgets has no room for a share, and none can be made in its time.

    `.pool`, `.asked`, `.free`; `.holders`: the registrars that hold the pool's shares.
    """

    pool: str
    asked: float
    free: float
    holders: tuple[str, ...] = ()


class ResourceBusy(LoadFailed):
    """Somebody else holds the exclusive resource, and the load may not wait (longer) for it: `wait_s` is over.

    `.holder`: the registrar that has it, "" while nobody does; `.since`: when that one asked for it, in seconds since
    1970, or None; `.waiting`: how many others waited for it. `.server`
    """

    holder: str
    since: float | None = None
    waiting: int = 0


class GraphError(LoadFailed, UsageError, ValueError):
    """A graph of actions is wrong, or something that it needs is not there. Nothing of it has run.

    `.file`: None if it came from no file; `.path`: the place in the JSON object, "actions[0].parents[1]"; `.expected`,
    `.got`
    """

    file: str | None
    path: str
    expected: str
    got: Any


class LoadTimeout(LoadError, TimeoutError):
    """No answer within the time limit; the load is withdrawn. `.server`, `.timeout_s`, the provider's `.status`

    Of a load that waited in line for an exclusive resource: `.holder`, the registrar that had it, as its server said
    last; "" if none did. `.since`: when that one asked for it, in seconds since 1970, or None.
    """

    server: str
    timeout_s: float
    status: str = ""
    holder: str = ""
    since: float | None = None


class HostUnreachable(LoadTimeout):
    """The host was not reachable within the time limit; the load is withdrawn. `.host`; `.since_s`: how long so far"""

    host: str
    since_s: float


class UnloadFailed(RrError):
    """An unload callback raised; the resource is kept as unload_failed. `.trace`, `.resource_id`"""

    resource_id: str
    trace: tuple[Frame, ...] = ()


class ResourceLost(RrError):
    """The resource of a stream that is read was lost, or its provider took it away. `.query_id`, `.resource_id`"""

    query_id: str
    resource_id: str


class AskFailed(RrError):
    """The handler of an actor raised while a connected program asked it: its exception cannot be brought here.

    `.actor`: as it was asked; `.error`: the exception's class, "ValueError", as its text names it.
    `.traceback`: its lines as Python prints them; a note shows them, too.
    """

    actor: str
    error: str
    traceback: str = ""


class Unavailable(RrError):
    """The other side cannot answer now."""


class NotRunning(Unavailable):
    """No running system was reached, or the system has ended, or the connection to it is closed."""


class RegistrarDown(Unavailable):
    """The registrar is stopped, dormant or gone for good. `.registrar`, `.status`"""

    registrar: str
    status: str


class ProtocolMismatch(Unavailable):
    """The other host speaks another version of the protocol between hosts. `.host`"""

    host: str


class ActorUnavailable(Unavailable):
    """The actor is not up yet, or is being respawned: the same reference will work then. `.id`"""

    id: str


class MailboxFull(Unavailable):
    """The mailbox has reached its bound. `.name`, `.limit`"""

    name: str
    limit: int


class CatalogError(RrError):
    """A catalog cannot be opened, and is not changed. `.path`"""

    path: str


class CatalogLocked(CatalogError):
    """A living process holds the catalog. `.path`, `.pid`"""

    pid: int | None


class CatalogDamaged(CatalogError):
    """The file is not a readable catalog. `.path`"""


class CatalogVersion(CatalogError):
    """Another version of rr_actors wrote the catalog. `.path`, `.expected`, `.got`"""

    expected: int
    got: int


class SupervisionError(RrError):
    """A supervisor could not do its work."""


class StartFailed(SupervisionError):
    """A child did not become ready; the children started before it are stopped again. `.id`, `__cause__`

    `.wanted`: what was wanting, "EMFILE: ..."; "" if the start failed for another reason.
    """

    id: str
    wanted: str = ""


class RestartIntensityExceeded(SupervisionError):
    """A supervisor made too many restarts in its window. `.supervisor`, `.restarts` (child, seconds ago, reason)"""

    supervisor: str
    restarts: Any
