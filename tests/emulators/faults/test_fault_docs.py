"""docs/how-to/faults.md: its example is a valid fault file, and its keys exist."""

from __future__ import annotations

import re
from pathlib import Path

from fieldtwin.emulators.faults.fault import Aim
from fieldtwin.emulators.faults.schema import load_faults

TEXT = (Path(__file__).parents[3] / "docs" / "how-to" / "faults.md").read_text()


def test_its_file_is_a_fault_file(tmp_path: Path) -> None:
    blocks = re.findall(r"```yaml\n(.*?)```", TEXT, re.S)
    assert blocks
    for block in blocks:
        path = tmp_path / "faults.yaml"
        path.write_text(block)
        assert load_faults(path)


def test_every_aim_is_explained() -> None:
    table = "".join(line for line in TEXT.splitlines() if line.startswith("| `"))
    for name, info in Aim.model_fields.items():
        assert f"`{info.alias or name}`" in table
