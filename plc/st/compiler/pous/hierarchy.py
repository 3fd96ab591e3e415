"""Combines the methods of classes with those that they inherit, and checks them (IEC 61131-3:2013, 6.6.5 to 6.6.7).

A method overrides one of the same name in a base and must have the same signature. A class that is not ABSTRACT has a body for
each method of its bases and interfaces.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

from fieldtwin.plc.st.compiler.declarations import Declarations
from fieldtwin.plc.st.compiler.initial.values import FB_INIT, FIXED
from fieldtwin.plc.st.compiler.pous.functions import Functions
from fieldtwin.plc.st.compiler.scope import Class, Environment, Method, Signature
from fieldtwin.plc.st.syntax import tree as t

_ACCESS = ("PUBLIC", "PROTECTED", "PRIVATE", "INTERNAL")
KINDS = ("FUNCTION_BLOCK", "CLASS", "PROGRAM", "INTERFACE")


class Hierarchy:
    """The classes of a unit, in `env.classes`."""

    def __init__(self, env: Environment, declarations: Declarations, functions: Functions) -> None:
        self.env, self.declarations, self.functions = env, declarations, functions

    def add(self, pou: t.Pou) -> None:
        """Add a POU with its methods; its bases and interfaces must have been added before."""
        for name in (*pou.extends, *pou.implements):
            self.env.refuse_missing(name.name.lower(), name.pos)
        made = Class(pou.name, pou.name.lower(), pou.kind)
        bases = [self.env.classes[n.name.lower()] for n in pou.extends if n.name.lower() in self.env.classes]
        if bases and pou.kind != "INTERFACE":
            made.ancestors = (bases[0], *bases[0].ancestors)
            made.actions.update(bases[0].actions)
            for one in made.ancestors:
                one.descendants.append(made)
        made.actions.update({action.name.lower(): made.key for action in pou.actions})
        for base in bases:
            for method in base.methods.values():
                self._inherit(pou, made, method)
        self.env.classes[made.key] = made
        seen: dict[str, t.Pos] = {}
        for declared in pou.methods:
            with self.env.declaring(declared.name, self.env.faulty):
                method = self._method(pou, declared)
                if seen.get(declared.name.lower(), declared.pos) != declared.pos or self._is_variable(
                    pou, declared.name
                ):
                    self.env.fail(declared.pos, f"{declared.name} is declared twice in {pou.name}")
                seen[declared.name.lower()] = declared.pos
                before = made.methods.get(method.attribute)
                made.methods[method.attribute] = method
                self._check_override(declared, method, before)
        if pou.kind in ("FUNCTION_BLOCK", "CLASS"):
            made.type = self.declarations.named(pou.name, pou.pos)
            if made.key not in self.env.incomplete:
                self._check_complete(pou, made)

    def _is_variable(self, pou: t.Pou, name: str) -> bool:
        names = {v.name.lower() for block in pou.blocks for v in block.variables}
        return name.lower() in names | {action.name.lower() for action in pou.actions}

    def _inherit(self, pou: t.Pou, made: Class, method: Method) -> None:
        before = made.methods.setdefault(method.attribute, method)
        if before is not method and not _same(before.signature, method.signature):
            self.env.fail(pou.pos, f"{pou.name} extends {before} and {method}, which have different signatures")

    # -- one method ---------------------------------------------------------------------------------------------------------

    def _method(self, pou: t.Pou, declared: t.Pou) -> Method:
        vendor = self.env.dialect.vendor
        if declared.kind != "METHOD" and not vendor:
            hint = "the standard has methods only; the dialects codesys and twincat have properties"
            self.env.fail(declared.pos, f"property {declared.name}", expected="a METHOD", hint=hint)
        if pou.kind == "PROGRAM" and not vendor:
            hint = "the dialects codesys and twincat allow it"
            self.env.fail(
                declared.pos, f"method {declared.name} in a PROGRAM", expected="one in a FUNCTION_BLOCK", hint=hint
            )
        if vendor and declared.name.lower() == FB_INIT.lower():
            self._check_creation(declared)
        given = [word for word in _ACCESS if word in declared.modifiers]
        if len(given) > 1:
            self.env.fail(declared.pos, f"{declared.name} is {' and '.join(given)}", expected="one of them")
        default = "PUBLIC" if vendor or pou.kind == "INTERFACE" else "PROTECTED"
        abstract = pou.kind == "INTERFACE" or "ABSTRACT" in declared.modifiers
        with self.declarations.within(declared):
            signature = self.functions.signature(declared)
        final = bool({"FINAL", "PRIVATE"} & declared.modifiers)
        access = given[0] if given else default
        method = Method(signature, declared.kind, pou.name, access, abstract, final, declared.pos)
        if abstract and declared.body:
            expected = "none, because it is ABSTRACT or belongs to an INTERFACE"
            self.env.fail(declared.body[0].pos, f"{method} has statements", expected=expected)
        if abstract and pou.kind != "INTERFACE" and "ABSTRACT" not in pou.modifiers:
            self.env.fail(declared.pos, f"{method} is ABSTRACT", expected=f"{pou.kind} ABSTRACT {pou.name}")
        return method

    def _check_creation(self, declared: t.Pou) -> None:
        """Check the parameters of FB_init."""
        inputs = [v for b in declared.blocks if b.kind == "VAR_INPUT" for v in b.variables]
        fixed = [
            v.name.lower()
            for v in inputs[: len(FIXED)]
            if isinstance(v.type, t.NamedType) and v.type.name.upper() == "BOOL"
        ]
        if fixed != [name.lower() for name in FIXED]:
            expected = " and ".join(f"{name} : BOOL" for name in FIXED)
            self.env.fail(declared.pos, f"the first two inputs of {FB_INIT}", expected=expected)
        for block in declared.blocks:
            if block.kind == "VAR_IN_OUT":
                self.env.fail(block.pos, f"VAR_IN_OUT in {FB_INIT}", expected="REFERENCE TO or POINTER TO in VAR_INPUT")

    def _check_override(self, declared: t.Pou, method: Method, before: Method | None) -> None:
        if before is None:
            if "OVERRIDE" in declared.modifiers and not self.env.incomplete_here:
                self.env.fail(declared.pos, f"{method} is declared OVERRIDE, but no base has it")
            return
        if before.final:
            word = "PRIVATE" if before.access == "PRIVATE" else "FINAL"
            self.env.fail(declared.pos, f"{method} overrides {before}, which is {word}")
        if self.env.dialect.vendor and declared.name.lower() == FB_INIT.lower():
            return  # it may have more parameters, and both are called
        if not _same(before.signature, method.signature):
            self.env.fail(
                declared.pos, f"{method} overrides {before} with a different signature",
                expected=_described(before.signature), got=_described(method.signature),
            )  # fmt: skip
        if self.env.dialect.vendor:
            return
        if "OVERRIDE" not in declared.modifiers:
            self.env.fail(declared.pos, f"{method} overrides {before}", expected="METHOD OVERRIDE, or a different name")
        if before.access != method.access:
            got = method.access
            self.env.fail(
                declared.pos, f"{method} overrides {before} with a different access", expected=before.access, got=got
            )

    # -- a whole class ------------------------------------------------------------------------------------------------------

    def _check_complete(self, pou: t.Pou, made: Class) -> None:
        """Check that a class implements its interfaces, and, if it is not ABSTRACT, all methods."""
        abstract = "ABSTRACT" in pou.modifiers
        for name in pou.implements:
            interface = self.env.classes.get(name.name.lower())
            for attribute, wanted in interface.methods.items() if interface is not None else ():
                found = made.methods.get(attribute)
                with self.env.errors.collect():
                    if found is None and not abstract:
                        hint = "declare it, or declare the POU ABSTRACT"
                        expected = f"{wanted.kind} {_described(wanted.signature)}"
                        self.env.fail(name.pos, f"{pou.name} does not implement {wanted}", expected=expected, hint=hint)
                    if found is None:
                        made.methods[attribute] = replace(wanted, owner=pou.name)
                    else:
                        self._check_implementation(found, wanted, name.pos)
        if not abstract:
            for method in made.methods.values():
                if method.abstract and method.owner != pou.name:
                    hint = "override it, or declare the POU ABSTRACT"
                    self.env.collected(
                        self.env.error(pou.pos, f"{pou.name} does not implement {method}, which is ABSTRACT", hint=hint)
                    )

    def _check_implementation(self, found: Method, wanted: Method, at: t.Pos) -> None:
        pos = found.pos if found.pos.path == at.path else at
        if not _same(found.signature, wanted.signature):
            self.env.fail(
                pos, f"{found} implements {wanted} with a different signature",
                expected=_described(wanted.signature), got=_described(found.signature),
            )  # fmt: skip
        if found.access not in ("PUBLIC", "INTERNAL"):
            self.env.fail(pos, f"{found} implements {wanted}", expected="METHOD PUBLIC", got=found.access)


def _parts(signature: Signature) -> Iterable[tuple[str, tuple[tuple[str, object], ...]]]:
    for kind, parameters in (("", signature.inputs), ("IN_OUT ", signature.in_outs), ("OUTPUT ", signature.outputs)):
        yield kind, tuple((p.name.lower(), p.type) for p in parameters)


def _same(a: Signature, b: Signature) -> bool:
    """Return whether parameters (names, types, order) and results are equal."""
    return a.returns == b.returns and list(_parts(a)) == list(_parts(b))


def _described(signature: Signature) -> str:
    """Return a signature as a message shows it: ``Start(speed : INT) : BOOL``."""
    shown = ", ".join(f"{kind}{name} : {of}" for kind, found in _parts(signature) for name, of in found)
    return f"{signature.name}({shown}) : {signature.returns}"
