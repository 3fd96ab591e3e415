"""Execute the end-to-end tests of IronPLC (compiler/codegen/tests) with the compiler of fieldtwin.

Such a test is a function in Rust that has a program in Structured Text, runs it for some scans and compares its variables with
expected values. The functions that the tests call to compile and to run a program are here; they have the names of IronPLC. A
variable is addressed by its name, or by its number: global variables first, then those of the program.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from datetime import UTC, datetime
from decimal import Decimal
from pathlib import Path
from typing import Any

import corpus_rust
from corpus_rust import Expression, NotRead
from corpus_rust_run import Differs, Interpreter, converted

from fieldtwin.gateway.core.errors import FieldtwinError, FileInvalid
from fieldtwin.plc.program import ScanInfo
from fieldtwin.plc.st import types as ty
from fieldtwin.plc.st.compiler.compile import compile_text
from fieldtwin.plc.st.dialects import Dialect
from fieldtwin.plc.st.program import program_class

STRING_HEADER_BYTES, DEFAULT_STRING = 6, 254
"""The size of what stands before the characters of a STRING in the memory of IronPLC, and the length of a STRING without one."""
_S = 10**9
_NS = {"milliseconds": 10**6, "seconds": _S, "minutes": 60 * _S, "hours": 3600 * _S, "days": 86400 * _S}
_UNITS = {"duration": 10**6, "tod": 10**6, "date": _S, "dt": _S}
"""The size in ns of the unit in which IronPLC holds a value."""
_LAST = ("Value::Int", "Value::Bool", "VarIndex::new", "vm_var_index")
"""Functions that return their last argument: the type of a value, the number of a variable."""


@dataclass(frozen=True, slots=True)
class Result:
    """A test, with why it differs, or why it is not read; both are empty if it passes."""

    name: str
    differs: str = ""
    not_read: str = ""


class Anything:
    """A value that this reader does not know, such as the number of an error. It equals every other one."""

    def __eq__(self, other: object) -> bool:
        return True

    __hash__ = None


@dataclass(frozen=True, slots=True)
class Moment:
    """A duration, date or time of day of an expectation, in ns."""

    ns: int

    def __sub__(self, other: Moment) -> Moment:
        return Moment(self.ns - other.ns)


@dataclass(frozen=True, slots=True)
class Options:
    """The options of IronPLC's compiler that change the numbers of variables."""

    system_globals: int = 0


@dataclass(frozen=True, slots=True)
class Outcome:
    """A `Result` of Rust."""

    value: Any = None
    error: FieldtwinError | None = None


@dataclass(frozen=True, slots=True)
class Variable:
    name: str
    kind: ty.Type
    value: Any

    def raw(self) -> Any:
        """Return the value as a number in the unit of IronPLC."""
        if isinstance(self.kind, ty.Array | ty.Struct | ty.Block | ty.String | ty.Pointer):
            raise NotRead(f"the place of {self.name} in memory")
        unit = next((size for kind, size in _UNITS.items() if ty.is_kind(self.kind, kind)), 0)
        return self.value // unit if unit else self.value

    def meets(self, expected: Any) -> bool:
        if isinstance(expected, Moment):
            return bool(self.value == expected.ns)
        return bool((self.value if isinstance(self.value, str) else self.raw()) == expected)


