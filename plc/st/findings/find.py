"""The findings about each POU of a unit.

A rule reports a construct only if the tree alone shows that it is suspicious. The unit has to be compiled first, so names and
types are valid here.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from itertools import pairwise

from fieldtwin.plc.st.compiler.configurations.located import overlaps
from fieldtwin.plc.st.dialects import StWarning
from fieldtwin.plc.st.findings.calls import called_sometimes
from fieldtwin.plc.st.syntax import tree as t
from fieldtwin.plc.st.syntax.addresses import area_of
from fieldtwin.plc.st.syntax.walk import nodes
from fieldtwin.plc.st.syntax.written import reference, text_of

_LOCAL = ("VAR", "VAR_TEMP", "VAR_EXTERNAL")
_COMPARISONS = ("=", "<>", "<", ">", "<=", ">=")
_REALS = ("REAL", "LREAL")
_REAL_FUNCTIONS = ("SQRT", "LN", "LOG", "EXP", "SIN", "COS", "TAN", "ASIN", "ACOS", "ATAN", "ATAN2")
Finding = tuple[str, t.Pos, str]
"""The id, the place, and the message."""


def findings(unit: t.SourceUnit) -> Iterator[StWarning]:
    """Yield the findings about a unit that compiles, POU by POU."""
    for pos, address, other in overlaps(unit, in_bytes=False):
        message = f"{address} and {other} are separate variables here and in OpenPLC, but share bits in CODESYS"
        yield StWarning("ST109", message, pos.path, pos.line, pos.column)
    enums = {one.name.lower(): one for one in unit.types if isinstance(one, t.EnumDecl)}
    pous = {pou.name.lower(): pou for pou in unit.pous}
    for pou in (one for one in unit.pous if one.kind != "INTERFACE"):
        family = tuple(one for one in unit.pous if pou in _lineage(one, pous))
        inherited = tuple(block for base in _lineage(pou, pous)[1:] for block in base.blocks)
        shared = (*unit.globals, *inherited)
        abouts = [_About(pou, enums, shared, family)]
        for method in pou.methods:
            if "ABSTRACT" not in method.modifiers:
                abouts.append(_About(method, enums, (*shared, *pou.blocks), (method,)))
        for about in abouts:
            for rule in _RULES:
                for id, pos, message in rule(about):
                    yield StWarning(id, message, pos.path, pos.line, pos.column)


def _lineage(pou: t.Pou, pous: Mapping[str, t.Pou]) -> list[t.Pou]:
    """Return a POU and the POUs that it extends, the nearest first."""
    found = [pou]
    while found[-1].extends:
        base = pous.get(found[-1].extends[0].name.lower())
        if base is None or base in found:
            break
        found.append(base)
    return found


class _About:
    """A POU or method with what the rules need to know about its names. All names are in lower case.

    `shared` are the variables that it uses and does not declare. `family` is the POU with those that extend it, because they and
    their methods use its variables.
    """

    def __init__(
        self, pou: t.Pou, enums: dict[str, t.EnumDecl], shared: tuple[t.VarBlock, ...], family: tuple[t.Pou, ...]
    ) -> None:
        self.pou, self.enums = pou, enums
        self.users = [one for each in family for one in nodes((each.body, each.actions, each.chart, each.methods))]
        declared = [(v, block) for block in (*shared, *pou.blocks) for v in block.variables]
        self.variables = {v.name.lower(): v for v, _ in declared}
        self.constants = {v.name.lower() for v, block in declared if "CONSTANT" in block.qualifiers}
        self.bodies = [pou.body, *(action.body for action in pou.actions)]
        self.nodes = list(nodes((pou.body, pou.actions, pou.chart)))
        self.chart_actions = {one.action.lower() for one in self.users if isinstance(one, t.Association)}
        self.conditions = [condition for one in self.nodes for condition in _conditions(one)]

    def named_type(self, name: str) -> str:
        """Return the name of the type of a variable, in capitals; "" if it has none or is unknown."""
        declared = self.variables.get(name.lower())
        return declared.type.name.upper() if declared and isinstance(declared.type, t.NamedType) else ""


def _conditions(node: object) -> Iterator[t.Expr]:
    """Yield the expressions on which the execution of other statements depends."""
    if isinstance(node, t.If):
        yield from (condition for condition, _ in node.branches)
    elif isinstance(node, t.Case):
        yield node.selector
    elif isinstance(node, t.While | t.Transition):
        yield node.condition


def _unused(about: _About) -> Iterator[Finding]:
    in_declarations = nodes(tuple((v.type, v.initial) for block in about.pou.blocks for v in block.variables))
    refs = (one for one in (*about.users, *in_declarations) if isinstance(one, t.Ref))
    used = {_variable_of(ref) for ref in refs} | about.chart_actions
    for block in about.pou.blocks:
        for variable in block.variables if block.kind in _LOCAL else ():
            if variable.name.lower() not in used and not variable.location:
                yield "ST101", variable.pos, f"{variable.name} is not used"


def _variable_of(ref: t.Ref) -> str:
    """Return the name of the variable to which a reference refers, also after THIS and SUPER."""
    first = ref.selectors[0] if ref.selectors else None
    if ref.name.lower().rstrip("^") in ("this", "super") and isinstance(first, t.Member):
        return first.name.lower()
    return ref.name.lower()


def _equal_reals(about: _About) -> Iterator[Finding]:
    for one in about.nodes:
        if not isinstance(one, t.Binary) or one.op not in ("=", "<>") or text_of(one.left) == text_of(one.right):
            continue  # `x <> x` is the test for NaN
        if _is_real(one.left, about) or _is_real(one.right, about):
            yield "ST102", one.pos, f"REAL numbers are compared with {one.op}: {text_of(one)}"


def _is_real(expr: t.Expr, about: _About) -> bool:
    if isinstance(expr, t.Literal):
        return expr.kind == "REAL"
    if isinstance(expr, t.Ref):
        return not expr.selectors and about.named_type(expr.name) in _REALS
    if isinstance(expr, t.Unary):
        return _is_real(expr.operand, about)
    if isinstance(expr, t.Binary):
        return expr.op in ("+", "-", "*", "/", "**") and (_is_real(expr.left, about) or _is_real(expr.right, about))
    name = expr.ref.name.upper()
    return name in _REAL_FUNCTIONS or name.endswith(("_TO_REAL", "_TO_LREAL"))


def _cases_without_else(about: _About) -> Iterator[Finding]:
    for one in about.nodes:
        if not isinstance(one, t.Case) or one.has_else or not isinstance(one.selector, t.Ref) or one.selector.selectors:
            continue
        enum = about.enums.get(about.named_type(one.selector.name).lower())
        if enum is None:
            continue
        labels = [label for labels, _ in one.branches for label in labels]
        if any(label.high is not None for label in labels):
            continue
        named = {text_of(label.low).rpartition("#")[2].rpartition(".")[2].lower() for label in labels}
        left = [name for name, _ in enum.values if name.lower() not in named]
        if left:
            yield "ST103", one.pos, f"CASE has no ELSE, and no branch for {', '.join(left)} of {enum.name}"


def _unwritten_outputs(about: _About) -> Iterator[Finding]:
    written = set(about.chart_actions)
    for one in about.users:
        if isinstance(one, t.Assign):
            written.add(_variable_of(one.target))
        elif isinstance(one, t.For):
            written.add(_variable_of(one.variable))
        elif isinstance(one, t.Call):
            written.add(_variable_of(one.ref))
            written.update(_variable_of(a.target) for a in one.arguments if a.target is not None)
            written.update(_variable_of(a.value) for a in one.arguments if isinstance(a.value, t.Ref))
    for block in about.pou.blocks:
        for variable in block.variables if block.kind == "VAR_OUTPUT" else ():
            if area_of(variable.location) == "I":
                continue  # the process writes it
            if variable.name.lower() not in {*written, "eno"} and variable.initial is None:
                yield "ST104", variable.pos, f"the output {variable.name} is never written"


def _conditional_calls(about: _About) -> Iterator[Finding]:
    for body in about.bodies:
        for name, pos in called_sometimes(body, lambda ref: about.named_type(ref.name) if not ref.selectors else ""):
            kind = about.named_type(name)
            yield (
                "ST105",
                pos,
                f"{name} ({kind}) is not called in every scan, so it does not follow time or edges meanwhile",
            )


def _divisions(about: _About) -> Iterator[Finding]:
    guarded = about.constants | set(_guarded(about))
    for one in about.nodes:
        if not isinstance(one, t.Binary) or one.op.upper() not in ("/", "MOD"):
            continue
        if isinstance(one.right, t.Literal) and _is_zero(one.right):
            yield "ST106", one.right.pos, f"a division by {one.right.text}"
        elif isinstance(one.right, t.Ref) and one.right.name.lower() in about.variables.keys() - guarded:
            yield "ST106", one.right.pos, f"a division by {reference(one.right)}, which no condition tests for 0"


def _guarded(about: _About) -> Iterator[str]:
    """Yield the variables that a condition or comparison uses, that count a FOR, or that MAX or LIMIT limits."""
    for one in about.nodes:
        if isinstance(one, t.Binary) and one.op in _COMPARISONS:
            yield from (each.name.lower() for each in nodes((one.left, one.right)) if isinstance(each, t.Ref))
        elif isinstance(one, t.For):
            yield one.variable.name.lower()
        elif (
            isinstance(one, t.Assign)
            and isinstance(one.value, t.Call)
            and one.value.ref.name.upper() in ("MAX", "LIMIT")
        ):
            yield one.target.name.lower()
    yield from (each.name.lower() for each in nodes(tuple(about.conditions)) if isinstance(each, t.Ref))


def _is_zero(literal: t.Literal) -> bool:
    return literal.kind in ("INTEGER", "REAL") and float(literal.text.replace("_", "")) == 0


def _unreachable(about: _About) -> Iterator[Finding]:
    for body in _all_bodies(about):
        for one, after in pairwise(body):
            if isinstance(one, t.Jump):
                yield "ST107", after.pos, f"a statement after {one.word} is never executed"
                break
    for one in about.nodes:
        if isinstance(one, t.If):
            for condition, _ in one.branches:
                if isinstance(condition, t.Literal) and condition.kind == "FALSE":
                    yield "ST107", condition.pos, "the condition is always FALSE"


def _all_bodies(about: _About) -> Iterator[Sequence[t.Statement]]:
    yield from about.bodies
    for one in about.nodes:
        if isinstance(one, t.If | t.Case):
            yield from (body for _, body in one.branches)
            yield one.otherwise
        elif isinstance(one, t.For | t.While | t.Repeat | t.Network):
            yield one.body


def _no_tags(about: _About) -> Iterator[Finding]:
    for block in about.pou.blocks if about.pou.kind == "PROGRAM" else ():
        for v in block.variables if block.kind in ("VAR_INPUT", "VAR_OUTPUT") else ():
            if isinstance(v.type, t.StringType | t.ArrayType):
                yield "ST110", v.pos, f"{v.name} cannot be a tag, so only a CONFIGURATION can connect it"


def _texts_at_addresses(about: _About) -> Iterator[Finding]:
    for v in (v for block in about.pou.blocks for v in block.variables if area_of(v.location) in ("I", "Q")):
        kind: t.TypeSpec = v.type
        while isinstance(kind, t.ArrayType):
            kind = kind.of
        if isinstance(kind, t.StringType):
            yield "ST115", v.pos, f"{v.name} AT {v.location} is a STRING, which cannot be bound to a tag"


_RULES: tuple[Callable[[_About], Iterator[Finding]], ...] = (
    _unused,
    _equal_reals,
    _cases_without_else,
    _unwritten_outputs,
    _conditional_calls,
    _divisions,
    _unreachable,
    _no_tags,
    _texts_at_addresses,
)
