"""The dialects of Structured Text, and the warnings about constructs that only a dialect accepts.

The standard's rules apply to all dialects. Each construct that a dialect accepts beyond them has the id of a warning. The
warnings show each place where a program relies on its dialect, and a user can turn them into errors.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass, field, replace

from fieldtwin.gateway.core.errors import FileInvalid, UsageError
from fieldtwin.gateway.core.files.nearest import did_you_mean

MAX_WARNINGS = 1_000
"""The largest number of warnings with one id that are kept for a unit."""

WARNINGS = {
    "ST001": "assignment to an input",
    "ST002": "implicit conversion that can change the value",
    "ST003": "bit string used as a number, or number used as a bit string",
    "ST004": "shift or rotation of an integer",
    "ST005": "logical operation on integers",
    "ST006": "enumeration used as a number, or number used as an enumeration",
    "ST007": "skipped pragma",
    "ST008": "operands of signed and unsigned types",
    "ST009": "FB_exit or FB_reinit, which is not called by itself",
    "ST010": "shift of a constant without a type",
    "ST011": "control variable of FOR altered in its loop",
}
"""The id and title of each warning about a construct of a dialect."""
FINDINGS = {
    "ST100": "waiver without an effect",
    "ST101": "unused variable",
    "ST102": "REAL numbers compared with = or <>",
    "ST103": "CASE over an enumeration without ELSE",
    "ST104": "output that is never written",
    "ST105": "timer, edge or counter that is not called in every scan",
    "ST106": "division without a test for 0",
    "ST107": "statement that is never executed",
    "ST108": "global variable that programs of several tasks write",
    "ST109": "addresses that overlap in other systems",
    "ST110": "input or output of a PROGRAM that cannot be a tag",
    "ST111": "tag and variable with different ranges",
    "ST112": "tag bound to an input that is not used",
    "ST113": "time bound to a tag in a different unit",
    "ST114": "writable tag that nothing writes",
    "ST115": "STRING at an address, which cannot be a tag",
    "ST116": "no machine code",
}
"""The id and title of each finding of `fieldtwin plc check` (`fieldtwin.plc.st.findings`), in every dialect."""


@dataclass(frozen=True, slots=True)
class StWarning:
    """A warning about a place in a source file. `line` and `column` count from 1."""

    id: str
    message: str
    path: str
    line: int
    column: int

    def __str__(self) -> str:
        return f"{self.path}:{self.line}:{self.column}: {self.id} {self.message}"

    def as_data(self) -> dict[str, str | int]:
        """Return the warning as data for JSON."""
        return {
            "id": self.id,
            "path": self.path,
            "line": self.line,
            "column": self.column,
            "message": self.message,
        }

    def as_error(self) -> FileInvalid:
        """Return the warning as an error, for users who refuse the construct."""
        return FileInvalid(f"{self.id} {self.message}", path=self.path, line=self.line, column=self.column)


@dataclass(frozen=True, slots=True)
class Dialect:
    """A dialect. `accepts`: the ids of the warnings that replace errors of the standard.

    `vendor` is true for CODESYS and the systems built on it: values of enumerations and global lists are qualified by a
    dot, operands are converted implicitly, and dates convert to numbers of seconds.
    """

    name: str
    accepts: frozenset[str] = frozenset()
    vendor: bool = False


STANDARD = Dialect("standard")
DIALECTS = {
    dialect.name: dialect
    for dialect in (
        STANDARD,
        Dialect("codesys", frozenset(WARNINGS), vendor=True),
        Dialect("twincat", frozenset(WARNINGS), vendor=True),
        Dialect("matiec", frozenset({"ST001", "ST004", "ST007"})),
    )
}


def dialect_of(name: str) -> Dialect:
    """Return the dialect called `name`. Raises `UsageError`."""
    if name not in DIALECTS:
        raise UsageError(
            "an unknown dialect", expected=", ".join(DIALECTS), got=name, hint=did_you_mean(name, list(DIALECTS))
        )
    return DIALECTS[name]


def chosen_ids(names: Iterable[str]) -> frozenset[str]:
    """Return the ids of the warnings that `names` select: ids in any case, or ``all``. Raises `UsageError`."""
    found: set[str] = set()
    for name in names:
        if name.lower() == "all":
            found |= {*WARNINGS, *FINDINGS}
        elif name.upper() in (*WARNINGS, *FINDINGS):
            found.add(name.upper())
        else:
            raise UsageError("an unknown warning", expected=f"all, {', '.join((*WARNINGS, *FINDINGS))}", got=name)
    return frozenset(found)


@dataclass
class WarningCollector:
    """The warnings of a unit, each place and id once. The last one that is kept of an id says that there are more."""

    found: dict[tuple[str, str, int, int], StWarning] = field(default_factory=dict)
    counts: Counter[str] = field(default_factory=Counter)

    def add(self, warning: StWarning) -> None:
        """Add a warning; beyond `MAX_WARNINGS` of its id it is dropped."""
        key = (warning.id, warning.path, warning.line, warning.column)
        if key in self.found or self.counts[warning.id] == MAX_WARNINGS:
            return
        self.counts[warning.id] += 1
        if self.counts[warning.id] == MAX_WARNINGS:
            warning = replace(warning, message=f"{warning.message}; further warnings {warning.id} are not listed")
        self.found[key] = warning

    def sorted(self) -> tuple[StWarning, ...]:
        """Return the warnings by file, line and column."""
        return tuple(sorted(self.found.values(), key=lambda w: (w.path, w.line, w.column, w.id)))
