"""Serial settings and unit IDs in the order in which a scan tries them, and the time that this takes. The module does no I/O."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

from fieldtwin.commissioning.scan.sweep import expected_s
from fieldtwin.gateway.core.endpoint import Endpoint, SerialSettings

LIKELY = tuple(
    SerialSettings(baudrate, frame)
    for baudrate, frame in (
        (9600, "8N1"), (19200, "8E1"), (9600, "8E1"), (19200, "8N1"), (38400, "8N1"), (115200, "8N1"), (57600, "8N1"),
        (4800, "8N1"), (38400, "8E1"), (115200, "8E1"), (9600, "8O1"), (2400, "8N1"), (57600, "8E1"), (19200, "8O1"),
        (4800, "8E1"), (2400, "8E1"),
    )
)  # fmt: skip
"""Factory settings of devices, most frequent first. Two stop bits are not tried separately: a receiver checks only one."""

BAUDRATES = (9600, 19200, 38400, 115200, 57600, 4800, 2400, 1200)
FRAMES = ("8N1", "8E1", "8O1", "8N2")
ASCII_FRAMES = ("7E1", "8N1", "8E1", "7O1", "7N2", "7N1")

UNITS = (1, 2, 3, 4, 5, 10, 16, 247, 17, 6, 7, 8, 9, 11, 32, 20, 100, 126, 50, 12, 64, 128, 13, 14, 15, 200)
"""The usual unit IDs of new devices, most frequent first."""

SERIAL_UNITS = tuple(range(1, 248))
TCP_UNITS = (*range(1, 248), 0, 255)

OPENING_S = 0.02
"""Time in seconds to change the settings of a port."""


def stated_settings(endpoint: Endpoint) -> SerialSettings | None:
    """Return the settings that the endpoint states; None if it does not state baud rate and frame."""
    said = {name for name, _ in endpoint.params}
    return endpoint.serial if endpoint.is_serial and {"baudrate", "frame"} <= said else None


def with_settings(endpoint: Endpoint, settings: SerialSettings) -> Endpoint:
    """Return the same port with different settings."""
    kept = tuple((k, v) for k, v in endpoint.params if k not in ("baudrate", "frame"))
    return replace(endpoint, params=(("baudrate", str(settings.baudrate)), ("frame", settings.frame), *kept))


def name_of(settings: SerialSettings) -> str:
    """Return a text such as ``9600 8N1``."""
    return f"{settings.baudrate} {settings.frame}"


@dataclass(frozen=True, slots=True)
class ScanStep:
    """One part of a scan: the unit IDs that are tried with one setting of the serial line (None: not a serial line).

    `request_chars` is the length of a request in characters, from which `seconds` follows.
    """

    settings: SerialSettings | None
    units: tuple[int, ...]
    request_chars: int
    timeout_s: float
    interval_s: float

    @property
    def seconds(self) -> float:
        """Return the duration in seconds if no unit answers."""
        char_s = self.settings.char_time_s if self.settings else 0.0
        opening_s = OPENING_S if self.settings else 0.0
        return opening_s + expected_s(
            len(self.units),
            self.request_chars,
            char_time_s=char_s,
            timeout_s=self.timeout_s,
            interval_s=self.interval_s,
        )


def seconds_of(steps: Iterable[ScanStep]) -> float:
    """Return the total duration in seconds of all steps if no unit answers."""
    return sum(step.seconds for step in steps)


@dataclass(frozen=True, slots=True)
class Pace:
    """The timing of requests: the timeout `timeout_s`, and at least `interval_s` from one request to the next, in seconds."""

    timeout_s: float
    interval_s: float
    ascii: bool = False

    def step(self, settings: SerialSettings | None, units: Sequence[int]) -> ScanStep:
        return ScanStep(settings, tuple(units), 17 if self.ascii else 8, self.timeout_s, self.interval_s)


def quick_pass(
    pace: Pace, candidates: Sequence[SerialSettings], units: Sequence[int], budget_s: float = 30.0
) -> list[ScanStep]:
    """Return steps for likely units at likely settings, as many as `budget_s` seconds allow.

    The most likely units are tried at every setting first, then the next ones.
    """
    steps: list[ScanStep] = []
    left_s = budget_s
    for first, last in ((0, 5), (5, 10), (10, 18), (18, len(UNITS))):
        batch = [u for u in UNITS if u in units][first:last]
        for settings in candidates if batch else ():
            step = pace.step(settings, batch)
            if step.seconds > left_s:
                return steps
            left_s -= step.seconds
            steps.append(step)
    return steps


def full_pass(
    pace: Pace, candidates: Sequence[SerialSettings | None], units: Sequence[int], done: Iterable[ScanStep] = ()
) -> list[ScanStep]:
    """Return steps for every unit at every one of `candidates`, without the combinations in `done`."""
    asked: dict[SerialSettings | None, set[int]] = {}
    for step in done:
        asked.setdefault(step.settings, set()).update(step.units)
    steps = []
    for settings in candidates:
        left = [u for u in units if u not in asked.get(settings, set())]
        if left:
            steps.append(pace.step(settings, left))
    return steps


def all_settings(endpoint: Endpoint) -> list[SerialSettings]:
    """Return all combinations of baud rate, parity and stop bits that `endpoint` leaves open, likely ones first."""
    ascii_mode = endpoint.scheme == "ascii"
    frames = ASCII_FRAMES if ascii_mode else FRAMES
    every = [SerialSettings(baudrate, frame) for frame in frames for baudrate in BAUDRATES]
    return _open(endpoint, every if ascii_mode else [*LIKELY, *every])


def likely_settings(endpoint: Endpoint) -> list[SerialSettings]:
    """Return the settings that a quick pass tries. Values that `endpoint` states are kept."""
    if endpoint.scheme != "ascii":
        return _open(endpoint, LIKELY)
    return _open(endpoint, [SerialSettings(b, f) for f in ("7E1", "8N1") for b in (9600, 19200, 38400, 115200, 4800)])


def _open(endpoint: Endpoint, settings: Sequence[SerialSettings]) -> list[SerialSettings]:
    """Return `settings`, in which the values that the endpoint states replace the others; equal results occur once."""
    said = dict(endpoint.params)
    baudrate, frame = endpoint.serial.baudrate, endpoint.serial.frame
    return list(
        dict.fromkeys(
            SerialSettings(baudrate if "baudrate" in said else s.baudrate, frame if "frame" in said else s.frame)
            for s in settings
        )
    )
