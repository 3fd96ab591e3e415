"""The Modbus test cases that can be run on a device from outside.

Cases that only concern clients and gateways are not here; nor MB-048 (only a profile defines values of several
registers), MB-058 to MB-063 (the devices behind a gateway are not visible) and MB-066, MB-067 (they concern the
operating system).
"""

from __future__ import annotations

from functools import partial

from fieldtwin.conformance.core.case import OWN, Basis, Elsewhere, Impact
from fieldtwin.conformance.devices.device_case import CaseProcedure, DeviceCase
from fieldtwin.conformance.devices.modbus import line_cases as line
from fieldtwin.conformance.devices.modbus import pdu_cases as pdu
from fieldtwin.conformance.devices.modbus import tcp_cases as tcp
from fieldtwin.conformance.devices.modbus import write_cases as write
from fieldtwin.conformance.devices.modbus.connection import DeviceConnection

ModbusCase = DeviceCase[DeviceConnection]
READ, WRITE, DISRUPT = Impact.READ, Impact.WRITE, Impact.DISRUPT
LINE = ("rtu-line",)
ASCII = ("ascii-line",)
FRAMED = ("rtu-line", "rtu-stream")
"""The transports with RTU frames, for cases that need no pauses: a serial line, and RTU over TCP."""
ANY_LINE = ("rtu-line", "ascii-line", "rtu-stream")
TCP = ("mbap-stream",)
STREAM = ("mbap-stream", "rtu-stream")


def case(
    id: str,
    title: str,
    clause: str,
    impact: Impact,
    does: str,
    must: str,
    play: CaseProcedure[DeviceConnection],
    wires: tuple[str, ...] = (),
    needs: tuple[str, ...] = (),
    basis: Basis = Basis.STANDARD,
    elsewhere: tuple[Elsewhere, ...] = (),
) -> ModbusCase:
    return DeviceCase(id, title, clause, impact, does, must, play, wires, needs, basis=basis, elsewhere=elsewhere)


robust = partial(case, basis=Basis.ROBUSTNESS)
field = partial(case, basis=Basis.FIELD)

