"""The output image of a PLC: what all programs of all tasks publish, as one region with one writer.

Each scan publishes the whole region: the present values of its own programs, and the values of the other programs after their
last scan. It inserts forced outputs, takes messages from the outboxes, and rejects a value that its tag cannot hold, with an
error that names the program. This module must not depend on when a scan is due.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import msgspec

from fieldtwin.gateway.core.errors import FileInvalid
from fieldtwin.gateway.core.image.image import (
    INPUTS,
    OUTPUTS,
    Image,
    NotEncodable,
    RegionFlag,
    RegionReader,
    RegionShape,
    TagKind,
    TagSpec,
    consumed_name,
    taken_name,
)
from fieldtwin.gateway.core.values import Quality, Reason, Scalar
from fieldtwin.plc.binding import BoundProgram
from fieldtwin.plc.cycle.forces import Forces
from fieldtwin.plc.program import Described, Outbox, ProgramFailed, SourceLine, Variable

Seen = Callable[[], dict[str, Scalar | None]]
"""A function that returns a program's inputs, by variable, as the program read them."""

_GOOD, _NO_REASON = Quality.GOOD, Reason.NONE  # local names, because looking up an Enum's members is slow
MAX_CHANGES = 16
"""The number of changes that are kept for each tag, each with the inputs that the program read when it made the change."""


class PublishedVariable:
    """One published variable, and the attribute in which the program keeps it.

    `taken` is the index in INPUTS of the tag that counts how many of the messages of this variable the receiver has taken.
    """

    def __init__(self, bound: BoundProgram, variable: Variable, spec: TagSpec, index: int) -> None:
        self.program = bound.program
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


class TagChange(msgspec.Struct, frozen=True, gc=False):
    """A change of a tag, for the command `why`: the program that made it, and the inputs as the program read them.

    All changes of a program in one scan share the same `inputs`. A large program makes hundreds of changes in each scan, so this
    class and those of its parts are of a kind that is created quickly.
    """

    tag: str
    t_ns: int
    scan: int
    program: str
    before: Scalar | None
    after: Scalar | None
    inputs: dict[str, Scalar | None]
    forced: bool = False
    place: SourceLine | None = None
    """The source line that assigned the new value (`after`)."""
    decided: Described | None = None
    """The statement of that line, and what decided that it was executed."""

    def describe(self, now_ns: int) -> dict[str, Any]:
        """Return the change as data for JSON."""
        return {
            "tag": self.tag,
            "age_ms": (now_ns - self.t_ns) / 1e6,
            "scan": self.scan,
            "program": self.program,
            "before": self.before,
            "after": self.after,
            "inputs": self.inputs,
            "forced": self.forced,
            "place": str(self.place or ""),
            "decided": self.decided.describe() if self.decided is not None else None,
        }


