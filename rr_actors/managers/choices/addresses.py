"""Addresses: the relays of choices, each of which stays while what is behind it changes."""

from __future__ import annotations

from collections.abc import Collection
from pathlib import Path
from typing import cast

from msgspec.structs import replace

from rr_actors.managers.choices.alternatives import Alternative
from rr_actors.managers.choices.chosen import Chosen, HeldChoice, chosen_of
from rr_actors.managers.choices.relays import Relays, SocketAddress, parse_address
from rr_actors.registrar.queries import Query


class Addresses:
    """The relays of the choices of one manager, by the id of the choice. From any thread."""

    def __init__(self, directory: Path, hosts: Collection[str]) -> None:
        """Make sockets in `directory`. Relays may connect to these hosts, and to this machine."""
        self._directory, self._hosts = directory, hosts
        self._relays = Relays()

    def made(self, id: str, held: HeldChoice, one: Alternative, query: Query) -> Chosen:
        """Return the response of a choice with this part; open its relay if it is to have one.

        Raises:
            ConfigError: it is to have a relay, and the part's response has no address that a relay may connect to.
            Unavailable: the relay cannot be opened.
        """
        chosen = chosen_of(one, query)
        if held.request.bind:
            source = self._source_of(chosen)
            held.address = held.address or str(self._relays.open(id, self._new_address(id, source)))
            chosen = replace(chosen, address=held.address)
        return chosen

    def point(self, id: str, chosen: Chosen | None) -> None:
        """Have the relay of a choice connect to its part; with None, to nothing."""
        if chosen is None:
            self._relays.point(id, None)
        elif chosen.address:
            self._relays.point(id, self._source_of(chosen))

    def restore(self, id: str, chosen: Chosen) -> None:
        """Open a relay at the address that programs know.

        Raises:
            RrError: that is not possible.
        """
        self._relays.open(id, parse_address(chosen.address))
        self.point(id, chosen)

    def close(self, id: str) -> None:
        """Close the relay of a choice, if it has one."""
        self._relays.close(id)

    def stop(self) -> None:
        """Close all relays."""
        self._relays.stop()

    def _new_address(self, id: str, source: SocketAddress) -> SocketAddress:
        return SocketAddress("127.0.0.1") if source.port else SocketAddress(str(self._directory / f"{id[-12:]}.sock"))

    def _source_of(self, chosen: Chosen) -> SocketAddress:
        given: object = chosen.response
        if isinstance(given, dict):
            given = cast("dict[str, object]", given).get("address")
        return parse_address(given, self._hosts)
