"""The project folder of an agent: which paths are inside, which files are read, and results of limited length."""

from __future__ import annotations

import tempfile
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fieldtwin.agents.project import Project, kind_of
from fieldtwin.agents.results import MOST_CHARACTERS, MOST_KEPT, Results
from fieldtwin.gateway.core.errors import FieldtwinError, NotAllowed, UsageError

PARTS = st.lists(st.sampled_from(["..", ".", "a", "b.yaml", "", "/", "~", "\0", ".git", "link", "x" * 300]), max_size=6)


@given(PARTS.map("/".join) | st.text(max_size=40))
def test_no_path_leaves_the_project(text: str) -> None:
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name).resolve() / "project"
        folder.mkdir()
        (folder / "link").symlink_to("..")
        try:
            path = Project(folder).inside(text)
        except FieldtwinError:
            return
        assert path.is_relative_to(folder)
        assert not any(part.startswith(".") for part in path.relative_to(folder).parts)


@pytest.mark.parametrize("name", ["token", "key.pem", "x.key", "x.sqlite", "program.py", "fmu.fmu", ""])
def test_files_of_other_kinds_are_not_read(name: str, tmp_path: Path) -> None:
    assert kind_of(Path(name)) == ""
    if name:
        (tmp_path / name).write_text("secret")
        with pytest.raises(NotAllowed, match="not read"):
            Project(tmp_path).read(name)
        assert Project(tmp_path).files() == ([], True)


LENGTHS = st.integers(MOST_CHARACTERS - 2, MOST_CHARACTERS + 2) | st.integers(0, 100_000)


@given(st.builds(lambda unit, length: (unit * length)[:length], st.text(min_size=1, max_size=9), LENGTHS))
def test_the_parts_of_a_long_result_are_the_whole_result(text: str) -> None:
    results = Results()
    shown, whole = results.shown(text), ""
    while shown.endswith(")]") and "\n[characters " in shown:
        part, _, note = shown.rpartition("\n[characters ")
        whole += part
        assert len(shown) <= MOST_CHARACTERS
        shown = results.part(1, int(note.rpartition("offset=")[2].removesuffix(")]")))
    assert whole + shown == text


def test_only_the_latest_long_results_are_kept() -> None:
    results = Results()
    for _ in range(MOST_KEPT + 1):
        results.shown("x" * (MOST_CHARACTERS + 1))
    assert results.part(2, MOST_CHARACTERS) == "x"
    with pytest.raises(UsageError, match="result 1 is not kept"):
        results.part(1, 0)
    with pytest.raises(UsageError, match="the offset"):
        results.part(2, -1)
