"""A device with a wrong parity: about half of the bytes have parity errors, and the port drops them."""

from __future__ import annotations

from random import Random

from fieldtwin.emulators.faults.fault import LOST, FaultEffect, WireFault, passed
from fieldtwin.emulators.faults.frames import FaultFrame


class WrongParity(WireFault):
    name = "wrong-parity"
    summary = "bytes whose parity bit is wrong are dropped, which depends on their bits"

    def apply(self, frame: FaultFrame, random: Random) -> FaultEffect:
        heard = bytes(byte for byte in frame.data if byte.bit_count() % 2 == 0)
        return passed(heard) if heard else LOST
