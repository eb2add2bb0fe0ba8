"""In a manager of a program that is one file, pickle and multiprocessing find what the program defines."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

PROGRAM = """
import concurrent.futures, enum, multiprocessing, pickle, sys, typing
from dataclasses import dataclass

import rr_actors as rr

print("the script runs")


@dataclass
class Point:
    x: int

    class Inner:
        pass


class Pair(typing.NamedTuple):
    first: int


class Color(enum.Enum):
    RED = 1


class Odd(Exception):
    pass


def double(point):
    if point.x % 2:
        raise Odd(point.x)
    return Point(point.x * 2)


class Circle:
    def __init__(self, radius):
        self.radius = radius


class Stuck:
    here = sys._getframe()


rr.codec(Circle, lambda circle: circle.radius, Circle)
rr.codec(Stuck, lambda _: None, lambda _: Stuck())


class Points(rr.Manager):
    @rr.server("unnamed")
    def unnamed(self, request):
        return f"a {type(request).__name__} of {request.radius}"

    @rr.server("pickled")
    def pickled(self, request: int) -> bool:
        values = Point(request), Pair(2), Color.RED, Point.Inner, double, Odd
        return pickle.loads(pickle.dumps(values))[:-1] == values[:-1]

    @rr.server("pool")
    def pool(self, method: str) -> list[int]:
        with multiprocessing.get_context(method).Pool(1) as pool:
            return [point.x for point in pool.map(double, [Point(2), Point(4)])]

    @rr.server("executor")
    def executor(self, method: str) -> list[str]:
        with concurrent.futures.ProcessPoolExecutor(1, multiprocessing.get_context(method)) as executor:
            six, seven = (executor.submit(double, Point(number)) for number in (6, 7))
            return [repr(six.result()), repr(seven.exception())]


if __name__ == "__main__":
    with rr.System([rr.ChildSpec(Points, id="points")], state_dir=sys.argv[1]) as system:
        app = system.open_registrar("app")
        print(app.load(sys.argv[2], eval(sys.argv[3])).response)
"""


@pytest.mark.parametrize(
    ("server", "request_", "response"),
    [
        ("points/pickled", "1", "True"),
        *(("points/pool", repr(method), "[4, 8]") for method in ("spawn", "forkserver")),
        *(("points/executor", repr(method), "['Point(x=12)', 'Odd(7)']") for method in ("spawn", "forkserver")),
    ],
)
def test_a_callback_pickles_what_its_script_defines_and_the_script_runs_once(
    tmp_path: Path, server: str, request_: str, response: str
) -> None:
    program = tmp_path / "program.py"
    program.write_text(PROGRAM)

    command = [sys.executable, str(program), str(tmp_path / "state"), server, request_]
    run = subprocess.run(command, capture_output=True, text=True, timeout=50, check=False)

    assert run.stdout == f"the script runs\n{response}\n", run.stderr


def test_a_manager_has_the_codec_of_a_class_of_the_script_that_it_does_not_name(tmp_path: Path) -> None:
    program = tmp_path / "program.py"
    program.write_text(PROGRAM)

    command = [sys.executable, str(program), str(tmp_path / "state"), "points/unnamed", "Circle(3)"]
    run = subprocess.run(command, capture_output=True, text=True, timeout=50, check=False)

    assert run.stdout == "the script runs\na Circle of 3\n", run.stderr
