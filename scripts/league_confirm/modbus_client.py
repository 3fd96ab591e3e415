"""Repeat a failed case of a Modbus client without fieldtwin: ``modbus_client.py CASE tcp|rtu|ascii PROGRAM ARGUMENT...``.

A socket or pty answers the program correctly with 1111, then oddly as the case says, with 3333 in every frame that the
client must refuse, then correctly again. The output and the requests of the program decide. The result is one JSON object:
`confirmed` is true if the client did what it must not. Exit status 3: this program has no such case.
"""

from __future__ import annotations

import json
import os
import pty
import select
import signal
import socket
import struct
import subprocess
import sys
import tempfile
import threading
import time
import tty
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

FIRST, SECOND, POISON = 1111, 2222, 3333
TIMEOUT_S = float(os.environ.get("LEAGUE_TIMEOUT_S", "0.15"))
"""The timeout of the league's programs."""
RECOVERY_S, PHASE_S = 6.0, 2.0 + 7 * TIMEOUT_S
Step = bytes | float | str
"""Bytes to send, seconds to wait, or ``close``, ``reset``, ``mute`` (never answer this connection again), ``unplug``."""


def crc(frame: bytes) -> bytes:
    value = 0xFFFF
    for byte in frame:
        value ^= byte
        for _ in range(8):
            value = value >> 1 ^ (0xA001 if value & 1 else 0)
    return struct.pack("<H", value)


@dataclass
class Request:
    """A read request as it arrived."""

    wire: str
    tag: int
    unit: int
    pdu: bytes

    @property
    def count(self) -> int:
        return int.from_bytes(self.pdu[3:5], "big")

    def values(self, value: int, more: int = 0) -> bytes:
        """Return the PDU of a correct answer, with `more` registers than were requested."""
        count = self.count + more
        return bytes((self.pdu[0], 2 * count)) + value.to_bytes(2, "big") * count

    def frame(
        self, pdu: bytes, unit: int | None = None, tag: int | None = None, protocol: int = 0, length: int | None = None
    ) -> bytes:
        body = bytes((self.unit if unit is None else unit,)) + pdu
        if self.wire == "tcp":
            size = len(body) if length is None else length
            return struct.pack(">HHH", self.tag if tag is None else tag, protocol, size) + body
        if self.wire == "rtu":
            return body + crc(body)
        return b":" + (body + bytes((-sum(body) & 0xFF,))).hex().upper().encode() + b"\r\n"


def pieces(frame: bytes, size: int, pause_s: float) -> list[Step]:
    steps: list[Step] = []
    for at in range(0, len(frame), size):
        steps += [frame[at : at + size], pause_s]
    return steps


def bad(frame: bytes, wire: str) -> bytes:
    """Return the frame with a wrong check sum."""
    return (
        frame[:-3] + (b"0" if frame[-3:-2] != b"0" else b"1") + frame[-2:]
        if wire == "ascii"
        else frame[:-1] + bytes((frame[-1] ^ 0xFF,))
    )


def poison(q: Request, more: int = 0) -> bytes:
    return q.values(POISON, more)


def good(q: Request) -> bytes:
    return q.frame(q.values(SECOND))


def odd_function(q: Request) -> bytes:
    return q.frame(bytes((7 - q.pdu[0],)) + poison(q)[1:])


