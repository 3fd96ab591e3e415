#!/usr/bin/env python3
"""One read without a wire, both ends: request, framing, the server's answer, framing, checked reply. Against pymodbus.

    benchmarks/modbus_codec.py [--runs 5] [--transactions 3000] [--quick]

Ours is the client's `Transaction` and the emulator's server with a map; pymodbus's is its client and server over its own null
modem, and, separately, its framers and PDU classes alone with a list. Runs are interleaved. Times are microseconds per
transaction: the median, and the minimum, which is least disturbed by other programs and to which the goal applies. Ratios are
those of pairs to the null modem over the same framing. The exit status is 1 if a goal is missed.
"""

from __future__ import annotations

import argparse
import asyncio
import gc
import sys
import time
from collections.abc import Callable

from peers import Goals, row
from pymodbus import FramerType
from pymodbus.client import AsyncModbusTcpClient
from pymodbus.framer import FramerRTU, FramerSocket
from pymodbus.pdu import DecodePDU
from pymodbus.pdu.register_message import ReadHoldingRegistersRequest, ReadHoldingRegistersResponse
from pymodbus.server import ModbusTcpServer
from pymodbus.simulator import DataType, SimData, SimDevice
from pymodbus.transport import NULLMODEM_HOST

from fieldtwin.emulators.modbus.bank import CellSpan, MapBank
from fieldtwin.emulators.modbus.mbap import MbapServer
from fieldtwin.emulators.modbus.rtu.line import RtuServer
from fieldtwin.emulators.modbus.unit import ModbusUnit
from fieldtwin.gateway.protocols.modbus.frames.mbap import MbapFramer
from fieldtwin.gateway.protocols.modbus.frames.rtu import RtuFramer
from fieldtwin.gateway.protocols.modbus.requests.data import ReadRegisters
from fieldtwin.gateway.protocols.modbus.transaction import Transaction

VALUES = [(i * 257) & 0xFFFF for i in range(125)]
TIMEOUT_NS = 1_000_000_000
GAP_NS = 10_000_000
UNIT = 1
GOALS_US = {10: 12.0, 125: 90.0}


def ours(framing: str, count: int, transactions: int) -> float:
    """Return the seconds for `transactions` reads of `count` registers."""
    bank = MapBank([CellSpan("holding", 0, len(VALUES))])
    bank.poke("holding", 0, *VALUES)
    units = {UNIT: ModbusUnit(bank)}
    server = MbapServer(units) if framing == "mbap" else RtuServer(units)
    framer = MbapFramer() if framing == "mbap" else RtuFramer()
    wanted = tuple(VALUES[:count])

    def exchange(now_ns: int) -> None:
        transaction = Transaction(framer, UNIT, ReadRegisters("holding", 0, count), timeout_ns=TIMEOUT_NS)
        [answer] = server.feed(transaction.start(now_ns), now_ns)
        reply = transaction.feed(answer, now_ns)
        assert reply is not None
        assert reply.registers == wanted

    return timed(exchange, transactions)


def pymodbus_codec(framing: str, count: int, transactions: int) -> float:
    framer = FramerSocket if framing == "mbap" else FramerRTU
    client, server = framer(DecodePDU(False)), framer(DecodePDU(True))
    wanted = VALUES[:count]

    def exchange(now_ns: int) -> None:
        number = now_ns // GAP_NS & 0xFFFF
        request = ReadHoldingRegistersRequest(address=0, count=count, dev_id=UNIT, transaction_id=number)
        _, asked = server.handleFrame(client.buildFrame(request), 0, 0)
        assert asked is not None
        answer = ReadHoldingRegistersResponse(
            registers=VALUES[asked.address : asked.address + asked.count],
            dev_id=asked.dev_id,
            transaction_id=asked.transaction_id,
        )
        _, reply = client.handleFrame(server.buildFrame(answer), UNIT, number)
        assert reply is not None
        assert reply.registers == wanted

    return timed(exchange, transactions)


def timed(exchange: Callable[[int], None], transactions: int) -> float:
    exchange(0)
    gc.collect()
    began = time.perf_counter()
    for i in range(1, transactions + 1):
        exchange(i * GAP_NS)
    return time.perf_counter() - began


def pymodbus_null_modem(framing: str, count: int, transactions: int) -> float:
    async def main() -> float:
        registers = SimData(0, values=VALUES, datatype=DataType.REGISTERS)
        bits = SimData(0, values=[False] * 16, datatype=DataType.BITS)
        framer = FramerType.SOCKET if framing == "mbap" else FramerType.RTU
        server = ModbusTcpServer(
            SimDevice(id=UNIT, simdata=([bits], [bits], [registers], [registers])),
            framer=framer,
            address=(NULLMODEM_HOST, 5020),
        )
        await server.serve_forever(background=True)
        client = AsyncModbusTcpClient(NULLMODEM_HOST, port=5020, framer=framer)
        await client.connect()
        wanted = VALUES[:count]
        await client.read_holding_registers(0, count=count, device_id=UNIT)
        gc.collect()
        began = time.perf_counter()
        for _ in range(transactions):
            reply = await client.read_holding_registers(0, count=count, device_id=UNIT)
            assert reply.registers == wanted
        took_s = time.perf_counter() - began
        client.close()
        await server.shutdown()
        return took_s

    return asyncio.run(main())


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--runs", type=int, default=5)
    parser.add_argument("--transactions", type=int, default=3000)
    parser.add_argument("--quick", action="store_true", help="2 runs of 1,000")
    options = parser.parse_args()
    runs, transactions = (2, 1000) if options.quick else (options.runs, options.transactions)
    goals = Goals()
    contestants = {
        "pymodbus null modem": pymodbus_null_modem,
        "pymodbus codec only": pymodbus_codec,
        "fieldtwin": ours,
    }
    for framing in ("mbap", "rtu"):
        for count in (10, 125):
            took_us: dict[str, list[float]] = {name: [] for name in contestants}
            for _ in range(runs):
                for name, run in contestants.items():
                    took_us[name].append(run(framing, count, transactions) / transactions * 1e6)
            print(f"{f'{framing}, {count} registers':<24} {'us, median':>12}   ratio   us, least")
            for name, values in took_us.items():
                print(row(name, values, took_us["pymodbus null modem"]), f"  {min(values):>6.1f}")
            goal = GOALS_US[count]
            goals.most(f"fieldtwin, {framing}, {count} registers", min(took_us["fieldtwin"]), goal, "us")
            print()
    return goals.verdict()


if __name__ == "__main__":
    sys.exit(main())
