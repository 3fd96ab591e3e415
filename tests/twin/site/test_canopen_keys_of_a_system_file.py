"""The CANopen keys of a system file: their effects, and errors in them, reported with file and line."""

from __future__ import annotations

from pathlib import Path

import pytest
from dcf_texts import TPDO1, var

from fieldtwin.gateway.core.errors import FileInvalid
from fieldtwin.gateway.devices.canopen_config import CanopenBusConfig, RpdoConfig
from fieldtwin.gateway.protocols.canopen.boot import ExpectedIdentity
from fieldtwin.gateway.protocols.canopen.lss.frames import LssAddress
from fieldtwin.twin.site.system import load_system

SYSTEM = """\
fieldtwin: 1
system: s
buses:
  can0: {url: "can:socketcan/can0", BUS}
  lan: {url: "tcp://h:502", LAN}
devices:
  incl: {profile: inclinometer-cia410, bus: can0, node: 5, NODE}
  ctd: {profile: ctd-reference, bus: lan, unit: 1, CTD}
plc:
  programs: {p: {source: "python: fieldtwin.plc.relay:Relay"}}
"""
DCF = "[DeviceInfo]\nVendorName=x\n\n" + TPDO1 + var("2001", 6, "rw", "0", "0x1234")


def write(tmp_path: Path, dcf: str = DCF, **keys: str) -> str:
    text = SYSTEM
    for mark in ("BUS", "LAN", "NODE", "CTD"):
        text = text.replace(", " + mark, ", " + keys[mark] if mark in keys else "")
    (tmp_path / "node5.dcf").write_text(dcf, encoding="utf-8")
    path = tmp_path / "s.yaml"
    path.write_text(text, encoding="utf-8")
    return str(path)


def test_the_effect_of_the_keys(tmp_path: Path) -> None:
    who = "identity: {vendor: 1, product: 0x10, revision: 3, serial: 4}"
    system = load_system(
        write(
            tmp_path,
            BUS="sync: {period_ms: 100, counter: 240}, time_ms: 60000, short_sdo: true, sdo_transfer_ms: 30000",
            NODE=f"{who}, sdo_transfer_ms: 2500, lss: true, dcf: node5.dcf, store: true, tpdos: dcf",
        )
    )
    assert system.buses["can0"].canopen == CanopenBusConfig(100, 240, 60_000, True, 30.0)
    boot = system.devices["incl"].canopen
    assert boot.identity == ExpectedIdentity(None, 1, 16, 3, 4)
    assert boot.lss == LssAddress(1, 16, 3, 4)
    assert boot.sdo_transfer_s == 2.5
    assert boot.dcf == "node5.dcf"
    assert boot.configuration is not None
    assert (len(boot.configuration.settings), boot.configuration.store, boot.configuration.date) == (9, True, None)
    assert boot.tpdos is not None
    assert [t.cob_id for t in boot.tpdos] == [0x185]
    assert not boot.adopt_tpdos
    plain = load_system(write(tmp_path, NODE="tpdos: node"))
    assert plain.devices["incl"].canopen.adopt_tpdos
    assert plain.buses["can0"].canopen == CanopenBusConfig()
    assert plain.devices["incl"].canopen.sdo_transfer_s is None


RPDO1 = "writable: [controlword, target_velocity, mode], rpdo1: "


def drive(tmp_path: Path, **keys: str) -> str:
    """The system with a drive in place of the inclinometer."""
    path = Path(write(tmp_path, **keys))
    path.write_text(path.read_text(encoding="utf-8").replace("inclinometer-cia410", "drive-cia402"), encoding="utf-8")
    return str(path)


def test_the_effect_of_the_keys_of_outputs_polls_and_pace(tmp_path: Path) -> None:
    pace = "timeout_ms: 80, retries: 3, backoff_first_ms: 100, backoff_limit_ms: 900"
    poll = "poll: {values: {every_ms: 500, phase_ms: 40}}"
    node = RPDO1 + "{map: [controlword, target_velocity], transmission: sync, event_ms: 50}, rpdos: node"
    found = load_system(drive(tmp_path, BUS="sync: {period_ms: 10}", NODE=f"{node}, {pace}, {poll}")).devices["incl"]
    assert found.canopen.rpdo1 == RpdoConfig(("controlword", "target_velocity"), True, 50)
    assert (found.canopen.adopt_rpdos, found.canopen.rpdos) == (True, None)
    assert (found.timeout_s, found.retries, found.backoff_first_s, found.backoff_limit_s) == (0.08, 3, 0.1, 0.9)
    assert (found.poll, found.phase) == ({"values": 500}, {"values": 40})
    plain = load_system(drive(tmp_path, NODE=RPDO1 + "{map: [mode]}")).devices["incl"]
    assert plain.canopen.rpdo1 == RpdoConfig(("mode",))
    assert (plain.timeout_s, plain.retries) == (None, None)


