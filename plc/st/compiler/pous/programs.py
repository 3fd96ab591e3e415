"""The code of programs (IEC 61131-3:2013, 6.6.4). A PROGRAM becomes a class, and its variables can be bound to tags."""

from __future__ import annotations

from dataclasses import dataclass

from fieldtwin.plc.program import Program
from fieldtwin.plc.st import types as ty
from fieldtwin.plc.st.compiler.pous.blocks import Bodies
from fieldtwin.plc.st.compiler.pous.variables import Variables
from fieldtwin.plc.st.compiler.scope import Symbol
from fieldtwin.plc.st.syntax import tree as t

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


class Programs(Bodies):
    """The compiler of the programs of a unit."""

    def __init__(self, variables: Variables) -> None:
        super().__init__(variables)
        self.outputs: dict[str, frozenset[str]] = {}
        """By class of a PROGRAM: the attributes that hold its outputs."""

    def write(self, pou: t.Pou) -> CompiledProgram:
        """Write the class of a PROGRAM."""
        symbols = self.variables.symbols_of(pou, "self.")
        self.note_parts(pou, symbols)
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
        self.outputs[f"P_{pou.name.lower()}"] = outputs
        with self.out.block(f"class P_{pou.name.lower()}:", pou.pos):
            with self.out.block("def __init__(self):"):
                self._initialise_program(pou, symbols)
            with self.out.block("def execute(self):"):
                self.variables.initialise(pou, symbols, ("VAR_TEMP",))
                inputs = frozenset(v.name for v in variables if v.role == "input")
                body = self.body_of(pou, symbols, pou.name.lower())
                body.program_inputs = set(inputs)
                body.body(pou.body)
            self.write_actions(pou, symbols, inputs)
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
                    self.variables.write_initial(v, symbol)

    def _check_interface(self, v: t.VarDecl, kind: ty.Type, role: str) -> None:
        if role != "local" and isinstance(kind, ty.String | ty.Array | ty.Struct | ty.Block):
            self.env.fail(
                v.pos,
                f"{v.name} cannot be bound to a tag",
                expected="BOOL, a number, a time, an enumeration or MESSAGES",
                got=str(kind),
            )
