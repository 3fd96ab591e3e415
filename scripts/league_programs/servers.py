"""Third-party servers in a separate program: one child process per row, each with a fresh device.

``servers.py NAME WIRE [LINE]`` serves one device and is what the league starts. ``servers.py NAME`` serves several, for tests.
Standard input: one line of JSON, a list of ``{"row": n, "wire": "rtu" | "ascii" | "mbap" | "udp", "line": path of a
serial port or "", "units": [1]}``. Standard output: ``n port`` per row when it serves (port 0 on a line). The program
ends, with all its children, at the end of standard input. Each row has a child, because pymodbus keeps its diagnostics
per process and libmodbus answers one client at a time. The children are forked, because that takes milliseconds.

It uses none of our code: it has a separate definition of the served device.
"""

from __future__ import annotations

import asyncio
import ctypes
import errno
import json
import logging
import os
import signal
import socket
import sys
import time
from collections.abc import Callable
from ctypes.util import find_library
from typing import Any

COILS, HOLDING, INPUTS = 48, 200, 8
HELD = {0: 0xAA, 1: 0xBB, 4: 0x12}
NAMES = {"VendorName": "fieldtwin", "ProductCode": "FT-1", "MajorMinorRevision": "V2.11", "VendorUrl": "u" * 200}
BAUD_RATE = 115200


def say(row: int, port: int) -> None:
    os.write(1, f"{row} {port}\n".encode())


def serve_pymodbus(job: dict[str, Any]) -> None:
    from pymodbus import FramerType, ModbusDeviceIdentification
    from pymodbus.server import ModbusSerialServer, ModbusTcpServer, ModbusUdpServer
    from pymodbus.simulator import DataType, SimData, SimDevice

    logging.getLogger("pymodbus.logging").setLevel(logging.CRITICAL)
    names = ModbusDeviceIdentification(info_name={**NAMES, "ProductName": "n" * 60})  # type: ignore[no-untyped-call]
    held = [HELD.get(i, 0) for i in range(HOLDING)]
    tables = (
        [SimData(0, values=[False] * COILS, datatype=DataType.BITS)],
        [SimData(0, values=[False] * 16, datatype=DataType.BITS)],
        [
            SimData(0, values=held, datatype=DataType.REGISTERS),
            SimData(299, values=[0], datatype=DataType.REGISTERS),
            SimData(300, values=[0], datatype=DataType.REGISTERS, readonly=True),
        ],
        [SimData(0, values=[0x4120] + [0] * (INPUTS - 1), datatype=DataType.REGISTERS)],
    )
    devices = [SimDevice(id=unit, simdata=tables, identity=names) for unit in job["units"]]

    async def main() -> None:
        server: ModbusSerialServer | ModbusTcpServer | ModbusUdpServer
        # on a line, requests to other units are ignored silently, and 0 is a broadcast
        if job["wire"] in ("rtu", "ascii"):
            server = ModbusSerialServer(
                devices, framer=FramerType(job["wire"]), port=job["line"], baudrate=BAUD_RATE, identity=names,
                ignore_missing_devices=True, broadcast_enable=True,
            )  # fmt: skip
        elif job["wire"] == "udp":
            server = ModbusUdpServer(devices, address=("127.0.0.1", 0), identity=names)
        else:
            server = ModbusTcpServer(devices, address=("127.0.0.1", 0), identity=names)
        await server.serve_forever(background=True)
        transport: Any = server.transport
        port = 0
        if job["wire"] == "mbap":
            port = transport.sockets[0].getsockname()[1]
        elif job["wire"] == "udp":
            port = transport.get_extra_info("sockname")[1]
        say(job["row"], port)
        await asyncio.Event().wait()

    asyncio.run(main())


class Mapping(ctypes.Structure):
    """modbus_mapping_t of modbus.h."""

    _fields_ = (
        *((name, ctypes.c_int) for name in ("nb_bits", "start_bits", "nb_input_bits", "start_input_bits")),
        *((name, ctypes.c_int) for name in ("nb_input_registers", "start_input_registers")),
        *((name, ctypes.c_int) for name in ("nb_registers", "start_registers")),
        *((name, ctypes.POINTER(ctypes.c_uint8)) for name in ("tab_bits", "tab_input_bits")),
        *((name, ctypes.POINTER(ctypes.c_uint16)) for name in ("tab_input_registers", "tab_registers")),
    )


