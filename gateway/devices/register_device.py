"""Drivers of Modbus devices: they read poll groups and write single values.

A group is read in as few transactions as the profile's limits and the gaps in the device's registers allow
(`read_plan`). A value or a message is never split over two transactions, so it has one time stamp. Where a profile
declares that values are *samples*, they are as old as the sample, not as the poll: a sensor that answers but does not
sample has no good values.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field

from fieldtwin.gateway.core.clock import NS_PER_MS, NS_PER_S
from fieldtwin.gateway.core.connection import PROTOCOL, ByteConnection
from fieldtwin.gateway.core.errors import Bug, ModbusExceptionReply, NotAllowed, VerifyFailed, WrongDevice
from fieldtwin.gateway.core.files.profile import Tag
from fieldtwin.gateway.core.values import COMMAND, DATA, MEASUREMENT, Quality, Reason, TagValue
from fieldtwin.gateway.devices.codec import apply_scale, decode, encode
from fieldtwin.gateway.devices.config import DeviceConfig
from fieldtwin.gateway.devices.driver import DeviceDriver, TagSink
from fieldtwin.gateway.devices.read_plan import (
    ILLEGAL_ADDRESS,
    TOO_LONG,
    GroupPlan,
    Learnt,
    Read,
    cells,
    place_of,
    read_request,
)
from fieldtwin.gateway.protocols.modbus.client import ModbusClient
from fieldtwin.gateway.protocols.modbus.unit_timing import UnitPace

MOST_REGISTERS, MOST_COILS = 123, 1968
"""The largest numbers of registers and coils that one request may write (AP 6.11 and 6.12)."""
SAMPLED_STEPS = 0x80000000
"""A step of the sample counter that is larger than this is a step backwards: the device restarted."""


NOTHING_READ = 1 << 16
"""The cost of a poll group without reads: more registers or bits than a device can have."""


class GroupReading:
    """A poll group that is being read, transaction by transaction. When all have been read, `items` holds the data to emit."""

    __slots__ = ("blocks", "items", "todo", "values", "what")

    def __init__(self, what: str, todo: Iterable[Read] = ()) -> None:
        self.what = what
        self.todo = deque(todo)
        self.blocks: list[tuple[Read, bytes]] = []
        self.values: dict[str, TagValue] = {}
        self.items: list[DATA] = []


@dataclass
class WriteProgress:
    """The progress of writing several tags: the tags that were sent, and the tags that the device confirmed."""

    sent: set[str] = field(default_factory=set)
    confirmed: set[str] = field(default_factory=set)


class RegisterDriver(DeviceDriver):
    """A driver of a Modbus device, created from its profile.

    `receive` reads a whole group. If other devices share the bus, call `begin`, then `read_next` until it returns True, then
    `finish`, which emits the messages. Each call of `read_next` carries out one transaction.
    """

    wire_types = frozenset({PROTOCOL.RS232, PROTOCOL.TCP})

    def __init__(self, config: DeviceConfig, sink: TagSink) -> None:
        super().__init__(config, sink)
        self.learnt = Learnt()
        self.plans = {group: GroupPlan(self.profile, group, self.learnt) for group in self.profile.groups}
        self.samples_missed = 0
        self.may_trigger = False
        """Whether this driver may write the register that makes its device measure. The gateway sets this attribute."""
        self._client: ModbusClient | None = None
        self._sample_count: int | None = None
        self._sample_t_ns = 0
        self._held: dict[str, TagValue] = {}
        self._decoded: dict[str, TagValue] = {}
        """The last decoded value of each tag, because the bytes of a tag usually do not change between polls."""
        self._names = {name: f"{config.name}.{name}" for name in self.profile.tags}
        self._scales = any(tag.scale_by is not None for tag in self.profile.tags.values())

    @property
    def message_tag(self) -> str | None:
        """Return the full name of the message that this driver emits, or None."""
        return next((f"{self.config.name}.{name}" for name in self.profile.messages), None)

    @property
    def client(self) -> ModbusClient:
        """Return the Modbus client of the bus that this device is connected to."""
        if self._client is None:
            raise Bug("a driver without a client was used", where=self.config.where)
        return self._client

    def attach_client(self, connection: ByteConnection, client: ModbusClient) -> None:
        """Use `client`, which communicates over `connection`, from now on."""
        self.attach(connection)
        self._client = client
        client.units.set_pace(self.config.address, UnitPace(self.config.timeout_s, self.config.spacing_s))

    def reconfigure(self, config: DeviceConfig) -> None:
        if config.profile != self.profile:
            self.plans = {g: GroupPlan(config.profile, g, self.learnt) for g in config.profile.groups}
            self._decoded.clear()
            self._names = {name: f"{config.name}.{name}" for name in config.profile.tags}
            self._scales = any(tag.scale_by is not None for tag in config.profile.tags.values())
        super().reconfigure(config)
        if self._client is not None:
            self._client.units.set_pace(config.address, UnitPace(config.timeout_s, config.spacing_s))

    def understood(self, tag_name: str, held: TagValue, of: TagValue | None) -> TagValue:
        """Return the value of a tag, decoded with the present configuration from the bytes in `held`.

        `of` is the value of the tag that holds its scale factor, or None if it has no scale factor."""
        tag = self.profile.tags[tag_name]
        value = decode(tag, held.raw, held.t_ns)
        return apply_scale(tag, value, of) if tag.scale_by is not None else value

    def know(self, learnt: Learnt) -> None:
        """Take over the gaps and missing tags that an earlier run learnt.

        Call it before the first read. Missing tags are requested once more.
        """
        self.learnt.gaps = list(learnt.gaps)
        self.learnt.missing = list(learnt.missing)
        self.ask_again()

    def ask_again(self) -> None:
        """Request missing tags again, because the device may have them after it was absent."""
        for plan in self.plans.values():
            plan.plan_again()

    def command(self, tag_name: str, value: float) -> COMMAND:
        """Return the command that writes `value` (engineering units) to a tag. Raises `NotAllowed` outside its
        limits."""
        tag = self.profile.tags.get(tag_name)
        if tag is None or not tag.writable:
            raise NotAllowed(f"the tag {tag_name!r} cannot be written", where=self.config.where)
        return COMMAND(encode(tag, value), self.profile.command_for(tag_name))

    async def identify(self) -> None:
        """Read the identity group and compare it with what the system file expects.

        Raises `WrongDevice` on a difference; the runtime then blocks writes and reports why.
        """
        if not self.config.expect:
            return
        values: dict[str, TagValue] = {}
        for tag_name in self.config.expect:
            tag = self.profile.tags[tag_name]
            values[tag_name] = await self._read_tag(tag)
        wrong = {n: v.value for n, v in values.items() if str(v.value) != self.config.expect[n]}
        self.identity_error = ", ".join(f"{n} is {v!r}" for n, v in wrong.items())
        if wrong:
            expected = ", ".join(f"{n} {self.config.expect[n]!r}" for n in wrong)
            raise WrongDevice(
                "a different device answers", expected=expected, got=self.identity_error, where=self.config.where
            )

    def cost(self, what: str) -> int:
        """Return the number of registers or bits that the first transaction of the group `what` reads. The number
        stands for the bus time that a failed attempt takes.

        A group without any reads cannot show whether the device is present, so its cost is higher than that of any other group.
        """
        plan = self.plans.get(what)
        return plan.reads[0].range.count if plan is not None and plan.reads else NOTHING_READ

    def begin(self, what: str) -> GroupReading:
        """Prepare to read the poll group `what`. Nothing is sent yet."""
        return GroupReading(what, self.plans[what].reads)

    async def read_next(self, reading: GroupReading) -> bool:
        """Carry out one transaction of `reading`. Return True when it was the last one and all values are published.

        After an error, the next call repeats the same transaction.
        """
        if reading.todo:
            await self._read_block(reading)
        if reading.todo:
            return False
        self.plans[reading.what].pass_ended()
        reading.items = self._complete(reading)
        return True

    def finish(self, reading: GroupReading) -> None:
        """Emit the events that `reading` has collected, such as messages, to the consumers of the driver."""
        for item in reading.items:
            self.emitter.emit(item)

    async def _read(self, what: str) -> list[DATA]:
        reading = self.begin(what)
        while not await self.read_next(reading):
            pass
        return reading.items

    async def _read_block(self, reading: GroupReading) -> None:
        plan, read = self.plans[reading.what], reading.todo[0]
        try:
            reply = await self.client.execute(self.config.address, read.request)
        except ModbusExceptionReply as e:
            if e.code not in (ILLEGAL_ADDRESS, TOO_LONG):
                raise
            reading.todo.popleft()
            parts = plan.refused(read, e.code)
            reading.todo.extendleft(reversed(parts))
            if not parts:
                self.sink.put_bad([f"{self.config.name}.{t.name}" for t in read.tags], Reason.REFUSED)
            return
        reading.todo.popleft()
        plan.taken(read)
        raw, t_ns, values = cells(reply), reply.t_ns, reading.values
        reading.blocks.append((read, raw))
        for tag, place in read.places:
            values[tag.name] = self._decode(tag, raw[place], t_ns)

    def _decode(self, tag: Tag, raw: bytes, t_ns: int) -> TagValue:
        """Return the value of `raw`. `codec.decode` is called only if the bytes differ from those of the last reading."""
        last = self._decoded.get(tag.name)
        if last is not None and last.raw == raw:
            return TagValue(last.value, last.quality, last.reason, t_ns, raw)
        value = self._decoded[tag.name] = decode(tag, raw, t_ns)
        return value

    def _complete(self, reading: GroupReading) -> list[DATA]:
        """Publish the values of a group that was read. Return its messages if the group has a new sample."""
        values, what = reading.values, reading.what
        for name, value in values.items() if self._scales else ():
            tag = self.profile.tags[name]
            if tag.scale_by is not None:
                values[name] = apply_scale(tag, value, values.get(tag.scale_by) or self._held.get(tag.scale_by))
        sampled = self.profile.sampled
        fresh = sampled is not None and what == sampled.poll and sampled.count in values and self._note_sample(values)
        for name, value in values.items():
            self._publish(name, value)
        if not fresh:
            return []
        return [MEASUREMENT(raw[place_of(m.at, read.range)]) for read, raw in reading.blocks for m in read.messages]

    async def _read_tag(self, tag: Tag) -> TagValue:
        reply = await self.client.execute(self.config.address, read_request(tag.registers))
        value = decode(tag, cells(reply), reply.t_ns)
        self._publish(tag.name, value)
        return value

    def _publish(self, name: str, value: TagValue) -> None:
        self._held[name] = value
        self.sink.put(self._names[name], value)

    def trigger_wait_ms(self, group: str) -> int:
        """Return how many milliseconds after `trigger` the values of `group` are ready; 0 if they need no trigger."""
        form = self.profile.form.trigger
        return form.wait_ms if form is not None and form.poll == group else 0

    async def trigger(self) -> None:
        """Start a measurement of the device. This is a write, so it is allowed only with `may_trigger`."""
        form = self.profile.form.trigger
        if form is None or not self.may_trigger:
            raise NotAllowed("this device may not be triggered", where=self.config.where)
        await self._write_tag(self.profile.tags[form.tag], encode(self.profile.tags[form.tag], form.value))

    # -- samples ----------------------------------------------------------------------------------------------------

    def _note_sample(self, values: dict[str, TagValue]) -> bool:
        """Return whether the values are a new sample. Replace the values of the group by values with the time of the sample.

        The first count is only a baseline, because the age of that sample is unknown.
        """
        sampled = self.profile.sampled
        assert sampled is not None
        count, t_ns = values[sampled.count].value, values[sampled.count].t_ns
        assert isinstance(count, int)
        before, self._sample_count = self._sample_count, count
        fresh = before is not None and count != before and count != 0
        if fresh:
            assert before is not None
            step = (count - before) & 0xFFFFFFFF
            self.samples_missed += step - 1 if step < SAMPLED_STEPS else 0
            self._sample_t_ns = t_ns
        reason = self._sample_reason(count, t_ns)
        for name, value in values.items():
            if name == sampled.count or value.quality is Quality.BAD:
                continue
            if reason is Reason.NEVER_READ:
                values[name] = TagValue(None, Quality.BAD, reason, 0, value.raw)
            else:
                quality = Quality.GOOD if reason is Reason.NONE else Quality.UNCERTAIN
                values[name] = TagValue(value.value, quality, reason, self._sample_t_ns, value.raw)
        return fresh

    def _sample_reason(self, count: int, now_ns: int) -> Reason:
        """Return the reason why the values of the sample are not good, or `Reason.NONE`. `count` is the sample counter."""
        sampled = self.profile.sampled
        assert sampled is not None
        if count == 0:
            return Reason.NEVER_READ
        period = self._held.get(sampled.period)
        period_s = period.value if period is not None and isinstance(period.value, int) else 0
        if not self._sample_t_ns or period_s <= 0:
            return Reason.NOT_SAMPLING
        limit_ns = period_s * NS_PER_S + sampled.slack_ms * NS_PER_MS
        return Reason.NONE if now_ns - self._sample_t_ns <= limit_ns else Reason.NOT_SAMPLING

    # -- writing ------------------------------------------------------------------------------------------------------

    async def _write(self, item: DATA) -> None:
        """Write the tag of command `item` with one request, and read it back, so that the value in the device is published."""
        if not isinstance(item, COMMAND):
            raise Bug("a register device accepts only commands", got=type(item).__name__, where=self.config.where)
        self.check(item)
        tag = self._tag_of(item)
        await self._write_tag(tag, item.data)
        await self._verify(tag, item)

    async def _verify(self, tag: Tag, item: COMMAND) -> None:
        """Raise `VerifyFailed` if the device holds a different value than the one that was written."""
        if tag.readable:
            held = await self._read_tag(tag)
            if int.from_bytes(held.raw) != int.from_bytes(item.data):  # a coil is read back as one byte
                raise VerifyFailed(
                    f"{item.name}: the device acknowledged the write, but holds a different value",
                    expected=item.data.hex(),
                    got=held.raw.hex(),
                    where=f"{self.config.where} {tag.registers}",
                )

    async def write_together(self, commands: Sequence[COMMAND], progress: WriteProgress) -> None:
        """Write the tags of `commands` and read each of them back.

        One request writes tags whose registers, or coils, are adjacent. Other tags are written one after another in their order.
        After an error, call this again with the same `progress` to write the remaining tags.
        """
        tags = [self._tag_of(command) for command in commands]
        data = {tag.name: command.data for tag, command in zip(tags, commands, strict=True)}
        together = self._adjacent(tags)
        if together:
            progress.sent.update(data)
            await self._write_adjacent(together, data)
        for tag, command in zip(tags, commands, strict=True):
            if tag.name in progress.confirmed:
                continue
            self.check(command)
            progress.sent.add(tag.name)
            if not together:
                await self._write_tag(tag, command.data)
            await self._verify(tag, command)
            progress.confirmed.add(tag.name)

    def _adjacent(self, tags: Sequence[Tag]) -> list[Tag]:
        """Return `tags` sorted by address if one request can write them all, otherwise an empty list."""
        ordered = sorted(tags, key=lambda tag: tag.registers.address)
        table, function = ordered[0].registers.table, 15 if ordered[0].registers.table == "coil" else 16
        end = ordered[0].registers.address
        for tag in ordered:
            if tag.registers.table != table or tag.registers.address != end:
                return []
            end += tag.registers.count
        functions = self.profile.form.limits.functions
        fits = end - ordered[0].registers.address <= (MOST_COILS if function == 15 else MOST_REGISTERS)
        return ordered if fits and (functions is None or function in functions) else []

    async def _write_adjacent(self, ordered: Sequence[Tag], data: Mapping[str, bytes]) -> None:
        first = ordered[0].registers
        raw = b"".join(data[tag.name] for tag in ordered)
        words = [int.from_bytes(raw[i : i + 2]) for i in range(0, len(raw), 2)]
        if first.table == "coil":
            await self.client.write_coils(self.config.address, first.address, [bool(word) for word in words])
        else:
            await self.client.write_registers(self.config.address, first.address, words)

    async def _write_tag(self, tag: Tag, data: bytes) -> None:
        """Write a tag with one request.

        Registers are written with function 10h, or 06 if the device does not support 10h; a coil with 05, or 0Fh if the device
        does not support 05.
        """
        at = tag.registers
        functions = self.profile.form.limits.functions
        if at.table == "coil" and functions is not None and 5 not in functions:
            await self.client.write_coils(self.config.address, at.address, [bool(int.from_bytes(data))])
        elif at.table == "coil":
            await self.client.write_coil(self.config.address, at.address, bool(int.from_bytes(data)))
        elif at.count == 1 and functions is not None and 16 not in functions:
            await self.client.write_register(self.config.address, at.address, int.from_bytes(data))
        else:
            words = [int.from_bytes(data[i : i + 2]) for i in range(0, len(data), 2)]
            await self.client.write_registers(self.config.address, at.address, words)

    def _tag_of(self, command: COMMAND) -> Tag:
        name = self.profile.form.commands.get(command.name, command.name.removeprefix("set_"))
        return self.profile.tags[name]


class SensorDriver(RegisterDriver):
    """The paper's SensorDriver: a register device on RS232."""

    wire_types = frozenset({PROTOCOL.RS232})
