"""The live terminal, at 80x24 and by keys alone: what its panes show of a running system, and what its keys do."""

from __future__ import annotations

import asyncio
import logging
import os
import re
import signal
import subprocess
import sys
import threading
import time
import types
from collections.abc import Awaitable, Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from textual.pilot import Pilot

import rr_actors as rr
from rr_actors.registrar.pages import ResourceRow
from rr_actors.system.console import console_messages as c
from rr_actors.system.console import console_questions as questions
from rr_actors.system.console.attention.attention_items import AttentionItem
from rr_actors.system.console.attention.attention_questions import Attention
from rr_actors.tools import process_usage
from rr_actors.tools.process_usage import UsageWatch
from rr_actors.tools.tables.sheets import SHEETS
from rr_actors.tools.tables.table import tables_of
from rr_actors.tools.terminal.attention_lines import attention_rows
from rr_actors.tools.terminal.console_link import ConsoleLink
from rr_actors.tools.terminal.terminal_app import Keys, Pane, Terminal
from rr_actors.tools.terminal.terminal_rows import Served, Window
from rr_actors.tools.terminal.terminal_tables import SheetRows
from support import LIMIT_S, Gate, Workshop, child, eventually, kill, pid_of, serve, wait_respawned
from support_managers import Order, Shop
from support_tmux import Tmux, needs_tmux, terminal

Start = Callable[..., rr.System]


class Person:
    """Somebody at the terminal: sees lines, presses keys."""

    def __init__(self, terminal: Terminal, pilot: Pilot[None]) -> None:
        self.terminal = terminal
        self._pilot = pilot

    async def press(self, *keys: str) -> None:
        await self._pilot.press(*keys)

    def lines(self, pane: Pane) -> list[str]:
        return [pane.render_line(y).text.rstrip() for y in range(pane.size.height)]

    @property
    def tree(self) -> str:
        return "\n".join(self.lines(self.terminal.left))

    @property
    def chosen(self) -> str:
        return "\n".join(self.lines(self.terminal.right))

    @property
    def events(self) -> str:
        return "\n".join(self.lines(self.terminal.events))

    @property
    def attention(self) -> str:
        shown = self.terminal.attention
        return "\n".join(shown.render_line(y).text.rstrip() for y in range(shown.size.height))

    async def sees(self, predicate: Callable[[], bool]) -> None:
        deadline = time.monotonic() + LIMIT_S
        while not predicate():
            what = f"{self.tree}\n---\n{self.chosen}\n---\n{self.events}\n---\n{self.terminal.status}"
            assert time.monotonic() < deadline, what
            await self._pilot.pause(0.02)

    async def chooses(self, name: str) -> None:
        """Go down the tree to a row with this text."""
        await self.sees(lambda: name in self.tree)
        await self.press("home")
        while (row := self.terminal.left.row) is None or name not in row.text:
            await self.press("down")


def sit_down(state_dir: Path, scene: Callable[[Person], Awaitable[None]]) -> None:
    """Play a scene at a terminal of 80x24 that shows the system in a state directory."""

    async def play() -> None:
        terminal = Terminal(ConsoleLink(state_dir))
        async with terminal.run_test(size=(80, 24)) as pilot:
            person = Person(terminal, pilot)
            await person.sees(lambda: "Tab changes the pane" in terminal.status)  # later words are of what is pressed
            await scene(person)

    asyncio.run(play())


@pytest.fixture
def shop(start: Start, workshop: Workshop) -> rr.System:
    """A system with a manager, `shop`, in a process of its own."""
    return start(rr.ChildSpec(Shop, id="shop", args=(str(workshop.root),)))


def test_the_tree_shows_the_children_and_the_chosen_ones_history(shop: rr.System, state_dir: Path) -> None:
    async def scene(person: Person) -> None:
        await person.sees(lambda: "started       shop" in person.chosen)  # the root has the history of all
        await person.chooses("  shop")
        await person.sees(lambda: "running, pid" in person.chosen and "started" in person.chosen)
        assert str(pid_of(shop, "shop")) in person.chosen
        assert person.tree.splitlines()[0].startswith("root")
        assert "@shop" in person.tree

    sit_down(state_dir, scene)


