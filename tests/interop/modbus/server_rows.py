"""Run the rows of tests/vectors/modbus_server.toml on third-party servers, over real ptys and sockets, all at the same
time.

Only behaviour visible to a client is tested: bytes, pauses, readable cells, and whether the wire is still usable
afterwards. Counters, strict timing and our own settings are not. Each deviation of a peer is described in one line that
is the same each time.
"""

from __future__ import annotations

import asyncio
import json
import os
import socket
import sys
import tomllib
import tty
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from fieldtwin.gateway.protocols.modbus.frames.ascii import lrc
from fieldtwin.gateway.protocols.modbus.frames.crc import with_crc

HERE = Path(__file__).parent
SERVERS = HERE.parents[2] / "scripts" / "league_programs" / "servers.py"
VECTORS = HERE.parents[1] / "vectors"
PEERS = {"pymodbus": ("rtu", "ascii", "mbap", "udp"), "libmodbus": ("rtu", "mbap")}
"""The wires that each peer can serve."""
REPLY_WITHIN_S = 1.5
SILENCE_S = 0.5
STAGGER_S = 0.01
"""Interval between the starts of two rows. With many simultaneous rows, a peer would seem slow to answer."""
PAUSE_S = 0.8
"""Longer than any peer waits for the rest of a frame."""
APART_S = 0.1
"""Minimum pause between two pieces that a row separates, so that the result does not depend on the machine's load."""
READ_COIL = b"\x01\x00\x00\x00\x01"

Row = dict[str, Any]


def load_rows() -> list[Row]:
    rows: list[Row] = tomllib.loads((VECTORS / "modbus_server.toml").read_text())["vector"]
    return rows


def wire_of(row: Row) -> str:
    return str(row.get("wire", "rtu"))


def asked_of(peer: str, row: Row, not_asked: dict[str, str]) -> bool:
    """Return whether the row applies to the peer: the peer has the wire, and the row needs no setting of our emulator."""
    own = {"even_only", "max_in_flight"} & set(row)
    return wire_of(row) in PEERS[peer] and not own and row["id"] not in not_asked


def to_bytes(row: Row, text: str) -> bytes:
    return text.encode() if wire_of(row) == "ascii" else bytes.fromhex(text)


def shown(row: Row, data: bytes | bytearray) -> str:
    text = data.decode("latin-1") if wire_of(row) == "ascii" else data[:16].hex(" ")
    return text.strip()[:47] + (f" and {len(data) - 16} more" if len(data) > 16 and wire_of(row) != "ascii" else "")


def framed(row: Row, pdu: bytes) -> bytes:
    """Return a request to unit 1 in the row's framing."""
    if wire_of(row) in ("mbap", "udp"):
        return b"\x77\x77\x00\x00" + (len(pdu) + 1).to_bytes(2, "big") + b"\x01" + pdu
    frame = b"\x01" + pdu
    if wire_of(row) == "rtu":
        return with_crc(frame)
    return b":" + (frame + bytes([lrc(frame)])).hex().upper().encode() + b"\r\n"


class Wire:
    """Our side of a pty or a connected socket, as a file descriptor, with the received bytes and whether it is closed."""

    def __init__(self, fd: int) -> None:
        self.fd = fd
        self.heard = bytearray()
        self.closed = False
        self._more = asyncio.Event()
        os.set_blocking(fd, False)
        asyncio.get_running_loop().add_reader(fd, self._hear)

    def _hear(self) -> None:
        try:
            data = os.read(self.fd, 4096)
        except OSError:
            data = b""
        self.heard += data
        if not data:
            self.closed = True
            asyncio.get_running_loop().remove_reader(self.fd)
        self._more.set()

    def send(self, data: bytes) -> None:
        try:
            os.write(self.fd, data)
        except OSError:
            self.closed = True

    async def take(self, count: int) -> bytes:
        """Return the received bytes when they are at least `count`, the wire is closed or the time is over."""
        try:
            async with asyncio.timeout(REPLY_WITHIN_S):
                while len(self.heard) < count and not self.closed:
                    self._more.clear()
                    await self._more.wait()
            await asyncio.sleep(APART_S)  # also collects surplus bytes
        except TimeoutError:
            pass
        data = bytes(self.heard)
        self.heard.clear()
        return data

    def close(self) -> None:
        asyncio.get_running_loop().remove_reader(self.fd)


