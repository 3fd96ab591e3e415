"""Judges of what only CANopen has: aborts, NMT, SYNC. Pure functions of an `Observation`."""

from __future__ import annotations

from fieldtwin.conformance.case import Finding, Judge, failed, inconclusive, passed, skipped
from fieldtwin.conformance.judges import DUTIES, all_of
from fieldtwin.conformance.observation import Asked, Observation, Sent, Shown, Told, Word

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


BLOCK_ENDED = 0xA1


def _block_ended(seen: Observation) -> Finding | None:
    for told in seen.of(Told, seen.begun_ns):
        if told.data[:1] == bytes((BLOCK_ENDED,)):
            return None
    return failed("the block download was never brought to its end")


completes = all_of(*DUTIES, _block_ended)


def _noticed(seen: Observation) -> Finding | None:
    """That a node's heartbeat stayed away shows in what is published, or in what is done about it."""
    if any(shown.word is Word.NONE for shown in seen.of(Shown, seen.begun_ns, seen.over_ns)):
        return passed("its value was none meanwhile")
    if any(_id(sent) == NMT for sent in seen.of(Sent, seen.begun_ns)):
        return passed("it commanded the node")
    return inconclusive("nothing shows that it noticed: right only for a master that watches no heartbeat")


notices = all_of(*DUTIES, _noticed)


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
