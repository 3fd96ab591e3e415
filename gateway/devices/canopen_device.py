"""The driver of a CANopen node: identity, configuration over SDO, values from TPDOs, state from the heartbeat.

The node's values are good while its TPDOs arrive and it is OPERATIONAL; a lost heartbeat makes them bad immediately. If
writing is not allowed, the driver neither configures nor starts the node: it only reads the PDO mapping and receives TPDOs.
The driver writes nothing at all to a node whose identity is not the expected one. An output is sent by RPDO if one of
the node's RPDOs carries it and the gateway may send that RPDO, otherwise by SDO.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial

from fieldtwin.gateway.core.clock import Clock
from fieldtwin.gateway.core.connection import PROTOCOL, CanConnection
from fieldtwin.gateway.core.errors import Bug, NotAllowed, SdoAborted, WrongDevice
from fieldtwin.gateway.core.files.profile import Tag
from fieldtwin.gateway.core.values import COMMAND, DATA, MEASUREMENT, Reason, TagValue
from fieldtwin.gateway.devices.canopen_rpdo import BITS, Rpdo, is_gap, mapped_tag, tags_in, usable
from fieldtwin.gateway.devices.codec import decode_little, encode, reorder
from fieldtwin.gateway.devices.config import DeviceConfig
from fieldtwin.gateway.devices.driver import DeviceDriver, TagSink
from fieldtwin.gateway.protocols.canopen.boot import download_configuration, holds_configuration, identity_differences
from fieldtwin.gateway.protocols.canopen.cob_id import RPDO1_BASE, TPDO_BASES
from fieldtwin.gateway.protocols.canopen.configure import (
    PdoConfig,
    configure_rpdo,
    configure_tpdo,
    read_rpdos,
    read_tpdo,
    read_tpdos,
    set_heartbeat_producer,
)
from fieldtwin.gateway.protocols.canopen.master import CanopenMaster, PdoCallback
from fieldtwin.gateway.protocols.canopen.nmt.states import NmtCommand, NmtState, NodeEvent
from fieldtwin.gateway.protocols.canopen.pdo.mapping import PdoEntry, PdoLengthMismatch, PdoMapping

_OPERATIONAL = NmtState.OPERATIONAL

CONSTANT = frozenset({0x1000, 0x1008, 0x1009, 0x100A, 0x1018})
"""Objects that do not change while a node runs (7.5.2.1, 7.5.2.9 to 7.5.2.11, 7.5.2.19): device type, names,
identity."""

NMT_COMMANDS = {
    "nmt_start": NmtCommand.START,
    "nmt_stop": NmtCommand.STOP,
    "nmt_preoperational": NmtCommand.ENTER_PRE_OPERATIONAL,
    "nmt_reset_node": NmtCommand.RESET_NODE,
    "nmt_reset_communication": NmtCommand.RESET_COMMUNICATION,
}


@dataclass(slots=True)
class TpdoSeen:
    """A TPDO of the node that the driver receives. `frames` counts its frames since the driver began to receive it; 0 means that
    the node has not sent it since then.

    `puts` holds the tags of its entries with their full names, and None for an entry that is not a tag of the profile.
    It is built with the first frame, and again after the profile changed.
    """

    number: int
    cob_id: int
    tags: tuple[str, ...]
    mapping: PdoMapping
    frames: int = 0
    puts: tuple[tuple[str, Tag] | None, ...] | None = None


class CanopenDriver(DeviceDriver):
    """The driver of one node, created from its profile."""

    wire_types = frozenset({PROTOCOL.CAN})

    def __init__(self, config: DeviceConfig, sink: TagSink, clock: Clock) -> None:
        super().__init__(config, sink)
        self._clock = clock
        self.node = config.address
        self.malformed_pdos = 0
        self._master: CanopenMaster | None = None
        self._by_object = {t.object: t for t in self.profile.tags.values()}
        self.tpdos: tuple[TpdoSeen, ...] = ()
        """The TPDOs that the driver listens to, by number."""
        self._listening: dict[int, PdoCallback] = {}
        self._by_change: frozenset[str] = frozenset()
        self.unmapped: tuple[str, ...] = ()
        """Tags of the configured `tpdo1` that the node's own mapping lacks, found when the driver may not write it: they are
        read over SDO."""
        self._rpdos: dict[str, Rpdo] = {}
        self._started = False

    @property
    def message_tag(self) -> str | None:
        """Return None, because a CANopen node emits no messages that a PLC program could receive."""
        return None

    @property
    def master(self) -> CanopenMaster:
        """Return the master of the bus that this node is connected to."""
        if self._master is None:
            raise Bug("a driver without a master was used", where=self.config.where)
        return self._master

    def reconfigure(self, config: DeviceConfig) -> None:
        super().reconfigure(config)
        self._by_object = {t.object: t for t in self.profile.tags.values()}
        for seen in self.tpdos:
            seen.puts = None

    def understood(self, tag_name: str, held: TagValue, of: TagValue | None) -> TagValue:
        """Return the value of a tag, decoded with the present configuration from the bytes in `held`. `of` is not used."""
        return decode_little(self.profile.tags[tag_name], held.raw, held.t_ns)

    @property
    def pdo_tags(self) -> list[str]:
        """Return the full names of the tags that TPDOs carry."""
        names = [n for n in self.config.tpdo1.tags if n not in self.unmapped] if self.config.tpdo1 else []
        names += [name for seen in self.tpdos for name in seen.tags]
        return [f"{self.config.name}.{name}" for name in dict.fromkeys(names)]

    @property
    def operational(self) -> bool:
        """Return whether the node accepts process data, according to its heartbeat.

        For a node without a heartbeat, return whether the last NMT command was "start".
        """
        state = self.master.node_state(self.node)
        if state in (None, NmtState.INITIALISING):
            return self._started
        return state is NmtState.OPERATIONAL and not self.master.heartbeat_lost(self.node)

    @property
    def unreceived_tags(self) -> tuple[str, ...]:
        """Return the tags of the node's TPDOs that are not received, because the node is not OPERATIONAL (7.3.2.2).

        A node without a heartbeat counts as OPERATIONAL for the TPDOs that it has sent. The state of a node whose heartbeat was
        lost is unknown.
        """
        if self.operational or self.master.heartbeat_lost(self.node):
            return ()
        unknown = self.master.node_state(self.node) is None
        return tuple(name for seen in self.tpdos if not (unknown and seen.frames) for name in seen.tags)

    @property
    def is_watched(self) -> bool:
        """Return whether a loss of the node would be noticed: its heartbeat has a consumer time and has been received.

        A node that produces no heartbeat, because the gateway only listens, is not watched (CiA 301, 7.2.8.3.2.2:
        monitoring starts with the first heartbeat).
        """
        return self.config.heartbeat is not None and self.master.heartbeat_watched(self.node)

    def stale_after_ms(self, tag: Tag) -> int | None:
        """Return how long a value of `tag` stays good without being refreshed, in milliseconds.

        Return None for a value that cannot change while the node runs, and for a value that a TPDO sends only when it
        changes, while the heartbeat shows that the node is alive.
        """
        constant = tag.name in self.config.expect or (tag.object is not None and tag.object[0] in CONSTANT)
        if constant or (tag.name in self._by_change and self.is_watched):
            return None
        return max(self.config.stale_after_ms, 3 * self.config.poll.get(tag.poll, 0))

    def attach_master(self, connection: CanConnection, master: CanopenMaster) -> None:
        """Use `master`, which communicates over `connection`, from now on."""
        self.attach(connection)
        self._master = master
        self.tpdos, self._listening, self.unmapped = (), {}, ()
        self._rpdos, self._started = {}, False
        consumer_ms = self.config.heartbeat.consumer_ms if self.config.heartbeat else 0
        master.add_node(
            self.node,
            heartbeat_consumer_ms=consumer_ms,
            sdo_timeout_s=self.config.timeout_s,
            sdo_retries=self.config.retries,
            sdo_transfer_s=self.config.canopen.sdo_transfer_s,
        )

    # -- bringing the node up (CiA 302-2, boot slave) ---------------------------------------------------------------

    async def identify(self) -> None:
        """Read the node's identity over SDO and compare it with that in the system file. Raises `WrongDevice` on a difference."""
        differences = await identity_differences(self.master, self.node, self.config.canopen.identity)
        if differences:
            self.identity_error = ", ".join(f"{name}: {difference}" for name, difference in differences.items())
            raise WrongDevice("a different node answers", got=self.identity_error, where=self.config.where)
        wrong: dict[str, object] = {}
        for name, expected in self.config.expect.items():
            tag = self.profile.tags[name]
            held = (await self._upload(tag)).value
            if str(held) != expected:
                wrong[name] = held
        self.identity_error = ", ".join(f"{n} is {v!r}" for n, v in wrong.items())
        if wrong:
            expected = ", ".join(f"{n} {self.config.expect[n]!r}" for n in wrong)
            raise WrongDevice(
                "a different node answers", expected=expected, got=self.identity_error, where=self.config.where
            )

    async def read_once(self) -> None:
        """Read over SDO the tags that no TPDO carries and that `identify` did not read.

        A tag that the node refuses gets no value.
        """
        others = {*(self.config.tpdo1.tags if self.config.tpdo1 else ()), *self.config.expect}
        for tag in self.profile.tags.values():
            if tag.readable and tag.name not in others:
                try:
                    await self._upload(tag)
                except SdoAborted:
                    self.sink.put_bad([f"{self.config.name}.{tag.name}"], Reason.REFUSED)

    @property
    def to_configure(self) -> str:
        """Return a text that lists what `configure` may write. It is empty if the system file configures nothing that has to be
        written.
        """
        canopen, parts = self.config.canopen, []
        if canopen.configuration is not None:
            parts.append(f"{canopen.dcf}(only if the node holds different values)")
        if self.config.heartbeat is not None and self.config.heartbeat.producer_ms is not None:
            parts.append("heartbeat")
        if self.config.tpdo1 is not None:
            parts.append("TPDO1")
        if canopen.rpdo1 is not None:
            parts.append("RPDO1")
        return f"{', '.join(parts)} as in the system file" if parts else ""

    async def configure(self) -> None:
        """Write the DCF unless the node already holds it, then heartbeat and TPDO1 as the system file states. Then listen to the
        TPDOs.

        These are writes: call this only where writing is allowed.
        """
        if self.config.canopen.configuration is not None:
            await download_configuration(self.master, self.node, self.config.canopen.configuration)
        if self.config.heartbeat is not None and self.config.heartbeat.producer_ms is not None:
            await set_heartbeat_producer(self.master, self.node, self.config.heartbeat.producer_ms)
        if self.config.tpdo1 is not None:
            objects = [self._entry(self.profile.tags[t]) for t in self.config.tpdo1.tags]
            cob_id = TPDO_BASES[0] + self.node
            event_ms = self.config.tpdo1.event_ms
            mapping = await configure_tpdo(self.master, self.node, 1, objects, cob_id, event_ms=event_ms)
            self._listen([PdoConfig(1, cob_id, True, 254, event_ms, mapping), *await self._other_tpdos()])
        else:
            await self.adopt()
        await self._take_rpdos()

    async def adopt(self) -> None:
        """From now on, receive the TPDOs as the node or its DCF configures them. This only reads from the node.

        Afterwards `unmapped` holds the tags of the configured `tpdo1` that no TPDO carries.
        """
        tpdos = await self._other_tpdos()
        if self.config.tpdo1 is not None:
            held = await read_tpdo(self.master, self.node, 1)
            tpdos += [held] if held.enabled else []
        self._listen(tpdos)
        brought = {name for seen in self.tpdos for name in seen.tags}
        wanted = self.config.tpdo1.tags if self.config.tpdo1 is not None else ()
        self.unmapped = tuple(name for name in wanted if name not in brought)

    @property
    def unmapped_ms(self) -> int:
        """Return the period of `read_unmapped` in milliseconds: half the time for which a value stays good, at least 100 ms."""
        shortest = min((self.stale_after_ms(self.profile.tags[n]) or 1000 for n in self.unmapped), default=1000)
        return max(100, shortest // 2)

    async def read_unmapped(self) -> None:
        """Read over SDO the tags that the node's TPDOs should carry but do not. A tag that the node refuses gets no value."""
        for name in self.unmapped:
            if self.profile.tags[name].poll in self.config.poll:
                continue  # the poll group of this tag reads it
            try:
                await self._upload(self.profile.tags[name])
            except SdoAborted:
                self.sink.put_bad([f"{self.config.name}.{name}"], Reason.REFUSED)

    async def to_be_halted(self) -> bool:
        """Return whether the node must enter PRE-OPERATIONAL before `configure`, because its configuration will change and it may
        be running."""
        configuration, state = self.config.canopen.configuration, self.master.node_state(self.node)
        if configuration is None or state in (NmtState.PRE_OPERATIONAL, NmtState.INITIALISING):
            return False
        return not await holds_configuration(self.master, self.node, configuration.date)

    async def _other_tpdos(self) -> list[PdoConfig]:
        """Return all TPDOs except the configured TPDO1, from the DCF or read from the node."""
        boot, first = self.config.canopen, 2 if self.config.tpdo1 else 1
        held = boot.tpdos or ()
        if boot.adopt_tpdos:
            held = await read_tpdos(self.master, self.node)
        return [t for t in held if t.enabled and t.number >= first and t.mapping.entries]

    def _listen(self, tpdos: list[PdoConfig]) -> None:
        for cob_id, callback in self._listening.items():
            self.master.unsubscribe_pdo(cob_id, callback)
        by_cob_id = {t.cob_id: t for t in tpdos}
        self.tpdos = tuple(
            TpdoSeen(t.number, t.cob_id, tuple(n for n in tags_in(t.mapping, self._by_object) if n), t.mapping)
            for t in sorted(by_cob_id.values(), key=lambda t: t.number)
        )
        self._by_change = frozenset(
            name for t in tpdos if not t.cyclic for name in tags_in(t.mapping, self._by_object) if name
        )
        self._listening = {seen.cob_id: partial(self._on_pdo, seen) for seen in self.tpdos}
        for cob_id, callback in self._listening.items():
            self.master.subscribe_pdo(cob_id, callback)

    async def _take_rpdos(self) -> None:
        """Map RPDO1 as the system file states, use all other RPDOs as the node or its DCF has them, and read their values."""
        boot, chosen = self.config.canopen, []
        if boot.rpdo1 is not None:
            objects = [self._entry(self.profile.tags[t]) for t in boot.rpdo1.tags]
            cob_id, kind = RPDO1_BASE + self.node, 1 if boot.rpdo1.synchronous else 255
            mapping = await configure_rpdo(self.master, self.node, 1, objects, cob_id, kind)
            chosen.append(PdoConfig(1, cob_id, True, kind, None, mapping))
        held = await read_rpdos(self.master, self.node) if boot.adopt_rpdos else boot.rpdos or ()
        others = [r for r in held if r.number > 1 or boot.rpdo1 is None]
        chosen += usable(others, self._by_object, self.config.writable, boot.rpdo1.tags if boot.rpdo1 else ())
        taken: dict[str, Rpdo] = {}
        for config in chosen:
            rpdo = await self._filled(config)
            taken |= {tag: rpdo for tag in rpdo.tags if tag} if rpdo is not None else {}
        self._rpdos = taken

    async def _filled(self, config: PdoConfig) -> Rpdo | None:
        """Return the RPDO, filled with the values that the node holds now.

        Return None if one of them cannot be read, because sending the RPDO would then overwrite it with a wrong value.
        """
        held = []
        for entry in config.mapping.entries:
            data = b""
            if not is_gap(entry):
                try:
                    data = await self.master.sdo_upload(
                        self.node, entry.index, entry.subindex, length=(entry.bits + 7) // 8
                    )
                except SdoAborted:
                    return None
            held.append(data)
        boot = self.config.canopen
        repeat_ms = boot.rpdo1.event_ms if boot.rpdo1 is not None and config.number == 1 else 0
        tags = tags_in(config.mapping, self._by_object)
        return Rpdo(config.number, config.cob_id, config.mapping, tags, held, config.synchronous, repeat_ms)

    def _entry(self, tag: Tag) -> tuple[int, int, int]:
        assert tag.object is not None
        return (*tag.object, BITS[tag.type])

    # -- received messages ----------------------------------------------------------------------------------------------

    def _on_pdo(self, seen: TpdoSeen, data: bytes, t_ns: int) -> None:
        seen.frames += 1
        if self.identity_error:
            return
        master = self.master
        state = master.node_state(self.node)
        if state is not _OPERATIONAL and state is not None and not self.operational:
            return  # the TPDO arrived after its node's last heartbeat: the state decides
        if master.heartbeat_lost(self.node):
            return  # whichever node sends this, the node's state is unknown until its heartbeat returns (CO-038)
        try:
            values = seen.mapping.unpack(data)
        except PdoLengthMismatch:
            self.malformed_pdos += 1
            return
        puts = seen.puts
        if puts is None:
            puts = seen.puts = tuple(self._put_of(entry) for entry in seen.mapping.entries)
        for put, raw in zip(puts, values, strict=True):
            if put is not None:
                name, tag = put
                self.sink.put(name, decode_little(tag, raw, t_ns))
        if self.emitter.observed:
            self.emitter.emit(MEASUREMENT(data))

    def _put_of(self, entry: PdoEntry) -> tuple[str, Tag] | None:
        """Return the full name and the tag of a mapped entry; None if there is no such tag, or if its size differs."""
        tag = mapped_tag(entry, self._by_object)
        return None if tag is None else (f"{self.config.name}.{tag.name}", tag)

    def on_event(self, event: NodeEvent) -> None:
        """Adapt the quality of the node's values to a change of its state or the loss of its heartbeat.

        A node that restarted, or may have restarted, can have lost its mappings. Its process data is ignored until it has been
        configured again.
        """
        if event.kind == "boot-up":
            self._rpdos, self._started = {}, False
        if event.kind == "heartbeat-lost":
            self.sink.put_bad(self.tag_names, Reason.HEARTBEAT_LOST)
        elif event.kind == "boot-up" or (event.kind == "state" and event.state is not NmtState.OPERATIONAL):
            self.sink.put_bad(self.pdo_tags, Reason.NOT_OPERATIONAL)
        if event.kind in ("boot-up", "heartbeat-lost"):
            self._listen([])

    # -- sent messages -------------------------------------------------------------------------------------------------

    def rpdo_of(self, tag_name: str) -> Rpdo | None:
        """Return the RPDO by which this tag is commanded, or None if it is written over SDO."""
        return self._rpdos.get(tag_name)

    @property
    def rpdos(self) -> list[Rpdo]:
        """Return the RPDOs that this driver sends."""
        return list(dict.fromkeys(self._rpdos.values()))

    async def send_rpdo(self, rpdo: Rpdo, values: Mapping[str, bytes]) -> None:
        """Send one frame with `values` by tag. Process data is not queued: only the newest value counts."""
        if self.identity_error:
            raise NotAllowed("a different node answers: nothing is written to it", got=self.identity_error).at(
                self.config.where
            )
        await self.master.send(rpdo.frame(values))
        rpdo.sent(values)

    # -- SDO ------------------------------------------------------------------------------------------------------------

    async def _upload(self, tag: Tag) -> TagValue:
        assert tag.object is not None
        length = BITS[tag.type] // 8 if tag.type in BITS else None
        raw = await self.master.sdo_upload(self.node, *tag.object, length=length)
        value = decode_little(tag, raw, self._clock.monotonic_ns())
        self.sink.put(f"{self.config.name}.{tag.name}", value)
        return value

    async def _read(self, what: str) -> list[DATA]:
        """Read a poll group over SDO, except the tags that TPDOs carry. A tag that the node refuses gets no value."""
        brought = self.pdo_tags
        for tag in self.profile.group(what):
            if f"{self.config.name}.{tag.name}" not in brought:
                try:
                    await self._upload(tag)
                except SdoAborted:
                    self.sink.put_bad([f"{self.config.name}.{tag.name}"], Reason.REFUSED)
        return []

    async def _write(self, item: DATA) -> None:
        if not isinstance(item, COMMAND):
            raise Bug("a node accepts only commands", got=type(item).__name__, where=self.config.where)
        self.check(item)
        if self.identity_error:
            raise NotAllowed("a different node answers: nothing is written to it", got=self.identity_error).at(
                self.config.where
            )
        if item.name in NMT_COMMANDS:
            await self.master.nmt(NMT_COMMANDS[item.name], self.node)
            self._started = item.name == "nmt_start"
            return
        tag = self.profile.tags[self.profile.form.commands.get(item.name, item.name.removeprefix("set_"))]
        assert tag.object is not None
        await self.master.sdo_download(self.node, *tag.object, item.data)

    def command(self, tag_name: str, value: float) -> COMMAND:
        """Return the command that writes `value` to a tag's object. Raises `NotAllowed` outside its limits."""
        tag = self.profile.tags.get(tag_name)
        if tag is None or not tag.writable:
            raise NotAllowed(f"the tag {tag_name!r} cannot be written", where=self.config.where)
        big = reorder(encode(tag, value), tag.order)
        return COMMAND(big[::-1][: BITS.get(tag.type, 64) // 8], self.profile.command_for(tag_name))
