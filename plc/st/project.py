"""The files of a program's source: one file, or a folder with everything below it, whose declarations form one unit.

In a unit, types, globals and POUs may be declared in any order and in any file, as in the projects of other PLC tools.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import lru_cache
from os.path import realpath
from pathlib import Path

from fieldtwin.gateway.core.errors import FileInvalid
from fieldtwin.gateway.core.files.error_collector import ErrorCollector
from fieldtwin.gateway.core.files.input_file import read_input
from fieldtwin.plc.source_files import source_files
from fieldtwin.plc.st.compiler.compile import CompiledUnit, compile_unit
from fieldtwin.plc.st.dialects import STANDARD, Dialect, StWarning
from fieldtwin.plc.st.libraries import STANDARD_NAMES, Library, with_library, without_qualifiers
from fieldtwin.plc.st.plcopen.elements import is_plcopen
from fieldtwin.plc.st.plcopen.read import read_parts, read_plcopen
from fieldtwin.plc.st.syntax import twincat
from fieldtwin.plc.st.syntax.parse import parse_all, parse_parts
from fieldtwin.plc.st.syntax.tree import SourceUnit
from fieldtwin.plc.st.tcunit_suites import SUITE, without_suites

_QUALIFIED_ONLY = re.compile(
    r"\{\s*attribute\s+'qualified_only'\s*\}(?:\s|\{[^}]*\}|//[^\n]*\n|\(\*.*?\*\))*VAR_GLOBAL",
    re.IGNORECASE | re.DOTALL,
)
"""The pragma of CODESYS before a list of global variables that are used only as ``LIST.variable``."""
_DECLARED = re.compile(r"<(?:\w+:)?(?:pou|dataType)\s[^>]*\bname\s*=\s*\"([^\"]*)\"")
"""The names of declarations in a PLCopen XML file that cannot be read as a whole."""
Texts = tuple[tuple[str, str], ...]
"""Files with their content."""
MAX_SOURCE_BYTES = 8 * 1024 * 1024
"""A larger source file is assumed to be a mistake."""


def compile_source(
    path: Path | tuple[Path, ...],
    dialect: Dialect = STANDARD,
    libraries: tuple[Path, ...] = (),
    *,
    machine_code: bool = False,
) -> CompiledUnit:
    """Read and compile a file or a folder, with the declarations of `libraries` (files or folders) that it uses.

    Several files and folders form one unit, which has the path of the first.
    With `machine_code` the programs get machine code (`fieldtwin.plc.st.native`), and a warning if that is not possible. Raises
    `FileInvalid` for the first error, with the others.
    """
    made = _with_machine_code if machine_code else _compiled
    paths = path if isinstance(path, tuple) else (path,)
    return made(source_texts(paths), source_texts(libraries), str(paths[0]), dialect, _names_of(libraries))


def read_with(
    path: Path,
    beside: tuple[Path, ...],
    libraries: tuple[Path, ...],
    dialect: Dialect,
    changed: Callable[[SourceUnit], SourceUnit],
) -> tuple[SourceUnit, list[SourceUnit]]:
    """Read the file `path` with the declarations that it uses from the files `beside` and from `libraries`.

    `changed` is applied to each file. Also return the other files as they were read. Raises `FileInvalid`.
    """
    library = _library(source_texts((*beside, *libraries)), dialect, changed)
    unit = with_library(changed(_parsed(source_texts((path,)), dialect)), library)
    return _without_qualifiers(unit, dialect, _names_of(libraries)), library.units


def source_texts(paths: tuple[Path, ...]) -> Texts:
    """Return the files of several sources with their content, each file once. Raises `FileInvalid`."""
    files: dict[str, Path] = {}
    for path in paths:
        for file in source_files(path):
            files.setdefault(realpath(file), file)  # unlike Path.resolve, no error for a link to itself
    return tuple((str(file), _text(file)) for file in files.values())


def _text(path: Path) -> str:
    try:
        return read_input(path, MAX_SOURCE_BYTES).decode("utf-8-sig")
    except UnicodeDecodeError as e:
        raise FileInvalid("not UTF-8 text", path=str(path), got=f"byte {e.start}: {e.object[e.start]:02x}h") from e
    except OSError as e:
        raise FileInvalid(f"cannot read: {e.strerror or e}", path=str(path)) from e


@lru_cache(maxsize=32)
def _compiled(texts: Texts, libraries: Texts, path: str, dialect: Dialect, names: frozenset[str]) -> CompiledUnit:
    """Return a compiled unit from a cache, because a system's file is read more than once and systems may share a program.

    `names` are those of the libraries.
    """
    library, unit = _library(libraries, dialect), _parsed(texts, dialect)
    if dialect.vendor and SUITE.lower() not in library.found:
        unit = without_suites(unit)
    unit = with_library(unit, library)
    unit = _without_qualifiers(unit, dialect, names)
    used = {declared.pos.path for declared in (*unit.types, *unit.globals, *unit.pous)}
    files = (*(file for file, _ in texts), *(file for file, _ in libraries if file in used))
    return compile_unit(unit, path, tuple(dict.fromkeys(files)), dialect)


@lru_cache(maxsize=32)
def _with_machine_code(
    texts: Texts, libraries: Texts, path: str, dialect: Dialect, names: frozenset[str]
) -> CompiledUnit:
    from fieldtwin.plc.st.native.machine import NoCompiler, with_machine_code  # few programs need it

    unit = _compiled(texts, libraries, path, dialect, names)
    try:
        return with_machine_code(unit)
    except NoCompiler as e:
        warning = StWarning("ST116", f"the program stays Python, because {e}", unit.path, 1, 1)
        return replace(unit, warnings=(*unit.warnings, warning))


def _names_of(libraries: tuple[Path, ...]) -> frozenset[str]:
    """Return the names of libraries, in lower case."""
    return frozenset(library.stem.lower() for library in libraries)


def _without_qualifiers(unit: SourceUnit, dialect: Dialect, names: frozenset[str]) -> SourceUnit:
    return without_qualifiers(unit, STANDARD_NAMES | names) if dialect.vendor else unit


def _library(
    texts: Texts, dialect: Dialect, changed: Callable[[SourceUnit], SourceUnit] = lambda unit: unit
) -> Library:
    """Return the declarations of libraries, each file as `changed` returns it. An error counts only if the program uses the part
    with the error.
    """
    library = Library()
    for path, text in texts:
        try:
            library.add(changed(_unit(path, text, dialect)))
        except FileInvalid as whole:
            try:
                for unit, names, error in _parts(path, text, dialect):
                    library.add(changed(unit))
                    library.fail(names, error or whole)
            except FileInvalid as e:  # not even text of the language: the file's name is that of its declaration
                library.fail((Path(path).stem, *_DECLARED.findall(text)), e)
    return library


def _parsed(texts: Texts, dialect: Dialect) -> SourceUnit:
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
        tuple(missing for unit in units for missing in unit.missing),
        tuple(instance for unit in units for instance in unit.instances),
        tuple(test for unit in units for test in unit.tests),
        tuple(task for unit in units for task in unit.tasks),
        tuple(variable for unit in units for variable in unit.configured),
    )


def _unit(path: str, text: str, dialect: Dialect) -> SourceUnit:
    """Return the declarations of a file. In a vendor's dialect its global variables form a list with the name of the file."""
    if _is_export(text):
        return read_plcopen(text, path, dialect)
    return _in_list(parse_all(_as_st(path, text), path, dialect), path, text, dialect)


def _parts(path: str, text: str, dialect: Dialect) -> Iterator[tuple[SourceUnit, tuple[str, ...], FileInvalid | None]]:
    """Read each declaration of a file alone, as `parse_parts` does, with the list of its global variables as in `_unit`."""
    if _is_export(text):
        yield from read_parts(text, path, dialect)
        return
    for unit, names, error in parse_parts(_as_st(path, text), path, dialect):
        yield _in_list(unit, path, text, dialect), names, error


def _is_export(text: str) -> bool:
    return is_plcopen(text) and not twincat.is_twincat(text)


def _as_st(path: str, text: str) -> str:
    """Return the Structured Text of a file that is not an export of PLCopen XML."""
    return twincat.to_st(text, path) if twincat.is_twincat(text) else text


def _in_list(unit: SourceUnit, path: str, text: str, dialect: Dialect) -> SourceUnit:
    if not dialect.vendor:
        return unit
    name, only_qualified = Path(path).stem, _QUALIFIED_ONLY.search(text) is not None
    lists = (
        block if block.namespace else replace(block, list=name, only_qualified=only_qualified) for block in unit.globals
    )
    return replace(unit, globals=tuple(lists))
