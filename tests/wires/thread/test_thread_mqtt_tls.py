"""Digital threads over a broker with TLS: accepted clients, verified brokers, permissions of a user; against a real mosquitto."""

from __future__ import annotations

import asyncio
import shutil
import subprocess
from contextlib import suppress
from pathlib import Path

import pytest
from local_mosquitto import Mosquitto, broker, program
from modbus_pki import Pki, make_pki
from support import eventually, run
from thread_rig import Twin, equal, value

from fieldtwin.gateway.core.errors import Unreachable, UsageError
from fieldtwin.gateway.wallclock import WallClock
from fieldtwin.twin.site.system import load_system
from fieldtwin.twin.thread.end import ThreadEnd
from fieldtwin.twin.thread.link import Carrier, Unwelcome
from fieldtwin.twin.thread.mqtt import session as mqtt_session
from fieldtwin.twin.thread.place import plant_carrier, twin_carrier
from fieldtwin.twin.thread.thread import schema_of

pytestmark = [
    pytest.mark.interop,
    pytest.mark.skipif(shutil.which("openssl") is None, reason="openssl makes the certificates"),
]
CLOCK = WallClock()
SYSTEM = load_system(str(Path(__file__).resolve().parents[3] / "profiles" / "systems" / "observatory.yaml"))
ACL = """user plant
topic readwrite spBv1.0/sea/#
topic read spBv1.0/STATE/#
user shore
topic readwrite spBv1.0/sea/#
topic readwrite spBv1.0/STATE/#
"""


@pytest.fixture(scope="module")
def pki(tmp_path_factory: pytest.TempPathFactory) -> Pki:
    return make_pki(tmp_path_factory.mktemp("pki"))


def strict(folder: Path, pki: Pki, *more: str) -> tuple[str, ...]:
    """Settings of a broker that requires a certificate, a user and a password, and restricts each user to its own topics."""
    passwords = folder / "passwords"
    program()  # skips if it is missing
    tool = shutil.which("mosquitto_passwd") or "mosquitto_passwd"
    for first, user in enumerate(("plant", "shore")):
        subprocess.run(
            [tool, "-b", *(() if first else ("-c",)), passwords, user, f"{user}-word"], check=True, capture_output=True
        )
    passwords.chmod(0o600)
    (folder / "acl").write_text(ACL)
    (folder / "acl").chmod(0o600)
    return (
        f"cafile {pki.ca}", f"certfile {pki.cert('server')}", f"keyfile {pki.key('server')}", "require_certificate true",
        "allow_anonymous false", f"password_file {passwords}", f"acl_file {folder / 'acl'}", *more,
    )  # fmt: skip


def url(here: Mosquitto, pki: Pki, user: str, *, certificate: bool = True, scheme: str = "mqtts") -> str:
    ours = f"&cert={pki.cert('client')}&key={pki.key('client')}" if certificate else ""
    return f"{scheme}://{user}@127.0.0.1:{here.port}/sea/obs" + (f"?ca={pki.ca}{ours}" if scheme == "mqtts" else "")


async def plant(place: str) -> Carrier:
    return (await plant_carrier(place, SYSTEM, CLOCK))[0]


def test_certificates_users_and_passwords_are_asked_for_and_the_logs_are_equal(
    tmp_path: Path, pki: Pki, monkeypatch: pytest.MonkeyPatch
) -> None:
    async def main() -> None:
        with broker(tmp_path, *strict(tmp_path, pki)) as here:
            monkeypatch.setenv("FIELDTWIN_MQTT_PASSWORD", "plant-word")
            near = await plant(url(here, pki, "plant"))
            monkeypatch.delenv("FIELDTWIN_MQTT_PASSWORD")
            (tmp_path / "word").write_text("shore-word\n")
            monkeypatch.setenv("FIELDTWIN_MQTT_PASSWORD_FILE", str(tmp_path / "word"))
            far = twin_carrier(url(here, pki, "shore"), SYSTEM, CLOCK)
            one = Twin("plant", tmp_path, CLOCK, lambda: near, schema_of(SYSTEM))
            other = Twin("shore", tmp_path, CLOCK, lambda: far, schema_of(SYSTEM))
            await one.start()
            await other.start()
            await one.log(*(value(n) for n in range(50)))
            await eventually(lambda: equal(one, other))
            assert str(near.name).startswith("thread over mqtts://")
            await other.kill()
            await one.kill()

    run(main())


