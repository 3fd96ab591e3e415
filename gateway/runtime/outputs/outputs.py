"""The writing of outputs: the values that the PLC commands, safe values, and the check whether a write is allowed.

A stopped PLC cannot make anything safe, so the gateway holds each output's safe value and writes it when the PLC's heartbeat
stops. A value is written when it differs from the value that the device last confirmed. It is written again after the device
was lost, or when the device reads back a different value. At the start the writer waits for the first reading of an output,
and writes nothing if the device already holds the wanted value. Outputs that share one frame (an RPDO) are written together.
Nothing is written to a plant where writing is not allowed, and every write and refusal is recorded in the audit log before it
is sent.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping

from fieldtwin.gateway.core.clock import NS_PER_MS, NS_PER_S
from fieldtwin.gateway.core.errors import EndpointBusy, FieldtwinError, NotAllowed, Unreachable
from fieldtwin.gateway.core.values import Quality, Reason, TagValue
from fieldtwin.gateway.devices.driver import DeviceDriver
from fieldtwin.gateway.runtime.audit_log import AuditLog
from fieldtwin.gateway.runtime.outputs.first_reading import is_known, waits_for_reading
from fieldtwin.gateway.runtime.outputs.output import SAFE, Output, as_sent
from fieldtwin.gateway.runtime.outputs.output_groups import OutputGroup, groups_of
from fieldtwin.gateway.runtime.outputs.refusals import RefusalCause, Refusals, cause_of
from fieldtwin.gateway.runtime.tags import TagTable

MIN_SPACING_NS = 100 * NS_PER_MS
"""At most ten writes per second go to one tag; an output that changes faster is written with its newest value."""
RETRY_NS = NS_PER_S
AWAY_AFTER_NS = NS_PER_S
"""An output that has waited this long for its device is reported as refused (cause "away")."""
AWAY_REPORTED = -1


class OutputWriter:
    """The writer of wanted values to the devices. `tick` starts writes and never waits for their end."""

    def __init__(
        self,
        outputs: list[Output],
        tags: TagTable,
        audit: AuditLog,
        allow_writes: bool,
        read_only: Collection[str] = (),
    ) -> None:
        """`read_only` names the buses to whose devices nothing is written although `allow_writes` is set."""
        self.outputs = outputs
        self._groups = groups_of(outputs)
        self._group_of = {output.tag: group for group in self._groups for output in group.outputs}
        self.allow_writes = allow_writes
        self._read_only = frozenset(read_only)
        self.journal = Refusals(audit)
        """The journal of every write that did not reach its device, with its cause."""
        self.writes = self.refusals = self.failures = self.rewrites = self.superseded = 0
        """Counters of writes. `superseded` counts values of programs that a newer value replaced before they were written."""
        self.safe_active = False
        self._tags = tags
        self._audit = audit
        self.now_ns = 0

    def want(self, tag: str, value: float) -> None:
        """Take the PLC's command `value` for `tag`.

        A value that cannot be written is refused immediately, because a newer value may replace it before it would be written."""
        for output in self.outputs:
            if output.tag == tag and (output.wanted != value or output.by != "plc" or output.not_a_number):
                self._command(output, value)

    def _command(self, output: Output, value: float) -> None:
        unwritten = output.by == "plc" and output.wanted is not None and output.held != output.wanted
        self.superseded += unwritten and output.refused != (output.wanted, output.by) and not output.pending
        output.wanted, output.by, output.not_a_number = value, "plc", False
        output.waits_since_ns = None
        try:
            self._check_allowed(output)
            output.driver.command(output.local, value)
        except NotAllowed as e:
            self._refuse(output, value, e)
        else:
            self.journal.settle(output.tag)

    def want_no_number(self, tag: str) -> None:
        """Handle an output that a program set to NaN: the device keeps its value."""
        for output in self.outputs:
            if output.tag == tag and not output.not_a_number:
                output.not_a_number, output.by = True, "plc"
                error = NotAllowed(f"{output.local}: not a number", expected="a finite number", got="nan")
                self._note(output, "nan", RefusalCause.LIMIT, error, "plc")
                self.refusals += 1

    def is_in_group(self, tag: str) -> bool:
        """Return whether a tag is written only together with the other tags of its group."""
        return tag in self._group_of

    def request(self, tag: str, value: float, by: str, done: Callable[[FieldtwinError | None], None]) -> None:
        """Write a tag once for a client (`by`); the tag must not be one that the PLC commands. `done` is called with
        the result.

        While the outputs are in their safe state, those that have a safe value keep it. Every write that is not carried out is
        recorded in the journal and in the audit log.
        """
        output = next((o for o in self.outputs if o.tag == tag), None)
        where = output.driver.config.where if output is not None else tag
        cause, error = self._turned_away(output, tag, where)
        if output is None or error is not None:
            assert error is not None
            self.refusals += 1
            if output is not None:
                self._note(output, value, cause, error, by)
            else:
                self.journal.note(tag.partition(".")[0], tag, value, cause, str(error), by, self.now_ns)
            done(error)
        else:
            output.wanted, output.by, output.asked = value, by, done
            self._start(output, value)

    def _turned_away(self, output: Output | None, tag: str, where: str) -> tuple[RefusalCause, FieldtwinError | None]:
        """Return the cause and the error if a client's write of a tag must not be started; the error is None if it may start."""
        if output is None or output.by == "plc":
            return RefusalCause.NOT_WRITABLE, NotAllowed(f"{tag} cannot be commanded by this client", where=where)
        if output.tag in self._group_of:
            group = self._group_of[output.tag].name
            return RefusalCause.NOT_WRITABLE, NotAllowed(f"{tag} is written with its group {group!r} only", where=where)
        if self.safe_active and output.safe is not None:
            return RefusalCause.NOT_NOW, EndpointBusy("the outputs are in their safe state", where=where)
        if output.pending or self.now_ns < output.next_try_ns:
            return RefusalCause.NOT_NOW, EndpointBusy("another write has just been made, or is under way", where=where)
        if not output.ready:
            wrong = output.driver.identity_error
            if wrong:
                return RefusalCause.WRONG_DEVICE, Unreachable(f"writes are blocked: {wrong}", where=where)
            return RefusalCause.AWAY, Unreachable("the device does not answer", where=where)
        return RefusalCause.NOT_NOW, None

    def make_safe(self, why: str) -> None:
        """Command every output's safe value; outputs without one keep their value."""
        self.safe_active = True
        for output in self.outputs:
            if output.safe is not None:
                output.wanted, output.by = output.safe, f"{SAFE}{why}"

    def release(self) -> None:
        """Follow the PLC's commands again.

        The gateway stops writing an output that no program writes. An output that a program writes keeps its safe value until the
        program has started.
        """
        self.safe_active = False
        for output in self.outputs:
            if not output.commanded and output.by.startswith(SAFE):
                output.wanted, output.by = None, ""

    def restated(self, driver: DeviceDriver, held: Mapping[str, bytes]) -> None:
        """Apply the new configuration of a driver's device.

        `held` maps each tag to the bytes that were sent for the value that the device holds. A value that would now be sent as
        different bytes is written again. Values that were refused may be allowed now.
        """
        for output in self.outputs:
            if output.driver is not driver:
                continue
            output.safe, output.refused = driver.config.safe.get(output.local), None
            if self.safe_active and output.safe is not None and output.by.startswith(SAFE):
                output.wanted = output.safe
            # This includes tags that may no longer be written: the wanted value is then refused, and the refusal is
            # recorded.
            if output.tag in held and as_sent(output) != held[output.tag]:
                output.held = None

    def as_sent(self, driver: DeviceDriver) -> dict[str, bytes]:
        """Return the values that a device's outputs hold, by tag, as the bytes that were sent."""
        return {o.tag: as_sent(o) for o in self.outputs if o.driver is driver and o.held is not None}

    def forget(self, driver: DeviceDriver) -> None:
        """Forget the values that a lost device held, because they are unknown after its return."""
        for output in self.outputs:
            if output.driver is driver:
                output.held, output.untouched = None, False

    @property
    def settled(self) -> bool:
        """Return whether no write is under way, and every output that can be written has its wanted value."""
        return not any(
            o.pending or (o.wanted is not None and o.held != o.wanted and self._possible(o)) for o in self.outputs
        )

    def _possible(self, output: Output) -> bool:
        return output.ready and output.refused != (output.wanted, output.by) and not self.held_back(output)

    def held_back(self, output: Output) -> bool:
        """Return whether the output has to wait with its group, because the group may not be written or is in its safe
        state."""
        group = self._group_of.get(output.tag)
        if group is None or output.by.startswith(SAFE):
            return False
        return not group.by_programs or group.obstacle is not None

    def tick(self, now_ns: int) -> None:
        """Start the writes that are due now."""
        self.now_ns = now_ns
        due: list[tuple[Output, float]] = []
        unread: set[object] = set()
        """Outputs that wait for the first reading of their device, and their frames."""
        for output in self.outputs:
            if output.wanted is None or output.pending:
                continue
            self._compare_with_device(output, now_ns)
            if output.untouched and output.ready and self._waits_for_reading(output):
                unread |= {output.tag, output.frame}
                continue
            if output.tag in self._group_of and not output.by.startswith(SAFE):
                continue  # written with its group, below
            if output.held == output.wanted or output.refused == (output.wanted, output.by):
                output.waits_since_ns = None
            elif not output.ready:
                self._wait(output, output.wanted)
            elif now_ns >= output.next_try_ns:
                output.waits_since_ns = None
                due.append((output, output.wanted))
        waiting = self._waiting_frames(now_ns) | unread if due else set()
        for output, value in due:
            if output.frame is None or output.frame not in waiting:
                self._start(output, value)
        for group in self._groups:
            if unread.isdisjoint(output.tag for output in group.outputs):
                self._tick_group(group)

    @property
    def is_idle(self) -> bool:
        """Return whether `tick` does nothing at any time until a command, a device or a value changes."""
        return all(map(self._rests, self.outputs))  # as a generator, it takes twice the time

    def _rests(self, output: Output) -> bool:
        """Return whether nothing is to be written, or the device holds the wanted value and nothing that it reported since then
        has to be compared.
        """
        if output.wanted is None or output.pending:
            return True
        if output.untouched or output.held != output.wanted:
            return False
        current = self._tags.held(output.tag)
        return current is output.compared or self._says_nothing(output, current)

    def _says_nothing(self, output: Output, current: TagValue) -> bool:
        """Return whether a reading does not show which value the device holds after the last write."""
        return current.t_ns <= output.held_since_ns + output.settle_ns or current.quality is Quality.BAD

    def _waits_for_reading(self, output: Output) -> bool:
        """Return whether the first write has to wait until the device was read. A value that the device already holds
        is not written again."""
        current = self._tags.current(output.tag, self.now_ns)
        if waits_for_reading(output, current, self.now_ns):
            return True
        output.untouched = False
        if output.wanted is not None and is_known(output, current) and self._may(output):
            sent = output.driver.command(output.local, output.wanted).data
            if int.from_bytes(current.raw) == int.from_bytes(sent):
                output.held, output.held_since_ns, output.compared = output.wanted, self.now_ns, current
        return False

    def _may(self, output: Output) -> bool:
        """Return whether the wanted value may be written. If not, it is refused even if the device already holds it."""
        try:
            self._check(output)
            output.driver.command(output.local, output.wanted or 0.0)
        except NotAllowed:
            return False
        return output.refused != (output.wanted, output.by)

    def _tick_group(self, group: OutputGroup) -> None:
        """Write a group whose device does not hold the values that its programs want, or hold the whole group back."""
        differing = group.differing()
        if not differing or not group.by_programs or any(o.pending for o in group.outputs):
            return
        obstacle = group.obstacle
        if obstacle is not None:
            self._hold_back(group, differing, *obstacle)
        elif not all(o.ready for o in group.outputs):
            for output in differing:
                assert output.wanted is not None
                self._wait(output, output.wanted)
        elif self.now_ns >= max(o.next_try_ns for o in group.outputs):
            self._start_group(group)

    def _hold_back(self, group: OutputGroup, differing: list[Output], culprit: Output, why: str) -> None:
        held = [o for o in differing if o is not culprit and o.refused != (o.wanted, o.by)]
        reported = (culprit.tag, why, *((o.tag, o.wanted) for o in held))
        if reported == group.reported:
            return
        group.reported = reported
        for output in held:
            error = NotAllowed(f"held back: {why}, and the group {group.name!r} is written whole or not at all")
            self._note(output, output.wanted, RefusalCause.GROUP, error, output.by)

    def _start_group(self, group: OutputGroup) -> None:
        """Check every member, then record every member, then write them all."""
        commands, group.reported = [], ()
        wanted = {output.tag: output.wanted for output in group.outputs if output.wanted is not None}
        for output in group.outputs:
            try:
                self._check(output)
                commands.append(output.driver.command(output.local, wanted[output.tag]))
            except NotAllowed as e:
                self._refuse(output, wanted[output.tag], e)
                return
        for output in group.outputs:
            old = self._tags.current(output.tag, self.now_ns).value
            if not self._on_record(output, output.driver.config.name, old, wanted[output.tag]):
                return
        by = {output.tag: output.by for output in group.outputs}
        for output in group.outputs:
            output.pending, output.untouched, output.waits_since_ns = True, False, None
        members = {output.local: output for output in group.outputs}

        def ended(local: str, error: FieldtwinError | None) -> None:
            output = members[local]
            self._done(output, wanted[output.tag], by[output.tag], error)

        first = group.outputs[0]
        first.bus.write(first.driver.config.name, list(zip(members, commands, strict=True)), ended)

    def _wait(self, output: Output, value: float) -> None:
        """Note that the device accepts no write now. An output that has waited for `AWAY_AFTER_NS` is reported once."""
        since_ns = output.waits_since_ns
        if since_ns is None:
            output.waits_since_ns = self.now_ns
        elif since_ns != AWAY_REPORTED and self.now_ns - since_ns >= AWAY_AFTER_NS:
            output.waits_since_ns = AWAY_REPORTED
            config, wrong = output.driver.config, output.driver.identity_error
            if wrong:
                error: FieldtwinError = NotAllowed(f"writes are blocked: {wrong}", where=config.where)
                self._note(output, value, RefusalCause.WRONG_DEVICE, error, output.by)
            else:
                error = Unreachable(
                    "the device accepts no writes now; the value is written when it does", where=config.where
                )
                self._note(output, value, RefusalCause.AWAY, error, output.by)

    def _waiting_frames(self, now_ns: int) -> set[object]:
        """Return the frames that contain an output that has to wait.

        The other outputs of such a frame wait too, so that the commands of one scan are sent together."""
        waits = [o for o in self.outputs if o.pending or now_ns < o.next_try_ns]
        return {o.frame for o in waits if o.frame is not None}

    def _compare_with_device(self, output: Output, now_ns: int) -> None:
        """Write a value again if the device reads back a different value, because it lost the commanded one (a restart).

        The bytes as sent are compared, because a device that holds the rounded value holds the commanded value.
        """
        current = self._tags.current(output.tag, now_ns)
        if current is output.compared:
            return  # the device has reported nothing new about it
        if output.held is None or self._says_nothing(output, current):
            return
        if int.from_bytes(current.raw) != int.from_bytes(as_sent(output)):
            output.held = None
            self.rewrites += 1
        else:
            output.compared = current

    def _start(self, output: Output, value: float) -> None:
        name = output.driver.config.name
        old = self._tags.current(output.tag, self.now_ns).value
        try:
            self._check(output)
            command = output.driver.command(output.local, value)
        except NotAllowed as e:
            self._refuse(output, value, e)
            output.answer(e)
            return
        if not self._on_record(output, name, old, value):
            output.answer(Unreachable("the write could not be recorded in the audit log", where=name))
            return
        output.pending, output.untouched = True, False
        by = output.by
        output.bus.write(name, [(output.local, command)], lambda local, error: self._done(output, value, by, error))

    def _refuse(self, output: Output, value: float, error: NotAllowed) -> None:
        """Refuse a value that may not be written. It is not tried again until a different value is wanted."""
        output.refused = (value, output.by)
        self.refusals += 1
        self._note(output, value, self._cause(output), error, output.by)

    def _cause(self, output: Output) -> RefusalCause:
        """Return why a check refused a value of this output."""
        if not self._may_write(output):
            return RefusalCause.READ_ONLY
        if output.local not in output.driver.config.writable:
            return RefusalCause.NOT_WRITABLE
        return RefusalCause.WRONG_DEVICE if output.driver.identity_error else RefusalCause.LIMIT

    def _note(
        self, output: Output, value: object, cause: RefusalCause, error: FieldtwinError, by: str, *, audit: bool = True
    ) -> None:
        name, old = output.driver.config.name, self._tags.current(output.tag, self.now_ns).value
        self.journal.note(
            name,
            output.tag,
            output.shown(value),
            cause,
            str(error),
            by,
            self.now_ns,
            old=output.shown(old),
            audit=audit,
        )

    def _on_record(self, output: Output, name: str, old: object, value: float) -> bool:
        """Record the write in the audit log before it is sent.

        If that fails, only a safe value is written; other writes are tried again later."""
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
        except Unreachable as e:
            self.failures += 1
            output.next_try_ns = self.now_ns + RETRY_NS
            self._note(output, value, RefusalCause.FAILED, e, output.by, audit=False)
            return self.safe_active and output.asked is None
        return True

    def _check(self, output: Output) -> None:
        self._check_allowed(output)
        if output.driver.identity_error:
            where = output.driver.config.where
            raise NotAllowed(f"writes are blocked: {output.driver.identity_error}", where=where)

    def _may_write(self, output: Output) -> bool:
        return self.allow_writes and output.driver.config.bus not in self._read_only

    def _check_allowed(self, output: Output) -> None:
        """Raise `NotAllowed` if the configuration forbids the write, independently of the device."""
        where = output.driver.config.where
        if not self._may_write(output):
            raise NotAllowed("this plant is read-only", where=where, hint="start with --allow-writes")
        if output.local not in output.driver.config.writable:
            raise NotAllowed(f"{output.tag} is not marked writable in the system file", where=where)

    def _done(self, output: Output, value: float, by: str, error: FieldtwinError | None) -> None:
        """Handle the end of a write of `value` that `by` requested. A different source may command the output now."""
        output.pending = False
        output.next_try_ns = self.now_ns + (MIN_SPACING_NS if error is None else RETRY_NS)
        if error is None:
            self.writes += 1
            output.held, output.held_since_ns = value, self.now_ns
            if not output.read_back and output.tag in self._tags:
                # the last reading is older than the write, and no newer reading will follow
                self._tags.put_bad([output.tag], Reason.STALE)
            self.journal.settle(output.tag)
        else:
            self.failures += 1
            self._note(output, value, cause_of(error), error, by, audit=False)
            output.driver.consumer.queue.clear()  # the failed command must not be repeated ahead of a newer command
        result = "done" if error is None else f"failed: {error}"
        try:
            self._audit.note(
                "write", output.driver.config.name, by=by, result=result, tag=output.tag, new=output.shown(value)
            )
        except Unreachable:
            self.failures += 1  # the missing record is counted, and the next write does not start without a record
        output.answer(error)
