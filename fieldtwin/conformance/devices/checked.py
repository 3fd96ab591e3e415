"""The result of a check of a device, for any protocol."""

from __future__ import annotations

from dataclasses import dataclass

from fieldtwin.conformance.devices.device_case import DeviceResult, Spoken


@dataclass(frozen=True, slots=True)
class Checked:
    """The result of a check.

    `identity` is the device's own identification, name to text; `before` are the frames before the first case, `took_s` is
    the duration of the whole check in seconds.
    """

    identity: dict[str, str]
    results: list[DeviceResult]
    before: tuple[Spoken, ...] = ()
    took_s: float = 0.0


def shown(raw: bytes) -> str:
    """Return the printable part of a device's text, at most 80 characters."""
    return "".join(chr(b) for b in raw if 32 <= b < 127).strip()[:80]
