"""Find the settings of a serial line by listening at one setting after another. Nothing is sent. The module does no I/O.

A line with traffic yields bytes at every setting, so listening at one setting is enough to detect a silent line. The setting
at which the bytes form whole frames is the correct one. The parity is known if the port counts parity errors; an additional
stop bit cannot be detected, because a receiver checks only one.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from fieldtwin.commissioning.scan.settings import name_of
from fieldtwin.commissioning.scan.traffic import Heard
from fieldtwin.gateway.connections.serial.line_counters import UartCounters
from fieldtwin.gateway.core.clock import NS_PER_S
from fieldtwin.gateway.core.endpoint import SerialSettings

SHORTEST_S, LONGEST_S = 1.5, 6.0
"""Shortest and longest time in seconds to listen at one setting. The time is longer if the line has long pauses between
frames.
"""

ENOUGH_BYTES = 400
"""Number of bytes without a good frame after which a setting is rejected."""


@dataclass(frozen=True, slots=True)
class Audition:
    """The result of listening at `settings`: the received bytes, and the errors that the port counted at the same time (None:
    it has no counters).
    """

    settings: SerialSettings
    heard: Heard
    errors: UartCounters | None = None


@dataclass(frozen=True, slots=True)
class LineVerdict:
    """The settings that the traffic on a line shows.

    `sure`: whether they are proved; `why` gives the reason as a sentence; `others` are settings that fit as well.
    """

    settings: SerialSettings
    framing: str
    sure: bool
    why: str
    others: tuple[SerialSettings, ...] = ()
    heard: Heard | None = None

    @property
    def fits(self) -> tuple[SerialSettings, ...]:
        """Return all settings with which the bytes form valid frames."""
        return (self.settings, *self.others)


def dwell_over(heard: Heard, elapsed_s: float) -> bool:
    """Return whether the line has been observed for long enough at the present setting."""
    if heard.sure or elapsed_s >= LONGEST_S:
        return True
    if heard.bytes >= ENOUGH_BYTES and not heard.good_bytes:
        return True
    wanted_s = max(SHORTEST_S, min(LONGEST_S, 2.5 * heard.longest_gap_ns / NS_PER_S))
    return elapsed_s >= wanted_s and not (heard.frames > 0 and not heard.sure)


def line_verdict(auditions: Iterable[Audition]) -> LineVerdict | None:
    """Return the setting that fits the received bytes best; None if the bytes form frames at no setting."""
    good = [a for a in auditions if a.heard.frames and a.heard.share > 0.2]
    if not good:
        return None
    good.sort(key=_rank)
    best = good[0]
    heard, errors = best.heard, best.errors
    evidence = f"{heard.frames} whole frames, {heard.share:.0%} of {heard.bytes} bytes"
    if not heard.sure:
        why = f"only {evidence}: listen longer"
        return LineVerdict(best.settings, heard.framing, False, why, (), heard)
    if errors is None:
        others = _same_bits(best.settings, [a.settings for a in good if a is not best and a.heard.sure])
        why = f"{evidence}; this port counts no parity errors, so the parity is not proved"
        return LineVerdict(best.settings, heard.framing, False, why, others, heard)
    if errors.parity + errors.frame:
        why = f"{evidence}, yet {errors.parity} parity and {errors.frame} framing errors: another parity, or a bad line"
        return LineVerdict(best.settings, heard.framing, False, why, (), heard)
    if best.settings.parity == "N":
        two = SerialSettings(best.settings.baudrate, best.settings.frame[:2] + "2")
        why = f"{evidence}, no framing error (a receiver cannot tell one stop bit from two)"
        return LineVerdict(best.settings, heard.framing, True, why, (two,), heard)
    return LineVerdict(best.settings, heard.framing, True, f"{evidence}, no parity error", (), heard)


def worth_hearing(first: SerialSettings, candidates: Sequence[SerialSettings]) -> list[SerialSettings]:
    """Return the settings at which to listen, each once: `first`, then the other likely ones."""
    return list(dict.fromkeys([first, *candidates]))


def siblings(settings: SerialSettings) -> list[SerialSettings]:
    """Return the settings with the same baud rate and the other parities, which may fit as well as `settings`."""
    bits = settings.frame[0]
    return [SerialSettings(settings.baudrate, bits + p + "1") for p in "NEO" if p != settings.parity]


def _rank(audition: Audition) -> tuple[int, int, float, int]:
    errors = audition.errors
    wrong = errors.parity + errors.frame if errors is not None else 0
    return (not audition.heard.sure, wrong > 0, -audition.heard.share, wrong)


def _same_bits(settings: SerialSettings, others: list[SerialSettings]) -> tuple[SerialSettings, ...]:
    found = [o for o in others if o.baudrate == settings.baudrate]
    two = SerialSettings(settings.baudrate, settings.frame[:2] + "2")
    return tuple(dict.fromkeys([*found, *([two] if settings.parity == "N" else [])]))


def describe(verdict: LineVerdict) -> str:
    """Return one line for the user: the settings that were found, others that fit as well, and the reason."""
    also = f" (or {', '.join(name_of(o) for o in verdict.others)})" if verdict.others else ""
    return f"{name_of(verdict.settings)}{also}: {verdict.why}"
