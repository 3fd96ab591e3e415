"""The CANopen test cases that can be run on a node from outside, through its SDO server, NMT and LSS alone.

Cases that need the node's PDO configuration, its outputs, its errors or a disturbed bus are not here: CO-018, CO-022 to
CO-025, CO-030, CO-034 to CO-039, CO-042, CO-043, CO-045 to CO-056, CO-058, CO-059, CO-061 to CO-066.
"""

from __future__ import annotations

from functools import partial

from fieldtwin.conformance.core.case import OWN, Basis, Impact
from fieldtwin.conformance.devices.canopen import nmt_cases as nmt
from fieldtwin.conformance.devices.canopen import sdo_cases as sdo
from fieldtwin.conformance.devices.canopen import write_cases as write
from fieldtwin.conformance.devices.canopen.connection import NodeConnection
from fieldtwin.conformance.devices.device_case import CaseProcedure, DeviceCase

CanopenCase = DeviceCase[NodeConnection]
READ, WRITE, DISRUPT = Impact.READ, Impact.WRITE, Impact.DISRUPT
OBJECT = ("object",)


def case(
    id: str,
    title: str,
    clause: str,
    impact: Impact,
    does: str,
    must: str,
    play: CaseProcedure[NodeConnection],
    needs: tuple[str, ...] = (),
    basis: Basis = Basis.STANDARD,
) -> CanopenCase:
    return DeviceCase(id, title, clause, impact, does, must, play, needs=needs, basis=basis)


robust = partial(case, basis=Basis.ROBUSTNESS)
field = partial(case, basis=Basis.FIELD)

