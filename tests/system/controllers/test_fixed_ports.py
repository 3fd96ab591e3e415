"""`run --prototype --fixed-ports`: an HMI with a fixed address reaches the prototype as it reaches the plant."""

from __future__ import annotations

import re
import socket
from pathlib import Path

import pytest
from click.testing import CliRunner
from procs import fieldtwin, free_port, wait_for

from fieldtwin.cli.main import cli
from fieldtwin.gateway.core.errors import FieldtwinError, UsageError

TANK = "device: mysite/tank\nprotocol: modbus\nsource: invented\ntags: {level: {at: 30001, type: uint16}}\n"
SYSTEM = """
fieldtwin: 1
system: hall
buses: {{lan: {{url: "tcp://192.0.2.1:502"}}}}
devices: {{tank: {{profile: ./tank.yaml, bus: lan, unit: 1, poll: {{values: {{every_ms: 100}}}}}}}}
serve:
  hmi: {{url: "tcp://127.0.0.1:{port}", tags: {{tank.level: {{input: 0, type: uint16}}}}}}
"""
PROTOTYPE = """
prototype_of: hall.yaml
buses: {lan: {listen: "tcp://127.0.0.1:0"}}
devices: {tank: {model: profile, values: {level: 7}}}
"""


def site(folder: Path, port: int) -> str:
    for name, text in (("tank", TANK), ("hall", SYSTEM.format(port=port)), ("hall.prototype", PROTOTYPE)):
        (folder / f"{name}.yaml").write_text(text)
    return str(folder / "hall.yaml")


def level(port: int) -> bytes:
    """Read input register 0 of unit 1, and return its two bytes."""
    with socket.create_connection(("127.0.0.1", port), 5) as client:
        client.settimeout(5)
        client.sendall(bytes.fromhex("000100000006010400000001"))
        return client.recv(64)[9:]


@pytest.mark.long
@pytest.mark.parametrize("is_fixed", [True, False])
def test_a_server_of_a_prototype_has_the_port_of_the_file_if_ports_are_fixed(tmp_path: Path, is_fixed: bool) -> None:
    port = free_port()
    words = ["run", site(tmp_path, port), "--prototype", *(["--fixed-ports"] if is_fixed else [])]
    with fieldtwin(tmp_path, *words) as run:
        found = wait_for(
            lambda: re.search(r"serve hmi  ←  tcp://127\.0\.0\.1:(\d+)", run.err), 90, "the server's address"
        )
        assert (int(found[1]) == port) is is_fixed
        wait_for(lambda: level(int(found[1])) == b"\x00\x07", 30, "the level of the simulated tank")


def test_a_plant_needs_no_option_for_its_ports(tmp_path: Path) -> None:
    words = ["run", site(tmp_path, 1502), "--plant", "--fixed-ports"]
    done = CliRunner().invoke(cli, words, standalone_mode=False)
    assert isinstance(done.exception, UsageError)
    assert "--fixed-ports needs --prototype" in str(done.exception)


def test_a_site_is_checked_by_its_folder(tmp_path: Path) -> None:
    file = site(tmp_path, 1502)
    done = CliRunner().invoke(cli, ["check", "site", file], standalone_mode=False)
    assert isinstance(done.exception, FieldtwinError)
    assert f"expected its folder: {tmp_path}" in str(done.exception)
