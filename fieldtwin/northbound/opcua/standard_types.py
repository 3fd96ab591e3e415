"""The types of OPC 10000-100 (Devices) and OPC 30000 (IEC 61131-3) that a system needs, with the NodeIds of their nodesets.

Only these types exist, without their optional members. So both namespaces are marked as subsets (OPC 10000-5, 6.3.13).
"""

from __future__ import annotations

from asyncua import ua

from fieldtwin.northbound.opcua.node_writer import BASE_OBJECT, DI_URI, HAS_COMPONENT, ORGANIZES, PLC_URI, NodeWriter

TOPOLOGY_ELEMENT, DEVICE, BLOCK, CONFIGURABLE, COMPONENT = 1001, 1002, 1003, 1004, 15063
DEVICE_SET = 5001
CONFIGURATION, RESOURCE, PROGRAM_UNIT, PROGRAM, TASK = 1001, 1002, 1003, 1004, 1006
HAS_INPUT_VARS, HAS_OUTPUT_VARS, HAS_LOCAL_VARS, WITH = 4001, 4002, 4004, 4006
FIELD_DEVICE = "FieldDeviceType"
"""The identifier of our subtype of DeviceType. DeviceType is abstract."""


async def add_standard_types(nodes: NodeWriter) -> None:
    """Add the types, and the DeviceSet below Objects."""
    di, plc = nodes.di, nodes.plc

    async def subtype(parent: ua.NodeId, number: int, index: int, name: str, *, abstract: bool = False) -> ua.NodeId:
        return await nodes.object_type(
            parent, ua.NodeId(number, index), ua.QualifiedName(name, index), abstract=abstract
        )

    element = await subtype(BASE_OBJECT, TOPOLOGY_ELEMENT, di, "TopologyElementType", abstract=True)
    await subtype(BASE_OBJECT, CONFIGURABLE, di, "ConfigurableObjectType")
    component = await subtype(element, COMPONENT, di, "ComponentType", abstract=True)
    device = await subtype(component, DEVICE, di, "DeviceType", abstract=True)
    block = await subtype(element, BLOCK, di, "BlockType", abstract=True)
    await nodes.object_type(device, nodes.id(FIELD_DEVICE), ua.QualifiedName(FIELD_DEVICE, nodes.own))
    await subtype(device, CONFIGURATION, plc, "CtrlConfigurationType")
    await subtype(device, RESOURCE, plc, "CtrlResourceType")
    unit = await subtype(block, PROGRAM_UNIT, plc, "CtrlProgramOrganizationUnitType", abstract=True)
    await subtype(unit, PROGRAM, plc, "CtrlProgramType")
    await subtype(BASE_OBJECT, TASK, plc, "CtrlTaskType")
    for number, name, inverse in (
        (HAS_INPUT_VARS, "HasInputVars", "InputVarsOf"),
        (HAS_OUTPUT_VARS, "HasOutputVars", "OutputVarsOf"),
        (HAS_LOCAL_VARS, "HasLocalVars", "LocalVarsOf"),
    ):
        await nodes.reference_type(HAS_COMPONENT, ua.NodeId(number, plc), ua.QualifiedName(name, plc), inverse)
    non_hierarchical = ua.NodeId(ua.ObjectIds.NonHierarchicalReferences)
    await nodes.reference_type(non_hierarchical, ua.NodeId(WITH, plc), ua.QualifiedName("With", plc), "Executes")
    await nodes.object(
        ua.NodeId(ua.ObjectIds.ObjectsFolder), ua.NodeId(DEVICE_SET, di), ua.QualifiedName("DeviceSet", di),
        reference=ORGANIZES,
    )  # fmt: skip
    for index, uri in ((di, DI_URI), (plc, PLC_URI)):
        await _describe_subset(nodes, index, uri)


async def _describe_subset(nodes: NodeWriter, index: int, uri: str) -> None:
    """Add the metadata of a namespace, which state that it is not complete."""
    described = await nodes.object(
        ua.NodeId(ua.ObjectIds.Server_Namespaces), nodes.id(f"/namespaces/{index}"), ua.QualifiedName(uri, index),
        ua.NodeId(ua.ObjectIds.NamespaceMetadataType),
    )  # fmt: skip
    await nodes.text(described, ua.QualifiedName("NamespaceUri"), uri)
    is_subset = ua.Variant(True, ua.VariantType.Boolean)
    await nodes.property(described, ua.QualifiedName("IsNamespaceSubset"), is_subset, "Boolean")
