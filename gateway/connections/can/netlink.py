"""Ask the kernel about a network interface: whether it is a CAN interface, whether it is up, its bit rate (rtnetlink(7)).

This module only reads: the kernel owns a CAN interface's bit rate, and fieldtwin checks it but never sets it. Decoding is
separate from the query, so that it can be tested on any system. This module sends and receives no CAN frames.
"""

from __future__ import annotations

import socket
import struct
from collections.abc import Iterator
from dataclasses import dataclass

_MESSAGE = struct.Struct("=IHHII")  # nlmsghdr: length, type, flags, sequence, port
_LINK = struct.Struct("=BxHiII")  # ifinfomsg: family, link type, index, flags, change mask
_ATTRIBUTE = struct.Struct("=HH")  # rtattr: length (this header included), type

_RTM_NEWLINK, _RTM_GETLINK = 16, 18
_NLM_F_REQUEST = 1
_IFLA_LINKINFO = 18
_IFLA_INFO_KIND, _IFLA_INFO_DATA = 1, 2
_IFLA_CAN_BITTIMING, _IFLA_CAN_STATE, _IFLA_CAN_CTRLMODE, _IFLA_CAN_BERR_COUNTER = 1, 4, 5, 8
_CTRLMODE_LISTENONLY = 0x02
_STATES = ("error-active", "error-warning", "error-passive", "bus-off", "stopped", "sleeping")
_ARPHRD_CAN = 280
_IFF_UP = 1
_TIMEOUT_S = 1.0


@dataclass(frozen=True, slots=True)
class CanInterface:
    """A network interface. `bitrate` in bit/s is 0 if the interface has none (vcan) or none was set.

    `kind` is ``vcan`` or ``vxcan`` for virtual interfaces, ``can`` for controllers, or empty if the driver names no kind.
    """

    is_can: bool
    is_up: bool
    kind: str
    bitrate: int
    listen_only: bool = False
    """The controller listens only: it does not even acknowledge frames."""
    state: str = ""
    """The controller's state: ``error-active``, ``error-passive``, ``bus-off``...; empty if it has none."""
    tx_errors: int = 0
    rx_errors: int = 0
    """The controller's error counters (ISO 11898-1, 12.1.4), 0 if the driver does not report them."""


def query_link(name: str) -> CanInterface:
    """Ask the kernel about interface `name`. Raises `OSError` (ENODEV if the interface does not exist)."""
    index = socket.if_nametoindex(name)
    request = _MESSAGE.pack(_MESSAGE.size + _LINK.size, _RTM_GETLINK, _NLM_F_REQUEST, 1, 0)
    with socket.socket(socket.AF_NETLINK, socket.SOCK_RAW, socket.NETLINK_ROUTE) as netlink:
        netlink.settimeout(_TIMEOUT_S)
        netlink.send(request + _LINK.pack(socket.AF_UNSPEC, 0, index, 0, 0))
        return read_link(netlink.recv(65536))


def read_link(answer: bytes) -> CanInterface:
    """Read an RTM_NEWLINK message. Raises `OSError` if the kernel answered with an error or a different message."""
    if len(answer) < _MESSAGE.size + _LINK.size:
        raise OSError(0, "the kernel's answer about the interface is too short")
    length, kind_of_message, *_ = _MESSAGE.unpack_from(answer)
    if kind_of_message != _RTM_NEWLINK:
        code = -struct.unpack_from("=i", answer, _MESSAGE.size)[0]
        raise OSError(code, "the kernel gives no information about the interface")
    _, link_type, _, flags, _ = _LINK.unpack_from(answer, _MESSAGE.size)
    info = dict(_attributes(dict(_attributes(answer[_MESSAGE.size + _LINK.size : length])).get(_IFLA_LINKINFO, b"")))
    kind = info.get(_IFLA_INFO_KIND, b"").rstrip(b"\0").decode("ascii", "replace")
    data = dict(_attributes(info.get(_IFLA_INFO_DATA, b""))) if "can" in kind else {}
    state = _number(data.get(_IFLA_CAN_STATE, b""), 4)
    has_state = _IFLA_CAN_STATE in data and state < len(_STATES)
    counters = data.get(_IFLA_CAN_BERR_COUNTER, b"")
    return CanInterface(
        link_type == _ARPHRD_CAN,
        bool(flags & _IFF_UP),
        kind,
        _number(data.get(_IFLA_CAN_BITTIMING, b""), 4),  # can_bittiming.bitrate
        listen_only=bool(_number(data.get(_IFLA_CAN_CTRLMODE, b"")[4:], 4) & _CTRLMODE_LISTENONLY),
        state=_STATES[state] if has_state else "",
        tx_errors=_number(counters, 2),
        rx_errors=_number(counters[2:], 2),
    )


def _number(data: bytes, size: int) -> int:
    return int.from_bytes(data[:size], "little" if struct.pack("=H", 1)[0] else "big")


def _attributes(data: bytes) -> Iterator[tuple[int, bytes]]:
    """Yield type and payload of each attribute; a damaged tail ends the iteration."""
    at = 0
    while at + _ATTRIBUTE.size <= len(data):
        length, kind = _ATTRIBUTE.unpack_from(data, at)
        if length < _ATTRIBUTE.size or at + length > len(data):
            return
        yield kind & 0x3FFF, data[at + _ATTRIBUTE.size : at + length]  # the two highest bits of the type are flags
        at += (length + 3) & ~3
