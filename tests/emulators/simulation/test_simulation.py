"""Simulations: due steps, inputs that take effect at their own time, and Python models that fail."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fieldtwin.emulators.journal import DeviceValueLog
from fieldtwin.emulators.simulation.python_model import PythonModel
from fieldtwin.emulators.simulation.signals import SimulatedSignals
from fieldtwin.emulators.simulation.simulation import MAX_STEPS, Simulation, by_formulas, by_model
from fieldtwin.gateway.core.clock import NS_PER_S
from fieldtwin.gateway.core.errors import FileInvalid, UsageError

START = 5 * NS_PER_S
STEP = NS_PER_S // 10


def at(seconds: float) -> int:
    return START + round(seconds * NS_PER_S)


def simulation(formulas: dict[str, str], inputs: tuple[str, ...] = (), **start: float) -> Simulation:
    step, begin = by_formulas(formulas, start, inputs, "seed")
    return Simulation(step, begin, inputs, START, STEP)


def test_a_tank_fills_by_its_inflow() -> None:
    tank = simulation({"level": "level + inflow * dt", "twice": "2 * level"}, ("inflow",), level=1.0)
    assert tank.values(START)["level"] == 1.0
    tank.put("inflow", 2.0, at(1.05))
    assert tank.values(at(1.05))["level"] == 1.0  # between two steps nothing changes
    assert tank.values(at(2.05))["level"] == pytest.approx(3.0)  # the step at 1.1 s was the first with it
    assert tank.values(at(2.05))["twice"] == pytest.approx(6.0)


def test_formulas_see_new_values_of_those_above_and_old_ones_of_those_below() -> None:
    order = simulation({"a": "b + 1", "b": "a * 10"})
    assert dict(order.values(START)) == {"a": 1.0, "b": 10.0}
    assert dict(order.values(at(0.1))) == {"a": 11.0, "b": 110.0}


@settings(max_examples=50, deadline=None)
@given(
    st.lists(st.integers(0, 3_000), max_size=20),
    st.lists(st.tuples(st.integers(0, 3_000), st.floats(-5, 5)), max_size=5),
)
def test_reading_changes_nothing(looks_ms: list[int], writes: list[tuple[int, float]]) -> None:
    """The same writes at the same times give the same values, independent of other reads."""

    def run(looks: list[int]) -> float:
        made = simulation({"x": "x + (u - x) * dt + noise(0.1)"}, ("u",), x=1.0)
        acts: list[tuple[int, int, float]] = [(ms, 0, value) for ms, value in writes] + [(ms, 1, 0.0) for ms in looks]
        for ms, kind, value in sorted(acts):
            if kind == 0:
                made.put("u", value, at(ms / 1000))
            else:
                made.values(at(ms / 1000))
        return made.values(at(3.5))["x"]

    assert run(looks_ms) == run([])


def test_after_long_silence_old_steps_are_left_out_and_counted() -> None:
    made = simulation({"n": "n + 1"})
    made.values(at(0))
    made.values(at(0.1 * (MAX_STEPS + 50)))
    assert made.skipped == 50
    assert made.values(at(0.1 * (MAX_STEPS + 50)))["n"] == MAX_STEPS + 1


def test_invalid_names_and_inputs() -> None:
    with pytest.raises(UsageError, match="no formula or step computes 'y'"):
        simulation({"x": "1"}, y=1.0)
    with pytest.raises(UsageError, match="not a valid name for a value"):
        simulation({"t": "1"})
    with pytest.raises(UsageError, match="no input 'v'"):
        simulation({"x": "u"}, ("u",)).put("v", 1.0, START)


def test_the_replayed_values_of_a_device() -> None:
    signals = SimulatedSignals(simulation({"x": "t", "y": "-t"}), {"depth": "x"}, "p.yaml")
    assert signals.names == ("depth",)
    assert signals.values(at(1.5)) == {"depth": pytest.approx(1.5)}
    assert signals.values_at(signals.position_s(at(2.0)))["depth"] == pytest.approx(2.0)
    assert signals.at(at(2.5), "depth") == pytest.approx(2.5)
    with pytest.raises(FileInvalid, match="no such signal"):
        signals.at(at(2.5), "x")


MODEL = """
class Tank:
    def __init__(self, start):
        self.level = start.get("level", 0.0)

    def step(self, t_s, dt_s, inputs):
        self.level += inputs["inflow"] * dt_s
        return {"level": self.level}

class Forgetful(Tank):
    def step(self, t_s, dt_s, inputs):
        return {"level": 1.0} if t_s < 1 else {}

class Broken(Tank):
    def step(self, t_s, dt_s, inputs):
        return {"level": 1 / (t_s - 1)}

class Odd(Tank):
    def step(self, t_s, dt_s, inputs):
        return {"level": "high"}

class Unmade(Tank):
    def __init__(self, start):
        raise RuntimeError("no")

class Shadow(Tank):
    def step(self, t_s, dt_s, inputs):
        return {"inflow": 1.0}
"""


def model(tmp_path: Path, name: str, start: Mapping[str, float] | None = None, text: str = MODEL) -> Simulation:
    path = tmp_path / "tank.py"
    path.write_text(text)
    step, begin = by_model(PythonModel(path, name, start or {}), ("inflow",))
    return Simulation(step, begin, ("inflow",), START, STEP)


def test_a_python_model(tmp_path: Path) -> None:
    tank = model(tmp_path, "Tank", {"level": 3.0})
    tank.put("inflow", 1.0, START)
    assert tank.values(at(2))["level"] == pytest.approx(5.0)


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("Tonk", "no class 'Tonk'"),
        ("Forgetful", "other names at 1 s"),
        ("Broken", "failed at 1 s in line 16: ZeroDivisionError"),
        ("Odd", "returned 'level'"),
        ("Unmade", "failed: RuntimeError: no"),
        ("Shadow", "returned the input"),
    ],
)
def test_a_python_model_that_fails_is_its_files_fault(tmp_path: Path, name: str, message: str) -> None:
    with pytest.raises(FileInvalid, match=message):
        model(tmp_path, name).values(at(3))


def test_a_file_that_is_not_python(tmp_path: Path) -> None:
    with pytest.raises(FileInvalid, match="cannot be imported: SyntaxError"):
        model(tmp_path, "Tank", text="class")
    with pytest.raises(FileInvalid, match="not a Python file"):
        PythonModel(tmp_path / "none.py", "Tank", {})


def test_a_journal_notifies_its_watcher_of_changes_only() -> None:
    journal, seen = DeviceValueLog(), []
    journal.note("x", b"\0", 1)
    journal.watch("x", lambda raw, t_ns: seen.append((raw, t_ns)))
    for raw, t_ns in ((b"\0", 2), (b"\1", 3), (b"\1", 4)):
        journal.note("x", raw, t_ns)
    journal.note("y", b"\2", 5)
    assert seen == [(b"\0", 0), (b"\1", 3)]
