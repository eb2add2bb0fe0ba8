"""State that survives and state that does not: a crash takes what is in memory, the catalog keeps what was promised.

Attributes are gone with the process, and that is the point: what may have broken it is gone as well. Resources come
back with the catalog, and `recover` makes anew for each of them what cannot be stored: a handle, a connection.

python examples/state_that_survives.py
"""

from __future__ import annotations

import os
import tempfile
import threading

import rr_actors as rr


class Printers(rr.Manager):
    def __init__(self) -> None:
        self.pages = 0  # in memory: does not survive
        self.open: dict[str, str] = {}  # made anew from the catalog

    @rr.server("printer")
    def load_printer(self, request: str) -> str:
        self.open[request] = f"connection of process {os.getpid()}"
        return f"queue of {request}"

    @load_printer.recover
    def recover_printer(self, request: str, response: str) -> str:
        self.load_printer(request)
        return response

    def on_receive(self, message: object) -> tuple[int, list[str]]:
        self.pages += 1
        return self.pages, sorted(self.open)


def main() -> None:
    children = [rr.ChildSpec(Printers, id="printers")]
    with tempfile.TemporaryDirectory() as state, rr.System(children, state_dir=state) as system:
        app, printers = system.open_registrar("app"), system.ref("printers")
        laser = app.load("printers/printer", "laser")
        app.load("printers/printer", "plotter")
        restarted = threading.Event()
        system.subscribe(lambda event: restarted.set() if event["event"] == "restarted" else None)
        printers.ask("print")
        print("before: pages, open printers:", *printers.ask("print"), flush=True)

        system.supervisor().which_child("printers").kill()
        again = app.load("printers/printer", "laser")  # waits until the manager serves again
        restarted.wait(10)  # its on_start has returned: from now on it takes messages, too

        print("after:  pages, open printers:", *printers.ask("print"), flush=True)
        print("the same resource, not another one:", again.resource_id == laser.resource_id, flush=True)


if __name__ == "__main__":
    main()
