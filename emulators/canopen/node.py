"""The emulated CANopen node: NMT slave, dispatch of frames, and the object dictionary as an SDO client sees it.

`CanopenNode` does no I/O: it takes frames and `now_ns`, and returns frames and the time of the next call. It must not depend on
asyncio, sockets, or how a driver interprets its frames. `serve.serve_node` runs it on a connection.

=================  ===========================================================  =====================================
state              answers                                                      left by
=================  ===========================================================  =====================================
INITIALISING       LSS, when it has no node ID yet                              `start` or a node ID: boot-up, PRE-OPERATIONAL
PRE-OPERATIONAL    NMT, error control, SDO, SYNC, TIME, EMCY, LSS               NMT command
OPERATIONAL        the same and PDOs                                            NMT command, heartbeat loss (1029h)
STOPPED            NMT, error control, LSS                                      NMT command
=================  ===========================================================  =====================================
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, field
from operator import attrgetter

from fieldtwin.emulators.canopen.aborts import Abort
from fieldtwin.emulators.canopen.acceptance import Acceptance
from fieldtwin.emulators.canopen.behaviour import Behaviour, DeviceModel, Distort
from fieldtwin.emulators.canopen.client_view import ClientView
from fieldtwin.emulators.canopen.eds.dictionary import Dictionary, Key
from fieldtwin.emulators.canopen.errors.bus_faults import BusFaults
from fieldtwin.emulators.canopen.errors.emcy import GENERIC, Emergency
from fieldtwin.emulators.canopen.errors.error_control import (
    ERROR_CONTROL,
    ErrorReaction,
    HeartbeatConsumer,
    HeartbeatProducer,
)
from fieldtwin.emulators.canopen.errors.guarding import NodeGuarding
from fieldtwin.emulators.canopen.lss.service import LssService
from fieldtwin.emulators.canopen.lss.slave import FROM_MASTER, UNCONFIGURED, LssStore
from fieldtwin.emulators.canopen.node_data import NodeData
from fieldtwin.emulators.canopen.pdo.rpdo import Rpdos
from fieldtwin.emulators.canopen.pdo.tpdo import Tpdos
from fieldtwin.emulators.canopen.sdo.channels import SdoChannels
from fieldtwin.emulators.canopen.service import (
    NEVER,
    AnswersReads,
    Core,
    Given,
    Held,
    NmtState,
    NodeCounters,
    NodeService,
    ObjectChange,
    ObjectSource,
    SentPdo,
)
from fieldtwin.emulators.canopen.storage import Storage
from fieldtwin.emulators.canopen.sync import Sync
from fieldtwin.emulators.canopen.time_of_day import TimeOfDay, TimeService
from fieldtwin.gateway.core.can_error import CanErrorState
from fieldtwin.gateway.core.canframe import CanFrame
from fieldtwin.gateway.core.clock import NS_PER_MS
from fieldtwin.gateway.core.errors import UsageError

NMT_COMMAND = 0x000

_INITIALISING = NmtState.INITIALISING
_DUE_NS = attrgetter("due_ns")

_START, _STOP, _PRE_OPERATIONAL, _RESET_NODE, _RESET_COMMUNICATION = 1, 2, 128, 129, 130
_TARGET = {
    _START: NmtState.OPERATIONAL,
    _STOP: NmtState.STOPPED,
    _PRE_OPERATIONAL: NmtState.PRE_OPERATIONAL,
}


@dataclass(frozen=True, slots=True)
class NodeContext:
    """The parts and settings of a node that its data sheet does not contain.

    `source` gives values by time and, if it is an `AnswersReads`, for each upload. `model` computes the device's behaviour
    from them and from the values that clients write; `distort` changes the model's output, for faults. `held` is called
    with each value that an object gets from the source, a client or the device, and `given` with the objects whose values the
    node has sent. `factory` replaces defaults (a serial number). `refusals` are objects for which SDO clients get an abort,
    regardless of the data sheet.

    `tolerate_short_sdo` accepts SDO requests of fewer than 8 bytes, which old PLCs send, as if they were padded with zeros; by
    default they are ignored. `sdo_block` is the number of segments that a client may send in one sub-block, 1 to 127. A TIME
    producer (1012h) sends its time every `time_period_ms`, 0 for never. `lss` enables or disables LSS, None uses the data sheet;
    `lss_store` is the result of LSS's store command. `journal_size` limits both journals: older entries are dropped.
    """

    source: ObjectSource | None = None
    model: DeviceModel | None = None
    held: Held | None = None
    given: Given | None = None
    distort: Distort | None = None
    factory: Mapping[Key, bytes] = field(default_factory=dict)
    refusals: Mapping[Key, Abort] = field(default_factory=dict)
    tolerate_short_sdo: bool = False
    sdo_timeout_ms: int = 1000
    sdo_block: int = 127
    time_period_ms: int = 0
    lss: bool | None = None
    lss_store: LssStore = LssStore.WORKS
    journal_size: int = 100_000


class CanopenNode:
    """One node. Call `start`, then `feed` for each frame and `tick` when `wake_at_ns` has come; send the frames that they return.

    A node with ID 255 is unconfigured and waits silently until LSS assigns a node ID. Raises `UsageError` for any other
    ID outside 1 to 127, for 255 without LSS, and from any call when `source` gives values that do not fit.
    """

    def __init__(self, dictionary: Dictionary, node_id: int, context: NodeContext | None = None) -> None:
        self.context = context = context or NodeContext()
        lss = dictionary.lss if context.lss is None else context.lss
        if not (1 <= node_id <= 127 or (lss and node_id == UNCONFIGURED)):
            raise UsageError("not a CANopen node id", expected="1 to 127, or 255 with LSS", got=str(node_id))
        data = NodeData(dictionary, 0 if node_id == UNCONFIGURED else node_id, context.factory)
        source, model = context.source, context.model
        self._behaviour = None if model is None else Behaviour(model, source, data, context.distort)
        self._core = core = Core(data, node_id, self._behaviour or source, context.journal_size)
        core.held = context.held
        core.given = context.given
        core.answers = source if isinstance(source, AnswersReads) else None
        self.accepts = Acceptance(core)
        """The acceptance filter: whether a frame can concern this node. Feeding other frames is harmless."""
        self._powered = False
        self._emergency = Emergency(core)
        react = ErrorReaction(core, self._enter)
        self._heartbeat = HeartbeatProducer(core)
        self._guarding = NodeGuarding(core, self._emergency, react)
        self._consumer = HeartbeatConsumer(core, self._emergency, react)
        self._faults = BusFaults(core, self._emergency, react)
        self._tpdos = Tpdos(core, lambda: self._sync.window_end_ns)
        self._sync = Sync(core, self._emergency, self._on_sync)
        self._rpdos = Rpdos(core, self._emergency, self._tpdos.changed, self._rpdo_wrote, self._sync.in_window)
        self._time = TimeService(core, context.time_period_ms * NS_PER_MS)
        self._lss = LssService(core, context.lss_store, self._boot) if lss else None
        services: list[NodeService] = [self._emergency, self._consumer, self._guarding, self._faults]
        services += [self._behaviour] if self._behaviour else []
        services += [self._heartbeat, self._sync, self._time, self._rpdos, self._tpdos, Storage(core)]
        services += [self._lss] if self._lss else []
        view = ClientView(core, services, self._tpdos, context.refusals)
        timeout_ns = context.sdo_timeout_ms * NS_PER_MS
        self._sdo = SdoChannels(core, view, timeout_ns, context.sdo_block, tolerate_short=context.tolerate_short_sdo)
        view.add(self._sdo)
        self._services = (self._sdo, *services)
        # Most services never wait for a time; the others are checked with every frame and every tick.
        self._timed = tuple(s for s in self._services if type(s).tick is not NodeService.tick and s.waits)
        self._wakers = tuple(s for s in self._timed if s is not self._behaviour)
        if self._behaviour is not None:
            self._behaviour.connect(core, self._emergency, self._tpdos.changed)

    # -- queries --------------------------------------------------------------------------------------------------

    @property
    def node_id(self) -> int:
        """Return the node ID; 255 while the node is unconfigured."""
        return self._core.node_id

    @property
    def state(self) -> NmtState:
        return self._core.state

    @property
    def counters(self) -> NodeCounters:
        return self._core.counters

    @property
    def data(self) -> NodeData:
        """Return the live values. Change them only with `set_value`, so that TPDOs are triggered."""
        return self._core.data

    @property
    def journal(self) -> deque[SentPdo]:
        """Return the TPDOs sent, oldest first, bounded."""
        return self._core.journal

    @property
    def changes(self) -> deque[ObjectChange]:
        """Return the latest NMT states, writes and errors, oldest first."""
        return self._core.changes

    @property
    def active_errors(self) -> tuple[int, ...]:
        """Return the EMCY codes of the errors that are present."""
        return self._emergency.active

    @property
    def bit_rate(self) -> int | None:
        """Return the bit rate that LSS activated, in bit/s; None if LSS has not changed it."""
        return self._lss.bit_rate if self._lss else None

    def time_of_day(self, now_ns: int) -> TimeOfDay | None:
        """Return the network's time as known to the node; None until it is set or received."""
        return self._time.now(now_ns)

    def wake_at_ns(self) -> int | None:
        """Return when `tick` is due next; None if only a frame can cause an action."""
        if self._core.state is _INITIALISING:
            wake_ns = self._lss.due_ns if self._lss else NEVER
        else:
            wake_ns = min(map(_DUE_NS, self._wakers))
            if self._behaviour is not None and self._behaviour.asks_at_ns < wake_ns:
                wake_ns = self._behaviour.asks_at_ns
        return None if wake_ns == NEVER else wake_ns

    # -- events ---------------------------------------------------------------------------------------------------

    def start(self, now_ns: int) -> list[CanFrame]:
        """Power the node on, or off and on again: set power-on values, send the boot-up message, enter PRE-OPERATIONAL."""
        self._powered = True
        if self._lss:
            self._lss.power_on()
        self._reset(now_ns, communication_only=False)
        return self._core.take_output()

    def feed(self, frame: CanFrame, now_ns: int) -> list[CanFrame]:
        """Process a frame from the bus."""
        if not self._powered:
            return []
        self._core.counters.frames_in += 1
        self._run_due(now_ns)
        if frame.error:
            self._faults.on_error_frame(frame, now_ns)
        elif frame.extended or self._core.mutes:
            self._core.counters.ignored += 1
        elif frame.remote:
            self._on_remote(frame, now_ns)
        else:
            self._on_data(frame, now_ns)
        self._run_due(now_ns)
        return self._core.take_output()

    def tick(self, now_ns: int) -> list[CanFrame]:
        """Process the passage of time. Early calls do nothing."""
        if self._powered:
            self._run_due(now_ns)
        return self._core.take_output()

    def bus_state(self, state: CanErrorState, now_ns: int) -> list[CanFrame]:
        """Process a state change of the CAN controller.

        Error-passive causes EMCY 8120h. In bus-off the node is silent, and sends 8140h afterwards."""
        if self._powered:
            self._faults.changed(state, now_ns)
        return self.tick(now_ns)

    def on_second_node(self, callback: Callable[[int], None]) -> None:
        """Call `callback` with the identifier when a different node sends on an identifier of this node. It is called once
        until the next reset."""
        self._faults.on_second_node = callback

    def overrun(self, now_ns: int) -> list[CanFrame]:
        """Report that the CAN controller lost received frames: EMCY 8110h."""
        if self._powered:
            self._faults.overrun(now_ns)
        return self.tick(now_ns)

    def take_overdue(self) -> frozenset[int]:
        """Return the identifiers of synchronous TPDOs whose window (1007h) has ended.

        The caller withdraws frames with these identifiers that still wait for the bus, as a controller aborts its
        mailboxes, and reports them with `dropped`. The identifiers of each SYNC are returned once.
        """
        return self._tpdos.take_overdue()

    def dropped(self, frames: Collection[CanFrame], now_ns: int) -> list[CanFrame]:
        """Count frames of this node that were withdrawn, and send EMCY 8100h once per SYNC."""
        if frames:
            self._tpdos.dropped(frames)
            self._sync.late(now_ns)
        return self.tick(now_ns)

    def set_time(self, time: TimeOfDay, now_ns: int) -> list[CanFrame]:
        """Set the device's own clock, which a TIME producer sends."""
        self._time.set_time(time, now_ns)
        return self.tick(now_ns)

    def set_value(self, index: int, subindex: int, raw: bytes, now_ns: int) -> list[CanFrame]:
        """Set an object to the device's own new value (bytes as sent). A change is an event for the TPDOs that map the object."""
        if self._core.data.put(index, subindex, raw):
            self._core.note(now_ns, "set", index, subindex, raw)
            self._tpdos.changed([(index, subindex)], now_ns)
        return self.tick(now_ns)

    def raise_error(self, code: int, now_ns: int, *, register: int = GENERIC, info: bytes = b"") -> list[CanFrame]:
        """Raise an error of the device: EMCY `code` with `info` (up to 5 bytes), active until `clear_error`.

        Raises `UsageError` for values that no EMCY message can carry.
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
        """Clear an error: EMCY 0000h with the remaining bits of the error register."""
        self._emergency.clear_error(code, now_ns)
        return self.tick(now_ns)

    # -- inside ---------------------------------------------------------------------------------------------------

    def _run_due(self, now_ns: int) -> None:
        if self._core.state is not _INITIALISING:
            for service in self._timed:  # one service can make the next ones due
                if service.due_ns <= now_ns:
                    service.tick(now_ns)
        elif self._lss is not None:
            self._lss.tick(now_ns)

    def _on_data(self, frame: CanFrame, now_ns: int) -> None:
        can_id, data = frame.can_id, frame.data
        if can_id == FROM_MASTER and self._lss is not None:
            self._lss.receive(data, now_ns)
        elif self.state is NmtState.INITIALISING:
            self._core.counters.ignored += 1
        elif can_id == NMT_COMMAND:
            self._on_nmt(data, now_ns)
        elif not self._taken(frame, now_ns) and ERROR_CONTROL < can_id <= ERROR_CONTROL + 127:
            self._consumer.heard(frame, now_ns)

    def _taken(self, frame: CanFrame, now_ns: int) -> bool:
        """Return whether one of the node's services handled the frame."""
        can_id, data = frame.can_id, frame.data
        return (
            self._sdo.receive(can_id, data, now_ns)
            or self._sync.receive(frame, now_ns)
            or self._time.receive(can_id, data, now_ns)
            or self._rpdos.receive(can_id, data, now_ns)
            or self._faults.heard(frame, now_ns)
        )

    def _on_remote(self, frame: CanFrame, now_ns: int) -> None:
        if frame.can_id == ERROR_CONTROL + self.node_id and self.state is not NmtState.INITIALISING:
            self._guarding.requested(now_ns)
        else:
            self._tpdos.on_remote(frame.can_id, now_ns)

    def _on_nmt(self, data: bytes, now_ns: int) -> None:
        """Process an NMT command; ignored unless it is exactly a command and a node ID for this node (CiA 301, 7.2.8.3.1)."""
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

    def _on_sync(self, counter: int | None, now_ns: int) -> None:
        """Process SYNC: sample inputs before the waiting RPDOs are applied."""
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
        for service in self._services:
            service.state_changed(now_ns)

    def _boot(self, now_ns: int) -> None:
        """Boot an unconfigured node to which LSS has assigned a node ID."""
        self._reset(now_ns, communication_only=False)

    def _reset(self, now_ns: int, *, communication_only: bool) -> None:
        """Reset the node. A node ID that LSS assigned takes effect here. A node without a node ID stays silent."""
        self._core.state = NmtState.INITIALISING
        self._core.note(now_ns, "nmt", 0, 0, bytes([NmtState.INITIALISING]))
        if self._lss is not None:
            self._lss.adopt(now_ns)
        self._core.data.reset(communication_only=communication_only)
        if self._behaviour is not None and not communication_only:
            self._behaviour.power_on(now_ns)
        for service in self._services:
            service.reset(now_ns)
        if self.node_id == UNCONFIGURED:
            return
        self._core.send(ERROR_CONTROL + self.node_id, bytes([NmtState.INITIALISING]), now_ns)
        self._enter(NmtState.PRE_OPERATIONAL, now_ns)