class Talker(rr.Actor):
    """Logs what it is sent."""

    def on_receive(self, message: Any) -> None:
        logging.getLogger("talk").error("%s", message)


def test_what_a_child_logs_stands_between_its_events(start: Start, state_dir: Path) -> None:
    system = start(rr.ChildSpec(Talker, id="talker"))
    system.ref("talker").tell("no such \x1b[31mdevice")

    async def scene(person: Person) -> None:
        await person.chooses("  talker")
        await person.sees(lambda: "ERROR    talk: no such ·[31mdevice" in person.chosen)
        before, _, after = person.chosen.partition("talk: no such")
        assert "started" not in before
        assert "started" in after

    sit_down(state_dir, scene)


def test_a_child_is_killed_stopped_and_started_again_by_a_key_each(shop: rr.System, state_dir: Path) -> None:
    pid = pid_of(shop, "shop")

    async def scene(person: Person) -> None:
        await person.chooses("  shop")
        await person.press("K", "y")
        await person.sees(lambda: f"sent SIGKILL to root/shop (pid {pid})" in person.terminal.status)
        await person.sees(lambda: "restarted" in person.events and "1x" in person.tree)
        await person.sees(lambda: "SIGKILL" in person.chosen and "restarted" in person.chosen)
        await person.press("t", "y")
        await person.sees(lambda: "stopped root/shop" in person.terminal.status)
        await person.sees(lambda: "stopped" in person.tree)
        assert child(shop, "shop").state == "stopped"
        await person.press("K")
        await person.sees(lambda: "kill: root/shop: it is stopped, and has no process" in person.terminal.status)
        await person.press("t")
        await person.sees(lambda: "stop: root/shop: it is stopped" in person.terminal.status)
        await person.press("r")
        await person.sees(lambda: "started root/shop again" in person.terminal.status)

    sit_down(state_dir, scene)

    assert pid_of(shop, "shop") != pid


def test_the_first_lines_say_what_needs_attention_and_are_gone_when_all_is_well(
    shop: rr.System, state_dir: Path
) -> None:
    async def scene(person: Person) -> None:
        await person.chooses("  shop")
        assert not person.terminal.attention.display
        await person.press("t", "y")
        await person.sees(lambda: "WARNING root/shop was stopped, and stays stopped until restart" in person.attention)
        assert person.terminal.attention.region.y == 1
        await person.press("r")
        await person.sees(lambda: not person.terminal.attention.display)

    sit_down(state_dir, scene)


@pytest.mark.parametrize(("total", "lines"), [(0, 0), (1, 1), (3, 3), (4, 3), (1000, 3)])
def test_three_lines_say_what_is_worst_and_how_much_more_there_is(total: int, lines: int) -> None:
    items = [AttentionItem(str(number), "ERROR", "disk", f"disk {number}", "") for number in range(total)]

    rows = attention_rows(Attention(total, items[: c.PAGE_LIMIT]))

    assert len(rows) == lines
    assert [row.text for row in rows[:2]] == [f"ERROR   disk {number}" for number in range(min(lines, 2))]
    assert [row.text for row in rows if "more" in row.text] == (
        [f"and {total - 2:,} more: rr-actors attention"] if total > 3 else []
    )


def test_a_question_says_what_would_happen(start: Start, state_dir: Path) -> None:
    system = start(
        rr.Supervisor(
            [rr.ChildSpec(Talker, id=id, placement="process") for id in ("one", "two")], strategy="rest_for_one"
        )
    )
    pid = pid_of(system, "one")

    async def scene(person: Person) -> None:
        await person.chooses("  one")
        await person.press("K")
        await person.sees(lambda: "two would stop" in person.terminal.status)
        assert "kill root/one? y: yes" in person.terminal.status
        await person.press("escape")
        await person.sees(lambda: "not done: kill root/one" in person.terminal.status)

    sit_down(state_dir, scene)

    assert pid_of(system, "one") == pid


