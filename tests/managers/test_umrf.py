"""The example of graphs: a table of three graphs, and a picture."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from xml.etree import ElementTree

from support import REPOSITORY


def test_the_example_prints_its_table_and_draws_its_picture(tmp_path: Path) -> None:
    picture = tmp_path / "inspect.svg"
    command = [sys.executable, str(REPOSITORY / "examples" / "umrf.py"), "--picture", str(picture)]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stdout.splitlines() == [
        "graph      result   says                what ran",
        "greet      on_true  please knock        Choose_1, LookAtDoor_0, Say_0",
        "deliver    on_true                      Dispatch_0, Drive_0, Handle_0",
        "inspect    on_true  a picture of spare  Say_0, TakePicture_0, TakePicture_1",
        f"{picture} is drawn",
    ]
    drawn = picture.read_text()
    ElementTree.fromstring(drawn)
    assert all(word in drawn for word in ("TakePicture_1", "FINISHED", "ERROR"))
