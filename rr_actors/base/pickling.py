"""Python objects as bytes, code included: classes, functions and lambdas of `__main__`, a REPL or a function travel by
value. The only user of cloudpickle.

Only for bytes that a process of the same system sent: loading runs code. This module does eleven things that
cloudpickle does not do:

- msgspec leaves a cache on dataclasses and similar classes, which cannot be pickled; the cache is left out.
- A class that returns to its own process is not changed there. cloudpickle would set it back to its state when it was
  sent, with methods that see a copy of its module's variables.
- A class of a script's `__main__` from an earlier run becomes the script's present class of that name, if that has the
  same fields: catalogs keep types.
- In a child process, what arrives of a script's `__main__` is found there by its name, too: pickle and
  multiprocessing look for it there (adopt_main).
- A msgspec Struct gets its fields when its class is made, so the fields travel with the class's name and bases.
- Annotations that are text ("from __future__ import annotations"), or contain text (`list["Node"]`), mean names of
  `__main__`, which the other process does not have; they travel as the types that they stand for.
- msgspec's bounds in annotations (`Annotated[int, msgspec.Meta(gt=0)]`) cannot be pickled; they are made again.
- A class that travels by value takes its codec along (rr.codec()). A child gets those of `__main__` that nothing of its
  own names, too.
- Code keeps the name of its file, so tracebacks, debuggers, profilers and coverage find its lines. cloudpickle 3.1.3
  and later leave the name out, to give equal functions equal bytes.
- An exception travels in parts, so it arrives even if its class cannot make it again from its `args`.
- An error names the part that failed, and says what to use instead of an object that cannot leave its process.
"""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import inspect
import io
import pickle
import sys
import types
import typing
import weakref
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, NoReturn, cast

import cloudpickle  # pyright: ignore[reportMissingTypeStubs] - it has none
import msgspec

from rr_actors.base.errors import NotSerializable, shown, text_of
from rr_actors.base.reporting import exception_parts
from rr_actors.base.values.codecs import codec, codec_of, types_of_main

CUT_OFF = (EOFError, pickle.UnpicklingError)
"""The errors that the reader of a value gets if only the beginning of its bytes arrived."""

_PROTOCOL = pickle.HIGHEST_PROTOCOL
_CloudPickler: Any = cloudpickle.Pickler

_MAIN = b"__main__"
_CONNECTION = b"multiprocessing.connection"
_ASYNCIO = (b"asyncio.locks", b"asyncio.queues")
"""A pickle that names one of these four modules is made again by cloudpickle, which is slower and handles more objects.
Three are the modules of objects that plain pickle accepts, although they cannot leave their process."""

_NAMES = pickle.STACK_GLOBAL
"""The byte by which a pickle of this protocol takes a class or a function. One without it names no module."""

_LOOKS = 16
_LEAVES = frozenset({bytes, str, bytearray, int, float, bool, type(None)})


LARGE_BYTES = 192 * 1024
"""How long a buffer, or a whole pickle, of a message is at least that goes through shared memory. A shorter one is
faster in the message itself (`make bench`, asks of 100 and 200 KB)."""


Bytes = bytes | bytearray | memoryview


class Large(msgspec.Struct, frozen=True, eq=False):
    """A large value: the parts of its pickle, and the buffers that the pickle does not contain.

    Long parts and buffers are the value's own memory, so use them before the value changes.
    """

    value: object
    what: str
    parts: Sequence[Bytes]
    buffers: Sequence[memoryview]

    def __len__(self) -> int:
        return sum(map(len, self.parts)) + sum(map(len, self.buffers))

    def whole(self) -> bytes:
        """Return a pickle that contains the buffers."""
        return dumps(self.value, self.what) if self.buffers else b"".join(self.parts)


def dumps(value: object, what: str = "value") -> bytes:
    """Return bytes from which `loads` makes an equal value, in this process or another.

    Raises:
        NotSerializable: a part cannot be pickled; `.path` leads to it ("load callback: closure variable 'lock'").
    """
    try:
        if isinstance(value, BaseException) and exception_parts.has_parts(value):
            return _dumps_by_value(value)
        blob = pickle.dumps(value, _PROTOCOL)  # five times faster, and the same if nothing in it goes by value
        if isinstance(value, BaseException) and len(blob) > exception_parts.PART_LIMIT_BYTES:
            return _dumps_by_value(value)
        if _is_plain(blob, value):
            return blob
    except Exception:
        pass  # cloudpickle handles more objects, and otherwise raises the error to report
    return _dumps_more(value, what)


