"""The code of functions (IEC 61131-3:2013, 6.6.2). A FUNCTION becomes a Python function."""

from __future__ import annotations

from fieldtwin.plc.st import types as ty
from fieldtwin.plc.st.compiler.pous.variables import Variables, addressed_in
from fieldtwin.plc.st.compiler.scope import Parameter, Signature, Symbol, by_reference, identifier, open_outputs
from fieldtwin.plc.st.compiler.statements import Statements
from fieldtwin.plc.st.syntax import tree as t


class Functions:
    """The compiler of the functions of a unit."""

    def __init__(self, variables: Variables) -> None:
        self.env, self.declarations, self.out = variables.env, variables.declarations, variables.out
        self.variables = variables

    def signature(self, pou: t.Pou) -> Signature:
        """Return the signature of a FUNCTION, whose body may not have been compiled yet."""
        found: dict[str, list[Parameter]] = {"VAR_INPUT": [], "VAR_IN_OUT": [], "VAR_OUTPUT": []}
        for block in pou.blocks:
            for v in block.variables:
                if block.kind in found:
                    kind = self.declarations.type_of(v.type, block.kind if isinstance(v.type, t.ArrayType) else "")
                    if block.kind == "VAR_IN_OUT":
                        found[block.kind].append(Parameter(v.name, kind, ""))
                        continue
                    initial = self.declarations.shared(self.declarations.initial(kind, v.initial, v.type))
                    found[block.kind].append(Parameter(v.name, kind, initial))
        return Signature(
            pou.name,
            self.declarations.type_of(pou.returns) if pou.returns is not None else ty.NOTHING,
            tuple(found["VAR_INPUT"]),
            tuple(found["VAR_IN_OUT"]),
            tuple(found["VAR_OUTPUT"]),
            tuple(v.name for block in pou.blocks if block.kind in ty.GIVEN for v in block.variables),
        )

    def write(self, pou: t.Pou) -> None:
        """Write the Python function of a FUNCTION."""
        signature = self.env.functions[pou.name.lower()]
        key = pou.name.lower()
        symbols = self.env.symbols[key] = self.variables.symbols_of(pou, "")
        body = Statements(self.env, symbols, self.out, key)
        self.write_body(pou, signature, body, f"f_{identifier(pou.name)}", "")

    def write_body(self, pou: t.Pou, signature: Signature, body: Statements, name: str, instance: str) -> None:
        """Write the Python function `name` of a FUNCTION or method. `instance` is the name of its first argument, if it has one.

        `body` compiles its statements; its symbols are the variables of the POU, and those of its owner.
        """
        key, symbols = pou.name.rpartition(".")[2].lower(), body.symbols
        own = {v.name.lower() for block in pou.blocks for v in block.variables}
        result = "None" if pou.returns is None else f"v_{key}"
        if pou.returns is not None and key in own:
            word = "function" if pou.kind == "FUNCTION" else "method"
            self.env.fail(pou.pos, f"{pou.name} is the name of the {word}'s result, and is declared again")
        reference = result if pou.returns is not None and key in addressed_in(pou) else ""
        if by_reference(signature.returns):
            reference = ""
        if reference:
            result = f"{reference}.v"
        if pou.returns is not None:
            symbols[key] = Symbol(pou.name, signature.returns, result, reference=reference)
        lent = open_outputs(signature.outputs)
        arguments = [f"v_{p.name.lower()}" for p in (*signature.inputs, *signature.in_outs, *lent)]
        results = [result, *(symbols[p.name.lower()].code for p in signature.outputs)]
        body.leave = f"return {results[0]}" if len(results) == 1 else f"return ({', '.join(results)})"
        with self.out.block(f"def {name}({', '.join([instance] * bool(instance) + arguments)}):", pou.pos):
            self.out.step(pou.pos)
            if pou.returns is not None:
                value = self.declarations.initial(signature.returns, None, pou.returns)
                self.out.line(f"{reference} = _v.Cell({value})" if reference else f"{result} = {value}", pou.pos)
            for p in signature.inputs:
                if reference := symbols[p.name.lower()].reference:
                    self.out.line(f"{reference} = _v.Cell({reference})", pou.pos)
            self.variables.initialise(pou, symbols, ("VAR", "VAR_OUTPUT", "VAR_TEMP"), body.own)
            body.body(pou.body)
            self.out.line(body.leave, pou.pos)
