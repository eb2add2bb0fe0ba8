"""The words of the first page: every registrar, server and client of a running system, in whatever process it is."""

from __future__ import annotations

import gc
import os
from collections.abc import Callable
from typing import Any

import pykka

import rr_actors as rr
from support import eventually

Start = Callable[..., rr.System]


def actors_here() -> dict[str, int]:
    """All actors of this process that are in its tree or parts of it: the path of each, and how many messages wait."""
    gc.unfreeze()  # the first objects of a process are frozen, and not listed
    gc.collect()
    actors = [one for one in gc.get_objects() if issubclass(type(one), pykka.Actor)]
    gc.freeze()
    return {str(one.actor_ref): len(one.actor_inbox) for one in actors if hasattr(one, "actor_ref")}


class Cameras(rr.Manager):
    @rr.server("camera")
    def camera(self, request: str) -> str:
        return f"{request} is open"

    def on_receive(self, message: Any) -> Any:
        return os.getpid(), actors_here()


class Maps(rr.Manager):
    @rr.server("map", at_once=1)
    def map(self, request: str) -> Any:
        return self.registrar.load("cameras/camera", request).response

    def on_receive(self, message: Any) -> Any:
        return os.getpid(), actors_here()


def parts_of(system: rr.System) -> set[str]:
    """The paths of all registrars, servers and clients of a system, by its own tables."""
    found: set[str] = set()
    children = {line.rpartition("/")[2]: line for line in ("root/cameras", "root/inner/maps", "root/near")}
    for name in system.snapshot()["registrars"]:
        path = f"{children[name]}/registrar" if name in children else name
        handle = system.registrar(name)
        servers = {server.partition("/")[2] for server in handle.servers()}
        providers = {server.partition("/")[0] for server in handle.clients()}
        found |= {path, *(f"{path}/servers/{one}" for one in servers), *(f"{path}/clients/{one}" for one in providers)}
    return found


def test_every_registrar_server_and_client_of_every_process_is_an_actor_with_a_mailbox(start: Start) -> None:
    system = start(
        rr.ChildSpec(Cameras, id="cameras"),
        rr.Supervisor([rr.ChildSpec(Maps, id="maps")], id="inner"),
        rr.ChildSpec(Cameras, id="near", placement="thread"),
    )
    app = system.open_registrar("app")
    app.register_server("own", lambda request: request)
    app.load("maps/map", "x")
    app.load("near/camera", "y")
    with rr.connect(system.state_dir) as connection:
        worker = connection.open_registrar("worker")
        worker.load("maps/map", "x")
        parts = parts_of(system)
        assert parts == {
            "app", "app/servers/own", "app/clients/maps", "app/clients/near",
            worker.name, f"{worker.name}/clients/maps",
            "root/cameras/registrar", "root/cameras/registrar/servers/camera",
            "root/inner/maps/registrar", "root/inner/maps/registrar/servers/map",
            "root/inner/maps/registrar/clients/cameras",
            "root/near/registrar", "root/near/registrar/servers/camera",
        }  # fmt: skip

        where: dict[str, set[int]] = {}
        for child in ("cameras", "maps", "near"):
            pid, here = system.ref(child).ask("who is here")
            for path in here:
                where.setdefault(path, set()).add(pid)
        for path in parts:
            ref = system.ref(path)
            assert issubclass(ref.actor_class, pykka.Actor), path
            assert ref.is_alive(), path
            assert ref.pid is not None
            assert where[path] == {ref.pid}, path  # an object of pykka.Actor is in that process, and in no other
            eventually(lambda path=path: system.mailbox(path).look() == rr.MailboxInfo(path, 100_000), what=path)
        assert len({pid for pids in where.values() for pid in pids}) == 3