class OutputImage:
    """The writer of OUTPUTS for all programs. Raises `FileInvalid` when the image and the programs do not match."""

    def __init__(self, image: Image, programs: Sequence[BoundProgram], forces: Forces | None = None) -> None:
        self.forces = Forces() if forces is None else forces
        self.writer = image.writer(OUTPUTS)
        self.outputs: list[PublishedVariable] = []
        self.outboxes: list[tuple[PublishedVariable, Outbox]] = []
        self.consumed: list[str] = []
        self.changes: dict[str, deque[TagChange]] = {}
        self.on_change: Callable[[TagChange], None] | None = None
        """A function that is called with each change. It must not raise an exception."""
        self._readers: dict[str, RegionReader] = {}
        self._read: list[tuple[int, RegionReader, str]] = []
        """For each message tag that a program reads: the index of its counter of consumed messages in OUTPUTS, its reader, and
        its name.
        """
        self.withheld = False
        """Whether every tag is published as BAD, because a scan was stopped by a debugger and its inputs are old."""
        self._forced = False
        """Whether the last publication had forced outputs."""
        self._bind(programs, image.reader(INPUTS).shape)
        self._by_tag = {o.tag: o for o in self.outputs}
        self._plain = [o for o in self.outputs if o.outbox is None]
        self._missing: dict[int, Reason] = {}
        """By index of an output without a value: the reason, unless it is that no program has set the output yet."""
        self._same = False
        """Whether the collected values equal those published last, apart from times."""
        self._room_for: Sequence[Scalar | None] | None = None
        """The values of INPUTS from which the room in the outboxes was computed; None if messages were sent since then."""
        self._by_owner: dict[str, list[PublishedVariable]] = {}
        for output in self.outputs:
            self._by_owner.setdefault(output.owner, []).append(output)
        self._resumed = self._before(image)
        self._values: list[Scalar | None] = [None] * (len(self.outputs) + len(self.consumed))
        for n, tag in enumerate(self.consumed, len(self.outputs)):
            self._values[n] = self._resumed[tag]

    def _bind(self, programs: Sequence[BoundProgram], inputs: RegionShape) -> None:
        shape = self.writer.shape
        made = {tag: (bound, variable) for bound in programs for variable, tag in bound.published()}
        for tag in made:
            find(shape, tag)
        for index, spec in enumerate(shape.layout.tags):
            if spec.name not in made:
                if not spec.name.endswith(consumed_name("")):
                    raise FileInvalid(f"no program writes {spec.name}", expected=", ".join(sorted(made)))
                self.consumed.append(spec.name.removesuffix(consumed_name("")))
                continue
            if self.consumed:
                raise FileInvalid(f"{spec.name} comes after the consumed tags", expected="a layout of process_image")
            bound, variable = made[spec.name]
            source = PublishedVariable(bound, variable, spec, index)
            self.outputs.append(source)
            if source.outbox is not None:
                source.taken = inputs.index.get(taken_name(spec.name))
                self.outboxes.append((source, source.outbox))

    def _before(self, image: Image) -> dict[str, int]:
        """Return, by message tag, the sequence number of the last message that an earlier process consumed; 0 if there was
        none.
        """
        before = image.reader(OUTPUTS).snapshot()
        found = {}
        for tag in self.consumed:
            value = before.value(consumed_name(tag)).value
            found[tag] = value if isinstance(value, int) else 0
        return found

    def reads(self, tag: str, reader: RegionReader) -> None:
        """Register `reader` as the consumer of the messages of `tag`. Raises `FileInvalid` if a different reader is already
        registered.
        """
        if self._readers.setdefault(tag, reader) is not reader:
            raise FileInvalid(f"messages of {tag} go to programs of two tasks", expected="programs of one task")
        reader.resume(tag, self._resumed[tag])
        self._read = [
            (at, self._readers[tag], tag)
            for at, tag in enumerate(self.consumed, len(self.outputs))
            if tag in self._readers
        ]

    # -- the cycle ----------------------------------------------------------------------------------------------------

    def force(self) -> None:
        """Set forced outputs and locals in their programs. Called before the logic runs."""
        forced = self.forces.outputs
        if forced:
            for output in self._plain:
                if output.tag in forced:
                    output.program.put(output.name, forced[output.tag].value)

    def publish_forces(self) -> None:
        """Apply forced outputs from the next publication on, although no program runs."""
        for output in self._plain:
            force = self.forces.outputs.get(output.tag)
            if force is not None and self._values[output.index] != force.value:
                self._values[output.index] = force.value
                self._same = False

    def room(self, taken: Sequence[Scalar | None]) -> None:
        """Compute the room in the outboxes from the counters in INPUTS of the messages that the receivers have taken."""
        if taken is self._room_for:  # a reader returns the same columns as long as nothing in them changes
            return
        self._room_for = taken
        sent = self.writer.last_sequence
        for output, outbox in self.outboxes:
            got = taken[output.taken] if output.taken is not None else 0
            # A receiver that counted messages before this process began may have taken more than were published.
            outbox.outstanding = max(0, sent(output.tag) - (got if isinstance(got, int) else 0))

    def collect(self, now_ns: int, scan: int, programs: Mapping[str, Seen]) -> None:
        """Collect the present values of `programs`, and record each change with the inputs that the program read."""
        for owner, outputs in self._by_owner.items():
            seen = programs.get(owner)
            if seen is not None:
                self._collect(outputs, now_ns, scan, seen)

    def _collect(self, outputs: list[PublishedVariable], now_ns: int, scan: int, seen: Seen) -> None:
        """Collect the values of the `outputs` of one program, and record changes with the inputs that `seen` returns."""
        values, forced, namespace = self._values, self.forces.outputs, outputs[0].namespace
        inputs: dict[str, Scalar | None] | None = None
        for output in outputs:
            value = namespace[output.name]
            if output.outbox is not None:
                if value is not output.outbox:
                    raise ProgramFailed(output.owner, "an outbox was overwritten; call its send()", variable=output.tag)
                continue
            force = forced.get(output.tag) if forced else None
            if force is not None:
                output.program.put(output.name, force.value)
                value = force.value
            before = values[output.index]
            if value is before or value == before:
                if value is None and self._missing.pop(output.index, None) is not None:
                    self._same = False  # the last value was NaN and this one is missing, so the reason changes
                continue
            if value != value:  # NaN must not be written to a plant; the gateway reports it
                value, broken = None, output.index not in self._missing
                self._missing[output.index] = Reason.NOT_A_NUMBER
            else:
                broken = False
                self._missing.pop(output.index, None)
            if value is not before or broken:
                kept = self.changes.get(output.tag)
                if kept is None:
                    kept = self.changes[output.tag] = deque(maxlen=MAX_CHANGES)
                if inputs is None:
                    inputs = seen()
                place, decided = output.program.last_assignment(output.name) if force is None else (None, None)
                change = TagChange(
                    output.tag, now_ns, scan, output.owner, before, value, inputs, force is not None, place, decided
                )
                kept.append(change)
                if self.on_change is not None:
                    self.on_change(change)
            values[output.index] = value
            self._same = False

    @property
    def taken_indexes(self) -> set[int]:
        """Return the indexes in INPUTS of the counters of messages that the receivers have taken."""
        return {output.taken for output, _ in self.outboxes if output.taken is not None}

    @property
    def same(self) -> bool:
        """Return whether the collected values equal those published last."""
        return self._same

    def publish(self, now_ns: int) -> None:
        """Publish what was collected. Raises `ProgramFailed` with the name of a program whose value does not fit its
        tag."""
        if self.withheld:
            self.stop(now_ns)
            return
        values = self._values
        messages = {}
        for output, outbox in self.outboxes:
            values[output.index] = 0
            if outbox.pending:
                messages[output.tag] = outbox.pending
                outbox.pending = []
                self._room_for = None
        for at, reader, tag in self._read:
            seen = reader.seen(tag)
            if values[at] != seen:
                values[at] = seen
                self._same = False
        but = None
        if self.forces.outputs or self._forced:
            self._forced = bool(self.forces.outputs)
            but = {o.index: Quality.SIMULATED for o in self._plain if o.tag in self.forces.outputs}
            self._same = False
        try:
            self.writer.publish_columns(
                values, _GOOD, _NO_REASON, now_ns, messages, but=but, same=self._same, missing=self._missing
            )
        except NotEncodable as e:
            values[self.writer.shape.index[e.tag]] = None  # so that stopping can publish the other values
            owner = next((output.owner for output in self.outputs if output.tag == e.tag), "?")
            raise ProgramFailed(owner, f"{e.message}; expected {e.expected}; got {e.got}", variable=e.tag) from e
        self._same = True

    @property
    def repeats(self) -> bool:
        """Return whether the next publication repeats the last one, unless values are collected, forced or consumed before.

        `writer.skip` may then count publications.
        """
        return self._same and not self._forced and not self.forces.outputs and self.writer.repeats

    def origin(self, tag: str, value: Scalar | None) -> tuple[str, str]:
        """Return (program, ``FILE:LINE``) that set `tag` to `value` (None: to NaN), from the recorded changes.

        The line is "" if none of them is that change and they come from more than one line.
        """
        changes = self.changes.get(tag, ())
        owner = self._by_tag[tag].owner if tag in self._by_tag else ""
        for change in reversed(changes):
            if change.after == value and not change.forced:
                return owner, str(change.place or "")
        places = {str(change.place or "") for change in changes}
        return owner, places.pop() if len(places) == 1 else ""

    def stop(self, now_ns: int) -> None:
        """Publish OUTPUTS flagged as stopped, so that its readers ignore it: every tag is BAD, and its value is unchanged."""
        self._same = False
        self.writer.publish_columns(self._values, Quality.BAD, Reason.NOT_OPERATIONAL, now_ns, None, RegionFlag.STOPPED)

    def current(self, tag: str) -> Scalar | None:
        """Return the present value of a program's variable: its initial value before the first scan."""
        output = self._by_tag[tag]
        value: Scalar | None = output.namespace[output.name]
        return value

    def release(self) -> None:
        self.writer.release()

    def last(self) -> dict[str, Scalar | None]:
        """Return every tag of OUTPUTS as last collected. The value of a message tag is its last sequence number."""
        shown = dict(zip(self.writer.shape.index, self._values, strict=True))
        return shown | {output.tag: self.writer.last_sequence(output.tag) for output, _ in self.outboxes}


def find(shape: RegionShape, tag: str) -> tuple[TagSpec, int]:
    """Return the index of a tag in a region. Raises `FileInvalid` if the region does not hold the tag."""
    index = shape.index.get(tag)
    if index is None:
        raise FileInvalid(f"tag {tag} is not in the process image", expected=f"a tag of region {shape.layout.name}")
    return shape.layout.tags[index], index
