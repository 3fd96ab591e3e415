"""An explanation of an ID, a code or a word: its meaning, its source, and what to do about it."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Explanation:
    """An entry of `fieldtwin explain`.

    `id` is what is printed elsewhere, such as ``MB-015`` or ``exception 02``. `also` are further spellings that find it.
    `meaning` describes it and its causes in a few sentences, and `todo` states what to do. `source` is the clause of the
    standard, or the page of the documentation. `page` is the page of the book about this entry alone, if there is one.
    """

    id: str
    kind: str
    title: str
    meaning: str
    todo: str
    source: str = ""
    also: tuple[str, ...] = ()
    page: str = ""

    @property
    def words(self) -> tuple[str, ...]:
        """Return all spellings by which a user can look up this entry, in lower case."""
        return tuple(dict.fromkeys(word.lower() for word in (self.id, *self.also)))
