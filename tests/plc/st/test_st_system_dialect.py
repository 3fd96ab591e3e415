"""The dialect of a program in a system file: its warnings are shown, and the program gets it."""

from __future__ import annotations

from pathlib import Path

import pytest
from template_rig import SHIPPED

from fieldtwin.gateway.core.errors import FileInvalid
from fieldtwin.twin.plant.physical import image_layout, program_warnings
from fieldtwin.twin.site.system import load_system


@pytest.fixture
def system_file(tmp_path: Path) -> Path:
    """A copy of a shipped system whose program assigns to an input."""
    shipped = SHIPPED / "systems" / "lab_vehicle.yaml"
    text = (SHIPPED / "systems" / "vehicle.st").read_text()
    name = "drive_status"
    (tmp_path / "vehicle.st").write_text(text.replace("END_PROGRAM", f"{name} := {name};\nEND_PROGRAM"))
    (tmp_path / "lab_vehicle.yaml").write_text(shipped.read_text())
    return tmp_path / "lab_vehicle.yaml"


def test_a_program_is_compiled_in_the_dialect_of_the_system_file(system_file: Path) -> None:
    with pytest.raises(FileInvalid, match="cannot be assigned to"):
        image_layout(load_system(str(system_file)))
    text = system_file.read_text()
    system_file.write_text(text.replace("source: vehicle.st", "source: vehicle.st\n      dialect: matiec"))
    system = load_system(str(system_file))
    image_layout(system)
    (warning,) = program_warnings(system)
    assert "vehicle.st:" in warning
    assert "ST001" in warning