def test_the_keys_of_vi_move_and_a_kill_asks_first(shop: rr.System, state_dir: Path) -> None:
    async def scene(person: Person) -> None:
        await person.chooses("  shop")
        await person.press("k")
        await person.sees(lambda: person.terminal.left.cursor == 0)
        await person.press("j", "y", "K")
        await person.sees(lambda: "kill root/shop? y: yes" in person.terminal.status)
        await person.press("escape")
        await person.sees(lambda: "not done: kill root/shop" in person.terminal.status)
        await person.press("y", "t", "y")
        await person.sees(lambda: "stopped root/shop" in person.terminal.status)
        assert "SIGKILL" not in person.events

    sit_down(state_dir, scene)


def test_without_a_terminal_it_is_refused_in_one_line(shop: rr.System, state_dir: Path) -> None:
    command = [sys.executable, "-m", "rr_actors", "top", "--state", str(state_dir)]
    ran = subprocess.run(command, stdin=subprocess.DEVNULL, capture_output=True, text=True, timeout=60.0)

    assert ran.returncode == 2, ran.stdout + ran.stderr
    assert "expected a terminal" in ran.stderr
    assert len(ran.stderr.splitlines()) == 1


def test_a_key_that_cannot_do_it_says_why(shop: rr.System, state_dir: Path) -> None:
    async def scene(person: Person) -> None:
        await person.chooses("root")
        await person.press("K", "y")
        await person.sees(lambda: "it is the root supervisor" in person.terminal.status)
        await person.press("u")
        await person.sees(lambda: "choose a resource" in person.terminal.status)
        await person.chooses("@shop")
        await person.press("K")
        await person.sees(lambda: "choose a child" in person.terminal.status)

    sit_down(state_dir, scene)


def test_resources_are_opened_to_their_holders_and_parts_and_unloaded(start: Start, state_dir: Path) -> None:
    system = start()
    provider, app = system.open_registrar("provider"), system.open_registrar("app")
    serve(provider, "lens", lambda request: "glass")
    served = serve(provider, "camera", lambda request: provider.load("provider/lens", request).response)
    query = app.load("provider/camera", "front", priority=5)

    async def scene(person: Person) -> None:
        await person.chooses("@provider")
        await person.sees(lambda: 'camera "front"' in person.chosen and 'lens "front"' in person.chosen)
        await person.sees(lambda: "provider, priority 5" in person.chosen)  # the lens inherits it
        await person.press("enter")
        while (row := person.terminal.right.row) is None or not row.text.startswith("camera"):
            await person.press("down")
        await person.press("enter")
        await person.sees(
            lambda: "app, for itself, priority 5" in person.chosen and 'provider/lens "front"' in person.chosen
        )
        await person.press("escape")
        await person.sees(lambda: person.terminal.right.rows == Served("provider"))
        await person.sees(lambda: person.terminal.right.row is not None)
        assert person.terminal.right.row.resource == query.resource_id  # the cursor is where it was
        await person.press("u")
        await person.sees(lambda: f"released query {query.id[-8:]}" in person.terminal.status)
        await person.sees(lambda: "camera" not in person.chosen)

    sit_down(state_dir, scene)

    served.unloads.wait()


def test_a_holder_that_is_slow_with_its_statuses_is_named(start: Start, state_dir: Path) -> None:
    system, gate = start(), Gate()
    provider, app = system.open_registrar("provider"), system.open_registrar("app")
    serve(provider, "camera")
    query = app.load("provider/camera", "front", on_status=lambda _: gate())
    for number in range(3):
        provider.send_status(query.resource_id, rr.Status(rr.State.WARNING, str(number)))

    async def scene(person: Person) -> None:
        await person.sees(lambda: "3 unheard" in person.tree)
        await person.chooses("@provider")
        await person.sees(lambda: "camera" in person.chosen)
        await person.press("enter", "enter")
        await person.sees(lambda: "app, for itself, 3 unheard" in person.chosen)

    try:
        sit_down(state_dir, scene)
    finally:
        gate.open()


