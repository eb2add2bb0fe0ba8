"""Who may open the web page: those with the token, at this server's own name, from its own page."""

from __future__ import annotations

import asyncio
from collections.abc import MutableMapping
from typing import Any

import pytest

from rr_actors.tools.web.web_access import Access, Keys, Receive, Scope, Send

HOST = b"127.0.0.1:8123"
SERVED = 200


class Visit:
    """What a server answers to one request."""

    def __init__(
        self, keys: Keys, host: str, kind: str, path: str, query: str, headers: list[tuple[bytes, bytes]]
    ) -> None:
        self.sent: list[MutableMapping[str, Any]] = []

        async def served(scope: Scope, receive: Receive, send: Send) -> None:
            await send({"type": "http.response.start", "status": SERVED, "headers": []})

        async def receive() -> MutableMapping[str, Any]:
            raise AssertionError("nothing is read of a request that is not let in")

        async def send(message: MutableMapping[str, Any]) -> None:
            self.sent.append(message)

        scope = {"type": kind, "path": path, "query_string": query.encode(), "headers": headers}
        asyncio.run(Access(served, keys, host, 8123)(scope, receive, send))

    @property
    def status(self) -> int:
        return self.sent[0].get("status", 0)

    @property
    def is_in(self) -> bool:
        return len(self.sent) == 1 and self.status == SERVED

    @property
    def is_closed(self) -> bool:
        return [message["type"] for message in self.sent] == ["websocket.close"]

    def header(self, name: bytes) -> str:
        return b", ".join(value for key, value in self.sent[0]["headers"] if key == name).decode()

    @property
    def text(self) -> str:
        return self.sent[1]["body"].decode()


def visit(
    keys: Keys,
    *headers: tuple[bytes, bytes],
    listens_at: str = "127.0.0.1",
    kind: str = "http",
    path: str = "/",
    query: str = "",
    host: bytes = HOST,
) -> Visit:
    return Visit(keys, listens_at, kind, path, query, [(b"host", host), *headers])


def cookie(keys: Keys) -> tuple[bytes, bytes]:
    return b"cookie", f"other=1; rr_actors_8123={keys.cookie}".encode()


def test_who_has_no_token_is_refused_and_told_what_to_open() -> None:
    refused = visit(Keys())

    assert refused.status == 403
    assert "the address that rr-actors web has printed" in refused.text


def test_the_token_is_exchanged_for_a_strict_cookie_that_no_script_can_read() -> None:
    keys = Keys()

    welcome = visit(keys, query=f"token={keys.token}", path="/resources")

    assert welcome.status == 200
    assert 'content="0;url=/resources"' in welcome.text
    assert welcome.header(b"set-cookie") == f"rr_actors_8123={keys.cookie}; HttpOnly; SameSite=Strict; Path=/"
    assert keys.token not in welcome.text
    assert welcome.header(b"referrer-policy") == "no-referrer"


def test_the_cookie_opens_the_page_and_the_connection_for_events() -> None:
    keys = Keys()

    assert visit(keys, cookie(keys)).is_in
    assert visit(keys, cookie(keys), (b"origin", b"http://" + HOST), kind="websocket").is_in


def test_other_applications_cookies_do_not_hide_this_servers() -> None:
    """A browser sends the cookies of all applications of this host, whatever is in them."""
    keys = Keys()
    name, own = cookie(keys)

    for foreign in (b'prefs={"theme": "dark", "n": [1, 2]}', b"a b=c", b"=", b"nothing", b'"'):
        assert visit(keys, (name, foreign + b"; " + own)).is_in
        assert visit(keys, (name, own + b"; " + foreign)).is_in


def test_a_program_shows_the_token_in_a_header() -> None:
    keys = Keys()

    assert visit(keys, (b"authorization", f"Bearer {keys.token}".encode()), path="/metrics").is_in
    assert visit(keys, (b"authorization", b"Bearer wrong"), path="/metrics").status == 403


@pytest.mark.parametrize("path", ["//elsewhere.example/x", "/\\elsewhere.example", '/"><script>'])
def test_the_token_leads_nowhere_else(path: str) -> None:
    keys = Keys()

    text = visit(keys, query=f"token={keys.token}", path=path).text

    target = text.split("url=")[1].split('"')[0]
    assert target.startswith("/")
    assert not target.startswith(("//", "/\\"))
    assert "<script>" not in text


