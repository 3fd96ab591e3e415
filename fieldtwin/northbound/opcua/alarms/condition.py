"""One alarm as a condition of the type AlarmConditionType (OPC 10000-9, 5.8.2): its nodes, and the fields of its events.

    Objects / Alarms / NAME                ns=2;s=alarm.NAME
    Objects / Alarms / NAME / FIELD        ns=2;s=alarm.NAME/FIELD, such as ns=2;s=alarm.NAME/ActiveState/Id

The variables and the fields of an event have the same names and values.
"""

from __future__ import annotations

import uuid
from collections.abc import Mapping
from datetime import datetime
from typing import Any

from asyncua import ua
from asyncua.common import event_objects

from fieldtwin.gateway.runtime.alarms.alarm_list import ALARM
from fieldtwin.gateway.runtime.alarms.state_machine import AlarmState
from fieldtwin.gateway.runtime.gateway_status import AlarmEvent
from fieldtwin.northbound.alarm_changes import quality_of
from fieldtwin.northbound.opcua.node_writer import HAS_COMPONENT, HAS_PROPERTY, NodeWriter
from fieldtwin.northbound.opcua.status_codes import status_code
from fieldtwin.twin.site.alarm_forms import AlarmForm

ALARMS = "/alarms"
"""The identifier of the object that is the source of all conditions."""
SEVERITIES: Mapping[str, int] = {"low": 200, "medium": 500, "high": 700, "critical": 900}
"""The severity of each priority, 1 to 1000 (OPC 10000-5, 6.4.2)."""
_PROPERTY, _COMPONENT, _TWO_STATE, _CONDITION_VARIABLE = (
    int(ua.ObjectIds.PropertyType),
    int(ua.ObjectIds.BaseDataVariableType),
    int(ua.ObjectIds.TwoStateVariableType),
    int(ua.ObjectIds.ConditionVariableType),
)
FIELDS: Mapping[str, tuple[str, int]] = {
    "EventId": ("ByteString", _PROPERTY),
    "EventType": ("NodeId", _PROPERTY),
    "SourceNode": ("NodeId", _PROPERTY),
    "SourceName": ("String", _PROPERTY),
    "Time": ("UtcTime", _PROPERTY),
    "ReceiveTime": ("UtcTime", _PROPERTY),
    "Message": ("LocalizedText", _PROPERTY),
    "Severity": ("UInt16", _PROPERTY),
    "ConditionClassId": ("NodeId", _PROPERTY),
    "ConditionClassName": ("LocalizedText", _PROPERTY),
    "ConditionName": ("String", _PROPERTY),
    "BranchId": ("NodeId", _PROPERTY),
    "Retain": ("Boolean", _PROPERTY),
    "EnabledState": ("LocalizedText", _TWO_STATE),
    "EnabledState/Id": ("Boolean", _PROPERTY),
    "Quality": ("StatusCode", _CONDITION_VARIABLE),
    "Quality/SourceTimestamp": ("UtcTime", _PROPERTY),
    "LastSeverity": ("UInt16", _CONDITION_VARIABLE),
    "LastSeverity/SourceTimestamp": ("UtcTime", _PROPERTY),
    "Comment": ("LocalizedText", _CONDITION_VARIABLE),
    "Comment/SourceTimestamp": ("UtcTime", _PROPERTY),
    "ClientUserId": ("String", _PROPERTY),
    "AckedState": ("LocalizedText", _TWO_STATE),
    "AckedState/Id": ("Boolean", _PROPERTY),
    "ActiveState": ("LocalizedText", _TWO_STATE),
    "ActiveState/Id": ("Boolean", _PROPERTY),
    "InputNode": ("NodeId", _PROPERTY),
    "SuppressedOrShelved": ("Boolean", _PROPERTY),
    "OnDelay": ("Duration", _PROPERTY),
    "OffDelay": ("Duration", _PROPERTY),
}
"""The data type and the variable type of each mandatory field of the type, and of the two delays."""
_VARIANTS = {"UtcTime": ua.VariantType.DateTime, "Duration": ua.VariantType.Double}
_UNACKNOWLEDGED = (AlarmState.UNACKNOWLEDGED.value, AlarmState.RETURNED.value)


