"""The test cases for Modbus clients: the action of the hostile device, and the expected reaction.

SL = MODBUS over Serial Line V1.02, TG = Messaging on TCP/IP Implementation Guide V1.0b, AP = Application Protocol
V1.1b3.

A case is REQUIRED only where a clause demands the behaviour. On a serial line SL 2.4.1 demands that the client checks
each reply before it uses the data; on TCP TG 4.4.1.3 demands the check of header, transaction ID, function code and
format. `on_tcp` gives the basis and the clause of a case on TCP, where they differ from those on a line.
"""

from __future__ import annotations

from fieldtwin.conformance.clients import checks
from fieldtwin.conformance.clients.habits import (
    bounded_addresses,
    broadcasts_wait,
    few_connections,
    legal_requests,
    no_broadcast_reads,
)
from fieldtwin.conformance.clients.modbus import line_replies as line_plays
from fieldtwin.conformance.clients.modbus import tcp_replies as tcp_plays
from fieldtwin.conformance.clients.modbus.setup import ModbusCase, ReplyFunction
from fieldtwin.conformance.core.case import OWN, Basis, CheckFunction, ClientCase, Impact

REQUIRED, ROBUST, FIELD = Basis.STANDARD, Basis.ROBUSTNESS, Basis.FIELD
READ, WRITE, CUT, LOOK = Impact.READ, Impact.WRITE, Impact.DISRUPT, Impact.OBSERVE
RTU, ASCII, LINES, TCP, STREAM = ("rtu",), ("ascii",), ("rtu", "ascii"), ("tcp",), ("stream",)


def _case(
    id: str,
    title: str,
    basis: Basis,
    clause: str,
    impact: Impact,
    play: ReplyFunction,
    check: CheckFunction,
    does: str,
    must: str,
) -> ModbusCase:
    return ModbusCase(ClientCase(id, title, clause, impact, does, must, check, basis=basis), play)


def _bad(
    id: str, title: str, basis: Basis, clause: str, play: ReplyFunction, does: str, must: str = "refuse it; go on"
) -> ModbusCase:
    return _case(id, title, basis, clause, READ, play, checks.rejects, does, must)


def _good(
    id: str, title: str, basis: Basis, clause: str, play: ReplyFunction, does: str, must: str = "take the answer"
) -> ModbusCase:
    case = _case(id, title, basis, clause, READ, play, checks.accepts, does, must)
    return case.on(holds_good=True, strikes=4)


def _waits(
    id: str, title: str, basis: Basis, clause: str, play: ReplyFunction, does: str, must: str = "take the answer"
) -> ModbusCase:
    case = _case(id, title, basis, clause, READ, play, checks.accepts_on_line, does, must)
    return case.on(holds_good=True, strikes=4)


def _watch(id: str, title: str, basis: Basis, clause: str, check: CheckFunction, must: str) -> ModbusCase:
    case = _case(id, title, basis, clause, LOOK, line_plays.nothing, check, "answers well during the whole run", must)
    return case.on(wants="nothing")


SILENT = _bad("MB-000", "no reply", ROBUST, "", line_plays.nothing, "is silent")
"""A test case outside the test-case list: the server does not answer, which measures the client's timeout."""

