"""A digital thread between two computers: over TLS, where both sides present a certificate; plain TCP is limited to one
computer."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest
from modbus_pki import Pki, make_pki
from support import eventually, run
from thread_rig import Twin, equal, value

from fieldtwin.gateway.core.errors import UsageError
from fieldtwin.gateway.wallclock import WallClock
from fieldtwin.twin.site.system import load_system
from fieldtwin.twin.thread.place import plant_carrier, twin_carrier
from fieldtwin.twin.thread.thread import schema_of

CLOCK = WallClock()
SYSTEM = load_system(str(Path(__file__).resolve().parents[3] / "profiles" / "systems" / "observatory.yaml"))


def url(pki: Pki, name: str, port: int, trusts: Pki) -> str:
    return f"tls://127.0.0.1:{port}?ca={trusts.ca}&cert={pki.cert(name)}&key={pki.key(name)}"


@pytest.mark.skipif(shutil.which("openssl") is None, reason="openssl makes the certificates")
def test_over_tls_both_sides_show_a_certificate(tmp_path: Path) -> None:
    for name in ("ours", "theirs"):
        (tmp_path / name).mkdir()
    ours, theirs = make_pki(tmp_path / "ours"), make_pki(tmp_path / "theirs")

    async def main() -> None:
        listening, place = await plant_carrier(url(ours, "server", 0, ours), SYSTEM, CLOCK)
        schema, here = schema_of(SYSTEM), port(place)

        def side(name: str, pki: Pki) -> Twin:
            return Twin(
                name, tmp_path, CLOCK, lambda: twin_carrier(url(pki, "client", here, ours), SYSTEM, CLOCK), schema
            )

        plant, shore, stranger = (
            Twin("plant", tmp_path, CLOCK, lambda: listening, schema),
            side("shore", ours),
            side("x", theirs),
        )
        await plant.start()
        await stranger.start()
        await plant.log(value(1))
        await eventually(lambda: bool(stranger.end.trouble))
        assert plant.end.waiting == 1
        await stranger.kill()
        await shore.start()
        await eventually(lambda: equal(plant, shore))
        await shore.kill()
        await plant.kill()

    run(main())


def port(place: str) -> int:
    return int(place.partition("?")[0].rpartition(":")[2])


@pytest.mark.parametrize(
    "place", ["tcp://0.0.0.0:7700", "tcp://[::]:7700", "tcp://plant:7700", "tls://0.0.0.0:7700?cert=a.pem&key=a.key"]
)
def test_a_remote_client_without_a_certificate_is_refused(place: str) -> None:
    with pytest.raises(
        UsageError,
        match=r"every client that reaches this port may command the plant|needs a certificate and the authority",
    ):
        run(plant_carrier(place, SYSTEM, CLOCK))


@pytest.mark.parametrize(
    "place",
    ["udp://127.0.0.1:1", "mqtt://broker", "mqtt://u:secret@broker/a/b", "mqtt://broker/a/b/c", "mqtt://broker/+/b"],
)
def test_an_invalid_place_is_refused(place: str) -> None:
    with pytest.raises(UsageError):
        twin_carrier(place, SYSTEM, CLOCK)
