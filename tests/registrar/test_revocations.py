"""What a registrar promises about the revocation of resources (docs/semantics.md, "Revocation")."""

from __future__ import annotations

import math
import threading
from typing import Any

import pytest

import rr_actors as rr
from rr_actors.base.values.failure import Failure
from rr_actors.registrar.core.decide import decide
from rr_actors.registrar.model import commands as c
from rr_actors.registrar.model import effects as e
from rr_actors.registrar.model.catalog import Catalog, Server
from rr_actors.registrar.model.messages import Fetch, Gone, Load, Noticed, Unload
from rr_actors.registrar.model.rows import REVOKED, Held, Hold, Notice, Phase, content_of
from support import LIMIT_S, eventually, loaded_with_parts, serve


class Unloads:
    """The unload callbacks of two servers, in their order."""

    def __init__(self) -> None:
        self.order: list[str] = []

    def of(self, name: str) -> Any:
        return lambda request, response: self.order.append(name)


def served(registrar: rr.Registrar) -> list[str]:
    return [info.id for info in registrar.resources()]


def test_the_highest_is_unloaded_first_and_every_holder_hears_why(
    app: rr.Registrar, provider: rr.Registrar, parts: rr.Registrar
) -> None:
    unloads, heard = Unloads(), []
    serve(parts, "part", unload=unloads.of("part"))
    serve(provider, "whole", load=loaded_with_parts(provider, ("parts/part", "bolt")), unload=unloads.of("whole"))
    app.load("provider/whole", "x", on_status=heard.append)
    app.load("parts/part", "bolt", on_status=heard.append)
    (part,) = parts.resources()
    parts.revoke(part, "too little power", grace_s=60, timeout_s=30)
    assert unloads.order == ["whole", "part"]
    assert [(status.state, status.message, status.reason, status.deadline_s) for status in heard] == [
        (rr.State.FATAL, "too little power", "revoked", 60.0)
    ] * 2
    assert eventually(lambda: not app.queries())
    assert served(provider) == served(parts) == []


def test_a_query_of_a_revoked_resource_is_released(app: rr.Registrar, provider: rr.Registrar) -> None:
    serve(provider, "thing")
    with app.load("provider/thing", "x") as query:
        provider.revoke(query.resource_id, "enough", timeout_s=30)
        assert eventually(lambda: not app.queries())
        assert eventually(lambda: query.released)


def test_a_query_that_its_holder_releases_is_not_released_by_its_provider(
    app: rr.Registrar, provider: rr.Registrar
) -> None:
    serve(provider, "thing")
    query = app.load("provider/thing", "x")
    query.unload()
    assert not query.released


@pytest.mark.parametrize("how", ["handled", "replaced"])
def test_a_whole_that_does_without_the_part_lives(
    app: rr.Registrar, provider: rr.Registrar, parts: rr.Registrar, how: str
) -> None:
    def on_status(request: Any, status: rr.Status) -> None:
        if how == "handled":
            status.handled()
        else:
            provider.replace_part(status, "nut", response=lambda spare: "with a nut")

    serve(parts, "part")
    bolts = [("parts/part", "bolt")] * (2 if how == "handled" else 1)
    serve(provider, "whole", load=loaded_with_parts(provider, *bolts), status=on_status)
    whole = app.load("provider/whole", "x")
    (part,) = parts.resources()
    parts.revoke(part.id, "old", grace_s=60, timeout_s=30)
    assert served(provider) == [whole.resource_id]
    left = [info.request for info in parts.resources()]
    assert left == ([] if how == "handled" else ["nut"])


def test_a_holder_that_does_not_let_go_loses_the_resource_at_the_deadline(
    app: rr.Registrar, provider: rr.Registrar
) -> None:
    goes_on = threading.Event()
    serve(provider, "thing")
    query = app.load("provider/thing", "x", on_status=lambda status: goes_on.wait(60))
    provider.revoke(query.resource_id, "now", grace_s=0.1, timeout_s=30)
    assert served(provider) == []
    goes_on.set()
    assert eventually(lambda: not app.queries())


