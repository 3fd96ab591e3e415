"""Servers of pymodbus and libmodbus for tests, and a null modem made of two ptys."""

from __future__ import annotations

import asyncio
import os
import sys
import tty
from collections.abc import AsyncIterator, Iterator
from contextlib import asynccontextmanager, contextmanager
from ctypes.util import find_library
from pathlib import Path

import pytest
from pymodbus.simulator import DataType, SimData, SimDevice

COUNT = 200
INPUTS = [(i * 257) & 0xFFFF for i in range(COUNT)]
LIBMODBUS = Path(__file__).with_name("modbus_libmodbus_server.py")


def sim_device() -> SimDevice:
    return SimDevice(
        id=1,
        simdata=(
            [SimData(0, values=[False] * COUNT, datatype=DataType.BITS)],
            [SimData(0, values=[i % 3 == 0 for i in range(COUNT)], datatype=DataType.BITS)],
            [SimData(0, values=[0] * COUNT, datatype=DataType.REGISTERS)],
            [SimData(0, values=INPUTS, datatype=DataType.REGISTERS)],
        ),
    )


@contextmanager
def null_modem() -> Iterator[tuple[str, str]]:
    """Two ptys joined byte for byte; their slave ends remain open, so that neither program sees a hang-up."""
    pairs = [os.openpty(), os.openpty()]
    loop = asyncio.get_running_loop()
    for _, slave in pairs:
        tty.setraw(slave)
    (a, a_slave), (b, b_slave) = pairs
    for source, sink in ((a, b), (b, a)):
        loop.add_reader(source, lambda source=source, sink=sink: os.write(sink, os.read(source, 4096)))
    try:
        yield os.ttyname(a_slave), os.ttyname(b_slave)
    finally:
        for fd in (a, b):
            loop.remove_reader(fd)
        for fd in (a, a_slave, b, b_slave):
            os.close(fd)


@asynccontextmanager
async def libmodbus(*arguments: str) -> AsyncIterator[str]:
    """Run the program; return its first line."""
    if find_library("modbus") is None:
        pytest.skip("libmodbus is not installed")
    process = await asyncio.create_subprocess_exec(
        sys.executable, str(LIBMODBUS), *arguments, stdout=asyncio.subprocess.PIPE
    )
    try:
        assert process.stdout is not None
        yield (await process.stdout.readline()).decode().strip()
    finally:
        process.terminate()
        await process.communicate()
