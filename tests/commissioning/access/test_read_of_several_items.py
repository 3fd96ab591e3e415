"""`fieldtwin read` of several items prints the items that it could read and reports the rest.

Defects: one failing item failed the others. Items that were read in one request shared its failure, a device that closed the
connection left no output, and one write-only item stopped everything before a request was sent.
"""

from __future__ import annotations

import asyncio
import json
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from canopen_slave_rig import NODE, RICH
from click.testing import CliRunner, Result
from dump_device_rig import device

from fieldtwin.cli.main import cli
from fieldtwin.emulators.canopen.eds.dictionary import parse_eds
from fieldtwin.emulators.canopen.node import CanopenNode
from fieldtwin.emulators.canopen.serve import serve_node
from fieldtwin.emulators.endpoints.can.bus_server import SoftBusServer
from fieldtwin.gateway.core.canframe import CanFrame
from fieldtwin.gateway.core.endpoint import Endpoint
from fieldtwin.gateway.wallclock import WallClock


def read(url: str, *arguments: str) -> Result:
    """Run `fieldtwin read`; errors are in the result's exception."""
    return CliRunner().invoke(cli, ["read", url, *arguments], standalone_mode=False)


def rows(result: Result) -> dict[str, dict[str, object]]:
    return {row["name"]: row for row in json.loads(result.stdout)["values"]}


def test_an_exception_of_one_register_does_not_take_its_neighbours_along() -> None:
    def one_fails(function: int, address: int, count: int) -> list[int] | int | None:
        return 4 if address <= 1 < address + count else list(range(address, address + count))

    with device(one_fails) as url:
        result = read(url, "holding:0", "holding:1", "holding:2", "--json", "--timeout", "500ms")
        table = read(url, "holding:0", "holding:1", "holding:2", "--timeout", "500ms")
    found = rows(result)
    assert (found["holding:0"]["value"], found["holding:2"]["value"]) == (0, 2)
    assert found["holding:1"]["value"] is None
    assert "04h" in str(found["holding:1"]["problem"])
    assert result.return_value == table.return_value == 5
    assert all(name in table.stdout for name in found), table.stdout


def test_a_device_that_is_silent_at_one_register_returns_the_others() -> None:
    def one_is_silent(function: int, address: int, count: int) -> list[int] | int | None:
        return None if address <= 1 < address + count else list(range(address, address + count))

    with device(one_is_silent) as url:
        result = read(url, "holding:0", "holding:1", "holding:2", "--json", "--timeout", "200ms")
    found = rows(result)
    assert (found["holding:0"]["value"], found["holding:2"]["value"]) == (0, 2)
    assert found["holding:1"]["reason"] == "timeout"
    assert result.return_value == 4


def test_a_silent_device_is_not_asked_for_every_item() -> None:
    asked: list[int] = []

    def silent(function: int, address: int, count: int) -> list[int] | int | None:
        asked.append(address)
        return None

    with device(silent) as url:
        result = read(url, "holding:0", "--count", "50", "--json", "--timeout", "50ms")
    assert {row["reason"] for row in rows(result).values()} == {"timeout"}
    assert len(asked) == 3
    assert result.return_value == 4


@contextmanager
def on_its_own_loop(main: Callable[[Callable[[str], None], asyncio.Event], object]) -> Iterator[str]:
    """Run `main(tell_url, stop)` on a loop in a separate thread, and yield the URL."""
    url: list[str] = []
    told, loop, stop = threading.Event(), asyncio.new_event_loop(), asyncio.Event()

    def tell(where: str) -> None:
        url.append(where)
        told.set()

    thread = threading.Thread(target=lambda: loop.run_until_complete(main(tell, stop)))  # type: ignore[arg-type]
    thread.start()
    try:
        assert told.wait(20)
        yield url[0]
    finally:
        loop.call_soon_threadsafe(stop.set)
        thread.join()
        loop.close()


async def _hangs_up_at_100(tell: Callable[[str], None], stop: asyncio.Event) -> None:
    """A Modbus TCP device that answers register 0, and closes the connection at a request for register 100."""

    async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        try:
            while len(request := await reader.read(12)) == 12 and request[8:10] == b"\0\0":
                writer.write(request[:4] + b"\0\5" + request[6:8] + b"\2\0\7")
        finally:
            writer.close()

    server = await asyncio.start_server(serve, "127.0.0.1", 0)
    tell(f"tcp://127.0.0.1:{server.sockets[0].getsockname()[1]}")
    await stop.wait()
    server.close()


def test_items_read_before_the_loss_of_the_connection_are_printed() -> None:
    with on_its_own_loop(_hangs_up_at_100) as url:
        result = read(url, "holding:0", "holding:100", "holding:200", "--json")
        table = read(url, "holding:0", "holding:100", "holding:200")
    found = rows(result)
    assert found["holding:0"]["value"] == 7
    for lost in ("holding:100", "holding:200"):
        assert (found[lost]["value"], found[lost]["reason"]) == (None, "unreachable")
        assert found[lost]["problem"]
    assert result.return_value == table.return_value == 4
    assert "holding:200" in table.stdout


PROFILE = """
device: tests/half-writable
source: a test
protocol: modbus
tags:
  level: {at: "holding:0", type: uint16, poll: all}
  command: {at: "holding:1", type: uint16, access: wo}
"""


def test_a_write_only_item_is_reported_and_the_others_are_read(tmp_path: Path) -> None:
    (tmp_path / "half.yaml").write_text(PROFILE)
    with device(lambda function, address, count: list(range(7, 7 + count)) if address == 0 else 2) as url:
        profile = ("--profile", str(tmp_path / "half.yaml"), "--json")
        result = read(url, "level", "command", *profile)
        nothing = read(url, "command", *profile)
    assert rows(result)["level"]["value"] == 7
    assert rows(result)["command"]["problem"] == "not asked: it can only be written (access: wo)"
    assert result.return_value == 5
    assert "cannot be read: command" in str(nothing.exception)


async def _node_on_a_bus_that_closes(tell: Callable[[str], None], stop: asyncio.Event) -> None:
    """A node on a software bus, which closes at a request for 1018h:04."""
    bus = await SoftBusServer.open(Endpoint.parse("can:fieldtwin/127.0.0.1:0"), 125_000, paced=False)
    closing: list[asyncio.Task[None]] = []

    class Node(CanopenNode):
        def feed(self, frame: CanFrame, now_ns: int) -> list[CanFrame]:
            if frame.can_id == 0x600 + NODE and frame.data[:4] == bytes.fromhex("40181004"):
                closing.append(asyncio.ensure_future(bus.aclose()))
                return []
            return super().feed(frame, now_ns)

    node = asyncio.ensure_future(serve_node(bus.attach("node"), Node(parse_eds(RICH), NODE), WallClock()))
    tell(str(bus.bound))
    await stop.wait()
    node.cancel()
    await asyncio.gather(node, return_exceptions=True)
    await bus.aclose()


def test_objects_that_were_read_before_the_bus_was_lost_are_printed() -> None:
    with on_its_own_loop(_node_on_a_bus_that_closes) as url:
        result = read(url, "--node", str(NODE), "1000h", "5FFEh", "1018h:04", "1008h", "--json")
    found = rows(result)
    assert found["1000h:00"]["quality"] == "good"
    assert found["5FFEh:00"]["reason"] == "refused"
    for lost in ("1018h:04", "1008h:00"):
        assert (found[lost]["value"], found[lost]["reason"]) == (None, "unreachable")
    assert result.return_value == 4
