"""Reading the kernel's information about a CAN interface."""

from __future__ import annotations

import errno
import socket
import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fieldtwin.gateway.connections.can.netlink import query_link, read_link


def attribute(kind: int, payload: bytes) -> bytes:
    raw = struct.pack("=HH", 4 + len(payload), kind) + payload
    return raw + bytes(-len(raw) % 4)


def newlink(link_type: int, flags: int, attributes: bytes) -> bytes:
    body = struct.pack("=BxHiII", socket.AF_UNSPEC, link_type, 3, flags, 0) + attributes
    return struct.pack("=IHHII", 16 + len(body), 16, 0, 1, 0) + body


def test_a_controller_with_a_bit_rate() -> None:
    # can_bittiming begins with the bit rate, then sample point 0.875 (875), tq...
    timing = attribute(1, struct.pack("=8I", 125_000, 875, 500, 6, 7, 2, 1, 4))
    info = attribute(0x8000 | 18, attribute(1, b"can\0") + attribute(2, attribute(9, b"\0" * 12) + timing))
    link = read_link(newlink(280, 0x10041, attribute(3, b"can0\0") + info))
    assert (link.is_can, link.is_up, link.kind, link.bitrate) == (True, True, "can", 125_000)


def test_a_virtual_interface_has_no_bit_rate() -> None:
    link = read_link(newlink(280, 0, attribute(18, attribute(1, b"vcan\0"))))
    assert (link.is_can, link.is_up, link.kind, link.bitrate) == (True, False, "vcan", 0)


def test_an_error_answer() -> None:
    with pytest.raises(OSError) as caught:
        read_link(struct.pack("=IHHIIi16x", 36, 2, 0, 1, 0, -errno.ENODEV))
    assert caught.value.errno == errno.ENODEV


@given(st.binary(max_size=80))
def test_a_broken_tail_ends_the_walk(tail: bytes) -> None:
    assert read_link(newlink(280, 1, tail)).is_can


@given(st.binary(max_size=60))
def test_garbage_is_an_oserror_or_a_link(data: bytes) -> None:
    try:
        read_link(data)
    except OSError:
        pass


@pytest.mark.skipif(not hasattr(socket, "AF_NETLINK"), reason="no netlink on this platform")
def test_the_real_loopback_is_not_a_can_interface() -> None:
    link = query_link("lo")
    assert not link.is_can
    with pytest.raises(OSError):
        query_link("nosuch0")
