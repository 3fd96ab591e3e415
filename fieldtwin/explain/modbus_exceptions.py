"""The exception codes of Modbus (Application Protocol V1.1b3, clause 7)."""

from __future__ import annotations

from fieldtwin.explain.explanation import Explanation

_SOURCE = "Modbus Application Protocol V1.1b3, clause 7"
_TEXTS: dict[int, tuple[str, str, str]] = {
    0x01: (
        "illegal function",
        "The device knows the request's function code, or not even that, but does not serve it, or does not serve it in "
        "its present state. A device that has only input registers refuses function 03 this way.",
        "Compare the function with the manual. In a profile, the tag's table decides it: `holding` is read with 03, `input` "
        "with 04. List the functions of the device under `limits: {functions: [...]}`.",
    ),
    0x02: (
        "illegal data address",
        "At least one of the requested registers or bits does not exist. Addresses in requests count from 0, those in most "
        "manuals from 1, so an address that is off by one also leads here. A range that is valid at both ends can have a "
        "gap in the middle.",
        "Read one register at a time around the address: `fieldtwin dump` finds the valid ranges. If the device refuses "
        "only longer requests, set `limits: {read_registers: N}`, or split the range at the gap.",
    ),
    0x03: (
        "illegal data value",
        "The structure of the request is wrong for the device: a quantity of 0 or more than it allows, a byte count that "
        "does not fit, or a coil value other than 0000h and FF00h. The standard does not mean a register value that is out "
        "of range, but many devices use it for that as well.",
        "Reduce the number of registers (`limits: {read_registers: N}`). On a write, check the range of the value in the manual.",
    ),
    0x04: (
        "server device failure",
        "The device failed in a way that it cannot correct while it carried out the request. Some devices also send it for "
        "values that are out of range, or while they start.",
        "Read the device's own diagnostics. Repeat the request later; if it always fails, compare it with the manual.",
    ),
    0x05: (
        "acknowledge",
        "The device has accepted the request and needs a long time for it. This is a reply to programming commands. The "
        "client shall ask later whether the work is done.",
        "Do not repeat the request at once. Ask for the result with the function that the manual names.",
    ),
    0x06: (
        "server device busy",
        "The device works on a long command and cannot take the request now.",
        "Repeat the request later. fieldtwin does so as often as `retries` of the bus says; a longer `spacing_ms` between "
        "requests helps devices that are often busy.",
    ),
    0x08: (
        "memory parity error",
        "The device found damage in its extended memory while it read or wrote a file record (functions 14h and 15h).",
        "Repeat the request. If it persists, the device's memory is faulty.",
    ),
    0x0A: (
        "gateway path unavailable",
        "A gateway has no path from its input port to the line of this unit ID. Usually the gateway is configured wrongly "
        "or overloaded.",
        "Check which unit IDs the gateway routes to which port. With `fieldtwin bridge`, check its `allow` rules.",
    ),
    0x0B: (
        "gateway target device failed to respond",
        "A gateway forwarded the request, but the device behind it did not answer. Usually the device is off, has another "
        "unit ID, or the wiring, baud rate or parity on its line is wrong.",
        "Check unit ID and wiring. `fieldtwin scan` on the gateway's address shows which unit IDs answer. The gateway's "
        "own timeout must be shorter than the client's.",
    ),
}

EXCEPTIONS: tuple[Explanation, ...] = tuple(
    Explanation(
        f"exception {code:02X}",
        "Modbus exception",
        title,
        meaning,
        todo,
        _SOURCE,
        (
            f"exception {code}",
            f"exception {code:02X}h",
            f"exception 0x{code:02X}",
            f"{code:02X}",
            f"{code:02X}h",
            title,
        ),
    )
    for code, (title, meaning, todo) in _TEXTS.items()
)
