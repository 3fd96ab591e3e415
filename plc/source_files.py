"""Which files the source of a program in Structured Text consists of."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

from fieldtwin.gateway.core.errors import FileInvalid

MAX_FILES = 2_000
"""The largest number of files in a folder of a program."""
SUFFIXES = (".st", ".iecst", ".exp", ".xml", ".tcpou", ".tcdut", ".tcgvl", ".tcio")
"""The file names' endings in lower case: Structured Text (as written here, and by other tools), PLCopen XML, TwinCAT."""

TEST_SUFFIX = ".test.st"
"""The end of the names of files with unit tests (`fieldtwin.plc.st.unit_tests`), which the source of a program excludes."""
_BEGINNING = 64 * 1024
"""In this number of bytes an XML file has its first element."""
_PROGRAM = re.compile(rb"<(\w+:)?(project|TcPlcObject)\b")
"""The first element of a PLCopen XML file, or of a file of a TwinCAT project."""


def is_test_file(path: Path) -> bool:
    """Return whether a file has the name of a file with unit tests."""
    return path.name.lower().endswith(TEST_SUFFIX)


def source_files(path: Path) -> tuple[Path, ...]:
    """Return the file `path`; or, if it is a folder, the source files in it and below it, sorted, without hidden ones,
    unit tests and XML files of other tools.

    Raises `FileInvalid` for a folder without source files, or with more than `MAX_FILES` of them.
    """
    if not path.is_dir():
        return (path,)
    found = sorted(file for file in source_paths(path) if not is_test_file(file))
    if not found:
        raise FileInvalid("a folder without a program", path=str(path), expected="files " + ", ".join(SUFFIXES))
    if len(found) > MAX_FILES:
        raise FileInvalid("too many files", path=str(path), expected=f"at most {MAX_FILES}", got=str(len(found)))
    return tuple(found)


def source_paths(folder: Path) -> Iterator[Path]:
    """Yield the files in a folder and below it that have the ending of a source file, unit tests too, without hidden ones
    and XML files of other tools.
    """
    for path in folder.rglob("*"):
        hidden = any(part.startswith(".") for part in path.relative_to(folder).parts)
        if path.suffix.lower() in SUFFIXES and path.is_file() and not hidden and not _is_of_another_tool(path):
            yield path


def _is_of_another_tool(path: Path) -> bool:
    """Return whether an XML file has other content than a program, such as beremiz.xml in a project of OpenPLC Editor."""
    if path.suffix.lower() != ".xml":
        return False
    try:
        with path.open("rb") as file:
            return _PROGRAM.search(file.read(_BEGINNING)) is None
    except OSError:
        return False  # the reader of the file reports this
