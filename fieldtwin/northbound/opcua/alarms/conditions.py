"""The conditions of a server: their nodes, their events, and the method Acknowledge (OPC 10000-9, 5.7.3)."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from datetime import datetime
from typing import Any

from asyncua import Server, ua

from fieldtwin.gateway.core.control import RemoteError
from fieldtwin.gateway.core.errors import FieldtwinError
from fieldtwin.gateway.runtime.gateway_status import AlarmEvent
from fieldtwin.northbound.opcua.access.users import Account
from fieldtwin.northbound.opcua.alarms.condition import ALARMS, Condition
from fieldtwin.northbound.opcua.node_writer import ORGANIZES, NodeWriter
from fieldtwin.northbound.opcua.writes import Call
from fieldtwin.twin.site.alarm_forms import AlarmForm

ACKNOWLEDGE = ua.NodeId(ua.ObjectIds.AcknowledgeableConditionType_Acknowledge)
MOST_COMMENT = 200
"""The largest number of characters of a comment."""
_SERVER = ua.NodeId(ua.ObjectIds.Server)


class Conditions:
    """The conditions of the alarms `forms`. `call` calls a command of the gateway; `server` is the name of the server."""

    def __init__(
        self, nodes: NodeWriter, server: Server, name: str, forms: Mapping[str, AlarmForm], call: Call
    ) -> None:
        self._nodes = nodes
        self._server = server
        self._name = name
        self._call = call
        self._conditions = {alarm: Condition(nodes, alarm, form) for alarm, form in forms.items()}
        self._by_node = {condition.node: condition for condition in self._conditions.values()}

    async def add_nodes(self) -> None:
        """Add the object Alarms with a condition for each alarm, and allow clients to subscribe to events of the server."""
        nodes, source = self._nodes, self._nodes.id(ALARMS)
        folder = ua.NodeId(ua.ObjectIds.ObjectsFolder)
        await nodes.object(folder, source, ua.QualifiedName("Alarms", nodes.own), reference=ORGANIZES)
        await nodes.refer(_SERVER, ua.NodeId(ua.ObjectIds.HasEventSource), source, ua.NodeClass.Object)
        notifier = ua.DataValue(ua.Variant(1 << ua.EventNotifier.SubscribeToEvents.value, ua.VariantType.Byte))
        await self._server.iserver.write_attribute_value(_SERVER, notifier, ua.AttributeIds.EventNotifier)
        for condition in self._conditions.values():
            await condition.add_nodes(nodes)

    async def publish(self, changes: list[AlarmEvent], utc: Callable[[int], datetime | None], now_ns: int) -> None:
        """Set the variables of the changed alarms, and send an event for each change. `utc` converts monotonic times."""
        now = utc(now_ns)
        assert now is not None
        for change in changes:
            condition = self._conditions[change.name]
            time = utc(change.t_ns) or now
            condition.take(change, time, now)
            for path, value in condition.values().items():
                data = ua.DataValue(value, SourceTimestamp=time, ServerTimestamp=now)
                await self._server.write_attribute_value(condition.id(self._nodes, path), data)
            await self._server.iserver.subscription_service.trigger_event(condition.event())

    async def call(self, request: Any, account: Account | None, address: str, now: datetime) -> str:
        """Carry out a method for a user at `address`. Return the name of the status code.

        The alarm changes when the gateway has reported its new state, not because of the request.
        """
        condition = self._by_node.get(request.ObjectId)
        if request.MethodId != ACKNOWLEDGE:
            return "BadMethodInvalid"
        if condition is None:
            return "BadNodeIdInvalid"
        if account is None or not account.may_write:
            return "BadUserAccessDenied"
        arguments = request.InputArguments or []
        if len(arguments) != 2:
            return "BadArgumentsMissing" if len(arguments) < 2 else "BadTooManyArguments"
        event_id, comment = (argument.Value for argument in arguments)
        if not isinstance(event_id, bytes) or not (comment is None or isinstance(comment, ua.LocalizedText)):
            return "BadInvalidArgument"
        if not condition.is_unacknowledged:
            return "BadConditionBranchAlreadyAcked"
        if event_id not in condition.events:
            return "BadEventIdUnknown"
        text = ((comment.Text if comment is not None else None) or "")[:MOST_COMMENT]
        by = f"opcua {self._name} {account.name} {address}"
        try:
            await self._call("acknowledge", alarm=condition.name, by=by, comment=text)
        except RemoteError:  # another user was faster
            return "BadConditionBranchAlreadyAcked"
        except FieldtwinError:
            return "BadNoCommunication"
        condition.comment, condition.user, condition.commented = text, account.name, now
        return "Good"
