"""The address space of a system: devices by OPC 10000-100, the PLC by OPC 30000, and a variable for every tag.

    DeviceSet / DEVICE / ParameterSet / TAG                                     ns=2;s=DEVICE.TAG
    DeviceSet / PLC / Resources / Resource / Programs / PROGRAM / VARIABLE      ns=2;s=PROGRAM.VARIABLE

The NodeIds depend on the names in the system file only, so that they stay the same in every run.
"""

from __future__ import annotations

import asyncio
from dataclasses import dataclass, field

from asyncua import Server, ua

from fieldtwin.__about__ import __version__
from fieldtwin.gateway.core.errors import Bug
from fieldtwin.gateway.core.files.error_collector import ErrorCollector
from fieldtwin.gateway.core.image.layout import TagKind
from fieldtwin.gateway.devices.config import DeviceConfig
from fieldtwin.northbound.data_types import OF_KIND, data_type
from fieldtwin.northbound.opcua import standard_types as types
from fieldtwin.northbound.opcua.node_writer import NodeWriter
from fieldtwin.northbound.opcua.tag_nodes import add_tag
from fieldtwin.plc.binding import BoundProgram
from fieldtwin.plc.program import Role
from fieldtwin.twin.plant.physical import bound_programs, fastest_ms
from fieldtwin.twin.site.system import System

SERIAL_TAGS = ("serial", "serial_number")
"""The names of tags that hold a device's serial number."""
_REFERENCES = {Role.OUTPUT: types.HAS_OUTPUT_VARS, Role.LOCAL: types.HAS_LOCAL_VARS}


@dataclass
class Variables:
    """The variables of an address space, by the string identifiers of their NodeIds."""

    data_types: dict[str, str] = field(default_factory=dict)
    words: dict[str, dict[int, str]] = field(default_factory=dict)
    """The names of values of each variable with a property `ValueAsText`."""
    serials: dict[str, str] = field(default_factory=dict)
    """The identifier of the property `SerialNumber` of each variable that holds a serial number."""
    inputs: dict[str, str] = field(default_factory=dict)
    """The variable of each tag of the region INPUTS of the process image."""
    outputs: dict[str, str] = field(default_factory=dict)
    """The variable of each tag of the region OUTPUTS."""
    texts: list[str] = field(default_factory=list)
    """The variables of texts, which the process image does not hold."""


async def build(server: Server, system: System) -> tuple[NodeWriter, Variables]:
    """Create the address space. Return the writer, which knows the namespaces, and the variables."""
    nodes = await NodeWriter.for_system(server, f"urn:fieldtwin:{system.name}")
    await types.add_standard_types(nodes)
    found = Variables()
    for device in system.devices.values():
        await _add_device(nodes, device, found)
        await asyncio.sleep(0)  # a large system takes seconds, in which the process continues to report its status
    errors = ErrorCollector()
    programs = bound_programs(system, errors)
    errors.raise_all()
    await _add_plc(nodes, system, programs, found)
    if len(found.data_types) != len(found.inputs) + len(found.outputs) + len(found.texts):
        raise Bug("two variables of the OPC UA server have the same identifier")
    return nodes, found


async def _add_device(nodes: NodeWriter, device: DeviceConfig, found: Variables) -> None:
    profile = device.profile
    vendor, _, model = profile.name.partition("/")
    node = nodes.id(device.name)
    kind = nodes.id(types.FIELD_DEVICE)
    await nodes.object(_device_set(nodes), node, ua.QualifiedName(device.name, nodes.own), kind)
    known = profile.form.identification
    await _add_nameplate(nodes, node, known.get(0, vendor), known.get(1, model), known.get(2, ""))
    parameters = await _group(nodes, node, "ParameterSet", nodes.di)
    for tag in profile.tags.values():
        if not tag.readable or tag.secret:
            continue
        name = f"{device.name}.{tag.name}"
        found.data_types[name] = data_type(tag)
        if await add_tag(
            nodes, parameters, name, tag.name, data_type(tag), unit=tag.unit, limits=tag.range, words=tag.values
        ):
            found.words[name] = dict(tag.values)
        if tag.name in SERIAL_TAGS:
            found.serials[name] = f"{device.name}/SerialNumber"
        if tag.is_text:
            found.texts.append(name)
        else:
            found.inputs[name] = name


async def _add_nameplate(nodes: NodeWriter, device: ua.NodeId, vendor: str, model: str, revision: str) -> None:
    """Add the mandatory properties of a DeviceType. A text that is not known is empty (OPC 10000-100, 4.5.2)."""
    for name, text, kind in (
        ("Manufacturer", vendor, "LocalizedText"),
        ("Model", model, "LocalizedText"),
        ("SerialNumber", "", "String"),
        ("HardwareRevision", "", "String"),
        ("SoftwareRevision", revision, "String"),
        ("DeviceRevision", "", "String"),
        ("DeviceManual", "", "String"),
    ):
        await nodes.text(device, ua.QualifiedName(name, nodes.di), text, kind)
    unknown = ua.Variant(-1, ua.VariantType.Int32)
    await nodes.property(device, ua.QualifiedName("RevisionCounter", nodes.di), unknown, "Int32")


