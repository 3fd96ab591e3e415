"""Pass messages between a transmitter's mailboxes and the control logic.

A mailbox is acknowledged only when the PLC has consumed its message, so a command is not lost if the gateway process dies before
that. The consumption is stored before the acknowledgement, so that the next gateway process does not deliver the message again.
If `remote` is `local` in the system file, the plant accepts no commands: they are acknowledged, refused and recorded. While
mailboxes are delegated to a digital thread, this module does not read or write them.
"""

from __future__ import annotations

from contextlib import suppress

from fieldtwin.gateway.core.clock import NS_PER_MS
from fieldtwin.gateway.core.concurrency.events import Consumer
from fieldtwin.gateway.core.errors import FieldtwinError, Unreachable
from fieldtwin.gateway.core.values import COMMAND, DATA, RESPONSE
from fieldtwin.gateway.devices.transmitter import TransmitterDriver
from fieldtwin.gateway.runtime.audit_log import AuditLog
from fieldtwin.gateway.runtime.buses.modbus.modbus_bus import ModbusBus
from fieldtwin.gateway.runtime.mailboxes.acked_commands import AckedCommandStore
from fieldtwin.gateway.runtime.mailboxes.mailboxes import Mailboxes
from fieldtwin.gateway.runtime.outputs.refusals import RefusalCause, Refusals, cause_of

RETRY_NS = 1000 * NS_PER_MS


