"""The reference nodes of the CiA device profiles: data sheets that three readers interpret identically, short profiles,
recordings that their script can regenerate, and each node on the software bus, read and commanded by the gateway's driver."""

from __future__ import annotations

import re
import sys
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from dataclasses import dataclass
from pathlib import Path

import canopen
import pytest
from support import eventually, run

from fieldtwin.emulators.canopen.eds.dictionary import load_eds
from fieldtwin.emulators.canopen.node import CanopenNode
from fieldtwin.emulators.canopen.serve import serve_node
from fieldtwin.emulators.endpoints.can.bus_server import SoftBusServer
from fieldtwin.emulators.journal import DeviceValueLog
from fieldtwin.emulators.models.canopen.emulated_node import emulated_node
from fieldtwin.emulators.signals import SignalPlayer, SignalTrack
from fieldtwin.gateway.connections.os_connector import OsConnector
from fieldtwin.gateway.core.concurrency.nursery import Nursery
from fieldtwin.gateway.core.endpoint import Endpoint
from fieldtwin.gateway.core.errors import FileInvalid, UsageError
from fieldtwin.gateway.core.files.profile import DeviceProfile
from fieldtwin.gateway.core.files.profile_file import load_profile
from fieldtwin.gateway.core.files.recording import RecordingReader
from fieldtwin.gateway.core.values import Quality
from fieldtwin.gateway.devices.canopen_device import CanopenDriver
from fieldtwin.gateway.devices.config import BusConfig, DeviceConfig, Heartbeat, Tpdo
from fieldtwin.gateway.protocols.canopen.eds.dictionary import load_dictionary
from fieldtwin.gateway.runtime.audit_log import AuditLog
from fieldtwin.gateway.runtime.buses.canopen.canopen_bus import CanopenBus
from fieldtwin.gateway.runtime.tags import TagTable
from fieldtwin.gateway.wallclock import WallClock
from fieldtwin.twin.prototype.file import load_prototype
from fieldtwin.twin.site.system import load_system

ROOT = Path(__file__).resolve().parents[3]
DEVICES = ROOT / "profiles" / "devices"
sys.path.insert(0, str(ROOT / "scripts"))

import make_device_recordings  # noqa: E402
import make_eds  # noqa: E402

PLAYED = sorted(make_device_recordings.NODES)
NAMES = sorted([*PLAYED, "inclinometer-cia410"])
RECORDINGS = {name: ROOT / "recordings" / f"{name}.jsonl" for name in PLAYED} | {
    "inclinometer-cia410": ROOT / "recordings" / "incl.jsonl"
}
TPDO1 = {
    "io-cia401": ("inputs_1", "inputs_2", "analogue_in_1"),
    "drive-cia402": ("statusword", "position"),
    "measuring-cia404": ("pressure", "temperature"),
    "encoder-cia406": ("position", "speed"),
    "inclinometer-cia410": ("slope_long", "slope_lateral"),
}


def shipped(name: str) -> DeviceProfile:
    return load_profile(DEVICES / f"{name}.yaml")


# -- the files -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("sheet", make_eds.SHEETS, ids=lambda sheet: sheet.name)
def test_a_shipped_data_sheet_is_generated_from_its_table(sheet: make_eds.Sheet) -> None:
    assert (DEVICES / sheet.file).read_text(encoding="ascii") == make_eds.text(sheet)


@pytest.mark.parametrize("name", NAMES)
def test_three_readers_interpret_a_data_sheet_identically(name: str) -> None:
    path, node = DEVICES / f"{name}.eds", 9
    ours, gateways = load_eds(path), load_dictionary(path, node)
    theirs = canopen.import_od(str(path), node)
    assert gateways.mended == ()
    assert len(gateways) == sum(1 for _ in ours.entries())
    for entry in ours.entries():
        other = gateways.get(*entry.key)
        assert other is not None
        assert (other.type_code, other.access, other.pdo_mappable) == (entry.data_type, entry.access, entry.mappable)
        found = theirs[entry.index]
        variable = found if isinstance(found, canopen.objectdictionary.ODVariable) else found[entry.subindex]
        assert (variable.data_type, variable.access_type) == (entry.data_type, entry.access)
        assert (variable.min, variable.max) == (entry.low, entry.high)
        assert variable.encode_raw(variable.default) == entry.initial(node)
        if isinstance(variable.default, float):
            assert other.default == pytest.approx(variable.default, rel=1e-6)  # the part of it that a REAL32 holds
        else:
            assert variable.default == other.default


