"""Outputs: what the PLC commands, what is safe, and whether it may be written at all.

A dead PLC cannot make anything safe, so the gateway holds each output's safe value and writes it when the PLC's heartbeat
stops (DESIGN.md, "Who makes outputs safe"). A value is written when it differs from what the device last confirmed; a device
that comes back, or that reads back something else, gets it again. Nothing is written to a plant that was not allowed,
and every write and refusal is on record before it is on the wire.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

from gateway.core.clock import NS_PER_MS, NS_PER_S
from gateway.core.errors import EndpointBusy, FieldtwinError, NotAllowed, Unreachable
from gateway.core.values import Quality
from gateway.devices.register_device import RegisterDriver
from gateway.runtime.audit import AuditLog
from gateway.runtime.modbus_bus import Job, ModbusBus
from gateway.runtime.tags import TagTable

MIN_SPACING_NS = 100 * NS_PER_MS
"""At most ten writes a second to one tag; what changes faster is written with its newest value."""
RETRY_NS = NS_PER_S
SAFE = "safe: "


@dataclass
class Output:
    """One output: its tag, its device, and how far the last write got."""

    tag: str
    local: str
    driver: RegisterDriver
    bus: ModbusBus
    safe: float | None
    wanted: float | None = None
    by: str = ""
    held: float | None = None
    held_since_ns: int = 0
    pending: bool = False
    refused: tuple[float, str] | None = None
    next_try_ns: int = 0
    asked: Callable[[FieldtwinError | None], None] | None = None
    """Who asked for one write and waits for its end; None for what the PLC or the safe state commands."""

    def shown(self, value: object) -> object:
        """`value` as the audit log may show it: a secret is not written down."""
        return "(secret)" if self.driver.profile.tags[self.local].secret else value

    def answer(self, error: FieldtwinError | None) -> None:
        """Tell who asked how it ended. It was for once: nothing is written again behind a person's back."""
        asked, self.asked = self.asked, None
        if asked is not None:
            if not self.by.startswith(SAFE):
                self.wanted = None
            asked(error)


