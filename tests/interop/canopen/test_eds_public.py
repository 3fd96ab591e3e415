"""Both readers of data sheets accept the public files of other projects, and interpret them identically.

The test fetches the files from package registries, because they belong to other projects; without a registry it is skipped.
tests/gateway/protocols/canopen/eds/test_eds_readers_agree.py tests each construct without them.
"""

from __future__ import annotations

import shutil
import subprocess
import sys
import tarfile
from importlib.metadata import version
from pathlib import Path

import pytest
from eds_agreement import NODE, differences

from fieldtwin.emulators.canopen.eds.dictionary import load_eds
from fieldtwin.gateway.protocols.canopen.eds.dictionary import load_dictionary

pytestmark = [pytest.mark.interop, pytest.mark.long]

PIP = [sys.executable, "-m", "pip", "download", "-q", "--no-deps", "--no-binary", ":all:"]
OLDER = ("1.2.1", "2.0.0", "2.2.0")
"""Releases of the package with data sheets different from the current ones."""
SOURCES = {
    "canopen from PyPI": [*PIP, f"canopen=={version('canopen')}"],
    **{f"canopen {older} from PyPI": [*PIP, f"canopen=={older}"] for older in OLDER},
    "canopen from npm": ["npm", "pack", "--silent", "canopen@6.2.1"],
}  # fmt: skip


@pytest.mark.parametrize("command", SOURCES.values(), ids=SOURCES)
def test_both_readers_agree_on_public_data_sheets(command: list[str], tmp_path: Path) -> None:
    if shutil.which(command[0]) is None:
        pytest.skip(f"{command[0]} is not installed")
    fetched = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=300, check=False)
    archives = [*tmp_path.glob("*.tar.gz"), *tmp_path.glob("*.tgz")]
    if fetched.returncode or not archives:
        pytest.skip(f"the registry gave no package: {fetched.stderr.strip()[-200:]}")
    with tarfile.open(archives[0]) as archive:
        archive.extractall(tmp_path, filter="data")
    sheets = sorted(path for path in tmp_path.rglob("*") if path.suffix.lower() in (".eds", ".dcf"))
    assert sheets
    for sheet in sheets:
        assert differences(load_eds(sheet), load_dictionary(sheet, NODE)) == [], sheet.name
