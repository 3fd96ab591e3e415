"""The kept tables of a parser are used only if they are complete and belong to the grammar."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest
from lark import Lark, UnexpectedInput

from fieldtwin.plc.st.syntax.grammar import parser
from fieldtwin.plc.st.syntax.parse_tables import parser_with_tables, place_of

SUM = 'start: NUMBER ("+" NUMBER)*\nNUMBER: /[0-9]+/\n'
DIFFERENCE = SUM.replace('"+"', '"-"')


class Builder:
    """Builds parsers and counts them."""

    def __init__(self, place: Path) -> None:
        self.place = place
        self.count = 0

    def parser(self, grammar: str) -> Lark:
        def build() -> Lark:
            self.count += 1
            return Lark(grammar, parser="lalr")

        return parser_with_tables(self.place, grammar, build)


@pytest.fixture
def builder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Builder:
    monkeypatch.setattr(sys, "dont_write_bytecode", False)
    return Builder(tmp_path / "__pycache__" / "grammar.tables")


def test_the_second_parser_reads_the_tables_of_the_first(builder: Builder) -> None:
    first, second = builder.parser(SUM), builder.parser(SUM)
    assert builder.count == 1
    assert second.parse("1+2+3") == first.parse("1+2+3")
    with pytest.raises(UnexpectedInput):
        second.parse("1-2")
    assert [file.name for file in builder.place.parent.iterdir()] == ["grammar.tables"]


def test_the_tables_of_a_changed_grammar_are_replaced(builder: Builder) -> None:
    builder.parser(SUM)
    assert len(builder.parser(DIFFERENCE).parse("1-2").children) == 2
    builder.parser(DIFFERENCE)
    assert builder.count == 2


@pytest.mark.parametrize("length", [0, 10, 40, -1])
def test_a_truncated_file_is_replaced(builder: Builder, length: int) -> None:
    builder.parser(SUM)
    whole = builder.place.read_bytes()
    builder.place.write_bytes(whole[:length])
    assert len(builder.parser(SUM).parse("1+2").children) == 2
    assert builder.count == 2
    assert len(builder.place.read_bytes()) == len(whole)


def test_a_changed_byte_is_detected(builder: Builder) -> None:
    builder.parser(SUM)
    whole = bytearray(builder.place.read_bytes())
    whole[len(whole) // 2] ^= 1
    builder.place.write_bytes(whole)
    builder.parser(SUM)
    assert builder.count == 2


def test_a_folder_that_cannot_be_written_is_no_error(builder: Builder) -> None:
    builder.place.parent.write_text("a file in place of the folder")
    assert len(builder.parser(SUM).parse("1+2").children) == 2


def test_pythons_option_against_compiled_files_also_forbids_tables(
    builder: Builder, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys, "dont_write_bytecode", True)
    builder.parser(SUM)
    assert not builder.place.exists()


def test_pythons_option_for_the_folder_of_compiled_files_applies_to_tables(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys, "pycache_prefix", str(tmp_path / "elsewhere"))
    assert place_of(tmp_path / "grammar.lark").is_relative_to(tmp_path / "elsewhere")


def test_the_parser_of_structured_text_can_be_kept(builder: Builder) -> None:
    text = "PROGRAM p VAR a : INT := 2; END_VAR IF a > 1 THEN a := a + 1; END_IF; END_PROGRAM"
    parser_with_tables(builder.place, "", parser)
    kept = parser_with_tables(builder.place, "", lambda: pytest.fail("the tables were not read"))
    assert kept.parse(text, start="start") == parser().parse(text, start="start")
