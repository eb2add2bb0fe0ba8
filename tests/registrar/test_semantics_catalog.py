"""What a registrar promises about its catalog (docs/semantics.md, "Catalog")."""

from __future__ import annotations

import os
import sqlite3
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest

import rr_actors as rr
from rr_actors.base.errors import CatalogError
from rr_actors.registrar.model.rows import ServedQuery
from rr_actors.storage.journaled_store import JournaledStore
from rr_actors.storage.opening import open_store, read_rows
from support import Calls, Workshop, catalog_path, eventually, read_catalog, serve
from support_managers import Order, Shop

Start = Callable[..., rr.System]


def pragma(path: Path, name: str) -> Any:
    with closing(sqlite3.connect(f"file:{path}?mode=ro", uri=True)) as connection:
        return connection.execute(f"PRAGMA {name}").fetchone()[0]


def size(path: Path) -> int:
    return sum(file.stat().st_size for file in path.parent.iterdir() if file.is_file())


# -- the file ------------------------------------------------------------------------------------------------------


def test_the_catalog_is_one_sqlite_file_per_registrar_in_wal_mode_with_a_schema_version(
    app: rr.Registrar, provider: rr.Registrar, state_dir: Path
) -> None:
    serve(provider, "thing")
    for registrar in (app, provider):
        path = catalog_path(state_dir, registrar.name)
        assert [file.name for file in path.parent.iterdir()] == ["catalog.lock"], "it holds nothing yet"
    app.load("provider/thing", "x")
    for registrar in (app, provider):
        registrar.save_catalog()
        path = catalog_path(state_dir, registrar.name)
        assert path.is_file()
        assert pragma(path, "journal_mode") == "wal"
        assert pragma(path, "user_version") >= 1


def test_a_person_can_read_who_holds_what_with_any_sqlite_tool(
    app: rr.Registrar, provider: rr.Registrar, state_dir: Path
) -> None:
    serve(provider, "thing")
    query = app.load("provider/thing", "x")
    path = catalog_path(state_dir, "provider")
    eventually(lambda: len(read_catalog(path, "resources")) == 1)  # it was in the catalog's journal until then
    (resource,) = read_catalog(path, "resources")
    assert (resource["id"], resource["server"]) == (query.resource_id, "thing")
    (row,) = read_catalog(path, "queries")
    assert (row["id"], row["resource_id"], row["origin"]) == (query.id, query.resource_id, "app")


def test_the_state_directory_is_private(app: rr.Registrar, state_dir: Path) -> None:
    for directory, _, files in os.walk(state_dir):
        assert os.stat(directory).st_mode & 0o077 == 0, directory
        for name in files:
            path = Path(directory) / name
            if not path.is_symlink():
                assert path.lstat().st_mode & 0o077 == 0, path


def test_what_was_released_takes_no_space(app: rr.Registrar, provider: rr.Registrar, state_dir: Path) -> None:
    serve(provider, "thing")
    path = catalog_path(state_dir, "provider")
    kept = app.load("provider/thing", "kept")

    def rows(name: str) -> dict[str, int]:
        tables = ("resources", "queries", "held", "notices")
        return {table: len(read_catalog(catalog_path(state_dir, name), table)) for table in tables}

    def rounds(count: int) -> None:
        for n in range(count):
            with app.load("provider/thing", n, on_status=print) as query:
                provider.send_status(query.resource_id, rr.Status(rr.State.OK, ""))

    rounds(20)
    eventually(lambda: rows("provider") == {"resources": 1, "queries": 1, "held": 0, "notices": 0})
    provider.save_catalog()
    before = size(path)
    rounds(200)
    eventually(lambda: rows("provider") == {"resources": 1, "queries": 1, "held": 0, "notices": 0})
    eventually(lambda: rows("app") == {"resources": 0, "queries": 0, "held": 1, "notices": 0})
    assert size(path) < before + 4_500_000  # SQLite's write-ahead log is kept at a bounded length
    assert [query.id for query in app.queries()] == [kept.id]


# -- configuration -------------------------------------------------------------------------------------------------


def test_save_on_modify_is_the_default(app: rr.Registrar, provider: rr.Registrar, state_dir: Path) -> None:
    assert provider.config.save_on_modify
    serve(provider, "thing")
    query = app.load("provider/thing", "x")
    path = catalog_path(state_dir, "provider")
    assert [row.id for row in read_rows(path) if isinstance(row, ServedQuery)] == [query.id]
    query.unload()
    assert read_rows(path) == []
    eventually(lambda: read_catalog(path, "queries") == [])


def test_a_saved_catalog_is_up_to_date_for_any_sqlite_tool(
    app: rr.Registrar, provider: rr.Registrar, state_dir: Path
) -> None:
    serve(provider, "thing")
    path = catalog_path(state_dir, "provider")
    for number in range(5):
        app.load("provider/thing", number)
        provider.save_catalog()
        assert len(read_catalog(path, "queries")) == number + 1


