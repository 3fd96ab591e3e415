"""Compiles a unit of Structured Text to Python, once: classes for structures and function blocks, functions, and a
class for each PROGRAM.

The Python code carries the files and line numbers of the source, so that an error in a scan names the line that the user
wrote. All errors are collected: an error in one statement or declaration does not hide those in others.
The compiled code has no state: each `fieldtwin.plc.st.resource.Resource` runs it in a separate namespace.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from types import CodeType
from typing import Any, Protocol

from fieldtwin.gateway.core.errors import FileInvalid
from fieldtwin.plc.st import types as ty
from fieldtwin.plc.st.charts.translate import is_hidden, without_charts
from fieldtwin.plc.st.classes.inheritance import with_inherited
from fieldtwin.plc.st.classes.instance_variables import without_instance_variables
from fieldtwin.plc.st.classes.structures import with_inherited_members
from fieldtwin.plc.st.compiler.assignments import Arrays, Assigned, Recorded, is_recorded
from fieldtwin.plc.st.compiler.configurations.called import with_called_programs
from fieldtwin.plc.st.compiler.configurations.instances import (
    CompiledInstance,
    compiled_instances,
    declared_name,
    with_configured,
)
from fieldtwin.plc.st.compiler.configurations.located import (
    misplaced,
    overlaps,
    shared_addresses,
    without_addresses,
)
from fieldtwin.plc.st.compiler.declarations import Declarations
from fieldtwin.plc.st.compiler.execution_control import with_execution_control
from fieldtwin.plc.st.compiler.pous.blocks import Blocks
from fieldtwin.plc.st.compiler.pous.functions import Functions
from fieldtwin.plc.st.compiler.pous.hierarchy import KINDS, Hierarchy
from fieldtwin.plc.st.compiler.pous.programs import CompiledProgram, Programs
from fieldtwin.plc.st.compiler.pous.recursion import refuse_recursion
from fieldtwin.plc.st.compiler.pous.source_lines import SourceLines, places_of
from fieldtwin.plc.st.compiler.pous.variables import GlobalVariable, Variables
from fieldtwin.plc.st.compiler.scope import CodeWriter, Environment, Symbol
from fieldtwin.plc.st.dialects import STANDARD, Dialect, StWarning
from fieldtwin.plc.st.edges import without_edges
from fieldtwin.plc.st.namespaces import with_full_names
from fieldtwin.plc.st.syntax import tree as t
from fieldtwin.plc.st.syntax.parse import parse_all


class MachineCode(Protocol):
    """The machine code of a unit (`fieldtwin.plc.st.native`)."""

    def load(self, space: Mapping[str, Any]) -> list[Any]:
        """Return the functions of machine code for the Python code that was executed in `space`."""

    def published(self, name: str) -> tuple[str, ...] | None:
        """Return the attributes that machine code publishes of the class `name` of a PROGRAM, in the order of their keys.

        Return None if Python code may change some of them.
        """


@dataclass(frozen=True, slots=True)
class CompiledUnit:
    """A unit, compiled from `files`: one file, or the files of the folder `path`.

    Its `code`, executed in this order with the names ``_v``, ``_c`` and ``_blocks``, defines the classes and functions of the
    unit; each part comes from one file. `python` is the text of `code`, for inspection.
    """

    path: str
    files: tuple[str, ...]
    code: tuple[CodeType, ...]
    python: str
    programs: tuple[CompiledProgram, ...]
    blocks: Mapping[str, tuple[tuple[str, ty.Type], ...]]
    """By the name of a FUNCTION_BLOCK or CLASS in lower case: its variables that keep their values, with their types."""
    globals: Mapping[str, GlobalVariable]
    """The global variables that keep their values, by list and name in lower case."""
    kinds: tuple[str, ...]
    """The kind of each declaration: program, function, function block, class, interface, type or global variable."""
    warnings: tuple[StWarning, ...] = ()
    missing: tuple[t.Missing, ...] = ()
    """The declarations that were not imported and are not used."""
    recorded: Mapping[int, tuple[ty.Type, ...]] = field(default_factory=dict)
    """By number of an assertion of a unit test: the types of the values that it shows."""
    probed: Mapping[int, ty.Type] = field(default_factory=dict)
    """By number of a probe for coverage with a value: the type of the value."""
    source: t.SourceUnit = field(default_factory=t.SourceUnit)
    """The declarations as they were parsed."""
    instances: tuple[CompiledInstance, ...] = ()
    """The programs that configurations run."""
    names: Mapping[str, str] = field(default_factory=dict)
    """The names of POUs, and of actions and methods (``pou.action``), as declared, by their names in lower case."""
    symbols: Mapping[str, tuple[Symbol, ...]] = field(default_factory=dict)
    """By POU, or method (``pou.method``), in lower case: its variables, each with the Python code that reads it."""
    global_symbols: tuple[Symbol, ...] = ()
    places: tuple[t.Pos, ...] = ()
    """The position in the source of each line of `python`."""
    types: Mapping[str, ty.Type] = field(default_factory=dict)
    """The structures, function blocks and classes by name in lower case, to which pointers may refer."""
    environment: Environment | None = field(default=None, compare=False, repr=False)
    """The declarations, for expressions that are compiled later; None if the unit was compiled in a different process."""
    record: Callable[[Any], None] | None = None
    """The function that the probes of a unit with probes call (`fieldtwin.plc.st.coverage.recording`); None without probes."""
    assigned: Assigned = field(default_factory=Assigned, repr=False)
    machine_code: MachineCode | None = field(default=None, repr=False)
    """The machine code that `code` calls; None without it."""


def compile_text(text: str, path: str = "", dialect: Dialect = STANDARD) -> CompiledUnit:
    """Compile a text. Raises `FileInvalid` with line and column for the first error, and with the others."""
    return compile_unit(parse_all(text, path, dialect), path, (path,), dialect)


def compile_unit(unit: t.SourceUnit, path: str, files: tuple[str, ...], dialect: Dialect = STANDARD) -> CompiledUnit:
    """Compile the declarations of `files`: one file, or the files of the folder `path`.

    Raises `FileInvalid` with line and column for the first error, and with the others.
    """
    try:
        return _Unit(unit, path, files, dialect).compiled()
    except RecursionError as e:
        raise FileInvalid("nested too deep", path=path) from e


class _Unit:
    def __init__(self, unit: t.SourceUnit, path: str, files: tuple[str, ...], dialect: Dialect) -> None:
        self.path, self.files = path, files
        self.env = Environment(dialect)
        for warning in unit.warnings:
            self.env.warnings.add(warning)
        self.out, self.source = CodeWriter(), unit
        unit = with_called_programs(with_full_names(unit), dialect)
        unit, structures = with_inherited_members(unit, dialect, self.env.errors)
        unit = with_configured(unit, vendor=dialect.vendor)
        self.unit = without_edges(without_charts(without_addresses(unit)))
        self.unit, pous = with_inherited(without_instance_variables(self.unit, dialect), self.env.errors)
        self.env.incomplete = structures | pous
        if not dialect.vendor:
            self.unit = with_execution_control(self.unit)
        declared = {each.name.lower() for each in (*unit.pous, *unit.types)}
        self.env.missing = {m.name.lower(): m for m in unit.missing if m.name.lower() not in declared}
        self._check_names()
        self._check_addresses(unit)
        self.declarations = Declarations(self.env, self.unit, self.out)
        self.variables = Variables(self.env, self.unit, self.declarations, self.out)
        self.variables.declare_global_constants()
        self.declarations.resolve()
        self.variables.declare_globals()
        self.instances = compiled_instances(self.env, self.unit, self.declarations)
        self.functions = Functions(self.variables)
        self.blocks = Blocks(self.variables, self.functions)
        self.programs = Programs(self.variables, self.functions, self.unit)
        hierarchy = Hierarchy(self.env, self.declarations, self.functions)
        self._warn_of_uncalled()
        for pou in self.unit.pous:
            if pou.kind == "FUNCTION":
                with self.env.declaring(pou.name, self.env.faulty), self.declarations.within(pou):
                    self.env.functions[pou.name.lower()] = self.functions.signature(pou)
            elif pou.kind in KINDS:
                with self.env.declaring(pou.name, self.env.faulty), self._within(pou):
                    hierarchy.add(pou)

    def compiled(self) -> CompiledUnit:
        programs = []
        for pou in self.unit.pous:
            self.env.faulty_here.clear()
            with self.env.declaring(pou.name, self.env.faulty_here), self._within(pou):
                if pou.kind == "FUNCTION":
                    if pou.name.lower() in self.env.functions:  # without an error in its declaration
                        self.functions.write(pou)
                elif pou.kind in ("FUNCTION_BLOCK", "CLASS"):
                    self.blocks.write(pou)
                elif pou.kind == "PROGRAM":
                    programs.append(self.programs.write(pou))
        self.programs.configured.check()
        with self.env.errors.collect():
            refuse_recursion(self.env)
        self.variables.write_globals()
        self.env.errors.raise_all()
        text = "\n".join(line for line, _ in self.out.lines) + "\n"
        kinds, warnings, missing = self._kinds(), self.env.warnings.sorted(), tuple(self.env.missing.values())
        assignments = {**self.programs.recorded, **self.blocks.recorded}
        arrays = self._arrays(assignments.values())
        assigned = Assigned(assignments, self._recorded_globals(), arrays)
        places = places_of(self.out, self.path)
        code = SourceLines(places, self.path, assigned).code(text)
        recorded, probed = self.env.recorded, self.env.probed
        return CompiledUnit(
            self.path,
            self.files,
            code,
            text,
            tuple(programs),
            self.blocks.kept,
            self.variables.kept_globals(),
            kinds,
            warnings,
            missing,
            recorded,
            probed,
            self.source,
            self.instances,
            dict(self._names()),
            {name: tuple(dict.fromkeys(of.values())) for name, of in self.env.symbols.items()},
            tuple(dict.fromkeys(self.env.globals.values())),
            places,
            {key: kind for key, kind in self.env.types.items() if isinstance(kind, ty.Struct | ty.Block)},
            self.env,
            assigned=assigned,
        )

    @contextmanager
    def _within(self, pou: t.Pou) -> Iterator[None]:
        """Make the constants of `pou` available. If its base is unknown because of an error, an unknown name is not reported."""
        self.env.incomplete_here = pou.name.lower() in self.env.incomplete
        try:
            with self.declarations.within(pou):
                yield
        finally:
            self.env.incomplete_here = False

    def _recorded_globals(self) -> frozenset[str]:
        """Return the attributes of the global variables that are assigned as a whole. The others have records of their parts."""
        parts = ty.Array | ty.Struct | ty.Block
        return frozenset(v.attribute for v in self.variables.kept_globals().values() if not isinstance(v.kind, parts))

    def _arrays(self, recorded: Collection[Recorded]) -> Arrays:
        """Return the attributes that hold arrays of simple values."""
        own = {name for one in recorded for name in one.arrays}
        own |= {v.attribute for v in self.variables.kept_globals().values() if is_recorded(v.kind)}
        members: dict[bool, set[str]] = {True: set(), False: set()}
        for kind in self.env.types.values():
            for name, (_, of) in kind.fields.items() if isinstance(kind, ty.Struct) else ():
                members[is_recorded(of)].add(f"m_{name}")
        own |= members[True] & members[False]
        lent = frozenset(name for one in recorded for name in one.lent)
        return Arrays(frozenset(own), lent, frozenset(members[True] - members[False]))

    def _warn_of_uncalled(self) -> None:
        """Warn of methods that CODESYS calls by itself, and this PLC does not (decision 78)."""
        for pou in self.source.pous:
            for method in pou.methods:
                if pou.kind == "FUNCTION_BLOCK" and method.name.lower() in ("fb_exit", "fb_reinit"):
                    message = f"only calls in the program execute {method.name} of {pou.name}"
                    self.env.accepts("ST009", method.pos, message)

    def _names(self) -> Iterator[tuple[str, str]]:
        for pou in self.unit.pous:
            yield pou.name.lower(), declared_name(pou.name)
            for name in (*(one.name for one in pou.actions), *(one.name for one in pou.methods)):
                yield f"{pou.name}.{name}".lower(), name

    def _kinds(self) -> tuple[str, ...]:
        declared = (pou for pou in self.unit.pous if declared_name(pou.name) == pou.name and not is_hidden(pou.name))
        pous = [pou.kind.lower().replace("_", " ") for pou in declared]
        variables = sum(len(block.variables) for block in self.unit.globals)
        return (*pous, *["type"] * len(self.unit.types), *["global variable"] * variables)

    def _check_names(self) -> None:
        seen: set[str] = set()
        for pou in self.unit.pous:
            if pou.name.lower() in seen or pou.name.upper() in ty.ELEMENTARY:
                self.env.collected(self.env.error(pou.pos, f"{pou.name} is declared twice"))
            seen.add(pou.name.lower())

    def _check_addresses(self, unit: t.SourceUnit) -> None:
        """Check that addresses are where they are allowed, and that the variables of a POU, and the global ones, have different
        addresses. `unit` still has the addresses.
        """
        for pos, message, expected in misplaced(unit):
            self.env.collected(self.env.error(pos, message, expected=expected))
        if self.env.dialect.vendor:
            for pos, address, other in overlaps(unit, in_bytes=self.env.dialect.name == "twincat"):
                message = f"{address} and {other} share bits in {self.env.dialect.name}, which is not supported"
                self.env.collected(self.env.error(pos, message, expected="bits of one variable, such as word.3"))
        for blocks in (unit.globals, *(pou.blocks for pou in unit.pous)):
            for variable, first in shared_addresses(blocks):
                message = f"{variable.name} and {first.name} have one address"
                expected = "one variable for each address"
                self.env.collected(self.env.error(variable.pos, message, expected=expected, got=variable.location))