@pytest.mark.parametrize("name", NAMES)
def test_a_data_sheet_is_right_to_a_stricter_eye(name: str) -> None:
    """CiA 306-1: every object in exactly one list, lists numbered and counted right, SubNumber and sub-index 0 true."""
    text = (DEVICES / f"{name}.eds").read_text(encoding="ascii")
    sections: dict[str, dict[str, str]] = {}
    for block in re.split(r"^\[", text, flags=re.M)[1:]:
        title, _, body = block.partition("]")
        assert title not in sections, "twice"
        sections[title] = dict(line.split("=", 1) for line in body.split("\n") if "=" in line)
    listed: list[int] = []
    for title in ("MandatoryObjects", "OptionalObjects", "ManufacturerObjects"):
        part = dict(sections[title])
        count = int(part.pop("SupportedObjects"))
        assert list(part) == [str(n) for n in range(1, count + 1)], title
        listed += [int(value, 16) for value in part.values()]
    assert sections["MandatoryObjects"] == {"SupportedObjects": "3", "1": "0x1000", "2": "0x1001", "3": "0x1018"}
    described = [int(title, 16) for title in sections if re.fullmatch("[0-9A-F]{4}", title)]
    assert sorted(listed) == sorted(described)
    for index in described:
        subs = [t for t in sections if re.fullmatch(f"{index:04X}sub[0-9A-F]+", t)]
        if "SubNumber" in sections[f"{index:04X}"]:
            assert int(sections[f"{index:04X}"]["SubNumber"]) == len(subs)
            highest = int(sections[f"{index:04X}sub0"]["DefaultValue"], 0)
            mapping = 0x1600 <= index < 0x1800 or 0x1A00 <= index < 0x1C00
            if index != 0x1003 and not mapping:  # there it counts errors, or mapped objects
                assert highest == max(int(t.partition("sub")[2], 16) for t in subs), f"{index:04X}"
    info = sections["DeviceInfo"]
    assert int(info["NrOfTXPDO"]) == sum(0x1800 <= i < 0x1A00 for i in described)
    assert int(info["NrOfRXPDO"]) == sum(0x1400 <= i < 0x1600 for i in described)
    assert int(info["ProductNumber"], 0) == int(sections["1018sub2"]["DefaultValue"], 0)
    assert info["VendorNumber"] == "0"
    assert f"cia{int(sections['1000']['DefaultValue'], 0) & 0xFFFF}" in name


@pytest.mark.parametrize("name", NAMES)
def test_default_pdo_mappings_exist_are_mappable_and_fit(name: str) -> None:
    dictionary = load_eds(DEVICES / f"{name}.eds")
    for index in [i for i in dictionary.objects if 0x1600 <= i < 0x1800 or 0x1A00 <= i < 0x1C00]:
        subs = dictionary.objects[index].entries
        codes = [int.from_bytes(subs[n].default, "little") for n in range(1, subs[0].default[0] + 1)]
        for code in codes:
            entry = dictionary.entry(code >> 16, code >> 8 & 0xFF)
            assert entry is not None, f"{code:08X}"
            assert entry.mappable, f"{code:08X}"
            assert entry.size == (code & 0xFF) // 8
            assert entry.writable or index >= 0x1A00
        assert sum(code & 0xFF for code in codes) <= 64


@pytest.mark.parametrize("name", NAMES)
def test_a_profile_is_at_most_forty_lines_cites_its_source_and_fits_its_data_sheet(name: str) -> None:
    profile = shipped(name)
    assert len((DEVICES / f"{name}.yaml").read_text(encoding="utf-8").splitlines()) <= 40
    assert f"CiA {name[-3:]}" in profile.form.source
    dictionary = load_dictionary(DEVICES / f"{name}.eds", profile.form.factory.node)
    codes = {"int8": 2, "int16": 3, "int32": 4, "uint8": 5, "uint16": 6, "uint32": 7, "float32": 8}
    for tag in profile.tags.values():
        assert tag.object is not None
        entry = dictionary.get(*tag.object)
        assert entry is not None, tag.name
        assert entry.type_code == codes[tag.type], tag.name
        assert tag.readable == entry.readable
        assert entry.writable or not tag.writable, tag.name


