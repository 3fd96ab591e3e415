"""The same system with different framings: Modbus ASCII on the serial port, Modbus over UDP to the modem."""

from __future__ import annotations

from pathlib import Path

import pytest
from procs import CHECKOUT, run_to_end

SYSTEMS = CHECKOUT / "profiles" / "systems"


@pytest.mark.long
def test_a_prototype_over_ascii_and_udp(tmp_path: Path) -> None:
    system = (SYSTEMS / "observatory.yaml").read_text(encoding="utf-8")
    system = system.replace("rtu:/dev/ttyS0?baudrate=19200&frame=8E1", "ascii:/dev/ttyS0?baudrate=19200&frame=7E1")
    system = system.replace("tcp://modem:502", "udp://modem:502")
    (tmp_path / "wires.yaml").write_text(system, encoding="utf-8")
    prototype = (SYSTEMS / "observatory.prototype.yaml").read_text(encoding="utf-8")
    prototype = prototype.replace("prototype_of: observatory.yaml", "prototype_of: wires.yaml")
    prototype = prototype.replace('lan:   {listen: "tcp://', 'lan:   {listen: "udp://')
    (tmp_path / "wires.prototype.yaml").write_text(prototype, encoding="utf-8")
    wanted = ("run", str(tmp_path / "wires.yaml"), "--prototype", "--for", "5s", "--instance", "ow", "--json")
    run = run_to_end(tmp_path, *wanted, name="wires")
    assert run.process.returncode == 0, run.err
    assert run.summary["errors"] == []
    assert [endpoint.partition(":")[0] for endpoint in run.summary["mapping"].values()] == ["ascii", "can", "udp"]
    for bus in ("line1", "lan"):
        exchanged = run.summary["exchanges"][bus]
        assert exchanged["gateway"]["replies"] == exchanged["emulators"]["replies"] > 0
    assert run.summary["published"]["wrong"] == 0
