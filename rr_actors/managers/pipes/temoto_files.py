"""TeMoto's files: components.yaml and pipes.yaml of temoto_component_manager, made into a file for Pipes.

A components.yaml has the key Components: a list of ROS programs with the topics that they take and give, by type. Each
other file is a pipes.yaml: for each type of pipe a list of methods, each with its segments. Types keep their spelling.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, cast

import msgspec
import yaml

from rr_actors.base.errors import ConfigError, shown
from rr_actors.base.folder import read_plain
from rr_actors.base.toml import convert_typed, wrong
from rr_actors.managers.pipes.pipe_files import TYPE_EXPECTED, SegmentDescription, check_ends, is_type
from rr_actors.managers.templates import Parameter, plain

_FIELDS = {"inputs": "input_topic_types", "outputs": "output_topic_types"}
_LAUNCH = ".launch"


class TemotoComponent(msgspec.Struct, frozen=True):
    """One entry of Components. Each topic has its type and its name; a parameter its value, if nobody gives another."""

    component_name: str
    component_type: str
    package_name: str
    executable: str
    description: str = ""
    reliability: Annotated[float, msgspec.Meta(ge=0, le=1)] = 1.0
    input_topics: dict[str, Parameter] | None = None
    output_topics: dict[str, Parameter] | None = None
    required_parameters: dict[str, Parameter] | None = None


class TemotoSegment(msgspec.Struct, frozen=True):
    """One segment of a method, which any component of the type can be."""

    segment_type: str
    input_topic_types: list[str] | None = None
    output_topic_types: list[str] | None = None
    required_parameters: list[str] | None = None

    def description(self) -> SegmentDescription:
        """Return the segment as a file for Pipes has it. Its parameters are those of its component."""
        return SegmentDescription(self.segment_type, self.input_topic_types or [], self.output_topic_types or [])


class TemotoMethod(msgspec.Struct, frozen=True):
    """One way to build a pipe."""

    method: Annotated[list[TemotoSegment], msgspec.Meta(min_length=1)]


def import_temoto(files: Sequence[Path]) -> str:
    """Return the TOML text of a file for Pipes that has what is in these files, the components first.

    What such a file cannot have is left out, and a comment says so.

    Raises:
        ConfigError: a file cannot be read, is no YAML, or is wrong. `.file`, `.key`, `.expected`, `.got`
    """
    components: list[str] = []
    pipes: list[str] = []
    names: set[str] = set()
    for path in files:
        file, content = str(path), _read(path)
        try:
            if "Components" in content:
                components += _components(file, content, names)
            else:
                pipes += _pipes(file, content)
            "".join(components + pipes).encode()
        except UnicodeEncodeError as error:  # an escape has made half a character
            raise _unread(file, "not valid YAML", str(error), "text of whole characters") from error
    return "\n".join(components + pipes)


def _read(path: Path) -> dict[str, Any]:
    file = str(path)
    try:
        content: object = yaml.safe_load(read_plain(path))
    except OSError as error:
        raise _unread(file, "cannot be read", error.strerror or str(error), "a YAML file") from error
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        problem = "nested too deeply" if isinstance(error, RecursionError) else " ".join(str(error).split())
        raise _unread(file, "not valid YAML", problem, "valid YAML") from error
    return convert_typed(content, file, dict[str, Any])


def _unread(file: str, what: str, problem: str, expected: str) -> ConfigError:
    text = f"{file}: {what}: {problem}; expected {expected}"
    return ConfigError(text, file=file, key=None, expected=expected, got=problem)


# -- components ----------------------------------------------------------------------------------------------------


def _components(file: str, content: Mapping[str, object], names: set[str]) -> Iterator[str]:
    for key in content:
        if key != "Components":
            yield _left_out(file, key)
    entries = convert_typed(content["Components"], file, list[TemotoComponent], "Components")
    for i, (one, raw) in enumerate(zip(entries, cast("list[dict[str, object]]", content["Components"]), strict=True)):
        key = f"Components[{i}]"
        if one.component_name in names:
            expected, said = "a name that no other component has", f"{shown(one.component_name)} again"
            raise wrong(file, f"{key}.component_name", expected, one.component_name, said=said)
        names.add(one.component_name)
        _check_names(file, key, one)
        yield from _unknown(file, key, raw, TemotoComponent)
        yield _component(one)


def _check_names(file: str, key: str, one: TemotoComponent) -> None:
    topics = ("input_topics", one.input_topics), ("output_topics", one.output_topics)
    for field, named in (*topics, ("required_parameters", one.required_parameters)):
        for name in named or {}:
            if not is_type(name):
                raise wrong(file, f"{key}.{field}", TYPE_EXPECTED, name)


def _component(one: TemotoComponent) -> str:
    """Return the table of a component: a ROS program, whose topics are remapped as TeMoto does it."""
    inputs, outputs = one.input_topics or {}, one.output_topics or {}
    topics = {f"input_{type}": topic for type, topic in inputs.items()}
    topics |= {f"output_{type}": topic for type, topic in outputs.items()}
    is_launch = one.executable.endswith(_LAUNCH)
    names = {name: name.partition("_")[2] if is_launch else plain(topic) for name, topic in topics.items()}
    parameters = one.required_parameters or {}
    mapped = {**names, **{name: name for name in parameters}}
    arguments = [_literal(one.package_name), _literal(one.executable)]
    arguments += [f"{_literal(to)}:=${{{name}}}" for name, to in mapped.items()]
    return "\n".join(
        [
            *(f"# {line}" for line in one.description.splitlines()),
            "[[component]]",
            f"name = {_toml(one.component_name)}",
            f"type = {_toml(one.component_type)}",
            f"reliability = {one.reliability}",
            f"inputs = {_list(inputs)}",
            f"outputs = {_list(outputs)}",
            f"defaults = {_table({**topics, **parameters})}",
            "",
            "[component.program]",
            f"command = {_toml('roslaunch' if is_launch else 'rosrun')}",
            f"arguments = {_list(arguments)}",
            "",
        ]
    )


def _literal(text: str) -> str:
    return text.replace("$", "$$")


# -- pipes ---------------------------------------------------------------------------------------------------------


def _pipes(file: str, content: Mapping[str, object]) -> Iterator[str]:
    for type, value in content.items():
        methods = convert_typed(value, file, list[TemotoMethod], type)
        for i, (one, raw) in enumerate(zip(methods, cast("list[dict[str, Any]]", value), strict=True)):
            key = f"{type}[{i}]"
            yield from _unknown(file, key, raw, TemotoMethod)
            for n, segment in enumerate(raw["method"]):
                yield from _unknown(file, f"{key}.method[{n}]", segment, TemotoSegment)
            segments = [segment.description() for segment in one.method]
            _check_method(file, f"{key}.method", segments)
            yield _pipe(type, segments)


def _check_method(file: str, key: str, segments: Sequence[SegmentDescription]) -> None:
    def wrong_at(i: int, field: str, expected: str, got: object) -> ConfigError:
        return wrong(file, f"{key}[{i}].{_FIELDS[field]}", expected, got)

    check_ends(segments, wrong_at)


def _pipe(type: str, segments: Sequence[SegmentDescription]) -> str:
    lines = ["[[pipe]]", f"type = {_toml(type)}", ""]
    for one in segments:
        lines += ["[[pipe.segment]]", f"type = {_toml(one.type)}"]
        lines += [f"inputs = {_list(one.inputs)}", f"outputs = {_list(one.outputs)}", ""]
    return "\n".join(lines)


# -- texts ---------------------------------------------------------------------------------------------------------


def _unknown(file: str, key: str, raw: Mapping[str, object], kind: type[msgspec.Struct]) -> Iterator[str]:
    """Return a comment for each key that is left out."""
    known = {field.encode_name for field in msgspec.structs.fields(kind)}
    for name in raw:
        if name not in known:
            yield _left_out(file, f"{key}.{name}")


def _left_out(file: str, key: str) -> str:
    return f"# left out: {_toml(f'{file}: {key}')}\n"


def _toml(value: Parameter) -> str:
    """Return a value as TOML. Its strings are those of JSON, except for one character."""
    if isinstance(value, float):
        return repr(value)
    return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")


def _list(values: Iterable[Parameter]) -> str:
    return f"[{', '.join(map(_toml, values))}]"


def _table(values: Mapping[str, Parameter]) -> str:
    return f"{{ {', '.join(f'{name} = {_toml(value)}' for name, value in values.items())} }}" if values else "{}"
