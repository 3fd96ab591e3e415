"""The OPC UA server: its address space, and the present samples as values of its variables.

A client's write goes to the gateway and changes no variable here. asyncua refuses every change of the address space, because no
client is an administrator.
"""

from __future__ import annotations

import errno
import logging
import socket
from collections.abc import Iterable
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any, NamedTuple

from asyncua import ua

from fieldtwin.__about__ import __version__
from fieldtwin.gateway.core.clock import Clock
from fieldtwin.gateway.core.errors import EndpointBusy, Unreachable, os_reason
from fieldtwin.gateway.core.values import Quality, Reason
from fieldtwin.gateway.runtime.gateway_status import AlarmEvent, ServerStatus
from fieldtwin.northbound.data_types import fitted
from fieldtwin.northbound.opcua.access.channels import checked_server
from fieldtwin.northbound.opcua.access.trust import load_identity
from fieldtwin.northbound.opcua.access.users import Account
from fieldtwin.northbound.opcua.address_space import Variables, build
from fieldtwin.northbound.opcua.alarms.conditions import Conditions
from fieldtwin.northbound.opcua.node_writer import NodeWriter
from fieldtwin.northbound.opcua.status_codes import BAD_CODES, StatusCode, status_code
from fieldtwin.northbound.opcua.tag_nodes import VALUE_AS_TEXT
from fieldtwin.northbound.opcua.writes import Call, TagWrites
from fieldtwin.northbound.samples import Sample
from fieldtwin.northbound.utc_times import UtcTimes
from fieldtwin.twin.site.servers.serving_opcua import OpcuaServeConfig, application_uri, url_of
from fieldtwin.twin.site.system import System

MAX_SUBSCRIPTIONS = 1000
MAX_QUEUE = 1000
"""The largest number of values that wait for a client for each monitored item; the oldest ones are dropped first."""
MAX_LOGGED = 1000
"""The largest number of messages of the library in the log of a run."""
_EPOCH = datetime(1970, 1, 1, tzinfo=UTC)


