"""Initialize a fork with the known state: programs continue from their variables, devices from their values."""

from __future__ import annotations

import shutil
from collections.abc import Mapping
from pathlib import Path

from fieldtwin.emulators.models.modbus.distorted_registers import DistortedRegisters
from fieldtwin.emulators.models.modbus.register_device import ProfileRegisters
from fieldtwin.gateway.core.errors import FileInvalid, UsageError
from fieldtwin.gateway.core.statemachine import encode_period
from fieldtwin.run.what_if.state import KnownState, Number
from fieldtwin.twin.prototype.virtual import VirtualPrototype


def retain_for(state: KnownState, run_dir: Path) -> None:
    """Copy retained variables to the file from which the fork's PLC reads them."""
    if state.retained is not None:
        shutil.copyfile(state.retained, run_dir / "retain")


def begin(run: VirtualPrototype, state: KnownState) -> list[str]:
    """Initialize `run`, for `VirtualPrototype(prepare=...)`. Return the devices whose known values could not be
    applied.

    A recording is searched for its nearest row, a simulation by formulas continues from the values, and registers take
    them. A device with internal state (a drive's motor, a model in Python) starts as usual. The gateway writes the
    outputs of the programs again. If a program has a known period that is not one of its variables, the period is
    sent as a command. Raises `FileInvalid` for a variable that cannot hold its value.
    """
    for bound in run.plc.programs:
        known = state.programs.get(bound.name)
        if known:
            try:
                bound.program.resume(known)
            except UsageError as e:
                raise FileInvalid(
                    f"{bound.name}: {e.message}", path=state.source, expected=e.expected, got=e.got
                ) from e
            if "period" in known and "period" not in bound.program.variables:
                _command(run, known["period"])
    by_device: dict[str, dict[str, Number]] = {}
    for name, value in state.values.items():
        device, _, tag = name.partition(".")
        by_device.setdefault(device, {})[tag] = value
    return [device for device, values in by_device.items() if not _begin_device(run, device, values)]


def _command(run: VirtualPrototype, period_s: Number) -> None:
    """Inject a command with this sample period, as if the only transmitter had received it. Without one, do nothing."""
    if len(run.gateway.pumps) == 1 and isinstance(period_s, int):
        run.gateway.pumps[0].command(encode_period(period_s).data, "what is known")


def not_restored(run: VirtualPrototype, state: KnownState) -> list[str]:
    """Return the programs that have started and whose state is not the known one."""
    waiting = {f"{start.name}.state" for start in run.plc.starts.waiting}
    outputs = {tag: value for tag, value in run.plc.outputs.last().items() if tag not in waiting}
    known = {name: variables["state"] for name, variables in state.programs.items() if "state" in variables}
    return [name for name, is_so in known.items() if outputs.get(f"{name}.state", is_so) != is_so]


def _begin_device(run: VirtualPrototype, name: str, values: Mapping[str, Number]) -> bool:
    now_ns = run.clock.monotonic_ns()
    device = run.field.devices.get(name)
    if device is None:
        return False
    taken = False
    bank = device.unit.bank if device.unit is not None and hasattr(device.unit, "bank") else None
    if isinstance(bank, DistortedRegisters):
        bank = bank.bank
    if isinstance(bank, ProfileRegisters):
        tags = device.emulated.profile.tags
        sets = [(tags[tag], float(v)) for tag, v in values.items() if not tags[tag].is_text and not isinstance(v, str)]
        bank.set(sets, now_ns)
        taken = bool(sets)
    signals = run.field.signals.get(name)
    if signals is not None:
        numbers = {tag: float(v) for tag, v in values.items() if not isinstance(v, str) and tag in signals.names}
        if numbers:  # the signals determine these registers from now on
            taken = signals.begin_with(numbers, now_ns)
    return taken
