"""The request to join the software CAN bus (hello), and the bus's answer. This module handles bytes and opens no sockets.

Both are records of 24 bytes like all others on that connection; bit 7 of the first byte distinguishes them from the record of a
frame. In network byte order: mark 80h, version, status, options, bit rate u32, the bus's monotonic clock u64 (ns),
``ftcb``, transmit window u16, two zero bytes. The joining node sends first; bit rate 0 accepts any bit rate.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass

from fieldtwin.gateway.core.canframe import RECORD_SIZE
from fieldtwin.gateway.core.errors import EndpointBusy, Unreachable, UsageError

_LAYOUT = struct.Struct("!BBBBIQ4sHH")
_MARK = 0x80
_VERSION, _FD_VERSION = 1, 2
_CONFIRM, _ERRORS, _VIOLATIONS = 0x01, 0x02, 0x04
_MAGIC = b"ftcb"

_WELCOME, _WRONG_BITRATE, _UNKNOWN_VERSION, _FULL = range(4)


@dataclass(frozen=True, slots=True)
class Welcome:
    """The bus's answer: its bit rate, the unconfirmed frames that it accepts from a node, and its clock (ns) when it answered."""

    bitrate: int
    window: int
    bus_ns: int
    data_bitrate: int = 0
    """bit/s, rounded down to kbit/s; 0 on a connection without CAN FD."""

    def clock_offset_ns(self, asked_ns: int, answered_ns: int) -> int:
        """Return the difference to add to the bus's time stamps to get this host's monotonic time.

        `asked_ns` and `answered_ns` are this host's clock before the request and after the answer. The result is zero on one
        host, where all processes share a clock; otherwise it is accurate to half the round trip.
        """
        if asked_ns <= self.bus_ns <= answered_ns:
            return 0
        return (asked_ns + answered_ns) // 2 - self.bus_ns


def ask(
    bitrate: int,
    *,
    confirmations: bool,
    errors: bool = True,
    violations: bool = False,
    fd: bool = False,
    data_bitrate: int = 0,
) -> bytes:
    """Return the request to join a bus of `bitrate` bit/s (0: any), with or without a confirmation of each own frame.

    `errors` requests error frames when the state of this node's controller changes, or frames for it were lost (as with
    a kernel interface); `violations` also requests one for each error on the bus (as with ``berr-reporting``). `fd`
    says that records carry CAN FD, and the bus must have the `data_bitrate` (0: any).
    """
    options = (_CONFIRM if confirmations else 0) | (_ERRORS if errors else 0) | (_VIOLATIONS if violations else 0)
    version, data_kbitrate = (_FD_VERSION, data_bitrate // 1000) if fd else (_VERSION, 0)
    return _LAYOUT.pack(_MARK, version, 0, options, bitrate, 0, _MAGIC, 0, data_kbitrate)


def read_answer(record: bytes, wanted_bitrate: int, where: str, *, fd: bool = False, data_bitrate: int = 0) -> Welcome:
    """Return the bus's answer to `ask`. `where` names the endpoint in errors.

    Raises `UsageError` for a wrong bit rate, `EndpointBusy` if the bus is full, `Unreachable` if the other end has a
    different version or is not a software CAN bus.
    """
    if len(record) != RECORD_SIZE:
        raise Unreachable(
            "the program that answers there is not a software CAN bus", got=f"{len(record)} bytes", where=where
        )
    mark, version, status, _, bitrate, bus_ns, magic, window, data_kbitrate = _LAYOUT.unpack(record)
    if mark != _MARK or magic != _MAGIC:
        raise Unreachable("the program that answers there is not a software CAN bus", got=record.hex(), where=where)
    if status == _WRONG_BITRATE and wanted_bitrate in (0, bitrate):
        raise UsageError(
            "the software CAN bus has a different data bit rate",
            expected=f"{data_bitrate} bit/s",
            got=f"{data_kbitrate * 1000} bit/s",
            where=where,
            hint="start the bus with this rate: fieldtwin can-bus --data-bitrate N",
        )
    if status == _WRONG_BITRATE:
        raise UsageError(
            "the software CAN bus runs at a different bit rate",
            expected=f"{wanted_bitrate} bit/s",
            got=f"{bitrate} bit/s",
            where=where,
            hint="set the bit rate of the bus in the system file, or start the bus with this rate",
        )
    if status == _FULL:
        raise EndpointBusy("the software CAN bus is full", where=where)
    wanted_version = _FD_VERSION if fd else _VERSION
    if status != _WELCOME or version != wanted_version:
        raise Unreachable(
            "the software CAN bus uses a different protocol version",
            expected=f"version {wanted_version}",
            got=f"version {version}, status {status}",
            where=where,
            hint="run the same fieldtwin on both sides",
        )
    return Welcome(bitrate, max(window, 1), bus_ns, data_kbitrate * 1000)
