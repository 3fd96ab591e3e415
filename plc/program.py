"""The base class of PLC programs: a plain class with declared inputs, outputs, local variables and messages.

    class Hysteresis(Program):
        level: float | None = var_input(TagKind.REAL)
        pump: bool = var_output(TagKind.BOOL, initial=False)
        starts: int = var_local(TagKind.INT, initial=0)

        def execute(self, scan: ScanInfo) -> None:
            ...

Within `execute`, inputs are attributes that do not change, and outputs and locals are attributes that the program sets. A
program must not depend on the plant behind a variable, the process image, a clock (`scan.now_ns` is constant during a scan) or
another program. No function of this module blocks.
"""

from __future__ import annotations

import os
import sys
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from enum import Enum
from types import CodeType
from typing import Any, ClassVar, Protocol

import msgspec

from fieldtwin.gateway.core.errors import Blame, Bug, FieldtwinError
from fieldtwin.gateway.core.image.image import Message, TagKind
from fieldtwin.gateway.core.values import Scalar, TagValue
from fieldtwin.plc.blocks import FunctionBlock

MESSAGE_BYTES = 256
MESSAGE_DEPTH = 16


class ProgramFailed(FieldtwinError):
    """A program raised an error, or set a variable to a value that its tag cannot hold.

    The task stops, and its outputs are set to their safe values.

    `program` is its name in the system file, `line` the line of its source that raised the error (0 if unknown),
    `variable` the tag concerned, if any.
    """

    exit_code = 1
    blame = Blame.FILE

    def __init__(self, program: str, message: str, *, path: str = "", line: int = 0, variable: str = "") -> None:
        self.program = program
        self.line = line
        self.variable = variable
        self.place = f"{path}:{line}" if line else path
        """File and line of the logic that failed; the file alone if the line is not known."""
        spot = ", ".join(part for part in (f"program {program}", self.place, variable) if part)
        super().__init__(message, where=spot)


class InputTripped(ProgramFailed):
    """An input whose policy is ``trip`` became bad: the task stops, and its outputs are set to their safe values."""


class ProgramStuck(ProgramFailed):
    """A program did not end its scan: the task stops, and its outputs are set to their safe values."""


class ScanTooLong(FieldtwinError):
    """Logic ran more loop iterations and calls in one scan than are allowed: it is treated as endless."""

    exit_code = 1
    blame = Blame.FILE


class ScanStuck(BaseException):
    """Raised by a guard inside logic that does not end. It is not an `Exception`, so that no program catches it."""


class Role(Enum):
    """VAR_INPUT, VAR_OUTPUT and VAR of IEC 61131-3. A local is published for display only and is not bound to a tag."""

    INPUT = "input"
    OUTPUT = "output"
    LOCAL = "local"


@dataclass(frozen=True, slots=True)
class Variable:
    """A declared variable.

    `initial` is its value before the first scan. `max_bytes` and `depth` apply to message outputs. The value of a `retain`
    variable is kept when the process ends. `limits` are shown to users, and a force must be within them. `words` are the names of
    its values. `address` is the direct address of a `located` variable, such as ``%QX0.0``; "" if it is not known yet. An input
    without `needs_tag` keeps its value while the system file binds it to no tag. Users do not see a `hidden` variable, which no
    source declares.
    """

    name: str
    role: Role
    kind: TagKind
    initial: Scalar | None = None
    unit: str = ""
    max_bytes: int = 0
    depth: int = 0
    retain: bool = False
    limits: tuple[float, float] | None = None
    words: tuple[tuple[int, str], ...] = ()
    address: str = ""
    needs_tag: bool = True
    located: bool = False
    type: str = ""
    """The type of the variable in the source; empty if the language of the program has no types of IEC 61131-3."""
    hidden: bool = False


def var_input(kind: TagKind, initial: Scalar | None = None) -> Any:
    """Declare an input. It is None as long as the plant has had no value and no substitute applies."""
    return Variable("", Role.INPUT, kind, initial)


Limits = tuple[float, float] | None


