"""Tour guide: twelve programs of a robot. First all of them are on, and then each only while it is needed.

python examples/tour_guide.py
"""

from __future__ import annotations

import statistics
import sys
import tempfile
import time

import rr_actors as rr
from rr_actors.managers import Programs, Ready, RunProgram

PROGRAM = """
import sys, time

busy_s, memory = float(sys.argv[1]), bytearray(b"x") * (int(sys.argv[2]) << 20)
print("ready", flush=True)
while True:
    began = time.process_time()
    while time.process_time() - began < busy_s:
        pass
    time.sleep(0.05)
"""
PROGRAMS = {  # how many seconds each is busy in every turn, and its memory in MiB
    "laser": (0.003, 4),
    "wheels": (0.002, 2),
    "obstacles": (0.004, 8),
    "place": (0.006, 16),
    "path": (0.006, 12),
    "camera": (0.004, 12),
    "faces": (0.008, 24),
    "screen": (0.003, 12),
    "voice": (0.003, 8),
    "microphone": (0.002, 2),
    "words": (0.008, 24),
    "answers": (0.004, 16),
}
USE_CASES = {  # and the programs that each needs
    "drive": {"laser", "wheels", "obstacles", "place", "path"},
    "explain": {"camera", "faces", "screen", "voice"},
    "answer": {"microphone", "words", "answers", "screen", "voice"},
}
TOUR = ("drive", "explain", "drive", "answer", "drive")
STEP_S = 0.8
SIGNS = {"paused": "·", "unloading": " "}


def program(name: str) -> tuple[str, RunProgram]:
    weights = [str(number) for number in PROGRAMS[name]]
    ready = Ready(line="ready", timeout_s=60)
    return "programs/program", RunProgram(sys.executable, ("-c", PROGRAM, *weights), ready=ready, instance=name)


class Guide(rr.Manager):
    @rr.server("use_case")
    def begin(self, name: str) -> str:
        self.registrar.load_all([program(needed) for needed in USE_CASES[name]], timeout_s=60)
        return name


class Watch:
    """What the usage callbacks say, and which programs run, from one look to the next."""

    def __init__(self, system: rr.System) -> None:
        self.programs, self.began = system.registrar("programs"), time.monotonic()
        self.cpu_s: dict[str, float] = {}
        self.memory: list[float] = []
        self.rows = dict.fromkeys(PROGRAMS, "")

    def look(self) -> set[str]:
        """Return the names of the programs that run."""
        phases = {info.request.instance: info.phase for info in self.programs.resources()}
        usages = self.programs.usage()
        self.cpu_s |= {id: used["cpu_s"] for id, used in usages.items()}
        self.memory.append(sum(used["memory_bytes"] for used in usages.values()) / 2**20)
        signs = {name: SIGNS.get(phase, "█") for name, phase in phases.items()}
        for name in PROGRAMS:
            self.rows[name] += signs.get(name, " ")
        return {name for name, sign in signs.items() if sign == "█"}

    def show(self, title: str) -> None:
        """Print what was used: CPU since the first program began, and memory on average."""
        cpus = sum(self.cpu_s.values()) / (time.monotonic() - self.began)
        print(f"{title:<10}  {cpus:4.0%} of one CPU  {statistics.mean(self.memory):4.0f} MiB", flush=True)


def guide(system: rr.System, kept: set[str]) -> Watch:
    """Give the tour with these programs always on. A step lasts until whatever is not needed in it is paused."""
    app, watch = system.open_registrar("app"), Watch(system)
    app.load_all([program(name) for name in kept], timeout_s=60)
    for step in TOUR:
        with app.load("guide/use_case", step, timeout_s=60):
            end = time.monotonic() + STEP_S
            while watch.look() - kept - USE_CASES[step] or time.monotonic() < end:
                time.sleep(0.1)
    return watch


def time_of_answer(system: rr.System, name: str) -> float:
    """Return how many milliseconds a load of a program takes."""
    began = time.perf_counter()
    with system.registrar("app").load(*program(name), timeout_s=60):
        return (time.perf_counter() - began) * 1000


def main() -> None:
    programs = rr.ChildSpec(Programs, id="programs", kwargs={"idle": "pause", "linger_s": 0.2, "paused_s": 1.6})
    children = [programs, rr.ChildSpec(Guide, id="guide")]
    for title, kept in (("all on", set(PROGRAMS)), ("on demand", set[str]())):
        with tempfile.TemporaryDirectory() as state, rr.System(children, state_dir=state) as system:
            watch = guide(system, kept)
            watch.show(title)
            answers = [time_of_answer(system, name) for name in USE_CASES[TOUR[-2]]]
    print(f"a paused program answers after {statistics.median(answers):.1f} ms")
    print("\n".join(f"{name:<10}  {row}" for name, row in watch.rows.items()))


if __name__ == "__main__":
    main()
