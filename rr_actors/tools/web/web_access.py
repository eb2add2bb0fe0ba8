"""Access: the check of every request to the web server. It needs no library.

A request or websocket must name this server as its Host. If it names an origin, that must be this server's page. It
must show the token: once in the address that is printed at the start, from then on in a cookie.
"""

from __future__ import annotations

import hmac
import ipaddress
import secrets
from collections.abc import Awaitable, Callable, Collection, Iterable, MutableMapping
from html import escape
from typing import Any
from urllib.parse import parse_qs, parse_qsl, quote, urlencode

Scope = MutableMapping[str, Any]
Receive = Callable[[], Awaitable[MutableMapping[str, Any]]]
Send = Callable[[MutableMapping[str, Any]], Awaitable[None]]
App = Callable[[Scope, Receive, Send], Awaitable[None]]

_UNANSWERED = "No response returned."
"""The RuntimeError of Starlette for a request whose client has left before the answer began."""
_LOOPBACK = frozenset({"localhost", "127.0.0.1", "[::1]"})
_HEADERS = (
    # Nothing is loaded from elsewhere. No other page may show this one in a frame, where it could steal clicks.
    (
        b"content-security-policy",
        b"default-src 'self' 'unsafe-inline' 'unsafe-eval' data: blob:; connect-src 'self'; frame-ancestors 'none'; "
        b"form-action 'none'; base-uri 'none'",
    ),
    (b"x-content-type-options", b"nosniff"),
    (b"referrer-policy", b"no-referrer"),
)


class Keys:
    """The secrets of one web server: the token in its address, and the cookie that a browser gets for the token."""

    def __init__(self) -> None:
        self.token = secrets.token_urlsafe(32)
        self.cookie = secrets.token_urlsafe(32)


class Access:
    """An ASGI application in front of another, which answers 403 to a client without the right to it.

    Args:
        app: the application that is served.
        keys: the secrets.
        host: the address that the server listens at: one of its names, besides those of the loopback.
        port: a part of the cookie's name, since browsers share cookies between the ports of a host.
        prefix: the path before all paths of this server, by which browsers reach it through a proxy: "/rr".
        names: of the hosts that browsers reach it at through a proxy, "hub.example.org" or "hub.example.org:8443".
    """

    def __init__(
        self, app: App, keys: Keys, host: str, port: int, prefix: str = "", names: Collection[str] = ()
    ) -> None:
        self.app = app  # NiceGUI looks for the application that serves it, by this name
        self._keys = keys
        self._cookie = f"rr_actors_{port}"
        self._is_open = not is_loopback(host)
        self._prefix = prefix
        self._origins = {f"{scheme}://{name.lower()}" for name in names for scheme in ("http", "https")}
        self._names = _LOOPBACK | {host.lower()} | {name.lower().partition(":")[0] for name in names}

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass a request or a connection on, or refuse it."""
        if scope["type"] == "lifespan":
            await self.app(scope, receive, send)
            return
        scope = self._without_prefix(scope)
        headers = _Headers(scope["headers"])
        problem = self._foreign(scope["type"], headers)
        if not problem and self._has(headers):
            await self._pass_on(scope, receive, _with_headers(send))
        elif not problem and scope["type"] == "http" and self._has_token(scope):
            await _reply(send, 200, *self._welcome(scope["path"], scope["query_string"].decode("latin-1")))
        else:
            text = problem or "open the address that rr-actors web has printed: it ends in a token"
            await _refuse(scope["type"], send, text)

    def _without_prefix(self, scope: Scope) -> Scope:
        """Return a request as if there were no proxy: most proxies remove the prefix. NiceGUI puts it before links."""
        path: str = scope["path"]
        if self._prefix and f"{path}/".startswith(f"{self._prefix}/"):
            path = path.removeprefix(self._prefix) or "/"
        headers = [one for one in scope["headers"] if one[0] != b"x-forwarded-prefix"]
        return {**scope, "path": path, "headers": [*headers, (b"x-forwarded-prefix", self._prefix.encode())]}

    async def _pass_on(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass a request on. NiceGUI's middleware raises an error for a client that has left: it concerns nobody."""
        has_left = False

        async def receive_or_note() -> MutableMapping[str, Any]:
            nonlocal has_left
            message = await receive()
            has_left = has_left or message["type"] == "http.disconnect"
            return message

        try:
            await self.app(scope, receive_or_note, send)
        except RuntimeError as error:
            if not has_left or str(error) != _UNANSWERED:
                raise

    def _foreign(self, kind: str, headers: _Headers) -> str:
        """Return why a request's Host or Origin is refused; "" if both are right."""
        host, origin = headers.one(b"host"), headers.one(b"origin")
        if not self._is_own_name(host):
            return f"this server is not {host or 'a server without a name'}"
        is_own = origin == f"http://{host}" or origin.lower() in self._origins
        if not is_own and (origin or kind == "websocket"):
            return f"this comes from another page: {origin or 'it does not say which'}"
        return ""

    def _is_own_name(self, host: str) -> bool:
        """Return whether a request's Host is this server. Another site's name may point to this server's address."""
        name = host.rpartition(":")[0] if not host.endswith("]") and ":" in host else host
        if name.lower() in self._names:
            return True
        return self._is_open and _is_address(name)  # an address is no name that could point here

    def _has(self, headers: _Headers) -> bool:
        """Return whether a request has the cookie, or, as programs send it, the token in a header."""
        shown = _cookies(headers.one(b"cookie")).get(self._cookie, "")
        bearer = headers.one(b"authorization").removeprefix("Bearer ")
        return _same(shown, self._keys.cookie) or _same(bearer, self._keys.token)

    def _has_token(self, scope: Scope) -> bool:
        query = parse_qs(scope["query_string"].decode("latin-1"))
        return any(_same(token, self._keys.token) for token in query.get("token", ()))

    def _welcome(self, path: str, query: str) -> tuple[str, Iterable[tuple[bytes, bytes]]]:
        """Return a page that sets the cookie and leads to the same address without the token.

        It is no redirect: after a redirect, a browser that came from another page would not send a strict cookie.
        """
        kept = urlencode([(key, value) for key, value in parse_qsl(query) if key != "token"])
        target = escape(self._prefix + quote("/" + path.lstrip("/\\")) + (f"?{kept}" if kept else ""))
        cookie = f"{self._cookie}={self._keys.cookie}; HttpOnly; SameSite=Strict; Path={self._prefix}/"
        icon = '<link rel="icon" href="data:,">'  # else the browser asks for one outside of the prefix
        text = f'<!doctype html><meta http-equiv="refresh" content="0;url={target}">{icon}<title>rr-actors</title>'
        return text, [(b"set-cookie", cookie.encode()), (b"content-type", b"text/html; charset=utf-8")]


