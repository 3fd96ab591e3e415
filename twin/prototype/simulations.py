"""The simulations of a prototype: they are built from its file, give its devices their values, and receive the values written
to these devices.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from pathlib import Path
from random import Random

from fieldtwin.emulators.journal import DeviceValueLog
from fieldtwin.emulators.models.modbus.sampled_sensor import sampled_tags
from fieldtwin.emulators.simulation.fmu.process import FmuProcess
from fieldtwin.emulators.simulation.formula import STEP, TIME, Formula, uses_time
from fieldtwin.emulators.simulation.inputs import number_of
from fieldtwin.emulators.simulation.python_model import PythonModel
from fieldtwin.emulators.simulation.signals import SimulatedSignals
from fieldtwin.emulators.simulation.simulation import Simulation, Step, by_formulas, by_model
from fieldtwin.gateway.core.clock import NS_PER_MS
from fieldtwin.gateway.core.errors import FieldtwinError, FileInvalid, UsageError
from fieldtwin.gateway.core.files.error_collector import ErrorCollector, FollowingError
from fieldtwin.gateway.core.files.nearest import did_you_mean
from fieldtwin.gateway.core.files.profile import DeviceProfile, Tag
from fieldtwin.gateway.core.files.yaml_file import YamlFile
from fieldtwin.twin.prototype.fmus import bind_fmu, fmu_process
from fieldtwin.twin.site.schema import EmulatedForm, PrototypeForm, SimulationForm
from fieldtwin.twin.site.system import System


def check_simulations(file: YamlFile, form: PrototypeForm, system: System, errors: ErrorCollector) -> None:
    """Check everything that can be known about a prototype's simulations without running its Python code.

    Errors are added to `errors`.
    """
    for name, simulation in form.simulations.items():
        loc = ("simulations", name)
        with errors.collect():
            _check_source(file, simulation, name)
        for key, known in simulation.inputs.items():
            with errors.collect():
                _check_input(file, form, system, (*loc, "inputs", key), known)
        with errors.collect():
            _check_formulas(file, simulation, name)
    for name, device in form.devices.items():
        if device.simulation is not None and device.simulation not in form.simulations:
            error = file.error(
                ("devices", name, "simulation"),
                f"no simulation {device.simulation!r}",
                expected=", ".join(form.simulations) or "one under `simulations:`",
                hint=did_you_mean(device.simulation, form.simulations),
            )
            errors.add(error)


def _check_source(file: YamlFile, simulation: SimulationForm, name: str) -> None:
    loc = ("simulations", name)
    if [bool(simulation.formulas), simulation.python is not None, simulation.fmu is not None].count(True) != 1:
        expected = "one of `formulas:`, `python: FILE.py:CLASS` and `fmu: FILE.fmu`"
        raise file.error(loc, f"the simulation of {name!r}", expected=expected)
    if simulation.fmu is None and simulation.variables:
        raise file.error(
            (*loc, "variables"), "`variables` belongs to an FMU", expected="`fmu: FILE.fmu` in the same simulation"
        )
    if simulation.fmu is not None:
        bind_fmu(file, simulation, name)
    if simulation.python is not None and not _python(file, simulation.python)[0].is_file():
        raise file.error((*loc, "python"), "no such file", expected="FILE.py:CLASS", got=simulation.python)


def check_plays(file: YamlFile, form: PrototypeForm, name: str, profile: DeviceProfile, errors: ErrorCollector) -> None:
    """Check that `plays` maps numeric tags of the device to names that its simulation computes, as far as these names are known.

    Raises `FileInvalid` if nothing can be checked; errors of single tags are added to `errors`.
    """
    device = form.devices[name]
    if device.plays and device.simulation is None:
        raise file.error(
            ("devices", name, "plays"), "`plays` without a simulation", expected="`simulation: NAME` of the same device"
        )
    for tag, value in device.plays.items():
        loc = ("devices", name, "plays", tag)
        if tag not in profile.tags or profile.tags[tag].is_text:
            numbers = [t.name for t in profile.tags.values() if not t.is_text]
            error = file.error(
                loc,
                f"{profile.name} has no numeric tag {tag!r}",
                expected=", ".join(numbers),
                hint=did_you_mean(tag, numbers),
            )
            errors.add(error)
        computed = _computed(file, form, device.simulation or "")
        if computed and value not in computed:
            errors.add(file.error(loc, f"no formula or step computes {value!r}", expected=", ".join(computed)))


def _computed(file: YamlFile, form: PrototypeForm, name: str) -> tuple[str, ...]:
    """Return the names that a simulation computes, as far as they are known before it runs."""
    simulation = form.simulations.get(name)
    if simulation is None:
        return ()
    if simulation.fmu is None:
        return tuple(simulation.formulas)
    try:
        return tuple(bind_fmu(file, simulation, name).outputs)
    except FieldtwinError:  # check_simulations reports it
        return ()


def _check_formulas(file: YamlFile, simulation: SimulationForm, name: str) -> None:
    known = (*simulation.formulas, *simulation.inputs)
    for key, text in simulation.formulas.items():
        if key in (TIME, STEP) or key in simulation.inputs:
            loc = ("simulations", name, "formulas", key)
            raise file.error(loc, f"{key!r} already has a meaning", expected="an unused name")
        try:
            Formula(text, known, Random(0))
        except UsageError as e:
            loc = ("simulations", name, "formulas", key)
            raise file.error(loc, e.message, expected=e.expected, got=e.got, hint=e.hint) from e
    for key in simulation.start:
        if simulation.formulas and key not in simulation.formulas:
            raise file.error(
                ("simulations", name, "start", key),
                f"no formula or step computes {key!r}",
                expected=", ".join(simulation.formulas),
            )


def _check_input(file: YamlFile, form: PrototypeForm, system: System, loc: tuple[str, ...], text: str) -> None:
    device, _, tag = text.partition(".")
    if device in form.devices and device in system.file.section("devices") and device not in system.devices:
        raise FollowingError(f"the device {device!r} has an error", path=file.path)
    if device not in form.devices or device not in system.devices:
        emulated = [name for name in form.devices if name in system.devices]
        raise file.error(loc, f"no emulated device {device!r}", expected=", ".join(emulated))
    tags = system.devices[device].profile.tags
    if tag not in tags or tags[tag].is_text:
        numbers = ", ".join(t.name for t in tags.values() if not t.is_text)
        raise file.error(loc, f"{device} has no number {tag!r}", expected=numbers)


def _python(file: YamlFile, text: str) -> tuple[Path, str]:
    """Return the file and the class of ``FILE.py:CLASS``, relative to the prototype file."""
    path, _, name = text.rpartition(":")
    return Path(file.path).parent / path, name


class Simulations:
    """The simulations of one prototype, which all begin at `start_ns`. Raises `FileInvalid` for a Python model that fails.

    An FMU runs from the first step until `close`, or until it fails: then `on_failure` is called once with the name of the
    simulation and the error, and the simulation keeps the values of the step before.
    """

    def __init__(
        self,
        file: YamlFile,
        form: PrototypeForm,
        system: System,
        start_ns: int,
        on_failure: Callable[[str, FileInvalid], None],
    ) -> None:
        self._file, self._form, self._system = file, form, system
        self._on_failure = on_failure
        self._fmus: list[FmuProcess] = []
        self._made = {name: self._make(name, simulation, start_ns) for name, simulation in form.simulations.items()}

    def _make(self, name: str, form: SimulationForm, start_ns: int) -> Simulation:
        inputs = tuple(form.inputs)
        step: Step
        if form.fmu is not None:
            binding = bind_fmu(self._file, form, name)
            fmu = fmu_process(name, form, binding)
            self._fmus.append(fmu)
            step = self._until_failure(name, fmu)
            start = dict.fromkeys(binding.outputs, math.nan)  # the first step reads the outputs
        elif form.python is not None:
            step, start = by_model(PythonModel(*_python(self._file, form.python), form.start), inputs)
        else:
            step, start = by_formulas(form.formulas, form.start, inputs, f"{self._form.seed}:{name}")
        of_time = any(uses_time(text) for text in form.formulas.values())
        return Simulation(step, start, inputs, start_ns, round(form.step_ms * NS_PER_MS), of_time)

    def _until_failure(self, name: str, fmu: FmuProcess) -> Step:
        """Return the step of an FMU, which changes nothing from its first failure on.

        A failed initialization is raised: the devices would have no values.
        """

        def step(t_s: float, dt_s: float, values: Mapping[str, float]) -> Mapping[str, float]:
            if fmu.failure is not None and t_s > 0:
                return {}
            try:
                return fmu.step(t_s, dt_s, values)
            except FileInvalid as e:
                if dt_s <= 0:
                    raise
                self._on_failure(name, e)
                return {}

        return step

    def signals_of(self, device: str, form: EmulatedForm, profile: DeviceProfile) -> SimulatedSignals:
        """Return the signals that give `device` its values: those that its entry names, else every value of the simulation that
        has the name of a tag.
        """
        assert form.simulation is not None
        simulation = self._made[form.simulation]
        plays = form.plays or {n: n for n in simulation.names if n in profile.tags and not profile.tags[n].is_text}
        for tag, name in plays.items():
            if name not in simulation.names:
                raise self._file.error(
                    ("devices", device, "plays", tag),
                    f"no formula or step computes {name!r}",
                    expected=", ".join(simulation.names),
                )
        if not plays:
            raise self._file.error(
                ("devices", device, "simulation"),
                f"{form.simulation!r} computes no tag of {device}",
                expected="`plays: {TAG: NAME}`",
                got=", ".join(simulation.names),
            )
        if profile.sampled is not None:
            missing = [tag.name for tag in sampled_tags(profile, form.identity) if tag.name not in plays]
            if missing:
                raise self._file.error(
                    ("devices", device, "simulation"),
                    f"{form.simulation!r} does not compute every value that {device} samples",
                    expected=f"also {', '.join(missing)}",
                    got=", ".join(plays),
                )
        return SimulatedSignals(simulation, plays, self._file.path)

    def close(self) -> None:
        """End the processes of the FMUs."""
        for fmu in self._fmus:
            fmu.close()

    def connect(self, journals: Mapping[str, DeviceValueLog]) -> None:
        """Feed values that are written to devices into the simulations, from now on."""
        watchers: dict[tuple[str, str], list[Callable[[float, int], None]]] = {}
        for name, form in self._form.simulations.items():
            for input_name, text in form.inputs.items():
                device, _, tag = text.partition(".")
                watchers.setdefault((device, tag), []).append(_putter(self._made[name], input_name))
        for (device, tag_name), putters in watchers.items():
            if device in journals:
                held = self._system.devices[device].profile.tags[tag_name]
                journals[device].watch(tag_name, _to_all(held, putters))


def _putter(simulation: Simulation, name: str) -> Callable[[float, int], None]:
    return lambda value, now_ns: simulation.put(name, value, now_ns)


def _to_all(tag: Tag, putters: list[Callable[[float, int], None]]) -> Callable[[bytes, int], None]:
    def changed(raw: bytes, now_ns: int) -> None:
        value = number_of(tag, raw)
        for put in putters:
            put(value, now_ns)

    return changed
