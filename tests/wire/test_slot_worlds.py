"""The slots of streams walked to the end: no history shows a wrong byte, and each planted defect is found soonest."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from rr_actors.streams.known_reader import Connected, KnownReader, PollSet, Shared
from rr_actors.streams.stream import Stream
from rr_actors.wire.segment_slots import Slot, Slots
from rr_actors.wire.segments import Parcel
from simulation.explore import Walk
from simulation.slot_worlds import PRODUCT, WORLDS, Reader, main, walk_slots

SMALLEST = ("copies", "loans", "a reader is closed", "the publisher is killed")


@pytest.mark.parametrize("name", SMALLEST)
def test_every_history_of_a_small_world_keeps_each_value_as_it_was(name: str) -> None:
    done = walk_slots(WORLDS[name])

    assert done.violation is None, done
    assert done.ended
    assert done.states > 1000


@pytest.mark.slow
@pytest.mark.timeout(240)
@pytest.mark.parametrize("name", [name for name in WORLDS if name not in SMALLEST])
def test_a_larger_world_keeps_each_value_as_far_as_it_is_walked(name: str) -> None:
    done = walk_slots(WORLDS[name], go_on=lambda so_far: so_far.states < 10_000)

    assert done.violation is None, done
    assert done.ended or done.states >= 10_000


# -- planted defects -------------------------------------------------------------------------------------------------


class FreeWithTheFirst(Slots):
    """A slot is free when one of those who share it has freed its number."""

    def collect(self) -> None:
        before = dict(self.used)
        super().collect()
        gone = {slot.start for number, slot in before.items() if number not in self.used}
        for number, slot in self.used.items():
            if slot.start in gone:
                self.free(number)
        super().collect()


class FullIsOverwritten(Slots):
    """When there is no room, the oldest slot is written again."""

    def take(self, size: int, room: int) -> Slot | None:
        return super().take(size, room) or next(iter(self.used.values()), None)


class SharedUnmarked(Slots):
    """The number of one more holder does not say that it is in use."""

    def share(self, number: int, holder: object, most_bytes: int) -> int | None:
        shared = super().share(number, holder, most_bytes)
        if shared is not None:
            self.free(shared)
        return shared


class Hoarded(Slots):
    """A reader may have as much as it likes."""

    def share(self, number: int, holder: object, most_bytes: int) -> int | None:
        return super().share(number, holder, 1 << 40)


class KeptByTheDead(Slots):
    """What a killed reader had stays in use."""

    def take_back(self, holder: object) -> None:
        pass


class UsedGivenBack(Slots):
    """Pages in use are given back to the machine, too."""

    def cool(self, most: int) -> list[tuple[int, int]]:
        return super().cool(most) + [(slot.start, slot.end) for slot in self.used.values()]


class _Keeping:
    """Shares slots, and frees none that was not sent."""

    def __init__(self, shared: Shared) -> None:
        self.may_share, self.share, self.take_back = shared.may_share, shared.share, shared.take_back

    def discard(self, parcel: Parcel) -> None:
        pass


class ReplacedAndKept(KnownReader):
    """A frame that a newer one replaces before it is sent stays in use."""

    def __init__(
        self, connected: Connected, pid: int, parcels: Shared, ready: PollSet, rebound: Callable[[str, Stream], None]
    ) -> None:
        super().__init__(connected, pid, _Keeping(parcels), ready, rebound)


class TakenBackTooSoon(KnownReader):
    """What a reader has is free when it reads no more, and not when it has ended."""

    def __init__(
        self, connected: Connected, pid: int, parcels: Shared, ready: PollSet, rebound: Callable[[str, Stream], None]
    ) -> None:
        super().__init__(connected, pid, parcels, ready, rebound)
        self.shared = parcels

    def leave(self) -> None:
        super().leave()
        self.shared.take_back(self)


class Deaf(KnownReader):
    """The publisher's thread is not told that a reader wants the frame that waits for it."""

    def hear(self, hears: bool) -> None:
        super().hear(False)


class FreedElsewhere(Reader):
    """A value's number is freed in the segment of the publisher of now."""

    def drop(self, which: int) -> None:
        if self.link is not None:
            self.link.segment.head[self.views[which].number] = 0
        super().drop(which)


class LineNotKept(Reader):
    """The connection is closed while there are values of it."""

    def leave(self) -> None:
        super().leave()
        for line in self.lines:
            line.ended = True


class NeverFreed(Reader):
    """A value that is dropped stays in use."""

    def drop(self, which: int) -> None:
        number, head = self.views[which].number, self.views[which].segment.head
        super().drop(which)
        head[number] = 1


FOUND = {
    FreeWithTheFirst: ("copies", 7),
    FullIsOverwritten: ("little memory", 14),
    SharedUnmarked: ("copies", 1),
    Hoarded: ("copies", 18),
    KeptByTheDead: ("a reader is killed", 7),
    UsedGivenBack: ("copies", 3),
    ReplacedAndKept: ("copies", 11),
    TakenBackTooSoon: ("a reader is closed", 12),
    Deaf: ("copies", 17),
    FreedElsewhere: ("the publisher is killed", 15),
    LineNotKept: ("a reader is closed", 12),
    NeverFreed: ("copies", 1),
}
"""A defect, a small world in which it shows, and the least number of steps it takes."""


@pytest.mark.parametrize("defect", FOUND)
def test_a_planted_defect_is_found_with_a_shortest_history(defect: type) -> None:
    name, steps = FOUND[defect]
    core = PRODUCT
    if issubclass(defect, Slots):
        core = core._replace(slots=defect)
    elif issubclass(defect, KnownReader):
        core = core._replace(consumer=defect)
    else:
        core = core._replace(reader=defect)
    done = walk_slots(WORLDS[name], core)

    assert done.violation is not None, done
    assert len(done.history) == steps, done


def test_a_walk_goes_as_far_as_it_is_allowed_to() -> None:
    done = walk_slots(WORLDS["copies"], go_on=lambda so_far: so_far.states < 50)

    assert done == Walk(done.depth, done.states, done.steps, False)
    assert 50 <= done.states < 60


def test_the_command_says_how_far_it_came(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["copies", "all of it", "--seconds", "0.2"]) == 0
    first, second = capsys.readouterr().out.splitlines()
    assert first.startswith("copies ")
    assert second.startswith("all of it ")
    assert second.endswith("as far as time allowed")


def test_the_command_names_the_worlds_there_are(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main(["copis"])
    assert "no world copis: there are copies, " in capsys.readouterr().err
