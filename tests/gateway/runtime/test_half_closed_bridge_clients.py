"""A client may close its direction of a TCP connection after its last request (FIN) and still wait for the answers.

Defect: the bridge and the tag server dropped complete requests that were followed by FIN, and closed without an answer.
"""

from __future__ import annotations

import asyncio
import socket
from pathlib import Path

from bridge_rig import ANY_PORT, WRITERS, read_adu, rig
from support import eventually, run
from test_serve_tags import served

from fieldtwin.gateway.runtime.bridge.bridge import BridgeConfig


async def ask_and_close(port: int, requests: bytes) -> bytes:
    """Send `requests`, close this direction at once, and return all bytes until the server closes."""
    reader, writer = await asyncio.open_connection("127.0.0.1", port)
    try:
        writer.write(requests)
        writer.write_eof()
        async with asyncio.timeout(5):
            return await reader.read()
    finally:
        writer.close()


def test_the_bridge_answers_requests_that_are_followed_by_fin(tmp_path: Path) -> None:
    async def main() -> None:
        async with rig(tmp_path, latency_s=0.05) as r:
            data = await ask_and_close(r.port, read_adu(1, 1, 0, 1) + read_adu(2, 2, 0, 1) + read_adu(3, 1, 1, 1))
            assert data.hex(" ", 11) == " ".join(
                ["0001000000050103020064", "00020000000502030200c8", "0003000000050103020065"]
            )
            await eventually(lambda: r.bridge.status().clients == [])

    run(main())


def test_the_bridge_executes_a_write_followed_by_fin_and_confirms_it(tmp_path: Path) -> None:
    async def main() -> None:
        async with rig(tmp_path, BridgeConfig("b", ANY_PORT, to="line", policy=WRITERS), latency_s=0.05) as r:
            write = bytes.fromhex("0009 0000 0006 01 06 0003 1234")
            assert await ask_and_close(r.port, write) == write
            assert r.units[1].bank.read("holding", 3, 1, 0) == [0x1234]

    run(main())


def test_the_bridge_answers_for_a_silent_unit_after_fin(tmp_path: Path) -> None:
    async def main() -> None:
        async with rig(tmp_path, timeout_s=0.05) as r:
            assert await ask_and_close(r.port, read_adu(1, 9, 0, 1)) == bytes.fromhex("0001 0000 0003 09 83 0b")

    run(main())


def test_half_a_request_that_is_followed_by_fin_ends_the_connection(tmp_path: Path) -> None:
    async def main() -> None:
        async with rig(tmp_path) as r:
            assert await ask_and_close(r.port, read_adu(1, 1, 0, 1)[:-1]) == b""
            assert r.heard == []

    run(main())


def test_a_client_that_closes_both_directions_costs_the_line_two_requests_at_most(tmp_path: Path) -> None:
    """A FIN alone does not distinguish a closed client from a waiting one; the first answer sent to it does."""

    async def main() -> None:
        async with rig(tmp_path, latency_s=0.05) as r:
            with socket.create_connection(("127.0.0.1", r.port)) as goes:
                goes.sendall(b"".join(read_adu(n, 1, n, 1) for n in range(1, 9)))
                await eventually(lambda: len(r.heard) == 1)
            await eventually(lambda: r.bridge.status().clients == [])
            async with r.client() as stays:
                await stays.read_registers(2, "holding", 0, 1)
            assert sum(frame[0] == 1 for frame in r.heard) <= 3

    run(main())


def test_the_tag_server_answers_requests_that_are_followed_by_fin() -> None:
    async def main() -> None:
        async with served() as s:
            s.put("period", 7)
            bound = s.server.front.bound
            assert bound is not None
            assert await ask_and_close(bound.port, read_adu(5, 1, 0, 1)) == bytes.fromhex(
                "0005 0000 0005 01 03 02 0007"
            )

    run(main())
