"""Judges of what only CANopen has: aborts, NMT, SYNC. Pure functions of an `Observation`."""

from __future__ import annotations

from fieldtwin.conformance.case import Finding, Judge, failed, inconclusive, passed, skipped
from fieldtwin.conformance.judges import DUTIES, all_of
from fieldtwin.conformance.observation import Asked, Observation, Sent

ABORT, NMT, SYNC, SDO_REQUEST = 0x80, 0x000, 0x080, 0x600


def aborts_with(code: int, *others: int) -> Judge:
    """The master ends the transfer by this abort code, or one of `others`, so that the node knows."""

    def aborted(seen: Observation) -> Finding | None:
        codes = [
            int.from_bytes(s.data[6:10], "little")
            for s in seen.of(Sent, seen.begun_ns)
            if SDO_REQUEST < _id(s) < SDO_REQUEST + 0x80 and s.data[2:3] == bytes((ABORT,))
        ]
        if {code, *others} & set(codes):
            return None
        if codes:
            return failed(f"aborted with {codes[0]:08X}h; expected {code:08X}h")
        return failed(f"sent no abort; expected {code:08X}h")

    return all_of(*DUTIES, aborted)


def _restarted(seen: Observation) -> Finding | None:
    for sent in seen.of(Sent, seen.over_ns):
        if _id(sent) == NMT:
            return passed("it commanded the node anew")
    for asked in seen.of(Asked, seen.over_ns):
        if asked.target[1] >> 5 == 1:
            return passed("it wrote to the node anew")
    return inconclusive("it neither commanded nor wrote to the node: right only for a master that configures nothing")


reconfigures = all_of(*DUTIES, _restarted)


def legal_nmt(seen: Observation) -> Finding:
    frames = [s for s in seen.of(Sent) if _id(s) == NMT]
    for sent in frames:
        if len(sent.data) != 4 or sent.data[3] > 127:
            return failed(f"sent the NMT frame {sent.data[2:].hex(' ')}")
    return passed(f"{len(frames)} NMT frames") if frames else skipped("it sent no NMT")


def legal_sync(seen: Observation) -> Finding:
    frames = [s for s in seen.of(Sent) if _id(s) == SYNC]
    for sent in frames:
        if len(sent.data) > 3:
            return failed(f"sent a SYNC of {len(sent.data) - 2} bytes")
    return passed(f"{len(frames)} SYNC") if frames else skipped("it sent no SYNC")


def _id(sent: Sent) -> int:
    return int.from_bytes(sent.data[:2], "big")
