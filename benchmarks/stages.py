"""Where the time of a warm load goes, hop by hop: `python -m benchmarks.stages [--rounds N]`.

Two tables. Stages: the CPU time of each piece of Python and of the commit, each run by itself, many times in a row (so
with warm caches: in a real load they cost more). Round trips: what one exchange with another process takes, from the
least that the machine can do up to a whole load, all measured in turns.
"""

from __future__ import annotations

import argparse
import contextlib
import itertools
import socket
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from typing import Any

import msgspec

import rr_actors as rr
from benchmarks.measure import interleaved
from benchmarks.workload import DURABILITIES, PAYLOAD, SERVER, Answer, Ask, Echo, running, unload_all
from benchmarks.yardsticks import pipe_echo
from rr_actors.base.values.canonical import encode
from rr_actors.registrar.core.decide import decide
from rr_actors.registrar.core.loads import loading
from rr_actors.registrar.engine.registrar_actor import RegistrarActor
from rr_actors.registrar.model.catalog import Decision
from rr_actors.registrar.model.messages import Load, Loaded, Message
from rr_actors.registrar.model.rows import ServedQuery
from rr_actors.wire import frames

A_ROUND = 500
_ORIGIN = "consumer"

# -- stages --------------------------------------------------------------------------------------------------------


class CannedLine:
    """A direct line whose provider answers at once."""

    epoch = 1

    def __init__(self, types: int) -> None:
        self._response = encode(Answer(PAYLOAD))
        self._types = types

    def exchange(self, message: Any, deadline: float) -> Any:
        return Loaded(message.query_id, "resource", self._response, self._types)

    def cut(self) -> None:
        pass

    def close(self) -> None:
        pass


class FramingLink:
    """A consumer's link that frames what is sent and does not write it."""

    def __init__(self) -> None:
        self.flushed = 0
        self._frames = bytearray()

    def send(self, message: Any) -> None:
        self._frames += frames.framed(message, frames.FRAME_LIMIT_BYTES)

    def flush(self) -> None:
        self.flushed += 1
        self._frames = bytearray()

    def send_now(self, message: Any) -> None:
        self.send(message)
        self.flush()

    def close(self) -> None:
        pass


def stages(rounds: int) -> dict[str, float]:
    """CPU seconds of each stage of one warm load, durability "process"; medians of rounds."""
    with both_here() as (provider, consumer):
        figures = {"consumer: Python of Registrar.load()": _consumer(consumer, rounds)}
        figures |= _frames(rounds)
        figures |= _provider(actor_of(provider), rounds)
        return figures


@contextlib.contextmanager
def both_here() -> Iterator[tuple[rr.Registrar, rr.Registrar]]:
    """Provider and consumer in this process, so that what they do can be called; one resource is loaded."""
    with (
        tempfile.TemporaryDirectory(prefix="rr-bench-") as state_dir,
        rr.System([], name="bench", state_dir=state_dir) as system,
    ):
        provider, consumer = system.open_registrar("provider"), system.open_registrar(_ORIGIN)
        echo = Echo()
        provider.register_server("echo", echo.load_echo, request_type=Ask, response_type=Answer)
        consumer.load(SERVER, Ask(0))
        yield provider, consumer


def actor_of(registrar: rr.Registrar) -> RegistrarActor:
    """The actor behind a registrar."""
    return registrar._actor


@contextlib.contextmanager
def answered_at_once(consumer: rr.Registrar) -> Iterator[None]:
    """The consumer's direct lines answer without going anywhere."""
    (client,) = actor_of(consumer).clients.values()
    connections = client.connections
    assert connections is not None, "nothing has been loaded yet"
    connections._idle.append(CannedLine(client.checksums["echo"]))
    try:
        yield
    finally:
        connections._idle.pop()


@contextlib.contextmanager
def framing_only(provider: RegistrarActor) -> Iterator[FramingLink]:
    """The provider's link to the consumer frames answers and writes nothing. On the loop."""
    links, framing = provider.consumers._links, FramingLink()
    link, links[_ORIGIN] = links[_ORIGIN], framing  # type: ignore[assignment]  # what is used of a Link
    try:
        yield framing
    finally:
        links[_ORIGIN] = link


def warm_loads() -> Iterator[Load]:
    """Loads of the resource that is there, each with an id of its own."""
    request = encode(Ask(0))
    return (Load(f"{number:032x}", "echo", request, _ORIGIN, "", 0, 1) for number in itertools.count())


def _median_of(rounds: int, once: Callable[[], float]) -> float:
    once()
    return statistics.median(once() for _ in range(rounds))


def _repeated(operation: Callable[[], object], rounds: int) -> float:
    def once() -> float:
        start = time.thread_time()
        for _ in range(A_ROUND):
            operation()
        return (time.thread_time() - start) / A_ROUND

    return _median_of(rounds, once)


def _consumer(consumer: rr.Registrar, rounds: int) -> float:
    """The caller's thread, everything but the exchange with the provider."""
    with answered_at_once(consumer):
        return _repeated(lambda: consumer.load(SERVER, Ask(0)), rounds)


def _frames(rounds: int) -> dict[str, float]:
    load = Load("0" * 32, "echo", encode(Ask(0)), _ORIGIN, "", 0, 1)
    loaded = Loaded("0" * 32, "0" * 32, encode(Answer(PAYLOAD)))
    decoder: msgspec.msgpack.Decoder[Any] = msgspec.msgpack.Decoder(Message)
    at_provider, at_consumer = (frames.FrameReader(decoder, frames.FRAME_LIMIT_BYTES) for _ in range(2))
    asked, answered = (frames.framed(message, 1 << 20) for message in (load, loaded))
    return {
        "consumer: frame the Load": _repeated(lambda: frames.framed(load, 1 << 20), rounds),
        "provider: decode the Load": _repeated(lambda: at_provider.feed(asked), rounds),
        "consumer: decode the Loaded": _repeated(lambda: at_consumer.feed(answered), rounds),
    }


