"""The invariants of a system file: rules that hold in every run, scenario and campaign, read and checked against the
system.
"""

from __future__ import annotations

from collections.abc import Container, Mapping
from dataclasses import dataclass

from fieldtwin.emulators.faults.schema import seconds
from fieldtwin.gateway.core.conditions.expression import Expression, Words
from fieldtwin.gateway.core.conditions.located_expression import read_expression
from fieldtwin.gateway.core.errors import UsageError
from fieldtwin.gateway.core.files.error_collector import ErrorCollector
from fieldtwin.gateway.core.files.yaml_file import Key, YamlFile
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
    """The invariant that `then` becomes true within `limit_s` of each time that `after` becomes true."""

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
        """Return the tags and variables that the invariants use."""
        every = [one.expression for one in self.stated]
        every += [part for one in self.followed for part in (one.after, one.then)]
        return {name for expression in every for name in expression.names}


def load_invariants(
    system: System,
    names: Mapping[str, Words],
    errors: ErrorCollector,
    incomplete: Container[str] = frozenset(),
    prefix: str = "",
) -> Invariants:
    """Read the invariants of a system file. `names` are the names that expressions may contain, with the texts that each
    can equal; `incomplete` are the devices and programs that have errors.

    `prefix` is the system's name in its network, with a dot; the names of the result begin with it. Errors are added to
    `errors`; the result contains the invariants without error.
    """
    form, file = system.invariants, system.file
    stated: list[Stated] = []
    followed: list[Followed] = []

    def expression(text: str, *loc: Key) -> Expression:
        read = read_expression(file, loc, text, names, names, prefix=prefix, incomplete=incomplete)
        if read.is_constant:
            expected = "a tag or a variable in it"
            raise file.error(loc, "the expression refers to no value", expected=expected, got=text)
        return read

    def where(*loc: Key) -> str:
        return f"{system.path}:{file.line(loc)}"

    for word, texts, wanted in (("always", form.always, True), ("never", form.never, False)):
        for n, text in enumerate(texts):
            loc: tuple[Key, ...] = ("invariants", word, n)
            with errors.collect():
                number = f"{prefix}invariant {word} {n + 1}"
                stated.append(Stated(number, where(*loc), expression(text, *loc), wanted))
    for n, one in enumerate(form.within):
        loc = ("invariants", "within", n)
        after = then = None
        with errors.collect():
            after = expression(one.after, *loc, "after")
        with errors.collect():
            then = expression(one.then, *loc, "then")
        with errors.collect():
            limit_s = _seconds(file, (*loc, "within"), one.within)
            if after is not None and then is not None:
                number = f"{prefix}invariant within {n + 1}"
                followed.append(Followed(number, where(*loc), after, then, limit_s))
    return Invariants(tuple(stated), tuple(followed))


def _seconds(file: YamlFile, loc: tuple[Key, ...], text: str) -> float:
    try:
        return seconds(text)
    except UsageError as e:
        raise file.error(loc, e.message, expected=e.expected, got=e.got, hint=e.hint) from e
