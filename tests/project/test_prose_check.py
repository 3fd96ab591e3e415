"""`scripts/prose`: sentences that it counts, and changes that it refuses."""

from __future__ import annotations

import importlib.util
import sys
from importlib.machinery import SourceFileLoader
from pathlib import Path
from types import ModuleType

import pytest

SCRIPT = Path(__file__).resolve().parents[2] / "scripts" / "prose"

PYTHON = '''"""Return the period in seconds."""


def f():
    """Whoever asks is told the period."""
    return "nobody asks"  # a reason
'''


@pytest.fixture
def prose(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    """The script, for a checkout of two files."""
    loader = SourceFileLoader("prose_script", str(SCRIPT))
    spec = importlib.util.spec_from_loader("prose_script", loader)
    assert spec is not None
    module = importlib.util.module_from_spec(spec)
    monkeypatch.setitem(sys.modules, "prose_script", module)
    loader.exec_module(module)
    monkeypatch.setattr(module, "ROOT", tmp_path)
    monkeypatch.setattr(module, "LIMITS", tmp_path / "prose.toml")
    monkeypatch.setattr(module, "files", lambda paths: ["plc/a.py", "docs/b.md"])
    monkeypatch.setattr(sys, "argv", ["prose"])
    (tmp_path / "plc").mkdir()
    (tmp_path / "docs").mkdir()
    (tmp_path / "plc" / "a.py").write_text(PYTHON)
    (tmp_path / "docs" / "b.md").write_text("The gateway writes it.\n\n```\nnobody reads this block here\n```\n")
    return module


def test_docstrings_and_paragraphs_count_and_code_does_not(prose: ModuleType) -> None:
    found = [s for path in prose.files([]) for s in prose.sentences(path)]
    assert [s.text for s in found if s.reasons()] == ["Whoever asks is told the period."]
    assert (found[1].path, found[1].line) == ("plc/a.py", 5)


def test_more_than_the_limit_is_refused(prose: ModuleType, capsys: pytest.CaptureFixture[str]) -> None:
    assert prose.main() == 1
    assert "plc has 1 sentences that readers have to decode, and 0 before" in capsys.readouterr().err
    prose.LIMITS.write_text("[limits]\nplc = 1\n")
    assert prose.main() == 0


def test_a_sentence_that_is_allowed_does_not_count(prose: ModuleType) -> None:
    prose.LIMITS.write_text('allowed = ["Whoever asks is told the period."]\n')
    assert prose.main() == 0


def test_limits_only_go_down(prose: ModuleType, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "argv", ["prose", "--lower"])
    prose.LIMITS.write_text("[limits]\nplc = 5\ndocs = 0\n")
    prose.main()
    assert '"plc" = 1\n' in prose.LIMITS.read_text()
    prose.LIMITS.write_text("[limits]\nplc = 0\n")
    prose.main()
    assert '"plc" = 0\n' in prose.LIMITS.read_text()