def test_a_resource_of_several_holders_is_taken_from_one_of_them_or_from_all(start: Start, state_dir: Path) -> None:
    system = start()
    provider = system.open_registrar("provider")
    served = serve(provider, "camera")
    queries = {name: system.open_registrar(name).load("provider/camera", "front") for name in ("one", "two", "three")}

    async def scene(person: Person) -> None:
        await person.chooses("@provider")
        await person.sees(lambda: "3 holders" in person.chosen)
        await person.press("enter", "u")
        await person.sees(lambda: "U takes it away from all" in person.terminal.status)
        await person.press("enter")
        await person.sees(lambda: "two, for itself" in person.chosen)
        while (row := person.terminal.right.row) is None or "two," not in row.text:
            await person.press("down")
        await person.press("u")
        await person.sees(lambda: f"released query {queries['two'].id[-8:]}" in person.terminal.status)
        await person.sees(lambda: "held by 2" in person.chosen)
        assert len(served.unloads) == 0
        await person.press("escape")
        await person.press("U")
        await person.sees(lambda: "Its holders lose it at once, and hear FATAL." in person.terminal.status)
        await person.press("y")
        await person.sees(lambda: "away from 2 holders" in person.terminal.status)

    sit_down(state_dir, scene)

    served.unloads.wait()


def test_a_resource_is_revoked_after_a_question(shop: rr.System, state_dir: Path) -> None:
    app = shop.open_registrar("app")
    app.load("shop/thing", Order("lamp"))

    async def scene(person: Person) -> None:
        await person.press("R")
        await person.sees(lambda: "revoke: choose a resource" in person.terminal.status)
        await person.press("2")
        await person.sees(lambda: "lamp" in person.tree)
        await person.press("R")
        await person.sees(lambda: "y: yes, Esc: no" in person.terminal.status)
        await person.press("escape")
        await person.sees(lambda: "not done: revoke shop/thing" in person.terminal.status)
        assert len(app.queries()) == 1
        await person.press("R", "y")
        await person.sees(lambda: "revoked shop/thing" in person.terminal.status)

    sit_down(state_dir, scene)
    assert app.queries() == []


def test_a_priority_is_typed_and_given_and_what_is_none_is_refused(start: Start, state_dir: Path) -> None:
    system = start(config=rr.SystemConfig(registrars={"guests": rr.RegistrarConfig(max_priority=2)}))
    provider, guests = system.open_registrar("provider"), system.open_registrar("guests")
    serve(provider, "thing")
    query = guests.load("provider/thing", "lamp")

    async def scene(person: Person) -> None:
        await person.press("p")
        await person.sees(lambda: "priority: choose a resource or a holder" in person.terminal.status)
        await person.press("2")
        await person.sees(lambda: "lamp" in person.tree)
        await person.press("p", "2", "enter")
        await person.sees(lambda: f"gave priority 2 to query {query.id[-8:]} of guests" in person.terminal.status)
        await person.sees(lambda: "priority 2" in person.chosen)
        await person.press("p", "x", "slash", "enter")
        limits = "priority: expected a whole number from -1000 to 1000, or standby, got 'x/'"
        await person.sees(lambda: limits in person.terminal.status)
        await person.press("p", "9", "enter")
        limit = "expected 2 at most, as the max_priority of registrar 'guests' says, got 9"
        await person.sees(lambda: limit in person.terminal.status)
        await person.press("p", "1", "escape")
        await person.sees(lambda: "the priority stays as it was" in person.terminal.status)
        assert query.priority == 2
        await person.press("p", *"standby", "enter")
        await person.sees(lambda: f"gave standby to query {query.id[-8:]}" in person.terminal.status)

    sit_down(state_dir, scene)
    assert query.priority is None


