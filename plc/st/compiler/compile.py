"""Compiles a unit of Structured Text to Python, once: classes for structures and function blocks, functions, and a
class for each PROGRAM.

The Python code carries the files and line numbers of the source, so that an error in a scan names the line that the user
wrote. All errors are collected: an error in one statement or declaration does not hide those in others.
The compiled code has no state: each `fieldtwin.plc.st.resource.Resource` runs it in a separate namespace.
"""

from __future__ import annotations

import ast
from collections.abc import Mapping
from dataclasses import dataclass, replace
from types import CodeType

from fieldtwin.gateway.core.errors import FileInvalid
from fieldtwin.plc.program import Program
from fieldtwin.plc.st import types as ty
from fieldtwin.plc.st.charts.translate import is_hidden, without_charts
from fieldtwin.plc.st.compiler.assignments import Assignments
from fieldtwin.plc.st.compiler.declarations import Declarations
from fieldtwin.plc.st.compiler.located import shared_addresses, without_addresses
from fieldtwin.plc.st.compiler.scope import CodeWriter, Environment, Parameter, Signature, Symbol, by_reference
from fieldtwin.plc.st.compiler.statements import Statements
from fieldtwin.plc.st.dialects import STANDARD, Dialect, StWarning
from fieldtwin.plc.st.edges import without_edges
from fieldtwin.plc.st.syntax import tree as t
from fieldtwin.plc.st.syntax.parse import parse_all

MAX_CALLS = 64
"""The longest chain of POUs that call each other."""
_API = frozenset(name for name in vars(Program) if not name.startswith("__")) | {"execute"}


@dataclass(frozen=True, slots=True)
class ProgramVariable:
    """A variable of a PROGRAM that can be bound to a tag.

    `role` is input, output or local, and `kind` the type of the tag. A `retain` variable keeps its value over restarts."""

    name: str
    role: str
    kind: ty.Type
    retain: bool


