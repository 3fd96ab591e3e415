"""The example of docs/how-to/faults.md is a valid fault file, and docs/reference/fault-files.md has every key."""

from __future__ import annotations

import re
from pathlib import Path

from fieldtwin.emulators.faults.fault import Aim
from fieldtwin.emulators.faults.schema import load_faults

DOCS = Path(__file__).parents[3] / "docs"


def test_the_file_on_the_page_is_a_fault_file(tmp_path: Path) -> None:
    blocks = re.findall(r"```yaml\n(.*?)```", (DOCS / "how-to" / "faults.md").read_text(), re.S)
    assert blocks
    for block in blocks:
        path = tmp_path / "faults.yaml"
        path.write_text(block)
        assert load_faults(path)


def test_every_aim_is_explained() -> None:
    table = "".join(
        line for line in (DOCS / "reference" / "fault-files.md").read_text().splitlines() if line.startswith("| `")
    )
    for name, info in Aim.model_fields.items():
        assert f"`{info.alias or name}`" in table
