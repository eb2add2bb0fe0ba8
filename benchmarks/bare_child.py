"""What a bare child of multiprocessing's fork server runs, beside a child of rr_actors."""

from __future__ import annotations

import asyncio
import os
import threading
from multiprocessing.connection import Connection

try:
    import uvloop

    new_loop = uvloop.new_event_loop
except ImportError:
    new_loop = asyncio.new_event_loop


def say(connection: Connection) -> None:
    """Do nothing but say that it is there."""
    connection.send_bytes(b"ready")


def listen(connection: Connection) -> None:
    """Run an event loop in a thread, listen on a Unix socket there, and say so: the least of what an actor needs."""
    listening = threading.Event()

    async def serve() -> None:
        server = await asyncio.start_unix_server(lambda _reader, _writer: None, f"\0bare-{os.getpid()}")
        listening.set()
        await server.serve_forever()

    threading.Thread(target=lambda: new_loop().run_until_complete(serve()), daemon=True).start()
    listening.wait()
    connection.send_bytes(b"ready")