CASES: tuple[CanopenCase, ...] = (
    case("CO-001a", "toggle bit repeated in an upload", "7.2.4", READ,
         "two segments asked for with the same toggle, then the next one",
         "abort 05030000 for the repeated toggle, then abort 05040001: the transfer is over", sdo.toggle_repeated),
    case("CO-001b", "toggle bit repeated in a download", "7.2.4", WRITE, "the second segment sent with the same toggle",
         "abort 05030000, nothing written", write.toggle_repeated, OBJECT),
    case("CO-002", "client aborts mid-segment", "7.2.4", READ, "an abort, then the next segment requested",
         "silence, then abort 05040001", sdo.client_aborts),
    case("CO-003a", "upload segment without initiate", "7.2.4", READ, "a segment requested", "abort 05040001",
         sdo.segment_alone),
    case("CO-003b", "download segment without initiate", "7.2.4", WRITE, "a segment sent", "abort 05040001",
         write.segment_alone),
    case("CO-004", "unknown command specifier", "7.2.4", DISRUPT, "E0", "abort 05040001", sdo.unknown_specifier),
    field("CO-005", "a new initiate during a transfer", "canopen-stack #132", READ, "an upload of 1000h in the middle of another",
         "answer it, or abort it and answer the next one", sdo.begun_anew),
    case("CO-006a", "write to a read-only object", "7.2.4", WRITE, "1000h, expedited, with its own value", "abort 06010002",
         write.read_only_expedited),
    case("CO-006b", "write to a read-only object in segments", "7.2.4", WRITE, "1000h, 20 bytes announced",
         "abort 06010002 at initiate", write.read_only_segmented),
    case("CO-007", "read of a write-only object", "7.2.4", READ, "an upload of what the EDS says is write-only",
         "abort 06010001", sdo.write_only, ("eds",)),
    case("CO-008a", "missing index", "7.2.4", READ, "an upload of an index that hardly any device has", "abort 06020000",
         sdo.missing_index),
    case("CO-008b", "subindex of a VAR", "7.2.4", READ, "1000h:01", "abort 06090011", sdo.subindex_of_a_var),
    case("CO-008c", "subindex beyond sub 00", "7.2.4", READ, "one more than 1018h (1010h, 1016h, 1029h) has", "abort 06090011",
         sdo.subindex_beyond),
    case("CO-009a", "too long", "7.2.4", WRITE, "a download of one byte more", "abort 06070012 or 06070010",
         write.too_long, OBJECT),
    case("CO-009b", "too short", "7.2.4", WRITE, "a download of one byte less", "abort 06070013 or 06070010",
         write.too_short, OBJECT),
    case("CO-010a", "above limit", "7.2.4", WRITE, "one more than HighLimit", "abort 06090031 or 06090030",
         write.above_limit, ("object", "eds")),
    case("CO-010b", "below limit", "7.2.4", WRITE, "one less than LowLimit", "abort 06090032 or 06090030",
         write.below_limit, ("object", "eds")),
    case("CO-011", "1003h:00 written non-zero", "7.5.2.4", WRITE, "1003h:00 = 1", "abort 06090030 or 08000000",
         write.history_set),
    field("CO-012", "1003h:01 while empty", "CN PR #253", READ, "1003h:01", "abort 08000024 or 08000000", sdo.empty_history),
    case("CO-013a", "more than the indicated size", "7.2.4", WRITE, "a segment with a byte more", "abort 06070012 or 06070010",
         write.more_than_announced, OBJECT),
    case("CO-013b", "less than the indicated size", "7.2.4", WRITE, "a segment with a byte less", "abort 06070013 or 06070010",
         write.less_than_announced, OBJECT),
    case("CO-014a", "block size 0", "7.2.4; CN PR #42", READ, "a block upload of 0 segments a block", "abort 05040002",
         sdo.block_size_0),
    case("CO-014b", "block size 128", "7.2.4; CN PR #42", READ, "a block upload of 128 segments a block", "abort 05040002",
         sdo.block_size_128),
    case("CO-015", "block CRC mismatch", "7.2.4", WRITE, "a block download that ends in another CRC",
         "abort 05040004, nothing written", write.crc_mismatch, OBJECT),
    case("CO-016", "segment lost in a block upload", "7.2.4; CN #205", READ, "the last segment of a block is not acknowledged",
         "send it again, from 1", sdo.segment_lost),
    case("CO-017", "segment lost in the last sub-block", "7.2.4; py #618", WRITE, "a block download without its second segment",
         "acknowledge the first, recover", write.segment_lost, OBJECT),
    field("CO-019", "a request right after block-upload end", "CN #39", READ, "the end of a block upload, at once 1000h",
         "answer it", sdo.right_after_the_end),
    case("CO-020", "per-segment replies inside a block", "7.2.4", WRITE, "a block download", "one reply a block",
         write.one_reply_a_block, OBJECT),
    case("CO-021", "switch from block to normal upload", "7.2.4", READ, "a block upload that does not allow the switch",
         "blocks, or an abort", sdo.no_switch_unasked),
    robust("CO-026", "SDO shorter than 8 bytes", "CN #584", READ, "an upload request of 4 bytes", "ignore it, or take it; go on",
         sdo.short_request),
    case("CO-027", "NMT reset during an SDO transfer", "7.3.2.2.1", DISRUPT, "reset communication in the middle of an upload",
         "boot-up; the transfer is over", nmt.reset_in_a_transfer),
    case("CO-028", "SDO in STOPPED", "7.3.2.2.4", DISRUPT, "NMT stop, 1000h", "silence", nmt.stopped),
    case("CO-029", "expedited without the size bit", "7.2.4", WRITE, "a number, expedited, without size", "take its own length",
         write.without_size, OBJECT),
    case("CO-031", "1010h with a wrong signature", "7.5.2.13", DISRUPT, "1010h:01 = 'none'", "abort 08000020 or 08000022",
         write.store_signature),
    case("CO-032a", "reset node", "7.3.2.2.1", DISRUPT, "NMT 81", "boot-up, PRE-OPERATIONAL", nmt.reset_node),
    case("CO-032b", "reset communication", "7.3.2.2.1", DISRUPT, "NMT 82", "boot-up, PRE-OPERATIONAL", nmt.reset_communication),
    robust("CO-033", "NMT with another length, node > 127", "7.2.8", DISRUPT, "resets of 1 and 3 bytes, and of node id + 128",
         "ignore them", nmt.odd_commands),
    case("CO-040", "guard requests", "7.2.8", DISRUPT, "two remote frames", "answer, toggle alternating", nmt.guarding),
    field("CO-041", "1017h changed live", "py #672", WRITE, "1017h = 200 ms", "the new period at once", write.heartbeat_changed,
         OBJECT),
    case("CO-044", "no TPDO outside OPERATIONAL", "7.3.2.2.2", DISRUPT, "NMT enter PRE-OPERATIONAL, a second of listening",
         "no PDO", nmt.silent_outside),
    field("CO-057", "fastscan with only configured nodes", "py #226", DISRUPT, "the first step of a fastscan", "silence",
         nmt.fastscan),
    robust("CO-060", "extended id with a CANopen number", OWN, READ, "1000h, asked for with a 29-bit identifier",
         "ignore it", sdo.extended_identifier),
)  # fmt: skip
