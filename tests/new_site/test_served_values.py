"""The values that a new site serves to an HMI: a gateway alone serves all polled values, each device in its own registers.

Defect: it served one value of each device, for a draft profile a setting, and the user had to add every other value by hand.
"""

from __future__ import annotations

from pathlib import Path

import yaml
from click.testing import CliRunner

from fieldtwin.cli.main import cli
from fieldtwin.gateway.core.files.profile import REGISTERS_OF
from fieldtwin.gateway.core.files.profile_file import resolve
from fieldtwin.gateway.core.files.yaml_file import parse
from fieldtwin.new_site.served import QUALITY_OFFSET, SPACING, served_values
from fieldtwin.site.check import check_site

STATION = """\
device: mysite/station
source: "page 3"
protocol: modbus
defaults: {order: ABCD}
tags:
  wind: {at: 30001, type: float32}
  pulses: {at: 30003, type: uint32}
  door: {at: 10001, type: bool}
  energy: {at: 30005, type: uint32, scale: 0.1}
  pin: {at: 40001, secret: true}
  serial: {at: 30007, type: string, registers: 6, poll: identity}
  model: {at: 30013, type: string, registers: 2}
  firmware: {at: 30015, poll: identity}
"""


def served(folder: Path, control: str) -> dict[str, dict[str, object]]:
    """Return the served tags of a new site with two stations."""
    (folder / "station.yaml").write_text(STATION, encoding="utf-8")
    chosen = ["--device", f"a={folder / 'station.yaml'}", "--device", f"b={folder / 'station.yaml'}"]
    done = CliRunner().invoke(cli, ["new", str(folder / "site"), *chosen, "--control", control], standalone_mode=False)
    assert done.exception is None, done.output
    assert check_site(folder / "site").errors == []
    tags: dict[str, dict[str, object]] = yaml.safe_load((folder / "site" / "site.yaml").read_text())["serve"]["hmi"][
        "tags"
    ]
    return tags


def test_a_gateway_alone_serves_all_polled_numbers(tmp_path: Path) -> None:
    assert served(tmp_path, "none") == {
        "a.wind": {"input": 0, "type": "float32", "quality": 500},
        "a.pulses": {"input": 2, "type": "uint32", "quality": 501},
        "a.door": {"input": 4, "type": "float32", "quality": 502},
        "a.energy": {"input": 6, "type": "float32", "quality": 503},
        "b.wind": {"input": 1000, "type": "float32", "quality": 1500},
        "b.pulses": {"input": 1002, "type": "uint32", "quality": 1501},
        "b.door": {"input": 1004, "type": "float32", "quality": 1502},
        "b.energy": {"input": 1006, "type": "float32", "quality": 1503},
    }


def test_beside_a_program_the_supervised_value_is_served(tmp_path: Path) -> None:
    assert list(served(tmp_path, "st")) == ["a.wind", "b.wind"]


def test_the_values_of_a_large_device_end_before_its_quality_registers() -> None:
    text = (
        'device: a/b\nsource: "x"\nprotocol: modbus\ntags:\n  v1..300: {at: 30001, type: float32}\n'
        "  w1..100: {at: 40001, type: uint64}\n"
    )
    tags = resolve(parse(text, "large.yaml")).tags.values()
    values = served_values(tags, 63)
    assert len(values) == QUALITY_OFFSET // 2
    assert values[-1].address + REGISTERS_OF[values[-1].type] <= values[0].quality
    assert max(value.quality for value in values) < 64 * SPACING <= 0x10000