def decided_alone(actor: RegistrarActor, load: Load) -> Decision:
    """What one Load changes and causes, if nothing else comes with it."""
    with actor.lock:
        return decide(actor.catalog, [actor.reader.read(load, _ORIGIN)])


def _provider(actor: RegistrarActor, rounds: int) -> dict[str, float]:
    """What the provider's loop does with one Load of a direct line, each step for many Loads before the next step."""
    source = warm_loads()
    taken: dict[str, list[float]] = {"provider: decide": [], "provider: commit": [], "provider: answer": []}
    line = FramingLink()

    def answer(query: ServedQuery) -> None:
        response = actor.catalog.resources[query.resource_id].response or b""
        line.send(Loaded(query.id, query.resource_id, response))
        line.flush()

    def once() -> None:
        loads = list(itertools.islice(source, A_ROUND))
        clock = time.thread_time
        begin = clock()
        queries = [query for load in loads if (query := loading.join(actor.catalog, load)) is not None]
        for query in queries:
            actor.catalog.set("queries", query.id, query)
        decided = clock()
        for query in queries:
            actor.commits.commit_row(query)
        committed = clock()
        for query in queries:
            answer(query)
        answered = clock()
        assert len(queries) == A_ROUND
        taken["provider: decide"].append((decided - begin) / A_ROUND)
        taken["provider: commit"].append((committed - decided) / A_ROUND)
        taken["provider: answer"].append((answered - committed) / A_ROUND)

    async def all_rounds() -> None:
        for _ in range(rounds + 1):
            once()

    actor.node.dispatcher.run(all_rounds())
    return {stage: statistics.median(seconds[1:]) for stage, seconds in taken.items()}


# -- round trips ---------------------------------------------------------------------------------------------------

_BLOCKING_ECHO = """
import socket, sys
connection = socket.socket(fileno=int(sys.argv[1]))
while data := connection.recv(65536):
    connection.sendall(data)
"""
_LOOP_ECHO = """
import asyncio, socket, sys
import uvloop
class Echo(asyncio.Protocol):
    def connection_made(self, transport):
        self.transport = transport
    def data_received(self, data):
        self.transport.write(data)
    def connection_lost(self, error):
        asyncio.get_running_loop().stop()
loop = uvloop.new_event_loop()
asyncio.set_event_loop(loop)
connection = socket.socket(fileno=int(sys.argv[1]))
loop.run_until_complete(loop.create_unix_connection(Echo, sock=connection))
loop.run_forever()
"""


@contextlib.contextmanager
def _socket_echo(program: str) -> Iterator[Callable[[], bytes]]:
    here, there = socket.socketpair()
    process = subprocess.Popen([sys.executable, "-c", program, str(there.fileno())], pass_fds=[there.fileno()])
    there.close()

    def echo() -> bytes:
        here.sendall(PAYLOAD)
        return here.recv(65536)

    try:
        yield echo
    finally:
        here.close()
        process.wait()


def round_trips(rounds: int) -> dict[str, float]:
    """Seconds of one exchange, medians; measured in turns."""
    with contextlib.ExitStack() as stack:
        operations: dict[str, Callable[[], object]] = {
            "raw pipe": stack.enter_context(pipe_echo(PAYLOAD)),
            "raw Unix socket, blocking echo": stack.enter_context(_socket_echo(_BLOCKING_ECHO)),
            "raw Unix socket, uvloop echo": stack.enter_context(_socket_echo(_LOOP_ECHO)),
        }
        cleaners: list[Callable[[], None]] = []
        for durability in DURABILITIES[:2]:
            system, consumer = stack.enter_context(running(durability))
            system.open_registrar("holder").load(SERVER, Ask(0))
            load, let_go = _loading(consumer)
            cleaners.append(let_go)
            operations[f"warm load, durability {durability}"] = load
        measured = interleaved(
            operations, times=A_ROUND * rounds, rounds=rounds, after_turn=lambda: [clean() for clean in cleaners]
        )
    return {name: samples.median for name, samples in measured.items()}


def _loading(consumer: rr.Registrar) -> tuple[Callable[[], None], Callable[[], None]]:
    queries: list[rr.Query] = []

    def load() -> None:
        queries.append(consumer.load(SERVER, Ask(0)))

    def let_go() -> None:
        unload_all(queries, consumer)
        queries.clear()

    return load, let_go


# -- picture -------------------------------------------------------------------------------------------------------


def chart(figures: dict[str, float], width: int = 40) -> str:
    """A bar for each figure, given in seconds and shown in microseconds."""
    most = max(figures.values())
    wide = max(map(len, figures))
    return "\n".join(
        f"{name.ljust(wide)}  {seconds * 1e6:6.1f} µs  {'█' * max(1, round(width * seconds / most))}"
        for name, seconds in figures.items()
    )


def main() -> None:
    """Measure and draw both."""
    parser = argparse.ArgumentParser(prog="benchmarks.stages", description="Where the time of a warm load goes.")
    parser.add_argument("--rounds", type=int, default=20)
    rounds = parser.parse_args().rounds
    figures = stages(rounds)
    print("CPU time of one warm load, durability process")
    print(chart(figures))
    print(f"together {sum(figures.values()) * 1e6:.1f} µs\n")
    print("Round trips to another process, 200 bytes")
    trips = round_trips(rounds)
    print(chart(trips))
    pipe = trips["raw pipe"]
    print("× raw pipe: " + ", ".join(f"{name} {seconds / pipe:.2f}" for name, seconds in trips.items()))


if __name__ == "__main__":
    main()
