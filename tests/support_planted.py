"""Managers for the tests of check_manager: a good one, and some with a planted fault each."""

from __future__ import annotations

import asyncio
import os
import threading
import time
from typing import Any

import rr_actors as rr
from rr_actors.testing import closed, opened


class Ports(rr.Manager):
    """A good one: each resource has an open port, which the kernel closes with the process."""

    def __init__(self) -> None:
        self.ports: dict[str, str] = {}

    def begin(self, device: str) -> str:
        self.ports[rr.current().resource_id] = device
        opened(device)
        return f"port of {device}"

    @rr.server("port")
    def open_port(self, device: str) -> str:
        return self.begin(device)

    @open_port.unload
    def close_port(self, device: str, response: str) -> None:
        if self.ports.pop(rr.current().resource_id, None) is not None:
            closed(device)

    @open_port.recover
    def find_port(self, device: str, response: str) -> str:
        return self.begin(device)

    @open_port.status
    def hear_of_port(self, device: str, status: rr.Status) -> None:
        pass


class ClosesTwice(Ports):
    def close_port(self, device: str, response: str) -> None:
        super().close_port(device, response)
        closed(device)


class KeepsOpenAfterACrash(rr.Manager):
    """A power supply stays on when the process dies. Its manager knows in memory alone which one is on."""

    def __init__(self) -> None:
        self.on = set[str]()

    @rr.server("supply", recovery="keep")
    def switch_on(self, device: str) -> str:
        key = f"{device} of {rr.current().resource_id}"
        opened(key, outlives=True)
        self.on.add(key)
        return key

    @switch_on.unload
    def switch_off(self, device: str, response: str | None) -> None:
        key = f"{device} of {rr.current().resource_id}"
        if key in self.on:
            self.on.remove(key)
            closed(key, outlives=True)


class Supplies(KeepsOpenAfterACrash):
    """The same, mended."""

    def switch_off(self, device: str, response: str | None) -> None:
        closed(f"{device} of {rr.current().resource_id}", outlives=True)


class InventsAResponse(Ports):
    def find_port(self, device: str, response: str) -> str:
        return super().find_port(device, response) + " again"


class InventsAPort(Ports):
    def find_port(self, device: str, response: str) -> str:
        return response


class SharesAKey(rr.Manager):
    def __init__(self) -> None:
        self.ports: dict[str, int] = {}

    @rr.server("port", recovery="lost")
    def open_port(self, device: str) -> int:
        self.ports[device] = 1
        return 1

    @open_port.unload
    def close_port(self, device: str, response: int | None) -> None:
        if not rr.current().interrupted and os.getpid() == self.pid:
            del self.ports[device]

    def on_start(self) -> None:
        self.pid = 0
        if not self.registrar.resources():
            self.pid = os.getpid()


class Blocks(Ports):
    def close_port(self, device: str, response: str) -> None:
        if rr.current().attempt > 1:
            time.sleep(1000)
        super().close_port(device, response)


class TakesAnything(rr.Manager):
    @rr.server("port", recovery="keep")
    def open_port(self, request: Any) -> str:
        return "open"


class FailsAfterACrash(rr.Manager):
    """It finds its lock file when its load runs again."""

    @rr.server("lock", recovery="keep")
    def take_lock(self, name: str) -> str:
        path = self.registrar.directory / f"lock-{rr.current().resource_id}"
        path.touch(exist_ok=False)
        return str(path)

    @take_lock.unload
    def give_lock(self, name: str, response: str | None) -> None:
        (self.registrar.directory / f"lock-{rr.current().resource_id}").unlink(missing_ok=True)


class LeavesThreads(rr.Manager):
    @rr.server("grabber", recovery="keep")
    def grab(self, device: str) -> str:
        threading.Thread(target=time.sleep, args=(1000,), daemon=True).start()
        return device


class RaisesInStatus(Ports):
    def hear_of_port(self, device: str, status: rr.Status) -> None:
        if status.state == rr.State.ERROR:
            raise ValueError("no words for this")


class DiesByItself(Ports):
    def hear_of_port(self, device: str, status: rr.Status) -> None:
        if status.state == rr.State.OK:
            os._exit(3)


class Lamps(rr.Manager):
    """A good one with all callbacks, two servers, and async ones."""

    @rr.server("lamp", idle="pause", paused_s=0.1, recovery="reload")
    def switch_on(self, room: str, bright: bool = False) -> str:
        return f"{room} is lit"

    @switch_on.unload
    def switch_off(self, room: str) -> None:
        pass

    @switch_on.pause
    def dim(self, room: str) -> None:
        pass

    @switch_on.resume
    def brighten(self, room: str) -> None:
        pass

    @switch_on.usage
    def watts(self, room: str) -> dict[str, float]:
        return {"watts": 4.0}

    @rr.server("scene", exclusive=True)
    async def set_scene(self, name: str) -> str:
        await asyncio.sleep(0.001)
        return name

    @set_scene.unload
    async def end_scene(self, name: str, response: str | None) -> None:
        await asyncio.sleep(0.001)

    @set_scene.recover
    async def find_scene(self, name: str, response: str) -> str:
        return response


class CountsByItself(rr.Manager):
    """Two loads at once may count as one."""

    def __init__(self) -> None:
        self.count = 0

    @rr.server("port")
    def open_port(self, device: str) -> str:
        before = self.count
        self.count = before + 1
        return device


class OpensTwice(rr.Manager):
    """Two loads at once may both find that a bus is not open."""

    def __init__(self) -> None:
        self.buses: dict[str, str] = {}

    @rr.server("port")
    def open_port(self, device: str) -> str:
        if "bus" not in self.buses:
            self.buses["bus"] = "open"
        return device


class CountsWithALock(rr.Manager):
    """What CountsByItself does, with a lock."""

    def __init__(self) -> None:
        self.count = 0
        self.lock = threading.Lock()

    @rr.server("port")
    def open_port(self, device: str) -> str:
        with self.lock:
            self.count += 1
        return device


class CountsSerially(CountsByItself, serial=True):
    """What CountsByItself does, one callback at a time."""