def serve_libmodbus(job: dict[str, Any]) -> None:
    """Behave like libmodbus's example servers: an invalid frame is ignored on a line and ends a TCP connection."""
    lib = ctypes.CDLL(find_library("modbus"), use_errno=True)
    for name in ("modbus_new_tcp", "modbus_new_rtu"):
        getattr(lib, name).restype = ctypes.c_void_p
    lib.modbus_mapping_new.restype = ctypes.POINTER(Mapping)
    mapping = lib.modbus_mapping_new(COILS, 16, HOLDING, INPUTS)
    for address, value in HELD.items():
        mapping.contents.tab_registers[address] = value
    mapping.contents.tab_input_registers[0] = 0x4120
    query = ctypes.create_string_buffer(260)
    if job["wire"] == "mbap":
        context = ctypes.c_void_p(lib.modbus_new_tcp(b"127.0.0.1", 0))
        listening = lib.modbus_tcp_listen(context, 1)
        with socket.socket(fileno=listening) as listener:
            say(job["row"], listener.getsockname()[1])
            while True:  # one client after the other
                accepted = ctypes.c_int(listening)
                if lib.modbus_tcp_accept(context, ctypes.byref(accepted)) < 0:
                    return
                while (size := lib.modbus_receive(context, query)) >= 0:
                    if size:
                        lib.modbus_reply(context, query, size, mapping)
                lib.modbus_close(context)
    context = ctypes.c_void_p(lib.modbus_new_rtu(job["line"].encode(), BAUD_RATE, ord("N"), 8, 1))
    lib.modbus_set_slave(context, job["units"][0])
    if lib.modbus_connect(context) != 0:
        sys.exit("cannot open the port")
    say(job["row"], 0)
    while True:
        size = lib.modbus_receive(context, query)
        if size > 0:
            lib.modbus_reply(context, query, size, mapping)
        elif size < 0 and ctypes.get_errno() in (errno.EIO, errno.EBADF, errno.ECONNRESET):
            return


def serve_pymodbustcp(job: dict[str, Any]) -> None:
    from pyModbusTCP.server import DataBank, DeviceIdentification, ModbusServer

    bank = DataBank(coils_size=COILS, d_inputs_size=16, h_regs_size=HOLDING, i_regs_size=INPUTS)
    bank.set_holding_registers(0, [HELD.get(i, 0) for i in range(HOLDING)])
    bank.set_input_registers(0, [0x4120])
    names = DeviceIdentification(vendor_name=b"fieldtwin", product_code=b"FT-1", major_minor_revision=b"V2.11")
    server = ModbusServer("127.0.0.1", 0, no_block=True, data_bank=bank, device_id=names)
    server.start()
    say(job["row"], server._service.socket.getsockname()[1])
    signal.pause()


def serve_umodbus(job: dict[str, Any]) -> None:
    from umodbus import conf

    conf.SIGNED_VALUES = False
    tables = [dict.fromkeys(range(n), 0) for n in (COILS, 16, HOLDING, INPUTS)]
    tables[2].update(HELD)
    tables[3][0] = 0x4120
    if job["wire"] == "mbap":
        from socketserver import TCPServer

        from umodbus.server.tcp import RequestHandler
        from umodbus.server.tcp import get_server as tcp_server

        server = tcp_server(TCPServer, ("127.0.0.1", 0), RequestHandler)
        port = server.socket.getsockname()[1]
    else:
        import serial
        from umodbus.server.serial import get_server as serial_server
        from umodbus.server.serial.rtu import RTUServer

        server, port = serial_server(RTUServer, serial.Serial(job["line"], BAUD_RATE)), 0
    for reads, writes, cells in zip(([1], [2], [3], [4]), ([5, 15], [], [6, 16], []), tables, strict=True):

        def read(slave_id: int, function_code: int, address: int, cells: dict[int, int] = cells) -> int:
            return cells[address]

        def write(slave_id: int, function_code: int, address: int, value: int, cells: dict[int, int] = cells) -> None:
            cells[address] = value

        server.route([1], reads, list(cells))(read)
        server.route([1], writes, list(cells))(write)
    say(job["row"], port)
    server.serve_forever(poll_interval=0.05)  # also the timeout for the rest of a frame on a line


def serve_modbus_tk(job: dict[str, Any]) -> None:
    from modbus_tk import defines

    if job["wire"] == "mbap":
        from modbus_tk.modbus_tcp import TcpServer

        server = TcpServer(port=0, address="127.0.0.1")
    else:
        import serial
        from modbus_tk.modbus_rtu import RtuServer

        server = RtuServer(serial.Serial(job["line"], BAUD_RATE))
    unit = server.add_slave(job["units"][0])
    unit.add_block("coils", defines.COILS, 0, COILS)
    unit.add_block("discrete", defines.DISCRETE_INPUTS, 0, 16)
    unit.add_block("holding", defines.HOLDING_REGISTERS, 0, HOLDING)
    unit.add_block("inputs", defines.ANALOG_INPUTS, 0, INPUTS)
    unit.set_values("holding", 0, [HELD.get(i, 0) for i in range(HOLDING)])
    unit.set_values("inputs", 0, [0x4120])
    server.start()
    while job["wire"] == "mbap" and server._sock is None:  # its thread opens it
        time.sleep(0.01)
    say(job["row"], server._sock.getsockname()[1] if job["wire"] == "mbap" else 0)
    signal.pause()


def serve_modbuslink(job: dict[str, Any]) -> None:
    from modbuslink import AsyncRtuModbusServer, AsyncTcpModbusServer, ModbusDataStore

    store = ModbusDataStore(COILS, 16, HOLDING, INPUTS)
    store.write_holding_registers(0, [HELD.get(i, 0) for i in range(HOLDING)])

    async def main() -> None:
        unit = job["units"][0]
        if job["wire"] == "mbap":
            port = free_port()
            server: Any = AsyncTcpModbusServer("127.0.0.1", port, store, unit)
        else:
            port, server = 0, AsyncRtuModbusServer(job["line"], BAUD_RATE, data_store=store, slave_id=unit)
        await server.start()
        say(job["row"], port)
        await server.serve_forever()

    asyncio.run(main())


