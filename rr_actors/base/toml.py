"""TOML: the one place that reads it. Every fault is a ConfigError, also a fault that the standard library accepts.

The errors for wrong keys and values are made here, too, for files and for arguments. parse_typed() makes a msgspec
Struct of a file. The end reads supervision trees.

msgspec imports the standard library's reader when the first file is read: most programs read none.
"""

from __future__ import annotations

import dataclasses
import functools
import importlib
import os
import re
from collections.abc import Collection, Iterator, Mapping, Sequence
from typing import Annotated, Any, Literal, TypeVar, cast, get_args, get_origin

import msgspec

from rr_actors.base.checks import path_text
from rr_actors.base.errors import ConfigError, InvalidSpec, did_you_mean, shortened, shown
from rr_actors.base.folder import read_plain

_T = TypeVar("_T")
_INTEGERS = range(-(2**63), 2**63)  # the range that TOML requires of a reader


def wrong(
    file: str | None, key: str, expected: str, got: object, *, where: str = "from_toml", said: str | None = None
) -> ConfigError:
    """Return the error for the value of a key in the file, or, without a file, in the arguments of `where`.

    An empty key means the whole file. The text shows `said`, or else the value and its type.
    """
    if said is None:
        said = shown(got) if got is None else f"{shown(got)} ({type(got).__name__})"
    place = ": ".join(filter(None, (file or where, shortened(key))))
    return ConfigError(f"{place}: expected {expected}, got {said}", file=file, key=key, expected=expected, got=got)


def raise_faults(faults: Sequence[ConfigError]) -> None:
    """Raise the error for all that is wrong; its attributes are of the first fault. Do nothing if there is none."""
    if len(faults) > 1:
        first = faults[0]
        text = "\n".join([f"{len(faults)} faults:", *(f"  {fault}" for fault in faults)])
        raise ConfigError(text, **first.details)
    for fault in faults:
        raise fault


def check_keys(table: Collection[str], known: Collection[str], file: str, prefix: str = "") -> None:
    """Check that each key of the table at `prefix` ("registrars.cameras.") is known.

    The text of the ConfigError has a similar known key.
    """
    for key in table:
        if key not in known:
            raise unknown_key(key, known, file, prefix)


def unknown_key(key: str, known: Collection[str], file: str, prefix: str = "") -> ConfigError:
    """Return the error for a key that the table at `prefix` cannot have."""
    said = f"an unknown key{did_you_mean(key, known)}"
    return wrong(file, prefix + key, f"one of {', '.join(known)}", key, said=said)


def file_name(path: object) -> str:
    """Return the path of a TOML file as text; raise ConfigError if `path` is no path."""
    text = path_text(path)
    if text == "":
        raise wrong(None, "path", "the path of a TOML file", path)
    return text


def read_toml(file: str) -> dict[str, Any]:
    """Return the content of the TOML file at this path; raise ConfigError if it cannot be read, or parsed."""
    return parse_toml(read_bytes(file), file)


def read_bytes(file: str) -> bytes:
    """Return the bytes of the TOML file at this path; raise ConfigError if it cannot be read."""
    try:
        return read_plain(file)
    except (OSError, ValueError) as error:  # ValueError: no file has such a name
        problem = getattr(error, "strerror", None) or str(error)
        raise ConfigError(
            f"{file}: cannot be read: {problem}; expected a TOML file",
            file=file,
            key=None,
            expected="a TOML file",
            got=problem,
        ) from error


def parse_toml(data: bytes, file: str) -> dict[str, Any]:
    """Decode the bytes of a TOML file called `file`.

    Raise ConfigError if they are not UTF-8 text or not TOML (the error has the line), are nested too deeply, or have a
    whole number that does not fit into 64 bits.
    """
    try:
        table = msgspec.toml.decode(data.decode())
        _check_integers(table)
        return table
    except (ValueError, RecursionError) as error:
        lines = len(data.splitlines()) or 1
        problem = str(error).replace("(at end of document)", f"(at line {lines}, end of the file)")
        if isinstance(error, RecursionError):
            problem = "nested too deeply"
        elif isinstance(error, UnicodeDecodeError):
            line = data[: error.start].count(b"\n") + 1
            problem = f"not UTF-8 text (at line {line})"
        raise ConfigError(
            f"{file}: not valid TOML: {problem}", file=file, key=None, expected="valid TOML", got=problem
        ) from error


def _check_integers(value: object) -> None:
    if isinstance(value, dict):
        for inner in cast("dict[str, object]", value).values():
            _check_integers(inner)
    elif isinstance(value, list):
        for inner in cast("list[object]", value):
            _check_integers(inner)
    elif isinstance(value, int) and value not in _INTEGERS:
        raise ValueError("a whole number that does not fit into 64 bits")


