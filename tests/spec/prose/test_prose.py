"""The paper's statements about prototypes, and a plant without emulators: whole runs of `fieldtwin`, observed from outside."""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import socket
import sqlite3
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from spec_rig import CHECKOUT, CLOCK, SYSTEMS, observatory

from fieldtwin.capture.recordings.importing import import_capture
from fieldtwin.emulators.models.modbus.sampled_sensor import SampledSensor
from fieldtwin.emulators.signals import SignalPlayer, SignalTrack
from fieldtwin.gateway.core.clock import NS_PER_S
from fieldtwin.gateway.core.files.recording import RecordingReader, shown
from fieldtwin.twin.site.resolved import read_resolved
from fieldtwin.twin.site.system import load_system

WITNESS = """
import os, sys
_log = os.open(os.environ["SPEC_OPENED"], os.O_WRONLY | os.O_APPEND | os.O_CREAT, 0o600)
def _hook(event, args):
    if event == "open" and isinstance(args[0], (str, bytes, os.PathLike)):
        path = os.fsdecode(args[0])
        if path.endswith(".yaml"):
            os.write(_log, f"{' '.join(sys.orig_argv)}\\t{os.path.realpath(path)}\\n".encode())
sys.addaudithook(_hook)
"""
"""A `sitecustomize` that every process of a run imports first. It records which process opened which YAML file."""


class Ended:
    """A finished run: exit code, summary, console output, and (process, file) for each YAML file that was opened."""

    def __init__(self, folder: Path, *args: str, code: Path = CHECKOUT) -> None:
        folder.mkdir()
        (folder / "sitecustomize.py").write_text(WITNESS, encoding="utf-8")
        (folder / "opened").touch()
        env = {
            **os.environ,
            "PYTHONPATH": os.pathsep.join((str(folder), str(code))),
            "FIELDTWIN_RUN": str(folder / "r"),
            "SPEC_OPENED": str(folder / "opened"),
        }
        done = subprocess.run(
            [sys.executable, "-m", "fieldtwin", "run", *args, "--instance", "i", "--json"],
            cwd=folder, env=env, capture_output=True, text=True, timeout=50, check=False,
        )  # fmt: skip
        self.folder, self.run_dir = folder, folder / "r" / "i"
        self.code, self.err = done.returncode, done.stderr
        self.summary: dict[str, Any] = json.loads(done.stdout) if done.stdout else {}
        lines = (folder / "opened").read_text(encoding="utf-8").splitlines()
        self.opened = [(line.partition("\t")[0], Path(line.partition("\t")[2])) for line in lines]

    def files_of(self, module: str) -> set[str]:
        """Return the names of the files that the processes of a module opened."""
        return {path.name for process, path in self.opened if f" {module} " in f"{process} "}


@pytest.fixture
def deserted(tmp_path: Path) -> Path:
    """The observatory's file for a plant without hardware, with its prototype file; return its path."""
    systems = tmp_path / "systems"
    systems.mkdir()
    shutil.copy(SYSTEMS / "observatory.prototype.yaml", systems)
    with socket.socket() as s:
        s.bind(("127.0.0.1", 0))
        port = s.getsockname()[1]
    text = (SYSTEMS / "observatory.yaml").read_text(encoding="utf-8")
    for old, new in (
        ("/dev/ttyS0", f"{tmp_path}/ttyNONE"),
        ("modem:502", f"127.0.0.1:{port}"),
        ("can/can0", "can/nocan0"),
    ):
        assert old in text
        text = text.replace(old, new)
    (systems / "observatory.yaml").write_text(text, encoding="utf-8")
    return systems / "observatory.yaml"


@pytest.fixture(scope="module")
def standby(tmp_path_factory: pytest.TempPathFactory) -> Ended:
    """A prototype without commands; its wires are captured, and it has a thread that no client requests."""
    folder = tmp_path_factory.mktemp("standby") / "run"
    more = ("--capture", "wires.jsonl", "--thread", "tcp://127.0.0.1:0")
    return Ended(folder, "observatory", "--prototype", "--commands", "none", "--for", "3s", *more)


