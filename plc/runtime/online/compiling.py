"""Compiles the programs of a PLC that runs, in a separate process.

A compilation takes about a second for 1500 lines, and would delay the scans, also in a thread, because a thread holds the
interpreter's lock. The process runs `main`: it reads a `CompileRequest` as JSON from stdin and writes the result to stdout.
The result is divided into small pieces, because the PLC cannot execute a scan while it decodes a piece.
"""

from __future__ import annotations

import marshal
import os
import pickle
import subprocess
import sys
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any

import msgspec

from fieldtwin.gateway.core.errors import Bug, FieldtwinError, FileInvalid, ReplyTimeout
from fieldtwin.plc.binding import library_places, text_source
from fieldtwin.plc.runtime.config import ProgramConfig
from fieldtwin.plc.runtime.realtime import make_way
from fieldtwin.plc.runtime.sources import ProgramSource, digest_of
from fieldtwin.plc.source_files import source_files
from fieldtwin.plc.st.compiler.compile import CompiledUnit
from fieldtwin.plc.st.decisions.statements import Decisions, decisions_of
from fieldtwin.plc.st.dialects import dialect_of
from fieldtwin.plc.st.drawing.live import Pictures
from fieldtwin.plc.st.program import StProgram, program_class
from fieldtwin.plc.st.project import compile_source
from fieldtwin.plc.st.state_diagram import StateDiagram
from fieldtwin.plc.st.syntax.tree import SourceUnit

PATIENCE_S = 100.0
"""The longest time in seconds that a compilation may take."""
PIECE = 8
"""How many entries of a mapping are decoded at a time, which takes less than 1 ms."""


class CompileRequest(msgspec.Struct, frozen=True):
    """The programs to be compiled, and the folders that are searched for them."""

    programs: tuple[ProgramConfig, ...]
    python_path: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class Version:
    """A version of a program in Structured Text: its class, and its files as they were read."""

    made: type[StProgram]
    sources: tuple[ProgramSource, ...]


def compile_programs(request: CompileRequest) -> dict[str, Version]:
    """Compile programs in this process, and return them by their names. Raises `FileInvalid`."""
    found = {}
    for config in request.programs:
        unit, name, digests = _compiled(config, request.python_path)
        found[config.name] = _version(config.name, _class_of(config, unit, name), digests)
    return found


def compile_elsewhere(request: CompileRequest) -> dict[str, Version]:
    """Do the same as `compile_programs` in a separate process, and delay a scan of this process by less than 1 ms.

    Call it in a thread. Also raises `ReplyTimeout` after `PATIENCE_S`.
    """
    # not with -m: the classes of the result would then belong to a module of another name
    command = [sys.executable, "-c", f"from {__name__} import main; main()"]
    try:
        done = subprocess.run(command, input=msgspec.json.encode(request), capture_output=True, timeout=PATIENCE_S)
    except subprocess.TimeoutExpired as e:
        raise ReplyTimeout("the programs were not compiled in time", expected=f"at most {PATIENCE_S:g} s") from e
    if done.returncode != 0:
        lines = done.stderr.decode(errors="replace").strip().splitlines()
        raise Bug("the compiler ended with an error", got=lines[-1] if lines else f"exit code {done.returncode}")
    result: _Result = pickle.loads(done.stdout)
    if result.error is not None:
        raise _error(result.error)
    units = [_unpacked(packed) for packed in result.units]
    found = {}
    for config in request.programs:
        at, name, digests = result.programs[config.name]
        unit, decisions = units[at]
        pictures = Pictures(_joined(result.drawings[config.name]), result.machines[config.name])
        made = _class_of(config, unit, name, decisions, pictures)
        found[config.name] = _version(config.name, made, digests)
        make_way()
    return found


def _compiled(config: ProgramConfig, folders: Sequence[str]) -> tuple[CompiledUnit, str, dict[str, str]]:
    """Compile a program, and return its unit, the name of its PROGRAM, and the digests of its files."""
    found = text_source(config.source, folders)
    if found is None:
        raise FileInvalid("not the source of a program in Structured Text", got=config.source)
    path, name = found
    libraries = library_places(config.libraries, folders)
    # first, so that a file that is saved during the compilation still counts as changed
    digests = {str(file): digest_of(str(file)) for place in (path, *libraries) for file in source_files(place)}
    unit = compile_source(path, dialect_of(config.dialect), libraries, machine_code=config.machine_code)
    return unit, name, digests