def test_without_save_on_modify_changes_are_written_each_save_interval(
    system: rr.System, app: rr.Registrar, state_dir: Path
) -> None:
    config = rr.RegistrarConfig(name="lazy", save_on_modify=False, save_interval_s=0.05)
    lazy = system.open_registrar("lazy", config)
    serve(lazy, "thing")
    app.load("lazy/thing", "x")
    eventually(lambda: len(read_catalog(catalog_path(state_dir, "lazy"), "queries")) == 1)


def test_without_save_on_modify_changes_are_written_by_save_catalog(
    system: rr.System, app: rr.Registrar, state_dir: Path
) -> None:
    config = rr.RegistrarConfig(name="lazy", save_on_modify=False, save_interval_s=3600.0)
    lazy = system.open_registrar("lazy", config)
    serve(lazy, "thing")
    app.load("lazy/thing", "x")
    assert read_catalog(catalog_path(state_dir, "lazy"), "queries") == []
    lazy.save_catalog()
    assert len(read_catalog(catalog_path(state_dir, "lazy"), "queries")) == 1


def test_without_save_on_modify_changes_are_written_at_stop(
    system: rr.System, app: rr.Registrar, state_dir: Path
) -> None:
    config = rr.RegistrarConfig(name="lazy", save_on_modify=False, save_interval_s=3600.0)
    lazy = system.open_registrar("lazy", config)
    serve(lazy, "thing")
    query = app.load("lazy/thing", "x")
    lazy.save_catalog()
    query.unload()
    assert len(read_catalog(catalog_path(state_dir, "lazy"), "queries")) == 1
    lazy.close()
    assert read_catalog(catalog_path(state_dir, "lazy"), "queries") == []


def test_erase_on_destruct_removes_the_catalog_at_close(system: rr.System, state_dir: Path) -> None:
    path = catalog_path(state_dir, "passing")
    passing = system.open_registrar("passing", rr.RegistrarConfig(name="passing", erase_on_destruct=True))
    assert path.parent.exists()
    passing.close()
    assert not path.parent.exists()
    kept = system.open_registrar("kept")
    kept.close()
    assert catalog_path(state_dir, "kept").parent.exists()


def test_erase_on_destruct_leaves_a_catalog_whose_releases_a_provider_that_is_down_has_to_hear_of(
    start: Start, workshop: Workshop, state_dir: Path
) -> None:
    shop = rr.ChildSpec(Shop, id="shop", args=(str(workshop.root),))
    system = start(shop)
    passing = system.open_registrar("passing", rr.RegistrarConfig(erase_on_destruct=True))
    passing.load("shop/thing", Order("wheel"))
    system.supervisor().terminate_child("shop")
    passing.close(timeout_s=0.1)
    system.stop()
    system = start(shop)
    assert system.dormant() == ["passing"]
    passing = system.open_registrar("passing", rr.RegistrarConfig(erase_on_destruct=True))
    workshop.wait("unload wheel")
    eventually(lambda: not system.registrar("shop").resources())
    passing.close()
    assert not catalog_path(state_dir, "passing").exists()


@pytest.mark.parametrize("broken", ["commit", "close"])
@pytest.mark.parametrize("ends", ["registrar", "system"])
def test_a_disk_that_is_full_or_broken_keeps_nothing_from_closing(
    start: Start, workshop: Workshop, state_dir: Path, monkeypatch: pytest.MonkeyPatch, broken: str, ends: str
) -> None:
    system = start(rr.ChildSpec(Shop, id="shop", args=(str(workshop.root),)))
    app = system.open_registrar("app", rr.RegistrarConfig(name="app", erase_on_destruct=True))
    app.load("shop/thing", Order("wheel")).unload()
    real = getattr(JournaledStore, broken)

    def breaks(store: JournaledStore, *changes: Any, **options: Any) -> None:
        if broken == "close" or store.path != catalog_path(state_dir, "app"):
            real(store, *changes, **options)
        if store.path == catalog_path(state_dir, "app"):
            raise CatalogError("app: full", path=str(store.path))

    monkeypatch.setattr(JournaledStore, broken, breaks)
    app.close() if ends == "registrar" else system.stop()
    with pytest.raises(rr.RrError):
        app.load("shop/thing", Order("wheel"))
    if ends == "registrar":
        assert not system.open_registrar("app").queries()
        system.stop()
    assert workshop.lines("stop") == ["stop shop"]