def test_what_cannot_be_revoked_is_refused_by_name(app: rr.Registrar, provider: rr.Registrar) -> None:
    serve(provider, "thing")
    query = app.load("provider/thing", "x")
    with pytest.raises(rr.UnknownQuery):
        provider.revoke("nothing", "why")
    for grace in (-1, math.nan, math.inf, "5", None):
        with pytest.raises(rr.UsageError, match="grace_s"):
            provider.revoke(query.resource_id, "why", grace_s=grace)  # type: ignore[arg-type]
    assert served(provider) == [query.resource_id]


# -- the decisions -----------------------------------------------------------------------------------------------------


class Served:
    """Resource "q" of app, loaded."""

    def __init__(self) -> None:
        self.catalog = Catalog("p")
        self.obey(c.Register(Server("cam"), "event"))
        self.tell(Fetch("app", True))
        self.tell(load("q"))
        self.obey(c.CallbackEnded("load", "q", 1, response=b"feed"))

    def obey(self, command: c.Command) -> list[Any]:
        return self._decide(command, None)

    def tell(self, message: Any) -> list[Any]:
        return self._decide(message, "app")

    def _decide(self, item: Any, sender: str | None) -> list[Any]:
        decision = decide(self.catalog, [(item, sender)])
        decision.close()
        return decision.effects

    def phase(self, id: str = "q") -> Phase | None:
        resource = self.catalog.resources.get(id)
        return resource and resource.phase


def load(id: str) -> Load:
    return Load(id, "cam", b"front", "app", "", 0, 1)


REVOKE = c.Revoke("q", "event", "why", 5000, "ticket")


def test_a_request_for_what_is_revoked_waits_until_it_is_gone() -> None:
    registrar = Served()
    effects = registrar.obey(REVOKE)
    assert any(isinstance(it, e.SendReply) and isinstance(it.message, Noticed) for it in effects)
    registrar.tell(load("next"))
    assert (registrar.phase(), registrar.phase("next")) == (Phase.LOADED, Phase.QUEUED)
    registrar.tell(Unload("q", "app"))
    assert registrar.phase("next") is Phase.QUEUED
    registrar.obey(c.CallbackEnded("unload", "q", 1))
    assert (registrar.phase(), registrar.phase("next")) == (None, Phase.LOADING)
    assert not registrar.catalog.revocations


def test_the_grace_is_over_once_and_begins_again_after_a_crash() -> None:
    registrar = Served()
    registrar.obey(REVOKE)
    rows = [row for table in registrar.catalog.tables.values() for row in table.values()]
    registrar.catalog = Catalog("p", content_of(rows), 2)
    registrar.obey(c.BeginAgain())
    timers = [it for it in registrar.obey(c.BeginServing("serving")) if isinstance(it, e.SetTimer)]
    assert timers == [e.SetTimer("revoke:q", 5.0, c.GraceOver("q", "event"))]
    registrar.obey(c.Register(Server("cam"), "again"))
    registrar.obey(c.GraceOver("q", "another"))
    assert registrar.phase() is Phase.LOADED
    registrar.obey(c.GraceOver("q", "event"))
    assert registrar.phase() is Phase.UNLOADING


@pytest.mark.parametrize("now", ["revoked already", "loading", "unloading"])
def test_what_is_not_loaded_is_not_revoked(now: str) -> None:
    registrar = Served()
    target = "q"
    if now == "revoked already":
        registrar.obey(REVOKE)
    elif now == "unloading":
        registrar.tell(Unload("q", "app"))
    else:
        target = "other"
        registrar.tell(Load("other", "cam", b"back", "app", "", 0, 2))
    (answer,) = registrar.obey(c.Revoke(target, "again", "why", 0, "ticket"))
    assert (answer.ticket, answer.failure.kind) == ("ticket", "UsageError")
    assert now in answer.failure.message


