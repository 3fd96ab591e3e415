"""Repeat a failed case of a Modbus device without fieldtwin: ``modbus_device.py CASE tcp|rtu|ascii PROGRAM ARGUMENT...``.

A socket or pty sends the bytes of the case to the program and compares what comes back. The result is one JSON object:
`confirmed` is true if the device did what it must not. Exit status 3: this program has no such case. The device has 200
holding registers and 48 coils, registers 190 to 199 and coil 3 may be written, and its unit ID is 1.
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
import time
import tty
from collections.abc import Callable
from pathlib import Path

from modbus_client import bad, crc

WAIT_S = 0.8
READ = bytes((3, 0, 0, 0, 1))
UNIT = 1
UNKNOWN = bytes((0x64, 0, 1))


class Wire:
    """The connection to the device, and everything that was sent and received."""

    def __init__(self, kind: str) -> None:
        self.kind, self.tag, self.log = kind, 0, list[str]()
        self.socket: socket.socket | None = None
        self.port = 0

    def connect(self) -> None:
        if self.kind == "tcp":
            if self.socket is not None:
                self.socket.close()
            self.socket = socket.create_connection(("127.0.0.1", self.port), timeout=5)
            self.socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            self.fd = self.socket.fileno()

    def adu(self, pdu: bytes, unit: int = UNIT, protocol: int = 0, tag: int | None = None) -> bytes:
        body = bytes((unit,)) + pdu
        if self.kind == "tcp":
            self.tag += 1
            return struct.pack(">HHH", self.tag if tag is None else tag, protocol, len(body)) + body
        if self.kind == "rtu":
            return body + crc(body)
        return b":" + (body + bytes((-sum(body) & 0xFF,))).hex().upper().encode() + b"\r\n"

    def send(self, data: bytes) -> None:
        self.log.append(f"> {data.hex(' ')}")
        try:
            os.write(self.fd, data)
        except OSError as e:
            self.log.append(f"< {e.strerror}")

    def hear(self, wait_s: float = WAIT_S) -> list[bytes]:
        """Return the bodies (unit and PDU) of the frames that arrive until nothing comes for `wait_s`."""
        got, closed = b"", False
        while select.select([self.fd], [], [], 0.15 if got else wait_s)[0]:
            try:
                chunk = os.read(self.fd, 4096)
            except OSError:
                chunk = b""
            if not chunk:
                closed = True
                break
            got += chunk
        self.log.append(f"< {got.hex(' ') or ('closed' if closed else 'silence')}")
        if closed:
            self.connect()
        return self.split(got)

    def split(self, got: bytes) -> list[bytes]:
        found = []
        self.tags = list[int]()
        if self.kind == "tcp":
            while len(got) >= 8:
                size = int.from_bytes(got[4:6], "big")
                self.tags.append(int.from_bytes(got[:2], "big"))
                found.append(got[6 : 6 + size])
                got = got[6 + size :]
        elif self.kind == "ascii":
            for text in got.split(b":")[1:]:
                found.append(bytes.fromhex(text.strip().decode("ascii", "replace"))[:-1])
        else:
            while got:
                end = next((n for n in range(5, len(got) + 1) if crc(got[: n - 2]) == got[n - 2 : n]), len(got))
                found.append(got[: end - 2])
                got = got[end:]
        return found

    def ask(self, pdu: bytes, unit: int = UNIT, **header: int) -> bytes | None:
        """Return the PDU of the first answer, None for silence."""
        self.send(self.adu(pdu, unit, **header))
        heard = self.hear()
        return heard[0][1:] if heard else None

    def goes_on(self) -> str:
        """Return "" if the device answers a read, after a new connection if the old one ended."""
        heard = self.ask(READ)
        if heard is None and self.kind == "tcp":
            self.connect()
            heard = self.ask(READ)
        return "" if heard and heard[0] == 3 else "it does not answer the next read"

    def cell(self, address: int = 190) -> int | None:
        heard = self.ask(struct.pack(">BHH", 3, address, 1))
        return int.from_bytes(heard[2:4], "big") if heard and heard[0] == 3 else None


def refuses(pdu: bytes, *codes: int) -> Callable[[Wire], str]:
    """The device must answer with one of these exceptions, and answer the read after it."""

    def case(wire: Wire) -> str:
        heard = wire.ask(pdu)
        if heard is None:
            return "silence instead of an exception"
        if len(heard) != 2 or heard[0] != pdu[0] | 0x80 or heard[1] not in codes:
            return f"answers {heard.hex(' ')} instead of {pdu[0] | 0x80:02x} {codes[0]:02x}"
        return wire.goes_on()

    return case


def refuses_write(pdu: bytes, *codes: int, address: int = 190) -> Callable[[Wire], str]:
    """As `refuses`, and the register must keep its value."""

    def case(wire: Wire) -> str:
        before = wire.cell(address)
        found = refuses(pdu, *codes)(wire)
        after = wire.cell(address)
        return "; ".join(
            filter(None, (found, "" if before == after else f"register {address} changed from {before} to {after}"))
        )

    return case


def refuses_coil(pdu: bytes) -> Callable[[Wire], str]:
    def case(wire: Wire) -> str:
        before = wire.ask(bytes((1, 0, 3, 0, 1)))
        found = refuses(pdu, 3)(wire)
        after = wire.ask(bytes((1, 0, 3, 0, 1)))
        return "; ".join(filter(None, (found, "" if before == after else "the coil changed")))

    return case


def silent_to(pdu: bytes, *units: int) -> Callable[[Wire], str]:
    def case(wire: Wire) -> str:
        for unit in units:
            heard = wire.ask(pdu, unit)
            if heard is not None:
                return f"answers {heard.hex(' ')} to a request to unit {unit}"
        return wire.goes_on()

    return case


def answers(pdu: bytes, good: Callable[[bytes], bool], what: str, unit: int = UNIT) -> Callable[[Wire], str]:
    def case(wire: Wire) -> str:
        heard = wire.ask(pdu, unit)
        return (
            "" if heard is not None and good(heard) else f"{heard.hex(' ') if heard else 'silence'} instead of {what}"
        )

    return case


def raw(
    *steps: Callable[[Wire], bytes] | float, replies: tuple[int, ...] | None = None, settle_s: float = 1.2
) -> Callable[[Wire], str]:
    """Send bytes with pauses; the number of answers to a read must be one of `replies`, and the device must go on."""

    def case(wire: Wire) -> str:
        for step in steps:
            if isinstance(step, float):
                time.sleep(step)
            else:
                wire.send(step(wire))
        bodies = wire.hear(settle_s)
        heard = [body for body in bodies if body[1:2] == b"\x03"]
        refused = [body for body in bodies if body[1:2] > b"\x7f"]
        if refused:
            return f"answers exception {refused[0][2]:02x}"
        if replies is not None and len(heard) not in replies:
            return f"{len(heard)} answers instead of {' or '.join(map(str, replies))}"
        return wire.goes_on()

    return case


def read(unit: int = UNIT) -> Callable[[Wire], bytes]:
    return lambda wire: wire.adu(READ, unit)


def after_unknown(wire: Wire) -> str:
    wire.ask(UNKNOWN)
    return "" if wire.ask(READ) else "it does not answer the next request"


def high_function(wire: Wire) -> str:
    heard = [wire.ask(bytes((0x83, 0, 0, 0, 1))) for _ in range(2)]
    if not wire.ask(READ):
        return "it does not answer the next request"
    said = [h.hex(" ") if h else "silence" for h in heard]
    return "" if heard[0] == heard[1] and heard[0] in (None, bytes((0x83, 1))) else f"answers {', '.join(said)}"


def broadcast_write(wire: Wire) -> str:
    heard = wire.ask(struct.pack(">BHH", 6, 190, 77), 0)
    held = wire.cell()
    return "; ".join(
        filter(
            None, ("" if heard is None else "answers a broadcast", "" if held == 77 else f"register 190 holds {held}")
        )
    )


def write_before_read(wire: Wire) -> str:
    heard = wire.ask(struct.pack(">BHHHHBH", 23, 190, 1, 190, 1, 2, 0x1234))
    return (
        ""
        if heard == bytes((23, 2, 0x12, 0x34))
        else f"{heard.hex(' ') if heard else 'silence'} instead of 17 02 12 34"
    )


def mask_write(wire: Wire) -> str:
    wire.ask(struct.pack(">BHH", 6, 190, 0x12))
    wire.ask(struct.pack(">BHHH", 22, 190, 0xF2, 0x25))
    held = wire.cell()
    return "" if held == 0x17 else f"register 190 holds {held} instead of 23"


def listen_only(wire: Wire) -> str:
    heard = [wire.ask(bytes((8, 0, 4, 0, 0))), wire.ask(READ)]
    wire.ask(bytes((8, 0, 1, 0, 0)))
    said = [h.hex(" ") for h in heard if h is not None]
    return f"answers {', '.join(said)} while it must only listen" if said else wire.goes_on()


def counters(wire: Wire) -> str:
    count = [wire.ask(bytes((8, 0, 0x0E, 0, 0)))]
    for _ in range(3):
        wire.ask(READ)
    count.append(wire.ask(bytes((8, 0, 0x0E, 0, 0))))
    if any(c is None or c[0] != 8 for c in count):
        return ""
    first, last = (int.from_bytes(c[3:5], "big") for c in count if c)
    return "" if last - first in (3, 4) else f"counts {last - first} requests instead of 4"


def identification(code: int, object_id: int, good: Callable[[bytes], bool], what: str) -> Callable[[Wire], str]:
    return answers(bytes((0x2B, 0x0E, code, object_id)), good, what)


def other_protocol(wire: Wire) -> str:
    wire.send(wire.adu(READ, protocol=1))
    if wire.hear():
        return "answers an ADU with protocol ID 1"
    if wire.log[-1] == "< closed":
        return "closes the connection"
    heard = wire.ask(READ)  # on the same connection
    return "" if heard else "it does not answer the next request"


def header(length: int) -> Callable[[Wire], str]:
    """The device must discard the ADU or close the connection; the next request must not be lost in silence."""

    def case(wire: Wire) -> str:
        frame = struct.pack(">HHHB", 9, 0, length, UNIT)[: 6 if length == 0 else 7]
        wire.send(frame + (READ if length > 1 else b""))
        time.sleep(0.25)
        if length > 1 and select.select([wire.fd], [], [], 0)[0] and (got := os.read(wire.fd, 260)):
            return f"answers {got.hex(' ')}"
        closed = bool(select.select([wire.fd], [], [], 0)[0]) and not os.read(wire.fd, 1)
        if closed:
            wire.log.append("< closed")
            wire.connect()
        heard = wire.ask(READ)
        if wire.log[-1] == "< closed":
            return ""
        return "" if heard and heard[0] == 3 else "it neither closes the connection nor answers the next request on it"

    return case


def several(count: int) -> Callable[[Wire], str]:
    def case(wire: Wire) -> str:
        wire.send(b"".join(wire.adu(READ) for _ in range(count)))
        heard = wire.hear(1.5)
        if len(heard) != count:
            return f"{len(heard)} answers to {count} requests in one segment"
        return "" if wire.tags == sorted(wire.tags) else f"answers in the order of transactions {wire.tags}"

    return case


def many_connections(wire: Wire) -> str:
    held = []
    for _ in range(20):
        try:
            held.append(socket.create_connection(("127.0.0.1", wire.port), timeout=2))
        except OSError:
            break
    try:
        wire.connect()
        return wire.goes_on()
    except OSError as e:
        return f"no connection: {e.strerror}"
    finally:
        for connection in held:
            connection.close()


def same_bytes(count: int) -> Callable[[Wire], str]:
    pdu = bytes((8, 0, 0)) + bytes(range(count))
    return answers(pdu, lambda heard: heard == pdu, "the same bytes")


def noise(data: bytes) -> Callable[[Wire], bytes]:
    return lambda wire: data


def half(wire: Wire) -> bytes:
    frame = wire.adu(READ)
    return frame[: len(frame) // 2]


def rest(wire: Wire) -> bytes:
    frame = wire.adu(READ)
    return frame[len(frame) // 2 :]


def bad_check(wire: Wire) -> bytes:
    return bad(wire.adu(READ), wire.kind)


def one_byte(at: int) -> Callable[[Wire], bytes]:
    return lambda wire: struct.pack(">HHHBBHH", 5, 0, 6, UNIT, 3, 0, 1)[at : at + 1]


def foreign_pair(wire: Wire) -> bytes:
    return wire.adu(READ, 2)


VALUE_3, COIL = bytes((0, 1)), bytes((0, 3))
REG = struct.pack(">H", 190)
CASES: dict[str, Callable[[Wire], str]] = {
    "MB-001": raw(bad_check, replies=(0,)),
    "MB-004": raw(half, 0.1, read(), replies=(1,)),
    "MB-005": raw(half, 0.01, rest, replies=(0, 1)),
    "MB-007": raw(lambda w: w.adu(READ) + w.adu(READ), replies=(0, 2)),
    "MB-008a": raw(lambda w: b"\0\0" + w.adu(READ), settle_s=0.35),
    "MB-008b": raw(lambda w: b"\xff\xff" + w.adu(READ), settle_s=0.35),
    "MB-009": raw(lambda w: w.adu(READ) + b"\0\0"),
    "MB-026": broadcast_write,
    "MB-027": silent_to(READ, 0),
    "MB-029": silent_to(READ, 2, 247, 200),
    "MB-030": raw(foreign_pair, 0.05, lambda w: w.adu(bytes((3, 2, 0, 9)), 2), 0.05, read(), replies=(1,)),
    "MB-031": raw(foreign_pair, 0.3, read(), replies=(1,)),
    "MB-032": raw(lambda w: w.adu(UNKNOWN, 2), replies=(0,), settle_s=0.25),
    "MB-033a": refuses(UNKNOWN, 1),
    "MB-033b": refuses(bytes((0x29,)), 1),
    "MB-034": after_unknown,
    "MB-035": high_function,
    "MB-036a": refuses(bytes((3, 0, 0, 0, 0)), 3),
    "MB-036b": refuses(bytes((3, 0, 0, 0, 126)), 3),
    "MB-036c": refuses(struct.pack(">BHH", 1, 0, 2001), 3),
    "MB-036d": refuses(bytes((16,)) + REG + bytes((0, 0, 0)), 3),
    "MB-037": refuses(struct.pack(">BHH", 3, 0xFFFF, 2), 2),
    "MB-038": refuses(struct.pack(">BHH", 3, 0xFFFF, 126), 3, 2),
    "MB-039a": refuses_coil(bytes((5,)) + COIL + bytes((0, 1))),
    "MB-039b": refuses_coil(bytes((5,)) + COIL + bytes((0xFF, 1))),
    "MB-040a": refuses_write(bytes((16,)) + REG + bytes((0, 1, 4, 0x11, 0x11, 0x22, 0x22)), 3),
    "MB-040b": refuses_coil(bytes((15,)) + COIL + bytes((0, 1, 2, 1, 1))),
    "MB-040c": refuses_write(bytes((16,)) + REG + bytes((0, 1, 2, 0x33, 0x33, 0x44, 0x44)), 3),
    "MB-040d": refuses_write(bytes((16,)) + REG + bytes((0, 1, 4, 0x55, 0x55)), 3),
    "MB-040e": refuses_write(bytes((16,)) + REG + bytes((0, 0, 0, 0x66, 0x66)), 3),
    "MB-041": refuses_write(struct.pack(">BHHBHH", 16, 199, 2, 4, 5, 6), 2, address=199),
    "MB-042a": write_before_read,
    "MB-042b": refuses_write(struct.pack(">BHHHHBH", 23, 0, 126, 190, 1, 2, 0x77), 3),
    "MB-043": mask_write,
    "MB-044": answers(
        bytes((24, 0, 0)), lambda h: h[0] == 0x98 or len(h) == 3 + int.from_bytes(h[1:3], "big"), "a queue or an exception"
    ),
    "MB-045a": identification(1, 0, lambda h: h[0] == 0x2B and h[6] >= 3, "vendor, product code and revision"),
    "MB-045b": identification(2, 0, lambda h: h[0] == 0x2B and h[2] == 2 and h[6] > 0, "regular identification"),
    "MB-045c": identification(4, 0x7F, lambda h: h == bytes((0xAB, 2)), "ab 02"),
    "MB-045d": identification(7, 0, lambda h: h == bytes((0xAB, 3)), "ab 03"),
    "MB-046": listen_only,
    "MB-047": counters,
    "MB-049": answers(bytes((1, 0, 0, 0, 3)), lambda h: h[0] == 1 and not h[2] & 0xF8, "padding bits of 0"),
    "MB-050a": same_bytes(250),
    "MB-050b": raw(lambda w: w.adu(bytes((8, 0, 0)) + bytes(251)), replies=(0,)),
    "MB-051": raw(*[step for n in range(12) for step in (one_byte(n), 0.01)], replies=(1,)),
    "MB-052": several(3),
    "MB-053": several(40),
    "MB-054": other_protocol,
    "MB-055a": header(0),
    "MB-055b": header(1),
    "MB-055c": header(0xFFFF),
    "MB-057a": answers(READ, lambda h: h[0] == 3, "an answer", 255),
    "MB-057b": answers(READ, lambda h: h[0] == 3, "an answer", 0),
    "MB-065": many_connections,
    "MB-068": raw(noise(bytes.fromhex("e6 80 9f fe 66 78")), replies=(0,)),
    "MB-069": raw(noise(bytes.fromhex("01 00 00 34 00 01 64 2a")), replies=(0,), settle_s=0.4),
    "MB-070a": raw(bad_check, replies=(0,)),
    "MB-070b": raw(lambda w: half(w) + w.adu(READ), replies=(1,)),
    "MB-070c": raw(half, 1.5, rest, replies=(0,)),
    "MB-070d": raw(half, 0.5, rest, replies=(1,)),
    "MB-070e": raw(lambda w: b"\x12xyz" + w.adu(READ), replies=(1,)),
    "MB-070f": raw(lambda w: w.adu(READ)[:5] + b"G" + w.adu(READ)[6:], replies=(0,)),
}  # fmt: skip
"""Each function returns the deviation in words, or an empty text."""


def main() -> int:
    case, kind, *words = sys.argv[1:]
    if case not in CASES:
        return 3
    wire = Wire(kind)
    with tempfile.TemporaryDirectory(dir="/tmp", prefix="ftc") as folder:
        line = Path(folder) / "line"
        if kind != "tcp":
            wire.fd, far = pty.openpty()
            tty.setraw(far)
            line.symlink_to(os.ttyname(far))
        program = subprocess.Popen(
            [str(line) if word == "LINE" else word for word in words],
            stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True, start_new_session=True,
        )  # fmt: skip
        try:
            assert program.stdout is not None
            wire.port = int(program.stdout.readline().split()[1])
            time.sleep(0.3)
            wire.connect()
            if wire.goes_on():
                raise RuntimeError("the device does not answer a read")
            wire.log.clear()
            found = CASES[case](wire)
        finally:
            os.killpg(program.pid, signal.SIGKILL)
            program.wait()
    sent = "; ".join(wire.log[:8])
    print(json.dumps({"confirmed": bool(found), "sent": sent, "observed": found or "it does what it must"}))
    return 0


if __name__ == "__main__":
    sys.exit(main())
