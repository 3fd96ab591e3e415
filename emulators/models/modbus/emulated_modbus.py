"""Build an emulated Modbus device from a profile and the source of its values.

The source is a recording of exchanges, signals, initial values or a modem. This module must not depend on buses, files or clocks:
the caller passes the time at which the values begin.
"""

from __future__ import annotations

from collections.abc import Mapping, Sized
from dataclasses import dataclass

from fieldtwin.emulators.distortion import Distortions
from fieldtwin.emulators.emulator import EmulatedUnit
from fieldtwin.emulators.journal import DeviceValueLog
from fieldtwin.emulators.modbus.bank import RegisterBank
from fieldtwin.emulators.modbus.unit import UnitLimits
from fieldtwin.emulators.models.modbus.distorted_registers import DistortedRegisters
from fieldtwin.emulators.models.modbus.mailbox_modem import MailboxModem
from fieldtwin.emulators.models.modbus.recorded_device import RecordedDevice
from fieldtwin.emulators.models.modbus.register_device import ProfileRegisters, add_own_functions
from fieldtwin.emulators.models.modbus.sampled_sensor import SampledSensor
from fieldtwin.emulators.models.modbus.simulated_registers import SimulatedRegisters
from fieldtwin.emulators.replay.replay import ExchangeReplay
from fieldtwin.emulators.signals import Signals
from fieldtwin.emulators.stated import parts_of
from fieldtwin.gateway.core.connection import RS232Connection, TCPConnection
from fieldtwin.gateway.core.files.profile import DeviceProfile

ConnectionKind = type[RS232Connection] | type[TCPConnection]


@dataclass(frozen=True, slots=True)
class EmulatedModbus:
    """The unit of a device, the journal of the values that it held, by tag, and the value faults of its registers."""

    unit: EmulatedUnit | RecordedDevice
    journal: DeviceValueLog
    distortions: Distortions


def recorded_device(
    profile: DeviceProfile,
    kind: ConnectionKind,
    replay: ExchangeReplay,
    unit_id: int,
    identity: Mapping[str, str] | None = None,
    name: str = "",
) -> EmulatedModbus:
    """Return a device that replays the exchanges of unit `unit_id` of a recording. It changes `replay`.

    `identity` maps tags to values that replace the recorded ones.
    """
    unit = RecordedDevice(profile, replay, unit_id, kind, identity or {}, name)
    return EmulatedModbus(unit, unit.journal, unit.distortions)


def register_device(
    profile: DeviceProfile,
    kind: ConnectionKind,
    values: Mapping[str, float | str],
    now_ns: int,
    signals: Signals | None = None,
    name: str = "",
) -> EmulatedModbus:
    """Return a device whose registers are created from its profile; `values` are the initial values of its tags.

    `signals` are the values of a simulation, for the tags that it computes. Raises `FileInvalid` for a value that a tag cannot
    hold.
    """
    if signals is None:
        bank = ProfileRegisters(profile, values, now_ns)
    else:
        bank = SimulatedRegisters(profile, values, signals, now_ns)
    seen = DistortedRegisters(bank, bank.peek, profile, bank.journal)
    unit = _unit(profile, kind, seen, (), name)
    add_own_functions(unit, bank, profile)
    return EmulatedModbus(unit, bank.journal, seen.distortions)


def sampled_device(
    profile: DeviceProfile,
    kind: ConnectionKind,
    signals: Signals,
    identity: Mapping[str, str],
    name: str = "",
    period_s: int = 0,
) -> EmulatedModbus:
    """Return a sensor that samples `signals` and puts its samples into a queue for its client.

    `period_s` is its first sampling period in seconds; with 0 it waits for a client to write one.
    """
    bank = SampledSensor(profile, signals, identity, period_s)
    seen = DistortedRegisters(bank, bank.peek, profile, bank.journal, bank.own_tags, bank.distortions)
    return EmulatedModbus(_unit(profile, kind, seen, signals, name), bank.journal, bank.distortions)


def mailbox_device(profile: DeviceProfile, kind: ConnectionKind, modem: MailboxModem, name: str = "") -> EmulatedModbus:
    """Return the device whose registers are those of `modem`."""
    seen = DistortedRegisters(modem, modem.peek, profile, modem.journal)
    return EmulatedModbus(_unit(profile, kind, seen, (), name), modem.journal, seen.distortions)


def unit_limits(profile: DeviceProfile) -> UnitLimits:
    """Return the functions that the device accepts and the limits of its requests, as its profile states them."""
    limits = profile.form.limits
    functions = frozenset(limits.functions) if limits.functions is not None else UnitLimits().functions
    return UnitLimits(functions=functions, read_registers=limits.read_registers, even_only=limits.even_only)


def _unit(profile: DeviceProfile, kind: ConnectionKind, bank: RegisterBank, context: Sized, name: str) -> EmulatedUnit:
    return EmulatedUnit(bank, profile, kind, context, unit_limits(profile), name or profile.name, parts_of(profile))
