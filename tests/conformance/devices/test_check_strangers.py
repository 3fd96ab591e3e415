"""`fieldtwin check modbus` on third-party devices: pymodbus's and libmodbus's servers get the documented verdicts."""

from __future__ import annotations

import asyncio
import tempfile
import tomllib
from pathlib import Path

import pytest
from strangers import check_all, version_of

from fieldtwin.conformance.devices.device_case import DeviceResult
from fieldtwin.results.model import Verdict

pytestmark = [
    pytest.mark.interop,
    pytest.mark.timeout(120),
]
KNOWN = tomllib.loads((Path(__file__).parent / "strangers.toml").read_text())
WIRES = [(peer, wire) for peer in ("pymodbus", "libmodbus") for wire in KNOWN[peer]]
_found: dict[tuple[str, str], list[DeviceResult]] = {}


def found_on(peer: str, wire: str) -> list[DeviceResult]:
    """Run once, all at the same time."""

    async def main(folder: Path) -> list[list[DeviceResult]]:
        return await asyncio.gather(*(check_all(p, w, folder, n * 0.5) for n, (p, w) in enumerate(here)))

    if not _found:
        here = [(p, w) for p, w in WIRES if version_of(p)]
        with tempfile.TemporaryDirectory(dir="/tmp") as folder:
            _found.update(zip(here, asyncio.run(main(Path(folder))), strict=True))
    return _found[peer, wire]


def again(peer: str, wire: str, only: frozenset[str]) -> list[DeviceResult]:
    """Run these cases alone, because their earlier results may have been caused by the load of this computer."""
    with tempfile.TemporaryDirectory(dir="/tmp") as folder:
        return asyncio.run(check_all(peer, wire, Path(folder), only=only))


def not_passed(results: list[DeviceResult]) -> dict[str, str]:
    return {r.case.id: f"{r.verdict.value}: {r.reason}" for r in results if r.verdict is not Verdict.PASSED}


@pytest.mark.parametrize(("peer", "wire"), WIRES)
@pytest.mark.long
def test_verdicts_are_the_known_ones(peer: str, wire: str) -> None:
    here = version_of(peer)
    if not here:
        pytest.skip(f"{peer} is not installed")
    results = found_on(peer, wire)
    known = KNOWN[peer][wire]
    found = not_passed(results)
    # repeat without the load of the other cases
    if odd := frozenset(id for id in found | known if found.get(id) != known.get(id)):
        found = {id: said for id, said in found.items() if id not in odd} | not_passed(again(peer, wire, odd))
    if here == KNOWN["versions"][peer]:
        assert found == known
    else:
        assert set(found) <= set(known), "a case that the known version passed"
    assert len(results) > len(known)
