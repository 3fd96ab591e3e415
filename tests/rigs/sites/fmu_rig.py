"""FMUs for tests: examples/tank-fmu, built for either version of FMI, whole or with a failure in its step."""

from __future__ import annotations

import importlib.util
import shutil
import tempfile
from functools import cache
from pathlib import Path

import pytest

EXAMPLE = Path(__file__).resolve().parents[3] / "examples" / "tank-fmu"
needs_gcc = pytest.mark.skipif(shutil.which("gcc") is None, reason="gcc is not installed")
FAILS_AT_S = 0.55
FAILURES = {
    "crash": "*(volatile int *)0 = 1;",
    "endless": "for (;;) { }",
    "discard": "return 2;",
    "error": "return 3;",
    "fatal": "return 4;",
    "not a number": "v[OUTLET] = NAN;",
    "exit": "exit(3);",
    "abort": "abort();",
}
"""Name of a failure -> the C code of the step that begins after `FAILS_AT_S`."""


def build_fmu(out: Path, fmi: int = 2, fails: str = "") -> Path:
    """Build the tank of the example as `out`, and return it. `fails` is one of `FAILURES`."""
    out.write_bytes(_built(fmi, fails))
    return out


@cache
def _built(fmi: int, fails: str) -> bytes:
    """Return an FMU. Each is built once in a test run."""
    flags = [f"-DBEFORE_STEP(v, t)=if (t > {FAILS_AT_S}) {{ {FAILURES[fails]} }}"] if fails else []
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder, "tank.fmu")
        _builder().build(out, fmi, flags)
        return out.read_bytes()


@cache
def _builder():
    spec = importlib.util.spec_from_file_location("build_tank_fmu", EXAMPLE / "build.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def tank_site(folder: Path, fmi: int = 2, fails: str = "") -> Path:
    """Copy the example into `folder` with its FMU, and return the system file."""
    folder.mkdir(parents=True, exist_ok=True)
    for file in EXAMPLE.iterdir():
        if file.suffix in (".yaml", ".st"):
            shutil.copy(file, folder / file.name)
    build_fmu(folder / "tank.fmu", fmi, fails)
    return folder / "tank.yaml"


def in_prototype(system: Path, old: str, new: str) -> None:
    """Replace `old`, which occurs once, in the prototype file of `system`."""
    path = system.with_name("tank.prototype.yaml")
    text = path.read_text(encoding="utf-8")
    assert text.count(old) == 1, old
    path.write_text(text.replace(old, new), encoding="utf-8")