_were_large = False


def dumps_large(value: object, what: str, large_bytes: int = LARGE_BYTES) -> bytes | Large:
    """Return what `dumps` returns, but a Large for a value of at least `large_bytes`. Raises the errors of dumps()."""
    if not _were_large:  # this way is the fastest, but copies long bytes and text
        try:
            blob = pickle.dumps(value, _PROTOCOL, buffer_callback=_stays)
            if len(blob) < large_bytes and _is_plain(blob, value) and not isinstance(value, BaseException):
                return blob
        except Exception:
            pass  # as above, or _LongBuffer
    return dumps(value, what) if isinstance(value, BaseException) else _dumps_parts(value, what, large_bytes)


def _dumps_parts(value: object, what: str, large_bytes: int) -> bytes | Large:
    global _were_large
    buffers: list[memoryview] = []
    keep = _keeper(buffers, large_bytes)
    try:
        parts: list[Bytes] = []
        pickle.Pickler(_Parts(parts.append), _PROTOCOL, buffer_callback=keep).dump(value)
        is_large = _were_large = sum(map(len, parts)) >= large_bytes
        if all(_is_plain(part, value) for part in parts if len(part) < _OWN_PART_BYTES or part[:1] in (_PROTO, _FRAME)):
            return Large(value, what, parts, buffers) if is_large or buffers else b"".join(parts)
    except Exception:
        pass  # as above
    buffers.clear()
    blob = _dumps_more(value, what, keep)
    return Large(value, what, (blob,), buffers) if buffers or len(blob) >= large_bytes else blob


class _Parts:
    """A file for a pickler, which writes long bytes and text to it as they are, and all else in frames."""

    def __init__(self, write: Callable[[Bytes], object]) -> None:
        self.write = write


_OWN_PART_BYTES = 64 * 1024  # a pickler writes so long bytes and text as parts of their own
_PROTO, _FRAME = b"\x80", b"\x95"  # a part of a pickle that contains names begins with one of these, or is short


class _LongBuffer(Exception):
    """A buffer is to be left out of the pickle."""


def dumps_around(value: object, what: str) -> Large:
    """Return a value that pickle can handle, an array say, as its pickle and its buffers, however short these are."""
    buffers = list[memoryview]()
    blob = pickle.dumps(value, _PROTOCOL, buffer_callback=lambda buffer: buffers.append(buffer.raw()))
    return Large(value, what, (blob,), buffers)


def _stays(buffer: pickle.PickleBuffer) -> bool:
    """Return that a short buffer becomes a part of the pickle; raise _LongBuffer for another."""
    if _is_short(buffer, _OWN_PART_BYTES):
        return True
    raise _LongBuffer


def _keeper(buffers: list[memoryview], large_bytes: int) -> Callable[[pickle.PickleBuffer], bool]:
    def keep(buffer: pickle.PickleBuffer) -> bool:
        if _is_short(buffer, large_bytes):
            return True
        buffers.append(buffer.raw())
        return False

    return keep


def _is_short(buffer: pickle.PickleBuffer, large_bytes: int) -> bool:
    with memoryview(buffer) as memory:
        return memory.nbytes < large_bytes or not memory.contiguous


def raw(value: Any) -> memoryview:
    """Return the memory of an object with a buffer, as bytes."""
    return pickle.PickleBuffer(value).raw()


def _is_plain(blob: Bytes, value: object) -> bool:
    """Return whether nothing in the pickle of a value, or a part of it, goes by value.

    The search goes through all bytes, four times. Most long values need none: they name nothing.
    """
    if _NAMES not in blob or _names_nothing(value):
        return True
    return not (
        _MAIN in blob
        or _CONNECTION in blob
        or (b"asyncio." in blob and any(name in blob for name in _ASYNCIO))
        or cloudpickle.list_registry_pickle_by_value()
    )