def test_prose_2_the_prototype_reads_the_plants_configuration_byte_for_byte(deserted: Path, tmp_path: Path) -> None:
    before = deserted.read_bytes()
    prototype = Ended(tmp_path / "a", str(deserted), "--prototype", "--commands", "none", "--for", "4s")
    plant = Ended(tmp_path / "b", str(deserted), "--plant", "--for", "1s")
    assert prototype.summary["devices"].keys() == plant.summary["devices"].keys()
    assert prototype.code == 0, prototype.summary["errors"]
    assert deserted.read_bytes() == before
    assert prototype.summary["system_hash"] == plant.summary["system_hash"]
    read = [{path.name for _, path in ended.opened if path.parent == deserted.parent} for ended in (prototype, plant)]
    assert read == [{"observatory.yaml", "observatory.prototype.yaml"}, {"observatory.yaml"}]
    for ended in (prototype, plant):  # the run reads the file, and hands what it read to gateway and PLC
        assert ended.files_of("fieldtwin.twin.plant.controller") == set()
    handed = [read_resolved(str(ended.run_dir / "system.pickle")) for ended in (prototype, plant)]
    assert handed[0] == handed[1]
    told = [json.loads((ended.run_dir / "gateway.json").read_text()) for ended in (prototype, plant)]
    for config in told:
        del config["run_dir"], config["resolved"]  # the folder of the run
    assert {key for key in told[0] if told[0][key] != told[1][key]} == {"mapping", "allow_writes"}
    plcs = [json.loads((ended.run_dir / "plc.json").read_text()) for ended in (prototype, plant)]
    for config in plcs:
        for path in ("image_path", "control_path", "retain_path", "audit_path"):  # in the run directory
            del config[path]
    assert plcs[0] == plcs[1]


def test_prose_2_the_plants_run_never_opens_a_prototype_file(deserted: Path, tmp_path: Path) -> None:
    ended = Ended(tmp_path / "run", str(deserted), "--plant", "--for", "1s")
    assert {path.name for _, path in ended.opened} >= {
        "observatory.yaml",
        "ctd-reference.yaml",
    }  # the recorder was active
    assert [path for _, path in ended.opened if path.name.endswith(".prototype.yaml")] == []


def test_prose_2_only_the_field_simulator_knows_what_is_emulated(standby: Ended) -> None:
    """The run reads the prototype file and hands it to the simulated devices; gateway and PLC get nothing of it."""
    assert "observatory.prototype.yaml" in {path.name for _, path in standby.opened}
    for module in ("fieldtwin.twin.plant.controller", "fieldtwin.plc"):
        assert standby.files_of(module) == set(), module
    of_the_prototype = b"fieldtwin.twin.prototype"
    assert of_the_prototype in (standby.run_dir / "prototype.pickle").read_bytes()
    assert of_the_prototype not in (standby.run_dir / "system.pickle").read_bytes()


def test_prose_2_the_emulated_connection_belongs_to_neither_device_nor_driver() -> None:
    """Neither side can import the other's half of the wire, nor the code that connects them (import contracts cover the rest)."""
    for folder, strangers in (("gateway", ("emulators", "twin")), ("emulators", ("gateway.devices", "twin"))):
        for path in (CHECKOUT / folder).rglob("*.py"):
            text = path.read_text(encoding="utf-8")
            for stranger in strangers:
                assert f"from fieldtwin.{stranger}" not in text, path
                assert f"import fieldtwin.{stranger}" not in text, path


