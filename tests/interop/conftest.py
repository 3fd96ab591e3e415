"""The conversations of the flagship test, made once per session for several tests."""

from __future__ import annotations

import asyncio
import shutil
import tempfile
from collections.abc import Callable, Iterator
from ctypes.util import find_library
from pathlib import Path
from typing import Any

import pytest
from flagship import Run, converse
from held import Held
from targets import emulated, independent, samples_like, slopes_like

MISSING = [p for p in ("socat",) if shutil.which(p) is None] + ([] if find_library("modbus") else ["libmodbus"])


@pytest.fixture(scope="session")
def short_dir() -> Iterator[Callable[[], Path]]:
    """Create directories with paths short enough for Unix sockets."""
    made: list[Path] = []

    def make() -> Path:
        made.append(Path(tempfile.mkdtemp(prefix="ft-")))
        return made[-1]

    yield make
    for path in made:
        shutil.rmtree(path)


@pytest.fixture(scope="session")
def with_emulators(short_dir: Callable[[], Path]) -> Held:
    """(a): the observatory against our emulators."""

    async def main() -> Run:
        run_dir = short_dir()
        async with emulated(run_dir) as target:
            return await converse(target, run_dir)

    return Held.of(asyncio.run(main()))


@pytest.fixture(scope="session")
def against_strangers(short_dir: Callable[[], Path], with_emulators: Held) -> Callable[..., Held]:
    """(b): the observatory against the independent devices, with or without planted differences."""
    if MISSING:
        pytest.skip(f"not installed: {', '.join(MISSING)}")
    samples = samples_like(with_emulators.talks["ctd"])
    slopes = slopes_like(with_emulators.talks["inclinometer"])

    def hold(plants: dict[str, str] | None = None, **options: Any) -> Held:
        async def main() -> Run:
            run_dir = short_dir()
            async with independent(run_dir, samples, slopes, plants) as target:
                return await converse(target, run_dir, **options)

        return Held.of(asyncio.run(main()))

    return hold


@pytest.fixture(scope="session")
def with_strangers(against_strangers: Callable[..., Held]) -> Held:
    """(b), without planted differences."""
    return against_strangers()