@pytest.mark.parametrize("name", PLAYED)
def test_a_shipped_recording_is_the_output_of_the_script_and_marked_synthetic(name: str, tmp_path: Path) -> None:
    make_device_recordings.make_node(name, tmp_path, make_device_recordings.DEFAULT_SEED)
    assert (tmp_path / f"{name}.jsonl").read_bytes() == RECORDINGS[name].read_bytes()
    with RecordingReader(RECORDINGS[name]) as reader:
        assert reader.header.source == "synthetic"
        assert reader.header.profile_hash == shipped(name).hash
        rows = list(reader.rows())
    assert rows[0].values == rows[-1].values  # a loop has no jump


def test_an_invalid_identity_and_a_data_sheet_without_an_object_are_reported(tmp_path: Path) -> None:
    profile = shipped("encoder-cia406")
    with pytest.raises(UsageError, match=r"identity 'serial'.*a number"):
        emulated_node(profile, 9, None, 0, {"serial": "x12"})
    text = (DEVICES / "encoder-cia406.yaml").read_text(encoding="utf-8")
    (tmp_path / "bad.yaml").write_text(text.replace("6004:00", "6005:00"), encoding="utf-8")
    (tmp_path / "encoder-cia406.eds").write_bytes((DEVICES / "encoder-cia406.eds").read_bytes())
    track = SignalTrack.load(RECORDINGS["encoder-cia406"])
    with pytest.raises(FileInvalid, match="no object 6005h:00 for tag 'position'"):
        emulated_node(load_profile(tmp_path / "bad.yaml"), 9, SignalPlayer(track, 0), 0)


# -- on the bus, with the gateway ------------------------------------------------------------------------------------------


@dataclass
class Line:
    """A gateway's bus with one emulated node on it."""

    profile: DeviceProfile
    driver: CanopenDriver
    tags: TagTable
    node: CanopenNode
    journal: DeviceValueLog
    track: SignalTrack

    def value(self, tag: str) -> object:
        now = self.tags.current(f"d.{tag}", WallClock().monotonic_ns())
        return now.value if now.quality is Quality.GOOD else None

    async def command(self, tag: str, value: float) -> None:
        self.driver.consumer.observe(self.driver.command(tag, value))
        await self.driver.send()


@asynccontextmanager
async def line(name: str, tmp_path: Path) -> AsyncIterator[Line]:
    clock, profile = WallClock(), shipped(name)
    server = await SoftBusServer.open(Endpoint.parse("can:fieldtwin/127.0.0.1:0"), 125_000, paced=False)
    track = SignalTrack.load(RECORDINGS[name])
    made = emulated_node(
        profile,
        profile.form.factory.node,
        SignalPlayer(track, clock.monotonic_ns()),
        clock.monotonic_ns(),
        {"serial": "77"},
    )
    tags = TagTable(clock)
    config = DeviceConfig(
        "d", profile, "can0", made.node.node_id, expect={"serial": "77"}, heartbeat=Heartbeat(100, 400),
        tpdo1=Tpdo(TPDO1[name], 20), start=True,
    )  # fmt: skip
    driver = CanopenDriver(config, tags, clock)
    tags.declare([f"d.{t.name}" for t in profile.tags.values() if t.readable], None)
    audit = AuditLog(tmp_path / "audit", clock)
    bus = CanopenBus(BusConfig("can0", server.bound, 0.5, 1), [driver], OsConnector(), clock, tags, audit, True)
    try:
        async with Nursery() as nursery:
            nursery.start(serve_node(server.attach(name), made.node, clock), "node")
            nursery.start(bus.run(), "bus")
            yield Line(profile, driver, tags, made.node, made.journal, track)
    finally:
        await server.aclose()
        audit.close()


