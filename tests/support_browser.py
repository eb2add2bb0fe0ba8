"""A browser for tests of web pages: Debian's Chromium, driven by Playwright from a thread of its own.

One browser serves all tests of a process. A new tab takes it half a second of a processor, so a test has one that an
earlier test has left, without what that has stored there. Two tabs of a test are the browsers of two persons. What a
page asks of any other machine is noted, and fails the test.
"""

from __future__ import annotations

import asyncio
import os
import shutil
import subprocess
import sys
import threading
from collections.abc import Callable, Coroutine, Iterator
from contextlib import contextmanager
from typing import Any, TypeVar
from urllib.parse import urlsplit

import psutil
import pytest
from playwright.async_api import (
    Browser,
    ConsoleMessage,
    Error,
    Locator,
    Page,
    Playwright,
    Request,
    WebSocket,
    async_playwright,
)

from rr_actors.system import web_process
from support import BROWSERS, LIMIT_S, REPOSITORY, eventually, wait_gone

T = TypeVar("T")

CHROMIUM = os.environ.get("RR_CHROMIUM") or shutil.which("chromium")
"""The browser. RR_CHROMIUM names it where the tests have to run, as in .ci/run."""

needs_chromium = pytest.mark.skipif(
    CHROMIUM is None, reason="needs Debian's Chromium: apt-get install chromium, or RR_CHROMIUM=/path/to/chromium"
)
LAB = REPOSITORY / "examples" / "lab"
PATIENCE_S = 30.0
"""How long somebody waits for what a page shows: it has come through four processes of a machine that may be busy."""
_ARGUMENTS = (
    "--no-sandbox",  # root has none
    "--host-resolver-rules=MAP * ~NOTFOUND, EXCLUDE 127.0.0.1, EXCLUDE localhost",
    "--disable-features=SpareRendererForSitePerProcess",
    "--renderer-process-limit=1",  # all tabs in one process, which a tab that stays open keeps: each test leaves none
    "--disable-site-isolation-trials",
)


class Chromium:
    """A browser, from open() to close(), and the loop that Playwright needs."""

    def __init__(self) -> None:
        self._loop = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self._loop.run_forever, name="playwright")
        self._playwright: Playwright | None = None
        self._browser: Browser | None = None
        self._pids: set[int] = set()
        self._free: list[Page] = []

    def open(self) -> None:
        self._thread.start()
        self.do(self._open())

    async def _open(self) -> None:
        before = {process.pid for process in psutil.Process().children()}
        self._playwright = await async_playwright().start()
        launch = self._playwright.chromium.launch
        self._browser = await launch(executable_path=CHROMIUM, args=list(_ARGUMENTS))
        await self._browser.new_page()
        drivers = {process.pid for process in psutil.Process().children()}
        self._pids = drivers - before
        BROWSERS.update(self._pids)

    def close(self) -> None:
        self.do(self._close())
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join()
        self._loop.close()
        wait_gone(*self._pids)
        BROWSERS.difference_update(self._pids)

    async def _close(self) -> None:
        if self._browser is not None:
            await self._browser.close()
        if self._playwright is not None:
            await self._playwright.stop()

    def do(self, doing: Coroutine[Any, Any, T]) -> T:
        return asyncio.run_coroutine_threadsafe(doing, self._loop).result(60)

    @contextmanager
    def tab(self, width: int = 1280, height: int = 800) -> Iterator[Tab]:
        """A tab in a browser of its own, which shows no page yet."""
        page = self._free.pop() if self._free else self.do(self._page())
        try:
            tab = self.do(self._tab(page, width, height))
            yield tab
            self.do(tab.leave())
        except BaseException:
            self.do(page.context.close())  # nobody knows what it shows
            raise
        self._free.append(page)
        assert tab.outside == []
        assert tab.errors == [], tab.errors

    async def _page(self) -> Page:
        assert self._browser is not None
        return await (await self._browser.new_context()).new_page()

    async def _tab(self, page: Page, width: int, height: int) -> Tab:
        """On the loop, as a part of what Playwright calls directly needs one."""
        await page.set_viewport_size({"width": width, "height": height})
        return Tab(self, page)