def var_output(kind: TagKind, initial: Scalar | None = None, unit: str = "", limits: Limits = None) -> Any:
    """Declare an output. While it is None, nothing is written to the plant. An output that is bound to a tag has the
    tag's unit and limits."""
    return Variable("", Role.OUTPUT, kind, initial, unit, limits=limits)


def var_local(
    kind: TagKind, initial: Scalar | None = None, unit: str = "", limits: Limits = None, words: Sequence[str] = ()
) -> Any:
    """Declare a local variable, published as ``<program>.<name>``. `words`: names of the values 0, 1, 2 and so on, for
    display."""
    return Variable("", Role.LOCAL, kind, initial, unit, limits=limits, words=tuple(enumerate(words)))


def var_retain(kind: TagKind, initial: Scalar | None = None, unit: str = "", limits: Limits = None) -> Any:
    """Declare a local variable (VAR RETAIN) that keeps its value from the last scan over a warm start."""
    return Variable("", Role.LOCAL, kind, initial, unit, retain=True, limits=limits)


def message_input() -> Any:
    """Declare an input of messages.

    In each scan it is the tuple of the new messages; each `Message` appears in exactly one scan.
    """
    return Variable("", Role.INPUT, TagKind.MESSAGE)


def message_output(max_bytes: int = MESSAGE_BYTES, depth: int = MESSAGE_DEPTH) -> Any:
    """Declare an output of messages: an `Outbox`. If it is bound to a plant's mailbox, it takes the mailbox's size."""
    return Variable("", Role.OUTPUT, TagKind.MESSAGE, max_bytes=max_bytes, depth=depth)


class ScanInfo(msgspec.Struct, frozen=True, gc=False):
    """The present scan: its time (monotonic ns, constant during the scan), its number from 1, and whether it is the first since
    the start.
    """

    now_ns: int
    number: int
    first_scan: bool


class Outbox:
    """A message output. At most `depth` messages wait for the receiver, so that none is overwritten before it is read.

    `waits` counts the calls of `send` that were refused because there was no room.
    """

    def __init__(self, max_bytes: int, depth: int) -> None:
        self.max_bytes = max_bytes
        self.depth = depth
        self.outstanding = 0
        """The number of messages that are published and that the receiver has not taken yet. The scan updates it."""
        self.pending: list[tuple[int, bytes]] = []
        """Messages that were sent in this scan and are published at its end."""
        self.waits = 0

    @property
    def room(self) -> int:
        """Return the number of messages that can still be sent in this scan."""
        return max(0, self.depth - self.outstanding - len(self.pending))

    def send(self, data: bytes, t_ns: int) -> bool:
        """Send `data`, whose source time is `t_ns`. Return False if there is no room: the program should try again in the next
        scan.

        Raises `Bug` for a message longer than `max_bytes`.
        """
        if len(data) > self.max_bytes:
            raise Bug("message too long", expected=f"at most {self.max_bytes} bytes", got=f"{len(data)} bytes")
        if not self.room:
            self.waits += 1
            return False
        self.pending.append((t_ns, data))
        return True


@dataclass(frozen=True, slots=True)
class InternalVariable:
    """A variable of a program that is not a tag, as users see it: a member of a block, an array or its element, a string.

    `name` is the path inside the program, such as ``delay.ET`` or ``levels[3]``; `type` the IEC type; a time is a number of ns.
    """

    name: str
    type: str
    value: Scalar | str


@dataclass(frozen=True, slots=True)
class VariableReader:
    """Reads one variable of a program. `type` is its IEC type, or the kind of its tag."""

    type: str
    read: Callable[[], Scalar | str | None]
    unit: str = ""


class Described(Protocol):
    """Something that can be described as data for JSON."""

    def describe(self) -> dict[str, Any]: ...


