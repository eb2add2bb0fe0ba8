"""The image of a catalog's tables is what they are, or is not taken for that; nothing depends on it."""

from __future__ import annotations

import errno
import os
import shutil
from collections.abc import Iterator, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any, NoReturn

import msgspec
import pytest
from hypothesis import given, settings

from rr_actors.errors import CatalogDamaged, CatalogError
from rr_actors.records import TABLE_OF, Change, Drop, Put, Query, Resource, Row, Table, rows_of
from rr_actors.stores import image, tables
from rr_actors.stores.image import Image, Mark
from rr_actors.stores.opening import open_store, read_rows
from rr_actors.stores.sqlite import SqliteStore
from support_stores import COMMITS, Rows, after, folder_of, in_order, part, query, with_images

ID = "0123456789abcdef"
FOLDS: list[list[Change]] = [
    [*(Put(query(f"q{n}", n)) for n in range(7)), Put(part("r1"))],
    [Drop("queries", "q1"), Drop("queries", "never"), Put(query("q2", 20)), Put(part("r2", b"x" * 400))],
    [Put(query("q1", 10)), Drop("resources", "r1")],
]


def at(folded: int, opening: str = "first") -> tables.Meta:
    """What the catalog says of itself after so many foldings."""
    return tables.Meta(ID, 1, folded, opening)


class Tables:
    """Stands in for the tables of which it is the image."""

    def __init__(self, *, used: int = 0) -> None:
        self.meta = at(0)
        self.content: Rows = {}
        self.used = used

    def fold(self, changes: Sequence[Change], opening: str = "first") -> None:
        self.content = after(self.content, changes)
        self.meta = at(self.meta.folded + 1, opening)

    def rows(self) -> Iterator[tuple[Table, list[Any]]]:
        for row in self.content.values():
            yield TABLE_OF[type(row)], [row]

    def used_bytes(self) -> int:
        return self.used


@pytest.fixture(autouse=True)
def for_all_catalogs(monkeypatch: pytest.MonkeyPatch) -> None:
    with_images(monkeypatch, anew=False)


@pytest.fixture
def catalog(tmp_path: Path) -> Path:
    return tmp_path / "catalog.sqlite3"


def made(catalog: Path, folds: Sequence[Sequence[Change]]) -> Tables:
    """An image to which these were added one after another."""
    source = Tables()
    of_tables = Image(folder_of(catalog), catalog)
    of_tables.keep(source)
    for changes in folds:
        put_in(of_tables, source, changes)
    return source


def put_in(of_tables: Image, source: Tables, changes: Sequence[Change], opening: str = "first") -> None:
    of_tables.add(tables.net_of(changes), Mark(opening, source.meta.folded + 1))
    source.fold(changes, opening)


def found(catalog: Path, meta: tables.Meta) -> list[Row] | None:
    content = Image(folder_of(catalog), catalog).rows(meta)
    return None if content is None else in_order(rows_of(content))


def states(folds: Sequence[Sequence[Change]]) -> dict[int, list[Row]]:
    """What there is after so many foldings."""
    rows: Rows = {}
    by_number = {0: in_order([])}
    for number, changes in enumerate(folds, 1):
        rows = after(rows, changes)
        by_number[number] = in_order(rows.values())
    return by_number


@settings(max_examples=60)
@given(folds=COMMITS)
def test_it_is_what_the_tables_are_after_any_folding(tmp_path_factory: pytest.TempPathFactory, folds: Any) -> None:
    catalog = tmp_path_factory.mktemp("image") / "catalog.sqlite3"
    made(catalog, folds)
    for number, rows in states(folds).items():
        assert found(catalog, at(number)) == rows
    for other in (at(len(folds) + 1), at(len(folds), "second"), msgspec.structs.replace(at(0), id="another")):
        assert found(catalog, other) is None


