"""A simulation written in Python: a class in a file next to the prototype file, stepped like a formula.

::

    class Tank:
        def __init__(self, start):          # start: {name: number}, as the prototype file says
            self.level = start.get("level", 0.0)

        def step(self, t_s, dt_s, inputs):  # seconds; inputs: {name: number}
            self.level += (inputs["inflow"] - 0.1 * self.level) * dt_s
            return {"level": self.level}

The class is the user's code and runs with the emulator's rights: read a model of a third party before you run it.
"""

from __future__ import annotations

import importlib.util
import math
import traceback
from collections.abc import Mapping
from pathlib import Path
from types import ModuleType
from typing import Protocol

from fieldtwin.gateway.core.errors import FileInvalid


class Model(Protocol):
    """The interface of a user's simulation class."""

    def step(self, t_s: float, dt_s: float, inputs: Mapping[str, float]) -> Mapping[str, float]:
        """Return the values at `t_s`, `dt_s` after the previous step; at the first step `dt_s` is 0."""
        ...


class PythonModel:
    """The class `name` of `path`, created with `start`. Any exception of the class is reported as `FileInvalid`."""

    def __init__(self, path: Path, name: str, start: Mapping[str, float]) -> None:
        self.where = f"{path}:{name}"
        self._file = str(path.absolute())  # the form in which a traceback names the file
        module = _load(path)
        made = getattr(module, name, None)
        if not isinstance(made, type) or not callable(getattr(made, "step", None)):
            classes = ", ".join(n for n, v in vars(module).items() if isinstance(v, type) and hasattr(v, "step"))
            raise FileInvalid(
                f"no class {name!r} with a step(t_s, dt_s, inputs)", path=str(path), expected=classes or "such a class"
            )
        try:
            self._model: Model = made(dict(start))
        except Exception as e:  # an error in the user's code is reported with its file and line
            raise FileInvalid(f"{name}(start) failed: {type(e).__name__}: {e}", path=str(path)) from e

    def step(self, t_s: float, dt_s: float, inputs: Mapping[str, float]) -> dict[str, float]:
        """Perform one step of the user's class. Raises `FileInvalid`."""
        try:
            values = self._model.step(t_s, dt_s, inputs)
        except Exception as e:
            text = f"step() failed at {t_s:g} s{self._line_of(e)}: {type(e).__name__}: {e}"
            raise FileInvalid(text, path=self.where) from e
        if not isinstance(values, Mapping):
            raise FileInvalid(
                "step() returned no values", path=self.where, expected="{name: number}", got=repr(values)[:80]
            )
        out: dict[str, float] = {}
        for key, value in values.items():
            if not isinstance(value, int | float) or not isinstance(key, str):
                raise FileInvalid(
                    f"step() returned {key!r}", path=self.where, expected="a number under a name", got=repr(value)[:80]
                )
            out[key] = float(value) if abs(value) < 1e308 or math.isinf(value) or math.isnan(value) else math.inf
        return out

    def _line_of(self, error: Exception) -> str:
        """Return the line of the user's file in a traceback, as `` in line 7``; empty if the file does not occur."""
        frames = traceback.extract_tb(error.__traceback__)
        line = next((frame.lineno for frame in reversed(frames) if frame.filename == self._file), None)
        return f" in line {line}" if line is not None else ""


def _load(path: Path) -> ModuleType:
    spec = importlib.util.spec_from_file_location(f"fieldtwin_simulation_{path.stem}", path)
    if spec is None or spec.loader is None or not path.is_file():
        raise FileInvalid("not a Python file", path=str(path), expected="FILE.py:CLASS")
    module = importlib.util.module_from_spec(spec)
    try:
        spec.loader.exec_module(module)
    except Exception as e:
        raise FileInvalid(f"cannot be imported: {type(e).__name__}: {e}", path=str(path)) from e
    return module
