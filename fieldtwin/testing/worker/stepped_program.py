"""A PLC program that a test steps: the test sets inputs, runs scans with a constant cycle, and reads outputs.

The program may be that of any system, in Python, Structured Text or a PLCopen export; the test decides how much time passes.
There are no PLC tasks, no process image and no wall clock.
"""

from __future__ import annotations

from typing import Any

from fieldtwin.gateway.core.clock import NS_PER_MS
from fieldtwin.gateway.core.errors import UsageError
from fieldtwin.gateway.core.image.image import Message, TagKind
from fieldtwin.gateway.core.values import Quality, Reason, TagValue
from fieldtwin.plc.binding import BoundProgram, load_program
from fieldtwin.plc.cycle.scan import failed
from fieldtwin.plc.program import Outbox, Program, ProgramFailed, Role, ScanInfo
from fieldtwin.plc.states import StateMachine

MAX_SCANS = 10_000_000
QUALITIES = {quality.name.lower(): quality for quality in Quality}


class SteppedProgram:
    """A PLC program that is executed scan by scan.

    An input is BAD, and has no value, until it is set; it keeps its value, except for messages, which are present for
    one scan.
    """

    def __init__(self, source: str, folders: tuple[str, ...], cycle_ms: float) -> None:
        """Load the program. Raises `FileInvalid` for an invalid one."""
        if cycle_ms <= 0:
            raise UsageError("a cycle", expected="more than 0 ms", got=f"{cycle_ms:g} ms")
        self.program: Program = load_program(source, folders)
        self.cycle_ns = round(cycle_ms * NS_PER_MS)
        self.now_ns = 0
        self.scans = 0
        self._sent: dict[str, list[str]] = {}
        self._inputs: dict[str, TagValue] = {
            v.name: TagValue(None, Quality.BAD, Reason.NEVER_READ, 0)
            for v in self.program.variables.values()
            if v.role is Role.INPUT and v.kind is not TagKind.MESSAGE
        }

    def set(self, name: str, value: Any, quality: str = "good") -> None:
        """Set an input from the next scan on; None: bad, without a value. A message is text or hex bytes."""
        variable = self.program.variables.get(name)
        if variable is None or variable.role is not Role.INPUT:
            inputs = [v.name for v in self.program.variables.values() if v.role is Role.INPUT]
            raise UsageError(f"no input {name!r}", expected=", ".join(inputs) or "a program with inputs")
        if quality not in QUALITIES:
            raise UsageError(f"no quality {quality!r}", expected=", ".join(QUALITIES))
        if variable.kind is TagKind.MESSAGE:
            waiting: tuple[Message, ...] = self.program.__dict__[name]
            number = waiting[-1].seq + 1 if waiting else 1
            self.program.__dict__[name] = (*waiting, Message(number, self.now_ns, str(value).encode()))
            return
        if value is not None:
            _fits(name, variable.kind, value)
            self.program.check(name, value)
        good = Quality.BAD if value is None else QUALITIES[quality]
        reason = Reason.TIMEOUT if good is Quality.BAD else Reason.NONE
        self._inputs[name] = TagValue(value, good, reason, self.now_ns)

    def scan(self, scans: int) -> None:
        """Run `scans` scans. Raises `ProgramFailed` with file and line where the program fails."""
        if not 0 < scans <= MAX_SCANS:
            raise UsageError("number of scans", expected=f"1 to {MAX_SCANS:,}", got=str(scans))
        for _ in range(scans):
            self._once()

    def _once(self) -> None:
        program = self.program
        self.now_ns += self.cycle_ns
        self.scans += 1
        for name, seen in self._inputs.items():
            program.__dict__[name] = seen.value
        program._lookup = self._inputs.__getitem__
        try:
            program.execute(ScanInfo(self.now_ns, self.scans, self.scans == 1))
        except ProgramFailed:
            raise
        except Exception as e:  # the logic is the user's, and can raise any exception; it is translated only here
            raise failed(BoundProgram(type(program).__name__, program), e) from e
        for v in program.variables.values():
            box = program.__dict__[v.name]
            if isinstance(box, Outbox):
                self._sent.setdefault(v.name, []).extend(data.decode(errors="replace") for _, data in box.pending)
                box.pending = []
                box.outstanding = 0
            elif v.kind is TagKind.MESSAGE:
                program.__dict__[v.name] = ()

    def values(self) -> dict[str, Any]:
        """Return every variable by its name.

        The `state` of a state machine is its name; a message output is the list of all sent messages.
        """
        found: dict[str, Any] = {}
        for v in self.program.variables.values():
            value = self.program.__dict__[v.name]
            if isinstance(value, Outbox):
                value = self._sent.get(v.name, [])
            elif v.kind is TagKind.MESSAGE:
                value = [m.data.decode(errors="replace") for m in value]
            found[v.name] = value
        if isinstance(self.program, StateMachine):
            found["state"] = self.program.state_name
        return found


def _fits(name: str, kind: TagKind, value: Any) -> None:
    fits = {
        TagKind.BOOL: isinstance(value, bool),
        TagKind.INT: isinstance(value, int) and not isinstance(value, bool),
        TagKind.REAL: isinstance(value, int | float) and not isinstance(value, bool),
    }.get(kind, True)
    if not fits:
        raise UsageError(f"{name} is of kind {kind.name}", got=repr(value))
