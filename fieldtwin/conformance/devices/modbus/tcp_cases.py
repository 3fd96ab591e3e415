"""Cases of Modbus TCP and of streams: invalid headers, several ADUs in one segment, connections that end.

TG is the Messaging on TCP/IP Implementation Guide V1.0b. The cases send only reads.
"""

from __future__ import annotations

from fieldtwin.conformance.core.case import Finding, failed, passed
from fieldtwin.conformance.devices.device_case import NotHere
from fieldtwin.conformance.devices.modbus.checks import answers_good, named
from fieldtwin.conformance.devices.modbus.connection import GATEWAY_SAYS_NO, DeviceConnection
from fieldtwin.conformance.devices.modbus.frames import ReceivedReply, mbap
from fieldtwin.gateway.core.errors import Unreachable


def _adu(wire: DeviceConnection, transaction: int, protocol: int = 0, length: int | None = None) -> bytes:
    return mbap(bytes((wire.unit,)) + wire.good, transaction, protocol, length)


async def byte_by_byte(wire: DeviceConnection) -> Finding:
    """MB-051: send a request with each byte in its own segment."""
    frame = wire.frame(wire.good)
    for at in range(len(frame)):
        await wire.send(frame[at : at + 1], wire.good, at_once=at > 0)
        await wire.pause(0.002)
    heard = await wire.hear()
    return passed() if answers_good(wire, heard, 1) else failed(f"{heard} instead of an answer")


async def several_at_once(wire: DeviceConnection) -> Finding:
    """MB-052: send three ADUs in one segment. The device must answer each or refuse it with exception 06, in order."""
    numbers = [wire.next_transaction() for _ in range(3)]
    await wire.send(b"".join(_adu(wire, n) for n in numbers), wire.good)
    heard = await wire.hear(3)
    got = [a.transaction for a in heard.answers]
    served = all(wire.is_good(a) or a.refusal == 0x06 for a in heard.answers)
    if got == numbers and served and not heard.rest:
        busy = sum(a.refusal == 0x06 for a in heard.answers)
        return passed(f"{3 - busy} answered, {busy} refused with 06" if busy else "")
    if sorted(got) == numbers:
        return failed(f"answers {got} to {numbers}: out of order")
    return failed(f"{len(got)} answers to 3 requests")


async def more_than_allowed(wire: DeviceConnection) -> Finding:
    """MB-053: send 40 requests at once. The device must answer each, or refuse it with exception 06."""
    numbers = [wire.next_transaction() for _ in range(40)]
    await wire.send(b"".join(_adu(wire, n) for n in numbers), wire.good)
    heard = await wire.hear(40)
    busy = [a for a in heard.answers if a.refusal == 0x06]
    if not busy and wire.good_reply[0] & 0x80:
        raise NotHere("it refuses every read anyway")
    odd = [a for a in heard.answers if a.refusal != 0x06 and not wire.is_good(a)]
    if odd:
        return failed(f"{odd[0]} instead of an answer or exception 06")
    if len(heard.answers) != 40:
        return failed(
            f"{len(heard.answers)} answers to 40 requests" + (", and closes the connection" if heard.closed else "")
        )
    return passed(f"{40 - len(busy)} answered, {len(busy)} refused with 06")


async def other_protocol(wire: DeviceConnection) -> Finding:
    """MB-054: send an ADU with protocol ID 1, then a good one."""
    odd, ours = wire.next_transaction(), wire.next_transaction()
    await wire.send(_adu(wire, odd, protocol=1), wire.good)
    await wire.send(_adu(wire, ours), wire.good)
    heard = await wire.hear()
    if any(a.transaction == odd for a in heard.answers):
        return failed(f"answers the ADU of another protocol: {heard}")
    return passed() if answers_good(wire, heard, 1) else failed(f"{heard} instead of an answer to the good one")


async def _wrong_length(wire: DeviceConnection, adu: bytes) -> Finding:
    """Send an invalid ADU: the device must discard it or close the connection, and must serve a new connection in both cases."""
    await wire.send(adu, wire.good)
    heard = await wire.hear()
    if heard.answers or heard.rest:
        return failed(f"{heard} instead of nothing, or an end of the connection")
    if heard.closed:
        return await _served_anew(wire, "hangs up")
    after = await wire.still_good()
    if not after:
        return passed("discards it")
    if after == "hangs up":
        return await _served_anew(wire, after)
    return failed(f"keeps the connection, but the request afterwards: {after}")


