"""The clients and users that a secured server admits and refuses, with asyncua's client: certificates, passwords, attacks."""

from __future__ import annotations

import asyncio
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from asyncua import Client, ua
from secured_server import (
    ENCRYPT,
    SIGN,
    TAG,
    client_of,
    make_certificate,
    secured_server,
    unsecured_channel,
    write_users,
)

from fieldtwin.northbound.opcua.access.channels import MOST_FAILURES
from fieldtwin.northbound.opcua.access.users import thumbprint

pytestmark = [pytest.mark.long, pytest.mark.timeout(180)]


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Path, str]]:
    folder = tmp_path_factory.mktemp("s")
    with secured_server(folder) as url:
        make_certificate(folder, "hmi")
        shutil.copy(folder / "hmi.der", folder / "pki/trusted/hmi.der")
        yield folder, url


async def read_with(made: Client) -> Any:
    async with made:
        return await made.get_node(TAG).read_value()


async def refused(made: Client) -> str:
    """Connect, and return the name of the status code of the refusal."""
    with pytest.raises(ua.UaStatusCodeError) as caught:
        await read_with(made)
    return ua.StatusCode(caught.value.code).name


@pytest.mark.parametrize("mode", [SIGN, ENCRYPT])
@pytest.mark.parametrize("user", ["anna", "bert"])
def test_a_user_with_a_password_reads_over_a_trusted_channel(
    server: tuple[Path, str], mode: ua.MessageSecurityMode, user: str
) -> None:
    folder, url = server

    async def look() -> None:
        assert await read_with(await client_of(url, folder / "hmi.der", mode, user)) == 50.0

    asyncio.run(look())


def test_only_the_secured_endpoints_are_offered(server: tuple[Path, str]) -> None:
    async def look() -> None:
        async with unsecured_channel(server[1]) as made:
            offered = await made.get_endpoints()
        assert {(e.SecurityPolicyUri.rpartition("#")[2], e.SecurityMode.name) for e in offered} == {
            ("Basic256Sha256", "Sign"),
            ("Basic256Sha256", "SignAndEncrypt"),
        }
        tokens = {token.TokenType.name for endpoint in offered for token in endpoint.UserIdentityTokens}
        assert tokens == {"UserName", "Certificate"}

    asyncio.run(look())


@pytest.mark.parametrize("mode", [SIGN, ENCRYPT])
def test_a_wrong_password_an_unknown_user_and_an_anonymous_user_are_refused(
    server: tuple[Path, str], mode: ua.MessageSecurityMode
) -> None:
    folder, url = server

    async def tries() -> None:
        wrong = await client_of(url, folder / "hmi.der", mode)
        wrong.set_password("correct house")
        assert await refused(wrong) == "BadUserAccessDenied"
        assert await refused(await client_of(url, folder / "hmi.der", mode, "carl")) == "BadUserAccessDenied"
        assert await refused(await client_of(url, folder / "hmi.der", mode, "")) == "BadIdentityTokenRejected"

    asyncio.run(tries())


def test_an_untrusted_client_is_refused_until_its_certificate_is_copied_into_the_folder(
    server: tuple[Path, str],
) -> None:
    folder, url = server
    certificate = make_certificate(folder, "tablet")

    async def tries() -> None:
        assert await refused(await client_of(url, certificate)) == "BadCertificateUntrusted"
        [kept] = [path for path in (folder / "rejected").iterdir() if path.name.startswith("tablet-")]
        assert kept.read_bytes() == certificate.read_bytes()
        shutil.copy(kept, folder / "pki/trusted")
        assert await read_with(await client_of(url, certificate)) == 50.0
        (folder / "pki/trusted" / kept.name).unlink()
        assert await refused(await client_of(url, certificate)) == "BadCertificateUntrusted"

    asyncio.run(tries())


def test_the_application_uri_must_be_that_of_the_certificate(server: tuple[Path, str]) -> None:
    folder, url = server

    async def tries() -> None:
        made = await client_of(url, folder / "hmi.der")
        made.application_uri = "urn:test:other"
        assert await refused(made) == "BadCertificateUriInvalid"

    asyncio.run(tries())


def test_a_user_with_a_certificate_is_admitted_by_its_key(server: tuple[Path, str]) -> None:
    folder, url = server
    own, other = make_certificate(folder, "own"), make_certificate(folder, "other")
    write_users(folder / "pki/users.yaml", historian=thumbprint(own.read_bytes()))

    async def as_user(certificate: Path) -> Client:
        made = await client_of(url, folder / "hmi.der", user="")
        await made.load_client_certificate(str(certificate))
        await made.load_private_key(str(certificate.with_suffix(".pem")))
        return made

    async def tries() -> None:
        assert await read_with(await as_user(own)) == 50.0
        assert await refused(await as_user(other)) == "BadUserAccessDenied"
        stolen = await as_user(own)
        await stolen.load_private_key(str(other.with_suffix(".pem")))
        assert await refused(stolen) in ("BadUserSignatureInvalid", "BadIdentityTokenInvalid")

    asyncio.run(tries())


