"""The paper's ControlLogic, and `Relay`, the PLC program that runs it in a scan.

`ControlLogic` implements the schema of the paper literally: consumers `sensor` and `transmitter`, producers `response` and
`command`, a period, a data log and the observatory's state machine. It does not interpret payloads, except for the period in a
command. `Relay` connects it to tags: messages from the mailboxes go to the consumers, and what the producers emit goes to
outputs. While the transmitter cannot keep up, these outputs wait in a queue of limited length.

Neither class may depend on a protocol, a register or the time of day; `now_ns` is the time of the scan.
"""

from __future__ import annotations

import json
from collections import deque
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

from fieldtwin.gateway.core.concurrency.events import Consumer, Producer
from fieldtwin.gateway.core.errors import Bug, Desync
from fieldtwin.gateway.core.image.image import Message, TagKind
from fieldtwin.gateway.core.statemachine import STATE_CODES, EventStateMachine, encode_period
from fieldtwin.gateway.core.values import COMMAND, DATA, RESPONSE, Scalar
from fieldtwin.plc.program import Outbox, Program, ScanInfo, message_input, message_output, var_local, var_output
from fieldtwin.plc.states import ANY, StateTable, Transition

QUEUE_CAPACITY = 256
LOG_CAPACITY = 1024
LOG_BYTES = 1024


@dataclass(frozen=True, slots=True)
class LogEntry:
    """One entry of the data log: ``command``, ``response`` or ``bad command``, its payload, and its time (monotonic
    ns)."""

    t_ns: int
    kind: str
    data: bytes

    def encode(self) -> bytes:
        """Return the entry as it is sent in the `log` messages: UTF-8 JSON ``{"t_ns": int, "kind": str, "data":
        hex}``."""
        return json.dumps({"t_ns": self.t_ns, "kind": self.kind, "data": self.data.hex()}).encode()


class DataLog:
    """The data log: limited in size, ordered, time-stamped. Duplicates are kept; a full log drops its oldest entry
    (paper.md, ruling 2).

    `total` counts all entries ever added.
    """

    def __init__(self, capacity: int = LOG_CAPACITY) -> None:
        self.entries: deque[LogEntry] = deque(maxlen=capacity)
        self.total = 0

    def append(self, entry: LogEntry) -> None:
        self.entries.append(entry)
        self.total += 1

    @property
    def dropped(self) -> int:
        return self.total - len(self.entries)

    def __len__(self) -> int:
        return len(self.entries)

    def __iter__(self) -> Iterator[LogEntry]:
        return iter(self.entries)


class ControlLogic:
    """The paper's ControlLogic. Init: period 0, log empty, state STANDBY.

    `commands` and `responses` count what was relayed, `bad_commands` the received commands that were invalid.
    """

    def __init__(self) -> None:
        self.sensor: Consumer[RESPONSE] = Consumer("sensor", QUEUE_CAPACITY)
        self.transmitter: Consumer[COMMAND] = Consumer("transmitter", QUEUE_CAPACITY)
        self.response: Producer[RESPONSE] = Producer("response")
        self.command: Producer[COMMAND] = Producer("command")
        self.machine = EventStateMachine()
        self.data_log = DataLog()
        self.commands = self.responses = self.bad_commands = 0

    @property
    def period_s(self) -> int:
        """Return the last commanded period in seconds: any integer (`period` of the schema)."""
        return self.machine.period_s

    def set_period(self, command: COMMAND) -> None:
        """Set the period and the state that follows from it (SetPeriod). Raises `Desync` for an invalid command."""
        self.machine.process_event(command)

    def log_data(self, kind: str, data: DATA, now_ns: int) -> None:
        """Append an entry to the data log (LogData).

        The precondition is period > 0; a call that violates it is a bug of the caller.
        """
        if self.period_s <= 0:
            raise Bug("data logged while nothing is sampled", expected="period > 0", got=str(self.period_s))
        self.data_log.append(LogEntry(now_ns, kind, data.data))

    def send_cmd(self, now_ns: int) -> None:
        """Drain the transmitter's queue (sendCmd): each command is consumed, sets the period, and is emitted.

        Every valid command is relayed. It is logged if the period that it sets is above 0 (paper.md, ruling 1). An invalid
        command changes nothing and is not relayed: it is counted, and logged if the present period is above 0.
        """
        for command in self.transmitter.drain():
            try:
                self.set_period(command)
            except Desync:
                self.bad_commands += 1
                self._log_if_active("bad command", command, now_ns)
                continue
            self.commands += 1
            self.command.emit(command)
            self._log_if_active("command", command, now_ns)

    def send_rsp(self, now_ns: int) -> None:
        """Drain the sensor's queue (sendRsp): each response is consumed, emitted unaltered, and logged if the state is active."""
        for response in self.sensor.drain():
            self.responses += 1
            self.response.emit(response)
            self._log_if_active("response", response, now_ns)

    def _log_if_active(self, kind: str, data: DATA, now_ns: int) -> None:
        if self.period_s > 0:
            self.log_data(kind, data, now_ns)


