"""What a registrar promises about reloads on demand (docs/semantics.md, "Reloads")."""

from __future__ import annotations

import os
import signal
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

import rr_actors as rr
from support import Calls, Gate, loaded_with_parts, serve

Start = Callable[..., rr.System]
LIMIT_S = 30.0


def said(heard: Calls, count: int) -> list[str]:
    """The first statuses that were heard, as texts."""
    return [f"{status.state} {status.message}" for status in heard.wait(count)]


def test_a_reload_unloads_and_loads_and_its_holders_keep_their_queries(
    app: rr.Registrar, provider: rr.Registrar
) -> None:
    served, heard = serve(provider, "thing"), (Calls(), Calls())
    queries = [app.load("provider/thing", "x", on_status=each) for each in heard]
    provider.send_status(queries[0], rr.Status("ERROR", "no picture"))

    provider.reload(queries[0].resource_id, timeout_s=LIMIT_S)

    assert served.unloads.items == [("x", {"of": "x", "number": 1})]
    assert [said(each, 2) for each in heard] == [["ERROR no picture", "UPDATE reloaded"]] * 2
    assert [query.response for query in queries] == [{"of": "x", "number": 2}] * 2
    (resource,) = provider.resources()
    assert (resource.id, resource.state, len(resource.queries)) == (queries[0].resource_id, "UPDATE", 2)


def test_holders_hear_of_a_reload_also_if_the_response_is_the_same(app: rr.Registrar, provider: rr.Registrar) -> None:
    serve(provider, "thing", load=str.upper)
    heard = Calls()
    provider.reload(app.load("provider/thing", "x", on_status=heard), timeout_s=LIMIT_S)
    assert said(heard, 1) == ["UPDATE reloaded"]


def test_a_reload_releases_the_parts_and_loads_them_again(
    app: rr.Registrar, provider: rr.Registrar, parts: rr.Registrar
) -> None:
    order = Calls()
    serve(parts, "part", load=lambda _: order("load part"), unload=lambda *_: order("unload part"))
    serve(parts, "shared")
    load = loaded_with_parts(provider, ("parts/part", "bolt"), ("parts/shared", "nut"))
    serve(provider, "whole", load=lambda it: [order("load whole"), load(it)], unload=lambda *_: order("unload whole"))
    whole, shared = app.load("provider/whole", "x"), app.load("parts/shared", "nut")

    provider.reload(whole.resource_id, timeout_s=LIMIT_S)

    first = ["load whole", "load part"]
    assert order.items == [*first, "unload whole", "unload part", *first]
    assert shared.response["number"] == 1  # somebody else holds it
    whole.unload()
    assert order.items[-2:] == ["unload whole", "unload part"]


def test_loads_and_unloads_wait_for_the_end_of_a_reload(app: rr.Registrar, provider: rr.Registrar) -> None:
    gate = Gate()
    served = serve(provider, "thing", unload=lambda *_: None if len(served.loads) > 1 else gate())
    first = app.load("provider/thing", "x")
    reloading = threading.Thread(target=provider.reload, args=(first,))
    reloading.start()
    gate.wait_arrived()
    second, unloading = app.load("provider/thing", "x", block=False), app.unload(first, block=False)
    with pytest.raises(rr.UsageError, match="which is being reloaded already"):
        provider.reload(first, timeout_s=LIMIT_S)
    gate.open()
    reloading.join(LIMIT_S)
    unloading.get(timeout=LIMIT_S)
    assert second.get(timeout=LIMIT_S).response == {"of": "x", "number": 2}
    assert (len(served.loads), len(served.unloads)) == (2, 1)


