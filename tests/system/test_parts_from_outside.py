"""A part is not taken from its whole by a call from outside (docs/semantics.md, "Dependencies")."""

from __future__ import annotations

from pathlib import Path

import pytest

import rr_actors as rr
from support_cli import run_cli


class Maps(rr.Manager):
    """A map has a tile as its part, and gives it up for a status of its own."""

    @rr.server("tile", recovery="keep")
    def load_tile(self, request: str) -> str:
        return request

    @rr.server("map", recovery="keep")
    def load_map(self, request: str) -> str:
        return str(self.registrar.load("maps/tile", request).response)

    @load_map.status
    def status_of_map(self, request: str, status: rr.Status) -> None:
        for query in self.registrar.queries():
            self.registrar.unload(query)


@pytest.mark.parametrize("by", ["handle", "handle, all at a server", "command line"])
def test_a_part_is_not_unloaded_from_outside_without_force(tmp_path: Path, by: str) -> None:
    state = tmp_path / "state"
    with rr.System([rr.ChildSpec(Maps, id="maps")], state_dir=state) as system:
        app = system.open_registrar("app")
        whole = app.load("maps/map", "hall")
        maps = system.registrar("maps")
        (part,) = app.children(whole)
        if by.startswith("handle"):
            with pytest.raises(rr.UsageError, match=r'a part of maps/map "hall".*revoke.*force'):
                maps.unload(part.id) if by == "handle" else maps.unload_client("maps/tile")
        else:
            for more in ((), ("--dry-run",)):
                done = run_cli("unload", part.id, "--state", str(state), *more)
                assert done.returncode != 0
                assert 'a part of maps/map "hall"' in " ".join((done.stdout + done.stderr).split())
        assert [query.id for query in app.children(whole)] == [part.id]
        assert whole.state is rr.State.OK
        maps.send_status(whole.resource_id, rr.Status(rr.State.WARNING, "give it up"))
        whole.wait_status(rr.State.WARNING)
        assert app.children(whole) == []
