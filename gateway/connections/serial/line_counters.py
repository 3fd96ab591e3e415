"""The counters and control lines of a serial port's driver: ``TIOCGICOUNT`` and ``TIOCMGET`` of Linux (tty_ioctl(4)).

Ptys, many USB adapters and other operating systems have no counters; the result is then None, never zeros. This module only
reads, and changes no setting of the port.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass, fields
from typing import Protocol, runtime_checkable

TIOCGICOUNT = 0x545D
TIOCMGET = 0x5415
_INTS = struct.Struct("@20i")  # struct serial_icounter_struct: 11 counters, 9 reserved
_INT = struct.Struct("@i")

_LINES = {"CTS": 0x020, "DSR": 0x100, "DCD": 0x040, "RI": 0x080, "DTR": 0x002, "RTS": 0x004}


@dataclass(frozen=True, slots=True)
class UartCounters:
    """Counters since the driver was loaded: characters in both directions, and receive errors.

    `overrun`: the UART was not read in time; `buffer_overrun`: the kernel's buffer was full; `breaks`: the line was
    held at 0 for longer than a character.
    """

    rx: int = 0
    tx: int = 0
    frame: int = 0
    overrun: int = 0
    parity: int = 0
    breaks: int = 0
    buffer_overrun: int = 0

    def since(self, before: UartCounters) -> UartCounters:
        """Return the differences from `before`; counters wrap at 32 bits."""
        return UartCounters(
            *((getattr(self, f.name) - getattr(before, f.name)) & 0xFFFF_FFFF for f in fields(UartCounters))
        )

    @property
    def errors(self) -> int:
        return self.frame + self.overrun + self.parity + self.breaks + self.buffer_overrun


@runtime_checkable
class CountsErrors(Protocol):
    """The interface of a connection whose serial port may count receive errors."""

    def counters(self) -> UartCounters | None:
        """Return the port's counters, or None if it has none."""
        ...

    def control_lines(self) -> dict[str, bool]:
        """Return CTS, DSR, DCD, RI (inputs) and DTR, RTS (outputs); empty if the port has none."""
        ...


def unpack_counters(data: bytes) -> UartCounters:
    """Read the kernel's struct: cts, dsr, rng, dcd, rx, tx, frame, overrun, parity, brk, buf_overrun."""
    numbers = _INTS.unpack(data)
    rx, tx, frame, overrun, parity, breaks, buffer_overrun = (n & 0xFFFF_FFFF for n in numbers[4:11])
    return UartCounters(rx, tx, frame, overrun, parity, breaks, buffer_overrun)


def read_counters(descriptor: int) -> UartCounters | None:
    """Return the driver's counters, or None if it has none."""
    answer = _ask(descriptor, TIOCGICOUNT, _INTS.size)
    return unpack_counters(answer) if answer is not None else None


def read_control_lines(descriptor: int) -> dict[str, bool]:
    """Return the state of each control line by name (CTS, DSR...); empty if the driver has none."""
    answer = _ask(descriptor, TIOCMGET, _INT.size)
    if answer is None:
        return {}
    bits = _INT.unpack(answer)[0]
    return {name: bool(bits & bit) for name, bit in _LINES.items()}


def _ask(descriptor: int, request: int, size: int) -> bytes | None:
    try:
        import fcntl
    except ImportError:  # Windows
        return None
    try:
        return fcntl.ioctl(descriptor, request, bytes(size))
    except OSError:
        return None
