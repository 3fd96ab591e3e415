"""The scan: read the input image once, execute the programs, publish the output image once.

One consistent snapshot and one frozen time a scan. Pure: `Scan.execute(now_ns)` is told the time, touches the image
and the programs, and nothing else. It must never know a clock, a cycle, a process or a protocol.

When the gateway's heartbeat in the image is older than its limit, or its region says stopped, every input is BAD /
GATEWAY_DEAD, whatever quality the image shows. Then, and for every input that is BAD by itself, the input's policy
says what the program sees (`InputBinding.if_bad`). Messages are events, not states: they are handed over whole, in
order, exactly once, whatever the quality of their tag.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence

from gateway.core.clock import NS_PER_MS
from gateway.core.errors import FieldtwinError, FileInvalid
from gateway.core.image import (
    INPUTS,
    OUTPUTS,
    Image,
    NotEncodable,
    RegionFlag,
    RegionShape,
    TagKind,
    TagSpec,
    consumed_name,
    taken_name,
)
from gateway.core.values import Quality, Reason, Scalar, TagValue
from plc.binding import BoundProgram, InputBinding, substitute
from plc.program import Outbox, Program, ProgramFailed, Role, ScanInfo, Variable


class _Input:
    """One bound input: where it is in the image, where the program sees it, and what it sees while that is BAD."""

    def __init__(self, program: Program, variable: Variable, spec: TagSpec, index: int, binding: InputBinding) -> None:
        self.namespace = program.__dict__
        self.name = variable.name
        self.tag = spec.name
        self.index = index
        self.message = variable.kind is TagKind.MESSAGE
        self.widen = variable.kind is TagKind.REAL and spec.kind is TagKind.INT
        self.hold = binding.if_bad == "hold"
        self.substitute = substitute(spec, binding.if_bad)
        self.held: tuple[Scalar | None, int] | None = None

    def apply(self, seen: TagValue) -> TagValue:
        """What the program sees in place of `seen`."""
        if seen.quality is not Quality.BAD:
            return seen
        if self.substitute is not None:
            return TagValue(self.substitute, Quality.SUBSTITUTED, seen.reason, seen.t_ns)
        if self.hold and self.held is not None:
            return TagValue(self.held[0], Quality.UNCERTAIN, seen.reason, self.held[1])
        return seen


class _Output:
    """One published variable: where the program keeps it. `taken` is where INPUTS says how far its messages got."""

    def __init__(self, bound: BoundProgram, variable: Variable, spec: TagSpec, index: int) -> None:
        self.namespace = bound.program.__dict__
        self.name = variable.name
        self.owner = bound.name
        self.tag = spec.name
        self.index = index
        self.taken: int | None = None
        self.outbox: Outbox | None = None
        if spec.kind is TagKind.MESSAGE:
            box: Outbox = self.namespace[variable.name]
            box.max_bytes, box.depth = spec.max_bytes, spec.depth
            self.outbox = box


class Scan:
    """All programs of a task over an attached image. The only writer of OUTPUTS.

    After a restart of the process messages go on behind the last one that OUTPUTS says was consumed. Raises
    `FileInvalid` when a binding's tag is not in the image.
    """

    def __init__(self, image: Image, programs: Sequence[BoundProgram], heartbeat_limit_ms: float) -> None:
        self.number = 0
        """Scans executed, the one that runs included."""
        self.gateway_alive = False
        self._limit_ns = int(heartbeat_limit_ms * NS_PER_MS)
        self._programs = tuple(programs)
        self._reader = image.reader(INPUTS)
        self._writer = image.writer(OUTPUTS)
        self._plain: list[_Input] = []
        self._messages: list[_Input] = []
        self._outputs: list[_Output] = []
        self._outboxes: list[tuple[_Output, Outbox]] = []
        self._consumed: list[str] = []
        for bound in programs:
            self._bind_inputs(bound)
        self._bind_outputs()
        self._reals = [o.index for o in self._outputs if self._writer.shape.layout.tags[o.index].kind is TagKind.REAL]
        self._resume(image)
        self._values: list[Scalar | None] = [None] * len(self._outputs)
        self._values += [self._reader.seen(tag) for tag in self._consumed]
        self._snapshot = self._reader.latest

    # -- assembly -----------------------------------------------------------------------------------------------

    def _bind_inputs(self, bound: BoundProgram) -> None:
        shape, own = self._reader.shape, {}
        for variable in bound.variables(Role.INPUT):
            binding = bound.inputs.get(variable.name)
            if binding is None:
                raise FileInvalid(f"input {variable.name!r} of program {bound.name} is bound to no tag")
            spec, index = _find(shape, binding.tag)
            item = _Input(bound.program, variable, spec, index, binding)
            (self._messages if item.message else self._plain).append(item)
            own[variable.name] = item
        bound.program._lookup = lambda name: own[name].apply(self._seen(own[name].index))

    def _bind_outputs(self) -> None:
        shape = self._writer.shape
        made = {tag: (bound, variable) for bound in self._programs for variable, tag in bound.published()}
        for tag in made:
            _find(shape, tag)
        for index, spec in enumerate(shape.layout.tags):
            if spec.name not in made:
                if not spec.name.endswith(consumed_name("")):
                    raise FileInvalid(f"no program writes {spec.name}", expected=", ".join(sorted(made)))
                self._consumed.append(spec.name.removesuffix(consumed_name("")))
                continue
            if self._consumed:
                raise FileInvalid(f"{spec.name} stands behind the consumed tags", expected="a layout of process_image")
            bound, variable = made[spec.name]
            source = _Output(bound, variable, spec, index)
            self._outputs.append(source)
            if source.outbox is not None:
                source.taken = self._reader.shape.index.get(taken_name(spec.name))
                self._outboxes.append((source, source.outbox))

    def _resume(self, image: Image) -> None:
        """Learn from OUTPUTS what a process before this one consumed."""
        before = image.reader(OUTPUTS).snapshot()
        for tag in self._consumed:
            value = before.value(consumed_name(tag)).value
            self._reader.resume(tag, value if isinstance(value, int) else 0)

    # -- the cycle ----------------------------------------------------------------------------------------------

    def execute(self, now_ns: int) -> None:
        """One scan at `now_ns` (monotonic, the same clock as the gateway's). Raises `ProgramFailed`, publishing nothing."""
        self.number += 1
        self._read(now_ns)
        info = ScanInfo(now_ns, self.number, self.number == 1)
        for bound in self._programs:
            try:
                bound.program.execute(info)
            except (Exception, SystemExit) as e:  # the logic is the user's: whatever it raises stops the task
                raise _failed(bound, e) from e
        self._publish(now_ns)

    def stop(self, now_ns: int) -> None:
        """Publish that nothing in OUTPUTS may be acted upon any more: flagged stopped, every tag BAD, values as last."""
        self._writer.publish_columns(
            self._values, Quality.BAD, Reason.NOT_OPERATIONAL, now_ns, None, RegionFlag.STOPPED
        )

    def _read(self, now_ns: int) -> None:
        snapshot = self._snapshot = self._reader.snapshot()
        alive = self.gateway_alive = not snapshot.stopped and snapshot.age_ns(now_ns) <= self._limit_ns
        values, qualities = snapshot.values, snapshot.qualities
        for item in self._plain:
            if alive and qualities[item.index] != Quality.BAD:
                value = values[item.index]
                if item.hold:
                    item.held = value, snapshot.times_ns[item.index]
            else:
                value = item.apply(self._seen(item.index)).value
            if item.widen and value is not None:
                value = float(value)
            item.namespace[item.name] = value
        for item in self._messages:
            item.namespace[item.name] = snapshot.messages.get(item.tag, ())
        for output, outbox in self._outboxes:
            taken = values[output.taken] if output.taken is not None else 0
            outbox.outstanding = self._writer.last_sequence(output.tag) - (taken if isinstance(taken, int) else 0)

    def _publish(self, now_ns: int) -> None:
        values = [output.namespace[output.name] for output in self._outputs]
        for i in self._reals:
            if values[i] != values[i]:  # not a number must not reach a plant
                values[i] = None
        messages = {}
        for output, outbox in self._outboxes:
            if output.namespace[output.name] is not outbox:
                raise ProgramFailed(output.owner, "an outbox was overwritten; call its send()", variable=output.tag)
            values[output.index] = 0
            if outbox.pending:
                messages[output.tag] = outbox.pending
                outbox.pending = []
        values += [self._reader.seen(tag) for tag in self._consumed]
        try:
            self._writer.publish_columns(values, Quality.GOOD, Reason.NONE, now_ns, messages)
        except NotEncodable as e:
            owner = next((output.owner for output in self._outputs if output.tag == e.tag), "?")
            raise ProgramFailed(owner, f"{e.message}; expected {e.expected}; got {e.got}", variable=e.tag) from e
        self._values = values

    # -- what watchers see --------------------------------------------------------------------------------------

    def _seen(self, index: int) -> TagValue:
        value = self._snapshot.value(index)
        if self.gateway_alive:
            return value
        return TagValue(value.value, Quality.BAD, Reason.GATEWAY_DEAD, value.t_ns)

    def inputs(self) -> dict[str, TagValue]:
        """Every tag of INPUTS as the last scan found it, before substitution: all BAD while the gateway is dead."""
        return {name: self._seen(i) for name, i in self._reader.shape.index.items()}

    def outputs(self) -> dict[str, Scalar | None]:
        """Every tag of OUTPUTS as last published by a scan that succeeded; a message tag's last sequence."""
        shown = dict(zip(self._writer.shape.index, self._values, strict=True))
        return shown | {output.tag: self._writer.last_sequence(output.tag) for output, _ in self._outboxes}

    def counters(self) -> dict[str, int]:
        """Messages missed on the way in and refused on the way out, looks at the image that failed."""
        return {
            "messages_missed": sum(self._reader.missed.values()),
            "mailbox_waits": sum(outbox.waits for _, outbox in self._outboxes),
            "image_retries": self._reader.retries,
            "image_gave_up": self._reader.gave_up,
        }


def _find(shape: RegionShape, tag: str) -> tuple[TagSpec, int]:
    index = shape.index.get(tag)
    if index is None:
        raise FileInvalid(f"tag {tag} is not in the process image", expected=f"a tag of region {shape.layout.name}")
    return shape.layout.tags[index], index


def _failed(bound: BoundProgram, error: BaseException) -> ProgramFailed:
    """Which program, which line: the innermost line of the program's own file, else the innermost of all."""
    made = type(bound.program)
    own = made.source_path or getattr(sys.modules.get(made.__module__), "__file__", None)
    path, line, inside = "", 0, False
    tb = error.__traceback__
    while tb is not None:
        here = tb.tb_frame.f_code.co_filename
        if here == own or not inside:
            path, line, inside = here, tb.tb_lineno, here == own
        tb = tb.tb_next
    text = error.message if isinstance(error, FieldtwinError) else str(error)
    return ProgramFailed(bound.name, f"{type(error).__name__}: {text}", path=path, line=line)
