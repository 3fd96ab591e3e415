"""A flow meter that docs/tutorials/unknown-device.md examines: a Modbus RTU server made with pymodbus, without fieldtwin.

python flow_meter.py PORT
"""

from __future__ import annotations

import asyncio
import math
import struct
import sys
import time

from pymodbus import FramerType, ModbusDeviceIdentification
from pymodbus.exceptions import NoSuchIdException
from pymodbus.server import ModbusSerialServer
from pymodbus.simulator import DataType, SimData, SimDevice

UNIT = 3
BEGAN = time.monotonic()
IDENTITY = {"VendorName": "Example", "ProductCode": "FM-300", "MajorMinorRevision": "1.4"}


def words(*values: float) -> list[int]:
    """Return 32-bit floats as registers with the low word first, as many meters send them."""
    return [word for value in values for word in reversed(struct.unpack(">HH", struct.pack(">f", value)))]


async def measure(function: int, start: int, address: int, count: int, registers: list[int], written: object) -> None:
    """Put the present measurements into the input registers. pymodbus calls this before each reply."""
    if function == 4:
        seconds = time.monotonic() - BEGAN
        flow = 12.0 + 3.0 * math.sin(seconds / 7.0)
        registers[0:6] = words(flow, 1.9 + 0.03 * flow, 21.5 + 0.7 * math.sin(seconds / 5.0))
        total = 184_467 + int(seconds * 900)
        registers[6:8] = [total >> 16, total & 0xFFFF]


async def nobody(*_: object) -> None:
    """Stand for every other unit: pymodbus 3.16.1 would answer for them, with exception 04."""
    raise NoSuchIdException


async def main(port: str) -> None:
    meter = SimDevice(
        id=UNIT,
        simdata=(
            [SimData(0, values=[False], datatype=DataType.BITS)],
            [SimData(0, values=[False], datatype=DataType.BITS)],
            [SimData(0, values=[100, 5], datatype=DataType.REGISTERS)],
            [SimData(0, values=[0] * 8, datatype=DataType.REGISTERS)],
        ),
        action=measure,
    )
    server = ModbusSerialServer(
        [meter, SimDevice(id=0, simdata=[SimData(0, count=65_536, datatype=DataType.REGISTERS)], action=nobody)],
        framer=FramerType.RTU,
        port=port,
        baudrate=9600,
        identity=ModbusDeviceIdentification(info_name=IDENTITY),
        ignore_missing_devices=True,
    )
    print(f"the flow meter answers on {port}", flush=True)
    await server.serve_forever()


asyncio.run(main(sys.argv[1]))
