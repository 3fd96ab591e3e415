"""Poll a serial line with a third-party library: ``dead_line_poller.py LIBRARY PORT UNITS PERIOD_S``.

Register 0 of every unit is due every PERIOD_S seconds. The program asks the units in order, and starts a round at once if the
last one took longer. The timeout is 1 s, with one repetition.
"""

from __future__ import annotations

import asyncio
import logging
import sys
import time
from collections.abc import Callable


def minimalmodbus(port: str) -> Callable[[int], object]:
    import minimalmodbus

    units = {}

    def read(unit: int) -> None:
        if unit not in units:
            units[unit] = minimalmodbus.Instrument(port, unit)
            units[unit].serial.baudrate, units[unit].serial.timeout = 19200, 1.0
        for _ in range(2):
            try:
                units[unit].read_register(0)
                return
            except (minimalmodbus.ModbusException, OSError):
                pass

    return read


def modbus_tk(port: str) -> Callable[[int], object]:
    from modbus_tk.modbus_rtu import RtuMaster
    from serial import Serial

    client = RtuMaster(Serial(port, baudrate=19200))
    client.set_timeout(1.0)

    def read(unit: int) -> None:
        for _ in range(2):
            try:
                client.execute(unit, 3, 0, 1)
                return
            except Exception:  # its errors have no common class
                pass

    return read


def rounds(read: Callable[[int], object], units: int, period_s: float) -> None:
    due = time.monotonic()
    while True:
        for unit in range(1, units + 1):
            read(unit)
        due = max(due + period_s, time.monotonic())
        time.sleep(max(0.0, due - time.monotonic()))


async def pymodbus(port: str, units: int, period_s: float) -> None:
    from pymodbus.client import AsyncModbusSerialClient
    from pymodbus.exceptions import ModbusException

    logging.disable(logging.CRITICAL)
    client = AsyncModbusSerialClient(port, baudrate=19200, parity="N", timeout=1.0, retries=1)
    await client.connect()
    loop = asyncio.get_running_loop()
    due = loop.time()
    while True:
        for unit in range(1, units + 1):
            try:
                if not client.connected:
                    await client.connect()
                await client.read_holding_registers(0, count=1, device_id=unit)
            except ModbusException:
                pass
        due = max(due + period_s, loop.time())
        await asyncio.sleep(max(0.0, due - loop.time()))


def main() -> None:
    library, port, units, period_s = sys.argv[1], sys.argv[2], int(sys.argv[3]), float(sys.argv[4])
    if library == "pymodbus":
        asyncio.run(pymodbus(port, units, period_s))
    else:
        rounds({"minimalmodbus": minimalmodbus, "modbus_tk": modbus_tk}[library](port), units, period_s)


if __name__ == "__main__":
    main()
