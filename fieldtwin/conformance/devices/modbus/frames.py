"""Modbus frames for checks: requests made by hand, including damaged ones, and replies found in the received bytes.

This module does no I/O. A driver's framer discards invalid data. A check examines invalid data, so nothing is discarded
here: bytes that form no frame are kept as `rest`. Sources: MODBUS over Serial Line V1.02 (SL), Messaging on TCP/IP V1.0b
(TG).
"""

from __future__ import annotations

import re
from dataclasses import dataclass

from fieldtwin.gateway.protocols.modbus.frames.ascii import lrc
from fieldtwin.gateway.protocols.modbus.frames.crc import crc16, with_crc
from fieldtwin.gateway.protocols.modbus.frames.shapes import MAX_FRAME, frame_lengths

NO_TRANSACTION = -1
_STEP = [crc16(bytes((index ^ 0xFF,))) ^ 0xFF for index in range(256)]
"""The table of the check sum for each byte value. It makes the search for a reply in garbage, which starts at each byte,
fast.
"""
_ASCII_FRAME = re.compile(rb":([0-9A-F]{6,512})\r\n")


@dataclass(frozen=True, slots=True)
class ReceivedReply:
    """A whole reply. `transaction` is `NO_TRANSACTION` on a line."""

    unit: int
    pdu: bytes
    transaction: int = NO_TRANSACTION

    @property
    def refusal(self) -> int:
        """Return the exception code, 0 for a normal reply (AP 7)."""
        return self.pdu[1] if self.pdu[0] & 0x80 and len(self.pdu) == 2 else 0

    def __str__(self) -> str:
        if self.refusal:
            return f"exception {self.refusal:02X}"
        return short(self.pdu)


def short(data: bytes, most: int = 16) -> str:
    """Return bytes for display: ``03 02 00 AA``."""
    more = f" and {len(data) - most} more" if len(data) > most else ""
    return data[:most].hex(" ").upper() + more


def framed(framing: str, unit: int, pdu: bytes, transaction: int = 1) -> bytes:
    """Return the frame of `pdu` to `unit` in `framing`: rtu, ascii, mbap or udp."""
    body = bytes((unit,)) + pdu
    if framing == "rtu":
        return with_crc(body)
    if framing == "ascii":
        return ascii_frame(body)
    return mbap(body, transaction)


def ascii_frame(body: bytes, check: int | None = None) -> bytes:
    """Return ``:``, the hex digits, the LRC and CR LF (SL 2.5.2.1); `check` replaces the check sum."""
    return b":" + (body + bytes((lrc(body) if check is None else check,))).hex().upper().encode() + b"\r\n"


def mbap(body: bytes, transaction: int, protocol: int = 0, length: int | None = None) -> bytes:
    """Return an ADU of unit and PDU (TG 3.1.3); `protocol` and `length` override the header's fields, to make it invalid."""
    said = len(body) if length is None else length
    return transaction.to_bytes(2) + protocol.to_bytes(2) + said.to_bytes(2) + body


def replies(framing: str, data: bytes) -> tuple[list[ReceivedReply], bytes]:
    """Return all whole replies in `data`, in order, and the bytes that form no reply or an incomplete one."""
    if framing == "rtu":
        return _rtu_replies(data)
    if framing == "ascii":
        return _ascii_replies(data)
    return _mbap_replies(data)


def _rtu_replies(data: bytes) -> tuple[list[ReceivedReply], bytes]:
    answers: list[ReceivedReply] = []
    rest = bytearray()
    at = 0
    while at < len(data):
        length = _rtu_length(data[at : at + MAX_FRAME])
        if length:
            answers.append(ReceivedReply(data[at], data[at + 1 : at + length - 2]))
            at += length
        else:
            rest.append(data[at])
            at += 1
    return answers, bytes(rest)


def _rtu_length(data: bytes) -> int:
    """Return the length of the RTU frame at the start of `data`, 0 if there is none.

    If the CRC is correct for several lengths, a length that the function can have is preferred, else the shortest.
    """
    least = 5 if len(data) > 1 and data[1] & 0x80 else 4  # the CRC of 01 80 is 01 80, so an exception must be longer
    if len(data) < least:
        return 0
    fitting, crc = set(), 0xFFFF
    for at, byte in enumerate(data, 1):
        crc = crc >> 8 ^ _STEP[(crc ^ byte) & 0xFF]
        if not crc and at >= least:  # the CRC over a whole frame is 0
            fitting.add(at)
    likely = [length for length in frame_lengths(data)[0] if length in fitting]
    return likely[0] if likely else min(fitting, default=0)


def _ascii_replies(data: bytes) -> tuple[list[ReceivedReply], bytes]:
    answers: list[ReceivedReply] = []
    rest, at = bytearray(), 0
    for match in _ASCII_FRAME.finditer(data):
        text = match[1]
        body = bytes.fromhex(text.decode()) if len(text) % 2 == 0 else b""
        if len(body) < 3 or lrc(body[:-1]) != body[-1]:
            continue
        rest += data[at : match.start()]
        answers.append(ReceivedReply(body[0], body[1:-1]))
        at = match.end()
    return answers, bytes(rest + data[at:])


def _mbap_replies(data: bytes) -> tuple[list[ReceivedReply], bytes]:
    answers: list[ReceivedReply] = []
    at = 0
    while len(data) - at >= 8:
        protocol, length = int.from_bytes(data[at + 2 : at + 4]), int.from_bytes(data[at + 4 : at + 6])
        if protocol or not 2 <= length <= 254 or len(data) - at < 6 + length:
            break
        answers.append(ReceivedReply(data[at + 6], data[at + 7 : at + 6 + length], int.from_bytes(data[at : at + 2])))
        at += 6 + length
    return answers, data[at:]
