"""fieldtwin/installation.py is the only place that decides how pages and messages install fieldtwin."""

from __future__ import annotations

import ast
import importlib.util
import shlex
import sys
import tomllib
from importlib.machinery import SourceFileLoader
from pathlib import Path
from types import ModuleType

import pytest

from fieldtwin import installation

ROOT = Path(__file__).resolve().parents[2]
LINES = """
    - run: pip install ./fieldtwin-0.1.0-py3-none-any.whl
`pip install './fieldtwin[mqtt,postgres]'`, `pip install dist/fieldtwin-0.1.0-py3-none-any.whl`
python -m venv x && x/bin/pip install --no-deps ./fieldtwin   # comment
pip install 'python-can[...]'
"""


@pytest.fixture
def script() -> ModuleType:
    loader = SourceFileLoader("installation_script", str(ROOT / "scripts" / "installation"))
    spec = importlib.util.spec_from_loader("installation_script", loader)
    assert spec is not None
    module = importlib.util.module_from_spec(spec)
    loader.exec_module(module)
    return module


def test_every_page_and_message_has_the_command_of_installation_py(script: ModuleType) -> None:
    assert list(script.wrong_lines()) == []


def test_a_command_that_cannot_work_is_corrected(script: ModuleType) -> None:
    wrong = LINES.replace("./fieldtwin", "fieldtwin").replace(
        "'fieldtwin[mqtt,postgres]'", '"fieldtwin[mqtt,postgres]"'
    )
    assert script.corrected(wrong) == script.corrected(LINES) == LINES


def test_the_release_switches_all_commands(script: ModuleType, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(installation, "PUBLISHED", True)
    assert script.corrected(LINES) == LINES.replace("./fieldtwin-0.1.0-py3-none-any.whl", "fieldtwin").replace(
        "./fieldtwin", "fieldtwin"
    )


def test_a_new_version_is_written_into_the_names_of_wheels(script: ModuleType, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(installation, "__version__", "0.2.0")
    monkeypatch.setattr(installation, "WHEEL", "./fieldtwin-0.2.0-py3-none-any.whl")
    assert script.corrected(LINES) == LINES.replace("0.1.0", "0.2.0")


def test_the_hint_about_a_missing_extra_works_in_every_folder_for_a_clone() -> None:
    command = shlex.split(installation.install_hint("studio"))
    assert command[:4] == [sys.executable, "-m", "pip", "install"]
    clone, _, extra = command[-1].rstrip("]").partition("[")
    assert Path(clone).is_absolute()
    project = tomllib.loads((Path(clone) / "pyproject.toml").read_text("utf-8"))["project"]
    assert project["name"] == "fieldtwin"
    assert extra in project["optional-dependencies"]


def test_the_hint_of_a_program_from_a_wheel_file_names_the_wheel_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(installation, "PROGRAM", tmp_path)
    assert installation.install_hint("studio").startswith("pip install './fieldtwin[studio]'")
    assert "wheel file" in installation.install_hint("studio")


@pytest.mark.long
def test_no_message_has_a_command_of_its_own() -> None:
    for folder in ("fieldtwin", "gateway", "plc", "emulators", "twin"):
        for path in (ROOT / folder).rglob("*.py"):
            if path.name != "installation.py":
                texts = [
                    node.value
                    for node in ast.walk(ast.parse(path.read_text("utf-8")))
                    if isinstance(node, ast.Constant)
                ]
                ours = [
                    text for text in texts if isinstance(text, str) and "pip install" in text and "fieldtwin" in text
                ]
                assert not ours, f"{path}: use install_hint of fieldtwin.installation"