class MailboxPump:
    """The message transfer of one transmitter. `inbox` holds received messages that are not yet passed to the PLC.

    `tick` never waits.
    """

    def __init__(
        self,
        driver: TransmitterDriver,
        bus: ModbusBus,
        audit: AuditLog,
        *,
        allow_writes: bool,
        remote: bool,
        delegated: bool = False,
        taken: AckedCommandStore | None = None,
        journal: Refusals | None = None,
    ) -> None:
        """Create the message transfer.

        `journal` records the messages that do not reach the transmitter, and the commands that are refused.
        """
        self.driver = driver
        self._journal = journal
        self._withheld: tuple[str, object] | None = None
        """The last message that was reported to the journal because the plant is read-only, so that each is reported once."""
        self._taken = taken or AckedCommandStore(None)
        driver.taken_before = self._taken.of(driver.config.name)
        self.inbox: Consumer[DATA] = Consumer(driver.emitter.event, capacity=64)
        if not delegated:
            driver.emitter.subscribe(self.inbox)
        self.commands_refused = 0
        self.remote = remote
        """Whether the plant accepts remote commands (`remote` in the system file); it may change at any time."""
        self._boxes = Mailboxes(driver, bus, self._ended)
        self._bus = bus
        self._audit = audit
        self._allow_writes = allow_writes
        self._lent = delegated
        self._sending = 0
        self._next_ns = self.now_ns = 0
        self._recorded: tuple[str, object] | None = None

    def command(self, payload: bytes, by: str) -> bool:
        """Handle and record a command that did not come through the mailbox.

        Return False if the command is refused because the plant accepts no remote commands.
        """
        name = self.driver.config.name
        result = "taken" if self.remote else "the plant is switched to local"
        with suppress(Unreachable):
            self._audit.note("command" if self.remote else "refuse", name, by=by, result=result, payload=payload.hex())
        if self.remote:
            self.inbox.observe(COMMAND(payload))
        else:
            self.commands_refused += 1
        return self.remote

    def offer(self, payloads: list[bytes]) -> None:
        """Queue messages of the control logic, in order.

        If the mailbox is delegated, do nothing: the digital thread reads the messages from the process image.
        """
        if self._lent:
            return
        for payload in payloads:
            self.driver.consumer.observe(RESPONSE(payload))

    @property
    def undelivered(self) -> int:
        """Return the number of messages of the control logic that have not reached the transmitter's mailbox yet."""
        return len(self.driver.consumer.queue) + self._sending

    def refuse_when_local(self) -> None:
        """Refuse the received messages if the plant accepts no remote commands."""
        if not self.remote:
            for item in self.inbox.drain():
                self.commands_refused += 1
                # the command is refused even if it cannot be recorded; the missing record is counted
                with suppress(Unreachable):
                    self._audit.note(
                        "refuse",
                        self.driver.config.name,
                        by="far side",
                        result="the plant is switched to local",
                        payload=item.data.hex(),
                    )
                self._tell("inbox", item.data.hex(), RefusalCause.LOCAL, "the plant is switched to local", "far side")

    def _tell(
        self, tag: str, value: object, cause: RefusalCause, reason: str, by: str = "plc", *, audit: bool = False
    ) -> None:
        if self._journal is not None:
            name = self.driver.config.name
            self._journal.note(name, f"{name}.{tag}", value, cause, reason, by, self.now_ns, audit=audit)

    def _withhold(self) -> None:
        """Report the first message that waits on a read-only plant; it stays in the queue."""
        if self.driver.consumer.queue:
            waits = ("outbox", self.driver.consumer.queue[0].data.hex())
            if waits != self._withheld:
                self._withheld = waits
                self._tell(
                    *waits, RefusalCause.READ_ONLY, "this plant is read-only (start with --allow-writes)", audit=True
                )

    def tick(self, now_ns: int, all_consumed: bool) -> None:
        """Start the next mailbox request. `all_consumed` says that the PLC has consumed all messages that were passed to it."""
        self.now_ns = now_ns
        self._keep(all_consumed)
        if not self.driver.to_acknowledge and not self.driver.consumer.queue:
            return
        if not self._allow_writes:
            self._withhold()
        if now_ns < self._next_ns or not self._allow_writes or not self._boxes.ready:
            return
        if self.driver.to_acknowledge and all_consumed and not self.inbox.queue:
            if self._on_record("inbox_ack", self.driver.to_acknowledge, now_ns):
                self._boxes.acknowledge()
        elif self.driver.consumer.queue:
            if not self.driver.outbox_free:
                self._boxes.look(now_ns)
            elif self._on_record("outbox", self.driver.consumer.queue[0].data.hex(), now_ns):
                self._sending = 1
                self._boxes.send(now_ns)

    @property
    def is_idle(self) -> bool:
        """Return whether there is no message to pass on, to acknowledge or to refuse, so that `tick` does nothing."""
        driver = self.driver
        return not (
            self._sending
            or driver.to_acknowledge
            or driver.consumer.queue
            or self.inbox.queue
            or self._taken.of(driver.config.name)
        )

    def _keep(self, all_consumed: bool) -> None:
        """Store whether the message in the inbox was consumed, so that it is not delivered again.

        Until the device is online, the content of the inbox is unknown.
        """
        driver, name = self.driver, self.driver.config.name
        if not driver.to_acknowledge and not self._taken.of(name):
            return
        with suppress(Unreachable):  # without the file the message may be delivered twice
            if driver.to_acknowledge:
                if all_consumed and not self.inbox.queue:
                    self._taken.note(name, driver.emitted)
            elif self._bus.online(driver):
                self._taken.note(name, b"")

    def _on_record(self, tag: str, new: object, now_ns: int) -> bool:
        """Record a write in the audit log before it is sent. Return False if that fails; the write is then tried again later."""
        name = self.driver.config.name
        try:
            self._audit.note("write", name, by="plc", result="asked", tag=f"{name}.{tag}", old=None, new=new)
        except Unreachable:
            self._next_ns = now_ns + RETRY_NS
            return False
        self._recorded = (f"{name}.{tag}", new)
        return True

    def _ended(self, error: FieldtwinError | None) -> None:
        self._sending = 0
        if self._recorded is not None:
            (tag, new), self._recorded = self._recorded, None
            result = "done" if error is None else f"failed: {error}"
            if error is not None:
                self._tell(tag.rpartition(".")[2], new, cause_of(error), str(error))
            with suppress(Unreachable):  # the next write does not start without a record
                self._audit.note("write", self.driver.config.name, by="plc", result=result, tag=tag, new=new)
