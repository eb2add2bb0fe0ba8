"""A resource never becomes its own part (docs/semantics.md, "Dependencies")."""

from __future__ import annotations

import pytest

import rr_actors as rr


def test_a_resource_that_would_become_its_own_part_is_refused_by_name(
    app: rr.Registrar, provider: rr.Registrar
) -> None:
    provider.register_server("thing", lambda request: request)
    one = app.load("provider/thing", "one")
    with pytest.raises(rr.CircularDependency, match="its own part"):
        provider.load("provider/thing", "one", parent=one.resource_id)
    one.unload()
    assert provider.resources() == []


def test_resources_do_not_become_parts_of_each_other(app: rr.Registrar, provider: rr.Registrar) -> None:
    provider.register_server("thing", lambda request: request)
    whole, part = app.load("provider/thing", "whole"), app.load("provider/thing", "part")
    provider.load("provider/thing", "part", parent=whole.resource_id)
    with pytest.raises(rr.CircularDependency, match="provider/thing -> provider/thing -> provider/thing"):
        provider.load("provider/thing", "whole", parent=part.resource_id)
    whole.unload()
    part.unload()
    assert provider.resources() == []