def _names_nothing(value: object) -> bool:
    """Return whether the value is made of bytes, text and numbers, as far as a look at its first level tells."""
    kind = type(value)
    if kind is tuple or kind is list:
        items = cast("Sequence[object]", value)
        return len(items) <= _LOOKS and all(type(item) in _LEAVES for item in items)
    if kind is dict:
        entries = cast("dict[object, object]", value)
        return len(entries) <= _LOOKS and all(type(k) in _LEAVES and type(v) in _LEAVES for k, v in entries.items())
    return kind in _LEAVES


def _dumps_more(value: object, what: str, keep: Callable[[pickle.PickleBuffer], bool] | None = None) -> bytes:
    try:
        return _dumps_by_value(value, keep=keep)
    except Exception:
        pass  # perhaps the type of an annotation is the reason: try again, and leave annotations as text
    try:
        return _dumps_by_value(value, resolve=False, keep=keep)
    except Exception as error:
        _refuse(value, what, error)


def loads(blob: bytes) -> Any:
    """Return the value that `dumps` was given.

    A class that travelled by value is the original class in the process that it came from. In any other process it is
    the same class each time that it arrives.

    Raises:
        Exception: an error of the value's own code; ImportError if a module of the value is missing.
    """
    return pickle.loads(blob)


def loads_large(blob: memoryview, buffers: Sequence[memoryview]) -> Any:
    """Return the value of a Large, from its pickle and its buffers. Raises the errors of loads()."""
    return pickle.loads(blob, buffers=buffers)


def classes_with_codecs() -> list[bytes]:
    """Return the classes of `__main__` that have a codec, each as bytes, but for those that cannot be pickled."""
    blobs: list[bytes] = []
    for cls in list(types_of_main):
        with contextlib.suppress(NotSerializable):
            blobs.append(dumps(cls))
    return blobs


def modules_of(value: object, what: str = "value") -> set[str]:
    """Return the names of the modules that `loads` would import for the bytes that `dumps` makes of this value."""
    pickler = _ModulesPickler(io.BytesIO(), _PROTOCOL)
    pickler.modules = set()
    try:
        pickler.dump(value)
    except Exception as error:
        _refuse(value, what, error)
    return pickler.modules


def send_by_value(module: types.ModuleType) -> None:
    """Have the classes and functions of a module travel with their code: other processes cannot import it."""
    cloudpickle.register_pickle_by_value(module)  # pyright: ignore[reportUnknownMemberType]  # its own has no types


def _dumps_by_value(
    value: object, *, resolve: bool = True, keep: Callable[[pickle.PickleBuffer], bool] | None = None
) -> bytes:
    with io.BytesIO() as file:
        pickler = _Pickler(file, _PROTOCOL, buffer_callback=keep)
        pickler.resolve = resolve
        pickler.dump(value)
        return file.getvalue()


_dumps_part = functools.partial(_dumps_by_value, resolve=False)


def _made_of(parts: exception_parts.Parts) -> BaseException:
    return exception_parts.made_of(parts, pickle.loads)


class _Pickler(_CloudPickler):
    resolve = True

    def reducer_override(self, obj: Any) -> Any:
        if _instead_of(obj) is not None:
            cls = type(cast("object", obj))
            name = cls.__qualname__ if cls.__module__ == "builtins" else f"{cls.__module__}.{cls.__qualname__}"
            raise TypeError(f"cannot pickle {name!r} object")
        if obj is dataclasses.MISSING:
            return "MISSING"  # a copy would count as the default of a field that has no default
        if isinstance(obj, msgspec.Meta):
            bounds = {name: getattr(obj, name) for name in _BOUNDS}
            return _make_bounds, ({name: bound for name, bound in bounds.items() if bound is not None},)
        if isinstance(obj, types.CodeType):
            return _code_of_file, (*self.dispatch_table[types.CodeType](obj), obj.co_filename)
        if isinstance(obj, BaseException):
            return exception_parts.reduced(obj, _dumps_part, _made_of)
        parent: Any = super()
        reduced = parent.reducer_override(obj)
        if reduced is NotImplemented or len(reduced) < 3:
            return reduced  # by reference
        if isinstance(obj, types.FunctionType):
            if self.resolve:
                _resolve(reduced[2][1], obj.__globals__, lambda: inspect.getclosurevars(obj).nonlocals)
            if obj.__module__ == "__main__" and obj.__qualname__.isidentifier():
                return (*reduced[:2], (reduced[5], reduced[2]), None, None, _set_main_function_state)
        elif isinstance(obj, type):
            module = sys.modules.get(obj.__module__)
            if self.resolve and module is not None:
                _resolve(reduced[2][0], vars(module), lambda: vars(obj))
            return _adapt_class(obj, reduced)
        return reduced


