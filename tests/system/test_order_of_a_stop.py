"""An orderly stop goes by what depends on what, and not by the order of opening (docs/semantics.md)."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

import rr_actors as rr


@pytest.mark.parametrize("first", ["me", "far"])
def test_wholes_are_unloaded_before_parts_whichever_registrar_was_opened_first(tmp_path: Path, first: str) -> None:
    unloaded: list[str] = []
    state, place = tmp_path / "state", tmp_path / "me"
    with rr.System(state_dir=state) as system:
        config = rr.RegistrarConfig(name="me", location=place, erase_on_destruct=True)
        if first == "far":
            system.open_registrar("far")
        me = system.open_registrar("me", config=config)
        far = system.open_registrar("far") if first == "me" else system.registrar("far")
        assert isinstance(far, rr.Registrar)

        def load(request: Any) -> str:
            me.load("far/part", request)
            return "whole"

        far.register_server("part", lambda request: request, lambda request, response: unloaded.append("part"))
        me.register_server("whole", load, lambda request, response: unloaded.append("whole"))
        me.load("me/whole", "a")
    assert unloaded == ["whole", "part"]
    assert not [path for path in place.rglob("*") if path.is_file()]


def test_registrars_that_hold_of_each_other_are_closed_all_the_same(tmp_path: Path) -> None:
    unloaded: list[str] = []
    with rr.System(state_dir=tmp_path / "state") as system:
        one, two = system.open_registrar("one"), system.open_registrar("two")
        for registrar in (one, two):
            registrar.register_server(
                "thing", lambda request: request, lambda request, response: unloaded.append(request)
            )
        one.load("two/thing", "of two")
        two.load("one/thing", "of one")
    assert sorted(unloaded) == ["of one", "of two"]
