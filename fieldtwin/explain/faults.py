"""The explanations of the faults that can be injected, made from the faults' classes."""

from __future__ import annotations

from fieldtwin.emulators.faults.fault import Fault
from fieldtwin.emulators.faults.registry import FAULTS
from fieldtwin.explain.explanation import Explanation


def _parameters(kind: type[Fault]) -> str:
    fields = kind.form.model_fields
    return " Parameters: " + ", ".join(f"`{name}` ({f.default})" for name, f in fields.items()) + "." if fields else ""


def _entry(kind: type[Fault]) -> Explanation:
    summary = kind.summary[:1].upper() + kind.summary[1:]
    return Explanation(
        kind.name, "fault", f"for {kind.kind.value}", f"{summary}.{_parameters(kind)}",
        f"Inject it with a step `- fault: {{name: {kind.name}, device: NAME, from: 5s, until: 12s}}` of a scenario, or with the "
        "same line in a file for `--faults`. A scenario fails if it never took effect.",
        "docs/how-to/faults.md", (f"fault {kind.name}",),
    )  # fmt: skip


EXPLAINED_FAULTS: tuple[Explanation, ...] = tuple(_entry(kind) for kind in FAULTS.values())
