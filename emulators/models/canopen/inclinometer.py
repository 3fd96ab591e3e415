"""A CiA 410 inclinometer: inversion, and the offsets that turn the measured value into a slope.

Objects follow CiA 410 v1.2 as printed in makers' manuals: operating parameter 6011h, preset 6012h, offset 6013h,
differential offset 6014h of the longitudinal slope 6010h, and the same from 6021h for the lateral 6020h. All are in
units of 6000h. The recording holds the slopes as recorded with the factory settings, which are the values that the cell measures.
"""

from __future__ import annotations

from fieldtwin.emulators.canopen.behaviour import DeviceModel, ModelOutput, Number, Situation
from fieldtwin.emulators.canopen.eds.dictionary import Key

SLOPES = (0x6010, 0x6020)
_PARAMETER, _PRESET, _OFFSET, _DIFFERENTIAL = 1, 2, 3, 4
"""Index offsets of a slope's settings from the index of the slope."""

_KEYS = tuple((slope, (slope, 0), (slope + _PRESET, 0), (slope + _OFFSET, 0)) for slope in SLOPES)

INVERTED, SCALED = 1, 2
"""Bits of the operating parameter."""


class Inclinometer(DeviceModel):
    """An inclinometer with one axis or two, 16 bits."""

    def __init__(self) -> None:
        self._offsets: dict[int, int] = {}

    def power_on(self, situation: Situation) -> None:
        self._offsets = {slope: situation.objects.whole(slope + _OFFSET) for slope in SLOPES}

    def step(self, situation: Situation) -> ModelOutput:
        objects, played, written = situation.objects, situation.played, situation.written
        states: dict[Key, Number] = {}
        readings: dict[Key, Number] = {}
        for slope, reading, preset_key, offset_key in _KEYS:
            if reading not in played:
                continue
            measured = float(played[reading])
            parameter = objects.whole(slope + _PARAMETER)
            if parameter & INVERTED:
                measured = -measured
            differential = objects.number(slope + _DIFFERENTIAL)
            if offset_key in written:
                self._offsets[slope] = objects.whole(slope + _OFFSET)
            if preset_key in written:
                preset = objects.number(slope + _PRESET)
                self._offsets[slope] = round(preset - measured - differential)
            offset = self._offsets.get(slope, 0)
            readings[reading] = measured + (offset + differential if parameter & SCALED else 0)
            states[offset_key] = offset
        return ModelOutput(states, readings)
