"""A CiA 401 I/O module: polarity, input masks, interrupts of inputs, and output values for errors.

Objects follow CiA 401-1 v3, as printed in makers' manuals: digital inputs 6000h to 6008h, digital outputs 6200h to
6207h, analogue inputs 6401h and 6421h to 6426h, analogue outputs 6411h, 6443h and 6444h. The recording contains 6000h
and 6401h.
"""

from __future__ import annotations

from collections.abc import Iterator

from fieldtwin.emulators.canopen.behaviour import DeviceModel, ModelOutput, Number, Objects, Situation
from fieldtwin.emulators.canopen.eds.dictionary import Key
from fieldtwin.emulators.canopen.service import NmtState
from fieldtwin.gateway.core.clock import NS_PER_MS

DIGITAL_IN, POLARITY_IN, INTERRUPT_ENABLE, ANY_CHANGE, RISING, FALLING = 0x6000, 0x6002, 0x6005, 0x6006, 0x6007, 0x6008
DIGITAL_OUT, POLARITY_OUT, ERROR_MODE_OUT, ERROR_VALUE_OUT = 0x6200, 0x6202, 0x6206, 0x6207
ANALOGUE_IN, TRIGGERS, ANALOGUE_ENABLE, UPPER, LOWER, DELTA = 0x6401, 0x6421, 0x6423, 0x6424, 0x6425, 0x6426
ANALOGUE_OUT, ANALOGUE_ERROR_MODE, ANALOGUE_ERROR_VALUE = 0x6411, 0x6443, 0x6444

AT_UPPER, BELOW_LOWER, MOVED, MOVED_DOWN, MOVED_UP = 1, 2, 4, 8, 16
"""Bits of 6421h."""

HEARTBEAT_LOST = 0x8130
SCAN_NS = 10 * NS_PER_MS
"""The interval at which the module scans its inputs while it is OPERATIONAL."""


class IoModule(DeviceModel):
    """An I/O module. `digital_outputs` and `analogue_outputs` hold the terminal values by channel group (subindex)."""

    def __init__(self) -> None:
        self.digital_outputs: dict[int, int] = {}
        self.analogue_outputs: dict[int, int] = {}
        self._inputs: dict[Key, int] = {}
        self._reported: dict[int, int] = {}

    def power_on(self, situation: Situation) -> None:
        self._inputs.clear()
        self._reported.clear()

    def step(self, situation: Situation) -> ModelOutput:
        self._set_outputs(situation)
        states: dict[Key, Number] = {}
        readings: dict[Key, Number] = {}
        for key, value, event in (*self._digital(situation), *self._analogue(situation)):
            (states if event else readings)[key] = value
        scanning = situation.nmt is NmtState.OPERATIONAL and bool(situation.played)
        return ModelOutput(states, readings, (), situation.now_ns + SCAN_NS if scanning else None)

    def _digital(self, situation: Situation) -> Iterator[tuple[Key, int, bool]]:
        """Yield each group of eight inputs with its value, and whether the masks let its change cause an interrupt."""
        objects = situation.objects
        enabled = objects.number(INTERRUPT_ENABLE, default=1)
        for sub in objects.channels(DIGITAL_IN):
            key = DIGITAL_IN, sub
            terminal = int(situation.played.get(key, 0)) ^ int(objects.factory(POLARITY_IN, sub))
            value = (terminal ^ objects.whole(POLARITY_IN, sub)) & 0xFF
            before = self._inputs.get(key, value)
            self._inputs[key] = value
            changed = value ^ before
            wanted = objects.whole(ANY_CHANGE, sub, default=0xFF)
            wanted |= objects.whole(RISING, sub) & value | objects.whole(FALLING, sub) & ~value
            yield key, value, bool(enabled and changed & wanted)

    def _analogue(self, situation: Situation) -> Iterator[tuple[Key, int, bool]]:
        objects = situation.objects
        enabled = objects.number(ANALOGUE_ENABLE)
        for sub in objects.channels(ANALOGUE_IN):
            key = ANALOGUE_IN, sub
            value = round(situation.played.get(key, 0))
            event = bool(enabled) and self._interrupts(sub, value, objects)
            if event or sub not in self._reported:
                self._reported[sub] = value
            yield key, value, event

    def _interrupts(self, sub: int, value: int, objects: Objects) -> bool:
        """Return whether the limit conditions hold and the value has moved far enough since its last interrupt."""
        triggers = objects.whole(TRIGGERS, sub, default=AT_UPPER | BELOW_LOWER | MOVED)
        moved = value - self._reported.get(sub, value)
        limits = triggers & (AT_UPPER | BELOW_LOWER)
        at_limit = (triggers & AT_UPPER and value >= objects.number(UPPER, sub)) or (
            triggers & BELOW_LOWER and value < objects.number(LOWER, sub)
        )
        delta = objects.number(DELTA, sub)
        if not triggers & (MOVED | MOVED_DOWN | MOVED_UP):
            far = moved != 0
        else:
            far = bool(
                (triggers & MOVED and abs(moved) > delta)
                or (triggers & MOVED_DOWN and -moved > delta)
                or (triggers & MOVED_UP and moved > delta)
            )
        return far and bool(at_limit or not limits)

    def _set_outputs(self, situation: Situation) -> None:
        """Set the outputs to the commanded values in OPERATIONAL, and as 6206h and 6443h state after NMT stop or a lost
        heartbeat.
        """
        objects = situation.objects
        failed = situation.nmt is NmtState.STOPPED or HEARTBEAT_LOST in situation.errors
        for sub in objects.channels(DIGITAL_OUT):
            value = objects.whole(DIGITAL_OUT, sub)
            if failed:
                mask = objects.whole(ERROR_MODE_OUT, sub, default=0xFF)
                value = value & ~mask | objects.whole(ERROR_VALUE_OUT, sub) & mask
            self.digital_outputs[sub] = (value ^ objects.whole(POLARITY_OUT, sub)) & 0xFF
        for sub in objects.channels(ANALOGUE_OUT):
            value = objects.whole(ANALOGUE_OUT, sub)
            if failed and objects.number(ANALOGUE_ERROR_MODE, sub, default=1):
                value = objects.whole(ANALOGUE_ERROR_VALUE, sub)
            self.analogue_outputs[sub] = value