def _code_of_file(make: Callable[..., types.CodeType], arguments: tuple[Any, ...], filename: str) -> types.CodeType:
    return make(*arguments).replace(co_filename=filename)


class _ModulesPickler(_Pickler):
    resolve = False
    modules: set[str]

    def reducer_override(self, obj: Any) -> Any:
        reduced = super().reducer_override(obj)
        if reduced is NotImplemented and isinstance(obj, _BY_REFERENCE):
            self.modules.add(cast("Any", obj).__module__ or "builtins")
        elif isinstance(obj, types.ModuleType):
            self.modules.add(obj.__name__)
        return reduced


_BY_REFERENCE = (type, types.FunctionType, types.BuiltinFunctionType)


def _adapt_class(cls: type, reduced: tuple[Any, ...]) -> tuple[Any, ...]:
    state = reduced[2]
    attributes: dict[str, Any] = state[0]
    attributes.pop("__msgspec_cache__", None)
    arguments = reduced[1]
    if msgspec.Struct in cls.__mro__:
        arguments = _struct_arguments(cls, arguments, attributes)
    elif typing.is_typeddict(cls) and arguments[2] == (dict,):  # made by a call: its base was never written
        arguments = (*arguments[:2], (typing.TypedDict,), *arguments[3:])
    if cls not in _arrived:
        _at_home.add(cls)
    fields = _fields(cls)
    given = codec_of(cls)
    state = (reduced[5], state, None if given is None else (given.encode, given.decode))
    if cls.__module__ == "__main__" and fields:
        arguments = (reduced[0], arguments, cls.__qualname__, fields)
        return (_own_or_made, arguments, state, None, None, _set_class_state)
    return (reduced[0], arguments, state, None, None, _set_class_state)


def _fields(cls: type) -> tuple[str, ...]:
    """Return the names of a class's fields, which tell two classes of one name apart; () for a class without fields."""
    return tuple(getattr(cls, "__members__", None) or vars(cls).get("__annotations__", ()))


def _own_or_made(make: Callable[..., type], arguments: tuple[Any, ...], name: str, fields: tuple[str, ...]) -> type:
    if not any(id in _trackers for id in arguments if isinstance(id, str)):  # not from this run, or here already
        own: Any = sys.modules.get("__main__")
        for part in name.split("."):
            own = getattr(own, part, None)
        if isinstance(own, type) and own.__module__ == "__main__" and _fields(own) == fields and own not in _arrived:
            _at_home.add(own)
            return own
    return make(*arguments)


# cloudpickle has no public way to ask which classes of this run it knows.
_trackers = cast("Mapping[str, type]", cast("Any", cloudpickle).cloudpickle._DYNAMIC_CLASS_TRACKER_BY_ID)


_at_home: weakref.WeakSet[type] = weakref.WeakSet()  # classes of this process that have left it by value
_arrived: weakref.WeakSet[type] = weakref.WeakSet()  # classes that have come here by value


def _set_class_state(cls: type, state: tuple[Any, ...]) -> None:
    if cls in _at_home:
        return
    _arrived.add(cls)
    _name_in_main(cls)
    state[0](cls, state[1])
    if len(state) > 2 and state[2] is not None:  # older catalogs have two parts
        codec(cls, *state[2])


# -- the names of __main__ in a child --------------------------------------------------------------------------------

_adopts = False


def adopt_main() -> None:
    """Give what arrives of another process's `__main__` its name in this one's, which has no script of its own.

    A callback may then use multiprocessing, a ProcessPoolExecutor or a library that pickles: pickle takes a class or
    function by its name in a module, and refuses one that is not there. The script is not run again.
    """
    global _adopts
    _adopts = True


