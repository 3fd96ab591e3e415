"""An LSS slave (CiA 305) in memory, for the tests of the master and of the boot of a CAN bus."""

from __future__ import annotations


class Slave:
    """One LSS slave (CiA 305), for these tests. `delay_s` is its response time."""

    def __init__(self, address: tuple[int, int, int, int], *, node: int = 0xFF, delay_s: float = 0.001) -> None:
        self.address, self.node, self.delay_s = address, node, delay_s
        self.pending = node
        self.stored: int | None = None
        self.configuring = False
        self.part = 0
        self.selected = 0

    def take(self, request: bytes) -> bytes | None:
        command, number = request[0], int.from_bytes(request[1:5], "little")
        if command == 0x04:
            self.configuring = bool(request[1])
            if not self.configuring:
                self.node = self.pending
            return None
        if command == 0x51:
            return self.scan(number, *request[5:8]) if self.node == 0xFF and not self.configuring else None
        if command == 0x4C:
            return b"\x50" if self.node == 0xFF else None
        if 0x40 <= command <= 0x43:
            return self.select(command - 0x40, number)
        return self.configure(command, request) if self.configuring else None

    def scan(self, number: int, bit: int, part: int, following: int) -> bytes | None:
        if bit == 0x80:
            self.part = 0
            return b"\x4f"
        if part != self.part or number >> bit != self.address[part] >> bit:
            return None
        if bit == 0:
            self.configuring = following < part
        self.part = following
        return b"\x4f"

    def select(self, part: int, number: int) -> bytes | None:
        self.selected = self.selected + 1 if number == self.address[part] and self.selected == part else 0
        if self.selected < 4:
            return None
        self.selected, self.configuring = 0, True
        return b"\x44"

    def configure(self, command: int, request: bytes) -> bytes | None:
        if command == 0x11:
            self.pending = request[1]
            return bytes([0x11, 0])
        if command == 0x13:
            return bytes([0x13, 0 if request[2] in (0, 2, 3, 4) else 1])
        if command == 0x17:
            self.stored = self.pending
            return bytes([0x17, 0])
        if 0x5A <= command <= 0x5D:
            return bytes([command]) + self.address[command - 0x5A].to_bytes(4, "little")
        return bytes([0x5E, self.node]) if command == 0x5E else None