@pytest.mark.parametrize(
    ("node", "says"),
    [
        ("rpdo1: {map: [controlword]}", "tags of this device's `writable`"),
        (RPDO1 + "{map: [statusword]}", "tags of this device's `writable`"),
        (RPDO1 + "{map: [mode, mode]}", "each once"),
        (RPDO1 + "{map: [mode], transmission: sync}", "nothing triggers its values"),
        (RPDO1 + "{map: [controlword, target_velocity, mode], event_ms: 0}", "at least 1"),
        ("writable: [target_velocity, target_position, mode], rpdo1: {map: [target_velocity, target_position, mode]}",
         "64 bits; got 72"),
        ("rpdos: dcf", "`dcf`, a DCF file"),
        ("spacing_ms: 5", "a Modbus bus"),
    ],
)  # fmt: skip
def test_errors_in_outputs_are_reported_with_their_line(tmp_path: Path, node: str, says: str) -> None:
    with pytest.raises(FileInvalid, match=says) as caught:
        load_system(drive(tmp_path, NODE=node))
    assert "s.yaml:7:" in str(caught.value)


@pytest.mark.parametrize(
    ("keys", "says"),
    [
        ({"BUS": "sync: {period_ms: 10, counter: 1}"}, "2 to 240"),
        ({"LAN": "sync: {period_ms: 10}"}, "a CAN bus"),
        ({"LAN": "sdo_transfer_ms: 100"}, "a CAN bus"),
        ({"CTD": "sdo_transfer_ms: 100"}, "a CANopen node"),
        ({"NODE": "sdo_transfer_ms: 0"}, "at least 1"),
        ({"CTD": "dcf: node5.dcf"}, "a CANopen node"),
        ({"CTD": "rpdos: node"}, "a CANopen node"),
        ({"CTD": "rpdo1: {map: [sample_period_s]}"}, "a CANopen node"),
        ({"NODE": "lss: true"}, "`identity` with vendor to serial"),
        ({"NODE": "lss: true, identity: {vendor: 1}"}, "`identity` with vendor to serial"),
        ({"NODE": "identity: {vendor: 0x100000000}"}, "4294967295"),
        ({"NODE": "store: true"}, "`dcf`, a DCF file"),
        ({"NODE": "tpdos: dcf"}, "`dcf`, a DCF file"),
        ({"NODE": "dcf: nothing.dcf"}, "no such file"),
    ],
)
def test_errors_are_reported_with_their_line(tmp_path: Path, keys: dict[str, str], says: str) -> None:
    with pytest.raises(FileInvalid) as told:
        load_system(write(tmp_path, **keys))
    assert says in str(told.value)
    assert "s.yaml:" in str(told.value)


@pytest.mark.parametrize(
    ("dcf", "says"),
    [
        ("[DeviceInfo]\nVendorName=x\n", "node5.dcf: no object in this file"),
        (DCF.replace("DataType=0x0006", "DataType=six", 1), r"node5.dcf:"),
        (DCF.replace("ParameterValue=0x1234", "ParameterValue=0x12345"), "[2001sub0] ParameterValue"),
        (DCF.replace("ParameterValue=0x1234", "ParameterValue=lots"), "ParameterValue"),
        (DCF + "[2001]\nParameterName=again\n", "2001"),
    ],
)
def test_a_malformed_dcf_is_reported_with_file_section_and_key(tmp_path: Path, dcf: str, says: str) -> None:
    with pytest.raises(FileInvalid) as told:
        load_system(write(tmp_path, dcf, NODE="dcf: node5.dcf"))
    assert says in str(told.value), str(told.value)
    assert "node5.dcf" in str(told.value)


def test_a_dcf_that_sets_nothing_is_reported(tmp_path: Path) -> None:
    with pytest.raises(FileInvalid, match="sets no object"):
        load_system(
            write(tmp_path, "[DeviceInfo]\nVendorName=x\n\n" + var("2001", 6, "rw", "0"), NODE="dcf: node5.dcf")
        )
