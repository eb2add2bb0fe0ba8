"""Back-off: a device needs time to come back, so each restart waits longer than the one before.

Without a back-off the restarts of a second would use up the intensity. The jitter takes a random part off each wait:
children that failed together then do not restart together.

Look for: the state "restarting", which lasts longer each time; with a jitter, the two modems, which do not wait equally
long although they failed together.
"""

# /// lab
# place = 5
# question = "The first wait is 1 s. How long will the third one be?"
# levers = [
#     {name = "factor", label = "factor", choices = [2.0, 1.0]},
#     {name = "jitter", label = "jitter", choices = [0.0, 0.5]},
# ]
# [answers]
# "about 1 s" = {prints = "wait 3: about 1 s"}
# "2 to 3 s" = {prints = "wait 3: 2 to 3 s"}
# "about 4 s" = {prints = "wait 3: about 4 s"}
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
    return "about 1 s" if wait_s < 1.5 else "2 to 3 s" if wait_s < 3.2 else "about 4 s"


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
