"""LastGood: after a crash the last good configuration holds, and an edit takes effect when somebody asks."""

from __future__ import annotations

from pathlib import Path

import pytest

import rr_actors as rr
from rr_actors.managers.planning.last_good import LastGood, Sources, one_file, still_standing
from rr_actors.registrar.manager import Beginning


def parsed(sources: Sources) -> int:
    (text,) = sources.values()
    if not text.isdigit():
        raise rr.ConfigError(f"expected a number, got {text!r}", file=None, key=None, expected="", got="")
    return int(text)


class Manager:
    """The starts of one manager."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.file, self.run = folder, folder / "given.toml", 0

    def says(self, text: str) -> None:
        self.file.write_text(text)

    def _start(self, run: int, *, by_hand: bool) -> LastGood[int]:
        beginning = Beginning("manager", self.folder / "state", f"run {run}", by_hand)
        return LastGood(beginning, lambda: one_file(self.file), parsed)

    def system_start(self) -> LastGood[int]:
        self.run += 1
        return self._start(self.run, by_hand=False)

    def respawn(self) -> LastGood[int]:
        return self._start(self.run, by_hand=False)

    def start_by_hand(self) -> LastGood[int]:
        return self._start(self.run, by_hand=True)


@pytest.fixture
def manager(tmp_path: Path) -> Manager:
    made = Manager(tmp_path)
    made.says("1")
    return made


def test_an_edit_takes_effect_at_a_start_that_somebody_asks_for_and_not_at_a_respawn(manager: Manager) -> None:
    assert manager.system_start().now == 1
    manager.says("2")
    respawned = manager.respawn()
    assert respawned.now == 1
    assert respawned.problem == f"{manager.file}: changed since it was read"
    by_hand = manager.start_by_hand()
    assert (by_hand.now, by_hand.problem) == (2, "")
    manager.says("3")
    assert manager.respawn().now == 2
    assert manager.system_start().now == 3


@pytest.mark.parametrize("way", ["missing", "half written", "a directory", "empty", "not UTF-8"])
def test_a_wrong_file_is_no_error_at_a_respawn_and_is_one_at_each_other_start(
    manager: Manager, way: str, caplog: pytest.LogCaptureFixture
) -> None:
    manager.system_start()
    match way:
        case "missing":
            manager.file.unlink()
        case "a directory":
            manager.file.unlink()
            manager.file.mkdir()
        case "not UTF-8":
            manager.file.write_bytes(b"\xff")
        case _:
            manager.says("" if way == "empty" else "1 +")
    for _ in range(2):
        caplog.clear()
        respawned = manager.respawn()
        assert respawned.now == 1
        assert respawned.problem
        assert respawned.problem in caplog.text
    with pytest.raises(rr.ConfigError):
        manager.start_by_hand()
    with pytest.raises(rr.ConfigError):
        manager.system_start()


def test_what_is_applied_holds_until_the_file_says_something_else_and_never_comes_back(manager: Manager) -> None:
    manager.system_start().apply({"other.toml": b"3"})
    assert manager.respawn().now == 3
    assert manager.system_start().now == 3
    assert manager.respawn().now == 3
    manager.says("2")
    assert manager.respawn().now == 3
    assert manager.system_start().now == 2
    manager.says("1")
    assert manager.system_start().now == 1


def test_what_is_applied_and_wrong_changes_nothing(manager: Manager) -> None:
    started = manager.system_start()
    with pytest.raises(rr.ConfigError, match="expected a number"):
        started.apply({"other.toml": b"?"})
    assert started.now == 1
    assert manager.respawn().now == 1


def test_a_damaged_record_costs_only_the_memory_of_what_was_applied(
    manager: Manager, caplog: pytest.LogCaptureFixture
) -> None:
    manager.system_start().apply({"other.toml": b"3"})
    (manager.folder / "state" / "configuration.json").write_text("{")
    assert manager.respawn().now == 1
    assert "is started anew" in caplog.text


def test_a_disk_that_refuses_the_record_costs_no_decision(manager: Manager, caplog: pytest.LogCaptureFixture) -> None:
    started = manager.system_start()
    record = manager.folder / "state" / "configuration.json"
    record.unlink()
    record.mkdir()
    assert not started.apply({"other.toml": b"3"})
    assert not started.apply({"other.toml": b"4"})
    assert started.now == 4
    assert caplog.text.count("cannot be written") == 1
    assert not started.catch_up()
    record.rmdir()
    assert started.catch_up()
    assert manager.respawn().now == 4


def test_an_override_stands_as_long_as_the_file_says_what_it_replaced() -> None:
    overrides = {"watts": (100, 60), "cores": (4, 2), "gone": (1, 0)}
    assert still_standing(overrides, {"watts": 100, "cores": 8}) == {"watts": (100, 60)}
