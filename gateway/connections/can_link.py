"""What the kernel knows about a network interface: is it CAN, is it up, at which bit rate (rtnetlink(7)).

Read-only: the kernel owns a CAN interface's bit rate, it is checked and never set. Reading bytes is apart from asking
the kernel, so that the former can be tested anywhere. Nothing here sends or receives a frame.
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
_IFLA_CAN_BITTIMING = 1
_ARPHRD_CAN = 280
_IFF_UP = 1
_TIMEOUT_S = 1.0


@dataclass(frozen=True, slots=True)
class CanLink:
    """A network interface. `bitrate` in bit/s is 0 where the interface has none (vcan) or none was set.

    `kind` is the driver's word for virtual ones (``vcan``, ``vxcan``, ``can`` for controllers), else empty.
    """

    is_can: bool
    is_up: bool
    kind: str
    bitrate: int


def query_link(name: str) -> CanLink:
    """Ask the kernel about interface `name`. Raises `OSError`: ENODEV when there is none."""
    index = socket.if_nametoindex(name)
    request = _MESSAGE.pack(_MESSAGE.size + _LINK.size, _RTM_GETLINK, _NLM_F_REQUEST, 1, 0)
    with socket.socket(socket.AF_NETLINK, socket.SOCK_RAW, socket.NETLINK_ROUTE) as netlink:
        netlink.settimeout(_TIMEOUT_S)
        netlink.send(request + _LINK.pack(socket.AF_UNSPEC, 0, index, 0, 0))
        return read_link(netlink.recv(65536))


def read_link(answer: bytes) -> CanLink:
    """Read an RTM_NEWLINK message. Raises `OSError` where the kernel answered with an error, or with something else."""
    if len(answer) < _MESSAGE.size + _LINK.size:
        raise OSError(0, "the kernel's answer about the interface is too short")
    length, kind_of_message, *_ = _MESSAGE.unpack_from(answer)
    if kind_of_message != _RTM_NEWLINK:
        code = -struct.unpack_from("=i", answer, _MESSAGE.size)[0]
        raise OSError(code, "the kernel tells nothing about the interface")
    _, link_type, _, flags, _ = _LINK.unpack_from(answer, _MESSAGE.size)
    info = dict(_attributes(dict(_attributes(answer[_MESSAGE.size + _LINK.size : length])).get(_IFLA_LINKINFO, b"")))
    kind = info.get(_IFLA_INFO_KIND, b"").rstrip(b"\0").decode("ascii", "replace")
    timing = dict(_attributes(info.get(_IFLA_INFO_DATA, b""))).get(_IFLA_CAN_BITTIMING, b"") if "can" in kind else b""
    bitrate = int.from_bytes(timing[:4], "little" if struct.pack("=H", 1)[0] else "big")  # can_bittiming.bitrate
    return CanLink(link_type == _ARPHRD_CAN, bool(flags & _IFF_UP), kind, bitrate)


def _attributes(data: bytes) -> Iterator[tuple[int, bytes]]:
    """Type and payload of each attribute; a broken tail ends the walk."""
    at = 0
    while at + _ATTRIBUTE.size <= len(data):
        length, kind = _ATTRIBUTE.unpack_from(data, at)
        if length < _ATTRIBUTE.size or at + length > len(data):
            return
        yield kind & 0x3FFF, data[at + _ATTRIBUTE.size : at + length]  # the top bits are flags
        at += (length + 3) & ~3
