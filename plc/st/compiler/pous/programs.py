"""The code of programs (IEC 61131-3:2013, 6.6.4). A PROGRAM becomes a class, and its variables can be bound to tags."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from inspect import isfunction
from itertools import islice

from fieldtwin.plc.program import Program
from fieldtwin.plc.st import types as ty
from fieldtwin.plc.st.compiler.assignments import Recorded, is_recorded
from fieldtwin.plc.st.compiler.configurations.configured import ConfiguredParts
from fieldtwin.plc.st.compiler.configurations.instances import declared_name
from fieldtwin.plc.st.compiler.configurations.offers import Offered, Offers
from fieldtwin.plc.st.compiler.configurations.parts import MAX_PARTS, Parts
from fieldtwin.plc.st.compiler.pous.blocks import Bodies
from fieldtwin.plc.st.compiler.pous.functions import Functions
from fieldtwin.plc.st.compiler.pous.variables import Variables
from fieldtwin.plc.st.compiler.scope import Symbol, Value, identifier
from fieldtwin.plc.st.compiler.statements import Statements
from fieldtwin.plc.st.runtime.parts import Key
from fieldtwin.plc.st.syntax import tree as t
from fieldtwin.plc.st.syntax.addresses import address_of, area_of, short_name

METHODS = frozenset(name for name, of in vars(Program).items() if isfunction(of) and not name.startswith("__"))
"""The methods of programs. A variable may have the name of one, because its value is found in the dictionary of the instance."""
_API = frozenset(name for name in vars(Program) if not name.startswith("__")) - METHODS


COMPOUND = (ty.String, ty.Array, ty.Struct)
"""The types of inputs and outputs of a PROGRAM that cannot be tags. Only a CONFIGURATION can connect them."""
_BLOCKS = {"VAR_INPUT": "input", "VAR_OUTPUT": "output", "VAR_IN_OUT": "local", "VAR": "local"}
"""The role of the variables in each block. A VAR_IN_OUT is a variable of the program, which a CONFIGURATION may connect."""
_ROLES = {"I": "input", "Q": "output", "M": "local"}
_AREAS = {"input": "%I*", "output": "%Q*"}


@dataclass(frozen=True, slots=True)
class ProgramVariable:
    """A variable of a PROGRAM, or a part of one, that can be bound to a tag.

    `role` is input, output or local, and `kind` the type of the tag. A `retain` variable keeps its value over restarts. Its
    value is the `attribute` of the program's object, or of the object with the global variables if it is `shared`. The value of
    a part, such as ``pump.fault``, is the `attribute`, or the element, of the object that is reached from there through
    `steps`. `location` is its address, if any. An `optional` input need not be bound to a tag.
    """

    name: str
    role: str
    kind: ty.Type
    retain: bool
    attribute: Key
    shared: bool = False
    location: str = ""
    optional: bool = False
    steps: tuple[Key, ...] = ()
    of_block: str = ""
    """The function block, in lower case, of which it is a variable."""
    unused: bool = False
    """Whether it is a global variable that no program uses."""


@dataclass(frozen=True, slots=True)
class CompiledProgram:
    """A PROGRAM, or its copy for a program of a configuration, and the file in which it is declared."""

    name: str
    path: str
    variables: tuple[ProgramVariable, ...]

    @property
    def declared_name(self) -> str:
        """Return the name of the PROGRAM in the source."""
        return declared_name(self.name)

    @property
    def own(self) -> list[tuple[str, ty.Type]]:
        """Return the names and types of the variables that are neither global ones nor parts of others."""
        return [(v.name, v.kind) for v in self.variables if not v.shared and not v.steps]


class Programs(Bodies):
    """The compiler of the programs of a unit."""

    def __init__(self, variables: Variables, functions: Functions, unit: t.SourceUnit) -> None:
        super().__init__(variables, functions)
        self._unit = unit
        self._parts = Parts(unit, self.declarations)
        self._offers = Offers(unit)
        self.configured = ConfiguredParts(self.env, self.declarations, unit)
        self.recorded: dict[str, Recorded] = {}
        """By class of a PROGRAM: the attributes whose assignments are recorded, among them its outputs and local variables."""

    def write(self, pou: t.Pou) -> CompiledProgram:
        """Write the class of a PROGRAM."""
        symbols = self.env.symbols[pou.name.lower()] = self.variables.symbols_of(pou, "self.")
        self.note_parts(pou, symbols)
        variables = []
        for block in pou.blocks:
            role = _BLOCKS.get(block.kind)
            retain = bool(block.qualifiers & {"RETAIN", "PERSISTENT"})
            for v in block.variables if role else ():
                if "CONSTANT" not in block.qualifiers and v.name.lower() in symbols:
                    kind = symbols[v.name.lower()].type
                    self._check_interface(v, kind, role or "")
                    if _is_reserved(v.name):
                        self.env.fail(v.pos, f"a PROGRAM's variable needs another name than {v.name}")
                    if retain:
                        self._check_retained(v, kind)
                    attribute = f"v_{v.name.lower()}"
                    address, located = address_of(v.location), bool(v.location)
                    variables.append(
                        ProgramVariable(v.name, role or "", kind, retain, attribute, location=address, optional=located)
                    )
        assigned = frozenset(str(v.attribute) for v in variables if v.role != "input")
        own = [part for v in variables for part in self._parts_of(pou, v, f"{pou.name}.{v.name}")]
        variables += own
        variables += self._offered(pou, {v.name.lower() for v in variables})
        arrays = frozenset(
            f"v_{s.name.lower()}" for s in symbols.values() if s.code.startswith("self.") and is_recorded(s.type)
        )
        self.recorded[f"P_{identifier(pou.name)}"] = Recorded(assigned - arrays, arrays)
        with self.out.block(f"class P_{identifier(pou.name)}:", pou.pos):
            with self.out.block("def __init__(self):"):
                self.variables.initialise(pou, symbols, tuple(_BLOCKS))
                self.configured.write_initials(self.out, pou)
            with self.out.block("def execute(self):"):
                self.variables.initialise(pou, symbols, ("VAR_TEMP",))
                inputs = frozenset(v.name for v in variables if v.role == "input" and not isinstance(v.kind, COMPOUND))
                body = self.body_of(pou, symbols, pou.name.lower())
                body.program_inputs = set(inputs)
                body.body(pou.body)
            self.write_actions(pou, symbols, inputs)
            self.write_methods(pou, symbols, inputs)
            for instance in self._unit.instances:
                if instance.program.lower() == pou.name.lower() and instance.arguments:
                    self._write_connections(instance, pou, symbols)
        return CompiledProgram(pou.name, pou.pos.path, tuple(variables))

    def _write_connections(self, instance: t.Instance, pou: t.Pou, symbols: dict[str, Symbol]) -> None:
        """Write the methods that copy global variables to the inputs of a program, and its outputs to global variables."""
        valid = [argument for argument in instance.arguments if self._is_connection(argument, pou)]
        body = Statements(self.env, {}, self.out, pou.name.lower())  # the arguments are outside of the program
        for into in (True, False):
            with self.out.block(f"def {connection(instance.name, into=into)}(self):", instance.pos):
                for argument in valid:
                    symbol = symbols.get(argument.name.lower())
                    if symbol is None:
                        continue
                    with self.env.errors.collect():
                        self._write_connection(argument, body, symbol, instance, into=into)

    def _write_connection(
        self, argument: t.Argument, body: Statements, symbol: Symbol, instance: t.Instance, *, into: bool
    ) -> None:
        """Write one copy before (`into`) or after the scan. A VAR_IN_OUT is copied both times."""
        if argument.value is None:
            if not into:
                body.take(argument, Value(symbol.code, symbol.type))
        elif into:
            value = body.value(argument.value, symbol.type)
            code = body.coerced(value, symbol.type, argument.pos, f"{argument.name} of {instance.name}")
            if isinstance(symbol.type, ty.Array | ty.Struct):
                function = "fill" if isinstance(symbol.type, ty.Array) else "put"
                self.out.line(f"_v.{function}({symbol.code}, {code})", argument.pos)
            else:
                self.out.line(f"{symbol.code} = {code}", argument.pos)
        elif not symbol.is_input:
            if not isinstance(argument.value, t.Ref):
                self.env.fail(
                    argument.pos, f"{argument.name} of {instance.name}", expected="a variable for a VAR_IN_OUT"
                )
            body.assign(argument.value, Value(symbol.code, symbol.type), argument.pos)

    def _is_connection(self, argument: t.Argument, pou: t.Pou) -> bool:
        """Return whether an argument of a program is an input with a valueor an output with a target; add an error if not."""
        is_input = argument.value is not None
        kinds, what = (("VAR_INPUT", "VAR_IN_OUT"), "input") if is_input else (("VAR_OUTPUT",), "output")
        known = [v.name for b in pou.blocks if b.kind in kinds for v in b.variables if not v.location]
        if argument.name.lower() in {name.lower() for name in known}:
            return True
        message, expected = (
            f"{declared_name(pou.name)} has no {what} {argument.name!r}",
            ", ".join(known) or f"a program with an {what}",
        )
        self.env.collected(self.env.error(argument.pos, message, expected=expected))
        return False

    def _parts_of(self, pou: t.Pou, of: ProgramVariable, *paths: str) -> Iterator[ProgramVariable]:
        """Yield the located parts of a variable that a program offers: those at %I and %Q, and those at %M with an address.

        `paths` are the paths of the variable in VAR_CONFIG.
        """
        area = _AREAS.get(of.role, "") if of.optional and isinstance(of.kind, ty.Array | ty.Struct) else ""
        found = list(islice(self._parts.of(of.kind, of.attribute, area), MAX_PARTS + 1))
        if len(found) > MAX_PARTS:
            message = f"{of.name} has too many variables at %I* and %Q*"
            self.env.fail(pou.pos, message, expected=f"at most {MAX_PARTS}")
        for part in found:
            location = self.configured.address(part, *(f"{path}{part.path}" for path in paths))
            role = _ROLES[area_of(part.location)]
            if (role != "local" or location) and _is_bindable(part.type):
                yield ProgramVariable(
                    f"{of.name}{part.path}",
                    role,
                    part.type,
                    False,
                    part.key,
                    of.shared,
                    location,
                    True,
                    part.steps,
                    part.block,
                )

    def _offered(self, pou: t.Pou, taken: set[str]) -> Iterator[ProgramVariable]:
        """Yield the located and the retained global variables, and located parts of global variables, that a program uses.
        `taken` has the names of its variables, in lower case.
        """
        for one in self._offers.of(pou):
            symbol = self.variables.offered(one)
            if symbol is None or symbol.constant is not None:
                continue
            if one.unused and (one.name.lower() in taken or _is_reserved(one.name) or not _is_bindable(symbol.type)):
                continue
            of = self._offered_variable(one, symbol, taken, pou)
            if one.variable.location or one.retain:
                yield of
            yield from self._parts_of(pou, of, f"{one.list}.{one.variable.name}", one.variable.name)

    def _offered_variable(self, one: Offered, symbol: Symbol, taken: set[str], pou: t.Pou) -> ProgramVariable:
        v, address = one.variable, address_of(one.variable.location)
        name = short_name(address) if _is_reserved(one.name) and address else one.name
        if name.lower() in taken or (_is_reserved(name) and v.location):
            expected = f"a name that {declared_name(pou.name)} does not use"
            self.env.fail(v.pos, f"the global variable {v.name} needs another name", expected=expected)
        taken.add(name.lower())
        role = _ROLES[area_of(v.location)] if v.location else "local"
        self._check_interface(v, symbol.type, role)
        if one.retain:
            self._check_retained(v, symbol.type)
        attribute = symbol.code.rpartition(".")[2]
        return ProgramVariable(
            name, role, symbol.type, one.retain, attribute, True, address, optional=True, unused=one.unused
        )

    def _check_retained(self, v: t.VarDecl, kind: ty.Type) -> None:
        if ty.holds_interface(kind):
            hint = "a restart creates new instances, so assign the reference again"
            self.env.fail(v.pos, f"{v.name} is RETAIN and refers to an instance", hint=hint)
        if isinstance(kind, ty.MessagesIn | ty.MessagesOut):
            self.env.fail(v.pos, "MESSAGES cannot be RETAIN")
        if isinstance(kind, ty.Pointer):
            self.env.fail(v.pos, f"{v.name}, a {kind}, cannot be RETAIN", hint="assign it in the first scan")

    def _check_interface(self, v: t.VarDecl, kind: ty.Type, role: str) -> None:
        if role == "local" or (isinstance(kind, ty.Array | ty.Struct) and _is_divisible(kind)):
            return
        if isinstance(kind, COMPOUND) and (not v.location or ("*" in v.location and self.env.dialect.vendor)):
            return
        if not _is_bindable(kind):
            self.env.fail(
                v.pos,
                f"{v.name} cannot be bound to a tag",
                expected="BOOL, a number, a time, an enumeration or MESSAGES",
                got=str(kind),
            )


def _is_divisible(kind: ty.Type) -> bool:
    """Return whether the parts of a variable can be bound: it is a structure, or an array without function blocks."""
    while isinstance(kind, ty.Array):
        kind = kind.of
    return isinstance(kind, ty.Struct) or _is_bindable(kind)


def _is_bindable(kind: ty.Type) -> bool:
    """Return whether a variable of this type can be bound to a tag."""
    parts = (*COMPOUND, ty.Block, ty.Pointer, ty.Interface, ty.OpenArray)
    return not isinstance(kind, parts) and not ty.is_kind(kind, "char")


def connection(instance: str, *, into: bool) -> str:
    """Return the name of the method that sets the inputs of an instance (`into`), or copies its outputs."""
    return f"{'into' if into else 'from'}_{instance.lower()}"


def _is_reserved(name: str) -> bool:
    """Return whether a variable of a program must not have this name, because the class of programs uses it."""
    return name in _API or name.startswith("st_")
