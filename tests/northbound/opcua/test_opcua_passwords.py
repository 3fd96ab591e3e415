"""Attacks on encrypted passwords of a secured server: an earlier one sent again, unsafe algorithms, and damaged ones.

The channel only signs its messages, because a client encrypts the password itself on such a channel.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Iterator
from pathlib import Path
from shutil import copy
from typing import Any

import pytest
from asyncua import Client, ua
from asyncua.crypto import uacrypto
from secured_server import PASSWORDS, SIGN, TAG, client_of, make_certificate, secured_server

pytestmark = [pytest.mark.long, pytest.mark.timeout(180)]
OAEP = "http://www.w3.org/2001/04/xmlenc#rsa-oaep"
RSA15 = "http://www.w3.org/2001/04/xmlenc#rsa-1_5"
Encrypted = tuple[bytes, str]


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Path, str]]:
    folder = tmp_path_factory.mktemp("p")
    with secured_server(folder) as url:
        make_certificate(folder, "hmi")
        copy(folder / "hmi.der", folder / "pki/trusted/hmi.der")
        yield folder, url


async def log_in(made: Client, encrypt: Callable[..., Encrypted]) -> Any:
    """Log in with a password that `encrypt` has encrypted, and read a value."""
    made._encrypt_password = encrypt
    async with made:
        return await made.get_node(TAG).read_value()


async def refusal(made: Client, encrypt: Callable[..., Encrypted]) -> str:
    with pytest.raises(ua.UaStatusCodeError) as caught:
        await log_in(made, encrypt)
    return str(ua.StatusCode(caught.value.code).name)


def server_key(made: Client) -> Any:
    return uacrypto.x509_from_der(made.security_policy.peer_certificate).public_key()


def with_nonce(made: Client, password: str) -> bytes:
    """The password as OPC 10000-4, 7.41.2.2 serializes it before the encryption."""
    packed: bytes = ua.ua_binary.Primitives.Bytes.pack(password.encode() + made._server_nonce)
    return packed


def test_an_encrypted_password_of_an_earlier_session_is_refused(server: tuple[Path, str]) -> None:
    folder, url = server

    async def attack() -> None:
        recorded: list[Encrypted] = []
        first = await client_of(url, folder / "hmi.der", SIGN)
        encrypt = first._encrypt_password

        def recording(password: str, policy: str) -> Encrypted:
            recorded.append(encrypt(password, policy))
            return recorded[-1]

        assert await log_in(first, recording) == 50.0
        again = await client_of(url, folder / "hmi.der", SIGN)
        assert await refusal(again, lambda *_: recorded[0]) == "BadIdentityTokenInvalid"
        own = await client_of(url, folder / "hmi.der", SIGN)
        assert await log_in(own, own._encrypt_password) == 50.0

    asyncio.run(attack())


def test_a_password_without_the_nonce_of_the_session_is_refused(server: tuple[Path, str]) -> None:
    folder, url = server

    async def attack() -> None:
        made = await client_of(url, folder / "hmi.der", SIGN)

        def encrypt(password: str, _: str) -> Encrypted:
            plain = ua.ua_binary.Primitives.Bytes.pack(password.encode())
            return uacrypto.encrypt_rsa_oaep(server_key(made), plain), OAEP

        assert await refusal(made, encrypt) == "BadIdentityTokenInvalid"

    asyncio.run(attack())


def test_a_password_that_was_encrypted_with_rsa_1_5_is_refused(server: tuple[Path, str]) -> None:
    folder, url = server

    async def attack() -> None:
        for named in (RSA15, OAEP):  # the second one names the right algorithm for the wrong bytes
            made = await client_of(url, folder / "hmi.der", SIGN)

            def encrypt(password: str, _: str, made: Client = made, named: str = named) -> Encrypted:
                return uacrypto.encrypt_rsa15(server_key(made), with_nonce(made, password)), named

            assert await refusal(made, encrypt) == "BadIdentityTokenInvalid"

    asyncio.run(attack())


@pytest.mark.parametrize("plain", [b"", b"\x05", b"\xff\xff\xff\xff", b"\x20\0\0\0" + b"x" * 32])
def test_a_damaged_password_is_refused(plain: bytes, server: tuple[Path, str]) -> None:
    folder, url = server

    async def attack() -> None:
        made = await client_of(url, folder / "hmi.der", SIGN)
        key_of = server_key
        assert (
            await refusal(made, lambda *_: (uacrypto.encrypt_rsa_oaep(key_of(made), plain), OAEP))
            == "BadIdentityTokenInvalid"
        )
        own = await client_of(url, folder / "hmi.der", SIGN)
        assert await log_in(own, own._encrypt_password) == 50.0

    asyncio.run(attack())


def test_a_password_that_is_no_text_is_refused(server: tuple[Path, str]) -> None:
    folder, url = server

    async def attack() -> None:
        made = await client_of(url, folder / "hmi.der", SIGN)

        def encrypt(*_: str) -> Encrypted:
            plain = ua.ua_binary.Primitives.Bytes.pack(b"\xff\xfe" + made._server_nonce)
            return uacrypto.encrypt_rsa_oaep(server_key(made), plain), OAEP

        assert await refusal(made, encrypt) in ("BadIdentityTokenInvalid", "BadUserAccessDenied")

    asyncio.run(attack())


def test_the_right_password_is_admitted_when_a_test_encrypts_it(server: tuple[Path, str]) -> None:
    folder, url = server

    async def look() -> None:
        made = await client_of(url, folder / "hmi.der", SIGN)

        def encrypt(*_: str) -> Encrypted:
            return uacrypto.encrypt_rsa_oaep(server_key(made), with_nonce(made, PASSWORDS["anna"])), OAEP

        assert await log_in(made, encrypt) == 50.0

    asyncio.run(look())
