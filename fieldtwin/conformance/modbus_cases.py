"""The rows of the Modbus catalogue that concern masters, as cases: what the hostile device does, and what is expected.

SL = MODBUS over Serial Line V1.02, TG = Messaging on TCP/IP Implementation Guide V1.0b, AP = Application Protocol V1.1b3.
"""

from __future__ import annotations

from fieldtwin.conformance import judges, line_plays, tcp_plays
from fieldtwin.conformance.case import Case, Danger, Judge
from fieldtwin.conformance.habits import (
    bounded_addresses,
    broadcasts_wait,
    few_connections,
    legal_requests,
    no_broadcast_reads,
)
from fieldtwin.conformance.scene import ModbusCase, Play

READ, WRITE, CUT, LOOK = Danger.READ, Danger.WRITE, Danger.DISRUPT, Danger.OBSERVE
RTU, ASCII, LINES, TCP, STREAM = ("rtu",), ("ascii",), ("rtu", "ascii"), ("tcp",), ("stream",)


def _case(
    id: str, title: str, clause: str, danger: Danger, play: Play, judge: Judge, does: str, must: str
) -> ModbusCase:
    return ModbusCase(Case(id, title, clause, danger, does, must, judge), play)


def _bad(id: str, title: str, clause: str, play: Play, does: str, must: str = "refuse it; go on") -> ModbusCase:
    return _case(id, title, clause, READ, play, judges.rejects, does, must)


def _good(id: str, title: str, clause: str, play: Play, does: str, must: str = "take the answer") -> ModbusCase:
    return _case(id, title, clause, READ, play, judges.accepts, does, must).on(holds_good=True, strikes=4)


def _waits(id: str, title: str, clause: str, play: Play, does: str, must: str = "take the answer") -> ModbusCase:
    return _case(id, title, clause, READ, play, judges.accepts_on_line, does, must).on(holds_good=True, strikes=4)


def _watch(id: str, title: str, clause: str, judge: Judge, must: str) -> ModbusCase:
    return _case(id, title, clause, LOOK, line_plays.nothing, judge, "watches all of the run", must).on(wants="nothing")


SILENT = _bad("MB-000", "no reply", "", line_plays.nothing, "is silent")
"""No case of the catalogue: how the master's timeout is guessed."""

