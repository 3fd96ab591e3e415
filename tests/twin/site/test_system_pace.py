"""The timing keys of a system file, defaults from profiles, and refused values."""

from __future__ import annotations

from pathlib import Path

import pytest

from fieldtwin.gateway.core.errors import FileInvalid
from fieldtwin.twin.plant.physical import gateway_config
from fieldtwin.twin.site.system import System, load_system

PROFILE = """
device: mysite/meter
source: "a test"
protocol: modbus
TIMING
tags: {a: {at: 30001}, b: {at: 30002, poll: slow}}
"""
SYSTEM = """
fieldtwin: 1
system: pace
buses:
  line1: {url: "URL", timeout_ms: 500BUS}
devices:
  meter: {profile: ./meter.yaml, bus: line1, unit: 1, poll: {values: {every_ms: 200POLL}, slow: {every_ms: 900}}DEVICE}
  other: {profile: ./meter.yaml, bus: line1, unit: 2}
plc: {programs: {p: {source: "python: x:Y"}}}
"""


def system(
    folder: Path,
    *,
    timing: str = "",
    bus: str = "",
    poll: str = "",
    device: str = "",
    url: str = "rtu:/dev/ttyS0",
) -> System:
    (folder / "meter.yaml").write_text(PROFILE.replace("TIMING", timing), encoding="utf-8")
    text = SYSTEM.replace("URL", url).replace("BUS", bus).replace("POLL", poll).replace("DEVICE", device)
    (folder / "pace.yaml").write_text(text, encoding="utf-8")
    return load_system(str(folder / "pace.yaml"))


def test_unstated_settings_keep_their_defaults(tmp_path: Path) -> None:
    s = system(tmp_path)
    bus, meter = s.buses["line1"], s.devices["meter"]
    assert (bus.timeout_s, bus.spacing_s, bus.turnaround_s, bus.connect_pause_s, bus.probe_share) == (
        0.5,
        0,
        0.1,
        0,
        0.1,
    )
    assert (bus.echo, bus.strict) == (False, False)
    assert (meter.timeout_s, meter.retries, meter.spacing_s, meter.phase) == (None, None, 0, {})
    assert (meter.backoff_first_s, meter.backoff_limit_s) == (0.25, 10)


def test_the_system_file_goes_before_the_profile_and_that_before_the_bus(tmp_path: Path) -> None:
    timing = "timing: {timeout_ms: 2000, spacing_ms: 50, connect_pause_ms: 700}"
    s = system(tmp_path, timing=timing, device=", timeout_ms: 300, spacing_ms: 0, retries: 4, backoff_first_ms: 100")
    meter, other = s.devices["meter"], s.devices["other"]
    assert (meter.timeout_s, meter.spacing_s, meter.retries, meter.backoff_first_s) == (0.3, 0, 4, 0.1)
    assert (other.timeout_s, other.spacing_s, other.retries) == (2.0, 0.05, None)
    assert s.buses["line1"].connect_pause_s == 0.7
    assert system(tmp_path, timing=timing, bus=", connect_pause_ms: 0").buses["line1"].connect_pause_s == 0


def test_everything_that_a_bus_may_state(tmp_path: Path) -> None:
    s = system(
        tmp_path,
        bus=", spacing_ms: 3, turnaround_ms: 150, connect_pause_ms: 20, echo: true, strict: true, probe_percent: 25",
        poll=", phase_ms: 199",
    )
    bus = s.buses["line1"]
    assert (bus.spacing_s, bus.turnaround_s, bus.connect_pause_s, bus.probe_share) == (0.003, 0.15, 0.02, 0.25)
    assert bus.echo
    assert bus.strict
    assert s.devices["meter"].phase == {"values": 199}
    assert gateway_config(s, allow_writes=False).buses["line1"].strict
    prototype = gateway_config(s, allow_writes=False, free_ports=True).buses["line1"]
    assert prototype.echo  # its emulators echo too
    assert not prototype.strict  # silences on a virtual port have no meaning


@pytest.mark.parametrize(
    ("stated", "where"),
    [
        ({"url": "tcp://x:502", "bus": ", echo: true"}, "only a serial line echoes"),
        ({"url": "ascii:/dev/ttyS0", "bus": ", strict: true"}, "only RTU frames are separated"),
        ({"url": "rtu+tcp://x:4001", "bus": ", strict: true"}, "baud rate"),
        ({"poll": ", phase_ms: 200"}, "less than 200"),
        ({"device": ", backoff_first_ms: 500, backoff_limit_ms: 499"}, "at least 500"),
        ({"bus": ", probe_percent: 0"}, "probe_percent"),
        ({"bus": ", spacing_ms: -1"}, "spacing_ms"),
        ({"device": ", retries: 11"}, "retries"),
        ({"timing": "timing: {timeout_ms: 0}"}, "timeout_ms"),
    ],
)
def test_impossible_settings_are_reported_with_their_place(tmp_path: Path, stated: dict[str, str], where: str) -> None:
    with pytest.raises(FileInvalid, match=where) as caught:
        system(tmp_path, **stated)
    assert caught.value.line > 1


def test_a_can_bus_has_no_modbus_pace(tmp_path: Path) -> None:
    with pytest.raises(FileInvalid, match="`spacing_ms` on a CAN bus"):
        system(tmp_path, url="can:socketcan/can0", bus=", spacing_ms: 3")
