"""A CiA 406 absolute rotary encoder: code sequence, scaling, preset, and the speed of the shaft.

Objects follow CiA 406 v3.2 for multi-turn encoders, as printed in encoder makers' manuals: operating parameters 6000h, measuring
units 6001h and total range 6002h, preset 6003h, position 6004h, speed 6030h, offset 6509h. The recording holds 6004h as recorded
with the factory settings (scaling off, clockwise, no preset). That is the position of the shaft in steps; 6501h is the number of
steps per turn. Without a recorded or simulated speed, the model computes the speed from the position.
"""

from __future__ import annotations

from fieldtwin.emulators.canopen.aborts import Abort
from fieldtwin.emulators.canopen.behaviour import DeviceModel, ModelOutput, Number, Objects, Situation
from fieldtwin.emulators.canopen.eds.dictionary import Key
from fieldtwin.gateway.core.clock import NS_PER_MS, NS_PER_S

PARAMETERS, UNITS_PER_TURN, TOTAL_RANGE, PRESET, POSITION = 0x6000, 0x6001, 0x6002, 0x6003, 0x6004
SPEED, CYCLIC_TIMER, OPERATING_STATUS = 0x6030, 0x6200, 0x6500
STEPS_PER_TURN, TURNS, OFFSET = 0x6501, 0x6502, 0x6509

COUNTER_CLOCKWISE, SCALING = 1 << 0, 1 << 2
"""Bits of 6000h; 6500h shows the same two bits."""

SPEED_OVER_NS = 20 * NS_PER_MS
"""The shortest time over which the speed is measured."""


class Encoder(DeviceModel):
    """An encoder whose shaft follows the recording. Its speed is in turns per minute, measured over 20 ms or more."""

    def __init__(self) -> None:
        self._offset = 0
        self._last: tuple[int, int] | None = None
        self._speed = 0.0

    def power_on(self, situation: Situation) -> None:
        self._offset = situation.objects.whole(OFFSET)
        self._last, self._speed = None, 0.0

    def refuse(self, key: Key, value: Number, objects: Objects) -> Abort | None:
        index = key[0]
        if index == PARAMETERS and int(value) & ~(COUNTER_CLOCKWISE | SCALING):
            return Abort.VALUE
        if index == PRESET and value >= _range(objects):
            return Abort.VALUE_HIGH
        if index == UNITS_PER_TURN and not 1 <= value <= objects.number(STEPS_PER_TURN, default=value):
            return Abort.VALUE_HIGH if value else Abort.VALUE_LOW
        if index == TOTAL_RANGE and not 1 <= value <= _physical_range(objects):
            return Abort.VALUE_HIGH if value else Abort.VALUE_LOW
        return None

    def step(self, situation: Situation) -> ModelOutput:
        objects = situation.objects
        shaft = round(situation.played.get((POSITION, 0), 0))
        raw = _raw_position(shaft, objects)
        if (PRESET, 0) in situation.written:
            self._offset = objects.whole(PRESET) - raw
        position = (raw + self._offset) % _range(objects)
        speed = situation.played.get((SPEED, 1))
        if speed is None:
            self._take_speed(raw, situation)
            speed = self._speed
        parameters = objects.whole(PARAMETERS) & (COUNTER_CLOCKWISE | SCALING)
        states = {(OPERATING_STATUS, 0): parameters, (OFFSET, 0): self._offset}
        return ModelOutput(states, {(POSITION, 0): position, (SPEED, 1): speed})

    def _take_speed(self, raw: int, situation: Situation) -> None:
        now_ns, whole = situation.now_ns, _range(situation.objects)
        if self._last is None or situation.written:
            self._last = now_ns, raw  # settings may have changed the scale, so there is nothing to compare with
            return
        then_ns, then = self._last
        if now_ns - then_ns < SPEED_OVER_NS:
            return
        way = (raw - then + whole // 2) % whole - whole // 2  # the shaft took the shorter of the two ways
        self._speed = way / _units_per_turn(situation.objects) * 60 * NS_PER_S / (now_ns - then_ns)
        self._last = now_ns, raw


def _raw_position(shaft: int, objects: Objects) -> int:
    """Return the position in the configured units, without the preset's offset."""
    parameters, physical = objects.whole(PARAMETERS), _physical_range(objects)
    shaft %= physical
    if parameters & COUNTER_CLOCKWISE:
        shaft = -shaft % physical
    if parameters & SCALING:
        steps = objects.whole(STEPS_PER_TURN, default=1)
        shaft = shaft * _units_per_turn(objects) // steps
    return shaft


def _units_per_turn(objects: Objects) -> int:
    steps = max(1, objects.whole(STEPS_PER_TURN, default=1))
    scaled = objects.whole(PARAMETERS) & SCALING
    return objects.whole(UNITS_PER_TURN, default=steps) if scaled else steps


def _physical_range(objects: Objects) -> int:
    return max(1, objects.whole(STEPS_PER_TURN, default=1 << 16) * objects.whole(TURNS, default=1))


def _range(objects: Objects) -> int:
    """Return the number of positions: they run from 0 to one less than this."""
    if objects.whole(PARAMETERS) & SCALING:
        return max(1, objects.whole(TOTAL_RANGE, default=_physical_range(objects)))
    return _physical_range(objects)
