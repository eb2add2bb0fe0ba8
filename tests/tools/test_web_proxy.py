"""The web page behind a proxy with a path, as notebook servers have it: all that it asks for has the prefix."""

from __future__ import annotations

import re
import socket
import threading
import urllib.error
import urllib.request
from collections.abc import Callable, Iterator
from typing import Any
from urllib.parse import urlsplit

import pytest

import rr_actors as rr
from support import Workshop, eventually, pid_of
from support_browser import LAB, Tab, needs_chromium, web
from support_managers import Order, Shop

pytestmark = pytest.mark.timeout(120)

Start = Callable[..., rr.System]
PREFIX = "/user/me/proxy/7"


class Proxy:
    """A small reverse proxy at PREFIX of localhost, from open() to close().

    Attributes:
        to: the port of the server that it leads to.
        strayed: the paths outside of PREFIX that were asked for.
    """

    def __init__(self, *, strips: bool, host: str) -> None:
        self.strayed: list[str] = []
        with socket.create_server(("127.0.0.1", 0)) as free:
            self.to: int = free.getsockname()[1]
        self._strips, self._host = strips, host
        self._sockets: list[socket.socket] = []
        self._threads: list[threading.Thread] = []
        self._listening = socket.create_server(("127.0.0.1", 0))
        self.port = self._listening.getsockname()[1]
        self._in_thread(self._accept)

    def _in_thread(self, do: Callable[..., None], *args: object) -> None:
        thread = threading.Thread(target=do, args=args)
        self._threads.append(thread)
        thread.start()

    def close(self) -> None:
        for one in [self._listening, *self._sockets]:
            try:
                one.shutdown(socket.SHUT_RDWR)
            except OSError:
                pass
            one.close()
        for thread in self._threads:
            thread.join()

    def _accept(self) -> None:
        while True:
            try:
                client, _ = self._listening.accept()
            except OSError:
                return
            self._sockets.append(client)
            self._in_thread(self._serve, client)

    def _serve(self, client: socket.socket) -> None:
        try:
            self._pass_on(client)
        except OSError:
            pass
        finally:
            client.close()

    def _pass_on(self, client: socket.socket) -> None:
        got = b""
        while b"\r\n\r\n" not in got:
            if not (data := client.recv(65_536)):
                return
            got += data
        head, _, body = got.partition(b"\r\n\r\n")
        first, *lines = head.decode("latin-1").split("\r\n")
        method, path, version = first.split(" ")
        if not path.startswith(f"{PREFIX}/"):
            self.strayed.append(path)
            client.sendall(b"HTTP/1.1 404 Not Found\r\nContent-Length: 0\r\nConnection: close\r\n\r\n")
            return
        path = path.removeprefix(PREFIX) if self._strips else path
        is_upgrade = any(line.lower().startswith("upgrade:") for line in lines)
        kept = [line for line in lines if not re.match("host:" if is_upgrade else "host:|connection:", line.lower())]
        more = [f"Host: {self._host}", *([] if is_upgrade else ["Connection: close"])]
        with socket.create_connection(("127.0.0.1", self.to)) as server:
            self._sockets.append(server)
            server.sendall("\r\n".join([f"{method} {path} {version}", *kept, *more, "", ""]).encode("latin-1") + body)
            there = threading.Thread(target=_pour, args=(client, server))
            there.start()
            _pour(server, client)
            there.join()


def _pour(source: socket.socket, target: socket.socket) -> None:
    try:
        while data := source.recv(65_536):
            target.sendall(data)
    except OSError:
        pass
    for one in (source, target):
        try:
            one.shutdown(socket.SHUT_RDWR)
        except OSError:
            pass


@pytest.fixture(params=[(True, "127.0.0.1:1"), (False, "hub.example.org")], ids=["strips", "keeps"])
def proxy(request: pytest.FixtureRequest) -> Iterator[Proxy]:
    strips, host = request.param
    proxy = Proxy(strips=strips, host=host)
    yield proxy
    proxy.close()


@needs_chromium
def test_each_page_works_behind_a_proxy_with_a_path(start: Start, workshop: Workshop, proxy: Proxy, tab: Tab) -> None:
    shop = start(rr.ChildSpec(Shop, id="shop", args=(str(workshop.root),)))
    app = shop.open_registrar("app")
    hosts = [f"localhost:{proxy.port}", "hub.example.org"]
    with shop.serve_web(port=proxy.to, prefix=PREFIX, hosts=hosts) as page, app.load("shop/thing", Order("tea")):
        assert page.url.startswith(f"http://localhost:{proxy.port}{PREFIX}/?token=")
        tab.goes_to(page.url)
        tab.sees(".rr-main", "All is well", "shop")
        for name, place, shown in (
            ("Resources", ".ag-center-cols-container", "tea"),  # by its fetch
            ("Loads", "body", "shop/thing"),
            ("Figures", "body", "shop"),
            ("Timeline", "body", "shop"),
            ("Tree", '[data-path="root/shop"]', f"{pid_of(shop, 'shop')}"),  # by its websocket
            ("Overview", ".rr-main", "All is well"),
        ):
            tab.clicks(name, "link")
            tab.sees(place, shown)
            path = "/" if name == "Overview" else f"/{name.lower()}"
            assert urlsplit(tab.page.url).path == PREFIX + path
    assert proxy.strayed == []
    assert {urlsplit(url).netloc for url in tab.asked if url.startswith("http")} == {f"localhost:{proxy.port}"}


def test_the_address_is_that_of_the_proxy_and_the_page_is_served_here_as_well(start: Start) -> None:
    system = start(rr.Supervisor([]))
    with system.serve_web(prefix="/rr/", hosts=["lab.example.org"]) as page:
        assert page.url.startswith("https://lab.example.org/rr/?token=")
    with system.serve_web(prefix="/proxy/{port}") as page:
        parts = urlsplit(page.url)
        assert parts.path == f"/proxy/{parts.port}/"
        with urllib.request.urlopen(page.url) as answer:  # the path is not removed
            assert f"0;url=/proxy/{parts.port}/" in answer.read().decode()
            assert answer.headers["set-cookie"].endswith(f"Path=/proxy/{parts.port}/")
        request = urllib.request.Request(page.url, headers={"Host": "hub.example.org"})
        with pytest.raises(urllib.error.HTTPError, match="403"):
            urllib.request.urlopen(request)


@needs_chromium
def test_the_lab_has_a_prefix_too(tab: Tab, proxy: Proxy) -> None:
    with web("--lab", LAB, "--port", proxy.to, "--prefix", PREFIX, "--host-name", f"localhost:{proxy.port}",
             "--host-name", "hub.example.org") as url:  # fmt: skip
        assert url.startswith(f"http://localhost:{proxy.port}{PREFIX}/lab?token=")
        tab.goes_to(url)
        tab.clicks("Ten questions", "link")
        eventually(lambda: urlsplit(tab.page.url).path == f"{PREFIX}/lab/questions", 30.0)
    assert proxy.strayed == []


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({"prefix": "user/me"}, "prefix: expected a path"),
        ({"prefix": '/a"><script>'}, "prefix: expected a path"),
        ({"prefix": 7}, "prefix: expected a path"),
        ({"hosts": "hub.example.org"}, "hosts: expected a list of names"),
        ({"hosts": ["https://hub.example.org"]}, "host name: expected the name of a host"),
    ],
)
def test_what_is_no_prefix_or_no_host_is_refused(start: Start, given: dict[str, Any], said: str) -> None:
    with pytest.raises(rr.UsageError, match=said):
        start(rr.Supervisor([])).serve_web(**given)