def test_a_client_that_the_broker_refuses_gets_the_reason(
    tmp_path: Path, pki: Pki, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "other").mkdir()
    stranger = make_pki(tmp_path / "other")

    async def refused(place: str, word: str) -> str:
        monkeypatch.setenv("FIELDTWIN_MQTT_PASSWORD", word)
        with pytest.raises(Unwelcome) as caught:
            await (await plant(place)).open()
        assert caught.value.exit_code == 4
        assert word not in str(caught.value)
        return str(caught.value)

    async def main() -> None:
        with broker(tmp_path, *strict(tmp_path, pki)) as here:
            assert "the broker refuses the connection: Not authorized" in await refused(
                url(here, pki, "plant"), "wrong-word"
            )
            trusting_others = url(here, pki, "plant").replace(pki.ca, stranger.ca)
            assert "the broker's certificate is refused: " in await refused(trusting_others, "plant-word")
            # TLS 1.3: the client may send CONNECT before the broker refuses
            monkeypatch.setattr(mqtt_session, "TIMEOUT_S", 0.5)
            with pytest.raises(Unreachable, match="the broker ends the connection: tlsv13 alert certificate required"):
                await (await plant(url(here, pki, "plant", certificate=False))).open()
            with pytest.raises(Unreachable, match="it may require mqtts://"):
                await (await plant(url(here, pki, "plant", scheme="mqtt"))).open()

    run(main(), timeout_s=40)


def test_a_twin_that_is_refused_ends_and_a_plant_that_is_refused_waits(
    tmp_path: Path, pki: Pki, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A plant's thread keeps its log meanwhile, because the password may be corrected at the broker."""

    async def main() -> None:
        with broker(tmp_path, *strict(tmp_path, pki)) as here:
            monkeypatch.setenv("FIELDTWIN_MQTT_PASSWORD", "wrong-word")
            near, far = await plant(url(here, pki, "plant")), twin_carrier(url(here, pki, "shore"), SYSTEM, CLOCK)
            one = Twin("plant", tmp_path, CLOCK, lambda: near, schema_of(SYSTEM))
            await one.start()
            await one.log(value(1))
            await eventually(lambda: "Not authorized" in one.end.trouble)
            assert one.end.waiting == 1
            with pytest.raises(Unwelcome, match="Not authorized"):
                await ThreadEnd(one.store, far, schema_of(SYSTEM), CLOCK, insists=False).run()
            await one.kill()

    run(main())


def test_a_broker_without_tls_is_asked_about(tmp_path: Path, pki: Pki) -> None:
    async def main() -> None:
        with broker(tmp_path) as here, pytest.raises(Unreachable, match="check that the broker supports TLS"):
            await (await plant(url(here, pki, "plant"))).open()

    run(main())


def test_a_forbidden_topic_is_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    """mosquitto grants every subscription and withholds messages; other brokers answer SUBACK with 0x80 (MQTT 3.9.3)."""

    gone = asyncio.Event()

    async def denies(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        with suppress(asyncio.IncompleteReadError):
            while True:
                kind, length = await reader.readexactly(2)  # no packet is longer than 127 bytes here
                packet = await reader.readexactly(length)
                if kind == 0x10:
                    writer.write(b"\x20\x02\x00\x00")
                elif kind == 0x82:
                    writer.write(b"\x90\x03" + packet[:2] + b"\x80")
        writer.close()
        gone.set()

    async def main() -> None:
        server = await asyncio.start_server(denies, "127.0.0.1", 0)
        port = server.sockets[0].getsockname()[1]
        carrier = await plant(f"mqtt://127.0.0.1:{port}/sea/obs")
        monkeypatch.setattr(mqtt_session, "GOODBYE_S", 0.1)
        with pytest.raises(Unwelcome, match=r"denies the subscription to spBv1\.0/sea/NCMD/obs"):
            await carrier.open()
        server.close()
        await server.wait_closed()
        await gone.wait()

    run(main())


@pytest.mark.parametrize(
    ("place", "text"),
    [
        ("mqtts://broker/sea/obs?ca=/nowhere.pem", "cannot read the TLS files: No such file"),
        ("mqtts://broker/sea/obs?key=/some.key", "a key needs its certificate"),
        ("mqtt://broker/sea/obs?ca=/some.pem", "certificates need mqtts://"),
        ("mqtts://broker/sea/obs?verify=no", "verify= is not a setting of a broker"),
        ("mqtts://u:secret@broker/sea/obs", "a password in a URL"),
    ],
)
def test_errors_in_the_url_are_reported_at_once(place: str, text: str) -> None:
    with pytest.raises((UsageError, Unreachable), match=text):
        twin_carrier(place, SYSTEM, CLOCK)
