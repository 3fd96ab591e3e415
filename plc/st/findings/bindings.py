"""Findings about the tags to which the variables of a PROGRAM are bound.

A wrong name, kind or direction of a binding is an error, which is found when the system is loaded. A finding is a binding that
works as long as the values are those that the user expects.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping

from fieldtwin.gateway.core.image.image import TagSpec
from fieldtwin.plc.program import Role
from fieldtwin.plc.st import types as ty
from fieldtwin.plc.st.compiler.pous.programs import ProgramVariable
from fieldtwin.plc.st.program import StProgram
from fieldtwin.plc.st.syntax import tree as t
from fieldtwin.plc.st.syntax.walk import nodes

BindingFinding = tuple[str, Role, str, str]
"""The id, the role and name of the bound variable, and the message."""


def binding_findings(
    program: StProgram, inputs: Mapping[str, str], outputs: Mapping[str, str], plant: Mapping[str, TagSpec]
) -> Iterator[BindingFinding]:
    """Yield the findings about the tags to which a program is bound. `plant` are the tags of the devices."""
    declared = {v.name: v for v in program.st_declared.variables}
    read = _read_variables(program)
    for role, names in ((Role.INPUT, inputs), (Role.OUTPUT, outputs)):
        for name, tag in names.items():
            if name not in declared:
                continue
            variable, spec = declared[name], plant.get(tag)
            if role is Role.INPUT and not variable.shared and name.lower() not in read:
                yield "ST112", role, name, f"{tag} is bound to the input {name}, which no statement uses"
            for id, message in _of_values(variable, role, spec) if spec is not None else ():
                yield id, role, name, message


def _read_variables(program: StProgram) -> frozenset[str]:
    """Return the variables that the PROGRAM and its methods use, in lower case."""
    unit = program.st_unit.source
    own = [pou for pou in unit.pous if pou.name.lower() == program.st_declared.declared_name.lower()]
    refs = [
        one for pou in own for one in nodes((pou.body, pou.actions, pou.chart, pou.methods)) if isinstance(one, t.Ref)
    ]
    connected = [name for one in unit.instances for name in (one.name.lower(), one.program.lower())]
    if program.st_declared.declared_name.lower() in connected:  # a CONFIGURATION may read its variables
        return frozenset(v.name.lower() for v in program.st_declared.variables)
    return frozenset(ref.name.lower() for ref in refs)


def _of_values(variable: ProgramVariable, role: Role, spec: TagSpec) -> Iterator[tuple[str, str]]:
    """Yield the id and message of each finding about the values of a variable and of the tag to which it is bound."""
    kind = variable.kind
    if ty.is_kind(ty.plain(kind), "duration"):
        if spec.unit not in ("", "ns"):
            message = (
                f"{variable.name} is a {kind}, which is bound as a number of ns, and {spec.name} is in {spec.unit}"
            )
            yield "ST113", message
        return
    range_of = _range(kind)
    if range_of is None or spec.limits is None:
        return
    low, high = range_of
    least, most = spec.limits
    if role is Role.INPUT and (least < low or most > high):
        message = f"{spec.name} can be {least:.10g} to {most:.10g}, and {variable.name} holds {low} to {high} only"
        yield "ST111", message
    elif role is Role.OUTPUT and isinstance(kind, ty.Subrange) and (low < least or high > most):
        message = f"{variable.name} can be {low} to {high}, and {spec.name} accepts {least:.10g} to {most:.10g} only"
        yield "ST111", message


def _range(kind: ty.Type) -> tuple[int, int] | None:
    """Return the smallest and largest value of an integer type or subrange; None for other types."""
    if isinstance(kind, ty.Subrange):
        return kind.low, kind.high
    if isinstance(kind, ty.Elementary) and kind.kind in ("int", "bits"):
        return kind.low, kind.high
    return None
