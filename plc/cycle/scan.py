"""The scan of one task: read the input image once, execute the task's programs, publish the output image once.

Each scan uses one consistent snapshot and one time, which does not change during the scan. `Scan.execute(now_ns)` is given the
time, and uses only the image and the programs. This module must not depend on a clock, a cycle time, a process or a protocol.

When the gateway's heartbeat in the image is older than its limit, or its region is flagged stopped, every input is BAD /
GATEWAY_DEAD, even if the image shows a better quality. For a BAD input the input's policy decides what the program sees
(`InputBinding.if_bad`). A forced input is always SIMULATED. Messages are events, not states: they are passed on unchanged, in
order and exactly once, independently of the quality of their tag.

A program that has not started (fieldtwin.plc.cycle.start) is not executed, and its outputs and locals are published without a
value. Messages wait while a program that takes messages has not started.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from fieldtwin.gateway.core.clock import NS_PER_MS
from fieldtwin.gateway.core.errors import FieldtwinError, FileInvalid
from fieldtwin.gateway.core.image.image import INPUTS, Image, Message, Snapshot, TagKind, TagSpec
from fieldtwin.gateway.core.values import NEVER, Quality, Reason, Scalar, TagValue
from fieldtwin.plc.binding import BoundProgram, InputBinding, substitute
from fieldtwin.plc.cycle.publishing import OutputImage, find
from fieldtwin.plc.cycle.skipping import Settling
from fieldtwin.plc.cycle.start import ProgramStart
from fieldtwin.plc.program import (
    InputTripped,
    Program,
    ProgramFailed,
    ProgramStuck,
    Role,
    ScanInfo,
    ScanStuck,
    ScanTooLong,
    Variable,
    within_import_path,
)

_BAD = int(Quality.BAD)
MAX_SHOWN, MAX_SHOWN_BYTES = 4, 24
"""How many of the messages that a scan read, and how many bytes of each, are recorded with a change that the scan made."""


class _Input:
    """One bound input: its index in the image, its variable in the program, and its policy while it is BAD."""

    def __init__(
        self, owner: str, program: Program, variable: Variable, spec: TagSpec, index: int, binding: InputBinding
    ) -> None:
        self.owner = owner
        self.namespace = program.__dict__
        self.name = variable.name
        self.tag = spec.name
        self.index = index
        self.message = variable.kind is TagKind.MESSAGE
        self.widen = variable.kind is TagKind.REAL and spec.kind is TagKind.INT
        self.hold = binding.if_bad == "hold"
        self.trip = binding.if_bad == "trip"
        self.known: Scalar | None = None
        """The last value that was not BAD; None before the first one. An input can trip only after it had such a value."""
        self.substitute = substitute(spec, binding.if_bad)
        self.held: tuple[Scalar | None, int] | None = None

    def apply(self, seen: TagValue) -> TagValue:
        """Return the value that the program sees instead of `seen`, by the policy of the input."""
        if seen.quality is not Quality.BAD:
            return seen
        if self.substitute is not None:
            return TagValue(self.substitute, Quality.SUBSTITUTED, seen.reason, seen.t_ns)
        if self.hold and self.held is not None:
            return TagValue(self.held[0], Quality.UNCERTAIN, seen.reason, self.held[1])
        if seen.value is None and self.known is not None:  # a restarted gateway has not read it yet
            return TagValue(self.known, seen.quality, seen.reason, seen.t_ns)
        return seen


class Scan:
    """The programs of one task over an attached image.

    `outputs` is the output image of all tasks; without it, the scan creates an output image for its programs. With
    `outputs_first`, a scan begins by publishing what the previous scan computed, so that outputs change at the start of the
    cycle, however long the logic runs. `starts` determines by name which programs may run; without it all may run. `may_skip`
    allows skipping the logic of a scan that would change nothing; the programs must share no data with other tasks. After a
    restart of the process, messages continue after the last message that OUTPUTS reports as consumed. Raises `FileInvalid` when
    a binding's tag is not in the image.
    """

    def __init__(
        self,
        image: Image,
        programs: Sequence[BoundProgram],
        heartbeat_limit_ms: float,
        outputs: OutputImage | None = None,
        *,
        outputs_first: bool = False,
        starts: Mapping[str, ProgramStart] | None = None,
        may_skip: bool = False,
    ) -> None:
        self.number = 0
        """How many scans were executed, including the one that runs."""
        self._not_run: list[tuple[BoundProgram, ProgramStart]] = []
        """The programs that have not executed a scan yet, with their start conditions."""
        self._waiting: frozenset[str] = frozenset()
        """The names of the programs that had not started at the last check."""
        self.gateway_alive = False
        self.output_image = outputs or OutputImage(image, programs)
        self._outputs_first = outputs_first
        self._limit_ns = int(heartbeat_limit_ms * NS_PER_MS)
        self._programs = tuple(programs)
        self._reader = image.reader(INPUTS)
        self._onlooker = image.reader(INPUTS)
        """Reads INPUTS while messages must not be consumed."""
        if starts is not None:
            self._not_run = [(bound, starts[bound.name]) for bound in programs]
        self._plain: list[_Input] = []
        self._messages: list[_Input] = []
        self._between: list[tuple[dict[str, Any], Variable, str]] = []
        self._seen: dict[str, Callable[[], dict[str, Scalar | None]]] = {}
        for bound in programs:
            self._bind_inputs(bound)
        self._settling = Settling(programs if may_skip else (), _state_of)
        self.skipped = 0
        """How many scans did not execute the logic, because it would have changed nothing."""
        self._held = [item for item in self._plain if item.hold]
        self._deciding = sorted({item.index for item in self._plain} | self.output_image.taken_indexes)
        """The indexes in INPUTS on which the logic depends."""
        self._steady = False
        """Whether the inputs of the last scan were those of the scan before."""
        self._columns: Sequence[Scalar | None] = []
        """The values of INPUTS that the last scan read. They are the same object as long as only a time changed."""
        self._given = ""
        """The inputs of the programs with qualities and reasons, and the counters of taken messages, of the last scan."""
        self._by_tag: dict[str, list[_Input]] = {}
        for item in self._plain:
            self._by_tag.setdefault(item.tag, []).append(item)
        for item in self._messages:
            self.output_image.reads(item.tag, self._reader)
        self._snapshot = self._reader.latest

    def _bind_inputs(self, bound: BoundProgram) -> None:
        shape, own = self._reader.shape, {}
        for variable in bound.variables(Role.INPUT):
            binding = bound.inputs.get(variable.name)
            if binding is None and not variable.needs_tag:
                continue
            if binding is None:
                raise FileInvalid(f"input {variable.name!r} of program {bound.name} is bound to no tag")
            if binding.tag not in shape.index and binding.tag in self.output_image.writer.shape.index:
                self._between.append((bound.program.__dict__, variable, binding.tag))
                continue
            spec, index = find(shape, binding.tag)
            item = _Input(bound.name, bound.program, variable, spec, index, binding)
            (self._messages if item.message else self._plain).append(item)
            own[variable.name] = item
        namespace, names = bound.program.__dict__, [v.name for v in bound.variables(Role.INPUT) if not v.hidden]
        self._seen[bound.name] = lambda: {
            name: _as_text(value) if isinstance(value := namespace[name], tuple) else value for name in names
        }
        others = {v.name: tag for space, v, tag in self._between if space is namespace}

        def lookup(name: str) -> TagValue:
            if name in others:
                value = self.output_image.current(others[name])
                forced = others[name] in self.output_image.forces.outputs
                if value is None and not forced:
                    return NEVER
                return TagValue(value, Quality.SIMULATED if forced else Quality.GOOD)
            return own[name].apply(self._looked_up(own[name])) if name in own else NEVER

        bound.program._lookup = lookup

    # -- the cycle ----------------------------------------------------------------------------------------------

    def execute(self, now_ns: int) -> None:
        """Execute one scan at `now_ns` (monotonic, the same clock as the gateway's).

        If it raises `ProgramFailed`, nothing is published.
        """
        self.number += 1
        if self._outputs_first:
            self.output_image.publish(now_ns)
        if self._not_run:
            self._execute_started(now_ns)
        elif self._is_skipped(now_ns):
            self.skipped += 1
        else:
            self.output_image.force()
            info = ScanInfo(now_ns, self.number, self.number == 1)
            for bound in self._programs:
                _run(bound, info)
            self.output_image.collect(now_ns, self.number, self._seen)
            if self._steady:
                self._settling.executed(now_ns, same_outputs=self.output_image.same)
        if not self._outputs_first:
            self.output_image.publish(now_ns)

    def _is_skipped(self, now_ns: int) -> bool:
        """Read the inputs, and return whether the logic need not be executed, because it would change nothing."""
        settling, forces = self._settling, self.output_image.forces
        snapshot = self._reader.snapshot()
        forced = bool(forces.inputs or forces.outputs)
        given = self._given
        if settling.possible and snapshot.values is not self._columns:
            given = repr([(snapshot.values[at], snapshot.qualities[at], snapshot.reasons[at]) for at in self._deciding])
        same = given == self._given and not forced and not snapshot.messages
        if settling.settled and same and self._is_alive(snapshot, now_ns):
            self._columns = snapshot.values
            self._keep(snapshot)
            self.gateway_alive = True
            return True
        self._take(snapshot, now_ns)
        if not settling.possible:
            return False
        self._steady = self.gateway_alive and same
        self._columns, self._given = snapshot.values, given
        if not self._steady:
            settling.disturbed()
        return settling.settled

    def may_skip(self, *, skip: bool) -> None:
        """Determine whether a scan that would change nothing may be skipped from now on."""
        self._settling = Settling(self._programs if skip else (), _state_of)
        self._steady = False  # else a scan without programs to compare would count as one that changed nothing

    def programs_changed(self) -> None:
        """Execute the logic of the next scan in any case, because programs of this task were replaced."""
        self._settling.disturbed()

    def repeats_until(self, until_ns: int) -> bool:
        """Return whether every scan before `until_ns` would skip the logic, and publish what the last scan did, see
        `fieldtwin.gateway.core.concurrency.cycle.Cycle`.
        """
        latest = self._reader.latest
        return (
            self._reader.repeats
            and self._settling.settled
            and not self._not_run
            and self.gateway_alive
            and until_ns - latest.t_ns <= self._limit_ns
            and latest.values is self._columns
            and self.output_image.repeats
            and not self.output_image.forces.inputs
        )

    def skip(self, count: int, last_ns: int) -> None:
        """Count scans that do not take place, see `Cycle`."""
        self.number += count
        self.skipped += count
        self._snapshot = self._reader.snapshot()
        if self._held:
            self._keep(self._snapshot)
        self.output_image.writer.skip(count, last_ns)

    def _keep(self, snapshot: Snapshot) -> None:
        """Keep a snapshot that changes no input of the logic."""
        self._snapshot = snapshot
        for item in self._held:
            if snapshot.qualities[item.index] != _BAD:
                item.held = snapshot.values[item.index], snapshot.time_ns(item.index)

    def _execute_started(self, now_ns: int) -> None:
        """Execute a scan while some programs have not started, or just have started. Only started programs run."""
        waiting = self._read_for_started(now_ns)
        self.output_image.force()
        first = {bound.name: start for bound, start in self._not_run if start.started}
        for bound in self._programs:
            if bound.name not in waiting:
                _run(bound, ScanInfo(now_ns, self.number, bound.name in first))
        for start in first.values():
            start.ran = True
        seen = {name: of for name, of in self._seen.items() if name not in waiting}
        self.output_image.collect(now_ns, self.number, seen)
        self._not_run = [(bound, start) for bound, start in self._not_run if not start.ran]

    def _read_for_started(self, now_ns: int) -> frozenset[str]:
        """Read the inputs, and return the names of the programs that still wait for their start.

        Messages are not consumed while a program that takes messages waits."""
        waiting = self._waiting = frozenset(bound.name for bound, start in self._not_run if not start.started)
        held_back = any(item.owner in waiting for item in self._messages)
        self._take((self._onlooker if held_back else self._reader).snapshot(), now_ns)
        if held_back:
            for item in self._messages:
                item.namespace[item.name] = ()
        return waiting

    @property
    def waiting(self) -> bool:
        """Return whether none of the programs has started."""
        return len(self._not_run) == len(self._programs) > 0 and not any(start.started for _, start in self._not_run)

    def hold(self, now_ns: int) -> None:
        """Publish without a scan, while the task is paused or all of its programs wait for their start.

        Inputs are read without consuming messages; outputs keep their values and are still published. A force also
        applies while the program waits.
        """
        if self.waiting:
            self._read_for_started(now_ns)
            self.output_image.publish_forces()
        else:
            self._snapshot = self._onlooker.snapshot()
            self.gateway_alive = self._is_alive(self._snapshot, now_ns)
        self.output_image.publish(now_ns)

    def stop(self, now_ns: int) -> None:
        """Publish OUTPUTS flagged as stopped, so that its readers ignore it: every tag is BAD, and its value is unchanged."""
        self.output_image.stop(now_ns)

    def release(self) -> None:
        self._reader.release()
        self._onlooker.release()

    def _is_alive(self, snapshot: Snapshot, now_ns: int) -> bool:
        return snapshot.counter > 0 and now_ns - snapshot.t_ns <= self._limit_ns and not snapshot.stopped

    def _take(self, snapshot: Snapshot, now_ns: int) -> None:
        """Set the inputs of the programs from `snapshot`."""
        self._snapshot = snapshot
        alive = self.gateway_alive = self._is_alive(snapshot, now_ns)
        values, qualities = snapshot.values, snapshot.qualities
        for item in self._plain:
            if alive and qualities[item.index] != _BAD:
                value = values[item.index]
                if item.hold:
                    item.held = value, snapshot.time_ns(item.index)
                item.known = value
            else:
                value = self._bad(item)
            if item.widen and value is not None:
                value = float(value)
            item.namespace[item.name] = value
        forced = self.output_image.forces.inputs
        if forced:
            for item in self._plain:
                if item.tag in forced:
                    value = forced[item.tag].value
                    item.namespace[item.name] = float(value) if item.widen else value
        if self._between:
            self._read_other_programs()
        messages = snapshot.messages
        for item in self._messages:
            item.namespace[item.name] = messages.get(item.tag, ()) if messages else ()
        self.output_image.room(values)

    def _read_other_programs(self) -> None:
        for namespace, variable, tag in self._between:
            value = self.output_image.current(tag)
            namespace[variable.name] = float(value) if variable.kind is TagKind.REAL and value is not None else value

    def _bad(self, item: _Input) -> Scalar | None:
        seen = self._seen_at(item.index)
        tripped = item.trip and item.known is not None and item.owner not in self._waiting
        if tripped and item.tag not in self.output_image.forces.inputs:
            raise InputTripped(item.owner, f"an input that must not be bad is: {seen.reason}", variable=item.tag)
        return item.apply(seen).value

    # -- data for displays --------------------------------------------------------------------------------------

    def _seen_at(self, index: int) -> TagValue:
        value = self._snapshot.value(index)
        if self.gateway_alive:
            return value
        return TagValue(value.value, Quality.BAD, Reason.GATEWAY_DEAD, value.t_ns)

    def _looked_up(self, item: _Input) -> TagValue:
        force = self.output_image.forces.inputs.get(item.tag)
        if force is not None:
            return TagValue(force.value, Quality.SIMULATED, t_ns=force.since_ns)
        return self._seen_at(item.index)

    def value(self, tag: str) -> Scalar | None:
        """Return the value of a tag of INPUTS or OUTPUTS as of the last scan; None for an input that is bad."""
        index = self._reader.shape.index.get(tag)
        if index is not None:
            force = self.output_image.forces.inputs.get(tag)
            seen = self._seen_at(index)
            return force.value if force else None if seen.quality is Quality.BAD else seen.value
        return self.output_image.last().get(tag)

    def inputs(self) -> dict[str, TagValue]:
        """Return every tag of INPUTS as the last scan read it, before substitution and forces: all BAD while the
        gateway is dead."""
        return {name: self._seen_at(i) for name, i in self._reader.shape.index.items()}

    def substituted_values(self, tag: str) -> dict[str, TagValue]:
        """Return the variables (``program.variable``) whose value differs from that of input `tag`.

        They differ because the input is bad and the policy of the variable replaces its value."""
        found: dict[str, TagValue] = {}
        for item in self._by_tag.get(tag, ()):
            there = self._looked_up(item)
            seen = item.apply(there)
            if seen is not there:
                found[f"{item.owner}.{item.name}"] = seen
        return found

    def input(self, tag: str) -> TagValue:
        """Return a tag of INPUTS as the last scan read it, before substitution and forces: BAD while the gateway is
        dead."""
        return self._seen_at(self._reader.shape.index[tag])

    def outputs(self) -> dict[str, Scalar | None]:
        """Return every tag of OUTPUTS as published by the last successful scan.

        The value of a message tag is its last sequence number.
        """
        return self.output_image.last()

    def counters(self) -> dict[str, int]:
        """Return the numbers of messages missed on input, of messages refused on output, and of failed reads of the image."""
        return {
            "messages_missed": sum(self._reader.missed.values()),
            "mailbox_waits": sum(outbox.waits for _, outbox in self.output_image.outboxes),
            "image_retries": self._reader.retries,
            "image_gave_up": self._reader.gave_up,
            "scans_skipped": self.skipped,
        }


def _run(bound: BoundProgram, info: ScanInfo) -> None:
    """Execute one scan of a program. Raises `ProgramFailed` if the program raises an error."""
    try:
        bound.program.execute(info)
    except (Exception, SystemExit, ScanStuck) as e:  # the logic is the user's: any error that it raises stops the task
        raise failed(bound, e) from e


def _state_of(bound: BoundProgram, now_ns: int) -> Any:
    """Return the whole state of a program. Raises `ProgramFailed` if the program raises an error."""
    try:
        return bound.program.whole_state(now_ns)
    except Exception as e:  # a program in Python may describe its state itself
        raise failed(bound, e) from e


def _as_text(messages: tuple[Message, ...]) -> str | None:
    """Return the messages that a scan took, in hex and shortened, for display; None if there were none."""
    shown = [m.data[:MAX_SHOWN_BYTES].hex() + ("..." if len(m.data) > MAX_SHOWN_BYTES else "") for m in messages]
    more = [f"{len(shown) - MAX_SHOWN} more"] if len(shown) > MAX_SHOWN else []
    return ", ".join(shown[:MAX_SHOWN] + more) or None


def failed(bound: BoundProgram, error: BaseException) -> ProgramFailed:
    """Return `error` as a `ProgramFailed` with program and line: the innermost line in the program's files, else of the
    traceback.
    """
    made = type(bound.program)
    own = made.source_files or (getattr(sys.modules.get(made.__module__), "__file__", None),)
    path, line, inside = "", 0, False
    tb = error.__traceback__
    while tb is not None:
        here = tb.tb_frame.f_code.co_filename
        if here in own or not inside:
            path, line, inside = here, tb.tb_lineno, here in own
        tb = tb.tb_next
    # the error is in the conversion of inputs or outputs, not in a line that the user wrote
    if made.source_path and not inside:
        path, line = made.source_path, 0
    if isinstance(error, ScanStuck | ScanTooLong):
        reason = error.message if isinstance(error, ScanTooLong) else str(error)
        return ProgramStuck(bound.name, f"the scan did not end: {reason}", path=within_import_path(path), line=line)
    text = error.message if isinstance(error, FieldtwinError) else str(error)
    return ProgramFailed(bound.name, f"{type(error).__name__}: {text}", path=within_import_path(path), line=line)
