"""The LAWICEL ASCII protocol ("slcan"), the adapter's side for one client. It converts between bytes and frames without sockets.

Commands end with CR; the adapter answers CR (done), BEL (refused), or the requested data. Supported: ``O`` open, ``L``
listen only, ``C`` close, ``S0`` to ``S8`` and ``sBBCC`` bit rate (SJA1000 at 16 MHz), ``t T r R`` send, ``V N F``
version, serial number, status flags, ``Z0 Z1`` time stamps (milliseconds of the minute), ``X1`` automatic polling,
which is always on, ``M m`` with "everything". All other commands are refused, including those of CAN FD.

The bit rate is that of the bus: a different one is refused, as is every frame while the channel is closed.
"""

from __future__ import annotations

from collections.abc import Callable

from fieldtwin.gateway.core.can_error import CanErrorState, reported_state, reports_overrun
from fieldtwin.gateway.core.canframe import CanFrame
from fieldtwin.gateway.core.clock import NS_PER_MS

OK, REFUSED = b"\r", b"\a"
VERSION, SERIAL_NUMBER = b"V1013\r", b"NFT01\r"
MAX_LINE = 32
"""The number of characters of the longest command, a frame: T, 8 digits, length, 16 digits, and a time stamp that some
programs append.
"""

_BIT_RATES = (10_000, 20_000, 50_000, 100_000, 125_000, 250_000, 500_000, 800_000, 1_000_000)
_ALL = {"M": ("00000000",), "m": ("FFFFFFFF",)}
_MINUTE_MS = 60_000
_RX_FULL, _TX_FULL, _WARNING, _OVERRUN, _PASSIVE, _BUS_ERROR = 0x01, 0x02, 0x04, 0x08, 0x20, 0x80
_HEX = frozenset("0123456789abcdefABCDEF")


class SlcanSession:
    """The adapter of one client.

    Call `feed` with bytes, then `step` until it returns None. `received` turns frames into bytes.
    """

    def __init__(self, bitrate: int) -> None:
        self.is_open = False
        self.listen_only = False
        self.refused = 0
        self.waiting = False
        """True if there was no room for the frame of the next command. The caller calls `step` again later."""
        self._bitrate = bitrate
        self._stamps = False
        self._buffer = bytearray()
        self._skipping = False  # True while a line is received that is longer than any command
        self._flags = 0
        self._state = 0

    def feed(self, data: bytes) -> None:
        """Take bytes from the client. Memory is bounded: an overlong line is dropped, and only its presence is recorded."""
        self._buffer += data
        if len(self._buffer) > MAX_LINE and b"\r" not in self._buffer:
            self._buffer.clear()
            self._skipping = True

    def step(self, send: Callable[[CanFrame], bool]) -> bytes | None:
        """Execute one command and return its answer.

        Returns None if no command is complete, or if it is `waiting` because `send` had no room.
        """
        self.waiting = False
        end = self._buffer.find(b"\r")
        if end < 0:
            return None
        line = self._buffer[:end].decode("ascii", "replace").lstrip("\n")
        if self._skipping or len(line) > MAX_LINE:
            answer: bytes | None = None
            self._skipping = False
        else:
            answer = self._command(line, send)
            if self.waiting:
                return None
        del self._buffer[: end + 1]
        if answer is None:
            self.refused += 1
            return REFUSED
        return answer

    def received(self, frame: CanFrame) -> bytes:
        """Return the bytes by which the client receives a frame; empty while the channel is closed."""
        if not self.is_open:
            return b""
        letter = "tT"[frame.extended] if not frame.remote else "rR"[frame.extended]
        stamp = f"{frame.t_ns // NS_PER_MS % _MINUTE_MS:04X}" if self._stamps else ""
        text = f"{letter}{frame.can_id:0{8 if frame.extended else 3}X}{frame.dlc}{frame.data.hex().upper()}{stamp}\r"
        return text.encode("ascii")

    def controller(self, frame: CanFrame) -> None:
        """Process an error frame: this protocol has none, so it sets status flags until ``F`` reads them."""
        if reports_overrun(frame):
            self._flags |= _OVERRUN | _RX_FULL
        state = reported_state(frame)
        if state is None:
            self._flags |= 0 if reports_overrun(frame) else _BUS_ERROR
        else:
            self._state = {
                CanErrorState.ACTIVE: 0,
                CanErrorState.WARNING: _WARNING,
                CanErrorState.PASSIVE: _WARNING | _PASSIVE,
                CanErrorState.BUS_OFF: _WARNING | _PASSIVE | _BUS_ERROR,
            }[state]

    def _command(self, line: str, send: Callable[[CanFrame], bool]) -> bytes | None:
        letter, rest = line[:1], line[1:]
        match letter:
            case "":
                return OK  # an empty line: clients send it to clear earlier input
            case "t" | "T" | "r" | "R":
                return self._transmit(letter, rest, send)
            case "O" | "L" if not rest and not self.is_open:
                self.is_open, self.listen_only = True, letter == "L"
                return OK
            case "C" if not rest:
                self.is_open = self.listen_only = False
                return OK
            case "S" | "s" if not self.is_open:
                return OK if self._bit_rate(letter, rest) == self._bitrate else None
            case "Z" if rest in ("0", "1"):
                self._stamps = rest == "1"
                return OK
            case "V" if not rest:
                return VERSION
            case "N" if not rest:
                return SERIAL_NUMBER
            case "F" if not rest and self.is_open:
                flags, self._flags = self._flags | self._state, 0
                return f"F{flags:02X}\r".encode("ascii")
            case "X" if rest == "1":
                return OK
            case "M" | "m" if rest.upper() in _ALL[letter]:
                return OK
            case _:
                return None

    def _transmit(self, letter: str, rest: str, send: Callable[[CanFrame], bool]) -> bytes | None:
        extended, remote = letter in "TR", letter in "rR"
        digits = 8 if extended else 3
        if not self.is_open or self.listen_only or not set(rest) <= _HEX or len(rest) <= digits:
            return None
        can_id, length, data = int(rest[:digits], 16), int(rest[digits], 16), rest[digits + 1 :]
        expected = 0 if remote else 2 * length
        # A time stamp after the data comes from a log; it has no meaning here.
        if length > 8 or can_id > (0x1FFFFFFF if extended else 0x7FF) or len(data) not in (expected, expected + 4):
            return None
        frame = CanFrame(can_id, bytes.fromhex(data[:expected]), extended=extended, remote=remote, dlc=length)
        if not send(frame):
            self._flags |= _TX_FULL
            self.waiting = True
        return b"Z\r" if extended else b"z\r"

    @staticmethod
    def _bit_rate(letter: str, rest: str) -> int:
        """Return the bit rate in bit/s; 0 for an invalid one."""
        if letter == "S":
            return _BIT_RATES[int(rest)] if len(rest) == 1 and rest in "012345678" else 0
        if len(rest) != 4 or not set(rest) <= _HEX:
            return 0
        btr0, btr1 = bytes.fromhex(rest)
        quanta = 1 + (btr1 & 0x0F) + 1 + (btr1 >> 4 & 0x07) + 1
        return round(8_000_000 / (((btr0 & 0x3F) + 1) * quanta))
