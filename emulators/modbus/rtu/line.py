"""Modbus RTU, server side: the units of one line that uses RTU frames (SL 2.5.1)."""

from __future__ import annotations

from collections.abc import Mapping

from fieldtwin.emulators.modbus.line import LineServer, ServedFrame, UnitLineCounters
from fieldtwin.emulators.modbus.rtu.receiver import FRAME_GAP_NS, RtuReceiver, with_crc
from fieldtwin.emulators.modbus.rtu.shapes import Declared
from fieldtwin.emulators.modbus.rtu.strict import StrictReceiver
from fieldtwin.emulators.modbus.unit import ModbusUnit
from fieldtwin.gateway.core.endpoint import SerialSettings

__all__ = ["RtuServer", "ServedFrame", "UnitLineCounters"]


class RtuServer(LineServer):
    """The server for the units of one RTU line.

    `units` maps a unit ID (1 to 247) to its unit. A pause of `gap_ns` ends an unfinished frame.

    By default frames are recognised by length and checksum, which tolerates irregular timing. `strict` gives the
    settings of the line; frames are then recognised by the pauses of SL 2.5.1.1 alone, which requires that bytes are
    delivered one by one and in time.
    """

    check_bytes = 2

    def __init__(
        self, units: Mapping[int, ModbusUnit], gap_ns: int = FRAME_GAP_NS, strict: SerialSettings | None = None
    ) -> None:
        receiver = StrictReceiver(strict) if strict is not None else _receiver(units, gap_ns)
        super().__init__(units, receiver)

    def encode(self, frame: bytes) -> bytes:
        return with_crc(frame)


def _receiver(units: Mapping[int, ModbusUnit], gap_ns: int) -> RtuReceiver:
    lengths = {unit_id: unit.request_lengths for unit_id, unit in units.items()}
    return RtuReceiver(frozenset(units), gap_ns, Declared(lengths))