def test_what_is_typed_filters_the_pane(shop: rr.System, state_dir: Path) -> None:
    app = shop.open_registrar("app")
    app.load("shop/thing", Order("lamp"))
    app.load("shop/thing", Order("chair"))

    async def scene(person: Person) -> None:
        await person.chooses("root")
        await person.press("slash", "a", "p", "p")
        await person.sees(lambda: person.tree.split()[:1] == ["@app"])
        await person.press("escape")
        await person.sees(lambda: "root" in person.tree)
        await person.chooses("@shop")
        await person.sees(lambda: "lamp" in person.chosen and "chair" in person.chosen)
        await person.press("tab", "slash", "l", "a", "m", "k", "backspace", "p", "enter")
        await person.sees(lambda: "lamp" in person.chosen and "chair" not in person.chosen)
        assert "filter: lamp" in str(person.terminal.right.border_title)
        assert "shop" in person.tree

    sit_down(state_dir, scene)


def test_a_system_that_stops_is_told_and_found_again(start: Start, state_dir: Path) -> None:
    first = start(rr.Supervisor([], id="early"))

    async def scene(person: Person) -> None:
        await person.sees(lambda: "early" in person.tree)
        await asyncio.to_thread(first.stop)
        await person.sees(lambda: "waiting for it" in person.terminal.status)
        assert str(state_dir) in person.terminal.status
        await asyncio.to_thread(start, rr.Supervisor([], id="late"))
        await person.sees(lambda: "started again" in person.terminal.status and "late" in person.tree)

    sit_down(state_dir, scene)


def test_the_children_are_sorted_by_each_column_and_the_resources_by_their_state(
    start: Start, state_dir: Path, workshop: Workshop
) -> None:
    shops = [rr.ChildSpec(Shop, id=id, args=(str(workshop.root),)) for id in ("quiet", "often")]
    system = start(rr.Supervisor(shops, id="root", max_restarts=9))
    wait_respawned(system, "often", kill(system, "often"))
    app = system.open_registrar("app")
    queries = [app.load("quiet/thing", Order(name)) for name in ("lamp", "chair")]
    system.registrar("quiet").send_status(queries[1].resource_id, rr.Status("ERROR", "broken"))

    def first(person: Person) -> list[str]:
        return [*person.tree.splitlines(), "?", "?"][1].split() or ["?"]  # while it is painted there may be no line

    async def scene(person: Person) -> None:
        await person.sees(lambda: "often" in person.tree)
        await person.press("z")
        await person.sees(lambda: first(person)[0] == "root" and person.tree.split()[0] == "cpu")
        for head, top in (("cpu", ""), ("memory", ""), ("restarts", "root/often"), ("mailbox", "")):
            await person.press("s")
            await person.sees(lambda head=head, top=top: f"▼{head}" in person.tree and top in first(person)[0])
        await person.press("s")
        await person.sees(lambda: first(person)[0] == "root/quiet" and first(person)[-2] == "2")
        await person.press("s")
        await person.sees(lambda: "▼loads/s" in person.tree)
        await person.press("s")
        await person.sees(lambda: "▼" not in person.tree and first(person)[0] == "root")

        await person.press("2", "s")
        await person.sees(lambda: '{"name":"chair"' in person.tree.splitlines()[1] and "ERROR" in person.tree)
        await person.press("enter")
        await person.sees(lambda: "ERROR: broken" in person.chosen and person.terminal.right.has_focus)
        await person.press("escape", "u")
        await person.sees(lambda: f"released query {queries[1].id[-8:]}" in person.terminal.status)
        await person.press("1")
        await person.sees(lambda: "often" in person.tree)

    sit_down(state_dir, scene)


