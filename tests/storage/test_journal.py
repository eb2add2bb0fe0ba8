"""The journal's bytes: whatever is cut off, wrong, missing or another's, what is read is what some commit left."""

from __future__ import annotations

import itertools
import random
import re
import shutil
from collections.abc import Callable, Sequence
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from rr_actors.registrar.model.rows import Change, Drop, Peer, Put, Row, apply, content_of, rows_of
from rr_actors.storage import journaled_store
from rr_actors.storage.damage import Damage
from rr_actors.storage.journaled_store import End, Segment
from rr_actors.storage.sql_tables import Meta
from support_stores import CHANGES, folder_of, in_order, part, query, segments_of, states

OWNER = Meta("0123456789abcdef", 3, 0)
HISTORY: list[list[list[Change]]] = [
    [[Put(query("a")), Put(part("r", b"x" * 50))], [Put(query("a", 2)), Put(Peer("hub"))]],
    [[Drop("queries", "a"), Put(query("b", 2**62))]],
    [[Put(query("c"))], [Put(part("r", b"\xcf" * 9)), Drop("peers", "hub")], [Put(query("c", -1))]],
    [[Drop("resources", "r")]],
]
"""Commits, by segment."""

HEADER = 56  # bytes

PARTS = st.lists(st.lists(st.lists(CHANGES, min_size=1, max_size=4), min_size=1, max_size=3), min_size=1, max_size=3)
SETTINGS = settings(max_examples=40, suppress_health_check=[HealthCheck.function_scoped_fixture])


@pytest.fixture
def catalog(tmp_path: Path) -> Path:
    (tmp_path / "reg").mkdir()
    return tmp_path / "reg" / "catalog.sqlite3"


def write(catalog: Path, parts: Sequence[Sequence[Sequence[Change]]], owner: Meta = OWNER) -> list[Path]:
    """Write segments as a store does, each with some commits; return them."""
    for path in segments_of(catalog):
        path.unlink()
    end = End()
    for number, commits in enumerate(parts, 1):
        segment = Segment(folder_of(catalog), catalog, owner, number, end)
        for changes in commits:
            segment.append(changes)
        end = segment.end
        segment.close()
    return segments_of(catalog)


def rows(catalog: Path, folded: int = 0, base: Sequence[Row] = (), owner: Meta = OWNER) -> list[Row]:
    content = content_of(base)
    apply(content, journaled_store.read(folder_of(catalog), catalog).since(Meta(owner.id, owner.epoch, folded)).changes)
    return in_order(rows_of(content))


def rows_or_damage(catalog: Path) -> list[Row] | None:
    """None for damage, which is named."""
    try:
        return rows(catalog)
    except Damage as error:
        named = re.match(r"catalog\.journal\.\d", str(error))
    assert named
    return None


def flat(parts: Sequence[Sequence[Sequence[Change]]]) -> list[Sequence[Change]]:
    return [changes for commits in parts for changes in commits]


def ends(parts: Sequence[Sequence[Sequence[Change]]]) -> list[int]:
    """How many commits there are up to the end of each segment; 0 first."""
    return [0, *itertools.accumulate(map(len, parts))]


# -- what was written ----------------------------------------------------------------------------------------------


@given(parts=PARTS)
@SETTINGS
def test_what_was_written_is_read_whatever_of_it_is_folded_already(
    catalog: Path, parts: list[list[list[Change]]]
) -> None:
    write(catalog, parts)
    expected = states(flat(parts))
    for folded, commits in enumerate(ends(parts)):
        assert rows(catalog, folded, expected[commits]) == expected[-1]
    assert journaled_store.read(folder_of(catalog), catalog).last == len(parts)


def test_without_segments_nothing_is_read_and_nothing_is_made(catalog: Path) -> None:
    assert rows(catalog) == []
    assert list(catalog.parent.iterdir()) == []


def test_segments_are_read_in_the_order_of_their_numbers_and_other_files_are_none(catalog: Path) -> None:
    parts = [[[Put(query("a", n))]] for n in range(12)]
    paths = write(catalog, parts)
    assert [path.name for path in paths] == [f"catalog.journal.{n}" for n in range(1, 13)]
    for name in (
        "catalog.journal.",
        "catalog.journal.0",
        "catalog.journal.013",
        "catalog.journal.13.old",
        "x.journal.1",
    ):
        catalog.with_name(name).write_bytes(b"something else")
    assert segments_of(catalog) == paths
    assert rows(catalog) == [query("a", 11)]


