"""Access to the interface: a token for each role, checks against other web sites, and headers that restrict the pages.

A web page of another site can send requests to this server from the user's browser. It cannot read the answers, but a
request could change a plant. Three checks prevent that: the ``Host`` header has to name this server (DNS rebinding), the
``Origin`` header of requests and WebSockets has to be this server's, and the cookie is sent by pages of this site only (RFC
6265bis, SameSite).
"""

from __future__ import annotations

import hmac
import secrets
from collections import OrderedDict
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from http.cookies import CookieError, SimpleCookie
from typing import Any
from urllib.parse import parse_qs, urlsplit

from starlette.datastructures import Headers, MutableHeaders
from starlette.responses import JSONResponse, RedirectResponse
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from fieldtwin.northbound.token_file import LONGEST_TOKEN
from fieldtwin.twin.site.servers.loopback import is_loopback

COOKIE = "fieldtwin_studio"
VIEW, OPERATE = "view", "operate"
LOOPBACK = ("127.0.0.1", "::1", "localhost")
"""The names under which programs on this computer know a server that listens on loopback."""
MOST_FAILURES = 10
"""Number of wrong tokens from one address after which that address has to wait."""
FORGET_FAILURES_S = 60.0
MOST_ADDRESSES = 1_000

NO_TOKEN = (
    "a token is required, in the header `Authorization: Bearer TOKEN`; a browser gets it with the address that "
    "`fieldtwin studio` prints"
)
POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' data:; font-src 'self'; connect-src 'self'; "
    "base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)
HEADERS = {
    "Content-Security-Policy": POLICY,
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Cache-Control": "no-store",
}


def new_token() -> str:
    """Return a token of 128 random bits."""
    return secrets.token_urlsafe(16)


@dataclass(frozen=True)
class Access:
    """The rules of access to the server. `operate` and `view` are the tokens of the roles; an empty one is not valid. `hosts`
    are the accepted ``Host`` headers.

    Without any token, every client has the role `open_role`. That is only for loopback.
    """

    hosts: frozenset[str]
    operate: str = field(default="", repr=False)
    view: str = field(default="", repr=False)
    open_role: str = OPERATE

    def role_of(self, token: str) -> str:
        """Return the role of a token, "" for a wrong one. The time of a comparison does not depend on the token."""
        given = token.encode(errors="replace")
        is_operate = hmac.compare_digest(given, self.operate.encode())
        is_view = hmac.compare_digest(given, self.view.encode())
        if is_operate and self.operate:
            return OPERATE
        return VIEW if is_view and self.view else ""

    @property
    def is_open(self) -> bool:
        """Return whether no token is needed."""
        return not self.operate and not self.view


class AccessMiddleware:
    """Refuse requests that `Access` does not allow, and put the role of the client into ``scope["role"]``.

    ``/?token=TOKEN`` stores the token in a cookie and redirects to the page without it, so that the address bar does not show
    the token.
    """

    def __init__(self, app: ASGIApp, access: Access, now_s: Callable[[], float]) -> None:
        self._app = app
        self._access = access
        self._now_s = now_s
        self._failures: OrderedDict[str, list[float]] = OrderedDict()

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] not in ("http", "websocket"):
            await self._app(scope, receive, send)
            return
        headers = Headers(scope=scope)
        problem = self._problem_of_site(headers, scope["type"] == "websocket" or scope["method"] not in ("GET", "HEAD"))
        if problem:
            await _refuse(scope, receive, send, 403, problem)
            return
        client = (scope.get("client") or ("?", 0))[0]
        if self._must_wait(client):
            await _refuse(scope, receive, send, 429, "too many wrong tokens; wait a minute")
            return
        token = _token_of(scope, headers)
        role = self._access.open_role if self._access.is_open else self._access.role_of(token)
        if not role:
            if token:
                self._note_failure(client)
            await _refuse(scope, receive, send, 401, NO_TOKEN)
            return
        scope["role"] = role
        if _in_query(scope) and scope["type"] == "http" and not scope["path"].startswith("/api/"):
            response = RedirectResponse(scope["path"], 303)
            secure = scope.get("scheme") == "https"
            response.set_cookie(COOKIE, token, httponly=True, samesite="strict", secure=secure, path="/")
            await response(scope, receive, _with_headers(send))
            return
        await self._app(scope, receive, _with_headers(send))

    def _problem_of_site(self, headers: Headers, needs_origin_check: bool) -> str:
        host = headers.get("host", "").lower()
        if host not in self._access.hosts:
            return f"this server is not {host[:60]!r}; it is {', '.join(sorted(self._access.hosts))}"
        origin = headers.get("origin")
        if needs_origin_check and origin is not None and urlsplit(origin).netloc.lower() not in self._access.hosts:
            return f"requests of pages from {origin[:60]!r} are refused"
        return ""

    def _must_wait(self, client: str) -> bool:
        recent = [at for at in self._failures.get(client, []) if at > self._now_s() - FORGET_FAILURES_S]
        if recent:
            self._failures[client] = recent
        else:
            self._failures.pop(client, None)
        return len(recent) >= MOST_FAILURES

    def _note_failure(self, client: str) -> None:
        self._failures.setdefault(client, []).append(self._now_s())
        while len(self._failures) > MOST_ADDRESSES:
            self._failures.popitem(last=False)


def allowed_hosts(host: str, names: Iterable[str], port: int) -> frozenset[str]:
    """Return the ``Host`` headers of a server that listens at `host` and is known under `names` as well.

    A server on loopback is known under all names of the loopback interface.
    """
    found = set()
    for name in {host, *names, *(LOOPBACK if is_loopback(host) else ())}:
        shown = f"[{name}]" if ":" in name else name.lower()
        found |= {f"{shown}:{port}"} | ({shown} if port in (80, 443) else set())
    return frozenset(found)


def _in_query(scope: Scope) -> bool:
    return b"token=" in scope.get("query_string", b"")


def _token_of(scope: Scope, headers: Headers) -> str:
    """Return the token of a request, from the header, the query or the cookie in this order; "" if it has none."""
    scheme, _, value = headers.get("authorization", "").partition(" ")
    if scheme.lower() == "bearer":
        return value.strip()[:LONGEST_TOKEN]
    if _in_query(scope):
        query: bytes = scope["query_string"]
        return parse_qs(query.decode("latin-1")).get("token", [""])[0][:LONGEST_TOKEN]
    try:
        cookies = SimpleCookie(headers.get("cookie", ""))
    except CookieError:
        return ""
    token: str = cookies[COOKIE].value if COOKIE in cookies else ""
    return token[:LONGEST_TOKEN]


def _with_headers(send: Send) -> Send:
    async def sending(message: Message) -> None:
        if message["type"] == "http.response.start":
            headers = MutableHeaders(scope=message)
            for name, value in HEADERS.items():
                headers.setdefault(name, value)
        await send(message)

    return sending


async def _refuse(scope: Scope, receive: Receive, send: Send, status: int, message: str) -> None:
    if scope["type"] == "websocket":
        await send({"type": "websocket.close", "code": 4000 + status, "reason": message[:120]})
        return
    body: dict[str, Any] = {"error": {"kind": "Refused", "message": message}}
    await JSONResponse(body, status)(scope, receive, _with_headers(send))
