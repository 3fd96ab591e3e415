"""Continue a sweep where asking address by address is too expensive: in silent areas, and with other read lengths.

Every request in a silent area costs a timeout, so only some addresses are tried, round numbers first, until the time budget
is used up. Registers that are refused one by one may hold values that can only be read whole, so reads of two and more
registers are tried there. The functions are generators without I/O, as those of `sweep`.
"""

from __future__ import annotations

from collections.abc import Iterator

from fieldtwin.commissioning.dump.coverage import INVALID, READABLE, REFUSED, coarse_to_fine
from fieldtwin.commissioning.dump.sweep import ROUND, Asking, Sweep

LEVELS = ((1000, 4096), (500, 1024), (100, 256), (ROUND, 64), (16,))
"""Steps at which manuals usually begin blocks, the likeliest first."""
SILENT_AGAIN = 3
"""Number of consecutive requests without a reply that end a readable block inside a silent area."""
LENGTHS = (1, 2, 4, 8, 16, 32)
"""Lengths in registers of the reads that look for values that can only be read whole."""


def beyond_silence(sweep: Sweep) -> Asking:
    """Sample the addresses of `sweep` for which the device has given no definite answer. Where it answers, continue the sweep
    from that address.
    """
    span, known = sweep.span, sweep.coverage
    sweep.most_silent = SILENT_AGAIN
    for at in coarse_to_fine(span.address, span.end, sweep.stride, LEVELS):
        if sweep.found.stopped:
            return
        if known.states[at] or known.is_sampled(at):
            continue
        grain = sweep.found.grain
        lengths = (1, 2) if sweep.in_words and grain == 1 and not sweep.singles else (grain,)
        for count in lengths:
            if at + count <= span.end and not known.is_definite(at):
                sweep.patient = False
                if not (yield from sweep.ask(at, count)) and (unit := (yield from sweep.ask_the_length_that_came(at))):
                    yield from _extend(sweep, at, unit)
        if known.is_definite(at):
            sweep.resume()
        if known.states[at] == READABLE:
            yield from sweep.walk((yield from sweep.back_from(at, _last_asked(sweep, at) + 1)))
        elif known.states[at] == REFUSED:
            yield from sweep.walk((yield from sweep.through_a_void(at + grain)))


def _last_asked(sweep: Sweep, at: int) -> int:
    """Return the nearest address below `at` that was requested, or the one before the span."""
    states = sweep.coverage.states
    return next((a for a in range(at - 1, sweep.span.address - 1, -1) if states[a]), sweep.span.address - 1)


def other_lengths(sweep: Sweep) -> Asking:
    """Read two and more registers where single ones were refused.

    `found.lengths` receives the lengths for which that was done everywhere.
    """
    if not sweep.in_words:
        if not sweep.found.stopped:
            sweep.found.lengths = [1]
        return
    sweep.charges_everything = True
    for length in LENGTHS:
        for at in _places(sweep, length):
            if sweep.found.stopped:
                return
            if (at, length) in sweep.asked or not _may_hide(sweep, at, length):
                continue
            if (yield from sweep.ask(at, length)):
                yield from _extend(sweep, at, length)
        sweep.found.lengths.append(length)


def _places(sweep: Sweep, length: int) -> Iterator[int]:
    """Yield the addresses at which a read of `length` may start a block. Pairs are tried in both alignments."""
    span = sweep.span
    states = sweep.coverage.states
    near = [a for a in range(span.address, span.end) if states[a] in (REFUSED, INVALID)]
    beside = {a for start, end in sweep.found.readable for a in (start - 1, end)} if length == 1 else set()
    near = [a for a in near if (a, 1) in sweep.asked or (a, 2) in sweep.asked or a in beside]
    if length > 4:
        near = [a for a in near if a % length == 0 or a % ROUND == 0]
    for at in near:
        yield at
        if length == 2 and at > span.address:
            yield at - 1


def _may_hide(sweep: Sweep, at: int, length: int) -> bool:
    """Return whether `length` registers from `at` could be one value: none of them was readable, and the device is not silent
    there.
    """
    if at + length > sweep.span.end:
        return False
    states = sweep.coverage.states
    return READABLE not in states[at : at + length] and (sweep.coverage.is_sampled(at) or states[at] == INVALID)


def _extend(sweep: Sweep, at: int, length: int) -> Asking:
    """After a successful read of `length` registers at `at`, where shorter reads failed, read the neighbours in steps of
    `length`.
    """
    low, high = at, at + length
    while high + length <= sweep.span.end and sweep.coverage.states[high] != READABLE:
        if not (yield from sweep.ask(high, length)):
            break
        high += length
    while low - length >= sweep.span.address and sweep.coverage.states[low - 1] != READABLE:
        if not (yield from sweep.ask(low - length, length)):
            break
        low -= length
    if length > 1:
        sweep.found.add_unit(low, high, length)
    if high - low > length and not (yield from sweep.ask(low, 2 * length)):
        sweep.found.borders += range(low + length, high, length)