class Machine:
    """A compiled program with its variables."""

    def __init__(self, text: str, dialect: Dialect, options: Options) -> None:
        unit = compile_text(text, "test.st", dialect)
        self.program = program_class(unit, "main")()
        pou = next(p for p in unit.source.pous if p.name.lower() == "main")
        self.names = [*[""] * options.system_globals, *(of.name for of in unit.globals.values())]
        self.names += [v.name for b in pou.blocks if b.kind != "VAR_EXTERNAL" for v in b.variables]
        self.scans = 0

    def scan(self, time_us: int) -> None:
        self.scans += 1
        self.program.execute(ScanInfo(time_us * 1000, self.scans, self.scans == 1))

    def variable(self, name: str | int) -> Variable:
        if isinstance(name, int):
            if name >= len(self.names):
                raise NotRead(f"variable {name}")
            name = self.names[name]
        found = self.program.st_paths.typed(name, self.program.st_body, self.program.st_resource.globals)
        if found is None:
            raise NotRead(f"variable {name}")
        return Variable(name, ty.plain(found[0]), found[1])

    def write(self, name: str | int, value: Any) -> None:
        found = self.variable(name)
        self.program.put(found.name, bool(value) if ty.is_kind(found.kind, "bool") else value)

    def string(self, offset: int) -> Variable:
        """Return the STRING at an offset of IronPLC's memory, in which strings are in the order of their declarations."""
        at = 0
        for name in filter(None, self.names):
            found = self.variable(name)
            if isinstance(found.kind, ty.Array | ty.Struct):
                break
            if isinstance(found.kind, ty.String):
                if at == offset:
                    return found
                at += STRING_HEADER_BYTES + _length(found) * (2 if found.kind.wide else 1)
        raise NotRead("the place of a string in memory")


class Slots:
    """The variables of a machine by their numbers."""

    def __init__(self, made: Machine) -> None:
        self.made = made

    def __getitem__(self, index: int) -> Variable:
        return self.made.variable(index)


def run_file(path: Path, dialect: Dialect) -> list[Result]:
    """Execute the tests of a file; each case of a test with cases is a test."""
    file = corpus_rust.read(path.read_text(encoding="utf-8"))
    found = []
    for name, test in IronPlc(file, dialect).tests():
        try:
            test()
            found.append(Result(name))
        except Differs as e:
            found.append(Result(name, differs=str(e)))
        except FileInvalid as e:
            found.append(Result(name, differs=f"does not compile: {e.message}"))
        except FieldtwinError as e:
            found.append(Result(name, differs=f"stops: {e.message}"))
        except (
            NotRead,
            TypeError,
            AttributeError,
            LookupError,
            ValueError,
        ) as e:  # code that this reader does not know
            found.append(Result(name, not_read=f"{e}"))
    return found


