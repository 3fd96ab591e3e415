"""The part of asyncua that holds sessions, with the checks of users that it lacks.

asyncua 2.1 accepts a password that was encrypted for an earlier session, and passwords and signatures with unsafe algorithms (RSA
PKCS #1 v1.5 and SHA-1). It also lets each session use the subscriptions of all others.
"""

from __future__ import annotations

import hmac
import logging
from collections.abc import Awaitable, Callable
from dataclasses import replace
from struct import unpack_from
from typing import Any

from asyncua import ua
from asyncua.common.utils import ServiceError
from asyncua.crypto import uacrypto
from asyncua.crypto.permission_rules import User, UserRole
from asyncua.server.internal_server import InternalServer
from asyncua.server.internal_session import InternalSession

from fieldtwin.gateway.core.errors import FileInvalid
from fieldtwin.northbound.opcua.access.users import Account, Users

NO_SUBSCRIPTION = 0
"""A number that no subscription has."""
_OAEP = "http://www.w3.org/2001/04/xmlenc#rsa-oaep"
_RSA_SHA256 = "http://www.w3.org/2001/04/xmldsig-more#rsa-sha256"
_log = logging.getLogger(__name__)


WriteValue = Callable[[Any, Account | None, str], Awaitable[str]]
"""Writes a `ua.WriteValue` for a user at an address. Returns the name of the status code."""


CallMethod = Callable[[Any, Account | None, str], Awaitable[str]]
"""Carries out a `ua.CallMethodRequest` for a user at an address. Returns the name of the status code."""
MOST_CALLS = 100
"""The largest number of method calls in one request."""
_REFRESH = (
    ua.NodeId(ua.ObjectIds.ConditionType_ConditionRefresh),
    ua.NodeId(ua.ObjectIds.ConditionType_ConditionRefresh2),
)


async def _refuse_call(request: Any, account: Account | None, address: str) -> str:
    return "BadMethodInvalid"


async def _refuse_write(item: Any, account: Account | None, address: str) -> str:
    return "BadNotWritable"


class SessionUser(User):  # type: ignore[misc]
    """The user of a session; `account` is None for an anonymous one."""

    def __init__(self, account: Account | None = None) -> None:
        super().__init__(role=UserRole.User, name=account.name if account is not None else "anonymous")
        self.account = account


class Session(InternalSession):  # type: ignore[misc]
    """A client's session, with the certificate of the channel that created it; None without security."""

    client_certificate: bytes | None = None
    user: User

    @property
    def account(self) -> Account | None:
        """Return the account of the user; None for an anonymous one."""
        return self.user.account if isinstance(self.user, SessionUser) else None

    async def write(self, params: ua.WriteParameters) -> list[ua.StatusCode]:
        """Pass the values, one after the other, to the function for writes, with user and address of the client."""
        write, address = self.iserver.write_value, str(self.name[0])
        codes = [await write(item, self.account, address) for item in params.NodesToWrite]
        return [ua.StatusCode(getattr(ua.StatusCodes, code)) for code in codes]

    async def call(self, params: list[ua.CallMethodRequest]) -> list[ua.CallMethodResult]:
        """Carry out methods: the refresh of conditions for this session's subscriptions, and those of alarms. No other method can
        be called.
        """
        if len(params) > MOST_CALLS:
            raise ServiceError(ua.StatusCodes.BadTooManyOperations)
        return [await self._call_one(each) for each in params]

    async def _call_one(self, request: ua.CallMethodRequest) -> ua.CallMethodResult:
        if request.MethodId in _REFRESH and self.iserver.bind_condition_methods:
            arguments = request.InputArguments or []
            if not arguments or not self._owns(arguments[0].Value):
                return ua.CallMethodResult(StatusCode=ua.StatusCode(ua.StatusCodes.BadSubscriptionIdInvalid))
            [found] = await super().call([request])
            return found
        code = await self.iserver.call_method(request, self.account, str(self.name[0]))
        return ua.CallMethodResult(StatusCode=ua.StatusCode(getattr(ua.StatusCodes, code)))

    def _owns(self, subscription: int) -> bool:
        """Return whether a subscription exists and is that of this session (OPC 10000-4, 5.14.1)."""
        found = self.subscription_service.subscriptions.get(subscription)
        return found is not None and found.session_id == self.session_id

    def _check_own(self, subscription: int) -> None:
        if not self._owns(subscription):
            raise ServiceError(ua.StatusCodes.BadSubscriptionIdInvalid)

    async def delete_subscriptions(self, ids: list[int]) -> list[ua.StatusCode]:
        """Delete the subscriptions of this session. Those of other sessions do not exist for it, as in all services below."""
        own = [each if self._owns(each) else NO_SUBSCRIPTION for each in ids]
        found: list[ua.StatusCode] = await super().delete_subscriptions(own)
        return found

    def modify_subscription(self, params: ua.ModifySubscriptionParameters) -> ua.ModifySubscriptionResult:
        self._check_own(params.SubscriptionId)
        return super().modify_subscription(params)

    async def set_publishing_mode(self, params: ua.SetPublishingModeParameters) -> list[ua.StatusCode]:
        own = [each if self._owns(each) else NO_SUBSCRIPTION for each in params.SubscriptionIds]
        found: list[ua.StatusCode] = await super().set_publishing_mode(replace(params, SubscriptionIds=own))
        return found

    async def create_monitored_items(self, params: ua.CreateMonitoredItemsParameters) -> Any:
        self._check_own(params.SubscriptionId)
        return await super().create_monitored_items(params)

    async def modify_monitored_items(self, params: ua.ModifyMonitoredItemsParameters) -> Any:
        self._check_own(params.SubscriptionId)
        return await super().modify_monitored_items(params)

    async def delete_monitored_items(self, params: ua.DeleteMonitoredItemsParameters) -> Any:
        self._check_own(params.SubscriptionId)
        return await super().delete_monitored_items(params)

    async def set_monitoring_mode(self, params: ua.SetMonitoringModeParameters) -> Any:
        self._check_own(params.SubscriptionId)
        return await super().set_monitoring_mode(params)

    def republish(self, params: ua.RepublishParameters) -> Any:
        self._check_own(params.SubscriptionId)
        return super().republish(params)

    def publish(self, acks: Any = None) -> tuple[int, list[ua.StatusCode]]:
        """Acknowledge messages of this session's subscriptions."""
        own = [
            each
            if self._owns(each.SubscriptionId)
            else ua.SubscriptionAcknowledgement(NO_SUBSCRIPTION, each.SequenceNumber)
            for each in acks or []
        ]
        found: tuple[int, list[ua.StatusCode]] = super().publish(own)
        return found

    async def transfer_subscriptions(self, params: ua.TransferSubscriptionsParameters, callback: Any) -> Any:
        """Refuse to take over subscriptions: a client continues its session on a new channel instead, and keeps them."""
        raise ServiceError(ua.StatusCodes.BadServiceUnsupported)

    async def read(self, params: ua.ReadParameters) -> list[ua.DataValue]:
        """Read attributes. The `UserAccessLevel` is that of the user of this session."""
        found: list[ua.DataValue] = await super().read(params)
        if self.account is None or self.account.may_write:
            return found
        for n, item in enumerate(params.NodesToRead):
            if item.AttributeId == ua.AttributeIds.UserAccessLevel and found[n].StatusCode.is_good():
                level = found[n].Value.Value & ~ua.AccessLevel.CurrentWrite.mask
                found[n] = ua.DataValue(ua.Variant(level, ua.VariantType.Byte))
        return found


