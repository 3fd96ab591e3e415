"""The examples of docs/reference/simulation.md run. Errors in simulations of a prototype file are reported with their place."""

from __future__ import annotations

import re
from pathlib import Path
from random import Random

import pytest

from fieldtwin.emulators.simulation.formula import FUNCTIONS, Formula
from fieldtwin.emulators.simulation.python_model import PythonModel
from fieldtwin.emulators.simulation.simulation import Simulation, by_formulas, by_model
from fieldtwin.gateway.core.clock import NS_PER_S
from fieldtwin.gateway.core.errors import FileInvalid
from fieldtwin.gateway.core.files.yaml_file import load
from fieldtwin.twin.prototype.file import load_prototype
from fieldtwin.twin.site.schema import SimulationForm
from fieldtwin.twin.site.system import load_system

ROOT = Path(__file__).resolve().parents[3]
PAGE = (ROOT / "docs" / "reference" / "simulation.md").read_text(encoding="utf-8")
SHIPPED = ROOT / "profiles" / "systems"


def snippets(language: str) -> list[str]:
    return re.findall(rf"```{language}\n(.*?)```", PAGE, re.DOTALL)


def test_the_pond_of_the_page(tmp_path: Path) -> None:
    levels = []
    for text in snippets("yaml"):
        (tmp_path / "p.yaml").write_text(text.partition("devices:")[0] + "\n", encoding="utf-8")
        pond = load(tmp_path / "p.yaml").data["simulations"]["pond"]
        form = SimulationForm.model_validate(pond)
        if form.fmu is not None:
            continue  # docs/how-to/fmu.md runs one
        if form.python is None:
            step, begin = by_formulas(form.formulas, form.start, tuple(form.inputs), "1")
        else:
            (tmp_path / "pond.py").write_text(snippets("python")[0], encoding="utf-8")
            step, begin = by_model(PythonModel(tmp_path / "pond.py", "Pond", form.start), tuple(form.inputs))
        made = Simulation(step, begin, tuple(form.inputs), 0, round(form.step_ms * 1e6))
        made.put("pump", 100.0, 0)
        values = made.values(10 * NS_PER_S)
        assert values["depth_mm"] == pytest.approx(1000 * values["level"])
        levels.append(values["level"])
    assert levels == pytest.approx([1.4, 1.4], abs=0.05)


def test_the_pages_name_every_function() -> None:
    language = (ROOT / "docs" / "reference" / "expressions.md").read_text(encoding="utf-8")
    named = set(re.findall(r"`([a-z0-9]+)\(", PAGE + language))
    assert set(FUNCTIONS) <= named
    for example in re.findall(r"`((?:ramp|sine|square|triangle|sawtooth|pulse)\([^`]*\))`", PAGE):
        names = re.findall(r"[a-z_]+", example.partition("(")[2])
        Formula(example, names, Random(1))


def changed(tmp_path: Path, old: str, new: str) -> Path:
    for name in ("lab_vehicle.yaml", "vehicle.st"):
        (tmp_path / name).write_text((SHIPPED / name).read_text(encoding="utf-8"), encoding="utf-8")
    text = (SHIPPED / "lab_vehicle.prototype.yaml").read_text(encoding="utf-8")
    assert text.count(old) == 1
    (tmp_path / "lab_vehicle.prototype.yaml").write_text(text.replace(old, new), encoding="utf-8")
    return tmp_path / "lab_vehicle.yaml"


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("wheel: drive.velocity,", "wheel: driver.velocity,", r":10:\d+: .*no emulated device 'driver'"),
        ("wheel: drive.velocity,", "wheel: drive.speed,", r":10:\d+: .*drive has no number 'speed'"),
        ("cos(turned)", "cos(turnt)", r":14:\d+: .*there is no value or function 'turnt'.*did you mean 'turned'"),
        ("cos(turned)", "cosine(turned)", r":14:\d+: .*no function 'cosine'.*did you mean"),
        ("{simulation: floor}", "{simulation: flor}", r"no simulation 'flor'; expected floor"),
        (
            "{simulation: floor}",
            "{simulation: floor, plays: {z: x}}",
            r"fieldtwin/vehicle-localiser has no numeric tag 'z'",
        ),
        ("{simulation: floor}", "{simulation: floor, plays: {x: z}}", r"no formula or step computes 'z'"),
        ("{simulation: floor}", "{model: profile, plays: {x: x}}", r"`plays` without a simulation"),
        ("{simulation: floor}", "{simulation: floor, model: profile}", r"the data source of 'localiser'"),
        ("step_ms: 10", "step_ms: 10\n    python: a.py:B", r"the simulation of 'floor'"),
        ("step_ms: 10", "start: {z: 1}", r"no formula or step computes 'z'"),
        ("heading: turned", "dt: turned", r"'dt' already has a meaning"),
    ],
)
def test_errors_are_reported_with_their_place(tmp_path: Path, old: str, new: str, message: str) -> None:
    with pytest.raises(FileInvalid, match=message):
        load_prototype(load_system(changed(tmp_path, old, new)))


def test_a_missing_python_file(tmp_path: Path) -> None:
    path = changed(tmp_path, "step_ms: 10", "step_ms: 10")
    file = tmp_path / "lab_vehicle.prototype.yaml"
    file.write_text(
        re.sub(r"    formulas:\n(      .*\n)+", "    python: none.py:Floor\n", file.read_text("utf-8")), "utf-8"
    )
    with pytest.raises(FileInvalid, match="no such file"):
        load_prototype(load_system(path))
