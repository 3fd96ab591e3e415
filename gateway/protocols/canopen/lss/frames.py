"""LSS frames (CiA 305): requests of the master on 7E5h, replies of slaves on 7E4h. `master` sends and receives them."""

from __future__ import annotations

from dataclasses import dataclass

from fieldtwin.gateway.core.canframe import CanFrame
from fieldtwin.gateway.core.errors import DeviceRefused, UsageError
from fieldtwin.gateway.protocols.canopen import cob_id

SWITCH_GLOBAL = 0x04
CONFIGURE_NODE_ID = 0x11
CONFIGURE_BIT_TIMING = 0x13
ACTIVATE_BIT_TIMING = 0x15
STORE = 0x17
SWITCH_SELECTIVE = (0x40, 0x41, 0x42, 0x43)
SWITCHED = 0x44
SLAVE_FOUND = 0x4F
NON_CONFIGURED_FOUND = 0x50
FASTSCAN = 0x51
IDENTIFY_NON_CONFIGURED = 0x4C
INQUIRE = (0x5A, 0x5B, 0x5C, 0x5D)
INQUIRE_NODE_ID = 0x5E

ANY_SLAVE = 0x80
"""The bit number of the fastscan request that every slave without a node ID answers, and that starts the scan again."""

UNCONFIGURED = 0xFF
"""The node ID of a slave that has none."""

BIT_RATES = {1_000_000: 0, 800_000: 1, 500_000: 2, 250_000: 3, 125_000: 4, 50_000: 6, 20_000: 7, 10_000: 8}
"""Bit rates (bit/s) and their index in the standard table 0."""

_ERRORS = {
    (CONFIGURE_NODE_ID, 1): "node id out of range",
    (CONFIGURE_BIT_TIMING, 1): "bit timing not supported",
    (STORE, 1): "store configuration not supported",
    (STORE, 2): "storage media access error",
}


class LssRefused(DeviceRefused):
    """An LSS slave answered with an error code. `code` is that of the standard, `specific` that of the vendor (code 255)."""

    def __init__(self, what: str, code: int, specific: int, meaning: str) -> None:
        super().__init__(f"LSS {what}: {meaning}", got=f"error {code}" + (f", specific {specific}" if specific else ""))
        self.code = code
        self.specific = specific


@dataclass(frozen=True, slots=True)
class LssAddress:
    """The identity of one LSS slave: the four numbers of 1018h."""

    vendor: int
    product: int
    revision: int
    serial: int

    def __post_init__(self) -> None:
        if not all(0 <= part <= 0xFFFF_FFFF for part in self.parts):
            raise UsageError("not an LSS address", expected="four numbers of 32 bits", got=str(self))

    @property
    def parts(self) -> tuple[int, int, int, int]:
        return self.vendor, self.product, self.revision, self.serial

    def __str__(self) -> str:
        return "/".join(f"{part:X}h" for part in self.parts)


def request(command: int, data: bytes = b"") -> CanFrame:
    """Return a request: command specifier, then up to 7 bytes, padded with zeros."""
    return CanFrame(cob_id.LSS_REQUEST, bytes([command]) + data.ljust(7, b"\0"))


def fastscan(number: int, bit: int, part: int, following: int) -> CanFrame:
    """Return a fastscan request.

    A slave replies if bits 31 to `bit` of its `part` (0 vendor, 1 product, 2 revision, 3 serial) equal those of `number`.
    `following` is the part with which the slave continues.
    """
    return request(FASTSCAN, number.to_bytes(4, "little") + bytes([bit, part, following]))


def check_node_id(node: int) -> int:
    """Return `node` if LSS can assign it: 1 to 127, or 255 to remove a node ID (CO-058)."""
    if not (1 <= node <= cob_id.NODE_MAX or node == UNCONFIGURED):
        raise UsageError("not a node id that LSS gives", expected="1 to 127, or 255 for none", got=str(node))
    return node


def check_result(what: str, reply: bytes) -> None:
    """Raise `LssRefused` if a configuration or store reply carries an error code."""
    code, specific = reply[1], reply[2]
    if code:
        meaning = _ERRORS.get((reply[0], code), "specific to the maker" if code == 0xFF else "reserved error code")
        raise LssRefused(what, code, specific if code == 0xFF else 0, meaning)
