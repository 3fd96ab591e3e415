"""Variables of a method that keep their values (``VAR_INST``), an addition of CODESYS and TwinCAT to the standard.

Each instance of the owner has such a variable. So it is translated into a variable of the owner, whose name begins with 0, so no
source can contain it. Users see it as a part of the owner: ``pump.Next.n`` is the variable ``n`` of the method ``Next``, and
``pump.Level.Get.n`` one of a property.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

from fieldtwin.gateway.core.errors import FileInvalid
from fieldtwin.gateway.core.files.error_collector import ErrorCollector
from fieldtwin.plc.st.dialects import Dialect
from fieldtwin.plc.st.syntax import tree as t
from fieldtwin.plc.st.syntax.errors import invalid
from fieldtwin.plc.st.syntax.walk import with_parts

_KIND = "VAR_INST"
_NAME = re.compile(r"0inst_(\w+?)(\d+)_(.+)")


def without_instance_variables(unit: t.SourceUnit, dialect: Dialect) -> t.SourceUnit:
    """Return `unit` with the VAR_INST of methods as variables of their owners.

    Raises `FileInvalid` with line and column for the first VAR_INST that is not allowed, and with the others.
    """
    errors = ErrorCollector()
    pous = []
    for pou in unit.pous:
        for block in (*pou.blocks, *(b for method in pou.methods for b in method.blocks if not dialect.vendor)):
            if block.kind == _KIND:
                hint = "the dialects codesys and twincat have it in a METHOD"
                errors.add(invalid(block.pos, _KIND, "VAR", hint=hint))
        for error in (each for method in pou.methods for each in _declared_again(method)):
            errors.add(error)
        pous.append(_moved(pou))
    errors.raise_all()
    return replace(unit, pous=tuple(pous))


def beginning(kind: str, method: str) -> str:
    """Return with what the names of a method's variables begin in its owner. `kind`: METHOD, GET or SET."""
    return f"0inst_{kind.lower()}{len(method)}_{method}_"  # the length, because names may contain underscores


def is_instance_variable(name: str) -> bool:
    """Return whether a variable of a POU is the VAR_INST of one of its methods."""
    return _NAME.fullmatch(name) is not None


def shown_name(name: str) -> str:
    """Return the name of a variable of a POU as users see it: ``Next.n`` for a VAR_INST, any other unchanged."""
    found = _NAME.fullmatch(name)
    if found is None:
        return name
    method, variable = found[3][: int(found[2])], found[3][int(found[2]) + 1 :]
    return f"{method}.{variable}" if found[1] == "method" else f"{method}.{found[1].capitalize()}.{variable}"


def own_name(shown: str) -> str:
    """Return the name in the POU of a variable that users see as `shown`."""
    method, *accessor, variable = ("", *shown.split(".")) if "." not in shown else shown.split(".")
    return f"{beginning(accessor[0] if accessor else 'method', method)}{variable}" if method else shown


def _declared_again(method: t.Pou) -> Iterator[FileInvalid]:
    """Yield an error for each VAR_INST that has the name of the result or of a different variable of the method."""
    result = {method.name.lower()} if method.returns is not None else set()
    others = {v.name.lower() for block in method.blocks if block.kind != _KIND for v in block.variables}
    for variable in (v for block in method.blocks if block.kind == _KIND for v in block.variables):
        name = variable.name.lower()
        if name in result:
            yield invalid(variable.pos, f"{variable.name} is the name of the method's result, and is declared again")
        elif name in others:
            yield invalid(variable.pos, f"{variable.name} is declared twice")
        others.add(name)


def _moved(pou: t.Pou) -> t.Pou:
    kept: list[t.VarBlock] = []
    methods = []
    for method in pou.methods:
        names: dict[str, str] = {}
        for block in (b for b in method.blocks if b.kind == _KIND):
            found = {v.name.lower(): f"{beginning(method.kind, method.name)}{v.name}" for v in block.variables}
            variables = tuple(replace(v, name=found[v.name.lower()]) for v in block.variables)
            kept.append(replace(block, kind="VAR", variables=variables))
            names.update(found)
        blocks = tuple(b for b in method.blocks if b.kind != _KIND)
        methods.append(replace(method, blocks=blocks, body=_renamed(method.body, names)) if names else method)
    return replace(pou, blocks=(*pou.blocks, *kept), methods=tuple(methods))


def _renamed(node: Any, names: dict[str, str]) -> Any:
    if isinstance(node, t.Ref) and node.name.lower() in names:
        return replace(node, name=names[node.name.lower()], selectors=_renamed(node.selectors, names))
    return with_parts(node, lambda part: _renamed(part, names))