class Tab:
    """What somebody sees and does on a page. Each step waits until it can be done, for as long as tests wait.

    Attributes:
        asked: the addresses that the page has asked for.
        outside: those of other machines.
        errors: what the page's scripts have complained of.
        expected: what a test makes them complain of, a part of the text. The complaint may come late: after the page
            shows what the test waits for.
    """

    def __init__(self, chromium: Chromium, page: Page) -> None:
        self.page = page
        self.context = page.context
        self.asked: list[str] = []
        self.outside: list[str] = []
        self.errors: list[str] = []
        self.expected: tuple[str, ...] = ("net::ERR_", "WebSocket")
        self._chromium = chromium
        page.set_default_timeout(PATIENCE_S * 1000)
        self.context.on("request", self._request)
        page.on("websocket", self._socket)
        page.on("pageerror", self._error)
        page.on("console", self._complaint)

    async def leave(self) -> None:
        """Leave the page, and take away what it has stored and what the test has set: the next test has the tab."""
        await self.page.unroute_all()
        await self.page.goto("about:blank")
        await self.page.emulate_media(color_scheme="light")
        await self.context.clear_permissions()
        await self.context.clear_cookies()
        stores = await self.context.new_cdp_session(self.page)
        places = [parts for parts in map(urlsplit, self.asked) if parts.scheme in ("http", "file")]
        for origin in {f"{parts.scheme}://{parts.netloc}" for parts in places}:
            await stores.send("Storage.clearDataForOrigin", {"origin": origin, "storageTypes": "all"})
        await stores.detach()
        self.context.remove_listener("request", self._request)
        self.page.remove_listener("websocket", self._socket)
        self.page.remove_listener("pageerror", self._error)
        self.page.remove_listener("console", self._complaint)

    def _request(self, request: Request) -> None:
        self._note(request.url)

    def _socket(self, socket: WebSocket) -> None:
        self._note(socket.url)

    def _error(self, error: Error) -> None:
        self.errors.append(str(error))

    def _note(self, url: str) -> None:
        self.asked.append(url)
        parts = urlsplit(url)
        if parts.scheme not in ("data", "blob", "file") and parts.hostname not in ("127.0.0.1", "localhost"):
            self.outside.append(url)

    def _complaint(self, message: ConsoleMessage) -> None:
        if message.type == "error" and not any(part in message.text for part in self.expected):
            self.errors.append(message.text)

    def do(self, doing: Coroutine[Any, Any, T]) -> T:
        """Do something with `page`, and return when it is done."""
        return self._chromium.do(doing)

    def goes_to(self, url: str, path: str = "") -> None:
        """Open the address that was printed, or another page of its server."""
        address, _, token = url.partition("?")
        self.do(self.page.goto(f"{address}{path}{'&' if '?' in path else '?'}{token}" if path else url))
        self.do(self.page.wait_for_url(lambda now: "token=" not in now))

    def clicks(self, name: str, role: Any = "button") -> None:
        self.do(self.page.get_by_role(role, name=name, exact=True).first.click())

    def presses(self, *keys: str) -> None:
        for key in keys:
            self.do(self.page.keyboard.press(key))

    def text(self, selector: str) -> str:
        return self.do(self.page.locator(selector).first.inner_text())

    def locate(self, selector: str) -> Locator:
        return self.page.locator(selector)

    def sees(self, selector: str, *words: str, limit_s: float = PATIENCE_S) -> str:
        """Return the text at a place on the page once it has all these words in it."""
        last = ""

        def found() -> bool:
            nonlocal last
            last = "\n".join(self.do(self.page.locator(selector).all_inner_texts()))  # of what is visible
            return bool(last) and all(word in last for word in words)

        try:
            eventually(found, limit_s)
        except AssertionError:
            pytest.fail(f"not seen at {selector}: {words}; but {last!r}")
        return last

    def waits(self, condition: Callable[[], object], what: str) -> None:
        eventually(condition, PATIENCE_S, what)


@contextmanager
def web(*arguments: object) -> Iterator[str]:
    """The address of `rr-actors web` with these arguments, which runs in this block, and begins as a system's page."""
    command = [sys.executable, "-m", "rr_actors", "web", *map(str, arguments)]
    with web_process.subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as program:
        assert program.stdout is not None
        try:
            yield program.stdout.readline().strip()
        finally:
            program.terminate()
            assert program.wait(LIMIT_S) == 0
