"""The component manager: the registry, the choice of the most reliable, replacement, reliability."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import socket
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

import rr_actors as rr
from rr_actors.managers import Components, LoadComponent, Programs
from rr_actors.managers.components import read_registry
from rr_actors.managers.planning.reliability import FALL, LEAST, RISE_S, Reliabilities
from rr_actors.managers.templates import fill
from support import Calls, child, eventually, kill, messages, states, wait_respawned
from support_programs import running_programs

Start = Callable[..., rr.System]

CODE = "import sys, time; print('ready', sys.argv[1]); time.sleep(600)"


def entry(name: str, type: str = "lidar", reliability: float = 1.0, code: str = CODE) -> str:
    return f'''
[[component]]
name = "{name}"
type = "{type}"
reliability = {reliability}
parameters = {{ topic = "${{place}}/{name}" }}
[component.program]
command = "${{python}}"
arguments = ["-u", "-c", "{code}", "${{topic}}"]
ready = {{ line = "ready", timeout_s = 5 }}
grace_s = 1
'''


@pytest.fixture
def registry(tmp_path: Path) -> Path:
    return tmp_path / "components.toml"


@pytest.fixture
def begin(start: Start, registry: Path) -> Callable[..., tuple[rr.System, rr.Registrar]]:
    """Start a system with these entries in the registry."""

    def begin(*entries: str, **more: object) -> tuple[rr.System, rr.Registrar]:
        registry.write_text("".join(entries))
        system = start(
            rr.ChildSpec(Programs, id="programs"),
            rr.ChildSpec(Components, id="components", kwargs={"registry": str(registry), **more}),
        )
        return system, system.open_registrar("app")

    return begin


Begin = Callable[..., tuple[rr.System, rr.Registrar]]
LIDAR = LoadComponent("lidar", {"place": "roof"})
LOST = rr.Status(rr.State.FATAL, "no scans")


def test_the_most_reliable_component_of_the_type_is_loaded_with_its_parameters_filled(begin: Begin) -> None:
    _, app = begin(entry("old", reliability=0.5), entry("good", reliability=0.9), entry("arm", type="arm"))
    with app.load("components/component", LIDAR) as lidar:
        assert lidar.response.name == "good"
        assert lidar.response.type == "lidar"
        assert lidar.response.parameters["topic"] == "roof/good"
        assert running_programs()[lidar.response.pid]
    assert not running_programs()


def test_components_whose_names_and_instances_have_colons_share_no_program(begin: Begin) -> None:
    program = 'command = "${python}"\narguments = ["-c", "import time; time.sleep(600)"]\ngrace_s = 1\n'
    entry = '[[component]]\nname = "{0}"\ntype = "{0}"\n[component.program]\n'
    _, app = begin(*(entry.format(name) + program for name in ("arm", "arm:left")))
    with (
        app.load("components/component", LoadComponent("arm", instance="left:1")) as one,
        app.load("components/component", LoadComponent("arm:left", instance="1")) as other,
    ):
        assert one.response.pid != other.response.pid
        assert set(running_programs()) == {one.response.pid, other.response.pid}


def test_a_component_that_fails_is_replaced_by_the_next_best_and_its_holders_hear_update(begin: Begin) -> None:
    _, app = begin(entry("good", reliability=0.9), entry("old", reliability=0.8))
    heard = Calls()
    with app.load("components/component", LIDAR, on_status=heard) as lidar:
        first = lidar.response.pid
        os.kill(first, signal.SIGKILL)
        (status,) = heard.wait()
        assert status.state is rr.State.UPDATE
        assert lidar.response.name == "old"
        eventually(lambda: list(running_programs()) == [lidar.response.pid])
    assert len(heard) == 1
    assert not running_programs()


def test_a_component_that_its_holder_calls_lost_is_replaced_and_its_holders_hear_update(begin: Begin) -> None:
    system, app = begin(entry("good", reliability=0.9), entry("old", reliability=0.8))
    heard = Calls()
    with app.load("components/component", LIDAR, on_status=heard) as lidar:
        system.registrar("components").send_status(lidar, LOST)
        (status,) = heard.wait()
        assert (status.state, lidar.response.name) == (rr.State.UPDATE, "old")
        eventually(lambda: list(running_programs()) == [lidar.response.pid])
        assert system.registrar("components").resources()[0].state == "UPDATE"
        with system.open_registrar("other").load("components/component", LIDAR) as same:
            assert same.response == lidar.response
    assert len(heard) == 1
    assert not running_programs()


def test_what_two_holders_call_lost_at_once_is_replaced_once_and_trusted_less_once(begin: Begin) -> None:
    system, app = begin(entry("good"), entry("old", reliability=0.6), entry("oldest", reliability=0.55))
    components, lidar = system.registrar("components"), app.load("components/component", LIDAR)
    with ThreadPoolExecutor() as holders:
        list(holders.map(lambda _: components.send_status(lidar, LOST), range(4)))
    lidar.wait_status(rr.State.UPDATE, timeout_s=10)
    eventually(lambda: list(running_programs()) == [lidar.response.pid])
    assert lidar.response.name == "old"
    kept = json.loads((components.directory / "reliability.json").read_text())["reliability"]
    assert {name: round(value, 2) for name, value in kept.items()} == {"good": 0.5}
    assert lidar.state is rr.State.UPDATE


def test_a_component_whose_program_ends_while_it_is_called_lost_is_replaced_once(begin: Begin) -> None:
    system, app = begin(entry("good"), entry("old", reliability=0.6), entry("oldest", reliability=0.55))
    with app.load("components/component", LIDAR) as lidar:
        os.kill(lidar.response.pid, signal.SIGKILL)
        system.registrar("components").send_status(lidar, LOST)
        lidar.wait_status(rr.State.UPDATE, timeout_s=10)
        eventually(lambda: list(running_programs()) == [lidar.response.pid])
        assert lidar.response.name == "old"


def test_a_component_is_called_lost_and_replaced_whatever_moment_its_manager_is_killed_at(begin: Begin) -> None:
    system, app = begin(entry("good", reliability=0.9), entry("old", reliability=0.8))
    with app.load("components/component", LIDAR) as lidar:
        for _ in range(3):
            before, manager = lidar.response.pid, child(system, "components").pid
            assert manager is not None
            system.registrar("components").send_status(lidar, LOST)
            kill(system, "components")
            wait_respawned(system, "components", manager)
            eventually(lambda: list(running_programs()) == [lidar.response.pid] != [before])  # noqa: B023
            assert lidar.state is rr.State.UPDATE


def test_the_only_component_of_a_type_is_started_anew_when_it_is_called_lost(begin: Begin) -> None:
    system, app = begin(entry("driver", type="driver"))
    with app.load("components/component", LoadComponent("driver", {"place": "base"})) as driver:
        for _ in range(3):
            pid = driver.response.pid
            system.registrar("components").send_status(driver, LOST)
            driver.wait_status(rr.State.UPDATE, timeout_s=10)
            assert driver.response.pid != pid
            eventually(lambda: list(running_programs()) == [driver.response.pid])


@pytest.mark.parametrize("replace", [True, False])
def test_when_what_is_called_lost_cannot_be_replaced_its_holders_hear_that(
    begin: Begin, tmp_path: Path, replace: bool
) -> None:
    code = f"import time; open('{tmp_path / 'once'}', 'x').close(); print('ready'); time.sleep(600)"
    system, app = begin(entry("fragile", code=code), replace=replace)
    with app.load("components/component", LIDAR) as lidar:
        system.registrar("components").send_status(lidar, LOST)
        assert lidar.wait_status(rr.State.FATAL, timeout_s=10).message == "no scans"
        assert system.registrar("components").resources()[0].state == "FATAL"


def test_the_only_component_of_a_type_takes_its_own_place(begin: Begin) -> None:
    _, app = begin(entry("driver", type="driver"))
    with app.load("components/component", LoadComponent("driver", {"place": "base"})) as driver:
        for _ in range(3):
            pid = driver.response.pid
            os.kill(pid, signal.SIGKILL)
            driver.wait_status(rr.State.UPDATE, timeout_s=10)
            assert driver.response.name == "driver"
            assert driver.response.pid != pid


def test_a_component_that_cannot_be_loaded_is_trusted_less_and_the_next_is_taken(begin: Begin, registry: Path) -> None:
    broken = entry("broken", reliability=0.9, code="raise SystemExit(5)")
    _, app = begin(broken, entry("old", reliability=0.3))
    with app.load("components/component", LIDAR) as lidar:
        assert lidar.response.name == "old"


def test_when_no_component_can_be_loaded_the_error_says_why_for_each(begin: Begin) -> None:
    _, app = begin(entry("a", code="raise SystemExit(5)"), entry("b", code="raise SystemExit(6)"))
    with pytest.raises(rr.LoadFailed, match=r"(?s)no component of type 'lidar'.*a: .*code 5.*b: .*code 6"):
        app.load("components/component", LIDAR)


def test_an_unknown_type_is_an_error_that_names_the_known_ones(begin: Begin) -> None:
    _, app = begin(entry("a"), entry("b", type="arm"))
    with pytest.raises(rr.LoadFailed, match=r"no component of type 'sonar'.*expected one of arm, lidar"):
        app.load("components/component", LoadComponent("sonar"))


def test_a_missing_parameter_is_an_error_that_names_it(begin: Begin) -> None:
    _, app = begin(entry("a"))
    with pytest.raises(rr.LoadFailed, match=r"component 'a': parameters.topic.*\$\{place\}"):
        app.load("components/component", LoadComponent("lidar"))


def test_a_default_stands_for_a_parameter_that_is_not_given(begin: Begin) -> None:
    _, app = begin(entry("a").replace("[component.program]", 'defaults = { place = "roof" }\n[component.program]'))
    with (
        app.load("components/component", LoadComponent("lidar")) as one,
        app.load("components/component", LoadComponent("lidar", {"place": "mast"})) as other,
    ):
        assert [query.response.parameters["topic"] for query in (one, other)] == ["roof/a", "mast/a"]


def test_when_nothing_can_take_its_place_the_holders_hear_fatal(begin: Begin, tmp_path: Path) -> None:
    once = tmp_path / "once"
    code = f"import os, time; open('{once}', 'x').close(); print('ready'); time.sleep(600)"
    _, app = begin(entry("fragile", code=code))
    with app.load("components/component", LIDAR) as lidar:
        os.kill(lidar.response.pid, signal.SIGKILL)
        assert "SIGKILL" in lidar.wait_status(timeout_s=10).message
        assert lidar.state is rr.State.FATAL


def test_without_replacement_the_holders_hear_fatal_at_once(begin: Begin) -> None:
    _, app = begin(entry("good", reliability=0.9), entry("old", reliability=0.8), replace=False)
    with app.load("components/component", LIDAR) as lidar:
        os.kill(lidar.response.pid, signal.SIGKILL)
        assert lidar.wait_status(timeout_s=10).state is rr.State.FATAL


def test_lost_trust_survives_the_managers_crash(begin: Begin) -> None:
    system, app = begin(entry("good", reliability=0.9), entry("old", reliability=0.8))
    with app.load("components/component", LIDAR) as lidar:
        os.kill(lidar.response.pid, signal.SIGKILL)
        lidar.wait_status(rr.State.UPDATE, timeout_s=10)
    pid = kill(system, "components")
    wait_respawned(system, "components", pid)
    with app.load("components/component", LIDAR) as lidar:
        assert lidar.response.name == "old"


def test_a_component_is_replaced_whatever_moment_its_manager_is_killed_at(begin: Begin) -> None:
    system, app = begin(entry("good", reliability=0.9), entry("old", reliability=0.8))
    with app.load("components/component", LIDAR) as lidar:
        for _ in range(3):
            before, manager = lidar.response.pid, child(system, "components").pid
            assert manager is not None
            os.kill(before, signal.SIGKILL)
            kill(system, "components")
            wait_respawned(system, "components", manager)
            eventually(lambda: list(running_programs()) == [lidar.response.pid] != [before])  # noqa: B023
            assert lidar.state is rr.State.UPDATE


def test_the_program_managers_crash_is_not_held_against_a_component(begin: Begin) -> None:
    system, app = begin(entry("good", reliability=0.9), entry("old", reliability=0.8))
    kill(system, "programs")
    with app.load("components/component", LIDAR) as lidar:
        assert lidar.response.name == "good"


# -- a component that is silent ------------------------------------------------------------------------------------

HEALTH = """[component.health]
socket = "${place}/checked"
every_s = 0.05
timeout_s = 30.0
fail_after = 2
"""


@pytest.fixture
def served(tmp_path: Path) -> Iterator[Callable[[], None]]:
    """A socket that accepts the connections of all checks, until this is called, and again after a second call."""
    path, listeners = str(tmp_path / "checked"), list[socket.socket]()

    def accept(listener: socket.socket) -> None:
        with contextlib.suppress(OSError):
            while True:
                listener.accept()[0].close()

    def toggle() -> None:
        if listeners:
            with contextlib.suppress(OSError):
                listeners[0].shutdown(socket.SHUT_RDWR)
            listeners.pop().close()
            os.unlink(path)
            return
        listeners.append(socket.socket(socket.AF_UNIX))
        listeners[0].bind(path)
        listeners[0].listen()
        threading.Thread(target=accept, args=listeners, daemon=True).start()

    toggle()
    yield toggle
    if listeners:
        toggle()


def test_a_component_that_is_silent_is_replaced_lowered_once_and_its_holders_hear_warning_then_update(
    begin: Begin, tmp_path: Path, served: Callable[[], None]
) -> None:
    system, app = begin(entry("good", reliability=0.9) + HEALTH, entry("old", reliability=0.8))
    heard = Calls()
    with app.load("components/component", LoadComponent("lidar", {"place": str(tmp_path)}), on_status=heard) as lidar:
        assert lidar.response.name == "good"
        served()
        eventually(lambda: rr.State.UPDATE in states(heard))
        assert states(heard)[0] is rr.State.WARNING
        assert messages(heard)[0].startswith(f"health: socket {tmp_path}/checked: ")
        assert (lidar.response.name, list(running_programs())) == ("old", [lidar.response.pid])
        kept = json.loads((system.registrar("components").directory / "reliability.json").read_text())["reliability"]
        assert kept == {"good": pytest.approx(0.45)}


@pytest.mark.parametrize("how", ["silent", "called lost"])
def test_the_only_component_of_a_type_is_started_anew_when_its_predecessor_has_ended(
    begin: Begin, tmp_path: Path, served: Callable[[], None], how: str
) -> None:
    """It takes a device for itself: a second one cannot start beside it."""
    device = tmp_path / "device"
    code = f"import fcntl, time; file = open('{device}', 'w'); fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)"
    system, app = begin(entry("driver", type="driver", code=f"{code}; print('ready'); time.sleep(600)") + HEALTH)
    with app.load("components/component", LoadComponent("driver", {"place": str(tmp_path)})) as driver:
        pid = driver.response.pid
        if how == "silent":
            served()
            eventually(lambda: system.registrar("programs").resources()[0].state == "FATAL")
            served()
        else:
            system.registrar("components").send_status(driver, LOST)
        eventually(lambda: driver.response.pid != pid)
        assert list(running_programs()) == [driver.response.pid]


def test_the_holders_of_a_component_that_is_called_lost_hear_warning_while_its_program_takes_long_to_end(
    begin: Begin,
) -> None:
    code = "import signal, time; signal.signal(15, signal.SIG_IGN); print('ready'); time.sleep(600)"
    system, app = begin(entry("good", code=code).replace("grace_s = 1", "grace_s = 3"), entry("old", reliability=0.4))
    heard = Calls()
    with app.load("components/component", LIDAR, on_status=heard) as lidar:
        system.registrar("components").send_status(lidar, LOST)
        eventually(lambda: rr.State.UPDATE in states(heard), 20)
        assert states(heard)[0] is rr.State.WARNING
        assert "no scans" in messages(heard)[0]
        eventually(lambda: list(running_programs()) == [lidar.response.pid])


# -- the registry's file -------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("text", "key", "says"),
    [
        ("[[component]\n", None, "not valid TOML"),
        ("components = []\n", "components", "an unknown key; did you mean 'component'?"),
        ("[[component]]\nname = 'a'\n", "component[0]", "type"),
        (entry("a").replace("1.0", "'high'"), "component[0].reliability", "expected `float`, got 'high' (str)"),
        (entry("a").replace("1.0", "1.5"), "component[0].reliability", "<= 1"),
        (entry("a").replace("1.0", "nan"), "component[0].reliability", ">= 0.0, got nan"),
        (entry("a").replace("grace_s", "grace"), "component[0].program.grace", "did you mean 'grace_s'?"),
        (entry("a").replace("timeout_s", "timeout"), "component[0].program.ready.timeout", "did you mean 'timeout_s'?"),
        ("[robot]\n", "robot", "expected one of component, got an unknown key"),
        (entry("a").replace("5 }", "'5' }"), "component[0].program.ready.timeout_s", "got '5' (str)"),
        (entry("a").replace("topic =", "topic = [], to ="), "component[0].parameters.topic", "got [] (list)"),
        (entry("a") + entry("a"), "component[1].name", "'a' again"),
        (entry("a") + HEALTH.replace("every", "evry"), "component[0].health.evry_s", "did you mean 'every_s'?"),
        (entry("a") + HEALTH.replace("0.05", "0"), "component[0].health.every_s", "a number from 0.01 to 86400, got 0"),
        (entry("a") + HEALTH.replace("2", "'2'"), "component[0].health.fail_after", "got '2' (str)"),
        (
            entry("a") + "[component.health]\n",
            "component[0].health.line_every_s",
            "expected this, port, socket or probe",
        ),
        (entry("a") + HEALTH.replace("${p", "$ {p"), "component[0].health.socket", "follows each dollar sign"),
        (
            entry("a") + HEALTH.replace("component.", "component.program."),
            "component[0].program.health",
            "none here, but",
        ),
        (entry("a") + HEALTH.replace("health", "helth"), "component[0].helth", "did you mean 'health'?"),
    ],
)
def test_a_wrong_registry_is_an_error_with_file_and_key(registry: Path, text: str, key: str | None, says: str) -> None:
    registry.write_text(text)
    with pytest.raises(rr.ConfigError) as caught:
        read_registry(registry)
    assert says in str(caught.value)
    assert str(registry) in str(caught.value)
    assert caught.value.details.get("key") == key
    assert caught.value.details["file"] == str(registry)


def test_a_registry_that_is_not_there_is_an_error_with_its_path(registry: Path) -> None:
    with pytest.raises(rr.ConfigError, match="cannot be read: No such file"):
        read_registry(registry)


def test_a_manager_with_a_wrong_registry_does_not_start(start: Start, registry: Path) -> None:
    with pytest.raises(rr.StartFailed, match="cannot be read"):
        start(rr.ChildSpec(Components, id="components", kwargs={"registry": str(registry)}))


def test_templates_are_filled_and_dollars_kept() -> None:
    assert fill("${a}/$$x/${b}", {"a": 1, "b": True}, "here") == "1/$x/true"
    with pytest.raises(rr.ConfigError, match=r"here: expected \$\{name\} or \$\$"):
        fill("$", {}, "here")


def test_a_failure_counts_once_and_is_kept_on_disk(tmp_path: Path) -> None:
    path = tmp_path / "deep" / "reliability.json"
    reliabilities = Reliabilities(path)
    assert reliabilities.of("a", 0.8) == 0.8
    reliabilities.lower("a", 0.8, "failure-1")
    reliabilities.lower("a", 0.8, "failure-1")
    assert Reliabilities(path).of("a", 0.8) == pytest.approx(0.8 * FALL)
    Reliabilities(path).lower("a", 0.8, "failure-2")
    assert Reliabilities(path).of("a", 0.8) == pytest.approx(0.8 * FALL * FALL)


def test_reliability_rises_with_the_hours_without_a_failure_and_never_falls_out_of_sight(tmp_path: Path) -> None:
    path, now = tmp_path / "reliability.json", [1_000_000.0]

    def trust(name: str = "a") -> float:
        return Reliabilities(path, lambda: now[0]).of(name, 0.8)

    for i in range(100):
        Reliabilities(path, lambda: now[0]).lower("a", 0.8, f"failure-{i}")
    assert trust() == pytest.approx(0.8 * LEAST)
    now[0] += RISE_S - 1
    assert trust() == pytest.approx(0.8 * LEAST)
    now[0] += 1
    assert trust() == pytest.approx(0.8 * LEAST / FALL)
    now[0] -= 5 * RISE_S  # the clock is set back
    assert trust() == pytest.approx(0.8 * LEAST)
    now[0] += 20 * RISE_S
    assert trust() == 0.8
    Reliabilities(path, lambda: now[0]).lower("a", 0.8, "later")
    assert trust() == pytest.approx(0.8 * FALL)


@pytest.mark.parametrize(
    "content",
    [b"{", b'{"reliability": {"\xff": 1}}', b'{"x":' + b"[" * 100_000, b'{"reliability": {"a": -5}}'],
    ids=["not JSON", "not UTF-8", "nested deeply", "less than none"],
)
def test_a_damaged_file_of_failures_is_begun_anew(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "reliability.json"
    path.write_bytes(content)
    assert Reliabilities(path).of("a", 0.8) == 0.8
    Reliabilities(path).lower("a", 0.8, "failure-1")
    assert Reliabilities(path).of("a", 0.8) == pytest.approx(0.8 * FALL)
