"""TeMoto's files of components and pipes: each becomes a file that Pipes reads, or is refused by name."""

from __future__ import annotations

from pathlib import Path

import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st

import rr_actors as rr
from rr_actors.managers.pipes.pipe_files import PipeFile, read_pipe_file
from rr_actors.managers.pipes.temoto_files import import_temoto

COMPONENTS = """
Components:
- component_name: "Front camera"
  component_type: "2d_camera"
  package_name: "robot_eyes"
  executable: "front.launch"
  description: "Needs light"
  output_topics:
    camera_data: "front/image"
    camera_info: "front/info"
  required_parameters:
    frame_id: "front_link"
    rate: 30

- component_name: "Tag finder"
  component_type: "tag_finder"
  package_name: "robot_eyes"
  executable: "find_tags"
  reliability: 0.75
  input_topics:
    camera_data: "image_in"
  output_topics:
    tag_data: "tags_out"
"""
PIPES = """
tag_tracking:
- method:
  - segment_type: "2d_camera"
    required_parameters:
      - frame_id
    output_topic_types:
      - camera_data
  - segment_type: "tag_finder"
    input_topic_types:
      - camera_data
    output_topic_types:
      - tag_data
"""


def imported(tmp_path: Path, *texts: str) -> PipeFile:
    """What Pipes reads from what was made of files with these texts."""
    made = tmp_path / "pipes.toml"
    made.write_text(import_temoto(written(tmp_path, *texts)))
    return read_pipe_file(made)


def written(tmp_path: Path, *texts: str) -> list[Path]:
    paths = [tmp_path / f"{number}.yaml" for number in range(len(texts))]
    for path, text in zip(paths, texts, strict=True):
        path.write_text(text)
    return paths


@pytest.mark.parametrize("texts", [(COMPONENTS, PIPES), (PIPES, COMPONENTS)])
def test_both_files_become_one_that_pipes_reads(tmp_path: Path, texts: tuple[str, str]) -> None:
    file = imported(tmp_path, *texts)

    camera, finder = file.component
    assert (camera.name, camera.type, camera.reliability) == ("Front camera", "2d_camera", 1.0)
    assert (camera.inputs, camera.outputs) == ((), ("camera_data", "camera_info"))
    assert (finder.inputs, finder.outputs, finder.reliability) == (("camera_data",), ("tag_data",), 0.75)
    (pipe,) = file.pipe
    assert pipe.type == "tag_tracking"
    assert [(one.type, one.inputs, one.outputs) for one in pipe.segment] == [
        ("2d_camera", [], ["camera_data"]),
        ("tag_finder", ["camera_data"], ["tag_data"]),
    ]


def test_topics_are_remapped_as_temoto_does_it(tmp_path: Path) -> None:
    camera, finder = imported(tmp_path, COMPONENTS).component

    assert camera.program.command == "roslaunch"
    assert camera.program.arguments == (
        "robot_eyes",
        "front.launch",
        "camera_data:=${output_camera_data}",
        "camera_info:=${output_camera_info}",
        "frame_id:=${frame_id}",
        "rate:=${rate}",
    )
    assert camera.defaults == {
        "output_camera_data": "front/image",
        "output_camera_info": "front/info",
        "frame_id": "front_link",
        "rate": 30,
    }
    assert finder.program.command == "rosrun"
    assert finder.program.arguments[2:] == ("image_in:=${input_camera_data}", "tags_out:=${output_tag_data}")


def test_what_cannot_be_kept_is_named_in_a_comment(tmp_path: Path) -> None:
    more = COMPONENTS.replace("  reliability", "  colour: blue\n  reliability") + "Other: 1\n"
    text = import_temoto(written(tmp_path, more, PIPES.replace("- method", "- name: best\n  method")))

    comments = [line for line in text.splitlines() if line.startswith("#")]
    assert comments == [
        f'# left out: "{tmp_path}/0.yaml: Other"',
        "# Needs light",
        f'# left out: "{tmp_path}/0.yaml: Components[1].colour"',
        f'# left out: "{tmp_path}/1.yaml: tag_tracking[0].name"',
    ]


@given(
    st.text(st.characters(exclude_categories=["Cs"]), min_size=1),
    st.floats(0, 1),
    st.floats() | st.booleans() | st.text(),
)
def test_any_text_and_number_is_the_same_afterwards(
    tmp_path_factory: pytest.TempPathFactory, text: str, reliability: float, value: float | str
) -> None:
    if isinstance(value, str):
        value = "".join(char for char in value if not "\ud800" <= char <= "\udfff")
    tmp_path = tmp_path_factory.mktemp("any")
    entry = {
        "component_name": text,
        "component_type": text,
        "package_name": "p",
        "executable": "e",
        "reliability": reliability,
        "required_parameters": {"value": value},
    }
    (component,) = imported(tmp_path, yaml.safe_dump({"Components": [entry]})).component

    assert (component.name, component.type, component.reliability) == (text, text, reliability)
    assert component.defaults["value"] == value or value != value


@pytest.mark.parametrize(
    ("text", "key", "says"),
    [
        ("a: [", None, "not valid YAML"),
        ('a: "\\ud800"', None, "not valid YAML"),
        ("\x00", None, "not valid YAML"),
        ("", "", "expected a table, got None"),
        ("- a\n", "", "expected a table, got ['a'] (list)"),
        ("Components: 1\n", "Components", "expected a list, got 1 (int)"),
        (COMPONENTS.replace('"2d_camera"', "[]"), "Components[0].component_type", "expected `str`, got [] (list)"),
        (COMPONENTS.replace("package_name", "package", 1), "Components[0]", "expected the key package_name"),
        (COMPONENTS.replace("0.75", "75"), "Components[1].reliability", "<= 1"),
        (COMPONENTS.replace("tag_data", "tag/data"), "Components[1].output_topics", "digits and _, got 'tag/data'"),
        (COMPONENTS.replace("Tag finder", "Front camera"), "Components[1].component_name", "'Front camera' again"),
        ("tests: {}\n", "tests", "expected a list, got {} (dict)"),
        ("tests:\n- method: []\n", "tests[0].method", "length >= 1"),
        ("tests:\n- methods: []\n", "tests[0]", "expected the key method, got none"),
        (PIPES.replace("segment_type", "type", 1), "tag_tracking[0].method[0]", "expected the key segment_type"),
        (
            PIPES.replace("      - camera_data\n", "      - data_camera\n", 1),
            "tag_tracking[0].method[1].input_topic_types",
            "expected outputs of the segment before it (data_camera), got ['camera_data'] (list)",
        ),
    ],
)
def test_a_wrong_file_is_an_error_with_file_and_key(tmp_path: Path, text: str, key: str | None, says: str) -> None:
    (path,) = written(tmp_path, text)
    with pytest.raises(rr.ConfigError) as caught:
        import_temoto([path])
    assert says in str(caught.value)
    assert caught.value.details["file"] == str(path)
    assert caught.value.details.get("key") == key


def test_a_file_that_is_not_there_is_an_error_with_its_path(tmp_path: Path) -> None:
    with pytest.raises(rr.ConfigError, match=r"none.yaml: cannot be read: No such file.*expected a YAML file"):
        import_temoto([tmp_path / "none.yaml"])
