"""The connections of an OPC UA server, with the checks of secure channels that asyncua lacks.

asyncua 2.1 opens a channel without security although no endpoint offers one, does not compare the certificate of a channel with
the trusted ones, and lets any channel continue the session of a different client, whose token can be guessed. This module
refuses all of that, and closes a connection after a message that is not authentic (OPC 10000-6, 6.7.6).
"""

from __future__ import annotations

import asyncio
import logging
from collections import OrderedDict
from collections.abc import Callable
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import Any

from asyncua import Server, ua
from asyncua.common.utils import ServiceError
from asyncua.crypto.security_policies import SecurityPolicyFactory, SecurityPolicyNone
from asyncua.server.binary_server_asyncio import BinaryServer, OPCUAProtocol
from asyncua.server.internal_session import SessionState
from asyncua.server.uaprocessor import UaProcessor
from asyncua.ua.ua_binary import struct_from_binary, uatcp_to_binary
from cryptography.x509 import Certificate

from fieldtwin.gateway.core.clock import NS_PER_S, Clock
from fieldtwin.northbound.opcua.access.sessions import Session, SessionServer
from fieldtwin.northbound.opcua.access.trust import NotTrusted, TrustedFolder, uris_of
from fieldtwin.northbound.opcua.access.users import Users
from fieldtwin.twin.site.servers.serving_opcua import OpcuaSecurity

CheckCertificate = Callable[[bytes], bytes]
"""Returns a client's certificate from what the client has sent; raises `NotTrusted`."""
MOST_FAILURES = 10
"""The number of failed log-ins from one address after which the address has to wait."""
FORGET_FAILURES_NS = 60 * NS_PER_S
MOST_WRITES = 8
"""The number of requests to write, of all clients together, that may be in flight at a time."""
MOST_VALUES = 100
"""The number of values in one request to write."""
MOST_ADDRESSES = 1000
"""The number of addresses whose failed log-ins are remembered."""
_log = logging.getLogger(__name__)


def _requests(*names: str) -> frozenset[Any]:
    return frozenset(ua.NodeId(getattr(ua.ObjectIds, f"{name}Request_Encoding_DefaultBinary")) for name in names)


_DISCOVERY = _requests("GetEndpoints", "FindServers", "CloseSecureChannel")
"""The requests that a channel without security may send to every server (OPC 10000-4, 5.4.1)."""
_REGISTRATION = _requests("RegisterServer", "RegisterServer2")
[_CREATE] = _requests("CreateSession")
[_WRITE] = _requests("Write")
[_ACTIVATE] = _requests("ActivateSession")


def checked_server(security: OpcuaSecurity | None, clock: Clock, rejected: Path | None) -> ChannelServer:
    """Return a server that admits the trusted clients and the users of `security`; None: anonymous users without security.

    The files are read again for each channel and each session. `rejected` is the folder for refused certificates.
    """
    if security is None:
        return ChannelServer(SessionServer(None), clock, None)
    folder = TrustedFolder(security.trusted, rejected)

    def check(sent: bytes) -> bytes:
        return folder.check(sent, datetime.fromtimestamp(clock.utc_ns() / NS_PER_S, UTC))

    return ChannelServer(SessionServer(partial(Users.load, security.users)), clock, check)


class LoginFailures:
    """The failed log-ins of each address in the last minute."""

    def __init__(self, clock: Clock) -> None:
        self._clock = clock
        self._failures: OrderedDict[str, list[int]] = OrderedDict()

    def note(self, address: str) -> None:
        self._failures.setdefault(address, []).append(self._clock.monotonic_ns())
        while len(self._failures) > MOST_ADDRESSES:
            self._failures.popitem(last=False)

    def must_wait(self, address: str) -> bool:
        """Return whether the address has to wait before the next attempt."""
        since_ns = self._clock.monotonic_ns() - FORGET_FAILURES_NS
        recent = [at for at in self._failures.pop(address, []) if at > since_ns]
        if recent:
            self._failures[address] = recent
        return len(recent) >= MOST_FAILURES


class ChannelServer(Server):  # type: ignore[misc]
    """A server whose channels are checked. `check` compares the certificates of clients; None for a server without security."""

    _policies: list[Any]

    def __init__(self, sessions: SessionServer, clock: Clock, check: CheckCertificate | None) -> None:
        super().__init__(iserver=sessions)
        self.check = check
        self.clock = clock
        self.failures = LoginFailures(clock)
        self.writes: set[asyncio.Task[None]] = set()
        """The requests to write that are in flight."""

    async def start(self) -> None:
        await self._setup_server_nodes()
        await self.iserver.start()
        host, port = self._get_bind_socket_info()
        self.bserver = _Listener(self, host, port)
        if self.check is not None:
            self.iserver.certificate_validator = _check_application
            self._policies = [_CheckedPolicy(each, self.check) for each in self._policies]
        self.bserver.set_policies(self._policies)
        await self.bserver.start()

    async def stop(self) -> None:
        for write in list(self.writes):
            write.cancel()
        await super().stop()


async def _check_application(certificate: Certificate, description: Any) -> None:
    """Refuse a client whose application URI is not that of its certificate (OPC 10000-4, 5.6.2.2)."""
    if description.ApplicationUri not in uris_of(certificate):
        raise ServiceError(ua.StatusCodes.BadCertificateUriInvalid)


class _CheckedPolicy(SecurityPolicyFactory):  # type: ignore[misc]
    """A policy of a channel, which is not created for a client that is not trusted."""

    def __init__(self, policy: SecurityPolicyFactory, check: CheckCertificate) -> None:
        super().__init__(policy.cls, policy.mode, policy.certificate, policy.private_key, policy.permission_ruleset)
        self._check = check

    def create(self, peer_certificate: bytes | None) -> Any:
        return super().create(self._check(peer_certificate or b""))


