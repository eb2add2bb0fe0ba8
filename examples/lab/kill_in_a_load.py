"""kill -9 in the middle of a load: a manager loads a map for six seconds, and dies after three.

The consumer has asked once, and waits.

Look for: the state of the resource after the kill; the manager's new process; the number of the attempt.

Why: the manager writes the request to disk before it begins. The next process reads the request, and runs the load
callback again. The consumer has asked once, and gets one answer, a little later.
"""

# /// lab
# place = 9
# question = "The manager is killed while it loads. What will the consumer get?"
# [answers]
# "the map, a little later" = {prints = "loaded: the map"}
# "an error" = {}
# ///

from __future__ import annotations

import os
import threading
import time

import rr_actors as rr


class Maps(rr.Manager):
    @rr.server("map")
    def load_map(self, request: str) -> str:
        attempt = rr.current().attempt
        print(f"process {os.getpid()} reads the map of {request}, attempt {attempt}", flush=True)
        time.sleep(6)
        return f"the map of {request}, from attempt {attempt}"


def main(state_dir: str) -> None:
    with rr.System([rr.ChildSpec(Maps, id="maps")], state_dir=state_dir) as system:
        app = system.open_registrar("app")
        loads = threading.Thread(target=lambda: print("loaded:", app.load("maps/map", "kitchen").response, flush=True))
        time.sleep(2)
        loads.start()
        time.sleep(3)
        (child,) = system.supervisor().which_children()
        print(f"SIGKILL to process {child.pid}, in the middle of its load", flush=True)
        child.kill()
        loads.join()
        time.sleep(4)
