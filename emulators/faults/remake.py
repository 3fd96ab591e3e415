"""Rebuild a frame with a different unit ID or PDU and a correct checksum or length."""

from __future__ import annotations

from fieldtwin.emulators.faults.frames import FaultFrame, Framing
from fieldtwin.emulators.modbus.ascii import lrc
from fieldtwin.emulators.modbus.rtu.shapes import with_crc


def remade(frame: FaultFrame, *, unit: int | None = None, pdu: bytes | None = None) -> bytes:
    """Return the bytes of `frame` with these parts replaced. A frame of unknown content is returned unchanged."""
    if not frame.pdu:
        return frame.data
    adu = bytes((frame.unit if unit is None else unit,)) + (frame.pdu if pdu is None else pdu)
    if frame.framing is Framing.MBAP:
        return frame.data[:4] + len(adu).to_bytes(2) + adu
    if frame.framing is Framing.ASCII:
        return b":" + (adu + bytes((lrc(adu),))).hex().upper().encode() + b"\r\n"
    return with_crc(adu)
