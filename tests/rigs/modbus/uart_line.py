"""A serial line bit by bit, in virtual time: the bytes that a UART receives from one with different settings.

A connector for the tests of `line` and `scan`: devices with hidden settings, other clients, a port that counts errors or does
not. Bytes are sent as levels over time and are sampled in the middle of the receiver's bits, as hardware does.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace

from commissioning_rig import loop
from modbus_virtual import VirtualWire

from fieldtwin.emulators.modbus.ascii import AsciiServer
from fieldtwin.emulators.modbus.line import LineServer
from fieldtwin.emulators.modbus.rtu.line import RtuServer
from fieldtwin.emulators.modbus.unit import ModbusUnit
from fieldtwin.gateway.connections.serial.line_counters import UartCounters
from fieldtwin.gateway.core.connection import ByteConnection, CanConnection
from fieldtwin.gateway.core.endpoint import Endpoint, SerialSettings
from fieldtwin.gateway.core.errors import EndpointBusy

OVERSAMPLING = 16


@dataclass(frozen=True)
class Received:
    """The bytes that a UART received from a waveform, each with its error flag."""

    data: bytes
    clean: bytes
    parity: int
    frame: int


def levels(data: bytes, settings: SerialSettings) -> list[int]:
    """The line's level in each bit time of the sender: start, data (low bit first), parity, stop."""
    out = []
    for byte in data:
        bits = [byte >> i & 1 for i in range(settings.data_bits)]
        out += [0, *bits]
        if settings.parity != "N":
            out.append((sum(bits) + (settings.parity == "O")) & 1)
        out += [1] * settings.stop_bits
    return out


def sampled(sent: list[int], sender: SerialSettings, receiver: SerialSettings) -> Received:
    """Return the bytes that a receiver with its own settings decodes from these levels; the line idles high afterwards."""
    ratio = sender.baudrate / receiver.baudrate  # the sender's bits per bit of the receiver
    end = len(sent)

    def level(at: float) -> int:
        i = int(at)
        return sent[i] if i < end else 1

    data, clean, parity_errors, frame_errors = bytearray(), bytearray(), 0, 0
    at, step = 0.0, ratio / OVERSAMPLING
    while at < end:
        if level(at):
            at += step
            continue
        if level(at + ratio / 2):  # too short for a start bit
            at += step
            continue
        bits = [level(at + ratio * (1.5 + i)) for i in range(receiver.data_bits)]
        where = 1.5 + receiver.data_bits
        byte, good = sum(b << i for i, b in enumerate(bits)), True
        if receiver.parity != "N":
            if (sum(bits) + level(at + ratio * where) + (receiver.parity == "O")) & 1:
                parity_errors, good = parity_errors + 1, False
            where += 1
        if not level(at + ratio * where):
            frame_errors, good = frame_errors + 1, False
        data.append(byte)
        if good:
            clean.append(byte)
        at += ratio * where
        while at < end and not good and not level(at):  # the next start bit needs an edge
            at += step
    return Received(bytes(data), bytes(clean), parity_errors, frame_errors)


@dataclass
class UartLine:
    """A connector to one line. `devices` listen and answer at `settings`; `chatter` is a foreign exchange every `period_s`:
    request and reply, the latter None if there is no reply. `counts`: our port counts errors."""

    devices: Mapping[int, ModbusUnit]
    settings: SerialSettings = SerialSettings(9600, "8N1")  # noqa: RUF009  frozen
    latency_s: float = 0.01
    counts: bool = False
    echo: bool = False
    ascii: bool = False
    chatter: tuple[tuple[bytes, bytes | None], ...] = ()
    period_s: float = 0.2
    damage: Callable[[int, bytes], bytes] = lambda n, reply: reply
    opened: list[SerialSettings] = field(default_factory=list)
    sent: list[bytes] = field(default_factory=list)
    counters: UartCounters = UartCounters()  # noqa: RUF009  frozen

    def __post_init__(self) -> None:
        self._slave: LineServer = (AsciiServer if self.ascii else RtuServer)(self.devices)
        self._port: _Port | None = None
        self._replies = 0
        self._turn = 0

    async def open_bytes(self, endpoint: Endpoint) -> ByteConnection:
        if self._port is not None:
            raise EndpointBusy("the port is held", where=str(endpoint))
        self.opened.append(endpoint.serial)
        self._port = (_CountingPort if self.counts else _Port)(endpoint, self)
        if self.chatter and len(self.opened) == 1:
            loop().call_later(0.05, self._talk)
        return self._port

    async def open_can(self, endpoint: Endpoint, bitrate: int) -> CanConnection:
        raise AssertionError("no CAN here")

    def closed(self) -> None:
        self._port = None

    def written(self, data: bytes, settings: SerialSettings) -> None:
        """Our transmission: the devices receive it with their settings, and answer with them."""
        self.sent.append(data)
        arrives_s = len(data) * settings.char_time_s
        loop().call_later(arrives_s, self._hear, data, settings)
        if self.echo:
            loop().call_later(arrives_s, self._deliver, data, settings)

    def _hear(self, data: bytes, settings: SerialSettings) -> None:
        heard = sampled(levels(data, settings), settings, self.settings).clean
        for reply in self._slave.feed(heard, loop().monotonic_ns()):
            self._replies += 1
            damaged = self.damage(self._replies, reply)
            loop().call_later(
                self.latency_s + len(reply) * self.settings.char_time_s, self._deliver, damaged, self.settings
            )

    def _deliver(self, data: bytes, settings: SerialSettings) -> None:
        if self._port is None:
            return
        got = sampled(levels(data, settings), settings, self._port.endpoint.serial)
        c = self.counters
        self.counters = replace(c, rx=c.rx + len(got.data), parity=c.parity + got.parity, frame=c.frame + got.frame)
        if got.data:
            self._port.feed(got.data)

    def _talk(self) -> None:
        request, reply = self.chatter[self._turn % len(self.chatter)]
        self._turn += 1
        self._deliver(request, self.settings)
        if reply is not None:
            loop().call_later(0.02, self._deliver, reply, self.settings)
        loop().call_later(self.period_s, self._talk)


class _Port(VirtualWire):
    def __init__(self, endpoint: Endpoint, line: UartLine) -> None:
        super().__init__(endpoint, lambda data: line.written(data, endpoint.serial))
        self._line = line

    async def aclose(self) -> None:
        if self.lost is None:
            self._line.closed()
        await super().aclose()
        await asyncio.sleep(0)


class _CountingPort(_Port):
    def counters(self) -> UartCounters | None:
        return self._line.counters

    def control_lines(self) -> dict[str, bool]:
        return {"CTS": True, "DSR": False}
