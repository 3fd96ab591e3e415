"""The shipped recordings are the output of the script, and have plausible values for a buoy and a cast."""

from __future__ import annotations

import subprocess
import sys
from itertools import pairwise
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fieldtwin.emulators.models.synthetic.seawater import C_35_15_0, T68_PER_T90, conductivity, salinity
from fieldtwin.emulators.signals import SignalTrack
from fieldtwin.gateway.core.files.recording import RecordingReader

ROOT = Path(__file__).resolve().parents[3]
SHIPPED = ("cast.jsonl", "incl.jsonl")


def make(out: Path, *arguments: str) -> None:
    script = ROOT / "scripts" / "make_recordings.py"
    subprocess.run([sys.executable, str(script), "--out", str(out), *arguments], check=True, capture_output=True)


def test_the_script_makes_the_committed_bytes_and_a_different_seed_other_bytes(tmp_path: Path) -> None:
    make(tmp_path)
    make(tmp_path / "other", "--seed", "2")
    for name in SHIPPED:
        assert (tmp_path / name).read_bytes() == (ROOT / "recordings" / name).read_bytes()
        assert (tmp_path / "other" / name).read_bytes() != (ROOT / "recordings" / name).read_bytes()


@pytest.mark.parametrize("name", SHIPPED)
def test_shipped_recordings_are_small_and_marked_synthetic(name: str) -> None:
    path = ROOT / "recordings" / name
    assert path.stat().st_size < 400_000
    with RecordingReader(path) as reader:
        assert reader.header.source == "synthetic"
        assert "--seed" in reader.header.made_by
        assert all(info.unit for info in reader.header.signals.values())


def test_the_cast_goes_down_and_up_through_a_stratified_sea() -> None:
    track = SignalTrack.load(ROOT / "recordings" / "cast.jsonl")
    assert track.names == ("pressure", "temperature", "conductivity")
    assert track.last_s == 1200.0
    pressures = [track.at(t, "pressure") for t in range(1201)]
    deepest = pressures.index(max(pressures))
    assert 495 < max(pressures) < 505
    assert pressures[0] < 10 > pressures[-1]
    assert 500 < deepest < 620
    down = [track.values(float(t)) for t in range(70, deepest, 5)]
    assert down[0]["temperature"] > 23
    assert down[-1]["temperature"] < 8
    salinities = [salinity(row["conductivity"], row["temperature"], row["pressure"]) for row in down]
    assert 33 < min(salinities) < 34 < 35.3 < max(salinities) < 36


def test_the_inclinometer_loops_without_a_jump() -> None:
    track = SignalTrack.load(ROOT / "recordings" / "incl.jsonl")
    assert (len(track), track.last_s) == (601, 60.0)
    for name in ("slope_long", "slope_lateral"):
        values = [track.at(i / 10, name) for i in range(601)]
        assert values[0] == values[-1]
        steps = [abs(b - a) for a, b in pairwise(values)]
        assert steps[-1] <= max(steps[:-1])
        assert max(map(abs, values)) < 15


UNESCO_44 = [(1.0, 15.0, 0.0, 35.0), (1.2, 20.0, 2000.0, 37.245628), (0.65, 5.0, 1500.0, 27.995347)]


@pytest.mark.parametrize(("ratio", "t68", "pressure", "expected"), [*UNESCO_44, (1.888091, 40.0, 10_000.0, 40.0)])
def test_salinity_meets_the_check_values(ratio: float, t68: float, pressure: float, expected: float) -> None:
    assert salinity(ratio * C_35_15_0, t68 / T68_PER_T90, pressure) == pytest.approx(expected, abs=5e-6)
    assert conductivity(expected, t68 / T68_PER_T90, pressure) == pytest.approx(ratio * C_35_15_0, abs=1e-6)


@given(st.floats(2, 42), st.floats(-2, 35), st.floats(0, 10_000))
def test_conductivity_is_the_inverse_of_salinity(psu: float, temperature: float, pressure: float) -> None:
    assert salinity(conductivity(psu, temperature, pressure), temperature, pressure) == pytest.approx(psu, abs=1e-9)