def test_the_events_alone_have_the_screen_and_their_filter_and_the_help_ends_by_a_key(
    shop: rr.System, state_dir: Path
) -> None:
    app = shop.open_registrar("app")

    async def scene(person: Person) -> None:
        await person.sees(lambda: "started" in person.events)
        for number in range(15):
            await app.load_async("shop/thing", Order(f"lamp {number}"))
        assert len(person.lines(person.terminal.events)) < 10
        await person.press("3")
        await person.sees(lambda: "lamp 0" in person.events and "lamp 14" in person.events)
        await person.press("slash", *"lamp", "space", "1", "3", "enter")
        await person.sees(lambda: "lamp 13" in person.events and "lamp 14" not in person.events)
        await person.press("escape", "escape")
        await person.sees(lambda: "shop" in person.tree and len(person.lines(person.terminal.events)) < 10)
        await person.press("question_mark", "K")
        await person.sees(lambda: isinstance(person.terminal.screen, Keys))
        assert "kill" not in person.terminal.status
        await person.press("escape")
        await person.sees(lambda: not isinstance(person.terminal.screen, Keys))

    sit_down(state_dir, scene)


def test_a_curve_shows_when_a_process_had_work(monkeypatch: pytest.MonkeyPatch) -> None:
    later_s = 0.0
    began = time.monotonic()
    clock = types.SimpleNamespace(monotonic=lambda: 1500.0 + time.monotonic() - began + later_s)
    monkeypatch.setattr(process_usage, "time", clock)
    usages = UsageWatch()
    works = subprocess.Popen([sys.executable, "-c", "while True: pass"])
    try:
        eventually(lambda: (usage := usages.look(works.pid)) is not None and usage.cpu_percent > 20.0)
        assert usages.curve(works.pid).strip() == "█"
        works.send_signal(signal.SIGSTOP)
        later_s = 60.0
        usages.look(works.pid)
        later_s = 120.0
        resting = usages.look(works.pid)
        assert resting is not None
        assert resting.cpu_percent == 0.0
        assert usages.curve(works.pid).lstrip() == "█   ▁   ▁"
    finally:
        works.kill()
        works.wait()
    assert usages.look(works.pid) is None
    assert usages.curve(works.pid) == ""


class Silent(ConsoleLink):
    """A system that answers no question while it is to be silent."""

    is_silent = False

    def ask(self, request: Any, timeout_s: float | None = None) -> Any:
        if self.is_silent:
            raise rr.Unavailable("it has not answered within 10 s")
        return super().ask(request, timeout_s)


def test_a_system_that_does_not_answer_is_told_until_it_does(start: Start, state_dir: Path) -> None:
    start()

    async def play() -> None:
        link = Silent(state_dir)
        terminal = Terminal(link)
        async with terminal.run_test(size=(80, 24)) as pilot:
            person = Person(terminal, pilot)
            await person.sees(lambda: "root" in person.tree)
            link.is_silent = True
            terminal.left.ask()
            await person.sees(lambda: "has not answered" in terminal.status)
            assert "root" in person.tree
            link.is_silent = False
            terminal.left.ask()
            await person.sees(lambda: "answers again" in terminal.status)

    asyncio.run(play())


def test_a_thread_that_follows_ends_when_the_link_is_closed(start: Start, state_dir: Path) -> None:
    start()
    link = ConsoleLink(state_dir)
    reached = threading.Event()

    following = threading.Thread(target=link.follow, args=(lambda _welcome: reached.set(), lambda _part: None))
    following.start()
    assert reached.wait(LIMIT_S)

    link.close()

    following.join(LIMIT_S)
    assert not following.is_alive()
    with pytest.raises(rr.Unavailable, match="is closed"):
        link.ask(questions.ListChildren())


def test_following_ends_when_the_link_is_closed_as_soon_as_it_has_reached_the_system(
    start: Start, state_dir: Path
) -> None:
    start()
    link = ConsoleLink(state_dir)

    ended = link.follow(lambda _welcome: link.close(), lambda _part: None)

    assert ended == "the connection to the system is closed"


