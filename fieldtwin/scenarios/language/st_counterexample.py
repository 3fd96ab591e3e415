"""Write a counterexample that the model checker found for a program in Structured Text as a scenario.

A scenario sets inputs from outside, and the program scans at its own interval. So the inputs are kept as long as the program
still violates the invariant; whether it does is tried with the compiled program. The invariant becomes a condition.
"""

from __future__ import annotations

from fieldtwin.gateway.core.clock import NS_PER_MS
from fieldtwin.gateway.core.errors import FileInvalid
from fieldtwin.gateway.core.values import Quality, Reason, TagValue
from fieldtwin.plc.prove import Given, Proof
from fieldtwin.plc.st import types as ty
from fieldtwin.plc.st.compiler.literals import Malformed, constant
from fieldtwin.plc.st.model_checking.proof import Report, Result
from fieldtwin.plc.st.model_checking.replay import tag_value
from fieldtwin.plc.st.model_checking.solving import Scan
from fieldtwin.plc.st.program import StProgram
from fieldtwin.plc.st.syntax import tree as t
from fieldtwin.plc.st.syntax.parse import parse_expression
from fieldtwin.scenarios.language.counterexample import outputs_seen, scenario_file
from fieldtwin.twin.site.system import System

NOT_EXACT = (
    "# The violation needs messages, or inputs that change in certain scans. This scenario may not reproduce it.\n"
)
_LOGIC = {"AND": "and", "&": "and", "AND_THEN": "and", "OR": "or", "OR_ELSE": "or", "XOR": "!="}
_COMPARISONS = {"=": "==", "<>": "!=", "<": "<", ">": ">", "<=": "<=", ">=": ">="}
_ARITHMETIC = ("+", "-", "*")


class _NoCondition(Exception):
    """An expression cannot be written as a condition of a scenario."""


def st_scenario(system: System, name: str, kind: type[StProgram], report: Report, result: Result) -> str:
    """Return a scenario file for the counterexample `result` of the program `name`, which `kind` creates."""
    held = report.held(result, report.interval_ns[0])
    way = [_given(report, scan) for scan in held or result.answer.way or ()]
    broken = f"{result.name} ({result.failure})" if result.failure else result.name
    try:
        never = _Condition(system, name, kind).negation(result.expression) if result.expression else ""
    except _NoCondition:
        never = outputs_seen(system, name, Proof(make=kind, domain={}, invariants={}), way)
    comment = f"{len(result.answer.way or ())} scans, found by plc prove, violate this: {broken}"
    text = scenario_file(system, name, broken, comment, kind(), way, never)
    messages = {v.name for v in kind.st_declared.variables if isinstance(v.kind, ty.MessagesIn)}
    sent = any(value for scan in result.answer.way or () for each, value in scan.values if each in messages)
    return text if held and not sent else NOT_EXACT + text


def _given(report: Report, scan: Scan) -> Given:
    program, good = report.make(), dict(scan.good)
    values: list[tuple[str, object]] = []
    for name, value in scan.values:
        if isinstance(program.st_variables[name].kind, ty.MessagesIn):  # the counterexample has empty messages
            values.append((name, b"" if value else None))
            continue
        tag = tag_value(program, name, value)
        bad = TagValue(tag, Quality.BAD, Reason.TIMEOUT, 0)
        values.append((name, tag if good.get(name, True) else bad))
    return Given(tuple(values), scan.after_ns / NS_PER_MS)


class _Condition:
    """Writes expressions over the variables of a program as conditions over the tags to which they are bound."""

    def __init__(self, system: System, name: str, kind: type[StProgram]) -> None:
        form = system.plc.programs[name]
        self._kinds = {v.name.lower(): v.kind for v in kind.st_declared.variables}
        self._tags = {v.name.lower(): f"{name}.{v.name}" for v in kind.st_declared.variables}
        self._tags.update({variable.lower(): tag for variable, tag in form.outputs.items()})
        self._tags.update({variable.lower(): source.tag for variable, source in form.inputs.items()})

    def negation(self, expression: str) -> str:
        """Return the condition that an expression is FALSE. Raises `_NoCondition`."""
        try:
            tree = parse_expression(expression, t.Pos(1, 1))
            tree = tree.operand if isinstance(tree, t.Unary) and tree.op == "NOT" else t.Unary(t.Pos(1, 1), "NOT", tree)
            text, is_bool = self._written(tree)
        except (FileInvalid, Malformed) as e:
            raise _NoCondition from e
        if not is_bool:
            raise _NoCondition
        return text.removeprefix("(").removesuffix(")") if text.count("(") == 1 else text

    def _written(self, expr: t.Expr) -> tuple[str, bool]:
        """Return the text of an expression, and whether it is a BOOL."""
        if isinstance(expr, t.Literal):
            return self._literal(expr)
        if isinstance(expr, t.Ref) and not expr.selectors:
            return self._variable(expr.name)
        if isinstance(expr, t.Unary):
            inner, is_bool = self._written(expr.operand)
            if is_bool == (expr.op == "NOT"):
                return (f"(not {inner})", True) if is_bool else (f"({expr.op}{inner})", False)
        if isinstance(expr, t.Binary):
            (left, first), (right, second) = self._written(expr.left), self._written(expr.right)
            if expr.op in _LOGIC and first and second:
                return f"({left} {_LOGIC[expr.op]} {right})", True
            if expr.op in _COMPARISONS and first == second:
                return f"({left} {_COMPARISONS[expr.op]} {right})", True
            if expr.op in _ARITHMETIC and not first and not second:
                return f"({left} {expr.op} {right})", False
        raise _NoCondition

    def _variable(self, name: str) -> tuple[str, bool]:
        key = name.lower()
        kind = ty.plain(self._kinds[key]) if key in self._kinds else None
        if isinstance(kind, ty.Elementary) and kind.kind in ("bool", "int", "real", "duration"):
            return self._tags[key], kind.kind == "bool"
        if isinstance(kind, ty.Enum):
            return self._tags[key], False
        for each in self._kinds.values():  # the value of an enumeration without its type
            words = {word.lower(): word for word in each.values} if isinstance(each, ty.Enum) else {}
            if kind is None and key in words:
                return f"'{words[key]}'", False
        raise _NoCondition

    @staticmethod
    def _literal(literal: t.Literal) -> tuple[str, bool]:
        if literal.kind == "ENUM_REF":
            return f"'{literal.text.partition('#')[2]}'", False
        value = constant(literal).value
        if isinstance(value, bool):
            return str(value).lower(), True
        if not isinstance(value, int | float):
            raise _NoCondition
        return repr(value), False