def test_an_unload_callback_that_raises_ends_the_reload_and_the_holders_hear_error(
    app: rr.Registrar, provider: rr.Registrar
) -> None:
    def stuck(_request: Any, _response: Any) -> None:
        if len(served.unloads) == 1:
            raise OSError("the cable is stuck")

    served, heard = serve(provider, "thing", unload=stuck), Calls()
    query = app.load("provider/thing", "x", on_status=heard)
    expected = "provider/thing: OSError: the cable is stuck; the resource is not loaded again, as its unload callback"
    with pytest.raises(rr.UnloadFailed, match=expected):
        provider.reload(query, timeout_s=LIMIT_S)
    assert said(heard, 1)[0].startswith(f"ERROR {expected}")
    assert len(served.loads) == 1

    provider.reload(query, timeout_s=LIMIT_S)  # tried again
    assert said(heard, 2)[1] == "UPDATE reloaded"


def test_a_load_callback_that_raises_loses_the_resource(app: rr.Registrar, provider: rr.Registrar) -> None:
    def load(request: str) -> str:
        if len(served.loads) > 1:
            raise OSError("unplugged")
        return request

    served, heard = serve(provider, "thing", load=load), Calls()
    query = app.load("provider/thing", "x", on_status=heard)
    with pytest.raises(rr.LoadFailed, match="lost: provider/thing: OSError: unplugged"):
        provider.reload(query, timeout_s=LIMIT_S)
    assert said(heard, 1) == ["FATAL lost: provider/thing: OSError: unplugged"]
    with pytest.raises(rr.UsageError, match="is FATAL: its holders have heard that it is lost"):
        provider.reload(query, timeout_s=LIMIT_S)


def test_what_is_taken_away_in_its_reload_is_not_loaded_again(app: rr.Registrar, provider: rr.Registrar) -> None:
    gate = Gate()
    served, heard = serve(provider, "thing", unload=lambda *_: gate()), Calls()
    query = app.load("provider/thing", "x", on_status=heard)
    errors = Calls()

    def reload() -> None:
        try:
            provider.reload(query)
        except rr.RrError as error:
            errors(str(error))

    thread = threading.Thread(target=reload)
    thread.start()
    gate.wait_arrived()
    taken = provider.unload(query.resource_id, force=True, block=False)
    gate.open()
    taken.get(timeout=LIMIT_S)
    thread.join(LIMIT_S)
    assert (len(served.loads), len(served.unloads), provider.resources()) == (1, 1, [])
    assert "was taken from its holders" in errors.wait()[0]
    assert said(heard, 1) == ["FATAL unloaded by its owner"]


def test_a_paused_resource_is_reloaded_and_paused_again(app: rr.Registrar, provider: rr.Registrar) -> None:
    paused, served = Calls(), Calls()
    provider.register_server(
        "motor", served, lambda *_: None, idle="pause", linger_s=0.0, pause=paused, resume=lambda *_: None
    )
    query = app.load("provider/motor", "x")
    query.standby()
    paused.wait(1)
    while provider.resources()[0].state != "paused":
        pass
    provider.reload(query, timeout_s=LIMIT_S)
    paused.wait(2)
    assert len(served) == 2


def test_what_cannot_be_reloaded_is_refused_by_name(app: rr.Registrar, provider: rr.Registrar) -> None:
    gate = Gate()
    serve(provider, "thing", load=gate)
    loading = app.load("provider/thing", "x", block=False)
    gate.wait_arrived()
    (resource,) = provider.resources()
    with pytest.raises(rr.UsageError, match=f"got {resource.id} of provider/thing, which is loading"):
        provider.reload(resource, timeout_s=LIMIT_S)
    gate.open()
    loading.get(timeout=LIMIT_S)
    with pytest.raises(rr.UnknownQuery, match="nothing"):
        provider.reload("nothing", timeout_s=LIMIT_S)
    with pytest.raises(rr.UsageError, match="expected"):
        provider.reload(7, timeout_s=LIMIT_S)  # type: ignore[arg-type]


def test_a_callback_does_not_wait_for_the_reload_of_its_own_resource(app: rr.Registrar, provider: rr.Registrar) -> None:
    caught = Calls()

    def unload(_request: Any, _response: Any) -> None:
        try:
            provider.reload(query, timeout_s=LIMIT_S)
        except rr.RrError as error:
            caught(str(error))

    serve(provider, "thing", unload=unload)
    query = app.load("provider/thing", "x")
    provider.reload(query, timeout_s=LIMIT_S)
    assert "is called in it: it would wait for itself; another thread may make it" in caught.wait()[0]


