"""Third-party clients in separate programs, each with the same conversation: ``third_party_clients.py NAME WIRE WHERE``.

WIRE is ``rtu``, ``ascii`` or ``tcp``; WHERE is a serial port or a local TCP port. The program prints only the result of
each step, as JSON. It uses none of our code.
"""

from __future__ import annotations

import ctypes
import json
import socket
import sys
from ctypes.util import find_library
from typing import Any, Protocol

UNIT = 1
BAUD_RATE = 115200


class Master(Protocol):
    """`read` and `write` by function code; `refused` returns the exception code of a read."""

    def read(self, function: int, address: int, count: int) -> list[int]: ...
    def write(self, function: int, address: int, values: list[int]) -> None: ...
    def refused(self, address: int) -> int: ...


class Libmodbus:
    ILLEGAL_ADDRESS = 112345678 + 2  # EMBXILADD of modbus.h

    def __init__(self, wire: str, where: str) -> None:
        self.lib = ctypes.CDLL(find_library("modbus"), use_errno=True)
        for name in ("modbus_new_tcp", "modbus_new_rtu"):
            getattr(self.lib, name).restype = ctypes.c_void_p
        if wire == "tcp":
            self.context = ctypes.c_void_p(self.lib.modbus_new_tcp(b"127.0.0.1", int(where)))
        else:
            self.context = ctypes.c_void_p(self.lib.modbus_new_rtu(where.encode(), BAUD_RATE, ord("N"), 8, 1))
        self.lib.modbus_set_slave(self.context, UNIT)
        self.lib.modbus_set_response_timeout(self.context, 3, 0)
        assert self.lib.modbus_connect(self.context) == 0, "cannot connect"

    def read(self, function: int, address: int, count: int) -> list[int]:
        name = {1: "read_bits", 2: "read_input_bits", 3: "read_registers", 4: "read_input_registers"}[function]
        cells = ((ctypes.c_uint8 if function < 3 else ctypes.c_uint16) * count)()
        assert getattr(self.lib, f"modbus_{name}")(self.context, address, count, cells) == count, ctypes.get_errno()
        return list(cells)

    def write(self, function: int, address: int, values: list[int]) -> None:
        if function in (5, 6):
            name = "write_bit" if function == 5 else "write_register"
            assert getattr(self.lib, f"modbus_{name}")(self.context, address, values[0]) == 1
            return
        name = "write_bits" if function == 15 else "write_registers"
        cells = ((ctypes.c_uint8 if function == 15 else ctypes.c_uint16) * len(values))(*values)
        assert getattr(self.lib, f"modbus_{name}")(self.context, address, len(values), cells) == len(values)

    def refused(self, address: int) -> int:
        cells = (ctypes.c_uint16 * 1)()
        assert self.lib.modbus_read_registers(self.context, address, 1, cells) == -1
        return 2 if ctypes.get_errno() == self.ILLEGAL_ADDRESS else ctypes.get_errno()


class Minimalmodbus:
    def __init__(self, wire: str, where: str) -> None:
        import minimalmodbus

        self.master = minimalmodbus.Instrument(where, UNIT, mode=wire)
        port: Any = self.master.serial
        port.baudrate, port.timeout = BAUD_RATE, 0.5  # it waits for this time if the reply is an exception

    def read(self, function: int, address: int, count: int) -> list[int]:
        read = self.master.read_bits if function < 3 else self.master.read_registers
        return list(read(address, count, functioncode=function))

    def write(self, function: int, address: int, values: list[int]) -> None:
        if function == 5:
            self.master.write_bit(address, values[0])
        elif function == 6:
            self.master.write_register(address, values[0], functioncode=6)
        elif function == 15:
            self.master.write_bits(address, values)
        else:
            self.master.write_registers(address, values)

    def refused(self, address: int) -> int:
        import minimalmodbus

        try:
            self.master.read_register(address)
        except minimalmodbus.IllegalRequestError as e:
            return 2 if "illegal data address" in str(e) else -1
        return 0


