"""Studio's description of a system says which tags can be read, so that the page does not count the others as bad values."""

from __future__ import annotations

from pathlib import Path

from fieldtwin.studio.live.observed import describe_system
from fieldtwin.twin.site.system import load_system

VALVE = """
device: mysite/valve
protocol: modbus
source: invented
tags:
  position: {at: 30001, type: uint16}
  reset: {at: 40001, type: uint16, access: wo}
"""
SYSTEM = """
fieldtwin: 1
system: hall
buses: {lan: {url: "tcp://192.0.2.1:502"}}
devices: {valve: {profile: ./valve.yaml, bus: lan, unit: 1, poll: {values: {every_ms: 100}}}}
"""


def test_a_tag_that_is_only_written_is_not_readable(tmp_path: Path) -> None:
    (tmp_path / "valve.yaml").write_text(VALVE)
    (tmp_path / "hall.yaml").write_text(SYSTEM)
    tags = describe_system(load_system(tmp_path / "hall.yaml"))["devices"]["valve"]["tags"]
    assert {name: tag["readable"] for name, tag in tags.items()} == {"position": True, "reset": False}
