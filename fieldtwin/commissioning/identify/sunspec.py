"""The SunSpec header and its chain of models (SunSpec Device Information Model, 6.1 to 6.3). The module does no I/O.

A map begins with the characters ``SunS`` at the address 40000, 50000 or 0 as sent. The models follow one after the other,
each with its number and its length in registers, up to number FFFFh. Model 1 states the manufacturer.
"""

from __future__ import annotations

BASES = (40000, 50000, 0)
HEADER = b"SunS"
END = 0xFFFF
MOST_MODELS = 64
COMMON, COMMON_REGISTERS = 1, 66
_FIELDS = {"manufacturer": (2, 16), "model": (18, 16), "version": (42, 8), "serial": (50, 16)}
"""Fields of model 1: offset from its number, and length in registers."""


def text_of(data: bytes) -> str:
    """Return the characters of registers up to the first NUL."""
    return data.split(b"\0")[0].decode("ascii", "replace").strip()


def common(data: bytes) -> dict[str, str]:
    """Return the names in model 1 (manufacturer, model, ...). `data` are its registers from its number on; the last ones may
    be missing.
    """
    return {name: text_of(data[2 * at : 2 * (at + size)]) for name, (at, size) in _FIELDS.items()}


def next_model(data: bytes, address: int) -> tuple[int, int, int] | None:
    """Return number, address and length of the model that begins with `data`, read at `address`. None if it is the end model
    or not a valid model.
    """
    number, size = int.from_bytes(data[:2], "big"), int.from_bytes(data[2:4], "big")
    if number in (0, END) or address + 2 + size > 0x10000:
        return None
    return number, address, size
