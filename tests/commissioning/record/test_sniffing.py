"""`record --sniff PORT`: one adapter that listens to a line between other devices makes a recording.

Defect: requests and replies arrive on one stream there, and 58 frames became "0 records, 58 answers to nothing".
"""

from __future__ import annotations

import asyncio
import json
import signal
import sys
from pathlib import Path

import pytest
from support import eventually, run

from fieldtwin.capture.recordings.rotating_file import exchanges_of
from fieldtwin.commissioning.record.sniffing import Directions
from fieldtwin.emulators.endpoints.pty import PtyEnd
from fieldtwin.gateway.core.connection import Direction
from fieldtwin.gateway.core.endpoint import Endpoint
from fieldtwin.gateway.protocols.modbus.frames.crc import with_crc

TALK = [
    ("01 03 0000 0002", "01 03 04 0001 0002"),
    ("01 03 0000 0002", "01 03 04 0001 0003"),
    ("02 04 0005 0001", "02 84 02"),
    ("01 06 0001 0007", "01 06 0001 0007"),
    ("01 01 0000 0008", "01 01 01 A5"),
    ("03 03 0000 0001", ""),
    ("01 10 0001 0001 02 0009", "01 10 0001 0001"),
]


def frames() -> list[tuple[Direction, bytes]]:
    said = []
    for request, reply in TALK:
        said.append((Direction.SENT, with_crc(bytes.fromhex(request))))
        if reply:
            said.append((Direction.RECEIVED, with_crc(bytes.fromhex(reply))))
    return said


@pytest.mark.parametrize("piece", [1, 3, 1000])
def test_requests_and_replies_are_distinguished_for_any_chunks(piece: int) -> None:
    directions = Directions("rtu")
    stream = b"".join(data for _, data in frames())
    found = [
        each for at in range(0, len(stream), piece) for each in directions.feed(stream[at : at + piece], 1000 * at)
    ]
    found += directions.flush()
    assert [(direction, frame.raw) for direction, frame in found] == frames()


def test_a_line_between_other_devices_becomes_a_recording(tmp_path: Path) -> None:
    """The program listens on a pty that receives the frames of both sides, as an RS-485 adapter does."""

    async def main() -> None:
        port = Endpoint.parse(f"rtu:{tmp_path / 'bus'}?baudrate=19200&frame=8E1")
        end = await PtyEnd.open(tmp_path / "bus", port)
        out = tmp_path / "line.jsonl"
        words = [sys.executable, "-m", "fieldtwin", "record", "--sniff", str(port), "-o", str(out), "--json"]
        program = await asyncio.create_subprocess_exec(
            *words, stdout=asyncio.subprocess.PIPE, stderr=asyncio.subprocess.PIPE
        )
        assert program.stderr is not None
        raw = tmp_path / "line.tap.jsonl"
        try:
            assert b"listening" in await program.stderr.readline()
            for _, data in frames():
                await end.write(data)
                await asyncio.sleep(0.01)
            await eventually(lambda: raw.exists() and raw.read_text().count("hex") == len(frames()), within_s=60)
            program.send_signal(signal.SIGINT)
            stdout, stderr = await program.communicate()
        finally:
            if program.returncode is None:
                program.kill()
            await end.aclose()
        said = json.loads(stdout)
        assert program.returncode == 0, stderr
        assert (said["exchanges"], said["unanswered"], said["strays"], said["malformed"]) == (7, 1, 0, 0)
        found = [
            (bytes((e.unit,)) + e.request, bytes((e.unit,)) + e.reply if e.reply else b"") for e in exchanges_of(out)
        ]
        assert found == [(bytes.fromhex(request), bytes.fromhex(reply)) for request, reply in TALK]

    run(main())
