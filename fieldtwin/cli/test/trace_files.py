"""The files for the traces of `fieldtwin test`: one for a single scenario, or one for each scenario in a folder."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from fieldtwin.gateway.core.errors import FileInvalid, UsageError
from fieldtwin.scenarios.language.file_name import case_of


def trace_files(scenarios: Sequence[Path], trace: str | None, folder: Path | None) -> list[Path | None]:
    """Return the trace of each scenario, None for no trace. A name that occurs again gets a number.

    Makes the folder. Raises `UsageError` if both are given, and `FileInvalid` if the folder cannot be made.
    """
    if folder is None:
        return [Path(trace) if trace else None for _ in scenarios]
    if trace:
        raise UsageError("--trace and --traces exclude each other", expected="one of them")
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as e:
        raise FileInvalid(f"cannot make the folder of the traces: {e.strerror or e}", path=str(folder)) from e
    count: dict[str, int] = {}
    found: list[Path | None] = []
    for scenario in scenarios:
        name = case_of(scenario)
        count[name] = count.get(name, 0) + 1
        found.append(folder / (f"{name}-{count[name]}.jsonl" if count[name] > 1 else f"{name}.jsonl"))
    return found
