"""`fieldtwin record` when nothing arrives: the message, the exit code, and no empty file."""

from __future__ import annotations

import asyncio
import json
import os
import re
import subprocess
import sys
import tty
from pathlib import Path

from support import eventually, run

from fieldtwin.emulators.endpoints.can.bus_server import SoftBusServer
from fieldtwin.gateway.core.endpoint import Endpoint

WRITE_ONLY = """device: test/valve
source: "a test"
protocol: modbus
tags:
  open: {at: 40001, type: uint16, access: wo}
"""


async def begin(folder: Path, *words: str) -> asyncio.subprocess.Process:
    return await asyncio.create_subprocess_exec(
        sys.executable, "-m", "fieldtwin", "record", *words,
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, cwd=folder,
    )  # fmt: skip


async def record(folder: Path, *words: str) -> tuple[int | None, str, str]:
    """Return exit code, stdout and stderr of ``fieldtwin record WORDS``."""
    program = await begin(folder, *words)
    out, err = await program.communicate()
    return program.returncode, out.decode(), err.decode()


def test_a_can_recording_without_a_frame_says_what_to_check_and_leaves_no_file(tmp_path: Path) -> None:
    async def main() -> None:
        server = await SoftBusServer.open(Endpoint.parse("can:fieldtwin/127.0.0.1:0"), 125_000)
        words = (str(server.bound), "--for", "300ms", "-o", "bus.log")
        try:
            for _ in range(2):  # the name is free for the second attempt
                code, out, err = await record(tmp_path, *words)
                assert code == 1
                assert out == ""
                assert re.search(rf"nothing was recorded: no frame arrived at {server.bound} in \d\.\d s; check", err)
                assert "the bit rate, the wiring with its termination, and whether a node sends" in err
                assert not (tmp_path / "bus.log").exists()
            code, out, _ = await record(tmp_path, *words, "--json")
        finally:
            await server.aclose()
        said = json.loads(out)
        assert (code, said["frames"], said["parts"]) == (1, 0, [])
        assert said["seconds"] >= 0.3
        assert "no frame arrived" in said["notes"][0]

    run(main(), timeout_s=60)


def test_a_silent_line_was_not_recorded(tmp_path: Path) -> None:
    async def main() -> None:
        near, far = os.openpty()
        try:
            code, out, err = await record(
                tmp_path, "--sniff", f"rtu:{os.ttyname(far)}", "--for", "300ms", "-o", "l.jsonl"
            )
        finally:
            os.close(near)
            os.close(far)
        assert (code, out) == (1, "")
        assert "nothing was recorded: no byte passed" in err
        assert list(tmp_path.iterdir()) == []

    run(main(), timeout_s=60)


def test_bytes_without_a_request_are_no_recording_but_are_kept(tmp_path: Path) -> None:
    async def main() -> None:
        near, far = os.openpty()
        tty.setraw(far)
        try:
            program = await begin(tmp_path, "--sniff", f"rtu:{os.ttyname(far)}", "-o", "l.jsonl")
            assert program.stderr is not None
            assert b"listening" in await program.stderr.readline()
            os.write(near, b"\xff\x00\xfe")
            raw = tmp_path / "l.tap.jsonl"
            await eventually(lambda: raw.exists() and b"ff00fe" in raw.read_bytes(), what="the bytes are written")
            program.terminate()
            out, err = await program.communicate()
        finally:
            os.close(near)
            os.close(far)
        assert program.returncode == 1
        assert b"nothing was recorded: 3 bytes passed, but no request" in err
        assert b"l.tap.jsonl" in out
        assert not (tmp_path / "l.jsonl").exists()

    run(main(), timeout_s=60)


def test_a_profile_without_a_readable_tag_records_nothing(tmp_path: Path) -> None:
    (tmp_path / "valve.yaml").write_text(WRITE_ONLY)

    async def main() -> None:
        async def say_nothing(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
            await reader.read()
            writer.close()

        server = await asyncio.start_server(say_nothing, "127.0.0.1", 0)
        url = f"tcp://127.0.0.1:{server.sockets[0].getsockname()[1]}"
        try:
            words = ("--profile", "valve.yaml", "--rounds", "1", "--every", "10ms", "-o", "v.jsonl")
            code, _, err = await record(tmp_path, url, *words)
        finally:
            server.close()
            await server.wait_closed()
        assert code == 1
        assert "nothing was recorded: no request was sent" in err
        assert not (tmp_path / "v.jsonl").exists()

    run(main(), timeout_s=60)
