"""Learn the normal answers of a Modbus device by reads only, as the reference of the checks.

A device is present when it answers at all; an exception counts as an answer, except those by which a gateway reports a
missing device.
"""

from __future__ import annotations

from fieldtwin.conformance.devices.modbus.connection import GATEWAY_SAYS_NO, DeviceConnection
from fieldtwin.conformance.devices.modbus.frames import ReceivedReply
from fieldtwin.gateway.core.errors import Unreachable

FUNCTION = {"coil": 0x01, "discrete": 0x02, "holding": 0x03, "input": 0x04}
TABLE = {number: name for name, number in FUNCTION.items()}
STARTS = (0, 1, 100, 1000, 40000)
"""Addresses at which register maps usually begin."""
ORDER = (0x03, 0x04, 0x01, 0x02)
"""The tables in the order in which they are tried: first those that reveal most about a device."""


def read_of(function: int, address: int, count: int) -> bytes:
    """Return the PDU of a read (AP 6.1 to 6.4)."""
    return bytes((function,)) + address.to_bytes(2) + count.to_bytes(2)


def values_of(answer: ReceivedReply | None, function: int, count: int) -> bytes | None:
    """Return the data of a whole reply to a read of `count` cells by `function`, or None for any other reply."""
    size = 2 * count if function in (0x03, 0x04) else (count + 7) // 8
    if answer is None or answer.pdu[:2] != bytes((function, size)) or len(answer.pdu) != 2 + size:
        return None
    return answer.pdu[2:]


async def learn(wire: DeviceConnection, given: dict[str, int], writable: dict[str, int] | None = None) -> None:
    """Read from the device, and fill `good`, `good_reply`, `readable` and `refused` of `wire` with the results.

    `given`: table -> address that can be read according to the user, `writable`: table -> address of a cell that may be
    written; these addresses are tried before the usual ones. Raises `Unreachable` if the device answers no read.
    """
    await wire.reopen()
    refusal: tuple[bytes, bytes] | None = None
    for function in ORDER:
        refusal = await _table(wire, function, given, writable or {}) or refusal
    chosen = [f for f in ORDER if f in wire.readable]
    chosen.sort(key=lambda f: TABLE[f] not in given)
    if chosen:
        wire.good = read_of(chosen[0], *wire.readable[chosen[0]])
        heard = await wire.ask(wire.good)
        wire.good_reply = heard.first.pdu if heard.first else b""
    elif refusal is not None:
        wire.good, wire.good_reply = refusal
    if not wire.good_reply:
        raise Unreachable(
            f"unit {wire.unit} answers no read",
            hint="check the unit ID, the baud rate and the framing; `fieldtwin scan` finds them",
        )
    await _widen(wire)


async def _table(
    wire: DeviceConnection, function: int, given: dict[str, int], writable: dict[str, int]
) -> tuple[bytes, bytes] | None:
    """Find a readable cell of one table, enter it in `wire.readable`, and return None.

    If there is no such cell, return the last refused request with its reply, or None if no request was refused.
    """
    table, refusal, silent = TABLE[function], None, 0
    counts = (1, 2) if function in (0x03, 0x04) else (1,)  # some devices do not support odd counts (MB-048)
    also = [writable[table]] if table in writable else []
    for address in [given[table]] if table in given else [*also, *STARTS]:
        for count in counts:
            pdu = read_of(function, address, count)
            answer = (await wire.ask(pdu)).first
            if answer is None or answer.unit != wire.unit or answer.refusal in GATEWAY_SAYS_NO:
                silent += 1
                if silent == 2:  # a single missing answer may be caused by a lost frame
                    return refusal
                continue
            if values_of(answer, function, count) is not None:
                wire.readable[function] = (address, count)
                return None
            refusal = pdu, answer.pdu
            wire.refused[function] = answer.refusal
            if answer.refusal == 0x01:  # the device does not have this table
                return refusal
    return refusal


async def _widen(wire: DeviceConnection) -> None:
    """Extend the known reads to 2 or 3 cells, which is enough to check padding and byte counts."""
    for function, (address, _) in list(wire.readable.items()):
        count = 3 if function in (0x01, 0x02) else 2
        if address + count <= 0x10000:
            heard = await wire.ask(read_of(function, address, count))
            if values_of(heard.first, function, count) is not None:
                wire.readable[function] = (address, count)