class OpcuaServer:
    """The server of one `serve` section. Call `build`, then `listen`; `aclose` ends it."""

    def __init__(
        self, config: OpcuaServeConfig, system: System, clock: Clock, call: Call, rejected: Path | None = None
    ) -> None:
        """Create the server.

        `call` calls a command of the gateway for a write of a client. `rejected` is the folder for the certificates of clients
        that are not trusted.
        """
        self.variables = Variables()
        self.updates = 0
        """Number of samples that were written to variables."""
        self.error = ""
        """The reason why the server does not listen; empty while it starts or listens."""
        self._config = config
        self._system = system
        self._clock = clock
        self._server = checked_server(config.security, clock, rejected)
        self._nodes: NodeWriter | None = None
        self._conditions: Conditions | None = None
        self._call = call
        self._writable: set[str] = set()
        self.writes = TagWrites(config.name, call, {}, ())
        self._listening = ""
        self._times = UtcTimes(clock)
        self._server_time: datetime | None = None
        """The time of the present look at the image, which is the ServerTimestamp of its samples."""
        self._ids: dict[str, ua.NodeId] = {}
        self._held: dict[str, _Held] = {}
        """The present sample of each tag that is not bad, by the name of its variable."""
        self._statuses: dict[StatusCode, ua.StatusCode] = {}
        logging.getLogger("asyncua").addFilter(_FirstMessages())

    async def build(self) -> None:
        """Create the address space. Until its first sample, each variable waits for initial data."""
        server = self._server
        server.iserver.bind_condition_methods = bool(self._system.alarms)
        await server.init()
        uri = application_uri(self._system.name, self._config.name)
        await server.set_application_uri(uri)
        server.set_server_name(f"fieldtwin {self._system.name}")
        server.set_endpoint(self._config.url)
        if self._config.security is None:
            server.set_security_policy([ua.SecurityPolicyType.NoSecurity])
        else:
            own = load_identity(self._config.security.certificate, self._config.security.key, uri)
            server.iserver.certificate, server.iserver.private_key = own.certificate, own.key
            server.set_security_policy(
                [ua.SecurityPolicyType.Basic256Sha256_SignAndEncrypt, ua.SecurityPolicyType.Basic256Sha256_Sign]
            )
        server.iserver.max_connections = self._config.clients
        server.iserver.max_subscriptions = MAX_SUBSCRIPTIONS
        server.iserver.max_monitored_item_queue_size = MAX_QUEUE
        await server.set_build_info(
            "urn:fieldtwin", "fieldtwin", "fieldtwin gateway", __version__, "", datetime.fromtimestamp(0, UTC)
        )
        self._nodes, self.variables = await build(server, self._system)
        self.writes = TagWrites(self._config.name, self._call, self.variables.data_types, self.variables.inputs)
        server.iserver.write_value = self._write_for_client
        if self._system.alarms:
            self._conditions = Conditions(self._nodes, server, self._config.name, self._system.alarms, self._call)
            await self._conditions.add_nodes()
            server.iserver.call_method = self._call_method
        waiting = Sample(None, Quality.BAD, Reason.NEVER_READ, 0)
        for name in self.variables.data_types:
            await self._write(name, waiting, None)

    async def listen(self) -> None:
        """Accept clients. Raises `EndpointBusy` or `Unreachable`; a later call tries again."""
        port = self._config.port
        try:
            self._probe(port)
            await self._server.start()
        except OSError as e:
            kind = EndpointBusy if e.errno == errno.EADDRINUSE else Unreachable
            raise kind(f"cannot listen: {os_reason(e)}", where=self._config.url) from e
        binary = self._server.bserver
        assert binary is not None
        self._listening = url_of(self._config.host, binary.port)
        self.error = ""

    def _probe(self, port: int) -> None:
        """Raise `OSError` if the port is taken. asyncua cannot be started a second time after it has failed."""
        family = socket.AF_INET6 if ":" in self._config.host else socket.AF_INET
        with socket.socket(family) as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            probe.bind((self._config.host, port))

    async def aclose(self) -> None:
        """Disconnect the clients."""
        if self._listening:
            self._listening = ""
            await self._server.stop()

    def status(self) -> ServerStatus:
        """Return where the server listens, its clients and its counters."""
        binary = self._server.bserver
        clients = [str(each.peer_name) for each in binary.clients] if binary is not None and self._listening else []
        return ServerStatus(
            listening=self._listening or None,
            error=self.error,
            counters={"updates": self.updates, **self.writes.counters},
            clients=clients,
            kind="opcua",
        )

    async def publish(self, names: dict[str, str], changes: Iterable[tuple[str, Sample]]) -> None:
        """Write samples to variables. `names` gives the variable of each tag."""
        self._times.follow()
        self._server_time = self._utc(self._clock.monotonic_ns())
        source_ns, source_time = 0, self._utc(0)
        for tag, sample in changes:
            if sample.source_ns != source_ns:  # the tags of a reply have the same time
                source_ns, source_time = sample.source_ns, self._utc(sample.source_ns)
            name = names[tag]
            held = self._held.get(name)
            if held is not None and held.content == sample[:3]:
                for data in held.shared:
                    data.SourceTimestamp = source_time
                    data.ServerTimestamp = self._server_time
            else:
                await self._write(name, sample, source_time)
            self.updates += 1

    async def publish_alarms(self, changes: list[AlarmEvent]) -> None:
        """Publish changes of alarms as events and as values of the conditions' variables."""
        assert self._conditions is not None
        self._times.follow()
        await self._conditions.publish(changes, self._utc, self._clock.monotonic_ns())

    async def _call_method(self, request: Any, account: Account | None, address: str) -> str:
        assert self._conditions is not None
        now = self._utc(self._clock.monotonic_ns())
        assert now is not None
        return await self._conditions.call(request, account, address, now)

    async def permit_writes(self, tags: Iterable[str]) -> None:
        """Give exactly these tags the access level for writes, and no tag if the server has no users."""
        wanted = set(tags) & set(self.variables.inputs) if self._config.security is not None else set()
        for name in wanted ^ self._writable:
            level = ua.AccessLevel.CurrentRead.mask
            if name in wanted:
                level |= ua.AccessLevel.CurrentWrite.mask
            value = ua.DataValue(ua.Variant(level, ua.VariantType.Byte))
            for attribute in (ua.AttributeIds.AccessLevel, ua.AttributeIds.UserAccessLevel):
                await self._server.iserver.write_attribute_value(self._id_of(name), value, attribute)
        self._writable = wanted

    async def _write_for_client(self, item: ua.WriteValue, account: Account | None, address: str) -> str:
        """Write a value for a client. Return the name of the status code."""
        if item.NodeId not in self._server.iserver.aspace:
            return "BadNodeIdUnknown"
        is_own = self._nodes is not None and item.NodeId.NamespaceIndex == self._nodes.own
        name = str(item.NodeId.Identifier) if is_own else item.NodeId.to_string()
        return await self.writes.write(item, name, account, address)

    async def _write(self, name: str, sample: Sample, source_time: datetime | None) -> None:
        """Set the variable of a tag, and those that show its value as a text or as the serial number of its device."""
        kind = self.variables.data_types[name]
        value = None if sample.value is None else fitted(sample.value, kind)
        status = status_code(sample.quality, sample.reason)
        if value is None and status.number < 0x8000_0000:  # the data type cannot hold the value
            status = BAD_CODES[Reason.OUT_OF_RANGE]
        shared = [await self._set(name, value, kind, status, source_time)]
        if name in self.variables.words:
            text = self.variables.words[name].get(int(value), "") if isinstance(value, int) else ""
            shown = ua.LocalizedText(text)
            shared.append(await self._set(f"{name}/{VALUE_AS_TEXT}", shown, "LocalizedText", status, source_time))
        if name in self.variables.serials and value is not None:
            serial = self.variables.serials[name]
            shared.append(await self._set(serial, str(value), "String", status, source_time))
        if value is None:
            self._held.pop(name, None)  # asyncua has stored a copy of a bad value
        else:
            self._held[name] = _Held(sample[:3], shared)

    async def _set(
        self, name: str, value: Any, kind: str, status: StatusCode, source_time: datetime | None
    ) -> _SharedValue:
        """Set the value of a variable. asyncua notifies clients if its value or status differs from the last one."""
        code = self._statuses.get(status)
        if code is None:
            code = self._statuses[status] = ua.StatusCode(status.number)
        data = _SharedValue(
            self._variant(value, kind), code, SourceTimestamp=source_time, ServerTimestamp=self._server_time
        )
        await self._server.write_attribute_value(self._id_of(name), data)
        return data

    def _id_of(self, name: str) -> ua.NodeId:
        assert self._nodes is not None
        node = self._ids.get(name)
        if node is None:
            node = self._ids[name] = self._nodes.id(name)
        return node

    @staticmethod
    def _variant(value: Any, kind: str) -> ua.Variant:
        return ua.Variant(value, ua.VariantType.Null if value is None else ua.VariantType[kind])

    def _utc(self, monotonic_ns: int) -> datetime | None:
        """Return a monotonic time as UTC, to the microsecond; None for 0, which stands for no time."""
        if not monotonic_ns:
            return None
        return _EPOCH + timedelta(microseconds=self._times.ns(monotonic_ns) // 1000)


@dataclass
class _SharedValue(ua.DataValue):  # type: ignore[misc]
    """A value of which only the times change after its creation.

    asyncua would copy each value for each monitored item, which takes 20 us. A new time of an equal value is set in place,
    because every poll brings a new time for all tags of a device, and a write costs 30 us for each monitored item.
    """

    def __deepcopy__(self, memo: object) -> _SharedValue:
        return self


class _Held(NamedTuple):
    """The present sample of a tag that is not bad: value, quality and reason, and the values of its variables."""

    content: tuple[Any, ...]
    shared: list[_SharedValue]


class _FirstMessages(logging.Filter):
    """Lets the first `MAX_LOGGED` messages pass, because a client can cause any number of them."""

    def __init__(self) -> None:
        super().__init__()
        self._passed = 0

    def filter(self, record: logging.LogRecord) -> bool:
        self._passed += 1
        return self._passed <= MAX_LOGGED
