"""The records of children: each is there whole or not at all. Damage to one is named, and leaves the others."""

from __future__ import annotations

import os
import zlib
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rr_actors.base.errors import CatalogDamaged, CatalogError, CatalogVersion
from rr_actors.storage import child_records
from rr_actors.storage.child_records import ChildRecord, ChildRecords, decode, encode

IDS = st.from_regex(r"[A-Za-z0-9_\-][A-Za-z0-9_\-.]{0,63}", fullmatch=True)
RECORDS = st.builds(
    ChildRecord,
    supervisor=st.lists(IDS, max_size=3).map("/".join),
    id=IDS,
    at_ns=st.integers(0, 2**63 - 1),
    args=st.binary(max_size=100),
)


@pytest.fixture
def records(tmp_path: Path) -> ChildRecords:
    return ChildRecords(tmp_path)


def place(tmp_path: Path, supervisor: str = ":pool") -> Path:
    return tmp_path / ".children" / supervisor


@given(RECORDS)
def test_a_record_is_read_as_it_was_written(record: ChildRecord) -> None:
    assert decode(encode(record), "file", record.supervisor, record.id) == record


@given(RECORDS, st.data())
def test_every_other_file_is_named_as_damaged(record: ChildRecord, data: st.DataObject) -> None:
    whole = encode(record)
    at = data.draw(st.integers(0, len(whole) - 1))
    changed = data.draw(
        st.one_of(
            st.just(whole[:at]),
            st.binary(min_size=1, max_size=5).map(lambda more: whole + more),
            st.integers(1, 255).map(lambda bits: whole[:at] + bytes([whole[at] ^ bits]) + whole[at + 1 :]),
            st.binary(max_size=200).filter(lambda other: other != whole),
        )
    )
    with pytest.raises(CatalogDamaged, match=r"^file: expected the record of a child, got other bytes"):
        decode(changed, "file", record.supervisor, record.id)


