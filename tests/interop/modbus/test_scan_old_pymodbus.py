"""`scan` on a TCP server of pymodbus 3.9.2: the package itself, fetched from the package registry when the test runs.

tests/commissioning/scan/test_scan_odd_replies.py tests its reply to an unknown unit, and the result of the scan,
without the package.
"""

from __future__ import annotations

import asyncio
import os
import subprocess
import sys
from pathlib import Path

import pytest
from support import run

HERE = Path(__file__).parent
pytestmark = [pytest.mark.interop, pytest.mark.long, pytest.mark.timeout(300)]


def test_a_scan_finds_the_two_units_and_reports_the_other_answers_once(tmp_path: Path) -> None:
    fetched = subprocess.run(
        [sys.executable, "-m", "pip", "install", "-q", "--no-deps", "--target", str(tmp_path / "old"), "pymodbus==3.9.2"],
        capture_output=True, text=True, timeout=200, check=False,
    )  # fmt: skip
    if fetched.returncode:
        pytest.skip(f"the registry gave no package: {fetched.stderr.strip()[-200:]}")

    async def main() -> tuple[str, str, int | None]:
        server = await asyncio.create_subprocess_exec(
            sys.executable, str(HERE / "old_pymodbus_server.py"), "5,9",
            stdout=asyncio.subprocess.PIPE, env={**os.environ, "PYTHONPATH": str(tmp_path / "old")},
        )  # fmt: skip
        assert server.stdout is not None
        try:
            port = int(await server.stdout.readline())
            scan = await asyncio.create_subprocess_exec(
                sys.executable, "-m", "fieldtwin", "scan", f"tcp://127.0.0.1:{port}",
                stdout=asyncio.subprocess.PIPE, stderr=asyncio.subprocess.PIPE,
            )  # fmt: skip
            told, said = await scan.communicate()
            return told.decode(), said.decode(), scan.returncode
        finally:
            server.kill()
            await server.wait()

    found, said, code = run(main(), timeout_s=120)
    assert code == 0
    assert [line.split()[:2] for line in found.splitlines()[1:]] == [["5", "answers"], ["9", "answers"]]
    odd = [line for line in said.splitlines() if "does not match" in line]
    assert len(odd) == 1
    assert "units (0-4, 6-8, 10-247, 255): a reply that does not match the request (80 0B): exception 0B" in odd[0]
    assert "two devices" not in said
