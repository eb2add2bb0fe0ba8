"""Slots: what is in use, what is free, and what takes memory."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from rr_actors.wire.segment_slots import PAGE_BYTES, Intervals, Slots

PAGES = 40

steps = st.lists(
    st.one_of(
        st.tuples(st.just("take"), st.integers(1, 12), st.integers(0, PAGES)),
        st.tuples(st.just("share"), st.integers(0, 100), st.just(0)),
        st.tuples(st.just("give"), st.integers(0, 100), st.just(0)),
        st.tuples(st.just("cool"), st.just(0), st.integers(0, PAGES)),
    ),
    max_size=60,
)


@given(steps)
def test_no_two_slots_overlap_and_the_memory_is_counted_to_the_page(steps: list[tuple[str, int, int]]) -> None:
    slots = Slots(bytearray(14), PAGE_BYTES, (PAGES + 1) * PAGE_BYTES, range(8, 14))
    warm: set[int] = set()  # pages
    held: dict[int, set[int]] = {}
    for what, number, room in steps:
        if what == "take":
            slot = slots.take(number * PAGE_BYTES - 1, room * PAGE_BYTES)
            if slot is None:
                continue
            pages = set(range(slot.start // PAGE_BYTES, slot.end // PAGE_BYTES))
            assert len(pages) == number
            assert pages <= set(range(1, PAGES + 1))
            assert all(pages.isdisjoint(others) for others in held.values())
            assert slot.number not in held
            assert slot.fresh == len(pages - warm) * PAGE_BYTES <= room * PAGE_BYTES
            held[slot.number] = pages
            warm |= pages
        elif what == "share" and held:
            which = sorted(held)[number % len(held)]
            other = slots.share(which, holder := object(), 1)
            if other is not None:
                assert other not in held
                held[other] = held[which]
                assert slots.numbers_of(holder) == [other]
        elif what == "give" and held:
            which = sorted(held)[number % len(held)]
            slots.free(which)
            slots.collect()
            del held[which]
        elif what == "cool":
            pieces = slots.cool(room * PAGE_BYTES)
            cooled = [page for start, end in pieces for page in range(start // PAGE_BYTES, end // PAGE_BYTES)]
            unused = warm - set[int]().union(*held.values())
            assert len(cooled) == len(set(cooled)) == min(room, len(unused))  # each once
            assert set(cooled) <= unused
            warm -= set(cooled)
        assert slots.resident == len(warm) * PAGE_BYTES
        assert slots.used.keys() == held.keys()


@given(st.lists(st.tuples(st.booleans(), st.integers(0, 30), st.integers(0, 30)), max_size=40))
def test_intervals_are_the_set_of_their_numbers(steps: list[tuple[bool, int, int]]) -> None:
    intervals = Intervals(5, 20)
    model = set(range(5, 20))
    for adds, one, other in steps:
        start, end = min(one, other), max(one, other) + 1
        part = set(range(start, end))
        assert intervals.count(start, end) == len(model & part)
        if adds:
            intervals.add(start, end)
            model |= part
        else:
            intervals.remove(start, end)
            model -= part
        assert [n for start, end in intervals for n in range(start, end)] == sorted(model)
        assert intervals.total == len(model)
        ends = [end for _, end in intervals]
        assert all(end < start for end, (start, _) in zip(ends, list(intervals)[1:], strict=False))


def test_a_value_is_put_where_the_last_one_was() -> None:
    slots = Slots(bytearray(20), PAGE_BYTES, 100 * PAGE_BYTES, range(8, 20))
    first = slots.take(10 * PAGE_BYTES, 100 * PAGE_BYTES)
    assert first is not None
    slots.free(first.number)
    again = slots.take(10 * PAGE_BYTES, 0)  # no page more
    assert again is not None
    assert (again.start, again.fresh) == (first.start, 0)


def test_there_are_no_more_slots_than_numbers() -> None:
    slots = Slots(bytearray(20), PAGE_BYTES, 100 * PAGE_BYTES, range(8, 10))
    assert [slots.take(1, 10**9) is None for _ in range(3)] == [False, False, True]


def test_a_holder_of_two_values_gets_more_while_they_are_small() -> None:
    slots, holder = Slots(bytearray(20), PAGE_BYTES, 100 * PAGE_BYTES, range(8, 20)), object()
    slot = slots.take(PAGE_BYTES, 10**9)
    assert slot is not None
    shared = [slots.share(slot.number, holder, 3 * PAGE_BYTES) for _ in range(4)]
    assert [number is None for number in shared] == [False, False, False, True]
    slots.take_back(holder)
    assert slots.share(slot.number, holder, PAGE_BYTES) is not None


def test_a_slot_is_free_when_the_last_of_its_numbers_is() -> None:
    slots = Slots(bytearray(20), PAGE_BYTES, 2 * PAGE_BYTES, range(8, 20))  # one page
    slot = slots.take(PAGE_BYTES, 10**9)
    assert slot is not None
    shared = [slots.share(slot.number, holder, 1) for holder in "ab"]
    for number in (slot.number, *shared):
        assert slots.take(PAGE_BYTES, 10**9) is None
        assert number is not None
        slots.free(number)
    assert slots.take(PAGE_BYTES, 10**9) is not None


def test_a_holder_of_many_small_values_leaves_as_many_numbers_to_others() -> None:
    slots, greedy, other = Slots(bytearray(60), PAGE_BYTES, 100 * PAGE_BYTES, range(8, 60)), object(), object()
    for holder in (greedy, other):
        shared = 0
        while (slot := slots.take(PAGE_BYTES, 10**9)) is not None:
            if slots.share(slot.number, holder, 10**9) is None:
                break
            slots.free(slot.number)
            shared += 1
        slots.free(slot.number if slot else 0)
        assert shared >= 10
    assert slots.take(PAGE_BYTES, 10**9) is not None