async def _add_plc(nodes: NodeWriter, system: System, programs: list[BoundProgram], found: Variables) -> None:
    """Add the configuration with its one resource, the tasks and the programs (OPC 30000, 5)."""
    plc = nodes.id("/plc")
    kinds = {number: ua.NodeId(number, nodes.plc) for number in (types.CONFIGURATION, types.RESOURCE)}
    name = ua.QualifiedName("PLC", nodes.own)
    await nodes.object(_device_set(nodes), plc, name, kinds[types.CONFIGURATION])
    await _add_nameplate(nodes, plc, "fieldtwin", "soft PLC", __version__)
    resources = await _configurable(nodes, plc, "Resources")
    resource = nodes.id("/plc/Resource")
    await nodes.object(resources, resource, ua.QualifiedName("Resource", nodes.own), kinds[types.RESOURCE])
    await _add_nameplate(nodes, resource, "fieldtwin", "soft PLC", __version__)
    tasks = await _add_tasks(nodes, system, await _configurable(nodes, resource, "Tasks"))
    below = await _configurable(nodes, resource, "Programs")
    for program in programs:
        node = nodes.id(f"/plc/program/{program.name}")
        kind = ua.NodeId(types.PROGRAM, nodes.plc)
        await nodes.object(below, node, ua.QualifiedName(program.name, nodes.own), kind)
        task = tasks[system.plc.programs[program.name].task or next(iter(tasks))]
        await nodes.refer(node, ua.NodeId(types.WITH, nodes.plc), task, ua.NodeClass.Object)
        await _add_variables(nodes, system, program, node, found)


async def _add_tasks(nodes: NodeWriter, system: System, below: ua.NodeId) -> dict[str, ua.NodeId]:
    """Add the tasks with interval and priority, and return their nodes by name."""
    forms = system.plc.tasks
    stated = {name: (form.interval_ms, form.priority, form.single or "") for name, form in forms.items()}
    found = {}
    for name, (interval_ms, priority, single) in (stated or {"main": (fastest_ms(system), 0, "")}).items():
        node = found[name] = nodes.id(f"/plc/task/{name}")
        kind = ua.NodeId(types.TASK, nodes.plc)
        await nodes.object(below, node, ua.QualifiedName(name, nodes.own), kind)
        number = ua.Variant(priority, ua.VariantType.UInt32)
        await nodes.property(node, ua.QualifiedName("Priority", nodes.plc), number, "UInt32")
        interval = f"T#{interval_ms}ms" if interval_ms else ""
        await nodes.text(node, ua.QualifiedName("Interval", nodes.plc), interval)
        await nodes.text(node, ua.QualifiedName("Single", nodes.plc), single)
    return found


async def _add_variables(
    nodes: NodeWriter, system: System, program: BoundProgram, node: ua.NodeId, found: Variables
) -> None:
    """Add outputs and locals, with the values that the PLC publishes, and refer to the tags of the inputs."""
    prefix = f"/plc/{program.name}" if program.name in system.devices else program.name
    for variable, tag in program.published():
        if variable.kind is TagKind.MESSAGE:
            continue
        identifier, kind = f"{prefix}.{variable.name}", OF_KIND[variable.kind]
        found.data_types[identifier] = kind
        found.outputs[tag] = identifier
        reference = ua.NodeId(_REFERENCES[variable.role], nodes.plc)
        if await add_tag(
            nodes, node, identifier, variable.name, kind,
            unit=variable.unit, limits=variable.limits, words=variable.words, reference=reference,
        ):  # fmt: skip
            found.words[identifier] = dict(variable.words)
    for binding in program.inputs.values():
        if binding.tag in found.inputs:  # not an input that another program publishes, or a message
            reference = ua.NodeId(types.HAS_INPUT_VARS, nodes.plc)
            await nodes.refer(node, reference, nodes.id(found.inputs[binding.tag]), ua.NodeClass.Variable)


def _device_set(nodes: NodeWriter) -> ua.NodeId:
    return ua.NodeId(types.DEVICE_SET, nodes.di)


async def _group(nodes: NodeWriter, parent: ua.NodeId, name: str, index: int) -> ua.NodeId:
    return await nodes.object(parent, nodes.id(f"{parent.Identifier}/{name}"), ua.QualifiedName(name, index))


async def _configurable(nodes: NodeWriter, parent: ua.NodeId, name: str) -> ua.NodeId:
    kind = ua.NodeId(types.CONFIGURABLE, nodes.di)
    return await nodes.object(parent, nodes.id(f"{parent.Identifier}/{name}"), ua.QualifiedName(name, nodes.plc), kind)
