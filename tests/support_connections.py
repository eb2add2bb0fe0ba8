"""A program that connects to a running system, loads what its arguments name, and waits to be killed."""

from __future__ import annotations

import sys
import threading

import rr_actors as rr

if __name__ == "__main__":
    _, state_dir, name, server, request = sys.argv
    query = rr.connect(state_dir).open_registrar(name).load(server, request)
    print(query.id, query.response, flush=True)
    threading.Event().wait(60)
