"""Buses of a prototype that share a wire: duplicate addresses are an error of the file, with both places."""

from __future__ import annotations

from pathlib import Path

import pytest

from fieldtwin.gateway.core.endpoint import Endpoint
from fieldtwin.gateway.core.errors import FileInvalid, UsageError
from fieldtwin.twin.prototype.file import Prototype, load_prototype
from fieldtwin.twin.site.system import System, load_system

BUS = "can:fieldtwin/127.0.0.1:29536"
SYSTEM = """fieldtwin: 1
system: two
buses:
  can0: {url: "can:socketcan/can0", bitrate: 125000}
  can1: {url: "can:socketcan/can1", bitrate: 125000}
  line: {url: "rtu:/dev/ttyS0"}
  lan:  {url: "tcp://there:502"}
devices:
  left:  {profile: inclinometer-cia410, bus: can0, node: 5, start: true}
  right: {profile: inclinometer-cia410, bus: can1, node: NODE}
  ctd:   {profile: ctd-reference, bus: line, unit: 5, writable: [sample_period_s]}
  modem: {profile: modem-mailbox, bus: lan, unit: 5, writable: [outbox, inbox_ack]}
plc:
  cycle_ms: 10
  programs:
    relay:
      source: "python: fieldtwin.plc.relay:Relay"
      inputs: {command: {tag: modem.inbox}, sample: {tag: ctd.sample}}
      outputs: {period_s: ctd.sample_period_s, response: modem.outbox}
"""
PROTOTYPE = """prototype_of: two.yaml
buses:
  can0: {listen: "CAN0"}
  can1: {listen: "CAN1"}
  line: {listen: "LINE"}
  lan:  {listen: "LAN"}
devices:
  left:  {recording: incl.jsonl}
  right: {recording: incl.jsonl}
  ctd:   {recording: cast.jsonl}
  modem: {model: mailbox, far: "tcp://127.0.0.1:0"}
"""
APART = {
    "CAN0": "can:fieldtwin/127.0.0.1:0",
    "CAN1": "can:fieldtwin/127.0.0.1:0",
    "LINE": "pty:line",
    "LAN": "tcp://127.0.0.1:0",
}


def written(folder: Path, node: int, **listen: str) -> tuple[System, Prototype]:
    text = PROTOTYPE
    for name, url in {**APART, **listen}.items():
        text = text.replace(name, url)
    (folder / "two.yaml").write_text(SYSTEM.replace("NODE", str(node)))
    (folder / "two.prototype.yaml").write_text(text)
    system = load_system(str(folder / "two.yaml"))
    return system, load_prototype(system)


def test_private_buses_are_not_shared(tmp_path: Path) -> None:
    written(tmp_path, 5)
    written(tmp_path, 6, CAN0=BUS, CAN1=BUS)


def test_two_nodes_with_one_id_on_one_wire_are_an_error_with_both_places(tmp_path: Path) -> None:
    with pytest.raises(FileInvalid) as e:
        written(tmp_path, 5, CAN0=BUS, CAN1=BUS)
    assert (e.value.path, e.value.line) == (str(tmp_path / "two.prototype.yaml"), 4)
    said = str(e.value)
    assert "'right' of 'can1' has node id 5 at can:fieldtwin/127.0.0.1:29536, and so has 'left' of 'can0'" in said
    assert "'can0' is in line 3; of two.yaml: 'right' in line 10 and 'left' in line 9" in said
    assert "the fault duplicate-node" in said


@pytest.mark.parametrize(
    ("listen", "line", "told"),
    [
        (
            {"LINE": "tcp://127.0.0.1:1502", "LAN": "tcp://127.0.0.1:1502"},
            6,
            "'lan' listens at tcp://127.0.0.1:1502, and so does 'line'",
        ),
        ({"CAN0": "can:socketcan/vcan0", "CAN1": "can:socketcan/vcan0"}, 4, "node id 5 at can:socketcan/vcan0"),
    ],
)
def test_two_buses_at_one_place(tmp_path: Path, listen: dict[str, str], line: int, told: str) -> None:
    with pytest.raises(FileInvalid) as e:
        written(tmp_path, 5, **listen)
    assert e.value.line == line
    assert told in str(e.value)


def test_two_buses_of_a_plant_that_are_one_interface(tmp_path: Path) -> None:
    text = SYSTEM.replace("NODE", "5").replace("socketcan/can1", "socketcan/can0")
    (tmp_path / "two.yaml").write_text(text)
    with pytest.raises(
        FileInvalid, match=r"10:\d+: 'right' has node 5 on 'can1', and so has 'left' on 'can0'.*'left' is in line 9"
    ):
        load_system(str(tmp_path / "two.yaml"))


def test_the_command_line_cannot_put_two_buses_on_one_endpoint(tmp_path: Path) -> None:
    system, prototype = written(tmp_path, 5, CAN0=BUS)
    with pytest.raises(UsageError, match="node id 5"):
        prototype.with_listen(system, "can1", Endpoint.parse(BUS))
    assert prototype.with_listen(system, "can1", Endpoint.parse("can:fieldtwin/127.0.0.1:29537")).buses["can1"].listen
