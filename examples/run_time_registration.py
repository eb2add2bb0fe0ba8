"""Run-time registration: a server is given to a manager that runs in another process, and is there again after a crash.

python examples/run_time_registration.py
"""

from __future__ import annotations

import os
import signal
import tempfile

import rr_actors as rr


class Host(rr.Manager):
    """A manager that declares nothing: its servers come to it while it runs."""


def main() -> None:
    with tempfile.TemporaryDirectory() as state, rr.System([rr.ChildSpec(Host, id="host")], state_dir=state) as system:
        app = system.open_registrar("app")
        factor = 2  # travels with the function, like everything that it uses

        system.registrar("host").register_server("times", lambda request: [request * factor, os.getpid()])

        product, pid = app.load("host/times", 21).response
        print("twice 21 is", product)
        print("it ran in another process:", pid != os.getpid())

        os.kill(pid, signal.SIGKILL)
        product, new_pid = app.load("host/times", 4).response
        assert new_pid != pid
        print("after a respawn, twice 4 is", product)


if __name__ == "__main__":
    main()
