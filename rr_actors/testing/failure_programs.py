"""A scenario as a program that can be run as it stands."""

from __future__ import annotations

import base64
import dataclasses
import enum
import importlib.util
import math
import pprint
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, cast

import msgspec

from rr_actors.base import pickling
from rr_actors.supervision.core.specs import ChildSpec, Supervisor
from rr_actors.testing.scenario_notes import Fault
from rr_actors.testing.scenario_steps import STEPS, Step

_PLAIN = (type(None), bool, int, float, str, bytes)
_WIDTH = 100
_NAMES = ("Path", "base64", "programs", "sys", "play_steps", *(step.__name__ for step in STEPS))
"""What a program has from elsewhere."""


class _Source:
    """Writes values as source code, and remembers what the program imports for them."""

    def __init__(self) -> None:
        self.imports: set[str] = set()
        self.files: dict[str, str] = {}
        self._modules = dict.fromkeys(_NAMES, "")  # by the names that are imported from them

    def of(self, value: object) -> str:
        """Return an expression for a value; of one that has none, the value's bytes."""
        try:
            return self._of(value)
        except _NoSource:
            self.imports.add("import base64, rr_actors.testing.failure_programs as programs")
            return f"programs.value({base64.b85encode(pickling.dumps(value)).decode()!r})"

    def _of(self, value: object) -> str:
        if type(value) is float and not math.isfinite(value):
            return f"float({str(value)!r})"
        if type(value) in _PLAIN:
            return repr(value)
        if isinstance(value, type):
            return self._named(value)
        if isinstance(value, enum.Enum):
            if value.name not in type(value).__members__:  # several flags
                return f"{self._named(type(value))}({self._of(value.value)})"
            return f"{self._named(type(value))}.{value.name}"
        if type(value) in (list, tuple, set):
            items = [self._of(item) for item in cast("Sequence[object]", value)]
            if type(value) is tuple:
                return f"({', '.join(items)}{',' if len(items) == 1 else ''})"
            return f"[{', '.join(items)}]" if type(value) is list else f"{{{', '.join(items)}}}" if items else "set()"
        if type(value) is dict:
            pairs = cast("dict[object, object]", value).items()
            return f"{{{', '.join(f'{self._of(key)}: {self._of(item)}' for key, item in pairs)}}}"
        if isinstance(value, Path):
            self.imports.add("from pathlib import Path")
            return f"Path({str(value)!r})"
        return f"{self._named(type(value))}({', '.join(self._fields(value))})"

    def _fields(self, value: object) -> list[str]:
        if dataclasses.is_dataclass(value):
            fields = {
                field.name: (getattr(value, field.name), field.default, field.default_factory)
                for field in dataclasses.fields(value)
                if field.init
            }
            missing = dataclasses.MISSING
        elif isinstance(value, msgspec.Struct):
            fields = {
                field.name: (getattr(value, field.name), field.default, field.default_factory)
                for field in msgspec.structs.fields(value)
            }
            missing = msgspec.NODEFAULT
        else:
            raise _NoSource
        written: list[str] = []
        for name, (given, default, factory) in fields.items():
            if default is missing and factory is missing and isinstance(value, Step):
                written.append(self.of(given))
            elif not (default is not missing and given == default) and not (
                factory is not missing and given == cast("Any", factory)()
            ):
                written.append(f"{name}={self._of(given)}")
        return written

    def _named(self, cls: type) -> str:
        """Return the name of a class, which the program imports."""
        module, name = cls.__module__, cls.__qualname__
        if "<" in name:
            raise _NoSource
        if module == "builtins":
            return name
        if module == "__main__":
            file = getattr(sys.modules["__main__"], "__file__", None)
            if file is None:
                raise _NoSource
            path = Path(file).resolve()
            module = path.stem
            self.files[module] = str(path)
        elif not _can_be_imported(module):
            raise _NoSource
        first, _, rest = name.partition(".")
        if self._modules.setdefault(first, module) != module:
            raise _NoSource  # the program has another one of this name
        self.imports.add(f"from {module} import {first}")
        if (
            file := getattr(sys.modules.get(module.partition(".")[0]), "__file__", None)
        ) and "site-packages" not in file:
            self.files.setdefault(module.partition(".")[0], file)
        return f"{first}.{rest}" if rest else first


def _can_be_imported(module: str) -> bool:
    try:
        return importlib.util.find_spec(module) is not None
    except (ImportError, ValueError):  # a package above it is none, or it has no spec
        return False


class _NoSource(Exception):
    """A value cannot be written as an expression."""


def value(text: str) -> Any:
    """Return the value that a program has as bytes."""
    return pickling.loads(base64.b85decode(text))


def program_of(
    child: ChildSpec,
    steps: Sequence[Step],
    fault: Fault,
    *,
    beside: Sequence[ChildSpec | Supervisor],
    callback_s: float,
    options: Mapping[str, object],
) -> str:
    """Return the source of a program that plays the steps, and ends with the fault.

    Args:
        options: arguments of play_steps() that differ from their defaults, beside these.
    """
    source = _Source()
    bare = child == ChildSpec(child.actor_class_or_manager, id=child.id) and child.id == default_id(child)
    manager = source.of(child.actor_class_or_manager if bare else child)
    played = "".join(f"            {_written(source, step)},\n" for step in steps)
    more = "".join(f"        {name}={source.of(given)},\n" for name, given in options.items())
    others = f"        beside={source.of(list(beside))},\n" if beside else ""
    names = sorted({type(step).__name__ for step in steps} | {"play_steps"}, key=str.lower)
    source.imports = {line for line in source.imports if not line.startswith("from rr_actors.testing.scenario_steps")}
    imports = "\n".join(sorted({*source.imports, f"from rr_actors.testing import {', '.join(names)}"}))
    paths = sorted({str(_root(module, file)) for module, file in source.files.items() if module != "rr_actors"})
    path = f"import sys\n\nsys.path[:0] = {pprint.pformat(paths, width=_WIDTH)}\n\n" if paths else ""
    return (
        f'"""{fault.promise}: broken. Found by rr_actors.testing.check_manager()."""\n\n{path}{imports}\n\n'
        'if __name__ == "__main__":\n'
        f"    play_steps(\n        {manager},\n        [\n{played}        ],\n"
        f"{others}        callback_s={callback_s!r},\n{more}    )\n"
    )


def default_id(child: ChildSpec) -> str:
    """Return the id that a manager has if none is given."""
    return getattr(child.actor_class_or_manager, "__name__", "").lower()


def written(step: Step) -> str:
    """Return a step as source code."""
    return _written(_Source(), step)


def _written(source: _Source, step: Step) -> str:
    return f"{type(step).__name__}({', '.join(source._fields(step))})"  # pyright: ignore[reportPrivateUsage] - same file


def _root(module: str, file: str) -> Path:
    """Return the directory from which a module or package is imported."""
    path = Path(file).resolve()
    return path.parent.parent if path.name == "__init__.py" else path.parent
