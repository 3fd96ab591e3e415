"""A device whose prototype states no identity is read with an empty identity, which counts as the value it held.

Defect: a virtual run of a device with a `serial` register, and without `identity` in the prototype file, was not ok:
"ctd.serial was published as '' (...): the device never had this value".
"""

from __future__ import annotations

import json
import re
import shutil
from pathlib import Path

import pytest
from click.testing import CliRunner

from fieldtwin.cli.run.simulate_command import command

ROOT = Path(__file__).resolve().parents[2]


@pytest.mark.parametrize(
    ("system", "files"), [("observatory", "observatory relay"), ("ocean_west", "ocean_west adapt")]
)
def test_a_run_without_identities_is_ok(tmp_path: Path, system: str, files: str) -> None:
    for name in files.split():
        for path in (ROOT / "profiles" / "systems").glob(f"{name}.*"):
            if not path.name.endswith(".scenario.yaml"):
                shutil.copy(path, tmp_path)
    for path in (ROOT / "recordings").glob("*.jsonl"):
        shutil.copy(path, tmp_path)
    prototype, plant = tmp_path / f"{system}.prototype.yaml", tmp_path / f"{system}.yaml"
    stated = prototype.read_text()
    prototype.write_text(re.sub(r",? *identity: \{[^}]*\}", "", stated))
    assert prototype.read_text() != stated
    plant.write_text(re.sub(r" +expect: \{[^}]*\}", "", plant.read_text()))
    words = [str(plant), "--for", "20s", "--json"]
    told = CliRunner().invoke(command, words, standalone_mode=False)
    summary = json.loads(told.stdout)
    assert summary["ok"], summary["errors"]
    assert summary["published"]["checked"] > 50
    assert summary["published"]["wrong"] == 0
