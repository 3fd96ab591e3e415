"""The result of `fieldtwin compare` as text on stdout."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from rich.table import Table

from fieldtwin.capture.recordings.comparing import Comparison, LatencyRow
from fieldtwin.capture.recordings.rotating_file import parts_of
from fieldtwin.console import stderr, stdout
from fieldtwin.gateway.core.files.recording import shown

SHOWN = 20


def print_comparison(result: Comparison, recording: Path, other: str, everything: bool) -> None:
    """Print the differences, the latencies and the fidelity; without `everything` only the first `SHOWN` differences."""
    name = recording.name if recording.suffix == ".log" else shown(parts_of(recording)[0])
    stdout.print(f"{other} against {name}", soft_wrap=True, markup=False)
    if result.differences:
        table = Table("at s", "unit", "what", "asked", "where", "recorded", "there", box=None, pad_edge=False)
        for d in result.differences if everything else result.differences[:SHOWN]:
            table.add_row(f"{d.t_s:.3f}", str(d.unit), d.what, d.request, d.where, d.recorded, d.other)
        stdout.print(table)
        left = sum(result.by_kind.values()) - min(len(result.differences), SHOWN)
        if left > 0 and not everything:
            stderr.print("  and more: --all", soft_wrap=True)
    if result.latency:
        table = Table(
            "latency, ms", "n", "recorded p50", "p90", "p99", "there p50", "p90", "p99", box=None, pad_edge=False
        )
        for row in result.latency:
            times = [f"{1000 * t:.1f}" for t in (*row.recorded_s, *row.other_s)]
            table.add_row(row.service, str(row.count), *times, "" if row.alike else "beyond tolerance")
        stdout.print(table)
        _advise_latency(result.latency)
    kinds = ", ".join(f"{n} {kind}" for kind, n in sorted(result.by_kind.items()))
    stdout.print(
        f"{result.compared} compared, {result.alike} alike" + (f"; otherwise: {kinds}" if kinds else ""), soft_wrap=True
    )
    if result.extra:
        stdout.print(f"{result.extra} more in the other one, which the recording does not contain", soft_wrap=True)
    if result.left_out:
        stdout.print(f"{result.left_out} left out: they may change the device, or cannot be sent", soft_wrap=True)
    if result.left_out_writes and result.by_kind:
        stdout.print(
            f"{result.after_left_out} of the differences are in what {result.left_out_writes} left-out writes had set; "
            "others may follow from these writes: --writes makes them again", soft_wrap=True,
        )  # fmt: skip
    _show_shifts(result)
    timing = "not known" if result.timing is None else f"{100 * result.timing:.1f} %"
    verdict = "met" if result.met else "INCONCLUSIVE" if result.inconclusive else "NOT met"
    alike = f"{100 * result.values:.1f} %" if result.compared else "not known"
    stdout.print(f"fidelity: values {alike}, timing {timing}: {verdict}", soft_wrap=True)


def advise_profile(result: Comparison, device: str) -> None:
    """Name --profile if registers differ that were compared one by one, although the recording names its device."""
    if device and result.by_kind.get("value"):
        stderr.print(
            f"registers were compared one by one, so that a tolerance has no meaning for halves of longer numbers; "
            f"--profile with the profile of {device} compares its values",
            soft_wrap=True, markup=False,
        )  # fmt: skip


def _advise_latency(rows: Sequence[LatencyRow]) -> None:
    """Explain latencies of zero, which no device on a serial line has."""
    if any(not row.alike for row in rows) and not any(max(row.recorded_s) for row in rows):
        stderr.print(
            "the recorded replies came sooner than the baud rate permits, as on a pseudo-terminal: such latencies cannot be "
            "compared with those of a line (--latency any)",
            soft_wrap=True,
        )


def _show_shifts(result: Comparison) -> None:
    """Print the registers that were read before the comparison, so that their recorded values are compared from a later
    position on, and the number of exchanges for which the recording therefore has no values.
    """
    for shift in result.shifts[:SHOWN]:
        stdout.print(
            f"unit {shift.unit}, {shift.where}: was read before, continues at value {shift.at + 1} of {shift.recorded} recorded",
            soft_wrap=True, markup=False,
        )  # fmt: skip
    if len(result.shifts) > SHOWN:
        stdout.print(f"and {len(result.shifts) - SHOWN} more registers or bits", soft_wrap=True)
    if result.not_compared:
        stdout.print(
            f"{result.not_compared} not compared: the recording has no values after that position. "
            "Restart the emulator to compare everything", soft_wrap=True,
        )  # fmt: skip
