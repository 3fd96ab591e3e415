"""A wrong checksum."""

from __future__ import annotations

from random import Random

from fieldtwin.emulators.faults.fault import FaultEffect, WireFault, passed
from fieldtwin.emulators.faults.frames import FaultFrame, Framing


class CorruptCrc(WireFault):
    name = "corrupt-crc"
    summary = "the check sum (CRC of RTU, LRC of ASCII) is wrong; no effect over TCP, which has none"
    framings = frozenset({Framing.RTU, Framing.ASCII})

    def apply(self, frame: FaultFrame, random: Random) -> FaultEffect:
        data = frame.data
        if frame.framing is Framing.RTU and data:
            return passed(data[:-1] + bytes((data[-1] ^ 0x5A,)))
        if frame.framing is Framing.ASCII and len(data) > 5:
            last = data[-3:-2]
            return passed(data[:-3] + (b"0" if last != b"0" else b"1") + data[-2:])
        return passed(data)
