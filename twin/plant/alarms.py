"""The alarms of a system file, read and checked against the system."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import islice

from fieldtwin.gateway.core.conditions.expression import Expression, names_in_text
from fieldtwin.gateway.core.conditions.located_expression import read_expression
from fieldtwin.gateway.core.files.error_collector import ErrorCollector
from fieldtwin.gateway.core.files.yaml_file import Key
from fieldtwin.gateway.core.image.layout import TagKind
from fieldtwin.gateway.runtime.alarms.alarm_list import ALARM, AlarmConfig
from fieldtwin.plc.binding import BoundProgram
from fieldtwin.plc.program import Program
from fieldtwin.twin.plant.names import incomplete_in, members_in, members_in_alarms, names_in
from fieldtwin.twin.site.system import System

_NOT_IN_ALARMS = {
    "age": "quality(TAG) == 'bad', which includes stale values",
    "updates": "a condition of values or qualities",
    "plc.late": "a condition of tags and variables",
    "command_pending": "a condition of tags and variables",
}
"""Functions and names that only scenarios know, each with the replacement for an alarm."""
MOST_SHOWN = 8
"""The largest number of members in an error."""
MOST_NEAR = 10_000
"""The largest number of variables of a program among which the one that is similar to an unknown name is looked for."""


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
    of_members = {f"{program}.{path}" for program, paths in members_in_alarms(system).items() for path in paths}
    words = {
        tag: dict(variable.words) for variable, tag in published if tag.endswith(".state") and tag not in of_members
    }
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
    published = {tag: variable for program in programs for variable, tag in program.published()}
    near: list[str] = []
    members = {f"{program}.{path}" for program, path in members_in(system, text)}
    for name in names_in_text(text):
        variable = published.get(name)
        bound = next((one for one in programs if name.startswith(f"{one.name}.")), None)
        if variable is not None and (name in members or (variable.words and not name.endswith(".state"))):
            names[name] = {word: number for number, word in variable.words}
        elif bound is not None and name not in names:
            near += [f"{bound.name}.{one}" for one in _refuse_parts(system, loc, text, name, bound.program)]
    incomplete = incomplete_in(system, programs)
    read = read_expression(file, loc, text, names, names, incomplete=incomplete, near=near)
    if read.is_constant:
        raise file.error(loc, "the condition refers to no value", expected="a tag or a variable in it", got=text)
    for asked, instead in _NOT_IN_ALARMS.items():
        if asked in read.asks:
            raise file.error(loc, f"the condition of an alarm cannot contain {asked!r}", expected=instead, got=text)
    for name in read.names:
        device, _, tag = name.partition(".")
        tags = system.devices[device].profile.tags if device in system.devices else {}
        if (tag in tags and not tags[tag].readable) or (name in published and published[name].kind is TagKind.MESSAGE):
            raise file.error(loc, f"{name!r} is never read as a value", expected="a tag that can be read", got=text)
    return read


def _refuse_parts(system: System, loc: tuple[Key, ...], text: str, name: str, program: Program) -> list[str]:
    """Raise an error for the name of a variable that exists and has no single value.

    Return the variables of the program without tags, for a suggestion in the error for an unknown name.
    """
    path, of = name.partition(".")[2], name.partition(".")[0]
    known = list(islice(program.internal_names(), MOST_NEAR))
    found, array = program.internal(path), path.rpartition("[")[0]
    if found is not None and path in known:
        expected = "a BOOL, a number, a time or an enumeration"
        raise system.file.error(loc, f"{name!r} is of the type {found.type}", expected=expected, got=text)
    if found is None and array in known and (of_array := program.internal(array)) is not None:
        expected = f"an element of {of}.{array}, which is an {of_array.type}"
        raise system.file.error(loc, f"there is no {name!r}", expected=expected, got=text)
    inside = [one for one in known if one.startswith((f"{path}.", f"{path}["))]
    if inside:
        members = ", ".join(f"{of}.{one}" for one in inside[:MOST_SHOWN])
        raise system.file.error(loc, f"{name!r} has members", expected=f"one of them, such as {members}", got=text)
    return known
