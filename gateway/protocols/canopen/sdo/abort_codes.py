"""SDO abort codes and their meanings (CiA 301, 7.2.4.3.17, table 22). Data only."""

from __future__ import annotations

TOGGLE_NOT_ALTERNATED = 0x0503_0000
TIMED_OUT = 0x0504_0000
UNKNOWN_SPECIFIER = 0x0504_0001
INVALID_BLOCK_SIZE = 0x0504_0002
INVALID_SEQUENCE = 0x0504_0003
CRC_ERROR = 0x0504_0004
OUT_OF_MEMORY = 0x0504_0005
LENGTH_TOO_HIGH = 0x0607_0012
LENGTH_TOO_LOW = 0x0607_0013
GENERAL_ERROR = 0x0800_0000

MEANINGS: dict[int, str] = {
    0x0503_0000: "toggle bit not alternated",
    0x0504_0000: "SDO protocol timed out",
    0x0504_0001: "command specifier not valid or unknown",
    0x0504_0002: "invalid block size",
    0x0504_0003: "invalid sequence number",
    0x0504_0004: "CRC error",
    0x0504_0005: "out of memory",
    0x0601_0000: "unsupported access to an object",
    0x0601_0001: "attempt to read a write-only object",
    0x0601_0002: "attempt to write a read-only object",
    0x0602_0000: "object does not exist in the object dictionary",
    0x0604_0041: "object cannot be mapped to the PDO",
    0x0604_0042: "number and length of the objects to be mapped would exceed the PDO length",
    0x0604_0043: "general parameter incompatibility",
    0x0604_0047: "general internal incompatibility in the device",
    0x0606_0000: "access failed due to a hardware error",
    0x0607_0010: "data type does not match, length of service parameter does not match",
    0x0607_0012: "data type does not match, length of service parameter too high",
    0x0607_0013: "data type does not match, length of service parameter too low",
    0x0609_0011: "sub-index does not exist",
    0x0609_0030: "invalid value for parameter",
    0x0609_0031: "value of parameter written too high",
    0x0609_0032: "value of parameter written too low",
    0x0609_0036: "maximum value is less than minimum value",
    0x060A_0023: "resource not available: SDO connection",
    0x0800_0000: "general error",
    0x0800_0020: "data cannot be transferred or stored to the application",
    0x0800_0021: "data cannot be transferred or stored to the application because of local control",
    0x0800_0022: "data cannot be transferred or stored to the application because of the present device state",
    0x0800_0023: "object dictionary dynamic generation failed or no object dictionary is present",
    0x0800_0024: "no data available",
}


def meaning(code: int) -> str:
    """Return the standard's text for `code`, or ``vendor or profile specific`` if the standard does not define the code."""
    return MEANINGS.get(code, "vendor or profile specific")