class SessionServer(InternalServer):  # type: ignore[misc]
    """The services of a server. With `load_users` each user must have an account in the users that it returns; without it
    every user is anonymous.
    """

    def __init__(self, load_users: Callable[[], Users] | None) -> None:
        super().__init__(user_manager=_Accounts(load_users))
        self.write_value: WriteValue = _refuse_write
        """Writes one value of a client."""
        self.call_method: CallMethod = _refuse_call
        """Carries out a method for a client."""
        tokens = [ua.UserNameIdentityToken, ua.X509IdentityToken]
        self.supported_tokens = tuple(tokens) if load_users is not None else (ua.AnonymousIdentityToken,)

    def create_session(self, name: Any, user: User | None = None, external: bool = False) -> Session:
        return Session(
            self, self.aspace, self.subscription_service, name, user=user or User(UserRole.Anonymous), external=external
        )

    def decrypt_user_token(self, isession: Any, token: Any) -> tuple[str, str]:
        """Return name and password. An encrypted password ends with the nonce of the session (OPC 10000-4, 7.41.2.2)."""
        secret = token.Password or b""
        if token.EncryptionAlgorithm:
            if token.EncryptionAlgorithm != _OAEP:
                raise ServiceError(ua.StatusCodes.BadIdentityTokenInvalid)
            plain = uacrypto.decrypt_rsa_oaep(self.private_key, secret)
            (length,) = unpack_from("<I", plain)
            secret, nonce = plain[4 : 4 + length - len(isession.nonce)], plain[4 + length - len(isession.nonce) :]
            if length != len(plain) - 4 or not hmac.compare_digest(nonce, isession.nonce):
                raise ServiceError(ua.StatusCodes.BadIdentityTokenInvalid)
        return str(token.UserName or ""), secret.decode() if isinstance(secret, bytes) else str(secret)

    def verify_x509_token(self, isession: Any, token: Any, signature: Any) -> bytes:
        """Return the user's certificate (DER) if the signature proves possession of its key."""
        if signature.Algorithm != _RSA_SHA256:
            raise ServiceError(ua.StatusCodes.BadUserSignatureInvalid)
        found: bytes = super().verify_x509_token(isession, token, signature)
        return found


class _Accounts:
    """The user manager that asyncua asks for the user of a session; None means that the user is refused."""

    def __init__(self, load_users: Callable[[], Users] | None) -> None:
        self._load_users = load_users

    def get_user(
        self, iserver: Any, username: str | None = None, password: str | None = None, certificate: bytes | None = None
    ) -> SessionUser | None:
        if self._load_users is None:
            return SessionUser()
        try:
            users = self._load_users()
        except FileInvalid as e:
            _log.error("no user is admitted: %s", e)
            return None
        if username is not None:
            account = users.with_password(username, password or "")
        else:
            account = users.with_certificate(certificate) if certificate is not None else None
        if account is None:
            _log.warning("no user %r with this password or certificate", (username or "")[:48])
            return None
        return SessionUser(account)
