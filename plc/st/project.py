"""The files of a program's source: one file, or a folder with everything below it, whose declarations form one unit.

In a unit, types, globals and POUs may be declared in any order and in any file, as in the projects of other PLC tools.
"""

from __future__ import annotations

import re
from dataclasses import replace
from functools import lru_cache
from pathlib import Path

from fieldtwin.gateway.core.errors import FileInvalid
from fieldtwin.gateway.core.files.error_collector import ErrorCollector
from fieldtwin.gateway.core.files.input_file import read_input
from fieldtwin.plc.source_files import source_files
from fieldtwin.plc.st.compiler.compile import CompiledUnit, compile_unit
from fieldtwin.plc.st.dialects import STANDARD, Dialect
from fieldtwin.plc.st.syntax.parse import parse_all
from fieldtwin.plc.st.syntax.plcopen import is_plcopen, to_st
from fieldtwin.plc.st.syntax.tree import SourceUnit

_QUALIFIED_ONLY = re.compile(
    r"\{\s*attribute\s+'qualified_only'\s*\}(?:\s|\{[^}]*\}|//[^\n]*\n|\(\*.*?\*\))*VAR_GLOBAL",
    re.IGNORECASE | re.DOTALL,
)
"""The pragma of CODESYS before a list of global variables that are used only as ``LIST.variable``."""
MAX_SOURCE_BYTES = 8 * 1024 * 1024
"""A larger source file is assumed to be a mistake."""


def compile_source(path: Path, dialect: Dialect = STANDARD) -> CompiledUnit:
    """Read and compile a file or a folder. Raises `FileInvalid` for the first error, with the others."""
    return _compiled(tuple((str(file), _text(file)) for file in source_files(path)), str(path), dialect)


def _text(path: Path) -> str:
    try:
        return read_input(path, MAX_SOURCE_BYTES).decode("utf-8-sig")
    except UnicodeDecodeError as e:
        raise FileInvalid("not UTF-8 text", path=str(path), got=f"byte {e.start}: {e.object[e.start]:02x}h") from e
    except OSError as e:
        raise FileInvalid(f"cannot read: {e.strerror or e}", path=str(path)) from e


@lru_cache(maxsize=32)
def _compiled(texts: tuple[tuple[str, str], ...], path: str, dialect: Dialect) -> CompiledUnit:
    """Return a compiled unit from a cache, because a system's file is read more than once and systems may share a program."""
    return compile_unit(_parsed(texts, dialect), path, tuple(file for file, _ in texts), dialect)


def _parsed(texts: tuple[tuple[str, str], ...], dialect: Dialect) -> SourceUnit:
    """Return the declarations of all files. Raises `FileInvalid` for the first syntax error, with the others."""
    units: list[SourceUnit] = []
    errors = ErrorCollector()
    for path, text in texts:
        with errors.collect():
            units.append(_unit(path, text, dialect))
    errors.raise_all()
    return SourceUnit(
        tuple(declared for unit in units for declared in unit.types),
        tuple(block for unit in units for block in unit.globals),
        tuple(pou for unit in units for pou in unit.pous),
        tuple(warning for unit in units for warning in unit.warnings),
    )


def _unit(path: str, text: str, dialect: Dialect) -> SourceUnit:
    """Return the declarations of a file. In a vendor's dialect its global variables form a list with the name of the file."""
    if is_plcopen(text):
        return parse_all(to_st(text, path), path, dialect)
    unit = parse_all(text, path, dialect)
    if not dialect.vendor:
        return unit
    name, only_qualified = Path(path).stem, _QUALIFIED_ONLY.search(text) is not None
    lists = (replace(block, list=name, only_qualified=only_qualified) for block in unit.globals)
    return replace(unit, globals=tuple(lists))
