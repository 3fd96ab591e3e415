"""Cases that write to the cells that the user named for writing, and restore their values.

A write that the device should refuse uses a value other than the cell's, so that a write that was executed is noticed. AP
is the Modbus Application Protocol V1.1b3.
"""

from __future__ import annotations

from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

from fieldtwin.conformance.core.case import Finding, Impact, failed, passed
from fieldtwin.conformance.devices.device_case import NotHere, Unsaid
from fieldtwin.conformance.devices.modbus.checks import must_refuse, named, refused
from fieldtwin.conformance.devices.modbus.connection import DeviceConnection
from fieldtwin.conformance.devices.modbus.learn import FUNCTION, read_of, values_of


async def _read(wire: DeviceConnection, table: str, address: int, count: int = 1) -> bytes:
    heard = await wire.ask(read_of(FUNCTION[table], address, count))
    data = values_of(heard.first, FUNCTION[table], count)
    if data is None:
        raise NotHere(f"{table} {address} cannot be read back: {heard}")
    return data


def _write(table: str, address: int, data: bytes) -> bytes:
    """Return a request FC 06 or FC 05 (AP 6.5, 6.6) with the data that `_read` returned."""
    if table == "holding":
        return b"\x06" + address.to_bytes(2) + data[:2]
    return b"\x05" + address.to_bytes(2) + (b"\xff\x00" if data[0] & 1 else b"\0\0")


@asynccontextmanager
async def _borrowed(wire: DeviceConnection, table: str) -> AsyncIterator[tuple[int, bytes]]:
    """Yield the address of the cell to write and its value, and restore the value afterwards. Raises `Unsaid` if that fails."""
    if table not in wire.may_write:
        raise NotHere(f"no address to write was given: --write {table}:ADDRESS")
    address, _ = wire.may_write[table]
    before = await _read(wire, table, address)
    try:
        yield address, before
    finally:
        if await _read(wire, table, address) != before:
            wire.impact = max(wire.impact, Impact.WRITE, key=lambda d: d.rank)
            await wire.ask(_write(table, address, before))
            now = await _read(wire, table, address)
            if now != before:
                raise Unsaid(f"{table} {address} could not be restored: {now.hex()} instead of {before.hex()}")


async def _unchanged(wire: DeviceConnection, table: str, address: int, before: bytes, finding: Finding) -> Finding:
    """Return `finding`, or a failure if the cell changed."""
    now = await _read(wire, table, address)
    if now != before:
        said = f"; {finding.reason}" if finding.reason else ""
        return failed(f"{table} {address} was written: {now.hex().upper()} instead of {before.hex().upper()}{said}")
    return finding


def _other(before: bytes) -> bytes:
    """Return a register value that differs from `before` by one bit."""
    return before[:1] + bytes((before[1] ^ 1,))


async def write_none(wire: DeviceConnection) -> Finding:
    """MB-036: send FC 16 with count 0."""
    async with _borrowed(wire, "holding") as (address, _):
        return await must_refuse(wire, b"\x10" + address.to_bytes(2) + b"\0\0\0", 0x03)


async def _odd_coil(wire: DeviceConnection, value: bytes) -> Finding:
    async with _borrowed(wire, "coil") as (address, before):
        on = bool(before[0] & 1)
        # the tested value must differ from the current state: FF01 on a coil that is off, 0001 likewise
        if on:
            heard = await wire.ask(_write("coil", address, b"\0"))
            if heard.first is None or heard.first.refusal:
                raise NotHere(f"coil {address} cannot be written: {heard}")
        finding = await must_refuse(wire, b"\x05" + address.to_bytes(2) + value, 0x03)
        return await _unchanged(wire, "coil", address, b"\0", finding)


async def coil_0001(wire: DeviceConnection) -> Finding:
    """MB-039: send FC 05 with value 0001h."""
    return await _odd_coil(wire, b"\x00\x01")


async def coil_ff01(wire: DeviceConnection) -> Finding:
    """MB-039: send FC 05 with value FF01h."""
    return await _odd_coil(wire, b"\xff\x01")


async def registers_mismatch(wire: DeviceConnection) -> Finding:
    """MB-040: send FC 16 for one register with byte count 4."""
    async with _borrowed(wire, "holding") as (address, before):
        pdu = b"\x10" + address.to_bytes(2) + b"\0\x01\x04" + _other(before) + b"\0\0"
        return await _unchanged(wire, "holding", address, before, await must_refuse(wire, pdu, 0x03))


async def _length_mismatch(wire: DeviceConnection, byte_count: int, more: bytes) -> Finding:
    """Send FC 16 for one register with a byte count that contradicts the length of the request (AP 7, exception 03)."""
    async with _borrowed(wire, "holding") as (address, before):
        pdu = b"\x10" + address.to_bytes(2) + bytes((0, 1, byte_count)) + _other(before) + more
        return await _unchanged(wire, "holding", address, before, await must_refuse(wire, pdu, 0x03))


async def count_below_length(wire: DeviceConnection) -> Finding:
    """MB-040: send FC 16 for one register with byte count 2 and four bytes of data."""
    return await _length_mismatch(wire, 2, b"\0\0")


