"""The coverage of a run in two short texts: the places of its programs, and which of them the run executed.

The places are equal for all runs of a campaign, so a ledger needs them once. The executed places are a bitmap of some ten
characters. Joining the coverage of runs is commutative and idempotent.
"""

from __future__ import annotations

import base64
import binascii
import zlib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import msgspec

from fieldtwin.gateway.core.errors import FileInvalid, UsageError
from fieldtwin.plc.st.coverage.places import Coverage, Kind, Place

MOST_PLACES = 100_000
"""Largest number of places of a run: 12.5 kB of its line in a ledger if it cannot be compressed."""
MOST_BYTES = 32 << 20
"""Largest size of the list of places before its compression, in bytes."""
_KEY = 8
"""Number of characters before the bitmap: the checksum of the list of places to which it belongs."""
_Row = tuple[str, int, int, str, str, str]


@dataclass(frozen=True, slots=True)
class CompactCoverage:
    """The places of the programs of a run, and which of them it executed. Both are empty if nothing was measured."""

    places: str = ""
    executed: str = ""


def compact(coverage: Mapping[Place, bool]) -> CompactCoverage:
    """Return the coverage of a run as two texts. Raises `UsageError` for more than `MOST_PLACES` places."""
    if not coverage:
        return CompactCoverage()
    if len(coverage) > MOST_PLACES:
        raise UsageError(
            "the programs are too large for the coverage of a campaign",
            expected=f"at most {MOST_PLACES} statements, branches and transitions",
            got=str(len(coverage)),
            hint="run the campaign without --coverage and --html",
        )
    ordered = sorted(coverage, key=_row)
    data = msgspec.msgpack.encode([_row(place) for place in ordered])
    bits = bytearray(-(-len(ordered) // 8))
    for number, place in enumerate(ordered):
        bits[number // 8] |= coverage[place] << number % 8
    return CompactCoverage(_text(data), _key(data) + _text(bits))


def joined_coverage(runs: Iterable[CompactCoverage]) -> Coverage:
    """Return the coverage by all runs together. The places of a run may be those of a different run. Raises `FileInvalid`."""
    known, executed = set[str](), set[str]()
    for run in runs:
        known.add(run.places)
        executed.add(run.executed)
    bits: dict[str, int] = {}
    for text in executed - {""}:
        bitmap = int.from_bytes(_data(text[_KEY:], MOST_PLACES // 8 + 1), "little")
        bits[text[:_KEY]] = bits.get(text[:_KEY], 0) | bitmap
    found = Coverage()
    for text in sorted(known - {""}):
        data = _data(text, MOST_BYTES)
        if _key(data) not in bits:
            continue
        places = _places(data)
        flags = bits[_key(data)].to_bytes(max(MOST_PLACES // 8 + 1, len(places) // 8 + 1), "little")
        for number, place in enumerate(places):
            reached = bool(flags[number // 8] >> number % 8 & 1)
            found.executed[place] = reached or found.executed.get(place, False)
    return found


def _row(place: Place) -> _Row:
    return place.path, place.line, place.column, place.kind.value, place.name, place.pou


def _places(data: bytes) -> list[Place]:
    try:
        rows = msgspec.msgpack.decode(data, type=list[_Row])
        return [Place(path, line, column, Kind(kind), name, pou) for path, line, column, kind, name, pou in rows]
    except ValueError as e:  # also that of msgspec
        raise FileInvalid(f"not a list of places: {e}", path="coverage") from e


def _key(data: bytes) -> str:
    return f"{zlib.crc32(data):08x}"


def _text(data: bytes | bytearray) -> str:
    return base64.b64encode(zlib.compress(data, 9)).decode()


def _data(text: str, most: int) -> bytes:
    """Return the bytes that `text` holds, at most `most`. Raises `FileInvalid`."""
    unpacked = zlib.decompressobj()
    try:
        data = unpacked.decompress(base64.b64decode(text, validate=True), most + 1)
    except (binascii.Error, ValueError, zlib.error) as e:
        raise FileInvalid(f"not a coverage of programs: {e}", path="coverage") from e
    if len(data) > most or not unpacked.eof:
        raise FileInvalid("not a coverage of programs: too long or incomplete", path="coverage")
    return data
