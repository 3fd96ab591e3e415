"""FMUs as simulations of a prototype: the variables that a prototype file names are checked against the FMU's description."""

from __future__ import annotations

import re
from collections.abc import Iterable
from pathlib import Path

from fieldtwin.emulators.simulation.fmu.description import FmuDescription, FmuVariable, describe
from fieldtwin.emulators.simulation.fmu.process import FmuBinding, FmuProcess
from fieldtwin.gateway.core.errors import FileInvalid, UsageError
from fieldtwin.gateway.core.files.nearest import did_you_mean
from fieldtwin.gateway.core.files.yaml_file import YamlFile
from fieldtwin.twin.plant.child import command
from fieldtwin.twin.site.schema import SimulationForm

SUFFIX = ".fmu"
MAX_OUTPUTS = 1000
"""The largest number of outputs that one simulation reads at each step."""
SHOWN = 12
"""The number of variables that a message lists."""
_NAME = re.compile(r"[a-zA-Z][a-zA-Z0-9_]*")
_OUTPUTS = ("output", "local")


def fmu_path(file: YamlFile, name: str) -> Path:
    """Return the path of an FMU that a prototype file names: relative to that file."""
    return Path(file.path).parent / name


def fmu_process(name: str, form: SimulationForm, binding: FmuBinding) -> FmuProcess:
    """Return the process of an FMU, which starts at the first step."""
    return FmuProcess(name, binding, form.limit_ms, command)


def bind_fmu(file: YamlFile, form: SimulationForm, name: str) -> FmuBinding:
    """Return the FMU of the simulation `name` and the variables that it uses. No code of the FMU is run.

    Raises `FileInvalid` with the place in the prototype file for an unsuitable FMU, or a variable that does not exist or has
    an unsuitable causality; `UsageError` without the extra `fmi`.
    """
    assert form.fmu is not None
    loc = ("simulations", name)
    path = fmu_path(file, form.fmu)
    if path.suffix.lower() != SUFFIX:  # by its suffix, a file of a template is recognised as code
        raise file.error((*loc, "fmu"), "not an FMU", expected=f"FILE{SUFFIX}", got=form.fmu)
    if not path.is_file():
        raise file.error((*loc, "fmu"), "no such file", expected=f"FILE{SUFFIX}", got=form.fmu)
    try:
        fmu = describe(path)
    except FileInvalid as e:
        raise file.error((*loc, "fmu"), f"{form.fmu}: {e.message}", expected=e.expected, got=e.got, hint=e.hint) from e
    except UsageError as e:
        raise e.at(f"{file.path}:{file.line((*loc, 'fmu'))}") from e
    _check_step(file, form, name, fmu)
    start = {}
    for key, value in form.start.items():
        variable = _variable(file, form, (*loc, "start", key), fmu)
        if not variable.has_start:
            raise file.error((*loc, "start", key), f"{variable.name!r} is computed by the FMU", expected=_settable(fmu))
        if variable.is_whole and not value.is_integer():
            raise file.error((*loc, "start", key), f"{variable.name!r} is not a float", expected="a whole number")
        start[variable.name] = value
    inputs = {}
    for key in form.inputs:
        variable = _variable(file, form, (*loc, "inputs", key), fmu)
        if variable.causality != "input":
            expected = _listed(v.name for v in fmu.variables.values() if v.causality == "input")
            raise file.error(
                (*loc, "inputs", key), f"{variable.name!r} is not an input of the FMU", expected=expected,
                got=f"causality {variable.causality}",
            )  # fmt: skip
        inputs[key] = variable.name
    return FmuBinding(fmu, start, inputs, _outputs(file, form, name, fmu))


def _check_step(file: YamlFile, form: SimulationForm, name: str, fmu: FmuDescription) -> None:
    fixed_s = fmu.fixed_step_s
    if fixed_s is not None and fixed_s > 0:
        parts = form.step_ms / 1000 / fixed_s
        if round(parts) < 1 or abs(parts - round(parts)) > 1e-6:
            raise file.error(
                ("simulations", name, "step_ms"),
                "the FMU has a fixed step",
                expected=f"a multiple of {fixed_s * 1000:g} ms",
                got=f"{form.step_ms:g} ms",
            )


def _variable(file: YamlFile, form: SimulationForm, loc: tuple[str, ...], fmu: FmuDescription) -> FmuVariable:
    """Return the FMU's variable for the name at the end of `loc`."""
    wanted = form.variables.get(loc[-1], loc[-1])
    variable = fmu.variables.get(wanted)
    if variable is None:
        if loc[-1] in form.variables:
            loc = (loc[0], loc[1], "variables", loc[-1])
        raise file.error(
            loc,
            f"the FMU has no variable {wanted!r}",
            expected=_listed(v.name for v in fmu.variables.values() if v.suffix and v.causality != "local"),
            hint=did_you_mean(wanted, fmu.variables),
        )
    if not variable.suffix:
        raise file.error(loc, f"{wanted!r} is an array, a text or binary", expected="a number")
    return variable


def _outputs(file: YamlFile, form: SimulationForm, name: str, fmu: FmuDescription) -> dict[str, str]:
    """Return the names of a simulation and the FMU's variables that give them values: every output with a plain name, and
    the variables under `variables:` that the FMU computes.
    """
    outputs = {}
    for variable in fmu.variables.values():
        if variable.causality == "output" and variable.suffix and _NAME.fullmatch(variable.name):
            outputs[variable.name] = variable.name
    for key in form.variables:
        variable = _variable(file, form, ("simulations", name, "variables", key), fmu)
        if variable.causality in _OUTPUTS:
            outputs[key] = variable.name
    for key in form.inputs:
        outputs.pop(key, None)
    if not outputs:
        found = (v.name for v in fmu.variables.values() if v.suffix and v.causality in _OUTPUTS)
        raise file.error(
            ("simulations", name, "fmu"),
            "the FMU has no output whose name can be used here",
            expected="`variables: {NAME: VARIABLE}`",
            got=_listed(found),
        )
    if len(outputs) > MAX_OUTPUTS:
        raise file.error(
            ("simulations", name, "fmu"), "the FMU has too many outputs", expected=f"at most {MAX_OUTPUTS}"
        )
    return outputs


def _settable(fmu: FmuDescription) -> str:
    return _listed(v.name for v in fmu.variables.values() if v.suffix and v.has_start)


def _listed(names: Iterable[str]) -> str:
    found = list(names)
    more = f" and {len(found) - SHOWN} more" if len(found) > SHOWN else ""
    return ", ".join(found[:SHOWN]) + more or "none"
