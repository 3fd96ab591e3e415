"""The device-specific functions that a profile declares, on the unit that replays the device.

Such a function has one documented request and one documented reply, and sets registers as the profile states. Other requests of
the function get exception 03. Like all emulator code, it has its own encoder.
"""

from __future__ import annotations

from fieldtwin.emulators.codec import encode
from fieldtwin.emulators.modbus.bank import IllegalValue
from fieldtwin.emulators.modbus.unit import Handler
from fieldtwin.emulators.replay.unit import ReplayUnit
from fieldtwin.gateway.core.files.profile import DeviceProfile, OwnFunction


def add_own_functions(unit: ReplayUnit, profile: DeviceProfile) -> None:
    """Make `unit` answer every function of `profile.own_functions`."""
    for function in profile.own_functions.values():
        unit.register(function.code, _handler(unit, function), request_length=1 + len(function.request))


def _handler(unit: ReplayUnit, function: OwnFunction) -> Handler:
    def respond(pdu: bytes, now_ns: int) -> bytes:
        if pdu[1:] != function.request:
            raise IllegalValue(f"{function.name}: {pdu[1:].hex(' ')}")
        for tag, value in function.sets:
            at = tag.registers
            words = encode((value - tag.offset) / tag.scale, tag.type, tag.order, registers=at.count)
            unit.replay.put(unit.unit_id, at.table, at.address, words)
        return pdu[:1] + function.reply

    return respond
