"""Find the faults that make a run fail: delta debugging (Zeller and Hildebrandt, 2002) over a schedule."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, TypeVar

T = TypeVar("T")
RESULT = TypeVar("RESULT")
MOST_RUNS = 60
"""Largest number of runs that reduce the schedule of one run."""
BROKEN_AT = ": broken at "
"""The separator in an error message between a rule's text and the values known when it was broken."""
_PLAIN = re.compile(r"[A-Za-z_]\w*")
_NUMBER = re.compile(r"\d+(?:\.\d+)?(?:e[-+]?\d+)?")


class FurtherRuns:
    """The number of runs that a campaign may still add to its own, to find the causes of its failures."""

    def __init__(self, seeds: int) -> None:
        """Allow as many runs as the campaign has seeds, and at least `MOST_RUNS`, so that the end of a large campaign takes at
        most as long as the campaign.
        """
        self.most = self.left = max(MOST_RUNS, seeds)

    def used(self, count: int) -> None:
        self.left = max(0, self.left - count)


def smallest(
    items: Sequence[T],
    fails: Callable[[Sequence[T]], bool],
    most_runs: int = MOST_RUNS,
    first_of: Callable[[Sequence[Sequence[T]]], int | None] | None = None,
) -> tuple[list[T], bool]:
    """Return a part of `items` that still `fails`, and whether all its items are necessary.

    The first test uses no item, so that a failure which occurs without any item is not attributed to one. After `most_runs`
    tests the smallest part found so far is returned. `items` as a whole must fail. `first_of` returns the index of the first of
    several parts that fails, or None; it may test them at the same time, and tests after that one are not counted.
    """
    first = first_of or (lambda parts: next((n for n, part in enumerate(parts) if fails(part)), None))
    left, parts, runs = list(items), 2, 0
    if left and most_runs > 0:
        runs += 1
        if first([()]) is not None:
            return [], True
    while len(left) > 1:
        size = -(-len(left) // parts)
        cuts = range(0, len(left), size)
        without = [left[:i] + left[i + size :] for i in cuts[: most_runs - runs]]
        found = first(without)
        runs += len(without) if found is None else found + 1
        if found is not None:
            left, parts = without[found], max(parts - 1, 2)
        elif len(without) < len(cuts):
            return left, False
        elif size == 1:
            break
        else:
            parts = min(2 * parts, len(left))
    return left, not left or runs > 0


def shrunk_run(
    items: Sequence[T],
    results_of: Callable[[Sequence[Sequence[T]]], Sequence[RESULT]],
    fails: Callable[[RESULT], bool],
    further: FurtherRuns,
    parallel: Callable[[], int] = lambda: 1,
) -> tuple[list[T], bool, RESULT, RESULT]:
    """Return the `smallest` part of `items` whose run still `fails`, whether all its items are necessary, and two results.

    They are the results of the run with that part and of the run without any item. `results_of` returns the results of several
    parts; each part is run once. `parallel` returns how many parts are run at a time, before each step; the result is the same
    with any number. `further` limits the number of tests if it has fewer runs left than `MOST_RUNS`.
    """
    seen: dict[str, RESULT] = {}

    def ended(parts: Sequence[Sequence[T]]) -> list[RESULT]:
        keys = [repr(list(part)) for part in parts]
        new = {key: part for key, part in zip(keys, parts, strict=True) if key not in seen}
        if new:
            seen.update(zip(new, results_of(list(new.values())), strict=True))
        return [seen[key] for key in keys]

    def first_of(parts: Sequence[Sequence[T]]) -> int | None:
        begin = 0
        while begin < len(parts):
            some = parts[begin : begin + parallel()]
            for n, result in enumerate(ended(some), begin):
                if fails(result):
                    return n
            begin += len(some)
        return None

    tests = 0

    def counted(parts: Sequence[Sequence[T]]) -> int | None:
        nonlocal tests
        found = first_of(parts)
        tests += len(parts) if found is None else found + 1
        return found

    most = min(MOST_RUNS, further.left)
    left, minimal = smallest(items, lambda part: counted([part]) is not None, most, counted)
    result, without = ended([left, ()])
    further.used(tests)
    return left, minimal, result, without


def kind_of(error: str) -> str:
    """Return an error without its numbers, so that the same failure at a different time or value has the same kind.

    A broken rule is the same for all values of its tags.
    """
    return _NUMBER.sub("#", error.partition(BROKEN_AT)[0])


def same_failure(found: Iterable[str], again: Iterable[str]) -> bool:
    """Return whether an error in `again` is of the same kind as an error in `found`."""
    return not {kind_of(error) for error in found}.isdisjoint(kind_of(error) for error in again)


def as_scenario(
    title: str,
    system: str,
    seed: int,
    duration_s: float,
    faults: Sequence[Mapping[str, Any]],
    why: Sequence[str],
    acts: Sequence[tuple[float, Mapping[str, Any]]] = (),
    keys: Mapping[str, Any] | None = None,
) -> str:
    """Return a scenario file that injects the faults, lets `duration_s` pass, and is checked by `keys`, by default as a run.

    `acts`: further steps, each with its time (s since the start). `why`: the errors of the run, for a comment.
    """
    lines = [
        "# Shrunk from a run that failed:",
        *(f"#   {line}" for text in why for line in text.splitlines()),
        f"scenario: {flow(title)}",
        f"system: {flow(system)}",
        f"seed: {seed}",
        *(f"{key}: {flow(value)}" for key, value in ({"judge": "run"} if keys is None else keys).items()),
        "steps:",
        *(f"  - fault: {flow(dict(fault))}" for fault in faults),
    ]
    now_s = 0.0
    for at_s, step in sorted(acts, key=lambda act: act[0]):
        if at_s > now_s:
            lines.append(f"  - pause: {_seconds(at_s - now_s)}")
        lines += [f"  - {key}: {flow(value)}" for key, value in step.items()]
        now_s = max(now_s, at_s)
    if duration_s > now_s:
        lines.append(f"  - pause: {_seconds(duration_s - now_s)}")
    return "\n".join(lines) + "\n"


def _seconds(time_s: float) -> str:
    return f"{round(time_s, 6):.12g}s"


def flow(value: Any) -> str:
    """Return plain data as YAML in one line. Texts are always quoted, and a float has a decimal point, as the reader of these
    files requires.
    """
    if isinstance(value, Mapping):
        return "{" + ", ".join(f"{_key(key)}: {flow(one)}" for key, one in value.items()) + "}"
    if isinstance(value, list | tuple):
        return "[" + ", ".join(map(flow, value)) + "]"
    if isinstance(value, float):
        said = repr(value)
        return said.replace("e", ".0e") if "e" in said and "." not in said else said
    return json.dumps(value, ensure_ascii=False)


def _key(key: Any) -> str:
    return key if isinstance(key, str) and _PLAIN.fullmatch(key) else json.dumps(key, ensure_ascii=False)