class IronPlc(Interpreter):
    """The tests of a file, and what they call."""

    def __init__(self, file: corpus_rust.RustFile, dialect: Dialect) -> None:
        here: dict[str, Callable[..., Any]] = {
            "parse_and_run": lambda *of: _both(self._ran(*of)),
            "parse_and_try_run": lambda *of: _attempted(lambda: _both(self._ran(*of))),
            "Snapshot::run": self._ran,
            "parse_and_compile": self._compiled,
            "try_parse_and_compile": lambda *of: _compiled(lambda: self._compiled(*of)),
            "parse_program": lambda text, _, *options: Outcome((text, *options)),
            "ironplc_analyzer::stages::analyze": self._analyzed,
            "load_and_start": lambda made, _: Outcome(made),
            "VmBuffers::from_container": lambda made: made,
            "parse_and_run_rounds": lambda text, options, scenario: scenario(self._compiled(text, options)),
            "run_scans": lambda text, options, scenario: scenario(self._compiled(text, options)),
            "drive_fb": lambda text, options, steps: _driven(self._compiled(text, options), steps),
            "assert_run": lambda text, expected, generic="": self._compare(text, Options(), expected, generic),
            "assert_run_with": lambda text, options, expected, generic="": self._compare(
                text, options, expected, generic
            ),
            "read_string": lambda made, offset: made.string(offset),
            "read_wstring": lambda made, offset: made.string(offset),
            "read_char_width": lambda made, offset: 2 if made.string(offset).kind.wide else 1,
            "read_cur_length": lambda made, offset: len(made.string(offset).value),
            "read_max_length": lambda made, offset: _length(made.string(offset)),
            "string_offset": lambda lengths: sum(STRING_HEADER_BYTES + n for n in lengths),
            "CompilerOptions::default": Options,
            "CompilerOptions::from_dialect": lambda of: Options(2 if of == "Rusty" else 0),
            "FileId::default": Options,
            **{f"Duration::{unit}": lambda n, size=size: Moment(n * size) for unit, size in _NS.items()},
            **{name: lambda *given: given[-1] for name in _LAST},
        }
        for step in ("write", "run", "expect", "pulse"):
            here |= {one: lambda *of, step=step: (step, *of) for one in (step, step.title(), f"FbStep::{step.title()}")}
        here |= {f"{prefix}::{name}": call for name, call in here.items() for prefix in ("crate::common", "common")}
        super().__init__(file, here)
        self.dialect, self.compiled = dialect, 0

    def tests(self) -> Iterator[tuple[str, Callable[[], Any]]]:
        for _, macro, arguments, text in self.file.macros:
            if macro.startswith("e2e"):
                label = re.search(r"^\s*(?:#\[[^\]]*\]\s*|//[^\n]*\s*)*(\w+)", text)
                yield label[1] if label else macro, lambda m=macro, a=arguments: self._expect(m, a())
            elif macro == "proptest":
                for test in re.findall(r"fn\s+(\w+)", text):
                    yield test, _random
        for function in self.file.functions.values():
            for case, given in (self.cases(function) if function.is_test else {}).items():
                name = f"{function.name}::{case}" if case else function.name
                yield name, lambda f=function, g=given: self._test(f, g)

    def _test(self, function: corpus_rust.Function, given: list[Any]) -> None:
        before = self.compiled
        self.call(function, given)
        if self.compiled == before:
            raise NotRead("a test without a program")

    def _expect(self, macro: str, arguments: list[Expression]) -> None:
        """Execute a macro that is a whole test: ``e2e_i32!(name, "program", &[(variable, value)])``."""
        kind = re.sub("^e2e_?|_?(with|near)$", "", macro)
        rest = self.values(arguments[1:], {})
        options = rest.pop(0) if macro.endswith("_with") else Options()
        near = rest.pop(0) if macro.endswith("_near") else 0.0
        self._compare(rest[0], options, rest[1], kind, near)

    def _compare(
        self, text: str, options: Options, expected: list[tuple[Any, Any]], kind: str, near: float = 0.0
    ) -> None:
        """Run one scan and compare variables with expected values, as numbers of type `kind` if there is one."""
        made = self._ran(text, options)
        for name, value in expected:
            got = made.variable(name)
            if near:
                same = abs(got.raw() - value) < near
            elif not kind or isinstance(value, Moment | str):
                same = got.meets(value)
            else:
                same = converted(got.raw(), kind) == converted(value, kind)
            if not same:
                raise Differs(f"{got.name} is {self.shown(got)}; expected {self.shown(value)}")

    def _compiled(self, text: str, options: Options | None = None) -> Machine:
        self.compiled += 1
        return Machine(text, self.dialect, options or Options())

    def _analyzed(self, parsed: list[tuple[Any, ...]], _: Options) -> Outcome:
        """Return the errors of a program in place of the context in which the analysis notes them."""
        outcome = _compiled(lambda: self._compiled(*parsed[0]))
        return Outcome((None, [outcome.error] if outcome.error else []))

    def _ran(self, text: str, options: Options | None = None) -> Machine:
        made = self._compiled(text, options)
        made.scan(0)
        return made

    def known(self, name: str) -> Any:
        first, _, last = name.rpartition("::")
        if name == "STRING_HEADER_BYTES":
            return STRING_HEADER_BYTES
        if first in ("Trap", "Problem"):
            return Anything()
        return last if first == "Dialect" else super().known(name)

    def member(self, of: Any, name: str) -> Any:
        if isinstance(of, Machine) and name in ("vars", "data_region"):
            return Slots(of) if name == "vars" else of
        if isinstance(of, FieldtwinError) and name in ("trap", "code"):
            return Anything()
        return super().member(of, name)

    def structure(self, name: str, fields: dict[str, Any]) -> Any:
        if name.endswith("Pulse"):
            return ("pulse", fields["var"], fields["n"], fields["time_base"])
        return Options() if name == "CompilerOptions" else super().structure(name, fields)

    def literal(self, macro: str, text: str) -> Any:
        return moment(macro, text) if macro in ("date", "time", "datetime") else super().literal(macro, text)

    def same(self, left: Any, right: Any) -> bool:
        return left.meets(right) if isinstance(left, Variable) else super().same(left, right)

    def shown(self, value: Any) -> str:
        if isinstance(value, Variable):
            return repr(value.value)
        return f"{value.ns} ns" if isinstance(value, Moment) else repr(value)

    def method(self, of: Any, name: str, generic: str, given: list[Any]) -> Any:
        match of, name:
            case (Outcome(error=error), "is_err" | "is_ok"):
                return (error is not None) == (name == "is_err")
            case (Outcome(value, error), "unwrap" | "expect"):
                if error is not None:
                    raise error
                return value
            case (Outcome(error=error), "unwrap_err" | "err" | "expect_err"):
                if error is None:
                    raise Differs("the program has no error; expected one")
                return error
            case (Machine(), "run_round" | "scan"):
                return _attempted(lambda: of.scan(given[0]))
            case (Machine(), "write_variable" | "write"):
                return Outcome(of.write(*given))
            case (Machine(), "read_variable"):
                return Outcome(converted(of.variable(given[0]).raw(), "i32"))
            case (Machine(), "read"):
                return of.variable(given[0])
            case (Machine(), "read_as"):
                return converted(of.variable(given[0]).raw(), generic)
            case (Machine(), "buffers"):
                return of
            case (Variable(), _) if name.startswith("as_"):
                return converted(of.raw(), name.removeprefix("as_"))
            case (Anything(), "code"):
                return of
            case (list(), "has_diagnostics" | "diagnostics"):
                return of
            case (list(), "any"):
                return any(given[0](one) for one in of)
        return super().method(of, name, generic, given)


