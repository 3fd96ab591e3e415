"""`fmu:` in a prototype file: what can be checked without running the FMU is reported with its place in the file."""

from __future__ import annotations

import re
import zipfile
from contextlib import suppress
from pathlib import Path

import pytest
from fmu_rig import build_fmu, in_prototype, needs_gcc, tank_site
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from fieldtwin.emulators.simulation.fmu.description import describe, unpack
from fieldtwin.gateway.core.errors import FileInvalid
from fieldtwin.site.check import check_site
from fieldtwin.twin.prototype.file import load_prototype
from fieldtwin.twin.site.system import load_system

pytestmark = needs_gcc


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("fmu: tank.fmu", "fmu: none.fmu", r":8:\d+: no such file; expected FILE\.fmu; got none\.fmu"),
        ("fmu: tank.fmu", "fmu: fill.st", r":8:\d+: not an FMU; expected FILE\.fmu; got fill\.st"),
        ("fmu: tank.fmu", "fmu: tank.fmu\n    python: a.py:B", r":7:\d+: the simulation of 'water'; expected one"),
        ("pump: pump.run", "pumpe: pump.run", r":12:\d+: the FMU has no variable 'pumpe'; .*did you mean 'pump'"),
        ("pump: pump.run", "area2: pump.run", r":12:\d+: the FMU has no variable 'area2'"),
        ("pump: pump.run", "full: pump.run", r":12:\d+: 'full' is not an input of the FMU; expected pump, inflow; got caus"),
        ("pump: pump.run", "pump: pumpe.run", r":12:\d+: no emulated device 'pumpe'"),
        ("area: 0.8", "aera: 0.8", r":11:\d+: the FMU has no variable 'aera'; .*did you mean 'area'"),
        ("area: 0.8", "outflow: 0.8", r":11:\d+: 'outflow' is computed by the FMU; expected pump, inflow, level, area,"),
        ("area: 0.8", "pump: 0.8", r":11:\d+: 'pump' is not a float; expected a whole number"),
        ("outlet: outlet.k", "outlet: outlet.x", r":10:\d+: the FMU has no variable 'outlet\.x'; .*did you mean 'outlet\.k'"),
        ("{simulation: water}", "{simulation: water, plays: {level: height}}", r":14:\d+: .*computes 'height'; expected"),
    ],
)  # fmt: skip
def test_errors_are_reported_with_their_place(tmp_path: Path, old: str, new: str, message: str) -> None:
    system = tank_site(tmp_path)
    in_prototype(system, old, new)
    with pytest.raises(FileInvalid, match=r"tank\.prototype\.yaml" + message):
        load_prototype(load_system(system))


def rewritten(path: Path, old: str, new: str, *, without: str = "") -> None:
    """Replace text in the description of an FMU, which FMPy checks against the schema of the standard."""
    with zipfile.ZipFile(path) as archive:
        contents = {name: archive.read(name) for name in archive.namelist()}
    text = contents["modelDescription.xml"].decode()
    assert old in text
    contents["modelDescription.xml"] = text.replace(old, new).encode()
    with zipfile.ZipFile(path, "w") as archive:
        for name, data in contents.items():
            if not without or without not in name:
                archive.writestr(name, data)


FIXED = (
    "canHandleVariableCommunicationStepSize",
    'fixedInternalStepSize="0.03" canHandleVariableCommunicationStepSize',
)


@pytest.mark.parametrize(
    ("fmi", "old", "new", "without", "message"),
    [
        (2, "CoSimulation modelIdentifier", "ModelExchange modelIdentifier", "", "modelDescription.xml is invalid"),
        (3, "CoSimulation model", "ScheduledExecution model", "", "no co-simulation; .*got scheduled execution only"),
        (
            3,
            "tank",
            "tank",
            "binaries",
            r"no binary for this computer; expected binaries/\S+/tank\.so; got no binaries",
        ),
        (2, 'fmiVersion="2.0"', 'fmiVersion="9.0"', "", r"Unsupported FMI version: 9\.0; expected FMI 2\.0 or 3\.0"),
        (2, "<ModelVariables>", "<Variables>", "", "modelDescription.xml is invalid"),
        (3, *FIXED, "", "the FMU has a fixed step; expected a multiple of 30 ms; got 100 ms"),
        (2, "tank", "tank", "modelDescription", "not an FMU; expected a zip file with a modelDescription.xml"),
    ],
)
def test_an_unsuitable_fmu_is_refused_before_it_runs(
    tmp_path: Path, fmi: int, old: str, new: str, without: str, message: str
) -> None:
    system = tank_site(tmp_path, fmi)
    rewritten(tmp_path / "tank.fmu", old, new, without=without)
    with pytest.raises(FileInvalid, match=rf"tank\.prototype\.yaml:\d+:\d+: .*{message}"):
        load_prototype(load_system(system))


def test_check_site_runs_no_code_of_the_fmu(tmp_path: Path) -> None:
    """The code of the FMU crashes, and the check does not notice it."""
    tank_site(tmp_path, fails="crash")
    found = check_site(tmp_path)
    assert not found.errors
    rewritten(tmp_path / "tank.fmu", 'name="level"', 'name="height"')
    assert [re.sub(r".*yaml", "", str(error)).partition(";")[0] for error in check_site(tmp_path).errors] == [
        ":11:13: the FMU has no variable 'level'"
    ]


@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_a_damaged_fmu_is_an_error_of_the_file(tmp_path: Path, data: st.DataObject) -> None:
    path = build_fmu(tmp_path / "tank.fmu")
    whole = path.read_bytes()
    at = data.draw(st.integers(0, len(whole) - 1))
    flipped = data.draw(st.binary(min_size=1, max_size=40))
    damaged = whole[:at] + flipped + whole[at + len(flipped) :]
    path.write_bytes(damaged[: data.draw(st.integers(0, len(damaged)))])
    with suppress(FileInvalid):  # any other exception fails the test
        describe(path)
        unpack(path, tmp_path / "unpacked")
