"""Find the explanations of an ID, a code or a word, as users copy it from a message."""

from __future__ import annotations

import re
from collections.abc import Sequence
from functools import cache

from fieldtwin.explain.explanation import Explanation
from fieldtwin.gateway.core.errors import UsageError
from fieldtwin.gateway.core.files.nearest import nearest

_CASE = re.compile(r"(mb|co)-?0*(\d{1,3})([a-h]?)")


@cache
def everything() -> tuple[Explanation, ...]:
    """Return all explanations, grouped by kind."""
    from fieldtwin.explain.cases import CASES
    from fieldtwin.explain.commissioning_words import COMMISSIONING_WORDS
    from fieldtwin.explain.errors import ERRORS
    from fieldtwin.explain.faults import EXPLAINED_FAULTS
    from fieldtwin.explain.modbus_exceptions import EXCEPTIONS
    from fieldtwin.explain.qualities import QUALITIES
    from fieldtwin.explain.sdo_aborts import ABORTS
    from fieldtwin.explain.st_warnings import ST_WARNINGS
    from fieldtwin.explain.verdicts import VERDICTS

    words = (*VERDICTS, *COMMISSIONING_WORDS, *ST_WARNINGS)
    return (*EXCEPTIONS, *ABORTS, *QUALITIES, *ERRORS, *EXPLAINED_FAULTS, *words, *CASES)


def explain(text: str) -> Sequence[Explanation]:
    """Return the explanations of `text`; several if a word has several meanings, such as a fault and a reason.

    Spelling is tolerant: case, ``MB-15`` for ``MB-015``, ``02h`` and ``0x02`` for an exception. Raises `UsageError`, which
    suggests similar words.
    """
    word = " ".join(text.lower().split())
    case = _CASE.fullmatch(word.replace(" ", ""))
    if case is not None:
        word = f"{case[1]}-{int(case[2]):03}{case[3]}"
    found = [entry for entry in everything() if word in entry.words]
    if found:
        return found
    known = [spelling for entry in everything() for spelling in entry.words]
    near = nearest(word, known, most=3)
    raise UsageError(
        f"no explanation of {text!r}",
        expected="a test case (MB-015), a fault, `exception 02`, an SDO abort code, a quality or its reason, a verdict, "
        "a certainty, an error, a warning of Structured Text, `exit 4`",
        hint=f"similar: {', '.join(near)}" if near else "`fieldtwin explain` without a word lists all",
    )
