"""The variables of a unit: the global ones, and those of each POU, with the code of their initial values."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

from fieldtwin.gateway.core.errors import FileInvalid
from fieldtwin.plc.st import types as ty
from fieldtwin.plc.st.classes.inheritance import INHERITED
from fieldtwin.plc.st.compiler.calls import Calls
from fieldtwin.plc.st.compiler.configurations.offers import Offered
from fieldtwin.plc.st.compiler.declarations import Declarations
from fieldtwin.plc.st.compiler.initial.order import in_order
from fieldtwin.plc.st.compiler.initial.values import InitialValues
from fieldtwin.plc.st.compiler.scope import Class, CodeWriter, Environment, Symbol, by_reference
from fieldtwin.plc.st.syntax import tree as t
from fieldtwin.plc.st.syntax.addresses import address_of, area_of, short_name
from fieldtwin.plc.st.syntax.walk import nodes


@dataclass(frozen=True, slots=True)
class GlobalVariable:
    """A global variable: its value is the `attribute` of the object with the global variables."""

    name: str
    attribute: str
    kind: ty.Type


class Variables:
    """The compiler of the variables of a unit."""

    def __init__(self, env: Environment, unit: t.SourceUnit, declarations: Declarations, out: CodeWriter) -> None:
        self.env, self.unit, self.declarations, self.out = env, unit, declarations, out
        self._globals: dict[tuple[str, str], Symbol] = {}
        """The global variables by list and name, in lower case."""
        self._lists = list(dict.fromkeys(block.list.lower() for block in unit.globals))

    # -- global variables -------------------------------------------------------------------------------------------------

    def declare_global_constants(self) -> None:
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
        name = short_name(v.name) if v.name.startswith("%") else v.name.lower()
        return f"_G.v{self._lists.index(block.list.lower()) if block.list else ''}_{name}"

    def declare_globals(self) -> None:
        """Declare all global variables, after the types are known."""
        for block in self.unit.globals:
            for v in block.variables:
                with self.env.declaring(v.name, self.env.faulty):
                    key = block.list.lower(), v.name.lower()
                    if key in self._globals:
                        self.env.fail(v.pos, f"{v.name} is declared twice")
                    symbol = self._global_symbol(v, block)
                    self._globals[key] = symbol
                    if isinstance(v.type, t.EnumType) and isinstance(symbol.type, ty.Enum):
                        self.declarations.register(symbol.type)
                    self.env.declare_global(symbol, block.list, only_qualified=block.only_qualified)
        if self._globals:
            first = self.unit.globals[0].pos
            self.declarations.bounded(first, (symbol.type for symbol in self._globals.values()))

    def _global_symbol(self, v: t.VarDecl, block: t.VarBlock) -> Symbol:
        """Return a global variable. One with an address is also known by its address, and all with one address are the same."""
        symbol, address = self._symbol(v, block, self._global_code(block, v)), address_of(v.location)
        if area_of(v.location) == "I" and symbol.constant is None:
            symbol = replace(symbol, writable=False, is_input=True)
        if not address:
            return symbol
        known = self.env.globals.setdefault(address.lower(), symbol)
        if known.type != symbol.type:
            self.env.fail(
                v.pos, f"{v.name} and {known.name} have one address", expected=str(known.type), got=str(symbol.type)
            )
        return replace(known, name=v.name)

    def offered(self, variable: Offered) -> Symbol | None:
        """Return the symbol of a global variable that a program offers; None if its declaration has an error."""
        return self._globals.get((variable.list, variable.variable.name.lower()))

    def write_globals(self) -> None:
        """Write the code of the global variables, after all code that they may need and before any program is created."""
        self.out.line("class _Globals: pass")
        self.out.line("_G = _Globals()")
        found = [
            (v, self._globals.get((block.list.lower(), v.name.lower())))
            for block in self.unit.globals
            for v in block.variables
        ]
        self.write_initials([(v, symbol) for v, symbol in found if symbol is not None], Calls(self.env, {}, self.out))

    def kept_globals(self) -> dict[str, GlobalVariable]:
        """Return the global variables that keep their values, by list and name in lower case, such as ``valves.open``."""
        return {
            ".".join(filter(None, key)): GlobalVariable(symbol.name, symbol.code.rpartition(".")[2], symbol.type)
            for key, symbol in self._globals.items()
            if not symbol.is_constant
        }

    # -- variables of POUs ------------------------------------------------------------------------------------------------

    def symbols_of(self, pou: t.Pou, prefix: str) -> dict[str, Symbol]:
        """Return all variables of a POU. `prefix` comes before their names in Python, such as ``self.``; a VAR_TEMP has none,
        because it is local to a call, unless the POU has actions, which use it too.
        """
        symbols: dict[str, Symbol] = {}
        addressed = addressed_in(pou)
        indexed = addressed | _indexed(pou)
        for block in pou.blocks:
            if pou.kind not in ("PROGRAM", "FUNCTION_BLOCK", "CLASS") or block.kind == "VAR_TEMP":
                self._no_retain(block, f"a variable of a {pou.kind}")
            for v in block.variables:
                with self.env.declaring(v.name, self.env.faulty_here):
                    if v.name.lower() in symbols:
                        self.env.fail(v.pos, f"{v.name} is declared twice")
                    before = "" if block.kind == "VAR_TEMP" and not pou.actions else prefix
                    symbol = self._variable(v, block, before, pou.kind)
                    names = indexed if isinstance(symbol.type, ty.String) else addressed
                    if "." not in symbol.code and v.name.lower() in names and not by_reference(symbol.type):
                        symbol = replace(symbol, code=f"{symbol.code}.v", reference=symbol.code)
                    symbols[v.name.lower()] = symbol
                    if address := address_of(v.location):
                        symbols.setdefault(address.lower(), symbol)
        for key, value in self.declarations.enumerated(pou).items():
            if key in symbols:
                self.env.fail(pou.pos, f"{value.name} is declared twice: as a variable and as a value of {value.type}")
            symbols[key] = value
        own = (
            symbols[v.name.lower()].type
            for b in pou.blocks
            if b.kind != "VAR_EXTERNAL"
            for v in b.variables
            if v.name.lower() in symbols
        )
        self.declarations.bounded(pou.pos, own)
        return symbols

    def _variable(self, v: t.VarDecl, block: t.VarBlock, prefix: str, of_kind: str) -> Symbol:
        of_program = of_kind == "PROGRAM"
        if block.kind == "VAR_EXTERNAL" or (_is_global(v) and not of_program):
            return self._external(v)
        code = f"{prefix}v_{v.name.lower()}"
        symbol = self._symbol(v, block, code)
        if {INHERITED, "PRIVATE"} <= block.qualifiers:
            return replace(symbol, refused=f"{v.name} is PRIVATE in the POU that declares it")
        if block.kind == "VAR_IN_OUT" and not of_program and not by_reference(symbol.type):
            return replace(symbol, code=f"{code}.v", reference=code)
        return symbol

    def _external(self, v: t.VarDecl) -> Symbol:
        found = self.env.globals.get(address_of(v.location).lower() or v.name.lower())
        if found is None:
            self.env.unknown(v.pos, "a global variable", v.name, [s.name for s in self.env.globals.values()])
        if found.type != self.declarations.type_of(v.type):
            self.env.fail(v.pos, f"{v.name} is declared with another type", expected=str(found.type))
        return replace(found, name=v.name) if v.location else found

    def _symbol(self, v: t.VarDecl, block: t.VarBlock, code: str) -> Symbol:
        kind = self.declarations.type_of(v.type, block.kind)
        if v.location and ty.holds_union(kind):
            hint = "declare a variable at the address, and assign it to a member of the union"
            self.env.fail(v.pos, f"{v.name} is or contains a union and has an address", hint=hint)
        if "CONSTANT" not in block.qualifiers:
            is_input = block.kind == "VAR_INPUT" or (area_of(v.location) == "I" and block.kind != "VAR_GLOBAL")
            return Symbol(v.name, kind, code, writable=not is_input, is_input=is_input)
        if isinstance(kind, ty.Block) and not self.env.dialect.vendor:
            self.env.fail(
                v.pos, f"{v.name} is an instance of {kind} and cannot be CONSTANT", expected="VAR without CONSTANT"
            )
        return self.declarations.constant(v, code) or Symbol(v.name, kind, code, writable=False)

    def initialise(
        self, pou: t.Pou, symbols: dict[str, Symbol], kinds: tuple[str, ...], own: Class | None = None
    ) -> None:
        """Write the initial values of the variables in the blocks of these kinds, such as VAR and VAR_OUTPUT.

        `own` is the class to which a method belongs.
        """
        of_program = pou.kind == "PROGRAM"
        blocks = (block for block in pou.blocks if block.kind in kinds)
        variables = [v for block in blocks for v in block.variables if of_program or not _is_global(v)]
        found = [(v, symbols[v.name.lower()]) for v in variables if v.name.lower() in symbols]
        compiler = Calls(self.env, symbols, self.out, pou.name.lower())
        compiler.own = self.env.classes.get(pou.name.lower()) if own is None else own
        self.write_initials(found, compiler)

    def write_initials(self, variables: Sequence[tuple[t.VarDecl, Symbol]], compiler: Calls) -> None:
        """Write the initial values of variables: those of references last, because they may refer to the others.

        In the dialects of CODESYS, an initial value may use other variables, which get their values before it.
        """
        ordered = sorted(variables, key=lambda each: isinstance(each[1].type, ty.Pointer))
        for v, symbol in in_order(self.env, ordered) if self.env.dialect.vendor else ordered:
            with self.env.errors.collect():
                self._write_initial(v, symbol, compiler)

    def _write_initial(self, v: t.VarDecl, symbol: Symbol, compiler: Calls) -> None:
        """Write the assignment of a variable's initial value. A constant needs none, because its value is written at each use."""
        if symbol.constant is not None:
            return
        if isinstance(symbol.type, ty.MessagesIn | ty.MessagesOut):
            value = "()"  # messages are passed in from outside
        elif isinstance(symbol.type, ty.Pointer) and isinstance(v.initial, t.Call | t.Ref):
            value = compiler.given(v.initial, symbol.type, v.initial.pos, "an initial value")
        elif isinstance(symbol.type, ty.OpenArray):
            of = v.type.of if isinstance(v.type, t.ArrayType) else None
            made = InitialValues(self.declarations).of(symbol.type.of, None, of)
            value = f"{symbol.code}.fresh(lambda: {made})"  # the argument has the limits of the caller's array
        else:
            values = InitialValues(self.declarations, compiler if self.env.dialect.vendor else None)
            value = values.of(symbol.type, v.initial, v.type)
        if symbol.reference:
            self.out.line(f"{symbol.reference} = _v.Cell({value})", v.pos)
        else:
            self.out.line(f"{symbol.code} = {value}", v.pos)

    def _no_retain(self, block: t.VarBlock, what: str) -> None:
        if block.qualifiers & {"RETAIN", "PERSISTENT"}:
            hint = "VAR RETAIN of a PROGRAM, FUNCTION_BLOCK or CLASS can, and global variables"
            self.env.collected(self.env.error(block.pos, f"{what} cannot be RETAIN", hint=hint))


def _indexed(pou: t.Pou) -> set[str]:
    """Return the names, in lower case, of the variables with an index after them, which may be strings."""
    refs = (node for node in nodes((pou.body, pou.actions)) if isinstance(node, t.Ref))
    return {ref.name.lower() for ref in refs if any(isinstance(selector, t.Index) for selector in ref.selectors)}


def _is_global(v: t.VarDecl) -> bool:
    """Return whether a variable of a function block is the global variable at its address."""
    return bool(address_of(v.location))


def addressed_in(pou: t.Pou) -> set[str]:
    """Return the names, in lower case, of the variables to which ADR or REF= makes a reference."""

    def found() -> Iterator[t.Expr | None]:
        initials = tuple(v.initial for block in pou.blocks for v in block.variables)
        for node in nodes((pou.body, pou.actions, initials)):
            if isinstance(node, t.Refer):
                yield node.value
            elif isinstance(node, t.Call) and node.ref.name.upper() == "ADR":
                yield from (argument.value for argument in node.arguments)

    return {expr.name.lower() for expr in found() if isinstance(expr, t.Ref)}