HOLDING, COIL = ("holding",), ("coil",)
CASES: tuple[ModbusCase, ...] = (
    case("MB-001", "bad CRC in a request", "SL 2.4.2", READ, "a read with the CRC inverted", "silence",
         line.bad_check_sum, FRAMED),
    case("MB-004", "half a request, a pause, a whole one", "SL 2.5.1.1", READ, "half a read, 100 ms, a read",
         "answer the second", line.half_then_whole, LINE),
    case("MB-005", "a gap over t1.5 inside a frame", "SL 2.5.1.1; libmodbus #400", READ,
         "a read with a pause in the middle", "discard it (strict) or take it (tolerant); go on", line.gap_inside, LINE),
    robust("MB-007", "two frames closer than t3.5", "SL 2.5.1.1", READ, "two reads without a pause",
         "answer both (tolerant) or none (strict)", line.no_gap, LINE),
    field("MB-008a", "leading 00 noise", "minimalmodbus #61", READ, "00 00, then a read",
         "take the frame (tolerant) or discard it with the noise (strict); go on",
         line.leading_zero, FRAMED),
    field("MB-008b", "leading FF noise", "minimalmodbus #61", READ, "FF FF, then a read",
         "take the frame (tolerant) or discard it with the noise (strict); go on",
         line.leading_ones, FRAMED),
    field("MB-009", "trailing 00s", "HA #69742", READ, "a read, then 00 00",
         "take the frame (tolerant) or discard it with the noise (strict); go on",
         line.trailing_zeros, FRAMED),
    case("MB-026", "broadcast write", "SL 2.1; libmodbus #372", DISRUPT, "FC 06 to unit 0", "execute it, keep silent",
         write.broadcast_write, ANY_LINE, ("holding", "i-know")),
    case("MB-027", "broadcast read", "SL 2.1; libmodbus #379", READ, "a read to unit 0", "silence",
         line.broadcast_read, ANY_LINE),
    case("MB-029", "request to another unit", "SL 2.4.2", READ, "reads to three other units", "silence", line.other_unit,
         ANY_LINE),
    case("MB-030", "another unit's request and response, then ours", "SL 2.4.2; libmodbus #18; pymodbus #674", READ,
         "another's read with its response, then ours", "answer ours", line.neighbours_talk, FRAMED),
    case("MB-031", "another unit silent, then ours", "SL 2.4.2; libmodbus #83, #86", READ,
          "a read to a unit that is not there, ours", "answer ours", line.neighbour_silent, FRAMED),
    case("MB-032", "unknown function to another unit", "SL 2.4.2; nanoMODBUS PR #78", DISRUPT, "function 64 to another unit",
         "silence", line.stranger_function, ANY_LINE),
    case("MB-033a", "unknown function", "AP 7", DISRUPT, "function 64 with two bytes", "exception 01", pdu.unknown_function),
    case("MB-033b", "unknown function without data", "AP 7", DISRUPT, "function 41, nothing else", "exception 01",
         pdu.unknown_bare_function),
    case("MB-034", "a valid frame after an unknown function", "AP 7", DISRUPT, "function 64, then a read",
         "answer the read", pdu.after_unknown),
    robust("MB-035", "request function from 80h", "AP 4.1", DISRUPT, "function 83, twice",
         "exception 01 or silence, the same both times", pdu.high_function),
    case("MB-036a", "count 0", "AP 6", READ, "a read of nothing", "exception 03", pdu.no_register),
    case("MB-036b", "126 registers", "AP 6", READ, "a read of 126 registers", "exception 03", pdu.many_registers),
    case("MB-036c", "2001 bits", "AP 6", READ, "a read of 2001 bits", "exception 03", pdu.many_bits),
    case("MB-036d", "count 0 in a write", "AP 6.12", WRITE, "FC 16 of nothing", "exception 03", write.write_none, (), HOLDING),
    case("MB-037", "start + count > 65536", "AP 6", READ, "a read of two cells from FFFF on", "exception 02",
         pdu.beyond_the_table),
    case("MB-038", "count and address both wrong", "AP 6", READ, "a read of too many cells from FFFF on",
         "exception 03 or 02: both are wrong", pdu.both_wrong),
    case("MB-039a", "FC05 value 0001h", "AP 6.5", WRITE, "FC 05 with 0001", "exception 03, coil unchanged", write.coil_0001, (),
         COIL),
    case("MB-039b", "FC05 value FF01h", "AP 6.5", WRITE, "FC 05 with FF01", "exception 03, coil unchanged", write.coil_ff01, (),
         COIL),
    case("MB-040a", "FC16 byte count mismatch", "AP 6.12; pymodbus #2974", WRITE, "FC 16, one register, byte count 4",
         "exception 03, nothing written", write.registers_mismatch, (), HOLDING),
    case("MB-040b", "FC15 byte count mismatch", "AP 6.11; pymodbus #2974", WRITE, "FC 15, one coil, byte count 2",
         "exception 03, nothing written", write.coils_mismatch, (), COIL),
    case("MB-040c", "FC16 byte count below the length", "AP 7", WRITE, "FC 16, one register, byte count 2, 4 bytes of data",
         "exception 03, nothing written", write.count_below_length, (), HOLDING),
    case("MB-040d", "FC16 byte count above the length", "AP 7", WRITE, "FC 16, one register, byte count 4, 2 bytes of data",
         "exception 03, nothing written", write.count_above_length, (), HOLDING),
    case("MB-040e", "FC16 of nothing with data", "AP 7", WRITE, "FC 16, no register, byte count 0, 2 bytes of data",
         "exception 03, nothing written", write.count_of_none, (), HOLDING),
    case("MB-041", "FC16 partly outside the map", "AP 6.12", WRITE, "FC 16 to the last registers and one more",
         "exception 02, nothing written", write.partly_outside, (), HOLDING),
    case("MB-042a", "FC23 writes before it reads", "AP 6.17", WRITE, "FC 23 that reads what it writes", "the new value",
         write.write_before_read, (), HOLDING),
    case("MB-042b", "FC23 refused as a whole", "AP 6.17", WRITE, "FC 23 that reads 126 registers",
         "exception 03, nothing written", write.refused_as_a_whole, (), HOLDING),
    case("MB-043", "FC22 masks", "AP 6.16", WRITE, "12, and F2, or 25", "17", write.mask, (), HOLDING),
    case("MB-044", "FC24 byte counts", "AP 6.18", READ, "FC 24", "a queue of up to 31 that adds up, or an exception",
         pdu.queue),
    case("MB-045a", "basic identification", "AP 6.21", READ, "FC 43/14, all basic objects", "vendor, product code, revision",
         pdu.identification),
    case("MB-045b", "regular identification", "AP 6.21", READ, "FC 43/14, regular objects",
         "all of them, in frames that add up", pdu.regular_identification),
    case("MB-045c", "an object that does not exist", "AP 6.21; pymodbus #2976", READ, "FC 43/14, object 7F", "exception 02",
         pdu.unknown_object),
    case("MB-045d", "a category that does not exist", "AP 6.21", READ, "FC 43/14, code 07", "exception 03", pdu.unknown_category),
    case("MB-046", "FC08/4 listen-only", "AP 6.8", DISRUPT, "08/04, a read, 08/01, a read", "silence until it is restarted",
         pdu.listen_only, ANY_LINE, ("i-know",)),
    case("MB-047", "FC08 counters", "AP 6.8", DISRUPT, "08/0E before and after three reads", "count them", pdu.counters),
    case("MB-049", "padding bits", "AP 6.1", READ, "a read of a few bits", "padding is 0", pdu.padding),
    case("MB-050a", "a frame of 256 bytes", "SL 2.5.1", DISRUPT, "08/00 with 250 bytes", "answer it", line.frame_of_256, FRAMED),
    robust("MB-050b", "a frame of 257 bytes", "SL 2.5.1", DISRUPT, "08/00 with 251 bytes", "discard it",
           line.frame_of_257, FRAMED),
    case("MB-051", "byte by byte", "TG 3.1.3", READ, "a read, one byte a segment", "answer it", tcp.byte_by_byte, STREAM,
         elsewhere=(Elsewhere("rtu-stream", "RTU over TCP", Basis.ROBUSTNESS, OWN),)),
    field("MB-052", "several ADUs in one segment", "OpenPLC #253; pymodbus #1949", READ, "three reads in one segment",
         "answer each in order, or exception 06", tcp.several_at_once, TCP),
    case("MB-053", "more requests in flight than allowed", "TG 4.4.2.2", DISRUPT, "40 reads in one segment",
         "answer each, or exception 06", tcp.more_than_allowed, TCP),
    case("MB-054", "protocol id not 0", "TG 4.4.2.2", READ, "an ADU with protocol id 1, then a read",
         "discard that ADU only", tcp.other_protocol, TCP),
    robust("MB-055a", "length 0", "TG 4.4.2.2", READ, "a header that counts nothing", "discard or close; serve the next client",
         tcp.length_zero, TCP),
    robust("MB-055b", "length 1", "TG 4.4.2.2", READ, "a header that counts the unit id only",
         "discard or close; serve the next client", tcp.length_one, TCP),
    robust("MB-055c", "length FFFFh", "TG 4.4.2.2", READ, "a header that counts 65535 bytes",
         "discard or close; serve the next client", tcp.length_ffff, TCP),
    case("MB-056a", "transaction id 0", "TG 4.4.1.3", READ, "a read with id 0", "echo the id", tcp.transaction_zero, TCP),
    robust("MB-056b", "the same transaction id twice", "TG 4.4.1.3", READ, "two reads with one id", "answer both",
         tcp.transaction_twice, TCP),
    case("MB-057a", "unit 255 on a direct device", "TG 4.4.1.2", READ, "a read to unit 255", "answer, echo the unit",
         tcp.unit_255, TCP),
    case("MB-057b", "unit 0 on a direct device", "TG 4.4.1.2", READ, "a read to unit 0", "answer, echo the unit",
         tcp.unit_0, TCP),
    robust("MB-064", "a client gone in the middle of a request", "TG 4.2.2", READ, "half a read, then the connection is closed",
         "serve the next connection", tcp.half_and_gone, STREAM),
    robust("MB-065", "connection limit", "TG 4.2.1", DISRUPT, "20 connections that are not used, then one more",
         "serve the last one", tcp.many_connections, STREAM),
    robust("MB-068", "wrong baud rate or parity", OWN, DISRUPT, "what another baud rate makes of a read",
           "silence; go on", line.wrong_baud_rate, FRAMED),
    field("MB-069", "two clients on one line", "pymodbus #432", DISRUPT, "two reads at once", "silence; go on",
         line.two_clients, FRAMED),
    case("MB-070a", "ASCII: bad LRC", "SL 2.5.2", READ, "a read with the LRC inverted", "silence", line.bad_lrc, ASCII),
    case("MB-070b", "ASCII: a second colon", "SL 2.5.2", READ, "half a read, then a read", "answer the second",
         line.second_colon, ASCII),
    case("MB-070c", "ASCII: a gap over 1 s", "SL 2.5.2", READ, "a read with 1.5 s in the middle", "silence",
         line.gap_over_a_second, ASCII),
    case("MB-070d", "ASCII: a gap under 1 s", "SL 2.5.2", READ, "a read with 0.5 s in the middle", "answer it",
         line.gap_under_a_second, ASCII),
    case("MB-070e", "ASCII: noise before the colon", "SL 2.5.2", READ, "noise, then a read", "answer it",
         line.noise_before_colon, ASCII),
    robust("MB-070f", "ASCII: a character other than 0 to F", "SL 2.5.2", READ, "a read with a G in it", "silence",
         line.no_character, ASCII),
)  # fmt: skip