# -- tables with a type ----------------------------------------------------------------------------------------------

_BETWEEN_TICKS = re.compile("`([^`]+)`")


def parse_typed(data: bytes, file: str, kind: type[_T]) -> _T:
    """Return the bytes of a TOML file called `file` as a `kind`, a msgspec Struct.

    Raises:
        ConfigError: they are no TOML, or keys are unknown, missing or of the wrong type: the text has all of them.
            `.file`, `.key`, `.expected`, `.got` are of the first.
    """
    return convert_typed(parse_toml(data, file), file, kind)


def convert_typed(value: object, file: str, kind: type[_T], key: str = "") -> _T:
    """Return a value that stands at `key` in a file as a `kind`; raise ConfigError as parse_typed() does."""
    try:
        return msgspec.convert(value, kind)
    except msgspec.ValidationError as error:
        raise_faults([*_faults(value, kind, file, key)])
        raise _wrong_at(value, kind, file, error, key) from error


def _faults(value: object, kind: Any, file: str, key: str) -> Iterator[ConfigError]:
    """Yield what is wrong in the parts of a value, in their order; or, if they are right, in the whole."""
    is_right = True
    for fault in _faults_of_parts(value, kind, file, key):
        is_right = False
        yield fault
    if is_right:
        try:
            msgspec.convert(value, kind)
        except msgspec.ValidationError as error:
            yield _wrong_at(value, kind, file, error, key)


def _faults_of_parts(value: object, kind: Any, file: str, key: str) -> Iterator[ConfigError]:
    if get_origin(kind) is Annotated:
        kind = get_args(kind)[0]
    struct, items = _struct_in(kind), [one for one in get_args(kind) if one is not ...]
    if struct is not None and isinstance(value, dict):
        yield from _faults_of_table(cast("dict[str, object]", value), struct, file, key)
    elif get_origin(kind) is dict and isinstance(value, dict):
        for name, inner in cast("dict[str, object]", value).items():
            yield from _faults(inner, items[-1], file, f"{key}.{name}".removeprefix("."))
    elif get_origin(kind) in (list, tuple) and len(items) == 1 and isinstance(value, list):
        for i, inner in enumerate(cast("list[object]", value)):
            yield from _faults(inner, items[0], file, f"{key}[{i}]")


def _faults_of_table(table: dict[str, object], struct: Any, file: str, key: str) -> Iterator[ConfigError]:
    fields = {field.encode_name: field for field in msgspec.structs.fields(struct)}
    prefix = f"{key}." if key else ""
    for name, value in table.items():
        if name in fields:
            yield from _faults(value, fields[name].type, file, prefix + name)
        elif struct.__struct_config__.forbid_unknown_fields:
            yield unknown_key(name, list(fields), file, prefix)
    for name, field in fields.items():
        if field.required and name not in table:
            yield wrong(file, key, f"the key {name}", table, said="none")


def _wrong_at(value: object, kind: Any, file: str, error: msgspec.ValidationError, key: str) -> ConfigError:
    """Return the error for msgspec's text about a value, such as "Expected `int`, got `str`".

    A Struct that checks itself has said which of its fields is wrong.
    """
    if isinstance(error.__cause__, InvalidSpec):
        details = error.__cause__.details
        return wrong(file, f"{key}.{details['field']}".removeprefix("."), details["expected"], details["got"])
    problem = str(error).partition(" - at `")[0]
    expected = _BETWEEN_TICKS.sub(_in_toml, problem.removeprefix("Expected ").partition(", got ")[0])
    if problem.startswith("Invalid enum value"):  # msgspec does not say which there are
        literal = next((one for one in (kind, *get_args(kind)) if get_origin(one) is Literal), None)
        expected = f"one of {', '.join(map(str, get_args(literal)))}" if literal else expected
    return wrong(file, key, expected, value)


def _in_toml(found: re.Match[str]) -> str:
    """Return "`object | null`" in the words of TOML, "a table"."""
    names = [name for name in found[1].split(" | ") if name != "null"]
    return " or ".join({"object": "a table", "array": "a list"}.get(name, f"`{name}`") for name in names)


def _struct_in(kind: Any) -> Any:
    """Return the Struct that a type is, or allows beside None; None for a list, a tuple or a mapping."""
    if get_origin(kind) in (list, tuple, dict):
        return None
    kinds = [one for one in (kind, *get_args(kind)) if isinstance(one, type)]
    return next((one for one in kinds if issubclass(one, msgspec.Struct)), None)