class Crowd(ConsoleLink):
    """A system of 500 children and 100,000 resources that notes what it is asked for."""

    CHILDREN, RESOURCES = 500, 100_000

    def __init__(self, state_dir: Path) -> None:
        super().__init__(state_dir)
        self.asked: list[Any] = []

    def ask(self, request: Any, timeout_s: float | None = None) -> Any:
        self.asked.append(request)
        match request:
            case questions.ListChildren(_, offset, limit):
                rows = [c.ChildRow(f"root/child{n}", 1, "worker", "running") for n in range(self.CHILDREN)]
                return c.Children(self.CHILDREN, rows[offset : offset + limit])
            case questions.ListRegistrars(_, offset, limit):
                return c.Registrars(1, [c.RegistrarRow("store", "up", ["store/thing"])][offset : offset + limit])
            case questions.ListResources(_, offset, limit):
                numbers = range(self.RESOURCES)[offset : offset + limit]
                return c.Resources(self.RESOURCES, [a_resource(number) for number in numbers])
            case questions.ListQueries():
                return c.QueryPage(0, [])
            case _:
                return super().ask(request, timeout_s)


def a_resource(number: int) -> ResourceRow:
    texts = f'"thing {number}"', "", "loaded", "OK", ""
    return ResourceRow(f"{number:032x}", "store/thing", *texts, 1, [], 0, [], 0)


def test_only_what_is_visible_is_asked_for(start: Start, state_dir: Path) -> None:
    start()

    async def play() -> None:
        crowd = Crowd(state_dir)
        terminal = Terminal(crowd)
        async with terminal.run_test(size=(80, 24)) as pilot:
            person = Person(terminal, pilot)
            await person.sees(lambda: "child0" in person.tree)
            await person.press("end")
            await person.sees(lambda: "child499" in person.tree and "@store" in person.tree)
            await person.sees(lambda: '"thing 0"' in person.chosen)
            await person.press("tab", "end")
            await person.sees(lambda: f'"thing {Crowd.RESOURCES - 1}"' in person.chosen)
            height = terminal.left.size.height
        lists = [
            one
            for one in crowd.asked
            if isinstance(one, questions.ListChildren | questions.ListResources | questions.ListRegistrars)
        ]
        assert height < 24
        assert max(one.limit for one in lists) == height
        assert len(lists) < 200

    asyncio.run(play())


class Jobs(rr.Manager):
    """Declares a table of its own."""

    @rr.table("jobs", rr.TableColumn("job"), rr.TableColumn("left", kind="bar", of="all"))
    def jobs(self) -> list[dict[str, Any]]:
        """Return the jobs."""
        return [{"job": "sweep", "left": 1, "all": 2}]


def test_the_tables_of_managers_are_a_list_of_their_own(start: Start, state_dir: Path) -> None:
    start(rr.ChildSpec(Jobs, id="jobs"))

    async def scene(person: Person) -> None:
        await person.press("6")
        await person.sees(lambda: "jobs sweep" in person.tree and "1 of 2" in person.tree)

    sit_down(state_dir, scene)


def test_a_window_goes_on_from_one_list_to_the_next(start: Start, state_dir: Path) -> None:
    start()
    crowd = Crowd(state_dir)
    try:
        listed = SheetRows(SHEETS[0], tables_of(SHEETS[0].module())).list(crowd, Window(offset=498, limit=10))
    finally:
        crowd.close()

    assert (listed.total, [row.key for row in listed.rows]) == (
        501,
        ["child root/child498", "child root/child499", "registrar store"],
    )


