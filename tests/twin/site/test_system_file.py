"""Systems, prototypes and instances: the shipped ones, how they are found, and unique instance names."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path

import pytest

from fieldtwin.gateway.connections.os_connector import OsConnector
from fieldtwin.gateway.core.device import Communication
from fieldtwin.gateway.core.endpoint import Endpoint
from fieldtwin.gateway.core.errors import CommandListMismatch, EndpointBusy, FileInvalid, UsageError
from fieldtwin.gateway.devices.config import BusConfig
from fieldtwin.twin.plant.instance import Instance, runtime_root
from fieldtwin.twin.plant.mapping import MappedConnector, mapped_endpoint, mapping_from_json, mapping_to_json
from fieldtwin.twin.plant.physical import gateway_config, image_layout, plc_config
from fieldtwin.twin.prototype.file import load_prototype
from fieldtwin.twin.site.data_files import data_root, find, find_recording
from fieldtwin.twin.site.system import load_system


def test_the_observatory_matches_the_paper() -> None:
    system = load_system("observatory")
    assert {n: str(b.endpoint) for n, b in system.buses.items()} == {
        "line1": "rtu:/dev/ttyS0?baudrate=19200&frame=8E1", "can0": "can:socketcan/can0", "lan": "tcp://modem:502",
    }  # fmt: skip
    assert system.buses["line1"] == BusConfig(
        "line1", Endpoint.parse("rtu:/dev/ttyS0?baudrate=19200&frame=8E1"), 0.3, 1
    )
    ctd = system.devices["ctd"]
    assert (ctd.address, ctd.poll, ctd.safe, ctd.writable) == (
        1, {"values": 500, "status": 1000}, {"sample_period_s": 0}, frozenset({"sample_period_s"}),
    )  # fmt: skip
    assert system.devices_on("can0") == [system.devices["inclinometer"]]
    assert gateway_config(system, allow_writes=False).outputs == {"ctd.sample_period_s", "modem.outbox"}
    assert plc_config(system, Path("/run/x")).cycle_ms == 10.0
    names = {tag.name for region in image_layout(system).regions for tag in region.tags}
    assert {"ctd.pressure", "modem.inbox", "modem.outbox", "relay.state", "ctd.sample_period_s"} <= names


def test_the_prototype_maps_every_bus_and_the_plant_never_needs_it(tmp_path: Path) -> None:
    system = load_system("observatory")
    prototype = load_prototype(system)
    assert set(prototype.buses) == set(system.buses)
    assert set(prototype.devices) == set(system.devices)
    alone = tmp_path / "observatory.yaml"
    alone.write_bytes(system.path.read_bytes())
    assert load_system(str(alone)).hash == system.hash  # without a prototype file next to it
    with pytest.raises(FileInvalid, match=r"observatory\.prototype\.yaml"):
        load_prototype(load_system(str(alone)))


def test_a_bus_of_the_plants_own_needs_no_emulators(tmp_path: Path) -> None:
    system = load_system("observatory")
    text = load_prototype(system).path.read_text(encoding="utf-8")
    path = tmp_path / "mixed.prototype.yaml"
    path.write_text(text.replace('{listen: "tcp://127.0.0.1:0"}', "plant"), encoding="utf-8")
    mixed = load_prototype(system, path)
    assert mixed.buses["lan"].listen is None
    assert set(mixed.devices) == {"ctd", "inclinometer"}


def test_files_are_found_by_flag_then_variable_then_here_then_shipped(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shipped = data_root() / "profiles" / "systems" / "observatory.yaml"
    folders = {name: tmp_path / name for name in ("flag", "variable", "here")}
    for folder in folders.values():
        (folder / "systems").mkdir(parents=True)
    (folders["here"] / "profiles" / "systems").mkdir(parents=True)
    monkeypatch.chdir(folders["here"])
    monkeypatch.delenv("FIELDTWIN_PROFILES", raising=False)
    assert find("systems", "observatory") == shipped
    here = folders["here"] / "profiles" / "systems" / "observatory.yaml"
    here.write_bytes(shipped.read_bytes())
    assert find("systems", "observatory").resolve() == here
    monkeypatch.setenv("FIELDTWIN_PROFILES", os.pathsep.join([str(tmp_path / "none"), str(folders["variable"])]))
    (folders["variable"] / "systems" / "observatory.yaml").write_bytes(shipped.read_bytes())
    assert find("systems", "observatory").parent.parent == folders["variable"]
    (folders["flag"] / "systems" / "observatory.yaml").write_bytes(shipped.read_bytes())
    assert find("systems", "observatory", extra=[folders["flag"]]).parent.parent == folders["flag"]
    with pytest.raises(UsageError, match="observatory"):
        find("systems", "nothing")
    with pytest.raises(UsageError, match="no recording"):
        find_recording("nothing.jsonl")


def test_an_instance_runs_once_and_leaves_its_name_free(tmp_path: Path) -> None:
    with Instance("one", tmp_path) as first:
        assert first.dir.stat().st_mode & 0o777 == 0o700
        with pytest.raises(EndpointBusy, match="running already"), Instance("one", tmp_path):
            pass
        with Instance("two", tmp_path):  # a second one next to it
            pass
    with Instance("one", tmp_path):
        pass


@pytest.mark.parametrize(
    ("form", "why"), [("bits: [0, 0]", "only a part of a register"), ("scale_by: run", "scaled by another register")]
)
def test_an_output_that_the_gateway_cannot_write_is_refused_when_the_file_is_read(
    tmp_path: Path, form: str, why: str
) -> None:
    tags = f"  run: {{at: 40001, type: uint16}}\n  start: {{at: 40002, type: uint16, access: rw, {form}}}\n"
    (tmp_path / "drive.yaml").write_text(f"device: mysite/drive\nprotocol: modbus\nsource: invented\ntags:\n{tags}")
    (tmp_path / "plant.yaml").write_text(
        'fieldtwin: 1\nsystem: plant\nbuses: {lan: {url: "tcp://192.0.2.1:502"}}\n'
        "devices:\n  drive:\n    {profile: ./drive.yaml, bus: lan, unit: 1, writable: [start]}\n"
    )
    with pytest.raises(
        FileInvalid, match=rf"plant\.yaml:6:\d+: the gateway cannot write the tag 'start' .*{why}; expected a tag"
    ):
        load_system(str(tmp_path / "plant.yaml"))


@pytest.mark.parametrize("name", ["", "a/b", "..", "-x", "a" * 41, "a b", "ä"])
def test_invalid_instance_names_are_refused(name: str, tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="instance name"):
        Instance(name, tmp_path)


def test_run_directories_of_instances(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("FIELDTWIN_RUN", str(tmp_path))
    monkeypatch.setenv("XDG_RUNTIME_DIR", "/run/user/5")
    assert runtime_root() == tmp_path
    monkeypatch.delenv("FIELDTWIN_RUN")
    assert runtime_root() == Path("/run/user/5/fieldtwin")
    monkeypatch.delenv("XDG_RUNTIME_DIR")
    assert runtime_root() == Path(f"/tmp/fieldtwin-{os.getuid()}")
    with pytest.raises(UsageError, match="too long for sockets"):
        Instance("x", tmp_path / ("y" * 100))


def test_the_mapping_keeps_the_plants_line_settings() -> None:
    plant = Endpoint.parse("rtu:/dev/ttyS0?baudrate=9600&frame=8N2")
    target = mapped_endpoint(plant, Endpoint.parse("pty:/run/x/line1"))
    assert str(target) == "rtu:/run/x/line1?baudrate=9600&frame=8N2"
    lan = Endpoint.parse("tcp://modem:502")
    assert str(mapped_endpoint(lan, Endpoint.parse("tcp://127.0.0.1:4711"))) == "tcp://127.0.0.1:4711"
    mapping = {plant: target, lan: Endpoint.parse("tcp://127.0.0.1:1")}
    assert mapping_from_json(mapping_to_json(mapping)) == mapping


def test_an_endpoint_that_is_not_mapped_is_never_opened() -> None:
    connector = MappedConnector(OsConnector(), {})
    with pytest.raises(UsageError, match="not mapped"):
        connector.open_bytes(Endpoint.parse("tcp://modem:502")).send(None)
    with pytest.raises(UsageError, match="not mapped"):
        connector.open_can(Endpoint.parse("can:socketcan/can0"), 125_000).send(None)


def test_command_lists_must_be_the_same_in_both_directions() -> None:
    same = Communication("ctd", frozenset({"a", "b"}), frozenset({"a", "b"}))
    same.check()
    with pytest.raises(CommandListMismatch, match="unknown to the device: b; unknown to the driver: nothing"):
        replace(same, device_commands=frozenset({"a"})).check()
    with pytest.raises(CommandListMismatch, match="unknown to the device: nothing; unknown to the driver: c"):
        replace(same, device_commands=frozenset({"a", "b", "c"})).check()
