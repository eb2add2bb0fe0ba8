"""What it costs to be watched: `python -m benchmarks.watching [--managers 20] [--resources 20000] [--events 1000]`.

A system of many managers and resources, with so many statuses a second, is measured in turns without a web page, and
with one that three browsers show: one of them on a processor that is 20 times slower. Then managers are killed, and
the page's own clock, which is this machine's, says when it showed that. It needs Chromium (RR_CHROMIUM) and Playwright.
"""

from __future__ import annotations

import argparse
import os
import shutil
import signal
import statistics
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager

import psutil
from playwright.sync_api import Browser, Page, sync_playwright

import rr_actors as rr
from benchmarks.measure import time_each
from benchmarks.table import Row, text
from benchmarks.workload import Answer, Ask

_PAINT_S, _KILL_S = 2.0, 0.3
_CPU_PERCENT, _MORE_MIB = 10.0, 50.0
_DISTURBED = 1.05
_SLOWER = 20  # times, of the slow browser's processor
_SETTLE_S = 3.0
_HAS_LANES = "() => document.querySelector('.rr-lanes')"
_HAS_ROWS = "() => document.querySelector('.ag-row')"
_PATIENCE_MS = 60_000
_AT_ONCE = 500

# Notes when the tree shows that a child does not run, or was restarted, by its path.
_NOTE_KILLS = """() => {
  const note = () => {
    for (const one of document.querySelectorAll('[data-path]'))
      if (!one.textContent.includes('running') || one.textContent.includes('↻'))
        window.seen[one.dataset.path] ??= Date.now() / 1000;
  };
  window.seen = {};
  window.noting?.disconnect();
  window.noting = new MutationObserver(note);
  window.noting.observe(document.querySelector('.rr-tree'), { subtree: true, childList: true, characterData: true });
}"""


class Busy(rr.Manager):
    """Echoes as Echo does, and has a resource with statuses all the time. No resource needs its process."""

    @rr.server("echo", recovery="keep")
    def load_echo(self, request: Ask) -> Answer:
        return Answer(request.payload)

    @rr.server("pulse")
    def load_pulse(self, a_second: float) -> None:
        resource, self.stopping = rr.current().resource_id, threading.Event()

        def beat() -> None:
            number = 0
            while not self.stopping.wait(1 / a_second):
                number += 1
                self.registrar.send_status(resource, rr.Status("WARNING" if number % 2 else "OK", f"beat {number}"))

        self.beating = threading.Thread(target=beat, name="pulse", daemon=True)
        self.beating.start()

    @load_pulse.recover
    def recover_pulse(self, a_second: float, response: None) -> None:
        self.load_pulse(a_second)

    @load_pulse.unload
    def unload_pulse(self, a_second: float, response: None) -> None:
        self.stopping.set()
        self.beating.join()


@contextmanager
def _system(managers: int) -> Iterator[tuple[rr.System, rr.Registrar]]:
    specs = [rr.ChildSpec(Busy, id=f"m{number}", shutdown_s="brutal_kill") for number in range(managers)]
    with (
        tempfile.TemporaryDirectory(prefix="rr-bench-") as state_dir,
        rr.System(rr.Supervisor(specs, max_restarts=1_000), name="bench", state_dir=state_dir) as system,
    ):
        app = system.open_registrar("app")
        yield system, app


