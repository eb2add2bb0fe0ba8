"""kill -9 in the middle of an unload: a manager closes a file for five seconds, and dies after three.

The consumer has released the file, and the manager's unload callback runs.

Look for: the state of the resource after the kill; the manager's new process; the number of the attempt.

Why: the manager writes the release to disk before the unload callback begins. The next process reads it, and runs the
callback again. So an unload callback may find that a part of its work is done.
"""

# /// lab
# place = 12
# question = "The manager is killed while it closes a file. What will become of the file?"
# [answers]
# "its unload runs again" = {prints = "closes the file, attempt 2"}
# "it stays open" = {}
# "the consumer holds it again" = {prints = "held again"}
# ///

from __future__ import annotations

import os
import threading
import time
from pathlib import Path

import rr_actors as rr


class Files(rr.Manager):
    def __init__(self, attempts: str) -> None:
        super().__init__()
        self.attempts = Path(attempts)

    @rr.server("file")
    def load_file(self, request: str) -> str:
        return f"{request}, open"

    @load_file.unload
    def close(self, request: str, response: str) -> None:
        with self.attempts.open("a") as file:
            file.write("x")
        attempt = len(self.attempts.read_text())
        print(f"process {os.getpid()} closes the file, attempt {attempt}", flush=True)
        time.sleep(5)
        print("the file is closed", flush=True)


def main(state_dir: str) -> None:
    attempts = str(Path(state_dir, "attempts"))
    with rr.System([rr.ChildSpec(Files, id="files", args=(attempts,))], state_dir=state_dir) as system:
        app = system.open_registrar("app")
        log = app.load("files/file", "log.txt")
        time.sleep(2)
        print("the consumer releases the file", flush=True)
        release = threading.Thread(target=log.unload)
        release.start()
        time.sleep(3)
        (child,) = system.supervisor().which_children()
        print(f"SIGKILL to process {child.pid}, in the middle of its unload", flush=True)
        child.kill()
        release.join()
        time.sleep(8)
