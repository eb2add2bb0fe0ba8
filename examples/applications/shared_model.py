"""A web service whose workers share one model: python shared_model.py, and uvicorn --workers 2 shared_model:app"""

from __future__ import annotations

import os
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from typing import Any

from fastapi import FastAPI, Request
from fastapi.responses import JSONResponse

import rr_actors as rr


class Models(rr.Manager):
    def __init__(self) -> None:
        self.models: dict[str, dict[str, int]] = {}  # by the id of the resource

    @rr.server("model")
    def load_model(self, name: str) -> str:
        self.models[rr.current().resource_id] = {
            word: number for number, word in enumerate(["zero", "one", "two"])
        }  # some gigabytes
        return name

    @load_model.recover
    def load_again(self, name: str, response: str) -> str:
        return self.load_model(name)

    @load_model.unload
    def drop_model(self, name: str, response: str) -> None:
        self.models.pop(rr.current().resource_id, None)

    def on_receive(self, message: Any) -> dict[str, Any]:
        return {"number": self.models[message["model"]].get(message["word"]), "model_pid": os.getpid()}


@asynccontextmanager
async def lifespan(app: FastAPI) -> AsyncIterator[None]:
    with rr.connect("rr_state") as connection:
        registrar = connection.open_registrar(f"web-{os.getpid()}")
        async with await registrar.load_async("models/model", "words") as model:  # all workers hold the same one
            app.state.connection, app.state.model = connection, model.resource_id
            yield


app = FastAPI(lifespan=lifespan)


@app.get("/numbers/{word}")
def number(word: str, request: Request) -> dict[str, Any]:
    state = request.app.state
    return state.connection.ask("models", {"model": state.model, "word": word}) | {"worker": os.getpid()}


@app.exception_handler(rr.Unavailable)
async def again(request: Request, error: Exception) -> JSONResponse:
    return JSONResponse({"error": str(error)}, status_code=503)  # the model is being loaded again


if __name__ == "__main__":
    rr.System([rr.ChildSpec(Models, id="models")], state_dir="rr_state").run()
