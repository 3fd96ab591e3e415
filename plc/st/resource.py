"""The data that programs of one Structured Text file share while they run: compiled code, global variables, the scan.

The standard calls this a resource (IEC 61131-3, 6.8.1). Programs of one file that run in one PLC share a resource, so
that they see the same VAR_GLOBAL. A deep copy has separate global variables and shares the code, which has no state.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

from fieldtwin.gateway.core.errors import FileInvalid
from fieldtwin.gateway.core.image.image import Message
from fieldtwin.gateway.core.values import TagValue
from fieldtwin.plc.blocks import BLOCKS, FunctionBlock
from fieldtwin.plc.program import Outbox, ScanInfo, ScanTooLong
from fieldtwin.plc.st import values
from fieldtwin.plc.st.compiler.compile import CompiledUnit
from fieldtwin.plc.st.compiler.initial.values import FB_INIT
from fieldtwin.plc.st.compiler.pous.inlining import NAMES
from fieldtwin.plc.st.context import MAX_STEPS, Context
from fieldtwin.plc.st.native.programs import RUNS
from fieldtwin.plc.st.runtime.layouts import Stored, Union
from fieldtwin.plc.st.runtime.logic_error import LogicError
from fieldtwin.plc.st.runtime.references import REFERENCES, Instance

Together = dict[Any, Any]
"""The resources of one PLC, by file and code."""


class Resource:
    """One execution of a compiled unit: its classes and functions, and its global variables with their initial values."""

    def __init__(self, unit: CompiledUnit, context: Context | None = None) -> None:
        self.context = context or Context()
        if unit.record is not None:
            self.context.executed = unit.record
        self.space: dict[str, Any] = {"_v": values, "_c": self.context, "_blocks": BLOCKS, **NAMES}
        self._files = unit.files
        with self._initialising():
            for part in unit.code:
                exec(part, self.space)
        self.globals: Any = self.space["_G"]
        self.bodies: list[Any] = []
        """The objects of the programs that use these global variables."""
        self.names: list[str] = []
        """The names of these programs in the system file, "" for an unknown one. Several may run the same PROGRAM."""
        if unit.machine_code is not None:
            self.space[RUNS] = unit.machine_code.load(self.space)
        self.absolute = ".scan_ns" in unit.python
        """Whether a program uses SCAN_TIME, so that its behaviour depends on absolute time."""
        self._has_references = "_v.pointed(" in unit.python

    def created(self, name: str) -> Any:
        """Return a new object of the class `name` of the compiled code, with its initial values.

        Raises `FileInvalid` for an initial value that cannot be computed.
        """
        self.space["_G"] = self.globals
        self.context.left = MAX_STEPS
        with self._initialising():
            return self.space[name]()

    @contextmanager
    def _initialising(self) -> Iterator[None]:
        """Raise errors of initial values, and of FB_init, as `FileInvalid` with their line."""
        try:
            yield
        except (LogicError, ScanTooLong, AttributeError, RecursionError) as e:
            path, line = line_of_error(e, self._files) or (self._files[0] if self._files else "", 1)
            message = "a variable is used before it has its initial value"
            if isinstance(e, LogicError | ScanTooLong):
                message = f"an initial value, or {FB_INIT}: {e.message}"
            elif isinstance(e, RecursionError):
                message = f"{FB_INIT} is nested too deep"
            raise FileInvalid(message, path=path, line=line) from e

    @classmethod
    def of(cls, unit: CompiledUnit, together: Together | None) -> Resource:
        """Return the resource of `unit` in `together`, after creating it there if necessary.

        If `together` is None, return a new one.
        """
        if together is None:
            return cls(unit)
        key = (unit.path, unit.python)
        if key not in together:
            together[key] = cls(unit)
        found: Resource = together[key]
        return found

    def add(self, body: Any) -> None:
        """Add the object of a program that uses these global variables."""
        self.bodies.append(body)
        self.names.append("")

    def call(self, body: Any, name: str) -> None:
        """Give the program with this object its name in the system file."""
        at = next(n for n, one in enumerate(self.bodies) if one is body)
        self.names[at] = name

    def begin(self, scan: ScanInfo, lookup: Callable[[str], TagValue]) -> None:
        """Prepare one execution of a program: from now on compiled code uses this scan and these global variables."""
        self.space["_G"] = self.globals
        context = self.context
        context.left = MAX_STEPS
        context.now_ns, context.first_scan, context.lookup = scan.now_ns, scan.first_scan, lookup
        context.scan = scan.number

    def numbers(self, body: Any) -> dict[int, int]:
        """Return the numbers of the objects of a program by their ids, if its variables may be references."""
        return _numbered((body, self.globals)) if self._has_references else {}

    def __deepcopy__(self, memo: dict[int, Any]) -> Resource:
        new = Resource.__new__(Resource)
        memo[id(self)] = new
        new._files = self._files
        new.context, new.space, new.absolute = self.context, self.space, self.absolute
        new._has_references = self._has_references
        new.globals = copy.deepcopy(self.globals, memo)
        new.bodies = copy.deepcopy(self.bodies, memo)
        new.names = [*self.names]
        return new


def attributes_of(body: Any) -> dict[str, Any]:
    """Return the attributes of the object of a PROGRAM, whose class has slots if it has machine code."""
    names = (name for name in getattr(type(body), "__slots__", ()) if name != "__dict__" and hasattr(body, name))
    return {**{name: getattr(body, name) for name in names}, **vars(body)}


def line_of_error(error: BaseException, files: Sequence[str]) -> tuple[str, int] | None:
    """Return the innermost line of the source in which an error occurred; None without one."""
    found, frames = None, error.__traceback__
    while frames is not None:
        path = frames.tb_frame.f_code.co_filename
        if path in files:
            found = path, frames.tb_lineno
        frames = frames.tb_next
    return found


def _numbered(roots: tuple[Any, ...]) -> dict[int, int]:
    """Return a number for each object below `roots` by its id. Copies of the roots have the same numbers."""
    numbers: dict[int, int] = {}
    waiting = list(roots)
    while waiting:
        value = waiting.pop()
        if isinstance(value, REFERENCES) or id(value) in numbers:
            continue
        if isinstance(value, Stored):
            numbers[id(value.memory)] = len(numbers)
            continue
        if isinstance(value, list):
            waiting += value
        elif hasattr(value, "__dict__"):
            waiting += attributes_of(value).values()
        elif hasattr(value, "__slots__"):
            waiting += [getattr(value, name, None) for name in value.__slots__]
        else:
            continue
        numbers[id(value)] = len(numbers)
    return numbers


def state_of(value: Any, now_ns: int, numbers: dict[int, int]) -> Any:
    """Return the part of a variable that affects later scans, as a hashable value. Equal states behave the same from
    now on. `numbers`: those of all objects (`Resource.numbers`), by which a reference names its variable.
    """
    if isinstance(value, list):
        return tuple([state_of(v, now_ns, numbers) for v in value])
    if isinstance(value, REFERENCES):
        owner, *where = value.key()
        return "reference", numbers.get(owner, owner), *where
    if isinstance(value, Union):
        return value.content
    if isinstance(value, FunctionBlock):
        return type(value).__name__, *value.state(now_ns)
    if isinstance(value, Instance):
        return value.of.number
    if isinstance(value, Outbox):
        return value.outstanding, tuple(value.pending)
    names = getattr(value, "__slots__", None)
    if names is None or isinstance(value, bool | int | float | str | Message):
        return repr(value) if isinstance(value, float) else value  # so that 0.0, -0.0 and NaN stay distinct
    references = getattr(value, "in_outs", ())
    return tuple([state_of(getattr(value, name), now_ns, numbers) for name in names if name not in references])
