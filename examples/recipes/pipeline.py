"""A pipeline of three programs: one that is killed is replaced, and the pipeline goes on."""

from __future__ import annotations

import os
import signal
import tempfile
from pathlib import Path

import rr_actors as rr
from rr_actors.managers import Programs, Ready, RunProgram

SOURCE = "while true; do i=$((i + 1)); echo $i >> raw; sleep 0.02; done"
FILTER = "tail -n +1 -F raw | sed -u s/^/measured:/ >> clean"
SINK = "tail -n +1 -F clean > shown"


def program(folder: str, script: str, instance: str = "") -> RunProgram:
    ready = Ready(line="begins")
    return RunProgram("sh", ("-c", f"echo begins; {script}"), directory=folder, ready=ready, instance=instance)


class Pipelines(rr.Manager):
    @rr.server("pipeline", recovery="keep")
    def begin(self, folder: str) -> str:
        for script in (SOURCE, FILTER, SINK):
            self.registrar.load("programs/program", program(folder, script))
        return "as begun"

    @begin.status
    def replace(self, folder: str, status: rr.Status) -> None:
        if status.resource_id != rr.current().resource_id and status.state is rr.State.FATAL:
            self.registrar.replace_part(status, program(folder, FILTER, "spare"), response=lambda spare: "with a spare")


def main() -> None:
    children = [rr.ChildSpec(Programs, id="programs"), rr.ChildSpec(Pipelines, id="pipelines")]
    with tempfile.TemporaryDirectory() as folder, rr.System(children, state_dir=Path(folder, "state")) as system:
        pipeline = system.open_registrar("app").load("pipelines/pipeline", folder)
        _, filter_part, _ = system.registrar("pipelines").queries()
        os.kill(filter_part.response.pid, signal.SIGKILL)
        print(pipeline.wait_status(timeout_s=20).state, pipeline.response)


if __name__ == "__main__":
    main()
