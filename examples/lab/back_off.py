"""Back-off: a device needs time to come back, so a restart can wait.

Two modems fail at the same time, three times. The first wait is 1 s, and each further wait is the one before times the
factor. A jitter of 0.5 takes a random part, up to a half, off each wait.

Look for: how long the state "restarting" lasts each time, for each of the two modems.

Why: with the factor 2 the third wait is 1 s times 2 times 2: 4 s. Without a back-off the restarts of one second would
use up the intensity. With a jitter the modems do not wait equally long: children that failed together do not come back
together, and do not overload what both of them need.
"""

# /// lab
# place = 5
# question = "The first wait of the left modem is 1 s, or less. How long will its third one be?"
# levers = [
#     {name = "factor", label = "factor", choices = [2.0, 1.0]},
#     {name = "jitter", label = "jitter", choices = [0.0, 0.5]},
# ]
# [answers]
# "under 1.5 s" = {prints = "root/left, wait 3: under 1.5 s"}
# "1.5 to 3 s" = {prints = "root/left, wait 3: 1.5 to 3 s"}
# "over 3 s" = {prints = "root/left, wait 3: over 3 s"}
# ///

from __future__ import annotations

import threading
import time
from collections import Counter

import rr_actors as rr


class Modem(rr.Actor):
    def on_receive(self, message: object) -> None:
        raise OSError("no carrier")


def rounded(wait_s: float) -> str:
    return "under 1.5 s" if wait_s < 1.5 else "1.5 to 3 s" if wait_s <= 3 else "over 3 s"


def main(state_dir: str, factor: float = 2.0, jitter: float = 0.0) -> None:
    backoff = rr.Backoff(delay_s=1.0, factor=factor, maximum_s=30.0, jitter=jitter)
    children = [rr.ChildSpec(Modem, id=id, backoff=backoff) for id in ("left", "right")]
    waits: Counter[str] = Counter()
    is_back = {"root/left": threading.Event(), "root/right": threading.Event()}

    def hear(event: rr.Event) -> None:
        if event["event"] == "exited" and event["path"] in is_back:
            waits[event["path"]] += 1
            wait_s = event.get("delay_s", 0.0)
            print(f"{event['path']}, wait {waits[event['path']]}: {rounded(wait_s)} ({wait_s:.2f} s)", flush=True)
        elif event["event"] == "restarted" and event["path"] in is_back:
            is_back[event["path"]].set()

    with rr.System(rr.Supervisor(children, max_restarts=20, max_seconds=60), state_dir=state_dir) as system:
        system.subscribe(hear)
        time.sleep(2)
        for _ in range(3):
            for path in is_back:
                is_back[path].clear()
                system.ref(path).tell("dial")
            for back in is_back.values():
                back.wait(20)
        time.sleep(3)