def _class_of(
    config: ProgramConfig,
    unit: CompiledUnit,
    name: str,
    decisions: Decisions | None = None,
    pictures: Pictures | None = None,
) -> type[StProgram]:
    return program_class(unit, name, decisions, pictures, takes_writes=config.takes_writes, published=config.published)


def _version(name: str, made: type[StProgram], digests: Mapping[str, str]) -> Version:
    return Version(made, tuple(ProgramSource(name, file, digests.get(file, ""), True) for file in made.source_files))


# -- between the two processes ---------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class _Packed:
    """A unit as bytes. The mappings are in pieces, and the declarations are left out; the decisions come from them."""

    unit: bytes
    code: tuple[bytes, ...]
    programs: list[bytes]
    blocks: list[bytes]
    globals: list[bytes]
    decisions: list[bytes]


@dataclass(frozen=True, slots=True)
class _Result:
    units: list[_Packed]
    programs: dict[str, tuple[int, str, dict[str, str]]]
    """By program: the number of its unit, the name of its PROGRAM, and the digests of its files."""
    drawings: dict[str, list[bytes]]
    machines: dict[str, StateDiagram | None]
    error: dict[str, Any] | None = None


def _packed(unit: CompiledUnit) -> _Packed:
    rest = replace(unit, code=(), programs=(), blocks={}, globals={}, source=SourceUnit(), environment=None)
    programs = [replace(program, variables=()) for program in unit.programs]
    variables = [(at, v) for at, program in enumerate(unit.programs) for v in program.variables]
    return _Packed(
        pickle.dumps((rest, programs)),
        tuple(marshal.dumps(part) for part in unit.code),
        _pieces(variables),
        _pieces(list(unit.blocks.items())),
        _pieces(list(unit.globals.items())),
        _pieces(list(decisions_of(unit.source).items())),
    )


def _unpacked(packed: _Packed) -> tuple[CompiledUnit, Decisions]:
    rest, programs = pickle.loads(packed.unit)
    variables = _joined(packed.programs)
    unit: CompiledUnit = replace(
        rest,
        code=tuple(marshal.loads(part) for part in packed.code),
        programs=tuple(
            replace(program, variables=tuple(v for of, v in variables if of == at))
            for at, program in enumerate(programs)
        ),
        blocks=dict(_joined(packed.blocks)),
        globals=dict(_joined(packed.globals)),
    )
    return unit, Decisions(unit.source, dict(_joined(packed.decisions)))


def _pieces(entries: list[Any]) -> list[bytes]:
    return [pickle.dumps(entries[at : at + PIECE]) for at in range(0, len(entries), PIECE)]


def _joined(pieces: list[bytes]) -> list[Any]:
    found: list[Any] = []
    for piece in pieces:
        found += pickle.loads(piece)
        make_way()
    return found


def _described(error: FileInvalid) -> dict[str, Any]:
    return {**error.as_data(), "others": [_described(other) for other in error.others]}


def _error(data: dict[str, Any]) -> FileInvalid:
    return FileInvalid(**{**data, "others": tuple(_error(other) for other in data["others"])})


def main() -> None:
    """Compile what stdin requests, and write the result to stdout."""
    with suppress(OSError, AttributeError):  # the PLC that runs goes first
        os.nice(10)
    request = msgspec.json.decode(sys.stdin.buffer.read(), type=CompileRequest)
    units: list[CompiledUnit] = []
    programs = {}
    drawings: dict[str, list[bytes]] = {}
    machines: dict[str, StateDiagram | None] = {}
    error = None
    try:
        for config in request.programs:
            unit, name, digests = _compiled(config, request.python_path)
            pictures = program_class(unit, name).st_pictured()  # an error if the source does not have this PROGRAM
            drawings[config.name] = [pickle.dumps([one]) for one in pictures.drawings]
            machines[config.name] = pictures.machine
            at = next((n for n, known in enumerate(units) if known is unit), len(units))
            if at == len(units):
                units.append(unit)
            programs[config.name] = at, name, digests
    except FileInvalid as e:
        error = _described(e)
    except FieldtwinError as e:
        error = _described(FileInvalid(str(e)))
    result = _Result([_packed(unit) for unit in units] if error is None else [], programs, drawings, machines, error)
    sys.stdout.buffer.write(pickle.dumps(result))
