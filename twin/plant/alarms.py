"""The alarms of a system file, read and checked against the system."""

from __future__ import annotations

from collections.abc import Sequence

from fieldtwin.gateway.core.conditions.expression import Expression
from fieldtwin.gateway.core.conditions.located_expression import read_expression
from fieldtwin.gateway.core.files.error_collector import ErrorCollector
from fieldtwin.gateway.core.files.yaml_file import Key
from fieldtwin.gateway.core.image.layout import TagKind
from fieldtwin.gateway.runtime.alarms.alarm_list import ALARM, AlarmConfig
from fieldtwin.plc.binding import BoundProgram
from fieldtwin.twin.plant.names import incomplete_in, names_in
from fieldtwin.twin.site.system import System

_NOT_IN_ALARMS = {
    "age": "quality(TAG) == 'bad', which includes stale values",
    "updates": "a condition of values or qualities",
    "plc.late": "a condition of tags and variables",
    "command_pending": "a condition of tags and variables",
}
"""Functions and names that only scenarios know, each with the replacement for an alarm."""


def load_alarms(system: System, programs: Sequence[BoundProgram], errors: ErrorCollector) -> tuple[AlarmConfig, ...]:
    """Return the configuration of the alarms of a system with these programs.

    Errors are added to `errors`; the result contains the alarms without error.
    """
    if not system.alarms:
        return ()
    for section, names in (("devices", system.devices), ("plc", system.plc.programs)):
        if ALARM in names:
            loc: tuple[Key, ...] = (section, ALARM) if section == "devices" else (section, "programs", ALARM)
            message = f"the name {ALARM!r} is reserved in a system with alarms"
            errors.add(system.file.error(loc, message, expected="a different name", hint=f"{ALARM}.NAME is an alarm"))
    published = [pair for program in programs for pair in program.published()]
    words = {tag: dict(variable.words) for variable, tag in published if tag.endswith(".state")}
    found = []
    for name, form in system.alarms.items():
        with errors.collect():
            found.append(
                AlarmConfig(
                    name=name,
                    condition=_condition(system, programs, ("alarms", name, "condition"), form.condition),
                    priority=form.priority,
                    text=form.text,
                    on_delay_ms=form.on_delay_ms,
                    off_delay_ms=form.off_delay_ms,
                    acknowledge=form.acknowledge,
                    words=words,
                )
            )
    return tuple(found)


def _condition(system: System, programs: Sequence[BoundProgram], loc: tuple[Key, ...], text: str) -> Expression:
    file, names = system.file, names_in(system, programs)
    read = read_expression(file, loc, text, names, names, incomplete=incomplete_in(system, programs))
    if read.is_constant:
        raise file.error(loc, "the condition refers to no value", expected="a tag or a variable in it", got=text)
    for asked, instead in _NOT_IN_ALARMS.items():
        if asked in read.asks:
            raise file.error(loc, f"the condition of an alarm cannot contain {asked!r}", expected=instead, got=text)
    published = {tag: variable for program in programs for variable, tag in program.published()}
    for name in read.names:
        device, _, tag = name.partition(".")
        tags = system.devices[device].profile.tags if device in system.devices else {}
        if (tag in tags and not tags[tag].readable) or (name in published and published[name].kind is TagKind.MESSAGE):
            raise file.error(loc, f"{name!r} is never read as a value", expected="a tag that can be read", got=text)
    return read