class Relay(Program):
    """The observatory's control logic as a program.

    `period_s` is the commanded period, also when it is 0 or negative; 0 before the first command (STANDBY). `response`
    carries the sensor's payloads unaltered, `log` the data log's entries (`LogEntry.encode`). While a mailbox is full,
    responses wait in a queue of limited length; the oldest is dropped and counted.
    """

    queue_capacity: ClassVar[int] = QUEUE_CAPACITY
    """The number of responses that may wait for the transmitter."""
    table = StateTable(
        Transition(ANY, "ACTIVE", when="command > 0"),
        Transition(ANY, "STANDBY", when="command = 0"),
        Transition(ANY, "OFF", when="command < 0"),
        states=tuple(STATE_CODES),
    )
    """The state machine, only to draw it as a diagram; fieldtwin.gateway.core.statemachine runs it."""
    command: tuple[Message, ...] = message_input()
    sample: tuple[Message, ...] = message_input()
    period_s: int = var_output(TagKind.INT, initial=0, unit="s")
    response: Outbox = message_output()
    log: Outbox = message_output(LOG_BYTES, depth=64)
    state: int = var_local(
        TagKind.INT, STATE_CODES["STANDBY"], limits=(0, len(STATE_CODES) - 1), words=tuple(STATE_CODES)
    )
    period: int = var_local(TagKind.INT, initial=0, unit="s")
    commands: int = var_local(TagKind.INT, initial=0)
    responses: int = var_local(TagKind.INT, initial=0)
    logged: int = var_local(TagKind.INT, initial=0)
    dropped: int = var_local(TagKind.INT, initial=0)
    bad_commands: int = var_local(TagKind.INT, initial=0)
    waiting: int = var_local(TagKind.INT, initial=0)

    def __init__(self) -> None:
        self.logic = ControlLogic()
        self._outgoing: Consumer[RESPONSE] = Consumer("response", self.queue_capacity)
        self.logic.response.subscribe(self._outgoing)
        self._log_sent = 0
        self._log_lost = 0
        self._too_long = 0

    def resume(self, known: Mapping[str, Scalar]) -> None:
        """Set the state from the period that was commanded last."""
        period = known.get("period")
        if isinstance(period, int):
            self.logic.machine.process_event(encode_period(period))
        self._show()

    def execute(self, scan: ScanInfo) -> None:
        logic = self.logic
        for message in self.command:
            logic.transmitter.observe(COMMAND(message.data))
        for message in self.sample:
            logic.sensor.observe(RESPONSE(message.data))
        if logic.transmitter.queue:
            logic.send_cmd(scan.now_ns)
        if logic.sensor.queue:
            logic.send_rsp(scan.now_ns)
        if self._outgoing.queue:
            self._pass_on_responses(scan.now_ns)
        self._pass_on_log()
        self._show()

    def _pass_on_responses(self, now_ns: int) -> None:
        queue = self._outgoing.queue
        while queue:
            if len(queue[0].data) > self.response.max_bytes:
                self._too_long += 1  # the transmitter could never send it
            elif not self.response.send(queue[0].data, now_ns):
                return
            self._outgoing.consume()

    def _pass_on_log(self) -> None:
        log = self.logic.data_log
        if log.total == self._log_sent:
            return
        first = log.total - len(log)
        if self._log_sent < first:  # entries were overwritten before they were sent
            self._log_lost += first - self._log_sent
            self._log_sent = first
        while self._log_sent < log.total and self.log.room:
            entry = log.entries[self._log_sent - first]
            text = entry.encode()
            if len(text) > self.log.max_bytes:
                self._too_long += 1
            else:
                self.log.send(text, entry.t_ns)
            self._log_sent += 1

    def _show(self) -> None:
        logic = self.logic
        self.period_s = self.period = logic.period_s
        self.state = STATE_CODES[logic.machine.state.name]
        self.commands, self.responses, self.bad_commands = logic.commands, logic.responses, logic.bad_commands
        self.logged = logic.data_log.total
        self.waiting = len(self._outgoing.queue)
        self.dropped = (
            logic.sensor.dropped + logic.transmitter.dropped + self._outgoing.dropped + self._log_lost + self._too_long
        )

    def whole_state(self, now_ns: int) -> Any:
        """Return counters and queues. Nothing in this program depends on the time between two scans."""
        logic = self.logic
        counters = (logic.commands, logic.responses, logic.bad_commands, logic.data_log.total, self._log_sent)
        losses = (
            logic.sensor.dropped,
            logic.transmitter.dropped,
            self._outgoing.dropped,
            self._log_lost,
            self._too_long,
        )
        queued = [tuple(item.data for item in c.queue) for c in (logic.transmitter, logic.sensor, self._outgoing)]
        return logic.period_s, counters, losses, tuple(queued)
