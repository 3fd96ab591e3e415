"""The variables of an exported FMU: inputs set what devices hold, outputs are tags and the variables of programs."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Literal

import msgspec

from fieldtwin.emulators.faults.values.value_ranges import limits
from fieldtwin.gateway.core.errors import FileInvalid, UsageError
from fieldtwin.gateway.core.files.error_collector import ErrorCollector
from fieldtwin.gateway.core.files.nearest import did_you_mean
from fieldtwin.gateway.core.files.profile import Tag
from fieldtwin.gateway.core.image.layout import TagKind
from fieldtwin.plc.binding import BoundProgram
from fieldtwin.twin.plant.physical import bound_programs
from fieldtwin.twin.prototype.file import Prototype
from fieldtwin.twin.site.system import System

Kind = Literal["real", "integer", "boolean", "string"]
MAX_INPUTS = 1000
"""The largest number of inputs. One message with all of them takes 40 kB, which fits into the buffer of a pipe."""
MAX_OUTPUTS = 10_000
SHOWN = 5
"""The number of possible inputs that an error lists."""
_INTEGER = (-(1 << 31), (1 << 31) - 1)
"""The range of the type Integer of FMI 2.0."""


class FmuPort(msgspec.Struct, frozen=True):
    """A variable of the FMU, and the name (`source`) of what it sets or shows: a tag of the gateway, or if `of_plc` is set, a
    value that the PLC publishes.

    `start` is the value of an input that the tool has not set.
    """

    name: str
    source: str
    kind: Kind
    of_plc: bool = False
    unit: str = ""
    text: str = ""
    start: float = 0.0


class FmuInterface(msgspec.Struct, frozen=True):
    """The variables of an FMU. Each output has a second variable, `NAME.good`, which is false while its value is not good."""

    inputs: list[FmuPort]
    outputs: list[FmuPort]


def interface_of(system: System, prototype: Prototype, chosen: Sequence[str] = ()) -> FmuInterface:
    """Return the variables of the FMU of a prototype.

    `chosen` are the DEVICE.TAG that become inputs; without any, these are the numbers of emulated devices that programs read.
    Raises `UsageError` for a choice that a simulation tool cannot set, and `FileInvalid` for programs that cannot be created.
    """
    errors = ErrorCollector()
    programs = bound_programs(system, errors)
    errors.raise_all()
    settable = {
        name: tag for name, tag in _tags(system) if name.partition(".")[0] in prototype.devices and not tag.is_text
    }
    for name in chosen:
        if name not in settable:
            raise UsageError(
                f"--input {name}: no such number of an emulated device",
                expected=f"DEVICE.TAG, such as {', '.join(list(settable)[:SHOWN])}",
                hint=did_you_mean(name, settable),
            )
    names = dict.fromkeys(chosen or (name for name in _read_by(programs) if name in settable))
    inputs = [_input(name, settable[name]) for name in names]
    outputs = [_output(name, tag) for name, tag in _tags(system)]
    known = {port.name for port in outputs}
    outputs += [port for port in _variables(programs) if port.name not in known]
    if len(inputs) > MAX_INPUTS or len(outputs) > MAX_OUTPUTS:
        raise FileInvalid(
            "the system has too many values for an FMU",
            path=str(system.path),
            expected=f"at most {MAX_INPUTS} inputs and {MAX_OUTPUTS} outputs",
            got=f"{len(inputs)} and {len(outputs)}",
        )
    return FmuInterface(inputs, outputs)


def _tags(system: System) -> Iterator[tuple[str, Tag]]:
    for device in system.devices.values():
        for tag in device.profile.tags.values():
            if tag.readable and not tag.secret:
                yield f"{device.name}.{tag.name}", tag


def _read_by(programs: Sequence[BoundProgram]) -> list[str]:
    return [binding.tag for program in programs for binding in program.inputs.values()]


def _input(name: str, tag: Tag) -> FmuPort:
    low, high = limits(tag) or (0.0, 0.0)
    return FmuPort(
        f"set.{name}",
        name,
        _kind_of(tag),
        unit=tag.unit,
        text=f"the value that the device holds for {name}, once the tool has set it",
        start=min(max(0.0, low), high) if low < high else 0.0,
    )


def _output(name: str, tag: Tag) -> FmuPort:
    return FmuPort(name, name, _kind_of(tag), unit=tag.unit, text="the value that the gateway publishes")


def _variables(programs: Sequence[BoundProgram]) -> Iterator[FmuPort]:
    for program in programs:
        for variable, tag in program.published():
            if variable.kind is TagKind.MESSAGE:
                continue
            kind = _number_kind(variable.kind is TagKind.BOOL, variable.kind is TagKind.INT, variable.limits)
            name, text = f"{program.name}.{variable.name}", f"variable of the program {program.name}"
            if name != tag:
                text += f"; the gateway writes it to {tag}"
            yield FmuPort(name, tag, kind, True, variable.unit, text)


def _kind_of(tag: Tag) -> Kind:
    return "string" if tag.is_text else _number_kind(tag.is_bit, tag.is_integer, limits(tag))


def _number_kind(is_bit: bool, is_integer: bool, within: tuple[float, float] | None) -> Kind:
    """Return the type of FMI for a number. A whole number that may need more than 32 bits is a Real."""
    if is_bit:
        return "boolean"
    fits = within is not None and _INTEGER[0] <= within[0] and within[1] <= _INTEGER[1]
    return "integer" if is_integer and fits else "real"