def test_DigitalTwinPrototype_values_are_simply_good_and_what_its_run_leaves_says_that_it_was_one(
    standby: Ended, tmp_path: Path
) -> None:
    """Ruling 15: summary, store, knowledge, capture, and the data recorded from it."""
    assert standby.code == 0, standby.summary["errors"]
    qualities = {name: tag["quality"] for name, tag in standby.summary["tags"].items()}
    assert qualities["inclinometer.slope_long"] == qualities["ctd.sample_period_s"] == "good"
    assert "simulated" not in qualities.values()
    assert standby.summary["prototype"] is True
    with contextlib.closing(sqlite3.connect(standby.run_dir / "store.sqlite")) as store:
        assert store.execute("SELECT prototype FROM run").fetchall() == [(1,)]
    with contextlib.closing(sqlite3.connect(standby.run_dir / "knowledge.sqlite")) as knowledge:
        assert knowledge.execute("SELECT prototype FROM origin").fetchall() == [(1,)]
    wires = standby.folder / "wires.jsonl"
    head = json.loads(wires.read_text(encoding="ascii").partition("\n")[0])
    assert (head["system"], head["prototype"]) == ("observatory", True)
    import_capture(wires, tmp_path / "ctd.jsonl", url=str(load_system("observatory").buses["line1"].endpoint))
    with RecordingReader(tmp_path / "ctd.jsonl") as recording:
        assert recording.header.prototype
    assert "of an emulator" in shown(tmp_path / "ctd.jsonl"), "and a replay of it says so as well"


def test_prose_3_STANDBY_at_start_period_0_and_no_samples_taken(standby: Ended) -> None:
    assert standby.code == 0, standby.summary["errors"]
    assert standby.summary["states"] == {"relay": ["STANDBY"]}
    tags = standby.summary["tags"]
    assert tags["ctd.sample_period_s"]["value"] == 0
    assert tags["ctd.sample_count"]["value"] == 0
    assert {tags[f"ctd.{name}"]["quality"] for name in ("pressure", "temperature", "conductivity")} == {"bad"}
    assert standby.summary["logged"] == 0


@settings(max_examples=50, deadline=None)
@given(
    period_s=st.integers(1, 60),
    seconds=st.integers(0, 200),
    stop_s=st.integers(-32768, 0),
    later=st.integers(0, 5000),
)
def test_prose_3_ACTIVE_samples_at_the_commanded_period_and_OFF_and_STANDBY_take_none(
    period_s: int, seconds: int, stop_s: int, later: int
) -> None:
    profile = observatory()[0].devices["ctd"].profile
    sensor = SampledSensor(profile, SignalPlayer(CAST, start_ns := CLOCK.monotonic_ns()), {"serial": "0042"})
    at = profile.tags["sample_period_s"].registers

    def count(now_ns: int) -> int:
        high, low = sensor.read("input", 6, 2, now_ns)
        return high << 16 | low

    assert count(start_ns + 10 * NS_PER_S) == 0
    begun_ns = start_ns + 20 * NS_PER_S
    sensor.write(at.table, at.address, [period_s], begun_ns)
    taken = 1 + seconds // period_s  # the first one at once
    stopped_ns = begun_ns + seconds * NS_PER_S
    assert count(stopped_ns) == taken
    sensor.write(at.table, at.address, [stop_s & 0xFFFF], stopped_ns)
    assert count(stopped_ns + later * NS_PER_S) == taken


CAST = SignalTrack.load(CHECKOUT / "recordings" / "cast.jsonl")

PROGRAM = """
from fieldtwin.gateway.core.image.image import TagKind
from fieldtwin.plc.program import Program, ScanInfo, var_output


class Sample(Program):
    period_s: int = var_output(TagKind.INT, initial=1, unit="s")

    def execute(self, scan: ScanInfo) -> None:
        self.period_s = 1
"""
FIRST = """
fieldtwin: 1
system: first
buses: {line1: {url: "rtu:/dev/ttyS0?baudrate=19200&frame=8E1"}}
devices:
  ctd:
    {profile: ctd-reference, bus: line1, unit: 1, poll: {values: {every_ms: 200}}, writable: [sample_period_s]}
plc: {programs: {sample: {source: "python: first_program:Sample", outputs: {period_s: ctd.sample_period_s}}}}
"""
FIRST_PROTOTYPE = """
prototype_of: first.yaml
unmapped: refuse
seed: 1
buses: {line1: {listen: "pty:line1"}}
devices:
  ctd: {recording: cast.jsonl, identity: {serial: "0001"}}
"""