def of_main_by_value(_pickler: object, obj: Any) -> Any:
    """Reduce a class or function of `__main__` to bytes that carry its code, for a worker process of a callback.

    Like `reducer_override` of a pickler. The worker, too, gives what arrives its name in its `__main__`.
    """
    if isinstance(obj, type | types.FunctionType) and obj.__module__ == "__main__":
        return _adopted, (_dumps_by_value(obj),)
    return NotImplemented


def _adopted(blob: bytes) -> Any:
    adopt_main()
    return loads(blob)


def _name_in_main(what: Any) -> None:
    if _adopts and what.__module__ == "__main__" and what.__qualname__.isidentifier():
        setattr(sys.modules["__main__"], what.__qualname__, what)


def _set_main_function_state(function: types.FunctionType, state: tuple[Any, Any]) -> None:
    set_state, values = state
    set_state(function, values)
    _name_in_main(function)


# -- annotations ---------------------------------------------------------------------------------------------------


def _resolve(attributes: dict[str, Any], names: Mapping[str, Any], inner: Callable[[], Mapping[str, Any]]) -> None:
    """Replace text in the annotations among the attributes by the type that it names, if that type can be found."""
    annotations: dict[str, Any] = attributes.get("__annotations__") or {}
    if not annotations:
        return
    attributes["__annotations__"] = found = dict(annotations)
    scopes = dict(names), dict(inner())  # eval writes to them
    for key, annotation in annotations.items():
        if not isinstance(annotation, type):
            alone = type("Alone", (), {"__annotations__": {key: annotation}})
            with contextlib.suppress(Exception):  # a name under TYPE_CHECKING, for instance
                found[key] = typing.get_type_hints(alone, *scopes, include_extras=True)[key]


_BOUNDS = [name for name in dir(msgspec.Meta) if not name.startswith("_")]


def _make_bounds(bounds: dict[str, Any]) -> msgspec.Meta:
    return msgspec.Meta(**bounds)


# -- Structs -------------------------------------------------------------------------------------------------------

_STRUCT_OPTIONS = [name for name in dir(msgspec.structs.StructConfig) if not name.startswith("_")]


def _struct_arguments(cls: Any, arguments: tuple[Any, ...], attributes: dict[str, Any]) -> tuple[Any, ...]:
    """Return cloudpickle's arguments for making the class, with the fields, and a metaclass that adds the options."""
    metaclass, name, bases, namespace, *rest = arguments
    annotations = attributes.get("__annotations__", {})
    own = [field for field in msgspec.structs.fields(cls) if field.name in annotations]
    options = {option: getattr(cls.__struct_config__, option) for option in _STRUCT_OPTIONS}
    options["kw_only"] = any(field.name not in cls.__match_args__ for field in own)
    options["rename"] = {field.name: field.encode_name for field in own}
    defaults = {field.name: (field.default, field.default_factory) for field in own if not field.required}
    make = functools.partial(_make_struct, metaclass, options, defaults)
    namespace = {**namespace, "__annotations__": {field.name: Any for field in own}, "__module__": cls.__module__}
    if "__post_init__" in attributes:
        namespace["__post_init__"] = _post_init
    return (make, name, bases, namespace, *rest)


def _make_struct(
    metaclass: Any,
    options: dict[str, Any],
    defaults: dict[str, tuple[Any, Any]],
    name: str,
    bases: tuple[type, ...],
    namespace: dict[str, Any],
) -> Any:
    field_of: Any = msgspec.field
    for field, (default, factory) in defaults.items():
        namespace[field] = field_of(default=default, default_factory=factory)
    return metaclass(name, bases, namespace, **options)


def _post_init(self: Any) -> None:
    """Call the Struct's own __post_init__, which msgspec looks up once, before the class has it again."""
    self.__post_init__()


# -- the part that cannot be pickled -------------------------------------------------------------------------------


def _refuse(value: object, what: str, error: Exception) -> NoReturn:
    path = what
    above = {id(value)}
    while not _is_too_deep(error) and (found := _failing_part(value, above)) is not None:
        name, value, error = found
        path = f"{path}: {name}"
        above.add(id(value))
    problem = text_of(error).partition(": ")[2]
    if _is_too_deep(error):
        problem = "nested too deeply"
    elif not problem or not isinstance(error, (TypeError, AttributeError, pickle.PicklingError)):
        problem = text_of(error)
    instead = _instead_of(value)
    if instead is None:
        advice = "it has to travel to another process: pass plain data, and make such an object there"
    else:
        advice = f"it cannot leave its process: {instead}"
    raise NotSerializable(f"{path}: {problem}; {advice}", path=path) from error


