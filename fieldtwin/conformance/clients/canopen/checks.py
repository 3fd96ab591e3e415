"""Checks that are specific to CANopen: aborts, NMT, SYNC. Each is a function of an `Observation` alone."""

from __future__ import annotations

from itertools import pairwise

from fieldtwin.conformance.clients.checks import accepts, owes, publishes_nothing_bad
from fieldtwin.conformance.core.case import CheckFunction, Finding, failed, inconclusive, passed, skipped
from fieldtwin.conformance.core.observation import Observation, ReplySent, RequestSeen, Sent, ValuePublished, Word
from fieldtwin.gateway.core.clock import NS_PER_S
from fieldtwin.results.model import Verdict

ABORT, NMT, SYNC, SDO_REQUEST = 0x80, 0x000, 0x080, 0x600
BLOCK_UPLOAD = 5
"""Client command specifier of a block upload."""


def aborts_with(code: int, *others: int) -> CheckFunction:
    """Return a check that the master ends the transfer with an SDO abort with `code` or one of `others`, which informs the
    node.
    """

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

    return owes(aborted)


BLOCK_ENDED = 0xA1


def _block_ended(seen: Observation) -> Finding | None:
    for told in seen.of(ReplySent, seen.begun_ns):
        if told.data[:1] == bytes((BLOCK_ENDED,)):
            return None
    return failed("the block download was never completed")


completes = owes(_block_ended)


def _noticed(seen: Observation) -> Finding | None:
    """Check that the master notices a missing heartbeat: it publishes no value meanwhile, or sends an NMT command.

    The result is inconclusive otherwise, because a master need not monitor heartbeats.
    """
    if any(shown.word is Word.NONE for shown in seen.of(ValuePublished, seen.begun_ns, seen.over_ns)):
        return passed("it published no value meanwhile")
    if any(_id(sent) == NMT for sent in seen.of(Sent, seen.begun_ns)):
        return passed("it commanded the node")
    return inconclusive("there is no sign that it noticed: correct only for a master that monitors no heartbeat")


notices = owes(_noticed)


def _unmoved(seen: Observation) -> Finding | None:
    """Check that a heartbeat that is slightly late has no effect: the master sends no command and continues to publish the
    value.
    """
    moved = any(_id(sent) == NMT for sent in seen.of(Sent, seen.begun_ns))
    if moved or any(shown.word is Word.NONE for shown in seen.of(ValuePublished, seen.begun_ns)):
        return inconclusive("it treated the node as lost: correct only if its consumer time is shorter")
    return None


is_unmoved = owes(_unmoved)


def _waits_for_each(seen: Observation) -> Finding | None:
    """Check that the master did not repeat a request before the answer to it arrived.

    In this test case every answer arrives within the timeout of its request.
    """
    asked = list(seen.of(RequestSeen, seen.begun_ns, seen.over_ns))
    for one, following in pairwise(asked):
        told = next(seen.of(ReplySent, one.t_ns, seen.over_ns), None)
        if told is None or told.good or following.t_ns >= told.t_ns:
            continue
        after_s, due_s = (following.t_ns - one.t_ns) / NS_PER_S, (told.t_ns - one.t_ns) / NS_PER_S
        said = f"asked again {after_s:.2f} s after a request that was answered after {due_s:.2f} s"
        return (
            failed(said)
            if seen.timeout_s
            else inconclusive(f"{said}: a failure if its timeout is longer: give --timeout")
        )
    return None


waits_for_each = owes(_waits_for_each)


def takes_the_switch(seen: Observation) -> Finding:
    """Apply the check `accepts` if the client permits the node to answer a block upload request with an ordinary upload.

    A client that sends a protocol switch threshold of 0 forbids this (7.2.4.3.13). It may then refuse each such reply; only
    a wrong published value is a failure.
    """
    found = accepts(seen)
    first = next(seen.of(RequestSeen, seen.begun_ns), None)
    forbidden = first is not None and first.target[1] >> 5 == BLOCK_UPLOAD and first.target[6:7] == b"\0"
    if not forbidden or found.verdict is not Verdict.FAILED:
        return found
    return publishes_nothing_bad(seen) or skipped("its requests forbid the switch: the protocol switch threshold is 0")


def _one_a_block(seen: Observation) -> Finding | None:
    """Check that the master acknowledges each sub-block once, and does not acknowledge single segments."""
    acknowledged = [s for s in seen.of(Sent, seen.begun_ns, seen.over_ns) if s.data[2] & 0xE3 == BLOCK_ACKNOWLEDGED]
    segments = sum(
        1 for t in seen.of(ReplySent, seen.begun_ns, seen.over_ns) if t.data[0] & 0x7F and t.data[0] not in _OTHERS
    )
    if not acknowledged:
        return inconclusive("no acknowledgement of a sub-block was seen")
    if len(acknowledged) * 4 > max(segments, 4):
        return failed(f"{len(acknowledged)} acknowledgements of {segments} segments")
    return None


BLOCK_ACKNOWLEDGED = 0xA2
_OTHERS = frozenset((*range(0xC0, 0xE0), ABORT))
"""First bytes of the node's block upload frames that are not segments: the initiate response, the end and the abort."""
one_a_block = owes(_one_a_block)


def _restarted(seen: Observation) -> Finding | None:
    for sent in seen.of(Sent, seen.over_ns):
        if _id(sent) == NMT:
            return passed("it commanded the node again")
    for asked in seen.of(RequestSeen, seen.over_ns):
        if asked.target[1] >> 5 == 1:
            return passed("it wrote to the node again")
    return inconclusive("it neither commanded nor wrote to the node: correct only for a master that configures no node")


reconfigures = owes(_restarted)


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
