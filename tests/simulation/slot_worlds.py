"""python -m simulation.slot_worlds: the slots of a stream's shared memory, walked in every interleaving.

One publisher has some threads, and there are some readers. Which slot is whose is decided by the product: Slots,
Consumer and places_in. Only what is around these is simulated: the memory, the sockets, the processes. Each page that
is written, each reader that is given a frame and each view that is dropped is a step of its own, and a process may die
between two.

After each step, each value that somebody has must be as it was published. From each state all is then brought to rest:
nobody waits for a dead reader, a reader that is there gets the newest frame, and no slot is in use that nobody has.
"""

from __future__ import annotations

import argparse
import hashlib
import os
import pickle
import select
import sys
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from typing import Literal, NamedTuple

import msgspec

from rr_actors.streams.known_reader import Connected, KnownReader, PublishedFrame
from rr_actors.streams.stream import Keep, Stream
from rr_actors.streams.stream_sockets import WISH, packet_of
from rr_actors.wire.segment_slots import PAGE_BYTES, Slot, Slots
from rr_actors.wire.segments import Lie, Parcel, places_in
from simulation.explore import Walk

FRAME_PAGES = 2
_FIRST_NUMBER = 8
_PACKETS = 4  # that a socket has room for

Step = tuple[str, *tuple[int, ...]]
What = Literal["copy", "loan", "abort"]


class Broken(Exception):
    """A promise of the slots was broken."""


def packed(world: World) -> bytes:
    """The world as bytes, to go on from later. It has no lock, which could not be packed."""
    return pickle.dumps(world)


