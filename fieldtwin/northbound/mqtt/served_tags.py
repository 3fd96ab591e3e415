"""The tags that an MQTT server publishes: readable tags of devices that are not secret, published variables of programs, and the
states of alarms.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

from fieldtwin.gateway.core.errors import Bug
from fieldtwin.gateway.core.files.error_collector import ErrorCollector
from fieldtwin.gateway.core.image.layout import TagKind
from fieldtwin.gateway.runtime.alarms.alarm_list import ALARM
from fieldtwin.northbound.data_types import OF_KIND, data_type
from fieldtwin.twin.plant.physical import bound_programs
from fieldtwin.twin.site.system import System


@dataclass(frozen=True, slots=True)
class ServedTag:
    """One published tag.

    `name` is DEVICE.TAG, PROGRAM.VARIABLE or alarm.NAME. `device` is "" for the last two, and `data_type` a type of OPC 10000-6.
    """

    device: str
    owner: str
    """The device, the program, or ``alarm``."""
    local: str
    """The name of the tag within its owner."""
    source: str
    """The name of the tag in its region of the process image; of an alarm, its name."""
    data_type: str
    unit: str = ""
    limits: tuple[float, float] | None = None
    words: tuple[tuple[int, str], ...] = ()
    is_alarm: bool = False

    @property
    def name(self) -> str:
        """Return the name, which is unique in the system."""
        return f"{self.owner}.{self.local}"

    @property
    def is_text(self) -> bool:
        """Return whether the value is a text or bytes, which the process image does not hold."""
        return self.data_type in ("String", "ByteString")

    def word(self, value: object) -> str:
        """Return the name of a value in the profile, "" if it has none."""
        return dict(self.words).get(value, "") if isinstance(value, int) else ""


def served_tags(system: System) -> list[ServedTag]:
    """Return the tags of a system, devices first and alarms last, in the order of the system file."""
    alarms = [ServedTag("", ALARM, name, name, "String", is_alarm=True) for name in system.alarms]
    tags = [*_of_devices(system), *_of_programs(system), *alarms]
    if len({tag.name for tag in tags}) != len(tags):
        raise Bug("two published tags have the same name")
    return tags


def _of_devices(system: System) -> Iterator[ServedTag]:
    for device in system.devices.values():
        for tag in device.profile.tags.values():
            if tag.readable and not tag.secret:
                yield ServedTag(
                    device.name, device.name, tag.name, f"{device.name}.{tag.name}", data_type(tag),
                    tag.unit, tag.range, tag.values,
                )  # fmt: skip


def _of_programs(system: System) -> Iterator[ServedTag]:
    errors = ErrorCollector()
    programs = bound_programs(system, errors)
    errors.raise_all()
    for program in programs:
        owner = f"plc-{program.name}" if program.name in system.devices else program.name
        for variable, tag in program.published():
            if variable.kind is not TagKind.MESSAGE:
                yield ServedTag(
                    "", owner, variable.name, tag, OF_KIND[variable.kind],
                    variable.unit, variable.limits, tuple(variable.words),
                )  # fmt: skip
