"""The paper's Emulator: a Device whose answers come from a virtual context (SPEC rows Emulator, SensorEmulator).

In its pure form, request bits in and recorded response bits out, each recording returned once. What an emulator is on a real
protocol, with registers and time, is built on the same context: emulators.replay for recorded exchanges, emulators.models for
devices that follow recorded signals.
"""

from __future__ import annotations

from pathlib import Path

from emulators.context import Recorded, VirtualContext, WhenUsedUp
from gateway.core.connection import RS232Connection
from gateway.core.device import Device, WireEnd
from gateway.core.recording import RecordingReader
from gateway.core.values import COMMAND, RECORDING, RESPONSE


class Emulator(Device):
    """A Device, and not a Sensor: the real one is a black box. `virtual_context` is a collection of RECORDINGs.

    ExecuteCommand requires the command to be in the list, returns one recording of the context and removes it.
    """

    def __init__(self, connection: WireEnd, context: VirtualContext) -> None:
        super().__init__(connection, context.command_list)
        self.virtual_context = context

    def _execute(self, command: COMMAND) -> RESPONSE:
        return self.virtual_context.take(command)


class SensorEmulator(Emulator):
    """An Emulator on RS232."""

    wire_types = frozenset({RS232Connection.type})


def context_of(recording: Path, unit: int, when_used_up: WhenUsedUp = WhenUsedUp.HOLD) -> VirtualContext:
    """The virtual context that a recording of exchanges holds for one unit: request bits to response bits, in order.

    Exchanges without a reply are left out. Raises `FileInvalid`.
    """
    context = VirtualContext(when_used_up=when_used_up)
    with RecordingReader(recording) as reader:
        for exchange in reader.exchanges():
            if exchange.unit == unit and exchange.reply:
                recorded = Recorded(exchange.t_s, RECORDING(exchange.reply), exchange.latency_s)
                context.add(COMMAND(exchange.request), recorded)
    return context
