"""docs/explanation/campaign-cost.md: its tables are those of benchmarks/campaign_cost.py."""

from __future__ import annotations

import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
PAGE = (ROOT / "docs" / "explanation" / "campaign-cost.md").read_text("utf-8")
SHOWN = re.findall(r"^\$ python (benchmarks/\S+ .*)\n((?:\|.*\n)+)", PAGE, re.MULTILINE)


def cost(*words: str) -> subprocess.CompletedProcess[str]:
    script = str(ROOT / "benchmarks" / "campaign_cost.py")
    return subprocess.run([sys.executable, script, *words], capture_output=True, text=True, check=False)


def test_the_page_shows_two_tables() -> None:
    assert len(SHOWN) == 2


@pytest.mark.parametrize(("command", "table"), SHOWN)
def test_a_table_of_the_page_is_what_the_script_prints(command: str, table: str) -> None:
    assert cost(*shlex.split(command)[1:]).stdout == table


def test_twice_the_cores_need_half_the_time_and_the_same_core_hours() -> None:
    def row(name: str, *words: str) -> float:
        found = re.search(rf"\| {name} \| ([\d,.]+)", cost("--cpu-s", "36", *words).stdout)
        assert found
        return float(found[1].replace(",", ""))

    assert row("core hours") == row("core hours", "--cores", "256") == 11_111
    assert row("wall time") == pytest.approx(2 * row("wall time", "--cores", "256"), rel=0.01)


@pytest.mark.parametrize("words", [["--cpu-s", "0"], ["--cpu-s", "nan"], ["--cpu-s", "x"], []])
def test_a_figure_of_a_wrong_form_is_named(words: list[str]) -> None:
    done = cost(*words)
    assert done.returncode == 2
    assert "--cpu-s" in done.stderr
    assert "Traceback" not in done.stderr
