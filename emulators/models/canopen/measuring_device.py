"""A CiA 404 measuring device: a field value, its linear conversion to a process value through two points, and taring.

Objects follow CiA 404 (2002, v1.2), analogue input block, as printed in sensor makers' manuals. The field value 6100h is the
output of the cell, the process value 6130h is in the unit of 6131h, and 7130h and 9130h are the same value as integers with 6132h
decimal digits. The recording holds one of these three objects as recorded with the factory scaling.
"""

from __future__ import annotations

import math
from collections.abc import Callable

from fieldtwin.emulators.canopen.aborts import Abort
from fieldtwin.emulators.canopen.behaviour import DeviceModel, ModelOutput, Number, Objects, Situation
from fieldtwin.emulators.canopen.eds.dictionary import Key

FIELD_VALUE, OPERATING_MODE = 0x6100, 0x6112
POINT_1_FIELD, POINT_1_PROCESS, POINT_2_FIELD, POINT_2_PROCESS = 0x6120, 0x6121, 0x6122, 0x6123
OFFSET, AUTOZERO = 0x6124, 0x6125
PROCESS_VALUE, DIGITS = 0x6130, 0x6132
SPAN_START, SPAN_END, STATUS = 0x6148, 0x6149, 0x6150
PROCESS_INTEGER_16, PROCESS_INTEGER_32 = 0x7130, 0x9130

ZERO = int.from_bytes(b"zero", "little")
"""The value that must be written to 6125h to tare the device: four letters, so that a scale is not tared by accident."""

OFF, NORMAL = 0, 1
NOT_VALID, ABOVE_SPAN, BELOW_SPAN = 1, 2, 4
"""Bits of 6150h."""


class MeasuringDevice(DeviceModel):
    """A measuring device with as many channels as 6130h has."""

    def __init__(self) -> None:
        self._offsets: dict[int, float] = {}

    def power_on(self, situation: Situation) -> None:
        self._offsets.clear()

    def refuse(self, key: Key, value: Number, objects: Objects) -> Abort | None:
        index, sub = key
        if index == AUTOZERO and value != ZERO:
            return Abort.NOT_STORED
        points = {POINT_1_FIELD: POINT_2_FIELD, POINT_2_FIELD: POINT_1_FIELD}
        if index in points and value == objects.number(points[index], sub):
            return Abort.INCOMPATIBLE  # two points with the same field value do not define a line
        return None

    def step(self, situation: Situation) -> ModelOutput:
        readings: dict[Key, Number] = {}
        states: dict[Key, Number] = {}
        for sub in situation.objects.channels(PROCESS_VALUE):
            self._channel(sub, situation, readings, states)
        return ModelOutput(states, readings)

    def _channel(self, sub: int, situation: Situation, readings: dict[Key, Number], states: dict[Key, Number]) -> None:
        objects = situation.objects
        played = _played(sub, situation)
        field = _field_value(played - float(objects.factory(OFFSET, sub)), sub, objects)
        process = _process_value(field, sub, objects)
        if (AUTOZERO, sub) in situation.written and math.isfinite(process):
            self._offsets[sub] = -process
        elif (OFFSET, sub) in situation.written:
            self._offsets.pop(sub, None)
        offset = self._offsets.get(sub, float(objects.number(OFFSET, sub)))
        process += offset
        if objects.number(OPERATING_MODE, sub, default=NORMAL) == OFF:
            process = math.nan
        status = _status(process, sub, objects)
        states |= {(STATUS, sub): status, (OFFSET, sub): offset}
        value = process if math.isfinite(process) else 0.0
        whole = value * 10 ** objects.whole(DIGITS, sub)
        readings |= {
            (FIELD_VALUE, sub): field if math.isfinite(field) else 0.0,
            (PROCESS_VALUE, sub): value,
            (PROCESS_INTEGER_16, sub): whole,
            (PROCESS_INTEGER_32, sub): whole,
        }


def _played(sub: int, situation: Situation) -> float:
    """Return the recorded process value, from a number or from one of the integers with the factory's digits."""
    if (PROCESS_VALUE, sub) in situation.played:
        return float(situation.played[PROCESS_VALUE, sub])
    for index in (PROCESS_INTEGER_32, PROCESS_INTEGER_16):
        if (index, sub) in situation.played:
            return float(situation.played[index, sub]) / float(10 ** int(situation.objects.factory(DIGITS, sub)))
    return math.nan


def _field_value(process: float, sub: int, objects: Objects) -> float:
    """Return the field value for which the device with its factory settings gives the process value `process`."""
    f1, p1, f2, p2 = _line(sub, objects.factory)
    return process if p1 == p2 else f1 + (process - p1) * (f2 - f1) / (p2 - p1)


def _process_value(field: float, sub: int, objects: Objects) -> float:
    f1, p1, f2, p2 = _line(sub, objects.number)
    return field if f1 == f2 else p1 + (field - f1) * (p2 - p1) / (f2 - f1)


def _line(sub: int, number: Callable[[int, int, Number], Number]) -> tuple[float, float, float, float]:
    """Return the two points of the conversion. Without their objects, field value and process value are equal."""
    first = float(number(POINT_1_FIELD, sub, 0.0)), float(number(POINT_1_PROCESS, sub, 0.0))
    second = float(number(POINT_2_FIELD, sub, 1.0)), float(number(POINT_2_PROCESS, sub, 1.0))
    return *first, *second


def _status(process: float, sub: int, objects: Objects) -> int:
    """Return 6150h: whether the value is invalid, or outside of the measuring span if there is a span."""
    if not math.isfinite(process):
        return NOT_VALID
    low, high = float(objects.number(SPAN_START, sub)), float(objects.number(SPAN_END, sub))
    if low < high and process > high:
        return ABOVE_SPAN
    return BELOW_SPAN if low < high and process < low else 0
