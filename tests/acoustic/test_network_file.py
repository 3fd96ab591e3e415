"""The network file: its meaning, and errors in it, reported at their position."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest
from click.testing import CliRunner

from fieldtwin.acoustic.faults import AcousticFaults
from fieldtwin.acoustic.network import load_network
from fieldtwin.cli.main import cli
from fieldtwin.gateway.core.errors import FileInvalid, UsageError
from fieldtwin.scenarios.language.form import load_scenario
from fieldtwin.twin.prototype.field_status import ActiveFaultStatus
from fieldtwin.twin.site.groups import group_file
from fieldtwin.twin.site.system import load_system

SYSTEMS = Path(__file__).resolve().parents[2] / "profiles" / "systems"
SHIPPED = SYSTEMS / "ocean_network.yaml"


def changed(folder: Path, old: str, new: str) -> Path:
    text = SHIPPED.read_text("utf-8")
    assert old in text
    path = folder / "net.yaml"
    path.write_text(text.replace(old, new), encoding="utf-8")
    return path


def line_of(path: Path, text: str) -> int:
    return next(n for n, line in enumerate(path.read_text("utf-8").splitlines(), 1) if text in line)


def test_the_shipped_network() -> None:
    network = load_network(SHIPPED)
    assert list(network.members) == ["west", "middle", "east"]
    sea = network.medium(1)
    assert {name: sea.neighbours(name) for name in network.places} == {
        "west": ["middle", "ship"], "middle": ["west", "east"], "east": ["middle"], "ship": ["west"],
    }  # fmt: skip
    whole = network.whole
    assert list(whole.devices)[:2] == ["west.ctd", "west.modem"]
    assert whole.devices["east.current"].bus == "east.line"
    assert [d.name for d in whole.devices_on("east.line")] == ["east.current"]
    assert network.split("west.ctd.pressure") == ("west", "ctd.pressure")
    with pytest.raises(UsageError, match="did you mean 'west'"):
        network.split("wets.ctd.pressure")


def test_no_system_of_it_mentions_another() -> None:
    """The files of a plant describe one observatory."""
    for name in ("west", "middle", "east"):
        keys = [
            line
            for line in (SYSTEMS / f"ocean_{name}.yaml").read_text("utf-8").splitlines()
            if not line.startswith("#")
        ]
        assert not any(word in line for line in keys for word in ("network", "water", "at_m"))
        assert {p.source for p in load_system(f"ocean_{name}").plc.programs.values()} == {"adapt.st"}


@pytest.mark.parametrize(
    ("old", "new", "at", "said"),
    [
        ("water: {range_m: 4000", "wather: {range_m: 4000", "wather", "did you mean 'water'?"),
        ("range_m: 4000", "rang_m: 4000", "rang_m", "did you mean 'range_m'?"),
        ("loss: 0.05", "loss: 1.5", "loss", "less than 1"),
        ("ocean_middle.yaml", "ocean_midle.yaml", "ocean_midle", "did you mean 'ocean_middle.yaml'?"),
        ("east.yaml,   modem: modem", "east.yaml,   modem: moden", "moden", "did you mean 'modem'?"),
        ("modem: modem, at_m: [6000, 0, -510]", "modem: current, at_m: [6000, 0, -510]", "current", "is not a modem of"),
        ("at_m: [6000, 0, -510]", "at_m: [6000, 0]", "[6000, 0]", "not as many coordinates"),
        ("at_m: [-2000, 500, 0], ", "at_m: [0], ", "[0]", "at least 2 items"),
        ("ocean_middle.yaml, modem", "ocean_west.yaml, modem", "middle", "its modem has the address 1, as west's has"),
        ("  west:  ", "  ship:  ", "  ship:  ", "'ship' is not a valid name"),
        ("says: 3", "says: 0", "says: 0", "at least 1"),
        ("seed: 5", "seed: 5\nseed: 6", "seed: 6", "is defined twice"),
    ],
)  # fmt: skip
def test_an_error_is_named_at_its_position(tmp_path: Path, old: str, new: str, at: str, said: str) -> None:
    path = changed(tmp_path, old, new)
    with pytest.raises(FileInvalid) as caught:
        load_network(path, [SYSTEMS.parent])
    assert said in str(caught.value)
    assert caught.value.line == line_of(path, at)
    assert caught.value.exit_code == 3


def test_an_error_in_a_system_is_named_there(tmp_path: Path) -> None:
    for file in SYSTEMS.glob("ocean_*.yaml"):
        shutil.copy(file, tmp_path)
    shutil.copy(SYSTEMS / "adapt.st", tmp_path)
    east = tmp_path / "ocean_east.yaml"
    east.write_text(east.read_text("utf-8").replace("bus: lan", "bus: lann"), encoding="utf-8")
    with pytest.raises(FileInvalid, match=r"ocean_east.yaml:\d+:\d+: .*did you mean 'lan'"):
        load_network(tmp_path / "ocean_network.yaml")


def test_a_network_is_not_a_system_and_a_system_not_a_network() -> None:
    found = group_file("ocean_network")
    assert found is not None
    assert (found[0], found[1].resolve()) == ("network", SHIPPED)
    assert group_file("observatory") is None
    assert group_file("no such thing") is None
    with pytest.raises(FileInvalid, match=r"a network, not a system.*west, middle, east"):
        load_system(str(SHIPPED))


@pytest.mark.parametrize(
    ("step", "said"),
    [
        ("wait: {until: \"west.adapt.stat == 'ACTIVE'\"}", "did you mean 'west.adapt.state'?"),
        ("wait: {until: \"adapt.state == 'ACTIVE'\"}", "no tag or variable 'adapt.state'"),
        ("expect: {wire: west.cdt, times: 1}", "did you mean 'west.ctd'?"),
        ("set: {tag: middle.optode.oxygne, value: 1}", "did you mean 'middle.optode.oxygen'?"),
        ("fault: {name: silence, device: east.curent}", "did you mean 'east.current'?"),
        ("fault: {name: delay, bus: water}", "does not exist on the acoustic channel"),
        ("fault: {name: drop, bus: water, device: eats}", "did you mean 'east'?"),
        ("fault: {name: drop, bus: water, unit: 3}", "'unit' has no meaning on the acoustic channel"),
    ],
)
def test_scenarios_of_a_network_are_checked_before_they_run(tmp_path: Path, step: str, said: str) -> None:
    path = tmp_path / "x.scenario.yaml"
    path.write_text(f"scenario: x\nsystem: ocean_network\nsteps:\n  - {step}\n")
    with pytest.raises(FileInvalid) as caught:
        load_scenario(path)
    assert said in str(caught.value)
    assert caught.value.line == 4


def test_a_scenario_of_a_network_has_no_probes(tmp_path: Path) -> None:
    path = tmp_path / "x.scenario.yaml"
    probes = "probes: {hmi: {serve: hmi, registers: {x: {at: 30001}}}}"
    path.write_text(f"scenario: x\nsystem: ocean_network\n{probes}\nsteps: [{{pause: 1s}}]\n")
    with pytest.raises(FileInvalid, match="'probes' has no meaning for a network"):
        load_scenario(path)


def test_faults_of_the_acoustic_channel_start_and_end() -> None:
    faults = AcousticFaults(load_network(SHIPPED).places, 1)
    assert faults.inject({"id": "deaf", "name": "drop", "bus": "water", "device": "east"}) == "deaf"
    assert [faults.spoils(5, listener, b"x") for listener in (1, 2, 3, 4)] == [False, False, True, False]
    assert faults.active() == [ActiveFaultStatus(id="deaf", name="drop", bus="water", device="east", struck=1)]
    with pytest.raises(UsageError, match="already active"):
        faults.inject({"id": "deaf", "name": "drop", "bus": "water"})
    faults.clear("deaf")
    assert not faults.spoils(6, 3, b"x")
    faults.inject({"name": "drop", "bus": "water", "from": "1s", "until": "2s"})
    assert [faults.spoils(round(t * 1e9), 1, b"x") for t in (0.5, 1.5, 2.5)] == [False, True, False]


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--plant"], "each of its systems is a separate plant"),
        (["--prototype", "--speed", "2"], "--speed: not available for a network"),
        (["--prototype", "--thread", "tcp://127.0.0.1:7700"], "a separate thread and port"),
        (["--prototype", "--seed", "3"], "use `fieldtwin simulate"),
    ],
)
def test_unsupported_requests_of_a_network(words: list[str], said: str) -> None:
    result = CliRunner().invoke(cli, ["run", "ocean_network", *words], standalone_mode=False)
    assert isinstance(result.exception, UsageError)
    assert said in str(result.exception)
