"""The fast tests try a third of the examples of property tests, and the long tests all of them."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from property_examples import fewer, has_examples, reduce_examples

ROOT = Path(__file__).parents[2]


def test_a_property_test_tries_a_third_of_its_examples_once_reduced() -> None:
    tried: list[int] = []

    @settings(max_examples=60, database=None)
    @given(st.integers())
    def property_of_numbers(number: int) -> None:
        tried.append(number)

    property_of_numbers()
    assert (has_examples(property_of_numbers), len(tried)) == (True, 60)
    for _ in range(2):  # two rows of parameters are one function
        tried.clear()
        reduce_examples(property_of_numbers)
        property_of_numbers()
        assert len(tried) == 20


def test_few_examples_are_not_reduced() -> None:
    assert [fewer(n) for n in (1, 8, 10, 12, 25, 30, 60, 500)] == [1, 8, 10, 10, 10, 10, 20, 166]


@pytest.mark.parametrize(
    ("selection", "tried"),
    [("not long", "33"), ("long", "100"), ("", "100")],
)
def test_the_selection_of_tests_decides_how_many_are_tried(selection: str, tried: str, tmp_path: Path) -> None:
    test = "tests/gateway/core/image/test_image.py::test_any_values_round_trip"
    options = ["-p", "no:cacheprovider", "--hypothesis-show-statistics", "--basetemp", str(tmp_path / "t")]
    done = subprocess.run(
        [sys.executable, "-m", "pytest", *options, "-m", selection, test],
        cwd=ROOT, capture_output=True, text=True, check=False, timeout=60,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout
    assert f"settings.max_examples={tried}\n" in done.stdout
