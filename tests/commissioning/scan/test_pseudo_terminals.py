"""`scan` says that a pseudo-terminal confirms no baud rate: it answered 9600 8N1 for a device with 4800 8N2."""

from __future__ import annotations

import os
from pathlib import Path

from fieldtwin.cli.device.scan_command import is_pseudo_terminal
from fieldtwin.gateway.core.endpoint import Endpoint


def test_a_pseudo_terminal_is_recognised_also_through_a_link(tmp_path: Path) -> None:
    controller, terminal = os.openpty()
    try:
        name = os.ttyname(terminal)
        (tmp_path / "line").symlink_to(name)
        for path in (name, tmp_path / "line"):
            assert is_pseudo_terminal(Endpoint.parse(f"rtu:{path}?baudrate=4800&frame=8N2"))
    finally:
        os.close(controller)
        os.close(terminal)


def test_other_ports_are_not_pseudo_terminals() -> None:
    for url in ("rtu:/dev/ttyS0", "rtu:/dev/null", "tcp://127.0.0.1:502"):
        assert not is_pseudo_terminal(Endpoint.parse(url))
