"""The alternatives of choices: what a file and a program may say, and how what is wrong is named."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import pytest

import rr_actors as rr
from rr_actors.managers.choices.alternatives import Alternative, key_of, read_alternatives

GOOD = """
[[alternative]]
kind = "range"
server = "cameras/depth"
request = { device = "front" }
provides = { rate_hz = 30, place = "roof", colour = true, reliability = 0.9 }

[[alternative]]
kind = "range"
server = "lidars/lidar"
break_first = true
timeout_s = 5
"""
CAMERA = Alternative(
    "range", "cameras/depth", {"device": "front"}, {"rate_hz": 30, "place": "roof", "colour": True, "reliability": 0.9}
)
LIDAR = Alternative("range", "lidars/lidar", break_first=True, timeout_s=5)


def test_alternatives_are_read_from_a_file_or_taken_as_they_are(tmp_path: Path) -> None:
    (tmp_path / "choices.toml").write_text(GOOD)
    assert read_alternatives(tmp_path / "choices.toml") == (CAMERA, LIDAR)
    assert read_alternatives([CAMERA, LIDAR]) == (CAMERA, LIDAR)


def test_a_key_says_what_is_loaded_whatever_type_the_request_has() -> None:
    assert key_of("a/b", None) == "a/b"
    assert key_of("a/b", {"y": 1, "x": "z"}) == 'a/b {"x":"z","y":1}'
    assert CAMERA.key == 'cameras/depth {"device":"front"}'


@pytest.mark.parametrize(
    ("old", "new", "key", "expected", "got"),
    [
        ('"cameras/depth"', '"cameras"', "alternative[0].server", "'registrar/server'", "cameras"),
        ("provides", "provide", "alternative[0].provide", "one of kind, server, request, provides", "provide"),
        ("= 30,", "= inf,", "alternative[0].provides.rate_hz", "a finite number, a text or a truth value", math.inf),
        ("= 0.9", "= 9", "alternative[0].provides.reliability", "a number from 0 to 1", 9),
        ("= 0.9", '= "high"', "alternative[0].provides.reliability", "a number from 0 to 1", "high"),
        ("place", '"-place"', "alternative[0].provides", "names that do not begin with '-'", "-place"),
        ('"roof"', "[]", "alternative[0].provides.place", "`str`", []),
        ("= 5", "= 0", "alternative[1].timeout_s", "a number of seconds over 0", 0),
        ('kind = "range"', 'kind = ""', "alternative[0].kind", "a name", ""),
        ('kind = "range"', "", "alternative[0]", "the key kind", None),
        ("break_first = true", "break_first = 1", "alternative[1].break_first", "`bool`", 1),
        ("[[alternative]]", "[[alternatives]]", "alternatives", "one of alternative", "alternatives"),
        (
            '"lidars/lidar"',
            '"cameras/depth"\nrequest = { device = "front" }',
            "alternative[1]",
            "a server and request that no other alternative of this kind has",
            CAMERA.key,
        ),
    ],
)
def test_what_is_wrong_in_a_file_is_named(
    tmp_path: Path, old: str, new: str, key: str, expected: str, got: object
) -> None:
    file = tmp_path / "choices.toml"
    file.write_text(GOOD.replace(old, new))
    with pytest.raises(rr.ConfigError) as raised:
        read_alternatives(str(file))
    error = raised.value
    assert (error.file, error.key) == (str(file), key)
    assert expected in str(error.expected)
    assert got is None or error.got == got


WRONG: list[tuple[Any, str]] = [
    ("lidar", "alternative[0]"),
    (Alternative("range", "lidars"), "alternative[0].server"),
    (Alternative("range", 5), "alternative[0].server"),  # type: ignore[arg-type]
    (Alternative("range", "a/b", object()), "alternative[0].request"),
    (Alternative("range", "a/b", provides={"rate_hz": []}), "alternative[0].provides.rate_hz"),  # type: ignore[dict-item]
    (Alternative("range", "a/b", provides={"rate_hz": math.nan}), "alternative[0].provides.rate_hz"),
    (Alternative("range", "a/b", timeout_s=math.inf), "alternative[0].timeout_s"),
    (Alternative("", "a/b"), "alternative[0].kind"),
]


@pytest.mark.parametrize(("alternative", "key"), WRONG)
def test_what_is_wrong_in_a_program_is_named(alternative: Any, key: str) -> None:
    with pytest.raises(rr.ConfigError, match="Choices: alternative") as raised:
        read_alternatives([alternative])
    assert raised.value.key == key