def _driven(made: Machine, steps: list[tuple[Any, ...]]) -> None:
    for step in steps:
        match step:
            case ("write", name, value):
                made.write(name, value)
            case ("run", time_us):
                made.scan(time_us)
            case ("expect", name, value):
                got = made.variable(name)
                if not got.meets(value):
                    raise Differs(f"{got.name} is {got.value!r}; expected {value!r}")
            case ("pulse", name, count, time_base):
                for at in range(2 * count):
                    made.write(name, 1 - at % 2)
                    made.scan(time_base + at)
            case _:
                raise NotRead(f"the step {step[0]}")


def _length(string: Variable) -> int:
    """Return the length of a STRING as IronPLC has it; 80 stands for the STRING without one."""
    return DEFAULT_STRING if string.kind.length == ty.DEFAULT_STRING else int(string.kind.length)


def _both(made: Machine) -> tuple[Machine, Machine]:
    """Return a machine as the compiled program and as its memory."""
    return made, made


def _attempted(run: Callable[[], Any]) -> Outcome:
    """Return what `run` returns, or the error that stops the program. An error of the compiler is not caught."""
    try:
        return Outcome(run())
    except FileInvalid:
        raise
    except FieldtwinError as e:
        return Outcome(error=e)


def _compiled(make: Callable[[], Machine]) -> Outcome:
    try:
        return Outcome(make())
    except FileInvalid as e:
        return Outcome(error=e)


def _random() -> None:
    raise NotRead("random inputs (proptest)")


def moment(kind: str, text: str) -> Moment:
    """Return the value of ``date!(2000-01-01)``, ``time!(12:30)`` or ``datetime!(2000-01-01 12:30)``."""
    text = text.replace(" - ", "-")
    day, _, clock = text.partition(" ") if kind == "datetime" else ("", "", text) if kind == "time" else (text, "", "")
    year, month, date = (int(n) for n in re.findall(r"\d+", day or "1970-01-01"))
    seconds = sum(Decimal(n) * size for n, size in zip(re.findall(r"[\d.]+", clock), (3600, 60, 1), strict=False))
    return Moment(int((int(datetime(year, month, date, tzinfo=UTC).timestamp()) + seconds) * _S))
