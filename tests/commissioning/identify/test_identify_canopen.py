"""`identify` of CANopen nodes: by device type and identity, and never certain of a wrong one."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from canopen_peer_node import PeerBus, PeerNode, closing
from commissioning_rig import loop, run_virtually
from hypothesis import given
from hypothesis import strategies as st

from fieldtwin.commissioning.identify.canopen import CanIdentity, identify_canopen
from fieldtwin.commissioning.identify.matching import CanClues, Sureness, rate_canopen
from fieldtwin.gateway.core.files.profile_file import load_profile
from fieldtwin.gateway.protocols.canopen.configure import Identity
from fieldtwin.gateway.protocols.canopen.eds.dictionary import load_dictionary

URL = "can:fieldtwin/h:1"
SHIPPED = [load_profile(path) for path in sorted(Path("profiles/devices").glob("*cia*.yaml"))]
SHEETS = [(p, load_dictionary(p.eds_path, 1)) for p in SHIPPED if p.eds_path is not None]


def numbers(kind: int, *parts: int) -> dict[tuple[int, int], bytes]:
    out = {(0x1000, 0): kind.to_bytes(4, "little"), (0x1018, 0): bytes([len(parts)])}
    return out | {(0x1018, i): part.to_bytes(4, "little") for i, part in enumerate(parts, start=1)}


async def identify(objects: dict[tuple[int, int], bytes], node: int = 5) -> CanIdentity:
    peer = PeerNode(node, objects)
    peers = PeerBus([peer])
    async with closing(peers):
        peer.power_on()
        found = await identify_canopen(URL, 5, SHIPPED, connector=peers, clock=loop(), timeout_s=0.1)
        assert peers.writes() == []
    return found


def test_the_reference_devices_are_likely_and_never_certain() -> None:
    """Their vendor ID is 0, which is not assigned."""

    async def main() -> None:
        found = await identify(numbers(0x00020192, 0, 0x402, 0x10000, 77) | {(0x1008, 0): b"DRV"})
        best = found.candidates[0]
        assert (best.profile, best.sureness) == ("fieldtwin/drive-cia402", Sureness.LIKELY)
        assert found.clues.name == "DRV"
        assert found.clues.identity == Identity(0x20192, 0, 0x402, 0x10000, 77)
        assert found.certain is None

    run_virtually(main())


def test_another_makers_drive_is_possible_and_another_kind_is_not() -> None:
    async def main() -> None:
        drive = await identify(numbers(0x00020192, 0x2E, 9))
        assert {c.profile for c in drive.candidates if c.sureness} == {"fieldtwin/drive-cia402"}
        assert drive.candidates[0].sureness is Sureness.POSSIBLE
        assert "a different maker" in " ".join(drive.candidates[0].against)
        strange = await identify(numbers(0, 0x2E, 9))
        assert all(c.sureness is Sureness.RULED_OUT for c in strange.candidates)
        assert strange.summary == "no known profile fits"

    run_virtually(main())


def test_silence_is_reported_as_silence() -> None:
    async def main() -> None:
        found = await identify({}, node=6)
        assert (found.answers, found.summary) == (False, "node 5 does not answer SDO requests")

    run_virtually(main())


def test_vendor_and_product_of_the_data_sheet_are_certain() -> None:
    profile, sheet = SHEETS[0]
    sheet = replace(sheet, vendor_number=0x2E, product_number=7)
    entry = sheet.get(0x1000)
    assert entry is not None
    assert isinstance(entry.default, int)
    same = rate_canopen(profile, sheet, CanClues(Identity(entry.default, 0x2E, 7, 1, 1)))
    assert same.sureness is Sureness.CERTAIN
    other = rate_canopen(profile, sheet, CanClues(Identity(entry.default, 0x2E, 8, 1, 1)))
    assert other.sureness is Sureness.POSSIBLE


U32 = st.integers(0, 0xFFFF_FFFF)


@given(st.builds(Identity, U32, st.none() | U32, st.none() | U32, U32, U32))
def test_no_identity_makes_a_reference_profile_certain(identity: Identity) -> None:
    assert all(rate_canopen(p, s, CanClues(identity)).sureness < Sureness.CERTAIN for p, s in SHEETS)
