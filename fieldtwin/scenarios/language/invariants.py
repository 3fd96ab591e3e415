"""The invariants of a system file: rules that hold in every run, scenario and campaign, read and checked against the
system.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

from fieldtwin.emulators.faults.schema import seconds
from fieldtwin.gateway.core.errors import UsageError
from fieldtwin.gateway.core.files.yaml_file import Key
from fieldtwin.scenarios.language.expression import Expression
from fieldtwin.twin.site.system import System


@dataclass(frozen=True)
class Stated:
    """An expression that must be true always (`wanted` True) or never (False).

    `number` is its name in reports, `where` FILE:LINE.
    """

    number: str
    where: str
    expression: Expression
    wanted: bool


@dataclass(frozen=True)
class Followed:
    """The rule that `then` becomes true within `limit_s` of each time that `after` becomes true."""

    number: str
    where: str
    after: Expression
    then: Expression
    limit_s: float


@dataclass(frozen=True)
class Invariants:
    """The invariants of a system, or of all systems of a network."""

    stated: tuple[Stated, ...] = ()
    followed: tuple[Followed, ...] = ()

    def __bool__(self) -> bool:
        return bool(self.stated or self.followed)

    def __add__(self, other: Invariants) -> Invariants:
        return Invariants(self.stated + other.stated, self.followed + other.followed)

    @property
    def names(self) -> set[str]:
        """The tags and variables that the invariants use."""
        every = [one.expression for one in self.stated]
        every += [part for one in self.followed for part in (one.after, one.then)]
        return {name for expression in every for name in expression.names}


def load_invariants(system: System, names: Mapping[str, tuple[str, ...]], prefix: str = "") -> Invariants:
    """Read the invariants of a system file. `names` are the names that expressions may contain, with the words that a
    state can be.

    `prefix` is the system's name in its network, with a dot; the names of the result begin with it. Raises
    `FileInvalid`.
    """
    form = system.invariants
    words = {name: states for name, states in names.items() if states}

    def expression(text: str, *loc: Key) -> Expression:
        try:
            read = Expression(text, names, words, prefix)
        except UsageError as e:
            raise system.file.error(loc, e.message, expected=e.expected, got=e.got, hint=e.hint) from e
        if read.is_constant:
            raise system.file.error(
                loc, "the expression refers to no value", expected="a tag or a variable in it", got=text
            )
        return read

    def where(*loc: Key) -> str:
        return f"{system.path}:{system.file.line(loc)}"

    def stated() -> Iterator[Stated]:
        for word, texts, wanted in (("always", form.always, True), ("never", form.never, False)):
            for n, text in enumerate(texts):
                loc = ("invariants", word, n)
                yield Stated(f"{prefix}invariant {word} {n + 1}", where(*loc), expression(text, *loc), wanted)

    def followed() -> Iterator[Followed]:
        for n, one in enumerate(form.within):
            loc = ("invariants", "within", n)
            try:
                limit_s = seconds(one.within)
            except UsageError as e:
                raise system.file.error((*loc, "within"), e.message, expected=e.expected, got=e.got, hint=e.hint) from e
            after, then = expression(one.after, *loc, "after"), expression(one.then, *loc, "then")
            yield Followed(f"{prefix}invariant within {n + 1}", where(*loc), after, then, limit_s)

    return Invariants(tuple(stated()), tuple(followed()))