def test_an_unload_that_fails_ends_the_revocation_and_is_the_answer() -> None:
    registrar = Served()
    registrar.obey(REVOKE)
    registrar.tell(Unload("q", "app"))
    failure = Failure("UnloadFailed", "stuck")
    effects = registrar.obey(c.CallbackEnded("unload", "q", 1, failure))
    assert e.AnswerCall("ticket", failure) in effects
    assert not registrar.catalog.revocations
    assert registrar.phase() is Phase.UNLOAD_FAILED


def test_a_release_that_failed_is_sent_again_when_its_resource_is_revoked() -> None:
    catalog = Catalog("app")
    held = Held("q", "p", "cam", b"front", None, "", "", 0, 1, Hold.OWED, rr.State.OK)
    catalog.set("held", "q", held)
    catalog.up["p"] = 1
    said = Notice("event:q", "q", "app", "q", "event", rr.State.FATAL, "why", "p/cam", reason=REVOKED, grace_ms=5000)
    decision = decide(catalog, [(Noticed(said), "p")])
    decision.close()
    assert e.SendRequest("p", Unload("q", "app")) in decision.effects


def test_what_nobody_holds_and_could_not_be_unloaded_is_tried_again() -> None:
    registrar = Served()
    registrar.tell(Unload("q", "app"))
    registrar.obey(c.CallbackEnded("unload", "q", 1, Failure("UnloadFailed", "stuck")))
    registrar.tell(Gone("app"))
    registrar.obey(c.CallbackEnded("unload", "q", 2, Failure("UnloadFailed", "stuck")))
    assert registrar.phase() is Phase.UNLOAD_FAILED
    registrar.obey(REVOKE)
    assert registrar.phase() is Phase.UNLOADING


def test_what_is_lost_gives_up_a_revoked_part_at_once_and_its_holders_hear_nothing_more(
    app: rr.Registrar, provider: rr.Registrar, parts: rr.Registrar
) -> None:
    heard: list[rr.Status] = []
    serve(parts, "part")
    serve(provider, "whole", load=loaded_with_parts(provider, ("parts/part", "bolt")))
    whole = app.load("provider/whole", "x", on_status=heard.append)
    provider.send_status(whole.resource_id, rr.Status("FATAL", "unplugged"))
    assert eventually(lambda: [status.message for status in heard] == ["unplugged"])
    (part,) = parts.resources()
    parts.revoke(part, "too little power", grace_s=600, timeout_s=30)
    assert served(parts) == []
    assert served(provider) == [whole.resource_id]
    whole.unload()
    assert [status.message for status in heard] == ["unplugged"]


def test_what_hears_in_its_status_callback_that_it_is_lost_keeps_its_parts_until_it_has_heard(
    app: rr.Registrar, provider: rr.Registrar, parts: rr.Registrar
) -> None:
    told, revoked = threading.Event(), threading.Event()

    def hear(request: Any, status: rr.Status) -> None:
        if status.reason != "revoked":
            told.set()
            assert revoked.wait(LIMIT_S)
            (part,) = provider.children(rr.current().resource_id)
            provider.replace_part(status, "nut", part=part)

    serve(parts, "part")
    serve(provider, "whole", load=loaded_with_parts(provider, ("parts/part", "bolt")), status=hear)
    whole = app.load("provider/whole", "x")
    (part,) = parts.resources()
    provider.send_status(whole.resource_id, rr.Status("FATAL", "unplugged"))
    assert told.wait(LIMIT_S)
    revocation = threading.Thread(target=parts.revoke, args=(part, "worn"), kwargs={"grace_s": 600})
    revocation.start()
    assert eventually(lambda: parts.resources()[0].message == "worn")
    revoked.set()
    revocation.join(LIMIT_S)
    assert eventually(lambda: [info.request for info in parts.resources()] == ["nut"])
    assert whole.fetch_state() != "FATAL"