def test_of_a_file_that_is_cut_off_or_has_a_wrong_byte_only_what_is_right_is_taken(catalog: Path) -> None:
    made(catalog, FOLDS)
    path = image.path_of(catalog)
    good = path.read_bytes()
    expected = states(FOLDS)
    taken = 0
    for byte in range(len(good)):
        flipped = bytearray(good)
        flipped[byte] ^= 1 << byte % 8
        for data in (good[:byte], flipped, good[:byte] + bytes(len(good) - byte)):
            path.write_bytes(data)
            for number, rows in expected.items():
                got = found(catalog, at(number))
                assert got in (None, rows), f"byte {byte}, {number}"
                taken += got is not None
    assert taken > len(good)


def test_where_there_is_none_or_something_else_the_tables_are_read(
    catalog: Path, caplog: pytest.LogCaptureFixture
) -> None:
    meta = at(0)
    path = image.path_of(catalog)
    assert found(catalog, meta) is None
    assert caplog.text == ""
    for make in (lambda: path.write_bytes(b"text"), path.mkdir, lambda: os.mkfifo(path)):
        make()
        caplog.clear()
        assert found(catalog, meta) is None
        assert f"{catalog}: its image: " in caplog.text
        path.rmdir() if path.is_dir() else path.unlink()


def test_what_was_added_but_never_folded_is_written_over(catalog: Path) -> None:
    source = made(catalog, FOLDS[:2])
    lost = Image(folder_of(catalog), catalog)
    assert lost.rows(source.meta) is not None
    lost.add(tables.net_of([Put(query("lost")), Put(part("lost", b"y" * 3000))]), Mark("first", 3))
    lost.add(tables.net_of([Drop("queries", "q2")]), Mark("first", 4))

    again = Image(folder_of(catalog), catalog)
    assert again.rows(source.meta) is not None
    put_in(again, source, FOLDS[2], opening="second")

    assert found(catalog, source.meta) == states(FOLDS)[3]
    assert found(catalog, at(4)) is None


def test_an_image_that_is_not_of_this_state_is_not_gone_on_with(catalog: Path) -> None:
    source = made(catalog, FOLDS[:2])
    before = image.path_of(catalog).read_bytes()
    other = Image(folder_of(catalog), catalog)
    assert other.rows(at(9)) is None
    other.add(tables.net_of(FOLDS[2]), Mark("first", 10))
    assert image.path_of(catalog).read_bytes() == before

    source.fold(FOLDS[2])
    other.keep(source)
    assert found(catalog, source.meta) == states(FOLDS)[3]