def test_catalogs_in_one_directory_have_journals_of_their_own(catalog: Path) -> None:
    write(catalog, [[[Put(query("a"))]]])
    another = catalog.with_name("another.sqlite3")
    write(another, [[[Put(query("b"))]]], Meta("another", 1, 0))
    assert rows(catalog) == [query("a")]
    assert rows(another, owner=Meta("another", 1, 0)) == [query("b")]


# -- cut off -------------------------------------------------------------------------------------------------------


@given(parts=PARTS)
@settings(SETTINGS, max_examples=8)
def test_every_truncation_of_the_last_segment_leaves_the_commits_that_are_whole(
    catalog: Path, parts: list[list[list[Change]]]
) -> None:
    paths = write(catalog, parts)
    last = paths[-1].read_bytes()
    whole = [len((write(catalog, [*parts[:-1], parts[-1][:n]]))[-1].read_bytes()) for n in range(len(parts[-1]) + 1)]
    expected = states(flat(parts))
    write(catalog, parts)
    for size in range(len(last) + 1):
        paths[-1].write_bytes(last[:size])
        commits = ends(parts)[-2] + max(0, sum(size >= end for end in whole) - 1)
        assert rows(catalog) == expected[commits], f"{size} of {len(last)} bytes, after {whole}"


@given(parts=PARTS, data=st.data())
@SETTINGS
def test_pages_of_zeros_at_the_end_of_any_segment_leave_a_state_before_it(
    catalog: Path, parts: list[list[list[Change]]], data: st.DataObject
) -> None:
    """What a power cut may leave of a file whose size is on the disk, and whose pages are not."""
    paths = write(catalog, parts)
    number = data.draw(st.integers(0, len(paths) - 1))
    good = paths[number].read_bytes()
    kept = data.draw(st.integers(0, len(good)))
    paths[number].write_bytes(good[:kept] + bytes(len(good) - kept))
    expected = states(flat(parts))
    at = ends(parts)
    until = at[number + 1] if kept < len(good) else at[-1]
    if (found := rows_or_damage(catalog)) is None:
        assert 0 < kept < HEADER
    else:
        assert found in expected[at[number] : until + 1] or found == expected[-1]


# -- wrong ---------------------------------------------------------------------------------------------------------


def test_every_wrong_byte_anywhere_is_found_and_leaves_the_state_after_a_commit(catalog: Path) -> None:
    paths = write(catalog, HISTORY)
    expected = states(flat(HISTORY))
    chance = random.Random(1)
    damaged = 0
    for number, path in enumerate(paths):
        good = path.read_bytes()
        before, behind = ends(HISTORY)[number : number + 2]
        for at in range(len(good)):
            bad = bytearray(good)
            bad[at] ^= chance.choice([1, 128, chance.randrange(1, 256)])
            path.write_bytes(bad)
            if (found := rows_or_damage(catalog)) is None:
                damaged += 1
            else:
                assert found in expected[before:behind], f"segment {number + 1}, byte {at}"
        path.write_bytes(good)
    assert damaged == len(paths) * HEADER, "every byte of the headers, and no other"


@given(parts=PARTS, data=st.data())
@SETTINGS
def test_bytes_that_are_overwritten_inserted_or_taken_out_leave_the_state_after_a_commit(
    catalog: Path, parts: list[list[list[Change]]], data: st.DataObject
) -> None:
    paths = write(catalog, parts)
    for _ in range(data.draw(st.integers(1, 3))):
        path = data.draw(st.sampled_from(paths))
        good = path.read_bytes()
        begin = data.draw(st.integers(0, len(good)))
        end = data.draw(st.integers(begin, min(len(good), begin + 20)))
        path.write_bytes(good[:begin] + data.draw(st.binary(max_size=20)) + good[end:])
    found = rows_or_damage(catalog)
    assert found is None or found in states(flat(parts))


