"""The shipped SunSpec inverter against pysunspec2, the SunSpec Alliance's own client.

Defect: the profile had neither "SunS" nor model headers nor the end model, so that a scan by pysunspec2 failed.
"""

from __future__ import annotations

import contextlib
import subprocess
import sys
from collections.abc import Iterator

import pytest

client = pytest.importorskip("sunspec2.modbus.client", reason="pysunspec2 is not installed")

MODEL, END = 103, 0xFFFF


@pytest.fixture
def inverter() -> Iterator[int]:
    """The port of `fieldtwin emulate sunspec-inverter-103`, with its shipped recording."""
    command = [sys.executable, "-m", "fieldtwin", "emulate", "sunspec-inverter-103", "--on", "tcp://127.0.0.1:0"]
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as process:
        assert process.stderr is not None
        try:
            line = next(text for text in process.stderr if "tcp://127.0.0.1:" in text)
            yield int(line.rpartition(":")[2])
        finally:
            process.terminate()
            process.stderr.read()


def test_pysunspec2_scans_the_shipped_inverter_and_reads_its_values(inverter: int) -> None:
    device = client.SunSpecModbusClientDeviceTCP(slave_id=126, ipaddr="127.0.0.1", ipport=inverter, timeout=10)
    with contextlib.closing(device):
        device.scan()
        assert device.base_addr == 40000
        assert [number for number in device.models if isinstance(number, int)] == [1, MODEL]
        common, model = device.models[1][0], device.models[MODEL][0]
        assert (common.points["Mn"].value, common.points["Md"].value) == ("fieldtwin", "synthetic 10k")
        assert (common.points["SN"].value, common.points["DA"].value) == ("S-0001", 126)
        assert (common.points["L"].value, model.points["L"].value) == (66, 50)
        assert model.points["A"].cvalue == pytest.approx(21.74)
        assert model.points["AphC"].value is None  # not implemented
        assert model.points["PhVphA"].cvalue == pytest.approx(230.1, abs=1)
        assert model.points["W"].cvalue == pytest.approx(5000, abs=40)
        assert model.points["Hz"].cvalue == pytest.approx(50.01)
        assert model.points["WH"].cvalue == pytest.approx(15_000_000, abs=2000)
        assert (model.points["St"].value, model.points["Evt1"].value) == (4, 0)
        for absent in ("VA", "VAr", "PF", "DCA", "DCV", "DCW", "TmpCab", "StVnd", "Evt2", "EvtVnd4"):
            assert model.points[absent].value is None, absent