@dataclass(frozen=True, slots=True)
class CompiledProgram:
    """A PROGRAM, and the file in which it is declared."""

    name: str
    path: str
    variables: tuple[ProgramVariable, ...]


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
    """By the name of a FUNCTION_BLOCK in lower case: its variables that keep their values, with their types."""
    kinds: tuple[str, ...]
    """The kind of each declaration: program, function, function block, type or global variable."""
    warnings: tuple[StWarning, ...] = ()
    missing: tuple[t.Missing, ...] = ()
    """The declarations that were not imported and are not used."""


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
        self._globals: dict[tuple[str, str], Symbol] = {}
        """The global variables by list and name, in lower case."""
        self._lists = list(dict.fromkeys(block.list.lower() for block in unit.globals))
        self.out = CodeWriter()
        self.unit = without_edges(without_charts(without_addresses(unit)))
        self._outputs: dict[str, frozenset[str]] = {}
        """By class of a PROGRAM: the attributes that hold its outputs."""
        self._kept: dict[str, tuple[tuple[str, ty.Type], ...]] = {}
        """By function block: its variables that keep their values."""
        declared = {each.name.lower() for each in (*unit.pous, *unit.types)}
        self.env.missing = {m.name.lower(): m for m in unit.missing if m.name.lower() not in declared}
        self._check_names()
        self._check_configuration()
        self._check_addresses(unit)
        self.declarations = Declarations(self.env, self.unit, self.out)
        self._declare_global_constants()
        self.declarations.resolve()
        self._declare_globals()
        for pou in self.unit.pous:
            if pou.kind == "FUNCTION":
                with self.env.declaring(pou.name, self.env.faulty), self.declarations.within(pou):
                    self.env.functions[pou.name.lower()] = self._signature(pou)

    def compiled(self) -> CompiledUnit:
        programs = []
        for pou in self.unit.pous:
            self.env.faulty_here.clear()
            with self.env.declaring(pou.name, self.env.faulty_here), self.declarations.within(pou):
                if pou.kind == "FUNCTION":
                    if pou.name.lower() in self.env.functions:  # without an error in its declaration
                        self._write_function(pou)
                elif pou.kind == "FUNCTION_BLOCK":
                    self._write_block(pou)
                else:
                    programs.append(self._write_program(pou))
        with self.env.errors.collect():
            self._refuse_recursion()
        self._write_globals()
        self.env.errors.raise_all()
        text = "\n".join(line for line, _ in self.out.lines) + "\n"
        kinds, warnings, missing = self._kinds(), self.env.warnings.sorted(), tuple(self.env.missing.values())
        code, declared = self._code(text), tuple(programs)
        return CompiledUnit(self.path, self.files, code, text, declared, self._kept, kinds, warnings, missing)

    def _kinds(self) -> tuple[str, ...]:
        pous = [pou.kind.lower().replace("_", " ") for pou in self.unit.pous if not is_hidden(pou.name)]
        variables = sum(len(block.variables) for block in self.unit.globals)
        return (*pous, *["type"] * len(self.unit.types), *["global variable"] * variables)

    def _check_names(self) -> None:
        seen: set[str] = set()
        for pou in self.unit.pous:
            if pou.name.lower() in seen or pou.name.upper() in ty.ELEMENTARY:
                self.env.collected(self.env.error(pou.pos, f"{pou.name} is declared twice"))
            seen.add(pou.name.lower())

    def _check_configuration(self) -> None:
        """Check that the programs that a CONFIGURATION runs exist. The system file states which programs and tasks a PLC runs."""
        programs = {pou.name.lower(): pou.name for pou in self.unit.pous if pou.kind == "PROGRAM"}
        for instance in self.unit.instances:
            if instance.program.lower() not in programs.keys() | self.env.missing.keys():
                message = f"a program {instance.program!r} is not declared"
                expected = ", ".join(programs.values())
                self.env.collected(self.env.error(instance.pos, message, expected=expected))

    def _check_addresses(self, unit: t.SourceUnit) -> None:
        """Check that the variables of a POU have different addresses. `unit` still has the addresses."""
        for pou in unit.pous:
            for variable, first in shared_addresses(pou):
                message = f"{variable.name} and {first.name} have one address"
                expected = "one variable for each address"
                self.env.collected(self.env.error(variable.pos, message, expected=expected, got=variable.location))

    def _code(self, text: str) -> tuple[CodeType, ...]:
        places = self._places()
        try:
            tree = ast.parse(text)
            parts: list[tuple[str, list[ast.stmt]]] = []
            for statement in tree.body:
                path = places[statement.lineno - 1].path
                if not parts or parts[-1][0] != path:
                    parts.append((path, []))
                parts[-1][1].append(self._at_source(statement, places))
            return tuple(compile(ast.Module(body, []), path or "<st>", "exec") for path, body in parts)
        except (SyntaxError, MemoryError, RecursionError) as e:  # Python's limits; those of this compiler are narrower
            at = e.lineno if isinstance(e, SyntaxError) and e.lineno else 1
            place = places[min(at, len(places)) - 1]
            raise FileInvalid(f"too deep for the compiler: {e}", path=place.path, line=place.line, column=1) from e

    def _places(self) -> list[t.Pos]:
        """Return the position in the source of each line of the Python code."""
        last, places = t.Pos(1, 1, self.path), []
        for _, pos in self.out.lines:
            last = pos or last
            places.append(last)
        return places

    def _at_source(self, statement: ast.stmt, places: list[t.Pos]) -> ast.stmt:
        """Return a class or function of the Python code with the line numbers of the source."""
        for node in ast.walk(statement):
            if isinstance(node, ast.stmt | ast.expr | ast.arg | ast.keyword):
                node.lineno = node.end_lineno = places[min(node.lineno, len(places)) - 1].line
                node.col_offset = node.end_col_offset = 0
        if isinstance(statement, ast.ClassDef) and statement.name in self._outputs:
            Assignments(self._outputs[statement.name]).visit(statement)
        return ast.fix_missing_locations(statement)

    # -- variables --------------------------------------------------------------------------------------------------------

    def _declare_global_constants(self) -> None:
        """Declare the constants whose value is known at once, because types may use them in their limits.

        A constant may refer to one that is declared after it, so those with an error are tried again after the others.
        """
        pending = [
            (block, v)
            for block in self.unit.globals
            for v in block.variables
            if "CONSTANT" in block.qualifiers
            and isinstance(v.type, t.NamedType)
            and v.type.name.upper() in ty.ELEMENTARY
        ]
        count = len(pending) + 1
        while len(pending) < count:
            count, unknown = len(pending), set(self.env.faulty_here)
            pending = [(block, v) for block, v in pending if not self._declare_constant(block, v)]
            self.env.faulty_here = unknown
        for block, v in pending:
            with self.env.declaring(v.name, self.env.faulty):
                self.declarations.constant(v, self._global_code(block, v))

    def _declare_constant(self, block: t.VarBlock, v: t.VarDecl) -> bool:
        """Declare a global constant; return False if it has an error, also one that later declarations may remove."""
        try:
            symbol = self.declarations.constant(v, self._global_code(block, v))
        except FileInvalid:
            return False
        if symbol is not None:
            self.env.declare_global(symbol, block.list, only_qualified=block.only_qualified)
        return True

    def _global_code(self, block: t.VarBlock, v: t.VarDecl) -> str:
        """Return the Python expression of a global variable; two lists may have variables of one name."""
        return f"_G.v{self._lists.index(block.list.lower()) if block.list else ''}_{v.name.lower()}"

    def _declare_globals(self) -> None:
        for block in self.unit.globals:
            self._no_retain(block, "a VAR_GLOBAL")
            for v in block.variables:
                with self.env.declaring(v.name, self.env.faulty):
                    self._no_address(v)
                    key = block.list.lower(), v.name.lower()
                    if key in self._globals:
                        self.env.fail(v.pos, f"{v.name} is declared twice")
                    symbol = self._symbol(v, block, self._global_code(block, v))
                    self._globals[key] = symbol
                    self.env.declare_global(symbol, block.list, only_qualified=block.only_qualified)
        if self._globals:
            first = self.unit.globals[0].pos
            self.declarations.bounded(first, (symbol.type for symbol in self._globals.values()))

    def _write_globals(self) -> None:
        """Write the code of the global variables, after all code that they may need and before any program is created."""
        self.out.line("class _Globals: pass")
        self.out.line("_G = _Globals()")
        for block in self.unit.globals:
            for v in block.variables:
                symbol = self._globals.get((block.list.lower(), v.name.lower()))
                if symbol is not None:
                    self._write_initial(v, symbol)

    def _write_initial(self, v: t.VarDecl, symbol: Symbol) -> None:
        """Write the assignment of a variable's initial value. A constant needs none, because its value is written at each use."""
        if symbol.constant is None:
            with self.env.errors.collect():
                value = self.declarations.initial(symbol.type, v.initial, v.type)
                self.out.line(f"{symbol.code} = {value}", v.pos)

    def _no_retain(self, block: t.VarBlock, what: str) -> None:
        if block.qualifiers & {"RETAIN", "PERSISTENT"}:
            hint = "a PROGRAM's VAR RETAIN can, also a block in it"
            self.env.collected(self.env.error(block.pos, f"{what} cannot be RETAIN", hint=hint))

    def _no_address(self, v: t.VarDecl) -> None:
        if v.location:
            self.env.fail(
                v.pos, f"{v.name} AT {v.location}: addresses are not supported",
                hint="declare it as VAR_INPUT or VAR_OUTPUT and bind it to a tag in the system file",
            )  # fmt: skip

    def _symbol(self, v: t.VarDecl, block: t.VarBlock, code: str) -> Symbol:
        kind = self.declarations.type_of(v.type, block.kind)
        if "CONSTANT" not in block.qualifiers:
            is_input = block.kind == "VAR_INPUT"
            return Symbol(v.name, kind, code, writable=not is_input, is_input=is_input)
        return self.declarations.constant(v, code) or Symbol(v.name, kind, code, writable=False)

    def _symbols(self, pou: t.Pou, prefix: str) -> dict[str, Symbol]:
        """Return all variables of a POU. `prefix` comes before their names in Python, such as ``self.``; a VAR_TEMP has none,
        because it is local to a call, unless the POU has actions, which use it too.
        """
        symbols: dict[str, Symbol] = {}
        for block in pou.blocks:
            if pou.kind != "PROGRAM":
                self._no_retain(block, f"a variable of a {pou.kind}")
            for v in block.variables:
                with self.env.declaring(v.name, self.env.faulty_here):
                    self._no_address(v)
                    if v.name.lower() in symbols:
                        self.env.fail(v.pos, f"{v.name} is declared twice")
                    before = "" if block.kind == "VAR_TEMP" and not pou.actions else prefix
                    symbols[v.name.lower()] = self._variable(v, block, before)
        own = (
            symbols[v.name.lower()].type
            for b in pou.blocks
            if b.kind != "VAR_EXTERNAL"
            for v in b.variables
            if v.name.lower() in symbols
        )
        self.declarations.bounded(pou.pos, own)
        return symbols

    def _variable(self, v: t.VarDecl, block: t.VarBlock, prefix: str) -> Symbol:
        if block.kind == "VAR_EXTERNAL":
            return self._external(v)
        code = f"{prefix}v_{v.name.lower()}"
        symbol = self._symbol(v, block, code)
        if block.kind == "VAR_IN_OUT" and not by_reference(symbol.type):
            return replace(symbol, code=f"{code}.v", reference=code)
        return symbol

    def _external(self, v: t.VarDecl) -> Symbol:
        found = self.env.globals.get(v.name.lower())
        if found is None:
            self.env.unknown(v.pos, "a global variable", v.name, [s.name for s in self.env.globals.values()])
        if found.type != self.declarations.type_of(v.type):
            self.env.fail(v.pos, f"{v.name} is declared with another type", expected=str(found.type))
        return found

    def _initialise(self, pou: t.Pou, symbols: dict[str, Symbol], kinds: tuple[str, ...]) -> None:
        for block in pou.blocks:
            for v in block.variables if block.kind in kinds else ():
                symbol = symbols.get(v.name.lower())
                if symbol is not None:
                    self._write_initial(v, symbol)

    # -- functions --------------------------------------------------------------------------------------------------------

    def _signature(self, pou: t.Pou) -> Signature:
        found: dict[str, list[Parameter]] = {"VAR_INPUT": [], "VAR_IN_OUT": [], "VAR_OUTPUT": []}
        for block in pou.blocks:
            for v in block.variables:
                if block.kind in found:
                    kind = self.declarations.type_of(v.type)
                    initial = self.declarations.shared(self.declarations.initial(kind, v.initial, v.type))
                    found[block.kind].append(Parameter(v.name, kind, initial))
        return Signature(
            pou.name,
            self.declarations.type_of(pou.returns) if pou.returns is not None else ty.NOTHING,
            tuple(found["VAR_INPUT"]),
            tuple(found["VAR_IN_OUT"]),
            tuple(found["VAR_OUTPUT"]),
        )

    def _write_function(self, pou: t.Pou) -> None:
        signature = self.env.functions[pou.name.lower()]
        key = pou.name.lower()
        symbols = self._symbols(pou, "")
        if key in symbols:
            self.env.fail(pou.pos, f"{pou.name} is the name of the function's result, and is declared again")
        result = "None" if pou.returns is None else f"v_{key}"
        if pou.returns is not None:
            symbols.setdefault(key, Symbol(pou.name, signature.returns, result))
        arguments = ", ".join(f"v_{p.name.lower()}" for p in signature.inputs + signature.in_outs)
        body = Statements(self.env, symbols, self.out, pou.name.lower())
        results = [result, *(f"v_{p.name.lower()}" for p in signature.outputs)]
        body.leave = f"return {results[0]}" if len(results) == 1 else f"return ({', '.join(results)})"
        with self.out.block(f"def f_{key}({arguments}):", pou.pos):
            self.out.step(pou.pos)
            if pou.returns is not None:
                self.out.line(f"{result} = {self.declarations.initial(signature.returns, None, pou.returns)}", pou.pos)
            self._initialise(pou, symbols, ("VAR", "VAR_OUTPUT", "VAR_TEMP"))
            body.body(pou.body)
            self.out.line(body.leave, pou.pos)

    # -- function blocks and programs -------------------------------------------------------------------------------------

    def _write_block(self, pou: t.Pou) -> None:
        symbols = self._symbols(pou, "self.")
        self._note_parts(pou, symbols)
        held = [s for s in symbols.values() if s.code.startswith("self.")]
        kept = [s.code.split(".")[1] for s in held]
        in_outs = [f"v_{v.name.lower()}" for b in pou.blocks if b.kind == "VAR_IN_OUT" for v in b.variables]
        self._kept[pou.name.lower()] = tuple(
            (s.name, s.type) for s, attribute in zip(held, kept, strict=True) if attribute not in in_outs
        )
        with self.out.block(f"class B_{pou.name.lower()}:", pou.pos):
            self.out.line(f"__slots__ = ({''.join(repr(name) + ', ' for name in kept)})")
            self.out.line(f"in_outs = {tuple(in_outs)}")
            with self.out.block("def __init__(self):"):
                self._initialise(pou, symbols, ("VAR", "VAR_INPUT", "VAR_OUTPUT", *self._kept_temporaries(pou)))
                for attribute in in_outs:
                    self.out.line(f"self.{attribute} = None")
            with self.out.block("def execute(self, now_ns):"):
                self.out.step(pou.pos)
                self._initialise(pou, symbols, ("VAR_TEMP",))
                self._body(pou, symbols, pou.name.lower()).body(pou.body)
            self._write_actions(pou, symbols)

    def _body(self, pou: t.Pou, symbols: dict[str, Symbol], name: str) -> Statements:
        """Return the compiler of a body of a POU. `name` is that of the POU, or of an action with the POU before it."""
        body = Statements(self.env, symbols, self.out, name)
        body.owner = pou.name.lower()
        body.actions = frozenset(action.name.lower() for action in pou.actions)
        return body

    def _write_actions(self, pou: t.Pou, symbols: dict[str, Symbol], inputs: frozenset[str] = frozenset()) -> None:
        seen: set[str] = set()
        for action in pou.actions:
            key = action.name.lower()
            if key in seen or key in symbols:
                self.env.collected(self.env.error(action.pos, f"{action.name} is declared twice"))
            seen.add(key)
            with self.out.block(f"def a_{key}(self):", action.pos):
                self.out.step(action.pos)
                body = self._body(pou, symbols, f"{pou.name.lower()}.{key}")
                body.program_inputs = set(inputs)
                body.body(action.body)

    def _kept_temporaries(self, pou: t.Pou) -> tuple[str, ...]:
        """Return VAR_TEMP if the POU has actions: one may be called before the POU, so the variables have to exist."""
        return ("VAR_TEMP",) if pou.actions else ()

    def _write_program(self, pou: t.Pou) -> CompiledProgram:
        symbols = self._symbols(pou, "self.")
        self._note_parts(pou, symbols)
        variables = []
        for block in pou.blocks:
            role = {"VAR_INPUT": "input", "VAR_OUTPUT": "output", "VAR": "local"}.get(block.kind)
            if block.kind == "VAR_IN_OUT":
                self.env.fail(
                    block.pos, "a PROGRAM has no VAR_IN_OUT", hint="VAR_INPUT and VAR_OUTPUT are bound to tags"
                )
            retain = bool(block.qualifiers & {"RETAIN", "PERSISTENT"})
            for v in block.variables if role else ():
                if "CONSTANT" not in block.qualifiers and v.name.lower() in symbols:
                    kind = symbols[v.name.lower()].type
                    self._check_interface(v, kind, role or "")
                    if v.name in _API or v.name.startswith("st_"):
                        self.env.fail(v.pos, f"a PROGRAM's variable needs another name than {v.name}")
                    if retain and isinstance(kind, ty.MessagesIn | ty.MessagesOut):
                        self.env.fail(v.pos, "MESSAGES cannot be RETAIN")
                    variables.append(ProgramVariable(v.name, role or "", kind, retain))
        outputs = frozenset(f"v_{v.name.lower()}" for v in variables if v.role == "output")
        self._outputs[f"P_{pou.name.lower()}"] = outputs
        with self.out.block(f"class P_{pou.name.lower()}:", pou.pos):
            with self.out.block("def __init__(self):"):
                self._initialise_program(pou, symbols)
            with self.out.block("def execute(self):"):
                self._initialise(pou, symbols, ("VAR_TEMP",))
                inputs = frozenset(v.name for v in variables if v.role == "input")
                body = self._body(pou, symbols, pou.name.lower())
                body.program_inputs = set(inputs)
                body.body(pou.body)
            self._write_actions(pou, symbols, inputs)
        return CompiledProgram(pou.name, pou.pos.path, tuple(variables))

    def _initialise_program(self, pou: t.Pou, symbols: dict[str, Symbol]) -> None:
        """Initialise all variables with their initial values; messages are passed in from outside."""
        for block in pou.blocks:
            for v in block.variables if block.kind in ("VAR", "VAR_INPUT", "VAR_OUTPUT") else ():
                symbol = symbols.get(v.name.lower())
                if symbol is None:
                    continue
                if isinstance(symbol.type, ty.MessagesIn | ty.MessagesOut):
                    self.out.line(f"{symbol.code} = ()", v.pos)
                else:
                    self._write_initial(v, symbol)

    def _check_interface(self, v: t.VarDecl, kind: ty.Type, role: str) -> None:
        if role != "local" and isinstance(kind, ty.String | ty.Array | ty.Struct | ty.Block):
            self.env.fail(
                v.pos,
                f"{v.name} cannot be bound to a tag",
                expected="BOOL, a number, a time, an enumeration or MESSAGES",
                got=str(kind),
            )

    def _note_parts(self, pou: t.Pou, symbols: dict[str, Symbol]) -> None:
        for kind, v in (
            (symbols[v.name.lower()].type, v) for b in pou.blocks for v in b.variables if v.name.lower() in symbols
        ):
            if by_reference(kind) and isinstance(kind, ty.Block):
                self.env.calls.setdefault(pou.name.lower(), {}).setdefault(kind.name.lower(), v.pos)

    def _refuse_recursion(self) -> None:
        """Refuse a POU that calls itself, directly or through others (IEC 61131-3, 6.6.1.5)."""

        def walk(name: str, path: tuple[str, ...]) -> None:
            if len(path) > MAX_CALLS:
                pos = next(iter(self.env.calls[path[-2]].values()))
                self.env.fail(pos, "calls nested too deep", expected=f"at most {MAX_CALLS}")
            for callee, pos in self.env.calls.get(name, {}).items():
                if callee in path:
                    self.env.fail(pos, f"{callee} calls itself: {' -> '.join((*path[path.index(callee) :], callee))}")
                if callee not in done:
                    walk(callee, (*path, callee))
            done.add(name)

        done: set[str] = set()
        for name in list(self.env.calls):
            walk(name, (name,))