@pytest.mark.parametrize("shown", ["", "x", "Ünï", "a" * 10_000])
def test_a_wrong_token_and_a_wrong_cookie_are_refused(shown: str) -> None:
    keys = Keys()

    assert visit(keys, query=f"token={shown}").status == 403
    assert visit(keys, (b"cookie", f"rr_actors_8123={shown}".encode())).status == 403
    assert visit(keys, (b"cookie", f"rr_actors_8123={keys.token}".encode())).status == 403


@pytest.mark.parametrize(
    "host", [b"attacker.example", b"attacker.example:8123", b"", b"192.168.1.7:8123", b"127.0.0.1.x"]
)
def test_a_name_that_is_not_this_servers_is_refused_whatever_is_shown(host: bytes) -> None:
    """A page may have had its own name lead to this address, and then is of the same origin."""
    keys = Keys()

    assert visit(keys, cookie(keys), host=host).status == 403
    assert visit(keys, query=f"token={keys.token}", host=host).status == 403
    assert visit(keys, cookie(keys), (b"origin", b"http://" + host), kind="websocket", host=host).is_closed


@pytest.mark.parametrize(
    ("host", "origin", "is_in"),
    [
        (b"hub.example.org", b"https://hub.example.org", True),
        (b"hub.example.org:443", b"https://hub.example.org", True),
        (HOST, b"https://hub.example.org", True),  # a proxy that changes the Host
        (HOST, b"https://hub.example.org:8443", False),
        (HOST, b"https://attacker.example", False),
        (b"hub.example.org", b"https://attacker.example", False),
        (b"attacker.example", b"https://hub.example.org", False),
    ],
)
def test_the_host_of_a_proxy_is_let_in_and_no_other(host: bytes, origin: bytes, is_in: bool) -> None:
    keys = Keys()
    sent: list[MutableMapping[str, Any]] = []

    async def served(scope: Scope, receive: Receive, send: Send) -> None:
        await send({"type": "served", "path": scope["path"]})

    async def send(message: MutableMapping[str, Any]) -> None:
        sent.append(message)

    async def receive() -> MutableMapping[str, Any]:
        raise AssertionError("nothing is read")

    headers = [(b"host", host), (b"origin", origin), cookie(keys)]
    scope = {"type": "websocket", "path": "/rr/ws", "query_string": b"", "headers": headers}
    access = Access(served, keys, "127.0.0.1", 8123, "/rr", ["hub.example.org"])
    asyncio.run(access(scope, receive, send))
    assert (sent == [{"type": "served", "path": "/ws"}]) == is_in
    assert len(sent) == 1


def test_a_request_with_two_hosts_is_refused() -> None:
    keys = Keys()

    assert visit(keys, cookie(keys), (b"host", b"attacker.example")).status == 403


@pytest.mark.parametrize("host", [b"localhost:8123", b"127.0.0.1:9000", b"[::1]:8123", b"LOCALHOST", b"[::1]"])
def test_the_loopback_names_are_this_servers_at_any_port(host: bytes) -> None:
    """Through a tunnel the port is another one."""
    keys = Keys()

    assert visit(keys, cookie(keys), (b"origin", b"http://" + host), kind="websocket", host=host).is_in


@pytest.mark.parametrize(
    "origin", [b"http://attacker.example", b"null", b"http://127.0.0.1:9999", b"https://127.0.0.1:8123"]
)
def test_another_page_can_neither_ask_nor_connect(origin: bytes) -> None:
    keys = Keys()

    assert visit(keys, cookie(keys), (b"origin", origin)).status == 403
    assert visit(keys, cookie(keys), (b"origin", origin), kind="websocket").is_closed


def test_a_connection_that_does_not_say_where_it_comes_from_is_closed() -> None:
    keys = Keys()

    assert visit(keys, cookie(keys), kind="websocket").is_closed


def test_a_server_that_listens_for_others_accepts_addresses_and_its_own_name_and_no_other_name() -> None:
    keys = Keys()

    assert visit(keys, cookie(keys), listens_at="0.0.0.0", host=b"192.168.1.7:8123").is_in
    assert visit(keys, cookie(keys), listens_at="robot.local", host=b"robot.local:8123").is_in
    assert visit(keys, cookie(keys), listens_at="0.0.0.0", host=b"attacker.example").status == 403


def test_no_other_page_may_frame_it_and_nothing_is_loaded_from_elsewhere() -> None:
    keys = Keys()

    policy = visit(keys, cookie(keys)).header(b"content-security-policy")

    assert "frame-ancestors 'none'" in policy
    assert "default-src 'self'" in policy
    assert "http" not in policy


def test_each_server_has_secrets_of_its_own() -> None:
    assert len({secret for keys in (Keys(), Keys()) for secret in (keys.token, keys.cookie)}) == 4
    assert len(Keys().token) > 40