class _Listener(BinaryServer):  # type: ignore[misc]
    def __init__(self, server: ChannelServer, host: str, port: int) -> None:
        super().__init__(server.iserver, host, port, server.limits)
        self._owner = server

    def _make_protocol(self) -> OPCUAProtocol:
        return _Protocol(self._owner, self._policies, self.clients, self.closing_tasks)


class _Protocol(OPCUAProtocol):  # type: ignore[misc]
    processor: Any

    def __init__(self, server: ChannelServer, policies: list[Any], clients: list[Any], closing: list[Any]) -> None:
        super().__init__(server.iserver, policies, clients, closing, server.limits)
        self._owner = server

    def connection_made(self, transport: Any) -> None:
        super().connection_made(transport)
        if self.processor is not None:
            self.processor = _Processor(self._owner, transport)
            self.processor.set_policies(self.policies)


class _Processor(UaProcessor):  # type: ignore[misc]
    """The messages of one connection."""

    session: Any

    def __init__(self, server: ChannelServer, transport: Any) -> None:
        super().__init__(server.iserver, transport, server.limits)
        self._is_secured = server.check is not None
        self._failures = server.failures
        self._address = str(self.name[0])
        self._clock = server.clock
        self._writes = server.writes

    async def process(self, header: Any, body: Any) -> bool:
        """Process one message. A channel whose client or message is not authentic gets the reason, and is closed."""
        try:
            return bool(await super().process(header, body))
        except NotTrusted as e:
            _log.warning("the client at %s is refused (%s): %s", self._address, e.code, e)
            return self._end(getattr(ua.StatusCodes, e.code), "the certificate is refused")
        except Exception as e:
            # asyncua answers errors of services itself; the others are messages that could not be decrypted, verified or decoded
            _log.warning("the connection of %s is closed: %s: %s", self._address, type(e).__name__, str(e)[:200])
            return self._end(ua.StatusCodes.BadSecurityChecksFailed, "the message is not valid")

    def _end(self, code: int, reason: str) -> bool:
        self._transport.write(uatcp_to_binary(ua.MessageType.Error, ua.ErrorMessage(ua.StatusCode(code), reason)))
        return False

    async def _process_message(self, typeid: Any, requesthdr: Any, seqhdr: Any, body: Any) -> Any:
        if typeid in _REGISTRATION:
            raise ServiceError(ua.StatusCodes.BadServiceUnsupported)
        is_open = isinstance(self._connection.security_policy, SecurityPolicyNone)
        if self._is_secured and is_open and typeid not in _DISCOVERY:
            raise ServiceError(ua.StatusCodes.BadSecurityPolicyRejected)
        if typeid == _WRITE and self.session is not None and self.session.is_activated():
            return self._start_write(requesthdr, seqhdr, body)
        if typeid == _ACTIVATE:
            return await self._activate(typeid, requesthdr, seqhdr, body)
        if typeid != _CREATE:
            return await super()._process_message(typeid, requesthdr, seqhdr, body)
        if self.session is not None and self.session.state is not SessionState.Closed:
            raise ServiceError(ua.StatusCodes.BadTooManySessions)
        result = await super()._process_message(typeid, requesthdr, seqhdr, body)
        self.session.client_certificate = self._connection.security_policy.peer_certificate
        return result

    def _start_write(self, requesthdr: Any, seqhdr: Any, body: Any) -> bool:
        """Start a write, which waits for its device. The connection meanwhile processes the client's other requests."""
        self.session.touch()
        self.session_last_activity = self._clock.monotonic_ns() / NS_PER_S
        parameters = struct_from_binary(ua.WriteParameters, body)
        if len(parameters.NodesToWrite) > MOST_VALUES:
            raise ServiceError(ua.StatusCodes.BadTooManyOperations)
        if len(self._writes) >= MOST_WRITES:
            raise ServiceError(ua.StatusCodes.BadServerTooBusy)
        task = asyncio.create_task(self._write(self.session, parameters, requesthdr, seqhdr))
        self._writes.add(task)
        task.add_done_callback(self._writes.discard)
        return True

    async def _write(self, session: Session, parameters: Any, requesthdr: Any, seqhdr: Any) -> None:
        response = ua.WriteResponse()
        response.Results = await session.write(parameters)
        if not self._transport.is_closing():
            self.send_response(requesthdr.RequestHandle, seqhdr, response)

    async def _activate(self, typeid: Any, requesthdr: Any, seqhdr: Any, body: Any) -> Any:
        """Activate a session. A new channel may continue a session only of a client with the same certificate."""
        if self._failures.must_wait(self._address):
            raise ServiceError(ua.StatusCodes.BadTooManyOperations)
        is_new = self.session is None
        if is_new:
            found: Session | None = self.iserver.lookup_external_session(requesthdr.AuthenticationToken)
            peer = self._connection.security_policy.peer_certificate
            if found is None or found.client_certificate != peer:
                raise ServiceError(ua.StatusCodes.BadSessionIdInvalid)
        try:
            return await super()._process_message(typeid, requesthdr, seqhdr, body)
        except Exception as e:
            if is_new:
                self.session = None  # the session of a different channel, which this client failed to activate
            self._failures.note(self._address)
            _log.warning("a user at %s is refused: %s", self._address, _reason(e))
            raise


def _reason(error: Exception) -> str:
    code = getattr(error, "code", None)
    return ua.StatusCode(code).name if code is not None else type(error).__name__