async def count_above_length(wire: DeviceConnection) -> Finding:
    """MB-040: send FC 16 for one register with byte count 4 and two bytes of data."""
    return await _length_mismatch(wire, 4, b"")


async def count_of_none(wire: DeviceConnection) -> Finding:
    """MB-040: send FC 16 for no register with byte count 0 and two bytes of data, as libmodbus's unit-test-client does."""
    async with _borrowed(wire, "holding") as (address, before):
        pdu = b"\x10" + address.to_bytes(2) + b"\0\0\0" + _other(before)
        return await _unchanged(wire, "holding", address, before, await must_refuse(wire, pdu, 0x03))


async def coils_mismatch(wire: DeviceConnection) -> Finding:
    """MB-040: send FC 15 for one coil with byte count 2."""
    async with _borrowed(wire, "coil") as (address, before):
        pdu = b"\x0f" + address.to_bytes(2) + b"\0\x01\x02" + bytes(((before[0] & 1) ^ 1, 0))
        return await _unchanged(wire, "coil", address, before, await must_refuse(wire, pdu, 0x03))


async def partly_outside(wire: DeviceConnection) -> Finding:
    """MB-041: send FC 16 for registers of which the last one is beyond the end of the map."""
    if "holding" not in wire.may_write:
        raise NotHere("no address to write was given: --write holding:ADDRESS+COUNT")
    address, count = wire.may_write["holding"]
    end = address + count
    if end > 0xFFFF or count > 122:
        raise NotHere("give the last registers of the map, at most 122: --write holding:ADDRESS+COUNT")
    beyond = await wire.ask(read_of(0x03, end, 1))
    if beyond.first is None or beyond.first.refusal != 0x02:
        raise NotHere(f"register {end} exists: give the last ones of the map, --write holding:ADDRESS+COUNT")
    async with _borrowed(wire, "holding") as (address, before):
        data = _other(before) + (await _read(wire, "holding", address, count))[2:] + b"\0\0"
        pdu = b"\x10" + address.to_bytes(2) + (count + 1).to_bytes(2) + bytes((2 * count + 2,)) + data
        return await _unchanged(wire, "holding", address, before, await must_refuse(wire, pdu, 0x02))


async def write_before_read(wire: DeviceConnection) -> Finding:
    """MB-042: send FC 23 that reads the register that it writes."""
    async with _borrowed(wire, "holding") as (address, before):
        at, new = address.to_bytes(2), _other(before)
        heard = await wire.ask(b"\x17" + at + b"\0\x01" + at + b"\0\x01\x02" + new)
        answer = heard.first
        if answer is None:
            return failed(f"{heard} instead of an answer")
        if answer.refusal == 0x01:
            raise NotHere("it has no function 17")
        if answer.refusal:
            return failed(f"{named(answer.refusal)} instead of an answer")
        if answer.pdu == b"\x17\x02" + new:
            return passed()
        return failed(f"answers {answer} where {new.hex().upper()} was written")


async def refused_as_a_whole(wire: DeviceConnection) -> Finding:
    """MB-042: send FC 23 that reads 126 registers. The device must refuse it and write nothing."""
    async with _borrowed(wire, "holding") as (address, before):
        at = address.to_bytes(2)
        pdu = b"\x17" + at + b"\0\x7e" + at + b"\0\x01\x02" + _other(before)
        return await _unchanged(wire, "holding", address, before, await must_refuse(wire, pdu, 0x03))


async def mask(wire: DeviceConnection) -> Finding:
    """MB-043: mask-write a register with the example of AP: 12h, AND mask F2h, OR mask 25h gives 17h."""
    async with _borrowed(wire, "holding") as (address, _):
        at = address.to_bytes(2)
        first = await wire.ask(b"\x06" + at + b"\x00\x12")
        if first.first is None or first.first.refusal:
            raise NotHere(f"register {address} cannot be written: {first}")
        pdu = b"\x16" + at + b"\x00\xf2\x00\x25"
        heard = await wire.ask(pdu)
        answer = heard.first
        if answer is None:
            return failed(f"{heard} instead of an answer")
        if answer.refusal == 0x01:
            raise NotHere("it has no function 16")
        if answer.refusal:
            return failed(refused(pdu, answer) or named(answer.refusal))
        now = await _read(wire, "holding", address)
        if answer.pdu != pdu:
            return failed(f"answers {answer} instead of the request")
        return passed() if now == b"\x00\x17" else failed(f"register {address} is {now.hex().upper()} instead of 0017")


async def broadcast_write(wire: DeviceConnection) -> Finding:
    """MB-026: send FC 06 to unit 0. The device must execute it and must not answer."""
    async with _borrowed(wire, "holding") as (address, before):
        new = _other(before)
        pdu = _write("holding", address, new)
        await wire.send(wire.frame(pdu, 0), pdu)
        heard = await wire.hear()
        if not heard.nothing:
            return failed(f"{heard} instead of silence")
        now = await _read(wire, "holding", address)
        return passed() if now == new else failed(f"register {address} is {now.hex().upper()}: it was not executed")
