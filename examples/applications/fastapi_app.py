"""A system in a FastAPI application, which starts and stops it: uvicorn fastapi_app:app"""

from __future__ import annotations

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


@asynccontextmanager
async def lifespan(app: FastAPI) -> AsyncIterator[None]:
    async with rr.System([rr.ChildSpec(Cameras, id="cameras")], state_dir="rr_state") as system:
        app.state.registrar = system.open_registrar("web")
        yield


app = FastAPI(lifespan=lifespan)


@app.get("/cameras/{device}")
async def camera(device: str, request: Request) -> dict[str, Any]:
    async with await request.app.state.registrar.load_async("cameras/camera", device) as camera:
        return {"topic": camera.response, "worker": os.getpid()}
