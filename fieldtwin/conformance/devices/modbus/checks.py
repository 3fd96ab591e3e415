"""Checks that many Modbus cases share: the correct exception response, no reply, and the recovery afterwards."""

from __future__ import annotations

from collections.abc import Sequence

from fieldtwin.conformance.core.case import Finding, failed, passed
from fieldtwin.conformance.devices.device_case import NotHere
from fieldtwin.conformance.devices.modbus.connection import DeviceConnection, Received
from fieldtwin.conformance.devices.modbus.frames import ReceivedReply

NAMES = {1: "illegal function", 2: "illegal data address", 3: "illegal data value", 4: "device failure", 6: "busy"}


def named(code: int) -> str:
    """Return a text such as ``exception 03``, with its name if it has one."""
    return f"exception {code:02X}" + (f" ({NAMES[code]})" if code in NAMES else "")


def refused(pdu: bytes, answer: ReceivedReply, *codes: int) -> str:
    """Return an empty string if `answer` refuses the request `pdu` with one of `codes`, else a description."""
    wanted = " or ".join(f"{code:02X}" for code in codes)
    if answer.refusal and answer.pdu[0] != pdu[0] | 0x80:
        return f"refuses function {answer.pdu[0] & 0x7F:02X} instead of {pdu[0]:02X}: {answer.pdu.hex(' ').upper()}"
    if answer.refusal in codes:
        return ""
    if answer.refusal:
        return f"{named(answer.refusal)} instead of {wanted}"
    return f"answers {answer} instead of exception {wanted}"


async def must_refuse(wire: DeviceConnection, pdu: bytes, *codes: int, may_lack: bool = True) -> Finding:
    """Send a request that the device has to refuse with one of the exception codes `codes`.

    `may_lack`: exception 01 means that the device lacks the function, and the case is skipped. If the device does not
    answer, the reason also states whether it answers the next request.
    """
    heard = await wire.ask(pdu)
    answer = heard.first
    if answer is None or answer.unit != wire.unit:
        after = await wire.still_good()
        return failed(f"{heard} instead of {named(codes[0])}" + (f"; the request afterwards: {after}" if after else ""))
    if may_lack and answer.pdu == bytes((pdu[0] | 0x80, 0x01)) and 0x01 not in codes:
        raise NotHere(f"it has no function {pdu[0]:02X}")
    wrong = refused(pdu, answer, *codes)
    return failed(wrong) if wrong else passed(named(answer.refusal))


async def silent_then_good(wire: DeviceConnection, heard: Received) -> Finding:
    """Return a pass if `heard` is silence and the device answers a request afterwards; else a failure."""
    if not heard.nothing:
        return failed(f"{heard} instead of silence")
    after = await wire.still_good()
    return (
        failed(f"the request afterwards: {after}") if after else passed("silence; the request afterwards is answered")
    )


def answers_good(wire: DeviceConnection, heard: Received, times: int) -> bool:
    """Return whether `heard` consists of the usual answer `times` times, and of nothing else."""
    return len(heard.answers) == times and all(wire.is_good(a) for a in heard.answers) and not heard.rest


def first_table(wire: DeviceConnection, functions: Sequence[int]) -> tuple[int, int, int]:
    """Return (function, address, count) of a read that the device answers, by the first possible one of `functions`.

    Raises `NotHere` if the device answers no read by any of them.
    """
    for function in functions:
        if function in wire.readable:
            return function, *wire.readable[function]
    raise NotHere(
        "nothing was found that can be read" if len(functions) > 2 else "it has no such table, as far as seen"
    )
