"""An independent ctd: libmodbus as the RTU server, a handwritten register map, samples from a table.

Run as ``python ctd_libmodbus.py PORT TABLE [--plant ...]``. TABLE is JSON: a list of [milliseconds, pressure,
temperature, conductivity], one row per sample. It was written from the text of the reference profile and shares no code
with this project.
"""

import argparse
import ctypes
import ctypes.util
import json
import math
import struct
import sys
import time

STANDBY, SAMPLING, OFF = 0, 1, 2
SERIAL = b"0042\0\0\0\0"
FUNCTIONS = (3, 4, 6, 16)
MAX_READ = 60
HOLDING = {*range(2), *range(100, 104)}
INPUTS = set(range(10))
ILLEGAL_FUNCTION, ILLEGAL_ADDRESS, ILLEGAL_VALUE = 1, 2, 3


class Mapping(ctypes.Structure):
    """modbus_mapping_t of libmodbus 3.1."""

    _fields_ = [
        *((name, ctypes.c_int) for name in ("nb_bits", "start_bits", "nb_input_bits", "start_input_bits")),
        *(
            (name, ctypes.c_int)
            for name in ("nb_input_registers", "start_input_registers", "nb_registers", "start_registers")
        ),
        *((name, ctypes.POINTER(ctypes.c_uint8)) for name in ("tab_bits", "tab_input_bits")),
        *((name, ctypes.POINTER(ctypes.c_uint16)) for name in ("tab_input_registers", "tab_registers")),
    ]


def library():
    lib = ctypes.CDLL(ctypes.util.find_library("modbus") or "libmodbus.so.5", use_errno=True)
    lib.modbus_new_rtu.restype = ctypes.c_void_p
    lib.modbus_new_rtu.argtypes = [ctypes.c_char_p, ctypes.c_int, ctypes.c_char, ctypes.c_int, ctypes.c_int]
    lib.modbus_mapping_new.restype = ctypes.POINTER(Mapping)
    for name in ("modbus_connect", "modbus_get_header_length"):
        getattr(lib, name).argtypes = [ctypes.c_void_p]
    lib.modbus_set_slave.argtypes = [ctypes.c_void_p, ctypes.c_int]
    lib.modbus_receive.argtypes = [ctypes.c_void_p, ctypes.c_char_p]
    lib.modbus_reply.argtypes = [ctypes.c_void_p, ctypes.c_char_p, ctypes.c_int, ctypes.POINTER(Mapping)]
    lib.modbus_reply_exception.argtypes = [ctypes.c_void_p, ctypes.c_char_p, ctypes.c_uint]
    return lib


class Ctd:
    """The instrument: takes a row of its table every `period` seconds while the period is positive, the first one at
    once."""

    def __init__(self, mapping, rows, swapped):
        self.inputs, self.holding = mapping.contents.tab_input_registers, mapping.contents.tab_registers
        self.rows, self.swapped = rows, swapped
        self.count, self.period, self.next = 0, 0, 0.0
        self.put(self.holding, 100, SERIAL)
        self.show(0, math.nan, math.nan, math.nan)

    @staticmethod
    def put(registers, address, data):
        for i, word in enumerate(struct.unpack(f">{len(data) // 2}H", data)):
            registers[address + i] = word

    def show(self, ms, *values):
        for i, value in enumerate(values):
            data = struct.pack(">f", value)
            self.put(self.inputs, 2 * i, data[2:] + data[:2] if self.swapped else data)
        self.put(self.inputs, 6, struct.pack(">II", self.count, ms))

    def catch_up(self, now):
        while self.period > 0 and self.next <= now and self.count < len(self.rows):
            self.count += 1
            self.show(*self.rows[self.count - 1])
            self.next += self.period

    def written(self, now):
        """If the period was written, a new one starts at once."""
        self.period = struct.unpack(">h", struct.pack(">H", self.holding[1]))[0]
        self.holding[0] = SAMPLING if self.period > 0 else STANDBY if self.period == 0 else OFF
        self.next = now
        self.catch_up(now)


def refusal(pdu):
    """Return the exception code that the instrument's manual requires, or 0."""
    function, address, count = struct.unpack(">BHH", pdu[:5])
    if function not in FUNCTIONS:
        return ILLEGAL_FUNCTION
    if function in (6, 16):
        return 0 if address == 1 and (function == 6 or count == 1) else ILLEGAL_ADDRESS
    if not 1 <= count <= MAX_READ:
        return ILLEGAL_VALUE
    known = INPUTS if function == 4 else HOLDING
    return 0 if known.issuperset(range(address, address + count)) else ILLEGAL_ADDRESS


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("port")
    parser.add_argument("table")
    parser.add_argument("--plant", choices=["exception", "swapped"])
    args = parser.parse_args()
    with open(args.table, encoding="utf-8") as file:
        rows = json.load(file)
    lib = library()
    line = lib.modbus_new_rtu(args.port.encode(), 19200, b"E", 8, 1)
    if not line or lib.modbus_set_slave(line, 1) or lib.modbus_connect(line):
        sys.exit(f"libmodbus cannot open {args.port}: errno {ctypes.get_errno()}")
    mapping = lib.modbus_mapping_new(0, 0, 104, 10)
    ctd = Ctd(mapping, rows, args.plant == "swapped")
    request = ctypes.create_string_buffer(256)
    print("ready", flush=True)
    while True:
        size = lib.modbus_receive(line, request)
        if size <= 0:
            continue
        pdu = request.raw[lib.modbus_get_header_length(line) : size - 2]
        ctd.catch_up(time.monotonic())
        code = refusal(pdu.ljust(5, b"\0"))
        if code:
            if args.plant == "exception" and code == ILLEGAL_ADDRESS:
                code = ILLEGAL_VALUE
            lib.modbus_reply_exception(line, request, code)
            continue
        lib.modbus_reply(line, request, size, mapping)
        if pdu[0] in (6, 16):
            ctd.written(time.monotonic())


if __name__ == "__main__":
    main()
