"""Compiles the C module of a unit with the C compiler of the computer, and keeps the result for the next time."""

from __future__ import annotations

import hashlib
import importlib.util
import os
import shutil
import subprocess
import sysconfig
import tempfile
from importlib.machinery import ExtensionFileLoader
from pathlib import Path
from types import ModuleType

from fieldtwin.plc.st.native.module_text import MODULE

LIMIT_S = 300.0
"""How long the compiler may take, in seconds. A program of 2,600 lines takes about 4."""
MAX_KEPT = 64
"""The largest number of compiled modules that are kept; the oldest ones are removed."""
_FLAGS = (
    "-O1", "-shared", "-fPIC", "-w", "-ffp-contract=off", "-fno-strict-aliasing",
    *(f"-fno-builtin-{name}" for name in ("sin", "cos", "tan", "asin", "acos", "atan", "exp", "log", "log10", "pow")),
)  # fmt: skip
"""Without contraction, and with the functions of the mathematical library that Python calls, the results are those of Python."""


class NoCompiler(Exception):
    """No module could be made. Its text says why, and what to do."""


def module_of(text: str) -> ModuleType:
    """Return the module with the C text `text`, compiled now or before. Raises `NoCompiler`."""
    path = _folder() / f"{_key(text)}.so"
    if not path.exists():
        _compile(text, path)
        _remove_oldest(path.parent)
    try:
        loader = ExtensionFileLoader(MODULE, str(path))
        spec = importlib.util.spec_from_file_location(MODULE, path, loader=loader)
        assert spec is not None
        module = importlib.util.module_from_spec(spec)
        loader.exec_module(module)
    except ImportError as e:
        path.unlink(missing_ok=True)
        raise NoCompiler(f"the compiled program cannot be loaded: {e}") from e
    return module


def _folder() -> Path:
    """Return the folder of the compiled modules. Raises `NoCompiler` for a user without a home directory."""
    try:
        return Path(os.environ.get("XDG_CACHE_HOME") or "~/.cache").expanduser() / "fieldtwin" / "machine-code"
    except RuntimeError as e:
        raise NoCompiler("the user has no home directory; set XDG_CACHE_HOME") from e


def _key(text: str) -> str:
    """Return the name of a module, which differs for each text, version of Python and compiler."""
    whole = "\0".join([text, sysconfig.get_config_var("SOABI") or "", " ".join(_command())])
    return hashlib.sha256(whole.encode()).hexdigest()[:32]


def _command() -> list[str]:
    """Return the compiler and its flags. Raises `NoCompiler`."""
    compiler = os.environ.get("CC") or "cc"
    found = shutil.which(compiler)
    if found is None:
        raise NoCompiler(f"there is no C compiler {compiler}; install gcc, or set CC")
    header = Path(sysconfig.get_paths()["include"]) / "Python.h"
    if not header.exists():
        raise NoCompiler(f"the headers of Python are missing ({header}); install python3-dev")
    return [found, *_FLAGS, f"-I{header.parent}"]


def _compile(text: str, path: Path) -> None:
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=path.parent) as folder:
            source, made = Path(folder) / "program.c", Path(folder) / path.name
            source.write_text(text, encoding="utf-8")  # a name in a namespace has a dot that is not ASCII
            command = [*_command(), "-o", str(made), str(source), "-lm"]
            done = subprocess.run(command, capture_output=True, text=True, timeout=LIMIT_S, check=False)
            if done.returncode:
                raise NoCompiler(f"{command[0]} failed: {done.stderr.strip()[:500]}")
            made.replace(path)
    except subprocess.TimeoutExpired as e:
        raise NoCompiler(f"the C compiler took more than {LIMIT_S:.0f} s") from e
    except OSError as e:
        raise NoCompiler(f"the compiled program cannot be written: {e}") from e


def _remove_oldest(folder: Path) -> None:
    kept = sorted(folder.glob("*.so"), key=lambda path: path.stat().st_mtime, reverse=True)
    for path in kept[MAX_KEPT:]:
        path.unlink(missing_ok=True)
