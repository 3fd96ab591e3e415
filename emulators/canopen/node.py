"""The emulated CANopen node: NMT slave, dispatch of frames, and the object dictionary as an SDO client sees it.

A pure object: frames and `now_ns` in, frames out, and when to be called next. It must never know asyncio, sockets, nor
what a driver makes of its frames. `serve.serve_node` runs it on a connection.

=================  ===========================================================  =====================================
state              answers                                                      left by
=================  ===========================================================  =====================================
INITIALISING       nothing                                                      `start`: boot-up, PRE-OPERATIONAL
PRE-OPERATIONAL    NMT, error control, SDO, SYNC, EMCY                          NMT command
OPERATIONAL        the same and PDOs                                            NMT command, heartbeat loss (1029h)
STOPPED            NMT, error control                                           NMT command
=================  ===========================================================  =====================================
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field

from emulators.canopen.aborts import Abort, abort
from emulators.canopen.behaviour import Behaviour, DeviceModel
from emulators.canopen.dictionary import Dictionary, Key
from emulators.canopen.emcy import GENERIC, Emergency
from emulators.canopen.error_control import ERROR_CONTROL, HeartbeatConsumer, HeartbeatProducer
from emulators.canopen.node_data import NodeData
from emulators.canopen.rpdo import Rpdos
from emulators.canopen.sdo_server import SdoServer
from emulators.canopen.service import Change, Core, NmtState, NodeCounters, SentPdo, Service, Source
from emulators.canopen.storage import Storage
from emulators.canopen.sync import SyncConsumer
from emulators.canopen.tpdo import Tpdos
from gateway.core.canframe import CanFrame
from gateway.core.clock import NS_PER_MS
from gateway.core.errors import UsageError

NMT_COMMAND = 0x000
SDO_REQUEST, SDO_RESPONSE = 0x600, 0x580

_START, _STOP, _PRE_OPERATIONAL, _RESET_NODE, _RESET_COMMUNICATION = 1, 2, 128, 129, 130
_TARGET = {
    _START: NmtState.OPERATIONAL,
    _STOP: NmtState.STOPPED,
    _PRE_OPERATIONAL: NmtState.PRE_OPERATIONAL,
}


@dataclass(frozen=True, slots=True)
class NodeContext:
    """What the node is given besides its data sheet.

    `source` plays values; `model` makes of them, and of what clients write, what the device does. `factory` replaces
    defaults (a serial number). `tolerate_short_sdo` takes SDO requests of fewer than 8 bytes as padded with zeros, as for
    old PLCs; by default they are ignored. `journal_size` bounds both journals: older lines fall off.
    """

    source: Source | None = None
    model: DeviceModel | None = None
    factory: Mapping[Key, bytes] = field(default_factory=dict)
    tolerate_short_sdo: bool = False
    sdo_timeout_ms: int = 1000
    journal_size: int = 100_000


class CanopenNode:
    """One node. Call `start`, then `feed` for each frame and `tick` when `wake_at_ns` has come; send what they return.

    Raises `UsageError` for a node id outside 1 to 127, and from any call when `source` gives what does not fit.
    """

    def __init__(self, dictionary: Dictionary, node_id: int, context: NodeContext | None = None) -> None:
        if not 1 <= node_id <= 127:
            raise UsageError("not a CANopen node id", expected="1 to 127", got=str(node_id))
        self.context = context or NodeContext()
        self.node_id = node_id
        data = NodeData(dictionary, node_id, self.context.factory)
        source, model = self.context.source, self.context.model
        self._behaviour = None if model is None else Behaviour(model, source, data)
        self._core = core = Core(data, node_id, self._behaviour or source, self.context.journal_size)
        self._emergency = Emergency(core)
        self._heartbeat = HeartbeatProducer(core)
        self._consumer = HeartbeatConsumer(core, self._emergency, self._enter)
        self._tpdos = Tpdos(core)
        self._rpdos = Rpdos(core, self._emergency, self._tpdos.changed, self._rpdo_wrote)
        self._sync = SyncConsumer(core, self._emergency, self._on_sync)
        self._services: tuple[Service, ...] = (
            self._emergency,
            self._consumer,
            *([self._behaviour] if self._behaviour else []),
            self._heartbeat,
            self._sync,
            self._rpdos,
            self._tpdos,
            Storage(core),
        )
        self._sdo = SdoServer(_ClientView(core, self._services, self._tpdos), self.context.sdo_timeout_ms * NS_PER_MS)
        if self._behaviour is not None:
            self._behaviour.connect(core, self._emergency, self._tpdos.changed)

    # -- what can be asked ----------------------------------------------------------------------------------------

    @property
    def state(self) -> NmtState:
        return self._core.state

    @property
    def counters(self) -> NodeCounters:
        return self._core.counters

    @property
    def data(self) -> NodeData:
        """The live values. Change them by `set_value` only, so that TPDOs learn of it."""
        return self._core.data

    @property
    def journal(self) -> deque[SentPdo]:
        """The TPDOs sent, oldest first, bounded."""
        return self._core.journal

    @property
    def changes(self) -> deque[Change]:
        """NMT states, writes and errors, oldest first, bounded."""
        return self._core.changes

    @property
    def active_errors(self) -> tuple[int, ...]:
        """EMCY codes of the errors that are present."""
        return self._emergency.active

    def wake_at_ns(self) -> int | None:
        """When `tick` is due next; None when only a frame can make the node do something."""
        if self.state is NmtState.INITIALISING:
            return None
        times = [self._sdo.deadline_ns, *(service.wake_at_ns() for service in self._services)]
        return min((t for t in times if t is not None), default=None)

    # -- what can happen to it ------------------------------------------------------------------------------------

    def start(self, now_ns: int) -> list[CanFrame]:
        """Power on (again): power-on values, boot-up message, PRE-OPERATIONAL."""
        self._reset(now_ns, communication_only=False)
        return self._core.take_output()

    def feed(self, frame: CanFrame, now_ns: int) -> list[CanFrame]:
        """A frame came off the bus."""
        if self.state is NmtState.INITIALISING:
            return []
        self._core.counters.frames_in += 1
        self._run_due(now_ns)
        if frame.extended or frame.error:
            self._core.counters.ignored += frame.extended
        elif frame.remote:
            self._on_remote(frame, now_ns)
        else:
            self._on_data(frame, now_ns)
        self._run_due(now_ns)
        return self._core.take_output()

    def tick(self, now_ns: int) -> list[CanFrame]:
        """Time passed. Early calls do nothing."""
        if self.state is not NmtState.INITIALISING:
            self._run_due(now_ns)
        return self._core.take_output()

    def set_value(self, index: int, subindex: int, raw: bytes, now_ns: int) -> list[CanFrame]:
        """The device itself changes a value (on-wire bytes); a change is an event for TPDOs that map it."""
        if self._core.data.put(index, subindex, raw):
            self._core.note(now_ns, "set", index, subindex, raw)
            self._tpdos.changed([(index, subindex)], now_ns)
        return self.tick(now_ns)

    def raise_error(self, code: int, now_ns: int, *, register: int = GENERIC, info: bytes = b"") -> list[CanFrame]:
        """An error arises in the device: EMCY `code` with `info` (up to 5 bytes), active until `clear_error`.

        Raises `UsageError` for what no EMCY message can carry.
        """
        if not 0 < code <= 0xFFFF or not 0 <= register <= 0xFF or len(info) > 5:
            raise UsageError(
                "not an EMCY message",
                expected="a code of 16 bits, a register of 8 bits, at most 5 bytes of information",
                got=f"{code:X}h, {register:X}h, {len(info)} bytes",
            )
        self._emergency.raise_error(code, now_ns, register=register, info=info)
        return self.tick(now_ns)

    def clear_error(self, code: int, now_ns: int) -> list[CanFrame]:
        """The error is gone: EMCY 0000h with what remains in the error register."""
        self._emergency.clear_error(code, now_ns)
        return self.tick(now_ns)

    # -- inside ---------------------------------------------------------------------------------------------------

    def _run_due(self, now_ns: int) -> None:
        for reply in self._sdo.tick(now_ns):
            self._send_sdo(reply, now_ns)
        for service in self._services:
            service.tick(now_ns)

    def _on_data(self, frame: CanFrame, now_ns: int) -> None:
        if frame.can_id == NMT_COMMAND:
            self._on_nmt(frame.data, now_ns)
        elif frame.can_id == SDO_REQUEST + self.node_id:
            self._on_sdo(frame.data, now_ns)
        elif self._sync.receive(frame, now_ns) or self._rpdos.receive(frame.can_id, frame.data, now_ns):
            pass
        elif ERROR_CONTROL < frame.can_id <= ERROR_CONTROL + 127:
            self._consumer.heard(frame, now_ns)

    def _on_remote(self, frame: CanFrame, now_ns: int) -> None:
        if frame.can_id == ERROR_CONTROL + self.node_id:
            self._heartbeat.guarded(now_ns)
        else:
            self._tpdos.on_remote(frame.can_id, now_ns)

    def _on_nmt(self, data: bytes, now_ns: int) -> None:
        """Ignored unless it is exactly a command and a node id that mean us (CiA 301, 7.2.8.3.1)."""
        if len(data) != 2 or data[1] > 127 or data[0] not in (*_TARGET, _RESET_NODE, _RESET_COMMUNICATION):
            self._core.counters.ignored += 1
            return
        command, node_id = data
        if node_id not in (0, self.node_id):
            return
        self._core.counters.nmt_commands += 1
        if command in _TARGET:
            self._enter(_TARGET[command], now_ns)
        else:
            self._reset(now_ns, communication_only=command == _RESET_COMMUNICATION)

    def _on_sdo(self, data: bytes, now_ns: int) -> None:
        short = len(data) < 8
        if not self._core.communicating or (short and not (data and self.context.tolerate_short_sdo)):
            self._core.counters.ignored += 1
            return
        replies = self._sdo.request(data.ljust(8, b"\0"), now_ns)
        self._core.counters.sdo_requests += data[0] >> 5 != 4
        for reply in replies:
            self._core.counters.sdo_replies += 1
            self._send_sdo(reply, now_ns)

    def _send_sdo(self, reply: bytes, now_ns: int) -> None:
        self._core.counters.sdo_aborts += reply[0] == 0x80
        self._core.send(SDO_RESPONSE + self.node_id, reply, now_ns)

    def _on_sync(self, counter: int | None, now_ns: int) -> None:
        """Inputs are sampled at the SYNC, before what came for it is applied."""
        self._tpdos.on_sync(counter, now_ns)
        self._rpdos.on_sync(now_ns)

    def _rpdo_wrote(self, keys: list[Key], now_ns: int) -> None:
        if self._behaviour is not None:
            self._behaviour.written(keys, now_ns)

    def _enter(self, state: NmtState, now_ns: int) -> None:
        if state is self.state:
            return
        self._core.state = state
        self._core.note(now_ns, "nmt", 0, 0, bytes([state]))
        if not self._core.communicating:
            self._sdo.reset()
        for service in self._services:
            service.state_changed(now_ns)

    def _reset(self, now_ns: int, *, communication_only: bool) -> None:
        self._core.state = NmtState.INITIALISING
        self._core.note(now_ns, "nmt", 0, 0, bytes([NmtState.INITIALISING]))
        self._core.data.reset(communication_only=communication_only)
        self._sdo.reset()
        if self._behaviour is not None and not communication_only:
            self._behaviour.power_on(now_ns)
        for service in self._services:
            service.reset(now_ns)
        self._core.send(ERROR_CONTROL + self.node_id, bytes([NmtState.INITIALISING]), now_ns)
        self._enter(NmtState.PRE_OPERATIONAL, now_ns)


class _ClientView:
    """`ObjectAccess` over the live values: generic rules first, then what the object's service says."""

    def __init__(self, core: Core, services: Iterable[Service], tpdos: Tpdos) -> None:
        self._core = core
        self._services = tuple(services)
        self._tpdos = tpdos

    def read(self, index: int, subindex: int, now_ns: int) -> bytes:
        entry = self._core.data.find(index, subindex)
        if not entry.readable:
            raise abort(index, subindex, Abort.WRITE_ONLY)
        for service in self._owners(index):
            service.check_read(index, subindex)
        self._core.refresh(now_ns)
        return self._core.data.get(index, subindex)

    def begin_write(self, index: int, subindex: int, size: int | None) -> int | None:
        entry = self._core.data.find(index, subindex)
        if not entry.writable:
            raise abort(index, subindex, Abort.READ_ONLY)
        if size is not None:
            self._core.data.check_size(entry, size)
        return entry.size

    def write(self, index: int, subindex: int, raw: bytes, now_ns: int) -> None:
        entry = self._core.data.find(index, subindex)
        self._core.data.check_value(entry, raw)
        owners = self._owners(index)
        for service in owners:
            service.check_write(index, subindex, raw)
        changed = self._core.data.put(index, subindex, raw)
        self._core.note(now_ns, "write", index, subindex, raw)
        for service in owners:
            service.wrote(index, subindex, now_ns)
        if changed:
            self._tpdos.changed([entry.key], now_ns)

    def _owners(self, index: int) -> list[Service]:
        return [service for service in self._services if service.owns(index)]