def _is_too_deep(error: Exception) -> bool:
    return isinstance(error, RecursionError) or isinstance(error.__cause__, RecursionError)


def _failing_part(value: object, above: set[int]) -> tuple[str, object, Exception] | None:
    if _instead_of(value) is not None or _refuses(value):
        return None  # the value's own error says more than an error about one of its parts
    try:
        parts = list(_each_part(value))
    except Exception:  # of the value's own code
        return None
    for name, part in parts:
        if id(part) in above:
            continue  # it contains itself
        try:
            _dumps_by_value(part, resolve=False)
        except Exception as error:
            return name, part, error
    return None


def _refuses(value: object) -> bool:
    try:
        value.__reduce__()
    except NotSerializable:
        return True
    except Exception:
        return False
    return False


def _each_part(value: Any) -> Iterator[tuple[str, object]]:
    if isinstance(value, types.FunctionType):
        found = inspect.getclosurevars(value)
        for kind, names in (("closure variable", found.nonlocals), ("global variable", found.globals)):
            yield from ((f"{kind} {name!r}", part) for name, part in names.items())
        yield from (("a default", part) for part in value.__defaults__ or ())
        yield from (("a default", part) for part in (value.__kwdefaults__ or {}).values())
        yield from _attributes(vars(value))
    elif isinstance(value, types.MethodType):
        yield "its object", value.__self__
        yield "its function", value.__func__
    elif isinstance(value, functools.partial):
        partial = cast("functools.partial[Any]", value)
        yield "its function", partial.func
        yield from ((f"argument {index}", part) for index, part in enumerate(partial.args))
        yield from ((f"argument {name!r}", part) for name, part in partial.keywords.items())
    elif isinstance(value, (list, tuple, set, frozenset)):
        yield from ((f"item {index}", part) for index, part in enumerate(cast("list[Any]", value)))
    elif isinstance(value, dict):
        for key, part in cast("dict[Any, Any]", value).items():
            yield f"key {shown(key)}", key
            yield f"item {shown(key)}", part
    elif isinstance(value, type):
        yield from _attributes(vars(value))
        yield from (("its base", base) for base in value.__bases__)
    elif isinstance(value, (staticmethod, classmethod)):
        yield "its function", cast("Any", value).__func__
    elif isinstance(value, property):
        yield from (("its function", part) for part in (value.fget, value.fset) if part is not None)
    else:
        slots = [name for cls in type(value).__mro__ for name in getattr(cls, "__slots__", ())]
        yield from _attributes({name: getattr(value, name) for name in slots if hasattr(value, name)})
        yield from _attributes(getattr(value, "__dict__", {}))
        yield "its class", type(value)


_NOT_PICKLED = {"__dict__", "__weakref__", "__msgspec_cache__", "__module__", "__doc__"}


def _attributes(names: Mapping[str, Any]) -> Iterator[tuple[str, object]]:
    for name, part in names.items():
        if name not in _NOT_PICKLED and not isinstance(part, types.MemberDescriptorType):
            yield f"attribute {name!r}", part


# -- objects that are of use in their own process only, and what to use instead -------------------------------------
#
# They hold a descriptor, a lock, a thread or a loop. Some can be pickled, as numbers and settings: the copy of a pipe's
# end would close a descriptor of the receiver, and the copy of an asyncio.Event would never be set. Types are known by
# name, so none of their modules has to be imported.