def write_first(folder: Path) -> Path:
    for name, text in (("first.yaml", FIRST), ("first.prototype.yaml", FIRST_PROTOTYPE), ("first_program.py", PROGRAM)):
        (folder / name).write_text(text.lstrip(), encoding="utf-8")
    return folder / "first.yaml"


@pytest.mark.long
def test_prose_11_a_first_useful_prototype_is_one_driver_and_one_emulator(tmp_path: Path) -> None:
    ended = Ended(tmp_path / "run", str(write_first(tmp_path)), "--prototype", "--for", "3s")
    assert ended.code == 0, ended.err + json.dumps(ended.summary.get("errors"))
    assert list(ended.summary["devices"]) == ["ctd"]
    assert ended.summary["published"]["wrong"] == 0
    tags = ended.summary["tags"]
    assert tags["ctd.sample_count"]["value"] >= 2
    assert {tags[f"ctd.{name}"]["quality"] for name in ("pressure", "temperature", "conductivity")} == {"good"}


@pytest.mark.long
def test_prose_11_devices_are_added_one_at_a_time(tmp_path: Path) -> None:
    system = write_first(tmp_path)
    text = system.read_text(encoding="utf-8").replace("buses: {", 'buses: {can0: {url: "can:socketcan/can0"}, ')
    node = "  incl: {profile: inclinometer-cia410, bus: can0, node: 5, tpdo1: {map: [slope_long], event_ms: 100}, start: true}\n"
    system.write_text(text.replace("plc: {", f"{node}plc: {{"), encoding="utf-8")
    prototype = tmp_path / "first.prototype.yaml"
    text = prototype.read_text(encoding="utf-8").replace(
        "buses: {", 'buses: {can0: {listen: "can:fieldtwin/127.0.0.1:0"}, '
    )
    prototype.write_text(text + "  incl: {recording: incl.jsonl, at_end: loop}\n", encoding="utf-8")
    ended = Ended(tmp_path / "run", str(system), "--prototype", "--for", "3s")
    assert ended.code == 0, ended.err + json.dumps(ended.summary.get("errors"))
    assert {d["state"] for d in ended.summary["devices"].values()} == {"good"}
    assert ended.summary["tags"]["incl.slope_long"]["quality"] == "good"


@pytest.mark.long
def test_prose_2_a_plant_needs_no_emulators(deserted: Path, tmp_path: Path) -> None:
    """With that folder removed, a plant without hardware behaves as with it: same exit code, same output."""
    bare = tmp_path / "bare"
    bare.mkdir()
    for folder in ("gateway", "plc", "twin", "fieldtwin", "profiles", "recordings"):
        # including the compiled files: times and sizes remain
        shutil.copytree(CHECKOUT / folder, bare / folder, symlinks=True)
    without = Ended(tmp_path / "without", str(deserted), "--plant", "--for", "2s", code=bare)
    whole = Ended(tmp_path / "with", str(deserted), "--plant", "--for", "2s")
    assert without.code == whole.code == 1, without.err
    said = " ".join(without.summary["errors"])
    assert all(endpoint in said for endpoint in ("ttyNONE", "nocan0", "127.0.0.1:"))
    assert without.summary["errors"] == whole.summary["errors"]
    assert without.summary["plc"]["state"] == "running"
    assert without.summary["plc"]["scans"] > 50
    logs = [path.read_text(encoding="utf-8") for path in without.run_dir.glob("*.log")]
    assert logs
    assert not any("Traceback" in text for text in [*logs, without.err])