@pytest.mark.parametrize("name", NAMES)
def test_the_driver_reads_the_values_of_the_node(name: str, tmp_path: Path) -> None:
    async def main() -> None:
        async with line(name, tmp_path) as rig:
            readable = [t for t in rig.profile.tags.values() if t.readable]
            await eventually(lambda: all(rig.value(t.name) is not None for t in readable), what=f"values of {name}")
            assert rig.value("serial") == 77
            for tag in readable:
                got = rig.tags.current(f"d.{tag.name}", WallClock().monotonic_ns())
                assert got.raw in {entry.raw for entry in rig.journal.since(0) if entry.tag == tag.name}, tag.name
                if tag.name in rig.track.names:
                    column = [rig.track.at(t, tag.name) for t in range(61)]
                    assert isinstance(got.value, int | float)
                    assert min(column) - tag.scale <= got.value <= max(column) + tag.scale
                    early = rig.track.at(0.0, tag.name)  # its replay has only just started
                    assert got.value == pytest.approx(early, rel=0.2, abs=max(1.0, tag.scale))

    run(main())


def test_the_driver_drives_the_drive(tmp_path: Path) -> None:
    async def main() -> None:
        async with line("drive-cia402", tmp_path) as rig:
            await eventually(lambda: rig.value("statusword") == 0x0250)  # switch on disabled, voltage, remote
            await rig.command("mode", 3)
            await rig.command("target_velocity", 5_000)
            for word, status in ((6, 0x0231), (7, 0x0233)):
                await rig.command("controlword", word)
                await eventually(lambda status=status: rig.value("statusword") == status)
            await rig.command("controlword", 15)
            await eventually(lambda: rig.value("statusword") == 0x0637)  # operation enabled, target reached
            before = rig.value("position")
            await eventually(lambda: rig.value("position") != before)
            await rig.command("controlword", 2)
            await eventually(lambda: rig.value("statusword") == 0x0250)
            assert rig.node.data.number(0x606C) == 0

    run(main())


def test_the_driver_tares_the_pressure_and_presets_the_encoder(tmp_path: Path) -> None:
    async def main() -> None:
        async with line("measuring-cia404", tmp_path) as rig:
            await eventually(lambda: rig.value("pressure") is not None)
            before = float(str(rig.value("pressure")))
            await rig.command("pressure_zero", 1869768058)
            await eventually(lambda: abs(float(str(rig.value("pressure") or before))) < before / 2)
        async with line("encoder-cia406", tmp_path) as rig:
            await eventually(lambda: rig.value("position") is not None)
            await rig.command("preset", 1000)
            await eventually(lambda: 0 < int(str(rig.value("position") or 0)) < 200_000)

    run(main())


def test_the_driver_sets_the_outputs_of_the_io_module(tmp_path: Path) -> None:
    async def main() -> None:
        async with line("io-cia401", tmp_path) as rig:
            await eventually(lambda: rig.value("inputs_1") is not None)
            await rig.command("outputs_2", 0xA5)
            await rig.command("analogue_out_1", 5.0)
            assert rig.node.data.get(0x6200, 2) == b"\xa5"
            assert int.from_bytes(rig.node.data.get(0x6411, 1), "little", signed=True) == 16384

    run(main())


def test_in_a_prototype_no_device_that_samples_is_emulated_by_its_profile_alone(tmp_path: Path) -> None:
    system = load_system("observatory")
    text = load_prototype(system).path.read_text(encoding="utf-8")
    path = tmp_path / "mine.prototype.yaml"
    path.write_text(text.replace("recording: incl.jsonl, at_end: loop", "model: profile"), encoding="utf-8")
    assert load_prototype(system, path).devices["inclinometer"].recording is None
    path.write_text(text.replace("recording: cast.jsonl, speed: 1, at_end: hold", "model: profile"), encoding="utf-8")
    with pytest.raises(FileInvalid, match="'ctd' needs more than its registers; expected `recording: FILE`") as error:
        load_prototype(system, path)
    assert error.value.line == next(n for n, line in enumerate(path.read_text().splitlines(), 1) if "ctd:" in line)
