"""Access to Studio: tokens and roles, other web sites, DNS rebinding, and listening beyond loopback."""

from __future__ import annotations

import asyncio

import httpx
import pytest
import websockets
from studio_rig import OPERATE, VIEW, Studio

from fieldtwin.gateway.core.errors import UsageError
from fieldtwin.studio.access import COOKIE, MOST_FAILURES, Access, AccessMiddleware
from fieldtwin.studio.server import StudioOptions

NAME = "/instances/observatory"


def test_nothing_is_shown_without_a_token(observatory: Studio) -> None:
    with observatory.client("") as client:
        for path in ("/instances", f"{NAME}/tags", f"{NAME}/frames", "/openapi.json"):
            assert client.get(path).status_code == 401
        assert httpx.get(observatory.url).status_code == 401


def test_the_role_view_changes_nothing(observatory: Studio) -> None:
    with observatory.client(VIEW) as client:
        for method, path, body in (
            ("POST", f"{NAME}/faults", {"fault": {"name": "silence", "device": "ctd"}}),
            ("PUT", f"{NAME}/tags/ctd.status/set", {"value": 1}),
            ("POST", f"{NAME}/plc/forces", {"tag": "ctd.status", "value": 1}),
            ("POST", f"{NAME}/plc/pause", {}),
            ("POST", "/instances", {"system": "observatory"}),
            ("DELETE", NAME, None),
        ):
            answer = client.request(method, path, json=body)
            assert answer.status_code == 403, path
            assert "operate" in answer.json()["error"]["message"]
        assert client.get(f"{NAME}/faults").json()["active"] == []


def test_the_address_with_the_token_sets_a_cookie_for_this_site_only(observatory: Studio) -> None:
    answer = httpx.get(observatory.page)
    assert answer.status_code == 303
    assert "token" not in answer.headers["location"]
    cookie = answer.headers["set-cookie"]
    assert cookie.startswith(f"{COOKIE}={OPERATE};")
    assert "HttpOnly" in cookie
    assert "SameSite=strict" in cookie
    page = httpx.get(observatory.url, cookies={COOKIE: OPERATE})
    assert page.status_code == 200
    policy = page.headers["content-security-policy"]
    assert "default-src 'none'" in policy
    assert "unsafe" not in policy


@pytest.mark.parametrize("host", ["evil.example", "127.0.0.1", "localhost:1", ""])
def test_another_host_name_is_refused_so_that_dns_rebinding_fails(observatory: Studio, host: str) -> None:
    with observatory.client() as client:
        assert client.get("/instances", headers={"Host": host}).status_code in (400, 403)


@pytest.mark.parametrize("origin", ["https://evil.example", "null", "http://127.0.0.1:1"])
def test_pages_of_other_sites_cannot_change_anything(observatory: Studio, origin: str) -> None:
    with observatory.client() as client:
        answer = client.post(f"{NAME}/plc/pause", headers={"Origin": origin})
        assert answer.status_code == 403
        assert client.get(f"{NAME}/plc").json()["state"] == "running"


def test_pages_of_other_sites_get_no_websocket(observatory: Studio) -> None:
    async def main() -> None:
        url = f"{observatory.api}{NAME}/stream".replace("http", "ws", 1)
        headers = {"Authorization": f"Bearer {OPERATE}", "Origin": "https://evil.example"}
        async with websockets.connect(url, additional_headers=headers) as socket:
            await socket.recv()

    with pytest.raises((websockets.InvalidStatus, websockets.ConnectionClosed)):
        asyncio.run(main())


def test_wrong_tokens_are_limited_and_forgotten_after_a_minute() -> None:
    now = 0.0

    async def main() -> list[int]:
        nonlocal now
        reached = []

        async def app(scope, receive, send) -> None:  # type: ignore[no-untyped-def]
            reached.append(scope["role"])
            await httpx_answer(send, 200)

        access = Access(frozenset({"here:1"}), operate="right")
        guarded = AccessMiddleware(app, access, lambda: now)
        statuses = []
        async with httpx.AsyncClient(transport=httpx.ASGITransport(guarded), base_url="http://here:1") as client:
            for _ in range(MOST_FAILURES):
                statuses.append((await client.get("/", headers={"Authorization": "Bearer wrong"})).status_code)
            statuses.append((await client.get("/", headers={"Authorization": "Bearer right"})).status_code)
            now = 61.0
            statuses.append((await client.get("/", headers={"Authorization": "Bearer right"})).status_code)
        assert reached == ["operate"]
        return statuses

    assert asyncio.run(main()) == [401] * MOST_FAILURES + [429, 200]


async def httpx_answer(send, status: int) -> None:  # type: ignore[no-untyped-def]
    await send({"type": "http.response.start", "status": status, "headers": []})
    await send({"type": "http.response.body", "body": b""})


@pytest.mark.parametrize(
    ("options", "text"),
    [
        (StudioOptions(host="0.0.0.0"), "--insecure"),
        (StudioOptions(host="192.0.2.1", no_token=True, insecure=True), "loopback"),
        (StudioOptions(host="::"), "--insecure"),
    ],
)
def test_beyond_loopback_needs_tls_or_an_explicit_decision_and_a_token(options: StudioOptions, text: str) -> None:
    with pytest.raises(UsageError, match=text):
        options.check()


@pytest.mark.parametrize("host", ["127.0.0.1", "127.0.0.2", "::1", "localhost"])
def test_loopback_needs_neither(host: str) -> None:
    StudioOptions(host=host, no_token=True).check()
