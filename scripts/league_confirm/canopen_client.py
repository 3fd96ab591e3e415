"""Repeat a failed case of an SDO client without fieldtwin: ``canopen_client.py CASE can PROGRAM ARGUMENT...``.

The program's bus is a TCP connection with a line for each frame. Node 5 answers uploads correctly with 1111, then oddly
as the case says, with 3333 in every frame that the client must refuse, then correctly with 2222. The result is one JSON
object: `confirmed` is true if the client did what it must not. Exit status 3: this program has no such case.
"""

from __future__ import annotations

import json
import os
import socket
import sys
import threading
import time
from collections.abc import Callable

from modbus_client import FIRST, POISON, RECOVERY_S, SECOND, TIMEOUT_S, Program, until

REQUEST, REPLY = "605", "585"
Step = tuple[str, bytes] | float
"""A frame (identifier, data), or seconds to wait."""


def expedited(request: bytes, value: int, command: int = 0x43) -> bytes:
    return bytes((command,)) + request[1:4] + value.to_bytes(4, "little")


def segmented(request: bytes, node: Node, segment: Callable[[int], bytes]) -> list[Step]:
    if request[0] == 0x40:
        node.segments = 0
        return [(REPLY, b"\x41" + request[1:4] + (14).to_bytes(4, "little"))]
    node.segments += 1
    return [(REPLY, segment(node.segments))]


WORD = POISON.to_bytes(4, "little").ljust(7, b"\0")
ABORT = bytes.fromhex("8000200022000008")
CASES: dict[str, tuple[int, str, Callable[[bytes, Node], list[Step]]]] = {
    "CO-001": (2, "03000305", lambda r, n: segmented(r, n, lambda at: bytes((1 if at > 1 else 0,)) + WORD)),
    "CO-002": (
        2,
        "",
        lambda r, n: segmented(
            r, n, lambda at: b"\0" + WORD if at == 1 else b"\x80\0\x20\0" + bytes.fromhex("22000008")
        ),
    ),
    "CO-004": (1, "01000405 00000405", lambda r, n: [(REPLY, b"\xe0" + expedited(r, POISON)[1:])]),
    "CO-005": (3, "", lambda r, n: [(REPLY, bytes((0x43, r[1] ^ 1)) + expedited(r, POISON)[2:])]),
    "CO-008": (3, "", lambda r, n: [(REPLY, b"\x80" + r[1:4] + bytes.fromhex("00000206"))]),
    "CO-013": (2, "", lambda r, n: segmented(r, n, lambda at: bytes((0x07,)) + WORD)),
    "CO-014a": (1, "02000405", lambda r, n: [(REPLY, b"\xa4" + r[1:4] + b"\0\0\0\0")]),
    "CO-014b": (1, "02000405", lambda r, n: [(REPLY, b"\xa4" + r[1:4] + b"\x80\0\0\0")]),
    "CO-022": (3, "", lambda r, n: [0.6 * TIMEOUT_S, (REPLY, expedited(r, SECOND))]),
    "CO-023": (1, "", lambda r, n: [1.5 * TIMEOUT_S, (REPLY, expedited(r, POISON))]),
    "CO-026": (3, "", lambda r, n: [(REPLY, expedited(r, FIRST)[:7])]),
    "CO-027": (3, "", lambda r, n: [0.05, ("705", b"\0")]),
    "CO-030": (
        3,
        "",
        lambda r, n: [(REPLY, b"\x41" + r[1:4] + bytes(4))] if r[0] == 0x40 else [(REPLY, b"\x0f" + bytes(7))],
    ),
    "CO-042": (3, "", lambda r, n: [(REPLY, expedited(r, FIRST)), 0.003, (REPLY, expedited(r, POISON))]),
    "CO-060": (3, "", lambda r, n: [("00000585", expedited(r, POISON))]),
}
"""How many requests are answered oddly, the abort codes of which the client must send one (as on the bus), and the frames."""