_REPORT = "pass the reference of an actor (self.actor_ref) and tell it what you would send"
_PIPE = f"{_REPORT}; messages between actors need no pipe"
_QUEUE = f"{_REPORT}: an actor's mailbox is the queue"
_LOCK = "let one actor own what the lock protects, and ask that actor"
_EVENT = f"{_REPORT}; or watch for an actor's end with rr_actors.monitor"
_SHARED = "let one actor own the value, and ask that actor; multiprocessing.shared_memory.SharedMemory may travel"
_FUTURE = "send its result (.result(), .get()), or return the future's value from the handler"
_FILE = "send the path and open it there, or send what you have read"
_OPEN_THERE = "send what is needed to open it (an address, a path), and open it there"
_PROCESS = "make what it runs a child of a supervisor (ChildSpec), and send that child's reference"
_ACTOR = "send its reference (actor_ref)"
_PLAIN_REF = (
    "only references of rr_actors reach other processes: derive the actor from rr_actors.Actor, or make it a child "
    "(ChildSpec) and send what system.ref(id) returns"
)
_LAZY = "send a list of what it yields"

_INSTEAD: dict[str, str | None] = {
    "_io.StringIO": None,
    "_io.BytesIO": None,
    "multiprocessing.connection._ConnectionBase": _PIPE,
    "multiprocessing.connection.Listener": _OPEN_THERE,
    "multiprocessing.queues.Queue": _QUEUE,
    "multiprocessing.queues.SimpleQueue": _QUEUE,
    "multiprocessing.synchronize.SemLock": _LOCK,
    "multiprocessing.synchronize.Condition": _LOCK,
    "multiprocessing.synchronize.Event": _EVENT,
    "multiprocessing.sharedctypes.SynchronizedBase": _SHARED,
    "multiprocessing.process.BaseProcess": _PROCESS,
    "multiprocessing.pool.Pool": _PROCESS,
    "multiprocessing.managers.BaseManager": "send its proxies (manager.dict(), manager.Queue()), which may travel",
    "_socket.socket": _OPEN_THERE,
    "sqlite3.Connection": _OPEN_THERE,
    "sqlite3.Cursor": _OPEN_THERE,
    "subprocess.Popen": _PROCESS,
    "mmap.mmap": _SHARED,
    "_io._IOBase": _FILE,
    "tempfile._TemporaryFileWrapper": _FILE,
    "_thread.lock": _LOCK,
    "_thread.RLock": _LOCK,
    "threading.Condition": _LOCK,
    "threading.Semaphore": _LOCK,
    "threading.Barrier": _LOCK,
    "threading.Event": _EVENT,
    "threading.Thread": _PROCESS,
    "queue.Queue": _QUEUE,
    "_queue.SimpleQueue": _QUEUE,
    "asyncio.locks.Lock": _LOCK,
    "asyncio.locks.Condition": _LOCK,
    "asyncio.locks.Semaphore": _LOCK,
    "asyncio.locks.Barrier": _LOCK,
    "asyncio.locks.Event": _EVENT,
    "asyncio.queues.Queue": _QUEUE,
    "_asyncio.Future": _FUTURE,
    "asyncio.futures.Future": _FUTURE,
    "concurrent.futures._base.Future": _FUTURE,
    "concurrent.futures._base.Executor": _PROCESS,
    "pykka._future.Future": _FUTURE,
    "pykka._actor.Actor": _ACTOR,
    "pykka._ref.ActorRef": _PLAIN_REF,
    "builtins.generator": _LAZY,
    "builtins.coroutine": "await it here, and send its result",
}

_STREAMS = ("stdin", "stdout", "stderr", "__stdin__", "__stdout__", "__stderr__")

_known: weakref.WeakKeyDictionary[type, str | None] = weakref.WeakKeyDictionary()


def _instead_of(value: object) -> str | None:
    """Return what to use instead of `value`, if it cannot leave its process; None if it can."""
    cls = type(value)
    try:
        hint = _known[cls]
    except KeyError:
        hint = _known[cls] = _hint(cls)
    if hint is _FILE and any(value is getattr(sys, name, None) for name in _STREAMS):
        return None  # travels as "the standard output of the process it comes to"
    return hint


def _hint(cls: type) -> str | None:
    for base in cls.__mro__:
        name = f"{base.__module__}.{base.__qualname__}"
        if name in _INSTEAD:
            return _INSTEAD[name]
        if base.__module__ not in _MODULES and not _TAUGHT.isdisjoint(vars(base)):
            return None  # this class has pickling code of its own
    return None


_TAUGHT = {"__reduce__", "__reduce_ex__", "__getstate__"}
_MODULES = {name.rpartition(".")[0] for name in _INSTEAD} | {"socket", "builtins"}
