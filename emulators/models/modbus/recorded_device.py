"""A device emulated from a recording of exchanges, with data from its profile: counters, identity, device-specific functions.

Like every emulator, it is reached through a connection of the device's own type and keeps a journal, here of every value that it
returned to a read. It must not depend on the gateway's driver or on the medium of the connection.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path

from fieldtwin.emulators.codec import encode
from fieldtwin.emulators.context import EndOfRecording
from fieldtwin.emulators.distortion import Distortions
from fieldtwin.emulators.emulator import emulator_kind
from fieldtwin.emulators.journal import DeviceValueLog
from fieldtwin.emulators.replay.counters import CounterSpan
from fieldtwin.emulators.replay.profiled import ProfiledReplay
from fieldtwin.emulators.replay.replay import ExchangeReplay
from fieldtwin.emulators.replay.requests import parse_request
from fieldtwin.emulators.stated import bytes_of, cells_of, merged, raw_of
from fieldtwin.gateway.core.connection import Connection
from fieldtwin.gateway.core.device import wire
from fieldtwin.gateway.core.errors import FileInvalid, UnknownCommand
from fieldtwin.gateway.core.files.profile import DeviceProfile, Tag
from fieldtwin.gateway.core.files.recording import RecordingReader

MOST_COUNTED = 4
"""The largest number of registers of a counter."""


def load_replay(
    profile: DeviceProfile, path: Path, at_end: EndOfRecording = EndOfRecording.HOLD
) -> tuple[ExchangeReplay, int]:
    """Return a recording of exchanges with a device of `profile`, and its unit ID in the recording.

    The unit ID is the profile's factory setting if the recording contains it, else the lowest recorded one. Raises `FileInvalid`.
    """
    with RecordingReader(path) as reader:
        exchanges = list(reader.exchanges())
    recorded = sorted({e.unit for e in exchanges})
    if not recorded:
        raise FileInvalid("the recording holds no exchange", path=str(path))
    unit = profile.form.factory.unit if profile.form.factory.unit in recorded else recorded[0]
    spans = [
        CounterSpan(unit, t.at.table, t.at.address, t.at.count)
        for t in profile.tags.values()
        if t.counter and t.at is not None and t.at.count <= MOST_COUNTED
    ]
    return ExchangeReplay(exchanges, when_used_up=at_end, counters=spans), unit


class RecordedDevice(ProfiledReplay):
    """One unit that replays a recording. `kind` is the connection type of the emulated device.

    `identity` maps tags to values that replace the recorded ones. A request that is not in the profile's command list is also
    answered, and counted in `unlisted`.
    """

    def __init__(
        self,
        profile: DeviceProfile,
        replay: ExchangeReplay,
        unit_id: int,
        kind: type[Connection[bytes]],
        identity: Mapping[str, str],
        name: str = "",
    ) -> None:
        super().__init__(profile, replay, unit_id, name)
        end, self._line = wire(kind)
        self.emulator = emulator_kind(end.type, profile)(end, profile, replay.context, super().respond)
        self.journal = DeviceValueLog()
        self.distortions = Distortions()
        """The value faults that change the device's answers to reads."""
        self.unlisted = 0
        self._readable = [t for t in profile.tags.values() if t.readable and t.at is not None]
        for tag, text in ((profile.tags[n], text) for n, text in identity.items()):
            at, value = tag.registers, text if tag.is_text else float(text)
            replay.put(unit_id, at.table, at.address, encode(value, tag.type, tag.order, registers=at.count))

    def respond(self, pdu: bytes, now_ns: int) -> bytes | None:
        self._line.write(pdu)
        try:
            self.emulator.receive(now_ns)
            reply = self._line.read() or None
        except UnknownCommand:
            self.unlisted += 1
            reply = super().respond(pdu, now_ns)
        if reply is not None and reply[0] == pdu[0]:
            if self.distortions:
                reply = self._distorted(pdu, reply, now_ns)
            self._note(pdu, reply, now_ns)
        return reply

    def _distorted(self, pdu: bytes, reply: bytes, now_ns: int) -> bytes:
        """Return the reply to a read of registers with the distorted values in it."""
        request = parse_request(pdu)
        if request is None or request.values is not None or request.table in ("coil", "discrete"):
            return reply
        data = bytearray(reply)
        for tag in self._readable:
            at = tag.registers
            inside = at.table == request.table and request.address <= at.address and at.end <= request.addresses.stop
            if not inside or tag.is_text or not self.distortions.of(tag.name):
                continue
            first = 2 + 2 * (at.address - request.address)
            words = [int.from_bytes(data[i : i + 2]) for i in range(first, first + 2 * at.count, 2)]
            value = self.distortions.apply(tag.name, raw_of(tag, words) * tag.scale + tag.offset, now_ns)
            if math.isnan(value) and tag.bits is not None:
                continue  # bits cannot express "no number"
            words = [merged(tag, own, cell) for own, cell in zip(words, cells_of(tag, value), strict=True)]
            data[first : first + 2 * at.count] = bytes_of(tag, words)
        return bytes(data)

    def _note(self, pdu: bytes, reply: bytes, now_ns: int) -> None:
        request = parse_request(pdu)
        if request is None or request.values is not None:
            return
        for tag in self._readable:
            at = tag.registers
            if at.table == request.table and request.address <= at.address and at.end <= request.addresses.stop:
                self.journal.note(tag.name, _raw(tag, at.address - request.address, reply[2:]), now_ns)


def _raw(tag: Tag, offset: int, data: bytes) -> bytes:
    """Return the bytes of a tag from the data of a reply; a bit is one byte."""
    if tag.registers.table in ("coil", "discrete"):
        return bytes([data[offset // 8] >> offset % 8 & 1])
    return data[2 * offset : 2 * (offset + tag.registers.count)]
