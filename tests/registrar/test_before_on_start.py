"""After a respawn, recover callbacks alone run before on_start has returned."""

from __future__ import annotations

import contextlib
import os
import signal
import threading
from pathlib import Path

import pytest

import rr_actors as rr
from support import Calls, eventually, pid_of, wait_respawned


class Slow(rr.Manager):
    """Its on_start waits for a file, and each callback needs what it makes."""

    def __init__(self, folder: str, loads: bool) -> None:
        super().__init__()
        self.folder, self.loads = Path(folder), loads

    def on_start(self) -> None:
        self.note("on_start")
        if self.loads:
            self.registrar.load("slow/thing", "a", timeout_s=20)
            self.registrar.load("slow/plain", "a", timeout_s=20)
        else:
            while not (self.folder / "go").exists():
                threading.Event().wait(0.02)
        self.driver = "open"
        self.note("started")

    def note(self, what: str) -> None:
        with (self.folder / "calls").open("a") as calls:
            calls.write(what + "\n")

    def step(self, what: str) -> None:
        self.note(what + ("" if hasattr(self, "driver") else " before on_start"))
        if (self.folder / f"kill {what}").exists():
            (self.folder / f"kill {what}").unlink()
            os.kill(os.getpid(), signal.SIGKILL)

    @rr.server("thing", idle="pause", recovery="keep", health=rr.Health(every_s=0.05, fail_after=1))
    def begin(self, request: str) -> str:
        self.step("load")
        return request

    @begin.pause
    def rest(self, request: str, response: str) -> None:
        self.step("pause")

    @begin.resume
    def rise(self, request: str, response: str) -> None:
        self.step("resume")

    @begin.health
    def look(self, request: str, response: str) -> None:
        assert self.driver == "open"
        self.note("probed")

    @begin.usage
    def use(self, request: str, response: str) -> dict[str, float]:
        return {"drivers": len(self.driver)}

    @rr.server("plain", recovery="keep")
    def plain(self, request: str) -> str:
        return request

    @plain.unload
    def end(self, request: str, response: str | None) -> None:
        self.step("unload")

    @rr.server("again", recovery="reload")
    def again(self, request: str) -> str:
        self.step("reload")
        return request


def calls(folder: Path) -> list[str]:
    return (folder / "calls").read_text().splitlines()


def spec(folder: Path, *, loads: bool = False) -> rr.ChildSpec:
    return rr.ChildSpec(Slow, id="slow", args=(str(folder), loads))


@pytest.mark.parametrize("interrupted", ["", "unload", "pause", "resume", "load"])
def test_no_callback_but_recover_runs_before_on_start_has_returned(tmp_path: Path, interrupted: str) -> None:
    (tmp_path / "go").touch()
    with rr.System([spec(tmp_path)], state_dir=tmp_path / "state") as system:
        app = system.open_registrar("app")
        heard = Calls()
        kept = app.load("slow/thing", "kept", on_status=heard)
        app.load("slow/again", "reloaded")
        rests = app.load("slow/thing", "rests")
        leaves = app.load("slow/plain", "leaves")
        eventually(lambda: "probed" in calls(tmp_path))
        (tmp_path / "go").unlink()
        pid = pid_of(system, "slow")
        if interrupted:
            (tmp_path / f"kill {interrupted}").touch()
        unloading = threading.Thread(target=lambda: leaves.unload(timeout_s=60))
        answered = Calls()
        match interrupted:
            case "":
                os.kill(pid, signal.SIGKILL)
            case "unload":
                unloading.start()
            case "load":
                loading = threading.Thread(target=lambda: answered(app.load("slow/thing", "next", timeout_s=60)))
                loading.start()
            case _:
                rests.standby()
                if interrupted == "resume":
                    eventually(lambda: "pause" in calls(tmp_path))
                    rests.priority = 0
        before = len(calls(tmp_path))
        eventually(lambda: calls(tmp_path).count("on_start") == 2)
        threading.Event().wait(0.3)  # long enough for some probes
        (tmp_path / "go").touch()
        wait_respawned(system, "slow", pid)
        eventually(lambda: "reload" in calls(tmp_path)[before:])
        if interrupted:
            eventually(lambda: calls(tmp_path).count(interrupted) >= 2)
        if interrupted == "unload":
            unloading.join(30)
        if interrupted == "load":
            assert answered.wait()[0].response == "next"
        assert system.registrar("slow").usage()[kept.resource_id] == {"drivers": 4}
    ran = calls(tmp_path)
    assert [line for line in ran if line.endswith("before on_start")] == []
    assert heard.items == []


@pytest.mark.parametrize("interrupted", ["unload", "pause"])
def test_what_on_start_itself_waits_for_runs_in_it(tmp_path: Path, interrupted: str) -> None:
    """Its load joins the resource that was being paused, or waits for the end of the one that was being unloaded."""
    with rr.System([spec(tmp_path, loads=True)], state_dir=tmp_path / "state") as system:
        (tmp_path / f"kill {interrupted}").touch()
        pid = pid_of(system, "slow")
        slow = system.registrar("slow")
        (query,) = (it for it in slow.queries() if ("plain" in it.server) is (interrupted == "unload"))
        with contextlib.suppress(rr.RegistrarDown):  # the process ends meanwhile
            if interrupted == "unload":
                slow.unload(query.id)
            else:
                slow.set_priority(query.id, None)
        wait_respawned(system, "slow", pid)
        assert calls(tmp_path).count("started") == 2
        assert f"{interrupted} before on_start" in calls(tmp_path)
        assert system.ended is None
