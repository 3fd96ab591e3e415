"""Which of many faults does it take to make a run fail: delta debugging (Zeller and Hildebrandt, 2002) over a schedule."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, TypeVar

T = TypeVar("T")
MOST_RUNS = 200


def smallest(items: Sequence[T], fails: Callable[[Sequence[T]], bool], most_runs: int = MOST_RUNS) -> list[T]:
    """A part of `items` that still `fails` and of which no single item can be left out; what was found by then after
    `most_runs` questions. `items` as a whole must fail."""
    left, parts, runs = list(items), 2, 0
    while len(left) > 1 and runs < most_runs:
        size = -(-len(left) // parts)
        pieces = [left[i : i + size] for i in range(0, len(left), size)]
        for n in range(len(pieces)):
            without = [item for m, piece in enumerate(pieces) if m != n for item in piece]
            if not without or runs >= most_runs:
                continue
            runs += 1
            if fails(without):
                left, parts = without, max(parts - 1, 2)
                break
        else:
            if size == 1:
                break
            parts = min(2 * parts, len(left))
    return left


def as_scenario(
    title: str,
    system: str,
    seed: int,
    duration_s: float,
    faults: Sequence[dict[str, Any]],
    why: Sequence[str],
    commands: Sequence[tuple[float, int]] = (),
) -> str:
    """The faults as a scenario file: put in, lived through, and judged as the run was. `commands`: when (s) the far end commanded
    which period."""
    lines = [
        "# Shrunk from a run that failed:",
        *(f"#   {line}" for line in why),
        f"scenario: {_quoted(title)}",
        f"system: {_quoted(system)}",
        f"seed: {seed}",
        "judge: run",
        "steps:",
    ]
    for fault in faults:
        inside = ", ".join(f"{key}: {_quoted(value)}" for key, value in fault.items())
        lines.append(f"  - fault: {{{inside}}}")
    now_s = 0.0
    for at_s, period_s in sorted(commands):
        lines += [f"  - pause: {at_s - now_s:g}s", f"  - send: {{period_s: {period_s}}}"]
        now_s = at_s
    lines.append(f"  - pause: {duration_s - now_s:g}s")
    return "\n".join(lines) + "\n"


def _quoted(value: object) -> str:
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, int | float):
        return repr(value)
    text = str(value)
    return '"' + text.replace("\\", "\\\\").replace('"', '\\"') + '"'
