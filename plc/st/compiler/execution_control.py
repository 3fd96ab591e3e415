"""Execution control with EN and ENO (IEC 61131-3:2013, 6.6.1.5, table 18).

Each call may have ``EN := condition`` and ``ENO => variable``, also of a POU that does not declare them. If EN is FALSE, the call
is not executed, its arguments are not evaluated, and ENO is FALSE. The variables at its outputs keep their values, and its result
is the initial value of its type. A run-time error stops the task, so ENO is never FALSE because of one.

A POU may declare ``VAR_INPUT EN : BOOL := TRUE;`` and ``VAR_OUTPUT ENO : BOOL;``. Its body is executed only if EN is TRUE, and
may assign FALSE to ENO. In CODESYS and TwinCAT, declared variables of these names have no such effect.
"""

from __future__ import annotations

from collections.abc import Container
from dataclasses import replace

from fieldtwin.plc.st.compiler.scope import Environment
from fieldtwin.plc.st.syntax import tree as t


def with_execution_control(unit: t.SourceUnit) -> t.SourceUnit:
    """Return `unit` with the bodies of its functions and function blocks that declare EN or ENO under their control."""
    left_out = ("PROGRAM", "INTERFACE")
    return replace(unit, pous=tuple(pou if pou.kind in left_out else _controlled(pou) for pou in unit.pous))


def _controlled(pou: t.Pou) -> t.Pou:
    en, eno = _declared(pou, "VAR_INPUT", "EN"), _declared(pou, "VAR_OUTPUT", "ENO")
    body = pou.body
    if eno is not None:
        body = (_assigned(pou.pos, eno, "TRUE"), *body)
    if en is not None:
        otherwise = () if eno is None else (_assigned(pou.pos, eno, "FALSE"),)
        body = (t.If(pou.pos, ((t.Ref(pou.pos, en.name), body),), otherwise),)
    methods = tuple(one if "ABSTRACT" in one.modifiers else _controlled(one) for one in pou.methods)
    return replace(pou, body=body, methods=methods)


def _declared(pou: t.Pou, kind: str, name: str) -> t.VarDecl | None:
    """Return the variable `name` of a POU if it is a BOOL in a block of `kind`."""
    for block in pou.blocks:
        for variable in block.variables if block.kind == kind else ():
            of = variable.type
            if variable.name.upper() == name and isinstance(of, t.NamedType) and of.name.upper() == "BOOL":
                return variable
    return None


def _assigned(pos: t.Pos, variable: t.VarDecl, word: str) -> t.Assign:
    return t.Assign(pos, t.Ref(pos, variable.name), t.Literal(pos, word, word))


def split_control(
    env: Environment, call: t.Call, declared: Container[str]
) -> tuple[t.Call, t.Expr | None, t.Argument | None]:
    """Return `call` without the arguments EN and ENO, the value of EN, and the argument ENO; None for one that is not given.

    `declared`: the parameters of what is called, in lower case. An EN or ENO that it declares is an ordinary argument.
    Raises `FileInvalid` for one that is given twice, and for an empty argument in a dialect that has none.
    """
    if call.empty is not None and not env.dialect.vendor:
        env.fail(
            call.empty,
            f"an empty argument of {call.ref.name}",
            expected="a value or a variable (or leave the argument out)",
        )
    en: t.Expr | None = None
    eno: t.Argument | None = None
    rest: list[t.Argument] = []
    for argument in call.arguments:
        name = argument.name.lower()
        is_en = name == "en" and argument.value is not None and name not in declared
        is_eno = name == "eno" and argument.target is not None and name not in declared
        if (is_en and en is not None) or (is_eno and eno is not None):
            env.fail(argument.pos, f"parameter {argument.name} of {call.ref.name} is given twice")
        if is_en:
            en = argument.value
        elif is_eno:
            eno = argument
        else:
            rest.append(argument)
    return replace(call, arguments=tuple(rest)), en, eno
