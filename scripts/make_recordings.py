#!/usr/bin/env python3
"""Generate the recordings that ship with fieldtwin: no measurements, our own models with a seed. Overwrites the files.

    scripts/make_recordings.py [--seed N] [--out DIR]

The same seed gives the same bytes; a test compares them with the committed files.
"""

from __future__ import annotations

import argparse
import random
import sys
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
if str(ROOT) not in sys.path:  # run as a file, the checkout's packages are not on the path
    sys.path.insert(0, str(ROOT))

from fieldtwin.emulators.models.synthetic import cast, tilt  # noqa: E402
from fieldtwin.gateway.core.files.recording import RecordingHeader, RecordingWriter, SignalInfo  # noqa: E402

DEFAULT_SEED = 1
Rows = Iterable[tuple[float, Sequence[float]]]


def main(argv: Sequence[str] | None = None) -> int:
    """Write both recordings; return the exit code."""
    parser = argparse.ArgumentParser(description="make the recordings that ship with fieldtwin")
    parser.add_argument("--seed", type=int, default=DEFAULT_SEED)
    parser.add_argument("--out", type=Path, default=ROOT / "recordings")
    options = parser.parse_args(argv)
    make(options.out, options.seed)
    return 0


def make(out: Path, seed: int) -> None:
    """Write cast.jsonl and incl.jsonl into `out`. Each has a separate generator, so a change of one model does not affect the
    other."""
    out.mkdir(parents=True, exist_ok=True)
    _write(
        out / "cast.jsonl",
        "fieldtwin/ctd-reference",
        seed,
        cast.SIGNALS,
        cast.cast_rows(cast.Cast(), random.Random(f"cast {seed}")),
    )
    _write(
        out / "incl.jsonl",
        "fieldtwin/inclinometer-cia410",
        seed,
        tilt.SIGNALS,
        tilt.tilt_rows(tilt.Tilt(), random.Random(f"tilt {seed}")),
    )


def _write(path: Path, device: str, seed: int, units: Mapping[str, str], rows: Rows) -> None:
    path.unlink(missing_ok=True)
    header = RecordingHeader(
        version=1,
        device=device,
        kind="signals",
        source="synthetic",
        made_by=f"scripts/make_recordings.py --seed {seed}",
        signals={name: SignalInfo(unit=unit) for name, unit in units.items()},
    )
    with RecordingWriter(path, header) as writer:
        for t_s, values in rows:
            writer.row(t_s, values)
    print(f"{path.name}: {writer.records} rows", file=sys.stderr)


if __name__ == "__main__":
    sys.exit(main())