REFUSE: dict[str, tuple[int, Callable[[Request], list[Step]]]] = {
    "MB-002": (3, lambda q: [bad(q.frame(poison(q)), q.wire)]),
    "MB-003": (3, lambda q: [q.frame(poison(q))[: len(q.frame(poison(q))) // 2]]),
    "MB-005": (3, lambda q: [q.frame(q.values(FIRST))[:4], 0.01, q.frame(q.values(FIRST))[4:]]),
    "MB-007": (3, lambda q: [q.frame(poison(q), unit=q.unit + 1) + q.frame(q.values(FIRST))]),
    "MB-011": (3, lambda q: [bytes((q.unit, q.pdu[0] ^ 0x40)) + q.frame(q.pdu)[2:]]),
    "MB-013": (1, lambda q: [1.5 * TIMEOUT_S, q.frame(poison(q))]),
    "MB-014": (3, lambda q: [q.frame(q.values(FIRST)), 0.003, q.frame(poison(q))]),
    "MB-015a": (3, lambda q: [q.frame(poison(q), unit=q.unit + 1)]),
    "MB-016": (3, lambda q: [odd_function(q)]),
    "MB-017a": (3, lambda q: [q.frame(poison(q, -1))]),
    "MB-017b": (3, lambda q: [q.frame(poison(q, 1))]),
    "MB-018a": (3, lambda q: [q.frame(bytes((q.pdu[0], 255)) + poison(q)[2:])]),
    "MB-018b": (3, lambda q: [q.frame(bytes((q.pdu[0], 2 * q.count + 1)) + poison(q)[2:] + b"\x0d")]),
    "MB-022": (3, lambda q: [q.frame(bytes((q.pdu[0] | 0x80, 0x50)))]),
    "MB-023": (3, lambda q: [q.frame(bytes((q.pdu[0] | 0x80, 5)))]),
    "MB-024": (4, lambda q: [q.frame(bytes((q.pdu[0] | 0x80, 6)))]),
    "MB-054a": (3, lambda q: [q.frame(poison(q), protocol=1)]),
    "MB-055a": (3, lambda q: [q.frame(poison(q), length=0)]),
    "MB-055b": (3, lambda q: [q.frame(poison(q), length=1)]),
    "MB-055c": (3, lambda q: [q.frame(poison(q), length=0xFFFF)]),
    "MB-056a": (3, lambda q: [q.frame(poison(q), tag=0x1234)]),
    "MB-056b": (3, lambda q: [q.frame(poison(q), tag=0)]),
    "MB-064a": (3, lambda q: [q.frame(poison(q))[:5], "reset"]),
    "MB-064b": (3, lambda q: ["close"]),
    "MB-064c": (1, lambda q: ["mute"]),
    "MB-065a": (3, lambda q: [q.frame(q.values(FIRST)), 0.005, "close"]),
    "MB-066": (1, lambda q: ["unplug"]),
    "MB-068": (3, lambda q: [bytes.fromhex("e6 80 9f fe 66 78 00 f8 1e")]),
    "MB-069": (3, lambda q: [bytes(a | b for a, b in zip(q.frame(poison(q)), crc(b"other") * 8, strict=False))]),
    "MB-070a": (3, lambda q: [bad(q.frame(poison(q)), q.wire)]),
    "MB-070c": (2, lambda q: [q.frame(poison(q))[:9], 1.2, q.frame(poison(q))[9:]]),
}
"""How often the case answers oddly, and how. The client must not print 3333, and must accept a correct answer afterwards."""

ACCEPT: dict[str, Callable[[Request], list[Step]]] = {
    "MB-006": lambda q: pieces(good(q), -(-len(good(q)) // 4), 0.016),
    "MB-008": lambda q: [b"\x00\xff\x00" + good(q)],
    "MB-009": lambda q: [good(q) + b"\0\0"],
    "MB-015b": lambda q: [q.frame(poison(q), unit=q.unit + 1), 0.025, good(q)],
    "MB-051": lambda q: pieces(good(q), 1, 0.001),
    "MB-052": lambda q: [q.frame(poison(q), tag=0x1234) + good(q)],
    "MB-054b": lambda q: [q.frame(poison(q), protocol=1) + good(q)],
    "MB-056c": lambda q: [q.frame(poison(q), tag=0x1234), 0.01, good(q)],
    "MB-070b": lambda q: [good(q)[:9] + good(q)],
}
"""The client must print 2222 from these answers, and no 3333."""


def spelled(step: Step) -> str:
    return step.hex(" ") if isinstance(step, bytes) else f"{step * 1000:g} ms" if isinstance(step, float) else step


class Stage:
    """The server: it answers correctly, then `strikes` times as the case says, then correctly again."""

    def __init__(self, wire: str, folder: Path) -> None:
        self.wire, self.folder, self.line = wire, folder, folder / "line"
        self.value, self.strikes, self.answer = FIRST, 0, None
        self.requests: list[float] = []
        self.struck: list[float] = []
        self.sent = ""
        self.muted: set[int] = set()
        self.open: set[socket.socket] = set()
        self.came = self.early = 0
        self.environment = dict(os.environ)
        if wire == "tcp":
            self.listener = socket.create_server(("127.0.0.1", 0))
            self.port = self.listener.getsockname()[1]
            self.environment |= {"FIELDTWIN_HOST": "127.0.0.1", "FIELDTWIN_PORT": str(self.port)}
            threading.Thread(target=self.accept, daemon=True).start()
        else:
            self.environment["FIELDTWIN_TTY"] = str(self.line)
            self.plug()
            threading.Thread(target=self.serve_line, daemon=True).start()

    def plug(self) -> None:
        self.master, far = pty.openpty()
        tty.setraw(far)
        self.far = far
        self.line.symlink_to(os.ttyname(far))

    def unplug(self) -> None:
        self.line.unlink()
        for fd in (self.far, self.master):
            os.close(fd)
        time.sleep(1.0)
        self.plug()

    def accept(self) -> None:
        while True:
            connection, _ = self.listener.accept()
            connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            threading.Thread(target=self.serve_connection, args=(connection,), daemon=True).start()

    def serve_connection(self, connection: socket.socket) -> None:
        pending = b""
        self.open.add(connection)
        self.came += 1
        try:
            while chunk := connection.recv(4096):
                pending += chunk
                while len(pending) >= 12:
                    tag, unit, pdu, pending = (
                        int.from_bytes(pending[:2], "big"),
                        pending[6],
                        pending[7:12],
                        pending[12:],
                    )
                    self.handle(Request("tcp", tag, unit, pdu), connection.sendall, connection)
        except OSError:
            pass
        self.open.discard(connection)
        connection.close()

    def serve_line(self) -> None:
        pending = b""
        while True:
            try:
                if not select.select([self.master], [], [], 0.05)[0]:
                    continue
                pending += os.read(self.master, 4096)
            except (OSError, ValueError):
                time.sleep(0.05)
                continue
            size = 8 if self.wire == "rtu" else 17
            while len(pending) >= size:
                whole, pending = pending[:size], pending[size:]
                body = whole if self.wire == "rtu" else bytes.fromhex(whole[1:-2].decode())
                self.handle(Request(self.wire, 0, body[0], body[1:6]), lambda data: self.write(data), None)

    def write(self, data: bytes) -> None:
        os.write(self.master, data)

    def handle(self, request: Request, send: Callable[[bytes], object], connection: socket.socket | None) -> None:
        self.requests.append(time.monotonic())
        if id(connection) in self.muted:
            return
        if not self.strikes or self.answer is None:
            send(request.frame(request.values(self.value)))
            return
        self.strikes -= 1
        self.struck.append(time.monotonic())
        steps = self.answer(request)
        self.sent = self.sent or "; ".join(map(spelled, steps))
        for step in steps:
            if isinstance(step, float):
                time.sleep(step)
                self.early += connection is None and bool(select.select([self.master], [], [], 0)[0])
            elif isinstance(step, bytes):
                send(step)
            elif step == "mute":
                self.muted.add(id(connection))
            elif step == "unplug":
                self.unplug()
            elif connection is not None:
                if step == "reset":
                    connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
                else:
                    connection.shutdown(socket.SHUT_RDWR)
                connection.close()
                raise OSError("closed")


class Program:
    """The client, and what it printed."""

    def __init__(self, words: list[str], environment: dict[str, str]) -> None:
        self.printed: list[tuple[float, str]] = []
        self.process = subprocess.Popen(
            words, env=environment, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True, start_new_session=True
        )
        threading.Thread(target=self.read, daemon=True).start()

    def read(self) -> None:
        assert self.process.stdout is not None
        for line in self.process.stdout:
            self.printed.append((time.monotonic(), line.strip()))

    def saw(self, value: int, since: float = 0.0) -> bool:
        return any(t >= since and str(value) in text.split() for t, text in list(self.printed))

    def end(self) -> None:
        try:
            os.killpg(self.process.pid, signal.SIGKILL)
        except ProcessLookupError:
            pass
        self.process.wait()


def until(condition: Callable[[], bool], within_s: float) -> bool:
    end = time.monotonic() + within_s
    while not condition() and time.monotonic() < end:
        time.sleep(0.01)
    return condition()


def most_in_a_second(times: list[float]) -> int:
    return max((sum(t <= other < t + 1 for other in times) for t in times), default=0)


def exception_timing(stage: Stage) -> tuple[bool, str]:
    """MB-021: two exceptions, at once and half a timeout after the request. A client that waits for its timeout after both asks
    again as late in both cases."""
    gaps = []
    for delay in (0.0, TIMEOUT_S / 2):
        stage.answer = lambda q, delay=delay: [delay, q.frame(bytes((q.pdu[0] | 0x80, 4)))]  # type: ignore[assignment, misc]
        count = len(stage.struck)
        stage.strikes = 1
        until(lambda count=count: len(stage.struck) > count and stage.requests[-1] > stage.struck[-1] + 0.005, 3.0)  # type: ignore[misc]
        gaps.append(stage.requests[-1] - stage.struck[-1])
        time.sleep(0.5)
    late = gaps[0] > 0.7 * TIMEOUT_S and abs(gaps[0] - gaps[1]) < 0.05
    return (
        late,
        f"next request {gaps[0] * 1000:.0f} ms after the first refused one, {gaps[1] * 1000:.0f} ms after the second",
    )


def connections(stage: Stage, program: Program) -> tuple[bool, str]:
    """MB-065b: connections are reset, closed and left unanswered in turn; afterwards the client must not hold many of them."""
    for case in ("MB-064a", "MB-064b", "MB-064c", "MB-065a"):
        count, stage.answer = REFUSE[case]
        stage.strikes = count
        until(lambda: stage.strikes == 0, PHASE_S)
        time.sleep(2.0)
    return len(stage.open) > 3, f"{len(stage.open)} connections are open, of {stage.came} that the client opened"


def play(case: str, stage: Stage, program: Program) -> tuple[bool, str]:
    if not until(lambda: program.saw(FIRST) and len(stage.requests) >= 3, 15.0):
        return False, "the program never printed a correct answer"
    time.sleep(1.0)
    usual = most_in_a_second(stage.requests[-50:])
    if case == "MB-065b":
        return connections(stage, program)
    if case == "MB-021":
        return exception_timing(stage)
    found = []
    begun = time.monotonic()
    if case in ACCEPT:
        stage.answer, stage.strikes = ACCEPT[case], 1_000_000
        if not until(lambda: program.saw(SECOND, begun) and len(stage.struck) >= 6, PHASE_S):
            found.append("never printed 2222, the value of the valid frame" if not program.saw(SECOND, begun) else "")
        if case == "MB-015b" and stage.early:
            found.append(f"asked again {stage.early} times before its own frame came")
        stage.strikes, last = 0, FIRST
    else:
        count, stage.answer = REFUSE[case]
        stage.strikes, last = count, SECOND
        until(lambda: stage.strikes == 0, PHASE_S + count * TIMEOUT_S)
    stage.value = last
    over = time.monotonic()
    if not until(lambda: program.saw(last, over), RECOVERY_S):
        ended = program.process.poll()
        why = f": it had ended with {ended}" if ended is not None else ""
        found.append(f"printed no correct answer within {RECOVERY_S:g} s afterwards{why}")
    time.sleep(0.5)
    if program.saw(POISON, begun):
        found.append("printed 3333, the value of the invalid frame")
    fastest = most_in_a_second([t for t in stage.requests if t >= begun])
    if fastest > max(5 * usual, 20):
        found.append(f"sent {fastest} requests in a second, usually {usual}")
    if not stage.struck:
        return False, "the program sent no request of this kind"
    said = [text for t, text in program.printed if t >= begun][:8]
    return bool(list(filter(None, found))), "; ".join([*filter(None, found), f"printed {', '.join(said) or 'nothing'}"])


def main() -> int:
    case, wire, *words = sys.argv[1:]
    if case not in REFUSE and case not in ACCEPT and case not in ("MB-021", "MB-065b"):
        return 3
    with tempfile.TemporaryDirectory(dir="/tmp", prefix="ftc") as folder:
        stage = Stage(wire, Path(folder))
        places = {"LINE": str(stage.line), "PORT": str(getattr(stage, "port", ""))}
        program = Program([places.get(word, word) for word in words], stage.environment)
        try:
            confirmed, observed = play(case, stage, program)
        finally:
            program.end()
        print(json.dumps({"confirmed": confirmed, "sent": stage.sent, "observed": observed}), flush=True)
    os._exit(0)  # its threads may still wait in a read


if __name__ == "__main__":
    sys.exit(main())
