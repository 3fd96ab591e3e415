"""The public Python API: its names, and the cost of its import."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

import fieldtwin

CHECKOUT = Path(__file__).resolve().parents[2]


def python(code: str) -> str:
    environment = {**os.environ, "PYTHONPATH": str(CHECKOUT)}
    ended = subprocess.run(
        [sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=False, timeout=30
    )
    assert ended.returncode == 0, ended.stderr
    return ended.stdout


def test_the_names_are_these() -> None:
    """A new name needs a decision; a removed name breaks user programs."""
    assert sorted(fieldtwin.__all__) == [
        "FieldtwinError", "RunOptions", "RunSession", "__version__", "load_profile", "load_prototype", "load_system",
        "scan_can_bus",
    ]  # fmt: skip
    assert dir(fieldtwin) == sorted(fieldtwin.__all__)


@pytest.mark.parametrize("name", fieldtwin.__all__)
def test_every_name_is_there_and_explains_itself(name: str) -> None:
    found = getattr(fieldtwin, name)
    assert found is not None
    if name != "__version__":
        assert found.__doc__
        assert found.__name__ == name


def test_an_unknown_name_is_an_attribute_error() -> None:
    with pytest.raises(AttributeError, match="'nothing'"):
        fieldtwin.nothing  # noqa: B018


def test_importing_the_package_imports_nothing_else() -> None:
    heavy = python(
        "import sys; import fieldtwin; print([m for m in ('pydantic', 'asyncio', 'pymodbus', 'can', 'canopen', 'click', 'yaml')"
        " if m in sys.modules])"
    )
    assert heavy.strip() == "[]"


def test_the_version_needs_no_protocol() -> None:
    shown = python(
        "import sys\n"
        "sys.argv = ['fieldtwin', '--version']\n"
        "from fieldtwin.cli.main import main\n"
        "try: main()\n"
        "except SystemExit as e: assert not e.code, e.code\n"
        "print([m for m in ('pydantic', 'pymodbus', 'can', 'canopen', 'rich', 'sqlite3') if m in sys.modules])"
    )
    assert shown.splitlines() == [f"fieldtwin, version {fieldtwin.__version__}", "[]"]


def test_the_api_loads_the_shipped_system() -> None:
    system = fieldtwin.load_system("observatory")
    assert list(system.devices) == ["ctd", "inclinometer", "modem"]
    assert fieldtwin.load_prototype(system).seed == 1
