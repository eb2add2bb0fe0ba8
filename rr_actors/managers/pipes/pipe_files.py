"""Pipe files: the registry of components with what each takes and gives, and the pipes that it describes.

A registry as Components reads it, with two more keys for a component, and tables of pipes, which it may leave out::

    [[component]]
    name = "front-camera"
    type = "2d_camera"
    outputs = ["camera_data"]                            # types of data; the one after takes some of them

    [component.program]
    command = "${python}"
    arguments = ["-m", "robot.camera", "--publish", "${output_camera_data}"]

    [[component]]
    name = "tag-tracker"
    type = "tracker"
    inputs = ["camera_data"]                             # all of this is given by the component before
    outputs = ["tags"]

    [component.program]
    command = "${python}"
    arguments = ["-m", "robot.tracker", "${input_camera_data}", "${output_tags}"]

    [[pipe]]                                             # without this, "tags" is what any chain ends in
    type = "tag_tracking"

    [[pipe.segment]]
    type = "2d_camera"
    outputs = ["camera_data"]

    [[pipe.segment]]
    type = "tracker"
    inputs = ["camera_data"]
    outputs = ["tags"]
"""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from itertools import pairwise
from pathlib import Path

import msgspec

from rr_actors.base.errors import ConfigError
from rr_actors.base.toml import parse_typed, wrong
from rr_actors.managers.components import ComponentDescription, check_components
from rr_actors.managers.pipes.chains import ChainComponent, PipeStep, Way
from rr_actors.managers.planning.last_good import last_good_file
from rr_actors.registrar.manager import Beginning

TYPE_EXPECTED = "a name of letters, digits and _"

_NAME = re.compile(r"\w+", re.ASCII)  # a template may name it


class PipeComponent(ComponentDescription, frozen=True, forbid_unknown_fields=True):
    """A component with the types of data that it takes and gives."""

    inputs: tuple[str, ...] = ()
    outputs: tuple[str, ...] = ()

    def link(self, trust: float) -> ChainComponent:
        """Return the component as the planner sees it."""
        return ChainComponent(self.name, self.type, frozenset(self.inputs), frozenset(self.outputs), trust)


class SegmentDescription(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """One segment of a pipe: a component of the type that takes and gives at least this."""

    type: str
    inputs: list[str] = []
    outputs: list[str] = []


class PipeDescription(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """One way to build a pipe of the type. Several may have the same type."""

    type: str
    segment: list[SegmentDescription]

    def way(self) -> Way:
        """Return the segments as the planner sees them."""
        return tuple(PipeStep(one.type, frozenset(one.inputs), frozenset(one.outputs)) for one in self.segment)


class PipeFile(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The whole file."""

    component: list[PipeComponent]
    pipe: list[PipeDescription] = []


WrongAt = Callable[[int, str, str, object], ConfigError]
"""Makes the error for a segment: its number, "inputs" or "outputs", what was expected there, and the value."""


def read_pipe_file(path: Path, beginning: Beginning | None = None) -> PipeFile:
    """Read the file, after a crash the last good one.

    Check that names are different, and that the ends of the segments of each pipe meet.

    Raises:
        ConfigError: the file cannot be read, or is wrong. `.file`, `.key`, `.expected`, `.got`
    """
    return last_good_file(beginning, path, _parse_pipe_file).now


def _parse_pipe_file(data: bytes, name: str) -> PipeFile:
    path, file = Path(name), parse_typed(data, name, PipeFile)
    check_components(name, file.component)
    for i, component in enumerate(file.component):
        _check_types(path, f"component[{i}].inputs", component.inputs)
        _check_types(path, f"component[{i}].outputs", component.outputs)
    for i, pipe in enumerate(file.pipe):
        _check_pipe(path, f"pipe[{i}].segment", pipe.segment)
    return file


def _check_types(path: Path, key: str, types: Sequence[str]) -> None:
    for i, type in enumerate(types):
        if not is_type(type):
            raise wrong(str(path), f"{key}[{i}]", TYPE_EXPECTED, type)


def _check_pipe(path: Path, key: str, segments: Sequence[SegmentDescription]) -> None:
    if not segments:
        raise wrong(str(path), key, "at least one segment", segments, said="none")
    check_ends(segments, lambda i, field, expected, got: wrong(str(path), f"{key}[{i}].{field}", expected, got))


def is_type(type: str) -> bool:
    """Return whether a type of data can be named in templates, as `${input_TYPE}`."""
    return _NAME.fullmatch(type) is not None


def check_ends(segments: Sequence[SegmentDescription], wrong_at: WrongAt) -> None:
    """Check that each segment takes what the one before gives, and that the last gives something.

    Raises:
        ConfigError: the ends of two segments do not meet, or the pipe has no beginning or end.
    """
    if segments[0].inputs:
        raise wrong_at(0, "inputs", "no inputs, as nothing comes before the first segment", segments[0].inputs)
    for i, (before, one) in enumerate(pairwise(segments), start=1):
        given = ", ".join(before.outputs) or "none"
        if not one.inputs or not set(one.inputs) <= set(before.outputs):
            raise wrong_at(i, "inputs", f"outputs of the segment before it ({given})", one.inputs)
    if not segments[-1].outputs:
        raise wrong_at(len(segments) - 1, "outputs", "at least one output of the last segment", segments[-1].outputs)
