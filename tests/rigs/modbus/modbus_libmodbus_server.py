"""libmodbus's server in a separate program: ``modbus_libmodbus_server.py tcp`` or ``... rtu DEVICE``.

Unit 1: 200 coils, discrete inputs (every third set), holding registers (0), input registers (257 x address). It prints the TCP
port, or ``ready``, and serves one client after the other until it is terminated.
"""

from __future__ import annotations

import ctypes
import socket
import sys
from ctypes.util import find_library

COUNT = 200


class Mapping(ctypes.Structure):
    """modbus_mapping_t of modbus.h."""

    _fields_ = (
        *((name, ctypes.c_int) for name in ("nb_bits", "start_bits", "nb_input_bits", "start_input_bits")),
        *((name, ctypes.c_int) for name in ("nb_input_registers", "start_input_registers")),
        *((name, ctypes.c_int) for name in ("nb_registers", "start_registers")),
        *((name, ctypes.POINTER(ctypes.c_uint8)) for name in ("tab_bits", "tab_input_bits")),
        *((name, ctypes.POINTER(ctypes.c_uint16)) for name in ("tab_input_registers", "tab_registers")),
    )


def library() -> ctypes.CDLL:
    lib = ctypes.CDLL(find_library("modbus"))
    for name in ("modbus_new_tcp", "modbus_new_rtu"):
        getattr(lib, name).restype = ctypes.c_void_p
    lib.modbus_mapping_new.restype = ctypes.POINTER(Mapping)
    return lib


def serve(lib: ctypes.CDLL, context: ctypes.c_void_p, mapping: ctypes._Pointer[Mapping]) -> None:
    query = ctypes.create_string_buffer(260)
    while (size := lib.modbus_receive(context, query)) >= 0:
        if size:
            lib.modbus_reply(context, query, size, mapping)


def main() -> None:
    lib = library()
    mapping = lib.modbus_mapping_new(COUNT, COUNT, COUNT, COUNT)
    for i in range(COUNT):
        mapping.contents.tab_input_bits[i] = i % 3 == 0
        mapping.contents.tab_input_registers[i] = i * 257 & 0xFFFF
    if sys.argv[1] == "tcp":
        context = ctypes.c_void_p(lib.modbus_new_tcp(b"127.0.0.1", 0))
        listening = lib.modbus_tcp_listen(context, 1)
        with socket.socket(fileno=listening) as listener:
            print(listener.getsockname()[1], flush=True)
            while True:
                accepted = ctypes.c_int(listening)
                lib.modbus_tcp_accept(context, ctypes.byref(accepted))
                serve(lib, context, mapping)
    context = ctypes.c_void_p(lib.modbus_new_rtu(sys.argv[2].encode(), 115200, ord("N"), 8, 1))
    lib.modbus_set_slave(context, 1)
    if lib.modbus_connect(context) != 0:
        sys.exit("cannot open the port")
    print("ready", flush=True)
    serve(lib, context, mapping)


if __name__ == "__main__":
    main()