class OutputWriter:
    """Brings every output's device to what is wanted. `tick` starts writes and never waits for one."""

    def __init__(self, outputs: list[Output], tags: TagTable, audit: AuditLog, allow_writes: bool) -> None:
        self.outputs = outputs
        self.allow_writes = allow_writes
        self.writes = self.refusals = self.failures = self.rewrites = 0
        self.safe_active = False
        self._tags = tags
        self._audit = audit
        self._now_ns = 0

    def want(self, tag: str, value: float) -> None:
        """The PLC commands `value`."""
        for output in self.outputs:
            if output.tag == tag:
                output.wanted, output.by = value, "plc"

    def request(self, tag: str, value: float, by: str, done: Callable[[FieldtwinError | None], None]) -> None:
        """Somebody (`by`) asks for one write of a tag that the PLC does not command. `done` is told how it ended.

        While the outputs are in their safe state, those that have a safe value keep it.
        """
        output = next((o for o in self.outputs if o.tag == tag), None)
        where = output.driver.config.where if output is not None else tag
        if output is None or output.by == "plc":
            done(NotAllowed(f"{tag} cannot be commanded from here", where=where))
        elif self.safe_active and output.safe is not None:
            done(EndpointBusy("the outputs are in their safe state", where=where))
        elif output.pending or self._now_ns < output.next_try_ns:
            done(EndpointBusy("another write has just been made, or is under way", where=where))
        elif not output.bus.online(output.driver):
            done(Unreachable("the device does not answer", where=where))
        else:
            output.wanted, output.by, output.asked = value, by, done
            self._start(output, value)

    def make_safe(self, why: str) -> None:
        """Command every output's safe value; outputs without one keep what they have."""
        self.safe_active = True
        for output in self.outputs:
            if output.safe is not None:
                output.wanted, output.by = output.safe, f"{SAFE}{why}"

    def release(self) -> None:
        """The PLC is back: its commands count again."""
        self.safe_active = False

    def forget(self, driver: RegisterDriver) -> None:
        """A device was lost: what it holds when it comes back is not known."""
        for output in self.outputs:
            if output.driver is driver:
                output.held = None

    @property
    def settled(self) -> bool:
        """True when no output that could be written still differs from what is wanted."""
        return not any(
            o.pending or (o.wanted is not None and o.held != o.wanted and self._possible(o)) for o in self.outputs
        )

    def _possible(self, output: Output) -> bool:
        return output.bus.online(output.driver) and output.refused != (output.wanted, output.by)

    def tick(self, now_ns: int) -> None:
        """Start what needs writing now."""
        self._now_ns = now_ns
        for output in self.outputs:
            if output.wanted is None or output.pending:
                continue
            self._compare_with_device(output, now_ns)
            if output.held != output.wanted and self._possible(output) and now_ns >= output.next_try_ns:
                self._start(output, output.wanted)

    def _compare_with_device(self, output: Output, now_ns: int) -> None:
        """A device that reads back something else lost what it was told (a restart): tell it again.

        Compared as sent: a device may hold a rounded value, and that is no other one.
        """
        current = self._tags.current(output.tag, now_ns)
        if output.held is None or current.t_ns <= output.held_since_ns or current.quality is Quality.BAD:
            return
        sent = output.driver.command(output.local, output.held).data
        if int.from_bytes(current.raw) != int.from_bytes(sent):
            output.held = None
            self.rewrites += 1

    def _start(self, output: Output, value: float) -> None:
        name = output.driver.config.name
        old = self._tags.current(output.tag, self._now_ns).value
        try:
            self._check(output)
            command = output.driver.command(output.local, value)
        except NotAllowed as e:
            output.refused = (value, output.by)
            self.refusals += 1
            try:
                self._audit.note(
                    "refuse",
                    name,
                    by=output.by,
                    result=str(e),
                    tag=output.tag,
                    old=output.shown(old),
                    new=output.shown(value),
                )
            except Unreachable:
                self.failures += 1  # counted; refused all the same
            output.answer(e)
            return
        if not self._on_record(output, name, old, value):
            output.answer(Unreachable("the write could not be put on record", where=name))
            return
        output.pending = True
        output.driver.consumer.observe(command)
        output.bus.submit(Job(output.driver, output.driver.send, partial(self._done, output, value)))

    def _on_record(self, output: Output, name: str, old: object, value: float) -> bool:
        """Note the write before it happens. Without a record only a safe value is written; the rest is tried again."""
        try:
            self._audit.note(
                "write",
                name,
                by=output.by,
                result="asked",
                tag=output.tag,
                old=output.shown(old),
                new=output.shown(value),
            )
        except Unreachable:
            self.failures += 1
            output.next_try_ns = self._now_ns + RETRY_NS
            return self.safe_active and output.asked is None
        return True

    def _check(self, output: Output) -> None:
        where = output.driver.config.where
        if not self.allow_writes:
            raise NotAllowed("this plant is read-only", where=where, hint="start with --allow-writes")
        if output.local not in output.driver.config.writable:
            raise NotAllowed(f"{output.tag} is not marked writable in the system file", where=where)
        if output.driver.identity_error:
            raise NotAllowed(f"writes are blocked: {output.driver.identity_error}", where=where)

    def _done(self, output: Output, value: float, error: FieldtwinError | None) -> None:
        output.pending = False
        output.next_try_ns = self._now_ns + (MIN_SPACING_NS if error is None else RETRY_NS)
        if error is None:
            self.writes += 1
            output.held, output.held_since_ns = value, self._now_ns
        else:
            self.failures += 1
            output.driver.consumer.queue.clear()  # the command that failed must not go out ahead of a newer one
        result = "done" if error is None else f"failed: {error}"
        try:
            self._audit.note(
                "write", output.driver.config.name, by=output.by, result=result, tag=output.tag, new=output.shown(value)
            )
        except Unreachable:
            self.failures += 1  # counted; the next write will not start without a record
        output.answer(error)
