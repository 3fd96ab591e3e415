"""A CiA 410 inclinometer: inversion, and the offsets that make a slope of what the cell measures.

Objects after CiA 410 v1.2 as makers' manuals print them: operating parameter 6011h, preset 6012h, offset 6013h, differential
offset 6014h of the longitudinal slope 6010h, and the same from 6021h for the lateral 6020h. All in units of 6000h. The recording
plays the slopes as they were with the factory's settings, which is what the cell measures.
"""

from __future__ import annotations

from emulators.canopen.behaviour import DeviceModel, Number, Outcome, Situation
from emulators.canopen.dictionary import Key

SLOPES = (0x6010, 0x6020)
_PARAMETER, _PRESET, _OFFSET, _DIFFERENTIAL = 1, 2, 3, 4
"""Where a slope's settings stand behind it."""

INVERTED, SCALED = 1, 2
"""Bits of the operating parameter."""


class Inclinometer(DeviceModel):
    """One axis or two, 16 bits."""

    def __init__(self) -> None:
        self._offsets: dict[int, int] = {}

    def power_on(self, situation: Situation) -> None:
        self._offsets = {slope: situation.objects.whole(slope + _OFFSET) for slope in SLOPES}

    def step(self, situation: Situation) -> Outcome:
        objects = situation.objects
        states: dict[Key, Number] = {}
        readings: dict[Key, Number] = {}
        for slope in SLOPES:
            if (slope, 0) not in situation.played:
                continue
            measured = float(situation.played[slope, 0])
            parameter = objects.whole(slope + _PARAMETER)
            if parameter & INVERTED:
                measured = -measured
            differential = objects.number(slope + _DIFFERENTIAL)
            if (slope + _OFFSET, 0) in situation.written:
                self._offsets[slope] = objects.whole(slope + _OFFSET)
            if (slope + _PRESET, 0) in situation.written:
                preset = objects.number(slope + _PRESET)
                self._offsets[slope] = round(preset - measured - differential)
            offset = self._offsets.get(slope, 0)
            readings[slope, 0] = measured + (offset + differential if parameter & SCALED else 0)
            states[slope + _OFFSET, 0] = offset
        return Outcome(states, readings)
