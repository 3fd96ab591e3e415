"""Programs for the tests of model checking, and the execution of a model with given inputs."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import Any

import z3

from fieldtwin.plc.program import Outbox
from fieldtwin.plc.st import types as ty
from fieldtwin.plc.st.compiler.compile import compile_text
from fieldtwin.plc.st.dialects import dialect_of
from fieldtwin.plc.st.model_checking.solving import Scan, float_of
from fieldtwin.plc.st.model_checking.state import Leaf, leaves
from fieldtwin.plc.st.model_checking.transition import Builder, Transition
from fieldtwin.plc.st.program import StProgram, program_class

INTERVAL_NS = (1_000_000, 3_600_000_000_000)


def model_of(text: str, name: str = "", dialect: str = "standard") -> tuple[Transition, type[StProgram]]:
    """Return the model of a program without properties, and its class."""
    kind = program_class(compile_text(text, "", dialect_of(dialect)), name)
    return Builder(kind(), INTERVAL_NS).build([], []), kind


def constant(value: Any) -> Any:
    """Return a constant of Z3 as a value of Python; None for an expression that depends on the unknown result of an operation."""
    if z3.is_true(value) or z3.is_false(value):
        return z3.is_true(value)
    if z3.is_bv_value(value):
        return value.as_signed_long()
    return float_of(value) if z3.is_fp_value(value) else None


def model_states(transition: Transition, way: Sequence[Scan]) -> Iterator[dict[str, Any] | None]:
    """Execute the model, and yield its variables after each scan. None after a scan that fails, which is the last one.

    It ends before a scan whose state depends on the unknown result of an operation.
    """
    parts = (z3.And(transition.limited, transition.assumed), transition.fails, *transition.following)
    # One expression is replaced and simplified several times faster than its parts, which have most of their terms in common.
    all_of_it = z3.Function("all", *(part.sort() for part in parts), z3.BoolSort())(*parts)
    state: Sequence[Any] = transition.initial
    for scan in way:
        pairs = list(zip(transition.state, state, strict=True))
        for symbol, value in zip(transition.symbols, (scan.after_ns, *(v for _, v in scan.values)), strict=True):
            variable = symbol.value if isinstance(symbol.value, z3.BoolRef) else symbol.value.expr
            pairs.append((variable, _expression(variable, value)))
        for name, variable in transition.qualities.items():
            pairs.append((variable, z3.BoolVal(dict(scan.good)[name])))
        allowed, fails, *state = z3.simplify(z3.substitute(all_of_it, *pairs)).children()
        assert z3.is_true(allowed)
        if z3.is_true(fails):
            yield None
            return
        known = [constant(value) for value in state]
        if None in known:
            assert transition.unknowns
            return
        yield {
            name: value
            for name, value in zip(transition.names, known, strict=True)
            if transition.names.count(name) == 1
        }


def _expression(variable: Any, value: Any) -> Any:
    if isinstance(variable, z3.BoolRef):
        return z3.BoolVal(value)
    return z3.FPVal(value, variable.sort()) if z3.is_fp(variable) else z3.BitVecVal(value, variable.size())


def program_states(kind: type[StProgram], way: Sequence[Scan]) -> Iterator[dict[str, Any] | None]:
    """Execute the program, and yield its variables after each scan. None after a scan that fails, which is the last one."""
    from fieldtwin.plc.st.model_checking.replay import Replay

    for _, failed, program in Replay(kind).scans(way):
        if failed:
            yield None
            return
        yield {leaf.name: leaf.get() for leaf in kept(program)}


def kept(program: StProgram) -> list[Leaf]:
    """Return the variables of a program that keep their values, without times of the clock."""
    mailboxes = {v.attribute for v in program.st_declared.variables if isinstance(v.kind, ty.MessagesIn)}
    roots = ((program.st_body, ""), (program.st_resource.globals, "global"))
    every = [leaf for root, name in roots for leaf in leaves(root, name)]
    return [
        leaf for leaf in every if not leaf.is_time and not isinstance(leaf.owner, Outbox) and leaf.name not in mailboxes
    ]


def same(a: Any, b: Any) -> bool:
    """Return whether two values are equal, also two that are not a number, and zeros only with the same sign."""
    if isinstance(a, float) and isinstance(b, float):
        return (math.isnan(a) and math.isnan(b)) or (a == b and math.copysign(1, a) == math.copysign(1, b))
    return type(a) is type(b) and bool(a == b)
