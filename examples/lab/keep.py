"""Keep: a file wants three radios, and one of them fails.

A radio is a resource whose part is a program. The keeper compares what is there with what is wanted, whenever something
happens. In the end another number of radios is wanted.

Look for: the radio that fails, and what is there before and after the wait; which radios are there in the end.

Why: what is wanted and not there is loaded again, under its own number, when the wait is over. If fewer are wanted, the
ones with the highest numbers go.
"""

# /// lab
# place = 17
# question = "Three radios are wanted, and radio 0 fails. What will be there eight seconds later?"
# levers = [
#     {name = "fault", label = "what becomes of radio 0", choices = ["killed", "silent"]},
#     {name = "delay_s", label = "seconds before what was lost is loaded again", choices = [2.0, 20.0]},
#     {name = "then_wanted", label = "then so many radios are wanted", choices = [1, 5]},
# ]
# [answers]
# "radio 0, radio 1 and radio 2" = {prints = "later: radio 0, radio 1, radio 2"}
# "radio 1, radio 2, and radio 3 as a new one" = {prints = "later: radio 1, radio 2, radio 3"}
# "radio 1 and radio 2" = {prints = "later: radio 1, radio 2 ("}
# ///

from __future__ import annotations

import os
import signal
import time
from pathlib import Path

import rr_actors as rr
from rr_actors.managers import Keeper, Kept, Programs, RunProgram

WANTED = '[[keep]]\nname = "radio"\nserver = "radios/radio"\nrequest = "radio {{instance}}"\nreplicas = {}\n'


class Radios(rr.Manager):
    silent = 0

    @rr.server("radio", health=rr.Health(every_s=0.2, timeout_s=5.0, fail_after=2, fatal_after_s=1.0))
    def switch_on(self, name: str) -> int:
        return int(self.registrar.load("programs/program", RunProgram("sleep", ("1000",), instance=name)).response.pid)

    @switch_on.health
    def listen(self, name: str, pid: int) -> rr.Status | None:
        return rr.Status("ERROR", "nothing is heard") if pid == self.silent else None


def radios_on(radios: rr.Registrar) -> dict[str, int]:
    return {info.request: info.response for info in radios.resources() if info.state == "OK"}


def show(kept: rr.Query[Kept], radios: rr.Registrar, step: str, pause_s: float) -> None:
    time.sleep(pause_s)
    why = f" ({kept.response.why})" if kept.response.why else ""
    print(f"{step}: {', '.join(sorted(radios_on(radios))) or 'none'}{why}", flush=True)


def main(state_dir: str, fault: str = "killed", delay_s: float = 2.0, then_wanted: int = 1) -> None:
    (folder := Path(state_dir)).mkdir(mode=0o700, parents=True, exist_ok=True)
    file = folder / "keep.toml"
    file.write_text(WANTED.format(3))
    keeper = rr.ChildSpec(Keeper, id="keeper", args=(file, rr.Backoff(delay_s, 1.0, delay_s, 0.0)))
    children = [rr.ChildSpec(Programs, id="programs"), rr.ChildSpec(Radios, id="radios"), keeper]
    with rr.System(children, state_dir=state_dir) as system:
        kept, radios = system.open_registrar("app").load("keeper/kept", "radio"), system.registrar("radios")
        show(kept, radios, "three are wanted", 4)
        first = radios_on(radios)
        print(f"radio 0 is {fault}", flush=True)
        if fault == "killed":
            os.kill(first["radio 0"], signal.SIGKILL)
        else:
            system.ref("radios").proxy().silent = first["radio 0"]
        show(kept, radios, "soon after the fault", 1)
        show(kept, radios, "later", 8)
        file.write_text(WANTED.format(then_wanted))
        system.ref("keeper").proxy().apply(file).get()
        show(kept, radios, f"{then_wanted} wanted", 4)
