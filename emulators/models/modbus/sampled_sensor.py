"""A sensor that takes samples: its registers come from a profile, its values from recorded signals.

The sensor takes a sample every period, the first one immediately. The period in seconds is the one that a client has written into
the tag that the profile names, or before that the initial one. A period of 0 is standby, a negative one is off. A sample
holds the values of all signals of the recording at one instant of the emulator's clock; the `instrument_time` register holds this
instant in milliseconds if the profile has such a register. The sensor runs no task and never waits: samples that are due are
taken at the next access.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence

from fieldtwin.emulators.codec import decode, encode
from fieldtwin.emulators.distortion import Distortions
from fieldtwin.emulators.journal import DeviceValueLog
from fieldtwin.emulators.modbus.bank import Access, CellSpan, IllegalValue, MapBank, RegisterBank, Table
from fieldtwin.emulators.signals import Signals
from fieldtwin.emulators.stated import bytes_of, cells_held, touches
from fieldtwin.gateway.core.clock import NS_PER_S
from fieldtwin.gateway.core.errors import FileInvalid
from fieldtwin.gateway.core.files.profile import DeviceProfile, Tag

STANDBY, SAMPLING, OFF = 0, 1, 2
MAX_CATCH_UP = 3600
"""The largest number of samples that one access takes after a long time without an access. Older samples are skipped, but
counted.
"""

OWN = ("status", "instrument_time")
"""Tags whose values the model provides itself, in addition to the sample counter and the period."""


def sampled_tags(profile: DeviceProfile, identity: Iterable[str]) -> list[Tag]:
    """Return the tags whose values a sampling sensor takes from signals: numeric tags, except those that it fills itself."""
    assert profile.sampled is not None
    own = {*OWN, profile.sampled.period, profile.sampled.count, *identity}
    return [t for t in profile.tags.values() if t.name not in own and not t.is_text]


class SampledSensor(RegisterBank):
    """The register bank of a sampling sensor. `identity` gives text tags their values (a serial number).

    `period_s` is the sampling period that it has at first, in seconds.
    """

    def __init__(self, profile: DeviceProfile, player: Signals, identity: Mapping[str, str], period_s: int = 0) -> None:
        if profile.sampled is None:
            raise FileInvalid("the profile has no `sampled`", path=profile.path, expected="`sampled:`")
        self.journal = DeviceValueLog()
        self.distortions = Distortions()
        """The value faults of the sensor's signals, which apply to the next samples."""
        self.samples = 0
        self._player = player
        self._tags = profile.tags
        self._period_tag = profile.tags[profile.sampled.period]
        self._count_tag = profile.tags[profile.sampled.count]
        self._signals = sampled_tags(profile, identity)
        for tag in self._signals:
            player.at(player.start_ns, tag.name)  # refuse a recording that lacks a signal of the device
        self._cells = MapBank(_spans(profile), self._on_write)
        self._period_s = 0
        self._next_ns = 0
        for tag in self._signals:
            self._put(tag, 0 if tag.type.startswith(("int", "uint")) else math.nan, player.start_ns)
        for tag in (self._count_tag, self._period_tag, *(profile.tags[n] for n in OWN if n in profile.tags)):
            self._put(tag, 0, player.start_ns)
        for name, text in identity.items():
            self._put(self._tag(name, profile), text, player.start_ns)
        for tag in profile.tags.values():  # a text without an identity is read as an empty text
            if tag.is_text and tag.readable and tag.name not in identity:
                self._note(tag, player.start_ns)
        if period_s:
            self._put(self._period_tag, period_s, player.start_ns)
            self._set_period(period_s, player.start_ns)

    @staticmethod
    def _tag(name: str, profile: DeviceProfile) -> Tag:
        if name not in profile.tags:
            raise FileInvalid(
                f"{profile.name} has no tag {name!r}", path=profile.path, expected=", ".join(profile.tags)
            )
        return profile.tags[name]

    @property
    def period_s(self) -> int:
        """Return the sampling period in seconds, as last written."""
        return self._period_s

    def read(self, table: Table, address: int, count: int, now_ns: int) -> Sequence[int]:
        if self._period_s > 0:
            self._take_due(now_ns)
        return self._cells.read(table, address, count, now_ns)

    def peek(self, table: Table, address: int) -> int:
        """Return the value of a cell, without taking samples that are due."""
        return self._cells.peek(table, address)

    @property
    def own_tags(self) -> list[Tag]:
        """Return the numeric tags that the model fills itself. Faults change them when a client reads them, not earlier."""
        signals = {tag.name for tag in self._signals}
        return [tag for tag in self._tags.values() if tag.name not in signals and not tag.is_text]

    def check_read(self, table: Table, address: int, count: int, now_ns: int) -> None:
        self._cells.check_read(table, address, count, now_ns)

    def write(self, table: Table, address: int, values: Sequence[int], now_ns: int) -> None:
        self._take_due(now_ns)
        self._cells.write(table, address, values, now_ns)
        self._note_tags(table, address, len(values), now_ns)
        at = self._period_tag.registers
        if table == at.table and address <= at.address < address + len(values):
            self._set_period(self._held_period(), now_ns)

    def _held_period(self) -> int:
        words = cells_held(self._period_tag, self._cells.peek)
        return int(decode(words, self._period_tag.type, self._period_tag.order))

    def _on_write(self, table: Table, address: int, values: tuple[int, ...], now_ns: int) -> None:
        """Refuse a write that covers only part of the period, because it would leave half a value."""
        at = self._period_tag.registers
        if table == at.table and address < at.end and address + len(values) > at.address:
            whole = address <= at.address and address + len(values) >= at.end
            if not whole:
                raise IllegalValue("half of the sample period", expected="all of its registers in one write")

    def _set_period(self, period_s: int, now_ns: int) -> None:
        self._period_s = period_s
        self._next_ns = now_ns
        status = SAMPLING if period_s > 0 else STANDBY if period_s == 0 else OFF
        if "status" in self._tags:
            self._put(self._tags["status"], status, now_ns)
        self._take_due(now_ns)

    def _take_due(self, now_ns: int) -> None:
        """Take every sample that is due up to `now_ns`, each at its own time."""
        if self._period_s <= 0 or now_ns < self._next_ns:
            return
        step_ns = self._period_s * NS_PER_S
        due = (now_ns - self._next_ns) // step_ns + 1
        skipped = max(0, due - MAX_CATCH_UP)
        self.samples += skipped
        self._next_ns += skipped * step_ns
        while self._next_ns <= now_ns:
            self._sample(self._next_ns)
            self._next_ns += step_ns

    def _sample(self, t_ns: int) -> None:
        """Take one sample of the signals at the instrument's time, which is the recording's time in whole milliseconds."""
        time_ms = round(self._player.position_s(t_ns) * 1000)
        values = self._player.values_at(time_ms / 1000)
        self.samples += 1
        for tag in self._signals:
            value = values[tag.name]
            if self.distortions:
                value = self.distortions.apply(tag.name, value, t_ns)
            self._put(tag, (value - tag.offset) / tag.scale, t_ns)
        if "instrument_time" in self._tags:
            self._put(self._tags["instrument_time"], time_ms & 0xFFFFFFFF, t_ns)
        self._put(self._count_tag, self.samples & 0xFFFFFFFF, t_ns)

    def _put(self, tag: Tag, value: float | int | str, now_ns: int) -> None:
        """Set a tag to a raw value (without scale and offset) or a text, and add it to the journal."""
        at = tag.registers
        words = encode(value, tag.type, tag.order, registers=at.count)
        self._cells.poke(at.table, at.address, *words)
        self.journal.note(tag.name, bytes_of(tag, words), now_ns)

    def _note_tags(self, table: Table, address: int, count: int, now_ns: int) -> None:
        """Journal the new values of the tags that a client's write touched."""
        for tag in self._tags.values():
            if touches(tag, table, range(address, address + count)):
                self._note(tag, now_ns)

    def _note(self, tag: Tag, now_ns: int) -> None:
        """Journal the present value of the registers of `tag`."""
        self.journal.note(tag.name, bytes_of(tag, cells_held(tag, self._cells.peek)), now_ns)


def _spans(profile: DeviceProfile) -> list[CellSpan]:
    """Return the cells that exist: those of the tags, each cell once."""
    spans: dict[tuple[str, int], CellSpan] = {}
    for tag in profile.tags.values():
        at = tag.registers
        access: Access = "ro" if tag.access == "ro" else "rw" if tag.access == "rw" else "wo"
        for address in range(at.address, at.end):
            spans.setdefault((at.table, address), CellSpan(at.table, address, 1, access))
    return list(spans.values())
