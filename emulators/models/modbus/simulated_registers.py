"""A Modbus device with some registers that follow a simulation; all others behave as its profile states."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from fieldtwin.emulators.modbus.bank import Table
from fieldtwin.emulators.models.modbus.register_device import ProfileRegisters
from fieldtwin.emulators.signals import Signals
from fieldtwin.gateway.core.errors import FileInvalid
from fieldtwin.gateway.core.files.profile import DeviceProfile


class SimulatedRegisters(ProfileRegisters):
    """The registers of the device. `signals` gives the values of its tags in engineering units.

    A value that a client writes to one of these tags lasts until the next read. Raises `FileInvalid` for a signal that
    is not a tag of the device, or that is text.
    """

    def __init__(
        self, profile: DeviceProfile, values: Mapping[str, float | str], signals: Signals, now_ns: int
    ) -> None:
        for name in signals.names:
            if name not in profile.tags or profile.tags[name].is_text:
                expected = ", ".join(tag.name for tag in profile.tags.values() if not tag.is_text)
                raise FileInvalid(f"{profile.name} has no numeric tag {name!r}", path=signals.path, expected=expected)
        super().__init__(profile, values, now_ns)
        self._signals = signals
        self._played = [profile.tags[name] for name in signals.names]
        self._held: dict[str, float] = {}
        self._simulate(now_ns)

    def read(self, table: Table, address: int, count: int, now_ns: int) -> Sequence[int]:
        self._simulate(now_ns)
        return super().read(table, address, count, now_ns)

    def write(self, table: Table, address: int, values: Sequence[int], now_ns: int) -> None:
        super().write(table, address, values, now_ns)
        self._held.clear()  # overwritten values are set again at the next read

    def _simulate(self, now_ns: int) -> None:
        values = self._signals.values(now_ns)
        changed = [(tag, values[tag.name]) for tag in self._played if values[tag.name] != self._held.get(tag.name)]
        self._held.update({tag.name: value for tag, value in changed})
        self.set(changed, now_ns)
