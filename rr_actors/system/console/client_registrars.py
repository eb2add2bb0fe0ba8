"""Registrars of clients: opened in the application's process for another process, as long as that is connected.

Each belongs to one connection. The kernel closes the connection when the client ends, however it ends. Then the
registrar is closed, and its queries are released. In the system it is called "client.NAME". The system's next start
gives up those that a killed application left.
"""

from __future__ import annotations

import logging
import threading

from rr_actors.base.errors import NotSerializable, RrError, Unavailable, UnknownQuery, UnknownRegistrar, shown, text_of
from rr_actors.base.names import CLIENTS, check_name
from rr_actors.base.values.canonical import Codec, encode
from rr_actors.registrar.registrar import Registrar, load_bytes
from rr_actors.system.console.console_messages import (
    RESPONSE_LIMIT_BYTES,
    AskActor,
    Done,
    Hold,
    Holding,
    Release,
    Replied,
)
from rr_actors.system.console.console_questions import View, Viewed

logger = logging.getLogger("rr_actors")


class ClientRegistrars:
    """The clients' registrars of one system. In workers."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._open: dict[str, tuple[object, Registrar]] = {}

    def open(self, view: View, name: str, owner: object) -> Done:
        """Open a registrar for a connection.

        Raises:
            InvalidName, NameTaken: the name is not valid, or another client has it.
        """
        full = check_name(CLIENTS + check_name(name, "registrar name"), "registrar name")
        registrar = view.open_registrar(full)
        with self._lock:
            self._open[full] = owner, registrar
        return Done(f"opened registrar {full}", {"registrar": full})

    def close(self, owner: object) -> None:
        """Close the registrars of a connection that has ended, and release what they hold."""
        with self._lock:
            mine = [name for name, (other, _) in self._open.items() if other is owner]
            closing = [self._open.pop(name)[1] for name in mine]
        for registrar in closing:
            try:
                registrar.close()
                logger.info("registrar %s: closed, as its client has gone", registrar.name)
            except Exception:  # a provider's error, or a defect: go on with the others
                logger.exception(
                    "registrar %s: its client has gone, and not all that it held is released", registrar.name
                )

    def hold(self, command: Hold) -> Holding:
        """Load a resource for a client.

        Raises:
            RrError: as Registrar.load(), or the response is too long.
        """
        registrar = self._of(command.registrar)
        query, response = load_bytes(registrar, command.server, command.request, command.timeout_s)
        if len(response) > RESPONSE_LIMIT_BYTES:
            registrar.unload(query.id, timeout_s=command.timeout_s)
            text = f"a response of {len(response)} bytes is over a client's limit of {RESPONSE_LIMIT_BYTES}"
            raise NotSerializable(f"{command.server}: {text}; give the name of a file, say", path="response")
        return Holding(query.id, query.resource_id, response)

    def release(self, command: Release) -> Done:
        """Release a query of a client's registrar.

        Raises:
            RrError: as Registrar.unload().
        """
        self._of(command.registrar).unload(command.query_id, timeout_s=command.timeout_s)
        return Done(f"released {command.query_id}")

    def release_unheard(self, registrar: str, query_id: str) -> None:
        """Release a query of a client that left before it kept the query."""
        try:
            self._of(registrar).unload(query_id)
        except (UnknownQuery, UnknownRegistrar):
            logger.debug("query %s: released by its client or with its registrar", query_id)
        except RrError:
            logger.exception("query %s: its client has gone, and it is not released", query_id)

    def _of(self, name: str) -> Registrar:
        with self._lock:
            entry = self._open.get(name)
        if entry is None:
            raise UnknownRegistrar(
                f"registrar {shown(name)}: no client has opened it, or its client has gone", registrar=name
            )
        return entry[1]


def ask(system: Viewed, command: AskActor) -> Replied:
    """Ask an actor of the system, and return its answer.

    Raises:
        RrError: there is no such actor, it does not answer, its handler raised, or its answer is no plain data.
    """
    message = _plain.decode(command.message, command.actor, "message")
    reply = system.ref(command.actor).ask(message, block=False)
    try:
        error = reply.exception(command.timeout_s)
    except TimeoutError as late:
        reply.cancel()
        text = f"{command.actor}: it has not answered within {command.timeout_s:g} s; a later answer reaches nobody"
        raise Unavailable(text) from late
    if error is not None and not isinstance(error, RrError):  # raised by the actor's handler
        raise RrError(f"{command.actor}: {text_of(error)}") from error
    return Replied(encode(reply.get(), f"answer of {command.actor}"))


_plain = Codec(None, "message")
