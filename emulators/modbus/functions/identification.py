"""Device identification, function 2Bh with MEI type 0Eh (AP 6.21): numbered texts, in several frames if necessary.

This module performs no I/O: it takes a request PDU and returns a response PDU.
"""

from __future__ import annotations

from collections.abc import Mapping

from fieldtwin.emulators.modbus.bank import IllegalFunction, IllegalValue, NoSuchAddress
from fieldtwin.gateway.core.errors import UsageError

MEI_TYPE = 0x0E
BASIC, REGULAR, EXTENDED, INDIVIDUAL = 1, 2, 3, 4
"""Read device id codes: three categories as a stream, and one individual object."""
_LAST_OF = {BASIC: 0x02, REGULAR: 0x7F, EXTENDED: 0xFF}
_INDIVIDUAL_ACCESS = 0x80
_HEAD = 7
MAX_OBJECT = 253 - _HEAD - 2
"""The number of bytes of the longest object that fits into one PDU."""


class Identification:
    """The objects of one device: number -> bytes. 0 vendor name, 1 product code and 2 revision are mandatory.

    3 to 6 (URL, product name, model name, application name) are regular objects; those from 80h on are vendor-specific.
    """

    def __init__(self, objects: Mapping[int, bytes]) -> None:
        for number in (0, 1, 2):
            if number not in objects:
                raise UsageError("device identification", expected="objects 0, 1 and 2", got=f"none numbered {number}")
        for number, value in objects.items():
            if not 0 <= number <= 0xFF or len(value) > MAX_OBJECT:
                raise UsageError(
                    f"identification object {number}",
                    expected=f"number 0 to 255, at most {MAX_OBJECT} bytes",
                    got=f"{len(value)} bytes",
                )
        self.objects = dict(sorted(objects.items()))
        highest = max(self.objects)
        self._level = next(code for code in (BASIC, REGULAR, EXTENDED) if highest <= _LAST_OF[code])

    def respond(self, pdu: bytes, now_ns: int) -> bytes:
        """Return the answer to a 2Bh request.

        A different MEI type is refused with 01, an invalid code or a wrong length with 03, and an individual object that does not
        exist with 02. If a stream is requested that starts at an unknown object, it starts at object 0 (AP 6.21).
        """
        if len(pdu) < 2 or pdu[1] != MEI_TYPE:
            raise IllegalFunction("MEI type", expected="0Eh", got=pdu[1:2].hex())
        if len(pdu) != 4 or not BASIC <= pdu[2] <= INDIVIDUAL:
            raise IllegalValue("read device id code", expected="1 to 4", got=pdu[2:].hex())
        code, first = pdu[2], pdu[3]
        if code == INDIVIDUAL:
            if first not in self.objects:
                raise NoSuchAddress(f"identification object {first}")
            return self._frame(code, [first], following=0)
        numbers = [n for n in self.objects if n <= _LAST_OF[code]]
        if first in numbers:
            numbers = numbers[numbers.index(first) :]
        fitting, room = 0, 253 - _HEAD
        for number in numbers:
            room -= 2 + len(self.objects[number])
            if room < 0:
                break
            fitting += 1
        following = numbers[fitting] if fitting < len(numbers) else 0
        return self._frame(code, numbers[:fitting], following)

    def _frame(self, code: int, numbers: list[int], following: int) -> bytes:
        """Return one frame.

        `following` is the first object of the next frame; 0 (which never follows) if this is the last.
        """
        more = 0xFF if following else 0x00
        head = bytes((0x2B, MEI_TYPE, code, self._level | _INDIVIDUAL_ACCESS, more, following, len(numbers)))
        return head + b"".join(bytes((n, len(self.objects[n]))) + self.objects[n] for n in numbers)