class Serial(rr.Manager, serial=True):
    """Opens things one at a time."""

    def __init__(self) -> None:
        self.inside = self.most = 0

    def _pass(self) -> None:
        self.inside += 1
        self.most = max(self.most, self.inside)
        self.inside -= 1

    @rr.server("thing", at_once=1)
    def open(self, request: int) -> int:
        self._pass()
        return request

    @open.unload
    def close(self, request: int, response: int) -> None:
        self._pass()

    def count(self) -> int:
        return self.most


class Ends(rr.Manager):
    """It ends by any message. What it has loaded is loaded again."""

    @rr.server("thing", recovery="reload")
    def load_thing(self, name: str) -> str:
        return name

    def on_receive(self, message: str) -> None:
        raise RuntimeError(message)


def test_a_manager_does_not_wait_in_its_start_for_reloads_that_begin_after_it(
    start: Start, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("rr_actors.registrar.engine.node._RECOVER_S", 3600.0)  # it waits so long for recover callbacks
    system = start(rr.ChildSpec(Ends, id="ends", placement="thread"))
    app = system.open_registrar("app")
    query = app.load("ends/thing", "cup")
    child = system.ref("ends")
    watch = rr.monitor(child)
    child.tell("end")
    down = watch.wait(LIMIT_S)
    assert down is not None
    assert down.reason != "normal"
    child.wait_running(LIMIT_S)
    assert app.load("ends/thing", "cup", timeout_s=LIMIT_S).resource_id == query.resource_id


def test_the_callbacks_of_reloads_of_a_serial_manager_run_one_at_a_time(start: Start) -> None:
    system = start(rr.ChildSpec(Serial, id="things", placement="thread"))
    app, things = system.open_registrar("app"), system.registrar("things")
    queries = [app.load("things/thing", number) for number in range(8)]
    threads = [threading.Thread(target=things.reload, args=(query.resource_id,)) for query in queries]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(LIMIT_S)
    assert [query.wait_status("UPDATE", timeout_s=LIMIT_S).message for query in queries] == ["reloaded"] * 8
    assert system.ref("things").proxy().count().get() == 1


class Deadly(rr.Manager):
    """Kills its process in the callback of this name, once: in its first run after the first load."""

    def __init__(self, root: str, where: str) -> None:
        self.root, self.where = Path(root), where

    def _note(self, what: str) -> int:
        with (self.root / "lines").open("a") as file:
            file.write(f"{what}\n")
        return (self.root / "lines").read_text().splitlines().count(what)

    def _die(self, what: str, runs: int) -> None:
        if self.where == what and runs == 1:
            os.kill(os.getpid(), signal.SIGKILL)

    @rr.server("thing", recovery="keep")
    def open(self, request: str) -> int:
        loads = self._note("load")
        self._die("load", loads - 1)
        return loads

    @open.unload
    def close(self, request: str, response: int) -> None:
        self._die("unload", self._note("unload"))


@pytest.mark.parametrize(
    ("where", "ran"), [("unload", ["load", "unload", "unload", "load"]), ("load", ["load", "unload", "load", "load"])]
)
def test_a_reload_that_a_kill_interrupts_goes_on_where_it_was(
    start: Start, tmp_path: Path, where: str, ran: list[str]
) -> None:
    system = start(rr.ChildSpec(Deadly, id="things", args=(str(tmp_path), where)))
    query = system.open_registrar("app").load("things/thing", "x")
    with pytest.raises(rr.RegistrarDown):  # whether it is done is not known to a handle
        system.registrar("things").reload(query.resource_id, timeout_s=LIMIT_S)
    assert query.wait_status("UPDATE", timeout_s=LIMIT_S).message == "reloaded"
    assert (tmp_path / "lines").read_text().splitlines() == ran
    assert query.response == ran.count("load")
