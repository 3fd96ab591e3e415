"""The verdict of a benchmark on a quiet host and on one whose processors were taken away."""

from __future__ import annotations

import importlib.util
import sys
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

import pytest

FOLDER = Path(__file__).parents[2] / "benchmarks"
IDLE_TICKS = 10_000


def load(name: str) -> ModuleType:
    spec = importlib.util.spec_from_file_location(name, FOLDER / f"{name}.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module
    spec.loader.exec_module(module)
    return module


@pytest.fixture
def bench() -> Iterator[tuple[ModuleType, ModuleType]]:
    """The modules `host` and `peers` as a benchmark imports them."""
    before = {name: sys.modules.get(name) for name in ("host", "peers")}
    try:
        yield load("host"), load("peers")
    finally:
        for name, module in before.items():
            if module is None:
                del sys.modules[name]
            else:
                sys.modules[name] = module


@pytest.mark.parametrize(
    ("stolen", "load_average", "got", "status", "word"),
    [
        (0, 0.5, 3.0, 0, "reached"),
        (0, 0.5, 1.0, 1, "MISSED"),
        (199, 0.5, 1.0, 1, "MISSED"),
        (201, 0.5, 1.0, 3, "INCONCLUSIVE"),
        (201, 0.5, 3.0, 3, "INCONCLUSIVE"),
        (0, 1e6, 3.0, 3, "INCONCLUSIVE"),
    ],
)
def test_a_timing_on_a_disturbed_host_is_inconclusive(
    bench: tuple[ModuleType, ModuleType],
    capsys: pytest.CaptureFixture[str],
    stolen: int,
    load_average: float,
    got: float,
    status: int,
    word: str,
) -> None:
    host, peers = bench
    goals = peers.Goals()
    goals.least("polls", got, 2.0, "a second")
    before = host.HostState(stolen=5, ticks=100, load=0.1)
    after = host.HostState(stolen=5 + stolen, ticks=100 + IDLE_TICKS, load=load_average)
    assert goals.verdict(before, after) == status
    out = capsys.readouterr().out
    assert out.startswith(word)
    if status == 3:
        assert "MISSED" not in out
        assert "reached" not in out
    assert f"steal {stolen / IDLE_TICKS:.1%}" in out


def test_a_result_without_timing_does_not_depend_on_the_host(
    bench: tuple[ModuleType, ModuleType], capsys: pytest.CaptureFixture[str]
) -> None:
    host, peers = bench
    goals = peers.Goals(timed=False)
    goals.most("bytes", 3.0, 2.0)
    disturbed = host.HostState(stolen=5_000, ticks=10_000, load=0.1)
    assert goals.verdict(host.HostState(0, 0, 0.1), disturbed) == 1
    assert capsys.readouterr().out.startswith("MISSED")


def test_the_state_of_the_host_is_read_from_proc_stat(bench: tuple[ModuleType, ModuleType], tmp_path: Path) -> None:
    (tmp_path / "stat").write_text("cpu  1 2 3 4 5 6 7 8 9 10\ncpu0 1 1 1 1 1 1 1 1 1 1\n")
    state = bench[0].HostState.read(tmp_path / "stat")
    assert (state.stolen, state.ticks) == (8, 36)
