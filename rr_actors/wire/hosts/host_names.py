"""The names of hosts: what a system knows of others, and which provider a server's id means. No network.

The gateway writes a row for each other host into the directory of names, and an entry for each of its registrars,
"hostb/cameras". All processes of the system read them there.
"""

from __future__ import annotations

import re
import time

import msgspec

from rr_actors.base.errors import NameTaken, NotExported, ProtocolMismatch, UnknownHost, did_you_mean, few
from rr_actors.base.names import ServerId
from rr_actors.wire.hosts.lease_rows import read_lease
from rr_actors.wire.name_service import Directory, HostInfo, Presence, registrar_key

UP = "up"
"""The state of a host that is reachable."""
UNREACHABLE = "unreachable"
"""The state of a host that was lost, or has not been seen yet."""
REFUSED = "refused"
"""The state of a host that speaks another version of the protocol, or for which this one's name is taken."""

_LOOPBACK = re.compile(r"tcp/(127\.\d+\.\d+\.\d+|localhost|\[::1\]):\d{1,5}")
ENDPOINT = "an endpoint on loopback, such as 'tcp/127.0.0.1:7447', as links between hosts are not encrypted yet"
"""What is expected of an endpoint, for errors."""


def is_endpoint(text: str) -> bool:
    """Return whether a text is an endpoint that may be listened at and connected to."""
    return _LOOPBACK.fullmatch(text) is not None


class HostRow(msgspec.Struct, frozen=True):
    """What is known of another host. `since`: when that began, in seconds since 1970.

    `name_taken`: it is refused as another system has this host's name, and not for its version.
    """

    state: str
    since: float
    why: str = ""
    name_taken: bool = False


_encode = msgspec.json.Encoder().encode
_decode = msgspec.json.Decoder(HostRow).decode


def put_row(directory: Directory, host: str, row: HostRow) -> None:
    """Write the row of a host, whose reason has 250 characters at most."""
    directory.put_host(host, _encode(row).decode())


def row_of(directory: Directory, host: str) -> HostRow | None:
    """Return the row of a host; None if nothing is known of it."""
    text = directory.host(host)
    return _decode(text) if text else None


def not_exported(host: str) -> str:
    """Return the reason in the entry of a registrar that a host does not let this one use."""
    return f"host {host!r} does not export it to this one"


def away(host: str, row: HostRow) -> str:
    """Return the reason in the entries of the registrars of a host that is not reachable."""
    since = time.strftime("%H:%M:%S", time.localtime(row.since))
    return f"{host}: {row.state} since {since}: {row.why}"


class HostNames(msgspec.Struct, frozen=True):
    """The own host's name, and the registrars for which another host's are meant: {"maps": "hostb/maps"}."""

    host: str
    routes: dict[str, str] = {}

    def provider(self, asked: ServerId, directory: Directory) -> ServerId:
        """Return the server that is meant: behind a route, or without the own host's name.

        A load at a host that is not reachable waits, so its registrar gets an entry if it has none.

        Raises:
            UnknownHost: no such host was seen, or is named in the settings.
            NotExported: the host is there, and does not export that registrar.
            ProtocolMismatch: the host speaks another version.
            NameTaken: for the host, another system has this one's name.
        """
        registrar = self.routes.get(asked.registrar, asked.registrar)
        host, slash, own = registrar.partition("/")
        if not slash:
            return asked
        if host == self.host:
            return ServerId(own, asked.server)
        target = ServerId(registrar, asked.server)
        key = registrar_key(registrar)
        entry = directory.lookup(key)
        if entry is not None and entry.status is Presence.UP:
            return target
        row = row_of(directory, host)
        if row is None:
            raise self._unknown(host, target, directory)
        if row.state == REFUSED:
            text = f"{target}: {row.why}"
            raise NameTaken(text, name=self.host) if row.name_taken else ProtocolMismatch(text, host=host)
        if row.state == UNREACHABLE and entry is None:
            directory.mark(key, Presence.STARTING, away(host, row))
        elif row.state == UP and (entry is None or entry.why == not_exported(host)):
            known = [name for info in self.known(directory) if info.name == host for name in info.exports]
            hint = did_you_mean(own, known) or f"; it exports: {few(known) or 'none'}"
            text = f"{target}: host {host!r} does not export {own!r} to {self.host!r}{hint}"
            raise NotExported(text, host=host, registrar=own, known=tuple(known))
        return target

    def _unknown(self, host: str, target: ServerId, directory: Directory) -> UnknownHost:
        known = [*directory.hosts(), self.host]
        hint = did_you_mean(host, known) or f"; there are: {few(sorted(known))}"
        return UnknownHost(f"{target}: no host {host!r} is known here{hint}", host=host, known=tuple(known))

    def known(self, directory: Directory) -> list[HostInfo]:
        """Return the other hosts that the directory knows, sorted by name."""
        found: list[HostInfo] = []
        registrars = directory.other_hosts_registrars()
        for host in directory.hosts():
            if (row := row_of(directory, host)) is None:
                continue
            exports: dict[str, str] = {}
            for name in registrars:
                entry = directory.lookup(registrar_key(name)) if name.startswith(f"{host}/") else None
                if entry is not None and entry.why != not_exported(host):
                    exports[name.removeprefix(f"{host}/")] = str(entry.status)
            found.append(HostInfo(host, row.state, row.since, row.why, exports))
        return found

    def lease(self, state_dir: str, registrar: str) -> tuple[int, float] | None:
        """Return the number of the lease at the host of a registrar, and how many seconds it goes on.

        None: that registrar is of this host, or it releases nothing when a lease ends.
        """
        host, slash, name = registrar.partition("/")
        row = read_lease(state_dir, host) if slash else None
        return None if row is None or name not in row.registrars else (row.number, row.left_s)

    def unreachable(self, directory: Directory, registrar: str) -> HostInfo | None:
        """Return the host of a registrar if that is another one, and not reachable now."""
        host, slash, _ = registrar.partition("/")
        row = row_of(directory, host) if slash else None
        return None if row is None or row.state != UNREACHABLE else HostInfo(host, row.state, row.since, row.why, {})