class SourceLine(msgspec.Struct, frozen=True, gc=False):
    """A line of a program's source.

    It is stored as an instruction of a code object; the line is looked up only when it is shown."""

    path: str = ""
    line: int = 0
    code: CodeType | None = None
    instruction: int = 0

    def __str__(self) -> str:
        """Return a text such as ``pump.st:14``; the path alone if the line is not known, "" if neither is known."""
        path, line = self.path, self.line
        if self.code is not None:
            path = within_import_path(self.code.co_filename)
            lines = [place[0] for place in self.code.co_positions()]
            line = (lines[self.instruction // 2] if self.instruction // 2 < len(lines) else None) or 0
        return f"{path}:{line}" if line else path


def within_import_path(path: str) -> str:
    """Return the path of a module's file relative to its entry of `sys.path`, such as ``plc/control.py``.

    A place is recorded in traces and in errors, which must not differ between two computers or folders.
    """
    entries = [os.path.abspath(entry) for entry in sys.path if entry]  # the folder of a system can be a relative entry
    folders = [entry for entry in entries if path.startswith(entry.rstrip("/") + "/")]
    return path[len(max(folders, key=len).rstrip("/")) + 1 :] if folders else path


class _Assigned:
    """A descriptor for outputs: it keeps the value in the instance, and records which instruction assigned it.

    It has no ``__get__``, so that reading an output costs as little as reading any other attribute.
    """

    __slots__ = ("name",)

    def __init__(self, name: str) -> None:
        self.name = name

    def __set__(self, program: Program, value: object) -> None:
        program.__dict__[self.name] = value
        frame = sys._getframe(1)
        program._assigned[self.name] = frame.f_code, frame.f_lasti


class Program(ABC):
    """The base class of all programs. A subclass declares variables in its body and overrides `execute`."""

    __slots__ = ("__dict__", "__weakref__", "_assigned")
    _assigned: dict[str, tuple[CodeType, int]]
    """By output: the instruction that last assigned it. It is not a variable, because variables are the program's state."""
    variables: ClassVar[dict[str, Variable]] = {}
    source_path: ClassVar[str] = ""
    """The file in which the program is declared, if it is not the file of its module."""
    source_files: ClassVar[tuple[str, ...]] = ()
    """All files from which the program was compiled, that one first; empty for a Python program."""
    source_warnings: ClassVar[tuple[str, ...]] = ()
    """The compiler's warnings about constructs that only the program's dialect accepts, each with file, line and id."""
    _lookup: Callable[[str], TagValue] | None = None

    def __init_subclass__(cls, **kwargs: Any) -> None:
        super().__init_subclass__(**kwargs)
        own = {
            name: replace(declared, name=name) for name, declared in vars(cls).items() if isinstance(declared, Variable)
        }
        cls.variables = {**cls.variables, **own}
        for name, declared in own.items():
            if declared.role is Role.OUTPUT and declared.kind is not TagKind.MESSAGE:
                setattr(cls, name, _Assigned(name))

    def __new__(cls, *args: Any, **kwargs: Any) -> Program:
        self = super().__new__(cls)
        self._assigned = {}
        for v in cls.variables.values():
            initial: object = v.initial
            if v.kind is TagKind.MESSAGE:
                initial = () if v.role is Role.INPUT else Outbox(v.max_bytes, v.depth)
            self.__dict__[v.name] = initial
        return self

    @abstractmethod
    def execute(self, scan: ScanInfo) -> None:
        """Execute one scan: read inputs, set outputs, return. An error that it raises stops the task."""

    def whole_state(self, now_ns: int) -> Any:
        """Return the whole state on which the next scans depend, as a hashable value with times relative to `now_ns`.

        Return None if it is unknown, as for logic in Python, which can keep state anywhere. A program that overrides this
        depends only on this state, on its inputs with their qualities, and on the time of the scan, and equal states behave the
        same from now on. Its scans are then skipped while they can change nothing (fieldtwin.plc.cycle.skipping).
        """
        return None

    def bound_as(self, name: str) -> None:  # noqa: B027  # only Structured Text has reasons with names of programs
        """Take over the name of the program in the system file, which its reasons show to users."""

    def last_assignment(self, name: str) -> tuple[SourceLine | None, Described | None]:
        """Return the line that assigned output `name` last, and its statement with what decided, each None if it is not known.

        Both are None while the output has its initial value, or a value set from outside.
        """
        assigned = self._assigned.get(name)
        return (SourceLine(code=assigned[0], instruction=assigned[1]) if assigned is not None else None), None

    def put(self, name: str, value: Scalar) -> None:
        """Set a variable from outside the logic, for example for a force."""
        self.__dict__[name] = value
        self._assigned.pop(name, None)

    def internal_names(self) -> Iterator[str]:
        """Return the paths of the variables that are not tags. In this class: the inputs and outputs of function blocks that are
        attributes of the program.
        """
        for name, block in vars(self).items():
            if isinstance(block, FunctionBlock):
                yield from (f"{name}.{member}" for member, _, _ in block.members())

    def drawings(self) -> list[tuple[str, str]]:
        """Return the name and the SVG text of each drawing of the program: charts, ladder and function block diagrams.

        The first call takes several ms for each drawing.
        """
        return []

    def drawn(self, number: int) -> dict[str, Any]:
        """Return the present values of a drawing, by kind and part, as data for JSON."""
        return {}

    def state_diagram(self) -> Any:
        """Return the states and transitions of the variable `state` as the source has them; None if it has none."""
        return None

    def internal(self, path: str) -> InternalVariable | None:
        """Return a variable that is not a tag, by its path; None if no block has it."""
        name, _, wanted = path.partition(".")
        block = vars(self).get(name)
        if isinstance(block, FunctionBlock):
            for member, kind, value in block.members():
                if member == wanted:
                    return InternalVariable(path, kind, value)
        return None

    def variable_reader(self, path: str) -> VariableReader | None:
        """Return what reads a variable by its path, whether or not it is a tag; None if the program has no such variable."""
        declared = self.variables.get(path)
        if declared is not None:
            kind = declared.kind.value
            return VariableReader(kind, lambda: self.__dict__[path], declared.unit) if kind != "message" else None
        found = self.internal(path)
        if found is None:
            return None
        unit = "ns" if found.type in ("TIME", "LTIME") else ""
        return VariableReader(found.type, lambda: self._internal_value(path), unit)

    def _internal_value(self, path: str) -> Scalar | str | None:
        found = self.internal(path)
        return found.value if found is not None else None

    def retained(self) -> dict[str, Any]:
        """Return the values that a warm start needs, by variable: numbers, strings, and lists and maps of them."""
        return {v.name: self.__dict__[v.name] for v in self.variables.values() if v.retain}

    def retain_layout(self) -> Any:
        """Return the properties that must be unchanged for retained values to keep their meaning, as data for JSON."""
        return [[v.name, v.kind.value] for v in self.variables.values() if v.retain]

    def retain_bytes(self) -> int:
        """Return the largest possible size in bytes of `retained` as MessagePack."""
        return sum(9 + 5 + len(v.name.encode()) for v in self.variables.values() if v.retain)

    def check(self, name: str, value: Scalar) -> None:
        """Raise `UsageError` if variable `name` cannot hold a `value` that its tag can hold. In this class every variable can."""
        return

    def restore(self, kept: dict[str, Any]) -> None:
        """Restore what `retained` returned; variables that are not in `kept` keep their initial value."""
        for v in self.variables.values():
            if v.retain and v.name in kept:
                self.__dict__[v.name] = kept[v.name]

    def resume(self, known: Mapping[str, Scalar]) -> None:
        """Continue from known values of the outputs and locals. Called before the first scan.

        A program with state in addition to its variables overrides this. Raises `UsageError` for a value that a variable
        cannot hold.
        """
        for v in self.variables.values():
            if v.role is not Role.INPUT and v.name in known and not isinstance(self.__dict__.get(v.name), Outbox):
                self.check(v.name, known[v.name])
                self.put(v.name, known[v.name])

    def tag(self, name: str) -> TagValue:
        """Return input `name` with quality, reason and time as this scan sees it, after its policy for bad values was applied."""
        if self._lookup is None:
            raise Bug("an input was looked up outside a scan", where=f"{type(self).__name__}.{name}")
        return self._lookup(name)


__all__ = [
    "InputTripped",
    "Message",
    "Outbox",
    "Program",
    "ProgramFailed",
    "ProgramStuck",
    "Role",
    "ScanInfo",
    "ScanStuck",
    "SourceLine",
    "Variable",
    "message_input",
    "message_output",
    "var_input",
    "var_local",
    "var_output",
    "var_retain",
    "within_import_path",
]
