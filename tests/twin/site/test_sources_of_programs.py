"""The source of a program in a system file: a file, a folder, or a list of files."""

from __future__ import annotations

from pathlib import Path

import pytest

from fieldtwin.gateway.core.errors import FileInvalid
from fieldtwin.twin.plant.physical import programs_of
from fieldtwin.twin.site.system import load_system

FILES = {
    "main.st": "PROGRAM Main VAR b : Twice; n : INT; END_VAR b(x := 3); n := b.y + OFFSET; END_PROGRAM",
    "blocks.st": "FUNCTION_BLOCK Twice VAR_INPUT x : INT; END_VAR VAR_OUTPUT y : INT; END_VAR y := 2 * x; END_FUNCTION_BLOCK",
    "more.st": "VAR_GLOBAL CONSTANT OFFSET : INT := 5; END_VAR",
}


def system(folder: Path, program: str) -> Path:
    for name, text in FILES.items():
        (folder / name).write_text(text)
    path = folder / "line.yaml"
    path.write_text(f"fieldtwin: 1\nsystem: line\nplc:\n  programs:\n    main: {{{program}}}\n")
    return path


@pytest.mark.parametrize(
    "program", ["source: [main.st, blocks.st, more.st]", "source: [main.st, blocks.st], libraries: [more.st]"]
)
def test_a_list_of_files_is_the_source_of_a_program(tmp_path: Path, program: str) -> None:
    (config,) = programs_of(load_system(str(system(tmp_path, program))))
    assert (config.source, config.libraries) == ("main.st", ("blocks.st", "more.st"))
    bound = config.bind((str(tmp_path),))
    assert [Path(file).name for file in bound.program.source_files] == ["main.st", "blocks.st", "more.st"]


@pytest.mark.parametrize("program", ["source: []", "source: [main.st, 5]", "source: [main.st], libraries: blocks.st"])
def test_other_lists_are_refused_with_their_line(tmp_path: Path, program: str) -> None:
    with pytest.raises(FileInvalid) as caught:
        load_system(str(system(tmp_path, program)))
    assert caught.value.line == 5
