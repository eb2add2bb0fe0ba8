"""Keep: three radios are wanted. One is killed, one is silent: both are replaced. In the end one alone is wanted.

python examples/keep.py
"""

from __future__ import annotations

import os
import signal
import tempfile
from pathlib import Path

import rr_actors as rr
from rr_actors.managers import Keeper, Kept, Programs, RunProgram

WANTED = '[[keep]]\nname = "radio"\nserver = "radios/radio"\nrequest = "radio {{instance}}"\nreplicas = {}\n'


class Radios(rr.Manager):
    silent = 0

    @rr.server("radio", health=rr.Health(every_s=0.1, timeout_s=5.0, fail_after=2, fatal_after_s=1.0))
    def switch_on(self, name: str) -> int:
        return int(self.registrar.load("programs/program", RunProgram("sleep", ("1000",), instance=name)).response.pid)

    @switch_on.health
    def listen(self, name: str, pid: int) -> rr.Status | None:
        return rr.Status("ERROR", "nothing is heard") if pid == self.silent else None


def show(kept: rr.Query[Kept], radios: rr.Registrar, what: str, ready: int, wanted: int) -> dict[str, int]:
    on = dict[str, int]()
    while (kept.response.ready, kept.response.wanted, len(on)) != (ready, wanted, ready):
        on = {info.request: info.response for info in radios.resources() if info.state == "OK"}
    print(f"{what:<18} {ready} of {wanted}  {kept.response.why}".rstrip(), flush=True)
    return on


def main() -> None:
    with tempfile.TemporaryDirectory() as folder:
        (file := Path(folder, "keep.toml")).write_text(WANTED.format(3))
        keeper = rr.ChildSpec(Keeper, id="keeper", args=(file, rr.Backoff(1.0, 2.0, 4.0, 0.0)))
        children = [rr.ChildSpec(Programs, id="programs"), rr.ChildSpec(Radios, id="radios"), keeper]
        with rr.System(children, state_dir=Path(folder, "state")) as system:
            at = system.open_registrar("app").load("keeper/kept", "radio"), system.registrar("radios")
            shown = [first := show(*at, "three are wanted", 3, 3)]
            os.kill(first["radio 0"], signal.SIGKILL)
            shown += [show(*at, "one is killed", 2, 3), show(*at, "it is back", 3, 3)]
            system.ref("radios").proxy().silent = first["radio 1"]
            shown += [show(*at, "one is silent", 2, 3), show(*at, "it is back", 3, 3)]
            file.write_text(WANTED.format(1))
            system.ref("keeper").proxy().apply(file).get()
            shown.append(show(*at, "one is wanted", 1, 1))
            for name in sorted(first):
                print(name, "".join("██" if name in on else "··" for on in shown))


if __name__ == "__main__":
    main()
