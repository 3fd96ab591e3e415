"""A STATUS of the observatory: both the state and the period (paper.md, ruling 7), in three bytes.

They are encoded separately, so that a state that does not follow from its period can be detected.
"""

from __future__ import annotations

import struct

from fieldtwin.gateway.core.errors import Desync
from fieldtwin.gateway.core.statemachine import PERIOD_MAX, PERIOD_MIN, STATE_CODES
from fieldtwin.gateway.core.values import STATUS

_STATUS = struct.Struct(">Bh")
_NAMES = {code: name for name, code in STATE_CODES.items()}


def encode_status(state: str, period_s: int) -> STATUS:
    """Encode the state's code, then the period in seconds (signed, 16 bits). Raises `Desync` if either is out of range."""
    if state not in STATE_CODES or not PERIOD_MIN <= period_s <= PERIOD_MAX:
        raise Desync("a status", expected=f"one of {', '.join(STATE_CODES)} and a period", got=f"{state} {period_s}")
    return STATUS(_STATUS.pack(STATE_CODES[state], period_s))


def decode_status(data: bytes) -> tuple[str, int]:
    """Return state and period. Raises `Desync` if `data` is not a status."""
    if len(data) != _STATUS.size or data[0] not in _NAMES:
        raise Desync("a status", expected="a state's code and a period, 3 bytes", got=data.hex())
    code, period_s = _STATUS.unpack(data)
    return _NAMES[code], period_s