def test_location_puts_the_catalog_elsewhere(
    system: rr.System, app: rr.Registrar, tmp_path: Path, state_dir: Path
) -> None:
    elsewhere = tmp_path / "elsewhere"
    provider = system.open_registrar("provider", rr.RegistrarConfig(name="provider", location=elsewhere))
    serve(provider, "thing")
    app.load("provider/thing", "x")
    provider.save_catalog()
    files = [path for path in (elsewhere, *elsewhere.rglob("*")) if path.is_file() and path.suffix != ".lock"]
    assert any(file.read_bytes()[:15] == b"SQLite format 3" for file in files)
    assert not catalog_path(state_dir, "provider").exists()


@pytest.mark.parametrize("durability", ["process", "power", "none"])
def test_every_durability_loads_and_unloads(system: rr.System, app: rr.Registrar, durability: Any) -> None:
    config = rr.RegistrarConfig(name="provider", durability=durability)
    provider = system.open_registrar("provider", config)
    served = serve(provider, "thing")
    app.load("provider/thing", "x").unload()
    assert (len(served.loads), len(served.unloads)) == (1, 1)
    assert provider.config.durability == durability


def test_load_catalog_reads_what_was_saved(system: rr.System, app: rr.Registrar, provider: rr.Registrar) -> None:
    serve(provider, "thing")
    query = app.load("provider/thing", "x")
    provider.save_catalog()
    provider.load_catalog()
    assert [resource.id for resource in provider.resources()] == [query.resource_id]
    query.unload()
    assert list(provider.resources()) == []


def test_load_catalog_loses_nothing_that_is_held(app: rr.Registrar, provider: rr.Registrar) -> None:
    served = serve(provider, "thing")
    query = app.load("provider/thing", "x")
    app.load_catalog()  # its row is written a moment later
    assert [held.id for held in app.queries()] == [query.id]
    app.unload(query.id)
    assert [request for request, _ in served.unloads] == ["x"]


def test_load_catalog_tells_the_holders_of_what_was_not_saved(system: rr.System, app: rr.Registrar) -> None:
    config = rr.RegistrarConfig(save_on_modify=False, save_interval_s=3600)
    provider = system.open_registrar("provider", config)
    serve(provider, "thing")
    kept = app.load("provider/thing", "kept")
    provider.save_catalog()
    statuses = Calls()
    lost = app.load("provider/thing", "lost", on_status=statuses)
    provider.load_catalog()
    (status,) = statuses.wait()
    assert (status.state, status.query_id) == (rr.State.FATAL, lost.id)
    eventually(lambda: [query.id for query in app.queries()] == [kept.id])
    assert [resource.request for resource in provider.resources()] == ["kept"]
    assert app.load("provider/thing", "kept").resource_id == kept.resource_id


def test_a_config_is_read_from_toml(tmp_path: Path, system: rr.System) -> None:
    file = tmp_path / "registrar.toml"
    file.write_text(
        f"""
name = "cameras"
location = "{tmp_path / "there"}"
save_interval_s = 5
save_on_modify = false
erase_on_destruct = true
durability = "power"
on_damage = "aside"
"""
    )
    config = rr.RegistrarConfig.from_toml(file)
    assert (config.name, str(config.location)) == ("cameras", str(tmp_path / "there"))
    assert (config.save_interval_s, config.save_on_modify, config.erase_on_destruct) == (5.0, False, True)
    assert (config.durability, config.on_damage) == ("power", "aside")
    assert system.open_registrar("cameras", config).config.durability == "power"


# -- damage --------------------------------------------------------------------------------------------------------


def write_garbage(path: Path) -> None:
    path.write_bytes(b"this is not a catalog at all\n" * 100)


def write_foreign(path: Path) -> None:
    with closing(sqlite3.connect(path)) as connection:
        connection.execute("CREATE TABLE recipes (id INTEGER, title TEXT)")
        connection.execute("INSERT INTO recipes VALUES (1, 'soup')")
        connection.commit()


def write_torn(path: Path) -> None:
    """A catalog whose middle was overwritten."""
    write_foreign(path)
    content = bytearray(path.read_bytes())
    content[20:2000] = b"\xff" * 1980
    path.write_bytes(bytes(content))


DAMAGES = [write_garbage, write_foreign, write_torn]


@pytest.mark.parametrize("damage", DAMAGES)
def test_a_damaged_or_foreign_file_is_an_error_that_names_it_and_it_is_left_as_it_is(
    system: rr.System, state_dir: Path, damage: Callable[[Path], None]
) -> None:
    path = catalog_path(state_dir, "hurt")
    path.parent.mkdir(mode=0o700)
    damage(path)
    content = path.read_bytes()
    for _ in range(2):
        with pytest.raises(rr.CatalogDamaged, match=r"catalog\.sqlite3") as caught:
            system.open_registrar("hurt")
        assert str(caught.value.path) == str(path)
        assert "aside" in str(caught.value)  # what to do
    assert path.read_bytes() == content


