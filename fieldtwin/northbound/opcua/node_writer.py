"""Adds nodes to the address space of an asyncua server, each with an explicit NodeId."""

from __future__ import annotations

from typing import Any

from asyncua import Server, ua

from fieldtwin.gateway.core.errors import Bug

DI_URI = "http://opcfoundation.org/UA/DI/"
PLC_URI = "http://PLCopen.org/OpcUa/IEC61131-3/"
PROPERTY_TYPE = ua.NodeId(ua.ObjectIds.PropertyType)
HAS_COMPONENT = ua.NodeId(ua.ObjectIds.HasComponent)
HAS_PROPERTY = ua.NodeId(ua.ObjectIds.HasProperty)
HAS_SUBTYPE = ua.NodeId(ua.ObjectIds.HasSubtype)
ORGANIZES = ua.NodeId(ua.ObjectIds.Organizes)
BASE_OBJECT = ua.NodeId(ua.ObjectIds.BaseObjectType)


class NodeWriter:
    """Adds nodes to `server`. `own`, `di` and `plc` are the indexes of the three namespaces."""

    def __init__(self, server: Server, own: int, di: int, plc: int) -> None:
        self.own = own
        self.di = di
        self.plc = plc
        self._session = server.iserver.isession

    @classmethod
    async def for_system(cls, server: Server, uri: str) -> NodeWriter:
        """Return a writer whose own namespace is `uri`. It has index 2 in every run, because it is registered first."""
        return cls(*(server, *[await server.register_namespace(each) for each in (uri, DI_URI, PLC_URI)]))

    def id(self, text: str) -> ua.NodeId:
        """Return the NodeId of a node of the system."""
        return ua.NodeId(text, self.own)

    async def object(
        self, parent: ua.NodeId, node: ua.NodeId, name: ua.QualifiedName, kind: ua.NodeId = BASE_OBJECT,
        reference: ua.NodeId = HAS_COMPONENT,
    ) -> ua.NodeId:  # fmt: skip
        """Add an object of the type `kind` below `parent`."""
        attributes = ua.ObjectAttributes(DisplayName=ua.LocalizedText(name.Name))
        return await self._add(parent, node, name, ua.NodeClass.Object, attributes, reference, kind)

    async def object_type(
        self, parent: ua.NodeId, node: ua.NodeId, name: ua.QualifiedName, *, abstract: bool = False
    ) -> ua.NodeId:
        """Add a subtype of an object type."""
        attributes = ua.ObjectTypeAttributes(DisplayName=ua.LocalizedText(name.Name), IsAbstract=abstract)
        return await self._add(parent, node, name, ua.NodeClass.ObjectType, attributes, HAS_SUBTYPE)

    async def reference_type(
        self, parent: ua.NodeId, node: ua.NodeId, name: ua.QualifiedName, inverse: str
    ) -> ua.NodeId:
        """Add a subtype of a reference type. `inverse` is the name of the inverse direction."""
        attributes = ua.ReferenceTypeAttributes(
            DisplayName=ua.LocalizedText(name.Name), InverseName=ua.LocalizedText(inverse)
        )
        return await self._add(parent, node, name, ua.NodeClass.ReferenceType, attributes, HAS_SUBTYPE)

    async def variable(
        self, parent: ua.NodeId, node: ua.NodeId, name: ua.QualifiedName, data_type: str,
        kind: int = ua.ObjectIds.BaseDataVariableType, reference: ua.NodeId = HAS_COMPONENT,
    ) -> ua.NodeId:  # fmt: skip
        """Add a read-only variable of the data type with this name. It has no value yet."""
        value = ua.Variant(None, ua.VariantType.Null)
        attributes = self._attributes(name, value, ua.NodeId(getattr(ua.ObjectIds, data_type)))
        return await self._add(parent, node, name, ua.NodeClass.Variable, attributes, reference, ua.NodeId(kind))

    async def property(self, owner: ua.NodeId, name: ua.QualifiedName, value: ua.Variant, data_type: str) -> ua.NodeId:
        """Add a read-only property with a value of the data type with this name."""
        attributes = self._attributes(name, value, ua.NodeId(getattr(ua.ObjectIds, data_type)))
        node = self.id(f"{owner.Identifier}/{name.Name}")
        return await self._add(owner, node, name, ua.NodeClass.Variable, attributes, HAS_PROPERTY, PROPERTY_TYPE)

    async def text(self, owner: ua.NodeId, name: ua.QualifiedName, text: str, data_type: str = "String") -> ua.NodeId:
        """Add a property with a text."""
        value: Any = ua.LocalizedText(text) if data_type == "LocalizedText" else text
        return await self.property(owner, name, ua.Variant(value, ua.VariantType[data_type]), data_type)

    async def refer(self, source: ua.NodeId, reference: ua.NodeId, target: ua.NodeId, target_class: int) -> None:
        """Add a reference between two nodes, in both directions."""
        for start, end, is_forward in ((source, target, True), (target, source, False)):
            item = ua.AddReferencesItem()
            item.SourceNodeId, item.TargetNodeId = start, end
            item.ReferenceTypeId, item.IsForward = reference, is_forward
            item.TargetNodeClass = ua.NodeClass(target_class) if is_forward else ua.NodeClass.Object
            for result in await self._session.add_references([item]):
                result.check()

    @staticmethod
    def _attributes(name: ua.QualifiedName, value: ua.Variant, data_type: ua.NodeId) -> ua.VariableAttributes:
        attributes = ua.VariableAttributes(DisplayName=ua.LocalizedText(name.Name), Value=value, DataType=data_type)
        attributes.AccessLevel = attributes.UserAccessLevel = ua.AccessLevel.CurrentRead.mask
        attributes.ValueRank = ua.ValueRank.OneDimension if isinstance(value.Value, list) else ua.ValueRank.Scalar
        return attributes

    async def _add(
        self, parent: ua.NodeId, node: ua.NodeId, name: ua.QualifiedName, node_class: ua.NodeClass, attributes: Any,
        reference: ua.NodeId, kind: ua.NodeId | None = None,
    ) -> ua.NodeId:  # fmt: skip
        item = ua.AddNodesItem()
        item.ParentNodeId, item.RequestedNewNodeId, item.BrowseName = parent, node, name
        item.NodeClass, item.NodeAttributes, item.ReferenceTypeId = node_class, attributes, reference
        if kind is not None:
            item.TypeDefinition = kind
        [result] = await self._session.add_nodes([item])
        if not result.StatusCode.is_good():
            raise Bug(f"cannot add the node {node.to_string()}: {result.StatusCode.name}")
        return node