class Condition:
    """The condition of one alarm. `node` is its NodeId, which is the ConditionId."""

    def __init__(self, nodes: NodeWriter, name: str, form: AlarmForm) -> None:
        self.name = name
        self.node = nodes.id(f"{ALARM}.{name}")
        self.comment = ""
        self.user = ""
        """The user who has acknowledged the alarm last, with `comment`."""
        self.commented: datetime | None = None
        self.events: set[bytes] = set()
        """The EventIds with which a client may acknowledge the alarm: those since it became unacknowledged."""
        self.is_unacknowledged = False
        self._form = form
        self._source = nodes.id(ALARMS)
        self._fields: dict[str, Any] = {}

    async def add_nodes(self, nodes: NodeWriter) -> None:
        """Add the object and its variables below the source of all conditions. They have no values yet."""
        kind = ua.NodeId(ua.ObjectIds.AlarmConditionType)
        await nodes.object(self._source, self.node, ua.QualifiedName(self.name, nodes.own), kind)
        await nodes.refer(self._source, ua.NodeId(ua.ObjectIds.HasCondition), self.node, ua.NodeClass.Object)
        for path, (data_type, type_number) in FIELDS.items():
            owner, _, local = path.rpartition("/")
            reference = HAS_PROPERTY if type_number == _PROPERTY else HAS_COMPONENT
            await nodes.variable(
                self.id(nodes, owner) if owner else self.node,
                self.id(nodes, path),
                ua.QualifiedName(local),
                data_type,
                type_number,
                reference,
            )
        method = ua.NodeId(ua.ObjectIds.AcknowledgeableConditionType_Acknowledge)
        await nodes.refer(self.node, HAS_COMPONENT, method, ua.NodeClass.Method)

    def id(self, nodes: NodeWriter, path: str) -> ua.NodeId:
        """Return the NodeId of the variable of a field."""
        return nodes.id(f"{self.node.Identifier}/{path}")

    def take(self, change: AlarmEvent, time: datetime, now: datetime) -> None:
        """Take a change of the alarm, which was at `time`, with a new EventId."""
        self.is_unacknowledged = change.state in _UNACKNOWLEDGED
        event_id = uuid.uuid4().bytes
        self.events = self.events | {event_id} if self.is_unacknowledged else set()
        quality, reason = quality_of(change)
        severity = SEVERITIES[self._form.priority]
        self._fields = {
            "EventId": event_id,
            "EventType": ua.NodeId(ua.ObjectIds.AlarmConditionType),
            "SourceNode": self._source,
            "SourceName": "Alarms",
            "Time": time,
            "ReceiveTime": now,
            "Message": ua.LocalizedText(self._form.text or self.name),
            "Severity": severity,
            "ConditionClassId": ua.NodeId(ua.ObjectIds.ProcessConditionClassType),
            "ConditionClassName": ua.LocalizedText("ProcessConditionClassType"),
            "ConditionName": self.name,
            "BranchId": ua.NodeId(),
            # a client must also see after a refresh that the state of an alarm is not known
            "Retain": change.state != AlarmState.NORMAL.value or change.quality == "bad",
            "EnabledState": ua.LocalizedText("Enabled"),
            "EnabledState/Id": True,
            "Quality": ua.StatusCode(status_code(quality, reason).number),
            "Quality/SourceTimestamp": time,
            "LastSeverity": severity,
            "LastSeverity/SourceTimestamp": time,
            "Comment": ua.LocalizedText(self.comment),
            "Comment/SourceTimestamp": self.commented or time,
            "ClientUserId": self.user,
            "AckedState": ua.LocalizedText("Unacknowledged" if self.is_unacknowledged else "Acknowledged"),
            "AckedState/Id": not self.is_unacknowledged,
            "ActiveState": ua.LocalizedText("Active" if change.active else "Inactive"),
            "ActiveState/Id": change.active,
            "InputNode": ua.NodeId(),
            "SuppressedOrShelved": change.state == AlarmState.SHELVED.value,
            "OnDelay": float(self._form.on_delay_ms),
            "OffDelay": float(self._form.off_delay_ms),
        }

    def values(self) -> dict[str, ua.Variant]:
        """Return the present value of each field."""
        return {path: ua.Variant(value, _variant_type(path)) for path, value in self._fields.items()}

    def event(self) -> event_objects.AlarmCondition:
        """Return an event with the present fields. Its field NodeId is the ConditionId."""
        event = event_objects.AlarmCondition()
        for path, value in self._fields.items():
            event.add_property(path, value, _variant_type(path))
        event.add_property("NodeId", self.node, ua.VariantType.NodeId)
        event.emitting_node = ua.NodeId(ua.ObjectIds.Server)
        return event


def _variant_type(path: str) -> ua.VariantType:
    data_type = FIELDS[path][0]
    return _VARIANTS[data_type] if data_type in _VARIANTS else ua.VariantType[data_type]