async def _served_anew(wire: DeviceConnection, why: str) -> Finding:
    try:
        await wire.reopen()
        after = await wire.still_good()
    except Unreachable as e:
        return failed(f"{why}, and takes no new connection: {e.message}")
    return failed(f"{why}; on a new connection: {after}") if after else passed(f"{why}, and serves the next connection")


async def length_zero(wire: DeviceConnection) -> Finding:
    """MB-055: send length 0 and no further bytes."""
    return await _wrong_length(wire, wire.next_transaction().to_bytes(2) + b"\0\0\0\0")


async def length_one(wire: DeviceConnection) -> Finding:
    """MB-055: send length 1, followed by the unit ID alone."""
    return await _wrong_length(wire, wire.next_transaction().to_bytes(2) + b"\0\0\0\x01" + bytes((wire.unit,)))


async def length_ffff(wire: DeviceConnection) -> Finding:
    """MB-055: send length FFFFh, followed by an ordinary request."""
    return await _wrong_length(wire, _adu(wire, wire.next_transaction(), length=0xFFFF))


async def transaction_zero(wire: DeviceConnection) -> Finding:
    """MB-056: send transaction ID 0, which the device must echo."""
    await wire.send(_adu(wire, 0), wire.good)
    heard = await wire.hear()
    good = answers_good(wire, heard, 1) and heard.answers[0].transaction == 0
    return passed() if good else failed(f"{_told(heard.first)} instead of an answer with id 0")


async def transaction_twice(wire: DeviceConnection) -> Finding:
    """MB-056: send two requests with the same transaction ID, the second after the answer to the first."""
    number = wire.next_transaction()
    for _ in range(2):
        await wire.send(_adu(wire, number), wire.good)
        heard = await wire.hear()
        if not answers_good(wire, heard, 1) or heard.answers[0].transaction != number:
            return failed(f"{_told(heard.first)} instead of an answer with id {number}")
    return passed()


def _told(answer: ReceivedReply | None) -> str:
    return "silence" if answer is None else f"{answer} with id {answer.transaction}"


async def _as_itself(wire: DeviceConnection, unit: int) -> Finding:
    """Check that a device that is not behind a gateway answers requests to `unit`, and repeats that unit ID (TG 4.4.1.2)."""
    if wire.unit == unit:
        raise NotHere(f"all other test cases use unit {unit}")
    heard = await wire.ask(wire.good, unit)
    answer = heard.first
    if answer is None:
        return failed(f"{heard} instead of an answer")
    if answer.unit != unit:
        return failed(f"answers as unit {answer.unit} to a request for unit {unit}")
    if answer.refusal in GATEWAY_SAYS_NO:
        raise NotHere(f"a gateway, not a direct device: {named(answer.refusal)}")
    same = answer.pdu[:2] == wire.good_reply[:2] and len(answer.pdu) == len(wire.good_reply)
    return passed() if same else failed(f"{answer} instead of the answer of unit {wire.unit}")


async def unit_255(wire: DeviceConnection) -> Finding:
    """MB-057: send a request to unit 255."""
    return await _as_itself(wire, 255)


async def unit_0(wire: DeviceConnection) -> Finding:
    """MB-057: send a request to unit 0."""
    return await _as_itself(wire, 0)


async def half_and_gone(wire: DeviceConnection) -> Finding:
    """MB-064: send half a request and disconnect. The device must serve the next client."""
    frame = wire.frame(wire.good)
    await wire.send(frame[: len(frame) // 2], wire.good)
    await wire.pause(0.05)
    return await _served_anew(wire, "left in the middle of a request")


async def many_connections(wire: DeviceConnection) -> Finding:
    """MB-065: open 20 idle connections. The device must still serve one more."""
    held = []
    try:
        for _ in range(20):
            try:
                held.append(await wire.open_another())
            except Unreachable:
                break
        made = len(held)
        try:
            await wire.reopen()
            after = await wire.still_good()
        except Unreachable as e:
            after = e.message
    finally:
        for connection in held:
            await connection.aclose()
    return failed(f"with {made} connections open, one more: {after}") if after else passed(f"with {made} others open")