def test_a_channel_without_security_cannot_create_a_session(server: tuple[Path, str]) -> None:
    async def tries() -> None:
        async with unsecured_channel(server[1]) as made:
            with pytest.raises(ua.UaStatusCodeError, match="BadSecurityPolicyRejected"):
                await made.create_session()

    asyncio.run(tries())


def test_a_client_cannot_continue_the_session_of_a_different_one(server: tuple[Path, str]) -> None:
    """asyncua numbers its sessions, so an attacker can guess the token of each session."""
    folder, url = server
    make_certificate(folder, "second")
    shutil.copy(folder / "second.der", folder / "pki/trusted/second.der")

    async def tries_to_take_over(made: Client, token: ua.NodeId) -> None:
        protocol = made.uaclient.protocol
        assert protocol is not None
        protocol.authentication_token = token
        request = ua.ActivateSessionRequest()
        request.Parameters.UserIdentityToken = ua.AnonymousIdentityToken()
        with pytest.raises(ua.UaStatusCodeError):
            await protocol.send_request(request)
        read = ua.ReadRequest()
        read.Parameters.NodesToRead = [ua.ReadValueId(ua.NodeId.from_string(TAG), ua.AttributeIds.Value)]
        with pytest.raises((ua.UaStatusCodeError, ConnectionError)):
            await protocol.send_request(read)

    async def attack() -> None:
        async with await client_of(url, folder / "hmi.der") as victim:
            assert victim.uaclient.protocol is not None
            token = victim.uaclient.protocol.authentication_token
            async with unsecured_channel(url) as made:
                await tries_to_take_over(made, token)
            made = await client_of(url, folder / "second.der")
            await made.connect_socket()
            await made.send_hello()
            await made.open_secure_channel()
            await tries_to_take_over(made, token)
            made.disconnect_socket()
            assert await victim.get_node(TAG).read_value() == 50.0

    asyncio.run(attack())


def test_a_client_cannot_use_or_delete_the_subscription_of_a_different_one(server: tuple[Path, str]) -> None:
    """asyncua numbers subscriptions, so an attacker can guess the number of each one."""
    folder, url = server
    invalid = "BadSubscriptionIdInvalid"

    async def attack() -> None:
        async with (
            await client_of(url, folder / "hmi.der") as victim,
            await client_of(url, folder / "hmi.der", user="bert") as attacker,
        ):
            received = asyncio.Queue[Any]()
            subscription = await victim.create_subscription(50, Receiver(received))
            number = subscription.subscription_id
            assert number is not None
            session = attacker.uaclient.session
            assert [code.name for code in await session.delete_subscriptions([number])] == [invalid]
            mode = ua.SetPublishingModeParameters(False, [number])
            assert [code.name for code in await session.set_publishing_mode(mode)] == [invalid]
            for refused in (
                session.create_monitored_items(ua.CreateMonitoredItemsParameters(number)),
                session.modify_monitored_items(ua.ModifyMonitoredItemsParameters(number)),
                session.delete_monitored_items(ua.DeleteMonitoredItemsParameters(number, [1])),
                session.set_monitoring_mode(ua.SetMonitoringModeParameters(number, ua.MonitoringMode.Disabled, [1])),
                session.modify_subscription(ua.ModifySubscriptionParameters(number)),
            ):
                with pytest.raises(ua.UaStatusCodeError, match=invalid):
                    await refused
            await subscription.subscribe_data_change(victim.get_node(TAG))
            assert await asyncio.wait_for(received.get(), 60) == 50.0
            await subscription.delete()

    asyncio.run(attack())


class Receiver:
    """Puts the values of a subscription into a queue."""

    def __init__(self, received: asyncio.Queue[Any]) -> None:
        self._received = received

    def datachange_notification(self, node: Any, value: Any, data: Any) -> None:
        self._received.put_nowait(value)


def test_an_altered_message_ends_the_connection(server: tuple[Path, str]) -> None:
    folder, url = server

    async def tries() -> None:
        made = await client_of(url, folder / "hmi.der")
        async with made:
            cryptography = made.security_policy.symmetric_cryptography
            signature = cryptography.Signer.signature
            cryptography.Signer.signature = lambda data: bytes(len(signature(data)))
            with pytest.raises((ua.UaError, ConnectionError, TimeoutError)):
                await made.get_node(TAG).read_value()
            cryptography.Signer.signature = signature
        assert await read_with(await client_of(url, folder / "hmi.der")) == 50.0

    asyncio.run(tries())


def test_after_many_failed_log_ins_an_address_has_to_wait(tmp_path: Path) -> None:
    with secured_server(tmp_path) as url:
        make_certificate(tmp_path, "hmi")
        shutil.copy(tmp_path / "hmi.der", tmp_path / "pki/trusted/hmi.der")

        async def tries() -> None:
            for _ in range(MOST_FAILURES):
                assert await refused(await client_of(url, tmp_path / "hmi.der", user="carl")) == "BadUserAccessDenied"
            assert await refused(await client_of(url, tmp_path / "hmi.der")) == "BadTooManyOperations"

        asyncio.run(tries())
