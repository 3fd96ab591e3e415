"""`fieldtwin check modbus` from the command line on a real socket: files, waivers, exit codes, the log of sent frames."""

from __future__ import annotations

import asyncio
import json
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest
from click.testing import CliRunner, Result
from devices_in_memory import make_unit

from fieldtwin.cli.test.check_command import command
from fieldtwin.emulators.endpoints.modbus_server import serve_mbap
from fieldtwin.emulators.endpoints.socket_end import SocketListener
from fieldtwin.emulators.modbus.mbap import MbapServer
from fieldtwin.gateway.core.connection import ByteConnection
from fieldtwin.gateway.core.endpoint import Endpoint
from fieldtwin.gateway.core.errors import FileInvalid
from fieldtwin.gateway.wallclock import WallClock


@pytest.fixture(scope="module")
def device() -> Iterator[str]:
    """A device on a local port that adds 1 to the exception code of a read of nonexistent registers."""
    ready, urls = threading.Event(), []
    unit = make_unit()
    right = unit.respond
    unit.respond = (
        lambda pdu, now_ns: (  # type: ignore[method-assign]
            b"\x83\x04" if pdu[0] == 3 and pdu[3:] == b"\0\0" else right(pdu, now_ns)
        )
    )
    loop = asyncio.new_event_loop()
    stop = asyncio.Event()

    async def serve(end: ByteConnection) -> None:
        await serve_mbap(end, MbapServer({1: unit}), WallClock())

    async def main() -> None:
        listener = await SocketListener.open(Endpoint.parse("tcp://127.0.0.1:0"), serve)
        urls.append(str(listener.bound))
        ready.set()
        await stop.wait()
        await listener.aclose()

    thread = threading.Thread(target=lambda: loop.run_until_complete(main()))
    thread.start()
    assert ready.wait(10)
    yield urls[0]
    loop.call_soon_threadsafe(stop.set)
    thread.join(10)
    loop.close()


def check(url: str, *words: str | Path) -> Result:
    given = [
        "modbus",
        url,
        "--timeout",
        "100ms",
        "--rate",
        "5000",
        "--only",
        "MB-036,MB-037,MB-045,MB-055",
        *map(str, words),
    ]
    return CliRunner().invoke(command, given, standalone_mode=False)


def test_files_and_exit_code(device: str, tmp_path: Path) -> None:
    html, junit, out, log = (tmp_path / name for name in ("c.html", "c.xml", "c.json", "c.jsonl"))
    result = check(device, "--html", html, "--junit", junit, "-o", out, "--log", log, "--by", "A. Fitter")
    assert result.return_value == 1, result.exception
    assert "failed        MB-036a read     count 0: exception 04 (device failure) instead of 03" in result.stdout
    data = json.loads(out.read_text())
    assert data["about"]["identity"]["product code"] == "FT-1"
    assert data["about"]["by"] == "A. Fitter"
    case = next(case for case in data["cases"] if case["id"] == "MB-036a")
    assert (case["verdict"], case["impact"], case["clause"], case["role"]) == ("failed", "read", "AP 6", "device")
    sent, received = (line["data"] for line in case["wire"])
    assert sent[6:] == "00 00 00 06 01 03 00 00 00 00"
    assert received[6:] == "00 00 00 03 01 83 04"
    assert received in html.read_text()
    assert received in junit.read_text()
    logged = [json.loads(line) for line in log.read_text().splitlines()]
    assert logged[0]["started"]
    assert bytes.fromhex(sent).hex() in [line.get("hex") for line in logged]


def test_a_waived_failure_is_skipped_and_all_is_well(device: str, tmp_path: Path) -> None:
    waivers = tmp_path / "waivers.yaml"
    waivers.write_text("waivers:\n  - {id: MB-036a, owner: A. Berg, reason: replaced in May, expires: 2999-05-31}\n")
    result = check(device, "--waivers", waivers, "--json")
    assert result.return_value == 0, result.exception
    case = next(case for case in json.loads(result.stdout)["cases"] if case["id"] == "MB-036a")
    assert (case["verdict"], case["waived"]) == ("skipped", True)
    assert "replaced in May; owner A. Berg, until 2999-05-31" in case["reason"]


def test_a_wrong_waiver_is_reported_before_anything_is_sent(tmp_path: Path) -> None:
    waivers = tmp_path / "waivers.yaml"
    waivers.write_text("waivers:\n  - {id: MB-999, owner: A. Berg, reason: replaced in May, expires: 2999-05-31}\n")
    assert isinstance(check("tcp://127.0.0.1:1", "--waivers", waivers).exception, FileInvalid)


def test_allowed_and_confirmed_cases_run(device: str) -> None:
    result = check(device, "--write", "holding:190", "--yes", "--json")
    played = {case["id"]: case["verdict"] for case in json.loads(result.stdout)["cases"]}
    assert played["MB-036d"] == "passed"
