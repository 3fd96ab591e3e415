"""The pragmas of CODESYS and TwinCAT that are skipped without a warning, because they do not change what a program computes.

An attribute that is not listed here is either unknown, such as one with a spelling mistake, or asks the vendor's system for
something that this PLC does not do, such as a call of a method at the start.
"""

from __future__ import annotations

import re

_ATTRIBUTE = re.compile(r"\{\s*attribute\s+'([^']*)'", re.IGNORECASE)
_OTHERS = re.compile(r"\{\s*(region|endregion|text|info|warning|error)\b", re.IGNORECASE)
_KNOWN = frozenset(
    # names in the scope of a program, and members of types; `qualified_only` and `pack_mode` are read by the compiler
    {"qualified_only", "strict", "to_string", "pack_mode", "subsequent", "const_replaced", "const_non_replaced"}
    # what an editor, a watch list and a visualisation show
    | {"hide", "hide_all_locals", "conditionalshow", "conditionalshow_all_locals", "expandfully", "displaymode"}
    | {"monitoring", "monitoring_instead", "monitoring_encoding", "no_virtual_actions", "pingroup", "processvalue"}
    | {"pin_presentation_order_inputs", "pin_presentation_order_outputs", "parameterstringof", "dataflow", "obsolete"}
    # symbols for other systems, and the code that a vendor's linker keeps
    | {"symbol", "linkalways", "external_name", "signature_flag", "reflection", "enable_dynamic_creation"}
    | {"no_instance_in_retain"}
    # checks, warnings and options of the vendor's compiler
    | {"analysis", "naming", "nameprefix", "no-check", "no_check", "no_assign", "no_assign_warning"}
    | {"estimated-stack-usage", "use_overload_resolution", "checksuperglobal"}
)
_FAMILIES = ("tc", "opc.ua", "analysis:", "suppress_warning_")
"""The beginnings of the names of TwinCAT's own attributes, and of those with many names."""
_WITH_EFFECT = frozenset({"tcinitonreset", "tcswapword", "tcswapdword", "tccallafteroutputupdate"})


def is_silent(pragma: str) -> bool:
    """Return whether a pragma, with its braces, is skipped without a warning in the dialects of CODESYS and TwinCAT."""
    found = _ATTRIBUTE.match(pragma)
    if found is None:
        return _OTHERS.match(pragma) is not None
    name = found[1].strip().lower()
    return name in _KNOWN or (name.startswith(_FAMILIES) and name not in _WITH_EFFECT)
