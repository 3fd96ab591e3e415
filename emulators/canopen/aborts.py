"""SDO abort codes by name (CiA 301 v4.2, 7.2.4.3.17) and how the emulated node raises them.

An abort is an ordinary `fieldtwin.gateway.core.errors.SdoAborted`; the SDO server turns it into a frame.
"""

from __future__ import annotations

from enum import IntEnum

from fieldtwin.gateway.core.errors import SdoAborted


class Abort(IntEnum):
    """The abort codes of the standard.

    Some have a cause only in a real device; a user can set them with `NodeContext.refusals`.
    """

    TOGGLE = 0x05030000
    TIMEOUT = 0x05040000
    COMMAND = 0x05040001
    BLOCK_SIZE = 0x05040002
    SEQUENCE = 0x05040003
    CRC = 0x05040004
    OUT_OF_MEMORY = 0x05040005
    ACCESS = 0x06010000
    WRITE_ONLY = 0x06010001
    READ_ONLY = 0x06010002
    NO_OBJECT = 0x06020000
    NOT_MAPPABLE = 0x06040041
    MAPPING_TOO_LONG = 0x06040042
    INCOMPATIBLE = 0x06040043
    INTERNAL = 0x06040047
    HARDWARE = 0x06060000
    LENGTH = 0x06070010
    TOO_LONG = 0x06070012
    TOO_SHORT = 0x06070013
    NO_SUBINDEX = 0x06090011
    VALUE = 0x06090030
    VALUE_HIGH = 0x06090031
    VALUE_LOW = 0x06090032
    MAXIMUM_BELOW_MINIMUM = 0x06090036
    NO_RESOURCE = 0x060A0023
    GENERAL = 0x08000000
    NOT_STORED = 0x08000020
    LOCAL_CONTROL = 0x08000021
    DEVICE_STATE = 0x08000022
    NO_DICTIONARY = 0x08000023
    NO_DATA = 0x08000024


MEANINGS = {
    Abort.TOGGLE: "toggle bit not alternated",
    Abort.TIMEOUT: "SDO protocol timed out",
    Abort.COMMAND: "command specifier not valid or unknown",
    Abort.BLOCK_SIZE: "invalid block size",
    Abort.SEQUENCE: "invalid sequence number",
    Abort.CRC: "CRC error",
    Abort.OUT_OF_MEMORY: "out of memory",
    Abort.ACCESS: "unsupported access to an object",
    Abort.WRITE_ONLY: "read of a write-only object",
    Abort.READ_ONLY: "write to a read-only object",
    Abort.NO_OBJECT: "object does not exist",
    Abort.NOT_MAPPABLE: "object cannot be mapped to the PDO",
    Abort.MAPPING_TOO_LONG: "mapped objects exceed the PDO's length",
    Abort.INCOMPATIBLE: "general parameter incompatibility",
    Abort.INTERNAL: "general internal incompatibility in the device",
    Abort.HARDWARE: "access failed due to a hardware error",
    Abort.LENGTH: "data type does not match, length of the parameter does not match",
    Abort.TOO_LONG: "length of the parameter too high",
    Abort.TOO_SHORT: "length of the parameter too low",
    Abort.NO_SUBINDEX: "subindex does not exist",
    Abort.VALUE: "invalid value for the parameter",
    Abort.VALUE_HIGH: "value too high",
    Abort.VALUE_LOW: "value too low",
    Abort.MAXIMUM_BELOW_MINIMUM: "maximum value is less than minimum value",
    Abort.NO_RESOURCE: "resource not available: SDO connection",
    Abort.GENERAL: "general error",
    Abort.NOT_STORED: "data cannot be transferred or stored",
    Abort.LOCAL_CONTROL: "data cannot be stored because of local control",
    Abort.DEVICE_STATE: "not in the present device state",
    Abort.NO_DICTIONARY: "object dictionary is not present or not generated",
    Abort.NO_DATA: "no data available",
}


def abort(index: int, subindex: int, code: Abort) -> SdoAborted:
    """Return the error that refuses access to an object, to be raised with ``raise abort(...)``."""
    return SdoAborted(index, subindex, int(code), MEANINGS[code], where="emulated node")


def abort_frame(error: SdoAborted) -> bytes:
    """Return the 8 bytes that abort a transfer."""
    mux = error.index.to_bytes(2, "little") + bytes([error.subindex])
    return b"\x80" + mux + error.code.to_bytes(4, "little")