class Play:
    """Run one row on one server."""

    def __init__(self, row: Row, wire: Wire) -> None:
        self.row, self.wire = row, wire

    async def after(self, delay_s: float) -> str:
        """Run `difference`, delayed."""
        await asyncio.sleep(delay_s)
        return await self.difference()

    async def difference(self) -> str:
        """Return the deviation of the server from the row; empty if there is none."""
        said_ms = 0.0
        for step in self.row["steps"]:
            if step["at_ms"] > said_ms:
                await asyncio.sleep(max(APART_S, (step["at_ms"] - said_ms) / 1000))
                said_ms = step["at_ms"]
            if self.wire.heard:
                return f"sends {shown(self.row, self.wire.heard)} unasked"
            await self.send(to_bytes(self.row, step["hear"]))
            wanted = b"".join(to_bytes(self.row, text) for text in step["say"])
            if wanted and (found := await self.wire.take(len(wanted))) != wanted:
                return f"{self.said(found)} instead of {shown(self.row, wanted)}"
        await asyncio.sleep(SILENCE_S)
        if self.wire.heard:
            # the same text as above, because the load decides which of the two detects it
            return f"sends {shown(self.row, self.wire.heard)} unasked"
        return await self.afterwards() or await self.cells()

    def said(self, data: bytes) -> str:
        if data:
            return shown(self.row, data)
        return "closes the connection" if self.wire.closed else "silent"

    async def send(self, data: bytes) -> None:
        """Send in one piece, or byte by byte if the row tests that."""
        size = 1 if "byte by byte" in self.row["id"] else 1000
        for i in range(0, len(data), size):
            self.wire.send(data[i : i + size])
            await asyncio.sleep(0.003 if size == 1 else 0)

    async def ask(self, pdu: bytes) -> bytes:
        request = framed(self.row, pdu)
        self.wire.send(request)
        return await self.wire.take(len(framed(self.row, pdu[:1] + b"\x01\x00" + b"\x00" * (pdu[0] == 3))))

    async def afterwards(self) -> str:
        """Return whether a request after a pause is answered; if the row says `closed`, it must not be."""
        await asyncio.sleep(PAUSE_S)
        answer = await self.ask(READ_COIL)
        if self.row.get("closed"):
            return f"goes on with {shown(self.row, answer)}" if answer else ""
        head = framed(self.row, b"\x01\x01\x00")
        if len(answer) == len(head):
            return ""
        return f"afterwards {self.said(answer)}"

    async def cells(self) -> str:
        """Return whether the readable cells of unit 1 have the values of the row."""
        for table, function in (("coil", 1), ("holding", 3)):
            for address, value in self.row.get(table, []):
                answer = await self.ask(bytes([function]) + address.to_bytes(2, "big") + b"\x00\x01")
                data = bytes([1, value]) if function == 1 else b"\x02" + value.to_bytes(2, "big")
                if answer != framed(self.row, bytes([function]) + data):
                    return f"{table} {address}: {self.said(answer)} instead of {value}"
        return ""


class Stage:
    """The wires of all rows, and the program that serves them."""

    def __init__(self, peer: str, rows: list[Row], stack: ExitStack) -> None:
        self.peer, self.rows, self.stack = peer, rows, stack
        self.lines: dict[int, int] = {}

    def jobs(self) -> list[dict[str, Any]]:
        return [
            {"row": n, "wire": wire_of(row), "line": self.line(n, row), "units": row.get("units", [1])}
            for n, row in enumerate(self.rows)
        ]

    def line(self, number: int, row: Row) -> str:
        """A pty for the row. Its far side remains open here, so that no peer sees a hang-up."""
        if wire_of(row) not in ("rtu", "ascii"):
            return ""
        near, far = os.openpty()
        tty.setraw(far)
        for fd in (near, far):
            self.stack.callback(os.close, fd)
        self.lines[number] = near
        return os.ttyname(far)

    def wire(self, number: int, port: int) -> Wire:
        if number in self.lines:
            wire = Wire(self.lines[number])
        else:
            kind = socket.SOCK_DGRAM if wire_of(self.rows[number]) == "udp" else socket.SOCK_STREAM
            connected = self.stack.enter_context(socket.socket(socket.AF_INET, kind))
            connected.connect(("127.0.0.1", port))
            if kind == socket.SOCK_STREAM:
                connected.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            wire = Wire(connected.fileno())
        self.stack.callback(wire.close)
        return wire


async def play_on(peer: str, rows: list[Row]) -> dict[str, str]:
    """Return the deviations of `peer` by row; '' for rows that pass."""
    with ExitStack() as stack:
        stage = Stage(peer, rows, stack)
        jobs = json.dumps(stage.jobs()).encode() + b"\n"
        program = await asyncio.create_subprocess_exec(
            sys.executable, str(SERVERS), peer, stdin=asyncio.subprocess.PIPE, stdout=asyncio.subprocess.PIPE
        )  # fmt: skip
        assert program.stdin is not None
        assert program.stdout is not None
        try:
            program.stdin.write(jobs)
            async with asyncio.timeout(60):
                ready = [tuple(map(int, (await program.stdout.readline()).split())) for _ in rows]
                plays = [Play(rows[number], stage.wire(number, port)) for number, port in ready]
                found = await asyncio.gather(*(play.after(n * STAGGER_S) for n, play in enumerate(plays)))
        finally:
            program.stdin.close()
            await program.wait()
        return {play.row["id"]: difference for play, difference in zip(plays, found, strict=True)}
