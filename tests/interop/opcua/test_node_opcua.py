"""The secured OPC UA server with a client that shares no code with asyncua: node-opcua, fetched from npm."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
from datetime import UTC, datetime
from pathlib import Path

import pytest
from cryptography import x509
from cryptography.hazmat.primitives.serialization import Encoding
from received_samples import NEAR_NS, history
from served_hall import running

from fieldtwin.gateway.wallclock import WallClock

pytestmark = [pytest.mark.interop, pytest.mark.long, pytest.mark.timeout(400)]
PACKAGE = "node-opcua-client@2.182.2"
CLIENT = Path(__file__).with_name("node_opcua_client.js")
INSTALLED = Path(__file__).parents[3] / "build/node-opcua"


@pytest.fixture(scope="module")
def modules() -> Path:
    """The folder of node-opcua's packages (about 100, 33 MB). They stay in build/ for the next time."""
    if shutil.which("npm") is None or shutil.which("node") is None:
        pytest.skip("needs npm and Node.js (on Debian: apt install npm)")
    stamp = INSTALLED / "package.txt"
    if not stamp.is_file() or stamp.read_text(encoding="utf-8") != PACKAGE:
        INSTALLED.mkdir(parents=True, exist_ok=True)
        command = ["npm", "install", "--no-audit", "--no-fund", "--ignore-scripts", "--prefix", str(INSTALLED), PACKAGE]
        done = subprocess.run(command, capture_output=True, text=True, timeout=300, check=False)
        if done.returncode:
            pytest.skip(f"npm cannot install {PACKAGE}: {done.stderr[-300:]}")
        stamp.write_text(PACKAGE, encoding="utf-8")
    return INSTALLED / "node_modules"


def test_node_opcua_reads_writes_and_subscribes(tmp_path: Path, modules: Path) -> None:
    with running(tmp_path, secured=True) as (run, url):
        certificate = x509.load_der_x509_certificate((tmp_path / "hmi.der").read_bytes())
        (tmp_path / "hmi.crt").write_bytes(certificate.public_bytes(Encoding.PEM))
        environment = os.environ | {"NODE_PATH": str(modules)}
        command = ["node", str(CLIENT), url, str(tmp_path)]
        done = subprocess.run(command, capture_output=True, text=True, timeout=120, env=environment, check=False)
        clock = WallClock()
        offset_ns = clock.utc_ns() - clock.monotonic_ns()
        good, _ = history(run.control("hall", "gateway"))
    assert done.returncode == 0, done.stderr
    found = json.loads(next(line for line in done.stdout.splitlines() if line.startswith("RESULT "))[7:])
    assert (found["read"]["sensor.serial"]["value"], found["read"]["sensor.state"]["value"]) == ("SN-0042", 7)
    assert found["write"] == {"fan.lamp": "Good", "fan.limit": "BadOutOfRange", "fan.mode": "BadNotWritable"}
    assert len(found["samples"]) == 5
    for sample in [*found["samples"], found["read"]["sensor.temperature"]]:
        assert sample["status"] == "Good"
        since = datetime.fromisoformat(sample["source"]) - datetime(1970, 1, 1, tzinfo=UTC)
        source_ns = int(since.total_seconds() * 1e9) - offset_ns
        near = [value for value, t_ns in good["sensor.temperature"] if abs(t_ns - source_ns) < NEAR_NS]
        assert sample["value"] in near