# -- supervision trees -----------------------------------------------------------------------------------------------
#
# A table with `children` is a Supervisor, one with `actor` a ChildSpec::
#
#     id = "root"
#     strategy = "rest_for_one"
#
#     [[children]]
#     actor = "robots.cameras:Cameras"       # module:class
#     id = "cameras"
#     kwargs = { quality = "low" }
#     backoff = { delay_s = 0.1, maximum_s = 10.0 }
#
#     [[children]]
#     id = "arms"                            # a supervisor below the first
#     max_restarts = 1
#
#     [[children.children]]
#     actor = "robots.arms:Arm"
#     args = ["left"]
#
# Every other key is a field of the same name of ChildSpec, Supervisor or Backoff. The table [hosts] is no part of the
# tree: Hosts.from_toml() reads it from the same file.

FilePath = str | os.PathLike[str]
_ACTOR = "actor_class_or_manager"  # ChildSpec's field for the key `actor`


def read_supervisor(path: FilePath, supervisor: type[_T], child: type[Any], backoff: type[Any]) -> _T:
    """Read the tree in a file, made of these three classes: supervision/core/specs.py passes them, so that this module
    need not import a core.
    """
    file = file_name(path)
    table = read_toml(file)
    table.pop("hosts", None)  # Hosts.from_toml() reads it
    reader = _Reader(file, supervisor, child, backoff)
    reader.check_keys(supervisor, "", table)
    if "children" not in table:
        raise wrong(file, "children", "a list of tables, [[children]]", None)
    return reader.supervisor_at("", table)


def parse_child(text: bytes, file: str, supervisor: type[Any], child: type[_T], backoff: type[Any]) -> _T | Any:
    """Make the child or supervisor in the text of a TOML file called `file`, of these three classes."""
    return _Reader(file, supervisor, child, backoff).child_at("", parse_toml(text, file))


class _Reader:
    def __init__(self, file: str, supervisor: type[Any], child: type[Any], backoff: type[Any]) -> None:
        self.file, self.supervisor, self.child, self.backoff = file, supervisor, child, backoff

    def supervisor_at(self, key: str, table: Mapping[str, Any]) -> Any:
        children = table["children"]
        if not isinstance(children, list):
            raise wrong(self.file, f"{key}children", "a list of tables, [[children]]", children)
        entries = enumerate(cast("list[object]", children))
        made = [self.child_at(f"{key}children[{index}].", entry) for index, entry in entries]
        return self._make(self.supervisor, key, {**table, "children": made})

    def child_at(self, key: str, table: object) -> Any:
        """Make the child or supervisor in a table; `key` is the prefix of the table's keys, "children[0]."."""
        if not isinstance(table, dict):
            raise wrong(self.file, key.rstrip("."), "a table", table)
        fields = dict(cast("dict[str, Any]", table))
        if ("children" in fields) == ("actor" in fields):
            got = "both" if "actor" in fields else "neither"
            raise wrong(self.file, key.rstrip("."), "either actor = 'module:class' or children", got, said=got)
        if "children" in fields:
            return self.supervisor_at(key, fields)
        fields["actor"] = self._class_at(f"{key}actor", fields["actor"])
        if "backoff" in fields:
            backoff = fields["backoff"]
            if not isinstance(backoff, dict):
                raise wrong(self.file, f"{key}backoff", "a table", backoff)
            fields["backoff"] = self._make(self.backoff, f"{key}backoff.", cast("dict[str, Any]", backoff))
        return self._make(self.child, key, fields)

    def _class_at(self, key: str, name: object) -> type[Any]:
        expected = "'module:class', a class that can be imported"
        if not isinstance(name, str) or name.count(":") != 1:
            raise wrong(self.file, key, expected, name)
        try:
            module, _, path_in_it = name.partition(":")
            found = functools.reduce(getattr, path_in_it.split("."), cast(object, importlib.import_module(module)))
        except (Exception, SystemExit) as error:  # importing runs the module: it may raise anything
            said = shortened(f"{shown(name)} ({type(error).__name__}: {error})")
            raise wrong(self.file, key, expected, name, said=said) from error
        if not isinstance(found, type):
            raise wrong(self.file, key, expected, name, said=f"{shown(name)}, which is not a class")
        return cast("type[Any]", found)

    def check_keys(self, cls: type[Any], key: str, fields: Mapping[str, Any]) -> None:
        """Check that each key is a field of the class."""
        known = [_in_file(field.name) for field in dataclasses.fields(cls)]
        check_keys(fields, known, self.file, key)

    def _make(self, cls: type[Any], key: str, fields: Mapping[str, Any]) -> Any:
        self.check_keys(cls, key, fields)
        try:
            return cls(**{_ACTOR if name == "actor" else name: value for name, value in fields.items()})
        except InvalidSpec as error:
            details = error.details
            raise wrong(self.file, key + _in_file(details["field"]), details["expected"], details["got"]) from error


def _in_file(field: str) -> str:
    return "actor" if field == _ACTOR else field