CASES: tuple[ModbusCase, ...] = (
    _bad("MB-002", "bad CRC in a reply", REQUIRED, "SL 2.4.1", line_plays.bad_crc, "inverts the CRC").on(framings=RTU),
    _bad("MB-003", "truncated reply", REQUIRED, "SL 2.4.1", line_plays.truncated, "sends half a reply",
         "time out; the next request is clean").on_tcp(ROBUST, OWN),
    _case("MB-005", "a pause inside a frame", REQUIRED, "SL 2.5.1.1", READ, line_plays.paused, checks.either,
          "pauses 10 ms in the middle", "take it (tolerant) or discard it (strict)").on(holds_good=True, strikes=3, framings=RTU),
    _waits("MB-006", "an adapter splits a frame by 16 ms", FIELD, "modbus-tk #13", line_plays.split_16_ms,
          "sends four pieces 16 ms apart").on(framings=RTU),
    _case("MB-007", "two frames closer than t3.5", ROBUST, "SL 2.5.1.1", READ, line_plays.glued, checks.either,
          "sends another unit's frame right before its own", "take its frame (tolerant) or discard both (strict)"
          ).on(holds_good=True, strikes=3, framings=RTU),
    _good("MB-008", "leading 00 / FF noise", FIELD, "minimalmodbus #61", line_plays.leading_noise,
          "sends 00 FF 00 before the reply", "skip the noise, take the frame").on(framings=RTU),
    _good("MB-009", "trailing 00s", FIELD, "HA #69742", line_plays.trailing_zeros, "sends 00 00 after the reply",
          "take the frame, drop the zeros").on(framings=RTU),
    _good("MB-010", "full local echo", ROBUST, OWN, line_plays.echo, "echoes the request, then answers",
          "skip the echo, take the answer").on(framings=RTU, needs="echo"),
    _bad("MB-011", "corrupt echo", REQUIRED, "SL 2.4.1", line_plays.corrupt_echo,
          "echoes the request with a bit flipped, nothing else").on(framings=RTU),
    _case("MB-012", "a late reply of another shape inside the next request", REQUIRED, "SL 2.4.1, AP 6; pymodbus PR #2636",
          READ, line_plays.late_other,
          checks.late_other, "answers a request when the next one, of another shape, has been sent", "never take it as data"
          ).on(wants="read", strikes=5).on_tcp(REQUIRED, "TG 4.4.1.3; pymodbus PR #2636"),
    _case("MB-013", "a late reply of identical shape", ROBUST, OWN, READ, line_plays.late, checks.late_same_shape,
          "answers after 1.5 timeouts", "never take it as the reply to the next request"
          ).on(strikes=1).on_tcp(REQUIRED, "TG 4.4.1.3"),
    _bad("MB-014", "a second reply", ROBUST, OWN, line_plays.second_reply, "answers twice, with another value the second time",
         "ignore the second").on_tcp(REQUIRED, "TG 4.4.1.3"),
    _bad("MB-015a", "a reply from an unexpected unit", REQUIRED, "SL 2.4.1; libmodbus PR #860", line_plays.other_unit,
         "answers with the id of another unit", "discard it").on_tcp(ROBUST, "TG 4.4.1.3; libmodbus PR #860"),
    _waits("MB-015b", "an unexpected unit's reply, then ours", REQUIRED, "SL 2.4.1", line_plays.other_unit_first,
           "sends a reply of another unit 10 to 40 ms before its own",
           "discard the first, keep the response timeout running, take the second"
           ).on(framings=LINES, least=4),
    _bad("MB-016", "wrong function code in a reply", REQUIRED, "SL 2.4.1, AP 4.1", line_plays.other_function,
          "answers with function code 04 instead of 03, or the reverse").on_tcp(REQUIRED, "TG 4.4.1.3, AP 4.1"),
    _bad("MB-017a", "byte count too small for the count asked", REQUIRED, "SL 2.4.1, AP 6.3", line_plays.too_few,
          "leaves out a register").on_tcp(REQUIRED, "TG 4.4.1.3, AP 6.3"),
    _bad("MB-017b", "byte count too large for the count asked", REQUIRED, "SL 2.4.1, AP 6.3", line_plays.too_many,
          "adds a register").on_tcp(REQUIRED, "TG 4.4.1.3, AP 6.3"),
    _bad("MB-018a", "byte count 255", REQUIRED, "SL 2.4.1, AP 6.3", line_plays.count_255, "announces 255 bytes and sends fewer",
         "refuse it within its timeout; go on").on_tcp(REQUIRED, "TG 4.4.1.3, AP 6.3"),
    _bad("MB-018b", "odd byte count", REQUIRED, "SL 2.4.1, AP 6.3", line_plays.odd_count, "adds half a register",
          "refuse it within its timeout; go on").on_tcp(REQUIRED, "TG 4.4.1.3, AP 6.3"),
    _case("MB-019", "write echo differs", ROBUST, "AP 6.6", WRITE, line_plays.other_echo, checks.write_echo,
          "confirms another value than was written", "say that the write failed: write again, or read back"
          ).on(wants="write", strikes=1),
    _case("MB-020", "exception for another function", REQUIRED, "SL 2.4.1, AP 7", READ, line_plays.other_exception,
          checks.not_our_exception, "sends the exception response of a function that was not requested", "refuse it; go on"
          ).on_tcp(REQUIRED, "TG 4.4.1.3, AP 7"),
    _case("MB-021", "exception frame of 5 bytes", ROBUST, "AP 7", READ, line_plays.exception_at_once_and_later(4),
          checks.short_frame, "answers with exception 04, the first time at once and the second time half a timeout later",
          "recognise it at once, without waiting for the length of a normal reply"),
    _case("MB-022", "vendor exception code", FIELD, "Telegraf #10597", READ, line_plays.exception(0x50), checks.survives,
          "answers with exception 50h", "go on"),
    _case("MB-023", "exception 05", ROBUST, "TG 4.4.2.5", READ, line_plays.exception(5), checks.survives,
          "answers with exception 05: the request takes longer", "go on polling"),
    _case("MB-024", "exception 06", ROBUST, "AP 7; HA #54345", READ, line_plays.exception(6), checks.busy,
          "answers 4 requests with exception 06: it is busy", "not ask more often; publish no value").on(strikes=4),
    _case("MB-025", "exception 02 in a merged read", FIELD, "ioBroker #581; Telegraf #14671", READ, line_plays.hole,
          checks.bisects,
          "refuses a read of several registers with exception 02", "ask for fewer registers").on(wants="read of several",
          strikes=6),
    _watch("MB-026", "broadcast write", REQUIRED, "SL 2.4.1; libmodbus #372", broadcasts_wait,
           "wait before the next request; 100 to 200 ms are usual"
           ).on(framings=LINES),
    _watch("MB-027", "broadcast read", REQUIRED, "SL 2.1; libmodbus #379", no_broadcast_reads,
           "send no read to unit 0: no unit answers it").on(framings=LINES),
    _case("MB-028", "unit 0 behind a gateway", FIELD, "mbusd #61", WRITE, line_plays.nothing, checks.unit_0,
          "does not answer a request to unit 0",
          "not repeat it because no reply came").on(framings=TCP, wants="request to unit 0", strikes=1),
    _watch("MB-036", "counts within the standard's", REQUIRED, "AP 6", legal_requests,
          "read 1 to 125 registers or 1 to 2000 bits, write 1 to 123 or 1 to 1968"),
    _watch("MB-037", "start and count within 65536", REQUIRED, "AP 4.4", bounded_addresses, "request no address beyond FFFFh"),
    _watch("MB-065b", "few connections", ROBUST, "TG 4.2.1", few_connections, "close connections that it no longer uses"
          ).on(framings=STREAM),
    _good("MB-051", "TCP byte by byte", REQUIRED, "TG 3.1.3", tcp_plays.bytewise,
          "sends each byte in a separate TCP segment").on(framings=TCP),
    _good("MB-052", "several ADUs in one segment", REQUIRED, "TG 3.1.3, 4.4.1.3; OpenPLC #253; pymodbus #1949",
          tcp_plays.with_stranger,
          "sends a reply with an unknown transaction id and its own reply in one segment",
          "discard the first, take the second").on(framings=TCP),
    _bad("MB-054a", "protocol id not 0", REQUIRED, "TG 4.4.1.3", tcp_plays.other_protocol, "answers with protocol id 1"
          ).on(framings=TCP),
    _good("MB-054b", "protocol id not 0, then ours", ROBUST, "TG 4.4.1.3", tcp_plays.other_protocol_first,
          "sends an ADU with protocol id 1 before its reply", "discard that ADU only, take the reply").on(framings=TCP),
    _bad("MB-055a", "length 0", REQUIRED, "TG 4.4.1.3", tcp_plays.length(0), "sends length 0 in the header: no byte follows",
         "discard or close").on(framings=TCP),
    _bad("MB-055b", "length 1", REQUIRED, "TG 4.4.1.3", tcp_plays.length(1),
          "sends length 1 in the header: only the unit id follows", "discard or close").on(framings=TCP),
    _bad("MB-055c", "length FFFFh", REQUIRED, "TG 4.4.1.3", tcp_plays.length(0xFFFF), "sends length 65535 in the header",
          "discard or close").on(framings=TCP),
    _bad("MB-056a", "unknown transaction id", REQUIRED, "TG 4.4.1.3; pymodbus #2709", tcp_plays.other_tag(0x1234),
          "answers with another transaction id").on(framings=TCP),
    _bad("MB-056b", "transaction id 0", REQUIRED, "TG 4.4.1.3; pymodbus #2844", tcp_plays.zero_tag,
          "answers with transaction id 0", "refuse it, unless it is set up to accept it").on(framings=TCP),
    _good("MB-056c", "unknown transaction id, then ours", REQUIRED, "TG 4.4.1.3", tcp_plays.other_tag_first,
          "sends a reply with another transaction id before its own", "discard the first, take the second").on(framings=TCP),
    _case("MB-064a", "reset inside a reply", ROBUST, "TG 4.2.2", CUT, tcp_plays.reset, checks.cut_off,
          "resets the connection inside a reply", "connect again, with a pause").on(framings=STREAM, strikes=3),
    _case("MB-064b", "the other side hangs up", ROBUST, "TG 4.2.2", CUT, tcp_plays.hang_up, checks.cut_off,
          "closes the connection instead of answering", "connect again, with a pause").on(framings=STREAM, strikes=3),
    _case("MB-064c", "half-open connection", ROBUST, "TG 4.2.2", CUT, tcp_plays.half_open, checks.cut_off,
          "leaves the connection open and no longer answers on it", "close it, connect again"
          ).on(framings=STREAM, strikes=1),
    _case("MB-065a", "connection limit", ROBUST, "TG 4.2.1", CUT, tcp_plays.closed_while_unused, checks.cut_off,
          "closes the connection while no request is pending", "connect again"
          ).on(framings=STREAM, strikes=3),
    _case("MB-066", "USB unplugged and back", FIELD, "pymodbus #2326", CUT, line_plays.unplugged(), checks.cut_off,
          "removes the port for 1 s", "open it again and go on").on(framings=("port",), strikes=1),
    _case("MB-067", "port locked", FIELD, "HA #144615", CUT, line_plays.unplugged(2.0), checks.cut_off,
          "removes the port for 1 s and locks it for 2 s when it is back", "try again and go on"
          ).on(framings=("lock",), strikes=1),
    _case("MB-068", "wrong baud rate or parity", ROBUST, OWN, CUT, line_plays.garbage, checks.survives,
          "answers with what a wrong baud rate makes of a reply", "go on, without a flood of requests").on(framings=RTU,
          strikes=3),
    _case("MB-069", "two clients on one line", FIELD, "pymodbus #432", CUT, line_plays.collision, checks.rejects,
          "overlays the reply with another frame", "never take it as data").on(framings=RTU),
    _bad("MB-070a", "ASCII: a bad LRC", REQUIRED, "SL 2.5.2.2", line_plays.bad_lrc, "sends a wrong LRC").on(framings=ASCII),
    _good("MB-070b", "ASCII: a second colon", REQUIRED, "SL 2.5.2.1", line_plays.second_colon,
          "begins a frame, and begins it again with a second colon",
          "discard what came before the second colon, take the frame").on(framings=ASCII),
    _bad("MB-070c", "ASCII: a gap over 1 s", REQUIRED, "SL 2.5.2.1", line_plays.long_gap, "pauses 1.2 s inside a reply",
         "discard it; go on").on(framings=ASCII),
)  # fmt: skip
"""All cases in the order of execution. Cases that only observe come last and check the whole run."""
