"""The server for agents over HTTP: it needs a token, refuses other names and pages of other sites, and serves the same tools."""

from __future__ import annotations

import asyncio
import signal
from collections.abc import Iterator
from pathlib import Path

import httpx
import httpx2
import pytest
from agent_site import write_project
from mcp.client.client import Client
from mcp.client.streamable_http import streamable_http_client
from procs import fieldtwin, no_tracebacks, run_to_end, wait_for

pytestmark = [pytest.mark.long, pytest.mark.timeout(180)]
TOKEN = "token-of-the-agents"


@pytest.fixture(scope="module")
def url(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    root = tmp_path_factory.mktemp("a")
    project = write_project(root)
    (root / "token").write_text(TOKEN)
    options = ("--listen", "127.0.0.1:0", "--token", f"@{root / 'token'}", "--audit", str(root / "calls.jsonl"))
    with fieldtwin(root, "mcp", str(project), *options) as server:
        line = wait_for(lambda: next((x for x in server.err.splitlines() if x.startswith("MCP")), ""), 60, "the server")
        yield line.partition("→")[2].strip()
        server.signal(signal.SIGINT)
        assert server.wait() == 0
        assert "list_files" in (root / "calls.jsonl").read_text()
    no_tracebacks(root)


def test_an_agent_with_the_token_calls_tools(url: str) -> None:
    async def work() -> None:
        headers = {"Authorization": f"Bearer {TOKEN}"}
        async with (
            httpx2.AsyncClient(headers=headers, timeout=30) as http,
            Client(streamable_http_client(url, http_client=http)) as client,
        ):
            assert "why" in {tool.name for tool in (await client.list_tools()).tools}
            result = await client.call_tool("list_files", {})
            assert not result.is_error
            assert client.instructions
            assert "Plants are read-only" in client.instructions

    asyncio.run(work())


def test_an_agent_over_http_needs_the_permission_of_the_user_too(url: str) -> None:
    async def work() -> None:
        headers = {"Authorization": f"Bearer {TOKEN}"}
        async with (
            httpx2.AsyncClient(headers=headers, timeout=30) as http,
            Client(streamable_http_client(url, http_client=http)) as client,
        ):
            for tool, given, option in (
                ("propose_write", {"instance": "a", "tag": "b.c", "value": 1, "reason": ""}, "--allow-proposals"),
                ("read_device", {"system": "a", "device": "b"}, "--allow-devices"),
            ):
                result = await client.call_tool(tool, given)
                assert result.is_error
                assert option in str(result.content[0])

    asyncio.run(work())


def test_requests_without_the_token_or_from_other_sites_are_refused(url: str) -> None:
    body = {"jsonrpc": "2.0", "id": 1, "method": "tools/list"}
    valid = {"Authorization": f"Bearer {TOKEN}"}
    assert httpx.post(url, json=body).status_code == 401
    assert httpx.post(url, json=body, headers={"Authorization": "Bearer wrong"}).status_code == 401
    assert httpx.post(url, json=body, headers=valid | {"Host": "evil.example"}).status_code == 403
    assert httpx.post(url, json=body, headers=valid | {"Origin": "https://evil.example"}).status_code == 403
    assert httpx.post(url, content=b"x" * 1_100_000, headers=valid).status_code == 413


@pytest.mark.parametrize(
    ("options", "text"),
    [
        (["--listen", "127.0.0.1:0"], "agents that connect over HTTP need a token; expected --token @FILE"),
        (["--listen", "0.0.0.0:0", "--token", "@token"], "without TLS everyone on the network can read the token"),
        (["--listen", "127.0.0.1", "--token", "@token"], "--listen; expected HOST:PORT"),
    ],
)
def test_an_open_server_is_refused(tmp_path: Path, options: list[str], text: str) -> None:
    (tmp_path / "token").write_text(TOKEN)
    ended = run_to_end(tmp_path, "mcp", ".", *options)
    assert (ended.process.returncode, text in ended.err) == (2, True), ended.err
