"""What a case is: an id of the catalogue, what the device does, what the master must do, and who judges it.

Protocols are elsewhere.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum

from fieldtwin.conformance.observation import Observation
from fieldtwin.report.model import Verdict

TRAIL_S = 0.3
"""How long a case looks on after the master is back to good, where it does not say otherwise: what comes late is seen."""


class Danger(Enum):
    """What a case may do to whatever is behind the master, in rising order."""

    OBSERVE = "observe"
    """Nothing: it only listens."""
    READ = "read"
    """Reads are answered oddly."""
    WRITE = "write"
    """Writes are answered oddly: the master may repeat them."""
    DISRUPT = "disrupt"
    """The connection is cut, or the line disturbed for everybody on it."""

    @property
    def rank(self) -> int:
        return list(Danger).index(self)


class Basis(Enum):
    """Why a case asks what it asks, and so how much a failure of it weighs."""

    STANDARD = "standard"
    """The clause of the standard that the case names requires it: a failure is a deviation."""
    ROBUSTNESS = "robustness"
    """No clause requires it. A device that fails is less tolerant than it could be, and still conforms."""
    FIELD = "field problem"
    """Devices in the field are known to fail here; the case names the project to which that was reported. A device that fails
    conforms, but may cause the same trouble."""


@dataclass(frozen=True, slots=True)
class Finding:
    """A verdict and the one sentence that says why."""

    verdict: Verdict
    reason: str = ""


def passed(reason: str = "") -> Finding:
    return Finding(Verdict.PASSED, reason)


def failed(reason: str) -> Finding:
    return Finding(Verdict.FAILED, reason)


def skipped(reason: str) -> Finding:
    return Finding(Verdict.SKIPPED, reason)


def inconclusive(reason: str) -> Finding:
    return Finding(Verdict.INCONCLUSIVE, reason)


Judge = Callable[[Observation], Finding]
"""Pure: the same observation, the same finding."""


@dataclass(frozen=True, slots=True)
class About:
    """The part of a case that people see.

    `id` is the catalogue's, with a letter behind it where a row is several cases. `clause` names the source as
    the catalogue does. `does` is what the checker does, `must` what is expected of whom it judges, who has the `role`.
    """

    id: str
    title: str
    clause: str
    danger: Danger
    does: str
    must: str

    @property
    def row(self) -> str:
        """The row of the catalogue."""
        return self.id.rstrip("abcdefgh")

    @property
    def role(self) -> str:
        """Whom the case judges."""
        return "master"

    @property
    def weighs(self) -> Basis:
        """How much a failure weighs. Cases for masters all weigh the same."""
        return Basis.STANDARD

    def chosen(self, only: frozenset[str]) -> bool:
        """Whether `only` names it, or its row; all are chosen by none."""
        return not only or self.id in only or self.row in only


@dataclass(frozen=True, slots=True)
class Case(About):
    """A case for masters, with its judge."""

    judge: Judge