def _fill(app: rr.Registrar, managers: int, resources: int, events: float) -> None:
    for number in range(managers):
        wanted = [(f"m{number}/echo", Ask(one)) for one in range(resources // managers)]
        for first in range(0, len(wanted), _AT_ONCE):
            app.load_all(wanted[first : first + _AT_ONCE], timeout_s=120)
        app.load(f"m{number}/pulse", events / managers)


class _Costs:
    """What the processes of a system use, in turns with and without a page."""

    def __init__(self, app: rr.Registrar, loads: int, seconds: float) -> None:
        self._app, self._loads, self._seconds = app, loads, seconds
        self.cpu_percent: list[float] = []
        self.mib: list[float] = []
        self.load_s: list[float] = []

    def measure(self, processes: Sequence[psutil.Process]) -> None:
        """Measure once: for some seconds CPU alone, then loads of a resource that is held already."""
        before, began = sum(map(_cpu_s, processes)), time.monotonic()
        time.sleep(self._seconds)
        used_s = sum(map(_cpu_s, processes)) - before
        self.cpu_percent.append(100 * used_s / (time.monotonic() - began))
        self.mib.append(sum(process.memory_info().rss for process in processes) / 2**20)
        self.load_s += time_each(lambda: self._app.load("m0/echo", Ask(0)).unload(), self._loads)


def _cpu_s(process: psutil.Process) -> float:
    times = process.cpu_times()
    return times.user + times.system


def _painted(page: Page, path: str, *are_there: str) -> Iterator[float]:
    """Yield how many seconds a page takes from its address to each of the things that it shows."""
    began = time.monotonic()
    page.goto(path)
    for is_there in are_there:
        page.wait_for_function(is_there, timeout=_PATIENCE_MS, polling=20)
        yield time.monotonic() - began


def _shown_after(page: Page, pid_of: Callable[[str], int], id: str) -> float:
    calm = f"() => /running/.test(document.querySelector('[data-path=\"root/{id}\"]').innerText)"
    page.wait_for_function(calm, timeout=_PATIENCE_MS)
    page.evaluate(_NOTE_KILLS)
    at = time.time()
    os.kill(pid_of(id), signal.SIGKILL)
    seen = page.wait_for_function(f"() => window.seen['root/{id}']", timeout=_PATIENCE_MS).json_value()
    return seen - at


def watching(browser: Browser, managers: int, resources: int, events: int, turns: int, seconds: float) -> list[Row]:
    """Measure all; return the figures, each with its aim."""
    # Playwright has an event loop in this thread, and a load must not block one.
    with _system(managers) as (system, app), ThreadPoolExecutor(1) as thread:
        thread.submit(_fill, app, managers, resources, events).result()
        own = [psutil.Process(), *psutil.Process().children(recursive=True)]
        drivers = {one.pid for one in own} - set(_pids(system).values()) - {os.getpid()}
        own = [one for one in own if one.pid not in drivers]
        without, watched = _Costs(app, 2_000, seconds), _Costs(app, 2_000, seconds)
        paints: dict[str, list[float]] = {"overview": [], "tree": [], "resources": [], "rows of the table": []}
        server: list[float] = []
        late: list[float] = []
        for turn in range(turns):
            thread.submit(without.measure, own).result()
            with system.serve_web() as served, ExitStack() as open_pages:
                pages = [browser.new_context() for _ in range(3)]
                for context in pages:
                    open_pages.callback(context.close)
                first, other, slow = (context.new_page() for context in pages)
                address = served.url.partition("?")[0]
                for page in (first, other, slow):
                    page.goto(served.url)
                    page.wait_for_url(lambda url: "token=" not in url)
                nodes = f"() => document.querySelectorAll('[data-path]').length > {managers}"
                paints["overview"] += _painted(first, address, _HAS_LANES)
                paints["tree"] += _painted(first, f"{address}tree", nodes)
                drawn = f"() => document.body.innerText.includes('{resources + managers:,} resources')"  # the counts
                counts_s, rows_s = _painted(other, f"{address}resources", drawn, _HAS_ROWS)
                paints["resources"].append(counts_s)
                paints["rows of the table"].append(rows_s)
                slow.context.new_cdp_session(slow).send("Emulation.setCPUThrottlingRate", {"rate": _SLOWER})
                time.sleep(_SETTLE_S)
                program = psutil.Process(_child_of(own[0], {one.pid for one in own} | drivers))
                before, began = _cpu_s(program), time.monotonic()
                thread.submit(watched.measure, own).result()
                server.append(100 * (_cpu_s(program) - before) / (time.monotonic() - began))
                if turn == turns - 1:
                    pids = _pids(system)
                    late = [_shown_after(first, pids.__getitem__, f"m{one}") for one in range(1, min(6, managers))]
    more = statistics.median(watched.cpu_percent) - statistics.median(without.cpu_percent)
    mib = statistics.median(watched.mib) - statistics.median(without.mib)
    alone, beside = statistics.median(without.load_s), statistics.median(watched.load_s)
    return [
        *(Row(f"paint: {name}", statistics.median(took), "s", at_most=_PAINT_S) for name, took in paints.items()),
        Row("CPU of the system, more with the page", more, "% of a core", at_most=_CPU_PERCENT),
        Row("memory of the system, more with the page", mib, "MiB", at_most=_MORE_MIB),
        Row("CPU of the page's server", statistics.median(server), "% of a core"),
        Row("a kill is shown after", statistics.median(late), "s", p99=max(late), at_most=_KILL_S),
        Row("load and unload, without a page", alone * 1e6, "us"),
        Row(
            "load and unload, with three browsers", beside * 1e6, "us", ratio=beside / alone,
            against="without a page", at_most=_DISTURBED,
        ),
    ]  # fmt: skip


def _pids(system: rr.System) -> dict[str, int]:
    """Return the processes of the managers, by their ids."""
    return {child.id: child.pid for child in system.supervisor().which_children() if child.pid is not None}


def _child_of(parent: psutil.Process, known: set[int]) -> int:
    """Return the newest child of a process that is not known: the page's server."""
    return max((one for one in parent.children() if one.pid not in known), key=lambda one: one.create_time()).pid


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(prog="benchmarks.watching", description="What it costs a system to be watched.")
    parser.add_argument("--managers", type=int, default=20)
    parser.add_argument("--resources", type=int, default=20_000)
    parser.add_argument("--events", type=int, default=1_000, help="statuses a second")
    parser.add_argument("--turns", type=int, default=3)
    parser.add_argument("--seconds", type=float, default=8.0, help="of each turn")
    wanted = parser.parse_args()
    path = os.environ.get("RR_CHROMIUM") or shutil.which("chromium")
    if path is None:
        parser.error("expected Debian's chromium, or RR_CHROMIUM=/path/to/chromium, got neither")
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=path, args=["--no-sandbox"])
        sizes = wanted.managers, wanted.resources, wanted.events
        print(text(watching(browser, *sizes, wanted.turns, wanted.seconds)))
        browser.close()


if __name__ == "__main__":
    main()