class _Headers:
    def __init__(self, headers: Iterable[tuple[bytes, bytes]]) -> None:
        self._headers = list(headers)

    def one(self, name: bytes) -> str:
        """Return a header's value; "" if the header is missing, or comes twice."""
        values = [value for key, value in self._headers if key == name]
        return values[0].decode("latin-1") if len(values) == 1 else ""


def _same(shown: str, secret: str) -> bool:
    """Return whether both are equal, in a time that does not depend on how much of them is equal."""
    return hmac.compare_digest(shown.encode("utf-8", "replace"), secret.encode())


def _cookies(header: str) -> dict[str, str]:
    """Return the cookies of a request. Python's SimpleCookie stops at a foreign cookie that has JSON in it."""
    pairs = (pair.partition("=") for pair in header.split(";"))
    return {name.strip(): value.strip() for name, _, value in pairs}


def is_loopback(host: str) -> bool:
    """Return whether only this machine reaches a server that listens at a host."""
    return host in _LOOPBACK or (_is_address(host) and ipaddress.ip_address(host.strip("[]")).is_loopback)


def _is_address(name: str) -> bool:
    try:
        ipaddress.ip_address(name.strip("[]"))
    except ValueError:
        return False
    return True


def _with_headers(send: Send) -> Send:
    async def send_with_headers(message: MutableMapping[str, Any]) -> None:
        if message["type"] == "http.response.start":
            message["headers"] = [*message.get("headers", ()), *_HEADERS]
        await send(message)

    return send_with_headers


async def _refuse(kind: str, send: Send, text: str) -> None:
    if kind == "websocket":
        await send({"type": "websocket.close", "code": 1008, "reason": text[:100]})
        return
    await _reply(send, 403, f"rr-actors: {text}\n", [(b"content-type", b"text/plain; charset=utf-8")])


async def _reply(send: Send, status: int, text: str, headers: Iterable[tuple[bytes, bytes]]) -> None:
    body = text.encode()
    own = [*headers, *_HEADERS, (b"cache-control", b"no-store"), (b"content-length", str(len(body)).encode())]
    await send({"type": "http.response.start", "status": status, "headers": own})
    await send({"type": "http.response.body", "body": body})
