"""The server rows on pymodbus's and libmodbus's servers: their deviations are listed, row by row, and there are no others."""

from __future__ import annotations

import asyncio
import ctypes
import tomllib
from ctypes.util import find_library
from importlib.metadata import version
from typing import Any

import pytest
from server_rows import PEERS, VECTORS, asked_of, load_rows, play_on

pytestmark = [pytest.mark.interop, pytest.mark.timeout(120)]
KNOWN: dict[str, Any] = tomllib.loads((VECTORS / "known_failures.toml").read_text())
NOT_ASKED = {peer: {entry["id"]: entry["why"] for entry in KNOWN[peer].get("not_asked", [])} for peer in PEERS}
ROWS = {peer: [row for row in load_rows() if asked_of(peer, row, NOT_ASKED[peer])] for peer in PEERS}
_found: dict[str, dict[str, str]] = {}


def version_of(peer: str) -> str:
    """Return the installed version of the peer, or an empty text."""
    if peer == "pymodbus":
        return version("pymodbus")
    if (name := find_library("modbus")) is None:
        return ""
    lib = ctypes.CDLL(name)
    parts = ("major", "minor", "micro")
    return ".".join(str(ctypes.c_uint.in_dll(lib, f"libmodbus_version_{part}").value) for part in parts)


def found_on(peer: str) -> dict[str, str]:
    """Run once, all rows of all peers at the same time, because they mostly wait for silent servers."""

    async def main() -> list[dict[str, str]]:
        return await asyncio.gather(*(play_on(name, ROWS[name]) for name in here))

    if not _found:
        here = [name for name in PEERS if version_of(name)]
        _found.update(zip(here, asyncio.run(main()), strict=True))
    return _found[peer]


@pytest.mark.parametrize("peer", PEERS)
def test_the_list_names_rows(peer: str) -> None:
    ids = {row["id"] for row in load_rows()}
    known = [entry["id"] for entry in KNOWN[peer]["known"]]
    assert set(known) <= {row["id"] for row in ROWS[peer]}
    assert len(set(known)) == len(known)
    assert set(NOT_ASKED[peer]) <= ids
    assert len(known) < len(ROWS[peer])


@pytest.mark.parametrize(("peer", "row_id"), [(peer, row["id"]) for peer in PEERS for row in ROWS[peer]])
def test_row_on_a_third_party_server(peer: str, row_id: str) -> None:
    here = version_of(peer)
    if not here:
        pytest.skip(f"{peer} is not installed")
    known = {entry["id"]: entry["instead"] for entry in KNOWN[peer]["known"]}
    found = found_on(peer)[row_id]
    if found != known.get(
        row_id, ""
    ):  # all rows together load the host and delay the timers of the servers: repeat alone
        [row] = [row for row in ROWS[peer] if row["id"] == row_id]
        found = asyncio.run(play_on(peer, [row]))[row_id]
    if here == KNOWN[peer]["version"]:
        assert found == known.get(row_id, "")
    elif row_id not in known:
        assert not found, f"a row that {KNOWN[peer]['version']} passed"