def test_it_is_written_anew_when_it_is_larger_than_the_tables(catalog: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(image, "_SPARE_BYTES", 500)
    source = Tables(used=4000)
    of_tables = Image(folder_of(catalog), catalog)
    of_tables.keep(source)
    path = image.path_of(catalog)
    sizes: list[int] = []
    for number in range(200):
        put_in(of_tables, source, [Put(query("q", number)), Put(query(f"q{number % 7}", number)), Drop("peers", "p")])
        of_tables.keep(source)
        sizes.append(path.stat().st_size)
        if number % 20 == 0:
            assert found(catalog, source.meta) == in_order(source.content.values())
    assert max(sizes) <= 4500
    assert sum(later < sooner for sooner, later in pairwise(sizes)) > 2
    assert found(catalog, source.meta) == in_order(source.content.values())
    assert [file.name for file in path.parent.iterdir()] == ["catalog.image"]


def test_no_more_is_encoded_at_a_time_than_a_block_may_have_but_for_one_long_row(
    catalog: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(image, "_ROWS", 100)
    monkeypatch.setattr(image, "_BLOCK_BYTES", 1000)
    packed: list[list[Any]] = []
    pack = image.blocks.packed
    monkeypatch.setattr(image.blocks, "packed", lambda rows: packed.append(rows) or pack(rows))
    long = part("s", b"s" * 5000)
    changes = [*(Put(part(f"r{n}", bytes([n]) * 200)) for n in range(40)), Put(long), Put(part("t"))]
    source = made(catalog, [[*changes, *(Put(query(f"q{n}")) for n in range(250))]])

    assert found(catalog, source.meta) == in_order(source.content.values())
    assert [long] in packed
    of_resources = [rows for rows in packed if type(rows[0]) is Resource and rows != [long]]
    assert max(sum(len(row.request) for row in rows) for rows in of_resources) == 1000
    assert [len(rows) for rows in packed if type(rows[0]) is Query] == [100, 100, 50]


def full(*_: Any, **__: Any) -> NoReturn:
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


@pytest.mark.parametrize("operation", ["open", "pwrite", "ftruncate"])
def test_where_it_cannot_be_added_to_there_is_none_until_the_next_opening(
    catalog: Path, operation: str, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    source = Tables()
    of_tables = Image(folder_of(catalog), catalog)
    of_tables.keep(source)
    with monkeypatch.context() as patch:
        patch.setattr(os, operation, full)
        put_in(of_tables, source, FOLDS[0])
    assert f"{catalog}: its image: " in caplog.text
    assert "No space left on device" in caplog.text
    assert list(catalog.parent.iterdir()) == []
    put_in(of_tables, source, FOLDS[1])
    of_tables.keep(source)
    assert list(catalog.parent.iterdir()) == []
    Image(folder_of(catalog), catalog).keep(source)
    assert found(catalog, source.meta) == states(FOLDS)[2]


def test_where_the_tables_cannot_be_read_none_is_made(catalog: Path, caplog: pytest.LogCaptureFixture) -> None:
    class Broken(Tables):
        def rows(self) -> Iterator[tuple[Table, list[Any]]]:
            yield "queries", [query("q")]
            raise CatalogError(f"{catalog}: broken", path=str(catalog))

    Image(folder_of(catalog), catalog).keep(Broken())
    assert "broken" in caplog.text
    assert list(catalog.parent.iterdir()) == []


def test_it_takes_no_file_descriptor(catalog: Path) -> None:
    source = Tables()
    of_tables = Image(folder_of(catalog), catalog)
    before = os.listdir("/proc/self/fd")
    of_tables.keep(source)
    put_in(of_tables, source, FOLDS[0])
    assert len(os.listdir("/proc/self/fd")) == len(before)


# -- of a store ----------------------------------------------------------------------------------------------------


def stored(catalog: Path, *, erase: bool = False) -> list[Row]:
    """What an image was made of, which is closed (or as good as killed) then."""
    store = open_store(catalog)
    for changes in FOLDS:
        store.commit(changes)
        store.tidy()
    rows = in_order(rows_of(store.load()))
    store.close(erase=erase)
    return rows


def of_no_table(*_: Any) -> NoReturn:
    raise AssertionError("the tables are read")


def test_a_catalog_with_an_image_is_opened_without_reading_its_tables(
    catalog: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    rows = stored(catalog)
    with monkeypatch.context() as patch:
        patch.setattr(tables, "read_all", of_no_table)
        store = open_store(catalog)
        assert in_order(rows_of(store.load())) == rows
    store.commit([Drop("queries", "q2")])
    left = catalog.parent / "left"
    left.mkdir()
    for file in catalog.parent.glob("catalog.*"):
        shutil.copy(file, left)
    store.close()
    expected = in_order(after(after({}, map(Put, rows)), [Drop("queries", "q2")]).values())
    for place in (catalog, left / catalog.name):  # what is not folded is added to it at opening
        for _ in range(2):
            with monkeypatch.context() as patch:
                patch.setattr(tables, "read_all", of_no_table)
                store = open_store(place)
                assert in_order(rows_of(store.load())) == expected
            assert in_order(read_rows(place)) == expected
            store.close()


def test_a_small_catalog_has_none(catalog: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.undo()
    stored(catalog)
    assert not image.path_of(catalog).exists()
    store = open_store(catalog)
    store.commit([Put(part(f"{n:05}", b"x" * 1000)) for n in range(5000)])
    store.tidy()
    assert image.path_of(catalog).exists()
    store.close()
    assert len(read_rows(catalog)) == 5000 + len(states(FOLDS)[3])
    monkeypatch.setattr(tables, "read_all", of_no_table)
    open_store(catalog).close()


@pytest.mark.parametrize("what", ["it is gone", "another's", "durability power in between"])
def test_without_an_image_of_this_state_the_tables_are_read_and_it_is_made_again(
    catalog: Path, what: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    rows = stored(catalog)
    path = image.path_of(catalog)
    if what == "it is gone":
        path.unlink()
    elif what == "another's":
        stored(catalog.with_name("other.sqlite3"))
        image.path_of(catalog.with_name("other.sqlite3")).replace(path)
    else:
        before = path.read_bytes()
        store = open_store(catalog, durability="power")
        assert not path.exists()
        store.commit([Put(query("power"))])
        rows = in_order([*rows, query("power")])
        store.close()
        path.write_bytes(before)
    store = open_store(catalog)
    assert in_order(rows_of(store.load())) == rows
    store.commit([Put(query("z"))])
    store.tidy()
    store.close()
    monkeypatch.setattr(tables, "read_all", of_no_table)
    store = open_store(catalog)
    assert in_order(rows_of(store.load())) == in_order([*rows, query("z")])
    store.close()


def test_tables_that_are_put_back_do_not_meet_an_image_of_what_came_after_them(
    catalog: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Openings and foldings are counted from there again: the numbers come to be the same."""
    store = open_store(catalog)
    store.commit(FOLDS[0])
    store.close()
    copy = catalog.read_bytes()
    with_images(monkeypatch, anew=True)

    def go_on(row: Row) -> None:
        store = open_store(catalog)
        for number in range(3):
            store.commit([Put(row), Put(query("n", number))])
            store.tidy()
        store.close()

    go_on(query("one course of events"))
    assert image.path_of(catalog).exists()
    catalog.write_bytes(copy)
    monkeypatch.setattr(image, "LARGE_BYTES", 2**30)
    go_on(query("another"))

    store = open_store(catalog)
    expected = in_order([*states(FOLDS)[1], query("another"), query("n", 2)])
    assert in_order(rows_of(store.load())) == expected
    assert not image.path_of(catalog).exists()
    store.close()


def test_what_a_crash_left_of_an_image_that_was_being_written_goes_at_the_next_opening(catalog: Path) -> None:
    stored(catalog)
    new = catalog.with_name("catalog.image.new")
    for image_is_there in (True, False):
        new.write_bytes(b"begun")
        if not image_is_there:
            image.path_of(catalog).unlink()
        open_store(catalog).close()
        assert not new.exists()
        assert image.path_of(catalog).exists() is image_is_there


def test_one_that_cannot_be_removed_does_not_matter(catalog: Path) -> None:
    rows = stored(catalog)
    path = image.path_of(catalog)
    path.unlink()
    for name in (path, path.with_name(path.name + ".new")):
        name.mkdir()
    store = open_store(catalog)
    assert in_order(rows_of(store.load())) == rows
    store.commit([Put(query("more"))])
    store.tidy()
    store.close()
    assert in_order(read_rows(catalog)) == in_order([*rows, query("more")])


def test_copies_that_take_turns_never_meet_an_image_of_one_another(catalog: Path) -> None:
    """Each has been opened as often, and folded as often, since they were one."""
    stored(catalog)
    before = catalog.read_bytes()
    copies: dict[str, bytes] = {}
    for name in ("one", "other"):
        catalog.write_bytes(before)
        store = open_store(catalog)
        store.commit([Put(query(name))])
        store.close()
        copies[name] = catalog.read_bytes()
    assert image.path_of(catalog).exists()

    for name in ("one", "other", "one"):
        catalog.write_bytes(copies[name])
        store = open_store(catalog)
        assert in_order(rows_of(store.load())) == in_order([*states(FOLDS)[3], query(name)])
        store.commit([Put(query("more"))])
        store.close()


def test_changes_stay_in_the_journal_whatever_comes_of_the_image(
    catalog: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    store = open_store(catalog)
    store.commit(FOLDS[0])
    store.tidy()
    store.commit(FOLDS[1])
    with monkeypatch.context() as patch:
        patch.setattr(Image, "add", lambda *_: _raise(KeyboardInterrupt()))
        with pytest.raises(KeyboardInterrupt):
            store.tidy()
    store.commit(FOLDS[2])
    assert in_order(rows_of(store.load())) == states(FOLDS)[3]
    with monkeypatch.context() as patch:
        patch.setattr(image.blocks, "packed", lambda _: _raise(MemoryError()))
        store.tidy()
    assert not image.path_of(catalog).exists()
    store.close()
    assert in_order(read_rows(catalog)) == states(FOLDS)[3]


def _raise(error: BaseException) -> NoReturn:
    raise error


def test_a_record_that_is_nested_too_deep_is_not_taken(catalog: Path) -> None:
    rows = stored(catalog)
    path = image.path_of(catalog)
    good = path.read_bytes()
    begin = image._begin(good[:32])
    body = b"\x93\x00\xa7queries" + b"\x91" * 100_000 + b"\x01"
    first = next(image.framing.records(good, begin))[1]
    record, _ = image.framing.record(body, first.checksum)
    path.write_bytes(good[: first.at] + record)
    store = open_store(catalog)
    assert in_order(rows_of(store.load())) == rows
    store.close()


def test_it_is_private_from_the_beginning(catalog: Path) -> None:
    new = catalog.with_name("catalog.image.new")
    new.write_bytes(b"begun")
    new.chmod(0o666)
    made(catalog, FOLDS)
    assert image.path_of(catalog).stat().st_mode & 0o777 == 0o600


def test_it_is_not_written_anew_again_before_it_has_grown(catalog: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(image, "_SPARE_BYTES", -(10**9))
    monkeypatch.setattr(image, "_GROWN", 1.5)
    made: list[int] = []
    make = Image._make
    monkeypatch.setattr(Image, "_make", lambda *args: made.append(1) or make(*args))
    source = Tables()
    of_tables = Image(folder_of(catalog), catalog)
    for number in range(100):
        put_in(of_tables, source, [Put(query(f"q{number}", number))])
        of_tables.keep(source)
    assert 5 < len(made) < 40
    assert found(catalog, source.meta) == in_order(source.content.values())


def test_a_folding_that_fails_leaves_an_image_that_is_right(catalog: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    store = open_store(catalog)
    store.commit(FOLDS[0])
    store.tidy()
    for failed in (FOLDS[1], FOLDS[2]):
        store.commit(failed)
        with monkeypatch.context() as patch:
            patch.setattr(SqliteStore, "fold", full_disk)
            with pytest.raises(CatalogError):
                store.tidy()
    left = catalog.parent / "left"
    left.mkdir()
    for file in catalog.parent.glob("catalog.*"):
        shutil.copy(file, left)
    store.close()
    for place in (catalog, left / catalog.name):
        for _ in range(2):
            with monkeypatch.context() as patch:
                patch.setattr(tables, "read_all", of_no_table)
                again = open_store(place)
            assert in_order(rows_of(again.load())) == states(FOLDS)[3]
            again.close()


def full_disk(*_: Any) -> NoReturn:
    raise CatalogError("full", path="")


def test_it_goes_with_its_catalog(catalog: Path) -> None:
    place = catalog.parent / "own" / catalog.name
    stored(place, erase=True)
    assert not place.parent.exists()

    stored(catalog)
    catalog.write_bytes(b"not SQLite")
    with pytest.raises(CatalogDamaged):
        open_store(catalog)
    assert image.path_of(catalog).exists()
    store = open_store(catalog, on_damage="aside")
    assert rows_of(store.load()) == []
    store.close(erase=True)
    assert sorted(file.name for file in catalog.parent.iterdir()) == [
        "catalog.sqlite3.damaged-1",
        "catalog.sqlite3.damaged-1-catalog.image",
    ]


def test_it_is_its_users_alone(catalog: Path) -> None:
    stored(catalog)
    path = image.path_of(catalog)
    assert path.stat().st_mode & 0o777 == 0o600
    path.chmod(0o644)
    open_store(catalog).close()
    assert path.stat().st_mode & 0o777 == 0o600
