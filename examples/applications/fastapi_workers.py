"""A system in each of several workers, with a state directory of its own: uvicorn --workers 2 fastapi_workers:app"""

from __future__ import annotations

import asyncio
import itertools
import os
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from typing import Any

from fastapi import FastAPI, Request

import rr_actors as rr


class Cameras(rr.Manager):
    @rr.server("camera", recovery="keep")
    def open_camera(self, device: str) -> str:
        return f"/images/{device}"


def start_system() -> rr.System:
    """Start a system in the first state directory that no other worker uses. A new worker takes a dead one's."""
    for number in itertools.count():
        try:
            return rr.System([rr.ChildSpec(Cameras, id="cameras")], state_dir=f"rr_state/worker{number}").start()
        except rr.CatalogLocked:
            continue
    raise AssertionError


@asynccontextmanager
async def lifespan(app: FastAPI) -> AsyncIterator[None]:
    system = await asyncio.to_thread(start_system)
    try:
        app.state.registrar = system.open_registrar("web")
        yield
    finally:
        await asyncio.to_thread(system.stop)


app = FastAPI(lifespan=lifespan)


@app.get("/cameras/{device}")
async def camera(device: str, request: Request) -> dict[str, Any]:
    async with await request.app.state.registrar.load_async("cameras/camera", device) as camera:
        return {"topic": camera.response, "worker": os.getpid()}
