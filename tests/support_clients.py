"""A program that connects to a running system, holds what it is told to hold, and waits to be killed."""

from __future__ import annotations

import sys
import time

import rr_actors as rr

if __name__ == "__main__":
    _, state_dir, name, server, request = sys.argv
    query = rr.connect(state_dir).open_registrar(name).load(server, request)
    print(query.id, query.response, flush=True)
    time.sleep(60)
