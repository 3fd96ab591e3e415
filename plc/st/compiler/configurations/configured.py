"""The addresses and initial values that VAR_CONFIG gives to located parts of variables (IEC 61131-3:2013, 6.8.2)."""

from __future__ import annotations

from typing import NoReturn

from fieldtwin.gateway.core.errors import FileInvalid
from fieldtwin.plc.st.compiler.configurations.located import used_addresses
from fieldtwin.plc.st.compiler.configurations.parts import Part
from fieldtwin.plc.st.compiler.declarations import Declarations
from fieldtwin.plc.st.compiler.scope import CodeWriter, Environment
from fieldtwin.plc.st.syntax import tree as t
from fieldtwin.plc.st.syntax.addresses import address_of, area_of


class ConfiguredParts:
    """The variables in VAR_CONFIG that belong to instances of function blocks or to structures.

    `unit.configured` has only these, with the name of a PROGRAM or of a global variable at the beginning of each `target`.
    """

    def __init__(self, env: Environment, declarations: Declarations, unit: t.SourceUnit) -> None:
        self._env, self._declarations = env, declarations
        self._stated = {one.target: one for one in unit.configured}
        self._globals = {
            name.lower() for b in unit.globals for name in (b.list, *(v.name for v in b.variables)) if name
        }
        self._found: dict[str, Part] = {}
        """By path: the located parts that were found."""
        self._addresses: dict[str, t.ConfiguredVariable] = {}
        self._taken = used_addresses(unit) if unit.configured else frozenset()

    def address(self, part: Part, *paths: str) -> str:
        """Return the address of a located part whose path is one of `paths`; "" without one. Errors are collected."""
        path = next((path.lower() for path in paths if path.lower() in self._stated), "")
        one = self._stated.get(path)
        if one is None:
            return ""
        self._found[path] = part
        address = address_of(one.location)
        with self._env.errors.collect():
            kind = self._declarations.type_of(one.type)
            if kind != part.type:
                self._fail(one, "another type", expected=str(part.type), got=str(kind))
            if not one.location:
                return ""
            if not address or area_of(address) != area_of(part.location):
                self._fail(one, f"the address {one.location}", expected=f"an address in %{area_of(part.location)}")
            if address in self._taken or self._addresses.setdefault(address, one) is not one:
                self._fail(one, f"{one.location} is the address of another variable", expected="a different address")
        return address

    def write_initials(self, out: CodeWriter, program: t.Pou) -> None:
        """Write the initial values that VAR_CONFIG states for the parts of a program's variables."""
        for path, part in self._found.items():
            one = self._stated[path]
            if one.initial is None or not path.startswith(f"{program.name.lower()}."):
                continue
            with self._env.errors.collect():
                steps = (f"[{key}]" if isinstance(key, int) else f".{key}" for key in (*part.steps, part.key))
                value = self._declarations.initial(part.type, one.initial, one.type)
                out.line(f"self{''.join(steps)} = {value}", one.pos)

    def check(self) -> None:
        """Add an error for each path that leads to no located part of a program's variables."""
        for path, one in self._stated.items():
            if path not in self._found and path.partition(".")[0] not in self._globals:
                error = self._error(one, "no variable at %I*, %Q* or %M* has this path", expected="the path of one")
                self._env.collected(error)

    def _error(self, one: t.ConfiguredVariable, message: str, *, expected: str, got: str = "") -> FileInvalid:
        return self._env.error(one.pos, f"VAR_CONFIG {'.'.join(one.path)}: {message}", expected=expected, got=got)

    def _fail(self, one: t.ConfiguredVariable, message: str, *, expected: str, got: str = "") -> NoReturn:
        raise self._error(one, message, expected=expected, got=got)