def test_a_wrong_byte_is_told_from_a_record_that_was_never_finished(
    catalog: Path, caplog: pytest.LogCaptureFixture
) -> None:
    (path,) = write(catalog, [[[Put(query(f"{n}"))] for n in range(3)]])
    good = path.read_bytes()
    assert (len(rows(catalog)), caplog.text) == (3, "")
    for size in (1, 5, 20):
        path.write_bytes(good[:-size])
        assert rows(catalog) == [query("0"), query("1")]
        assert "catalog.journal.1: its last record is not whole" in caplog.text
        assert "wrong from byte" not in caplog.text
        caplog.clear()
    for at in (good.index(b"r1", good.index(b"r1") + 1), HEADER + (len(good) - HEADER) // 3):
        bad = bytearray(good)
        bad[at] ^= 1
        path.write_bytes(bad)
        assert rows(catalog) == [query("0")]
        assert f"{catalog}: catalog.journal.1: wrong from byte " in caplog.text
        assert "not whole" not in caplog.text
        caplog.clear()
    path.write_bytes(good + bytes(4096))
    assert len(rows(catalog)) == 3
    assert "catalog.journal.1: wrong from byte " in caplog.text


@pytest.mark.parametrize("bit", range(32))
def test_a_wrong_bit_in_the_length_of_any_record_is_told_though_the_record_would_go_on_behind_the_end(
    catalog: Path, bit: int, caplog: pytest.LogCaptureFixture
) -> None:
    (path,) = write(catalog, [[[Put(query(f"{n}"))] for n in range(3)]])
    good = path.read_bytes()
    size = (len(good) - HEADER) // 3
    for number in range(3):
        bad = bytearray(good)
        bad[HEADER + number * size + bit // 8] ^= 1 << bit % 8
        path.write_bytes(bad)
        assert len(rows(catalog)) == number
        assert "catalog.journal.1: wrong from byte " in caplog.text
        caplog.clear()


def test_a_segment_that_is_known_to_be_begun_is_missed_though_it_is_the_last(
    catalog: Path, caplog: pytest.LogCaptureFixture
) -> None:
    paths = write(catalog, HISTORY)
    found = journaled_store.read(folder_of(catalog), catalog)
    assert len(found.since(OWNER, 4).changes) == len([change for changes in flat(HISTORY) for change in changes])
    assert caplog.text == ""
    for spoil in (Path.unlink, lambda path: path.write_bytes(b""), lambda path: path.write_bytes(bytes(500))):
        paths[-1].touch()
        spoil(paths[-1])
        assert journaled_store.read(folder_of(catalog), catalog).since(OWNER, 3).changes != []
        assert caplog.text == ""
        journaled_store.read(folder_of(catalog), catalog).since(OWNER, 4)
        assert "catalog.journal.4: missing" in caplog.text
        caplog.clear()


def test_a_good_checksum_over_something_else_than_changes_is_damage(
    catalog: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    too_large = b"\x91\x92\xa7queries\x96" + b"\xa0" * 4 + b"\x01\xcf" + b"\xff" * 8
    for body in (
        too_large,
        b"\x91\x92\xa7queries\xa1\xff",
        b"\x91\x92\xa7queries" + b"\x91" * 100_000,
        b"\x90",
        b"\x91\x92\xa7queries\xc0",
        b"\x91\x92\xa5songs\xa1a",
        b"\x91\x92\xa7queries\x91\xa1a",
        b"\xc1",
    ):
        segment = Segment(folder_of(catalog), catalog, OWNER, 1, End())
        monkeypatch.setattr(journaled_store, "_encode", lambda _, body=body: body)
        segment.append([Put(query("a"))])
        segment.close()
        monkeypatch.undo()
        if body == b"\x90":
            assert rows(catalog) == []
        else:
            with pytest.raises(Damage):
                rows(catalog)


# -- missing, or another's -----------------------------------------------------------------------------------------

SPOILT: dict[str, Callable[[Path], object]] = {
    "missing": Path.unlink,
    "empty": lambda path: path.write_bytes(b""),
    "zeros": lambda path: path.write_bytes(bytes(path.stat().st_size)),
    "a page of zeros": lambda path: path.write_bytes(bytes(4096)),
    "its magic alone": lambda path: path.write_bytes(path.read_bytes()[:8]),
    "half its magic": lambda path: path.write_bytes(path.read_bytes()[:3]),
    "half its header": lambda path: path.write_bytes(path.read_bytes()[:30]),
}


@pytest.mark.parametrize("spoil", SPOILT.values(), ids=SPOILT)
@pytest.mark.parametrize("number", [1, 2, 3, 4])
def test_what_comes_after_a_segment_that_is_gone_is_ignored_with_a_warning(
    catalog: Path, spoil: Callable[[Path], object], number: int, caplog: pytest.LogCaptureFixture
) -> None:
    paths = write(catalog, HISTORY)
    expected = states(flat(HISTORY))
    spoil(paths[number - 1])
    assert rows(catalog) == expected[ends(HISTORY)[number - 1]]
    assert (f"{catalog}: catalog.journal.{number}: missing, or not what was written next" in caplog.text) == (
        number < 4
    )
    if number < 4:
        assert rows(catalog, number, expected[ends(HISTORY)[number]]) == expected[-1], "folded, it is not missed"


@pytest.mark.parametrize("commits", [0, 1, 2])
def test_a_segment_that_has_lost_its_end_takes_those_after_it_along(
    catalog: Path, commits: int, caplog: pytest.LogCaptureFixture
) -> None:
    shorter = write(catalog, [*HISTORY[:2], HISTORY[2][:commits]])[2].read_bytes()
    paths = write(catalog, HISTORY)
    assert paths[2].read_bytes().startswith(shorter)
    paths[2].write_bytes(shorter)
    assert rows(catalog) == states(flat(HISTORY))[3 + commits]
    assert "catalog.journal.4: missing, or not what was written next" in caplog.text


def test_swapped_segments_are_damage(catalog: Path) -> None:
    paths = write(catalog, HISTORY)
    spare = catalog.with_name("spare")
    for one, two in itertools.combinations(paths, 2):
        one.rename(spare)
        two.rename(one)
        spare.rename(two)
        with pytest.raises(Damage, match=f"{one.name}, whose beginning is damaged, or another file's"):
            rows(catalog)
        one.rename(spare)
        two.rename(one)
        spare.rename(two)
    assert rows(catalog) == states(flat(HISTORY))[-1]


@pytest.mark.parametrize(
    "owner", [Meta("another", 3, 0), Meta(OWNER.id, 2, 0), Meta("", 3, 0), Meta(OWNER.id[:15], 3, 0)]
)
@pytest.mark.parametrize("number", [1, 2, 3, 4])
def test_a_segment_of_another_catalog_or_an_earlier_epoch_is_damage_unless_it_is_folded(
    catalog: Path, owner: Meta, number: int, tmp_path: Path
) -> None:
    (tmp_path / "other").mkdir()
    theirs = write(tmp_path / "other" / "catalog.sqlite3", HISTORY, owner)
    paths = write(catalog, HISTORY)
    shutil.copy(theirs[number - 1], paths[number - 1])
    with pytest.raises(Damage, match=rf"catalog.journal.{number}, which belongs to another catalog"):
        rows(catalog)
    expected = states(flat(HISTORY))
    assert rows(catalog, number, expected[ends(HISTORY)[number]]) == expected[-1]


def test_a_segment_of_a_later_epoch_is_read(catalog: Path) -> None:
    """A power cut has taken the -wal in which that epoch was counted."""
    write(catalog, HISTORY, Meta(OWNER.id, 4, 0))
    assert rows(catalog) == states(flat(HISTORY))[-1]


def test_segments_of_another_course_of_events_are_not_mixed_with_these(
    catalog: Path, caplog: pytest.LogCaptureFixture
) -> None:
    others: list[list[list[Change]]] = [[[Put(query("x"))]], [[Put(query("y"))]], [[Put(query("z"))]]]
    theirs = [path.read_bytes() for path in write(catalog, others)]
    for number in range(1, 3):
        paths = write(catalog, HISTORY)
        paths[number].write_bytes(theirs[number])
        assert rows(catalog) == states(flat(HISTORY))[ends(HISTORY)[number]]
        assert f"catalog.journal.{number + 1}: missing, or not what was written next" in caplog.text


@pytest.mark.parametrize(
    "text", [b"x", b"text, and more of it than a header has, whatever that is worth", b"RRACJ\0\0\3" * 9]
)
@pytest.mark.parametrize("number", [1, 4, 9])
def test_a_file_that_is_no_segment_is_damage(catalog: Path, text: bytes, number: int) -> None:
    write(catalog, HISTORY)
    catalog.with_name(f"catalog.journal.{number}").write_bytes(text)
    with pytest.raises(Damage, match=f"catalog.journal.{number}, which is something else"):
        rows(catalog)