def serve_modbus_rs(job: dict[str, Any]) -> None:
    import modbus_rs

    held = [HELD.get(i, 0) for i in range(HOLDING)]
    coils = [modbus_rs.CoilState.Off] * COILS

    def part(cells: list[Any], address: int, count: int) -> list[Any]:
        if address + count > len(cells):
            raise IndexError("illegal data address")
        return cells[address : address + count]

    class Device(modbus_rs.ModbusApp):  # type: ignore[misc, name-defined]
        def handle_read_coils(self, address: int, count: int) -> list[Any]:
            return part(coils, address, count)

        def handle_write_coil(self, address: int, value: Any) -> None:
            coils[address] = value

        def handle_write_coils(self, address: int, values: list[Any]) -> None:
            part(coils, address, len(values))
            coils[address : address + len(values)] = values

        def handle_read_holding_registers(self, address: int, count: int) -> list[int]:
            return part(held, address, count)

        def handle_write_register(self, address: int, value: int) -> None:
            held[address] = value

        def handle_write_registers(self, address: int, values: list[int]) -> None:
            part(held, address, len(values))
            held[address : address + len(values)] = values

    port = free_port() if job["wire"] == "mbap" else 0
    if job["wire"] == "mbap":
        server = modbus_rs.TcpServer("127.0.0.1", Device(), port=port, unit_id=job["units"][0])
    else:
        server = modbus_rs.SerialServer(job["line"], Device(), baud_rate=BAUD_RATE, unit_id=job["units"][0])
    say(job["row"], port)
    server.serve_forever()


def serve_modbus_tcp_server(job: dict[str, Any]) -> None:
    from modbus_tcp_server.network import ModbusTCPServer

    port = free_port()
    ModbusTCPServer("127.0.0.1", port).start()
    say(job["row"], port)
    signal.pause()


def serve_pymodbus_3_0(job: dict[str, Any]) -> None:
    """Serve with pymodbus 3.0, whose device is a data store."""
    from pymodbus.datastore import ModbusSequentialDataBlock, ModbusServerContext, ModbusSlaveContext
    from pymodbus.device import ModbusDeviceIdentification
    from pymodbus.framer.rtu_framer import ModbusRtuFramer
    from pymodbus.server import StartAsyncSerialServer, StartAsyncTcpServer

    held = [HELD.get(i, 0) for i in range(HOLDING)]
    blocks = {"co": [0] * COILS, "di": [0] * 16, "hr": held, "ir": [0x4120] + [0] * (INPUTS - 1)}
    unit = ModbusSlaveContext(**{k: ModbusSequentialDataBlock(0, v) for k, v in blocks.items()}, zero_mode=True)
    names = ModbusDeviceIdentification(info_name=NAMES)  # type: ignore[no-untyped-call]
    devices = ModbusServerContext({job["units"][0]: unit}, single=False)
    port = free_port() if job["wire"] == "mbap" else 0

    async def main() -> None:
        asyncio.get_running_loop().call_later(0.5, say, job["row"], port)  # its start functions do not return
        if port:
            await StartAsyncTcpServer(devices, identity=names, address=("127.0.0.1", port))
        else:
            await StartAsyncSerialServer(
                devices, identity=names, framer=ModbusRtuFramer, port=job["line"], baudrate=BAUD_RATE
            )
            await asyncio.Event().wait()

    asyncio.run(main())


def free_port() -> int:
    """Return a free port, for libraries that do not tell which one they have bound."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


SERVERS: dict[str, Callable[[dict[str, Any]], None]] = {
    "libmodbus": serve_libmodbus,
    "modbus-rs": serve_modbus_rs,
    "modbus-tcp-server": serve_modbus_tcp_server,
    "modbus_tk": serve_modbus_tk,
    "modbuslink": serve_modbuslink,
    "pyModbusTCP": serve_pymodbustcp,
    "pymodbus": serve_pymodbus,
    "pymodbus-3.0": serve_pymodbus_3_0,
    "umodbus": serve_umodbus,
}


def main() -> None:
    serve = SERVERS[sys.argv[1]]
    if len(sys.argv) > 2:
        line = sys.argv[3] if len(sys.argv) > 3 else ""
        serve({"row": 0, "wire": "mbap" if sys.argv[2] == "tcp" else sys.argv[2], "line": line, "units": [1]})
        return
    if serve is serve_pymodbus:  # shared by all children
        import pymodbus.server
        import pymodbus.simulator  # noqa: F401
    children = []
    for job in json.loads(sys.stdin.readline()):
        child = os.fork()
        if not child:
            try:
                serve(job)
            finally:
                os._exit(0)
        children.append(child)
    sys.stdin.read()
    for child in children:
        os.kill(child, signal.SIGKILL)
        os.waitpid(child, 0)


if __name__ == "__main__":
    main()
