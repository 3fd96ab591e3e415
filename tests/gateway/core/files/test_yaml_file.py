"""YAML as users mean it: scalars, duplicates, positions, and only `FileInvalid` for any content of a file."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path
from typing import Literal

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import BaseModel, ConfigDict, Field

from fieldtwin.gateway.core.errors import FileInvalid
from fieldtwin.gateway.core.files.yaml_file import MAX_BYTES, MAX_NESTING, load, parse, validate


class Inner(BaseModel):
    model_config = ConfigDict(extra="forbid", strict=True)
    count: int
    names: list[str] = []


class Line(BaseModel):
    model_config = ConfigDict(extra="forbid", strict=True)
    url: str = Field(examples=["tcp://h:502"])
    kind: Literal["rtu", "ascii"]
    speeds: list[int] = Field(examples=[[9600]])


class Outer(BaseModel):
    model_config = ConfigDict(extra="forbid", strict=True)
    title: str
    inner: dict[str, Inner] = {}
    line: Line | None = None


@pytest.mark.parametrize(
    ("scalar", "value"),
    [
        ("OFF", "OFF"), ("off", "off"), ("yes", "yes"), ("NO", "NO"), ("True", "True"), ("true", True), ("false", False),
        ("1017:00", "1017:00"), ("1:30", "1:30"), ("8E1", "8E1"), ("0x10", 16), ("010", "010"), ("0", 0), ("-5", -5),
        ("+5", 5), ("1.5", 1.5), (".5", 0.5), ("1_000", "1_000"), ("2026-11-21", "2026-11-21"), ("null", None), ("~", None),
        ("", None), ("'5'", "5"), (".inf", ".inf"), ("=", "="),
    ],
)  # fmt: skip
def test_scalars_follow_the_core_schema_of_yaml(scalar: str, value: object) -> None:
    read = parse(f"x: {scalar}\n", "f").data["x"]
    assert read == value
    assert type(read) is type(value)


@pytest.mark.parametrize(
    ("text", "line", "column", "told"),
    [
        ("a: 1\n\tb: 2\n", 2, 1, "spaces, never tabs"),
        ("a: 1\n  b: 2\n", 2, 4, "not YAML"),
        ("a: [1, 2\n", 2, 1, "not YAML"),
        ("a: 1\nb: 2\na: 3\n", 3, 1, "is defined twice"),
        ("x:\n  a: 1\n  a: 2\n", 3, 3, "first at line 2"),
        ("- 1\n- 2\n", 1, 0, "no keys"),
        ("", 1, 0, "no keys"),
        ("just text\n", 1, 0, "no keys"),
        ("? [1, 2]\n: 3\n", 1, 3, "plain word"),
        ("a: *nobody\n", 1, 4, "not YAML"),
        ("a: !!python/object:os.system x\n", 1, 4, "not YAML"),
        ("a: 1\n---\nb: 2\n", 2, 1, "not YAML"),
        ("a: \x00\n", 1, 0, "not YAML"),
    ],
)
def test_errors_point_at_their_position(text: str, line: int, column: int, told: str) -> None:
    with pytest.raises(FileInvalid) as error:
        parse(text, "f.yaml")
    assert (error.value.line, error.value.column) == (line, column)
    assert told in str(error.value)
    assert str(error.value).startswith(f"f.yaml:{line}")


@pytest.mark.parametrize(
    ("text", "line", "column", "told"),
    [
        ("titel: x\n", 1, 1, "did you mean 'title'?"),
        ("title: x\ninner:\n  a:\n    cuont: 1\n", 4, 5, "did you mean 'count'?"),
        ("inner: {}\n", 1, 1, "'title' is missing"),
        ("title: x\ninner:\n  a: {names: []}\n", 3, 3, "'count' is missing in 'inner.a'"),
        ("title: x\ninner:\n  a: {}\n", 3, 3, "'count' is missing in 'inner.a'; expected a whole number"),
        ("title: x\nline: {}\n", 2, 1, "'url' is missing in 'line'; expected url: tcp://h:502, for example"),
        ("title: x\nline: {url: a}\n", 2, 1, "'kind' is missing in 'line'; expected kind: rtu or ascii"),
        (
            "title: x\nline: {url: a, kind: rtu}\n",
            2,
            1,
            "'speeds' is missing in 'line'; expected speeds: [9600], for example",
        ),
        ("title: 5\n", 1, 1, "title; expected text; got 5"),
        ("title: x\ninner:\n  a: {count: 1, names: [b, 5]}\n", 3, 28, "inner.a.names.1"),
        ("title: x\ninner:\n  a: {count: true}\n", 3, 7, "inner.a.count; expected a whole number; got true"),
        ("title: x\ninner: [1]\n", 2, 1, "inner"),
    ],
)
def test_a_model_error_names_the_expected_type(text: str, line: int, column: int, told: str) -> None:
    file = parse(text, "f.yaml")
    with pytest.raises(FileInvalid) as error:
        validate(file, Outer)
    assert told in str(error.value)
    assert (error.value.line, error.value.column) == (line, column)


def test_files_that_cannot_be_read(tmp_path: Path) -> None:
    with pytest.raises(FileInvalid, match="cannot read the file"):
        load(tmp_path / "nowhere.yaml")
    with pytest.raises(FileInvalid, match="cannot read the file"):
        load(tmp_path)
    (tmp_path / "latin.yaml").write_bytes(b"a: \xe9t\xe9\n")
    with pytest.raises(FileInvalid, match="not UTF-8"):
        load(tmp_path / "latin.yaml")
    with (tmp_path / "large.yaml").open("wb") as large:
        large.truncate(MAX_BYTES + 1)
    with pytest.raises(FileInvalid, match="too large"):
        load(tmp_path / "large.yaml")


@given(st.text(max_size=60))
def test_any_text_raises_only_file_invalid(text: str) -> None:
    with suppress(FileInvalid):
        validate(parse(text, "f"), Outer)


@given(st.text(st.sampled_from("ab:[]{}-,&*!|>'\"%@`#?~ \n\t0.x"), max_size=40))
def test_any_yaml_like_text_raises_only_file_invalid(text: str) -> None:
    with suppress(FileInvalid):
        validate(parse(text, "f"), Outer)


def test_deep_nesting_and_aliases_end_in_an_error_and_not_in_a_crash() -> None:
    with pytest.raises(FileInvalid):
        parse("a: " + "[" * 1500, "f")
    bomb = "a: &a [x, x, x, x, x, x, x, x, x]\n"
    for now, before in zip("bcdefghi", "abcdefgh", strict=True):
        bomb += f"{now}: &{now} [{', '.join(['*' + before] * 9)}]\n"
    with pytest.raises(FileInvalid):
        parse(bomb, "f")


@pytest.mark.parametrize(("begins", "told"), [(b"PK\x03\x04\xff", "template unpack"), (b"\xff\xfef\x00", "UTF-16")])
def test_another_kind_of_file_is_named(tmp_path: Path, begins: bytes, told: str) -> None:
    (tmp_path / "given").write_bytes(begins)
    with pytest.raises(FileInvalid, match=told):
        load(tmp_path / "given")


@pytest.mark.parametrize("begins", [b"\xef\xbb\xbfa: 1\n", b"a: 1\r\nb: 2\r\n"])
def test_files_of_editors_on_other_systems_are_read(tmp_path: Path, begins: bytes) -> None:
    (tmp_path / "given").write_bytes(begins)
    assert load(tmp_path / "given").data["a"] == 1


def test_brackets_may_be_nested_up_to_the_limit_only() -> None:
    inside = "a: " + "[" * MAX_NESTING + "]" * MAX_NESTING
    assert parse(inside, "x.yaml").data["a"] is not None
    with pytest.raises(FileInvalid, match=f"more than {MAX_NESTING} nested"):
        parse("a: " + "{b: " * (MAX_NESTING + 1), "x.yaml")


def test_a_section_has_the_entries_as_the_user_wrote_them() -> None:
    file = parse("a: {x: {y: 1}}\nb:\nc: [1]\nd: 5\n", "f.yaml")
    assert file.section("a") == {"x": {"y": 1}}
    assert [file.section(name) for name in ("b", "c", "d", "e")] == [{}, {}, {}, {}]