class Node:
    """Node 5 on the line of the program."""

    def __init__(self) -> None:
        self.listener = socket.create_server(("127.0.0.1", 0))
        self.environment = {**os.environ, "FIELDTWIN_CAN_LINE": f"127.0.0.1:{self.listener.getsockname()[1]}"}
        self.value, self.case, self.strikes, self.segments = FIRST, "", 0, 0
        self.block = 0
        self.log: list[str] = []
        self.aborts: list[str] = []
        self.times: list[float] = []
        threading.Thread(target=self.serve, daemon=True).start()

    def serve(self) -> None:
        self.link, _ = self.listener.accept()
        self.link.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        for line in self.link.makefile("r"):
            digits, _, data = line.strip().partition("#")
            if digits == REQUEST and not data.startswith("R"):
                self.handle(bytes.fromhex(data))

    def send(self, identifier: str, data: bytes) -> None:
        self.link.sendall(f"{identifier}#{data.hex().upper()}\n".encode())

    def handle(self, request: bytes) -> None:
        if self.block:
            self.segment(request)
            return
        if request[0] == 0x80:
            self.aborts.append(request[4:].hex())
            if self.log:
                self.log.append(f"< {REQUEST}#{request.hex().upper()}")
            return
        self.times.append(time.monotonic())
        download = request[0] >> 5 == 6
        wanted = download if self.case.startswith("CO-014") else request[0] in (0x40, 0x60, 0x70)
        if self.strikes and wanted:
            self.strikes -= 1
            for step in CASES[self.case][2](request, self):
                if isinstance(step, float):
                    time.sleep(step)
                else:
                    self.log.append(f"< {REQUEST}#{request.hex().upper()}; > {step[0]}#{step[1].hex().upper()}")
                    self.send(*step)
            return
        if request[0] == 0x40:
            self.send(REPLY, expedited(request, self.value))
        elif download and not request[0] & 1:
            self.block = 1
            self.send(REPLY, b"\xa4" + request[1:4] + b"\x7f\0\0\0")
        elif download:
            self.send(REPLY, b"\xa1" + bytes(7))
        elif request[0] >> 5 == 5:
            self.upload_block(request)
        else:
            self.send(REPLY, b"\x80" + request[1:4] + bytes.fromhex("01000405"))

    def segment(self, frame: bytes) -> None:
        """Acknowledge the segments of a block download."""
        if frame[0] & 0x80 or frame[0] == 0x7F:
            self.block = 0
            self.send(REPLY, bytes((0xA2, frame[0] & 0x7F, 0x7F)) + bytes(5))

    def upload_block(self, request: bytes) -> None:
        """Send 7 bytes as a block upload."""
        data = self.value.to_bytes(4, "little").ljust(7, b"\0")
        if request[0] & 3 == 0:
            self.send(REPLY, b"\xc2" + request[1:4] + (7).to_bytes(4, "little"))
        elif request[0] & 3 == 3:
            self.send(REPLY, b"\x81" + data)
        elif request[0] & 3 == 2:
            self.send(REPLY, b"\xc1" + bytes(7))


def play(case: str, node: Node, program: Program) -> tuple[bool, str]:
    if not until(lambda: program.saw(FIRST) and len(node.times) >= 3, 15.0):
        return False, "the program never printed a correct answer"
    time.sleep(0.5)
    count, codes, _ = CASES[case]
    found = []
    begun = time.monotonic()
    node.aborts.clear()
    node.case, node.strikes = case, count
    until(lambda: node.strikes == 0, 5.0)
    time.sleep(2 * TIMEOUT_S)
    node.strikes, node.value, over = 0, SECOND, time.monotonic()
    if not node.log:
        return False, "the program sent no request of this kind"
    if codes and not set(codes.split()) & set(node.aborts):
        found.append(
            f"sent {', '.join(node.aborts) or 'no abort'} instead of an abort with {codes.split()[0]} (as on the bus)"
        )
    if not until(lambda: program.saw(SECOND, over), RECOVERY_S):
        found.append(f"printed no correct answer within {RECOVERY_S:g} s afterwards")
    time.sleep(0.5)
    if program.saw(POISON, begun):
        found.append("printed 3333, the value of the invalid frame")
    if case == "CO-030" and program.saw(0, begun):
        found.append("printed 0, although no byte was transferred")
    said = [text for t, text in program.printed if t >= begun][:8]
    return bool(found), "; ".join([*found, f"printed {', '.join(said) or 'nothing'}"])


def main() -> int:
    case, _, *words = sys.argv[1:]
    if case not in CASES:
        return 3
    node = Node()
    program = Program(words, node.environment)
    try:
        confirmed, observed = play(case, node, program)
    finally:
        program.end()
    print(json.dumps({"confirmed": confirmed, "sent": "; ".join(node.log[:6]), "observed": observed}), flush=True)
    os._exit(0)


if __name__ == "__main__":
    sys.exit(main())
