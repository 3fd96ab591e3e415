"""Cases about request PDUs, on any transport: functions, counts, addresses, identification, padding. Nothing is written.

AP is the Modbus Application Protocol V1.1b3.
"""

from __future__ import annotations

from fieldtwin.conformance.core.case import Finding, failed, passed
from fieldtwin.conformance.devices.device_case import NotHere, Unsaid
from fieldtwin.conformance.devices.modbus.checks import first_table, must_refuse, named, refused
from fieldtwin.conformance.devices.modbus.connection import DeviceConnection
from fieldtwin.conformance.devices.modbus.frames import short
from fieldtwin.conformance.devices.modbus.learn import ORDER, read_of, values_of

MOST_FRAMES = 32
"""Maximum number of frames in which one identification is read: 255 objects fit into fewer. The limit ends a read that
would otherwise never end, because the device always announces more objects.
"""


async def unknown_function(wire: DeviceConnection) -> Finding:
    """MB-033: send the undefined function 64h, with two bytes."""
    return await must_refuse(wire, b"\x64\x00\x01", 0x01)


async def unknown_bare_function(wire: DeviceConnection) -> Finding:
    """MB-033: send the undefined function 41h, without data."""
    return await must_refuse(wire, b"\x41", 0x01)


async def after_unknown(wire: DeviceConnection) -> Finding:
    """MB-034: send a good request right after one with an unknown function."""
    await wire.ask(b"\x64\x00\x01")
    after = await wire.still_good()
    return failed(f"the request afterwards: {after}") if after else passed()


async def high_function(wire: DeviceConnection) -> Finding:
    """MB-035: send function 83h twice. The device must give code 01 or no answer, and the same both times."""
    seen = []
    for _ in range(2):
        heard = await wire.ask(b"\x83\x00\x00\x00\x01", due=False)
        if heard.nothing:
            seen.append("silence")
        elif heard.first is not None and heard.first.refusal == 0x01 and not heard.rest:
            seen.append(named(0x01))
        else:
            return failed(f"{heard} instead of exception 01 or silence")
        after = await wire.still_good()
        if after:
            return failed(f"{seen[-1]}; the request afterwards: {after}")
    return passed(seen[0]) if seen[0] == seen[1] else failed(f"once {seen[0]}, once {seen[1]}")


async def no_register(wire: DeviceConnection) -> Finding:
    """MB-036: read 0 registers."""
    function, address, _ = first_table(wire, ORDER)
    return await must_refuse(wire, read_of(function, address, 0), 0x03, may_lack=False)


async def many_registers(wire: DeviceConnection) -> Finding:
    """MB-036: read 126 registers, one more than allowed."""
    function, address, _ = first_table(wire, (0x03, 0x04))
    return await must_refuse(wire, read_of(function, min(address, 0xFFFF - 125), 126), 0x03, may_lack=False)


async def many_bits(wire: DeviceConnection) -> Finding:
    """MB-036: read 2001 bits, one more than allowed."""
    function, address, _ = first_table(wire, (0x01, 0x02))
    return await must_refuse(wire, read_of(function, min(address, 0xFFFF - 2000), 2001), 0x03, may_lack=False)


async def beyond_the_table(wire: DeviceConnection) -> Finding:
    """MB-037: read two cells from FFFFh on, of which the second does not exist."""
    function, _, _ = first_table(wire, ORDER)
    return await must_refuse(wire, read_of(function, 0xFFFF, 2), 0x02, may_lack=False)


async def both_wrong(wire: DeviceConnection) -> Finding:
    """MB-038: read too many cells from FFFFh on, so that both count and address are invalid. AP 6 checks the count first
    (exception 03); exception 02, for the address, is also accepted.
    """
    function, _, _ = first_table(wire, ORDER)
    count = 126 if function in (0x03, 0x04) else 2001
    return await must_refuse(wire, read_of(function, 0xFFFF, count), 0x03, 0x02, may_lack=False)


async def padding(wire: DeviceConnection) -> Finding:
    """MB-049: check that the bits after the last requested one are 0."""
    function, address, count = first_table(wire, (0x01, 0x02))
    heard = await wire.ask(read_of(function, address, count))
    data = values_of(heard.first, function, count)
    if data is None:
        return failed(f"{heard} instead of {count} bits")
    return failed(f"{short(data)} for {count} bits: the padding is not 0") if data[-1] >> count % 8 else passed()


async def queue(wire: DeviceConnection) -> Finding:
    """MB-044: read a FIFO queue at any address: byte count and count agree, at most 31."""
    _, address, _ = first_table(wire, (0x03, 0x04))
    pdu = b"\x18" + address.to_bytes(2)
    heard = await wire.ask(pdu)
    answer = heard.first
    if answer is None:
        after = await wire.still_good()
        return failed(f"{heard} instead of a queue or an exception" + (f"; then {after}" if after else ""))
    if answer.refusal == 0x01:
        raise NotHere("it has no function 18")
    if answer.refusal:
        wrong = refused(pdu, answer, 0x02, 0x03)
        return failed(wrong) if wrong else passed(f"no queue there: {named(answer.refusal)}")
    size, count = int.from_bytes(answer.pdu[1:3]), int.from_bytes(answer.pdu[3:5])
    if len(answer.pdu) != 3 + size or size != 2 + 2 * count or count > 31:
        return failed(f"byte count {size}, count {count} in {len(answer.pdu)} bytes: {short(answer.pdu)}")
    return passed(f"a queue of {count}")


# -- identification (AP 6.21) ----------------------------------------------------------------------------------------


