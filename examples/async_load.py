"""Asynchronous loading: coroutine callbacks, and ten loads awaited at once.

python examples/async_load.py
"""

from __future__ import annotations

import asyncio
import tempfile
import time

import rr_actors as rr

PAUSE_S = 0.1


class Slow(rr.Manager):
    @rr.server("square")
    async def load_square(self, request: int) -> int:
        await asyncio.sleep(PAUSE_S)
        return request**2


async def use(app: rr.Registrar) -> None:
    begun = time.monotonic()
    queries = await asyncio.gather(*(app.load_async("slow/square", n) for n in range(10)))
    print("ten loads at once:", [query.response for query in queries])
    print("one at a time they would have taken longer:", time.monotonic() - begun < 10 * PAUSE_S)
    for query in queries:
        await app.unload(query, block=False)


def main() -> None:
    with tempfile.TemporaryDirectory() as state, rr.System([rr.ChildSpec(Slow, id="slow")], state_dir=state) as system:
        asyncio.run(use(system.open_registrar("app")))


if __name__ == "__main__":
    main()
