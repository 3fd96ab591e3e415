"""Findings about the bindings of a system's programs, each at its place in the system file."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

from fieldtwin.plc.st.dialects import StWarning

if TYPE_CHECKING:
    from fieldtwin.twin.site.system import System


def findings_about_bindings(system: System) -> Iterator[StWarning]:
    """Yield the findings about the tags to which programs in Structured Text are bound, and about tags that no program writes.

    Programs with errors are left out; loading the system reports these.
    """
    from fieldtwin.gateway.core.files.error_collector import ErrorCollector
    from fieldtwin.plc.program import Role
    from fieldtwin.plc.st.findings.bindings import binding_findings
    from fieldtwin.plc.st.program import StProgram
    from fieldtwin.twin.plant.physical import bound_programs, plant_tags

    plant, errors = plant_tags(system), ErrorCollector()
    for bound in bound_programs(system, errors):
        if not isinstance(bound.program, StProgram):
            continue
        inputs = {name: binding.tag for name, binding in bound.inputs.items()}
        for id, role, name, message in binding_findings(bound.program, inputs, bound.outputs, plant):
            key = "inputs" if role is Role.INPUT else "outputs"
            yield _at(system, ("plc", "programs", bound.name, key, name), id, message)
    yield from _never_written(system)


def _never_written(system: System) -> Iterator[StWarning]:
    """Yield a finding for each tag in `writable` that nothing in the system file writes.

    Clients of other servers than Modbus, a bridge and the digital twin may write every such tag, so with one of them nothing is
    reported. A mailbox is written by the gateway itself.
    """
    serving = system.serving
    if serving.separate or serving.bridges or system.remote == "remote" or not system.plc.programs:
        return
    written = {tag for form in system.plc.programs.values() for tag in form.outputs.values()}
    written |= {tag.tag for server in serving.serve for tag in server.tags if tag.write}
    for device in system.devices.values():
        for local in sorted(device.writable) if device.profile.inbox is None else ():
            if f"{device.name}.{local}" not in written:
                message = f"{device.name}.{local} is in `writable`, and no program and no server writes it"
                yield _at(system, ("devices", device.name, "writable"), "ST114", message)


def _at(system: System, loc: tuple[str, ...], id: str, message: str) -> StWarning:
    place = system.file.error(loc, message)
    return StWarning(id, message, place.path or str(system.path), place.line or 1, place.column or 1)
