"""The test cases for CANopen masters that can be checked on the bus. Clauses are CiA 301 v4.2 unless stated otherwise.

A case is REQUIRED only where a clause demands the behaviour. A client has to refuse a value that was transferred
wrongly, but it may omit the abort to the node (7.2.4: client and server "may" execute it): a case that expects an abort
is ROBUST. Only the end of a block upload has to be confirmed or aborted. The reaction of a master to the loss or the
restart of a node is the application's decision: such cases are ROBUST as well.
"""

from __future__ import annotations

from collections.abc import Callable

from fieldtwin.conformance.clients import checks
from fieldtwin.conformance.clients.canopen import replies as plays
from fieldtwin.conformance.clients.canopen.checks import (
    aborts_with,
    completes,
    is_unmoved,
    legal_nmt,
    legal_sync,
    notices,
    one_a_block,
    reconfigures,
    takes_the_switch,
    waits_for_each,
)
from fieldtwin.conformance.clients.canopen.setup import CanopenCase, SdoReplyFunction
from fieldtwin.conformance.core.case import OWN, Basis, CheckFunction, ClientCase, Impact

REQUIRED, ROBUST, FIELD = Basis.STANDARD, Basis.ROBUSTNESS, Basis.FIELD
READ, CUT, LOOK = Impact.READ, Impact.DISRUPT, Impact.OBSERVE


def _case(
    id: str,
    title: str,
    basis: Basis,
    clause: str,
    impact: Impact,
    play: SdoReplyFunction,
    check: CheckFunction,
    does: str,
    must: str,
) -> CanopenCase:
    return CanopenCase(ClientCase(id, title, clause, impact, does, must, check, basis=basis), play)


def _watch(id: str, title: str, basis: Basis, clause: str, check: CheckFunction, must: str) -> CanopenCase:
    case = _case(id, title, basis, clause, LOOK, plays.nothing, check, "answers well during the whole run", must)
    return case.on(wants="nothing")


RESTART_S = 2.0
"""Time within which a master has to notice that a node booted, and to start it."""
SILENT = _case("CO-000", "no reply", ROBUST, "", READ, plays.nothing, checks.rejects, "is silent", "")
"""A test case outside the test-case list: the node does not answer, which measures the master's SDO timeout."""
BLOCK: Callable[[CanopenCase], CanopenCase] = lambda case: case.on(wants="block upload")  # noqa: E731
DOWN: Callable[[CanopenCase], CanopenCase] = lambda case: case.on(wants="block download")  # noqa: E731