CASES: tuple[ModbusCase, ...] = (
    _bad("MB-002", "bad CRC in a reply", "SL 2.4.1", line_plays.bad_crc, "inverts the CRC").on(framings=RTU),
    _bad("MB-003", "truncated reply", "SL 2.4.1", line_plays.truncated, "sends half a reply",
         "time out; the next request is clean"),
    _case("MB-005", "a pause inside a frame", "SL 2.5.1.1", READ, line_plays.paused, judges.either,
          "pauses 10 ms in the middle", "take it (tolerant) or discard it (strict)").on(holds_good=True, strikes=3, framings=RTU),
    _waits("MB-006", "an adapter splits a frame by 16 ms", "modbus-tk #13", line_plays.split_16_ms,
          "sends four pieces 16 ms apart").on(framings=RTU),
    _case("MB-007", "two frames closer than t3.5", "SL 2.5.1.1", READ, line_plays.glued, judges.either,
          "sends another unit's frame right before ours", "take ours (tolerant) or discard both (strict)"
          ).on(holds_good=True, strikes=3, framings=RTU),
    _good("MB-008", "leading 00 / FF noise", "minimalmodbus #61", line_plays.leading_noise, "sends 00 FF 00 before the reply",
          "hunt, take the frame").on(framings=RTU),
    _good("MB-009", "trailing 00s", "HA #69742", line_plays.trailing_zeros, "sends 00 00 behind the reply",
          "take it, drop the tail").on(framings=RTU),
    _good("MB-010", "full local echo", "catalogue", line_plays.echo, "echoes the request, then answers", "strip the echo"
          ).on(framings=RTU, needs="echo"),
    _bad("MB-011", "corrupt echo", "catalogue", line_plays.corrupt_echo, "echoes the request with a bit flipped, nothing else"
         ).on(framings=RTU),
    _case("MB-012", "a late reply of another shape inside the next request", "pymodbus PR #2636", READ, line_plays.late_other,
          judges.late_other, "answers a request when the next one, of another shape, has been sent", "never take it as data"
          ).on(wants="read", strikes=5),
    _case("MB-013", "a late reply of identical shape", "catalogue", READ, line_plays.late, judges.late_same_shape,
          "answers after 1.5 timeouts", "hold the line for one more timeout and drain it; never take it as the next answer"
          ).on(strikes=1),
    _bad("MB-014", "a second reply", "catalogue", line_plays.second_reply, "answers twice, with another value the second time",
         "ignore the second"),
    _bad("MB-015a", "a reply from an unexpected unit", "SL 2.4.1; libmodbus PR #860", line_plays.other_unit,
         "another unit answers", "discard it"),
    _waits("MB-015b", "an unexpected unit's reply, then ours", "SL 2.4.1", line_plays.other_unit_first,
           "another unit answers 10 to 40 ms before ours", "discard the first, the timer keeps running, take ours"
           ).on(framings=LINES, least=4),
    _bad("MB-016", "wrong function code in a reply", "TG 4.4.1.3", line_plays.other_function, "answers for 04 instead of 03"),
    _bad("MB-017a", "byte count too small for the count asked", "AP 6.3", line_plays.too_few, "leaves out a register"),
    _bad("MB-017b", "byte count too large for the count asked", "AP 6.3", line_plays.too_many, "adds a register"),
    _bad("MB-018a", "byte count 255", "AP 6.3", line_plays.count_255, "announces 255 bytes and stops", "wait in bounds; recover"),
    _bad("MB-018b", "odd byte count", "AP 6.3", line_plays.odd_count, "adds half a register", "wait in bounds; recover"),
    _case("MB-019", "write echo differs", "AP 6.6", WRITE, line_plays.other_echo, judges.write_echo,
          "confirms another value than was written", "say that the write failed: write again, or read back"
          ).on(wants="write", strikes=1),
    _case("MB-020", "exception for another function", "AP 7", READ, line_plays.other_exception, judges.not_our_exception,
          "refuses a function that was not asked for", "refuse it; go on"),
    _case("MB-021", "exception frame of 5 bytes", "AP 7", READ, line_plays.exception_at_once_and_later(4), judges.short_frame,
          "answers with exception 04, once at once and once half a timeout later",
          "see it at once, without waiting for the normal length"),
    _case("MB-022", "vendor exception code", "Telegraf #10597", READ, line_plays.exception(0x50), judges.survives,
          "answers with exception 50h", "go on"),
    _case("MB-023", "exception 05", "TG 4.4.2.5", READ, line_plays.exception(5), judges.survives,
          "says that it takes longer", "poll on, do not fail"),
    _case("MB-024", "exception 06", "HA #54345", READ, line_plays.exception(6), judges.busy,
          "is busy for 4 requests", "back off; never publish 0").on(strikes=4),
    _case("MB-025", "exception 02 in a merged read", "ioBroker #581; Telegraf #14671", READ, line_plays.hole, judges.bisects,
          "refuses reads that touch the last register", "ask for less, learn the hole").on(wants="read of several", strikes=6),
    _watch("MB-026", "broadcast write", "SL 2.4.1; libmodbus #372", broadcasts_wait,
           "leave 100 ms before the next request"
           ).on(framings=LINES),
    _watch("MB-027", "broadcast read", "libmodbus #379", no_broadcast_reads,
           "refuse it locally: nobody answers").on(framings=LINES),
    _case("MB-028", "unit 0 behind a gateway", "mbusd #61", WRITE, line_plays.nothing, judges.unit_0, "answers nothing",
          "send it once, never again for want of an answer").on(framings=TCP, wants="request to unit 0", strikes=1),
    _watch("MB-036", "counts within the standard's", "AP 6", legal_requests, "never ask for 0, 126 registers, 2001 bits"),
    _watch("MB-037", "start and count within 65536", "AP 6", bounded_addresses, "never ask beyond FFFFh"),
    _watch("MB-065b", "few connections", "TG 4.2.1", few_connections, "close what it no longer uses").on(framings=STREAM),
    _good("MB-051", "TCP byte by byte", "catalogue", tcp_plays.bytewise, "sends one byte a segment").on(framings=TCP),
    _good("MB-052", "several ADUs in one segment", "OpenPLC #253; pymodbus #1949", tcp_plays.with_stranger,
          "sends an answer that nobody asked for and ours in one segment", "find ours").on(framings=TCP),
    _bad("MB-054a", "protocol id not 0", "TG 4.4.2.2", tcp_plays.other_protocol, "answers with protocol id 1").on(framings=TCP),
    _good("MB-054b", "protocol id not 0, then ours", "TG 4.4.2.2", tcp_plays.other_protocol_first,
          "sends an ADU of another protocol before the answer", "discard that ADU only").on(framings=TCP),
    _bad("MB-055a", "length 0", "TG 4.4.2.2", tcp_plays.length(0), "says that no byte follows",
         "discard or close").on(framings=TCP),
    _bad("MB-055b", "length 1", "TG 4.4.2.2", tcp_plays.length(1), "counts the unit id only",
         "discard or close").on(framings=TCP),
    _bad("MB-055c", "length FFFFh", "TG 4.4.2.2", tcp_plays.length(0xFFFF), "announces 65535 bytes", "discard or close"
         ).on(framings=TCP),
    _bad("MB-056a", "unknown transaction id", "TG 4.4.1.3; pymodbus #2709", tcp_plays.other_tag(0x1234), "answers with another id"
         ).on(framings=TCP),
    _bad("MB-056b", "transaction id 0", "TG 4.4.1.3; pymodbus #2844", tcp_plays.zero_tag, "answers with id 0",
         "refuse it, unless told otherwise").on(framings=TCP),
    _good("MB-056c", "unknown transaction id, then ours", "TG 4.4.1.3", tcp_plays.other_tag_first,
          "sends an answer with another id before ours", "discard the first, take ours").on(framings=TCP),
    _case("MB-064a", "reset inside a reply", "TG 4.2.2", CUT, tcp_plays.reset, judges.cut_off,
          "resets the connection inside a reply", "connect again, with a pause").on(framings=STREAM, strikes=3),
    _case("MB-064b", "the other side hangs up", "TG 4.2.2", CUT, tcp_plays.hang_up, judges.cut_off,
          "ends the connection instead of answering", "connect again, with a pause").on(framings=STREAM, strikes=3),
    _case("MB-064c", "half-open connection", "TG 4.2.2", CUT, tcp_plays.half_open, judges.cut_off,
          "says nothing any more on the connection and leaves it open", "close it, connect again"
          ).on(framings=STREAM, strikes=1),
    _case("MB-065a", "connection limit", "TG 4.2.1", CUT, tcp_plays.closed_while_unused, judges.cut_off,
          "ends the connection while it is not used", "connect again"
          ).on(framings=STREAM, strikes=3),
    _case("MB-066", "USB unplugged and back", "pymodbus #2326", CUT, line_plays.unplugged(), judges.cut_off,
          "takes the port away for 1 s", "open it again and go on").on(framings=("port",), strikes=1),
    _case("MB-067", "port locked", "HA #144615", CUT, line_plays.unplugged(2.0), judges.cut_off,
          "takes the port away for 1 s and holds it for 2 s when it is back", "try again and go on"
          ).on(framings=("lock",), strikes=1),
    _case("MB-068", "wrong baud rate or parity", "catalogue", CUT, line_plays.garbage, judges.survives,
          "answers with what a wrong baud rate makes of it", "go on, in bounds").on(framings=RTU, strikes=3),
    _case("MB-069", "two masters on one line", "pymodbus #432", CUT, line_plays.collision, judges.rejects,
          "overlays the reply with another frame", "never take it as data").on(framings=RTU),
    _bad("MB-070a", "ASCII: a bad LRC", "SL 2.5.2.2", line_plays.bad_lrc, "sends another LRC").on(framings=ASCII),
    _good("MB-070b", "ASCII: a second colon", "SL 2.5.2.1", line_plays.second_colon, "begins a frame, and begins again",
          "start afresh at the second colon").on(framings=ASCII),
    _bad("MB-070c", "ASCII: a gap over 1 s", "SL 2.5.2.1", line_plays.long_gap, "pauses 1.2 s inside a reply",
         "discard it; go on").on(framings=ASCII),
)  # fmt: skip
"""In the order in which they are played; observers judge the whole run in the end."""
