"""A test case: its ID in the test-case list, the action of the device, the expected reaction of the client, and its check.

This module does not depend on a protocol.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from enum import Enum
from typing import Self

from fieldtwin.conformance.core.observation import Observation
from fieldtwin.results.model import Verdict

TRAIL_S = 0.3
"""Default time in seconds that a case continues after the client has recovered, so that late effects are seen."""


class Impact(Enum):
    """The impact levels of a case on the equipment that the client controls, in rising order."""

    OBSERVE = "observe"
    """No effect: the case only listens."""
    READ = "read"
    """The simulated device answers reads with faults; the plant behind the client stays unchanged."""
    WRITE = "write"
    """The simulated device answers writes with faults, so the client may repeat them."""
    DISRUPT = "disrupt"
    """The connection is cut, or the line is disturbed for all devices on it."""

    @property
    def rank(self) -> int:
        return list(Impact).index(self)


class Basis(Enum):
    """The reason for a case's expectation, which determines the weight of a failure."""

    STANDARD = "standard"
    """The clause of the standard that the case names requires it: a failure is a deviation."""
    ROBUSTNESS = "robustness"
    """No clause requires it. A device or master that fails the case is less tolerant than it could be, and still conforms."""
    FIELD = "field problem"
    """Known products fail here; the case names the project to which that was reported.

    A device or master that fails conforms, but may cause the same trouble.
    """


OTHER_WIRE = "not on this kind of bus"
"""The reason that is shown for a skipped case that is for other transports."""
OWN = "fieldtwin"
"""The source of a case that is based neither on a clause nor on a report of another project."""


@dataclass(frozen=True, slots=True)
class Elsewhere:
    """The basis and the source of a case on one kind of transport, where they differ from those on all others.

    `trait` is the transport's name in the program (see `HostileServer` and `RtuWire`), `wire` its name for users.
    """

    trait: str
    wire: str
    basis: Basis
    clause: str


@dataclass(frozen=True, slots=True)
class Finding:
    """A verdict and a sentence with its reason."""

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


CheckFunction = Callable[[Observation], Finding]
"""A function that checks a case. It depends on nothing else: the same observation always gives the same finding."""


@dataclass(frozen=True, slots=True)
class About:
    """The part of a case that is shown to users.

    `id` is that of the test-case list, followed by a letter where one entry has several cases. `clause` names the
    source: the clause of the standard, or the project that reported the problem. `does` is the checker's action,
    beginning with a verb ("inverts the CRC"), `must` is the expected behaviour of the device or master, which has the
    `role`. `elsewhere` overrides `basis` and `clause` for certain kinds of transport.
    """

    id: str
    title: str
    clause: str
    impact: Impact
    does: str
    must: str
    basis: Basis = field(kw_only=True)
    elsewhere: tuple[Elsewhere, ...] = field(default=(), kw_only=True)

    @property
    def row(self) -> str:
        """Return the ID of the entry in the test-case list: `id` without its letter."""
        return self.id.rstrip("abcdefgh")

    @property
    def role(self) -> str:
        """Return the tested role: ``client``, or ``device`` for a case for devices."""
        return "client"

    @property
    def required_by(self) -> str:
        """Return the clauses that require the behaviour, such as ``TG 4.4.1.3, AP 6.3``; empty if none does."""
        if self.basis is not Basis.STANDARD:
            return ""
        clauses = self.clause.split(";")[0]
        return f"CiA 301, {clauses}" if clauses[:1].isdigit() else clauses

    @property
    def bases(self) -> str:
        """Return the basis as text: ``standard``, or ``standard; TCP: robustness`` if it differs on some transports."""
        return "; ".join(
            [self.basis.value, *(f"{e.wire}: {e.basis.value}" for e in self.elsewhere if e.basis is not self.basis)]
        )

    @property
    def sources(self) -> str:
        """Return `clause` followed by the sources on other transports: ``SL 2.4.1; TCP: TG 4.4.1.3``."""
        return "; ".join([self.clause, *(f"{e.wire}: {e.clause}" for e in self.elsewhere)])

    def on_wire(self, traits: frozenset[str]) -> Self:
        """Return the case with its basis and source on a transport with these traits."""
        for each in self.elsewhere:
            if each.trait in traits:
                return replace(self, basis=each.basis, clause=each.clause, elsewhere=())
        return replace(self, elsewhere=()) if self.elsewhere else self

    def chosen(self, only: frozenset[str]) -> bool:
        """Return whether `only` contains its ID or its entry; an empty `only` selects all cases."""
        return not only or self.id in only or self.row in only


@dataclass(frozen=True, slots=True)
class CasePlan:
    """The choice of cases, and the limits of a run.

    `only` are IDs or entries of the test-case list, all if empty; `at_most` is the highest impact level; `has` the inputs
    and options that some cases need (``holding``, ``coil``, ``object``, ``eds``, ``i-know``, ``echo``); no case begins
    `for_s` seconds after the start or later, 0 for no limit.
    """

    only: frozenset[str] = frozenset()
    at_most: Impact = Impact.READ
    has: frozenset[str] = frozenset()
    for_s: float = 0.0


@dataclass(frozen=True, slots=True)
class ClientCase(About):
    """A case for masters, with its check."""

    check: CheckFunction
