"""What a check of a device comes to, whatever it speaks."""

from __future__ import annotations

from dataclasses import dataclass

from fieldtwin.checking.device_case import DeviceResult, Spoken


@dataclass(frozen=True, slots=True)
class Checked:
    """What the device says of itself, name to text, the results, what was said before the first, and how long all took."""

    identity: dict[str, str]
    results: list[DeviceResult]
    before: tuple[Spoken, ...] = ()
    took_s: float = 0.0


def shown(raw: bytes) -> str:
    """A device's text as it can be shown, at most 80 characters; empty where nothing can."""
    return "".join(chr(b) for b in raw if 32 <= b < 127).strip()[:80]