CASES: tuple[CanopenCase, ...] = (
    _case("CO-001", "toggle bit repeated in a segment", ROBUST, "7.2.4", READ, plays.same_toggle, aborts_with(0x05030000),
          "repeats the toggle bit in the second segment", "abort with 05030000").on(strikes=1),
    _case("CO-002", "abort amid segments", REQUIRED, "7.2.4", READ, plays.aborts_amid, checks.rejects,
          "sends one segment of a value and then an abort", "not take part of a value; go on").on(strikes=1),
    _case("CO-004", "unknown command specifier", ROBUST, "7.2.4", READ, plays.unknown_command, aborts_with(0x05040001,
          0x05040000), "answers with E0h", "abort with 05040001, or with 05040000 once it has waited").on(strikes=1),
    _case("CO-005", "a reply for another object", REQUIRED, "7.2.4; canopen-stack #132", READ, plays.other_object, checks.rejects,
          "answers for another index", "never mistake it for the requested object"),
    _case("CO-006", "write refused", REQUIRED, "7.2.4", Impact.WRITE, plays.refuses_write, checks.survives,
          "aborts a download at once with 06010002", "end the transfer; go on").on(wants="download"),
    _case("CO-008", "missing index", REQUIRED, "7.2.4", READ, plays.no_object, checks.survives, "aborts with 06020000", "go on"),
    _case("CO-013", "segmented total differs from the indicated size", REQUIRED, "7.2.4", READ, plays.other_length,
          checks.rejects, "indicates 14 bytes and ends after a few", "refuse the value").on(strikes=1),
    BLOCK(_case("CO-015", "block CRC mismatch", REQUIRED, "7.2.4", READ, plays.wrong_crc, aborts_with(0x05040004),
          "ends a block upload with a wrong CRC", "abort with 05040004").on(strikes=1)),
    BLOCK(_case("CO-016", "segment lost in a block", REQUIRED, "7.2.4; CN #205", READ, plays.loses(5), checks.accepts,
          "leaves out a segment", "acknowledge the last good one").on(holds_good=True)),
    BLOCK(_case("CO-017", "segment lost in the last sub-block", REQUIRED, "7.2.4; py #618", READ, plays.loses(-2), checks.accepts,
          "leaves out the last segment but one", "recover").on(holds_good=True)),
    BLOCK(_case("CO-020", "one acknowledgement a sub-block", REQUIRED, "7.2.4", READ, plays.honest, one_a_block,
          "sends all segments", "acknowledge each sub-block once, and no single segment").on(strikes=1)),
    BLOCK(_case("CO-021", "switch from block to normal upload", REQUIRED, "7.2.4.3.13", READ, plays.expedited_instead,
          takes_the_switch,
          "answers a block upload by an expedited one", "take it, where its request allows the switch (pst above 0)"
          ).on(holds_good=True)),
    DOWN(_case("CO-014a", "block size 0", ROBUST, "7.2.4; CN PR #42", READ, plays.block_size(0), aborts_with(0x05040002),
          "allows no segment of a block download", "abort with 05040002").on(strikes=1)),
    DOWN(_case("CO-014b", "block size 128", ROBUST, "7.2.4; CN PR #42", READ, plays.block_size(128), aborts_with(0x05040002),
          "allows 128 segments of a block download at once", "abort with 05040002").on(strikes=1)),
    DOWN(_case("CO-018", "early acknowledge of a sub-block", FIELD, "CN #426", READ, plays.honest, completes,
          "acknowledges a sub-block after its second segment", "send the rest, renumbered from 1").on(strikes=1, early=2)),
    DOWN(_case("CO-015b", "block CRC refused", REQUIRED, "7.2.4", READ, plays.refuses_crc, checks.survives,
          "aborts a block download with 05040004: wrong check sum", "end the transfer; go on").on(strikes=1)),
    DOWN(_case("CO-016b", "segment of a block download lost", REQUIRED, "7.2.4; CN #205", READ, plays.honest, completes,
          "does not receive the second segment", "send again from there, renumbered from 1").on(strikes=1, misses=2)),
    _case("CO-022", "slow segments", ROBUST, OWN, READ, plays.slow_segments, checks.accepts,
          "takes 0.35 timeouts for each of five steps", "start the timeout again at each step, and take the value").on(
          holds_good=True),
    _case("CO-023", "response after the client's timeout", ROBUST, OWN, READ, plays.late, checks.late_same_shape,
          "answers after 1.5 timeouts", "discard it, never pair it with the next request").on(strikes=1),
    _case("CO-024", "a stale timeout", FIELD, "canopen-stack #146", READ, plays.unhurried, waits_for_each,
          "takes 0.6 timeouts for each reply", "never end a transfer by the timeout of the one before").on(strikes=4),
    _case("CO-025", "a responder floods garbage", FIELD, "py #409", CUT, plays.flood, checks.survives,
          "sends 30 replies with unknown command specifiers, then the right one",
          "go on, without a flood of requests"),
    _case("CO-026", "SDO shorter than 8 bytes", ROBUST, "CN #584", READ, plays.short, checks.either,
          "leaves out the unused bytes of its reply", "ignore it, or take the value").on(holds_good=True, strikes=2),
    _case("CO-027", "NMT reset during a transfer", ROBUST, "7.3.2.2.1", READ, plays.restarts, checks.survives,
          "sends a boot-up message instead of a reply", "end the transfer; go on"),
    _case("CO-028", "SDO in STOPPED", ROBUST, "7.3.2.2.4", CUT, plays.honest, checks.survives,
          "is STOPPED for 4 s, reports this state, and does not answer SDO requests",
          "go on asking, without a flood of requests").on(strikes=1, mutes="sdo"),
    _case("CO-029", "expedited without the size bit", REQUIRED, "7.2.4", READ, plays.no_size, checks.accepts,
          "leaves the size to the object", "take the object's own length").on(holds_good=True, strikes=4),
    _case("CO-030", "size 0 transfer", ROBUST, OWN, READ, plays.empty, checks.rejects,
          "answers with a value of no bytes", "never take it for a number; go on"),
    _case("CO-034", "boot-up storm", ROBUST, OWN, CUT, plays.boot_storm, checks.survives, "lets 20 nodes boot at once",
          "go on").on(strikes=1),
    _case("CO-035", "unexpected boot-up", ROBUST, OWN, READ, plays.boots, reconfigures,
          "boots without a command", "configure and start it again").on(strikes=1, trail_s=RESTART_S),
    _case("CO-036a", "heartbeat lost", ROBUST, "7.2.8", READ, plays.honest, notices,
          "sends no heartbeat for 4 s; everything else continues", "notice it; go on").on(
          strikes=1, mutes="heartbeat", framings=("heartbeat",)),
    _case("CO-036b", "node lost and back", ROBUST, "7.2.8", CUT, plays.honest, checks.survives,
          "sends nothing at all for 4 s", "go on asking, without a flood of requests").on(strikes=1, mutes="all"),
    _case("CO-037", "late heartbeat", ROBUST, "7.2.8", READ, plays.honest, is_unmoved,
          "sends one heartbeat 0.2 s late; everything else continues", "report no loss within its consumer time").on(
          strikes=1, beat_late_s=0.2, framings=("heartbeat",)),
    _case("CO-038", "restart while timed out", FIELD, "CN #636", CUT, plays.honest, reconfigures,
          "sends nothing at all for 4 s, then boots", "configure and start it again; go on monitoring it").on(
          strikes=1, mutes="all", boots=True, trail_s=RESTART_S),
    _case("CO-039a", "heartbeat of length 0", ROBUST, "7.2.8", READ, plays.heartbeat(b""), checks.survives,
          "sends an empty heartbeat", "ignore it"),
    _case("CO-039b", "heartbeat of an unknown state", ROBUST, "7.2.8", READ, plays.heartbeat(b"\x55"), checks.survives,
          "sends a heartbeat with state 55h", "ignore it"),
    _case("CO-040", "guarding toggle wrong", ROBUST, "7.2.8", READ, plays.nothing, checks.survives,
          "repeats the toggle bit of a guard reply", "go on").on(wants="guard request", strikes=1),
    _case("CO-042", "two nodes with one id", ROBUST, OWN, READ, plays.twin, checks.rejects,
          "answers twice, with another value the second time", "never take the second for a later request"),
    _case("CO-043", "PDO too short", REQUIRED, "7.5.2.36", READ, plays.short_pdo, checks.rejects,
          "sends a TPDO of one byte", "use no byte of it"),
    _case("CO-044", "PDO outside OPERATIONAL", ROBUST, "7.3.2.2.2", READ, plays.pdo_outside, checks.rejects,
          "reports PRE-OPERATIONAL and sends a TPDO", "use no byte of it"),
    _case("CO-052", "EMCY burst", ROBUST, "7.2.7", CUT, plays.emcy_burst, checks.survives, "sends 20 EMCY messages", "go on"
          ).on(strikes=1),
    _case("CO-053", "EMCY shorter than 8 bytes", ROBUST, "7.2.7", READ, plays.emcy_short, checks.survives,
          "sends an EMCY message of 3 bytes", "go on"),
    _case("CO-054", "EMCY 0000h while other errors are active", ROBUST, "7.2.7", READ, plays.emcy_partly_over, checks.survives,
          "sends two EMCY messages, and then that one of the errors is over", "go on"),
    _case("CO-060", "extended id with a CANopen number", ROBUST, OWN, READ, plays.extended, checks.rejects,
          "answers with a 29-bit identifier", "ignore it"),
    _case("CO-062", "frames lost", ROBUST, OWN, READ, plays.unanswered, checks.survives, "does not receive two requests",
          "time out; the next request is clean"),
    _watch("CO-033", "NMT of another length, node > 127", REQUIRED, "7.2.8", legal_nmt,
          "send NMT commands of 2 bytes to node ids up to 127"),
    _watch("CO-047", "SYNC of the wrong length", REQUIRED, "7.2.5", legal_sync,
          "send SYNC with no byte, or with the counter alone"),
)  # fmt: skip
"""All cases in the order of execution. Cases that only observe come last and check the whole run."""