@pytest.mark.parametrize("damage", DAMAGES)
def test_on_damage_aside_renames_the_file_and_starts_empty(
    system: rr.System, app: rr.Registrar, state_dir: Path, damage: Callable[[Path], None]
) -> None:
    path = catalog_path(state_dir, "hurt")
    path.parent.mkdir(mode=0o700)
    damage(path)
    content = path.read_bytes()
    hurt = system.open_registrar("hurt", rr.RegistrarConfig(name="hurt", on_damage="aside"))
    assert list(hurt.resources()) == []
    serve(hurt, "thing")
    app.load("hurt/thing", "x")
    hurt.save_catalog()
    assert len(read_catalog(path, "queries")) == 1
    assert content in [other.read_bytes() for other in path.parent.iterdir() if other != path and other.is_file()]


def test_a_newer_catalog_is_refused_and_left_as_it_is(system: rr.System, state_dir: Path) -> None:
    path = catalog_path(state_dir, "modern")
    open_store(path, durability="power").close()
    with closing(sqlite3.connect(path)) as connection:
        connection.execute("PRAGMA user_version = 999")
        connection.commit()
    with pytest.raises(rr.CatalogVersion, match="999") as caught:
        system.open_registrar("modern")
    assert str(caught.value.path) == str(path)
    assert caught.value.got == 999
    assert pragma(path, "user_version") == 999


@pytest.mark.parametrize("name", ["catalog.sqlite3", "catalog.journal.1"])
def test_a_pipe_in_the_place_of_a_file_is_damage_and_not_waited_for(system: rr.System, name: str) -> None:
    pipe = catalog_path(Path(system.state_dir), "app").with_name(name)
    system.open_registrar("app").close()
    pipe.unlink(missing_ok=True)
    os.mkfifo(pipe)
    with pytest.raises(rr.CatalogDamaged, match=f"{name}, which is no file but a pipe"):
        system.open_registrar("app")
    assert pipe.is_fifo()


def test_a_damaged_catalog_of_a_manager_stops_the_start_and_is_named(workshop: Workshop, state_dir: Path) -> None:
    path = catalog_path(state_dir, "shop")
    path.parent.mkdir(mode=0o700, parents=True)
    state_dir.chmod(0o700)
    write_garbage(path)
    system = rr.System([rr.ChildSpec(Shop, id="shop", args=(str(workshop.root),))], state_dir=state_dir)
    with pytest.raises(rr.RrError) as caught:
        system.start()
    assert isinstance(caught.value, (rr.StartFailed, rr.CatalogDamaged))
    told = str(caught.value) + str(caught.value.__cause__ or "")
    assert str(path) in told
    assert path.read_bytes().startswith(b"this is not")


# -- locks ---------------------------------------------------------------------------------------------------------


def test_a_second_system_on_a_state_directory_in_use_is_refused_directly(system: rr.System, state_dir: Path) -> None:
    with pytest.raises(rr.CatalogLocked, match=str(state_dir)) as caught:
        rr.System(name="another", state_dir=state_dir).start()
    assert caught.value.pid == os.getpid()
    system.open_registrar("app")  # the first one is untouched


def test_a_second_system_is_refused_whatever_its_children_are_called(
    system: rr.System, state_dir: Path, workshop: Workshop
) -> None:
    spec = rr.ChildSpec(Shop, id="something-else", args=(str(workshop.root),))
    with pytest.raises(rr.CatalogLocked):
        rr.System([spec], name="another", state_dir=state_dir).start()
    assert workshop.lines() == []


def test_a_catalog_locked_by_a_living_process_is_refused_and_named(
    system: rr.System, start: Start, tmp_path: Path
) -> None:
    config = rr.RegistrarConfig(name="shared", location=tmp_path / "shared")
    first = system.open_registrar("shared", config)
    serve(first, "thing")
    second = start(state_dir=tmp_path / "other-state", name="second")
    with pytest.raises(rr.CatalogLocked, match="shared") as caught:
        second.open_registrar("shared", config)
    assert caught.value.pid == os.getpid()
    first.close()
    second.open_registrar("shared", config)


def test_a_state_directory_can_be_used_again_when_its_system_has_stopped(start: Start, state_dir: Path) -> None:
    for _ in range(3):
        system = start()
        provider, app = system.open_registrar("provider"), system.open_registrar("app")
        serve(provider, "thing")
        assert app.load("provider/thing", "x").response["number"] == 1
        system.stop()


def test_a_manager_without_its_system_cannot_be_opened_twice(start: Start, workshop: Workshop) -> None:
    system = start(rr.ChildSpec(Shop, id="shop", args=(str(workshop.root),)))
    with pytest.raises(rr.NameTaken, match="shop"):
        system.open_registrar("shop")
    assert system.open_registrar("app").load("shop/thing", Order("wheel")).response.name == "wheel"
