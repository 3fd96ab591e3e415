"""Write PLCopen XML files with bodies in Ladder Diagram and Function Block Diagram for the tests, and run them."""

from __future__ import annotations

from typing import Any

from fieldtwin.plc.program import ScanInfo
from fieldtwin.plc.st.compiler.compile import compile_unit
from fieldtwin.plc.st.plcopen.read import read_plcopen
from fieldtwin.plc.st.program import program_class

BLOCKS = {"in": "inputVars", "out": "outputVars", "var": "localVars"}


def variables(role: str, text: str) -> str:
    """Return declarations: ``a b:INT t:TON``."""
    rows = (name.partition(":")[::2] for name in text.split())
    kinds = ((name, kind or "BOOL") for name, kind in rows)
    of = (
        (n, f"<{k}/>" if k in ("BOOL", "INT", "USINT", "REAL", "TIME") else f'<derived name="{k}"/>') for n, k in kinds
    )
    inside = "".join(f'<variable name="{name}"><type>{kind}</type></variable>' for name, kind in of)
    return f"<{BLOCKS[role]}>{inside}</{BLOCKS[role]}>"


def at(local: int, x: int, y: int, order: int = 0) -> str:
    return f'localId="{local}"' + (f' executionOrderId="{order}"' if order else "") + f'><position x="{x}" y="{y}"/>'


def link(*sources: str | int) -> str:
    """Return an input with connections: ``3``, or ``3.Q`` for the output Q of the element 3."""
    rows = (str(source).partition(".")[::2] for source in sources)
    inside = "".join(f'<connection refLocalId="{n}"' + (f' formalParameter="{o}"' if o else "") + "/>" for n, o in rows)
    return f"<connectionPointIn>{inside}</connectionPointIn>"


def rail(local: int) -> str:
    return f"<leftPowerRail {at(local, 0, 0)}</leftPowerRail>"


def contact(local: int, name: str, *sources: str | int, x: int = 1, y: int = 0, how: str = "") -> str:
    return f"<contact {how} {at(local, x, y)}{link(*sources)}<variable>{name}</variable></contact>"


def coil(local: int, name: str, *sources: str | int, x: int = 9, y: int = 0, how: str = "", order: int = 0) -> str:
    return f"<coil {how} {at(local, x, y, order)}{link(*sources)}<variable>{name}</variable></coil>"


def value(local: int, text: str, how: str = "") -> str:
    return f"<inVariable {how} {at(local, 0, 0)}<expression>{text}</expression></inVariable>"


def result(local: int, text: str, source: str | int, x: int = 9, y: int = 0, how: str = "", order: int = 0) -> str:
    return f"<outVariable {how} {at(local, x, y, order)}{link(source)}<expression>{text}</expression></outVariable>"


def block(
    local: int,
    kind: str,
    inputs: dict[str, str | int],
    outputs: str,
    *,
    instance: str = "",
    x: int = 5,
    y: int = 0,
    order: int = 0,
    how: str = "",
) -> str:
    pins = "".join(f'<variable formalParameter="{n}" {how}>{link(s)}</variable>' for n, s in inputs.items())
    outs = "".join(f'<variable formalParameter="{n}"><connectionPointOut/></variable>' for n in outputs.split())
    name = f' instanceName="{instance}"' if instance else ""
    return (
        f'<block typeName="{kind}"{name} {at(local, x, y, order)}<inputVariables>{pins}</inputVariables><inOutVariables/>'
        f"<outputVariables>{outs}</outputVariables></block>"
    )


def export(language: str, interface: str, *elements: str, more: str = "") -> str:
    body = "\n".join(elements)
    return (
        '<project xmlns="http://www.plcopen.org/xml/tc6_0201"><types><pous>'
        f'{more}<pou name="Main" pouType="program"><interface>{interface}</interface>\n'
        f"<body><{language}>\n{body}\n</{language}></body></pou></pous></types></project>"
    )


def program(text: str) -> Any:
    return program_class(compile_unit(read_plcopen(text, "plant.xml"), "plant.xml", ("plant.xml",)))()


def scan(made: Any, number: int, **inputs: Any) -> None:
    for name, given_value in inputs.items():
        setattr(made, name, given_value)
    made.execute(ScanInfo(10_000_000 * number, number, number == 1))


def ladder(interface: str, *elements: str) -> Any:
    return program(export("LD", interface, rail(0), *elements))


def label(local: int, name: str, x: int = 0, y: int = 0, order: int = 0) -> str:
    return f'<label label="{name}" {at(local, x, y, order)}</label>'


def jump(local: int, name: str, *sources: str | int, x: int = 9, y: int = 0, order: int = 0) -> str:
    return f'<jump label="{name}" {at(local, x, y, order)}{link(*sources) if sources else ""}</jump>'


def leave(local: int, *sources: str | int, x: int = 9, y: int = 0) -> str:
    return f"<return {at(local, x, y)}{link(*sources) if sources else ''}</return>"
