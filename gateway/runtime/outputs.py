"""Outputs: what the PLC commands, what is safe, and whether it may be written at all.

A dead PLC cannot make anything safe, so the gateway holds each output's safe value and writes it when the PLC's heartbeat
stops (DESIGN.md, "Who makes outputs safe"). A value is written when it differs from what the device last confirmed; a device
that comes back, or that reads back something else, gets it again. Outputs that share one frame (an RPDO) are written
together. Nothing is written to a plant that was not allowed,
and every write and refusal is on record before it is on the wire.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial

from gateway.core.clock import NS_PER_MS, NS_PER_S
from gateway.core.errors import EndpointBusy, FieldtwinError, NotAllowed, Unreachable
from gateway.core.values import COMMAND, Quality, TagValue
from gateway.devices.canopen_device import CanopenDriver
from gateway.devices.register_device import RegisterDriver
from gateway.runtime.audit import AuditLog
from gateway.runtime.canopen_bus import CanopenBus
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
    driver: RegisterDriver | CanopenDriver
    bus: ModbusBus | CanopenBus
    safe: float | None
    wanted: float | None = None
    by: str = ""
    held: float | None = None
    held_since_ns: int = 0
    compared: TagValue | None = None
    """What the device was last heard to hold, found to be what it was told."""
    pending: bool = False
    refused: tuple[float, str] | None = None
    next_try_ns: int = 0
    asked: Callable[[FieldtwinError | None], None] | None = None
    """Who asked for one write and waits for its end; None for what the PLC or the safe state commands."""

    @property
    def ready(self) -> bool:
        """Whether the device takes a write now."""
        if isinstance(self.driver, CanopenDriver):
            assert isinstance(self.bus, CanopenBus)
            return self.bus.takes(self.driver, self.local)
        assert isinstance(self.bus, ModbusBus)
        return self.bus.online(self.driver)

    @property
    def frame(self) -> object | None:
        """What it shares one frame with: the same object for each of those outputs. None where it is written by itself."""
        if isinstance(self.bus, CanopenBus) and isinstance(self.driver, CanopenDriver):
            return self.bus.frame_of(self.driver, self.local)
        return None

    @property
    def settle_ns(self) -> int:
        """How long after a write the device may still be heard to say what it held before."""
        if isinstance(self.bus, CanopenBus) and isinstance(self.driver, CanopenDriver):
            return self.bus.settle_ns(self.driver, self.local)
        return 0

    def submit(self, command: COMMAND, done: Callable[[FieldtwinError | None], None]) -> None:
        """Put the write on its way."""
        if isinstance(self.driver, CanopenDriver):
            assert isinstance(self.bus, CanopenBus)
            self.bus.write(self.driver, self.local, command, done)
        else:
            assert isinstance(self.bus, ModbusBus)
            self.driver.consumer.observe(command)
            self.bus.submit(Job(self.driver, self.driver.send, done))

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


def as_sent(output: Output) -> bytes:
    """What `output` holds, as it would be sent now; empty where it may not be sent any more."""
    try:
        return output.driver.command(output.local, output.held).data if output.held is not None else b""
    except NotAllowed:
        return b""


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
        elif not output.ready:
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

    def restated(self, driver: RegisterDriver | CanopenDriver, held: Mapping[str, bytes]) -> None:
        """The configuration of a driver's device is another one. `held` is what it held, as sent, by tag: what that would
        be sent as otherwise now is written again. What was refused may be allowed now."""
        for output in self.outputs:
            if output.driver is not driver:
                continue
            output.safe, output.refused = driver.config.safe.get(output.local), None
            if self.safe_active and output.safe is not None and output.by.startswith(SAFE):
                output.wanted = output.safe
            if output.tag in held and as_sent(output) not in (held[output.tag], b""):
                output.held = None

    def as_sent(self, driver: RegisterDriver | CanopenDriver) -> dict[str, bytes]:
        """What a device's outputs hold, as it was sent."""
        return {o.tag: as_sent(o) for o in self.outputs if o.driver is driver and o.held is not None}

    def forget(self, driver: RegisterDriver | CanopenDriver) -> None:
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
        return output.ready and output.refused != (output.wanted, output.by)

    def tick(self, now_ns: int) -> None:
        """Start what needs writing now."""
        self._now_ns = now_ns
        due: list[tuple[Output, float]] = []
        for output in self.outputs:
            if output.wanted is None or output.pending:
                continue
            self._compare_with_device(output, now_ns)
            if output.held != output.wanted and self._possible(output) and now_ns >= output.next_try_ns:
                due.append((output, output.wanted))
        waiting = self._waiting_frames(now_ns) if due else set()
        for output, value in due:
            if output.frame is None or output.frame not in waiting:
                self._start(output, value)

    def _waiting_frames(self, now_ns: int) -> set[object]:
        """Frames of which an output has to wait: the others wait with it, so that what a scan commanded goes out whole."""
        waits = [o for o in self.outputs if o.pending or now_ns < o.next_try_ns]
        return {o.frame for o in waits if o.frame is not None}

    def _compare_with_device(self, output: Output, now_ns: int) -> None:
        """A device that reads back something else lost what it was told (a restart): tell it again.

        Compared as sent: a device may hold a rounded value, and that is no other one.
        """
        current = self._tags.current(output.tag, now_ns)
        if current is output.compared:
            return  # nobody heard anything new of it
        if (
            output.held is None
            or current.t_ns <= output.held_since_ns + output.settle_ns
            or current.quality is Quality.BAD
        ):
            return
        sent = output.driver.command(output.local, output.held).data
        if int.from_bytes(current.raw) != int.from_bytes(sent):
            output.held = None
            self.rewrites += 1
        else:
            output.compared = current

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
        output.submit(command, partial(self._done, output, value))

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
