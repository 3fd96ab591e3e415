"""The verdicts on test cases and scenarios, and the words for failures that do not deviate from a standard."""

from __future__ import annotations

from fieldtwin.conformance.core.case import Basis
from fieldtwin.explain.cases import WEIGHT
from fieldtwin.explain.explanation import Explanation
from fieldtwin.results.model import Verdict

_SOURCE = "docs/explanation/conformance.md"
_VERDICTS: dict[Verdict, tuple[str, str]] = {
    Verdict.PASSED: ("The device, client or system did what the test case or scenario requires.", "Nothing."),
    Verdict.FAILED: (
        "It did not do what the test case or scenario requires; the reason has the observation and its time.",
        "Run it alone with `--only ID`; the report of `--html` has every byte. An accepted failure belongs in a file for "
        "`--waivers`.",
    ),
    Verdict.ERROR: (
        "The test itself could not be run: a file is invalid, or an endpoint cannot be opened.",
        "Correct what the message names, and run it again.",
    ),
    Verdict.INCONCLUSIVE: (
        "The result proves neither a pass nor a failure: it cannot be decided from outside, the other side did not behave "
        "normally before, no observation was possible, or this computer was late. It does not count as passed.",
        "Read the reason next to it. Often an option is missing, such as `--timeout` or `--probe`; after a late computer run it "
        "again.",
    ),
    Verdict.SKIPPED: (
        "The test case or scenario does not apply: another kind of bus, no such request, an option or a permission that was "
        "not given; or its failure is waived.",
        "Read the reason next to it. `--allow write` and `--allow disrupt` permit more cases on a device.",
    ),
}
_BASES: dict[Basis, str] = {
    Basis.ROBUSTNESS: "The exit code counts it with `--fail-on robustness`.",
    Basis.FIELD: "The exit code counts it with `--fail-on field`.",
}

VERDICTS: tuple[Explanation, ...] = (
    *(Explanation(verdict.value, "verdict", verdict.name, *_VERDICTS[verdict], _SOURCE) for verdict in Verdict),
    *(
        Explanation(basis.value, "verdict", "a failed case", WEIGHT[basis], todo, _SOURCE)
        for basis, todo in _BASES.items()
    ),
)