def test_each_flipped_bit_of_a_file_is_found_and_the_other_children_are_read(
    records: ChildRecords, tmp_path: Path
) -> None:
    for id in ("a", "b"):
        records.write("root/pool", id, id.encode(), 1, synced=False)
    file = place(tmp_path) / "a"
    whole = file.read_bytes()
    for bit in range(len(whole) * 8):
        flipped = bytearray(whole)
        flipped[bit // 8] ^= 1 << bit % 8
        file.write_bytes(flipped)
        with pytest.raises(CatalogDamaged) as caught:
            records.read("root/pool", "a")
        assert caught.value.path == str(file)
        assert records.read("root/pool", "b").args == b"b"
    assert records.ids("root/pool") == ["a", "b"]


def test_the_record_of_another_child_in_its_place_is_damage(records: ChildRecords, tmp_path: Path) -> None:
    records.write("root/pool", "a", b"", 1, synced=False)
    (place(tmp_path) / "b").write_bytes((place(tmp_path) / "a").read_bytes())
    with pytest.raises(CatalogDamaged, match="got that of 'a' of the supervisor 'pool'"):
        records.read("root/pool", "b")


def test_the_record_of_another_version_is_named(
    records: ChildRecords, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with monkeypatch.context() as later:
        later.setattr(child_records, "_VERSION", 2)
        records.write("root/pool", "a", b"", 1, synced=False)
    with pytest.raises(CatalogVersion, match="expected the record of a child in version 1, got version 2"):
        records.read("root/pool", "a")


@pytest.mark.parametrize("body", [b"", b"1", b"1 ", b"x \x80", b"9" * 5000 + b" \x80", b"1 \x84", b"1 \xa1\xff"])
def test_a_whole_file_that_no_version_writes_is_named_as_damaged(body: bytes) -> None:
    with pytest.raises(CatalogDamaged, match=r"^file: expected the record of a child, got one "):
        decode(b"rr-child %08x %b" % (zlib.crc32(body), body), "file", "pool", "a")


@pytest.mark.parametrize("kind", ["link", "directory", "pipe"])
def test_what_is_no_file_is_not_read(records: ChildRecords, tmp_path: Path, kind: str) -> None:
    records.write("root/pool", "a", b"", 1, synced=False)
    planted = place(tmp_path) / "b"
    match kind:
        case "link":
            planted.symlink_to(place(tmp_path) / "a")
        case "directory":
            planted.mkdir()
        case _:
            os.mkfifo(planted)
    with pytest.raises(CatalogDamaged, match="expected the record of a child, got a"):
        records.read("root/pool", "b")
    assert records.read("root/pool", "a").id == "a"


def test_a_directory_that_cannot_be_read_is_named(records: ChildRecords, tmp_path: Path) -> None:
    records.write("root/pool", "a", b"", 1, synced=False)
    place(tmp_path).rename(tmp_path / "elsewhere")
    place(tmp_path).symlink_to(tmp_path / "elsewhere")
    with pytest.raises(CatalogError, match="a symbolic link"):
        records.ids("root/pool")


@pytest.mark.parametrize("synced", [False, True])
@pytest.mark.parametrize("before", [None, b"old"])
def test_a_crash_at_any_step_of_a_write_leaves_the_old_record_or_the_new(
    tmp_path: Path, before: bytes | None, synced: bool
) -> None:
    step, done = 0, False
    while not done:
        step += 1
        records = ChildRecords(tmp_path / str(step))
        Path(tmp_path / str(step)).mkdir()
        if before is not None:
            records.write("root/pool", "a", before, 1, synced=False)
        done = not _killed_at(step, lambda records=records: records.write("root/pool", "a", b"new", 2, synced=synced))
        found = [records.read("root/pool", id).args for id in records.ids("root/pool")]
        assert found in ([b"new"], [] if before is None else [before]), f"after step {step}"
        records.write("root/pool", "a", b"again", 3, synced=synced)
        assert records.read("root/pool", "a").args == b"again"
        records.remove("root/pool", ["a"], synced=synced)
        assert not place(tmp_path / str(step)).exists(), "what the crash left is gone, too"
    assert step > 4


@pytest.mark.parametrize("synced", [False, True])
def test_a_crash_at_any_step_of_a_removal_leaves_the_whole_record_or_none(tmp_path: Path, synced: bool) -> None:
    step, done = 0, False
    while not done:
        step += 1
        records = ChildRecords(tmp_path / str(step))
        Path(tmp_path / str(step)).mkdir()
        for id in ("a", "b"):
            records.write("root/pool", id, id.encode(), 1, synced=False)
        done = not _killed_at(step, lambda records=records: records.remove("root/pool", ["a"], synced=synced))
        found = [records.read("root/pool", id).args for id in records.ids("root/pool")]
        assert found in ([b"b"], [b"a", b"b"]), f"after step {step}"
    assert step > 2


class _Killed(BaseException):
    pass


def _killed_at(step: int, act: object) -> bool:
    """Do something, and end it before its n-th change of the disk. Return whether it has not come to its end."""
    left = step
    names = ("open", "mkdir", "rename", "unlink", "rmdir", "fsync", "fchmod")
    real = {name: getattr(os, name) for name in names}

    def counted(name: str) -> object:
        def call(*args: object, **options: object) -> object:
            nonlocal left
            left -= 1
            if left <= 0:
                raise _Killed
            return real[name](*args, **options)

        return call

    with pytest.MonkeyPatch.context() as patched:
        for name in names:
            patched.setattr(os, name, counted(name))
        try:
            assert callable(act)
            act()
        except _Killed:
            return True
    return False


def test_supervisors_with_records_are_listed_by_their_ids_below_the_root(records: ChildRecords) -> None:
    assert records.supervisors() == []
    for path in ("root", "root/pool", "root/pool/deep", "root/pool2"):
        records.write(path, "a", b"", 1, synced=False)
    assert records.supervisors() == ["", "pool", "pool/deep", "pool2"]
    assert ChildRecords(records.state_dir).read("root-2/pool", "a").id == "a", "the root may have another id"
    records.remove_below("root/pool")
    assert records.supervisors() == ["", "pool2"]
    records.remove_below("root")
    assert records.supervisors() == []
