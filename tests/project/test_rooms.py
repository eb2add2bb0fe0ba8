"""The layout of the package: few rooms, none too large, and no two files of one name."""

from __future__ import annotations

from collections import defaultdict
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
PACKAGE = ROOT / "rr_actors"
PACKAGES = sorted(path.parent for path in PACKAGE.rglob("__init__.py"))


def modules(package: Path) -> list[Path]:
    return [path for path in package.glob("*.py") if path.name not in ("__init__.py", "__main__.py")]


def test_the_package_lists_at_most_sixteen_entries() -> None:
    entries = [path.name for path in PACKAGE.iterdir() if path.name != "__pycache__"]

    assert len(entries) <= 16, sorted(entries)


def test_a_room_has_three_to_twelve_modules() -> None:
    sizes = {str(package.relative_to(PACKAGE)): len(modules(package)) for package in PACKAGES if package != PACKAGE}

    assert {room: size for room, size in sizes.items() if not 3 <= size <= 12} == {}


def test_a_room_says_what_it_is_for_and_imports_nothing() -> None:
    """A room's modules may lie in different layers; what is imported in its __init__ would put them into one."""
    entrances = {"rr_actors", "rr_actors/managers", "rr_actors/testing"}  # people import these
    for package in PACKAGES:
        text = (package / "__init__.py").read_text()
        assert text.startswith('"""'), package
        if str(package.relative_to(ROOT)) not in entrances:
            assert "import " not in text.rpartition('"""')[2], package


def test_no_two_files_have_the_same_name() -> None:
    places: dict[str, list[str]] = defaultdict(list)
    for path in [*PACKAGE.rglob("*.py"), *(ROOT / "tests").rglob("*.py")]:
        if path.name not in ("__init__.py", "__main__.py", "conftest.py"):
            places[path.name].append(str(path.relative_to(ROOT)))

    assert {name: paths for name, paths in places.items() if len(paths) > 1} == {}
