"""The located variables of a system's programs, and their Modbus addresses by the convention of OpenPLC.

OpenPLC Runtime 3 serves %QX0.0 to %QX99.7 as coils 0 to 799, %IX0.0 to %IX99.7 as discrete inputs 0 to 799, %IW0 to %IW1023 as
input registers, and as holding registers %QW0 to %QW1023 (0 to 1023), %MW0 to %MW1023 (1024 to 2047), %MD0 to %MD1023 (2048 to
4095) and %ML0 to %ML1023 (4096 to 8191), the high word first.
"""

from __future__ import annotations

from collections.abc import Container, Mapping
from dataclasses import replace
from pathlib import Path

from fieldtwin.gateway.core.errors import FieldtwinError
from fieldtwin.gateway.core.files.yaml_file import Key, YamlFile
from fieldtwin.gateway.protocols.modbus.server.analysis import ServedTable
from fieldtwin.gateway.runtime.serve import ServedTag
from fieldtwin.plc.binding import text_source
from fieldtwin.plc.program import Role
from fieldtwin.plc.st import types as ty
from fieldtwin.plc.st.compiler.pous.programs import ProgramVariable
from fieldtwin.plc.st.dialects import dialect_of
from fieldtwin.plc.st.program import StProgram, program_class
from fieldtwin.plc.st.project import compile_source
from fieldtwin.twin.site.schema import PlcForm, ProgramForm

_PLACES: Mapping[str, tuple[ServedTable, int, int]] = {
    "%IW": ("input", 0, 1), "%QW": ("holding", 0, 1), "%MW": ("holding", 1024, 1), "%MD": ("holding", 2048, 2),
    "%ML": ("holding", 4096, 4),
}  # fmt: skip
"""By the beginning of an address: the table, its first register, and the number of registers of each variable."""
_EACH = 1024
_BITS: Mapping[str, ServedTable] = {"%IX": "discrete", "%QX": "coil"}
_BYTES = 100


def served_by_address(
    file: YamlFile, at: tuple[Key, ...], plc: PlcForm, folder: Path, *, write: bool
) -> list[ServedTag]:
    """Return the located variables of the programs at their registers; with `write` clients may write %Q and %M.

    A variable whose address or type has no place in the convention is left out. A source with an error has no variables here; its
    errors are found when the programs are compiled. Raises `FileInvalid` if one address is two variables.
    """
    found: dict[tuple[ServedTable, int], tuple[ServedTag, object]] = {}
    for name, form in plc.programs.items():
        program = _program(form, folder)
        if program is None:
            continue
        for v in program.st_declared.variables:
            served = _served(name, form, program, v, plc.programs, write=write)
            if served is None:
                continue
            place = served.table, served.address
            storage = program.st_unit.path if v.shared else name, *v.steps, v.attribute
            before = found.get(place)
            if before is not None and before[1] != storage:
                raise file.error(
                    at,
                    f"{v.location} is a variable of two programs: {before[0].tag} and {name}.{v.name}",
                    expected="one variable for each address",
                )
            if before is None or (before[0].constant is not None and served.constant is None):
                found[place] = served, storage
    return [served for served, _ in found.values()]


def _program(form: ProgramForm, folder: Path) -> StProgram | None:
    try:
        source = text_source(form.source, (str(folder),))
        if source is None:
            return None
        libraries = tuple(folder / library for library in form.libraries)
        return program_class(compile_source(source[0], dialect_of(form.dialect), libraries), source[1])()
    except FieldtwinError:
        return None


def _served(
    name: str, form: ProgramForm, program: StProgram, v: ProgramVariable, programs: Container[str], *, write: bool
) -> ServedTag | None:
    place = _place(v.location)
    kind = _type(v.kind, place[2]) if place is not None else ""
    if place is None or not kind or v.name not in program.variables:
        return None
    served = ServedTag(f"{name}.{v.name}", place[0], place[1], kind)
    if program.variables[v.name].role is Role.INPUT:
        bound = form.inputs.get(v.name)
        if bound is None:
            return replace(served, constant=program.st_value(v))
        return replace(served, tag=bound.tag, from_plc=bound.tag.partition(".")[0] in programs)
    writable = write and not isinstance(v.kind, ty.Enum)
    return replace(
        served,
        tag=form.outputs.get(v.name, served.tag),
        from_plc=True,
        write=writable,
        variable=served.tag if writable else "",
        limits=program.variables[v.name].limits,
    )


def _place(address: str) -> tuple[ServedTable, int, int] | None:
    """Return the table, the register or bit, and the number of registers (0 for a bit) of an address; None if it has no place."""
    numbers = [int(number) for number in address[3:].split(".")] if address else []
    if address[:3] in _BITS and len(numbers) == 2 and numbers[0] < _BYTES and numbers[1] < 8:
        return _BITS[address[:3]], 8 * numbers[0] + numbers[1], 0
    if address[:3] in _PLACES and len(numbers) == 1 and numbers[0] < _EACH:
        table, first, count = _PLACES[address[:3]]
        return table, first + count * numbers[0], count
    return None


def _type(kind: ty.Type, registers: int) -> str:
    """Return the type of the registers of a variable; "" if its values do not fit them."""
    plain = ty.INT if isinstance(kind, ty.Enum) else ty.plain(kind)
    if not isinstance(plain, ty.Elementary) or (plain.kind == "bool") != (registers == 0):
        return ""
    if plain.kind == "bool":
        return "bool"
    if plain.bits > 16 * registers or plain.kind not in ("int", "bits", "real"):
        return ""
    if plain.kind == "real":
        return f"float{plain.bits}" if plain.bits == 16 * registers else ""
    signed = plain.low < 0 or registers == 4  # the tags of unsigned 64-bit variables have their two's complement
    return f"{'int' if signed else 'uint'}{16 * registers}"