class PyModbusTCP:
    def __init__(self, wire: str, where: str) -> None:
        from pyModbusTCP.client import ModbusClient

        self.master = ModbusClient("127.0.0.1", int(where), UNIT, timeout=3, auto_open=True)

    def read(self, function: int, address: int, count: int) -> list[int]:
        m = self.master
        reads = {1: m.read_coils, 2: m.read_discrete_inputs, 3: m.read_holding_registers, 4: m.read_input_registers}
        return [int(v) for v in reads[function](address, count) or ()]

    def write(self, function: int, address: int, values: list[int]) -> None:
        m = self.master
        single: dict[int, Any] = {5: m.write_single_coil, 6: m.write_single_register}
        several: dict[int, Any] = {15: m.write_multiple_coils, 16: m.write_multiple_registers}
        if function in single:
            assert single[function](address, values[0])
        else:
            assert several[function](address, values)

    def refused(self, address: int) -> int:
        assert self.master.read_holding_registers(address, 1) is None
        return int(self.master.last_except)


class Umodbus:
    """Read and write with the same functions for both wires."""

    def __init__(self, wire: str, where: str) -> None:
        self.wire: Any
        if wire == "tcp":
            from umodbus.client import tcp

            self.make, self.wire = tcp, socket.create_connection(("127.0.0.1", int(where)), 3)
        else:
            import serial
            from umodbus.client.serial import rtu

            self.make, self.wire = rtu, serial.Serial(where, BAUD_RATE, timeout=3)

    def read(self, function: int, address: int, count: int) -> list[int]:
        name = {1: "coils", 2: "discrete_inputs", 3: "holding_registers", 4: "input_registers"}[function]
        adu = getattr(self.make, f"read_{name}")(UNIT, address, count)
        return list(self.make.send_message(adu, self.wire))

    def write(self, function: int, address: int, values: list[int]) -> None:
        names = {5: "single_coil", 6: "single_register", 15: "multiple_coils", 16: "multiple_registers"}
        make = getattr(self.make, f"write_{names[function]}")
        self.make.send_message(make(UNIT, address, values[0] if function in (5, 6) else values), self.wire)

    def refused(self, address: int) -> int:
        from umodbus.exceptions import ModbusError

        try:
            self.read(3, address, 1)
        except ModbusError as e:
            return int(e.error_code)
        return 0


class Pymodbus:
    def __init__(self, wire: str, where: str) -> None:
        from pymodbus import FramerType
        from pymodbus.client import ModbusSerialClient, ModbusTcpClient

        self.master: Any
        if wire == "tcp":
            self.master = ModbusTcpClient("127.0.0.1", port=int(where), timeout=3, retries=0)
        else:
            self.master = ModbusSerialClient(
                where, framer=FramerType(wire), baudrate=BAUD_RATE, parity="N", timeout=3, retries=0
            )
        assert self.master.connect()

    def read(self, function: int, address: int, count: int) -> list[int]:
        m = self.master
        reads = {1: m.read_coils, 2: m.read_discrete_inputs, 3: m.read_holding_registers, 4: m.read_input_registers}
        reply = reads[function](address, count=count, device_id=UNIT)
        return [int(v) for v in (reply.bits[:count] if function < 3 else reply.registers)]

    def write(self, function: int, address: int, values: list[int]) -> None:
        m = self.master
        writes = {5: m.write_coil, 6: m.write_register, 15: m.write_coils, 16: m.write_registers}
        given: Any = [bool(v) for v in values] if function in (5, 15) else values
        reply = writes[function](address, given[0] if function in (5, 6) else given, device_id=UNIT)
        assert not reply.isError(), reply

    def refused(self, address: int) -> int:
        return int(self.master.read_holding_registers(address, count=1, device_id=UNIT).exception_code)


MASTERS: dict[str, type[Any]] = {
    "libmodbus": Libmodbus,
    "minimalmodbus": Minimalmodbus,
    "pyModbusTCP": PyModbusTCP,
    "pymodbus": Pymodbus,
    "umodbus": Umodbus,
}


def main() -> None:
    name, wire, where = sys.argv[1:]
    master: Master = MASTERS[name](wire, where)
    said: dict[str, Any] = {"inputs": master.read(4, 0, 125), "discrete": master.read(2, 0, 13)}
    master.write(6, 3, [0xBEEF])
    master.write(16, 4, list(range(100)))
    said["holding"] = master.read(3, 3, 4)
    master.write(5, 9, [1])
    master.write(15, 10, [0, 1, 1])
    said["coils"] = master.read(1, 8, 6)
    said["refused"] = master.refused(900)
    said["again"] = master.read(3, 103, 1)
    print(json.dumps(said))


if __name__ == "__main__":
    main()
