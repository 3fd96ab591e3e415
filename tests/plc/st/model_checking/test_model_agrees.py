"""The model of a program and the compiled program do the same with any inputs: every variable after every scan is equal."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from example_programs import CODESYS, EXAMPLES, MAIL_COUNTED_MODULO
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from model_bench import INTERVAL_NS, kept, model_of, model_states, program_states, same

from fieldtwin.gateway.core.errors import FileInvalid
from fieldtwin.plc.st import types as ty
from fieldtwin.plc.st.dialects import dialect_of
from fieldtwin.plc.st.model_checking.execution.mailboxes import LATEST_NS, MOST_MESSAGES
from fieldtwin.plc.st.model_checking.solving import Scan
from fieldtwin.plc.st.model_checking.transition import Builder, Transition
from fieldtwin.plc.st.program import StProgram, program_class
from fieldtwin.plc.st.project import compile_source

ROOT = Path(__file__).parents[4]
SHIPPED = sorted(
    path.relative_to(ROOT).as_posix()
    for folder in ("profiles", "examples", "benchmarks", "tests/emulators", "tests/vectors/plcopen")
    for path in (ROOT / folder).rglob("*")
    if path.suffix in (".st", ".xml")
)
WITHOUT_MODEL = {
    "profiles/systems/adapt.st": "a loop that can run more than 200 times",
    "profiles/systems/relay.st": "a loop that can run more than 200 times",
}
"""Shipped programs that are refused, and what the refusal names: both have a loop over the characters of a message."""


def whole_numbers(low: int, high: int) -> st.SearchStrategy[int]:
    """Return numbers from `low` to `high`: small ones, both ends, and any."""
    small = st.integers(max(low, -4), min(high, 8))
    return st.one_of(small, st.sampled_from([low, high]), st.integers(low, high))


def values(kind: ty.Type) -> st.SearchStrategy[Any]:
    """Return the values of an input of this type."""
    if isinstance(kind, ty.Enum):
        return st.sampled_from(sorted(kind.values.values()))
    if isinstance(kind, ty.Subrange):
        return whole_numbers(kind.low, kind.high)
    if isinstance(kind, ty.MessagesIn):
        return whole_numbers(0, MOST_MESSAGES)
    assert isinstance(kind, ty.Elementary)
    if kind.kind == "bool":
        return st.booleans()
    if kind.kind == "real":
        small = st.integers(-400, 400).map(lambda n: n / 4)
        return st.one_of(small, st.floats(width=32 if kind.bits == 32 else 64, allow_nan=False, allow_infinity=False))
    if kind.kind == "duration":
        return st.one_of(whole_numbers(0, 5).map(lambda s: s * 10**9), whole_numbers(kind.low, kind.high))
    return whole_numbers(kind.low, kind.high)


def ways(kind: type[StProgram]) -> st.SearchStrategy[list[Scan]]:
    """Return sequences of scans with any inputs of a program."""
    inputs = [v for v in kind().st_declared.variables if v.role == "input"]
    after = st.one_of(
        st.just(INTERVAL_NS[0]), st.integers(1, 60).map(lambda n: n * 100_000_000), st.integers(*INTERVAL_NS)
    )
    pairs = st.tuples(*(values(v.kind).map(lambda value, name=v.name: (name, value)) for v in inputs))
    good = st.tuples(*(st.booleans().map(lambda on, name=v.name: (name, on)) for v in inputs))
    scans = st.lists(st.builds(Scan, after, pairs, good), min_size=1, max_size=6)
    if not kind().st_resource.absolute:
        return scans
    start = st.one_of(st.integers(0, 1000), st.integers(0, LATEST_NS - 6 * INTERVAL_NS[1]))
    return st.builds(_beginning, scans, start)


def _beginning(way: list[Scan], at_ns: int) -> list[Scan]:
    """Return scans of which the first one is at a time of the clock."""
    return [replace(way[0], after_ns=at_ns), *way[1:]]


def check(transition: Transition, kind: type[StProgram], way: list[Scan]) -> None:
    """Check that model and program agree in every scan of `way`."""
    initial = {leaf.name: leaf.get() for leaf in kept(kind())}
    known = set(transition.names)
    for model, program in zip(model_states(transition, way), program_states(kind, way), strict=not transition.unknowns):
        if model is None or program is None:
            assert model == program, "one of them ends the scan with an error"
            return
        inputs = {f"v_{name.lower()}" for name, _ in way[0].values}
        for name, value in program.items():
            if name in model:
                assert same(model[name], value), (name, model[name], value)
            elif isinstance(value, str):
                continue  # a text that changes is not part of the model's state
            elif name not in known | inputs:
                assert same(initial[name], value), f"{name} changes, and is a constant in the model"


def check_many(transition: Transition, kind: type[StProgram], examples: int) -> None:
    @settings(max_examples=examples, suppress_health_check=[HealthCheck.too_slow])
    @given(ways(kind))
    def agrees(way: list[Scan]) -> None:
        check(transition, kind, way)

    agrees()


@pytest.mark.parametrize("name", EXAMPLES)
def test_model_and_program_agree(name: str) -> None:
    check_many(*model_of(EXAMPLES[name]), 12)


def test_model_and_program_agree_in_the_dialect_codesys() -> None:
    check_many(*model_of(CODESYS, dialect="codesys"), 12)


@pytest.mark.long
@pytest.mark.timeout(300)
def test_model_and_program_agree_where_the_solver_finds_no_answer_in_time() -> None:
    check_many(*model_of(MAIL_COUNTED_MODULO), 12)


@pytest.mark.long
@pytest.mark.timeout(300)
@pytest.mark.parametrize("path", SHIPPED)
def test_model_and_shipped_program_agree(path: str) -> None:
    unit = compile_source(ROOT / path, dialect_of("codesys" if "codesys" in path else "standard"))
    for program in unit.programs:
        kind = program_class(unit, program.name)
        if path in WITHOUT_MODEL:
            with pytest.raises(FileInvalid, match=WITHOUT_MODEL[path]):
                Builder(kind(), INTERVAL_NS).build([], [])
        else:
            check_many(Builder(kind(), INTERVAL_NS).build([], []), kind, 15)
