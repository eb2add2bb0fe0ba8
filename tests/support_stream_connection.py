"""A program that connects to a running system, loads a resource, and prints what it reads of a stream until its end."""

from __future__ import annotations

import sys
import zlib

import rr_actors as rr


def main() -> None:
    _, state_dir, server, request, stream = sys.argv
    frames: list[rr.StreamFrame] = []  # the last is in hand while it waits for the next
    query = rr.connect(state_dir).open_registrar("viewer").load(server, request)
    try:
        with query.stream(stream, keep="all", timeout_s=60) as reader:
            print("reads", flush=True)
            for frame in reader:
                frames[:] = [frame]
                print(zlib.crc32(frame.value), frame.missed, flush=True)
        print("end", flush=True)
    except rr.ResourceLost as error:
        print(type(error).__name__, flush=True)


if __name__ == "__main__":
    main()