class Segment:
    """Shared memory: the head, and which frame each page has. It lives as long as somebody has it."""

    def __init__(self, pages: int) -> None:
        self.head = bytearray(PAGE_BYTES * (1 + pages))
        self.pages: list[int] = [0] * (1 + pages)

    def has(self, slot: Slot | View, frame: int) -> bool:
        """Whether a whole frame is there, and nothing else."""
        return {*self.pages[slot.start // PAGE_BYTES : slot.end // PAGE_BYTES]} == {frame}


class View(NamedTuple):
    """A value that a process has in its hands."""

    segment: Segment
    number: int
    start: int
    end: int
    frame: int


class Link:
    """A reader's connection, as both ends and the kernel know it."""

    def __init__(self, segment: Segment) -> None:
        self.segment = segment
        self.mask = 0
        self.asked: deque[bytes] = deque()
        self.packets: deque[bytes] = deque()
        self.shut = self.ended = False  # by the reader: for writing, or as a whole

    def recv(self, size: int, /) -> bytes:
        """Return what the reader has sent."""
        if self.asked:
            return self.asked.popleft()
        if self.shut:
            return b""
        raise BlockingIOError

    def send(self, packet: bytes, /) -> int:
        """Put a packet where the reader finds it."""
        if self.ended:
            raise BrokenPipeError
        if len(self.packets) == _PACKETS:
            raise BlockingIOError
        self.packets.append(packet)
        return len(packet)

    def has_unread(self) -> bool:
        """Return whether the reader has still to read a packet."""
        return bool(self.packets) and not self.ended

    def end(self) -> None:
        """Have the reader hear that it gets nothing more."""
        raise Broken("the publisher gives a reader up")

    def fileno(self) -> int:
        """Return no descriptor: there is none."""
        return -1

    def close(self) -> None:
        """Close the publisher's end, of which the reader reads no more."""


class Poller:
    """Notes what the publisher's thread is to be told of each connection."""

    def register(self, connected: Connected, events: int, /) -> None:
        """Tell it of these events."""
        assert isinstance(connected, Link)
        connected.mask = events

    modify = register


class Sharing:
    """What Parcels does beside its Slots."""

    def __init__(self, slots: Slots) -> None:
        self._slots = slots

    def may_share(self, holder: object, most_bytes: int) -> bool:
        """Return whether share() would return a parcel."""
        return self._slots.may_share(holder, most_bytes)

    def share(self, parcel: Parcel, holder: object, most_bytes: int) -> Parcel | None:
        """Return a parcel for one more holder."""
        number = self._slots.share(parcel.slot, holder, most_bytes)
        return None if number is None else msgspec.structs.replace(parcel, slot=number)

    def discard(self, parcel: Parcel) -> None:
        """Free the slot of a parcel that was not sent."""
        self._slots.free(parcel.slot)

    def take_back(self, holder: object) -> None:
        """Free all that a holder has."""
        self._slots.take_back(holder)


class Reader:
    """A process that reads the stream."""

    def __init__(self, keep: Keep) -> None:
        self.keep: Keep = keep
        self.link: Link | None = None
        self.lines: list[Link] = []  # shut, and open for the sake of the views
        self.views: list[View] = []
        self.owes = False
        self.last = 0

    def come(self, segment: Segment) -> Link:
        """Connect to the publisher."""
        self.leave()
        self.link = link = Link(segment)
        link.asked.append(msgspec.msgpack.encode((self.keep, 1)))
        self.owes, self.last = self.keep == "latest", 0
        return link

    def ask(self) -> None:
        """Say that it can take one more frame."""
        assert self.link is not None
        self.link.asked.append(WISH)
        self.owes = False

    def read(self) -> None:
        """Take the next packet, and have its value in hand."""
        assert self.link is not None
        number, _, body, note = msgspec.structs.astuple(packet_of(self.link.packets.popleft()))
        if note:
            return
        self.owes, self.last = True, number
        assert isinstance(body, Parcel)
        segment = self.link.segment
        try:
            end = places_in(body, segment.head)[-1]
        except Lie as error:
            raise Broken(f"frame {body.key} is refused: {error}") from error
        self.views.append(View(segment, body.slot, body.start, end, body.key))

    def drop(self, which: int) -> None:
        """Have one value no more."""
        view = self.views.pop(which)
        view.segment.head[view.number] = 0
        self._end_lines()

    def leave(self) -> None:
        """Read no more. The connection stays open while it has values of it."""
        if self.link is not None:
            self.link.shut = True
            self.link.packets.clear()
            self.lines.append(self.link)
            self.link = None
            self._end_lines()

    def _end_lines(self) -> None:
        for line in [line for line in self.lines if all(view.segment is not line.segment for view in self.views)]:
            self.lines.remove(line)
            line.ended = True

    def die(self) -> None:
        """Be killed."""
        self.leave()
        self.views.clear()
        self._end_lines()


class Core(NamedTuple):
    """The decisions that are walked."""

    slots: type[Slots] = Slots
    consumer: type[KnownReader] = KnownReader
    reader: type[Reader] = Reader


PRODUCT = Core()


class SlotWorld(NamedTuple):
    """What there is, and how often something may happen in one history.

    Args:
        threads: what each thread of the publisher does, in this order. "abort": a loan whose block raises.
        readers: which frames each reader wants.
        pages: of the segment.
        numbers: of slots.
        most_pages: that a reader may keep, if these are more than two values.
        closes, crashes: how many readers are closed, or killed.
        downs: how often the publisher is killed, and respawned.
        cools: how often free pages are given back to the machine.
    """

    threads: tuple[tuple[What, ...], ...]
    readers: tuple[Keep, ...] = ("latest",)
    pages: int = 3 * FRAME_PAGES
    numbers: int = 6
    most_pages: int = FRAME_PAGES
    closes: int = 0
    crashes: int = 0
    downs: int = 0
    cools: int = 0


class Thread:
    """A thread that publishes: what is left for it to do, and how far it is with the frame of now."""

    def __init__(self, program: Sequence[What]) -> None:
        self.program = deque(program)
        self.slot: Slot | None = None
        self.written = 0
        self.frame = 0
        self.number = 0  # from when readers are given it
        self.to: deque[KnownReader] = deque()  # who is still to be given it


class World:
    """One publisher and its readers, at one moment."""

    def __init__(self, small: SlotWorld, core: Core) -> None:
        self.small = small
        self.core = core
        self.threads = [Thread(program) for program in small.threads]
        self.readers = [core.reader(keep) for keep in small.readers]
        self.loans: list[View] = []
        self.frames = 0
        self.spent = {"close": 0, "crash": 0, "down": 0, "cool": 0}
        self._rise()
        for number in range(len(self.readers)):
            self.do(("come", number))
            self.do(("hear", number))

    def _rise(self) -> None:
        self.segment = Segment(self.small.pages)
        numbers = range(_FIRST_NUMBER, _FIRST_NUMBER + self.small.numbers)
        self.slots = self.core.slots(self.segment.head, PAGE_BYTES, len(self.segment.head), numbers)
        self.sharing = Sharing(self.slots)
        self.consumers: list[tuple[Link, KnownReader]] = []
        self.number = 0

    # -- what can happen -----------------------------------------------------------------------------------------------

    def moves(self) -> Iterator[Step]:
        """Yield the steps that can happen now."""
        for number, thread in enumerate(self.threads):
            if thread.program and self._can_go_on(thread):
                yield "publish", number
        for number in range(len(self.loans)):
            yield "forget", number
        for number, (link, _) in enumerate(self.consumers):
            if link.ended:
                yield "end", number
            elif (link.asked and link.mask & select.EPOLLIN) or (link.shut and link.mask & select.EPOLLRDHUP):
                yield "hear", number
        for number, reader in enumerate(self.readers):
            yield from self._moves_of(number, reader)
        for what, most in (("down", self.small.downs), ("cool", self.small.cools)):
            if self.spent[what] < most:
                yield (what,)

    def _moves_of(self, number: int, reader: Reader) -> Iterator[Step]:
        for which in range(len(reader.views)):
            yield "drop", number, which
        if (link := reader.link) is not None:
            if reader.owes:
                yield "ask", number
            if link.packets:
                yield "read", number
            elif link.segment is not self.segment:
                yield "come", number
            if self.spent["close"] < self.small.closes:
                yield "close", number
        if (link is not None or reader.views) and self.spent["crash"] < self.small.crashes:
            yield "crash", number

    def _can_go_on(self, thread: Thread) -> bool:
        """Whether it waits for no reader of all frames."""
        if not thread.to or thread.to[0].keep == "latest" or thread.to[0].left:
            return True
        return thread.to[0].readiness(self._frame(thread)) != "behind"

    # -- what happens --------------------------------------------------------------------------------------------------

    def do(self, step: Step) -> None:
        """Do a step; raise Broken if a promise is broken."""
        what, *where = step
        if what in self.spent:
            self.spent[what] += 1
        reader = self.readers[where[0]] if what in _OF_READERS else None
        match what:
            case "publish":
                self._go_on(self.threads[where[0]])
            case "forget":
                self.slots.free(self.loans.pop(where[0]).number)
            case "hear":
                self.consumers[where[0]][1].receive()
            case "end":
                self.consumers.pop(where[0])[1].close()
            case "down":
                self._go_down()
            case "cool":
                for start, end in self.slots.cool(len(self.segment.head)):
                    for page in range(start // PAGE_BYTES, end // PAGE_BYTES):
                        self.segment.pages[page] = 0
            case _:
                assert reader is not None
                self._read(reader, what, where)
        self.check()

    def _read(self, reader: Reader, what: str, where: list[int]) -> None:
        if what == "come":
            link = reader.come(self.segment)
            self.consumers.append((link, self.core.consumer(link, os.getpid(), self.sharing, Poller(), _unheard)))
        elif what == "drop":
            reader.drop(where[1])
        else:
            {"ask": reader.ask, "read": reader.read, "close": reader.leave, "crash": reader.die}[what]()

    def _go_on(self, thread: Thread) -> None:
        """Do the next thing that a thread does to publish a frame, as Publisher does it."""
        if not thread.frame:
            self.frames += 1
            thread.frame, thread.written = self.frames, 0
            thread.slot = self.slots.take(FRAME_PAGES * PAGE_BYTES, len(self.segment.head))
        elif thread.slot is not None and thread.written < FRAME_PAGES:
            self.segment.pages[thread.slot.start // PAGE_BYTES + thread.written] = thread.frame
            thread.written += 1
            if thread.program[0] == "abort":
                self._end(thread)
        elif not thread.number:
            self.number += 1
            thread.number = self.number
            thread.to.extend(consumer for _, consumer in self.consumers if consumer.keep and not consumer.left)
        elif thread.to:
            consumer = thread.to.popleft()
            if consumer.keep == "latest" or not consumer.left:
                consumer.give(self._frame(thread))
        else:
            self._end(thread)

    def _frame(self, thread: Thread) -> PublishedFrame:
        return PublishedFrame(thread.number, 0.0, b"", self._body(thread), self.small.most_pages * PAGE_BYTES)

    def _body(self, thread: Thread) -> bytes | Parcel:
        if (slot := thread.slot) is None:
            return b""
        lengths = (slot.end - slot.start,)
        return Parcel(0, thread.frame, len(self.segment.head), slot.number, slot.start, lengths)

    def _end(self, thread: Thread) -> None:
        """Have published: a loan's array may be in use for longer."""
        if (slot := thread.slot) is not None:
            if thread.program[0] == "loan":
                self.loans.append(View(self.segment, slot.number, slot.start, slot.end, thread.frame))
            else:
                self.slots.free(slot.number)
        thread.program.popleft()
        thread.frame = thread.number = 0
        thread.slot = None

    def _go_down(self) -> None:
        """Be killed, and respawned: those who read connect again."""
        for thread in self.threads:
            thread.frame = thread.number = 0
            thread.slot = None
            thread.to.clear()
        self.loans.clear()
        self._rise()

    # -- promises ------------------------------------------------------------------------------------------------------

    def check(self) -> None:
        """Raise Broken if somebody has something else than what was published, or more than its part."""
        for who, views in (*enumerate(reader.views for reader in self.readers), ("the publisher", self.loans)):
            for view in views:
                if not view.segment.has(view, view.frame):
                    raise Broken(f"{who} has frame {view.frame}, in which something else was written")
        most = max(2, 1 + self.small.most_pages // FRAME_PAGES)
        if any(len(self.slots.numbers_of(consumer)) > most for _, consumer in self.consumers):
            raise Broken(f"a reader has more than {most} frames")

    def come_to_rest(self) -> None:
        """Let all go on that can, publish one frame more, and have everybody leave."""
        self._run()
        if any(thread.program for thread in self.threads):
            raise Broken("a thread waits for a reader that does not come")
        for link, consumer in self.consumers:
            before = len(link.packets)
            consumer.receive()
            if len(link.packets) > before:
                raise Broken("a reader wants the frame that waits for it, and nobody hears it")
        self.threads.append(Thread(("copy",)))
        self._run()
        for number, reader in enumerate(self.readers):
            if reader.link is not None and reader.last != self.number:
                raise Broken(f"{number} waits, and has not got the newest frame")
        self._check_unused()
        for reader in self.readers:
            reader.leave()
        self._run()
        if self.consumers:
            raise Broken("the publisher has not heard that a reader has left")
        self._check_unused()

    def _check_unused(self) -> None:
        self.slots.cool(len(self.segment.head))
        if self.slots.used or self.slots.resident:
            raise Broken(f"slots are in use that nobody has: {sorted(self.slots.used)}")

    def _run(self) -> None:
        """Do what can be done, but nothing that goes wrong; views are dropped first."""
        while steps := [step for step in self.moves() if step[0] not in self.spent]:
            self.do(min(steps, key=lambda step: _ORDER.index(step[0])))


_OF_READERS = frozenset(("come", "ask", "read", "drop", "close", "crash"))
_ORDER = ("drop", "forget", "end", "hear", "read", "come", "ask", "publish")


def _unheard(registrar: str, before: Stream) -> None:
    """Hear that a reader goes on with this stream."""


# -- the walk --------------------------------------------------------------------------------------------------------


def walk_slots(small: SlotWorld, core: Core = PRODUCT, go_on: Callable[[Walk], bool] = lambda so_far: True) -> Walk:
    """Meet every state, breadth first, or go as far as `go_on` says; or to the first broken promise."""
    first = packed(World(small, core))
    met = {_digest(first)}
    level: deque[tuple[tuple[Step, ...], bytes]] = deque([((), first)])
    depth = steps = 0
    while level and go_on(so_far := Walk(depth, len(met), steps, False)):
        history, state = level.popleft()
        depth = len(history)
        for step in [*pickle.loads(state).moves()]:
            steps += 1
            world: World = pickle.loads(state)
            try:
                world.do(step)
                following = packed(world)
                if (mark := _digest(following)) in met:
                    continue
                met.add(mark)
                level.append(((*history, step), following))
                world.come_to_rest()
            except Exception as error:  # Broken, or a defect that raised
                return so_far._replace(states=len(met), steps=steps, history=(*history, step), violation=error)
    return Walk(depth, len(met), steps, not level)


def _digest(state: bytes) -> bytes:
    return hashlib.blake2b(state, digest_size=16).digest()


_TWO: tuple[What, ...] = "copy", "copy"
_THREE: tuple[What, ...] = "copy", *_TWO

WORLDS = {
    "copies": SlotWorld((_THREE,), cools=1),
    "little memory": SlotWorld((_THREE,), pages=2 * FRAME_PAGES),
    "two threads": SlotWorld((("copy", "copy"), ("loan",))),
    "loans": SlotWorld((("loan", "abort", "copy"),), cools=1),
    "each frame": SlotWorld((_TWO, ("copy",)), ("all",)),
    "a reader is closed": SlotWorld((_THREE,), closes=1),
    "a reader is killed": SlotWorld((_THREE,), ("latest", "all"), crashes=1),
    "the publisher is killed": SlotWorld((("copy", "copy"),), downs=1),
    "all of it": SlotWorld((("copy", "loan"), ("copy",)), ("latest", "all"), closes=1, crashes=1, downs=1, cools=1),
}
"""Those that end within seconds first."""


def main(arguments: list[str] | None = None) -> int:
    """Walk the worlds of these names, or all; 1 if a promise was broken."""
    parser = argparse.ArgumentParser(prog="python -m simulation.slot_worlds", description="Slots of streams, walked.")
    parser.add_argument("names", nargs="*", metavar="NAME", help=f"of {', '.join(WORLDS)} (default: all)")
    parser.add_argument("--seconds", type=float, default=60.0, help="for all of them together (default: 60)")
    options = parser.parse_args(arguments)
    names: list[str] = options.names or [*WORLDS]
    if unknown := sorted({*names} - {*WORLDS}):
        parser.error(f"no world {', '.join(unknown)}: there are {', '.join(WORLDS)}")
    broken = False
    for name in names:
        until = time.monotonic() + options.seconds / len(names)
        done = walk_slots(WORLDS[name], go_on=lambda _, until=until: time.monotonic() < until)
        how = "to the end" if done.ended else "as far as time allowed"
        if done.violation is not None:
            how, broken = f"{done.violation!r}, after {len(done.history)} steps: {done.history}", True
        far = f"{done.states:>8} states, {done.steps:>8} steps, {done.depth:>3} deep: {how}"
        sys.stdout.write(f"{name.ljust(max(map(len, WORLDS)))}  {far}\n")
        sys.stdout.flush()
    return int(broken)


if __name__ == "__main__":
    sys.exit(main())
