"""FIFO queues of registers, function 18h (AP 6.18).

A queue is identified by its pointer address. A read does not empty the queue; only the device takes values out. This module
performs no I/O.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable

from fieldtwin.emulators.modbus.bank import IllegalValue, NoSuchAddress
from fieldtwin.gateway.core.errors import UsageError

MOST_READ = 31
"""The number of registers that fit one answer. A longer queue is refused with 03 until the device takes registers out."""


class FifoQueues:
    """The queues of a unit by pointer address (0 to 65535), each of at most `capacity` registers, empty at first.

    `dropped` counts the registers that did not fit.
    """

    def __init__(self, addresses: Iterable[int], capacity: int = MOST_READ) -> None:
        self.capacity = capacity
        self.dropped = 0
        self._queues: dict[int, deque[int]] = {}
        for address in addresses:
            if not 0 <= address <= 0xFFFF:
                raise UsageError("pointer address of a queue", expected="0 to 65535", got=str(address))
            self._queues[address] = deque()

    def push(self, address: int, *values: int) -> None:
        """Append registers (0 to 65535). Raises `NoSuchAddress` if there is no queue, or `IllegalValue`."""
        queue = self._queue(address)
        for value in values:
            if not 0 <= value <= 0xFFFF:
                raise IllegalValue("register", expected="0 to 65535", got=str(value))
            if len(queue) >= self.capacity:
                self.dropped += 1
            else:
                queue.append(value)

    def take(self, address: int, count: int = 1) -> list[int]:
        """Remove up to `count` registers from the head, as the device does, and return them. Raises `NoSuchAddress`."""
        queue = self._queue(address)
        return [queue.popleft() for _ in range(min(count, len(queue)))]

    def respond(self, pdu: bytes, now_ns: int) -> bytes:
        """Return the answer to an 18h request. Raises `Refusal`."""
        if len(pdu) != 3:
            raise IllegalValue("length of the request", expected="3 bytes", got=str(len(pdu)))
        queue = self._queue(pdu[1] << 8 | pdu[2])
        if len(queue) > MOST_READ:
            raise IllegalValue("registers in the queue", expected=f"at most {MOST_READ}", got=str(len(queue)))
        data = len(queue).to_bytes(2, "big") + b"".join(value.to_bytes(2, "big") for value in queue)
        return pdu[:1] + len(data).to_bytes(2, "big") + data

    def _queue(self, address: int) -> deque[int]:
        if address not in self._queues:
            raise NoSuchAddress(f"no queue at {address}")
        return self._queues[address]