def test_a_text_that_would_drive_the_terminal_is_shown_harmless(start: Start, state_dir: Path) -> None:
    system = start()
    serve(system.open_registrar("provider"), "camera")
    system.open_registrar("app").load("provider/camera", "red \x9b31m alert")

    async def scene(person: Person) -> None:
        await person.chooses("@provider")
        await person.sees(lambda: "alert" in person.chosen)
        assert "\x9b" not in person.chosen
        assert "\x1b" not in person.chosen
        await person.press("slash", "left_square_bracket", "slash", "b", "right_square_bracket")
        await person.sees(lambda: person.terminal.left.match == "[/b]" and person.tree.strip() == "")

    sit_down(state_dir, scene)


def test_without_the_extra_the_command_says_what_to_install(tmp_path: Path, shop: rr.System) -> None:
    (tmp_path / "textual.py").write_text("raise ModuleNotFoundError('No module named textual', name='textual')")

    ran = subprocess.run(
        [sys.executable, "-m", "rr_actors", "top"],
        env=os.environ | {"PYTHONPATH": str(tmp_path)},
        capture_output=True,
        text=True,
    )

    assert ran.returncode == 2
    assert "pip install '.[top]'" in ran.stderr
    assert len(ran.stderr.splitlines()) == 1


@pytest.fixture
def tmux(state_dir: Path, tmp_path: Path) -> Iterator[Tmux]:
    """`rr-actors top` in a real terminal."""
    with terminal(tmp_path, "top", "--state", str(state_dir), columns=80, lines=24) as tmux:
        yield tmux


@needs_tmux
def test_it_runs_in_a_real_terminal(shop: rr.System, tmux: Tmux) -> None:
    pid = pid_of(shop, "shop")
    eventually(lambda: "  shop" in tmux("capture-pane", "-p"), timeout=30.0)
    tmux("send-keys", "j", "K")
    eventually(lambda: "kill root/shop?" in tmux("capture-pane", "-p"), timeout=30.0)
    tmux("send-keys", "y")
    eventually(lambda: f"(pid {pid})" in tmux("capture-pane", "-p"), timeout=30.0)
    eventually(lambda: "restarted" in tmux("capture-pane", "-p"), timeout=30.0)
    tmux("send-keys", "/", "k", "/", "t")  # at once, as a slow line has it: no letter of it is a command
    eventually(lambda: "filter: k/t" in tmux("capture-pane", "-p"), timeout=30.0)
    tmux("send-keys", "Escape")
    eventually(lambda: "filter:" not in tmux("capture-pane", "-p"), timeout=30.0)
    tmux("send-keys", "q")
    eventually(lambda: "exit code 0" in tmux("capture-pane", "-p"), timeout=30.0)


class Cameras(rr.Manager):
    @rr.server("camera")
    def open_camera(self, device: str) -> None:
        self.images = rr.current().open_stream("images")
        self.ended = threading.Event()
        threading.Thread(target=self.grab, daemon=True).start()

    @open_camera.unload
    def close_camera(self, device: str, response: object) -> None:
        self.ended.set()

    def grab(self) -> None:
        while not self.ended.wait(0.01):
            self.images.publish(bytes(1000))


@pytest.fixture
def cameras(start: Start) -> rr.System:
    return start(rr.ChildSpec(Cameras, id="cameras"))


@needs_tmux
def test_streams_are_listed_with_their_figures(cameras: rr.System, tmux: Tmux) -> None:
    def shows(pattern: str) -> None:
        eventually(lambda: re.search(pattern, tmux("capture-pane", "-p")), timeout=30.0)

    with cameras.open_registrar("app").load(Cameras.open_camera, "front").stream("images", timeout_s=30.0) as frames:
        next(frames)
        shows("  cameras")
        tmux("send-keys", "4", "z")
        shows(r"rate +bytes +readers +missed")
        shows(r"images  cameras/camera.* \d+\.\d/s +\d\.\d MiB/s +1 +\d")
        tmux("send-keys", "z", "Enter")
        shows(r"stream images: 1 read it +\d+\.\d/s, ")
    tmux("send-keys", "q")
    shows("exit code 0")