async def _objects(wire: DeviceConnection, code: int) -> tuple[dict[int, bytes], str]:
    """Return all objects of a category, read in as many frames as needed, and a description of the first error, empty if
    there was none.
    """
    objects: dict[int, bytes] = {}
    at = 0
    for _ in range(MOST_FRAMES):
        heard = await wire.ask(bytes((0x2B, 0x0E, code, at)))
        answer = heard.first
        if answer is None:
            after = await wire.still_good()
            return objects, f"{heard} instead of an identification" + (f"; then {after}" if after else "")
        if answer.refusal == 0x01:
            raise NotHere("it has no function 2B/0E")
        if answer.refusal:
            return objects, f"{named(answer.refusal)} instead of objects from {at:02X} on"
        pdu = answer.pdu
        if len(pdu) < 7 or pdu[:3] != bytes((0x2B, 0x0E, code)) or pdu[4] not in (0x00, 0xFF):
            return objects, f"no identification: {short(pdu)}"
        more, following, place = pdu[4] == 0xFF, pdu[5], 7
        for _ in range(pdu[6]):
            if place + 2 > len(pdu) or place + 2 + pdu[place + 1] > len(pdu):
                return objects, f"fewer objects than the {pdu[6]} announced: {short(pdu)}"
            objects[pdu[place]] = pdu[place + 2 : place + 2 + pdu[place + 1]]
            place += 2 + pdu[place + 1]
        if place != len(pdu):
            return objects, f"{len(pdu) - place} bytes after the last object"
        if not more:
            return objects, ""
        if following <= at or not objects or following <= max(objects):
            return objects, f"more follows from {following:02X} on, which was there already"
        at = following
    return objects, f"more follows after {MOST_FRAMES} frames"


async def identification(wire: DeviceConnection) -> Finding:
    """MB-045: read the basic objects. The device must have all of them."""
    objects, wrong = await _objects(wire, 0x01)
    if wrong:
        return failed(wrong)
    missing = [f"{n:02X}" for n in (0, 1, 2) if n not in objects]
    if missing:
        return failed(f"basic objects missing: {', '.join(missing)}")
    return passed(", ".join(text_of(objects[n]) for n in (0, 1, 2)))


async def regular_identification(wire: DeviceConnection) -> Finding:
    """MB-045: read the regular objects, in as many frames as they need."""
    objects, wrong = await _objects(wire, 0x02)
    if wrong:
        return failed(wrong)
    return passed(f"{len(objects)} objects") if objects else failed("no object at all")


async def unknown_object(wire: DeviceConnection) -> Finding:
    """MB-045: read one object that does not exist."""
    first = await wire.ask(b"\x2b\x0e\x04\x00")
    if first.first is None or first.first.refusal:
        raise NotHere(f"it does not answer for single objects: {first}")
    for object_id in (0x7F, 0x6F):
        heard = await wire.ask(bytes((0x2B, 0x0E, 0x04, object_id)))
        answer = heard.first
        if answer is None:
            return failed(f"{heard} instead of exception 02")
        if answer.refusal or object_id == 0x6F:
            wrong = refused(b"\x2b", answer, 0x02)
            return failed(wrong) if wrong else passed()
    raise Unsaid("it has objects 7F and 6F")


async def unknown_category(wire: DeviceConnection) -> Finding:
    """MB-045: send an undefined read device ID code."""
    return await must_refuse(wire, b"\x2b\x0e\x07\x00", 0x03)


def text_of(raw: bytes) -> str:
    """Return the printable part of a device's text."""
    return raw.decode("latin-1").strip("\0 ") or "(empty)"


# -- diagnostics (AP 6.8) ---------------------------------------------------------------------------------------------


async def counters(wire: DeviceConnection) -> Finding:
    """MB-047: check that the device's counter of requests increases by the number of requests sent."""
    before = await _counter(wire, 0x0E)
    for _ in range(3):
        if after := await wire.still_good():
            return failed(f"a request meanwhile: {after}")
    counted = (await _counter(wire, 0x0E) - before) & 0xFFFF
    if counted in (3, 4):  # the request that reads the counter may be counted or not
        return passed()
    return failed(f"counted {counted} requests instead of 4")


async def _counter(wire: DeviceConnection, which: int) -> int:
    heard = await wire.ask(bytes((0x08, 0x00, which, 0x00, 0x00)))
    answer = heard.first
    if answer is None or answer.refusal or len(answer.pdu) != 5:
        raise NotHere(f"it has no counter 08/{which:02X}: {heard}")
    return int.from_bytes(answer.pdu[3:5])


async def listen_only(wire: DeviceConnection) -> Finding:
    """MB-046: switch the device to listen-only mode, and end the mode by a restart."""
    echo = await wire.ask(b"\x08\x00\x00\x5a\x5a")
    if echo.first is None or echo.first.refusal:
        raise NotHere(f"it has no function 08: {echo}")
    try:
        entered = await wire.ask(b"\x08\x00\x04\x00\x00", due=False)
        meanwhile = await wire.ask(wire.good, due=False)
    finally:  # also after a failure, because the device may be in listen-only mode
        left = await wire.ask(b"\x08\x00\x01\x00\x00", due=False)
    after = await wire.still_good()
    if entered.first is not None and entered.first.refusal and not after:
        raise NotHere(f"it has no listen-only mode: {entered}")
    if not entered.nothing:
        return failed(f"{entered} instead of silence to 08/04")
    if not meanwhile.nothing:
        return failed(f"answers in listen-only mode: {meanwhile}")
    if not left.nothing:
        return failed(f"{left} instead of silence to the restart that ends it")
    return failed(f"after the restart: {after}") if after else passed()
