"""The test cases of `fieldtwin check`, from their lists. A case that tests devices and clients has one entry for both."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from fieldtwin.book import case_page
from fieldtwin.conformance.clients.canopen.cases import CASES as CANOPEN_MASTERS
from fieldtwin.conformance.clients.modbus.cases import CASES as MODBUS_CLIENTS
from fieldtwin.conformance.core.case import About, Basis
from fieldtwin.conformance.devices.canopen.cases import CASES as CANOPEN_DEVICES
from fieldtwin.conformance.devices.modbus.cases import CASES as MODBUS_DEVICES
from fieldtwin.explain.explanation import Explanation

LISTS: tuple[tuple[str, str, Sequence[About]], ...] = (
    ("modbus", "a Modbus device", MODBUS_DEVICES),
    ("modbus-client", "a Modbus client", [case.about for case in MODBUS_CLIENTS]),
    ("canopen", "a CANopen node", CANOPEN_DEVICES),
    ("canopen-master", "a CANopen master", [case.about for case in CANOPEN_MASTERS]),
)
"""The lists of test cases: the command that runs them, the tested thing as text, and the cases."""
WEIGHT = {
    Basis.STANDARD: "The standard requires it: a failure is a deviation.",
    Basis.ROBUSTNESS: "No clause requires it: a failure means less tolerance than possible, not a deviation.",
    Basis.FIELD: "No clause requires it, but known products fail here, so a failure can cause trouble in the field.",
}


_NAMES = {
    "AP": "Modbus Application Protocol V1.1b3,",
    "SL": "Modbus over Serial Line V1.02,",
    "TG": "Modbus Messaging on TCP/IP V1.0b,",
    "CN": "CANopenNode",
    "py": "canopen (Python)",
}


def spelled_out(sources: str) -> str:
    """Return the sources of a case with the names of standards: ``SL 2.4.1`` -> ``Modbus over Serial Line V1.02, 2.4.1``."""
    parts = []
    for part in sources.split("; "):
        label, colon, rest = part.partition(": ")
        head, tail = (label + colon, rest) if colon and not rest.startswith("#") else ("", part)
        first, _, clause = tail.partition(" ")
        named = f"{_NAMES[first]} {clause}" if first in _NAMES else f"CiA 301, {tail}" if tail[:1].isdigit() else tail
        parts.append(head + named)
    return "; ".join(dict.fromkeys(parts))


def _weight(case: About) -> str:
    """Return the weight of a failure as text, with the transports on which the weight is different."""
    others = [f"On {other.wire}: {WEIGHT[other.basis]}" for other in case.elsewhere if other.basis is not case.basis]
    return " ".join([WEIGHT[case.basis], *others])


def _entries() -> Iterable[Explanation]:
    found: dict[str, list[tuple[str, str, About]]] = {}
    for command, tested, cases in LISTS:
        for case in cases:
            found.setdefault(case.id, []).append((command, tested, case))
    for id, of in sorted(found.items()):
        meaning = []
        for _, tested, case in of:
            sent = (
                f"fieldtwin {case.does or 'only listens'}" if case.role == "client" else f"fieldtwin sends: {case.does}"
            )
            meaning.append(f"Test of {tested}: {sent}. Expected: {case.must or 'go on'}. {_weight(case)}")
        run = " or ".join(f"`fieldtwin check {command} ... --only {id}`" for command, _, _ in of)
        sources = spelled_out("; ".join(case.sources for _, _, case in of if case.sources))
        row = of[0][2].row
        yield Explanation(
            id, "test case", of[0][2].title, " ".join(meaning),
            f"Repeat it alone with {run}; the report and `--json` have its frames. It has the impact level "
            f"`{of[0][2].impact.value}`.",
            sources, (row,) if row != id else (), case_page(id),
        )  # fmt: skip


CASES: tuple[Explanation, ...] = tuple(_entries())
